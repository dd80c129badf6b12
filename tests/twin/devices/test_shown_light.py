"""The virtual projector shows patterns as the twin projects them, and pictures where geometry has them."""

import cv2
import numpy as np
import pytest

from recon.artwork.projected_images import images
from recon.devices.pattern_player import Stage, Triggered, take
from recon.model.patterns import CentreLine, Fringes, Patterns
from scenes.kinds import plane
from twin.devices.shown_light import KnownLight
from twin.devices.virtual_session import StillSettings, before_scene
from twin.optics.light_transport import Tracing
from twin.optics.projected_image import ImageLight
from twin.optics.raster import Light

PATTERNS = Patterns(
    projector_size=(1280, 800),
    unwrap="centre_line",
    parts=(CentreLine(), Fringes(pitch=12, steps=4), CentreLine(axis="rows"), Fringes(axis="rows", pitch=16, steps=3)),
)


def test_light_of_images_is_that_of_their_patterns(rig):
    """Rounded to 8 bits, as the twin projects them; each is found by its image."""
    shown = images(PATTERNS)
    known = KnownLight.of(shown, rig.projector)
    expected = Light.of(PATTERNS, rig.projector)
    assert known.light.axes == expected.axes
    for one, other in zip(known.light.profiles, expected.profiles, strict=True):
        assert np.abs(one - other).max() < 2e-3
    for k, pattern in enumerate(shown):
        light, place = known.find(pattern)
        assert light is known.light and place == k
    assert known.find(np.full((800, 1280), 7, np.uint8))[0] is not known.light
    assert isinstance(known.find(np.eye(800, 1280, dtype=np.uint8))[0], ImageLight)


def test_a_picture_is_lit_where_geometry_says(rig):
    """Two dots on a tilted plate, shown by the virtual projector and seen by its camera 1; by 0.1 px of the camera.

    Their middles by brightness, of thousands of pixels, are off by some thousandths of a pixel from noise and rounding, and by
    0.02 px from perspective within a dot.
    """
    design = {"kind": "plane", "tilt_deg": [10.0, -15.0]}
    virtual = before_scene(StillSettings(rig, Tracing(samples=4), ["cam1"]), design, [])
    stage = Stage(virtual.projector, virtual.cameras, Triggered())
    virtual.cameras["cam1"].set_exposure(0.01, 1.0)
    dots = {(520, 330): 20, (840, 470): 12}
    picture = stage.black
    for middle, radius in dots.items():
        cv2.circle(picture, middle, radius, 255, -1)
    frame = take(stage, picture)["cam1"].image.astype(float)
    plate = plane.build(plane.Config(tilt_deg=(10.0, -15.0))).shapes[0]
    projector, camera = rig.projector.optics.camera(), rig.cam1.optics.camera()
    rays = projector.rays(np.array(list(dots), float))
    along = (plate.point - projector.centre) @ plate.normal / (rays @ plate.normal)
    expected = camera.project(projector.centre + along[:, None] * rays)
    assert 100 < frame.max() < 255
    _, _, boxes, _ = cv2.connectedComponentsWithStats(np.uint8(frame > 0.3 * frame.max()))
    assert len(boxes) == 1 + len(dots)
    for middle, radius in zip(expected, dots.values(), strict=True):
        assert centroid(frame, middle, 4 * radius) == pytest.approx(middle, abs=0.1)


def centroid(image, middle, reach):
    """Middle (u, v) of the light around a place, less what is dark."""
    left, upper = np.rint(middle - reach).astype(int)
    part = image[upper : upper + 2 * reach + 1, left : left + 2 * reach + 1]
    light = np.where(part > 0.2 * part.max(), part, 0)
    v, u = np.mgrid[: light.shape[0], : light.shape[1]]
    return np.array([left + (light * u).sum() / light.sum(), upper + (light * v).sum() / light.sum()])
