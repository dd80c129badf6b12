"""Whether B-scans look like a sweep: alike where they were taken near each other, with the probe's face at the top."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

Array = NDArray[np.float64]


@dataclass(frozen=True)
class SweepLimits:
    """When B-scans are told to be in another order, or upside down."""

    most: int = 1000  # B-scans that are compared, the first of the sweep
    least: int = 8
    side: int = 24  # blocks along each side of a B-scan, whose mean levels are compared; speckle averages out
    alike: float = 0.6  # difference of the most similar two over that of any two, at most: else there is nothing to compare
    apart: float = 0.85  # difference of neighbours in space over that of any two, at least, where the order is another
    band: float = 0.02  # of the height, at the top and at the bottom
    brighter: float = 40.0  # grey levels above the B-scan's median row, of the ringing at the probe's face
    steadier: float = 0.5  # standard deviation from image to image over that of the median row


LIMITS = SweepLimits()


def faults(images: Iterable[NDArray[np.uint8]], world_from_pixel: Array) -> Iterator[str]:
    """Lines on what is unlike a sweep; none as a rule.

    Parameters
    ----------
    images : n B-scans (h, w)
    world_from_pixel : (n, 4, 4) mm
        NaN where there is no pose.
    """
    blocks, rows, centres = [], [], []
    for image, pose in zip(images, world_from_pixel[: LIMITS.most], strict=False):
        if np.isfinite(pose).all():
            blocks.append(cv2.resize(image, (LIMITS.side, LIMITS.side), interpolation=cv2.INTER_AREA).astype(np.float32).ravel())
            rows.append(image.mean(axis=1))
            centres.append(pose[:3] @ [image.shape[1] / 2, image.shape[0] / 2, 0, 1])
    if len(blocks) < LIMITS.least:
        return
    if _disordered(np.array(blocks), np.array(centres)):
        yield (
            "B-scans that were taken near each other look no more alike than any two: images in another order, or poses of "
            "another sweep?"
        )
    if _upside_down(np.array(rows)):
        yield "the lowest rows are as bright and as steady as the ringing at a probe's face is: upside down?"


def _disordered(blocks: NDArray[np.float32], centres: Array) -> bool:
    """Whether B-scans that resemble each other exist, but not where they are neighbours by their centres : (n, 3) mm."""
    squares = (blocks**2).sum(axis=1)
    differences = np.sqrt(np.maximum(squares[:, None] + squares - 2 * blocks @ blocks.T, 0))
    usual = float(np.median(differences[~np.eye(len(blocks), dtype=bool)]))
    nearest = cKDTree(centres).query(centres, k=2)[1][:, 1]
    neighbours = float(np.median(differences[np.arange(len(blocks)), nearest]))
    np.fill_diagonal(differences, np.inf)
    return float(np.median(differences.min(axis=1))) < LIMITS.alike * usual and neighbours > LIMITS.apart * usual


def _upside_down(rows: Array) -> bool:
    """Whether the lowest rows of mean levels : (n, height) ring as a probe's face does, and the uppermost don't."""
    level, scatter, band = rows.mean(axis=0), rows.std(axis=0), max(2, round(LIMITS.band * rows.shape[1]))

    def rings(part: slice) -> bool:
        brighter = level[part].mean() > np.median(level) + LIMITS.brighter
        return bool(brighter and scatter[part].mean() < LIMITS.steadier * np.median(scatter))

    return rings(slice(-band, None)) and not rings(slice(band))
