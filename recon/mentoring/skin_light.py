"""Light on a skin that moves: for each sighting the projector's picture is drawn anew.

A skin whose patient is followed is lit where the patient was last seen for a moment more, as a hand may cover the target; then
the projector goes dark. A skin that isn't followed is lit where it was measured.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from threading import Thread
from time import monotonic_ns, thread_time
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from recon.errors import InputError
from recon.mentoring.drawings import Drawings
from recon.mentoring.sightings import Sighting
from recon.navigation.newest import Newest
from recon.navigation.publishing import Latencies
from recon.skin_projection.live_picture import LivePicture, Strips

Array = NDArray[np.float64]
Image = NDArray[np.uint8]
LOOK_S = 0.05  # between looks whether it must go dark
STILL_S = 0.2  # between two showings of a picture that is the same
SILENT_S = 1.0  # without a picture of camera 1, which is told


class Shows(Protocol):
    """Whatever shows pictures: a projector, or a file."""

    def show(self, pattern: Image, /) -> Any:
        """Show a picture : (h, w)."""


class State(NamedTuple):
    """What is lit."""

    lit: bool
    words: str  # of where it is lit, or why it is dark


UNSEEN = State(False, "dark: nothing seen yet")


@dataclass
class SkinLight:
    """Draws and shows, from a thread of its own."""

    picture: LivePicture
    still: Strips  # of masses and cuts
    drawings: Drawings
    projector: Shows
    hold_s: float | None  # how long a place of the skin holds; None where nothing moves it
    delay_s: float = 0.0  # from `show` to light
    clock: Callable[[], int] = monotonic_ns
    sightings: Newest[Sighting] = field(default_factory=Newest)
    latencies: Latencies = field(default_factory=Latencies)  # from exposure to light, of pictures for a new place
    state: State = UNSEEN
    fault: InputError | None = None  # that has ended it
    pictures: int = 0  # that were drawn
    drawing_s: float = 0.0  # CPU time of this thread for all of them
    _known: Sighting | None = None  # the last one that told where the skin is
    _silent_since: int | None = None
    _reason: str = ""
    _drawn: tuple[int, int] | None = None  # sighting and changes of the drawings that were drawn last; None when dark
    _image: Image | None = None
    _shown_ns: int | None = None  # when a picture was shown last
    _ended: bool = False
    _thread: Thread | None = None

    def start(self) -> None:
        """Begin."""
        self._thread = Thread(target=self._run, name="light", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """End, dark."""
        self._ended = True
        self.sightings.close()
        if self._thread is not None:
            self._thread.join()

    @property
    def alive(self) -> bool:
        """Whether it goes on."""
        return self._thread is not None and self._thread.is_alive()

    def step(self, sighting: Sighting | None) -> None:
        """Take in a sighting, if there is one, and show what is due; DeviceError if the projector is gone."""
        if sighting is not None:
            self._reason = sighting.reason
            if sighting.image is not None:
                self._silent_since = None
            elif self._silent_since is None:
                self._silent_since = sighting.exposed_ns
            if sighting.world_from_skin is not None:
                self._known = sighting
        self.state = self._due()
        if not self.state.lit or self._known is None or self._known.world_from_skin is None:
            self._darken()
            return
        wanted = (0 if self.hold_s is None else self._known.number, self.drawings.changes)
        new = wanted != self._drawn
        if new or self._image is None:
            self._image, self._drawn = self._draw(self._known.world_from_skin), wanted
        if new or self._is_due_again():
            self._show(self._image)
        if new and sighting is self._known:
            self.latencies.add(sighting.exposed_ns, self.clock() + round(self.delay_s * 1e9))

    def _due(self) -> State:
        if self._known is None:
            return State(False, f"dark: {self._reason}") if self._reason else UNSEEN
        now = self.clock()
        if self.hold_s is None:
            silent_s = 0.0 if self._silent_since is None else (now - self._silent_since) * 1e-9
            silent = f"; no picture of camera 1 for {silent_s:.0f} s" if silent_s > SILENT_S else ""
            return State(True, f"lit where the skin was measured{silent}")
        age_s = (now - self._known.exposed_ns) * 1e-9
        reason = self._reason or "frames come late"
        if age_s > self.hold_s:
            return State(False, f"dark for {age_s:.1f} s: {reason}")
        return State(True, f"lit where the patient was {age_s:.1f} s ago: {reason}" if self._reason else "lit")

    def _draw(self, world_from_skin: Array) -> Image:
        begun = thread_time()
        image = self.picture.draw(Strips.joined([self.still, self.drawings.strips]), world_from_skin)
        self.drawing_s += thread_time() - begun
        self.pictures += 1
        return image

    def _darken(self) -> None:
        if self._drawn is not None or self._is_due_again():
            self._drawn = self._image = None
            self._show(self.picture.dark)

    def _is_due_again(self) -> bool:
        """Whether a picture that is the same is to be shown again, so that a display that is gone is noticed."""
        return self._shown_ns is None or self.clock() - self._shown_ns > STILL_S * 1e9

    def _show(self, image: Image) -> None:
        self.projector.show(image)
        self._shown_ns = self.clock()

    def _run(self) -> None:
        try:
            while not self._ended:
                self.step(self.sightings.take(LOOK_S))
            self._show(self.picture.dark)
        except InputError as error:  # of a display that is gone
            self.fault = error
