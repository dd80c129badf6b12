"""The surface of a dark mass in averaged echo power, from profiles across a rough one.

A border of two tissues, blurred by pulse, beam and slice, is a step with half of its height on the border; a border that is
square to the beam also reflects, which adds a bright line in the same place. Both are fitted to profiles along the surface's
normals, each with levels of its own, so that it doesn't matter how bright the tissue beside is. Profiles are averaged over their
neighbours at the same distance from the rough surface: unlike a blur of the image, this doesn't shrink what is round.
"""

from dataclasses import dataclass

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy import sparse
from scipy.ndimage import uniform_filter1d
from scipy.spatial import KDTree
from scipy.special import ndtr

from recon.geometry import rigid
from recon.segmentation.echo_power import EchoPower

Array = NDArray[np.float64]

REACH_MM = 2.4  # of a profile, on either side of the surface
BIN_MM = 0.2
MOST_MM = 1.0  # that a vertex moves in one round
STEP_MM = 0.1  # of the places that are tried
BLURS_MM = (0.25, 0.4, 0.6)  # standard deviations that are tried
PATCH_MM = 1.0  # standard deviation of the weights by which neighbours are averaged
STAY = 0.1  # of the median certainty: how strongly a vertex stays where it is
UNLIKE = 0.05  # of tissue's power, by which blurs differ from those tried
EVENINGS = 10  # rounds of smoothing over neighbouring vertices
LINE_GAIN = 1.5  # by which the misfit must be less with a line on the border
NEVER = 1e9  # of a misfit
FLOOR = 0.05  # of tissue's power: no level counts as more certain than that of this


@dataclass(frozen=True)
class Refined:
    """A surface moved to where the profiles have their step."""

    mesh: trimesh.Trimesh
    moved: Array  # (n,) mm outwards, of the vertices


def refine(rough: trimesh.Trimesh, power: EchoPower, patch_mm: float = PATCH_MM) -> Refined:
    """Move the vertices of a closed mesh along their normals to the border that the power shows."""
    number, distance, value, weight = _near(rough, power)
    bins = round(2 * REACH_MM / BIN_MM)
    index = number * bins + np.clip(((distance + REACH_MM) / BIN_MM).astype(int), 0, bins - 1)
    count = len(rough.vertices) * bins
    total = np.bincount(index, weight * value, count).reshape(-1, bins)
    mass = np.bincount(index, weight, count).reshape(-1, bins)
    tree = KDTree(rough.vertices)
    gaps = tree.sparse_distance_matrix(tree, 2.5 * patch_mm, output_type="coo_matrix")
    facing = (rough.vertex_normals[gaps.row] * rough.vertex_normals[gaps.col]).sum(axis=1)
    share = np.exp(-(gaps.data**2) / (2 * patch_mm**2)) * np.clip(facing, 0, None)
    mixing = sparse.csr_matrix((share, (gaps.row, gaps.col)), shape=gaps.shape)
    mass, total = mixing @ mass, mixing @ total
    step, doubt = _steps(np.divide(total, mass, out=np.zeros_like(total), where=mass > 0), mass)
    sure = mixing @ (1 / doubt)
    moved = (mixing @ (step / doubt)) / (sure + STAY * np.median(sure))  # where little is known it stays
    mesh = trimesh.Trimesh(rough.vertices + moved[:, None] * rough.vertex_normals, rough.faces, process=False)
    return Refined(trimesh.smoothing.filter_taubin(mesh, iterations=EVENINGS), moved)  # takes spikes, keeps the volume


def _near(rough: trimesh.Trimesh, power: EchoPower) -> tuple[NDArray[np.int64], Array, Array, Array]:
    """Voxels that were seen near a surface: the nearest vertex, distance (positive outside), power and weight."""
    volume = power.volume
    voxel = rigid.apply(np.linalg.inv(volume.world_from_voxel), rough.vertices)
    margin = 2 * REACH_MM / volume.spacing
    low = np.maximum(np.floor(voxel.min(axis=0) - margin), 0).astype(int)
    high = np.minimum(np.ceil(voxel.max(axis=0) + margin).astype(int) + 1, volume.voxels.shape[::-1])
    part = tuple(slice(a, b) for a, b in zip(low[::-1], high[::-1], strict=True))
    k, j, i = np.nonzero(power.weight[part] > 0.01)
    index = np.column_stack([i, j, k]) + low
    places = rigid.apply(volume.world_from_voxel, index)
    away, nearest = KDTree(rough.vertices).query(places, distance_upper_bound=1.5 * REACH_MM, workers=-1)
    kept = np.isfinite(away)
    places, nearest, index = places[kept], nearest[kept], index[kept]
    distance = ((places - rough.vertices[nearest]) * rough.vertex_normals[nearest]).sum(axis=1)
    kept = np.abs(distance) < REACH_MM
    i, j, k = index[kept].T
    return (
        nearest[kept],
        distance[kept],
        volume.voxels[k, j, i].astype(float),
        power.weight[k, j, i].astype(float),
    )


def _steps(profiles: Array, weight: Array) -> tuple[Array, Array]:
    """Where profiles : (n, bins) step up : (n,) mm, and a variance in some unit.

    Each place and blur is tried with the levels within, without and of a line on the border that fit best; the least sum of
    squares, weighed as speckle scatters, counts. A weak line can't be told from a step that lies elsewhere, so there is one only
    where the fit is much better with it.
    """
    s = -REACH_MM + BIN_MM * (np.arange(profiles.shape[1]) + 0.5)
    candidates = np.arange(-MOST_MM, MOST_MM + STEP_MM / 2, STEP_MM)
    weight = weight / np.maximum(uniform_filter1d(profiles, 5, axis=1, mode="nearest"), FLOOR)
    plain, lined = np.full((2, len(candidates), len(profiles)), NEVER)
    for blur in BLURS_MM:
        for c, place in enumerate(candidates):
            z = (s - place) / blur
            basis = np.stack([ndtr(z), ndtr(-z), np.exp(-z * z / 2)])
            plain[c] = np.minimum(plain[c], _misfit(basis[:2], profiles, weight))
            lined[c] = np.minimum(lined[c], _misfit(basis, profiles, weight))
    least = UNLIKE**2 * weight.sum(axis=1)
    costs = np.where(plain.min(axis=0) + least > LINE_GAIN * (lined.min(axis=0) + least), lined, plain)
    c = np.clip(costs.argmin(axis=0), 1, len(candidates) - 2)
    rows = np.arange(len(profiles))
    before, here, after = costs[c - 1, rows], costs[c, rows], costs[c + 1, rows]
    bend = np.maximum(before + after - 2 * here, 1e-9)
    shift = np.clip((before - after) / (2 * bend), -0.5, 0.5)
    found = (here < NEVER) & (costs.argmin(axis=0) == c)  # not at an end of what was tried
    return np.where(found, candidates[c] + shift * STEP_MM, 0.0), np.where(found, here / bend + 1e-3, NEVER)


def _misfit(basis: Array, profiles: Array, weight: Array) -> Array:
    """Weighted sum of squares : (n,) that the best mixture of basis : (2 or 3, bins) leaves.

    `NEVER` where it is no step up, or the line isn't bright.
    """
    sums, levels = _residual(basis, profiles, weight)
    return np.where((levels[:, 0] > levels[:, 1]) & (levels[:, 2:] > 0).all(axis=1), sums, NEVER)


def _residual(basis: Array, profiles: Array, weight: Array) -> tuple[Array, Array]:
    count = len(basis)
    products = (basis[:, None] * basis[None]).reshape(count * count, -1)
    normal = (weight @ products.T).reshape(-1, count, count) + 1e-9 * np.eye(count)
    right = (weight * profiles) @ basis.T
    levels = np.linalg.solve(normal, right[..., None])[..., 0]
    return (weight * profiles**2).sum(axis=1) - (levels * right).sum(axis=1), levels
