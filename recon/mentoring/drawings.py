"""The drawings that are lit: all threads share them, and each change has a number."""

from collections.abc import Iterable
from dataclasses import dataclass, field
from threading import Lock

from recon.errors import InputError
from recon.mentoring.stroke_casting import MOST_POINTS, STEP_MM
from recon.skin_projection.live_picture import Strips
from recon.skin_projection.projector_image import Line
from recon.skin_projection.skin_curve import SkinCurve

MOST_DRAWINGS = 500


@dataclass(frozen=True, eq=False)
class Drawing:
    """A stroke or a text on the skin."""

    number: int
    who: str
    time_ns: int  # of the calendar (UNIX)
    words: str  # of a text; nothing of a stroke
    line: Line
    curve: SkinCurve  # in the skin's frame


@dataclass
class Drawings:
    """Drawings in their order, and what is lit of them."""

    changes: int = 0  # that were made
    _next: int = 0
    _kept: tuple[Drawing, ...] = ()
    _strips: Strips = field(default_factory=lambda: Strips.joined([]))
    _lock: Lock = field(default_factory=Lock)

    def __iter__(self):
        return iter(self._kept)

    def __len__(self) -> int:
        return len(self._kept)

    @property
    def strips(self) -> Strips:
        """Of all drawings."""
        return self._strips

    @property
    def next_number(self) -> int:
        """Number of the next drawing; none is given twice."""
        return self._next

    def check_room(self, curve: SkinCurve) -> None:
        """Raise InputError if there is no room for one more."""
        if len(self._kept) >= MOST_DRAWINGS:
            raise InputError(f"expected at most {MOST_DRAWINGS} drawings, found all of them drawn: undo or clear some")
        points = len(curve.points) + sum(len(drawing.curve.points) for drawing in self._kept)
        if points > MOST_POINTS:
            most_m = MOST_POINTS * STEP_MM / 1000
            raise InputError(f"expected at most {most_m:g} m of lines in all drawings, found them used up: undo or clear some")

    def add(self, drawing: Drawing) -> None:
        """Light one more."""
        with self._lock:
            self._next = drawing.number + 1
            self._set((*self._kept, drawing))

    def last_of(self, who: str) -> Drawing | None:
        """The newest drawing of a mentor that is lit."""
        return next((drawing for drawing in reversed(self._kept) if drawing.who == who), None)

    def remove(self, numbers: Iterable[int]) -> None:
        """Light some no longer."""
        gone = set(numbers)
        with self._lock:
            self._set(tuple(drawing for drawing in self._kept if drawing.number not in gone))

    def _set(self, kept: tuple[Drawing, ...]) -> None:
        self._kept = kept
        self._strips = Strips.joined([Strips.of(drawing.curve, drawing.line) for drawing in kept])
        self.changes += 1
