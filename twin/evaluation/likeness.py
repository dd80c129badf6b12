"""Likeness of a real capture and the twin's rendering of the same: figures of the images of both, by the same functions.

Nothing here needs a truth. Each statistic is a ratio of the real one to the twin's, or a difference, with the value that it has
where the twin explains the capture, its own standard deviation, and a bar.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_erosion

from recon.errors import InputError
from recon.identification.photon_transfer import TileNoise, noise_of_patterns
from recon.model.patterns import Fringes, Patterns
from recon.structured_light import frame_errors
from recon.structured_light.decode import ProjectorMap, Status
from recon.structured_light.phase import MIN_STEPS_FOR_NOISE, design, pseudo_inverse
from recon.structured_light.triangulate import PointMap
from twin.conditions import Frames
from twin.evaluation import local_residuals
from twin.optics.seen_surface import SeenLight, inside_of, stripes

Array = NDArray[np.float64]
Map = NDArray[np.float32]  # (h, w)
Mask = NDArray[np.bool_]  # (h, w)

SURE = 3.0  # standard deviations beyond a bar, from which on a statistic is off
BORDER_PX = 2  # of the compared pixels, whose neighbours are compared, too
FEWEST_PX = 1000  # that are compared
BINS = 8  # of grey level, at most
TILES = 25  # a bin, at least
HARMONICS = 6  # of the fringes, the highest that is looked at
PATCH = 32  # px, side of the squares whose noise has a spatial spectrum
RINGS = 8  # bands of spatial frequency, up to half a cycle a pixel; the first holds what is smooth in a square
BANDS = (2 * RINGS * np.hypot(np.fft.fftfreq(PATCH)[:, None], np.fft.fftfreq(PATCH))).astype(int)
HANN = 2.25  # equivalent noise bandwidth of the window over a square: neighbouring waves aren't independent
LOCKED = 5  # harmonics of the fringes that errors of frames show in a square
WIDEST = 2.0  # periods of the fringes, or 16 px: narrower stripes show two edges at once
LEAST_STRIPE_PX = 16.0
NEAR_PX, FINE = 8.0, 0.25  # projector px around an edge of light, and the step of its profile there
FARTHEST_PX = 100.0  # projector px from an edge, up to which its light is looked at
LEAST_PASSED = 0.1  # of a wave, over that of the fringes, by edges, whose change by blur is known
DARK_WIDTHS = 3.0  # of an edge, from which on it should be dark, or bright


@dataclass(frozen=True)
class Bars:
    """Deviations up to which a statistic counts as explained."""

    variance: float = 0.05  # of noise, in each bin of level
    spectrum: float = 0.15  # of the temporal power of noise and frames' errors; of noise in a band of spatial frequency
    correlation: float = 0.03  # of the modulation's maps, below 1
    sigma: float = 0.05  # of predicted over local residual
    modulation: float = 0.02  # its median over that of the light
    harmonic: float = 0.01  # of the modulation
    width: float = 0.05  # of edges of light
    halo: float = 0.01  # of the light


BARS = Bars()


@dataclass(frozen=True)
class Taken:
    """A capture, real or rendered, with its results."""

    images: NDArray  # (n, h, w) DN
    patterns: Patterns
    bits: int
    found: ProjectorMap
    points: PointMap
    distance: Map  # of the points from the camera, mm
    light: SeenLight

    def fringes(self) -> Iterator[tuple[Fringes, NDArray]]:
        """Sets of grey fringes with their images : (steps, h, w)."""
        for part, place in self.patterns.slices():
            if isinstance(part, Fringes) and part.waveform == "sine":
                yield part, self.images[place]


@dataclass(frozen=True)
class Statistic:
    """A figure of the likeness."""

    name: str
    value: float  # NaN where the capture doesn't show it
    expected: float  # 1 or 0, where the twin explains the capture
    bar: float  # deviation that counts as explained; NaN where there is none
    sigma: float = 0.0  # of the value, by noise and by the number of frames

    @property
    def off(self) -> float:
        """Deviation in bars, less what chance explains; 0 where there is no bar or nothing shows it."""
        beyond = abs(self.value - self.expected) - SURE * self.sigma
        return max(beyond / self.bar, 0.0) if np.isfinite(beyond) and np.isfinite(self.bar) else 0.0

    @property
    def explained(self) -> bool:
        """Whether it is within its bar, as far as chance lets it be told."""
        return self.off <= 1


class LevelNoise(NamedTuple):
    """Variance of noise over grey level. All (b,)."""

    level: Array  # DN
    real: Array  # DN^2
    twin: Array  # DN^2
    sigma: Array  # of real over twin


class Spectrum(NamedTuple):
    """Power over frequency. All (f,)."""

    frequency: Array
    real: Array  # DN^2
    twin: Array  # DN^2
    sigma: Array  # of real over twin, for white noise


class FrameScatter(NamedTuple):
    """Errors of frames of a set of fringes: standard deviations as found, and as the conditions have them."""

    steps: int
    real: Frames
    expected: Frames
    level_dn: float  # of the fringes' light, at which flicker counts
    modulation_dn: float


class Profile(NamedTuple):
    """Light across edges of light, from dark (negative) to bright. All (b,)."""

    place: Array  # projector px from the edge
    real: Array  # of the light between dark and bright
    twin: Array


@dataclass(frozen=True)
class Likeness:
    """All that is compared."""

    compared: Mask
    noise: LevelNoise | None  # None without eight steps of fringes, or a code with its inverse
    temporal: Spectrum | None  # over harmonics of the sequence
    spatial: Spectrum | None  # over cycles a px
    frames: FrameScatter | None
    harmonics: tuple[NDArray[np.complex128], NDArray[np.complex128]] | None  # from the second on, of the modulation; the
    # twin's as they were behind the real one's blur
    contrast: tuple[Map, Map]  # modulation over the light between dark and bright
    edges: Profile | None
    statistics: tuple[Statistic, ...]

    def __getitem__(self, name: str) -> Statistic:
        """A statistic by its name."""
        return next(one for one in self.statistics if one.name == name)

    @property
    def off(self) -> list[Statistic]:
        """Statistics beyond their bars, the farthest first."""
        return sorted((one for one in self.statistics if not one.explained), key=lambda one: -one.off)


def compare(real: Taken, twin: Taken, inside: Mask, frames: Frames) -> Likeness:
    """Compare a real capture with its rendering.

    Parameters
    ----------
    inside : (h, w) pixels of the surface whose surroundings were rendered
    frames : conditions of its frames

    Raises
    ------
    InputError
        If few pixels are on the surface and decoded in both.
    """
    both = inside & np.isfinite(real.distance) & np.isfinite(twin.distance)
    both &= (real.found.status == Status.OK) & (twin.found.status == Status.OK)
    for light in (real.light, twin.light):
        both &= np.isfinite(light.bright) & np.isfinite(light.dark) & (light.bright - light.dark > 0)
    both = binary_erosion(both, iterations=BORDER_PX)
    if np.count_nonzero(both) < FEWEST_PX:
        found = f"found {np.count_nonzero(both)}: is it a rig of that capture?"
        raise InputError(f"likeness: expected {FEWEST_PX} px or more of a surface in both captures, {found}")
    dark, full = float(np.median(twin.light.dark[both])), 2.0**real.bits - 1
    noise = level_noise(real, twin, both)
    scatter = frame_scatter(real, both, frames, dark)
    temporal, spatial = temporal_spectrum(real, twin, both), spatial_spectrum(real, twin, both)
    contrast = contrast_of(real, both), contrast_of(twin, both)
    edges = edge_profile(real, twin, both)
    found = harmonics(real, both), _as_blurred(harmonics(twin, both), twin.patterns, edges)
    statistics = [
        _variance(noise),
        _power(noise, scatter, full),
        _rings(spatial),
        *_modulation(real, twin, contrast, both),
        _harmonic(*found),
        *_edges(edges, scatter),
        *_residuals(real, twin),
        _histogram(real, twin, both),
    ]
    told = None if found[0] is None or found[1] is None else (found[0], found[1])
    return Likeness(both, noise, temporal, spatial, scatter, told, contrast, edges, tuple(statistics))


def level_noise(real: Taken, twin: Taken, both: Mask) -> LevelNoise | None:
    """Variance of one image over grey level, of tiles that lie in the compared pixels; None without fringes of eight steps."""
    ones, others = _tiles(real, both), _tiles(twin, both)
    if ones is None or others is None:
        return None
    bins = min(BINS, min(len(ones.level), len(others.level)) // TILES)
    if bins < 1:
        return None
    ends = np.quantile(ones.level, np.linspace(0, 1, bins + 1))
    rows = []
    for low, high in pairwise(ends):
        means, freedoms, level = [], [], 0.0
        for side in (others, ones):
            part = (side.level >= low) & (side.level <= high)
            if np.count_nonzero(part) < TILES / 2:
                break
            means.append(np.average(side.variance[part], weights=side.freedom[part]))
            freedoms.append(side.freedom[part].sum())
            level = np.average(side.level[part], weights=side.freedom[part])
        else:
            ratio = means[1] / means[0]
            rows.append((level, means[1], means[0], ratio * np.sqrt(2 / freedoms[0] + 2 / freedoms[1])))
    return LevelNoise(*np.array(rows).T) if rows else None


def _tiles(side: Taken, both: Mask) -> TileNoise | None:
    """Noise of tiles within the compared pixels."""
    found = noise_of_patterns(np.where(both, side.images, 0), side.patterns, side.bits)  # a tile that touches 0 is left out
    return found if found is not None and len(found.level) else None


def frame_scatter(real: Taken, both: Mask, expected: Frames, dark_dn: float) -> FrameScatter | None:
    """Errors of the frames of the first fringes, by the images alone; None of too few steps."""
    for part, images in real.fringes():
        if part.steps < MIN_STEPS_FOR_NOISE:
            continue
        full = 2.0**real.bits - 1
        errors = frame_errors.estimate(np.where(both, images, 0), part.shifts, least_modulation=4 * full / 255, saturation=full)
        turn, unit = 2 * np.pi / part.steps, 2.0 ** (real.bits - 8)
        spread = [
            float(np.sqrt((one**2).sum() / (part.steps - 1))) for one in (errors.gain, errors.offset / unit, errors.shift / turn)
        ]
        offset, c, s = np.tensordot(pseudo_inverse(part.shifts), images[:, both].astype(float), 1)
        found = Frames.model_construct(  # beyond the bounds of conditions, too
            flicker=spread[0], stray_dn=spread[1], shift=spread[2]
        )
        return FrameScatter(part.steps, found, expected, float(np.median(offset)) - dark_dn, float(np.median(np.hypot(c, s))))
    return None


def power_of(frames: Frames, scatter: FrameScatter, full: float) -> float:
    """Mean variance, DN^2, that errors of frames add to a pixel."""
    stray = frames.stray_dn * (full + 1) / 256
    shifted = scatter.modulation_dn * 2 * np.pi / scatter.steps * frames.shift
    return float((frames.flicker * scatter.level_dn) ** 2 + stray**2 + shifted**2 / 2)


def temporal_spectrum(real: Taken, twin: Taken, both: Mask) -> Spectrum | None:
    """Power of a pixel's harmonics over the sequence, from the second on; white noise of some variance has that in each."""
    for (part, ours), (_, theirs) in zip(real.fringes(), twin.fringes(), strict=True):
        if part.steps < MIN_STEPS_FOR_NOISE:
            continue
        waves = np.arange(2, part.steps // 2 + 1)
        powers = []
        for images in (ours, theirs):
            lines = np.fft.rfft(images[:, both].astype(float), axis=0)[2:]
            powers.append((np.abs(lines) ** 2).mean(axis=1) / part.steps)
        sigma = np.full(len(waves), 2 / np.sqrt(max(np.count_nonzero(both), 1)))
        return Spectrum(waves.astype(float), powers[0], powers[1], sigma)
    return None


def spatial_spectrum(real: Taken, twin: Taken, both: Mask) -> Spectrum | None:
    """Power of temporal noise over spatial frequency, in rings; 1 in the mean of all: its sum is in its variance."""
    one, other = _rings_of(real, both), _rings_of(twin, both)
    if one is None or other is None:
        return None
    (ours, squares), (theirs, _) = one, other
    modes = np.bincount(BANDS.ravel())[1:RINGS] / 2  # of a real field each counts twice
    sigma = np.sqrt(2 * HANN / (squares * modes)) * ours / theirs
    return Spectrum((np.arange(1, RINGS) + 0.5) / (2 * RINGS), ours, theirs, sigma)


def _rings_of(side: Taken, both: Mask) -> tuple[Array, int] | None:
    """Power of rings : (RINGS - 1,) over its mean, and the number of squares and independent fields that it is of."""
    down, across = (length // PATCH for length in both.shape)

    def squares(images: NDArray) -> NDArray:
        cut = images[..., : down * PATCH, : across * PATCH].reshape(*images.shape[:-2], down, PATCH, across, PATCH)
        return cut.swapaxes(-3, -2).reshape(*images.shape[:-2], down * across, PATCH**2)

    whole = squares(both).all(axis=-1)
    window = np.outer(np.hanning(PATCH + 1)[:-1], np.hanning(PATCH + 1)[:-1])
    total, power = 0, np.zeros((PATCH, PATCH))
    for part, images in side.fringes():
        if part.steps < MIN_STEPS_FOR_NOISE or not whole.any():
            continue
        values = squares(images)[:, whole].astype(float)
        left = np.linalg.svd(design(part.shifts, min(3, (part.steps - 2) // 2)).T)[2]
        left = left[1 + 2 * min(3, (part.steps - 2) // 2) :]
        offset, c, s = np.tensordot(pseudo_inverse(part.shifts), values, 1)
        phasor = c + 1j * s
        turn = np.exp(1j * np.angle(phasor))
        shapes = [np.ones_like(offset), offset]
        shapes += [part for m in range(LOCKED) for part in ((phasor * turn**m).real, (phasor * turn**m).imag)]
        basis, _ = np.linalg.qr(np.stack(shapes, axis=-1))
        fields = np.tensordot(left, values, 1)
        fields = fields - np.einsum("tpm,tqm,ktq->ktp", basis, basis, fields, optimize=True)
        waves = np.fft.fft2(fields.reshape(-1, PATCH, PATCH) * window)
        power += (np.abs(waves) ** 2).sum(axis=0)
        total += len(waves)
    if not total:
        return None
    rings = np.array([power[k == BANDS].mean() for k in range(1, RINGS)])
    return rings / rings.mean(), total


def harmonics(side: Taken, both: Mask) -> NDArray[np.complex128] | None:
    """Harmonics of the first fringes that show any, of five steps or more."""
    for part, images in side.fringes():
        if part.steps >= 5:
            return harmonics_of(part.shifts, images[:, both].astype(float))
    return None


def harmonics_of(shifts: Array, values: Array) -> NDArray[np.complex128]:
    """Temporal harmonics that follow the fringes, from the second on, of their modulation, in the mean over pixels.

    A gamma makes them; errors of frames, noise and edges have no phase in common with the fringes and fall out.

    Parameters
    ----------
    shifts : (n,) rad, n >= 5
    values : (n, pixels) DN
    """
    orders = np.arange(1, min(HARMONICS, (len(shifts) - 1) // 2) + 1)[:, None]
    lines = np.exp(-1j * orders * shifts) * 2 / len(shifts) @ values
    turned = lines * np.exp(-1j * orders * np.angle(lines[0]))
    return turned[1:].mean(axis=1) / np.abs(lines[0]).mean()


def _as_blurred(found: NDArray[np.complex128] | None, patterns: Patterns, edges: Profile | None) -> NDArray[np.complex128] | None:
    """The twin's harmonics behind a blur by which edges are as wide as the real ones: blur takes finer waves most."""
    if found is None or edges is None:
        return found
    pitch = next(
        part.pitch
        for part in patterns.parts
        if isinstance(part, Fringes) and part.waveform == "sine" and (part.steps - 1) // 2 >= 2
    )
    passed = [[passed_by(edges.place, light, pitch / k) for k in range(1, len(found) + 2)] for light in edges[1:]]
    ours, theirs = (np.array(one[1:]) / one[0] for one in passed)
    known = theirs > LEAST_PASSED
    return found * np.where(known, ours / np.where(known, theirs, 1), 1)


def contrast_of(side: Taken, both: Mask) -> Map:
    """Modulation over the light between dark and bright : (h, w), NaN elsewhere: 1/2 of sharp fringes without a gamma."""
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = side.found.modulation / (side.light.bright - side.light.dark)
    return np.where(both, ratio, np.float32(np.nan))


def edge_profile(real: Taken, twin: Taken, both: Mask) -> Profile | None:
    """Light across edges of stripes, between that of dark and of bright places; None without wide stripes."""
    chosen = [
        edges
        for edges in stripes(real.patterns)
        if np.isfinite(edges.inside_px).all() and edges.narrowest_px >= max(WIDEST * edges.pitch, LEAST_STRIPE_PX)
    ]
    if not chosen:
        return None
    near = np.arange(-NEAR_PX, NEAR_PX + FINE / 2, FINE)
    widest = max(edges.narrowest_px for edges in chosen)
    far = np.arange(NEAR_PX + 1, min(widest, FARTHEST_PX), 2.0)
    ends = np.concatenate([-far[::-1], near, far])
    sums = []
    for side in (real, twin):
        light, part = np.zeros((2, len(ends) - 1)), both
        bright = side.light.bright - side.light.dark
        for edges in chosen:
            place = inside_of(edges, side.found)[part]
            values = np.stack([side.images[edges.number][part] - side.light.dark[part], bright[part]])
            light += [np.histogram(place, ends, weights=one)[0] for one in values]
        with np.errstate(divide="ignore", invalid="ignore"):
            sums.append(light[0] / light[1])
    middle = (ends[1:] + ends[:-1]) / 2
    known = np.isfinite(sums[0]) & np.isfinite(sums[1])
    return Profile(middle[known], sums[0][known], sums[1][known]) if known.any() else None


def width_of(place: Array, light: Array) -> float:
    """Distance, projector px, over which light rises from a quarter to three quarters; NaN if it doesn't."""
    rising = np.maximum.accumulate(light)
    if rising[0] > 0.25 or rising[-1] < 0.75:
        return np.nan
    first, last = (np.interp(share, rising + 1e-9 * np.arange(len(rising)), place) for share in (0.25, 0.75))
    return float(last - first)


def passed_by(place: Array, light: Array, pitch: float) -> float:
    """Share of the modulation of fringes of a pitch that a blur lets pass by which edges are as they are."""
    rising = np.gradient(light, place)
    return float(np.abs(np.trapezoid(rising * np.exp(-2j * np.pi * place / pitch), place)))


def halo_of(profile: Profile, width: float) -> tuple[float, float]:
    """Light in the dark and missing in the bright beyond an edge's own width, real and twin's, of the light."""
    beyond = np.abs(profile.place) > max(DARK_WIDTHS * width, 2.0)
    if not beyond.any():
        return np.nan, np.nan
    bright = profile.place[beyond] > 0
    real, twin = (float(np.mean(np.where(bright, 1 - one[beyond], one[beyond]))) for one in (profile.real, profile.twin))
    return real, twin


def _variance(noise: LevelNoise | None) -> Statistic:
    """The bin of level whose variance is the farthest off."""
    if noise is None:
        return Statistic("noise_variance", np.nan, 1, BARS.variance)
    ratio = noise.real / noise.twin
    worst = int(np.argmax(np.abs(ratio - 1) - SURE * noise.sigma))
    return Statistic("noise_variance", float(ratio[worst]), 1, BARS.variance, float(noise.sigma[worst]))


def _power(noise: LevelNoise | None, scatter: FrameScatter | None, full: float) -> Statistic:
    """Temporal power of noise and errors of frames, real over expected: few frames know their scatter badly."""
    if noise is None or scatter is None:
        return Statistic("temporal_spectrum", np.nan, 1, BARS.spectrum)
    real, expected = (power_of(one, scatter, full) for one in (scatter.real, scatter.expected))
    total = float(noise.twin.mean()) + expected
    chance = expected * np.sqrt(2 / (scatter.steps - 1)) / total
    return Statistic("temporal_spectrum", (float(noise.real.mean()) + real) / total, 1, BARS.spectrum, float(chance))


def _rings(spatial: Spectrum | None) -> Statistic:
    """The ring of spatial frequency whose share of the noise is the farthest off."""
    if spatial is None:
        return Statistic("spatial_spectrum", np.nan, 1, BARS.spectrum)
    ratio = spatial.real / spatial.twin
    worst = int(np.argmax(np.abs(ratio - 1) - SURE * spatial.sigma))
    return Statistic("spatial_spectrum", float(ratio[worst]), 1, BARS.spectrum, float(spatial.sigma[worst]))


def _modulation(real: Taken, twin: Taken, contrast: tuple[Map, Map], both: Mask) -> Iterator[Statistic]:
    """Correlation of the modulation's maps, and the median ratio of contrasts."""
    maps = real.found.modulation[both], twin.found.modulation[both]
    yield Statistic("modulation_correlation", float(np.corrcoef(*maps)[0, 1]), 1, BARS.correlation)
    ratio = float(np.median(contrast[0][both]) / np.median(contrast[1][both]))
    yield Statistic("modulation_ratio", ratio, 1, BARS.modulation)
    yield Statistic("modulation_repeated", float(np.sqrt(repeated(real, both) * repeated(twin, both))), 1, np.nan)


def repeated(side: Taken, both: Mask) -> float:
    """Correlation of the modulation's maps of two captures alike, of other noise and errors of frames; NaN of few or odd steps.

    By that of the halves of the steps, r, without the harmonics that follow the fringes: twice the steps have 2 r / (1 + r).

    Source: Spearman 1910, Brown 1910.
    """
    for part, images in side.fringes():
        if part.steps < MIN_STEPS_FOR_NOISE or part.steps % 2:
            continue
        values = images[:, both].astype(float)
        _, c, s = np.tensordot(pseudo_inverse(part.shifts), values, 1)
        phase = np.angle(c + 1j * s) + part.shifts[:, None]
        for k, share in enumerate(harmonics_of(part.shifts, values), 2):
            values -= np.hypot(c, s) * (share * np.exp(1j * k * phase)).real
        halves = [np.tensordot(pseudo_inverse(part.shifts[first::2]), values[first::2], 1)[1:] for first in (0, 1)]
        r = float(np.corrcoef(*(np.hypot(*half) for half in halves))[0, 1])
        return 2 * r / (1 + r)
    return np.nan


def _harmonic(real: NDArray[np.complex128] | None, twin: NDArray[np.complex128] | None) -> Statistic:
    """The largest difference of a harmonic, of the modulation."""
    if real is None or twin is None:
        return Statistic("harmonics", np.nan, 0, BARS.harmonic)
    return Statistic("harmonics", float(np.abs(real - twin).max()), 0, BARS.harmonic)


def _edges(profile: Profile | None, scatter: FrameScatter | None) -> Iterator[Statistic]:
    """Width of edges of light, and light beyond them, which each frame's own light adds to."""
    if profile is None:
        yield Statistic("edge_width", np.nan, 1, BARS.width)
        yield Statistic("halo", np.nan, 0, BARS.halo)
        return
    real, twin = (width_of(profile.place, light) for light in (profile.real, profile.twin))
    yield Statistic("edge_width", real / twin, 1, BARS.width)
    beyond = halo_of(profile, np.nanmax([real, twin]))
    frames = Frames() if scatter is None else scatter.expected
    stray = 0.0 if scatter is None else frames.stray_dn / max(2 * scatter.level_dn, 1.0)
    yield Statistic("halo", beyond[0] - beyond[1], 0, BARS.halo, float(np.hypot(stray, frames.flicker / 2)))


def _residuals(real: Taken, twin: Taken) -> Iterator[Statistic]:
    """Sigma as the twin predicts it, and as the images themselves do, over what neighbouring points leave."""
    ratio = local_residuals.smooth_noise_ratio(real.distance, twin.points.sigma)
    yield Statistic("twin_sigma_over_residual", 1 / ratio, 1, BARS.sigma)
    own = local_residuals.smooth_noise_ratio(real.distance, real.points.sigma)
    yield Statistic("own_sigma_over_residual", 1 / own, 1, np.nan)
    rendered = local_residuals.smooth_noise_ratio(twin.distance, twin.points.sigma)
    yield Statistic("twin_sigma_over_twin_residual", 1 / rendered, 1, np.nan)


def _histogram(real: Taken, twin: Taken, both: Mask) -> Statistic:
    """The largest difference of the shares of pixels up to a grey level, over all images (Kolmogorov)."""
    shares = [np.cumsum(histogram(side, both)) for side in (real, twin)]
    return Statistic("histogram_distance", float(np.abs(shares[0] - shares[1]).max()), 0, np.nan)


def histogram(side: Taken, both: Mask) -> Array:
    """Share of the compared pixels of all images at each grey level : (2^bits,)."""
    counts = np.zeros(2**side.bits)
    mask = both.astype(np.uint8)
    for image in side.images:
        counts += cv2.calcHist([image.astype(np.uint16)], [0], mask, [len(counts)], [0, len(counts)]).ravel()
    return counts / max(counts.sum(), 1)
