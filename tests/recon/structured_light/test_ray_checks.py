"""Images of a wall, mirrored, turned, or with another calibration: what both devices see, both see from its front."""

import re
from dataclasses import replace

import numpy as np
import pytest

from recon.errors import InputError
from recon.geometry import rigid
from recon.geometry.camera import Camera
from recon.structured_light import ray_checks
from recon.structured_light.decode import ProjectorMap
from recon.structured_light.phase import Noise
from recon.structured_light.triangulate import PointMap, triangulate

SIZE = (160, 120)
CAMERA = Camera(SIZE, np.array([[400.0, 0, 80], [0, 400, 60], [0, 0, 1]]), np.zeros(5))
MATRIX = np.array([[1900.0, 0, 640], [0, 1900, 400], [0, 0, 1]])


def projector():
    """A projector 150 mm to the left of the camera that looks at the middle of the wall, 650 mm away."""
    turned, place = rigid.from_rotation_vector(np.array([0, -np.arctan2(150, 650), 0]), np.zeros(3)), np.eye(4)
    place[0, 3] = 150
    return Camera((1280, 800), MATRIX, np.zeros(5), turned @ place)


PROJECTOR = projector()


def seen(rng, rows):
    """The projector's coordinates : (h, w) px of a tilted, bowed wall, to 0.03 px."""
    rays = CAMERA.rays(CAMERA.pixel_grid())
    x, y = rays[..., 0] / rays[..., 2], rays[..., 1] / rays[..., 2]
    wall = rays / rays[..., 2:] * (650 + 60 * x - 40 * y + 100 * x * x)[..., None]
    pixels = PROJECTOR.project(wall.reshape(-1, 3)).reshape(*wall.shape[:2], 2)
    pixels = np.float32(pixels + rng.normal(scale=0.03, size=pixels.shape))
    return pixels[..., 0], pixels[..., 1] if rows else None


def decoded(columns, rows=None):
    """A map of columns, and of rows perhaps."""
    sigma, status = np.full(columns.shape, 0.03, np.float32), np.zeros(columns.shape, np.uint8)
    shown = (sigma, sigma, sigma, status, status == 0)
    return ProjectorMap(columns, rows, sigma, None if rows is None else sigma, *shown, Noise(1, 0), {})


@pytest.mark.parametrize(
    ("turn", "rows", "match"),
    [
        ((1, 1), False, None),
        ((1, 1), True, None),
        ((1, -1), False, "light the back .* mirrored or turned"),
        ((-1, -1), False, "light the back .* mirrored or turned"),
        ((-1, 1), True, "columns and rows that agree .* mirrored or turned"),
    ],
)
def test_only_images_of_this_rig_make_a_scene(rng, caplog, turn, rows, match):
    columns, its_rows = (None if image is None else image[:: turn[0], :: turn[1]].copy() for image in seen(rng, rows))
    found = decoded(columns, its_rows)

    def scene():
        ray_checks.check(found, triangulate(found, CAMERA, PROJECTOR), CAMERA, PROJECTOR, "shots")

    if match is None:
        scene()
        return
    with pytest.raises(InputError, match=match) as caught:
        scene()
    assert (
        str(caught.value).endswith("give implausible=take")
        and "\n" not in str(caught.value)
        and str(caught.value).startswith("triangulate: " if rows else "shots: ")
    )
    raw = triangulate(found, CAMERA, PROJECTOR, "take")
    ray_checks.check(found, raw, CAMERA, PROJECTOR, "shots", "take")
    assert "taken all the same" in caplog.text and np.isfinite(raw.points).any()


@pytest.mark.parametrize(
    ("off_px", "tilt_deg", "match"),
    [
        (440, 0, r"don't meet in front of both in [45]\d % .* the calibration that of this rig"),
        (900, 0, "don't meet in front of both in 100 % "),
        (0, 20, r"\d\d % of the points lie where the projector has no rows"),
    ],
)
def test_another_calibration_makes_none_unless_it_is_to_be_taken(rng, caplog, off_px, tilt_deg, match):
    """Columns shifted as of a projector turned outwards, so that half of the rays run apart, or all; one above the wall."""
    found = decoded(seen(rng, False)[0] - off_px)
    tilt = rigid.from_rotation_vector([np.deg2rad(tilt_deg), 0, 0], np.zeros(3))
    other = replace(PROJECTOR, camera_from_world=tilt @ PROJECTOR.camera_from_world)
    raw = triangulate(found, CAMERA, other)
    with pytest.raises(InputError, match=rf"^shots: .*{match}.*give implausible=take$"):
        ray_checks.check(found, raw, CAMERA, other, "shots")
    ray_checks.check(found, raw, CAMERA, other, "shots", implausible="take")
    (said,) = caplog.messages
    assert "taken all the same" in said and re.search(match, said)


def test_what_an_object_hides_from_a_second_camera_contradicts_nothing():
    """A sphere lit from the front, two cameras 45 degrees to either side: half of what one sees faces away from the other."""

    def at(degrees):
        place = 500 * np.array([np.sin(np.deg2rad(degrees)), 0, -np.cos(np.deg2rad(degrees))])
        axes = rigid.from_rotation_vector([0, np.deg2rad(degrees), 0], np.zeros(3))[:3, :3]
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = axes, -axes @ place
        return Camera((320, 320), np.array([[1500.0, 0, 159.5], [0, 1500, 159.5], [0, 0, 1]]), np.zeros(5), pose)

    def shot(camera, light):
        rays = camera.pixel_rays().astype(float)
        nearest = rays @ camera.centre
        with np.errstate(invalid="ignore"):
            points = camera.centre - (nearest + np.sqrt(nearest**2 - (500**2 - 40**2)))[..., None] * rays
        points[np.sum((light.centre - points) * points, axis=-1) < 0] = np.nan
        columns = light.project(points.reshape(-1, 3))[:, 0].reshape(points.shape[:2])
        return decoded(np.float32(columns)), PointMap(np.float32(points), np.zeros(points.shape[:2], np.float32))

    (found, raw), (other, _) = (shot(at(degrees), at(0)) for degrees in (-45, 45))
    assert ray_checks.check_beside(found, raw, other, at(45), "shots") > 0.95
    with pytest.raises(InputError, match="did one of them move"):
        ray_checks.check_beside(found, raw, replace(other, columns=other.columns + 20), at(45), "shots")
