"""What is published: a scene that stands still, and moments; and a thread a publisher, so that none waits for another."""

import logging
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from threading import Lock, Thread
from time import monotonic_ns
from typing import Protocol

import numpy as np
import trimesh
from numpy.typing import NDArray

from recon.errors import InputError
from recon.model.tip import Tip
from recon.navigation.mass_distances import MassDistance
from recon.navigation.newest import Newest
from recon.navigation.placed_scans import PlacedScan
from recon.navigation.seen_so_far import SeenSoFar
from recon.navigation.tool_distances import TipFigures

log = logging.getLogger(__name__)
Array = NDArray[np.float64]
WAIT_S = 0.2  # for a moment, before looking whether to end


@dataclass(frozen=True, eq=False)
class StillScene:
    """What is known before, in the world, but for the probe and the tools, which are in their targets' frames."""

    target_from_image: Array  # (4, 4), mm
    skin: trimesh.Trimesh | None = None
    masses: Mapping[str, trimesh.Trimesh] = field(default_factory=dict)
    probe: trimesh.Trimesh | None = None
    circles: trimesh.Trimesh | None = None  # of the target
    tools: Mapping[str, Tip | None] = field(default_factory=dict)  # by the body's name; None of one whose tip isn't calibrated
    shapes: Mapping[str, trimesh.Trimesh] = field(default_factory=dict)  # of the tools
    plan: Array | None = None  # (2, 3) mm, the planned path's entry and aim


@dataclass(frozen=True)
class Latency:
    """Figures of the last ten seconds."""

    median_ms: float
    high_ms: float  # 99 of 100 are below
    rate_hz: float


@dataclass(frozen=True)
class BodyAt:
    """A body besides the probe at a moment."""

    name: str
    state: str  # of tracking: how it was found, or why it wasn't
    world_from_body: Array | None = None  # (4, 4) mm; None where it isn't known
    camera_from_body: Array | None = None  # (4, 4) mm, as the cameras see it, wherever the patient is
    figures: TipFigures | None = None  # of a tool whose tip is calibrated


@dataclass(frozen=True)
class Moment:
    """All that is known at one pair of frames."""

    number: int
    exposed_ns: int  # monotonic time of the frames
    world_from_target: Array | None  # (4, 4), mm; None where it isn't found
    state: str  # of tracking: how it was found, or why it wasn't
    scan: PlacedScan | None = None  # the newest, which may be that of an earlier moment
    distances: tuple[MassDistance, ...] = ()  # of that B-scan
    troubles: tuple[str, ...] = ()  # of devices, a line each
    latency: Latency | None = None  # of the moments before
    bodies: tuple[BodyAt, ...] = ()  # besides the probe
    frame_ns: int | None = None  # of camera 1's frame, by its own clock; None without frames
    seen: SeenSoFar | None = None  # of the B-scans before; None where it isn't mapped

    @property
    def places_any(self) -> bool:
        """Whether the probe or another body is placed."""
        return self.world_from_target is not None or any(body.world_from_body is not None for body in self.bodies)

    @property
    def status(self) -> str:
        """One line for whoever watches."""
        parts = [self.state, *self.troubles]
        if self.latency is not None:
            figures = self.latency
            parts.append(f"{figures.rate_hz:.0f} a second, {figures.median_ms:.0f} ms late, 99 % below {figures.high_ms:.0f} ms")
        return "; ".join(parts)


class Publisher(Protocol):
    """Whatever shows or sends moments; used by one thread."""

    name: str

    def publish(self, moment: Moment) -> None:
        """Show or send a moment."""

    def close(self) -> None:
        """End."""


@dataclass
class Latencies:
    """Times at which things were exposed and published."""

    _pairs: deque[tuple[int, int]] = field(default_factory=deque)
    _lock: Lock = field(default_factory=Lock)

    def add(self, exposed_ns: int, published_ns: int) -> None:
        """Take in one, by monotonic times."""
        remembered_ns = 10_000_000_000
        with self._lock:
            self._pairs.append((exposed_ns, published_ns))
            while self._pairs[0][1] < published_ns - remembered_ns:
                self._pairs.popleft()

    def figures(self) -> Latency | None:
        """Median, 99 %, and number a second; None of less than two."""
        with self._lock:
            pairs = np.array(self._pairs, np.int64).reshape(-1, 2)
        fewest = 2  # of which figures are made
        if len(pairs) < fewest or pairs[-1, 1] <= pairs[0, 1]:
            return None
        median, high = np.percentile((pairs[:, 1] - pairs[:, 0]) * 1e-6, [50, 99])
        return Latency(float(median), float(high), (len(pairs) - 1) / float(pairs[-1, 1] - pairs[0, 1]) * 1e9)


@dataclass
class Outlet:
    """Gives a publisher the newest moment whenever it is done with the last, from a thread of its own."""

    publisher: Publisher
    latencies: Latencies = field(default_factory=Latencies)  # from exposure to the end of `publish`
    scans: Latencies = field(default_factory=Latencies)  # the same of each B-scan's first moment
    newest: Newest[Moment] = field(default_factory=Newest)
    _ended: bool = False
    _thread: Thread | None = None

    def start(self) -> None:
        """Begin."""
        self._thread = Thread(target=self._run, name=f"to {self.publisher.name}", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """End, and close the publisher."""
        self._ended = True
        self.newest.close()  # what is left in it is still published
        if self._thread is not None:
            self._thread.join()
        self.publisher.close()

    @property
    def alive(self) -> bool:
        """Whether it goes on."""
        return self._thread is not None and self._thread.is_alive()

    def _run(self) -> None:
        try:
            self._publish_all()
        except InputError as error:  # such as a B-scan larger than a message may be
            log.error("%s: %s; navigation ends", self.publisher.name, error)

    def _publish_all(self) -> None:
        shown = None
        while True:
            moment = self.newest.take(WAIT_S)
            if moment is None:
                if self._ended:
                    return
                continue
            self.publisher.publish(moment)
            now = monotonic_ns()
            if moment.places_any:
                self.latencies.add(moment.exposed_ns, now)
            if moment.scan is not None and moment.scan is not shown:
                shown = moment.scan
                self.scans.add(moment.scan.taken_ns, now)
