"""Does the light of an image agree with that of a pattern, which is computed another way, and lie where the image has it?"""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from twin.optics.instruments import CameraOptics, ProjectorOptics
from twin.optics.light_transport import Tracing, render
from twin.optics.projected_image import ImageLight
from twin.optics.raster import Light, LightTable


def looked_up(table, pixels):
    """Light at projector coordinates : (n, 2), of the first image."""
    return np.asarray(table.lookup(mi.Point2f(*np.float32(pixels.T)), dr.full(mi.Bool, True, len(pixels)))[0])


def test_an_image_of_a_pattern_gives_the_patterns_light(rig, rng):
    """Fringes along columns, as an image and as a profile: to a hundredth, the fineness of the image's table."""
    size, values = (1280, 800), np.float32(0.5 + 0.5 * np.cos(2 * np.pi * np.arange(1280) / 12))
    light = Light.of_profiles(size, [("columns", False, values)], rig.projector)
    image = np.broadcast_to(np.uint8(np.round(255 * values)), (800, 1280))
    pixels = rng.uniform([0, 0], [1279, 799], (2000, 2))
    expected = looked_up(LightTable.of(light), pixels)
    assert np.abs(looked_up(ImageLight.of(image, rig.projector).table, pixels) - expected).max() < 0.015


def test_a_pixel_lights_its_own_place_and_none_outside_is_lit(rig):
    image = np.zeros((800, 1280), np.uint8)
    image[300, 700] = 255
    table = ImageLight.of(image, rig.projector).table
    v, u = np.mgrid[296:304.01:0.25, 696:704.01:0.25]
    light = looked_up(table, np.column_stack([u.ravel(), v.ravel()])) - 1 / rig.projector.contrast
    assert (light @ np.column_stack([u.ravel(), v.ravel()]) / light.sum()).tolist() == pytest.approx([700, 300], abs=0.02)
    assert light.sum() * 0.25**2 == pytest.approx(1, abs=0.02), "the point spread takes no light away"
    outside = np.array([[-0.6, 10.0], [1279.6, 10], [10, -0.6], [10, 799.6]])
    assert (looked_up(ImageLight.of(np.full_like(image, 255), rig.projector).table, outside) == 0).all()


def test_images_do_not_spread_beneath_a_shape(rig):
    world = mi.load_dict({"type": "scene", "shape": {"type": "sphere", "center": [0.0, 0, 660], "radius": 20.0}})
    camera, projector = CameraOptics.of(rig.cam1), ProjectorOptics.of(rig.projector)
    light = ImageLight.of(np.zeros((800, 1280), np.uint8), rig.projector)
    with pytest.raises(ValueError, match="expected patterns along one axis"):
        render(world, camera, projector, light, Tracing(samples=2), 0, [(world.shapes()[0], 1.0)])
