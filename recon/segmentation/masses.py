"""Masses darker than the tissue around them, in tracked B-scans: each a closed surface in the world."""

import logging
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from recon import arguments, threads
from recon.errors import InputError
from recon.freehand.volume_compounding import Clip
from recon.geometry import rigid
from recon.segmentation import blur_correction, border_fit, echo_power
from recon.segmentation.blur_correction import Blur, Planes
from recon.segmentation.echo_power import EchoPower, pixel_mm
from recon.segmentation.mass_surface import Mass, distances, evened, meshed
from recon.segmentation.refraction import Sound, follow
from recon.segmentation.shadow_clearing import Recording, cleared

log = logging.getLogger(__name__)

Array = NDArray[np.float64]
Map = NDArray[np.float32]
Mask = NDArray[np.bool_]

SPACING_MM = (0.5, 0.25, 0.5)  # along the array, the beam and across; a border square to the beam is a line of its pulse
REFINEMENTS = (2, 3)  # after each clearing


@dataclass(frozen=True)
class MassLimits:
    """When dark voxels count as a mass. Powers are shares of the tissue's around."""

    smooth_mm: float = 0.6  # standard deviation; speckle cells are smaller
    around_mm: float = 6.0  # standard deviation over which tissue's level is taken
    dark: float = 0.35  # 4.6 dB below tissue
    seed: float = 0.12  # above the power of a mass's core: 9 dB
    rise: float = 4.0  # of power from the darkest on: behind is no longer the mass but its shadow
    grow_mm: float = 1.0  # from a rough body, within which its border is searched; the shadow behind begins there too
    edge_mm: float = 0.5  # of what was scanned: bodies nearer to it are none
    open_mm: float = 1.5  # radius: thinner parts are shadows of borders
    least_mm3: float = 50.0
    streak: float = 2.5  # height of a body down the beam over its thickness, above which it may be the shadow of a border
    core: float = 0.6  # of a mass's extent: its darkest part
    least_seen: float = 0.3  # of the core, by sound that came through other masses


@dataclass(frozen=True)
class CutBodyLimits:
    """When dark voxels at a side or an end of the scan are named as a body that it cuts."""

    least_mm3: float = 15.0  # of what is seen of it
    least_mm: float = 2.5  # of it down the beam; speckle has no holes as deep
    darkest: float = 0.1  # share that is as dark as a mass's core: of a small piece most lies within the blur of its border
    same: float = 0.5  # share of it that is whole by itself
    mostly: float = 0.6  # share of what was seen before it that shows tissue: elsewhere the probe doesn't touch
    before: float = 0.2  # share of what lies before it that was seen; gel beside the skin begins at the face
    behind: float = 0.5  # share of another body within its shadow, which can't be cleared


@dataclass(frozen=True)
class GapLimits:
    """When what no B-scan shows, with B-scans on both sides, is named as a gap."""

    widths_mm: tuple[float, float] = (3.5, 20.0)  # least, from which masses are cut in two, and most: beyond are strokes apart
    height_mm: float = 6.0  # down the beam, at least: a hand that goes up and down leaves less at the images' lower end
    least_mm3: float = 500.0  # lost B-scans leave thousands; turned planes leave less beside each other
    named: int = 3  # at most, the largest


LIMITS, CUT, GAP = MassLimits(), CutBodyLimits(), GapLimits()


def from_scans(
    images: Callable[[], Iterator[NDArray]],
    shape: tuple[int, int],
    world_from_pixel: Array,
    sound: Sound | None = None,
    dynamic_range_db: float = 60.0,
    grey: float | None = None,
    blur: Blur | None = None,
) -> list[Mass]:
    """Find masses in B-scans, largest first.

    Parameters
    ----------
    images : streams the n B-scans (h, w) uint8, one by one, from the first at each call
    shape : (h, w)
    world_from_pixel : (n, 4, 4)
        With depths as of the tissue's speed of sound, see `recon.probe_calibration.sound_in_water.in_tissue`; images with a NaN
        are left out.
    grey : float
        Of tissue, by default that of `tissue_grey`.
    blur : of the B-scans
        Lobes of masses are corrected for it, and for what the fit does to them; edges of shadows are as wide as the beam. Without
        it neither is done.

    Raises
    ------
    InputError
        If no image has a pose, they show no tissue, or `shape` isn't theirs.
    """
    if not callable(images):
        expected = "a function that gives the B-scans from the first on, such as lambda: iter(scans)"
        raise InputError(f"images: expected {expected}, found {arguments.described(images)}")
    arguments.of_kind("sound", sound, Sound, type(None))
    arguments.of_kind("blur", blur, Blur, type(None))
    height, width = arguments.image_size("shape", shape, "height and width")
    shape = height, width
    world_from_pixel = arguments.places_of_pixels("world_from_pixel", world_from_pixel)
    sound = sound or Sound()
    first = next(images(), None)
    if first is not None and np.shape(first) != shape:
        found = f"images of shape {np.shape(first)}"
        raise InputError(f"shape: expected that of the images, height and width, found {shape} with {found}: swapped?")
    clip = _below_face(shape, world_from_pixel)
    grey = tissue_grey(images(), shape, world_from_pixel) if grey is None else grey
    grid = echo_power.beam_grid(world_from_pixel, shape, SPACING_MM, clip)
    spread_mm = blur.lateral_mm if blur else 0.0
    recording = Recording(images, world_from_pixel, echo_power.powers(grey, dynamic_range_db), clip, spread_mm)
    power = echo_power.averaged(images(), world_from_pixel, grid, grey, dynamic_range_db, clip)
    roughly = 1  # refinement of the surface, as exact as clearing needs it
    masses = refined(rough(power), power, roughly)
    for times in REFINEMENTS:
        if masses:
            power = cleared(recording, grid, masses, sound)
            masses = refined([mass for mass in masses if _is_dark(mass, power)], power, times)
    if masses and blur is not None:
        planes = Planes(world_from_pixel, range(clip.v, shape[0]), shape[1], blur)
        masses = blur_correction.corrected(masses, power, planes, partial(refined, times=REFINEMENTS[-1]))
    return sorted(masses, key=lambda mass: -mass.volume)


def _below_face(shape: tuple[int, int], world_from_pixel: Array) -> Clip:
    """The part of images (h, w) below the ringing at the face; InputError if there is none."""
    top_mm = 3.0  # ringing at the face, left out
    top = int(np.ceil(top_mm / pixel_mm(world_from_pixel)[1]))
    if top >= shape[0] // 2:
        raise InputError(
            f"images: expected more than {2 * top_mm:g} mm of depth, found {shape[0]} rows, of which {top} are ringing"
        )
    return Clip(0, top, shape[1], shape[0])


def tissue_grey(images: Iterable[NDArray], shape: tuple[int, int], world_from_pixel: Array) -> float:
    """Typical grey level of tissue in n B-scans (h, w) uint8: the median of the upper halves of some of those with a pose.

    Raises
    ------
    InputError
        If these are black: gel, a standoff, or water.
    """
    top, placed = _below_face(shape, world_from_pixel).v, np.flatnonzero(np.isfinite(world_from_pixel).all(axis=(1, 2)))
    sampled = 40  # images for the level of tissue
    chosen = set(placed[:: max(1, len(placed) // sampled)].tolist())
    sample = np.stack([image[top : shape[0] // 2] for k, image in enumerate(images) if k in chosen])
    grey = echo_power.typical_grey(sample, slice(None))
    least_grey = 5.0  # of 255, of tissue
    if grey < least_grey:
        expected = f"tissue in the upper half of the B-scans, of a grey level of {least_grey:g} or more"
        raise InputError(f"images: expected {expected}, found {grey:.0f} (median): gel, a standoff, or water?")
    return grey


def _is_dark(mass: Mass, power: EchoPower) -> bool:
    """Whether a mass is still dark after the shadows of others have been taken away."""
    places = mass.centre + LIMITS.core * (mass.mesh.vertices - mass.centre)
    voxel = np.rint(rigid.apply(np.linalg.inv(power.volume.world_from_voxel), places)).astype(int)
    i, j, k = np.clip(voxel, 0, np.array(power.weight.shape[::-1]) - 1).T
    seen = power.weight[k, j, i] > 0
    return bool(seen.mean() > LIMITS.least_seen and np.median(power.volume.voxels[k, j, i][seen]) < LIMITS.dark)


def shown(masses: Sequence[Mass], world_from_pixel: Array, shape: tuple[int, int], sound: Sound) -> Iterator[Mask]:
    """Pixels of each B-scan that show a mass : n times (h, w), delays and bent lines included; none without a pose."""
    inside, scale = distances(masses, echo_power.beam_grid(world_from_pixel, shape, SPACING_MM)), pixel_mm(world_from_pixel)

    def mask(matrix: Array) -> Mask:
        placed = np.isfinite(matrix).all()
        return follow(inside, scale, matrix, shape, sound).inside if placed else np.zeros(shape, bool)

    return threads.mapped(mask, world_from_pixel)


def refined(masses: Sequence[Mass], power: EchoPower, times: int) -> list[Mass]:
    """The same masses with their surfaces moved to the borders in the power, some times over."""

    def refine(mass: Mass) -> Mass:
        for _ in range(times):
            mass = evened(Mass(border_fit.refine(mass.mesh, power)), power.volume.directions)
        return mass

    return list(threads.mapped(refine, masses, most=len(masses)))


def rough(power: EchoPower) -> list[Mass]:
    """Dark bodies with tissue all around, without the shadows that hang on to them.

    Warnings are logged of bodies that the scan's side or end cuts, of those behind them, and of streaks down the beam, which may
    be shadows of borders.
    """
    spacing, gaps = power.volume.spacing[::-1], _name_gaps(power)
    smooth = _smooth(power.volume.voxels, power.weight, LIMITS.smooth_mm / spacing)
    seen = np.isfinite(smooth)
    tissue = np.minimum(power.volume.voxels, 2.0)
    bright = seen.copy()
    for _ in range(3):
        level = _smooth(tissue, power.weight * bright, LIMITS.around_mm / spacing)
        bright = seen & (smooth > LIMITS.dark * np.nan_to_num(level, nan=np.inf))
    middles = _middles(seen & ~bright, spacing)
    if middles.any() and (bright & ~middles).any():
        hollow = middles & (smooth < LIMITS.dark * level[_nearest(bright & ~middles, spacing)])
        level = _smooth(tissue, power.weight * (bright & ~hollow), LIMITS.around_mm / spacing)
        level = np.where(hollow, level[_nearest(np.isfinite(level), spacing)], level)
    ratio = np.where(seen, smooth / level, 1.0)
    dark = seen & (ratio < LIMITS.dark)
    dark &= ~_risen(np.where(dark, ratio, np.inf))
    body = _opened(dark, LIMITS.open_mm, spacing)
    unknown = ~seen
    labels, count = ndimage.label(body)
    parts = ndimage.find_objects(labels)
    margin, edge = (np.ceil(one / spacing).astype(int) for one in (2 * LIMITS.grow_mm, LIMITS.edge_mm))
    whole, candidates = np.zeros(dark.shape, bool), []
    for number in range(1, count + 1):
        part = tuple(slice(max(0, s.start - m), s.stop + m) for s, m in zip(parts[number - 1], margin, strict=True))
        inside = labels[part] == number
        volume = inside.sum() * float(np.prod(spacing))
        touches = (_widen(inside, LIMITS.edge_mm, spacing) & unknown[part]).any()
        cut = any(s.start < m or s.stop > n - m for s, m, n in zip(parts[number - 1], edge, dark.shape, strict=True))
        core = np.median(ratio[part][inside])
        if volume < LIMITS.least_mm3 or core > LIMITS.seed or touches or cut:
            continue
        whole[part] |= inside
        candidates.append((part, inside, volume, core))
    shadowed = _name_cut_bodies(dark, whole, ratio, seen, gaps, power)
    result = []
    for part, inside, volume, core in candidates:
        height, thick = np.ptp(np.nonzero(inside)[1]) * spacing[1], _thickness(inside, spacing)
        if height > LIMITS.streak * thick:
            told = "a dark streak at %.0f, %.0f, %.0f mm, %.0f mm down the beam and %.0f mm thick, is left out: "
            told += "a shadow of a border, or a body longer down the beam than %g times its thickness"
            log.warning(told, *_middle(inside, part, power), height, thick, LIMITS.streak)
        elif shadowed[part][inside].mean() > CUT.behind:
            told = "a dark body of %.0f mm3 at %.0f, %.0f, %.0f mm is left out: it lies behind one that is cut, maybe its shadow"
            log.warning(told, volume, *_middle(inside, part, power))
        else:
            field = np.where(_widen(inside, LIMITS.grow_mm, spacing), ratio[part], 1.0)
            result.append(Mass(meshed(field, (1 + core) / 2, part, power.volume)))
    return result


def _middles(dark: Mask, spacing: Array) -> Mask:
    """Voxels with dark ones all around; none unless they are many, as in a body so large that its middle surrounds itself."""
    labels, count = ndimage.label(~dark)
    open_ = np.zeros(count + 1, bool)
    open_[0] = True
    for axis in range(3):
        open_[labels.take([0, -1], axis)] = True
    inner = ~open_[labels]
    sizes = np.bincount(labels[inner], minlength=1) * float(np.prod(spacing))
    return inner if sizes.max() >= LIMITS.least_mm3 else np.zeros_like(inner)


def _nearest(mask: Mask, spacing: Array) -> tuple[NDArray[np.intp], ...]:
    """Indices of the voxel of a mask that is nearest to each."""
    return tuple(np.asarray(ndimage.distance_transform_edt(~mask, spacing, return_distances=False, return_indices=True)))


def _name_gaps(power: EchoPower) -> Mask:
    """Log the largest gaps that no B-scan shows, with B-scans on both sides, where masses are missed: voxels in any gap."""
    spacing, gaps, found = power.volume.spacing[::-1], np.zeros(power.weight.shape, bool), []
    tall = np.ones((1, int(np.ceil(GAP.height_mm / spacing[1])), 1), bool)
    for axis, where in ((0, "in the sweep"), (2, "between strokes")):
        width = _gap_widths(power.seen, axis, float(spacing[axis]))
        width[gaps | (width > GAP.widths_mm[1])] = 0
        gaps |= width > 0
        labels, _ = ndimage.label(ndimage.binary_opening(width >= GAP.widths_mm[0], tall))
        for one, part in enumerate(ndimage.find_objects(labels), start=1):
            inside = labels[part] == one
            if (volume := inside.sum() * float(np.prod(spacing))) >= GAP.least_mm3:
                found.append((volume, float(np.median(width[part][inside])), where, _middle(inside, part, power)))
    found.sort(key=lambda gap: -gap[0])
    for volume, wide, where, middle in found[: GAP.named]:
        told = "a gap of %.1f mm %s, %.0f mm3 about %.0f, %.0f, %.0f mm, wasn't scanned: masses in it may be missed"
        log.warning(told, wide, where, volume, *middle)
    if others := found[GAP.named :]:
        log.warning("%d smaller gaps, %.0f mm3 together, weren't scanned", len(others), sum(gap[0] for gap in others))
    return gaps


def _gap_widths(seen: Mask, axis: int, step_mm: float) -> Map:
    """Width, mm, along an axis of the run of unseen voxels that each is in; infinite at an end of the volume, 0 of seen ones."""
    number = np.arange(seen.shape[axis], dtype=np.float32).reshape(np.where(np.arange(3) == axis, -1, 1))
    width = np.where(seen, number, np.float32(np.inf))
    width = np.flip(np.minimum.accumulate(np.flip(width, axis), axis), axis)  # the next that is seen
    width -= np.maximum.accumulate(np.where(seen, number, np.float32(-np.inf)), axis)
    width -= np.float32(1)
    width *= np.float32(step_mm)
    width[seen] = 0
    return width


def _name_cut_bodies(dark: Mask, whole: Mask, ratio: NDArray, seen: Mask, gap: Mask, power: EchoPower) -> Mask:
    """Log a line of each dark body behind tissue that a side, an end or a gap of the scan cuts: voxels in their shadows.

    Bodies that are whole are left out. The dark behind a phantom has a line of its own: nothing bright is behind it, and it has
    hardly a side.
    """
    spacing = power.volume.spacing[::-1]
    pad = int(np.ceil(2 * LIMITS.open_mm / spacing.min()))
    whole, known, gap = np.pad(whole, pad), np.pad(seen, pad), np.pad(gap, pad)
    ratio = np.pad(ratio, pad, constant_values=1.0)
    dark = np.pad(dark, pad)
    bright = known & (ratio > LIMITS.dark)
    last = ~np.logical_or.accumulate(bright[:, ::-1], axis=1)[:, ::-1]  # nothing behind is bright
    labels, _ = ndimage.label(dark & _opened(dark | ~known, LIMITS.open_mm, spacing))
    margin = np.ceil(4 * LIMITS.edge_mm / spacing).astype(int)
    shadowed = np.zeros(dark.shape, bool)
    for number, box in enumerate(ndimage.find_objects(labels), start=1):
        part = tuple(slice(s.start - m, s.stop + m) for s, m in zip(box, margin, strict=True))
        inside, here = labels[part] == number, known[part]
        volume = inside.sum() * float(np.prod(spacing))
        extents = [(s.stop - s.start) * step for s, step in zip(box, spacing, strict=True)][::-1]
        across, height, along = extents
        small = volume < CUT.least_mm3 or height < CUT.least_mm or height > LIMITS.streak * max(across, along)
        if small or np.quantile(ratio[part][inside], CUT.darkest) > LIMITS.seed or whole[part][inside].mean() > CUT.same:
            continue
        shell, behind = _widen(inside, 2 * LIMITS.edge_mm, spacing) & ~inside, np.logical_or.accumulate(inside, axis=1)
        before = np.logical_or.accumulate(inside[:, ::-1], axis=1)[:, ::-1] & ~behind
        beside, before = shell & ~behind & ~before, shell & before & inside.any(axis=1, keepdims=True)
        unseen, front = shell & ~here, before & here
        sides = {
            ("the images' side", "scan on there"): _fullest(unseen, 2),
            ("the sweep's end", "scan on there"): _fullest(unseen & ~gap[part], 0),
            ("a gap in the sweep", "scan there again"): _fullest(unseen & gap[part], 0),
            ("the images' lower end", "set a greater depth"): _fullest(unseen, 1),
        }
        covered = front.sum() > CUT.before * before.sum() and (front & bright[part]).sum() >= CUT.mostly * front.sum()
        if not any(sides.values()) or not covered:
            continue
        ends = (inside & last[part]).any(axis=1).sum() > (1 - CUT.mostly) * inside.any(axis=1).sum()
        middle = tuple(slice(s.start - pad, s.stop - pad) for s in part)
        if ends and (beside & ~here).sum() > (1 - CUT.mostly) * beside.sum():
            told = "the dark behind the tissue, %.0f mm3 about %.0f, %.0f, %.0f mm, holds no mass, or one that isn't told from it"
            log.info(told, volume, *_middle(inside, middle, power))
            continue
        border, way = max(sides, key=lambda name: sides[name])
        told = "a dark body is cut by %s, and is left out: %.0f mm3 of it at %.0f, %.0f, %.0f mm, %.0f x %.0f x %.0f mm; %s"
        log.warning(told, border, volume, *_middle(inside, middle, power), *extents, way)
        near = _widen(inside, 2 * LIMITS.grow_mm, spacing)
        below = np.pad(near, ((0, 0), (0, dark.shape[1] - part[1].start - near.shape[1]), (0, 0)))
        shadowed[part[0], part[1].start :, part[2]] |= np.logical_or.accumulate(below, axis=1)
    return shadowed[pad:-pad, pad:-pad, pad:-pad]


def _fullest(unseen: Mask, axis: int) -> int:
    """Greatest number of unseen voxels of a body's shell in one layer along an axis: what cuts it lies square to the greatest."""
    return int(unseen.sum(axis=tuple(one for one in range(3) if one != axis)).max(initial=0))


def _thickness(inside: Mask, spacing: Array) -> float:
    """Diameter of the largest ball within a body, mm."""
    return 2 * float(np.max(np.asarray(ndimage.distance_transform_edt(np.pad(inside, 1), spacing))))


def _middle(inside: Mask, part: tuple[slice, ...], power: EchoPower) -> Array:
    """Middle : (3,) mm, in the world, of a body in a part of a volume."""
    voxel = np.array([np.mean(axis) + s.start for axis, s in zip(np.nonzero(inside), part, strict=True)][::-1])
    return rigid.apply(power.volume.world_from_voxel, voxel)


def _risen(ratio: NDArray) -> Mask:
    """Voxels behind a rise of power by `LIMITS.rise`, in each run of finite values down the beam (axis 1)."""
    lowest, risen = np.full(ratio[:, 0].shape, np.inf), np.zeros(ratio[:, 0].shape, bool)
    result = np.zeros(ratio.shape, bool)
    for row in range(ratio.shape[1]):
        here = ratio[:, row]
        run = np.isfinite(here)
        lowest = np.where(run, np.minimum(lowest, here), np.inf)
        risen = run & (risen | (here > LIMITS.rise * lowest))
        result[:, row] = risen
    return result


def _smooth(values: NDArray, weight: NDArray, sigma: Array) -> NDArray:
    fields = (np.asarray(field, np.float32) for field in (weight, values * weight))
    share, total = threads.mapped(lambda field: _blurred(field, sigma), fields)
    return np.divide(total, share, out=np.full_like(total, np.nan), where=share > 0.02)


def _blurred(field: Map, sigma: Array) -> Map:
    """A Gaussian blur of (nz, ny, nx), reflected at the sides: as `scipy.ndimage.gaussian_filter`, by vector instructions."""
    blur_reach = 4  # standard deviations to which a blur reaches
    aside, down, across = (cv2.getGaussianKernel(2 * round(blur_reach * one) + 1, one, cv2.CV_32F) for one in sigma)
    sheets = np.empty_like(field)
    for sheet, blurred in zip(field, sheets, strict=True):
        cv2.sepFilter2D(sheet, -1, across, down, dst=blurred, borderType=cv2.BORDER_REFLECT)
    lines = sheets.reshape(len(field), -1)
    return cv2.sepFilter2D(lines, -1, np.ones(1, np.float32), aside, borderType=cv2.BORDER_REFLECT).reshape(field.shape)


def _opened(mask: Mask, radius_mm: float, spacing: Array) -> Mask:
    """The voxels of a mask that lie in balls which fit into it, or no more than half of the widest voxel away."""
    core = ~_widen(~mask, radius_mm, spacing)
    beside_mm = 0.25  # half of the widest voxel
    return mask & _widen(core, radius_mm + beside_mm, spacing)


def _widen(mask: Mask, radius_mm: float, spacing: Array) -> Mask:
    """Voxels no farther than a radius from a mask's: a dilation by a ball, disc by disc."""
    reach = np.floor(radius_mm / spacing).astype(int)
    aside, down, across = (np.arange(-n, n + 1) * one for n, one in zip(reach, spacing, strict=True))
    discs = (aside[:, None, None] ** 2 + down[:, None] ** 2 + across**2 <= radius_mm**2).astype(np.uint8)
    sheets = mask.view(np.uint8)

    def widen(k: int) -> Mask:
        near = [(sheets[k + n - reach[0]], disc) for n, disc in enumerate(discs) if 0 <= k + n - reach[0] < len(mask)]
        return np.max([cv2.dilate(sheet, disc) for sheet, disc in near if disc.any()], axis=0) > 0

    return np.stack(list(threads.mapped(widen, range(len(mask)))))
