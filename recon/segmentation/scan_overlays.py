"""B-scans with outlines drawn over: some of those that show a thing, evenly through the sweep."""

from collections.abc import Iterable, Mapping, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

Overlay = NDArray[np.uint8]  # (h, w, 3), blue, green, red
Mask = NDArray[np.bool_]

LEAST_PX = 30  # of a mass in a B-scan that is drawn
COLOUR = (60, 220, 255)  # of outlines, blue, green, red


def of_masks(images: Iterable[NDArray[np.uint8]], masks: Iterable[Mask], count: int) -> list[Overlay]:
    """Draw the borders of masks : n of (h, w) over some of n B-scans."""
    outlines = {k: mask for k, mask in enumerate(masks) if mask.sum() >= LEAST_PX}
    chosen = spread({k: int(mask.sum()) for k, mask in outlines.items()}, count)
    return [_draw_over(image, _contours(outlines[k])) for k, image in enumerate(images) if k in chosen]


def of_outlines(images: Iterable[NDArray[np.uint8]], outlines: Mapping[int, NDArray], count: int) -> list[Overlay]:
    """Draw open outlines : (m, 2) px, by the numbers of their images, over some of n B-scans."""
    chosen = spread({k: len(outline) for k, outline in outlines.items()}, count)
    return [_draw_over(image, [outlines[k]], closed=False) for k, image in enumerate(images) if k in chosen]


def spread(sizes: Mapping[int, int], count: int) -> set[int]:
    """Numbers of `count` images, evenly through those with a size: of each part of the sweep the largest."""
    parts = np.array_split(sorted(sizes), min(count, len(sizes))) if count and sizes else []
    return {max(part.tolist(), key=lambda k: sizes[k]) for part in parts}


def _draw_over(image: NDArray[np.uint8], outlines: Sequence[NDArray], closed: bool = True) -> Overlay:
    """A B-scan in colour, with outlines : (m, 2) px."""
    result = cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)
    for outline in outlines:
        points = np.rint(16 * np.asarray(outline)).astype(np.int32)[:, None]
        cv2.polylines(result, [points], closed, COLOUR, 1, cv2.LINE_AA, shift=4)
    return result


def _contours(mask: Mask) -> list[NDArray]:
    """Borders of a mask, without the slits that neighbouring lines leave which a flank bends differently."""
    slit_px = 7  # width of slits and spikes that are not drawn
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (slit_px, slit_px))
    padded = np.pad(mask.astype(np.uint8), slit_px)
    whole = cv2.morphologyEx(cv2.morphologyEx(padded, cv2.MORPH_CLOSE, disc), cv2.MORPH_OPEN, disc)
    return [line[:, 0] - slit_px for line in cv2.findContours(whole, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)[0]]
