"""B-scans of a known world become a volume of it."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from recon.errors import InputError
from recon.files.volumes import Volume
from recon.freehand import volume_compounding
from recon.freehand.volume_compounding import Clip, Grid
from recon.geometry import rigid

SHAPE = (40, 50)
PIXEL = np.diag([0.2, 0.25, 0.2, 1.0])  # mm/px
RAMP = np.array([3.0, 2.0, -2.5])  # grey levels a mm


def fan(rng, count):
    """World from pixel of slices that follow each other by half a mm, and tilt a little."""
    moves = [rigid.from_rotation_vector(rng.normal(0, 0.03, 3), [0, 0, 0.5 * k]) for k in range(count)]
    return np.array(moves) @ PIXEL


def pixel_places(world_from_pixel):
    v, u = np.indices(SHAPE)
    pixels = np.stack([u, v, np.zeros(SHAPE), np.ones(SHAPE)], axis=-1)
    return (pixels @ world_from_pixel.T)[..., :3]


def ramp_images(world_from_pixel):
    return [np.round(120 + pixel_places(m) @ RAMP).astype(np.uint8) for m in world_from_pixel]


def voxel_places(volume):
    k, j, i = np.indices(volume.voxels.shape)
    return rigid.apply(volume.world_from_voxel, np.stack([i, j, k], axis=-1))


@pytest.fixture
def sweep(rng):
    matrices = fan(rng, 12)
    return ramp_images(matrices), matrices


@pytest.mark.parametrize("interpolation", ["nearest", "linear"])
@pytest.mark.parametrize("grid_around", [volume_compounding.aligned_grid, volume_compounding.principal_grid])
def test_a_ramp_of_grey_is_found_again(sweep, interpolation, grid_around):
    """A voxel's pixels are within half a voxel, or one with linear shares; the mean differs by at most that much of the ramp."""
    images, matrices = sweep
    spacing = np.array([0.6, 0.6, 0.6])
    grid = grid_around(volume_compounding.corners(matrices, SHAPE), spacing)
    found = volume_compounding.reconstruct(images, matrices, grid, "mean", interpolation)
    error = found.volume.voxels - (120 + voxel_places(found.volume) @ RAMP)
    reach = 0.5 if interpolation == "nearest" else 1.0
    bound = reach * np.abs(RAMP @ grid.directions) @ spacing + 1  # and the rounding of images and voxels
    assert found.filled.mean() > 0.5
    assert np.abs(error[found.filled]).max() < bound
    assert abs(error[found.filled].mean()) < 0.3
    assert not found.volume.voxels[~found.filled].any()


@pytest.mark.parametrize("compounding", ["mean", "maximum", "latest"])
def test_a_plain_loop_finds_the_same(rng, compounding):
    """Slow and readable: all pixels of a voxel in a list. The grid cuts some of the pixels off."""
    matrices = fan(rng, 4)
    images = rng.integers(0, 256, (4, *SHAPE), np.uint8)
    grid = Grid((9, 8, 4), np.array([0.5, 0.4, 0.1]), np.array([0.8, 0.9, 0.7]), Rotation.random(rng=rng).as_matrix())
    inside: dict[tuple, list] = {}
    for image, matrix in zip(images, matrices, strict=True):
        for v, u in np.ndindex(SHAPE):
            place = grid.directions.T @ ((matrix @ [u, v, 0, 1])[:3] - grid.origin) / grid.spacing
            inside.setdefault(tuple(np.floor(place + 0.5).astype(int)), []).append(int(image[v, u]))
    found = volume_compounding.reconstruct(images, matrices, grid, compounding)
    assert found.filled.any() and not found.filled.all()
    for k, j, i in np.ndindex(found.filled.shape):
        values = inside.get((i, j, k))
        assert found.filled[k, j, i] == (values is not None)
        if values:
            expected = {"mean": np.floor(np.mean(values) + 0.5), "maximum": max(values), "latest": values[-1]}[compounding]
            assert found.volume.voxels[k, j, i] == expected


def test_linear_shares_add_up_to_the_pixels(rng):
    """Inside the grid each pixel counts once in all, so the weighted sum of a lone bright pixel is its place."""
    matrix = fan(rng, 1)
    image = np.zeros(SHAPE, np.uint8)
    image[17, 23] = 255
    mask = image > 0
    grid = volume_compounding.aligned_grid(volume_compounding.corners(matrix, SHAPE) + np.array([[-3], [3], [-3], [3]]), 0.7)
    found = volume_compounding.reconstruct([image], matrix, grid, "mean", "linear", masks=[mask])
    touched = np.argwhere(found.filled)[:, ::-1]
    place = (np.linalg.inv(found.volume.world_from_voxel) @ matrix[0] @ [23, 17, 0, 1])[:3]
    assert len(touched) == 8 and np.abs(touched - place).max() < 1
    assert (found.volume.voxels[found.filled] == 255).all()


@pytest.mark.parametrize("arithmetic", ["plus_full", "plus_partial"])
def test_the_mean_of_plus_is_too_dark(arithmetic, rng):
    """Rounding down at each of 36 pixels loses some levels of the mean; the true mean is within half of one."""
    images = rng.integers(90, 111, (1, 6, 6), np.uint8)
    grid = Grid((1, 1, 1), np.zeros(3), np.full(3, 10.0), np.eye(3))
    matrices = np.eye(4)[None] * [0.1, 0.1, 1, 1]
    true = volume_compounding.reconstruct(images, matrices, grid)
    whole = volume_compounding.reconstruct(images, matrices, grid, arithmetic=arithmetic)
    assert abs(true.volume.voxels[0, 0, 0] - images.mean()) <= 0.5
    assert images.mean() - 15 < whole.volume.voxels[0, 0, 0] < images.mean() - 2


@pytest.mark.parametrize("arithmetic", ["plus_full", "plus_partial"])
@pytest.mark.parametrize("compounding", ["mean", "maximum", "latest", "weighted"])
def test_shares_of_pixels_are_whole_levels_in_plus(arithmetic, compounding, rng):
    """Slow and readable: places and shares in steps of 2^-14 or without, weights of 1/256, levels rounded at each share."""
    matrices, images = fan(rng, 2), rng.integers(0, 256, (2, *SHAPE), np.uint8)
    own = rng.integers(0, 256, SHAPE, np.uint8) * (rng.random(SHAPE) < 0.9) if compounding == "weighted" else None
    grid = volume_compounding.principal_grid(volume_compounding.corners(matrices, SHAPE), [0.8, 0.9, 0.7])
    step = 2.0**-14 if arithmetic == "plus_full" else 0.0
    levels, weights = np.zeros(grid.size[::-1], int), np.zeros(grid.size[::-1], int)
    for image, matrix in zip(images, matrices, strict=True):
        placed = np.linalg.inv(Volume(levels, grid.origin, grid.spacing, grid.directions).world_from_voxel) @ matrix
        placed = np.rint(placed / step) * step if step else placed
        for v, u in np.ndindex(SHAPE):
            place = (placed @ [u, v, 0, 1])[:3]
            first = np.floor(place + 2.0**-17).astype(int)  # PLUS's tolerance
            if (first < 0).any() or (first + (place != first) >= grid.size).any() or (own is not None and own[v, u] == 0):
                continue
            for corner in np.ndindex(2, 2, 2):
                wx, wy, wz = np.where(corner, place - first, 1 - place + first)
                share = np.floor(wx * (np.floor(wy * wz / step + 0.5) * step) / step + 0.5) * step if step else wx * wy * wz
                if share == 0:
                    continue
                at = tuple((first + corner)[::-1])
                before, known, total = levels[at], weights[at] / 256, share
                if compounding == "mean":
                    total = share + known
                    mean = (share * image[v, u] + known * before) / total
                    levels[at] = np.floor((np.rint(mean / step) * step if step else mean + 2.0**-17) + 0.5)
                elif own is not None:
                    part = int(own[v, u])
                    total = part * share / 256 + known
                    parts = np.array([int(image[v, u]) * part * share / 256, known]) / total
                    new, old = np.rint(parts / step) * step if step else parts
                    levels[at] = np.floor(new + old * before + 0.5 + (0 if step else 2.0**-17))
                elif share >= 0.125 and (compounding == "latest" or image[v, u] > before):
                    levels[at] = image[v, u]
                else:
                    continue
                weights[at] = np.floor(total * 256 + 0.5 + 2.0**-17)
    found = volume_compounding.reconstruct(images, matrices, grid, compounding, "linear", arithmetic=arithmetic, weights=own)
    assert np.array_equal(found.filled, weights > 0) and found.filled.sum() > 50
    assert (found.volume.voxels == levels).all()


@pytest.mark.parametrize("interpolation", ["nearest", "linear"])
def test_pixels_count_by_their_weights(interpolation, rng):
    """Two images a voxel apart of which each is constant: the weighted mean, and none of what has no weight."""
    grid = Grid((6, 5, 1), np.zeros(3), np.ones(3), np.eye(3))
    images = np.stack([np.full((5, 6), level, np.uint8) for level in (40, 200)])
    weights = rng.integers(1, 256, (5, 6), np.uint8)
    weights[:, 4:] = 0
    moved = np.eye(4) + np.eye(4, k=3)  # by a voxel along x
    found = volume_compounding.reconstruct(images, np.stack([np.eye(4), moved]), grid, "weighted", interpolation, weights=weights)
    assert not found.filled[0, :, 5].any() and found.filled[0, :, :5].all()
    first, second = weights[:, 1:4].astype(float), weights[:, :3].astype(float)
    expected = (40 * first + 200 * second) / (first + second)
    assert np.abs(found.volume.voxels[0, :, 1:4] - expected).max() <= 0.5
    whole = volume_compounding.reconstruct(
        images, np.stack([np.eye(4), moved]), grid, "weighted", interpolation, arithmetic="plus_none", weights=weights
    )
    down = np.floor(expected) if interpolation == "nearest" else np.floor(expected + 0.5)
    assert np.array_equal(whole.volume.voxels[0, :, 1:4], down) and np.array_equal(whole.filled, found.filled)
    for given, compounding in ((None, "weighted"), (weights, "mean"), (weights[:4], "weighted"), (1.0 * weights, "weighted")):
        with pytest.raises(InputError, match="weights: expected"):
            volume_compounding.reconstruct(images, np.stack([np.eye(4), moved]), grid, compounding, weights=given)


def test_points_of_a_segmented_ball_lie_on_it(rng):
    """Outlines of a ball in oblique slices, as points; without a mask, all pixels are points."""
    centre, radius = np.array([5.0, 5.0, 3.0]), 3.5
    for matrix in fan(rng, 12):
        distance = np.linalg.norm(pixel_places(matrix) - centre, axis=-1)
        outline = np.abs(distance - radius) < 0.15
        places, pixels = volume_compounding.points(matrix, SHAPE, outline)
        assert len(places) == outline.sum() and outline[pixels[:, 1], pixels[:, 0]].all()
        assert np.all(np.abs(np.linalg.norm(places - centre, axis=1) - radius) < 0.15)
        everything, _ = volume_compounding.points(matrix, SHAPE)
        assert np.abs(everything.reshape(*SHAPE, 3) - pixel_places(matrix)).max() < 1e-9


def test_clips_and_masks_leave_pixels_out(sweep):
    images, matrices = sweep
    clip = Clip(10, 5, 20, 12)
    inside = np.zeros(SHAPE, bool)
    inside[5:17, 10:30] = True
    places, pixels = volume_compounding.points(matrices[0], SHAPE, clip=clip)
    assert len(places) == 240 and pixels.min(axis=0).tolist() == [10, 5] and pixels.max(axis=0).tolist() == [29, 16]
    grid = volume_compounding.aligned_grid(volume_compounding.corners(matrices, SHAPE), 0.5)
    clipped = volume_compounding.reconstruct(images, matrices, grid, clip=clip)
    masked = volume_compounding.reconstruct(images, matrices, grid, masks=[inside] * 12)
    assert np.array_equal(clipped.volume.voxels, masked.volume.voxels) and np.array_equal(clipped.filled, masked.filled)
    assert 0 < clipped.filled.sum() < 0.2 * volume_compounding.reconstruct(images, matrices, grid).filled.sum()
    with pytest.raises(InputError, match="clip: expected a part of an image of 50x40, found"):
        volume_compounding.points(matrices[0], SHAPE, clip=Clip(60, 0, 5, 5))


@pytest.mark.parametrize("grid_around", [volume_compounding.aligned_grid, volume_compounding.principal_grid])
def test_no_pixel_falls_outside(rng, grid_around):
    """And none of the grid's six faces could be a voxel further in."""
    turn = rigid.transform(Rotation.random(rng=rng).as_matrix(), rng.normal(0, 100, 3))
    matrices = turn @ fan(rng, 30)
    grid = grid_around(volume_compounding.corners(matrices, SHAPE), [0.5, 0.7, 0.9])
    index = np.concatenate([volume_compounding.points(m, SHAPE)[0] for m in matrices]) - grid.origin
    index = np.floor(index @ grid.directions / grid.spacing + 0.5).astype(int)
    assert index.min(axis=0).tolist() == [0, 0, 0] and tuple(index.max(axis=0) + 1) == grid.size
    assert abs(np.linalg.det(grid.directions) - 1) < 1e-9


def test_principal_axes_make_a_diagonal_sweep_small(rng):
    turn = rigid.from_rotation_vector([0.5, 0.6, 0.3], [0, 0, 0])
    around = volume_compounding.corners(
        turn @ np.array([rigid.transform(np.eye(3), [0, 0, k]) for k in range(100)]) @ PIXEL, SHAPE
    )
    aligned, principal = (
        np.prod(grid(around, 0.5).size) for grid in (volume_compounding.aligned_grid, volume_compounding.principal_grid)
    )
    assert principal < 0.5 * aligned


def test_frames_are_used_one_at_a_time(sweep):
    """All images share one buffer, so a frame that was kept for later would be wrong; and frames without a pose are left out."""
    images, matrices = sweep
    matrices = matrices.copy()
    matrices[4] = np.nan
    buffer = np.empty(SHAPE, np.uint8)

    def one_by_one():
        for image in images:
            buffer[:] = image
            yield buffer

    grid = volume_compounding.aligned_grid(volume_compounding.corners(matrices, SHAPE), 0.5)
    streamed = volume_compounding.reconstruct(one_by_one(), matrices, grid)
    others = [k for k in range(12) if k != 4]
    kept = volume_compounding.reconstruct([images[k] for k in others], matrices[others], grid)
    assert np.array_equal(streamed.volume.voxels, kept.volume.voxels) and np.array_equal(streamed.filled, kept.filled)


def test_what_cannot_be_reconstructed(sweep):
    images, matrices = sweep
    around = volume_compounding.corners(matrices, SHAPE)
    grid = volume_compounding.aligned_grid(around, 0.5)
    with pytest.raises(InputError, match=r"volume: expected at most 4.0 GiB, found .* GiB for .* voxels; take a larger spacing"):
        volume_compounding.reconstruct(images, matrices, volume_compounding.aligned_grid(around, 0.001))
    with pytest.raises(InputError, match=r"arithmetic: expected one of floating, plus_full, .*, found 'plus'"):
        volume_compounding.reconstruct(images, matrices, grid, arithmetic="plus")
    with pytest.raises(InputError, match="images: expected as many as poses, 12, found 11"):
        volume_compounding.reconstruct(images[1:], matrices, grid)
    with pytest.raises(InputError, match="images: expected as many as poses, 11, found more"):
        volume_compounding.reconstruct(images, matrices[1:], grid)
    pairs = [(images, matrices[1:], 12, "images: expected as many as poses, 11, found more")]
    pairs += [(images, matrices, 11, "masks: expected one for each image, found 11")]
    pairs += [(images, matrices, 13, "masks: expected one for each image, 12, found more")]
    for some, placed, masks, complaint in pairs:
        with pytest.raises(InputError, match=complaint):
            volume_compounding.reconstruct(some, placed, grid, masks=[np.ones(SHAPE, bool)] * masks)
    with pytest.raises(
        InputError, match=r"image 0: expected height x width of uint8 and a mask like it, found .*, mask \(3, 3\)"
    ):
        volume_compounding.reconstruct(images, matrices, grid, masks=[np.ones((3, 3), bool)] * 12)
    with pytest.raises(InputError, match="poses: expected at least one that is valid, found none in 12"):
        volume_compounding.corners(np.full((12, 4, 4), np.nan), SHAPE)
    for make in (volume_compounding.aligned_grid, volume_compounding.principal_grid):
        with pytest.raises(InputError, match="around: expected points, mm, found none"):
            make(np.zeros((0, 3)), 0.5)
        with pytest.raises(InputError, match=r"around: expected numbers of shape \(n, 3\)"):
            make(np.zeros((4, 2)), 0.5)
        assert np.prod(make(np.array([[1.0, 2, 3], [1, 2, 5]]), 0.5).size) == 5
    with pytest.raises(InputError, match="spacing_mm: expected lengths above 0 mm, one or three, found -1"):
        volume_compounding.aligned_grid(around, -1)
