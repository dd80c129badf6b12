"""The navigator: frames of both cameras and B-scans in, moments out, as they come.

A feed a device, a thread that tracks, a thread a publisher. Between them stands one place for the newest thing, never a queue:
where something is slow, what is shown is less often new, but never older.
"""

from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from threading import Event, Thread
from time import monotonic_ns

import numpy as np

from recon.geometry import rigid
from recon.model.probe import ProbeCalibration
from recon.navigation import mass_distances
from recon.navigation.feeds import Device, Feed
from recon.navigation.frame_pairs import FramePair, Pairing
from recon.navigation.mass_distances import Body, MassDistance
from recon.navigation.moving_bodies import MovingBodies, Placed, state_of
from recon.navigation.newest import Every, Newest
from recon.navigation.placed_scans import PlacedScan, ScanPlacing
from recon.navigation.publishing import BodyAt, Moment, Outlet, Publisher
from recon.navigation.seen_so_far import Mapper, SeenSoFar
from recon.tracking.bodies import BodyTracker
from recon.tracking.tracker import Tracker, Tracking

NO_POSE = np.full((4, 4), np.nan)
FACING = rigid.transform(np.diag([1.0, -1.0, -1.0]), [0.0, 0.0, 650.0])  # a target before camera 1


def warm_up(tracker: Tracker | BodyTracker) -> None:
    """Run all that a tracker's first frames need once, on dark ones: it may have to be compiled, which takes some seconds."""
    each = list(tracker.trackers.values()) if isinstance(tracker, BodyTracker) else [tracker]
    left, right = (np.zeros(camera.size[::-1], np.uint8) for camera in each[0].cameras)
    for one in each:
        one.remember(FACING, 0.0)
    tracker.step(left, right, 0.01)
    tracker.forget()


@dataclass
class Navigator:
    """Follows the probe live, and further bodies. `start`, then `stop`; the first publisher's latency is the one that is told."""

    cameras: tuple[Device, Device]
    scanner: Device | None
    tracker: Tracker | BodyTracker
    probe: ProbeCalibration
    lag_s: float
    bodies: dict[str, Body]
    publishers: Sequence[Publisher]
    again_s: float = 1.0  # until a device that was lost is opened again
    moving: MovingBodies = field(default_factory=lambda: MovingBodies({}))  # of a tracker of several bodies
    recorders: Sequence[Publisher] = ()  # that get every moment
    mapper: Mapper | None = None  # of what was seen
    outlets: list[Outlet] = field(init=False)
    feeds: list[Feed] = field(init=False)
    pairs: Newest[FramePair] = field(default_factory=Newest, init=False)
    _stopped: Event = field(default_factory=Event, init=False)
    _thread: Thread | None = field(default=None, init=False)

    def __post_init__(self) -> None:
        pairing = Pairing(self.pairs)
        self._placing = ScanPlacing(self.probe, self.lag_s)
        self.outlets = [Outlet(publisher) for publisher in self.publishers]
        self.outlets += [Outlet(recorder, newest=Every()) for recorder in self.recorders]
        self.feeds = [
            Feed(self.cameras[0], lambda arrival: pairing.add(0, arrival), self.again_s),
            Feed(self.cameras[1], lambda arrival: pairing.add(1, arrival), self.again_s),
        ]
        if self.scanner is not None:
            self.feeds.append(Feed(self.scanner, self._placing.add_scan, self.again_s))

    def start(self) -> None:
        """Open the devices, and begin."""
        for each in self._threads:
            each.start()
        self._thread = Thread(target=self._run, name="tracking", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """End all threads, and give devices and publishers back, each whatever befalls the others."""
        self._stopped.set()
        self.pairs.close()
        with ExitStack() as stack:
            for each in self._threads:
                stack.callback(each.stop)
            if self._thread is not None:
                self._thread.join()

    @property
    def _threads(self) -> list[Outlet | Feed | Mapper]:
        return [*self.outlets, *self.feeds, *([] if self.mapper is None else [self.mapper])]

    @property
    def running(self) -> bool:
        """Whether all of it goes on; a part that has ended by itself has a fault, which it has told."""
        return self._thread is not None and self._thread.is_alive() and all(each.alive for each in (*self.feeds, *self.outlets))

    def _run(self) -> None:
        number, scan, distances = 0, None, ()
        stale_ns = 500_000_000  # beyond the lag, after which a B-scan is shown no more
        wait_s = 0.5  # for a pair of frames, until it is told that there are none
        while True:
            pair = self.pairs.take(wait_s)
            if self._stopped.is_set():
                return
            if pair is None:
                why, troubles = "no frames of both cameras", self._troubles()
                self._publish(Moment(number, monotonic_ns(), None, why, troubles=troubles, seen=self._seen))
                continue
            number += 1
            found = self.tracker.step(pair.left.frame.image, pair.right.frame.image, pair.exposed_ns * 1e-9)
            placed = self._placed(found, pair.exposed_ns)
            self._placing.add_pose(pair.exposed_ns, NO_POSE if placed.world_from_target is None else placed.world_from_target)
            if (newer := self._placing.newest()) is not None:
                scan, distances = newer, mass_distances.distances(self.bodies, newer)
                if self.mapper is not None:
                    self.mapper.add(newer)
            elif scan is not None and pair.exposed_ns - scan.taken_ns > stale_ns + self.lag_s * 1e9:
                scan, distances = None, ()
            bodies = self.moving.measure(placed, scan)
            self._publish(self._moment(number, pair, placed, scan, distances, bodies))

    def _placed(self, found: Tracking | dict[str, Tracking], exposed_ns: int) -> Placed:
        if isinstance(found, dict):
            return self.moving.place(found, exposed_ns)
        return Placed(found.pose.world_from_target if found.found else None, state_of(found))

    def _moment(
        self,
        number: int,
        pair: FramePair,
        placed: Placed,
        scan: PlacedScan | None,
        distances: tuple[MassDistance, ...],
        bodies: tuple[BodyAt, ...],
    ) -> Moment:
        pose, state = placed.world_from_target, placed.state
        latency = self.outlets[0].latencies.figures() if self.outlets else None
        frame_ns = pair.left.frame.time_ns
        known = self._troubles(), latency, bodies, frame_ns, self._seen
        return Moment(number, pair.exposed_ns, pose, state, scan, distances, *known)

    @property
    def _seen(self) -> SeenSoFar | None:
        return None if self.mapper is None else self.mapper.newest

    def _troubles(self) -> tuple[str, ...]:
        return tuple(feed.trouble for feed in self.feeds if feed.trouble is not None)

    def _publish(self, moment: Moment) -> None:
        for outlet in self.outlets:
            outlet.newest.put(moment)
