"""B-scans in place: each where the probe was when it was taken, by poses that may have come later."""

from collections import deque
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from recon.freehand import sequences
from recon.geometry import rigid
from recon.model import tracks
from recon.model.probe import ProbeCalibration
from recon.model.tracks import Track
from recon.navigation.feeds import Arrival

Array = NDArray[np.float64]

WAITING = 8  # B-scans whose pose isn't known yet


@dataclass(frozen=True)
class PlacedScan:
    """A B-scan in the world."""

    image: NDArray[np.uint8]  # (h, w), read-only
    number: int  # as the scanner counts
    taken_ns: int  # monotonic time, without the scanner's lag
    world_from_pixel: Array  # (4, 4)

    @property
    def corners(self) -> Array:
        """Centres of the corner pixels : (4, 3) mm, from (0, 0) on clockwise."""
        right, bottom = self.image.shape[1] - 1, self.image.shape[0] - 1
        return rigid.apply(self.world_from_pixel, [[0, 0, 0], [right, 0, 0], [right, bottom, 0], [0, bottom, 0]])


@dataclass
class ScanPlacing:
    """The last poses, and the B-scans that wait for theirs. B-scans may come from another thread than poses."""

    probe: ProbeCalibration
    lag_s: float  # by which the scanner's time stamps are late
    _times: deque[int] = field(default_factory=deque)
    _poses: deque[Array] = field(default_factory=deque)
    _waiting: deque[Arrival] = field(default_factory=lambda: deque(maxlen=WAITING))

    def add_scan(self, arrival: Arrival) -> None:
        """Take in a B-scan."""
        self._waiting.append(arrival)

    def add_pose(self, exposed_ns: int, world_from_target: Array) -> None:
        """Take in a pose : (4, 4) mm of a monotonic time, or NaN where the target wasn't found."""
        if self._times and exposed_ns <= self._times[-1]:  # a camera's clock was set back
            self._times.clear()
            self._poses.clear()
        self._times.append(exposed_ns)
        self._poses.append(world_from_target)
        remembered_ns = 2_000_000_000  # of poses, more than any scanner's lag and its frames' delay
        while self._times[0] < exposed_ns - remembered_ns:
            self._times.popleft()
            self._poses.popleft()

    def newest(self) -> PlacedScan | None:
        """The newest B-scan, not given before, between two known poses; None without. Those before it are left out."""
        if not self._times:
            return None
        waiting = list(self._waiting)
        taken = np.array([arrival.exposed_ns - round(self.lag_s * 1e9) for arrival in waiting], np.int64)
        poses = tracks.at(Track(np.array(self._times), np.stack(self._poses)), taken)
        known = np.flatnonzero(np.isfinite(poses).all(axis=(1, 2)))
        if not len(known):
            return None
        k = int(known[-1])
        while self._waiting and self._waiting.popleft() is not waiting[k]:
            pass
        placed = poses[k] @ sequences.target_from_pixel(self.probe)
        return PlacedScan(waiting[k].frame.image, waiting[k].frame.number, int(taken[k]), placed)
