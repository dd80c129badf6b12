"""The scene as echoes see it: solids by their signed distance on a grid, wires by their ends.

A distance is negative inside. Solids may lie within one another: where several hold a point, the last one counts, and the
smaller come later. A plane's distance is linear, and so exact on a grid of two points; a cylinder's is sampled from its formula.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt, label, sum_labels

from recon.compiled import njit
from recon.errors import InputError
from recon.geometry.primitives import Cylinder
from recon.geometry.surface_tree import surface_tree
from scenes.acoustics import BACKSCATTER, Tissue, faster, surroundings, tissue_of
from scenes.scene_types import Scene, Thing
from twin import conditions
from twin.conditions import Sound

Array = NDArray[np.float64]

MARGIN_MM = 3.0  # of the grids, around the solid

FIRST, NX, NY, NZ = range(4)  # columns of `Solids.grid`
X0, Y0, Z0, PER_X, PER_Y, PER_Z = range(6)  # columns of `Solids.frame`


class Solids(NamedTuple):
    """Signed distances of the n solids on their grids, for compiled code; a row a solid."""

    distance: NDArray[np.float32]  # (m,) mm, of all grids, one after the other
    grid: NDArray[np.int64]  # (n, 4) place of the first value in `distance`, and points along x, y, z
    frame: Array  # (n, 6) first point, mm in the world, and points a mm


class Tissues(NamedTuple):
    """Acoustic figures by label : (n + 1,), 0 for the surroundings, for compiled code."""

    impedance: Array  # MRayl
    speed: Array  # m/s
    loss: Array  # nepers a mm, both ways
    roughness: Array  # mm


@dataclass(frozen=True, eq=False)
class Solid:
    """A closed body, by its signed distance."""

    name: str
    tissue: Tissue
    distance: NDArray[np.float32]  # (nx, ny, nz) mm, negative inside
    origin: Array  # (3,) mm in the world, of the first grid point
    spacing: Array  # (3,) mm
    mesh: trimesh.Trimesh  # for exact sections


@dataclass(frozen=True, eq=False)
class Wire:
    """A straight, thin, round string."""

    name: str
    tissue: Tissue
    ends: Array  # (2, 3) mm in the world
    radius: float  # mm


@dataclass(frozen=True, eq=False)
class Body:
    """All of a scene's solids and wires, and the packed tables that compiled code walks through."""

    medium: Tissue
    solids: tuple[Solid, ...]
    wires: tuple[Wire, ...]

    @property
    def tissues(self) -> tuple[Tissue, ...]:
        """By label: 0 is what surrounds the solids."""
        return (self.medium, *(solid.tissue for solid in self.solids))

    def packed(self) -> Solids:
        """The solids' distances, for compiled code."""
        return self._packed

    @cached_property
    def _packed(self) -> Solids:
        sizes = [solid.distance.size for solid in self.solids]
        starts = np.concatenate([[0], np.cumsum(sizes)])[:-1] if sizes else []
        grid = [(int(start), *solid.distance.shape) for start, solid in zip(starts, self.solids, strict=True)]
        frame = [(*solid.origin, *(1 / solid.spacing)) for solid in self.solids]
        flat = np.concatenate([solid.distance.ravel() for solid in self.solids]) if sizes else np.zeros(0, np.float32)
        return Solids(flat, np.array(grid, np.int64).reshape(-1, 4), np.array(frame, float).reshape(-1, 6))

    def acoustics(self, frequency_mhz: float) -> Tissues:
        """The tissues' figures at a frequency, for compiled code."""
        loss = self.column("attenuation") * frequency_mhz * np.log(10) / 100  # from dB/cm/MHz
        return Tissues(self.column("impedance"), self.column("speed"), loss, self.column("roughness"))

    def column(self, name: str) -> Array:
        """A figure of the tissues by label : (n + 1,)."""
        return np.array([getattr(tissue, name) for tissue in self.tissues], float)

    def scattering(self) -> Array:
        """Backscatter coefficient by label : (n + 1,) 1/(mm sr)."""
        levels = [tissue.echogenicity for tissue in self.tissues]
        return np.array([0.0 if level is None else BACKSCATTER * 10 ** (level / 10) for level in levels])


def body(scene: Scene) -> Body:
    """The solids and wires of a scene for ultrasound. Takes seconds for a large mesh: build it once a scene.

    Raises
    ------
    InputError
        If a thing's tissue is unknown.
    """
    shapes = {shape.name: shape for shape in scene.shapes if isinstance(shape, Cylinder)}
    solids, wires = [], []
    thin_mm = 0.5  # radius, below which a rod is a wire
    for thing in scene.things:
        tissue, shape = tissue_of(scene, thing), shapes.get(thing.name)
        if shape is not None and shape.radius < thin_mm:
            along = (thing.mesh.vertices - shape.point) @ shape.axis
            ends = shape.point + np.outer([along.min(), along.max()], shape.axis)
            wires.append(Wire(thing.name, tissue, ends, shape.radius))
        else:
            solids.append(solid(thing, tissue, shape))
    solids.sort(key=lambda one: -float(np.prod(one.mesh.extents)))
    return Body(surroundings(scene), tuple(solids), tuple(wires))


def at_speeds(body: Body, errors: Sound, *key: int) -> Body:
    """The same body with speeds of sound drawn anew, the same for the same key."""
    ratio, warmer = conditions.speeds(errors, *key)
    if ratio == 1 and warmer == 0:
        return body
    solids = tuple(replace(one, tissue=faster(one.tissue, ratio, warmer)) for one in body.solids)
    return Body(faster(body.medium, ratio, warmer), solids, body.wires)


def solid(thing: Thing, tissue: Tissue, shape: Cylinder | None) -> Solid:
    """A thing by its signed distance: exact for boxes along the axes, spheres and cylinders, sampled from the mesh otherwise."""
    bounds = thing.mesh.bounds
    sag_mm = 0.001  # by which a rod's wall lies within the true one: of a chord between the points of its grid
    if shape is not None:
        along = (thing.mesh.vertices - shape.point) @ shape.axis
        across = min(_spacing(thing), float(np.sqrt(8 * shape.radius * sag_mm)))
        steps = np.where(np.abs(shape.axis) > 1 - 1e-9, _spacing(thing), across)  # along the axis the wall is straight
        return _sample(thing, tissue, lambda points: _in_rod(points, shape, along.min(), along.max()), steps)
    if thing.primitive is not None:
        return _sample(thing, tissue, thing.primitive.distance, np.full(3, _spacing(thing)))
    if np.isclose(thing.mesh.volume, np.prod(thing.mesh.extents), rtol=1e-6):
        distance, steps = _box(bounds)
        return Solid(thing.name, tissue, distance, bounds[0] - MARGIN_MM, steps, thing.mesh)
    step = _spacing(thing)
    points, low = _grid(thing, np.full(3, step))
    return Solid(thing.name, tissue, _from_mesh(thing.mesh, points, step), low, np.full(3, step), thing.mesh)


def _spacing(thing: Thing) -> float:
    large_mm = 60.0  # greatest extent of a small one
    spacing_mm = (0.5, 1.0)  # of the grids, of small and of large solids
    return spacing_mm[int(thing.mesh.extents.max() > large_mm)]


def _grid(thing: Thing, steps: Array) -> tuple[Array, Array]:
    """Points : (nx, ny, nz, 3) around a thing, and the first of them."""
    low, high = thing.mesh.bounds[0] - MARGIN_MM, thing.mesh.bounds[1] + MARGIN_MM
    counts = np.ceil((high - low) / steps).astype(int) + 1
    _check_count(thing.name, counts)
    axes = [low[k] + steps[k] * np.arange(counts[k]) for k in range(3)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1), low


def _check_count(name: str, counts: Array) -> None:
    most_points = 3e8  # of a grid
    if (points := np.prod(counts.astype(float))) > most_points:
        raise InputError(f"scene: {name}: expected a thing whose grid has up to {most_points:g} points, found {points:.2g}")


def _sample(thing: Thing, tissue: Tissue, distance: Callable[[Array], Array], steps: Array) -> Solid:
    points, low = _grid(thing, steps)
    values = np.stack([distance(sheet.reshape(-1, 3)).reshape(sheet.shape[:-1]) for sheet in points])
    return Solid(thing.name, tissue, values.astype(np.float32), low, steps, thing.mesh)


def _in_rod(points: Array, rod: Cylinder, first: float, last: float) -> Array:
    offset = points - rod.point
    along = offset @ rod.axis
    radial = np.linalg.norm(offset - np.outer(along, rod.axis), axis=1) - rod.radius
    return np.maximum(radial, np.maximum(first - along, along - last))


def _box(bounds: Array) -> tuple[NDArray[np.float32], Array]:
    """Distance on few points: between them it is linear, as far as it matters near a face."""
    low, high = bounds[0] - MARGIN_MM, bounds[1] + MARGIN_MM
    counts = np.maximum(np.ceil((high - low) / 5.0).astype(int), 4) + 1
    steps = (high - low) / (counts - 1)
    axes = [low[k] + steps[k] * np.arange(counts[k]) for k in range(3)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    outside = np.maximum(bounds[0] - points, points - bounds[1])
    return outside.max(axis=-1).astype(np.float32), steps


def _from_mesh(mesh: trimesh.Trimesh, points: Array, step: float) -> NDArray[np.float32]:
    """Distance along the normal of the nearest vertex, within a band: second order in the facet's size, where vertices are dense.

    Farther away each connected region takes the side of most of its neighbours in the band. The mesh's box bounds it as well,
    for a flat base may have no vertices of its own.
    """
    flat = points.reshape(-1, 3)
    band_mm = 3.0  # from a mesh, beyond which only the sign of its distance counts
    far, nearest = surface_tree(mesh.vertices).query(flat, distance_upper_bound=band_mm)
    near = np.isfinite(far)
    value = np.full(len(flat), band_mm)
    value[near] = ((flat[near] - mesh.vertices[nearest[near]]) * mesh.vertex_normals[nearest[near]]).sum(axis=1)
    value, near = value.reshape(points.shape[:-1]), near.reshape(points.shape[:-1])
    beyond = np.maximum(mesh.bounds[0] - points, points - mesh.bounds[1]).max(axis=-1)
    source = distance_transform_edt(~near, sampling=step, return_distances=False, return_indices=True)
    votes = np.sign(value[tuple(source)])
    regions, count = label(~near & (beyond < 0))
    side = np.sign(sum_labels(votes, regions, np.arange(count + 1)))
    value = np.where(near, value, np.where(regions > 0, band_mm * side[regions], beyond))
    return np.maximum(value, beyond).astype(np.float32)


@njit(inline="always")
def between(low, high, share):
    """The value a share of the way from one to another."""
    return low + share * (high - low)


@njit(inline="always")
def distance_at(solids, solid, x, y, z):
    """Signed distance of one solid at a point of the world, trilinear; 1e3 outside its grid."""
    grid, frame = solids.grid, solids.frame
    gx = (x - frame[solid, X0]) * frame[solid, PER_X]
    gy = (y - frame[solid, Y0]) * frame[solid, PER_Y]
    gz = (z - frame[solid, Z0]) * frame[solid, PER_Z]
    nx, ny, nz = grid[solid, NX], grid[solid, NY], grid[solid, NZ]
    if gx < 0 or gy < 0 or gz < 0 or gx > nx - 1 or gy > ny - 1 or gz > nz - 1:
        return 1e3
    i, j, k = min(int(gx), nx - 2), min(int(gy), ny - 2), min(int(gz), nz - 2)
    a, b, c = gx - i, gy - j, gz - k
    value, row, sheet = solids.distance, np.uint64(nz), np.uint64(ny * nz)
    p = np.uint64(grid[solid, FIRST] + (i * ny + j) * nz + k)  # unsigned, or each access would look for a negative index
    q, r, s, one = p + row, p + sheet, p + sheet + row, np.uint64(1)
    near = between(between(value[p], value[p + one], c), between(value[q], value[q + one], c), b)
    far = between(between(value[r], value[r + one], c), between(value[s], value[s + one], c), b)
    return between(near, far, a)


@njit(inline="always")
def label_at(solids, x, y, z):
    """Label of a point: 0 in the surroundings, k + 1 in solid k, the last that holds it."""
    for k in range(len(solids.grid) - 1, -1, -1):
        if distance_at(solids, k, x, y, z) < 0:
            return k + 1
    return 0
