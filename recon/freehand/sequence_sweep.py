"""A PLUS sequence as a sweep: its B-scans with their time stamps, and the poses of what the probe carries, between frames too.

A frame's transforms hold for its time stamp. Where the recorder's clocks weren't set right the images are late against them, by
the latency that `recon.probe_calibration.latency` measures from such a sweep.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydantic import model_validator

from recon.capture import sweep_part
from recon.capture.images import Size
from recon.capture.manifest import Purpose
from recon.capture.sweep_part import SweepCapture
from recon.errors import Implausible, InputError
from recon.freehand import sequence_checks, sequences
from recon.freehand.sequences import MOST_SECONDS, FrameName, FrameNames
from recon.geometry import rigid
from recon.model import tracks
from recon.model.rig import Part
from recon.model.tracks import MAX_GAP_S, Track

Array = NDArray[np.float64]


class SequenceFields(Part):
    """Fields of a verb that takes a sequence in place of a capture."""

    sequence: Path | None = None
    """instead of a capture: a sequence of the PLUS toolkit, .igs.mha or .igs.nrrd"""
    tracker: Path | None = None
    """the sequence of its poses, where the tracker's were saved in a file of their own: put at the images' times"""
    target: FrameName | None = None
    """frame of the sequence that is fixed to the probe, in which its calibration is; null is Probe"""
    reference: FrameName | None = None
    """frame of the sequence in which wires and bottom rest, and results are, such as Tracker, or LPS for where 3D Slicer shows
    the sequence; null is a configuration's, or else Reference"""
    implausible: Implausible = "refuse"
    """poses that no hand makes, and lengths that no scanner has: refuse leaves poses out, and refuses if they are many; take
    uses all of them, with a warning"""

    @model_validator(mode="after")
    def _of_a_sequence(self) -> "SequenceFields":
        if self.sequence is None and self.tracker is not None:
            raise ValueError(f"tracker: expected none without a sequence, whose poses it holds, found {self.tracker}")
        given = {name: getattr(self, name, None) for name in FrameNames._fields}
        for name, value in given.items():
            if self.sequence is None and value is not None:
                raise ValueError(f"{name}: expected none without a sequence, of which it names a frame, found {value}")
        return self

    def frame_names(self, usual: FrameNames) -> FrameNames:
        """The frames by the names that are given, and by the usual ones else."""
        return FrameNames(*(getattr(self, name, None) or value for name, value in usual._asdict().items()))


@dataclass(frozen=True)
class SequenceSweep:
    """The n B-scans of a sequence of m frames, with what `SweepCapture` has of a capture; covariances of poses aren't known."""

    name: str  # of the file, for messages
    size: Size  # of the B-scans: width, height, px
    frames: NDArray[np.int64]  # (n,) numbers of the frames with a B-scan, increasing
    times_s: Array  # (m,) s, NaN where a frame has none
    world_from_target: Array  # (m, 4, 4) mm, from the target to the reference frame; NaN where the target was not found
    stream: Callable[[], Iterator[NDArray[np.uint8]]]  # images of all frames, from the first at each call

    @property
    def times(self) -> NDArray[np.int64]:
        """Time stamps of the B-scans : (n,) ns; InputError if one has none, see `timed`."""
        return _nanoseconds(self.name, self.times_s[self.frames])

    @property
    def clocked(self) -> bool:
        """Whether all frames have a time stamp, in order, so that poses between them are known."""
        return bool((np.abs(self.times_s) < MOST_SECONDS).all() and (np.diff(self.times_s) >= 0).all())

    @property
    def track(self) -> Track:
        """The poses of all frames with a time stamp."""
        return _track(self.name, self.times_s, self.world_from_target)

    def timed(self) -> "SequenceSweep":
        """The B-scans that have a time stamp; InputError if none has."""
        known = np.isfinite(self.times_s)[self.frames]
        if not known.any():
            raise InputError(f"{self.name}: Timestamp: expected one in each frame, found none: a latency needs them")
        return replace(self, frames=self.frames[known])

    def images(self) -> Iterator[NDArray[np.uint8]]:
        """Read all B-scans : (h, w), one by one."""
        wanted = set(self.frames.tolist())
        return (image for number, image in enumerate(self.stream()) if number in wanted)

    def poses(self, lag_s: float = 0.0) -> Array:
        """Poses : (n, 4, 4) at which the B-scans were taken, NaN where there is none; InputError if no B-scan has one."""
        poses = lagged(self.name, self.times_s, self.world_from_target, lag_s)[self.frames]
        if not np.isfinite(poses).any():
            raise InputError(f"{self.name}: expected frames with a B-scan and a pose, found none")
        return poses

    def pose_covariance(self, lag_s: float = 0.0) -> None:
        """None: no sequence has a covariance."""


def read_source(fields: SequenceFields, capture: Path | None, sweep: str, purpose: Purpose) -> SweepCapture | SequenceSweep:
    """Open the sweep of a capture, by its name or as the only one for a purpose; without a capture, the sequence.

    Raises
    ------
    InputError
        If it is damaged, or the capture has no such sweep.
    """
    if capture is not None:
        return sweep_part.read_sweep(capture, sweep, purpose, fields.implausible)
    assert fields.sequence is not None
    return read_sequence_sweep(fields.sequence, fields.frame_names(FrameNames()), fields.tracker, fields.implausible)


def read_sequence_sweep(
    path: Path, names: FrameNames, tracker: Path | None = None, implausible: Implausible = "refuse"
) -> SequenceSweep:
    """Open a sequence as a sweep, without poses that no hand makes; images are read only to look into poses that repeat.

    tracker : the sequence file of the poses, where they were saved apart from the images

    Raises
    ------
    InputError
        If the file is damaged, holds no images, or no transforms that lead from the target to the reference frame; or too many
        poses are implausible.
    """
    height, width = sequences.image_shape(path)
    frames, _ = sequence_checks.read_tracking(path, names.reference, names.target, None, tracker, implausible)
    poses = sequences.poses(frames, names.reference, names.target)
    numbers = np.flatnonzero(frames.valid["Image"])
    return SequenceSweep(str(path), (width, height), numbers, frames.times_s, poses, lambda: sequences.stream_images(path))


def lagged(name: str, times_s: Array, poses: Array, lag_s: float) -> Array:
    """Poses : (n, 4, 4) at which images of time stamps : (n,) s were taken; without a lag those of the frames, as recorded.

    Parameters
    ----------
    poses : (n, 4, 4)
        Of a rigid body at the time stamps, times any one matrix, such as that from pixels to mm; NaN where there is none.
    lag_s : float
        How late the time stamps of the images are; see `recon.probe_calibration.latency.Lag`.

    Raises
    ------
    InputError
        If there is a lag and no image has poses around it, or there are no time stamps, or they aren't in order.
    """
    if lag_s == 0:
        return poses
    moving = _track(name, times_s, poses)
    if not moving.found.any():
        raise InputError(f"{name}: lag_s: expected frames with a pose and a time stamp, found none; without a lag none is needed")
    start = rigid.transform(moving.poses[moving.found][0, :3, :3], np.zeros(3))  # so that origins are interpolated as they are
    motion = replace(moving, poses=moving.poses @ np.linalg.inv(start))
    known = np.isfinite(times_s)
    result = np.full(poses.shape, np.nan)
    result[known] = tracks.poses_at(motion, _nanoseconds(name, times_s[known]), lag_s) @ start
    if len(moving.times) * 2 < known.sum():
        times = "1 different time" if len(moving.times) == 1 else f"{len(moving.times)} different times"
        found = f"only {times} in {known.sum()} frames, from {times_s[known][0]:.15g} s on"
        raise InputError(f"{name}: Timestamp: expected one of each frame's own, by which poses are interpolated, found {found}")
    if not np.isfinite(result).any():
        found = "none: is the lag right, or the frame rate too low?"
        raise InputError(f"{name}: lag_s: expected B-scans between poses at most {MAX_GAP_S:g} s apart, found {found}")
    return result


def _track(name: str, times_s: Array, poses: Array) -> Track:
    """Poses of the frames with a time stamp; of frames with the same the first that has one."""
    known = np.flatnonzero(np.isfinite(times_s))
    times = _nanoseconds(name, times_s[known])
    early = np.flatnonzero(np.diff(times) < 0) + 1
    if len(early):
        number, before = known[early[0]], times_s[known[early[0] - 1]]
        found = f"{times_s[number]:g} s: two recordings in one file?"
        raise InputError(f"{name}: Seq_Frame{number:04d}_Timestamp: expected {before:g} s or later, as before, found {found}")
    found = np.isfinite(poses[known]).all(axis=(1, 2))
    order = np.lexsort((~found, times))  # of equal times those with a pose come first
    moments, first = np.unique(times[order], return_index=True)
    return Track(moments, poses[known[order[first]]])


def _nanoseconds(name: str, times_s: Array) -> NDArray[np.int64]:
    if not (np.abs(times_s) < MOST_SECONDS).all():
        worst = times_s[~(np.abs(times_s) < MOST_SECONDS)][0]
        raise InputError(f"{name}: Timestamp: expected seconds below {MOST_SECONDS:g}, found {worst:g}: milliseconds, or none?")
    return np.round(times_s * 1e9).astype(np.int64)
