"""Faults of a frame at once, in words that say how to mend them: saturated, dark, blurred, without fringes."""

from typing import Annotated, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from recon.model.patterns import Fringes, Patterns
from recon.model.rig import Part, Positive
from recon.structured_light.phase import DEFAULT_NOISE, wrapped_phase

Images = NDArray[np.uint8] | NDArray[np.uint16]
Share = Annotated[float, Field(gt=0, le=1)]

BRIGHTEST = 99.9  # percentile that counts as the brightest: a few highlights and hot pixels don't


class Limits(Part):
    """Limits beyond which a frame has a fault."""

    saturated: Share = 0.005
    """share of the pixels at full scale"""
    least_level: Share = 0.2
    """of full scale, of the brightest thousandth of the pixels"""
    most_blur_px: Positive = 2.5
    """px, standard deviation of edges"""
    least_contrast_dn: Positive = 5.0
    """DN of 255, of fringes, in the median of what is lit"""
    least_lit: Share = 0.02
    """share of the image with fringes"""


class Look(NamedTuple):
    """What a frame shows, in numbers."""

    level: float  # of full scale, of the brightest thousandth of the pixels
    saturated: float  # share of pixels at full scale
    focus_px: float  # standard deviation of the edges of the sharpest direction; NaN without edges
    motion_px: float  # of the most blurred direction, beyond that

    @property
    def text(self) -> str:
        """In one line."""
        edges = "no edges" if np.isnan(self.focus_px) else f"edges {self.focus_px:.1f} px"
        return f"brightest {100 * self.level:.0f} %, {100 * self.saturated:.1f} % saturated, {edges}"


class Contrast(NamedTuple):
    """What a fringe sequence shows, in numbers."""

    modulation_dn: float  # of 255, in the median of the lit pixels
    lit: float  # share of the image that is lit
    saturated: float  # of the lit pixels, in any image

    @property
    def text(self) -> str:
        """In one line."""
        return (
            f"fringes {self.modulation_dn:.0f} DN on {100 * self.lit:.0f} % of the image, {100 * self.saturated:.1f} % saturated"
        )


def look(image: Images, bits: int) -> Look:
    """Measure brightness and edges of a frame : (h, w)."""
    full = 2**bits - 1
    level = float(np.percentile(image[::4, ::4], BRIGHTEST)) / full
    widths = _edge_widths(image)
    if not widths:
        return Look(level, float(np.mean(image >= full)), np.nan, np.nan)
    return Look(level, float(np.mean(image >= full)), min(widths), float(np.sqrt(max(widths) ** 2 - min(widths) ** 2)))


def _edge_widths(image: Images) -> list[float]:
    """Standard deviations of edges in px, one a direction that has enough of them.

    A step of height H that is blurred by sigma has the largest gradient `H / (sigma sqrt(2 pi))`.
    """
    smooth = np.float32(image)
    across, down = (cv2.Scharr(smooth, cv2.CV_32F, *axis, scale=1 / 32) for axis in ((1, 0), (0, 1)))
    gradient = cv2.magnitude(across, down)
    window_px = 15  # about an edge: both of its levels must lie within
    window = np.ones((window_px, window_px), np.uint8)
    step = cv2.dilate(smooth, window) - cv2.erode(smooth, window)
    low, high = np.percentile(smooth[::4, ::4], (100 - BRIGHTEST, BRIGHTEST))
    crest = gradient >= cv2.dilate(gradient, np.ones((3, 3), np.uint8))
    least_step = 0.2  # of the image's range, of an edge that is looked at
    v, u = np.nonzero(crest & (step > max(least_step * (high - low), 8.0)) & (gradient > 0.3 * step / window_px))
    width = step[v, u] / (np.sqrt(2 * np.pi) * gradient[v, u])
    directions = 4  # of edges, told apart: motion leaves those along it sharp
    turn = np.arctan2(down[v, u], across[v, u]) * directions / np.pi
    direction = np.rint(turn).astype(int) % directions
    sharp = 30.0  # percentile of the edges' widths that counts: others lie on shades, and beside other edges
    few = 40  # pixels of edges in a direction, with fewer of which nothing is said
    found = [np.percentile(width[direction == k], sharp) for k in range(directions) if np.sum(direction == k) >= few]
    step_blur_px = 0.6  # standard deviation by which the gradient's own differences widen an edge, with the pixels
    return [float(np.sqrt(max(each**2 - step_blur_px**2, 0.0))) for each in found]


def contrast(images: Images, patterns: Patterns, bits: int, limits: Limits) -> Contrast:
    """Measure the fringes of a sequence : (n, h, w), of its finest set."""
    sets = [(part, place) for part, place in patterns.slices() if isinstance(part, Fringes)]
    if not sets:
        return _code_contrast(images, bits, limits)
    fringes, place = min(sets, key=lambda pair: pair[0].pitch)
    found = wrapped_phase(np.float32(images[place]), fringes.shifts, noise=DEFAULT_NOISE, saturation=2**bits - 1)
    return _contrast(found.modulation, found.saturated, bits, limits)


def _code_contrast(images: Images, bits: int, limits: Limits) -> Contrast:
    """The same of Gray code alone: half of what the images differ by at each pixel."""
    half = (images.max(axis=0).astype(np.float32) - images.min(axis=0)) / 2
    return _contrast(half, (images >= 2**bits - 1).any(axis=0), bits, limits)


def _contrast(modulation: NDArray[np.float32], saturated: NDArray[np.bool_], bits: int, limits: Limits) -> Contrast:
    dn = modulation * np.float32(255 / (2**bits - 1))
    lit = dn > limits.least_contrast_dn / 2
    if not lit.any():
        return Contrast(float(np.median(dn)), 0.0, float(saturated.mean()))
    return Contrast(float(np.median(dn[lit])), float(lit.mean()), float(saturated[lit].mean()))


def frame_faults(found: Look, limits: Limits) -> list[str]:
    """Faults of a frame, each with the way to mend it; none of a good one."""
    faults = light_faults(found, limits)
    if found.level < limits.least_level:
        return faults
    if found.focus_px > limits.most_blur_px:
        faults.append(f"blurred: edges {found.focus_px:.1f} px wide in all directions; focus the lens, or come into its range")
    elif found.motion_px > limits.most_blur_px:
        way = "hold still, or expose shorter under more light; round or slanted rims at rest look so, too"
        faults.append(f"blurred: smeared by {found.motion_px:.1f} px in one direction; {way}")
    return faults


def light_faults(found: Look, limits: Limits) -> list[str]:
    """Faults of a frame's brightness, each with the way to mend it."""
    faults = []
    if found.saturated > limits.saturated:
        faults.append(f"saturated: {100 * found.saturated:.1f} % of the pixels; halve the exposure, or turn glossy things aside")
    if found.level < limits.least_level:
        times = 0.8 / max(found.level, 0.01)
        faults.append(
            f"dark: brightest {100 * found.level:.0f} % of full scale; expose {times:.1f} times as long, or open the lens"
        )
    return faults


def fringe_faults(found: Contrast, limits: Limits) -> list[str]:
    """Faults of a fringe sequence, each with the way to mend it; none of a good one."""
    if found.lit < limits.least_lit:
        return [
            f"no fringes: on {100 * found.lit:.1f} % of the image; is the projector on, focused, and its light on what is seen?"
        ]
    faults = []
    if found.modulation_dn < limits.least_contrast_dn:
        way = "darken the room, expose longer, or focus the projector"
        faults.append(f"weak fringes: {found.modulation_dn:.1f} DN of 255; {way}")
    if found.saturated > max(limits.saturated, 0.05):
        faults.append(f"saturated: {100 * found.saturated:.1f} % of what is lit; halve the exposure, or powder what shines")
    return faults
