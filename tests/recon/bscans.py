"""B-scans of wires in water, drawn with a Gaussian point spread and log compression, and of a tank's bottom."""

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

SIZE = (321, 408)  # width, height, px
MM_PER_PX = 0.1225
DYNAMIC_RANGE_DB = 60.0
SPOT_MM = (0.75, 0.3)  # standard deviation of the amplitude, along the array and in depth


def spot(pixel, peak_db=-3.0, sigma_mm=SPOT_MM, tail_db=-14.0):
    """Amplitude of a wire's echo, with a comet tail below and side lobes beside it."""
    width, height = SIZE
    u, v = np.arange(width) - pixel[0], (np.arange(height) - pixel[1])[:, None]
    across, deep = (s / MM_PER_PX for s in sigma_mm)
    row, column = np.exp(-(u**2) / (2 * across**2)), np.exp(-(v**2) / (2 * deep**2))
    beside = sum(np.exp(-((u - side * 5 * across) ** 2) / (2 * across**2)) for side in (-1, 1))
    tail = np.where(v > 0, np.exp(-v / 25), 0) * (0.6 + 0.4 * np.cos(v)) / (1 + np.exp(-(v - 10) / 2))
    return 10 ** (peak_db / 20) * (column * (row + 10 ** (-26 / 20) * beside) + 10 ** (tail_db / 20) * tail * row)


def face(peak_db=-2.0, depth_px=10.0):
    """Amplitude of the reverberation at the probe's face."""
    v = np.arange(SIZE[1])[:, None]
    return 10 ** (peak_db / 20) * np.exp(-v / depth_px) * (0.7 + 0.3 * np.cos(v)) * np.ones(SIZE[0])


def bottom(depth_px, slope=0.0, peak_db=-4.0, sigma_px=3.0):
    """Amplitude of a flat bottom, whose line passes `depth_px` in the middle column, with what lies behind it."""
    u, v = np.meshgrid(np.arange(SIZE[0]) - (SIZE[0] - 1) / 2, np.arange(SIZE[1]))
    off = v - depth_px - slope * u
    behind = 10 ** (-22 / 20) * np.where(off > 0, np.exp(-off / 40), 0)
    return 10 ** (peak_db / 20) * (np.exp(-(off**2) / (2 * sigma_px**2)) + behind)


def image(amplitude, rng, floor_db=-52.0) -> NDArray[np.uint8]:
    """The amplitude with a noise floor, log-compressed to 8 bits."""
    shape = (SIZE[1], SIZE[0])
    real, other = (gaussian_filter(rng.standard_normal(shape), (0.8, 1.2)) for _ in range(2))
    scale = 10 ** (floor_db / 20) / np.sqrt((real**2 + other**2).mean())
    level = 20 * np.log10(np.abs(amplitude + scale * (real + 1j * other)) + 1e-9)
    return np.clip(255 * (1 + level / DYNAMIC_RANGE_DB), 0, 255).round().astype(np.uint8)
