"""The surface of a dark mass in averaged echo power, from profiles across a rough one.

A border of two tissues, blurred by pulse, beam and slice, is a step with half of its height on the border; a border square to the
beam also reflects, which adds a bright line in the same place. Both are fitted to profiles along the surface's normals, each with
levels of its own, so that the brightness of the tissue beside is free. Profiles are averaged over their neighbours at the same
distance from the rough surface: unlike a blur of the image, this doesn't shrink what is round.
"""

from typing import NamedTuple

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy import ndimage, sparse
from scipy.ndimage import uniform_filter1d
from scipy.spatial import KDTree
from scipy.special import ndtr

from recon.compiled import kernel, njit
from recon.geometry import rigid
from recon.geometry.surface_tree import nearest
from recon.segmentation.echo_power import EchoPower
from recon.threads import in_threads

Array = NDArray[np.float64]

REACH_MM = 2.4  # of a profile, on either side of the surface
BIN_MM = 0.2
PATCH_MM = 1.0  # standard deviation of the weights by which neighbours are averaged
FARTHEST = 2.5  # patches: neighbours beyond count nothing
EVENINGS = 10  # rounds of smoothing over neighbouring vertices
NEVER = 1e9  # misfit of no step up, or of a dark line
RIDGE = 1e-9  # on the diagonal of the normal equations, for profiles without data
OUTSIDE, INSIDE, LINE = 0, 1, 2  # rows of a trial: shares of both levels, and the bright line


class _Cells(NamedTuple):
    """Places sorted into cubes; a row of cubes along z lies in one piece."""

    places: Array  # (n, 3) mm, sorted
    normals: Array  # (n, 3), likewise
    cube: NDArray[np.int64]  # (n, 3) of each place
    start: NDArray[np.int64]  # (nx, ny, nz + 1) number of the first place in a cube; the last ends the row


def refine(rough: trimesh.Trimesh, power: EchoPower, bright: bool = False, patch_mm: float = PATCH_MM) -> trimesh.Trimesh:
    """Move the vertices of a closed mesh along their normals to the border in the power.

    bright : whether power steps down to the outside, and not up.
    """
    number, distance, value, weight = _near(rough, power)
    bins = round(2 * REACH_MM / BIN_MM)
    index = number * bins + np.clip(((distance + REACH_MM) / BIN_MM).astype(int), 0, bins - 1)
    count = len(rough.vertices) * bins
    total = np.bincount(index, weight * value, count).reshape(-1, bins)
    mass = np.bincount(index, weight, count).reshape(-1, bins)
    vertices, normals = np.asarray(rough.vertices), np.asarray(rough.vertex_normals)
    mixed = mix(vertices, normals, np.hstack([mass, total]), patch_mm)
    mass, total = mixed[:, :bins], mixed[:, bins:]
    step, doubt = _steps(np.divide(total, mass, out=np.zeros_like(total), where=mass > 0), mass, bright)
    sure, pull = mix(vertices, normals, np.column_stack([1 / doubt, step / doubt]), patch_mm).T
    stay = 0.1  # of the median certainty: weight of the place before
    moved = pull / (sure + stay * np.median(sure))  # uncertain vertices stay
    return evened(rough, vertices + moved[:, None] * normals)


def mix(places: Array, normals: Array, values: Array, patch_mm: float) -> Array:
    """Weighted sums : (n, k) of values : (n, k) over neighbouring vertices.

    The weight is a Gaussian of the distance times the cosine between the normals : (n, 3), 0 for opposite ones.
    """
    reach = FARTHEST * patch_mm
    cube = ((places - places.min(axis=0)) / reach).astype(np.int64)
    size = cube.max(axis=0) + 1
    flat = np.ravel_multi_index(cube.T, size)
    order = np.argsort(flat, kind="stable")
    start = np.searchsorted(flat[order], np.arange(size.prod() + 1))
    rows = np.append(start[:-1].reshape(size), start[size[2] :: size[2]].reshape(*size[:2], 1), axis=2)
    result = np.empty_like(values)
    cells, sorted_values, sums = _Cells(places[order], normals[order], cube[order], rows), values[order], np.zeros_like(values)
    in_threads(_mix, len(values), cells, sorted_values, (patch_mm, reach), sums)
    result[order] = sums
    return result


@kernel
def _mix(first, end, cells, values, lengths, sums):
    nx, ny, nz = cells.start.shape
    for n in range(first, end):
        x, y, z = cells.cube[n, 0], cells.cube[n, 1], cells.cube[n, 2]
        low, high = max(z - 1, 0), min(z + 2, nz - 1)
        for i in range(max(x - 1, 0), min(x + 2, nx)):
            for j in range(max(y - 1, 0), min(y + 2, ny)):
                _add_row(sums, cells, values, n, (cells.start[i, j, low], cells.start[i, j, high]), lengths)


@njit(inline="always")
def _add_row(sums, cells, values, n, row, lengths):
    patch, reach = lengths
    place, normal = cells.places[n], cells.normals[n]
    for other in range(row[0], row[1]):
        gap, cosine = 0.0, 0.0
        for axis in range(3):
            gap += (place[axis] - cells.places[other, axis]) ** 2
            cosine += normal[axis] * cells.normals[other, axis]
        if gap <= reach * reach and cosine > 0:
            share = np.exp(-gap / (2 * patch * patch)) * cosine
            for column in range(values.shape[1]):
                sums[n, column] += share * values[other, column]


def evened(mesh: trimesh.Trimesh, vertices: Array) -> trimesh.Trimesh:
    """A mesh with other vertices, spikes taken off by Taubin's smoothing, which nearly keeps the volume."""
    ends = mesh.faces[:, [0, 1, 2, 1, 2, 0]].T.reshape(2, -1)
    joined = sparse.csr_matrix((np.ones(ends.shape[1]), ends), shape=2 * (len(vertices),))
    joined = joined + joined.T
    joined.data[:] = 1
    share = sparse.diags(1 / np.maximum(np.diff(joined.indptr), 1))
    moved = trimesh.Trimesh(vertices, mesh.faces, process=False)
    return trimesh.smoothing.filter_taubin(moved, iterations=EVENINGS, laplacian_operator=share @ joined)


def _near(rough: trimesh.Trimesh, power: EchoPower) -> tuple[NDArray[np.int64], Array, Array, Array]:
    """Voxels with data near a surface: the nearest vertex, distance (positive outside), power and weight."""
    volume = power.volume
    nearby = 1.1  # times that: distance of a profile's voxel from its vertex, as vertices lie closer than voxels
    farthest, spared = (
        nearby * REACH_MM,
        np.linalg.norm(volume.spacing) / 2,
    )  # a vertex lies up to this far from its voxel's centre
    voxel = rigid.apply(np.linalg.inv(volume.world_from_voxel), rough.vertices)
    margin = (farthest + spared) / volume.spacing
    low = np.maximum(np.floor(voxel.min(axis=0) - margin), 0).astype(int)
    high = np.minimum(np.ceil(voxel.max(axis=0) + margin).astype(int) + 1, volume.voxels.shape[::-1])
    part = tuple(slice(a, b) for a, b in zip(low[::-1], high[::-1], strict=True))
    apart = np.ones(tuple(high - low)[::-1], bool)
    apart[tuple(np.clip(np.rint(voxel).astype(int) - low, 0, high - low - 1).T[::-1])] = False
    within = np.asarray(ndimage.distance_transform_edt(apart, volume.spacing[::-1])) < farthest + spared
    k, j, i = np.nonzero((power.weight[part] > 0.01) & within)
    index = np.column_stack([i, j, k]) + low
    places = rigid.apply(volume.world_from_voxel, index)
    away, chosen = nearest(KDTree(rough.vertices), places, farthest=farthest)
    kept = np.isfinite(away)
    places, chosen, index = places[kept], chosen[kept], index[kept]
    distance = ((places - rough.vertices[chosen]) * rough.vertex_normals[chosen]).sum(axis=1)
    kept = np.abs(distance) < REACH_MM
    i, j, k = index[kept].T
    return (
        chosen[kept],
        distance[kept],
        volume.voxels[k, j, i].astype(float),
        power.weight[k, j, i].astype(float),
    )


def _steps(profiles: Array, weight: Array, down: bool = False) -> tuple[Array, Array]:
    """Places : (n,) mm at which profiles : (n, bins) step up, or down, and a variance in some unit.

    Where none is found, or the least misfit lies beside places at which nothing fits, as in noise alone, the variance is `NEVER`.

    Each trial place and blur is fitted with the levels within, without and of a line on the border; the least sum of squares,
    weighed as speckle scatters, counts. A weak line looks like a step elsewhere, so a line counts only where the fit is much
    better with it.
    """
    s = -REACH_MM + BIN_MM * (np.arange(profiles.shape[1]) + 0.5)
    most_mm = 1.0  # by which a vertex is moved in one round
    step_mm = 0.1  # between trial places
    candidates = np.arange(-most_mm, most_mm + step_mm / 2, step_mm)
    floor = 0.05  # of tissue's power: no level counts as more certain than that of this
    weight = weight / np.maximum(uniform_filter1d(profiles, 5, axis=1, mode="nearest"), floor)
    blurs_mm = (0.25, 0.4, 0.6)  # trial standard deviations; with a narrower one more steps are found beside lines
    z = (s - candidates[:, None, None]) / np.array(blurs_mm)[:, None]
    trials = np.stack([ndtr(z), ndtr(-z), np.exp(-z * z / 2)], axis=2)  # (places, blurs, 3, bins)
    plain, lined = misfits(-profiles if down else profiles, weight, trials)
    if down:
        lined = np.full_like(plain, NEVER)  # a bright body's border has no dark line
    unlike = 0.05  # of tissue's power, by which blurs differ from those tried
    least = unlike**2 * weight.sum(axis=1)
    line_gain = 1.5  # by which the misfit must be less with a line on the border
    costs = np.where(plain.min(axis=0) + least > line_gain * (lined.min(axis=0) + least), lined, plain)
    c = np.clip(costs.argmin(axis=0), 1, len(candidates) - 2)
    rows = np.arange(len(profiles))
    before, here, after = costs[c - 1, rows], costs[c, rows], costs[c + 1, rows]
    bend = np.maximum(before + after - 2 * here, 1e-9)
    shift = np.clip((before - after) / (2 * bend), -0.5, 0.5)
    found = (np.maximum(before, after) < NEVER) & (costs.argmin(axis=0) == c)  # not at an end
    return np.where(found, candidates[c] + shift * step_mm, 0.0), np.where(found, here / bend + 1e-3, NEVER)


def misfits(profiles: Array, weight: Array, trials: Array) -> tuple[Array, Array]:
    """Least weighted sums of squares : (places, n) over the blurs, of steps alone and of steps with a bright line.

    `NEVER` where the levels don't step up, or the line isn't bright.
    """
    plain, lined = np.full((2, len(trials), len(profiles)), NEVER)
    in_threads(_fill_misfits, len(profiles), profiles, weight, trials, plain, lined)
    return plain, lined


@kernel
def _fill_misfits(first, end, profiles, weight, trials, plain, lined):
    for n in range(first, end):
        for place in range(trials.shape[0]):
            for blur in range(trials.shape[1]):
                sums = _weighted_sums(trials[place, blur], profiles[n], weight[n])
                plain[place, n] = min(plain[place, n], _misfit_of_step(sums))
                lined[place, n] = min(lined[place, n], _misfit_with_line(sums))


class _Sums(NamedTuple):
    """Weighted sums over a profile y and the rows a, b, c of a trial."""

    yy: float
    ay: float
    by: float
    cy: float
    aa: float
    ab: float
    ac: float
    bb: float
    bc: float
    cc: float


@njit(inline="always")
def _weighted_sums(trial, profile, weight):
    yy, ay, by, cy = 0.0, 0.0, 0.0, 0.0
    aa, ab, ac, bb, bc, cc = RIDGE, 0.0, 0.0, RIDGE, 0.0, RIDGE
    for s in range(len(profile)):
        y, a, b, c = profile[s], trial[OUTSIDE, s], trial[INSIDE, s], trial[LINE, s]
        wy, wa, wb, wc = weight[s] * y, weight[s] * a, weight[s] * b, weight[s] * c
        yy, ay, by, cy = yy + wy * y, ay + wa * y, by + wb * y, cy + wc * y
        aa, ab, ac, bb, bc, cc = aa + wa * a, ab + wa * b, ac + wa * c, bb + wb * b, bc + wb * c, cc + wc * c
    return _Sums(yy, ay, by, cy, aa, ab, ac, bb, bc, cc)


@njit(inline="always")
def _misfit_of_step(m):
    """Sum of squares left by the best levels on both sides, by Cramer's rule."""
    det = m.aa * m.bb - m.ab * m.ab
    outside, inside = (m.ay * m.bb - m.by * m.ab) / det, (m.by * m.aa - m.ay * m.ab) / det
    if outside > inside:
        return m.yy - outside * m.ay - inside * m.by
    return NEVER


@njit(inline="always")
def _misfit_with_line(m):
    """Sum of squares left by the best levels on both sides and of the line, by elimination of the line."""
    ac, bc = m.ac / m.cc, m.bc / m.cc
    aa, ab, bb = m.aa - ac * m.ac, m.ab - ac * m.bc, m.bb - bc * m.bc
    ay, by = m.ay - ac * m.cy, m.by - bc * m.cy
    det = aa * bb - ab * ab
    outside, inside = (ay * bb - by * ab) / det, (by * aa - ay * ab) / det
    line = m.cy / m.cc - ac * outside - bc * inside
    if outside > inside and line > 0:
        return m.yy - outside * m.ay - inside * m.by - line * m.cy
    return NEVER
