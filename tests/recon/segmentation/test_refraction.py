"""Do lines bend, hasten and fade at a mass as the laws say, and as a plain follower does?"""

import numpy as np
import pytest

from recon.files.volumes import Volume
from recon.geometry import rigid
from recon.segmentation import refraction
from recon.segmentation.mass_surface import FAR_MM
from recon.segmentation.refraction import Sound, follow

SPACING, SIZE = 0.5, (72, 72, 64)  # nx, ny, nz: 36 x 36 x 32 mm
CENTRE, RADIUS = np.array([3.0, 698.0, 14.0]), 5.0
ORIGIN = CENTRE - [18.0, 14.0, 16.0]


def inside_of_ball():
    k, j, i = np.mgrid[: SIZE[2], : SIZE[1], : SIZE[0]]
    places = ORIGIN + SPACING * np.stack([i, j, k], axis=-1)
    distance = (np.linalg.norm(places - CENTRE, axis=-1) - RADIUS).astype(np.float32)
    return Volume(np.minimum(distance, FAR_MM), ORIGIN, np.full(3, SPACING))


def test_lines_through_a_fast_ball():
    """Along its axis 10 mm of mass at 1600 m/s are shown as 9.375 mm of tissue at 1500, and little is lost."""
    scale = (0.2, 0.1)
    pose = rigid.transform(np.eye(3), [CENTRE[0] - 16, CENTRE[1] - 13, CENTRE[2]]) @ np.diag([*scale, 1, 1])
    lines = follow(inside_of_ball(), scale, pose, (320, 161), Sound(tissue=1500, mass=1600))
    middle = 80
    assert lines.within[-1, middle] == pytest.approx(2 * RADIUS, abs=0.15)
    assert lines.v[-1, middle] * scale[1] == pytest.approx(31.9 + 2 * RADIUS * (1 - 1500 / 1600), abs=0.02)
    assert lines.u[-1, middle] == pytest.approx(middle, abs=0.05)
    assert 0.99 < lines.passed[-1, middle] < 1
    np.testing.assert_allclose(lines.u[:, 10], 10, atol=1e-4)  # beside it


def test_a_fast_ball_spreads_lines_and_its_flanks_let_nothing_through():
    """At half of the radius the incidence is 30 deg: Snell bends by 2.3 deg at each border. Beyond 70 deg all is reflected."""
    scale = (0.2, 0.1)
    pose = rigid.transform(np.eye(3), [CENTRE[0] - 16, CENTRE[1] - 13, CENTRE[2]]) @ np.diag([*scale, 1, 1])
    lines = follow(inside_of_ball(), scale, pose, (320, 161), Sound(tissue=1500, mass=1600))
    at = 80 + round(RADIUS / 2 / scale[0])
    leaving = np.flatnonzero(lines.within[:, at] >= lines.within[-1, at] - 1e-3)[0]
    slope = np.polyfit(lines.v[leaving + 20 :, at] * scale[1], lines.u[leaving + 20 :, at] * scale[0], 1)[0]
    bend = np.arcsin(1600 / 1500 * 0.5) - np.arcsin(0.5)
    assert slope == pytest.approx(np.tan(2 * bend), rel=0.25)
    assert lines.passed[-1, 80 + round(0.97 * RADIUS / scale[0])] == 0


def test_equal_speeds_leave_pixels_where_they_are():
    scale = (0.2, 0.1)
    pose = rigid.transform(np.eye(3), [CENTRE[0] - 16, CENTRE[1] - 13, CENTRE[2]]) @ np.diag([*scale, 1, 1])
    lines = follow(inside_of_ball(), scale, pose, (320, 161), Sound())
    v, u = np.mgrid[:320, :161]
    np.testing.assert_allclose(lines.u, u, atol=1e-3)
    np.testing.assert_allclose(lines.v, v, atol=1e-3)


def plain_line(inside, scale, pose, column, rows, ratio):
    """A line followed with a look at each of its steps: u, v, way in masses, power and whether inside, a row each."""
    voxel_from_pixel = np.linalg.inv(inside.world_from_voxel) @ pose

    def distance(u, depth):
        place = (voxel_from_pixel @ [u, depth / scale[1], 0, 1])[:3]
        low = np.floor(place).astype(int)
        if (low < 0).any() or (low + 1 >= inside.voxels.shape[::-1]).any():
            return refraction.OUTSIDE_MM
        (i, j, k), share = low, place - low
        cube = inside.voxels[k : k + 2, j : j + 2, i : i + 2].astype(float)
        for part in share[::-1]:
            cube = cube[0] * (1 - part) + cube[1] * part
        return float(cube)

    u, depth, shown, slope, way, power = float(column), 0.0, 0.0, 0.0, 0.0, 1.0
    within, result = distance(u, 0.0) < 0, []
    for row in range(rows):
        while shown < row * scale[1]:
            step = refraction.STEP_MM / ratio if within else refraction.STEP_MM
            share = min(1.0, (row * scale[1] - shown) / step) + 1e-9
            length = share * refraction.STEP_MM
            depth, shown, u, way = depth + length, shown + share * step, u + length * slope / scale[0], way + length * within
            if (distance(u, depth) < 0) != within:
                within = not within
                faster = ratio if within else 1 / ratio
                reach = refraction.REACH_MM
                across = (distance(u + reach / scale[0], depth) - distance(u - reach / scale[0], depth)) / (2 * reach)
                down = (distance(u, depth + reach) - distance(u, depth - reach)) / (2 * reach)
                cosine = min(1.0, abs(down))
                sine = np.sqrt(1 - cosine**2)
                if cosine * refraction.STEEPEST < sine or faster * sine >= 1:
                    power = 0.0
                if cosine * refraction.STEEPEST >= sine:
                    onwards = np.sqrt(max(1 - (faster * sine) ** 2, 0))
                    power *= (1 - ((faster * cosine - onwards) / (faster * cosine + onwards)) ** 2) ** 2
                    slope -= (faster - 1) * across / down
        result.append((u, depth / scale[1], way, power, within))
    return np.array(result, float).T


@pytest.mark.parametrize("speed", [1400, 1600])
def test_lines_are_those_of_a_plain_follower(speed):
    """Past the ball, along its flank, through it; and from within the ball, where the probe's face cuts it."""
    scale = (0.2, 0.1)
    for start, columns in ((13.0, (40, 57, 70, 84)), (1.0, (75, 90))):
        pose = rigid.from_rotation_vector([0.05, 0.1, -0.05], [CENTRE[0] - 16, CENTRE[1] - start, CENTRE[2]]) @ np.diag(
            [*scale, 1, 1]
        )
        lines = follow(inside_of_ball(), scale, pose, (200, 161), Sound(tissue=1500, mass=speed))
        for column in columns:
            plain = plain_line(inside_of_ball(), scale, pose, column, 200, speed / 1500)
            np.testing.assert_allclose([each[:, column] for each in lines], plain, rtol=1e-5, atol=1e-5)


def test_some_columns_are_as_among_all():
    scale = (0.2, 0.1)
    pose = rigid.transform(np.eye(3), [CENTRE[0] - 16, CENTRE[1] - 13, CENTRE[2]]) @ np.diag([*scale, 1, 1])
    whole, some = (follow(inside_of_ball(), scale, pose, (300, 161), Sound(1500, 1600), every) for every in (1, 4))
    for all_, thinned in zip(whole, some, strict=True):
        np.testing.assert_array_equal(all_[:, ::4], thinned)
