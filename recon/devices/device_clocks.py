"""Times of a device's clock as times of this computer's, found from the moments at which its frames arrive.

A frame arrives later than it was taken, by the time of its transfer and, now and then, by much more: the operating system was
busy, the bus was shared. So only the fastest frames show the clock. They lie on the lower edge of arrival over device time, a
straight line whose slope is the quotient of two crystals, and which holds until the device's clock is set anew.
"""

import logging
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from recon.devices.interfaces import Camera, DeviceError, Scanner

LOG = logging.getLogger(__name__)
FEWEST = 8  # frames for a first map while more come, and of a block
BLOCKS = 12  # in each the fastest frame counts
WINDOW = 512  # frames that are looked back on: some seconds, in which a crystal's rate stays as it is
LATE = 64  # frames in a row that come late, most of them by the same time: no accident


@dataclass(frozen=True)
class ClockMap:
    """A device's clock beside this computer's monotonic one: a straight line, best known at `device_ns`.

    Of a device whose clock can't be read, the times are those at which the fastest frames arrive: later than the exposures by
    the least transfer.
    """

    device_ns: int
    computer_ns: int  # the same moment by this computer's clock
    rate: float  # of this computer's clock by the device's
    sigma_ns: float  # of `computer_ns`
    rate_sigma: float

    def at(self, device_ns: int) -> int:
        """Time in ns of this computer's clock at a time of the device's."""
        ahead = device_ns - self.device_ns
        return self.computer_ns + ahead + round((self.rate - 1) * ahead)  # a float holds a clock's time to some 100 ns only

    def back(self, computer_ns: int) -> int:
        """Time in ns of the device's clock at a time of this computer's."""
        ahead = computer_ns - self.computer_ns
        return self.device_ns + ahead + round((1 / self.rate - 1) * ahead)

    def sigma_at(self, device_ns: int) -> float:
        """Standard deviation in ns of `at`."""
        return float(np.hypot(self.sigma_ns, self.rate_sigma * (device_ns - self.device_ns)))


@dataclass(frozen=True)
class ClockReading:
    """A device's clock, read on demand between two readings of this computer's."""

    device_ns: int
    before_ns: int
    after_ns: int


@dataclass(frozen=True)
class Jump:
    """A device's clock that was set anew."""

    device: str
    device_ns: int  # first time after it
    step_ns: int  # by which the clock went forward

    def __str__(self) -> str:
        return f"{self.device}: its clock jumped by {self.step_ns / 1e9:+.3f} s; times before and after don't belong together"


def fit_clock(device_ns: NDArray[np.int64], arrived_ns: NDArray[np.int64]) -> ClockMap:
    """Map a device's clock by the lower edge of arrivals.

    The frames are cut into blocks; the one that comes first for its time speaks for its block. A straight line goes through
    those, its rate held near 1 as far as a short time leaves it open. That they, too, are late is corrected as if delays fell
    off exponentially, by their mean over a block's size. Since the law of the delays isn't known, the standard deviation of the
    offset is that correction and the scatter of the blocks together; with fewer than four blocks, a whole delay; of a single
    frame, whose delay nothing shows, infinite.

    Parameters
    ----------
    device_ns, arrived_ns : (n,) int64, ns
        Times of frames by the device's clock, rising, and arrivals by this computer's; n >= 1.

    Raises
    ------
    ValueError
        If there are none, or the device's clock stands still.

    Source: lower envelopes for clocks over networks: Paxson 1998 (fastest packets of segments); the mean smallest of n
    exponential delays is their mean over n.
    """
    if len(device_ns) == 0:
        raise ValueError("device_ns: expected a time or more, found none")
    reference, arrival = int(device_ns[len(device_ns) // 2]), int(arrived_ns[len(device_ns) // 2])
    times = np.float64(device_ns - reference)
    if len(times) > 1 and times[-1] <= times[0]:
        raise ValueError("device_ns: expected rising times, found a clock that stands still")
    delays = np.float64(arrived_ns - arrival) - times
    blocks = np.array_split(np.arange(len(times)), min(BLOCKS, max(len(times) // FEWEST, 1)))
    fastest = np.array([block[np.argmin(delays[block])] for block in blocks])
    at, least = times[fastest], delays[fastest]
    middle = at.mean()
    spread = np.sum((at - middle) ** 2)
    fewest_blocks = 4  # for a rate
    enough = len(at) >= fewest_blocks
    slope = np.sum((at - middle) * least) / spread if enough else 0.0
    residuals = least - least.mean() - slope * (at - middle)
    scatter = float(np.sqrt(np.sum(residuals**2) / max(len(at) - 2, 1)))
    typical = float(np.median(delays - least.mean() - slope * (times - middle))) / np.log(2)  # mean of an exponential law
    late = typical * len(blocks) / len(times)  # of a block's fastest frame
    sigma = max(late, scatter)
    crystal = 1e-4  # standard deviation of a rate about 1; quartz oscillators are within some tens of parts in a million
    held = spread / (spread + (sigma / crystal) ** 2) if enough else 0.0  # weight of the blocks beside what crystals do
    lowest = least.mean() - late
    return ClockMap(
        reference + round(middle),
        arrival + round(middle + lowest),
        1 + held * slope,
        late + scatter if enough else typical if len(times) > 1 else np.inf,
        crystal * float(np.sqrt(1 - held)),
    )


def least_transfer(edge: ClockMap, readings: Sequence[ClockReading]) -> tuple[float, float]:
    """Time from exposure to arrival of the fastest frames, and its standard deviation, in ns.

    Of several readings of the device's clock, that counts which took the shortest time. Its moment lies anywhere between this
    computer's two readings: their middle is off by their distance / sqrt(12).
    """
    best = min(readings, key=lambda one: one.after_ns - one.before_ns)
    width = best.after_ns - best.before_ns
    transfer = edge.at(best.device_ns) - best.before_ns - width / 2
    return transfer, float(np.hypot(edge.sigma_at(best.device_ns), width / np.sqrt(12)))


class ClockFollower:
    """Follows a device's clock from frame to frame, and names jumps; used by one thread at a time.

    A clock that was set forward shows at once: a frame arrives before it was taken. One that was set back looks like a late
    frame at first, and is believed when many frames in a row are late by the same time; a frame whose time isn't after that of
    the one before leaves no doubt. Steps below `least_jump_s` can't be told from a transfer that became slower or faster.
    """

    def __init__(self, device: str, read: Callable[[], ClockReading | None] | None = None, least_jump_s: float = 0.005) -> None:
        """Begin without a map.

        Parameters
        ----------
        device : str
            Its name in messages.
        read : () -> ClockReading, optional
            Reads the device's clock; called some times when the first frames are there.
        least_jump_s : float
            Smallest step that counts as one.
        """
        self.device = device
        self.clock: ClockMap | None = None  # None before the first frames
        self._read = read
        self._least_ns = round(1e9 * least_jump_s)
        self._edge: ClockMap | None = None  # `clock` with the least transfer in it
        self._transfer: tuple[float, float] = 0.0, 0.0  # and its standard deviation, ns
        self._readings: list[ClockReading] = []
        self._frames = deque[tuple[int, int]](maxlen=WINDOW)  # device time, arrival
        self._late = deque[tuple[int, int]](maxlen=LATE)
        self._until_fit = FEWEST

    def add(self, device_ns: int, arrived_ns: int) -> Jump | None:
        """Take the next frame's times; a jump if the clock has been set anew just before it, or some frames ago."""
        last = max((times[-1] for times in (self._frames, self._late) if times), key=lambda one: one[1], default=None)
        if last is not None and device_ns <= last[0]:
            return self._begin_anew([(device_ns, arrived_ns)], device_ns - last[0] - (arrived_ns - last[1]))
        if self._edge is None:
            self._take(device_ns, arrived_ns)
            return None
        delay = arrived_ns - self._edge.at(device_ns)
        doubt = self._least_ns + 5 * self._edge.sigma_at(device_ns)
        if delay < -doubt:
            return self._begin_anew([(device_ns, arrived_ns)], device_ns - self._edge.back(arrived_ns))
        if delay > doubt:
            self._late.append((device_ns, arrived_ns))
            return self._set_back(self._edge)
        self._late.clear()
        self._take(device_ns, arrived_ns)
        return None

    def clock_of_few(self) -> ClockMap | None:
        """The clock by the frames so far, however few, where no more will come; None if there are none.

        Of a device that is gone and whose clock wasn't read before, the least transfer stays in it.
        """
        if self.clock is not None or not self._frames:
            return self.clock
        edge = self._fit()
        try:
            return self._without_transfer(edge)
        except DeviceError as gone:
            LOG.debug("%s: its clock can't be read: %s", self.device, gone)
            return edge

    def _take(self, device_ns: int, arrived_ns: int) -> None:
        self._frames.append((device_ns, arrived_ns))
        self._until_fit -= 1
        refit = 16  # frames between two fits
        if self._until_fit <= 0:
            self._edge = self._fit()
            self.clock = self._without_transfer(self._edge)
            self._until_fit = refit if len(self._frames) > 2 * refit else FEWEST // 2

    def _fit(self) -> ClockMap:
        device, arrived = np.array(self._frames, np.int64).T
        return fit_clock(device, arrived)

    def _without_transfer(self, edge: ClockMap) -> ClockMap:
        """Take the least transfer out, by readings of the first moments; it is held when the window is full, or after a jump."""
        readings = 8  # of a device's clock, of which the fastest counts
        if self._read is not None:
            self._readings = [reading for reading in (self._read() for _ in range(readings)) if reading is not None]
            self._read = None
        if self._readings:
            self._transfer = least_transfer(edge, self._readings)
        if len(self._frames) == WINDOW:
            self._readings = []
        transfer, sigma = self._transfer
        return replace(edge, computer_ns=edge.computer_ns - round(transfer), sigma_ns=float(np.hypot(edge.sigma_ns, sigma)))

    def _set_back(self, clock: ClockMap) -> Jump | None:
        """Jump if most of the late frames are late by the same time; under load, they differ by much more."""
        if len(self._late) < LATE:
            return None
        steps = np.array([device - clock.back(arrived) for device, arrived in self._late])
        fastest = int(steps.max())
        if fastest - np.median(steps) > self._least_ns:
            return None
        return self._begin_anew(list(self._late), fastest)

    def _begin_anew(self, frames: list[tuple[int, int]], step_ns: int) -> Jump:
        jump = Jump(self.device, frames[0][0], step_ns)
        if self.clock:  # a device without a clock jumps with each frame
            LOG.warning("%s", jump)
        self._frames.clear()
        self._late.clear()
        self.clock = self._edge = None
        self._readings = []
        self._until_fit = FEWEST
        for device_ns, arrived_ns in frames:
            self._take(device_ns, arrived_ns)
        return jump


def follow(device: Camera | Scanner) -> ClockFollower:
    """Follower of a device's clock, which reads that clock if the device offers `read_clock`."""
    return ClockFollower(device.name, getattr(device, "read_clock", None))
