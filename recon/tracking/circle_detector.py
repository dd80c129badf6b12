"""Where circles may be in a frame, and which ones: the detector's answer, read."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from recon.tracking.networks import CELL, DETECTOR_SIZE, Networks

Array = NDArray[np.float64]

APART = 4  # px of the detector's image: of two maxima nearer than that the higher one counts
LEAST_SCORE = 0.015
MOST = 12  # candidates; the target needs three


@dataclass(frozen=True)
class Candidates:
    """n places that may be middles of circles, the surest first."""

    points: Array  # (n, 2) px of the frame
    scores: Array  # (n,) probability of a circle there
    identity: Array  # (n, 4) probabilities of c0, c1, c2, none


def detect(frames: list[NDArray], networks: Networks) -> list[Candidates]:
    """Candidates in each frame : (h, w) of 0 to 255; all frames go through the network at once."""
    small = np.stack([network_image(frame) for frame in frames])
    detection, identity = networks.detect(small)
    return [read(where, who, frame.shape) for where, who, frame in zip(detection, identity, frames, strict=True)]


def network_image(frame: NDArray) -> NDArray[np.float32]:
    """The detector's input : (240, 320) of 0 to 1, as published: the whole frame, squeezed."""
    return cv2.resize(frame, DETECTOR_SIZE).astype(np.float32) / np.float32(255)


def read(detection: NDArray, identity: NDArray, shape: tuple[int, ...]) -> Candidates:
    """Candidates from logits : (65, 30, 40) and (4, 30, 40), in px of a frame of (h, w)."""
    rows, columns = detection.shape[1:]
    within = _softmax(np.asarray(detection, float))[:-1].reshape(CELL, CELL, rows, columns)
    score = within.transpose(2, 0, 3, 1).reshape(rows * CELL, columns * CELL).astype(np.float32)
    highest = cv2.dilate(score, np.ones((2 * APART + 1, 2 * APART + 1), np.uint8))
    v, u = np.nonzero((score > LEAST_SCORE) & (score == highest))
    best = np.argsort(-score[v, u], kind="stable")[:MOST]
    u, v = u[best], v[best]
    scale = np.array([shape[1] / (columns * CELL), shape[0] / (rows * CELL)])
    names = _softmax(np.asarray(identity, float))[:, v // CELL, u // CELL].T
    return Candidates(np.column_stack([u, v]) * scale, score[v, u].astype(float), names)


def _softmax(logits: Array) -> Array:
    shifted = np.exp(logits - logits.max(axis=0))
    return shifted / shifted.sum(axis=0)
