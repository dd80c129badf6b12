"""Echoes of needles and styluses, beside Huygens' sum over their surface, and closed forms."""

from dataclasses import replace

import numpy as np
import pytest

from scenes.acoustics import TISSUES
from scenes.handheld.shaft import Shaft
from scenes.tissue import Tissue
from tests.twin.ultrasound.phantoms import down
from twin.ultrasound import bmode_image
from twin.ultrasound.beam import BAND, STEP_MM, _diffract, beam, through_lens
from twin.ultrasound.bscan import scan
from twin.ultrasound.echo_solids import Body
from twin.ultrasound.sound_paths import follow
from twin.ultrasound.tool_echoes import Tool, tool_echoes
from twin.ultrasound.transducer import Transducer

SOFT = Tissue(1.5, 1540.0, 0.0, None)  # without loss or echoes
HARD = Tissue(1e6, 1e6, 0.0, None)  # a mirror, in which nothing rings
RADIUS, DEPTH = 0.4, 22.0
POSE = np.eye(4)


def rod(array: Transducer, angle_deg: float, tip=(0.0, DEPTH, 0.0), heading_deg: float = 0.0, length=60.0, **fields) -> Shaft:
    """A hard rod with a round end, led down to the right; the tip from the middle of the face."""
    angle, heading = np.radians([angle_deg, heading_deg])
    along = np.array([np.cos(angle) * np.cos(heading), np.sin(angle), np.cos(angle) * np.sin(heading)])
    up = np.array([np.sin(angle) * np.cos(heading), -np.cos(angle), np.sin(angle) * np.sin(heading)])
    place = np.add(tip, [array.width_mm / 2, 0.0, 0.0])
    return Shaft(place, along, up, length, RADIUS, HARD, **({"kind": "ball", "ball": RADIUS} | fields))


def received(array: Transducer, *shafts: Shaft, medium: Tissue = SOFT) -> np.ndarray:
    """Envelope (h, w) of what comes back from shafts alone, 1 from a perfect mirror."""
    body, spread = Body(medium, (), ()), beam(array)
    paths = follow(body, array, POSE)
    return np.abs(bmode_image.focused(sum(tool_echoes(Tool(one), body, array, spread, paths, POSE) for one in shafts), spread))


Surface = tuple[np.ndarray, np.ndarray, np.ndarray]  # points, normals, areas


def round_end(shaft: Shaft, length: float, step: float) -> Surface:
    """All over a cylinder with half a ball at its end, of some length from the tip."""
    polar = np.arange(step / 2 / RADIUS, np.pi / 2, step / RADIUS)
    height = np.arange(RADIUS + step / 2, length, step)
    radius = np.concatenate([RADIUS * np.sin(polar), np.full(len(height), RADIUS)])
    back = np.concatenate([RADIUS * (1 - np.cos(polar)), height])
    lean = np.concatenate([np.cos(polar), np.zeros(len(height))])
    turn = np.arange(0, 2 * np.pi, step / RADIUS)
    side = np.cross(shaft.along, shaft.up)
    out = np.outer(np.cos(turn), shaft.up) + np.outer(np.sin(turn), side)
    points = shaft.tip - back[:, None, None] * shaft.along + radius[:, None, None] * out
    normals = lean[:, None, None] * shaft.along + np.sqrt(1 - lean**2)[:, None, None] * out
    areas = np.broadcast_to((radius * step * (turn[1] - turn[0]))[:, None], points.shape[:2])
    return points.reshape(-1, 3), normals.reshape(-1, 3), areas.ravel()


def cut_end(shaft: Shaft, length: float, step: float) -> Surface:
    """All over a cylinder that a plane cuts at the shaft's angle, its point away from `up`."""
    slope, side = 1 / np.tan(shaft.angle), np.cross(shaft.along, shaft.up)
    count = int(2 * np.pi * RADIUS / step)
    turn = 2 * np.pi * np.arange(count) / count
    out = np.outer(np.cos(turn), shaft.up) + np.outer(np.sin(turn), side)
    centre = shaft.tip + RADIUS * shaft.up
    height = np.arange(step / 2, length, step)
    back = RADIUS * (1 + np.cos(turn)) * slope + height[:, None]
    wall = centre + RADIUS * out - back[..., None] * shaft.along
    radius = np.arange(step / 2, RADIUS, step)
    x, y = np.outer(radius, np.cos(turn)), np.outer(radius, np.sin(turn))
    face = centre + x[..., None] * shaft.up + y[..., None] * side - (RADIUS + x)[..., None] * slope * shaft.along
    normal = np.cos(shaft.angle) * shaft.up + np.sin(shaft.angle) * shaft.along
    normals = np.concatenate(
        [np.broadcast_to(out, wall.shape).reshape(-1, 3), np.broadcast_to(normal, face.shape).reshape(-1, 3)]
    )
    width = 2 * np.pi / count
    areas = np.concatenate(
        [np.full(wall[..., 0].size, step * RADIUS * width), np.repeat(radius, count) * step * width / np.sin(shaft.angle)]
    )
    return np.concatenate([wall.reshape(-1, 3), face.reshape(-1, 3)]), normals, areas


def huygens(array: Transducer, shaft: Shaft, line_mm: float, depths: np.ndarray) -> np.ndarray:
    """Envelope at depths : (n,) on a line, of Kirchhoff's integral over the surface of a hard rod, with no raster between."""
    points, normals, areas = (cut_end if shaft.kind == "bevel" else round_end)(shaft, 12.0, 0.02)
    x, y, z = points.T
    cosine = -normals[:, 1]
    kept = (cosine > 0) & (np.abs(x - line_mm) < 3.9) & (np.abs(z) < 3.5) & (y > 8)
    x, y, z, weight = x[kept] - line_mm, y[kept], z[kept], (cosine * areas)[kept]
    offsets, rows = np.arange(0, 4.0, 0.01), np.arange(8.0, 30.0, 0.5)
    send = array.transmit_focus_mm / array.transmit_f_number
    table = np.empty((len(rows), len(offsets)), complex)
    lens = np.empty((len(rows), len(offsets)), complex)
    for k, row in enumerate(rows):
        receive = float(np.clip(row / array.receive_f_number, 1, array.aperture_mm))
        sent = _diffract(offsets, row, send, array.transmit_focus_mm, array.wavelength_mm, apodised=True)
        table[k] = sent * _diffract(offsets, row, receive, row, array.wavelength_mm, apodised=True) / receive
        near, far = array.bandwidth
        share = BAND * (near + (far - near) * row / array.depth_mm)
        band = np.exp(-8 * np.log(2) * BAND**2)
        waves = array.wavelength_mm / (1 + share)
        lens[k] = band / band.sum() @ through_lens(offsets, row, array.elevation_mm, array.elevation_focus_mm, waves) ** 2
    a, b, c = (y - 8) / 0.5, np.abs(x) / 0.01, np.abs(z) / 0.01

    def at(grid: np.ndarray, row: np.ndarray, column: np.ndarray) -> np.ndarray:
        i, j = row.astype(int), column.astype(int)
        p, q = row - i, column - j
        return (1 - p) * ((1 - q) * grid[i, j] + q * grid[i, j + 1]) + p * ((1 - q) * grid[i + 1, j] + q * grid[i + 1, j + 1])

    echo = weight * at(table, a, b) * at(lens, a, c) / array.elevation_mm * np.exp(2j * array.wavenumber * y)
    sigma = array.axial_sigma_mm(depths)[:, None]
    return np.abs(
        np.array([(echo * np.exp(-0.5 * ((depth - y) / s) ** 2)).sum() for depth, s in zip(depths, sigma, strict=True)])
    )


def brightest(array: Transducer, shaft: Shaft, behind_mm: float) -> tuple[float, float]:
    """Within some mm of a place on the shaft, down its line: as the twin has it, and by Huygens' sum."""
    sx, sy = array.scale_mm_per_px
    place = shaft.tip - behind_mm * shaft.along
    column, rows = round(place[0] / sx), np.arange(round((place[1] - 2.0) / sy), round((place[1] + 1.0) / sy))
    rows = rows[rows > 80]
    return received(array, shaft)[rows, column].max(), huygens(array, shaft, sx * column, sy * rows).max()


@pytest.mark.parametrize(
    ("angle_deg", "heading_deg", "beside_mm"),
    [(0, 0, 0), (6, 0, 0), (9, 0, 0), (0, 0, 0.7), (3, 90, 0), (10, 90, 0), (4, 30, 0.3)],
)
@pytest.mark.parametrize("behind_mm", [0.0, 5.0])
def test_a_shaft_is_huygens_sum_over_its_surface(clean, angle_deg, heading_deg, beside_mm, behind_mm):
    """To 1.5 dB: the series has orders beyond a mirror's, and beside the plane the beam falls over the strip's width."""
    found, expected = brightest(clean, rod(clean, angle_deg, (0.0, DEPTH, beside_mm), heading_deg), behind_mm)
    assert found == pytest.approx(expected, rel=0.18, abs=5e-4)


@pytest.mark.parametrize(
    ("angle_deg", "heading_deg", "beside_mm"), [(25, 0, 0), (45, 0, 0), (60, 0, 0), (45, 0, 0.6), (40, 90, 0), (50, 40, 0)]
)
def test_a_steep_shaft_is_seen_by_its_end_alone(clean, angle_deg, heading_deg, beside_mm):
    """A cut of 45 degrees diffracts as Huygens' sum has it, to 2 dB; 5 mm behind it all is 70 dB below a mirror."""
    cut = rod(clean, angle_deg, (0.0, DEPTH, beside_mm), heading_deg, kind="bevel", angle=np.radians(45), ball=0.0)
    found, expected = brightest(clean, cut, 0.0)
    assert found == pytest.approx(expected, rel=0.25, abs=5e-4)
    assert max(brightest(clean, cut, 5.0)) < 4e-4


def test_a_ball_is_as_bright_as_a_mirrors_patch(clean):
    """A point of lambda / 2 (1 / r + 1 / y), as the beam's waves are bent, too; its echo the tables give. To 0.4 dB."""
    spread, row = beam(clean), 180
    depth = row * clean.scale_mm_per_px[1]
    along, up = np.array([0.0, -1.0, 0.0]), np.array([1.0, 0.0, 0.0])  # led from below: its end is nearest
    envelope = received(clean, replace(rod(clean, 90, (0.0, depth, 0.0), ball=1.0), along=along, up=up))
    across = np.interp(depth, spread.depth_step_mm * np.arange(len(spread.elevation)), np.abs(spread.elevation[:, 0]))
    expected = clean.wavelength_mm / 2 / (1 + 1 / depth) * np.abs(spread.lateral[row, spread.lateral.shape[1] // 2]) * across
    assert envelope[row - 4 : row + 5].max() == pytest.approx(expected, rel=0.05)


def test_beside_the_plane_it_fades_as_the_beam(clean):
    """A thin rod parallel to the plane: as the two-way beam across it, to 0.5 dB down to -30 dB."""
    spread, sy = beam(clean), clean.scale_mm_per_px[1]
    rows = slice(round((DEPTH - 1.5) / sy), round((DEPTH + 1) / sy))
    row = round(DEPTH / spread.depth_step_mm)
    peaks, expected = [], []
    for beside in (0.0, 0.3, 0.6, 0.9, 1.2):
        thin = replace(rod(clean, 0, (8.0, DEPTH, beside)), radius=0.1, ball=0.1)
        peaks.append(received(clean, thin)[rows, clean.image_size[0] // 2].max())
        expected.append(np.abs(spread.elevation[row, round(beside / STEP_MM)]))
    found, wanted = 20 * np.log10(np.array(peaks) / peaks[0]), 20 * np.log10(np.array(expected) / expected[0])
    assert wanted[-1] < -15
    np.testing.assert_allclose(found, wanted, atol=0.8)


def test_between_it_and_the_face_it_repeats(clean):
    """At twice its depth, R r sqrt(a / 4 y) weaker, as what it sends back spreads in one direction; and by the beam there."""
    array = clean.model_copy(update={"reverberations": 1, "face_reflection": 0.3})
    spread, sy = beam(array), array.scale_mm_per_px[1]
    envelope = received(array, rod(array, 0, (15.0, DEPTH, 0.0)))
    front = DEPTH - RADIUS
    first, second = (round(order * front / sy) for order in (1, 2))
    column = array.image_size[0] // 2
    peaks = [envelope[row - 4 : row + 5, column].max() for row in (first, second)]
    sums = [np.abs(spread.lateral[row].sum()) for row in (first, second)]
    expected = 0.3 * np.sqrt(RADIUS / (4 * front)) * sums[1] / sums[0]
    assert peaks[1] / peaks[0] == pytest.approx(expected, rel=0.12)
    tilted = received(array, rod(array, 15, (15.0, DEPTH, 0.0)))
    assert tilted[second - 30 : second + 31].max() < 0.02 * peaks[1], "to the side, past the aperture"


def test_roughness_shows_a_steep_shaft(clean):
    """Lambert's law over the front, where it is small: 3 / 8 a (2 k sigma)² cos⁴ of R² a mm, as scatterers are summed."""
    sigma, angle = 0.003, np.radians(45)
    shaft = replace(rod(clean, 45, (14.0, 36.0, 0.0)), material=replace(HARD, roughness=sigma))
    envelope = received(clean, shaft)
    spread, (sx, sy) = beam(clean), clean.scale_mm_per_px
    columns = np.arange(110, 210)
    rows = np.rint((36.0 - (14.0 + clean.width_mm / 2 - sx * columns) * np.tan(angle)) / sy).astype(int)
    power = np.array(
        [(envelope[row - 12 : row + 13, column] ** 2).sum() for row, column in zip(rows, columns, strict=True)]
    ).mean()
    length = 1 / np.sin(angle)  # of shaft a mm of depth
    f2 = 3 / 8 * RADIUS * (2 * clean.wavenumber * sigma) ** 2 * np.cos(angle) ** 4 * clean.wavelength_mm**2
    middle = rows[len(rows) // 2]
    cell = (np.abs(spread.lateral[middle]) ** 2).sum() * sx
    pulse = (spread.axial[middle] ** 2).sum() * sy / 2
    across = np.abs(spread.elevation[round(middle * sy / spread.depth_step_mm), 0]) ** 2
    expected = f2 * across * cell * pulse / sy * length
    assert 10 * np.log10(power / expected) == pytest.approx(0, abs=2.0)


def test_a_needle_shines_at_its_tip_when_the_shaft_does_not(clean):
    """At 40 degrees, of polished steel: tip over shaft by 10 dB or more, at the place that truth tells."""
    shaft = replace(rod(clean, 40), material=replace(TISSUES["steel"], roughness=0.0), kind="bevel", ball=0.0)
    envelope, (sx, sy) = received(clean, shaft), clean.scale_mm_per_px
    v, u = np.unravel_index(envelope.argmax(), envelope.shape)
    assert np.hypot(u * sx - shaft.tip[0], v * sy - shaft.tip[1]) < 4.5, "at the point or at the heel of its bevel"
    behind = shaft.tip - 12 * shaft.along
    near = envelope[
        round(behind[1] / sy) - 12 : round(behind[1] / sy) + 13, round(behind[0] / sx) - 2 : round(behind[0] / sx) + 3
    ]
    assert 20 * np.log10(envelope.max() / near.max()) > 10


def test_far_tools_change_nothing(small, speckle):
    """The same bytes without tools, and with one that stands elsewhere."""
    plain = scan(speckle, small, POSE, 3).image
    away = rod(small, 30, (0.0, 20.0, 40.0))
    np.testing.assert_array_equal(scan(speckle, small, POSE, 3, tools=(Tool(away),)).image, plain)
    there = rod(small, 30)
    assert (scan(speckle, small, POSE, 3, tools=(Tool(there),)).image != plain).any()


def test_it_moves_with_its_pose(clean):
    """The same picture of a tool and an image that are moved together."""
    shaft = rod(clean, 30)
    pose = down(clean, (4.0, -3.0, 650.0), 11.0)
    body, spread = Body(SOFT, (), ()), beam(clean)
    moved = tool_echoes(Tool(shaft.moved(pose)), body, clean, spread, follow(body, clean, pose), pose)
    found = np.abs(bmode_image.focused(moved, spread))
    assert np.abs(found - received(clean, shaft)).max() < 1e-4 * found.max()


def test_curved_arrays_see_it_where_it_is(clean):
    array = Transducer.model_validate(
        clean.model_dump()
        | {"image_size": (300, 300), "scale_mm_per_px": (0.2, 0.15), "curved": {"radius_mm": 40, "sector_deg": 60, "lines": 256}}
    )
    shaft = replace(rod(clean, 0), tip=np.array([array.face_mm[0] + 6.0, array.face_mm[1] + 20.0, 0.0]))
    image = scan(Body(SOFT, (), ()), array, POSE, 1, tools=(Tool(shaft),)).image
    v, u = np.unravel_index(image.argmax(), image.shape)
    assert abs(v * 0.15 - (shaft.tip[1] - RADIUS)) < 0.5 and u * 0.2 < shaft.tip[0] + 0.5
