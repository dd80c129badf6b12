"""Dark and bright bodies in averaged echo power, roughly, and what is left out with its reason."""

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from recon import threads
from recon.freehand.volume_compounding import grid_of
from recon.geometry import rigid
from recon.segmentation.echo_power import EchoPower
from recon.segmentation.left_out import LeftOut, Reason
from recon.segmentation.mass_surface import Mass, distances, meshed

log = logging.getLogger(__name__)

Array = NDArray[np.float64]
Map = NDArray[np.float32]
Mask = NDArray[np.bool_]
Part = tuple[slice, ...]  # of a volume, along z, y and x
Place = tuple[float, float, float]


@dataclass(frozen=True)
class MassLimits:
    """When dark voxels count as a mass. Powers are shares of the tissue's around."""

    smooth_mm: float = 0.6  # standard deviation; speckle cells are smaller
    around_mm: float = 6.0  # standard deviation over which tissue's level is taken
    dark: float = 0.35  # 4.6 dB below tissue
    seed: float = 0.12  # above the power of a mass's core: 9 dB
    rise: float = 4.0  # of power from the darkest on: behind is no longer the mass but its shadow
    floor: float = 0.03  # of power, 15 dB below tissue: what is darker may be noise in fluid, which rises by any factor
    grow_mm: float = 1.0  # from a rough body, within which its border is searched; the shadow behind begins there too
    edge_mm: float = 0.5  # of what was scanned: bodies nearer to it are none
    open_mm: float = 1.5  # radius: thinner parts are shadows of borders
    least_mm3: float = 50.0
    fine_mm: float = 0.6  # the former, of small bodies, whose borders have no lobes
    small_mm3: float = 6.0  # least of what is seen of small bodies; speckle has none
    dense: float = 0.8  # share of a small one's voxels with a pixel in them: between B-scans far apart are pieces of shadows
    spot_mm3: float = 1.0  # of still smaller ones that are named
    few: int = 3  # small ones, at most, beyond which they are taken for the tissue's own unevenness
    streak: float = 2.5  # height of a body down the beam over its thickness, above which it may be the shadow of a border
    core: float = 0.6  # of a mass's extent: its darkest part
    still: float = 0.5  # of power in its core at most, after the shadows of others are cleared
    told: int = 8  # of what is left out for one reason, that are said; all are listed
    passed: float = 0.1  # of power that comes through a mass, at least: else its back isn't told from its shadow
    own: float = 1.5  # of a dark mass's own power, by which it is more; with less its back was found mm too deep
    within: float = 1.25  # of its own power 4 to 6 mm before its back, at most: else its shadow hangs on to it
    tall: float = 1.3  # times as deep as wide is a dark mass that may have its shadow on it, if it is deep
    tall_mm: float = 12.0
    shadowing: float = 0.5  # of power that comes through such a mass, at most
    edge_shadow_mm: float = 5.0  # beside a mass of which little is seen, from where its border may cast a shadow
    clutter: float = 0.01  # of power, at least, of which that is a multiple
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
    around: float = 0.8  # share of what lies beside one that begins at the face that is tissue: gel has little
    thick: float = 0.3  # of its lesser width, that of such a one: gel on a curved skin is thinner
    bump_mm: float = 6.0  # by which the dark behind the tissue begins before its median, over as wide a place: a body's shadow
    rim: float = 0.4  # share of that place's rim with dark behind it: at the tissue's edge it begins early
    behind: float = 0.5  # share of another body within its shadow, which can't be cleared


@dataclass(frozen=True)
class GapLimits:
    """When what no B-scan shows, with B-scans on both sides, is named as a gap."""

    widths_mm: tuple[float, float] = (3.5, 20.0)  # least, from which masses are cut in two, and most: beyond are strokes apart
    height_mm: float = 6.0  # down the beam, at least: a hand that goes up and down leaves less at the images' lower end
    least_mm3: float = 500.0  # lost B-scans leave thousands; turned planes leave less beside each other
    named: int = 3  # at most, the largest


@dataclass(frozen=True)
class FaintLimits:
    """When voxels that are little darker than the tissue around, or brighter, count as a mass: in even tissue only.

    Tissue that varies by itself, as a breast does, holds bodies of its own that none of these are told from.
    """

    even_db: float = 1.5  # of tissue that is even: speckle of silicone leaves 0.8, lobules of fat and gland make 3.4 and more
    seed: float = 0.33  # in even tissue, above the power of a dark body's core
    dark: float = 0.5  # there, of a small body's power: speckle blurs its core
    smooth_mm: float = 1.0  # standard deviation: over five times the voxels of a dark body's, as the contrast is less
    around_mm: tuple[float, ...] = (
        12.0,
        12.0,
        8.0,
    )  # standard deviations over which the tissue's level is taken, one after another
    least_db: float = 2.4  # of contrast, at least
    core_db: float = 2.8  # of contrast in its middle
    beside_mm: float = 2.0  # of masses, where shadows and borders are left over
    least_mm3: float = 80.0
    told_mm3: float = 40.0  # of smaller ones that are named
    behind: float = 0.5  # share of tissue in what lies behind it: else it may be what the tissue lies on
    behind_mm: float = 5.0  # of that
    thick_mm: float = 6.0  # of a bright body that the scan cuts: skin, and what the tissue lies on, are thinner


@dataclass(frozen=True)
class LookLimits:
    """When voxels count as a mass by their looks, as of `recon.segmentation.mass_network`."""

    smooth_mm: float = 1.0  # standard deviation; B-scans lie about as far apart
    sure: float = 0.5  # probability
    unsure: float = 0.2  # of bodies that are named
    least_mm3: float = 30.0
    told_mm3: float = 15.0  # of a body that isn't measured, that is named
    denied: float = 0.1  # mean probability below which a dark body counts as the tissue's own


WIDE = 6.0  # standard deviation of a blur, voxels, above which few cosines make it up
LIMITS, CUT, GAP, FAINT, LOOK = MassLimits(), CutBodyLimits(), GapLimits(), FaintLimits(), LookLimits()
CUT_WAYS: dict[Reason, str] = {
    "cut by a gap in the sweep": "scan there again",
    "cut by the images' lower end": "set a greater depth",
    "cut by the ringing at the face": "scan there through more gel",
}
"""on from what cuts a body, where another sweep beside isn't the way"""


class Found(NamedTuple):
    """Masses, and what is left out."""

    masses: list[Mass]
    left_out: list[LeftOut]
    uneven_db: float = np.nan  # standard deviation of the tissue's power


class Candidate(NamedTuple):
    """A dark body, in a part of the volume."""

    part: Part
    inside: Mask  # of that part
    volume: float  # mm^3
    core: float  # median of its power over the tissue's


class Rough(NamedTuple):
    """What a first search finds."""

    masses: list[Mass]
    left_out: list[LeftOut]
    uneven_db: float  # standard deviation of the tissue's power; from FAINT.even_db on, no faint ones are told from it
    hidden: Mask  # voxels of dark bodies that are left out, if no mass is before them, and those in the shadows of cut ones
    gap: Mask  # voxels that no B-scan shows, with B-scans on both sides


def rough(power: EchoPower) -> Rough:
    """Dark bodies with tissue all around, without the shadows that hang on to them.

    Left out, with their reasons, are bodies that the scan's side, end or a gap cuts, those behind them, streaks down
    the beam, which may be shadows of borders, weak ones, and small ones where they are many.
    """
    spacing = power.volume.spacing[::-1]
    gap, left_out = gaps(power)
    ratio, seen = _over_tissue(power)
    dark = seen & (ratio < LIMITS.dark)
    uneven_db = _unevenness(ratio, seen & ~_widen(dark, FAINT.beside_mm, spacing))
    even = uneven_db < FAINT.even_db
    dark &= ~_risen(np.where(dark, ratio, np.inf))
    seed = FAINT.seed if even else LIMITS.seed
    bodies, edge = _bodies(_opened(dark, LIMITS.open_mm, spacing), ratio, seen, spacing)
    touching = _mask(edge, dark.shape)
    large = [one for one in bodies if one.volume >= LIMITS.least_mm3]
    dim = dark | (seen & even & (ratio < FAINT.dark))
    fine, _ = _bodies(_opened(dim, LIMITS.fine_mm, spacing), ratio, seen, spacing, taken=touching | _mask(large, dark.shape))
    small = [one for one in fine if one.volume >= LIMITS.small_mm3 and ratio[one.part][one.inside].min() <= seed]
    if even:
        labels, _ = ndimage.label(dim)
        seeded = np.isin(labels, np.unique(labels[dim & (ratio <= seed)]))  # speckle alone is hardly as dark
        spots, _ = _bodies(dim & seeded, ratio, seen, spacing, taken=touching | _mask([*large, *small], dark.shape))
        left_out += [_leave_out("small", one, power) for one in spots if one.volume >= LIMITS.spot_mm3]
    chosen = [one for one in large if one.core <= seed]
    left_out += [_leave_out("weak contrast", one, power) for one in large if one.core > seed]
    behind = np.logical_or.accumulate(_widen(_mask(chosen, dark.shape), 2 * LIMITS.grow_mm, spacing), axis=1)
    for one in small:
        sure = power.seen[one.part][one.inside].mean() > LIMITS.dense and not behind[one.part][one.inside].any()
        if sure and (even or len(small) <= LIMITS.few):
            chosen.append(one)
        else:
            left_out.append(_leave_out("small", one, power))
    cut, shadowed = _cut_bodies(dark, _mask(chosen, dark.shape), ratio, seen, gap, power)
    left_out += cut
    masses, kept = list[Mass](), list[Candidate]()
    for one in chosen:
        if _is_streak(one, spacing):
            left_out.append(_leave_out("streak down the beam", one, power))
        elif shadowed[one.part][one.inside].mean() > CUT.behind:
            left_out.append(_leave_out("behind a cut body", one, power))
        else:
            field = np.where(_widen(one.inside, LIMITS.grow_mm, spacing), ratio[one.part], 1.0)
            masses.append(Mass(meshed(field, (1 + one.core) / 2, one.part, power.volume)))
            kept.append(one)
    in_shadow = np.logical_or.accumulate(_mask(kept, dark.shape), axis=1)  # which will be cleared
    return Rough(masses, left_out, uneven_db, shadowed | (dark & ~in_shadow), gap)


def say(left_out: Sequence[LeftOut]) -> None:
    """Log what is left out: of each reason the largest ones, and how many others."""
    for reason in dict.fromkeys(one.reason for one in left_out if one.reason != "gap"):
        alike = sorted((one for one in left_out if one.reason == reason), key=lambda one: -one.volume_mm3)
        for one in alike[: LIMITS.told]:
            one.say()
        if len(alike) > LIMITS.told:
            log.info("%d more are left out: %s", len(alike) - LIMITS.told, reason)


def faint(power: EchoPower, masses: Sequence[Mass], begun: Rough, signs: tuple[int, ...] = (-1, 1)) -> Found:
    """Bodies little darker than even tissue around, or brighter, in power without the shadows of the masses that are known.

    What is left out isn't logged.

    Parameters
    ----------
    begun : of a search for dark bodies; none are looked for where it says that they are hidden
    signs : -1 for darker ones, 1 for brighter ones
    """
    spacing, volume = power.volume.spacing[::-1], power.volume
    free = ~begun.hidden & (distances(masses, grid_of(volume)).voxels > FAINT.beside_mm)
    smooth = _smooth(volume.voxels, power.weight * free, FAINT.smooth_mm / spacing)
    seen = np.isfinite(_smooth(volume.voxels, power.weight, LIMITS.smooth_mm / spacing))
    known = seen & free & np.isfinite(smooth)
    depths = np.where(known, smooth, np.nan).swapaxes(0, 1).reshape(seen.shape[1], -1)
    usual = np.array([np.median(row[np.isfinite(row)]) if np.isfinite(row).any() else np.nan for row in depths], np.float32)
    level, contrast = np.broadcast_to(usual[:, None], seen.shape), np.zeros(seen.shape, np.float32)
    for around_mm in (*FAINT.around_mm, 0.0):
        told = known & (level > 0)
        contrast[told] = 10 * np.log10(np.maximum(smooth[told] / level[told], 1e-6))
        if around_mm:
            level = _smooth(volume.voxels, power.weight * (told & (np.abs(contrast) < FAINT.least_db)), around_mm / spacing)
            level = np.where(np.isfinite(level), level, usual[:, None])
    plain = known & (np.abs(contrast) < FAINT.least_db)
    found, left_out = list[Mass](), list[LeftOut]()
    for sign in signs:
        bodies, edge = _bodies(_opened(sign * contrast > FAINT.least_db, LIMITS.open_mm, spacing), contrast, seen, spacing)
        for one in bodies:
            if not _counts(one) and one.volume >= FAINT.told_mm3:
                left_out.append(_leave_out("small" if one.volume < FAINT.least_mm3 else "weak contrast", one, power))
        bodies, edge = ([one for one in several if _counts(one)] for several in (bodies, edge))
        for one in edge:
            thick = sign > 0 and _thickness(one.inside, spacing) > FAINT.thick_mm
            left_out.append(_leave_out(_cut_by(one, seen, begun.gap, spacing) if thick else "at the scan's edge", one, power))
        for one in bodies:
            field = np.where(_widen(one.inside, LIMITS.grow_mm, spacing), -sign * contrast[one.part], 0.0)
            if _is_streak(one, spacing):
                left_out.append(_leave_out("streak down the beam", one, power))
            elif any(_in_line(one, other) for other in bodies if other is not one):
                left_out.append(_leave_out("weak contrast", one, power))
            elif _tissue_behind(one, plain, spacing) < FAINT.behind:
                left_out.append(_leave_out("behind the tissue", one, power))
            else:
                found.append(Mass(meshed(field, -abs(one.core) / 2, one.part, volume, outside=0.0), bright=sign > 0))
    return Found(found, left_out)


def likely(chance: EchoPower, power: EchoPower, begun: Rough) -> Found:
    """Bodies that look like masses, in tissue as uneven as these; what is left out isn't logged.

    Parameters
    ----------
    chance : mean probability of a mass, in place of power
    begun : of a search for dark bodies, which are tissue where they don't look like masses
    """
    spacing, volume = chance.volume.spacing[::-1], chance.volume
    smooth = _smooth(volume.voxels, chance.weight, LOOK.smooth_mm / spacing)
    seen = np.isfinite(smooth) & ~_wide_gaps(chance)  # which the smoothing would bridge
    smooth = np.where(seen, smooth, 0).astype(np.float32)
    bodies, edge = _bodies(smooth > LOOK.sure, smooth, seen, spacing)
    found, left_out = list[Mass](), [one for one in begun.left_out if one.reason == "gap"]
    for one in bodies:
        if one.volume < LOOK.least_mm3:
            left_out += [_leave_out("small", one, power)] if one.volume >= LOOK.told_mm3 else []
            continue
        field = np.where(_widen(one.inside, LIMITS.grow_mm, spacing), 1 - smooth[one.part], 1.0)
        mesh = meshed(field, 1 - LOOK.sure, one.part, volume)
        found.append(Mass(mesh, bright=_level(one, power) > 1))
    for one in edge:
        if one.volume >= LOOK.told_mm3:
            left_out.append(_leave_out(_cut_by(one, seen, begun.gap, spacing), one, power))
    taken = _mask([*bodies, *edge], smooth.shape)
    doubtful, open_ = _bodies(smooth > LOOK.unsure, smooth, seen, spacing, taken=taken)
    left_out += [_leave_out("unsure", one, power) for one in (*doubtful, *open_) if one.volume >= LOOK.told_mm3]
    return Found(found, left_out, begun.uneven_db)


def _wide_gaps(power: EchoPower) -> Mask:
    """Voxels in gaps of the scan that cut masses in two."""
    across, along = _widths(power)
    return (across >= GAP.widths_mm[0]) | (along >= GAP.widths_mm[0])


def _level(one: Candidate, power: EchoPower) -> float:
    """Mean power in a body over that around it."""
    spacing = power.volume.spacing[::-1]
    around = _widen(np.pad(one.inside, 0), 2 * LIMITS.grow_mm, spacing) & ~_widen(one.inside, LIMITS.edge_mm, spacing)
    values, weight = power.volume.voxels[one.part], power.weight[one.part]
    within, beside = (float((values * weight)[where].sum() / max(weight[where].sum(), 1e-6)) for where in (one.inside, around))
    return within / max(beside, 1e-6)


def _cut_by(one: Candidate, seen: Mask, gap: Mask, spacing: Array) -> Reason:
    """By what a body is cut whose border wasn't seen as a whole."""
    margin = np.ceil(2 * LIMITS.edge_mm / spacing).astype(int)
    pairs = [(m, m) for m in margin]
    inside = np.pad(one.inside, pairs)
    known, within = (np.pad(field, pairs) for field in (seen, gap))
    part = tuple(slice(s.start, s.start + n) for s, n in zip(one.part, inside.shape, strict=True))
    sides = cut_sides(_widen(inside, 2 * LIMITS.edge_mm, spacing) & ~inside & ~known[part], within[part])
    return max(sides, key=lambda name: sides[name])


def _counts(one: Candidate) -> bool:
    """Whether a body is large enough, and differs enough, for a faint one."""
    return one.volume >= FAINT.least_mm3 and abs(one.core) >= FAINT.core_db


def _is_streak(one: Candidate, spacing: Array) -> bool:
    """Whether a body is so much longer down the beam than thick that it may be the shadow of a border."""
    return bool(np.ptp(np.nonzero(one.inside)[1]) * spacing[1] > LIMITS.streak * _thickness(one.inside, spacing))


def _tissue_behind(one: Candidate, plain: Mask, spacing: Array) -> float:
    """Share of plain tissue in what lies just behind a body."""
    deep = round(FAINT.behind_mm / float(spacing[1]))
    below = np.zeros((*one.inside.shape[::2], deep), bool)
    last = one.part[1].start + one.inside.shape[1] - 1 - one.inside[:, ::-1].argmax(axis=1)  # row of each column's end
    part = plain[one.part[0], :, one.part[2]]
    for row in range(deep):
        rows = np.minimum(last + 1 + row, part.shape[1] - 1)
        below[..., row] = np.take_along_axis(part, rows[:, None], axis=1)[:, 0]
    return float(below.mean(axis=2)[one.inside.any(axis=1)].mean())


def _in_line(one: Candidate, other: Candidate) -> bool:
    """Whether the less wide one of two bodies lies mostly before or behind the other: one of them may be the other's shadow."""
    box = [slice(max(a.start, b.start), min(a.stop, b.stop)) for a, b in zip(one.part[::2], other.part[::2], strict=True)]
    if any(s.stop <= s.start for s in box):
        return False
    wide = [body.inside.any(axis=1) for body in (one, other)]
    shared = [
        columns[tuple(slice(s.start - p.start, s.stop - p.start) for s, p in zip(box, body.part[::2], strict=True))]
        for columns, body in zip(wide, (one, other), strict=True)
    ]
    return bool((shared[0] & shared[1]).sum() > CUT.behind * min(columns.sum() for columns in wide))


def _over_tissue(power: EchoPower) -> tuple[NDArray, Mask]:
    """Power over that of the tissue around, smoothed over speckle, and where it is known; 1 elsewhere."""
    spacing = power.volume.spacing[::-1]
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
    return np.where(seen, smooth / level, 1.0), seen


def _unevenness(ratio: NDArray, where: Mask) -> float:
    """Standard deviation, dB, of the tissue's power, robust against bodies in it; infinite without tissue."""
    known = ratio[where & np.isfinite(ratio)]
    return 1.4826 * float(np.median(np.abs(10 * np.log10(np.maximum(known, 1e-6))))) if len(known) else np.inf


def _bodies(
    mask: Mask, ratio: NDArray, seen: Mask, spacing: Array, taken: Mask | None = None
) -> tuple[list[Candidate], list[Candidate]]:
    """Bodies of a mask with all of their border within the scan, and the others; none that meets what is taken."""
    labels, count = ndimage.label(mask)
    touching, candidates = list[Candidate](), list[Candidate]()
    margin, edge = (np.ceil(one / spacing).astype(int) for one in (2 * LIMITS.grow_mm, LIMITS.edge_mm))
    boxes = ndimage.find_objects(labels)
    for number in range(1, count + 1):
        box = boxes[number - 1]
        part = tuple(slice(max(0, s.start - m), s.stop + m) for s, m in zip(box, margin, strict=True))
        inside = labels[part] == number
        if taken is not None and (taken[part] & inside).any():
            continue
        ends = any(s.start < m or s.stop > n - m for s, m, n in zip(box, edge, mask.shape, strict=True))
        volume = inside.sum() * float(np.prod(spacing))
        one = Candidate(part, inside, volume, float(np.median(ratio[part][inside])))
        cut = ends or (_widen(inside, LIMITS.edge_mm, spacing) & ~seen[part]).any()
        (touching if cut else candidates).append(one)
    return candidates, touching


def _mask(bodies: Sequence[Candidate], shape: tuple[int, ...]) -> Mask:
    """Voxels of bodies."""
    mask = np.zeros(shape, bool)
    for one in bodies:
        mask[one.part] |= one.inside
    return mask


def _leave_out(reason: Reason, one: Candidate, power: EchoPower) -> LeftOut:
    """What is told of a body that is left out."""
    spacing = power.volume.spacing[::-1]
    thick = _thickness(one.inside, spacing)
    extents, centre = _extents(ndimage.find_objects(one.inside.astype(int))[0], spacing), _middle(one.inside, one.part, power)
    place = f"{one.volume:.0f} mm3 at {in_words(centre)} mm"
    match reason:
        case "streak down the beam":
            centre = _middle(one.inside & (np.cumsum(one.inside.any(axis=(0, 2))) * spacing[1] < thick)[:, None], one.part, power)
            text = f"a streak from {in_words(centre)} mm on, {extents[1]:.0f} mm down the beam and "
            text += f"{thick:.0f} mm thick, is left out: a shadow of a border, "
            text += f"or a body longer down the beam than {LIMITS.streak:g} times its thickness"
        case "behind a cut body":
            text = f"a dark body of {place} is left out: it lies behind one that is cut, maybe its shadow"
        case "weak contrast":
            text = f"a body of {place} is left out: its contrast is weak"
        case "behind the tissue":
            text = f"a body of {place} is left out: no tissue is seen behind it, so it may be what the tissue lies on"
        case "at the scan's edge":
            text = f"a body of {place} is left out: it reaches the scan's edge; scan on there if it may be a mass"
        case "unsure":
            text = f"a body of {place} may be a mass, or tissue that looks like one; it isn't measured"
        case "looks like tissue":
            text = f"a dark body of {place} is left out: it looks like tissue, such as a lobule of fat"
        case reason if reason.startswith("cut by"):
            along, deep, across = extents
            text = f"a body is {reason}, and is left out: {place}, {along:.0f} x {deep:.0f} x {across:.0f} mm; "
            text += CUT_WAYS.get(reason, "scan on there")
        case _:
            text = f"a body of {place} is left out: it is too small to be measured, or told from a shadow or uneven tissue"
    return LeftOut(reason=reason, volume_mm3=one.volume, centre_mm=centre, extents_mm=extents, text=text)


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


def gaps(power: EchoPower) -> tuple[Mask, list[LeftOut]]:
    """Voxels that no B-scan shows, with B-scans on both sides, where masses are missed; and the largest of these gaps."""
    spacing, gaps, found = power.volume.spacing[::-1], np.zeros(power.weight.shape, bool), list[LeftOut]()
    tall = np.ones((1, int(np.ceil(GAP.height_mm / spacing[1])), 1), bool)
    for width, where in zip(_widths(power), ("in the sweep", "between strokes"), strict=True):
        gaps |= width > 0
        labels, _ = ndimage.label(ndimage.binary_opening(width >= GAP.widths_mm[0], tall))
        for one, part in enumerate(ndimage.find_objects(labels), start=1):
            inside = labels[part] == one
            if (volume := inside.sum() * float(np.prod(spacing))) >= GAP.least_mm3:
                wide, centre = float(np.median(width[part][inside])), _middle(np.ones_like(inside), part, power)
                text = f"a gap of {wide:.1f} mm {where}, {volume:.0f} mm3 about {in_words(centre)} mm, wasn't scanned: "
                text += "masses in it may be missed"
                extents = _extents(part, spacing)
                found.append(LeftOut(reason="gap", volume_mm3=volume, centre_mm=centre, extents_mm=extents, text=text))
    found.sort(key=lambda gap: -gap.volume_mm3)
    for gap in found[: GAP.named]:
        gap.say()
    if others := found[GAP.named :]:
        log.warning("%d smaller gaps, %.0f mm3 together, weren't scanned", len(others), sum(gap.volume_mm3 for gap in others))
    return gaps, found


def _widths(power: EchoPower) -> tuple[Map, Map]:
    """Width, mm, of the gap that each voxel is in, across the B-scans and along the array; 0 of those in none.

    What lies between two B-scans is no gap along the array.
    """
    spacing = power.volume.spacing[::-1]
    across, along = (_gap_widths(power.seen, axis, float(spacing[axis])) for axis in (0, 2))
    across[across > GAP.widths_mm[1]] = 0
    along[(across > 0) | (along > GAP.widths_mm[1])] = 0
    return across, along


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


def _cut_bodies(dark: Mask, whole: Mask, ratio: NDArray, seen: Mask, gap: Mask, power: EchoPower) -> tuple[list[LeftOut], Mask]:
    """Dark bodies behind tissue that a side, an end or a gap of the scan cuts, and voxels in their shadows.

    Bodies that are whole are left out. The dark behind a phantom has a reason of its own: nothing bright is behind it, and it has
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
    shadowed, left_out = np.zeros(dark.shape, bool), list[LeftOut]()
    for number, box in enumerate(ndimage.find_objects(labels), start=1):
        part = tuple(slice(s.start - m, s.stop + m) for s, m in zip(box, margin, strict=True))
        inside, here = labels[part] == number, known[part]
        volume = inside.sum() * float(np.prod(spacing))
        along, height, across = extents = _extents(box, spacing)
        tall = height > LIMITS.streak * max(along, across)
        small = volume < CUT.least_mm3 or height < CUT.least_mm
        if small or np.quantile(ratio[part][inside], CUT.darkest) > LIMITS.seed or whole[part][inside].mean() > CUT.same:
            continue
        shell, behind = _widen(inside, 2 * LIMITS.edge_mm, spacing) & ~inside, np.logical_or.accumulate(inside, axis=1)
        before = np.logical_or.accumulate(inside[:, ::-1], axis=1)[:, ::-1] & ~behind
        beside, before = shell & ~behind & ~before, shell & before & inside.any(axis=1, keepdims=True)
        unseen, front = shell & ~here, before & here
        sides: dict[Reason, int] = cut_sides(unseen, gap[part])
        covered, told = front.sum() > CUT.before * before.sum(), (beside & here).sum()
        among = told > CUT.mostly * beside.sum() and (beside & bright[part]).sum() > CUT.around * told  # tissue
        among = among and _thickness(inside, spacing) > CUT.thick * min(along, across)
        if not covered and among:
            sides = {"cut by the ringing at the face": 1}
        covered = among if not covered else (front & bright[part]).sum() >= CUT.mostly * front.sum()
        if not any(sides.values()) or not covered:
            continue
        middle = tuple(slice(s.start - pad, s.stop - pad) for s in part)
        if tall:
            to_end = max(sides, key=lambda name: sides[name]) == "cut by the images' lower end"
            if to_end and _thickness(inside, spacing) >= CUT.least_mm:
                left_out.append(_shadow_to_the_end(inside, middle, power))
            continue
        ends = (inside & last[part]).any(axis=1).sum() > (1 - CUT.mostly) * inside.any(axis=1).sum()
        centre = _middle(inside, middle, power)
        if ends and (beside & ~here).sum() > (1 - CUT.mostly) * beside.sum():
            reason: Reason = "behind the tissue"
            text = f"the dark behind the tissue, {volume:.0f} mm3 about {in_words(centre)} mm, "
            text += "holds no mass, or one that isn't told from it"
        else:
            reason = max(sides, key=lambda name: sides[name])
            text = f"a dark body is {reason}, and is left out: {volume:.0f} mm3 of it at {in_words(centre)} mm, "
            text += f"{along:.0f} x {height:.0f} x {across:.0f} mm; {CUT_WAYS.get(reason, 'scan on there')}"
        left_out.append(LeftOut(reason=reason, volume_mm3=volume, centre_mm=centre, extents_mm=extents, text=text))
        if reason == "behind the tissue":
            left_out += _bumps(inside, middle, power)
            continue
        near = _widen(inside, 2 * LIMITS.grow_mm, spacing)
        below = np.pad(near, ((0, 0), (0, dark.shape[1] - part[1].start - near.shape[1]), (0, 0)))
        shadowed[part[0], part[1].start :, part[2]] |= np.logical_or.accumulate(below, axis=1)
    return left_out, shadowed[pad:-pad, pad:-pad, pad:-pad]


def _shadow_to_the_end(inside: Mask, part: Part, power: EchoPower) -> LeftOut:
    """What is told of a body whose shadow reaches the images' lower end, from a dark column in a part of the volume."""
    spacing = power.volume.spacing[::-1]
    first = int(np.flatnonzero(inside.any(axis=(0, 2)))[0])
    front = inside & (np.arange(inside.shape[1]) < first + _thickness(inside, spacing) / spacing[1])[:, None]
    extents, volume = _extents(ndimage.find_objects(front.astype(int))[0], spacing), front.sum() * float(np.prod(spacing))
    return _hidden_back(_middle(front, part, power), extents, volume, "the images' lower end")


def _hidden_back(centre: Place, extents: Place, volume: float, end: str) -> LeftOut:
    """What is told of a body of which a shadow without an end is seen."""
    along, _, across = extents
    text = f"a dark body at {in_words(centre)} mm, {along:.0f} x {across:.0f} mm wide, is left out: "
    text += f"its shadow reaches {end}, so its back isn't seen"
    why: Reason = "its shadow hides its back"
    return LeftOut(reason=why, volume_mm3=volume, centre_mm=centre, extents_mm=extents, text=text)


def cut_sides(unseen: Mask, gap: Mask) -> dict[Reason, int]:
    """By what a body is cut, with the number of voxels there, from those of its shell that weren't seen : (nz, ny, nx)."""
    return {
        "cut by the images' side": _fullest(unseen, 2),
        "cut by the sweep's end": _fullest(unseen & ~gap, 0),
        "cut by a gap in the sweep": _fullest(unseen & gap, 0),
        "cut by the images' lower end": _fullest(unseen, 1),
    }


def _bumps(behind: Mask, part: Part, power: EchoPower) -> list[LeftOut]:
    """Bodies whose shadows reach the dark behind the tissue, in a part of the volume: where that begins before its median."""
    spacing, columns, found = power.volume.spacing[::-1], behind.any(axis=1), list[LeftOut]()
    front = np.where(columns, behind.argmax(axis=1), 0).astype(float) * spacing[1]
    labels, _ = ndimage.label(columns & (front < np.median(front[columns]) - CUT.bump_mm))
    for number, box in enumerate(ndimage.find_objects(labels), start=1):
        wide = labels == number
        if wide.sum() * spacing[0] * spacing[2] < CUT.bump_mm**2:
            continue
        rim = ndimage.binary_dilation(wide, iterations=3) & ~wide
        if (rim & columns).sum() < CUT.rim * rim.sum():  # at the tissue's edge
            continue
        across, along = ((s.stop - s.start) * float(step) for s, step in zip(box, spacing[::2], strict=True))
        k, i = np.nonzero(wide)
        row = (float(front[k, i].min()) + min(across, along) / 2) / spacing[1]
        places = np.array([i.mean() + part[2].start, row + part[1].start, k.mean() + part[0].start])
        x, y, z = rigid.apply(power.volume.world_from_voxel, places).tolist()
        deep = float(np.median(front[columns]) - front[k, i].min())
        volume = float(behind[k, :, i].sum() * np.prod(spacing))
        found.append(_hidden_back((x, y, z), (along, deep, across), volume, "the dark behind the tissue"))
    return found


def _fullest(unseen: Mask, axis: int) -> int:
    """Greatest number of unseen voxels of a body's shell in one layer along an axis: what cuts it lies square to the greatest."""
    return int(unseen.sum(axis=tuple(one for one in range(3) if one != axis)).max(initial=0))


def _thickness(inside: Mask, spacing: Array) -> float:
    """Diameter of the largest ball within a body, mm."""
    return 2 * float(np.max(np.asarray(ndimage.distance_transform_edt(np.pad(inside, 1), spacing))))


def _middle(inside: Mask, part: Part, power: EchoPower) -> Place:
    """Middle, mm in the world, of a body in a part of a volume."""
    voxel = np.array([np.mean(axis) + s.start for axis, s in zip(np.nonzero(inside), part, strict=True)][::-1])
    x, y, z = rigid.apply(power.volume.world_from_voxel, voxel).tolist()
    return x, y, z


def _extents(part: Part, spacing: Array) -> Place:
    """Extents, mm, along the array, down the beam and across, of a part of a volume with a spacing : (3,) z, y, x."""
    across, deep, along = ((s.stop - s.start) * float(step) for s, step in zip(part, spacing, strict=True))
    return along, deep, across


def in_words(centre: Place) -> str:
    """A place for people."""
    return ", ".join(f"{value:.0f}" for value in centre)


def _risen(ratio: NDArray) -> Mask:
    """Voxels behind a rise of power by `LIMITS.rise`, in each run of finite values down the beam (axis 1)."""
    lowest, risen = np.full(ratio[:, 0].shape, np.inf), np.zeros(ratio[:, 0].shape, bool)
    result = np.zeros(ratio.shape, bool)
    for row in range(ratio.shape[1]):
        here = ratio[:, row]
        run = np.isfinite(here)
        lowest = np.where(run, np.minimum(lowest, here), np.inf)
        risen = run & (risen | (here > LIMITS.rise * np.maximum(lowest, LIMITS.floor)))
        result[:, row] = risen
    return result


def _smooth(values: NDArray, weight: NDArray, sigma: Array) -> NDArray:
    """Means of values, weighed by their weights and a Gaussian; NaN where little is known nearby."""
    fields = (np.asarray(field, np.float32) for field in (weight, values * weight))
    blur = _widely_blurred if sigma.min() > WIDE else _blurred
    share, total = threads.mapped(lambda field: blur(field, sigma), fields)
    return np.divide(total, share, out=np.full_like(total, np.nan), where=share > 0.02)


def _widely_blurred(field: Map, sigma: Array) -> Map:
    """A Gaussian blur of (nz, ny, nx) over many voxels, reflected at the sides: by the few cosines that it passes."""
    aside, down, across = (_passed(*one) for one in zip(field.shape, sigma, strict=True))
    lines = down.T @ (field @ across)
    sheets = aside @ (aside.T @ lines.reshape(len(field), -1))
    return (down @ sheets.reshape(lines.shape)) @ across.T


def _passed(count: int, sigma: float) -> Map:
    """Cosines : (count, k) of a discrete transform that a blur passes, each times the root of the share that is passed."""
    least = 1e-7  # share of a cosine that is passed, as precise as the numbers
    number = np.arange(count)
    share = np.exp(-((np.pi * number * sigma / count) ** 2) / 2)
    kept = number[share > least]
    waves = np.cos(np.pi * np.outer(number + 0.5, kept) / count) * np.sqrt(np.where(kept, 2, 1) / count)
    return (waves * np.sqrt(share[kept])).astype(np.float32)


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
