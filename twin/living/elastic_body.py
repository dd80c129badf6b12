"""A soft body on a hard base under a probe's face: linear elasticity by finite elements, with contact that only pushes.

The body is meshed in columns along the world's z, from the skin that faces the cameras down to what holds it. Elements are
trilinear hexahedra of nearly incompressible, isotropic tissue; the change of volume counts in their middles alone, so that they
don't lock (selective reduced integration). The face is a set of points; a point that lies below the skin pushes it along the
face's normal until it lies in the face, and none pulls:

    f >= 0,  C f - d >= 0,  f (C f - d) = 0,

with the compliance C of the skin at the points and their depths d below the resting skin: Signorini's conditions, solved as a
non-negative least-squares problem.
Sources: Hughes 2000, The Finite Element Method, 4.4 (reduced integration); Wriggers 2006, Computational Contact Mechanics, 5.
"""

from dataclasses import dataclass, field
from itertools import pairwise
from threading import RLock
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.linalg import cholesky, get_lapack_funcs
from scipy.optimize import nnls
from threadpoolctl import ThreadpoolController, threadpool_limits

from recon.compiled import kernel
from recon.threads import in_threads
from twin.displacement import Displacement, Flow, led_through, led_to
from twin.ultrasound.echo_solids import Body, Solid, label_at
from twin.ultrasound.probe_path import top

Array = NDArray[np.float64]
Tile = tuple[int, int]  # of the skin, along x and y

TILE = 4  # nodes of the skin along x and y whose responses are worked out at once
KEPT = 32  # tiles whose responses are kept, of 20 MB each by default; a face lies on up to 18
LAYERS = (0.04, 0.06, 0.08, 0.11, 0.15, 0.18, 0.19, 0.19)  # heights of a column's elements over its own, from the skin
BESIDE_MM = 15.0  # of the mesh beside a body that lies on a soft support
HELD_MM = 10.0  # below a soft support's surface, where bone holds it; assumed
LEAST_MM = 3.0  # of a column; lower ones are left out
HARD_KPA = 1e7  # of what isn't soft
REACH_MM = 20.0  # along the normal, within which the skin under a point of the face is looked for
NEAR_MM = 3.0  # of the skin, from where a point of the face may touch it
FRICTION = 0.5  # of wet skin on the face, over the pressure; assumed
POISSON = 0.495  # of soft tissue: nearly incompressible
STIFFEST = 40.0  # times the softest: stiffer tissues, which don't yield beside it, count as much
GRID_MM = 2.5  # of the grid that displacements are kept on
SAMPLES = (2, 2, 2)  # of an element's tissues


class Mesh(NamedTuple):
    """Columns of nodes."""

    x: Array  # (nx,) mm in the world
    y: Array  # (ny,)
    skin: Array  # (nx, ny) mm, z of the skin
    base: float  # mm, z of what holds the body
    kept: NDArray[np.bool_]  # (nx - 1, ny - 1) whether a column of elements is tissue

    @property
    def shares(self) -> Array:
        """Depth of the nodes of a column below the skin over its height : (nz,)."""
        return np.concatenate([[0.0], np.cumsum(LAYERS)])

    def nodes(self) -> Array:
        """Places of all nodes : (nx, ny, nz, 3) mm in the world."""
        z = self.skin[..., None] + (self.base - self.skin)[..., None] * self.shares
        x, y = np.broadcast_to(self.x[:, None, None], z.shape), np.broadcast_to(self.y[None, :, None], z.shape)
        return np.stack([x, y, z], axis=-1)


@dataclass(frozen=True, eq=False)
class PlaneFactor:
    """Block elimination of a stiffness that couples each plane of nodes with the next ones alone, plane by plane.

    With the blocks K of p planes and their couplings A with the planes before, of m unknowns each, `S = K - A S'^-1 A^T` of the
    plane before. Inverses are kept in single precision, and what that leaves of the forces is solved for once more: without, 4e-6
    of the largest displacement is wrong, and compliances under a face are no longer positive.
    """

    stiffness: sparse.csr_matrix  # (m p, m p)
    ends: NDArray[np.int64]  # (p + 1,) first unknown of each plane, and the end
    inverses: list[NDArray[np.float32]]  # (p,) S^-1 : (m, m)
    before: list[sparse.csr_matrix]  # (p,) A : (m, m'), of which the first plane has none

    @classmethod
    def of(cls, stiffness: Any, ends: NDArray[np.int64]) -> "PlaneFactor":
        """Eliminate the unknowns of a sparse matrix, on one thread, for the same bits anywhere."""
        inverses, before, inverse = list[NDArray[np.float32]](), list[Any](), np.zeros((0, 0))
        invert: Any = get_lapack_funcs("potri", (inverse,))
        with threadpool_limits(1):
            for k, (first, end) in enumerate(pairwise(ends.tolist())):
                coupling = stiffness[first:end, ends[max(k - 1, 0)] : first]
                block = stiffness[first:end, first:end].toarray()
                block -= coupling @ np.ascontiguousarray((coupling @ inverse).T)
                root = cholesky(block, lower=True, overwrite_a=True, check_finite=False)
                inverse, _ = invert(root, lower=True, overwrite_c=True)
                inverse = np.ascontiguousarray(np.tril(inverse) + np.tril(inverse, -1).T)
                inverses.append(inverse.astype(np.float32))
                before.append(coupling.astype(np.float32))
        return cls(stiffness, ends, inverses, before)

    def solve(self, forces: Array) -> Array:
        """Displacements : (m p, k) by forces : (m p, k); bits depend on k and on the number of BLAS's threads."""
        found = self._nearly(forces)
        return found + self._nearly(forces - self.stiffness @ found)

    def _nearly(self, forces: Array) -> Array:
        """The same in single precision."""
        found, parts = np.float32(forces), [slice(*ends) for ends in pairwise(self.ends.tolist())]
        for k, part in enumerate(parts):
            if k:
                found[part] -= self.before[k] @ found[parts[k - 1]]
            if found[part].any():  # planes before all forces rest as yet
                found[part] = self.inverses[k] @ found[part]
        for k in reversed(range(len(parts) - 1)):
            found[parts[k]] -= self.inverses[k] @ (self.before[k + 1].T @ found[parts[k + 1]])
        return found.astype(float)


@dataclass(frozen=True, eq=False)
class ElasticBody:
    """A body that yields, and its responses to unit forces on the skin, which are worked out as they are asked for."""

    mesh: Mesh
    free: NDArray[np.int64]  # (m,) numbers of the degrees of freedom that nothing holds
    factor: PlaneFactor  # of the stiffness of these
    coupling: sparse.csr_matrix  # (m, k) stiffness between these and those of the base
    held: NDArray[np.int64]  # (k,) numbers of the base's degrees of freedom
    responses: dict[Tile, dict[int, NDArray[np.float32]]] = field(default_factory=dict)  # kept, the one used last at the end
    lock: RLock = field(default_factory=RLock)  # of the responses, and of all threads of linear algebra
    blas: ThreadpoolController = field(default_factory=ThreadpoolController)  # found once, which takes 5 ms

    @property
    def size(self) -> tuple[int, int, int]:
        """Nodes along x, y and depth."""
        return len(self.mesh.x), len(self.mesh.y), len(LAYERS) + 1

    def respond(self, nodes: NDArray[np.int64]) -> dict[int, NDArray[np.float32]]:
        """Displacements : (3, 3 n) mm of all nodes by unit forces on nodes of the skin, by i ny + j, and on those beside them.

        All of a tile are worked out at once, for the same bits always, and the KEPT tiles that were used last are kept.
        """
        with self.lock, self.blas.limit(limits=1):
            found: dict[int, NDArray[np.float32]] = {}
            for tile in sorted({(node // self.size[1] // TILE, node % self.size[1] // TILE) for node in nodes.tolist()}):
                self.responses[tile] = self.responses.pop(tile, None) or self._responses_of(tile)
                found |= self.responses[tile]
                while len(self.responses) > KEPT:
                    del self.responses[next(iter(self.responses))]
            return found

    def _responses_of(self, tile: Tile) -> dict[int, NDArray[np.float32]]:
        nx, ny, nz = self.size
        i, j = (TILE * first + np.arange(TILE) for first in tile)
        nodes = (i[i < nx, None] * ny + j[j < ny]).ravel()
        place = np.full(3 * nx * ny * nz, -1)
        place[self.free] = np.arange(len(self.free))
        rows = place[3 * nz * np.repeat(nodes, 3) + np.tile(np.arange(3), len(nodes))]
        forces = np.zeros((len(self.free), len(rows)))
        forces[rows[rows >= 0], np.flatnonzero(rows >= 0)] = 1.0
        every = np.zeros((len(rows), len(place)), np.float32)
        every[:, self.free] = self.factor.solve(forces).T
        return {node: every[3 * n : 3 * n + 3] for n, node in enumerate(nodes.tolist())}

    def moved_base(self, shifts: Array) -> Array:
        """Displacements : (nx, ny, nz, 3) mm of all nodes when those of the base are moved : (nx, ny, 3) mm."""
        every = np.zeros((*self.size, 3))
        every[:, :, -1] = shifts
        flat = every.reshape(-1)
        with self.lock, self.blas.limit(limits=1):
            flat[self.free] = self.factor.solve(-(self.coupling @ flat[self.held])[:, None])[:, 0]
        return every


def elastic_body(body: Body, surface: Solid, support: Solid | None, element_mm: float) -> ElasticBody:
    """Mesh a solid that faces the cameras, with all that lies in it, and factorise its stiffness; takes some seconds.

    support : on which it lies; where that is soft, the body is held HELD_MM below its surface
    """
    mesh = _mesh(surface, support, element_mm)
    modulus = _moduli(body, mesh)
    stiffness: Any = _stiffness(mesh, modulus)  # SciPy's own hints say that a sparse matrix has no parts
    number = np.arange(stiffness.shape[0]).reshape(*mesh.skin.shape, -1)
    held = number[:, :, -3:].ravel()
    used = np.zeros(mesh.skin.shape, bool)
    for i, j in ((0, 0), (0, 1), (1, 0), (1, 1)):
        used[i : i + mesh.kept.shape[0], j : j + mesh.kept.shape[1]] |= mesh.kept
    free = number[..., :-3][used].ravel()
    plane = free // int(np.prod(number.shape[1:]))
    ends = np.searchsorted(free, number[np.unique(plane), 0, 0])
    factor = PlaneFactor.of(stiffness[free][:, free].tocsr(), np.append(ends, len(free)))
    return ElasticBody(mesh, free, factor, stiffness[free][:, held].tocsr(), held)


def press(soft: ElasticBody, face: Array, normal: Array, already: Array | None = None, drag: Array | None = None) -> Displacement:
    """Displacement of a body under a probe's face.

    Parameters
    ----------
    face : (m, 3) mm
        Points of the face, in the world.
    normal : (3,)
        Unit, into the tissue.
    already : (nx, ny, nz, 3) mm
        Displacements of the nodes by other causes, which the face meets.
    drag : (3,) mm
        By which the face draws the skin along that it touches, square to the normal.
    """
    base = np.zeros((*soft.size, 3)) if already is None else already
    under = _under(soft, face, normal)
    if not (under.depth > -NEAR_MM).any():
        return led_through(spread(soft, base))
    face = face[under.depth > -NEAR_MM]
    under = _Under(*(values[under.depth > -NEAR_MM] for values in under))
    nodes, at = np.unique(under.nodes, return_inverse=True)
    share = np.zeros((len(face), len(nodes)))
    np.add.at(share, (np.repeat(np.arange(len(face)), 4), at.ravel()), under.weights.ravel())
    rested = face - under.depth[:, None] * normal
    wanted = under.depth - (share @ base[:, :, 0].reshape(-1, 3)[nodes]) @ normal
    with soft.lock, soft.blas.limit(limits=1):
        responses = soft.respond(nodes)
        surface = 3 * soft.size[2] * np.repeat(nodes, 3) + np.tile(np.arange(3), len(nodes))
        compliance = np.stack([responses[node][:, surface] for node in nodes.tolist()]).astype(float)  # by a force on b, j
        compliance = compliance.reshape(len(nodes), 3, len(nodes), 3)
        # (m, 3, m, 3) displacement of each point by a force on each other
        skin = np.einsum("ma,bjai,nb->minj", share, compliance, share, optimize=True)
        pushed = np.einsum("i,minj,j->mn", normal, skin, normal)
        pushed += 1e-6 * np.trace(pushed) / len(pushed) * np.eye(len(pushed))
        root = np.linalg.cholesky(pushed)

    def pushed(depth: Array) -> tuple[Array, Flow]:
        """Forces of the points that push the skin by a depth : (m,), and what flows by them."""
        with soft.lock, soft.blas.limit(limits=1):
            force, _ = nnls(root.T, np.linalg.solve(root, depth))
            forces = force[:, None] * normal
            if drag is not None and force.any():
                forces += _dragging(skin, forces, force > 0, normal, drag)
            moved = base.reshape(-1).copy()
            for node, push in zip(nodes.tolist(), share.T @ forces, strict=True):
                if push.any():
                    moved += push.astype(np.float32) @ responses[node]
        return force, spread(soft, moved.reshape(base.shape))

    force, flow = pushed(wanted)
    left = np.where(force > 0, (face - led_to(flow, rested)) @ normal, 0)  # as displacements are large
    return led_through(pushed(wanted + left)[1])


class _Under(NamedTuple):
    """The skin under points of a face."""

    nodes: NDArray[np.int64]  # (m, 4) of the skin around each
    weights: Array  # (m, 4)
    depth: Array  # (m,) mm, of the point below the skin; negative above it


def _under(soft: ElasticBody, face: Array, normal: Array) -> _Under:
    """The resting skin under each point of a face, along its normal: the nearest; far from any the depth is -inf."""
    mesh, steps = soft.mesh, np.arange(-REACH_MM, REACH_MM + 0.2, 0.2)

    def within(depth: Array) -> tuple[Array, NDArray[np.int64], Array]:
        """How far a place at a depth below the skin lies within the tissue, down the world's z, and the nodes about it."""
        place = face.reshape(-1, *(1,) * (depth.ndim - 1), 3) - depth[..., None] * normal
        i, a = _between(place[..., 0], mesh.x)
        j, b = _between(place[..., 1], mesh.y)
        weights = np.stack([(1 - a) * (1 - b), (1 - a) * b, a * (1 - b), a * b], axis=-1)
        nodes = np.stack([i, i, i + 1, i + 1], axis=-1) * len(mesh.y) + np.stack([j, j + 1, j, j + 1], axis=-1)
        skin = (weights * mesh.skin.ravel()[nodes]).sum(axis=-1)
        beside = ~mesh.kept[i, j]
        for axis, line in enumerate((mesh.x, mesh.y)):
            beside |= (place[..., axis] < line[0]) | (place[..., axis] > line[-1])
        return np.where(beside, -np.inf, place[..., 2] - skin), nodes, weights

    inside = within(np.broadcast_to(steps, (len(face), len(steps))))[0]
    leaves = (inside[:, :-1] >= 0) & (inside[:, 1:] < 0) & np.isfinite(inside[:, 1:])  # from tissue outwards
    nearest = np.where(leaves, np.abs(steps[:-1]), np.inf).argmin(axis=1)
    low, high = steps[nearest], steps[nearest + 1]
    for _ in range(20):
        middle = (low + high) / 2
        held = within(middle)[0] >= 0
        low, high = np.where(held, middle, low), np.where(held, high, middle)
    _, nodes, weights = within(low)
    return _Under(nodes, weights, np.where(leaves.any(axis=1), low, -np.inf))


def _between(values: Array, nodes: Array) -> tuple[NDArray[np.int64], Array]:
    step = nodes[1] - nodes[0]
    share = np.clip((values - nodes[0]) / step, 0, len(nodes) - 1)
    first = np.minimum(share.astype(int), len(nodes) - 2)
    return first, share - first


def _dragging(skin: Array, pushing: Array, touching: NDArray[np.bool_], normal: Array, drag: Array) -> Array:
    """Forces : (m, 3) by which points that touch the skin draw it along, square to the normal, as far as friction holds it."""
    across = np.linalg.svd(normal[None])[2][1:]  # (2, 3)
    some = np.flatnonzero(touching)
    wanted = np.tile(across @ drag, (len(some), 1)) - np.einsum("ki,minj,nj->mk", across, skin[some], pushing)
    matrix = np.einsum("ki,minj,lj->mknl", across, skin[np.ix_(some, range(3), some, range(3))], across)
    matrix = matrix.reshape(2 * len(some), -1)
    matrix += 1e-6 * np.trace(matrix) / len(matrix) * np.eye(len(matrix))
    forces = np.zeros_like(pushing)
    forces[some] = np.linalg.solve(matrix, wanted.ravel()).reshape(-1, 2) @ across
    most, found = FRICTION * np.linalg.norm(pushing.sum(axis=0)), np.linalg.norm(forces.sum(axis=0))
    return forces * min(1.0, most / max(found, 1e-12))


def _mesh(surface: Solid, support: Solid | None, element_mm: float) -> Mesh:
    low, high = surface.mesh.bounds
    soft = support is not None and support.tissue.soft
    beside = BESIDE_MM if soft else 0.0
    x, y = (
        np.linspace(start - beside, end + beside, int(np.ceil((end - start + 2 * beside) / element_mm)) + 1)
        for start, end in zip(low[:2], high[:2], strict=True)
    )
    ground = float(support.mesh.bounds[0, 2]) if support is not None else float(high[2])
    places = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)
    middle, within = (low[:2] + high[:2]) / 2, 1 - 1e-4  # a little within, or a side would be missed
    skin = top(surface, middle + within * (places - middle)).reshape(len(x), len(y))
    skin = np.where(np.isfinite(skin), np.minimum(skin, ground), ground)
    base = ground + (HELD_MM if soft else 0.0)
    height = base - skin
    kept = np.minimum.reduce([height[:-1, :-1], height[:-1, 1:], height[1:, :-1], height[1:, 1:]]) >= LEAST_MM
    return Mesh(x, y, skin, base, kept)


def _moduli(body: Body, mesh: Mesh) -> Array:
    """Young's modulus, kPa, of all elements : (nx - 1, ny - 1, nz - 1): the mean of the tissues at some of its points."""
    soft = [tissue.modulus_kpa if tissue.soft else HARD_KPA for tissue in body.tissues]
    nodes = mesh.nodes()
    inside = [(np.arange(n) + 0.5) / n for n in SAMPLES]
    shares = np.stack(np.meshgrid(*inside, indexing="ij"), axis=-1).reshape(-1, 3)
    total, count = np.zeros(np.subtract(nodes.shape[:3], 1)), 0
    for a, b, c in shares:
        low = (1 - a) * nodes[:-1] + a * nodes[1:]
        low = (1 - b) * low[:, :-1] + b * low[:, 1:]
        points = (1 - c) * low[:, :, :-1] + c * low[:, :, 1:]
        labels = np.zeros(points.shape[:3], np.int64)
        in_threads(_label, len(points), labels, points, body.packed())
        values = np.array(soft)[labels]
        total += np.where(labels > 0, values, 0)
        count = count + (labels > 0)
    modulus = total / np.maximum(count, 1)
    softest = np.quantile(modulus[count > 0], 0.01)
    return np.clip(modulus, softest, STIFFEST * softest)


@kernel
def _label(first, end, labels, points, solids):
    for i in range(first, end):
        for j in range(labels.shape[1]):
            for k in range(labels.shape[2]):
                labels[i, j, k] = label_at(solids, points[i, j, k, 0], points[i, j, k, 1], points[i, j, k, 2])


def _stiffness(mesh: Mesh, modulus: Array) -> sparse.csr_matrix:
    """Stiffness of all nodes : (3 n, 3 n), a node's x, y and z one after the other; those that no element has are empty.

    With the gradients g and h of two nodes' shares, `K_ij = mu (g.h delta_ij + g_j h_i - 2/3 g_i h_j) + k g_i h_j`, summed over
    two Gauss's points along each axis; the last part in an element's middle alone.
    """
    nx, ny, nz = (*mesh.skin.shape, len(LAYERS) + 1)
    number = np.arange(nx * ny * nz).reshape(nx, ny, nz)
    corners = np.array(list(np.ndindex(2, 2, 2)))  # (8, 3)
    nodes, total = mesh.nodes().reshape(-1, 3), sparse.csr_matrix((3 * number.size, 3 * number.size))
    bulk = 2 * (1 + POISSON) / (3 * (1 - 2 * POISSON))  # over the shear modulus
    for i in range(nx - 1):  # a plane of elements at once
        kept = np.broadcast_to(mesh.kept[i, :, None], modulus.shape[1:])
        cells = np.stack([number[i + p, q : ny - 1 + q, r : nz - 1 + r][kept] for p, q, r in corners.tolist()], axis=1)  # (n, 8)
        shear, stiff = modulus[i][kept] / 3, np.zeros((len(cells), 8, 3, 8, 3))
        for point in np.vstack([0.5 + (corners - 0.5) / np.sqrt(3), [[0.5, 0.5, 0.5]]]):
            sides, signs = np.where(corners, point, 1 - point), 2.0 * corners - 1
            slopes = np.stack([signs[:, n] * np.delete(sides, n, axis=1).prod(axis=1) for n in range(3)], axis=1)  # (8, 3)
            lengths = np.einsum("cu,ncx->nux", slopes, nodes[cells])
            gradient = np.einsum("nxu,cu->ncx", np.linalg.inv(lengths), slopes)
            each = np.einsum("n,nai,nbj->naibj", shear * np.linalg.det(lengths), gradient, gradient, optimize=True)
            if (point == 0.5).all():
                stiff += bulk * each
            else:
                stiff += (each.transpose(0, 1, 4, 3, 2) - 2 / 3 * each + np.einsum("naxbx,ij->naibj", each, np.eye(3))) / 8
        rows = (3 * cells[..., None] + np.arange(3)).reshape(len(cells), 24)
        places = np.repeat(rows, 24, axis=1).ravel(), np.tile(rows, (1, 24)).ravel()
        total += sparse.csr_matrix((stiff.ravel(), places), total.shape)
    return total


def spread(soft: ElasticBody, moved: Array) -> Flow:
    """Displacements of a body's nodes : (nx, ny, nz, 3) mm on a grid, as between the nodes; beyond the body as at its border."""
    mesh = soft.mesh
    first = np.array([mesh.x[0], mesh.y[0], mesh.skin.min() - GRID_MM])
    last = np.array([mesh.x[-1], mesh.y[-1], mesh.base + GRID_MM])
    counts = np.ceil((last - first) / GRID_MM).astype(int) + 1
    found = np.zeros((*counts, 3), np.float32)
    in_threads(_spread, counts[0], found, np.ascontiguousarray(moved, float), mesh, mesh.shares, first, GRID_MM)
    return Flow(first, 1 / GRID_MM, found)


@kernel
def _spread(start, end, found, moved, mesh, shares, first, step):
    nx, ny, nz, _ = moved.shape
    per_x, per_y = 1 / (mesh.x[1] - mesh.x[0]), 1 / (mesh.y[1] - mesh.y[0])
    for gi in range(start, end):
        gx = min(max((first[0] + step * gi - mesh.x[0]) * per_x, 0.0), nx - 1.0)
        i = min(int(gx), nx - 2)
        a = gx - i
        for gj in range(found.shape[1]):
            gy = min(max((first[1] + step * gj - mesh.y[0]) * per_y, 0.0), ny - 1.0)
            j = min(int(gy), ny - 2)
            b = gy - j
            w = (1 - a) * (1 - b), (1 - a) * b, a * (1 - b), a * b
            skin = w[0] * mesh.skin[i, j] + w[1] * mesh.skin[i, j + 1]
            skin += w[2] * mesh.skin[i + 1, j] + w[3] * mesh.skin[i + 1, j + 1]
            k = 0
            for gk in range(found.shape[2]):
                share = (first[2] + step * gk - skin) / max(mesh.base - skin, 1e-6)
                share = min(max(share, 0.0), 1.0)
                while k < nz - 2 and share > shares[k + 1]:
                    k += 1
                c = (share - shares[k]) / (shares[k + 1] - shares[k])
                c = min(max(c, 0.0), 1.0)
                for n in range(3):
                    upper = w[0] * moved[i, j, k, n] + w[1] * moved[i, j + 1, k, n]
                    upper += w[2] * moved[i + 1, j, k, n] + w[3] * moved[i + 1, j + 1, k, n]
                    lower = w[0] * moved[i, j, k + 1, n] + w[1] * moved[i, j + 1, k + 1, n]
                    lower += w[2] * moved[i + 1, j, k + 1, n] + w[3] * moved[i + 1, j + 1, k + 1, n]
                    found[gi, gj, gk, n] = (1 - c) * upper + c * lower
