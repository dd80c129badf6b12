"""What a scanner makes of echoes before it shows them: compounding, gain as set, smoothing, edges, grey map.

The coherent sum is taken anew for each look, of a part of the band and from another direction, and their powers are averaged.
Then come clutter, gain, logarithm, smoothing, interpolation between lines, despeckling, smoothing along streaks, edge
enhancement, persistence, the grey map and compression.
"""

from typing import Annotated

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field, field_validator
from scipy.ndimage import gaussian_filter

from recon.model.rig import NotNegative, Part

Array = NDArray[np.float64]
Image = NDArray[np.float32]


class Picture(Part):
    """How a scanner's picture is made of its echoes. As it stands, nothing is done to them."""

    bands: Annotated[int, Field(ge=1, le=4)] = 1
    """parts of the band that are compounded: frequency compounding"""
    angles: Annotated[int, Field(ge=1, le=9)] = 1
    """directions that are compounded: spatial compounding"""
    steered_deg: Annotated[float, Field(ge=0, le=25)] = 8.0
    """of the outermost directions from the middle one"""
    line_mm: Annotated[float, Field(ge=0, le=2)] = 0.0
    """between lines that are shown; the columns between them are interpolated. 0 for a line a column"""
    sliders_db: tuple[Annotated[float, Field(ge=-40, le=40)], ...] = ()
    """gain over depth as set by hand, at even depths from the first row to the last"""
    smooth_mm: tuple[NotNegative, NotNegative] = (0.0, 0.0)
    """standard deviations of the smoothing of the logarithm, along the array and in depth"""
    despeckle: Annotated[float, Field(ge=0, le=1)] = 0.0
    """share of a smoothing that spares edges (a guided filter)"""
    despeckle_mm: Annotated[float, Field(gt=0, le=5)] = 0.8
    """width of its windows"""
    streaks: Annotated[float, Field(ge=0, le=1)] = 0.0
    """share of a smoothing along what runs through the picture: fibres, borders, or the grains' own length (line integrals)"""
    streaks_mm: Annotated[float, Field(gt=0, le=5)] = 1.0
    """over which it is smoothed, to either side"""
    edges: Annotated[float, Field(ge=0, le=3)] = 0.0
    """by which what differs from its surroundings is amplified (an unsharp mask)"""
    edges_mm: Annotated[float, Field(gt=0, le=5)] = 0.5
    """standard deviation of the mask's blur"""
    persistence: Annotated[float, Field(ge=0, lt=1)] = 0.0
    """share of the picture before that is kept, as long as the probe stays within 5 mm from one B-scan to the next"""
    grey_map: tuple[Annotated[float, Field(ge=0, le=1)], ...] = ()
    """shown greys of even shares of the dynamic range, from black to white, rising"""
    clutter_db: Annotated[float, Field(ge=-100, le=0)] = -100.0
    """of what side lobes and echoes between layers smear over the surroundings, under these, anew in each B-scan; -100 is none"""
    clutter_mm: Annotated[float, Field(gt=0, le=20)] = 4.0
    """standard deviation of the smear along the array; in depth, it trails behind"""
    jpeg: Annotated[int, Field(ge=0, le=100)] = 0
    """quality of a compression; 0 is none"""

    @field_validator("grey_map")
    @classmethod
    def _rises(cls, values: tuple[float, ...]) -> tuple[float, ...]:
        if len(values) == 1 or (np.diff(values) < 0).any():
            raise ValueError(f"expected rising values from 0 to 1, two at least, found {list(values)}")
        return values


def processed(share: Image, picture: Picture, line_mm: float, row_mm: float) -> Image:
    """Shares of the grey scale : (rows, lines), 0 to 1, as the scanner shows them, before persistence.

    line_mm, row_mm : between lines, and between rows
    """
    shown = share
    if any(picture.smooth_mm):
        shown = gaussian_filter(shown, (picture.smooth_mm[1] / row_mm, picture.smooth_mm[0] / line_mm), mode="nearest")
    if picture.line_mm > line_mm:
        shown = _interpolated(shown, picture.line_mm / line_mm)
    if picture.despeckle:
        shown = shown + np.float32(picture.despeckle) * (_softened(shown, picture.despeckle_mm, line_mm, row_mm) - shown)
    if picture.streaks:
        shown = shown + np.float32(picture.streaks) * (_along_streaks(shown, picture.streaks_mm, line_mm, row_mm) - shown)
    if picture.edges:
        blurred = gaussian_filter(shown, (picture.edges_mm / row_mm, picture.edges_mm / line_mm), mode="nearest")
        shown = np.clip(shown + np.float32(picture.edges) * (shown - blurred), 0, 1)
    return shown


def mapped_greys(share: Image, picture: Picture) -> Image:
    """Shares after the grey map."""
    if not picture.grey_map:
        return share
    return np.interp(share, np.linspace(0, 1, len(picture.grey_map)), picture.grey_map).astype(np.float32)


def compressed_image(image: NDArray[np.uint8], picture: Picture) -> NDArray[np.uint8]:
    """The image after the compression."""
    if not picture.jpeg:
        return image
    _, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, picture.jpeg])
    return cv2.imdecode(data, cv2.IMREAD_GRAYSCALE)


def _softened(share: Image, width_mm: float, line_mm: float, row_mm: float) -> Image:
    """Means over windows, less of them where what varies is more than grains: the guided filter of He, Sun & Tang 2013."""
    grains = 0.005  # variance of grains in shares of the scale: of 5 dB in 60
    window = 2 * round(width_mm / line_mm / 2) + 1, 2 * round(width_mm / row_mm / 2) + 1
    mean, square = cv2.blur(share, window), cv2.blur(share * share, window)
    variance = np.maximum(square - mean * mean, 0)
    slope = variance / (variance + np.float32(grains))
    return cv2.blur(slope, window) * share + cv2.blur((1 - slope) * mean, window)


def _along_streaks(share: Image, reach_mm: float, line_mm: float, row_mm: float) -> Image:
    """Means to either side along the direction of least change, by the tensor of slopes 0.6 mm about: a step of Weickert 1999.

    Weights fall linearly to none at `reach_mm`. Where no direction stands out, the smoothing is as much shorter.
    """
    blur = cv2.GaussianBlur(share, (0, 0), 0.15 / line_mm, sigmaY=0.15 / row_mm)
    x, y = cv2.Sobel(blur, -1, 1, 0, scale=1 / line_mm), cv2.Sobel(blur, -1, 0, 1, scale=1 / row_mm)
    xx, xy, yy = (cv2.GaussianBlur(part, (0, 0), 0.6 / line_mm, sigmaY=0.6 / row_mm) for part in (x * x, x * y, y * y))
    angle = np.arctan2(2 * xy, xx - yy) / 2 + np.float32(np.pi / 2)
    length = np.hypot(2 * xy, xx - yy) / np.maximum(xx + yy, 1e-9)  # share of the slopes that agree
    aside, down = np.cos(angle) * length / np.float32(line_mm), np.sin(angle) * length / np.float32(row_mm)
    row, column = np.mgrid[: share.shape[0], : share.shape[1]].astype(np.float32)
    total, weights, steps = share.copy(), 1.0, 4
    for step in (*range(-steps + 1, 0), *range(1, steps)):
        far, weight = np.float32(reach_mm * step / steps), 1 - abs(step) / steps
        places = column + far * aside, row + far * down
        total += weight * cv2.remap(share, *places, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        weights += weight
    return total / np.float32(weights)


def _interpolated(share: Image, columns: float) -> Image:
    """Shares of lines that stand so many columns apart, with those between them."""
    width = share.shape[1]
    count = max(round((width - 1) / columns) + 1, 2)
    lines = np.rint(np.linspace(0, width - 1, count)).astype(int)
    places = np.interp(np.arange(width), lines, np.arange(count))
    before = np.minimum(places.astype(int), count - 2)
    low, high = share[:, lines[before]], share[:, lines[before + 1]]
    return low + (places - before).astype(np.float32) * (high - low)
