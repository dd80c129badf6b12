"""Errors of the frames of a fringe sequence, from its images: gains of a lamp that flickers, offsets, and wrong phase shifts.

Three numbers are fitted to the n frames of each pixel. Errors that all pixels of a frame share leave residuals in common, which
noise does not, so they follow by least squares. But some leave none, as they look like fringes: offsets and gains that rise and
fall once over the sequence move the mean phasor of a window of whole periods off zero; gains that do so twice, with shifts, the
mean of its square. Both vanish without errors where reflectance doesn't vary in step with the fringes. The mean gain, offset
and shift look like other light, or another surface: errors are counted from these.

The standard deviations of gains, offsets and shifts are estimated with them, and so are those of the phasors (empirical Bayes).
Errors of a steady sequence come out as none, and errors that the images don't show count as much as those that they show.

Sources: Wang and Han 2004 (shifts from images); Vargas and others 2011 (phasors whose means vanish); MacKay 1992 (standard
deviations).
"""

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from recon.structured_light.phase import DEFAULT_NOISE, FrameErrors, design, pseudo_inverse, steady

Array = NDArray[np.float64]
Phasors = NDArray[np.complex128]
Image = NDArray[np.float32]
Mask = NDArray[np.bool_]

LEAST_STEPS = 4  # three frames leave no residuals
FEWEST = 200  # pixels that are looked at
ROUNDS = 2  # of linearisation; errors of a twentieth are left at a thousandth by one
LINEAR = 3e-3  # gain, or shift in rad: less needs no second round
EVERY = 64  # rows and columns, of which one shows the fringes' period
UPDATES = 10  # of the standard deviations
START = np.array([0.02, 2e-3, 0.02])  # standard deviations of gains, offsets of full scale, and shifts in rad, to begin with
LEAST, MOST = 1e-3 * START, 10 * START
SAMPLES = 4  # a period along an axis, of the pixels that are looked at
THINNEST = 3  # of a period, at least one of these where the fringes run along the axis
WINDOW = 0.75  # periods, standard deviation of a Gaussian: 2e-5 of the fringes are left in its mean
SHARED = 9  # windows that show the same, with one standard deviation from one to the next
WHOLE = 0.998  # of a window, that must be known
FEW = 3  # windows
UNUSUAL = 5  # standard deviations, from which on a phasor is left out
SURE = 1e-4  # of the modulation: no phasor is more certain
MEDIAN = np.sqrt(2 * np.log(2))  # of the length of a complex normal number, per part's standard deviation
ROUNDING = 1 / 12  # DN^2, of whole numbers: no residual is known better, be the images computed
FIXED = 1e6  # weight by which mean errors are held at zero


class Observed(NamedTuple):
    """Phasors of windows that vanish without errors, and their slopes by the errors."""

    values: Phasors  # (w,) of the modulation
    slopes: Phasors  # (w, 3 n), or one row for all


def estimate(images: NDArray, shifts: Array, *, least_modulation: float, saturation: float) -> FrameErrors:
    """Estimate the errors of the frames of one set of fringes.

    Parameters
    ----------
    images : (n, h, w), DN
    shifts : (n,) rad, as they should be
    least_modulation : DN
        Of the pixels that count.
    saturation : DN
        Full scale; pixels that reach it, or zero, don't count.

    Returns
    -------
    FrameErrors
        None of them with fewer than four frames, or with too few pixels.
    """
    found = steady(len(shifts))
    if len(shifts) < LEAST_STEPS:
        return found
    turns = _turns(images, shifts, least_modulation)
    period = 2 * np.pi / np.hypot(*turns)
    down, across = strides = [int(np.clip(2 * np.pi / turn / SAMPLES, 1, max(period / THINNEST, 1))) for turn in turns]
    thin = images[:, down // 2 :: down, across // 2 :: across].astype(np.float32)
    unclipped = (thin.max(axis=0) < saturation) & (thin.min(axis=0) > 0)
    for _ in range(ROUNDS):
        data = found.levelled(thin)
        fit = _fitted(data, shifts + found.shift)
        valid = unclipped & (np.hypot(fit[1], fit[2]) > least_modulation)
        if np.count_nonzero(valid) < FEWEST:
            return found
        normal, right = _by_residuals(data[:, valid], fit[:, valid], shifts + found.shift, saturation)
        observed = _by_windows(fit, valid, WINDOW * period / np.array(strides), shifts + found.shift)
        before, found = found, _solved(found, normal, right, observed, saturation)
        if max(np.abs(found.gain - before.gain).max(), np.abs(found.shift - before.shift).max()) < LINEAR:
            break
    return found


def _fitted(data: Image, shifts: Array) -> Image:
    """Offset A, B cos(phase) and B sin(phase) : (3, ...) of images : (n, ...)."""
    return np.tensordot(pseudo_inverse(shifts).astype(np.float32), data, 1)


def _turns(images: NDArray, shifts: Array, least: float) -> list[float]:
    """Median turn of the phase, rad, from a pixel to the next down and across, in some lines; once round the image, at least."""
    turns = []
    for lines in (images[:, :, EVERY // 4 :: EVERY].transpose(0, 2, 1), images[:, EVERY // 4 :: EVERY]):
        _, c, s = _fitted(lines.astype(np.float32), shifts)
        phasor = c + 1j * s
        lit = c * c + s * s > least**2
        turn = np.angle((phasor[:, 1:] * phasor[:, :-1].conj())[lit[:, 1:] & lit[:, :-1]])
        turns.append(max(float(np.median(np.abs(turn))) if turn.size else 0.0, 2 * np.pi / lines.shape[2]))
    return turns


def _slopes(shifts: Array) -> Array:
    """Slopes of frames by gain, offset and shift : (3, n, 4), as shares of A, B cos(phase), B sin(phase) and 1."""
    none, one = np.zeros(len(shifts)), np.ones(len(shifts))
    gain = [one, np.cos(shifts), -np.sin(shifts), none]
    offset = [none, none, none, one]
    shift = [none, -np.sin(shifts), -np.cos(shifts), none]
    return np.stack([gain, offset, shift]).transpose(0, 2, 1)


def _by_residuals(data: Image, fit: Image, shifts: Array, saturation: float) -> tuple[Array, Array]:
    """Normal equations : (3 n, 3 n), (3 n,) of the errors, from the residuals of pixels : (n, p), (3, p).

    A residual is the errors' intensities, projected off the fit, so all sums over pixels are those of products of A,
    B cos(phase), B sin(phase) and 1.
    """
    project = np.eye(len(shifts)) - design(shifts) @ pseudo_inverse(shifts)
    noise = DEFAULT_NOISE.scaled(saturation / 255)
    known = np.concatenate([fit, np.ones((1, fit.shape[1]), np.float32)])
    weighted = known / np.maximum(noise.read_variance + noise.gain * fit[0], noise.read_variance / 2)
    residual = project.astype(np.float32) @ data
    power = float(weighted[3] @ (residual**2).sum(axis=0)) / (len(shifts) - 3)
    excess = max(power, ROUNDING * float(weighted[3].sum())) / residual.shape[1]
    products, pulls = (weighted @ known.T).astype(float), (weighted @ residual.T).astype(float)
    # Rounded alike in many like pixels, sums seem to show errors that leave no residuals: none is left by an exact projection
    products, pulls = (products + products.T) / 2, pulls @ project
    slopes = _slopes(shifts)
    normal = np.einsum("akx,xy,bly,kl->akbl", slopes, products, slopes, project)
    right = np.einsum("akx,xk->ak", slopes, pulls)
    return normal.reshape(right.size, right.size) / excess, right.ravel() / excess


def _by_windows(fit: Image, valid: Mask, width: Array, shifts: Array) -> tuple[Observed, ...]:
    """Mean phasors, and means of their squares, of windows of whole periods; none if there are too few such windows."""
    a, c, s = fit
    maps = np.stack([a, c, s, c * c - s * s, 2 * c * s, c * c + s * s])
    a, c, s, real, imaginary, power = _window_means(maps, valid, width)
    if len(a) < FEW:
        return ()
    solve, modulation = pseudo_inverse(shifts), np.sqrt(power)
    slopes = np.tile(solve[1] + 1j * solve[2], 3)[:, None] * _slopes(shifts).reshape(-1, 4)  # of the phasor
    once = (np.stack([a, c, s, np.ones_like(a)], axis=1) / modulation[:, None]) @ slopes.T
    # of the square, 2 z dz: the means of z times A, B cos, B sin and 1 are 0, B^2 / 2, i B^2 / 2 and 0
    twice = np.array([[0, 1, 1j, 0]]) @ slopes.T
    phasors, squares = (c + 1j * s) / modulation, (real + 1j * imaginary) / power
    usual = _usual(phasors) & _usual(squares)
    if np.count_nonzero(usual) < FEW:
        return ()
    return Observed(phasors[usual], once[usual]), Observed(squares[usual], twice)


def _window_means(maps: Image, valid: Mask, width: Array) -> Array:
    """Means : (m, w) of maps : (m, h, w) over the windows in which all is known; of a standard deviation down and across."""
    down, across = np.maximum(np.rint(width), 1).astype(int)

    def means(one: Image) -> Image:
        blurred = cv2.GaussianBlur(one, (0, 0), sigmaX=width[1], sigmaY=width[0], borderType=cv2.BORDER_CONSTANT)
        return blurred[down // 2 :: down, across // 2 :: across]

    share = means(valid.astype(np.float32))
    whole = share > WHOLE
    return np.array([means(np.where(valid, one, np.float32(0)))[whole] / share[whole] for one in maps], float)


def _solved(known: FrameErrors, normal: Array, right: Array, observed: tuple[Observed, ...], saturation: float) -> FrameErrors:
    """The errors after a step of least squares, with the standard deviations that explain them best."""
    n, unit = len(known.gain), np.array([1, saturation, 1])
    before = np.concatenate([known.gain, known.offset, known.shift])
    shares = [_equations(one) for one in observed]
    widest = scatters = [_scatter(one.values - _middle(one.values)) for one in observed]
    sigma, found = START * unit, known
    for _ in range(UPDATES):
        precision = np.repeat(sigma**-2, n)
        total = normal + np.diag(precision) + np.kron(np.diag(FIXED * sigma**-2), np.ones((n, n)))
        pull = right - precision * before
        for (by_slopes, by_values), scatter in zip(shares, scatters, strict=True):
            total, pull = total + by_slopes / scatter**2, pull + by_values / scatter**2
        covariance = np.linalg.inv(total)
        step = covariance @ pull
        gain, offset, shift = errors = (before + step).reshape(3, n)
        found = FrameErrors(gain, offset, shift, covariance)
        squares = (errors**2).sum(axis=1) + np.diag(covariance).reshape(3, n).sum(axis=1)
        sigma = np.clip(np.sqrt(squares / (n - 1)), LEAST * unit, MOST * unit)
        scatters = [min(_scatter(one.values - one.slopes @ step), most) for one, most in zip(observed, widest, strict=True)]
    return found


def _equations(observed: Observed) -> tuple[Array, Array]:
    """Normal equations : (3 n, 3 n), (3 n,) of phasors with a scatter of 1."""
    back, alike = observed.slopes.conj().T, len(observed.values) // len(observed.slopes)
    values = observed.values.reshape(-1, alike).sum(axis=1)
    return (back @ observed.slopes).real * alike / SHARED, (back @ values).real / SHARED


def _usual(values: Phasors) -> Mask:
    """Phasors that aren't outliers, such as those of windows in which fringes are much wider than elsewhere, or end."""
    off = values - _middle(values)
    return np.abs(off) < UNUSUAL * _scatter(off)


def _middle(values: Phasors) -> complex:
    """Median of real and of imaginary parts."""
    return complex(np.median(values.real), np.median(values.imag))


def _scatter(values: Phasors) -> float:
    """Robust standard deviation of each part of complex numbers around zero."""
    return max(float(np.median(np.abs(values))) / float(MEDIAN), SURE)
