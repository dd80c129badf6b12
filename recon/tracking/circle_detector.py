"""Where circles may be in a frame, and which ones: the detector's answer, read.

The network knows circles of some tenths of its image's width. So a frame of any size is seen through windows: one over the whole,
and, where circles may be smaller, finer levels of windows that overlap by what the target takes up.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from recon.geometry.ellipses import Ellipses
from recon.tracking.networks import CELL, DETECTOR_SIZE, Networks

Array = NDArray[np.float64]

APART = 4  # px of the detector's image: of two maxima nearer than that the higher one counts
LEAST_SCORE = 0.015
MOST = 12  # candidates of a window; a target needs three or four
FRAME = (1280, 1024)  # width, height, px, of the cameras that the networks know: to these a window is scaled
LEAST_PX = 16.0  # of the frame, of the diameter of a circle that is looked for
SEEN_PX = 36.0  # of a window at the size of FRAME, of the smallest circle that the network finds in it
USUAL_PX = 90.0  # and of one that it is used to
FINER = 2.5  # most, from one level of windows to the next
APART_OF_WINDOWS = 0.65  # of a window's size, from one to the next: the target takes up less than the rest
AT_ONCE = 8  # windows that go through the network at once


class Window(NamedTuple):
    """A part of a frame, which ends beyond the frame where that has another aspect."""

    left: int  # px, its first column and row
    top: int
    scale: float  # px of FRAME that make one of the frame

    @property
    def width(self) -> float:
        """Width, px of the frame."""
        return FRAME[0] / self.scale

    def cut(self, frame: NDArray) -> NDArray:
        """The part at the size of FRAME : (1024, 1280); beyond the frame its border goes on."""
        width, height = (round(length / self.scale) for length in FRAME)
        left, top = max(self.left, 0), max(self.top, 0)
        part = frame[top : self.top + height, left : self.left + width]
        size = tuple(max(round(length * self.scale), 1) for length in part.shape[::-1])
        size = min(size[0], FRAME[0]), min(size[1], FRAME[1])
        if size != part.shape[::-1]:
            part = cv2.resize(part, size, interpolation=cv2.INTER_AREA if self.scale < 1 else cv2.INTER_LINEAR)
        if size == FRAME:
            return part
        before = [round((first - given) * self.scale) for first, given in ((top, self.top), (left, self.left))]
        gaps = [(gap, length - gap - own) for gap, length, own in zip(before, FRAME[::-1], part.shape, strict=True)]
        return np.pad(part, gaps, mode="edge")

    def back(self, points: Array) -> Array:
        """Places : (n, 2) px of the frame, of those in the window at the size of FRAME."""
        return (points + 0.5) / self.scale - 0.5 + [self.left, self.top]


@cache
def levels(size: tuple[int, int]) -> tuple[tuple[Window, ...], ...]:
    """Windows of a frame of a size, width and height in px: one over the whole, one twice as large for circles that are too large
    for the network in that, and then ever finer ones.
    """
    whole = min(FRAME[0] / size[0], FRAME[1] / size[1])
    finest = SEEN_PX / LEAST_PX
    count = max(int(np.ceil(np.log(finest / whole) / np.log(FINER))), 0)
    scales = [whole * (finest / whole) ** (k / count) for k in range(count + 1)] if count else [whole]
    around = Window(-size[0] // 2, -size[1] // 2, whole / 2)
    first, *finer = (tuple(_windows(size, scale)) for scale in scales)
    return first, (around,), *finer


def usual_level(windows: Sequence[Sequence[Window]], disc_px: float | None) -> int:
    """Number of the level in which circles of a diameter, px of the frame, are as large as usual; 0 if it isn't known."""
    if disc_px is None:
        return 0
    return int(np.argmin([abs(np.log(disc_px * each[0].scale / USUAL_PX)) for each in windows]))


def _windows(size: tuple[int, int], scale: float) -> list[Window]:
    """Windows of one scale all over a frame."""
    across, down = (
        np.linspace(0, max(length - of / scale, 0), 1 + int(np.ceil(max(length * scale / of - 1, 0) / APART_OF_WINDOWS)))
        for length, of in zip(size, FRAME, strict=True)
    )
    return [Window(round(left), round(top), scale) for top in down.tolist() for left in across.tolist()]


@dataclass(frozen=True)
class Candidates:
    """n places that may be middles of circles, the surest first."""

    points: Array  # (n, 2) px of the frame
    scores: Array  # (n,) probability of a circle there
    identity: Array  # (n, circles + 1) probabilities of c0, c1 and on, and of none

    def apart_from(self, places: Array, near: float) -> "Candidates":
        """Those farther than `near` (px) from all places : (m, 2)."""
        away = np.linalg.norm(self.points[:, None] - places, axis=2).min(axis=1) > near
        return Candidates(self.points[away], self.scores[away], self.identity[away])

    def unnamed(self, circles: int) -> "Candidates":
        """The same without the network's word on which circle each is, of a target with a number of circles."""
        return replace(self, identity=np.full((len(self.points), circles + 1), 1 / (circles + 1)))


@dataclass(frozen=True)
class Detections:
    """What the detector sees in a pair of frames : (h, w) of 0 to 255: each window is looked at once, whoever asks."""

    frames: tuple[NDArray, NDArray]
    networks: Networks
    most: int = MOST  # candidates of a window
    named: bool = True  # whether the network's word on which circle each is counts
    _seen: dict[tuple[int, Window], Candidates] = field(default_factory=dict, init=False, repr=False)
    _taken: list[tuple[int, Ellipses]] = field(default_factory=list, init=False, repr=False)

    def take(self, k: int, ellipses: Ellipses) -> None:
        """Leave the circles of a body that is found in frame k out of what is seen from now on."""
        self._taken.append((k, ellipses))

    def candidates(self, places: Sequence[tuple[int, Window]], circles: int) -> list[Candidates]:
        """Candidates in windows of frames : (k, window) of numbers k, in px of the frame, without circles that are taken.

        circles : of the target, which has so many names
        """
        new = [place for place in dict.fromkeys(places) if place not in self._seen]
        found = detect([self.frames[k] for k, _ in new], [window for _, window in new], self.networks, self.most)
        self._seen.update(zip(new, found, strict=True))
        free = [self._free(k, self._seen[k, window]) for k, window in places]
        return free if self.named else [each.unnamed(circles) for each in free]

    def _free(self, k: int, seen: Candidates) -> Candidates:
        for number, ellipses in self._taken:
            if number == k:
                near = np.fmin.reduce(np.trace(ellipses.shape, axis1=1, axis2=2), initial=np.inf) / 2
                seen = seen.apart_from(ellipses.centre, near)
        return seen


def detect(frames: Sequence[NDArray], windows: Sequence[Window], networks: Networks, most: int = MOST) -> list[Candidates]:
    """Candidates in a window of each frame : (h, w) of 0 to 255, in px of the frame; `most` of each window, the surest."""
    found = []
    both = list(zip(frames, windows, strict=True))
    for first in range(0, len(both), AT_ONCE):
        some = both[first : first + AT_ONCE]
        detection, identity = networks.detect(np.stack([network_image(window.cut(frame)) for frame, window in some]))
        for where, who, (_, window) in zip(detection, identity, some, strict=True):
            seen = read(where, who, FRAME[::-1], most)
            found.append(Candidates(window.back(seen.points), seen.scores, seen.identity))
    return found


def network_image(frame: NDArray) -> NDArray[np.float32]:
    """The detector's input : (240, 320) of 0 to 1, as published: the whole frame, squeezed."""
    return cv2.resize(frame, DETECTOR_SIZE).astype(np.float32) / np.float32(255)


def read(detection: NDArray, identity: NDArray, shape: tuple[int, ...], most: int = MOST) -> Candidates:
    """Candidates from logits : (65, 30, 40) and (circles + 1, 30, 40), in px of a frame of (h, w)."""
    rows, columns = detection.shape[1:]
    within = _softmax(np.asarray(detection, float))[:-1].reshape(CELL, CELL, rows, columns)
    score = within.transpose(2, 0, 3, 1).reshape(rows * CELL, columns * CELL).astype(np.float32)
    highest = cv2.dilate(score, np.ones((2 * APART + 1, 2 * APART + 1), np.uint8))
    v, u = np.nonzero((score > LEAST_SCORE) & (score == highest))
    best = np.argsort(-score[v, u], kind="stable")[:most]
    u, v = u[best], v[best]
    scale = np.array([shape[1] / (columns * CELL), shape[0] / (rows * CELL)])
    names = _softmax(np.asarray(identity, float))[:, v // CELL, u // CELL].T
    return Candidates(np.column_stack([u, v]) * scale, score[v, u].astype(float), names)


def _softmax(logits: Array) -> Array:
    shifted = np.exp(logits - logits.max(axis=0))
    return shifted / shifted.sum(axis=0)
