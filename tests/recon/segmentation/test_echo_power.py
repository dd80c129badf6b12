"""From grey levels of tracked B-scans back to the tissue's power."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation

from recon.errors import InputError
from recon.geometry import rigid
from recon.segmentation import echo_power
from recon.segmentation.echo_power import Placed

SCALE = np.array([0.2, 0.15])
SIZE = (150, 180)  # w, h: 30 x 27 mm
CENTRE, RADIUS, DARK = np.array([1.0, 14.0, -0.5]), 5.0, 0.05


def poses(count, rng):
    """world_from_pixel of a sweep across the world's z, with y the depth, slightly unsteady."""
    result = []
    for z in np.linspace(-10, 10, count):
        turn = Rotation.from_rotvec(np.deg2rad(rng.normal(0, 1, 3))).as_matrix()
        result.append(rigid.transform(turn, [-15 + rng.normal(0, 0.3), rng.normal(0, 0.2), z]) @ np.diag([*SCALE, 1, 1]))
    return np.stack(result)


def b_scan(pose, rng):
    """Speckle of a dark ball in tissue, its cells 0.5 x 0.3 mm, log-compressed over 60 dB, tissue at 28 dB below white."""
    u, v = np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1]))
    points = rigid.apply(pose, np.stack([u, v, 0 * u], axis=-1))
    strength = np.where(np.linalg.norm(points - CENTRE, axis=-1) < RADIUS, np.sqrt(DARK), 1.0)
    field = rng.normal(size=(2, *strength.shape)) * strength
    sigma = np.array([0.12, 0.2]) / SCALE[::-1]
    parts = [gaussian_filter(part, sigma) for part in field]
    power = (parts[0] ** 2 + parts[1] ** 2) * 2 * np.pi * sigma.prod()
    return np.rint(np.clip(255 * (1 + (10 * np.log10(power + 1e-9) - 28) / 60), 0, 255)).astype(np.uint8)


@pytest.fixture(scope="module")
def recorded():
    rng = np.random.default_rng(4)
    world_from_pixel = poses(50, rng)
    return np.stack([b_scan(pose, rng) for pose in world_from_pixel]), world_from_pixel


def test_power_is_that_of_the_tissue(recorded):
    """The mean over some 30 000 cells of speckle. Clipping at 8 dB above tissue takes 0.2 % from it."""
    images, matrices = recorded
    grid = echo_power.beam_grid(matrices, images.shape[1:], (0.4, 0.3, 0.5))
    power = echo_power.averaged(images, matrices, grid, echo_power.typical_grey(images, slice(0, 40)))
    k, j, i = np.nonzero(power.seen)
    points = rigid.apply(power.volume.world_from_voxel, np.column_stack([i, j, k]))
    distance = np.linalg.norm(points - CENTRE, axis=1)
    values = power.volume.voxels[k, j, i]
    assert values[distance > RADIUS + 2].mean() == pytest.approx(1, abs=0.03)
    assert values[distance < RADIUS - 2].mean() == pytest.approx(DARK, abs=0.01)


def test_grid_lies_along_the_beam_and_holds_all_pixels(recorded):
    _, matrices = recorded
    matrices = rigid.from_rotation_vector([0.4, 1.1, -0.3], [5, 6, 700]) @ matrices
    matrices[3] = np.nan
    grid = echo_power.beam_grid(matrices, SIZE[::-1], (0.5, 0.25, 0.4))
    beam = matrices[10, :3, 1] / np.linalg.norm(matrices[10, :3, 1])
    assert grid.directions[:, 1] @ beam > np.cos(np.deg2rad(5))
    assert np.linalg.det(grid.directions) == pytest.approx(1)
    corner = matrices[10] @ [149, 179, 0, 1]
    index = (corner[:3] - grid.origin) @ grid.directions / grid.spacing
    assert (index >= 0).all() and (index <= np.array(grid.size) - 1).all()


def test_a_grid_that_memory_does_not_hold_is_refused():
    wide = np.tile(np.diag([1.0, 1.0, 1.0, 1.0]), (2, 1, 1))
    wide[1, 2, 3] = 2000.0
    with pytest.raises(InputError, match=r"power: expected at most 4 GiB, found \d+ GiB for 399 x 797 x 4001 voxels; clip"):
        echo_power.beam_grid(wide, (200, 200), (0.5, 0.25, 0.5))


def test_arrays_all_round_have_no_grid():
    turns = np.stack([rigid.from_rotation_vector([0, a, 0], [0, 0, 0]) for a in np.linspace(0, 2 * np.pi, 8, endpoint=False)])
    with pytest.raises(InputError, match="about one way"):
        echo_power.beam_grid(turns, (20, 20), 3 * (0.5,))


def test_pixels_are_shared_out_by_their_distance(rng):
    """Pixel by pixel, to all voxels at once; those beside the grid and those that aren't to count left out."""
    grid = echo_power.Grid((7, 6, 5), np.zeros(3), np.full(3, 1.0), np.eye(3))
    power, light = rng.uniform(0, 2, (2, 9, 8)).astype(np.float32)
    power[3, 4] = np.nan
    v, u = np.mgrid[:9, :8].astype(np.float32)
    pose = rigid.from_rotation_vector([0.3, 0.2, -0.1], [-0.8, 0.3, 1.2])
    voxels = np.stack(np.mgrid[:5, :6, :7], axis=-1)[..., ::-1]
    total, weight = np.zeros((2, 5, 6, 7))
    places = rigid.apply(pose, np.stack([u, v, 0 * u], axis=-1)).reshape(-1, 3)
    for place, value, lit in zip(places, power.ravel(), light.ravel(), strict=True):
        share = np.clip(1 - np.abs(voxels - place), 0, None).prod(axis=-1)
        total += np.nan_to_num(share * value)
        weight += share * lit * np.isfinite(value)
    found = echo_power.accumulated([Placed(power, light, u, v)], pose[None], grid)
    np.testing.assert_allclose(found.weight, weight, atol=1e-5)
    np.testing.assert_allclose(found.volume.voxels[weight > 0.01], (total / np.maximum(weight, 1e-6))[weight > 0.01], rtol=1e-3)
