"""A plain camera for tests: it sees a given projector coordinate at each pixel. No optics, so that truth is exact."""

import numpy as np
from numpy.typing import NDArray

from recon.model.patterns import Patterns
from recon.structured_light.decode import ProjectorMap
from recon.structured_light.phase import Noise

NOISE = Noise(0.5, 0.033)  # DN^2, DN


def photograph(
    patterns: Patterns,
    maps: dict[str, NDArray],
    rng: np.random.Generator,
    *,
    light: NDArray | float = 180.0,
    ambient: NDArray | float = 8.0,
    blur: float = 0.5,
    gamma: float = 1.0,
    noise: Noise = NOISE,
) -> NDArray[np.uint8]:
    """Images : (n, h, w) uint8 of a scene whose pixels see the projector coordinates `maps[axis]` : (h, w) px, NaN in shadow.

    `light` is what a fully lit pixel adds to the `ambient`, DN; `blur` the projector's defocus, sigma in projector px. Rounding
    adds 1/12 DN^2; the noise given is the sum.
    """
    oversample = 8
    images, seen = [], {}
    light, ambient = np.float32(light), np.float32(ambient)
    read, gain = np.float32(noise.read_variance - 1 / 12), np.float32(noise.gain)
    for axis, binary, profile in patterns.profiles():
        length = patterns.length(axis)
        fine = np.repeat(np.asarray(profile, float) ** (1.0 if binary else gamma), oversample)
        offsets = np.arange(-6 * oversample, 6 * oversample + 1)
        kernel = np.exp(-0.5 * (offsets / (max(blur, 0.05) * oversample)) ** 2)
        places = (np.arange(length * oversample) + 0.5) / oversample - 0.5
        if not binary:  # grey levels vary slowly: interpolate them, so that the map's truth isn't quantised to the raster
            fine = np.interp(places, np.arange(length), np.asarray(profile, float) ** gamma)
        fine = np.convolve(np.pad(fine, len(offsets) // 2, mode="edge"), kernel / kernel.sum(), mode="valid")
        if axis not in seen:
            seen[axis] = _between(maps[axis], places)
        number, share = seen[axis]
        fine = np.append(fine, [0, 0]).astype(np.float32)  # the last two: what isn't lit
        image = ambient + light * (fine[number] + share * (fine[number + 1] - fine[number]))
        image = image + rng.standard_normal(image.shape) * np.sqrt(np.maximum(read + gain * image, 0))
        images.append(np.clip(np.rint(image), 0, 255).astype(np.uint8))
    return np.stack(images)


def _between(x: NDArray, places: NDArray) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Number of the place before each coordinate x : (h, w), of evenly spaced ones, and the share of the step to the next.

    Of coordinates beyond all places, and of NaN, it is the first of two more.
    """
    lit = (x >= places[0]) & (x <= places[-1])
    steps = np.where(lit, (x - places[0]) / (places[1] - places[0]), len(places))
    number = np.where(lit, np.minimum(steps.astype(int), len(places) - 2), len(places))
    return number, (steps - number).astype(np.float32)


def projector_map(
    columns: NDArray | None = None,
    rows: NDArray | None = None,
    sigma_columns: NDArray | None = None,
    sigma_rows: NDArray | None = None,
) -> ProjectorMap:
    """A map of these coordinates, (h, w) each, all of them decoded."""
    shape = next(image.shape for image in (columns, rows) if image is not None)
    nothing, status = np.zeros(shape, np.float32), np.zeros(shape, np.uint8)
    shown = (nothing, nothing, nothing, status, status == 0)
    return ProjectorMap(columns, rows, sigma_columns, sigma_rows, *shown, NOISE, {})


def breast(shape: tuple[int, int] = (1024, 1280), middle: float = 639.5) -> NDArray[np.float64]:
    """Projector columns : (h, w) of a smooth dome on a table, with the shadow of its flank; NaN in shadow."""
    height, width = shape
    v, u = np.mgrid[:height, :width].astype(float)
    radius = np.hypot((u - 0.5 * width) / (0.36 * width), (v - 0.5 * height) / (0.45 * height))
    x = middle + 0.55 * (u - width / 2) + 0.02 * (v - height / 2) + 0.04 * width * np.cos(np.pi / 2 * np.clip(radius, 0, 1)) ** 2
    x[(np.hypot((u - 0.56 * width) / (0.36 * width), (v - 0.5 * height) / (0.45 * height)) < 1) & (radius > 1)] = np.nan
    return x


def island(rng: np.random.Generator, shape: tuple[int, int] = (320, 480), middle: float = 639.5) -> tuple[NDArray, NDArray]:
    """A slanted background with the line, and a nearer object off the line, in shadow on one side and touching on the other.

    Returns the projector columns : (h, w), NaN in shadow, and the object's mask : (h, w). The jump along the touching border
    varies, passing whole numbers of periods.
    """
    height, width = shape
    v, u = np.mgrid[:height, :width].astype(float)
    x = middle + 0.55 * (u - 0.35 * width) + rng.uniform(-0.05, 0.05) * (v - height / 2)
    x += rng.uniform(0, 3) * np.sin(2 * np.pi * (u / width * rng.uniform(0.3, 1.5) + rng.uniform()))
    a, b = rng.uniform(0.08, 0.16) * width, rng.uniform(0.15, 0.3) * height
    cu, cv = rng.uniform(0.65, 0.75) * width, rng.uniform(0.4, 0.6) * height
    power = rng.choice([2, 8])  # an ellipse, or nearly a box
    inside = np.abs((u - cu) / a) ** power + np.abs((v - cv) / b) ** power < 1
    raised = x + rng.uniform(6, 60) + rng.uniform(-0.12, 0.12) * (v - cv) + rng.uniform(-0.1, 0.1) * (u - cu)
    shadow = (np.abs((u - cu - 0.35 * a) / a) ** power + np.abs((v - cv) / b) ** power < 1) & ~inside
    x = np.where(inside, raised, x)
    x[shadow] = np.nan
    return x, inside


def whole_jumps(x: NDArray, inside: NDArray, pitch: float) -> float:
    """Share of an object's touching border whose jump is a whole number of periods, to 0.4 rad: what no phase can see."""
    jumps = []
    for here, there in ((np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1], np.s_[1:])):
        jump = (x[there] - x[here])[inside[here] != inside[there]] / pitch
        jumps += jump[np.isfinite(jump)].tolist()
    return float(np.mean(np.abs(jumps - np.rint(jumps)) < 0.4 / (2 * np.pi)))
