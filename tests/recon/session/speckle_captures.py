"""Captures with sweeps of made speckle: exponential powers, smoothed to grains, on a grey map that is linear in dB."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from recon.capture.manifest import SCANNER, Device
from recon.capture.writer import new_capture

Images = NDArray[np.uint8]

SIZE = (48, 300)  # px
MM_PER_PX = (0.12, 0.08)
GREYS_A_DB = 4.25
HZ, JITTER_S = 20.0, 0.002


def speckle(count: int, level_db: float, rng: np.random.Generator, grain_px: float = 1.3) -> Images:
    """B-scans : (n, h, w) of a mean level under white."""
    shape = (2, count, *SIZE[::-1])
    field = gaussian_filter(rng.standard_normal(shape), (0, 0, grain_px, grain_px))
    power = (field**2).sum(axis=0)
    return np.clip(np.rint(255 + GREYS_A_DB * (level_db + 10 * np.log10(power / power.mean()))), 0, 255).astype(np.uint8)


def in_air(count: int, rng: np.random.Generator) -> Images:
    """Ringing of the face, 4 dB over white, falling to 1/e in 0.35 mm; and noise of -45 dB."""
    depth = MM_PER_PX[1] * np.arange(SIZE[1])
    ring = 10 ** ((4.0 - 8.686 * depth / 0.35) / 20)
    noise = np.sqrt(10**-4.5 / 2) * gaussian_filter(rng.standard_normal((2, count, *SIZE[::-1])), (0, 0, 1.0, 0.7)) / 0.25
    power = (ring[:, None] + noise[0]) ** 2 + noise[1] ** 2
    return np.clip(np.rint(255 + GREYS_A_DB * 10 * np.log10(power)), 0, 255).astype(np.uint8)


def write(folder: Path, sweeps: dict[str, Images], rng: np.random.Generator) -> None:
    """A capture with sweeps by name, taken evenly but for a jitter."""
    with new_capture(folder, "phantom") as capture:
        for name, images in sweeps.items():
            times = 1e9 * (np.arange(len(images)) / HZ + JITTER_S * rng.standard_normal(len(images)) + 1)
            shown = ((SCANNER, image) for image in images)
            capture.add_sweep({SCANNER: np.rint(times).astype(np.int64)}, shown, {SCANNER: Device(size=SIZE)}, name=name)
