"""Sightings of the skin: camera 1's pictures, each with where the skin was in it, as they come.

The skin is where it was measured, or where the patient's target has carried it since.
"""

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from threading import Event, Thread
from time import monotonic_ns

import numpy as np
from numpy.typing import NDArray

from recon.devices.interfaces import Image
from recon.geometry import rigid
from recon.model.rig import PATIENT
from recon.navigation.feeds import Arrival, Device, Feed
from recon.navigation.frame_pairs import FramePair, Pairing
from recon.navigation.newest import Newest
from recon.tracking.bodies import BodyTracker

Array = NDArray[np.float64]
WAIT_S = 0.2  # for frames, before it is told that there are none


@dataclass(frozen=True, eq=False)
class Sighting:
    """A picture of camera 1, and where the skin was in it."""

    number: int
    exposed_ns: int  # monotonic time of the exposure's middle
    image: Image | None  # (h, w); None where no frames came
    world_from_skin: Array | None  # (4, 4) mm; None where that isn't known
    reason: str = ""  # why it isn't


Follow = Callable[[FramePair], tuple[Array | None, str]]  # where the skin is in a pair of frames, or why that isn't known


def by_patient(tracker: BodyTracker, world_from_patient: Array | None) -> Follow:
    """The skin's place by the patient's target.

    Parameters
    ----------
    tracker : of the patient, and of any other bodies
    world_from_patient : (4, 4) mm, when the skin was measured; None for the first pose that is found
    """
    patient_from_skin = None if world_from_patient is None else rigid.invert(world_from_patient)

    def follow(pair: FramePair) -> tuple[Array | None, str]:
        nonlocal patient_from_skin
        found = tracker.step(pair.left.frame.image, pair.right.frame.image, pair.exposed_ns * 1e-9)[PATIENT]
        if not found.found:
            return None, f"the {PATIENT} isn't found: {found.pose.reason}"
        if patient_from_skin is None:
            patient_from_skin = rigid.invert(found.pose.world_from_target)
        return found.pose.world_from_target @ patient_from_skin, ""

    return follow


@dataclass
class Sightings:
    """Takes frames of camera 1, or pairs of both cameras where the patient is followed, and hands sightings on."""

    cameras: Sequence[Device]  # camera 1, or both where `follow` is given
    follow: Follow | None
    deliver: Callable[[Sighting], None]  # from a thread of its own
    again_s: float = 1.0  # until a device that was lost is opened again
    feeds: list[Feed] = field(init=False)
    _pairs: Newest[FramePair] = field(default_factory=Newest, init=False)
    _ended: Event = field(default_factory=Event, init=False)
    _thread: Thread | None = field(default=None, init=False)

    def __post_init__(self) -> None:
        if self.follow is None:
            self.feeds = [Feed(self.cameras[0], self._alone, self.again_s)]
            return
        pairing = Pairing(self._pairs)
        self.feeds = [
            Feed(self.cameras[0], lambda arrival: pairing.add(0, arrival), self.again_s),
            Feed(self.cameras[1], lambda arrival: pairing.add(1, arrival), self.again_s),
        ]

    def start(self) -> None:
        """Open the cameras, and begin."""
        for feed in self.feeds:
            feed.start()
        self._thread = Thread(target=self._run, name="sightings", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """End all threads, and give the cameras back."""
        self._ended.set()
        self._pairs.close()
        with ExitStack() as stack:
            for feed in self.feeds:
                stack.callback(feed.stop)
            if self._thread is not None:
                self._thread.join()

    @property
    def running(self) -> bool:
        """Whether all of it goes on."""
        return self._thread is not None and self._thread.is_alive() and all(feed.alive for feed in self.feeds)

    def _alone(self, arrival: Arrival) -> None:
        self._pairs.put(FramePair(arrival, arrival))

    def _run(self) -> None:
        number = 0
        while not self._ended.is_set():
            pair = self._pairs.take(WAIT_S)
            number += 1
            if pair is None:
                troubles = [feed.trouble for feed in self.feeds if feed.trouble is not None]
                reason = "; ".join(troubles) or "no frames of both cameras together" * (self.follow is not None)
                self.deliver(Sighting(number, monotonic_ns(), None, None, reason or "no frames"))
            else:
                place, reason = (np.eye(4), "") if self.follow is None else self.follow(pair)
                self.deliver(Sighting(number, pair.exposed_ns, pair.left.frame.image, place, reason))
