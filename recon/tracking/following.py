"""A tracker's poses of many frames as a track, with the reason where there is none."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from recon.tracking.tracker import Tracker, Tracking
from recon.tracks import Track


@dataclass(frozen=True)
class Followed:
    """n pairs of frames, tracked."""

    track: Track
    reasons: tuple[str | None, ...]  # n; None where the target was found
    trackings: tuple[Tracking, ...]  # n


def follow(tracker: Tracker, frames: Iterable[tuple[int, NDArray, NDArray]]) -> Followed:
    """Track pairs of frames: time in ns, camera 1's image, camera 2's image, in order of time."""
    times, trackings = [], []
    for time_ns, left, right in frames:
        times.append(time_ns)
        trackings.append(tracker.step(left, right, time_ns * 1e-9))
    return gathered(np.array(times, np.int64), trackings)


def gathered(times: NDArray[np.int64], trackings: list[Tracking]) -> Followed:
    """A track of what a tracker said at times : (n,) ns."""
    poses = np.array([each.pose.world_from_target for each in trackings]).reshape(-1, 4, 4)
    covariance = np.array([each.pose.covariance for each in trackings]).reshape(-1, 6, 6)
    return Followed(Track(times, poses, covariance), tuple(each.pose.reason for each in trackings), tuple(trackings))
