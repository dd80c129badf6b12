"""Is tissue as bright behind a mass as beside it, once the mass is known?"""

import numpy as np
import pytest
import trimesh

from recon.freehand.volume_compounding import Clip
from recon.segmentation import echo_power, shadow_clearing
from recon.segmentation.mass_surface import Mass, distances
from recon.segmentation.refraction import Sound, follow
from recon.segmentation.shadow_clearing import Recording

PIXEL_MM, SIDE, PLANES = 0.15, 200, 21  # 30 mm by 30 mm, planes 0.5 mm apart
CENTRE, RADIUS = np.array([15.0, 12.0, 5.0]), 4.0
BY_PATH = 0.1  # nepers a mm of mass
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
    inside = distances([ball(RADIUS)], echo_power.beam_grid(planes, SHAPE, 0.25))
    images = []
    for matrix in planes:
        lines = follow(inside, (PIXEL_MM, PIXEL_MM), matrix, SHAPE, SOUND)
        power = lines.passed * np.exp(-BY_PATH * lines.within) * ~lines.inside
        decibels = 10 * np.log10(np.maximum(power, 1e-9) / echo_power.MEDIAN_OF_MEAN)
        images.append(np.clip(np.rint(GREY + decibels * 255 / 60), 0, 255).astype(np.uint8))
    return Recording(lambda: iter(images), planes, echo_power.powers(GREY), Clip(0, 0, *SHAPE))


def shells(power):
    """Each voxel's distance from the line of sound through the ball's middle, and its depth below the middle."""
    places = np.moveaxis(np.indices(power.weight.shape)[::-1], 0, -1) * power.volume.spacing
    x, y, z = np.moveaxis(places @ power.volume.directions.T + power.volume.origin - CENTRE, -1, 0)
    return np.hypot(x, z), y


def test_tissue_is_as_bright_behind_a_mass_as_beside_it(recording, planes):
    """Some 8 mm of mass on the way take half of the power; the loss is found from the tissue itself. The inset costs 6 %."""
    power = shadow_clearing.cleared(recording, echo_power.beam_grid(planes, SHAPE, 0.5), [ball(RADIUS)], SOUND)
    aside, depth = shells(power)
    for low, high in ((0, 1), (1, 2), (2, 3), (7, 9)):
        shell = (aside >= low) & (aside < high) & (depth > RADIUS + 2) & (depth < 14)
        assert power.volume.voxels[shell].mean() == pytest.approx(1, abs=0.08)


def test_tissue_beside_a_flank_is_seen_past_a_mass_that_is_too_large(recording, planes):
    """By 0.2 mm; were it taken for the flank's shadow, nothing could move the surface back."""
    power = shadow_clearing.cleared(recording, echo_power.beam_grid(planes, SHAPE, 0.25), [ball(RADIUS + 0.2)], SOUND)
    aside, depth = shells(power)
    near, far = ((depth > 1) & (depth < 14) & (aside > low) & (aside < low + 0.2) for low in (RADIUS, RADIUS + 3))
    assert power.weight[near].mean() > 0.9 * power.weight[far].mean()
