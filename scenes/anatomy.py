"""Tissues of a breast, grown from a seed as signed distances on a grid: skin, fat lobules, ligaments, gland, ducts, chest wall.

From the skin inwards: skin; subcutaneous fat in lobules, which Cooper's ligaments part; the gland's cone behind the nipple, with
islands of fat and ducts; fat behind it; the pectoral muscle under its fascia; ribs; the lung. Lobules are the cells of a warped
Voronoi diagram, as in Bakic et al. 2003 and Pokrajac et al. 2012, and ligaments their borders. The gland is made of such cells,
so that fat scallops it; it is mottled, fat differs from lobule to lobule, and septa run along a muscle's bundles.

Phantom frame: chest in z = 0, z up to the apex; see `scenes.dome`.
"""

from dataclasses import dataclass
from typing import Annotated, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy.ndimage import distance_transform_edt, gaussian_filter, map_coordinates
from scipy.spatial import Delaunay, KDTree

from recon.geometry import rigid
from recon.geometry.surface_tree import nearest
from recon.model.rig import Part, Positive
from scenes.dome import Dome
from scenes.scene_types import Layer

Array = NDArray[np.float64]
Volume = NDArray[np.float32]

REACH_MM = 3.0  # of the distances
MARGIN_MM = 3.0  # of the grid around the breast
CHEST_MM = 25.0  # of the grid below the breast
Density = Literal["fatty", "scattered", "heterogeneous", "dense"]
GLANDULAR: dict[Density, float] = {"fatty": 0.06, "scattered": 0.15, "heterogeneous": 0.3, "dense": 0.5}
"""share of the breast's volume; classes of BI-RADS, shares assumed about the mean of 0.16 [Yaffe et al. 2009]"""


class Anatomy(Part):
    """What a breast is grown by; lengths in mm."""

    density: Density = "heterogeneous"
    """of the gland, by the classes of BI-RADS"""
    skin_mm: Annotated[float, Field(ge=0.3, le=5)] = 1.6
    """thickness of the skin [Willson et al. 1982: 1.62 in mammograms; Warszawski: 1.68 by ultrasound]"""
    skin_uneven: Annotated[float, Field(ge=0, le=0.4)] = 0.22
    """standard deviation of the skin's thickness over some 12 mm, of it; assumed"""
    areola_skin_mm: Annotated[float, Field(ge=0, le=5)] = 0.8
    """by which the skin is thicker at the areola; assumed"""
    septum_mm: Annotated[float, Field(ge=1.5, le=40)] = 6.0
    """from septum to septum along the skin, many of them broken; assumed"""
    lobule_mm: Annotated[float, Field(ge=4, le=40)] = 18.0
    """width of fat lobules, which are 0.45 of it thick: patients lie on their backs; assumed"""
    ligament_mm: Annotated[float, Field(ge=0.05, le=2)] = 0.25
    """least thickness of Cooper's ligaments; up to four times as thick here and there; assumed"""
    subcutaneous_mm: Annotated[float, Field(ge=0, le=40)] = 8.0
    """fat between skin and gland, none at the nipple; assumed"""
    retromammary_mm: Annotated[float, Field(ge=0, le=40)] = 4.0
    """fat between gland and muscle; assumed"""
    ducts: Annotated[int, Field(ge=0, le=40)] = 12
    """main ducts; 9 on average [Ramsay et al. 2005], more by others"""
    bundle_mm: Annotated[float, Field(ge=1, le=10)] = 2.2
    """from septum to septum in the muscle; assumed by the look of published images"""
    muscle_mm: Positive = 9.0
    """thickness of the pectoral muscle; assumed"""
    rib_mm: Positive = 32.0
    """from rib to rib; assumed"""
    uneven_db: Annotated[float, Field(ge=0, le=10)] = 2.2
    """standard deviation of the backscatter within a tissue, over 2 to 12 mm, and twice that within gland and muscle; assumed"""
    voxel_mm: Annotated[float, Field(ge=0.7, le=2)] = 1.0
    """of the grid"""


class Grid(NamedTuple):
    """Points of the phantom's frame, evenly."""

    first: Array  # (3,) mm
    step: float  # mm
    shape: tuple[int, int, int]

    def axes(self) -> tuple[Array, Array, Array]:
        """Coordinates, mm, that broadcast to the grid."""
        x, y, z = (start + self.step * np.arange(count) for start, count in zip(self.first, self.shape, strict=True))
        return x[:, None, None], y[None, :, None], z[None, None, :]

    def points(self) -> Array:
        """All of them : (n, 3) mm."""
        return np.stack(np.broadcast_arrays(*self.axes()), axis=-1).reshape(-1, 3)


@dataclass(frozen=True, eq=False)
class GrownBreast:
    """Tissues of a breast in its frame."""

    grid: Grid
    layers: tuple[Layer, ...]  # the first one, all under the skin, holds the others, of which the later ones count
    uneven_db: Volume  # backscatter over its tissue's
    strata_mm: Volume  # place across its strands, which lie along the skin, and farther down along the muscle
    depth: Volume  # mm under the skin


def grow(anatomy: Anatomy, skin: Dome, rng: np.random.Generator) -> GrownBreast:
    """Grow the tissues under a skin that stands on the chest's plane."""
    low, high = skin.vertices.min(axis=0), skin.vertices.max(axis=0)
    first = np.array([*(low[:2] - MARGIN_MM), -CHEST_MM])
    step = anatomy.voxel_mm
    shape = tuple((np.ceil((high + MARGIN_MM - first) / step) + 1).astype(int).tolist())
    grid = Grid(first, step, shape)
    x, y, z = grid.axes()
    noise = _Noise(grid, rng)

    depth = _depth_under(skin, grid)
    nipple = skin.vertices[skin.vertices[:, 2].argmax()]
    from_nipple = np.hypot(x - nipple[0], y - nipple[1])
    skin_mm = anatomy.skin_mm * (1 + anatomy.skin_uneven * noise.plane(12).clip(-2, 2)) + 0.1 * noise(4)
    skin_mm = skin_mm + anatomy.areola_skin_mm * np.exp(-((from_nipple / 14) ** 2))
    muscle = (z - 7 - 1.0 * noise.plane(60)).astype(np.float32)  # height over the muscle
    chest_mm = 3 + 0.0002 * (x**2 + y**2)  # by which the chest falls away to the sides
    muscle = np.maximum(muscle + chest_mm, skin_mm + 2 - depth).astype(np.float32)

    strata = _strata(depth, muscle, noise)
    lobules = _lobules(anatomy, grid, noise, strata)
    gland, glandular = _gland(anatomy, grid, noise, lobules, strata, depth, muscle, from_nipple)
    cooper = _ligaments(anatomy, grid, noise, lobules, glandular, gland, strata)
    layers = [
        Layer("fat", _cut(skin_mm - depth), mirrors=True),
        Layer("gland", gland),
        Layer("ligament0", cooper, half_mm=anatomy.ligament_mm / 2),
    ]
    if anatomy.ducts:
        layers.append(Layer("duct", _ducts(anatomy, grid, gland, nipple, rng)))
    core = np.hypot(from_nipple, np.maximum(nipple[2] - 12 - z, 0))
    layers += [
        Layer("nipple", _cut(core - 5.5)),
        Layer("muscle", muscle),  # of which the fibres' direction is that of the whole field
        Layer("ligament1", _septa(anatomy, grid, noise, strata, muscle), half_mm=anatomy.ligament_mm / 2),
        Layer("fascia", _cut(muscle), half_mm=0.3),
        Layer("rib", _ribs(anatomy, grid, muscle + 0.3 * noise(8)), mirrors=True),
        Layer("lung", _cut(muscle + anatomy.muscle_mm + 11 + 0.5 * noise(9)), mirrors=True),
    ]
    uneven = _unevenness(anatomy, grid, noise, lobules, strata, gland, muscle)
    return GrownBreast(grid, tuple(layers), uneven, strata, depth)


def in_world(layer: Volume, grid: Grid, world_from_phantom: Array) -> tuple[Volume, Array]:
    """The values on a grid along the world's axes, of the same spacing, and its first point : (3,) mm.

    Turns by right angles about the axes change no value; others interpolate.
    """
    corners = np.array([grid.first, grid.first + grid.step * (np.array(grid.shape) - 1)])
    box = np.stack(np.meshgrid(*corners.T, indexing="ij"), axis=-1).reshape(-1, 3)
    world = rigid.apply(world_from_phantom, box)
    first, last = world.min(axis=0), world.max(axis=0)
    turn = np.rint(world_from_phantom[:3, :3])
    if np.allclose(turn, world_from_phantom[:3, :3], atol=1e-9):
        order = np.abs(turn).argmax(axis=1)
        values = np.transpose(layer, order)
        return np.ascontiguousarray(values[tuple(slice(None, None, int(turn[k, order[k]])) for k in range(3))]), first
    counts = np.ceil((last - first) / grid.step).astype(int) + 1
    points = np.stack(
        np.meshgrid(*(start + grid.step * np.arange(n) for start, n in zip(first, counts, strict=True)), indexing="ij")
    )
    places = np.einsum(
        "ij,j...->i...", np.linalg.inv(world_from_phantom[:3, :3]), points - world_from_phantom[:3, 3, None, None, None]
    )
    values = map_coordinates(layer, (places - grid.first[:, None, None, None]) / grid.step, order=1, mode="nearest")
    return values.astype(np.float32), first


class _Noise:
    """Smooth random fields on a grid, of unit variance, each drawn anew."""

    def __init__(self, grid: Grid, rng: np.random.Generator) -> None:
        self._grid, self.rng = grid, rng

    def __call__(self, length_mm: float | tuple[float, float, float]) -> Volume:
        """Over lengths, mm, along x, y, z: about the distance from a hill to the next hollow."""
        sigma = np.broadcast_to(np.asarray(length_mm, float), 3) / np.pi / self._grid.step
        white = self.rng.standard_normal(self._grid.shape, dtype=np.float32)
        smooth = gaussian_filter(white, sigma, mode="wrap")
        return smooth / smooth.std()

    def plane(self, length_mm: float) -> Volume:
        """The same for every z."""
        flat = _Noise(self._grid._replace(shape=(*self._grid.shape[:2], 1)), self.rng)
        return flat((length_mm, length_mm, 1e-6))


def _cut(distance: Array) -> Volume:
    return np.clip(distance, -REACH_MM, REACH_MM).astype(np.float32)


def _depth_under(skin: Dome, grid: Grid) -> Volume:
    """Depth under the skin, mm, negative outside: to its facets near it, else by whole voxels; beside the breast, the chest's."""
    z = grid.axes()[2]
    inside = _is_inside(skin, grid)
    outside_mm, inside_mm = (np.asarray(distance_transform_edt(side, sampling=grid.step)) for side in (~inside, inside))
    depth = inside_mm - outside_mm - np.where(inside, 0.5, -0.5) * grid.step
    near = (np.abs(depth) < 5) & (z > 0)
    facet_mm = float(np.linalg.norm(np.diff(skin.vertices[skin.faces[:, :2]], axis=1), axis=2).max())
    points = grid.points()[near.ravel()]
    distance, chosen = nearest(KDTree(skin.vertices), points, farthest=5 + facet_mm)
    met = np.isfinite(distance)
    vertex = np.where(met, chosen, 0)
    along = np.einsum("ij,ij->i", skin.vertices[vertex] - points, _normals(skin)[vertex])
    by_facet = np.where(distance < max(3.0, 2 * facet_mm), along, np.sign(along) * distance)
    depth[near] = np.where(met, by_facet, depth[near])
    return depth.astype(np.float32)


def _normals(skin: Dome) -> Array:
    a, b, c = (skin.vertices[skin.faces[:, k]] for k in range(3))
    facing = np.cross(b - a, c - a)
    normals = np.zeros_like(skin.vertices)
    for k in range(3):
        np.add.at(normals, skin.faces[:, k], facing)
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)


def _is_inside(skin: Dome, grid: Grid) -> NDArray[np.bool_]:
    """Whether points lie under the skin or under the chest's plane."""
    from matplotlib.tri import LinearTriInterpolator, Triangulation  # loaded only where tissue grows

    x, y, z = grid.axes()
    corners = Delaunay(skin.vertices[:, :2]).simplices
    plan = Triangulation(skin.vertices[:, 0], skin.vertices[:, 1], corners)  # by SciPy's own interpolator it takes 6 times longer
    height = LinearTriInterpolator(plan, skin.vertices[:, 2])(*np.broadcast_arrays(x[:, :, 0], y[:, :, 0]))
    return z < np.maximum(height.filled(0.0), 0)[:, :, None]


def redistance(field: Volume, step: float) -> Volume:
    """Distances, mm, to a field's zero level, of its sign: by its slope near the level, by whole voxels farther off."""
    slope = np.linalg.norm(np.gradient(field, step), axis=0)
    near = field / np.maximum(slope, 1e-6)
    outside, inside = (np.asarray(distance_transform_edt(side, sampling=step)) for side in (field > 0, field <= 0))
    far = outside - inside - np.sign(field) * step / 2
    return np.where(np.abs(far) <= step, np.clip(near, -1.5 * step, 1.5 * step), far).clip(-REACH_MM, REACH_MM).astype(np.float32)


class _Lobules(NamedTuple):
    """Cells of a warped Voronoi diagram that fill the grid, flat along the strata."""

    nearest: NDArray[np.int64]  # (n, 5) cells by the distance of their seeds
    distance: Array  # (n, 5) to these, over a cell's width
    count: int
    grid: Grid
    width_mm: float

    def means(self, field: Array) -> Array:
        """Means of a field over each cell : (count,)."""
        cell = self.nearest[:, 0]
        total = np.bincount(cell, np.broadcast_to(field, self.grid.shape).ravel(), self.count)
        return total / np.maximum(np.bincount(cell, minlength=self.count), 1)

    def border(self, inside: NDArray[np.bool_]) -> Array:
        """Distance, mm, about, to the faces that part cells of one kind, (count,), from the others; negative within."""
        of = inside[self.nearest]
        to_these, to_others = (np.where(kind, self.distance, np.inf).min(axis=1) for kind in (of, ~of))
        gap = np.clip((to_these - to_others) / 2, -0.5, 0.5).reshape(self.grid.shape)
        slope = np.linalg.norm(np.gradient(gap, self.grid.step), axis=0)
        return gap / np.maximum(slope, 0.5 / self.width_mm)


def _lobules(anatomy: Anatomy, grid: Grid, noise: _Noise, strata: Volume) -> _Lobules:
    """Lobules of fat and of gland alike: the gland's border is scalloped by the fat that lies on it."""
    size = anatomy.lobule_mm * np.array([1, 1, 0.45])
    wide = anatomy.lobule_mm
    lengths = ((wide, wide, 0.35 * wide), (wide, wide, 0.35 * wide), (wide, wide, wide))  # mm; sides slant and overlap
    warp = [0.22 * wide * noise(length) for length in lengths]
    places = (*grid.axes()[:2], strata)
    scaled = np.stack([(axis + bent) / mm for axis, bent, mm in zip(places, warp, size, strict=True)], axis=-1)
    low, high = (bound(scaled.reshape(-1, 3), axis=0) for bound in (np.min, np.max))
    cells = np.stack(np.meshgrid(*(np.arange(np.floor(a) - 1, np.ceil(b) + 2) for a, b in zip(low, high, strict=True))), axis=-1)
    seeds = cells.reshape(-1, 3) + 0.5 + noise.rng.uniform(-0.42, 0.42, (cells.size // 3, 3))
    distance, chosen = nearest(KDTree(seeds), scaled.reshape(-1, 3).astype(np.float32), 5)
    return _Lobules(chosen, distance, len(seeds), grid, wide)


def _gland(
    anatomy: Anatomy,
    grid: Grid,
    noise: _Noise,
    lobules: _Lobules,
    strata: Volume,
    depth: Volume,
    muscle: Volume,
    from_nipple: Array,
) -> tuple[Volume, NDArray[np.bool_]]:
    """Distance to the gland, and the lobules it is made of: a cone from the nipple to the muscle, and islands of fat in it."""
    covered = anatomy.subcutaneous_mm * (1 + 0.35 * noise.plane(30)) * (1 - np.exp(-((from_nipple / 16) ** 2)))
    wide = 0.36 * (grid.shape[0] + grid.shape[1]) / 2 * grid.step
    within = np.minimum(depth - anatomy.skin_mm - covered, muscle - anatomy.retromammary_mm)
    within = np.minimum(within, (wide + 9 * noise.plane(35) - from_nipple) / 2)
    ragged = within + 2.0 * noise(14)
    breast = (depth > anatomy.skin_mm) & (muscle > 0)
    mean = lobules.means(np.where(breast, ragged, -9.0))
    share = GLANDULAR[anatomy.density]
    glandular = mean >= np.quantile(mean[lobules.nearest[:, 0].reshape(grid.shape)[breast]], 1 - 1.35 * share)
    fringe = 1.8 * _along(strata, grid, noise((9, 9, 2.5))) + 0.4 * noise(3)  # mm, by which its border frays, most along strata
    outer = np.maximum(lobules.border(glandular) + fringe, np.maximum(anatomy.skin_mm + 0.7 - depth, 1 - muscle))
    fat = noise((8, 8, 5)) + 0.4 * noise(4) - 1.3  # positive in islands
    return np.maximum(_cut(gaussian_filter(outer, 0.8)), redistance(fat, grid.step)), glandular


def _strata(depth: Volume, muscle: Volume, noise: _Noise) -> Volume:
    """Place across strands, mm: even shares of the way from the skin to the muscle, wavy, and below along the muscle."""
    way_mm = 45.0  # from skin to muscle, where it is its true length
    above, below = np.maximum(muscle, 0), np.maximum(-muscle, 0)
    level = way_mm * depth / np.maximum(depth + above, way_mm / 2) + below
    wavy = 1.3 * noise((18, 18, 9)) + 0.15 * noise((6, 6, 4))
    return (gaussian_filter(level, 1.0) + wavy).astype(np.float32)


def _along(strata: Volume, grid: Grid, field: Volume) -> Volume:
    """A field's values where its heights are the strata."""
    i, j, _ = np.meshgrid(*(np.arange(n, dtype=np.float32) for n in grid.shape), indexing="ij")
    laid = map_coordinates(field, [i, j, strata / np.float32(grid.step)], order=1, mode="grid-wrap")
    return laid / laid.std()


def _ligaments(
    anatomy: Anatomy, grid: Grid, noise: _Noise, lobules: _Lobules, glandular: NDArray[np.bool_], gland: Volume, strata: Volume
) -> Volume:
    """Distance to Cooper's ligaments, of sign: borders between lobules that fall to different sides of a toss, and the gland's.

    So some lobules hang together. Distances are stretched or shrunk as sheets are thinner or thicker; within the gland they fade.
    """
    tossed = lobules.border(noise.rng.random(lobules.count) < 0.5)
    cooper = _either(tossed, lobules.border(glandular))
    thin = np.exp(1.0 * (_along(strata, grid, noise((10, 10, 5))) + 0.5 * noise(5) - 0.3)).clip(0.4, 8)
    return _cut(cooper * thin * np.where(gland < -1, 2.0, 1.0))


def _septa(anatomy: Anatomy, grid: Grid, noise: _Noise, strata: Volume, muscle: Volume) -> Volume:
    """Distance to septa, of sign: along strata in fat and gland, tapering off; in muscle between bundles, along its fibres.

    Bundles lie askew to the muscle's face by some degrees, and are thick and thin, as their septa are.
    """
    spacing = anatomy.septum_mm / np.pi
    level = strata + 2.0 * noise((16, 16, 8)) + 0.3 * noise((6, 6, 6))
    faint = np.exp(1.2 * (_along(strata, grid, noise((11, 11, 4))) + 0.3 * noise(5)) + 0.6).clip(0.45, 12)
    septum = spacing * np.sin(level / spacing) * faint
    x, y, _ = grid.axes()
    bundle = anatomy.bundle_mm / np.pi
    depth = -muscle + 0.06 * (x + y) + 1.0 * noise((25, 25, 6)) + 0.5 * noise((14, 14, 3))
    fading = np.exp(1.5 * _along(depth.astype(np.float32), grid, noise((16, 16, 2.5))) + 0.3 * noise(4)).clip(0.3, 12)
    return _cut(np.where(muscle < 0, bundle * np.sin(depth / bundle) * fading, septum))


def _unevenness(
    anatomy: Anatomy, grid: Grid, noise: _Noise, lobules: _Lobules, strata: Volume, gland: Volume, muscle: Volume
) -> Volume:
    """Backscatter over its tissue's, dB : of each tissue's mean power.

    Fat differs from lobule to lobule, and little within one. Gland is mottled: its lobules and ducts are dark in bright stroma,
    some mm wide and half as thick. Muscle has bundles along its fibres.
    """
    toss = noise.rng.standard_normal(lobules.count)[lobules.nearest[:, 0]].reshape(grid.shape)
    fat = 0.75 * gaussian_filter(toss, 0.7) + 0.65 * noise(9)
    dark = 1 / (1 + np.exp(-4 * (_along(strata, grid, noise((5, 5, 2.5))) - 0.4)))  # in a third of it
    mottled = 0.75 * (0.33 - dark) / 0.4 + 0.5 * _along(strata, grid, noise((10, 10, 4))) + 0.45 * noise(12)
    bundles = 0.8 * _along(strata, grid, noise((14, 14, 2.5))) + 0.6 * noise(9)
    found = np.zeros(grid.shape, np.float32)
    for tissue, field, spread in (
        ((gland >= 0) & (muscle >= 0), fat, 1.0),
        ((gland < 0) & (muscle >= 0), mottled, 2.0),
        (muscle < 0, bundles, 2.0),
    ):
        if tissue.any():
            levels = anatomy.uneven_db * spread * field[tissue] / field[tissue].std()
            found[tissue] = levels - 10 * np.log10(np.mean(10 ** (levels / 10)))
    return found


def _either(one: Array, other: Array) -> Array:
    """Distances, of sign, to the nearer of two sheets."""
    return np.where(np.signbit(one) == np.signbit(other), 1, -1) * np.minimum(np.abs(one), np.abs(other))


def _ducts(anatomy: Anatomy, grid: Grid, gland: Volume, nipple: Array, rng: np.random.Generator) -> Volume:
    """Distance to ducts: from the nipple they fan out into the gland, fork, and thin from 1.2 to 0.6 mm of radius."""
    places, radii = [], []
    for turn in 2 * np.pi * (np.arange(anatomy.ducts) + rng.uniform(-0.3, 0.3, anatomy.ducts)) / anatomy.ducts:
        spread = rng.uniform(0.4, 1.15)  # rad from the axis
        start = nipple - [0, 0, 5] + [2 * np.cos(turn), 2 * np.sin(turn), 0]
        heading = np.array([np.sin(spread) * np.cos(turn), np.sin(spread) * np.sin(turn), -np.cos(spread)])
        branches = [(start, heading, 60)]
        while branches:
            place, heading, left = branches.pop()
            while left > 0:
                heading = heading + 0.06 * rng.standard_normal(3)
                heading /= np.linalg.norm(heading)
                place, left = place + 0.8 * heading, left - 1
                places.append(place)
                radii.append(0.6 + 0.6 * left / 60)
                if 8 < left < 45 and rng.random() < 0.03:
                    aside = heading + 0.6 * rng.standard_normal(3)
                    branches.append((place, aside / np.linalg.norm(aside), left - 5))
    distance, chosen = nearest(KDTree(np.array(places)), grid.points(), farthest=REACH_MM + 2)
    radius = np.append(radii, 0.0)[chosen]
    tube = np.where(np.isfinite(distance), distance - radius, REACH_MM).reshape(grid.shape)
    return _cut(np.maximum(tube, gland))


def _ribs(anatomy: Anatomy, grid: Grid, muscle: Volume) -> Volume:
    """Distance, at most the true one, to ribs aslant across the chest, oval, slightly bent; slope assumed."""
    x, y, _ = grid.axes()
    wide, thick = 6.5, 4.0  # half of a rib's width and thickness
    across = (y - 0.5 * x - 0.0006 * x**2) / np.hypot(1, 0.5)
    beside = (across + anatomy.rib_mm / 2) % anatomy.rib_mm - anatomy.rib_mm / 2
    below = muscle + anatomy.muscle_mm + thick
    return _cut((np.hypot(beside / wide, below / thick) - 1) * thick)
