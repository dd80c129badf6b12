"""Transforms of a sequence that can be believed, and those of a tracker's own file, put at the times of the images."""

import logging
from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from itertools import combinations
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from recon.errors import Implausible, InputError
from recon.freehand import sequences
from recon.freehand.sequences import TRANSFORM, Frames
from recon.model import pose_checks, tracks
from recon.model.pose_checks import LIMITS, Images
from recon.model.tracks import Track

log = logging.getLogger(__name__)

Array = NDArray[np.float64]


def read_tracking(
    path: Path,
    to: str,
    of: str,
    fixed: Mapping[str, Array] | None = None,
    tracker: Path | None = None,
    implausible: Implausible = "refuse",
    hint: str = "",
) -> tuple[Frames, int]:
    """Read a sequence without its images, and without poses that no hand makes; the number of these.

    Parameters
    ----------
    to, of, fixed : the chain of transforms that is looked at, as of `sequences.poses`
    tracker : the sequence file of the poses, where they were saved apart from the images
    hint : for the end of the message where no transforms lead from one frame to the other

    Raises
    ------
    InputError
        If a file is damaged, no transforms lead there, the tracker's has none while the images were taken, or too many poses are
        implausible, of another unit, or all the same; see `recon.model.pose_checks`.
    """
    frames = sequences.read_tracking(path)
    tracked = None if tracker is None else _in_order(tracker, sequences.read_tracking(tracker))
    transforms = {**frames.transforms, **(tracked.transforms if tracked else {})}
    try:
        chain = sequences.chain(transforms, to, of, fixed)
    except InputError as error:
        raise InputError(f"{path}: {error}{hint if transforms else ''}") from None
    names = [name for name in chain if name in transforms and name not in (fixed or {})]
    times_s, numbers = frames.times_s, np.arange(len(frames.times_s), dtype=float)

    @cache
    def small() -> NDArray[np.float32]:
        return pose_checks.small_images(sequences.stream_images(path))

    def without_implausible(file: Path, of_file: Frames, names: list[str], clock: Array, moments: Array) -> tuple[Frames, int]:
        images = (lambda: (moments, small())) if "Image" in frames.valid else None
        return _without_implausible(file, of_file, names, implausible, clock, images)

    others = [name for name in names if tracked is not None and name in tracked.transforms]
    own = [name for name in names if name not in others]
    frames, left_out = without_implausible(path, frames, own, numbers, numbers)
    if tracker is not None and tracked is not None:
        tracked, more = without_implausible(tracker, tracked, others, tracked.times_s, times_s)
        frames, left_out = _join(path, frames, tracker, tracked), left_out + more
    if names:
        moving = [k for k, name in enumerate(chain) if name in names and _moves(frames.transforms[name], frames.valid[name])]
        passed = [of]
        for name in chain:
            source, destination = TRANSFORM.findall(name)[0]
            passed.append(destination if source == passed[-1] else source)
        first, last = (moving[0], moving[-1] + 1) if moving else (0, -1)  # a calibration may be in mm where the tracker is not
        motion = sequences.poses(frames, passed[last], passed[first], fixed)
        pose_checks.check_motion(f"{path}: {', '.join(names)}", frames.times_s, motion, implausible)
        _warn_of_untracked(path, frames, names)
    return frames, left_out


def _in_order(tracker: Path, tracked: Frames) -> Frames:
    """Rows of a tracker's own file in order of time, the first of each."""
    if not tracked.transforms:
        raise InputError(f"{tracker}: tracker: expected transforms in each frame, such as ProbeToTracker, found none")
    _check_times(tracker, tracked.times_s)
    _, first = np.unique(np.round(tracked.times_s * 1e9).astype(np.int64), return_index=True)
    transforms, valid = ({name: each[first] for name, each in of.items()} for of in (tracked.transforms, tracked.valid))
    return Frames(tracked.times_s[first], transforms, valid)


def _check_times(file: Path, times_s: Array) -> None:
    if not np.isfinite(times_s).all() or np.abs(times_s).max(initial=0) > sequences.MOST_SECONDS:
        raise InputError(f"{file}: Timestamp: expected seconds in each frame, by which poses find their images, found others")


def _without_implausible(
    path: Path, frames: Frames, names: list[str], implausible: Implausible, clock: Array, images: Images | None
) -> tuple[Frames, int]:
    """The frames without poses of some transforms that no hand makes; number of those frames."""
    valid, left_out = dict(frames.valid), np.empty(0, np.int64)
    for name in names:
        if _moves(frames.transforms[name], valid[name]):
            poses = np.where(valid[name][:, None, None], frames.transforms[name], np.nan)
            place = f"{path}: {name}"
            kept, found = pose_checks.without_implausible(place, frames.times_s, poses, implausible, images, clock, "frame")
            valid[name] = np.isfinite(kept).all(axis=(1, 2))
            left_out = np.union1d(left_out, found.rows_left_out)
    return replace(frames, valid=valid), len(left_out)


def _join(path: Path, frames: Frames, tracker: Path, tracked: Frames) -> Frames:
    """The frames with the transforms of another file, between two of its rows by time; none where a frame has no time.

    They replace the images' own of the same name, which recorders fill with identities. A transform that is the same in all rows
    holds always, if it is valid in all of them.
    """
    timed = np.isfinite(frames.times_s)
    _check_times(path, frames.times_s[timed] if timed.any() else frames.times_s)
    moments, taken = (np.round(each * 1e9).astype(np.int64) for each in (tracked.times_s, np.where(timed, frames.times_s, 0)))
    transforms, valid, moving = dict(frames.transforms), dict(frames.valid), []
    for name, matrices in tracked.transforms.items():
        seen, start = tracked.valid[name], np.eye(4)
        if seen.any():
            start[:3, :3] = matrices[seen.argmax(), :3, :3]  # with a scale, if it has one: without it poses are rigid
        at = tracks.at(Track(moments, np.where(seen[:, None, None], matrices, np.nan) @ np.linalg.inv(start)), taken) @ start
        valid[name] = np.isfinite(at).all(axis=(1, 2)) & timed
        transforms[name] = np.where(valid[name][:, None, None], at, np.eye(4))
        if _moves(matrices, seen):
            moving.append(name)
        elif seen.all():
            transforms[name], valid[name] = np.tile(matrices[0], (len(taken), 1, 1)), np.ones(len(taken), bool)
    if moving and not any(valid[name].any() for name in moving):
        spans = [f"{times.min():.3f} to {times.max():.3f} s" for times in (tracked.times_s, frames.times_s[timed])]
        raise InputError(
            f"{tracker}: tracker: expected poses while the images were taken, at {spans[1]}, found some at {spans[0]}"
        )
    return replace(frames, transforms=transforms, valid=valid)


def _warn_of_untracked(path: Path, frames: Frames, names: list[str]) -> None:
    """Name a tool that is always at the same place, while one farther along the chain, in the same tracker's frame, moves."""
    moves = {name: _moves(frames.transforms[name], frames.valid[name]) for name in names}
    for name, later in combinations(names, 2):
        count, (tool, tracker) = int(frames.valid[name].sum()), TRANSFORM.findall(name)[0]
        if not moves[name] and moves[later] and later.endswith(f"To{tracker}") and count > LIMITS.repeats:
            told = f"the same to the last digit in all {count} frames while {later} moves: was {tool} tracked?"
            log.warning("%s: %s: %s", path, name, told)


def _moves(matrices: Array, valid: NDArray[np.bool_]) -> bool:
    known = matrices[valid]
    return len(known) > 1 and not (known == known[0]).all()
