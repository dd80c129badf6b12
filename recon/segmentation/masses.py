"""Masses darker than the tissue around them, in tracked B-scans: each a closed surface in the world."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import KDTree
from skimage.measure import marching_cubes

from recon.errors import InputError
from recon.files.volumes import Volume
from recon.freehand.volume_compounding import Clip, Grid
from recon.geometry import rigid
from recon.segmentation import border_fit, echo_power
from recon.segmentation.echo_power import EchoPower
from recon.segmentation.refraction import Sound, follow

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

SPACING_MM = 0.5
SMOOTH_MM = 0.6  # standard deviation; speckle cells are smaller
AROUND_MM = 6.0  # standard deviation over which tissue's level is taken
DARK = 0.35  # of tissue's power around: 4.6 dB below it
SEED = 0.12  # that a mass's core is darker than: 9 dB
RISE = 4.0  # of power from the darkest on: what lies behind is no longer the mass but its shadow
GROW = 4  # voxels from there to the border
OPEN_MM = 1.5  # radius: thinner parts are shadows of borders
LEAST_MM3 = 50.0
TOP_MM = 3.0  # ringing at the face, left out
ROUNDS = 2  # of clearing
EVEN_MM = 0.5  # standard deviation; a voxel
REFINEMENTS = 3  # of the surface in each
SAMPLED = 40  # images that tissue's level is taken from
LEAST_GREY = 5.0  # of 255, that tissue has
CORE = 0.6  # of a mass's extent: where it is darkest
LEAST_SEEN = 0.3  # of the core, by sound that came through other masses
LEVELLINGS = 4  # Newton's steps to the level that holds the volume
NEAR_MM = 1.5  # of a vertex, within which distances come from the surface itself
NEIGHBOURS = 6  # vertices that the distance to a surface is taken from
FAR_MM = 5.0  # to which distances are known around a mass
CLEAR_MM = 2.0  # from a border, where pixels show one tissue only
MOST_BY_PATH = 0.25  # nepers a mm: 11 dB/cm more than tissue, there and back
MOST_LOSS = 0.05  # of power left: darker pixels are left out rather than made as bright as they were


@dataclass(frozen=True)
class Mass:
    """A mass in the world."""

    mesh: trimesh.Trimesh  # closed, mm

    @property
    def volume(self) -> float:
        """mm^3."""
        return float(self.mesh.volume)

    @property
    def centre(self) -> Array:
        """Centre of gravity : (3,) mm."""
        return np.asarray(self.mesh.center_mass)


def from_scans(
    images: Callable[[], Iterator[NDArray]],
    shape: tuple[int, int],
    world_from_pixel: Array,
    sound: Sound | None = None,
    dynamic_range_db: float = 60.0,
    grey: float | None = None,
) -> list[Mass]:
    """Find masses in B-scans, largest first.

    Parameters
    ----------
    images : gives the n B-scans (h, w) uint8, one by one, from the first at each call
    shape : (h, w)
    world_from_pixel : (n, 4, 4)
        With depths as of the tissue's speed of sound, see `recon.probe_calibration.sound_in_water.in_tissue`; images with a NaN
        are left out.
    grey : float
        Of tissue, as of `tissue_grey`, which is asked if it isn't given.

    Raises
    ------
    InputError
        If no image has a pose, or they show no tissue.
    """
    sound = sound or Sound()
    clip = below_face(shape, world_from_pixel)
    grey = tissue_grey(images(), shape, world_from_pixel) if grey is None else grey
    grid = echo_power.beam_grid(world_from_pixel, shape, SPACING_MM, clip)
    table = echo_power.powers(grey, dynamic_range_db)
    power = echo_power.averaged(images(), world_from_pixel, grid, grey, dynamic_range_db, clip)
    masses = find(power)
    for _ in range(ROUNDS):
        if masses:
            power = cleared(images, world_from_pixel, grid, table, clip, masses, sound)
            masses = refined([mass for mass in masses if is_dark(mass, power)], power)
    return sorted(masses, key=lambda mass: -mass.volume)


def below_face(shape: tuple[int, int], world_from_pixel: Array) -> Clip:
    """The part of images (h, w) below the ringing at the face; InputError if nothing is."""
    top = int(np.ceil(TOP_MM / pixel_mm(world_from_pixel)[1]))
    if top >= shape[0] // 2:
        raise InputError(
            f"images: expected more than {2 * TOP_MM:g} mm of depth, found {shape[0]} rows, of which {top} are ringing"
        )
    return Clip(0, top, shape[1], shape[0])


def tissue_grey(images: Iterable[NDArray], shape: tuple[int, int], world_from_pixel: Array) -> float:
    """Typical grey level of tissue in n B-scans (h, w) uint8: the median of the upper halves of some of those that have a pose.

    Raises
    ------
    InputError
        If it is black there: gel, a standoff, or water.
    """
    top, placed = below_face(shape, world_from_pixel).v, np.flatnonzero(np.isfinite(world_from_pixel).all(axis=(1, 2)))
    chosen = set(placed[:: max(1, len(placed) // SAMPLED)].tolist())
    sample = np.stack([image[top : shape[0] // 2] for k, image in enumerate(images) if k in chosen])
    grey = echo_power.typical_grey(sample, slice(None))
    if grey < LEAST_GREY:
        expected = f"tissue in the upper half of the B-scans, of a grey level of {LEAST_GREY:g} or more"
        raise InputError(f"images: expected {expected}, found {grey:.0f} (median): gel, a standoff, or water?")
    return grey


def is_dark(mass: Mass, power: EchoPower) -> bool:
    """Whether a mass is still there, and dark, where shadows of others have been taken away."""
    places = mass.centre + CORE * (mass.mesh.vertices - mass.centre)
    voxel = np.rint(rigid.apply(np.linalg.inv(power.volume.world_from_voxel), places)).astype(int)
    i, j, k = np.clip(voxel, 0, np.array(power.weight.shape[::-1]) - 1).T
    seen = power.weight[k, j, i] > 0
    return bool(seen.mean() > LEAST_SEEN and np.median(power.volume.voxels[k, j, i][seen]) < DARK)


def shown(masses: Sequence[Mass], world_from_pixel: Array, shape: tuple[int, int], sound: Sound) -> Iterator[Mask]:
    """Which pixels of each B-scan show a mass : n times (h, w), delays and bent lines included; none where there's no pose."""
    inside, scale = distances(masses, echo_power.beam_grid(world_from_pixel, shape, SPACING_MM)), pixel_mm(world_from_pixel)
    for matrix in world_from_pixel:
        if np.isfinite(matrix).all():
            lines = follow(inside, scale, matrix, shape, sound)
            yield _sampled(inside, matrix, lines.u, lines.v) < 0
        else:
            yield np.zeros(shape, bool)


def find(power: EchoPower) -> list[Mass]:
    """Find masses in averaged power, largest first; see `rough`."""
    return sorted(refined(rough(power), power), key=lambda mass: -mass.volume)


def refined(masses: Sequence[Mass], power: EchoPower) -> list[Mass]:
    """The same masses with the surfaces that the power shows."""
    for _ in range(REFINEMENTS):
        masses = [evened(Mass(border_fit.refine(mass.mesh, power).mesh), power.volume) for mass in masses]
    return list(masses)


def evened(mass: Mass, lattice: Volume) -> Mass:
    """The same mass without folds and spikes finer than a voxel, as large as before.

    Moved vertices can cross each other; the smoothed distance to them has a clean surface, taken where it holds the same volume.
    """
    low, high = _around(mass, lattice)
    origin = rigid.apply(lattice.world_from_voxel, low)
    around = distances([mass], Grid(tuple(high - low), origin, lattice.spacing, lattice.directions))
    field, whole = ndimage.gaussian_filter(around.voxels, EVEN_MM / lattice.spacing[::-1]), 3 * (slice(0, None),)
    level = 0.0
    for _ in range(LEVELLINGS):
        mesh = _meshed(field, level, whole, around, outside=FAR_MM)
        level += (mass.volume - mesh.volume) / mesh.area
    return Mass(_meshed(field, level, whole, around, outside=FAR_MM))


def _around(mass: Mass, lattice: Volume) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """First voxel and the one after the last : (3,) x, y, z, of the box to `FAR_MM` around a mass, maybe beyond the lattice."""
    voxel = rigid.apply(np.linalg.inv(lattice.world_from_voxel), mass.mesh.vertices)
    margin = FAR_MM / lattice.spacing
    return np.floor(voxel.min(axis=0) - margin).astype(int), np.ceil(voxel.max(axis=0) + margin).astype(int) + 1


def rough(power: EchoPower) -> list[Mass]:
    """Dark bodies with tissue all around, without the shadows that hang on to them."""
    spacing = power.volume.spacing[::-1]
    smooth = _smoothed(power.volume.voxels, power.weight, SMOOTH_MM / spacing)
    seen = np.isfinite(smooth)
    tissue = np.minimum(power.volume.voxels, 2.0)
    bright = seen.copy()
    for _ in range(3):
        level = _smoothed(tissue, power.weight * bright, AROUND_MM / spacing)
        bright = seen & (smooth > DARK * np.nan_to_num(level, nan=np.inf))
    ratio = np.where(seen, smooth / level, 1.0)
    dark = seen & (ratio < DARK)
    dark &= ~_risen(np.where(dark, ratio, np.inf))
    body = _opened(dark, OPEN_MM, spacing)
    unknown = ~seen
    labels, count = ndimage.label(body)
    parts = ndimage.find_objects(labels)
    result = []
    for number in range(1, count + 1):
        part = tuple(slice(max(0, s.start - 8), s.stop + 8) for s in parts[number - 1])
        inside = labels[part] == number
        volume = inside.sum() * float(np.prod(spacing))
        touches = (ndimage.binary_dilation(inside, iterations=2) & unknown[part]).any()
        edge = any(s.start < 2 or s.stop > n - 2 for s, n in zip(parts[number - 1], dark.shape, strict=True))
        core = np.median(ratio[part][inside])
        if volume < LEAST_MM3 or touches or edge or core > SEED:
            continue
        field = np.where(ndimage.binary_dilation(inside, iterations=GROW), ratio[part], 1.0)
        result.append(Mass(_meshed(field, (1 + core) / 2, part, power.volume)))
    return result


def _risen(ratio: NDArray) -> Mask:
    """What lies behind where power rises again by `RISE`, in each run down the beam (axis 1) of values that are finite."""
    lowest, risen = np.full(ratio[:, 0].shape, np.inf), np.zeros(ratio[:, 0].shape, bool)
    result = np.zeros(ratio.shape, bool)
    for row in range(ratio.shape[1]):
        here = ratio[:, row]
        run = np.isfinite(here)
        lowest = np.where(run, np.minimum(lowest, here), np.inf)
        risen = run & (risen | (here > RISE * lowest))
        result[:, row] = risen
    return result


def distances(masses: Sequence[Mass], grid: Grid) -> Volume:
    """Signed distance to the masses : mm, negative inside, on a grid; `FAR_MM` at most, and exact near them only."""
    field = np.full(grid.size[::-1], FAR_MM, np.float32)
    volume = Volume(field, grid.origin, grid.spacing, grid.directions)
    for mass in masses:
        low, high = _around(mass, volume)
        part = tuple(slice(max(a, 0), min(b, n)) for a, b, n in zip(low[::-1], high[::-1], field.shape, strict=True))
        near = _near_distance(mass.mesh, volume, part)
        apart, _ = ndimage.label(np.isnan(near))
        bodies, count = ndimage.label((apart != apart[0, 0, 0]) & ~(near >= 0))
        inside = bodies == np.bincount(bodies.ravel())[1:].argmax() + 1 if count else bodies > 0  # narrow hollows are unsure
        steps = [np.asarray(ndimage.distance_transform_edt(one, grid.spacing[::-1])) for one in (~inside, inside)]
        whole = steps[0] - steps[1] - np.where(inside, -0.5, 0.5) * grid.spacing[0]
        signed = np.where(np.isfinite(near) & ((near < 0) == inside), near, whole)
        field[part] = np.minimum(field[part], np.clip(signed, -FAR_MM, FAR_MM))
    return volume


def _near_distance(mesh: trimesh.Trimesh, volume: Volume, part: tuple[slice, ...]) -> NDArray:
    """Signed distance of a part's voxels to a mesh, by the tangent planes of its nearest vertices; NaN beyond `NEAR_MM`."""
    shape, low = tuple(s.stop - s.start for s in part), [s.start for s in part[::-1]]
    voxel = np.rint(rigid.apply(np.linalg.inv(volume.world_from_voxel), mesh.vertices)).astype(int) - low
    apart = np.ones(shape, bool)
    apart[tuple(np.clip(voxel, 0, np.array(shape[::-1]) - 1).T[::-1])] = False
    k, j, i = np.nonzero(np.asarray(ndimage.distance_transform_edt(apart, volume.spacing[::-1])) < NEAR_MM)
    places = rigid.apply(volume.world_from_voxel, np.column_stack([i, j, k]) + low)
    _, nearest = KDTree(mesh.vertices).query(places, k=NEIGHBOURS, workers=-1)
    across = ((places[:, None] - mesh.vertices[nearest]) * mesh.vertex_normals[nearest]).sum(axis=2)
    result = np.full(shape, np.nan)
    result[k, j, i] = across.mean(axis=1)
    return result


def cleared(
    images: Callable[[], Iterator[NDArray]],
    world_from_pixel: Array,
    grid: Grid,
    table: NDArray[np.float32],
    clip: Clip,
    masses: Sequence[Mass],
    sound: Sound,
) -> EchoPower:
    """Average power again, with each pixel where sound was, and as bright as it were without the masses' shadows."""
    inside, scale = distances(masses, grid), pixel_mm(world_from_pixel)
    by_depth, by_path = shading(images, world_from_pixel, table, clip, inside, sound)

    def parts() -> Iterator[tuple[NDArray, NDArray, NDArray]]:
        for image, matrix in zip(images(), world_from_pixel, strict=True):
            if not np.isfinite(matrix).all():
                yield table[image], table[image], table[image]
                continue
            lines = follow(inside, scale, matrix, image.shape, sound)
            rows = np.arange(image.shape[0], dtype=np.float32)[:, None] * scale[1]
            left = lines.passed * np.exp(-by_path * lines.within)
            power = np.where(left > MOST_LOSS, table[image] / np.maximum(left, MOST_LOSS), np.nan) * np.exp(by_depth * rows)
            top = clip.v
            yield power[top:].astype(np.float32), lines.u[top:], lines.v[top:]

    return echo_power.accumulated(parts(), world_from_pixel, grid)


def shading(
    images: Callable[[], Iterator[NDArray]],
    world_from_pixel: Array,
    table: NDArray[np.float32],
    clip: Clip,
    inside: Volume,
    sound: Sound,
) -> tuple[float, float]:
    """Loss of power, nepers a mm: of tissue with depth, beyond what the gain makes up for; and of masses more than tissue.

    Fitted to the mean power of tissue some mm around the masses, by depth and length of the way through masses.
    """
    scale = pixel_mm(world_from_pixel)
    depth_bins, path_bins = 60, 40
    total, count = np.zeros((2, depth_bins * path_bins))
    for image, matrix in zip(images(), world_from_pixel, strict=True):
        if not np.isfinite(matrix).all():
            continue
        lines = follow(inside, scale, matrix, image.shape, sound)
        some = (slice(clip.v, None, 4), slice(None, None, 4))
        u, v, within, passed, power = (a[some] for a in (lines.u, lines.v, lines.within, lines.passed, table[image]))
        away = _sampled(inside, matrix, u, v)
        used = (away > CLEAR_MM) & (away < FAR_MM - 0.2) & (passed > 0.5)
        bins = np.minimum(v[used] * scale[1], depth_bins - 1).astype(int) * path_bins
        bins += np.minimum(within[used], path_bins - 1).astype(int)
        total += np.bincount(bins, power[used] / passed[used], len(total))
        count += np.bincount(bins, minlength=len(count))
    enough = (count > 20) & (total > 0)
    if enough.sum() < 4:
        return 0.0, 0.0
    depth, path = np.divmod(np.flatnonzero(enough), path_bins)
    path = np.where(path > 0, path + 0.5, 0.0)
    design = np.column_stack([np.ones(enough.sum()), -(depth + 0.5), -path]) * np.sqrt(count[enough])[:, None]
    level = np.log(total[enough] / count[enough]) * np.sqrt(count[enough])
    _, by_depth, by_path = np.linalg.lstsq(design, level)[0]
    return float(max(by_depth, 0.0)), float(np.clip(by_path, 0.0, MOST_BY_PATH))


def pixel_mm(world_from_pixel: Array) -> tuple[float, float]:
    """Size of a pixel along the array and into the depth."""
    found = world_from_pixel[np.isfinite(world_from_pixel).all(axis=(1, 2))]
    if not len(found):
        raise InputError(f"poses: expected at least one that is valid, found none in {len(world_from_pixel)}")
    across, down = np.linalg.norm(found[0, :3, :2], axis=0)
    return float(across), float(down)


def _sampled(inside: Volume, world_from_pixel: Array, u: NDArray, v: NDArray) -> Array:
    """Signed distance at pixels, mm."""
    voxel_from_pixel = np.linalg.inv(inside.world_from_voxel) @ world_from_pixel
    i, j, k = np.moveaxis(rigid.apply(voxel_from_pixel, np.stack([u, v, 0 * u], axis=-1)), -1, 0)
    return ndimage.map_coordinates(inside.voxels, [k, j, i], order=1, mode="nearest")


def _smoothed(values: NDArray, weight: NDArray, sigma: Array) -> NDArray:
    share = ndimage.gaussian_filter(np.asarray(weight, np.float32), sigma)
    total = ndimage.gaussian_filter(np.asarray(values * weight, np.float32), sigma)
    return np.divide(total, share, out=np.full_like(total, np.nan), where=share > 0.02)


def _opened(mask: Mask, radius_mm: float, spacing: Array) -> Mask:
    core = np.asarray(ndimage.distance_transform_edt(mask, spacing)) > radius_mm
    return mask & (np.asarray(ndimage.distance_transform_edt(~core, spacing)) <= radius_mm + 0.25)


def _meshed(field: NDArray, level: float, part: tuple[slice, ...], volume: Volume, outside: float = 1.0) -> trimesh.Trimesh:
    padded = np.pad(field, 1, constant_values=outside)
    vertices, faces, _, _ = marching_cubes(padded, level)
    index = vertices[:, ::-1] - 1 + [s.start for s in part[::-1]]
    mesh = trimesh.Trimesh(rigid.apply(volume.world_from_voxel, index), faces)
    mesh = max(mesh.split(only_watertight=True), key=lambda one: abs(one.volume))
    return trimesh.Trimesh(mesh.vertices, mesh.faces if mesh.volume > 0 else mesh.faces[:, ::-1], process=False)
