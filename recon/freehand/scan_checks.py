"""Whether B-scans look like the sweep of their poses: alike near each other, shifted as these say, with the face at the top."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

Array = NDArray[np.float64]


@dataclass(frozen=True)
class SweepLimits:
    """When B-scans are said to be in another order, frozen, elsewhere, or upside down."""

    most: int = 1000  # B-scans that are compared, the first of the sweep
    least: int = 8
    side: int = 24  # blocks along each side of a B-scan, whose mean levels are compared; speckle averages out
    alike: float = 0.6  # difference of the most similar two over that of any two, at most: else there is nothing to compare
    by_chance: float = 0.01  # share of random orders in which neighbours in space are as much alike, at least, of another order
    orders: int = 400  # random ones
    apart_mm: float = 1.0  # of B-scans of which shifts are measured, so that noise of the poses is none
    repeats: int = 4  # B-scans in a row that are the same to the last digit
    longer: float = 3.0  # times the median of such rows: a grabber that is faster than the scanner has many short ones
    flat: float = 2.0  # grey levels, standard deviation of an image that shows nothing
    wide: int = 128  # px, of the B-scans in which shifts are measured
    clear: float = 0.15  # phase correlation's peak in the median, at least
    within: float = 0.6  # shift within the plane by the poses over the whole step, at least, of transforms that are wrong
    shown: float = 0.5  # shift that the images show over that by the poses, at most
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
    small, places = [], []
    for image, pose in zip(images, world_from_pixel[: LIMITS.most], strict=False):
        if np.isfinite(pose).all():
            size = LIMITS.wide, max(round(LIMITS.wide * image.shape[0] / image.shape[1]), LIMITS.side)
            small.append(cv2.resize(image, size, interpolation=cv2.INTER_AREA))
            places.append(pose @ np.diag([image.shape[1] / size[0], image.shape[0] / size[1], 1, 1]))
    if len(small) < LIMITS.least:
        return
    blocks = np.array([cv2.resize(one, (LIMITS.side,) * 2, interpolation=cv2.INTER_AREA).astype(np.float32) for one in small])
    centre = np.array([small[0].shape[1] / 2, small[0].shape[0] / 2, 0, 1])
    centres = np.array(places)[:, :3] @ centre
    if _disordered(blocks.reshape(len(blocks), -1), centres):
        yield (
            "B-scans that were taken near each other look no more alike than any two: images in another order, or poses of "
            "another sweep?"
        )
    else:
        by_poses, shown, step = _shifts(small, places, centre, centres)
        if by_poses > LIMITS.within * step and shown < LIMITS.shown * by_poses:
            yield (
                f"the poses shift B-scans {step:.2g} mm apart by {by_poses:.2g} mm within their own planes, and the images show "
                f"{shown:.2g} mm: a transform the other way round, axes exchanged, or another probe's calibration?"
            )
    if line := frozen(small, places):
        yield line
    if _upside_down(np.mean(small, axis=2)):
        yield "the lowest rows are as bright and as steady as the ringing at a probe's face is: upside down?"


def frozen(images: Iterable[NDArray[np.uint8]], poses: Iterable[Array]) -> str | None:
    """Say that B-scans are the same to the last digit where their poses : (4, 4) differ; None as a rule, and of flat images."""
    fresh = [
        not np.array_equal(one, other) or one.std() <= LIMITS.flat or np.array_equal(pose, after, equal_nan=True)
        for (one, pose), (other, after) in pairwise(zip(images, poses, strict=True))
    ]
    runs = np.diff([0, *(np.flatnonzero(fresh) + 1), len(fresh) + 1])
    if (run := runs.max()) < LIMITS.repeats or run <= LIMITS.longer * np.median(runs):
        return None
    return f"{run} B-scans in a row are the same to the last digit while the probe moves: a frozen image, or no contact?"


def _disordered(blocks: NDArray[np.float32], centres: Array) -> bool:
    """Whether B-scans that resemble each other exist, but not where they are neighbours by their centres : (n, 3) mm."""
    squares = (blocks**2).sum(axis=1)
    differences = np.sqrt(np.maximum(squares[:, None] + squares - 2 * blocks @ blocks.T, 0))
    others = differences[~np.eye(len(blocks), dtype=bool)].reshape(len(blocks), -1)
    if not np.median(others.min(axis=1)) < LIMITS.alike * np.median(others):
        return False
    nearest = KDTree(centres).query(centres, k=2)[1][:, 1]
    neighbours = np.median(differences[np.arange(len(blocks)), nearest])
    rng = np.random.default_rng(0)
    orders = (rng.permutation(len(blocks)) for _ in range(LIMITS.orders))
    by_chance = np.mean([np.median(differences[order, order[nearest]]) <= neighbours for order in orders])
    return bool(by_chance > LIMITS.by_chance)


def _shifts(small: list[NDArray[np.uint8]], places: list[Array], centre: Array, centres: Array) -> tuple[float, float, float]:
    """Medians over B-scans that are apart, mm: shift within the plane by poses and in the images, and distance; else zeros.

    Parameters
    ----------
    small : (h, w) each
    places : (4, 4) each
        world_from_pixel of them.
    centre, centres : (4,) px, (n, 3) mm
    """
    mean = np.mean(small, axis=0, dtype=np.float32)  # what is alike in all is the scanner's, and never shifts
    window = cv2.createHanningWindow(mean.shape[::-1], cv2.CV_32F)
    found = []
    strides = range(1, len(small) // 4)
    apart = (s for s in strides if np.median(np.linalg.norm(centres[s:] - centres[:-s], axis=1)) >= LIMITS.apart_mm)
    stride = next(apart, len(small) // 4)
    for before, here, after, there in zip(small, places, small[stride:], places[stride:], strict=False):
        pixel_mm = np.linalg.norm(here[:3, :2], axis=0)
        moved = (np.linalg.inv(here) @ there @ centre - centre)[:2] * pixel_mm
        seen, peak = cv2.phaseCorrelate(before - mean, after - mean, window)
        found.append([np.linalg.norm(moved), np.linalg.norm(seen * pixel_mm), np.linalg.norm((there - here)[:3] @ centre), peak])
    by_poses, shown, step, peak = np.median(found, axis=0)
    return (float(by_poses), float(shown), float(step)) if peak > LIMITS.clear else (0.0, 0.0, 0.0)


def _upside_down(rows: Array) -> bool:
    """Whether the lowest rows of mean levels : (n, height) ring as a probe's face does, and the uppermost don't."""
    level, scatter, band = rows.mean(axis=0), rows.std(axis=0), max(2, round(LIMITS.band * rows.shape[1]))

    def rings(part: slice) -> bool:
        brighter = level[part].mean() > np.median(level) + LIMITS.brighter
        return bool(brighter and scatter[part].mean() < LIMITS.steadier * np.median(scatter))

    return rings(slice(-band, None)) and not rings(slice(band))
