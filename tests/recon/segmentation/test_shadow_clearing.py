"""Is tissue as bright behind a mass as beside it, once the mass is known?"""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from scipy import ndimage

from recon.freehand.volume_compounding import Clip
from recon.segmentation import echo_power, shadow_clearing
from recon.segmentation.mass_surface import Mass, distances
from recon.segmentation.masses import SPACING_MM
from recon.segmentation.refraction import Sound, follow
from recon.segmentation.shadow_clearing import Recording

PIXEL_MM, SIDE, PLANES = 0.15, 200, 21  # 30 mm by 30 mm, planes 0.5 mm apart
CENTRE, RADIUS = np.array([15.0, 12.0, 5.0]), 4.0
BY_PATH = 0.1  # nepers a mm of mass
SPREAD_MM = 0.2  # sigma of the beam along the array, in power
GREY = 136
SOUND = Sound(1500.0, 1500.0)  # lines are straight
SHAPE = (SIDE, SIDE)


def ball(radius: float) -> Mass:
    mesh = trimesh.creation.icosphere(subdivisions=4, radius=radius)
    mesh.vertices += CENTRE
    return Mass(mesh)


@pytest.fixture(scope="module")
def planes() -> np.ndarray:
    """B-scans side by side, square to z."""
    matrices = np.tile(np.diag([PIXEL_MM, PIXEL_MM, 1.0, 1.0]), (PLANES, 1, 1))
    matrices[:, 2, 3] = 0.5 * np.arange(PLANES)
    return matrices


@pytest.fixture(scope="module")
def recording(planes) -> Recording:
    """Tissue of one level with a ball in it, which echoes nothing, absorbs, and lets nothing through at its flanks."""
    inside = distances([ball(RADIUS)], echo_power.beam_grid(planes, SHAPE, (0.25, 0.25, 0.25)))
    images = []
    for matrix in planes:
        lines = follow(inside, (PIXEL_MM, PIXEL_MM), matrix, SHAPE, SOUND)
        light = ndimage.gaussian_filter(lines.passed * np.exp(-BY_PATH * lines.within), (0, SPREAD_MM / PIXEL_MM))
        power = light * ~lines.inside
        decibels = 10 * np.log10(np.maximum(power, 1e-9) / echo_power.MEDIAN_OF_MEAN)
        images.append(np.clip(np.rint(GREY + decibels * 255 / 60), 0, 255).astype(np.uint8))
    no_gel = np.ones((PLANES, SIDE), np.float32)
    return Recording(lambda: iter(images), planes, echo_power.powers(GREY), Clip(0, 0, *SHAPE), SPREAD_MM, no_gel)


def shells(power):
    """Each voxel's distance from the line of sound through the ball's middle, and its depth below the middle."""
    places = np.moveaxis(np.indices(power.weight.shape)[::-1], 0, -1) * power.volume.spacing
    x, y, z = np.moveaxis(places @ power.volume.directions.T + power.volume.origin - CENTRE, -1, 0)
    return np.hypot(x, z), y


def test_tissue_is_as_bright_behind_a_mass_as_beside_it(recording, planes):
    """Some 8 mm of mass on the way take half of the power, flanks all of it; both are found and mended, edges of shadows too."""
    power = shadow_clearing.cleared(recording, echo_power.beam_grid(planes, SHAPE, SPACING_MM), [ball(RADIUS)], SOUND)
    aside, depth = shells(power)
    for low, high in ((0, 1), (1, 2), (2, 3), (3, 3.4), (3.4, 3.6), (3.6, 3.8), (3.8, 4), (4, 4.2), (4.2, 4.6), (7, 9)):
        shell = (aside >= low) & (aside < high) & (depth > RADIUS + 2) & (depth < 14) & (power.weight > 0.1)
        assert power.volume.voxels[shell].mean() == pytest.approx(1, abs=0.06), (low, high)


def test_lit_pixels_count_more_than_shaded_ones(recording, planes):
    """By their light, which a flank takes away."""
    power = shadow_clearing.cleared(recording, echo_power.beam_grid(planes, SHAPE, SPACING_MM), [ball(RADIUS)], SOUND)
    aside, depth = shells(power)
    deep = (depth > RADIUS + 2) & (depth < 14)
    behind, flank, free = (power.weight[deep & (aside > low) & (aside < low + 0.15)].mean() for low in (1.0, 3.85, 7.0))
    assert behind == pytest.approx(free * np.exp(-BY_PATH * 7.7), rel=0.15)
    assert flank < 0.7 * free


@pytest.mark.parametrize("spread_mm", [0.0, 1e-9])
def test_a_beam_without_width_leaves_shadows_sharp(recording, planes, spread_mm):
    sharp = replace(recording, spread_mm=spread_mm)
    power = shadow_clearing.cleared(sharp, echo_power.beam_grid(planes, SHAPE, SPACING_MM), [ball(RADIUS)], SOUND)
    assert np.isfinite(power.volume.voxels).all()


def test_what_comes_through_a_mass_is_measured_behind_it(recording, planes):
    """Half of the power through its middle; nothing through one that absorbs fifty times as much."""
    grid = echo_power.beam_grid(planes, SHAPE, SPACING_MM)
    share = shadow_clearing.passed(recording, grid, [ball(RADIUS)], 0, SOUND)
    assert share == pytest.approx(np.exp(-BY_PATH * 6.3), abs=0.08)  # mean way of lines that pass 3 mm and more of it
    images = [image.copy() for image in recording.images()]
    row = round((CENTRE[1] + RADIUS) / PIXEL_MM)
    for image in images:
        image[row:, round((CENTRE[0] - RADIUS) / PIXEL_MM) : round((CENTRE[0] + RADIUS) / PIXEL_MM)] = 0
    assert shadow_clearing.passed(replace(recording, images=lambda: iter(images)), grid, [ball(RADIUS)], 0, SOUND) < 0.1


def test_columns_behind_gel_count_as_if_there_were_none(recording, planes):
    """Half of them are brighter by 26 grey levels, which are taken off: what is cleared, and what comes through, stays."""
    grid, levels, half = echo_power.beam_grid(planes, SHAPE, SPACING_MM), 26, SIDE // 2
    images = [image.astype(int) for image in recording.images()]
    for image in images:
        image[:, :half] += levels * (image[:, :half] > 0)
    factor = np.ones((PLANES, SIDE), np.float32)
    factor[:, :half] = 10 ** (levels * 60 / 255 / 10)
    gelled = replace(recording, images=lambda: iter([image.astype(np.uint8) for image in images]), brightening=factor)
    plain, same = (shadow_clearing.cleared(one, grid, [ball(RADIUS)], SOUND) for one in (recording, gelled))
    np.testing.assert_allclose(same.volume.voxels, plain.volume.voxels, rtol=0.01, atol=0.002)
    through, again = (shadow_clearing.passed(one, grid, [ball(RADIUS)], 0, SOUND) for one in (recording, gelled))
    assert again == pytest.approx(through, rel=0.005)
