"""Where the sound of a sweep went: for each place how many B-scans saw it, how deep, from where, how finely, with what gaps.

A tally takes B-scans one by one, in any order, and holds sums and extremes alone: its result doesn't depend on the order, its
memory on the number of voxels only. On the grid along the mean array (x) and beam (y) and across both (z) it keeps sums in voxels
of some 2 mm, and marks in parts of these whether a B-scan passed.

A line of the array counts where it shows tissue: down to its last bright echo, without what is dark for longer than a mass is
deep, which is a shadow, and without what is black from the image's upper border or its sides on, which lies beside a fan or under
a line that doesn't touch the skin.
"""

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import repeat
from typing import NamedTuple

import cv2
import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy import ndimage

from recon import arguments, threads
from recon.compiled import kernel, njit
from recon.errors import InputError
from recon.files.volumes import Volume
from recon.freehand.volume_compounding import Grid
from recon.geometry import rigid
from recon.segmentation import echo_power
from recon.segmentation.containment import below
from recon.segmentation.echo_power import SLICE_MM, SPREAD_MM
from recon.segmentation.rough_bodies import GAP

Array = NDArray[np.float64]
Map = NDArray[np.float32]
Mask = NDArray[np.bool_]

PARTS = (4, 2, 4)  # of a voxel along z, y and x, that are marked: gaps lie across the beam
FAMILIES = 4  # of image planes, by the direction of their normals about the beam: strokes that cross are told apart
DIRECTIONS = 8  # across the beam, in which the resolution is looked at
TIE_MM = 1e-7  # by which a plane just between two voxels belongs to one of them, whatever rounding says
NO_GAP, ENDLESS = 0, 255  # parts that a B-scan passes, and those without one on both sides


@dataclass(frozen=True)
class SeeingLimits:
    """What counts as seen, and as scanned."""

    step_mm: float = 2.0  # of the grid
    ringing_mm: float = 3.0  # at the face, in which no masses are looked for
    bridged_mm: float = GAP.widths_mm[0]  # between B-scans: masses are found across narrower gaps
    widest_mm: float = GAP.widths_mm[1]  # of a gap; beyond are strokes apart
    around_mm: float = (
        10.0  # beside the scanned hull, that is still to be scanned; strokes less than twice that apart are one hull
    )
    block_mm: float = 2.0  # of a B-scan, over which speckle is averaged before it counts as bright or dark
    drop_db: float = 8.0  # below the typical level in the image's upper half: what is darker is a mass, a shadow or noise
    dark_mm: float = 12.0  # down a line, beyond which what is dark counts as a shadow
    black_mm: float = 1.0  # of black between echoes, that is speckle's
    least_grey: float = 5.0  # of 255, of tissue, at least
    most_voxels: int = 4_000_000  # half a GB


LIMITS = SeeingLimits()


@dataclass(frozen=True)
class Spread:
    """Standard deviations of an echo's power, mm; by default those of the default array."""

    lateral_mm: float = SPREAD_MM[0]  # along the array
    axial_mm: float = SPREAD_MM[1]
    slice_mm: tuple[tuple[float, float], ...] = SLICE_MM  # depth, rising, and across the image plane there; none: a thin slice

    def across(self, depths: Array) -> Array:
        """Standard deviation across the image plane, mm, at depths, mm."""
        return np.interp(depths, *np.transpose(self.slice_mm)) if self.slice_mm else np.zeros_like(depths)


class Sums(NamedTuple):
    """Sums and extremes over B-scans, (nz, ny, nx) float32."""

    count: Map  # B-scans through a voxel
    depth: Map  # mm, sum
    beam: Map  # (nz, ny, nx, 3), sum of unit vectors
    density: Map  # (FAMILIES, nz, ny, nx), B-scans a mm, by a triangle that ends where gaps begin
    variance: Map  # (FAMILIES, nz, ny, nx) mm^2, least one across the plane


class Shown(NamedTuple):
    """The part of a B-scan that shows tissue."""

    pixels: Mask  # (h, w)
    top: int  # first row below the ringing
    face_row: float  # from which depths count
    down_mm: float  # height of a pixel
    variance: Array  # (h,) mm^2 across the plane, of each row


@dataclass(frozen=True, eq=False)
class Tally:
    """B-scans so far, on a grid; `add` changes the arrays."""

    grid: Grid
    shape: tuple[int, int]  # h, w of the B-scans
    spread: Spread
    face_row: float
    dynamic_range_db: float  # from black to white
    sums: Sums
    marks: NDArray[np.uint8]  # (nz, ny, nx) times PARTS: whether a B-scan passed


class Planned(NamedTuple):
    """All that is to be scanned, in place of what was: (nz, ny, nx) mm."""

    under_mm: Map  # depth below the skin; NaN elsewhere
    room_mm: Map  # from skin, ringing and the images' lower end, whichever is nearest


@dataclass(frozen=True, eq=False)
class Insonation:
    """How each place was seen: (nz, ny, nx) float32 on the tally's grid, x along the array, y into the depth, z across."""

    tally: Tally
    elevational_mm: Map  # sigma of an echo's power across the beam where it is coarsest, by the B-scans' spacing, too
    gap_mm: Map  # width of the widest gap between B-scans in the voxel: 0 where there is none, infinite beside the scan
    seen: Map  # share of the voxel that was seen, gaps that masses are found across included
    cells: Map  # independent cells of speckle a mm^3
    under_mm: Map  # depth below the skin, negative above; from the array's face where there is no skin over it
    room_mm: Map  # from skin, ringing and the images' lower end, whichever is nearest: radius of a ball that can be seen whole
    hull: Mask  # what was scanned, with what lies between
    around: Mask  # that, and what lies beside it under the skin

    @property
    def grid(self) -> Grid:
        """The voxels."""
        return self.tally.grid

    @property
    def voxel_mm3(self) -> float:
        """Volume of a voxel."""
        return float(np.prod(self.grid.spacing))

    @property
    def count(self) -> Map:
        """B-scans through a voxel."""
        return self.tally.sums.count

    @property
    def depth_mm(self) -> Map:
        """Mean depth below the face; NaN without a B-scan."""
        return _mean(self.tally.sums.depth, self.count)

    @property
    def beam(self) -> Map:
        """Mean direction of the beam in the world, a unit vector : (nz, ny, nx, 3); NaN without a B-scan."""
        beam = self.tally.sums.beam
        return _mean(beam, np.linalg.norm(beam, axis=-1)[..., None])

    @property
    def turned_deg(self) -> Map:
        """Standard deviation of that direction; NaN without a B-scan."""
        length = _mean(np.linalg.norm(self.tally.sums.beam, axis=-1), self.count)
        return np.rad2deg(np.sqrt(np.maximum(2 * (1 - length), 0)))

    @property
    def axial_mm(self) -> float:
        """Sigma of an echo's power in depth."""
        return self.tally.spread.axial_mm

    @property
    def lateral_mm(self) -> Map:
        """The same across the beam where it is finest; infinite far from any B-scan."""
        return np.sqrt(np.minimum.reduce(list(_variances(self.tally))))


def begin(
    grid: Grid,
    shape: tuple[int, int],
    spread: Spread | None = None,
    face_row: float = 0.0,
    dynamic_range_db: float = 60.0,
) -> Tally:
    """A tally without B-scans; shape (h, w) of those to come.

    Raises
    ------
    InputError
        If the grid has too many voxels.
    """
    nx, ny, nz = grid.size
    if nx * ny * nz > LIMITS.most_voxels:
        found = f"{nx} x {ny} x {nz}; take a larger step, or clip the images"
        raise InputError(f"map of what was seen: expected at most {LIMITS.most_voxels} voxels, found {found}")
    size = nz, ny, nx
    families = FAMILIES, *size
    count, depth, beam, density = (np.zeros(one, np.float32) for one in (size, size, (*size, 3), families))
    sums = Sums(count, depth, beam, density, np.full(families, np.inf, np.float32))
    marks = np.zeros(np.multiply(size, PARTS), np.uint8)
    return Tally(grid, shape, spread or Spread(), face_row, dynamic_range_db, sums, marks)


def grid_around(world_from_pixel: Array, shape: tuple[int, int], step_mm: float = LIMITS.step_mm) -> Grid:
    """The grid along the mean array and beam around all B-scans (h, w) with poses : (n, 4, 4), and what lies beside.

    Raises
    ------
    InputError
        As of `recon.segmentation.echo_power.beam_grid`.
    """
    inner = echo_power.beam_grid(world_from_pixel, shape, (step_mm,) * 3)
    beside = int(np.ceil(LIMITS.around_mm / step_mm)) + 1
    return widened(inner, (beside, 0, beside))


def widened(grid: Grid, more: tuple[int, int, int]) -> Grid:
    """A grid with some voxels more at both ends of x, y and z."""
    origin = grid.origin - grid.directions @ (grid.spacing * more)
    nx, ny, nz = (n + 2 * m for n, m in zip(grid.size, more, strict=True))
    return Grid((nx, ny, nz), origin, grid.spacing, grid.directions)


def grown(tally: Tally, more: tuple[int, int, int]) -> Tally:
    """The same tally on a grid with some voxels more at both ends of x, y and z; InputError if these are too many."""
    larger = begin(widened(tally.grid, more), tally.shape, tally.spread, tally.face_row, tally.dynamic_range_db)
    (z, y, x), (nz, ny, nx) = more[::-1], tally.grid.size[::-1]
    inner = slice(z, z + nz), slice(y, y + ny), slice(x, x + nx)
    for name, one in zip(Sums._fields, tally.sums, strict=True):
        getattr(larger.sums, name)[(..., *inner) if name in ("density", "variance") else inner] = one
    larger.marks[tuple(slice(s.start * n, s.stop * n) for s, n in zip(inner, PARTS, strict=True))] = tally.marks
    return larger


def top_row(face_row: float, down_mm: float) -> int:
    """First row of images below the ringing at the face."""
    return max(0, math.ceil(face_row + LIMITS.ringing_mm / down_mm - 1e-6))


def tissue(
    image: NDArray[np.uint8], pixel_mm: tuple[float, float], face_row: float = 0.0, dynamic_range_db: float = 60.0
) -> Mask:
    """Pixels : (h, w) below the ringing that show tissue in a B-scan (h, w) whose grey levels are log-compressed.

    pixel_mm : width and height of a pixel
    """
    (height, width), top = image.shape, top_row(face_row, pixel_mm[1])
    echoes = ~_black(image, pixel_mm)
    size = tuple(max(1, round(n * mm / LIMITS.block_mm)) for n, mm in ((width, pixel_mm[0]), (height, pixel_mm[1])))
    sums, shares = (cv2.resize(one, size, interpolation=cv2.INTER_AREA) for one in (image, np.uint8(255) * echoes))
    blocks = sums / np.maximum(shares / 255, 1 / 255)
    first, count = min(top * len(blocks) // height, len(blocks) - 1), len(blocks)
    upper = blocks[first : max(first + 1, count // 2)]
    if not (upper >= LIMITS.least_grey).any():
        return np.zeros(image.shape, bool)
    typical = float(np.median(upper[upper >= LIMITS.least_grey]))
    bright = blocks >= max(LIMITS.least_grey, typical - LIMITS.drop_db * 255 / dynamic_range_db)
    row = np.arange(count)[:, None]
    before = np.maximum.accumulate(np.where(bright, row, first - 1))
    after = np.minimum.accumulate(np.where(bright, row, count)[::-1])[::-1]
    dark_mm = (after - before - 2) * height * pixel_mm[1] / count  # its ends lie within blocks
    shown = bright | ((after < count) & (dark_mm <= LIMITS.dark_mm))
    rows, columns = (np.arange(n) * blocks // n for n, blocks in ((height, size[1]), (width, size[0])))
    pixels = shown[rows][:, columns] & echoes
    pixels[:top] = False
    return pixels


def _black(image: NDArray[np.uint8], pixel_mm: tuple[float, float]) -> Mask:
    """Pixels : (h, w) that are black, with all between them and the image's upper border or its sides."""
    size = tuple(2 * max(1, round(LIMITS.black_mm / mm / 2)) + 1 for mm in pixel_mm)
    closed = cv2.morphologyEx((image > 0).astype(np.uint8), cv2.MORPH_CLOSE, np.ones(size[::-1], np.uint8))
    dark = np.asarray(closed) == 0
    count, labels = cv2.connectedComponents(dark.astype(np.uint8), connectivity=4)
    outer = np.zeros(count, bool)
    outer[np.concatenate([labels[0], labels[:, 0], labels[:, -1]])] = True
    outer[0] = False  # what isn't dark
    return outer[labels]


def add(tally: Tally, world_from_pixel: Array, image: NDArray[np.uint8] | None = None) -> None:
    """Take in a B-scan (h, w) at a pose : (4, 4); one of NaN is left out. Without an image all of it counts as tissue.

    Raises
    ------
    InputError
        If the image has another size or isn't grey.
    """
    if image is not None:
        check(image, tally.shape)
    if not np.isfinite(world_from_pixel).all():
        return
    height, width = tally.shape
    across_mm, down_mm = np.linalg.norm(world_from_pixel[:3, :2], axis=0).tolist()
    plane, x, y = np.eye(4), *world_from_pixel[:3, :2].T
    plane[:3] = np.column_stack([x, y, np.cross(x, y) / np.linalg.norm(np.cross(x, y)), world_from_pixel[:3, 3]])
    pixels = np.ones(tally.shape, bool)
    if image is not None:
        pixels = tissue(image, (across_mm, down_mm), tally.face_row, tally.dynamic_range_db)
    variance = tally.spread.across((np.arange(height) - tally.face_row) * down_mm) ** 2
    shown = Shown(pixels, top_row(tally.face_row, down_mm), tally.face_row, down_mm, variance)
    corners = np.array([[u, v, d] for u in (-0.5, width - 0.5) for v in (-0.5, height - 0.5) for d in (-1, 1)], float)
    along = plane[:3, 2] @ tally.grid.directions
    family = round(math.atan2(along[0], along[2]) / (math.pi / FAMILIES)) % FAMILIES
    beam = (y / down_mm).astype(np.float32)
    for fine, reach in ((False, LIMITS.bridged_mm), (True, 0.0)):
        world_from_place = _world_from_part(tally.grid) if fine else world_from_voxel(tally.grid)
        pixel_from_place = np.linalg.inv(plane) @ world_from_place
        half = float(np.abs(pixel_from_place[2, :3]).sum()) / 2  # of a voxel, along the plane's normal
        ends = rigid.apply(np.linalg.inv(pixel_from_place), corners * [1, 1, max(reach, half)])
        size = tally.marks.shape if fine else tally.sums.count.shape
        low = np.clip(np.floor(ends.min(axis=0)).astype(int), 0, size[::-1])
        high = np.clip(np.ceil(ends.max(axis=0)).astype(int) + 1, 0, size[::-1])
        box = (*low[::-1].tolist(), *high[::-1].tolist())
        if fine:
            _mark(tally.marks, pixel_from_place, half, box, shown)
        else:
            _sum(tally.sums, pixel_from_place, half, reach, box, shown, family, beam)


def check(image: NDArray, shape: tuple[int, ...]) -> None:
    """Refuse an image of another size than (h, w), or one that isn't of 8-bit grey: InputError."""
    if image.shape != shape or image.ndim != 2 or image.dtype != np.uint8:
        wanted, found = ("x".join(map(str, (*one[1::-1], *one[2:]))) for one in (shape, image.shape))
        raise InputError(f"image: expected {wanted} px of 8-bit grey, found {found} of {image.dtype}")


def of_sweep(
    world_from_pixel: Array,
    shape: tuple[int, int],
    images: Iterable[NDArray[np.uint8]] | None = None,
    skin: trimesh.Trimesh | None = None,
    spread: Spread | None = None,
    face_row: float = 0.0,
    step_mm: float = LIMITS.step_mm,
    dynamic_range_db: float = 60.0,
) -> Insonation:
    """How each place in and beside a sweep was seen.

    Parameters
    ----------
    world_from_pixel : (n, 4, 4) mm
        B-scans with a NaN are left out.
    shape : (h, w) of the B-scans
    images : n times (h, w), of which lines count as far as they show tissue; all of them without
    skin : as measured by light, under which places are
    face_row : px, from which depths count

    Raises
    ------
    InputError
        If no B-scan has a pose, arrays point all round, the grid is too large, there are more or fewer images than poses, or one
        has another size.
    """
    world_from_pixel = arguments.places_of_pixels("world_from_pixel", world_from_pixel)
    height, width = arguments.image_size("shape", shape, "height and width")
    grid = grid_around(world_from_pixel, (height, width), step_mm)
    tally = begin(grid, (height, width), spread, face_row, dynamic_range_db)
    left = iter(world_from_pixel)
    for image in repeat(None, len(world_from_pixel)) if images is None else images:
        if (matrix := next(left, None)) is None:
            raise InputError(f"images: expected as many as poses, {len(world_from_pixel)}, found more")
        add(tally, matrix, image)
    if next(left, None) is not None:
        raise InputError(f"images: expected as many as poses, {len(world_from_pixel)}, found fewer")
    return insonation(tally, skin)


def insonation(tally: Tally, skin: trimesh.Trimesh | None = None, planned: Planned | None = None) -> Insonation:
    """How each place was seen so far.

    Parameters
    ----------
    skin : as measured by light
    planned : in place of the hull of what was scanned
    """
    sums, spread = tally.sums, tally.spread
    gap_mm, seen = _gaps(tally)
    cell = 2 * np.sqrt(np.pi)  # correlation length of speckle over sigma of power: Wagner et al. 1983, for a Gaussian
    with np.errstate(divide="ignore"):
        finest = 1 / (cell * np.sqrt(sums.variance))
    cells = np.minimum(sums.density, finest).sum(axis=0) / (cell**2 * spread.lateral_mm * spread.axial_mm)
    elevational = np.sqrt(np.maximum.reduce(list(_variances(tally))))
    if planned is None:
        under, room, hull, around = _scanned(tally, skin)
    else:
        hull = around = np.isfinite(planned.under_mm)
        under, room = (np.where(hull, one, np.float32(-1)) for one in planned)
    return Insonation(tally, elevational, gap_mm, seen, (cells * seen).astype(np.float32), under, room, hull, around)


def _mean(total: Map, count: Map) -> Map:
    """A sum over a count; NaN where that is 0."""
    return total / np.where(count > 0, count, np.float32(np.nan))


def _variances(tally: Tally) -> Iterator[Map]:
    """Variances of an echo's power : (nz, ny, nx) mm^2 in each of DIRECTIONS across the beam, by the best family of planes."""
    sums, lateral = tally.sums, np.float32(tally.spread.lateral_mm**2)
    with np.errstate(divide="ignore", invalid="ignore"):
        spaced = (1 / sums.density) ** 2 / 12 + sums.variance  # an even spread between planes
    angles = np.arange(DIRECTIONS) * np.pi / DIRECTIONS
    within = np.cos(angles[:, None] - np.arange(FAMILIES) * np.pi / FAMILIES) ** 2
    for shares in within.astype(np.float32):
        one = np.full(sums.count.shape, np.inf, np.float32)
        for share, variance in zip(shares, spaced, strict=True):
            near = np.isfinite(variance)
            one[near] = np.minimum(one[near], (share * variance + (1 - share) * lateral)[near])
        yield one


def centres(grid: Grid) -> Array:
    """Centres : (nz, ny, nx, 3) mm of a grid's voxels."""
    k, j, i = np.indices(grid.size[::-1])
    return rigid.apply(world_from_voxel(grid), np.stack([i, j, k], axis=-1).astype(float))


def _scanned(tally: Tally, skin: trimesh.Trimesh | None) -> tuple[Map, Map, Mask, Mask]:
    """Depths : mm below skin or face, room there, what was scanned with what lies between, and that with what lies beside."""
    step, known = float(tally.grid.spacing[1]), tally.sums.count > 0
    footprint = known.any(axis=1)
    if not footprint.any():
        none = np.zeros(known.shape, bool)
        return np.full(known.shape, -1, np.float32), np.full(known.shape, -1, np.float32), none, none
    pad = int(np.ceil(2 * LIMITS.around_mm / tally.grid.spacing[[0, 2]].min())) + 1
    sides, wide = tally.grid.spacing[[2, 0]], np.pad(footprint, pad)
    near = np.asarray(ndimage.distance_transform_edt(~wide, sides)) <= LIMITS.around_mm
    closed = wide | (np.asarray(ndimage.distance_transform_edt(near, sides)) > LIMITS.around_mm)
    inner = 2 * (slice(pad, -pad),)
    core = ndimage.binary_erosion(footprint, iterations=2)  # at the sides B-scans may be cut
    core = core if core.any() else footprint
    at = np.asarray(ndimage.distance_transform_edt(~core, sides, return_distances=False, return_indices=True))
    at = tuple(np.where(footprint, np.indices(footprint.shape), at))
    first, last = known.argmax(axis=1)[at], (known.shape[1] - 1 - known[:, ::-1].argmax(axis=1))[at]
    row, depth = np.arange(known.shape[1])[:, None], _mean(tally.sums.depth, tally.sums.count)
    begins = depth[at[0], first, at[1]] - first * step  # depth of the grid's first row below the face
    under = (row * step + begins[:, None]).astype(np.float32)
    column = near[inner][:, None] & (under >= 0) & (row <= last[:, None])
    if skin is not None:
        places = np.argwhere(near[inner][:, None] & (row <= last[:, None]))
        depths = below(rigid.apply(world_from_voxel(tally.grid), places[:, ::-1].astype(float)), skin)[0]
        k, j, i = places[np.isfinite(depths)].T
        under[k, j, i] = depths[np.isfinite(depths)]
        column = near[inner][:, None] & (under >= 0) & (row <= last[:, None])
    room = np.minimum(under, np.minimum(row - first[:, None], last[:, None] - row) * np.float32(step))
    return under, room, column & closed[inner][:, None], column


def world_from_voxel(grid: Grid) -> Array:
    """The matrix (4, 4) from indices (i, j, k) of voxels to mm."""
    return Volume(np.empty((0, 0, 0)), grid.origin, grid.spacing, grid.directions).world_from_voxel


def _world_from_part(grid: Grid) -> Array:
    """The same of indices of their parts."""
    parts = np.array(PARTS[::-1])
    return world_from_voxel(grid) @ rigid.transform(np.diag(1 / parts), (1 / parts - 1) / 2)


def _gaps(tally: Tally) -> tuple[Map, Map]:
    """Width, mm, of the widest gap in each voxel, and the share of it that was seen or lies in a gap that is bridged."""
    marks, step = tally.marks, float(tally.grid.spacing[0]) / PARTS[2]
    most = min(int(LIMITS.widest_mm / step), ENDLESS - 1)
    widths = np.where(marks > 0, np.uint8(NO_GAP), np.uint8(ENDLESS))
    threads.in_threads(_gaps_across, marks.shape[1], marks, most, np.full(marks.shape[1:], -1, np.int32), widths)
    threads.in_threads(_gaps_along, marks.shape[0], marks, most, widths)
    gap, seen = np.zeros((2, *tally.sums.count.shape), np.float32)
    _pool(widths, np.float32(step), np.float32(LIMITS.bridged_mm), gap, seen)
    return gap, seen


@njit(inline="always")
def _place(m, i, j, k):
    """Pixel and distance from the plane, mm, of a voxel."""
    u = m[0, 0] * i + m[0, 1] * j + m[0, 2] * k + m[0, 3]
    v = m[1, 0] * i + m[1, 1] * j + m[1, 2] * k + m[1, 3]
    d = m[2, 0] * i + m[2, 1] * j + m[2, 2] * k + m[2, 3]
    return u, v, d


@njit(inline="always")
def _shows(shown, u, v):
    """Whether a B-scan shows tissue at a pixel."""
    height, width = shown.pixels.shape
    if not (-0.5 <= u < width - 0.5 and shown.top <= v < height - 0.5):
        return False
    return shown.pixels[int(v + 0.5), int(u + 0.5)]


@kernel
def _mark(marks, pixel_from_part, half, box, shown):
    """Mark the parts of voxels in a box that a B-scan passes."""
    for k in range(box[0], box[3]):
        for j in range(box[1], box[4]):
            for i in range(box[2], box[5]):
                u, v, d = _place(pixel_from_part, i, j, k)
                if -half <= d + TIE_MM < half and _shows(shown, u, v):
                    marks[k, j, i] = 1


@kernel
def _sum(sums, pixel_from_voxel, half, reach, box, shown, family, beam):
    """Add a B-scan to the voxels in a box."""
    for k in range(box[0], box[3]):
        for j in range(box[1], box[4]):
            for i in range(box[2], box[5]):
                u, v, d = _place(pixel_from_voxel, i, j, k)
                near = 1 - abs(d) / reach
                through = -half <= d + TIE_MM < half
                if (near <= 0 and not through) or not _shows(shown, u, v):
                    continue
                if near > 0:
                    row = min(max(int(v + 0.5), 0), shown.variance.size - 1)
                    sums.density[family, k, j, i] += near / reach
                    sums.variance[family, k, j, i] = min(sums.variance[family, k, j, i], np.float32(shown.variance[row]))
                if through:
                    sums.count[k, j, i] += 1
                    sums.depth[k, j, i] += (v - shown.face_row) * shown.down_mm
                    for axis in range(3):
                        sums.beam[k, j, i, axis] += beam[axis]


@kernel
def _gaps_across(first, end, marks, most, last, widths):
    """Number of parts in gaps along z, in some rows, where it is less than known; `last` (ny, nx) holds -1, for use here."""
    for j in range(first, end):
        for k in range(marks.shape[0]):
            for i in range(marks.shape[2]):
                if marks[k, j, i]:
                    wide = k - last[j, i] - 1
                    if last[j, i] >= 0 and 0 < wide <= most:
                        for between in range(last[j, i] + 1, k):
                            widths[between, j, i] = min(widths[between, j, i], np.uint8(wide))
                    last[j, i] = k


@kernel
def _gaps_along(first, end, marks, most, widths):
    """The same along x, in some sheets."""
    for k in range(first, end):
        for j in range(marks.shape[1]):
            last = -1
            for i in range(marks.shape[2]):
                if marks[k, j, i]:
                    wide = i - last - 1
                    if last >= 0 and 0 < wide <= most:
                        for between in range(last + 1, i):
                            widths[k, j, between] = min(widths[k, j, between], np.uint8(wide))
                    last = i


@kernel
def _pool(widths, step, bridged, gap, seen):
    """Widest gap of a voxel's parts, mm, and the share of those that are seen or bridged."""
    for k in range(gap.shape[0]):
        for j in range(gap.shape[1]):
            for i in range(gap.shape[2]):
                widest, good = 0, 0
                for n in range(PARTS[0] * PARTS[1] * PARTS[2]):
                    c, b, a = n // (PARTS[1] * PARTS[2]), n // PARTS[2] % PARTS[1], n % PARTS[2]
                    width = int(widths[k * PARTS[0] + c, j * PARTS[1] + b, i * PARTS[2] + a])
                    widest = max(widest, width)
                    good += width != ENDLESS and width * step < bridged
                gap[k, j, i] = np.inf if widest == ENDLESS else widest * step
                seen[k, j, i] = good / np.float32(PARTS[0] * PARTS[1] * PARTS[2])
