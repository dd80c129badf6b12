"""Mistakes behind frames of a probe's calibration that are refused: other readings by which they would be taken.

A reading is named if the frames misfit far less by it, and the phantom then calibrates the probe without a complaint. Frames that
agree up to some moment, or from there on, show that something changed.
"""

from collections.abc import Callable, Iterator
from dataclasses import replace
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recon.errors import InputError
from recon.probe_calibration import probe_checks
from recon.probe_calibration.free_lag import STILL_MM_S
from recon.probe_calibration.phantom_frames import PhantomFrames

Array = NDArray[np.float64]
Misfit = Callable[[PhantomFrames], float]

MOST_TRIED = 24  # frames, evenly over all, and places of a change
LESS, AS_WELL = 1 / 8, 1.5  # of the misfit as given, up to which a reading may be right: of frames that don't agree, and that do
MOST_LATE = 3  # frames
FEWEST_AFTER = 3  # frames of those that don't agree with the others
MANY = 0.2  # of the frames: so many outliers may agree with each other
OF_OTHER = 0.9  # of the frames of one part, that are outliers where a result is of the other part
CHANGED = "a bracket that slipped, a phantom that was pushed, another depth setting, or B-scans that were lost"
FACES_DEG = 150.0  # between the normals of a target that cameras see from its front, at most


def explain(frames: PhantomFrames, kind: ModuleType, settings: Any, expected: Array, how: probe_checks.How) -> str:
    """Name the likely mistake in frames that a phantom's `calibrate` refuses as misread, to be added to that; or nothing.

    Parameters
    ----------
    kind, settings, expected : of the phantom, with its `misfit`, and as its `calibrate` takes them
    how : of `probe_checks.Misread`
    """

    def misfit(some: PhantomFrames) -> float:
        if len(some.usable) < kind.MIN_FRAMES:
            return np.inf
        return kind.misfit(_some(some, _evenly(0, len(some.usable) - 1)), settings)

    here = misfit(frames)
    most, likely = (AS_WELL if how == "agree" else LESS) * here, []
    for meaning, other in _readings(frames, kind):
        if (value := misfit(other)) > most:
            continue
        try:
            found = kind.calibrate(other, settings.model_copy(update={"max_sigma_mm": np.inf}), expected).calibration
        except InputError:
            continue
        likely.append((value / float(np.prod(found.scale)), meaning, found))  # px^2, which is alike in any unit of the poses
    if likely:
        best = [each for each in likely if each[0] <= AS_WELL * min(value for value, *_ in likely)]
        away = {
            meaning: probe_checks.off_design(found, frames.size, expected)[1]
            for _, meaning, found in best
            if probe_checks.near(found, frames.size, expected)
        }
        meant = min(away, key=lambda meaning: away[meaning]) if away else " or ".join(meaning for _, meaning, _ in best)
        return f"; likely {meant}: read so, they agree"
    if how != "contradict":
        return ""
    return _changed(frames, kind.MIN_FRAMES, LESS * here, misfit) or _faces(frames)


def two_parts(frames: PhantomFrames, outliers: NDArray[np.bool_], kind: ModuleType, settings: Any) -> str:
    """Say between which frames something changed, if those before it agree, and those after it, but never both; or nothing.

    Frames of both parts may agree by a wrong scale, others of both being outliers : (n,) of the usable frames: then the result is
    of neither part. It is of one part, and right there, if the other's are outliers.
    """
    count, least = len(outliers), kind.MIN_FRAMES
    if count < 2 * least:
        return ""
    misfits = {
        first: max(kind.misfit(_some(frames, part), settings) for part in np.split(np.arange(count), [first]))
        for first in _evenly(least, count - least).tolist()
    }
    first = min(misfits, key=lambda each: misfits[each])
    of_one = max(outliers[:first].mean(), outliers[first:].mean()) > OF_OTHER
    if of_one or misfits[first] >= LESS * kind.misfit(frames, settings):
        return ""
    numbers = frames.numbers[frames.usable]
    ends = f"frames {numbers[0]} to {numbers[first - 1]} agree with one another, and so do {numbers[first]} to {numbers[-1]}"
    return f"; {ends}, but not with the others: {CHANGED}, at about frame {numbers[first]}"


def _readings(frames: PhantomFrames, kind: ModuleType) -> Iterator[tuple[str, PhantomFrames]]:
    """Common mistakes, each with the frames as they would be without."""
    poses = frames.sightings.poses
    for meaning, read in probe_checks.readings(poses).items():
        yield f"poses of {meaning}", _at(frames, read)
    for unit, length in probe_checks.POSE_UNITS.items():
        longer = poses.copy()
        longer[:, :3, 3] *= length
        yield f"poses in {unit}", _at(frames, longer)
    count = np.isfinite(frames.poses).all(axis=(1, 2)).sum()
    yield "poses in reversed order", _in_order(frames, np.arange(count)[::-1])
    if not _in_motion(frames):  # else a lag explains more
        for late in range(1, MOST_LATE + 1):
            yield f"B-scans late by {late} of the poses", _in_order(frames, np.arange(count) - late)
            yield f"B-scans early by {late} of the poses", _in_order(frames, np.arange(count) + late)
    for meaning, known in kind.others(frames.known) if hasattr(kind, "others") else ():
        yield meaning, replace(frames, known=known)


def _changed(frames: PhantomFrames, least: int, most: float, misfit: Misfit) -> str:
    """Say between which frames something changed, if many at one end agree to a misfit at most, and never all."""
    count, numbers = len(frames.usable), frames.numbers[frames.usable]
    for size in _evenly(max(least, count // 2), count - FEWEST_AFTER)[::-1].tolist():
        for first, kept in ((size, np.arange(size)), (count - size, np.arange(count - size, count))):
            if misfit(_some(frames, kept)) < most:
                agree = f"frames {numbers[kept[0]]} to {numbers[kept[-1]]} agree with one another, but not with the others"
                return f"; {agree}: {CHANGED}, at about frame {numbers[first]}"
    return ""


def _faces(frames: PhantomFrames) -> str:
    """Ask about a target that faces to all sides."""
    normals = frames.sightings.poses[:, :3, 2]
    turned = float(np.degrees(np.arccos(np.clip(normals @ normals.T, -1, 1))).max())
    if turned < FACES_DEG:
        return ""
    return f"; the target's face turns by up to {turned:.0f} deg, as cameras see none: are degrees read as radians?"


def _in_motion(frames: PhantomFrames) -> bool:
    """Whether the probe moved as the B-scans were taken, so that a lag counts."""
    rates = frames.sightings.pose_rates
    return rates is not None and bool(np.median(np.linalg.norm(rates[:, :3, 3], axis=1)) > STILL_MM_S)


def _at(frames: PhantomFrames, poses: Array) -> PhantomFrames:
    """The same at other poses."""
    return replace(frames, sightings=replace(frames.sightings, poses=poses))


def _in_order(frames: PhantomFrames, order: NDArray[np.intp]) -> PhantomFrames:
    """The usable frames at poses of others : (m,), by their numbers among those that have a pose, as far as there are such."""
    posed = np.flatnonzero(np.isfinite(frames.poses).all(axis=(1, 2)))
    there = order[np.searchsorted(posed, frames.usable)]
    chosen = np.flatnonzero((there >= 0) & (there < len(posed)))
    return _at(_some(frames, chosen), frames.poses[posed[there[chosen]]])


def _some(frames: PhantomFrames, chosen: NDArray[np.intp]) -> PhantomFrames:
    """Some of the usable frames, by number from 0 on."""
    which = frames.usable[chosen]
    seen, poses = tuple(frames.seen[k] for k in which), frames.poses[which]
    return replace(frames, sightings=frames.sightings.of(chosen), numbers=frames.numbers[which], seen=seen, poses=poses)


def _evenly(first: int, last: int) -> NDArray[np.intp]:
    """At most MOST_TRIED whole numbers from one to another."""
    return np.unique(np.linspace(first, last, MOST_TRIED).astype(int))
