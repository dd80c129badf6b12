"""Mistakes behind frames of a probe's calibration that are refused: other readings by which they would be taken.

A reading is named if the frames misfit far less by it, and the phantom then calibrates the probe without a complaint. Frames that
agree up to some moment, and again from there on, show that something moved.
"""

from collections.abc import Callable, Iterator
from dataclasses import fields, replace
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

MOST_TRIED = 24  # frames, evenly over all
LESS, AS_WELL = 1 / 8, 1.5  # of the misfit as given, up to which a reading may be right: of frames that contradict, and of others
LARGE_MM2 = 4.0  # misfit of frames that are at no rest by any reading; 9 at most
MOST_LATE = 3  # frames
FEWEST_AFTER = 3  # frames of those that don't agree with the others
FACES_DEG = 150.0  # between the normals of a target that cameras see from its front, at most


def explain(frames: PhantomFrames, kind: ModuleType, settings: Any, expected: Array, agree: bool) -> str | None:
    """Name the likely mistake in frames that a phantom's `calibrate` refuses, in words; None without one.

    Parameters
    ----------
    kind, settings, expected : of the phantom, with its `misfit`, and as its `calibrate` takes them
    agree : whether the frames agree, by a calibration that can't be
    """

    def misfit(some: PhantomFrames) -> float:
        return kind.misfit(_some(some, np.unique(np.linspace(0, len(some.usable) - 1, MOST_TRIED).astype(int))), settings)

    if len(frames.usable) < kind.MIN_FRAMES:
        return None
    here = misfit(frames)
    tried = [(misfit(other), meaning, other) for meaning, other in _readings(frames, kind)]
    likely = []
    for value, meaning, other in tried:
        if value > (AS_WELL if agree else LESS) * here:
            continue
        try:
            found = kind.calibrate(other, settings.model_copy(update={"max_sigma_mm": np.inf}), expected).calibration
        except InputError:
            continue
        away = probe_checks.off_design(found, frames.size, expected)[1]
        likely.append((value / float(np.prod(found.scale)), away, meaning))  # px^2, which any unit of the poses leaves as it is
    if likely:
        least = min(value for value, *_ in likely)
        nearest = min(each[1:] for each in likely if each[0] <= AS_WELL * least)
        return f"{nearest[1]}: read so, they agree"
    if moved := _moved(frames, kind.MIN_FRAMES, LESS * here, misfit):
        return moved
    normals = frames.sightings.poses[:, :3, 2]
    if (turned := float(np.degrees(np.arccos(np.clip(normals @ normals.T, -1, 1))).max())) > FACES_DEG:
        cause = "degrees read as radians, or a quaternion's numbers in another order?"
        return f"a target that faces to all sides, up to {turned:.0f} deg from one another, as cameras see none: {cause}"
    if agree or here < LARGE_MM2:
        return None
    return f"{'a lag, or ' if _in_motion(frames) else ''}poses in the frame of another body, or of something that moves"


def _readings(frames: PhantomFrames, kind: ModuleType) -> Iterator[tuple[str, PhantomFrames]]:
    """Common mistakes, each with the frames as they would be without."""
    poses = frames.sightings.poses
    for meaning, read in probe_checks.readings(poses).items():
        yield f"poses of {meaning}", _at(frames, read)
    for unit, length in probe_checks.POSE_UNITS.items():
        longer = poses.copy()
        longer[:, :3, 3] *= length
        yield f"poses in {unit}", _at(frames, longer)
    yield "poses in reversed order", _in_order(frames, np.arange(len(frames.poses))[::-1])
    every = np.arange(len(frames.poses))
    if not _in_motion(frames):  # else a lag explains more
        for late in range(1, MOST_LATE + 1):
            yield f"B-scans late by {late} of the poses", _in_order(frames, every - late)
            yield f"B-scans early by {late} of the poses", _in_order(frames, every + late)
    for meaning, known in kind.others(frames.known) if hasattr(kind, "others") else ():
        yield meaning, replace(frames, known=known)


def _moved(frames: PhantomFrames, least: int, most: float, misfit: Misfit) -> str | None:
    """Say between which frames something moved, if many at one end agree to a misfit at most, and never all."""
    count, numbers = len(frames.usable), frames.numbers[frames.usable]
    for size in range(count - FEWEST_AFTER, max(least, count // 2) - 1, -1):
        for first, kept in ((size, np.arange(size)), (count - size, np.arange(count - size, count))):
            if misfit(_some(frames, kept)) < most:
                return (
                    f"frames {numbers[kept[0]]} to {numbers[kept[-1]]} that agree with one another, but not with the others: "
                    f"a bracket that slipped, or a phantom that was pushed, before frame {numbers[first]}"
                )
    return None


def _in_motion(frames: PhantomFrames) -> bool:
    """Whether the probe moved as the B-scans were taken, so that a lag counts."""
    rates = frames.sightings.pose_rates
    return rates is not None and bool(np.median(np.linalg.norm(rates[:, :3, 3], axis=1)) > STILL_MM_S)


def _at(frames: PhantomFrames, poses: Array) -> PhantomFrames:
    """The same at other poses."""
    return replace(frames, sightings=replace(frames.sightings, poses=poses))


def _in_order(frames: PhantomFrames, order: NDArray[np.intp]) -> PhantomFrames:
    """The usable frames at poses of others : (n,) by number, as far as there are such."""
    there = order[frames.usable]
    chosen = np.flatnonzero((there >= 0) & (there < len(order)))
    poses = frames.poses[there[chosen]]
    found = np.isfinite(poses).all(axis=(1, 2))
    return _at(_some(frames, chosen[found]), poses[found])


def _some(frames: PhantomFrames, chosen: NDArray[np.intp]) -> PhantomFrames:
    """Some of the usable frames, by number from 0 on."""
    which, sightings = frames.usable[chosen], frames.sightings
    values = {each.name: getattr(sightings, each.name) for each in fields(sightings)}
    own = {name: value[chosen] for name, value in values.items() if isinstance(value, np.ndarray)}
    seen = tuple(frames.seen[k] for k in which)
    own_poses = frames.poses[which] if len(frames.poses) else frames.poses
    return replace(frames, sightings=replace(sightings, **own), numbers=frames.numbers[which], seen=seen, poses=own_poses)
