"""What is kept of tracked pairs of frames, a kilobyte each, and the track that they make."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from recon.tracking.tracker import Tracking
from recon.tracks import Track

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Step:
    """A pair of frames, tracked: without its images and rims."""

    time_ns: int
    world_from_target: Array  # (4, 4) mm; NaN if it wasn't found
    covariance: Array  # (6, 6), as in tracks.Track
    how: str | None  # as of Tracking
    reason: str | None  # None where the target was found
    blur_px: tuple[float, float]  # the longest of each view
    seconds: float  # that it took

    @property
    def found(self) -> bool:
        """Whether there is a pose."""
        return self.reason is None

    @property
    def sigmas(self) -> tuple[float, float]:
        """Predicted standard deviations, over all directions: mm and deg; NaN without a pose."""
        turn, shift = (float(np.sqrt(np.trace(self.covariance[part, part]))) for part in (slice(0, 3), slice(3, 6)))
        return shift, float(np.rad2deg(turn))


def kept(found: Tracking, time_ns: int) -> Step:
    """What is kept of a pair."""
    pose, (first, second) = found.pose, found.views
    blurs = float(np.fmax.reduce(first.blur_px)), float(np.fmax.reduce(second.blur_px))
    return Step(time_ns, pose.world_from_target, pose.covariance, found.how, pose.reason, blurs, sum(found.seconds.values()))


def track_of(steps: Sequence[Step]) -> Track:
    """The track that n pairs make, in order of time."""
    return Track(
        np.array([step.time_ns for step in steps], np.int64),
        np.array([step.world_from_target for step in steps]).reshape(-1, 4, 4),
        np.array([step.covariance for step in steps]).reshape(-1, 6, 6),
    )
