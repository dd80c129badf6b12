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
from recon.model.pose_checks import LIMITS
from recon.model.tracks import Track

log = logging.getLogger(__name__)

Array = NDArray[np.float64]


def read_tracking(path: Path, tracker: Path | None = None) -> Frames:
    """Read a sequence without its images, with the transforms of a tracker's own sequence, where both were saved apart.

    Raises
    ------
    InputError
        If a file is damaged, or the tracker's has no transforms while the images were taken.
    """
    frames = sequences.read_tracking(path)
    return frames if tracker is None else joined(path, frames, tracker, sequences.read_tracking(tracker))


def joined(path: Path, frames: Frames, tracker: Path, tracked: Frames) -> Frames:
    """The frames with the transforms of another file, between two of its frames by time; those of the first go before."""
    if not tracked.transforms:
        raise InputError(f"{tracker}: tracker: expected transforms in each frame, such as ProbeToTracker, found none")
    for file, times in ((path, frames.times_s), (tracker, tracked.times_s)):
        if not np.isfinite(times).all() or np.abs(times).max(initial=0) > sequences.MOST_SECONDS:
            raise InputError(f"{file}: Timestamp: expected seconds in each frame, by which poses find their images, found others")
    moments, first = np.unique(tracked.times_s, return_index=True)
    transforms, valid = dict(frames.transforms), dict(frames.valid)
    taken = np.round(frames.times_s * 1e9).astype(np.int64)
    moving = []
    for name, matrices in tracked.transforms.items():
        if name in transforms:
            continue
        if not _moves(matrices, tracked.valid[name]):
            transforms[name] = np.tile(matrices[tracked.valid[name].argmax()], (len(taken), 1, 1))
            valid[name] = np.full(len(taken), tracked.valid[name].any())
            continue
        moving.append(name)
        known = np.where(tracked.valid[name][:, None, None], matrices, np.nan)[first]
        at = tracks.at(Track(np.round(moments * 1e9).astype(np.int64), known), taken)
        valid[name] = np.isfinite(at).all(axis=(1, 2))
        transforms[name] = np.where(valid[name][:, None, None], at, np.eye(4))
    if moving and not any(valid[name].any() for name in moving):
        spans = [f"{times.min():.3f} to {times.max():.3f} s" for times in (tracked.times_s, frames.times_s)]
        raise InputError(
            f"{tracker}: tracker: expected poses while the images were taken, at {spans[1]}, found some at {spans[0]}"
        )
    return replace(frames, transforms=transforms, valid=valid)


def believed(
    path: Path, frames: Frames, to: str, of: str, fixed: Mapping[str, Array] | None = None, implausible: Implausible = "refuse"
) -> tuple[Frames, int]:
    """The frames without poses that no hand makes, of transforms that lead from a frame of reference to another; their number.

    Raises
    ------
    InputError
        If too many are implausible, of another unit, or all the same; see `recon.model.pose_checks`.
    """
    valid, numbers, left_out = dict(frames.valid), np.arange(len(frames.times_s), dtype=float), np.empty(0, np.int64)

    @cache
    def changes() -> tuple[Array, Array]:
        return numbers, pose_checks.image_changes(sequences.stream_images(path))

    try:
        chain = sequences.chain(frames, to, of, fixed)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    names = [name for name in chain if name in frames.transforms and name not in (fixed or {})]
    for name in names:
        if not _moves(frames.transforms[name], valid[name]):
            continue
        poses = np.where(valid[name][:, None, None], frames.transforms[name], np.nan)
        place, images = f"{path}: {name}", changes if "Image" in valid else None
        kept, found = pose_checks.checked(place, frames.times_s, poses, implausible, images, numbers, "frame")
        valid[name] = np.isfinite(kept).all(axis=(1, 2))
        left_out = np.union1d(left_out, found.all)
    result = replace(frames, valid=valid)
    if names:
        pose_checks.check_motion(f"{path}: {', '.join(names)}", sequences.poses(result, to, of, fixed), implausible)
        _warn_of_untracked(path, result, names)
    return result, len(left_out)


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
