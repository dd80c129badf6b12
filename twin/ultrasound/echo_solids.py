"""The scene as echoes see it: solids by their signed distance on a grid, wires by their ends.

A distance is negative inside. Solids may lie within one another: where several hold a point, the last one counts, and the
smaller come later; so of a border that two share. A box along the axes is known by its bounds; other distances are sampled on a
grid, so that between its points a plane's is exact, a curved face's off by its sag, and an edge rounded within a cell.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from recon.compiled import njit
from recon.errors import InputError
from recon.geometry.primitives import Cylinder
from scenes.acoustics import BACKSCATTER, faster, surroundings, tissue_of
from scenes.scene_types import Layers, Scene, Thing
from scenes.tissue import Tissue
from twin import conditions
from twin.conditions import Sound
from twin.displacement import NOWHERE, Displacement, carried_back, cofactors
from twin.ultrasound.grown_layers import NONE, Grown, layer_at, layer_distance, packed
from twin.ultrasound.mesh_distance import Grid, signed_distances

Array = NDArray[np.float64]

MARGINS_MM = 0.8, 0.2  # by which ragged and even borders of what lies in grown tissue are blurred to either side; assumed
MARGIN_MM = 3.0  # of the grids, around the solid, and most of a mesh's distance

FIRST, NX, NY, NZ = range(4)  # columns of `Solids.grid`
X0, Y0, Z0, PER_X, PER_Y, PER_Z = range(6)  # columns of `Solids.frame`


class Solids(NamedTuple):
    """Signed distances of the n solids on their grids, for compiled code; a row a solid."""

    distance: NDArray[np.float32]  # (m,) mm, of all grids, one after the other
    grid: NDArray[np.int64]  # (n, 4) place of the first value in `distance`, and points along x, y, z: none of a box
    frame: Array  # (n, 6) first point, mm in the world, and points a mm; of a box its middle, and half its sides, mm
    mirrors: NDArray[np.bool_]  # (n,) whether the border is even enough for an echo of its own
    layers: tuple[int, int]  # the first solid that is a layer, and the end
    grown: Grown  # the layers
    field: Displacement  # by which all of them have moved from where the grids have them


class Tissues(NamedTuple):
    """Acoustic figures by label : (n + 1,), 0 for the surroundings, for compiled code."""

    impedance: Array  # MRayl
    speed: Array  # m/s
    loss: Array  # nepers a mm, both ways
    roughness: Array  # mm
    fibres: Array  # nepers of amplitude by which a layer of fibres is brighter where it is met squarely
    specks: Array  # calcifications a mm3
    strands: Array  # nepers, standard deviation of the amplitude from strand to strand


@dataclass(frozen=True, eq=False)
class Solid:
    """A closed body, by its signed distance."""

    name: str
    tissue: Tissue
    distance: NDArray[np.float32]  # (nx, ny, nz) mm, negative inside; none of a box, which its mesh's bounds tell
    origin: Array  # (3,) mm in the world, of the first grid point
    spacing: Array  # (3,) mm
    mesh: trimesh.Trimesh  # for exact sections; of a layer, that of what holds it
    is_layer: bool = False  # whether it has grown, on a grid that others share
    half_mm: float = 0.0  # half the thickness of a layer that is a sheet
    mirrors: bool = True  # whether its border is even enough for an echo of its own

    @property
    def is_box(self) -> bool:
        """Whether it is a box along the axes, without a grid."""
        return not self.distance.size

    def distances(self, points: Array) -> Array:
        """Signed distances : (n,) mm of points : (n, 3) in the world; 1e3 outside the grid."""
        if self.is_box:
            beyond = np.abs(points - self.mesh.bounds.mean(axis=0)) - self.mesh.extents / 2
            return np.linalg.norm(np.maximum(beyond, 0), axis=1) + np.minimum(beyond.max(axis=1), 0)
        places = ((points - self.origin) / self.spacing).T
        found = map_coordinates(self.distance, places, order=1, mode="constant", cval=1e3)
        return np.abs(found) - self.half_mm if self.half_mm else found


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
    grown: Layers | None = None  # those of the solids that are layers
    field: Displacement = NOWHERE  # by which all of it has moved from where its solids say

    @property
    def tissues(self) -> tuple[Tissue, ...]:
        """By label: 0 is what surrounds the solids."""
        return (self.medium, *(solid.tissue for solid in self.solids))

    def packed(self) -> Solids:
        """The solids' distances, for compiled code."""
        return self._packed

    @cached_property
    def _packed(self) -> Solids:
        first = next((k for k, solid in enumerate(self.solids) if solid.is_layer), len(self.solids))
        sizes = [0 if solid.is_layer else solid.distance.size for solid in self.solids]
        starts = np.concatenate([[0], np.cumsum(sizes)])[:-1] if sizes else []
        grid = [(int(start), *solid.distance.shape) for start, solid in zip(starts, self.solids, strict=True)]
        frame = [
            (*solid.mesh.bounds.mean(axis=0), *(solid.mesh.extents / 2))
            if solid.is_box
            else (*solid.origin, *(1 / solid.spacing))
            for solid in self.solids
        ]
        own = [solid.distance.ravel() for solid in self.solids if not solid.is_layer]
        return Solids(
            np.concatenate(own) if own else np.zeros(0, np.float32),
            np.array(grid, np.int64).reshape(-1, 4),
            np.array(frame, float).reshape(-1, 6),
            np.array([solid.mirrors for solid in self.solids], bool),
            (first, first + sum(solid.is_layer for solid in self.solids)),
            packed(self.grown),
            self.field,
        )

    def displaced(self, field: Displacement) -> "Body":
        """The same body, displaced from its rest; wires stay."""
        moved = replace(self, field=field)
        moved.__dict__["_packed"] = self.packed()._replace(field=field)  # as the cached property would have it
        return moved

    def acoustics(self, frequency_mhz: float) -> Tissues:
        """The tissues' figures at a frequency, for compiled code."""
        loss = self.column("attenuation") * frequency_mhz * np.log(10) / 100  # from dB/cm/MHz
        fibres = self.column("fibres_db") * np.log(10) / 20
        strands = self.column("strands_db") * np.log(10) / 20
        impedance, speed, roughness, specks = map(self.column, ("impedance", "speed", "roughness", "specks_per_mm3"))
        return Tissues(impedance, speed, loss, roughness, fibres, specks, strands)

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
        If a thing's tissue is unknown, its mesh is open, or its grid too large.
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
    if scene.layers is None:
        return Body(surroundings(scene), tuple(solids), tuple(wires))
    grown = scene.layers()
    inside = 1 + [solid.name for solid in solids].index(grown.within)
    steps = np.full(3, grown.step_mm)
    held = solids[inside - 1].mesh
    layers = [
        Solid(one.name, tissue_of(scene, one), one.distance, grown.origin, steps, held, True, one.half_mm, one.mirrors)
        for one in grown.layers
    ]
    return Body(surroundings(scene), (*solids[:inside], *layers, *solids[inside:]), tuple(wires), grown)


def at_speeds(body: Body, errors: Sound, *key: int) -> Body:
    """The same body with speeds of sound drawn anew, the same for the same key."""
    ratio, warmer = conditions.speeds(errors, *key)
    if ratio == 1 and warmer == 0:
        return body
    solids = tuple(replace(one, tissue=faster(one.tissue, ratio, warmer)) for one in body.solids)
    return replace(body, medium=faster(body.medium, ratio, warmer), solids=solids)


def solid(thing: Thing, tissue: Tissue, shape: Cylinder | None) -> Solid:
    """A thing by its signed distance: of a box along the axes, a sphere or a cylinder by its formula, else of the mesh."""
    spacing_mm = 0.5 if thing.mesh.extents.max() <= 60.0 else 1.0  # of the grids of small and of large solids
    sag_mm = 0.001  # by which a rod's wall lies within the true one: of a chord between the points of its grid
    steps = np.full(3, spacing_mm)
    if shape is not None:
        along = (thing.mesh.vertices - shape.point) @ shape.axis
        across = min(spacing_mm, float(np.sqrt(8 * shape.radius * sag_mm)))
        steps = np.where(np.abs(shape.axis) > 1 - 1e-9, spacing_mm, across)  # along the axis the wall is straight
        grid = _grid(thing, steps)
        distance = _sampled(grid, lambda points: _in_rod(points, shape, along.min(), along.max()))
    elif thing.primitive is not None:
        grid = _grid(thing, steps)
        distance = _sampled(grid, thing.primitive.distance)
    elif not thing.mesh.is_watertight:
        raise InputError(f"scene: {thing.name}: expected a closed mesh, found open edges; merge its vertices, or fill its holes")
    elif np.isclose(thing.mesh.volume, np.prod(thing.mesh.extents), rtol=1e-6):
        empty = np.zeros((0, 0, 0), np.float32)
        return Solid(thing.name, tissue, empty, thing.mesh.bounds[0], steps, thing.mesh, mirrors=thing.mirrors)
    else:
        grid = _grid(thing, steps)
        distance = signed_distances(np.asarray(thing.mesh.triangles, float), grid, MARGIN_MM)
    return Solid(thing.name, tissue, distance, grid.first, steps, thing.mesh, mirrors=thing.mirrors)


def _grid(thing: Thing, steps: Array) -> Grid:
    """Points around a thing."""
    low, high = thing.mesh.bounds[0] - MARGIN_MM, thing.mesh.bounds[1] + MARGIN_MM
    counts, most_points = np.ceil((high - low) / steps).astype(int) + 1, 3e8
    if (points := np.prod(counts.astype(float))) > most_points:
        raise InputError(f"scene: {thing.name}: expected a thing whose grid has up to {most_points:g} points, found {points:.2g}")
    return Grid(low, steps, counts)


def _sampled(grid: Grid, distance: Callable[[Array], Array]) -> NDArray[np.float32]:
    """A formula's distances at a grid's points, plane by plane."""
    x, y, z = (grid.first[k] + grid.steps[k] * np.arange(grid.counts[k]) for k in range(3))
    sheets = (np.stack(np.meshgrid(each, y, z, indexing="ij"), axis=-1).reshape(-1, 3) for each in x)
    return np.stack([distance(sheet).reshape(len(y), len(z)) for sheet in sheets]).astype(np.float32)


def _in_rod(points: Array, rod: Cylinder, first: float, last: float) -> Array:
    offset = points - rod.point
    along = offset @ rod.axis
    radial = np.linalg.norm(offset - np.outer(along, rod.axis), axis=1) - rod.radius
    return np.maximum(radial, np.maximum(first - along, along - last))


@njit(inline="always")
def between(low, high, share):
    """The value a share of the way from one to another."""
    return low + share * (high - low)


@njit(inline="always")
def distance_at(solids, solid, x, y, z):
    """Signed distance of one solid at a point of the world: of a box exact, else trilinear, and 1e3 outside its grid.

    Of a displaced body it is one that no border is nearer than, as lengths shrink by its least stretch at most.
    """
    x, y, z = resting_place(solids, x, y, z)
    return shrinking(solids) * resting_distance(solids, solid, x, y, z)


@njit(inline="always")
def is_displaced(solids):
    """Whether a body has moved from its rest."""
    return solids.field.moved.shape[0] > 0


@njit(inline="always")
def shrinking(solids):
    """Least share of a resting distance that is left of it."""
    return solids.field.stretch


@njit(inline="always")
def resting_place(solids, x, y, z):
    """Where a point of a body rested."""
    if is_displaced(solids):
        field = solids.field
        x, y, z = carried_back(field.moved, field.back, field.first, field.per_mm, x, y, z)
    return x, y, z


@njit(inline="always")
def turned(solids, nx, ny, nz, x, y, z):
    """A normal at a place of a body at rest, as the displacement has turned it; of length 1."""
    if is_displaced(solids):
        a, b, c, _ = cofactors(solids.field.moved, solids.field.first, solids.field.per_mm, x, y, z)
        nx, ny, nz = (
            nx * a[0] + ny * b[0] + nz * c[0],
            nx * a[1] + ny * b[1] + nz * c[1],
            nx * a[2] + ny * b[2] + nz * c[2],
        )
        size = np.sqrt(nx * nx + ny * ny + nz * nz) + 1e-12
        nx, ny, nz = nx / size, ny / size, nz / size
    return nx, ny, nz


@njit(inline="always")
def resting_step(solids, dx, dy, dz, x, y, z):
    """A small step from where a place of a body rested, as it was at rest."""
    if is_displaced(solids):
        a, b, c, volume = cofactors(solids.field.moved, solids.field.first, solids.field.per_mm, x, y, z)
        dx, dy, dz = (
            (a[0] * dx + a[1] * dy + a[2] * dz) / volume,
            (b[0] * dx + b[1] * dy + b[2] * dz) / volume,
            (c[0] * dx + c[1] * dy + c[2] * dz) / volume,
        )
    return dx, dy, dz


@njit(inline="always")
def resting_distance(solids, solid, x, y, z):
    """Signed distance of one solid, at rest, at a point."""
    first, end = solids.layers
    if first <= solid < end:
        grown = solids.grown
        return layer_distance(grown.distance, grown.half_mm, grown.first, grown.per_mm, solid - first, x, y, z)
    return own_distance(solids, solid, x, y, z)


@njit(inline="always")
def is_sheet(solids, solid):
    """Whether a solid is a layer of two faces."""
    first, end = solids.layers
    return first <= solid < end and solids.grown.half_mm[solid - first] > 0


@njit(inline="always")
def own_distance(solids, solid, x, y, z):
    """Signed distance of a solid with a grid of its own, or none."""
    grid, frame = solids.grid, solids.frame
    if grid[solid, NX] == 0:
        return _box_distance(frame, solid, x, y, z)
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
def _box_distance(frame, solid, x, y, z):
    """Signed distance of a box along the axes."""
    a = abs(x - frame[solid, X0]) - frame[solid, PER_X]
    b = abs(y - frame[solid, Y0]) - frame[solid, PER_Y]
    c = abs(z - frame[solid, Z0]) - frame[solid, PER_Z]
    d, e, f = max(a, 0.0), max(b, 0.0), max(c, 0.0)
    return np.sqrt(d * d + e * e + f * f) + min(max(a, b, c), 0.0)


@njit(inline="always")
def label_at(solids, x, y, z):
    """Label of a point: 0 in the surroundings, k + 1 in solid k, the last that holds it."""
    x, y, z = resting_place(solids, x, y, z)
    return resting_label(solids, x, y, z)


@njit(inline="always")
def resting_label(solids, x, y, z, beside=0.0):
    """Label of a point of a body at rest; what lies over layers holds it from as far beside its border, of its MARGINS_MM."""
    (first, end), grown = solids.layers, solids.grown
    for k in range(len(solids.grid) - 1, -1, -1):
        if first <= k < end:
            if k == end - 1:
                layer = layer_at(grown.sure, grown.among, grown.distance, grown.half_mm, grown.first, grown.per_mm, x, y, z)
                if layer != NONE:
                    return first + layer + 1
        elif own_distance(solids, k, x, y, z) <= (beside * MARGINS_MM[int(solids.mirrors[k])] if first < end <= k else 0.0):
            return k + 1
    return 0
