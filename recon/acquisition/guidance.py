"""Who works before the devices, and who says what is to be done next: narrow protocols, and a plain guide for boards."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from recon.board_detection.detect import BoardNotFound, detect
from recon.model.boards import Board

Array = NDArray[np.float64]
Answer = Literal["wait", "take", "end"]

MOVED = 0.04  # of the image's width, by which the board's points must have moved on the whole between two poses
WHERE = (
    "in the middle, square to camera 1",
    "in the upper left corner, its left side nearer",
    "in the upper right corner, its right side nearer",
    "in the lower right corner, its lower side nearer",
    "in the lower left corner, its upper side nearer",
    "in the middle, nearer by a tenth, turned a quarter",
    "in the middle, farther by a tenth, tilted to the left",
    "at the left border, tilted upwards",
    "at the right border, tilted downwards",
    "at the upper border, tilted to the right",
)


class Step(NamedTuple):
    """What is to be done next."""

    text: str
    world_from_board: Array | None = None  # (4, 4) mm, where the board is best held; None if the guide doesn't compute it


class Verdict(NamedTuple):
    """Whether a pose is worth recording, and why not."""

    accepted: bool
    text: str


class Operator(Protocol):
    """A person before the devices, or what stands in for one."""

    def ask(self, step: Step) -> None:
        """Say what is to be done; returns at once."""

    def answer(self) -> Answer:
        """`take` once it has been done, `wait` until then, `end` if no more is to be recorded; returns at once."""


class BoardGuide(Protocol):
    """Where to hold the board next, and whether a pose adds to those before it."""

    def suggest(self) -> Step:
        """The next pose."""

    def judge(self, lit: Mapping[str, NDArray]) -> Verdict:
        """Look at the board as each camera sees it lit : camera -> (h, w)."""

    def accept(self, lit: Mapping[str, NDArray]) -> None:
        """Take note of a pose that was recorded."""


@dataclass
class EvenGuide:
    """Leads a board once around the view, and takes each pose in which all cameras find it somewhere else than before."""

    board: Board
    full: float  # largest value of a pixel
    _before: list[dict[str, Array]] = field(default_factory=list)

    def suggest(self) -> Step:
        """The next pose."""
        return Step(f"hold the board {WHERE[len(self._before) % len(WHERE)]}")

    def judge(self, lit: Mapping[str, NDArray]) -> Verdict:
        """Look at the board as each camera sees it lit : camera -> (h, w)."""
        points, missing = self._points(lit)
        if missing:
            return Verdict(False, next(iter(missing.values())))
        nearest = min((self._moved(points, before, lit) for before in self._before), default=np.inf)
        if nearest < MOVED:
            return Verdict(False, f"nearly a pose that is there already, {100 * nearest:.1f} % of the image away")
        return Verdict(True, f"found in {' and '.join(points)}")

    def accept(self, lit: Mapping[str, NDArray]) -> None:
        """Take note of a pose that was recorded."""
        self._before.append(self._points(lit)[0])

    def _points(self, lit: Mapping[str, NDArray]) -> tuple[dict[str, Array], dict[str, str]]:
        """The board's points in px by camera, and of cameras that don't find it the reason."""
        points, missing = dict[str, Array](), dict[str, str]()
        for camera, image in lit.items():
            try:
                points[camera] = detect(image, self.board, full=self.full).pixels
            except BoardNotFound as error:
                missing[camera] = f"{camera} doesn't find the board: {error}"
        return points, missing

    def _moved(self, points: Mapping[str, Array], before: Mapping[str, Array], lit: Mapping[str, NDArray]) -> float:
        """RMS displacement of the points, of the image's width; the largest of all cameras."""
        away = [
            np.sqrt(np.nanmean(np.sum((points[name] - before[name]) ** 2, axis=1))) / lit[name].shape[1]
            for name in points.keys() & before.keys()
        ]
        return float(max(away, default=np.inf))


def sentence(faults: Sequence[str]) -> str:
    """Faults in one line."""
    return "; ".join(faults)
