"""A sweep before the virtual devices: both cameras film the target while the scanner takes B-scans, each at its own moments.

A hand leads the probe along the path of `twin.filmed_sweep`. Frames are rendered as they are asked for, so a sweep takes longer
than in life; its time stamps are those of the moments that were rendered.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from time import sleep

from numpy.typing import NDArray

from recon.capture.manifest import CAMERAS, SCANNER, Device
from recon.devices.interfaces import DeviceError, Frame, Size, Trigger
from twin.devices.virtual_clock import Turns
from twin.devices.virtual_rig import TRANSFER_NS
from twin.filmed_sweep import PlannedSweep
from twin.tracking.sampling_ranges import DataRanges

PAIR = "cameras"


@dataclass(frozen=True)
class FramePair:
    """Frames of both cameras of one moment."""

    frames: tuple[Frame, Frame]
    apart_ns: int = 0  # one wire triggers both
    lost: tuple[str, ...] = ()


class VirtualPair:
    """Both cameras, triggered by one wire, before a hand that leads the probe."""

    def __init__(self, planned: PlannedSweep, ranges: DataRanges, turns: Turns) -> None:
        self._planned, self._ranges, self._turns = planned, ranges, turns
        self._moments = planned.plan.track.times.tolist()
        self._frames: Iterator[tuple[NDArray, NDArray]] | None = None
        self._taken = 0

    def devices(self) -> Mapping[str, Device]:
        """Both cameras as they are set."""
        frames, rig = self._planned.settings.frames, self._planned.settings.rig
        return {
            name: Device(size=getattr(rig, name).optics.size, exposure_s=frames.exposure_s, gain=frames.gain) for name in CAMERAS
        }

    @property
    def over(self) -> bool:
        """Whether the hand has come to the path's end."""
        return self._taken >= len(self._moments)

    def start(self, trigger: Trigger, second: Trigger | None = None) -> None:
        """Begin to take pairs."""
        self._frames, self._taken = self._film(), 0
        self._turns.set_next(PAIR, self._moments[0])

    def pair(self, timeout_s: float) -> FramePair | None:
        """Wait for the next pair; None if none is due in time, as after the path's end."""
        if self._frames is None:
            raise DeviceError("cameras: expected ones that were started, found them at rest")
        if self.over:
            sleep(timeout_s)
            return None
        if not self._turns.wait(PAIR, timeout_s):
            return None
        images, moment = next(self._frames), self._moments[self._taken]
        arrived = moment + round(0.5e9 * self._planned.settings.frames.exposure_s) + TRANSFER_NS
        first, second = (Frame(_locked(image), self._taken, moment, arrived) for image in images)
        self._taken += 1
        self._turns.advance(PAIR, arrived, None if self.over else self._moments[self._taken])
        return FramePair((first, second))

    def rest(self) -> tuple[FramePair, ...]:
        """Pairs that still wait, which are none."""
        return ()

    def stop(self) -> tuple[str, ...]:
        """Take no more frames; names those lost, which are none."""
        self._frames = None
        self._turns.set_next(PAIR, None)
        return ()

    def close(self) -> None:
        """Give the cameras back."""
        self.stop()

    def _film(self) -> Iterator[tuple[NDArray, NDArray]]:
        for frames in self._planned.film(self._ranges).frames():
            yield frames.views


class VirtualScanner:
    """The scanner, as `recon.acquisition.sweep_recording.ScanSource`: its stamps are late, and jitter, as the plan has them."""

    def __init__(self, planned: PlannedSweep, turns: Turns) -> None:
        self.name = SCANNER
        self.size: Size = tuple(planned.settings.ultrasound.image_size)
        self._turns, self._scans = turns, planned.scans()
        self._stamps, self._moments = planned.plan.times.tolist(), planned.plan.truth.times.tolist()
        self._taken = 0
        turns.set_next(SCANNER, self._moments[0])

    @property
    def over(self) -> bool:
        """Whether the path has come to its end."""
        return self._taken >= len(self._moments)

    def frame(self, timeout_s: float) -> Frame | None:
        """Wait for the next B-scan : (h, w) uint8; None if none is due in time, as after the path's end."""
        if self.over:
            sleep(timeout_s)
            return None
        if not self._turns.wait(SCANNER, timeout_s):
            return None
        image, stamp = next(self._scans).image, self._stamps[self._taken]
        arrived = max(stamp, self._moments[self._taken]) + TRANSFER_NS
        frame = Frame(_locked(image), self._taken, stamp, arrived)
        self._taken += 1
        self._turns.advance(SCANNER, arrived, None if self.over else self._moments[self._taken])
        return frame

    def rest(self) -> tuple[Frame, ...]:
        """B-scans that still wait, which are none."""
        return ()

    def close(self) -> None:
        """Give the scanner back."""
        self._taken = len(self._moments)
        self._turns.set_next(SCANNER, None)


def _locked(image: NDArray) -> NDArray:
    image.setflags(write=False)
    return image
