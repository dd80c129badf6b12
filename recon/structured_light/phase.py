"""Phase of N-step fringes by least squares, and the noise that comes with it."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from recon.compiled import kernel, njit
from recon.threads import in_threads

Array = NDArray[np.float64]
Image = NDArray[np.float32]

QUANTISATION = 1 / 12  # DN^2, variance of rounding to whole digital numbers
MIN_STEPS_FOR_NOISE = 8  # below eight steps no temporal harmonic is free of the projector's second and third
GAMMA_HARMONICS = 3  # the highest that a gamma adds with some strength
EVEN = 3.0  # condition number up to which shifts are even enough to tell harmonics apart: of even ones it is 1.4
NOISIER = 1.02  # variance of the phase that being blind to them may cost
ONE_SIGMA = 0.6827  # of normal values are within a standard deviation
GOLDEN = 0.618034  # whose multiples fill the interval from 0 to 1 evenly, however many
NOISE_SAMPLES = 40_000  # pixels of the estimate; enough for 1 % in the variance

BRIGHTEST = 6  # row of the sums: the brightest image

PI, HALF_PI = np.float32(np.pi), np.float32(np.pi / 2)
# atan(t) / t as a polynomial in t^2: least squares at Chebyshev nodes of [0, 1].
ATAN = tuple(np.float32(c) for c in (1.0, -0.33333284, 0.1999823, -0.14261574, 0.10940199, -0.08372064, 0.05746356, -0.03071751,
                                     0.01068072, -0.0017437012))  # fmt: skip


class Noise(NamedTuple):
    """Photon-transfer noise of a camera: `variance = read_variance + gain * intensity`, in DN^2 and DN."""

    read_variance: float  # DN^2, rounding included
    gain: float  # DN of variance a DN of intensity

    def scaled(self, factor: float) -> "Noise":
        """The same noise when digital numbers are `factor` times as large."""
        return Noise(self.read_variance * factor**2, self.gain * factor)


DEFAULT_NOISE = Noise(0.5, 0.033)  # 8-bit; an 1/1.8" sensor of some 7700 electrons full well: 255 / 7700 DN an electron


class FrameErrors(NamedTuple):
    """Errors of n frames, each of which shows `(1 + gain) I(phase + shift) + offset` instead of `I(phase)`."""

    gain: Array  # (n,) relative
    offset: Array  # (n,) DN
    shift: Array  # (n,) rad, beyond that of the sequence
    covariance: Array  # (3 n, 3 n), in this order

    def levelled(self, images: Image) -> Image:
        """Images : (n, ...) without their errors of gain and offset."""
        each = (slice(None), *(None,) * (images.ndim - 1))
        return (images - np.float32(self.offset)[each]) / np.float32(1 + self.gain)[each]

    def phase_variance(self, shifts: Array) -> Array:
        """Variance of a phase by the covariance, rad^2, as the four numbers of `(a + b A + c A^2) / B^2 + d`.

        For offset A and modulation B, in the mean over all phases. An error moves the phasor `B exp(i phase)` by a constant, by
        a share of its conjugate and by one of itself.
        """
        _, c, s = pseudo_inverse(shifts + self.shift)
        phasor, turn, none = c + 1j * s, np.exp(1j * shifts), np.zeros(len(shifts))
        by_offset, by_gain = np.concatenate([none, phasor, none]), np.concatenate([phasor, none, none])
        of_conjugate = np.concatenate([phasor / turn, none, -1j * phasor / turn]) / 2
        of_itself = np.concatenate([(phasor * turn).imag, none, (phasor * turn).real]) / 2

        def covariance(x: NDArray, y: NDArray) -> float:
            return float((x @ self.covariance @ y.conj()).real)

        constant = (covariance(by_offset, by_offset), 2 * covariance(by_offset, by_gain), covariance(by_gain, by_gain))
        return np.array([*constant, covariance(of_conjugate, of_conjugate) + 2 * covariance(of_itself, of_itself)]) / 2


def steady(n: int) -> FrameErrors:
    """No errors of n frames."""
    none = np.zeros(n)
    return FrameErrors(none, none, none, np.zeros((3 * n, 3 * n)))


class Fringe(NamedTuple):
    """A decoded fringe sequence. All (h, w)."""

    phase: Image  # rad, in (-pi, pi]
    modulation: Image  # B, DN
    offset: Image  # A, DN
    sigma: Image  # rad, predicted standard deviation of the phase; inf without modulation
    saturated: NDArray[np.bool_]  # any image at or above full scale


class Fit(NamedTuple):
    """Figures of the fit, for compiled code. All float32."""

    weights: Image  # (6, n) of the images in A, B cos(phase), B sin(phase), and in the variances of the latter two
    start: Image  # (3,) of A, B cos(phase), B sin(phase), without the images
    quadratic: Image  # (3,) sums of the last three weights
    common: Image  # (4,) a variance that all pixels share, see `FrameErrors.phase_variance`
    read_variance: float  # DN^2
    gain: float  # DN of variance a DN of intensity
    saturation: float  # DN


def wrapped_phase(
    images: NDArray, shifts: ArrayLike, *, noise: Noise, saturation: float, errors: FrameErrors | None = None
) -> Fringe:
    """Least-squares phase of an N-step fringe sequence.

    Parameters
    ----------
    images : (n, h, w) uint8, uint16 or float32
        Intensities `A + B cos(phase + shift)`, in digital numbers (DN), n >= 3.
    shifts : (n,) float, rad
        Any spacing; need not divide the circle evenly.
    noise : Noise
        Of one image; propagated through the fit to `sigma`. For even spacing and noise of one variance s^2 that is
        `sqrt(2 / n) * s / B`.
    saturation : float, DN
        Full scale: a pixel that reaches it in any image is marked.
    errors : FrameErrors
        Known errors of the images, by default none. Their covariance counts to `sigma`, too.

    Returns
    -------
    Fringe
        phase, modulation, offset, sigma float32 and saturated bool, each (h, w).

    Raises
    ------
    ValueError
        If fewer than three images are given, their number is not that of the shifts, or the shifts leave the phase
        undetermined.

    Source: Greivenkamp 1984, generalized data reduction (least squares).
    """
    images, shifts = np.asarray(images), np.asarray(shifts, float)
    if images.ndim != 3 or shifts.shape != (len(images),) or len(images) < 3:
        raise ValueError(f"expected n >= 3 images (n, h, w) and n shifts, found {images.shape} and {shifts.shape}")
    errors = steady(len(shifts)) if errors is None else errors
    solve = phase_weights(shifts + errors.shift) / (1 + errors.gain)
    # The phase error of unit noise in image i is (cos(phase) s_i - sin(phase) c_i) / B: its variance needs three quadratic sums.
    _, c, s = solve
    weights = np.concatenate([solve, [c * c, c * s, s * s]]).astype(np.float32)
    start, quadratic = np.float32(-solve @ errors.offset), weights[3:].sum(axis=1)
    common = np.float32(errors.phase_variance(shifts))
    images, shape = np.ascontiguousarray(images), images.shape[1:]
    empty = np.empty((4, *shape), np.float32)
    fringe = Fringe(empty[0], empty[1], empty[2], empty[3], np.empty(shape, np.bool_))
    fit = Fit(weights, start, quadratic, common, np.float32(noise.read_variance), np.float32(noise.gain), np.float32(saturation))
    in_threads(lambda first, end: _fit(first, end, images, fit, np.empty((7, shape[1]), np.float32), fringe), shape[0])
    return fringe


def pseudo_inverse(shifts: Array) -> Array:
    """Least-squares weights : (3, n) that turn n intensities into A, B cos(phase), B sin(phase)."""
    waves = design(shifts)
    if np.linalg.cond(waves) > 1e3:
        raise ValueError(f"shifts {np.round(shifts, 3).tolist()} rad leave the phase undetermined")
    return np.linalg.pinv(waves)


def phase_weights(shifts: Array) -> Array:
    """The same weights, blind to harmonics 2 and 3 of a projector's gamma as well, as far as that costs no noise.

    Even shifts are blind to them without more ado; for shifts a little off the harmonics are fitted, too.
    """
    best = least = pseudo_inverse(shifts)
    for highest in range(2, min(GAMMA_HARMONICS, (len(shifts) - 1) // 2) + 1):
        waves = design(shifts, highest)
        if np.linalg.cond(waves) > EVEN:
            break
        more = np.linalg.pinv(waves)[:3]
        if (more[1:] ** 2).sum() < NOISIER * (least[1:] ** 2).sum():
            best = more
    return best


def design(shifts: Array, highest: int = 1) -> Array:
    """Shares : (n, 1 + 2 highest) of A, and of the cosine and sine parts of each harmonic, in n intensities."""
    waves = [wave for k in range(1, highest + 1) for wave in (np.cos(k * shifts), -np.sin(k * shifts))]
    return np.stack([np.ones_like(shifts), *waves], axis=1)


@njit(inline="always")
def _arctangent(y, x):
    """Angle of (x, y) in (-pi, pi], to 3e-7 rad in float32; branch-free, so that a row is computed with vector instructions."""
    ax, ay = abs(x), abs(y)
    t = min(ax, ay) / max(max(ax, ay), np.float32(1e-30))
    q = t * t
    p = ATAN[9]
    for i in range(8, -1, -1):
        p = p * q + ATAN[i]
    angle = p * t
    angle = HALF_PI - angle if ay > ax else angle
    angle = PI - angle if x < 0 else angle
    return -angle if y < 0 else angle


@kernel
def _fit(first, end, images, fit, sums, fringe):
    """Fit rows `first` to `end`, not included; `sums` : (7, w) has room for those of a row."""
    n, _, width = images.shape
    weights, quadratic, common, read, gain = fit.weights, fit.quadratic, fit.common, fit.read_variance, fit.gain
    for v in range(first, end):
        sums[:] = 0
        sums[0], sums[1], sums[2] = fit.start[0], fit.start[1], fit.start[2]
        for i in range(n):
            row = images[i, v]
            w0, w1, w2, w3, w4, w5 = weights[0, i], weights[1, i], weights[2, i], weights[3, i], weights[4, i], weights[5, i]
            for u in range(width):
                value = np.float32(row[u])
                sums[0, u] += w0 * value
                sums[1, u] += w1 * value
                sums[2, u] += w2 * value
                sums[3, u] += w3 * value
                sums[4, u] += w4 * value
                sums[5, u] += w5 * value
                sums[BRIGHTEST, u] = max(sums[BRIGHTEST, u], value)
        for u in range(width):
            x, y = sums[1, u], sums[2, u]
            square = x * x + y * y
            amplitude = math.sqrt(square)
            fringe.phase[v, u] = _arctangent(y, x)
            fringe.offset[v, u], fringe.modulation[v, u] = sums[0, u], amplitude
            cc = read * quadratic[0] + gain * sums[3, u]
            cs = read * quadratic[1] + gain * sums[4, u]
            ss = read * quadratic[2] + gain * sums[5, u]
            by_noise = max(x * x * ss - np.float32(2) * x * y * cs + y * y * cc, np.float32(0)) / square
            shared = common[0] + sums[0, u] * (common[1] + sums[0, u] * common[2])
            fringe.sigma[v, u] = math.sqrt((by_noise + shared) / square + common[3]) if square > 0 else np.float32(np.inf)
            fringe.saturated[v, u] = sums[BRIGHTEST, u] >= fit.saturation


def estimate_noise(
    images: NDArray, shifts: ArrayLike, *, saturation: float = 255, errors: FrameErrors | None = None
) -> Noise | None:
    """Measure the camera's noise from the fringes themselves.

    A sinusoid fills the mean and the first temporal harmonic of an evenly shifted sequence. The others hold noise, the same in
    each, and additions of the projector and the lamp: harmonics 2 and 3 its non-linearity (gamma; the fourth is 0.14 % of the
    modulation for gamma 2.2), odd ones the edges of binary fringes, any of them its flicker. Since these only add, the
    quietest harmonic is the noise; its power against the mean intensity is the photon-transfer line.

    Parameters
    ----------
    images : (n, h, w), DN
    shifts : (n,) float, rad
    saturation : float, DN
        Pixels that reach it, or that touch zero, are clipped and left out.
    errors : FrameErrors
        Known errors of the images, which are no noise.

    Returns
    -------
    Noise or None
        None if n < 8, the shifts are not even steps through the whole circle, or too few pixels are left.

    Source: photon transfer after EMVA 1288 (variance against mean).
    """
    images, shifts = np.asarray(images), np.asarray(shifts, float)
    n = len(images)
    even = np.allclose(np.diff(shifts), 2 * np.pi / n, atol=1e-6)
    if n < MIN_STEPS_FOR_NOISE or not even:
        return None
    samples = sample_pixels(images, NOISE_SAMPLES)
    samples = samples[:, (samples.max(axis=0) < saturation) & (samples.min(axis=0) > 0)]
    if samples.shape[1] < 500:
        return None
    if errors is not None:
        samples = _corrected(samples, shifts, errors)
    quietest = min((_harmonic(samples, k) for k in range(2, n // 2 + 1)), key=lambda values: np.mean(np.abs(values)))
    return _photon_transfer(samples.mean(axis=0), quietest)


def _corrected(samples: Image, shifts: Array, errors: FrameErrors) -> Image:
    """Samples : (n, pixels) as they would be without errors of the frames."""
    samples, shifted = errors.levelled(samples), shifts + errors.shift
    return samples + np.float32((design(shifts) - design(shifted)) @ pseudo_inverse(shifted)) @ samples


def _harmonic(samples: Image, k: int) -> Image:
    """Temporal harmonic k of samples : (n, pixels), as one or two rows that have the variance of one image."""
    n = len(samples)
    angle = 2 * np.pi * k * np.arange(n) / n
    waves = [np.cos(angle)] if 2 * k == n else [np.sqrt(2) * np.cos(angle), np.sqrt(2) * np.sin(angle)]
    return np.array(waves, np.float32) @ samples / np.float32(np.sqrt(n))


def sample_pixels(images: NDArray, count: int) -> Image:
    """About `count` pixels of all images : (n, pixels) float32.

    On a grid whose rows and columns are shifted against each other, as a regular one may see fringes in a few phases alone.
    """
    height, width = images[0].shape
    step = max(1, int(np.sqrt(height * width / count)))
    i, j = np.mgrid[: height // step, : width // step]
    shifts = (step * (GOLDEN * np.arange(max(i.shape)) % 1)).astype(int)
    return images[:, i * step + shifts[j], j * step + shifts[i]].reshape(len(images), -1).astype(np.float32)


def _photon_transfer(level: Image, residuals: Image) -> Noise:
    """Line `variance = a + b * level` through the robust variance of the residuals : (m, pixels) in bins of level."""
    order = np.argsort(level)
    levels, variances, counts = [], [], []
    for part in np.array_split(order, min(16, max(1, len(order) // 500))):
        values = residuals[:, part].ravel()
        scale = max(np.quantile(np.abs(values), ONE_SIGMA), np.sqrt(QUANTISATION))  # in the dark half are rounded to zero
        kept = values[np.abs(values) < 4 * scale]  # a clip at 4 sigma keeps the variance to 0.1 %
        levels.append(level[part].mean())
        variances.append(np.mean(kept.astype(float) ** 2))
        counts.append(kept.size)
    x, y = np.array(levels, float), np.array(variances)
    weight = np.sqrt(np.array(counts)) / np.maximum(y, QUANTISATION)  # the variance of a variance is 2 v^2 / n
    design = np.stack([np.ones_like(x), x], axis=1)
    a, b = np.linalg.lstsq(design * weight[:, None], y * weight, rcond=None)[0]
    if b < 0:
        a, b = np.average(y, weights=weight**2), 0.0
    elif a < QUANTISATION:
        a = QUANTISATION
        b = max(np.sum(weight**2 * x * (y - a)) / np.sum(weight**2 * x * x), 0.0)
    return Noise(float(a), float(b))
