"""Bend of the phase by light that isn't proportional to the fringes' grey levels, measured on the fringes themselves and undone.

A projector's gamma, or a camera's, adds harmonics to a sinusoid. N steps take harmonics N - 1 and N + 1 for the fundamental: the
phasor of a phase is not `exp(i phase)` but

    exp(i phase) + c exp(-i (N - 1) phase) + d exp(i (N + 1) phase),

and the phase bends N times a period. Of a gamma g, c is (g - 1) / (g + 2) for three steps and a hundredth of that order for four,
less what blur takes; d is 0.02 and less. Two things show it without any knowledge of the projector:

- Over whole periods of a smooth surface all phases are seen equally often. Means of `exp(i N phase)` and `exp(2 i N phase)` over
  windows vanish when c and the small rest, `e sin(2 N phase)`, are undone.
- Fringes too wide for that, as a coarse cue, or too fine for the pixels, are compared with other ones; see `straightening`.

The noise of the phase is magnified where it is stretched, and what may be left of the bend counts to it.

Sources: Guo, He and Chen 2004 (histogram of the phase); Liu and others 2010 (harmonics of a gamma).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from recon.compiled import kernel
from recon.model.patterns import Fringes
from recon.structured_light.phase import Fringe
from recon.threads import in_threads

Array = NDArray[np.float64]
Image = NDArray[np.float32]
Mask = NDArray[np.bool_]
Waveform = Literal["sine", "binary"]
Hidden = Literal["few", "fine"]  # why fringes don't show their bend: too few whole periods, or periods of too few pixels

DEFOCUS = "defocus the projector more, or take sine fringes"
LINEAR_LIGHT = "set projector and camera to linear, project patterns of linearise_gamma, or take 5 steps or more"

MOST_STEPS = 4  # from five on a gamma bends the phase by less than a hundredth of a radian
TABLE = 512  # entries a bend
ALONG = 8  # samples a period along the fringes, or where they are as wide as the image
WINDOW = 0.5  # periods, standard deviation of a Gaussian
PERIODS = 2.5  # across a window's reach: an image of fewer shows no whole one
WHOLE = 0.7  # of a window that must be known
CUT_OFF = 0.005  # of a window that may be saturated
SHARED = 9  # windows that show the same, with one standard deviation from one to the next
FEWEST = 30  # windows
FINEST = 0.75  # of a whole turn from pixel to pixel: faster phasors are aliased
LAGS = (1, 4, 16, 64)  # px
UNAMBIGUOUS = 1.5  # rad, as far as one of the former turns over several pixels
ROUNDS = 8
SETTLED = 2e-4  # rad
STRONGEST = {3: 0.44, 4: 0.3}  # c by steps: three at 0.5 have a phase that stands still; no more can be undone
STEEPEST = 0.9  # 2 N e likewise: at 1 the phase stands still
FURTHER = (3, 4)  # multiples of the bend that aren't undone: they tell what is left, as of binary fringes
SURE = 4.0  # standard errors, from which on a bend is undone
NORMAL = 1.4826  # standard deviation of normal values over their median distance


@dataclass(frozen=True)
class Bend:
    """The bend of one set of fringes, as it was undone."""

    table: Array  # (TABLE, 2) of true less seen phase, rad, and the slope of true by seen, over the phase seen, one bend long
    steps: int
    pitch: float  # projector px
    sigma: float  # rad, what may be left, a standard deviation over all phases
    gamma: float | None  # of a law of light that bends as much; of blurred fringes nearer to 1 than the projector's; None of none
    undone: bool = True  # False of more than can be undone
    waveform: Waveform = "sine"  # of binary fringes it is their own harmonics that bend

    @property
    def most_px(self) -> float:
        """Largest bend in projector px."""
        return float(np.abs(self.table[:, 0]).max() * self.pitch / (2 * np.pi))

    @property
    def left_px(self) -> float:
        """Standard deviation of what may be left, in projector px."""
        return self.sigma * self.pitch / (2 * np.pi)

    def straightened(self, fringe: Fringe) -> Fringe:
        """Fringes without the bend, their noise with what it magnifies and what may be left."""
        phase, sigma = np.empty_like(fringe.phase), np.empty_like(fringe.sigma)
        table = np.float32(np.concatenate([self.table, self.table[:1]]))
        in_threads(_straighten, len(phase), fringe, table, self.steps, np.float32(self.sigma**2), phase, sigma)
        return fringe._replace(phase=phase, sigma=sigma)


@kernel
def _straighten(first, end, fringe: Fringe, table, steps, left, phase, sigma):
    """Fill rows `first` to `end`, not included."""
    count = table.shape[0] - 1
    scale = np.float32(count * steps / (2 * np.pi))
    for v in range(first, end):
        for u in range(phase.shape[1]):
            seen = fringe.phase[v, u]
            place = (seen + np.float32(np.pi)) * scale
            whole = np.floor(place)
            share, entry = place - whole, int(whole) % count
            by = table[entry, 0] + share * (table[entry + 1, 0] - table[entry, 0])
            slope = table[entry, 1] + share * (table[entry + 1, 1] - table[entry, 1])
            true = seen + by
            phase[v, u] = true - np.sign(true) * np.float32(2 * np.pi) if abs(true) > np.pi else true
            sigma[v, u] = np.sqrt((slope * fringe.sigma[v, u]) ** 2 + left)


def table(steps: int, seen: Array, true: Array) -> Array:
    """True less seen phase, and slope : (TABLE, 2), from a curve that rises by 2 pi / steps, one bend : (n,) rad each."""
    turn = 2 * np.pi / steps
    at = -np.pi + turn * np.arange(TABLE) / TABLE
    seen, true = (np.concatenate([curve - turn, curve, curve + turn]) for curve in (seen, true))
    by = np.interp((at - seen[0]) % turn + seen[0] + turn, seen, true - seen)
    return np.stack([by, 1 + (np.roll(by, -1) - np.roll(by, 1)) / (2 * turn / TABLE)], axis=1)


def by_harmonics(steps: int, c: float, e: float) -> Array:
    """The table of harmonic N - 1 of c of the fundamental, after a rest by which phases are less by `e sin(2 N phase)`."""
    phase = np.linspace(0, 2 * np.pi / steps, 4 * TABLE + 1)
    seen = phase + np.angle(1 + c * np.exp(-1j * steps * phase))
    true = np.interp(phase, phase - e * np.sin(2 * steps * phase), phase)
    return table(steps, seen[:-1], true[:-1])


def by_gamma(steps: int, gamma: float) -> Array:
    """The table of light that goes with level^gamma."""
    phase, shifts = 2 * np.pi / steps * np.arange(4 * TABLE) / (4 * TABLE), 2 * np.pi * np.arange(steps)[:, None] / steps
    light = ((1 + np.cos(phase + shifts)) / 2) ** gamma
    bend = np.angle(np.sum(light * np.exp(-1j * shifts), axis=0) * np.exp(-1j * phase))
    return table(steps, phase + bend, phase)


def gamma_of(steps: int, c: float) -> float | None:
    """The gamma whose harmonic N - 1 is c of the fundamental: of four steps, the one from 1.5 up; None if there is none."""
    if steps == 3:
        return (1 + 2 * c) / (1 - c)
    gammas = np.geomspace(1.45, 5, 400)
    harmonics = (gammas - 1) * (gammas - 2) / ((gammas + 2) * (gammas + 3))
    return float(np.interp(c, harmonics, gammas)) if c >= harmonics[0] else None


def measure(fringe: Fringe, part: Fringes, valid: Mask) -> Bend | Hidden:
    """Measure the bend of a set of fringes on windows of whole periods.

    Parameters
    ----------
    fringe : Fringe
    part : Fringes
        Their sequence.
    valid : (h, w) bool
        Pixels that count.

    Returns
    -------
    Bend, or the reason why there is none to see
        With a table of no bend if none is sure.
    """
    steps = part.steps
    turns = [_turn(fringe.phase, valid, axis) for axis in (0, 1)]
    speed = float(np.hypot(*turns))
    if steps * speed >= FINEST * 2 * np.pi:
        return "fine"
    if speed == 0:
        return "few"
    period = 2 * np.pi / speed
    if PERIODS * WINDOW * period > max(valid.shape) / 2:
        return "few"
    longest = max(1.0, period / ALONG)
    strides = [int(np.clip(2 * np.pi / max(turn, speed / 4) / (ALONG * steps), 1, longest)) for turn in turns]
    strides = [stride if 2 * turn < speed else 1 for stride, turn in zip(strides, turns, strict=True)]
    thin = np.s_[strides[0] // 2 :: strides[0], strides[1] // 2 :: strides[1]]
    seen, known, saturated = fringe.phase[thin], valid[thin], fringe.saturated[thin]
    width = WINDOW * period / np.array(strides)
    twice = 2 * steps * speed < FINEST * 2 * np.pi
    if part.waveform == "binary" and steps == 3 and not twice:  # whose bend has even multiples alone
        return "fine"
    c, e, limit = 0.0, 0.0, STRONGEST[steps]
    for _ in range(ROUNDS):
        windows = _windows(straight(seen, by_harmonics(steps, c, e), steps), known, saturated, width, (steps, 2 * steps))
        if windows.shape[1] < FEWEST:
            return "few"
        once, second = np.median(windows.real, axis=1)
        c, e = c + 2 * once / steps, e + second / steps if twice else 0.0
        if abs(c) > limit or 2 * steps * abs(e) > STEEPEST:
            of_a_gamma, c = abs(c) > limit, float(np.clip(c, -limit, limit))
            gamma = gamma_of(steps, c) if of_a_gamma else None
            return Bend(by_harmonics(steps, c, 0.0), steps, part.pitch, np.inf, gamma, False, part.waveform)
        if 2 * abs(once) / steps < SETTLED:
            break
    multiples = [k * steps for k in FURTHER if k * steps * speed < FINEST * 2 * np.pi]
    rest = _windows(straight(seen, by_harmonics(steps, c, e), steps), known, saturated, width, multiples)
    further = rest / (np.array(multiples) / 2)[:, None]  # amplitudes, rad
    return _judged(windows, further, part, c, e if twice else 0.0)


def _judged(windows: NDArray[np.complex128], further: NDArray[np.complex128], part: Fringes, c: float, e: float) -> Bend:
    """The bend, or none where it isn't sure, by windows : (2, w), and what is left by its further multiples : (k, w) rad.

    Shapes and noise scatter their real and imaginary parts alike; real parts scatter more where the bend varies, as with blur.
    """
    steps = part.steps
    real, imaginary = _scatter(windows.real), _scatter(windows.imag)
    unsure = 1.25 * real * np.sqrt(SHARED / windows.shape[1]) * np.array([2, 1]) / steps  # of c and e, rad
    varies = np.sqrt(np.maximum(real**2 - imaginary**2, 0)) * np.array([2, 1]) / steps
    c, e = (value if abs(value) > SURE * error else 0.0 for value, error in zip((c, e), unsure, strict=True))
    more = np.median(further.real, axis=1)
    more = more[np.abs(more) > SURE * 1.25 * _scatter(further.real) * np.sqrt(SHARED / windows.shape[1])]
    counted = [*unsure, *more, varies[0] if c else 0.0]
    left = float(np.linalg.norm(counted) / np.sqrt(2))
    gamma = gamma_of(steps, c) if c else 1.0
    return Bend(by_harmonics(steps, c, e), steps, part.pitch, left, gamma, waveform=part.waveform)


def _scatter(values: Array) -> Array:
    """Robust standard deviations : (k,) of rows : (k, w)."""
    return NORMAL * np.median(np.abs(values - np.median(values, axis=1)[:, None]), axis=1)


def _turn(phase: Image, valid: Mask, axis: int) -> float:
    """Median turn of the phase from a pixel to the next along an axis, rad; over several pixels where noise would hide it."""
    phase, valid = (image[:, ::4].T if axis == 0 else image[::4] for image in (phase, valid))
    found = 0.0
    for lag in LAGS:
        if found * lag > UNAMBIGUOUS:
            break
        both = valid[:, lag:] & valid[:, :-lag]
        step = (phase[:, lag:] - phase[:, :-lag])[both].astype(float)
        if step.size:
            found = float(np.median(np.abs((step + np.pi) % (2 * np.pi) - np.pi))) / lag
    return found


def straight(seen: Image, bend: Array, steps: int) -> Array:
    """Phases without a bend, by its table."""
    turn = 2 * np.pi / steps
    return seen + np.interp((seen + np.pi) % turn, turn * np.arange(TABLE + 1) / TABLE, np.append(bend[:, 0], bend[0, 0]))


def _windows(phase: Array, known: Mask, saturated: Mask, width: Array, multiples: Sequence[int]) -> NDArray[np.complex128]:
    """Means of `exp(i m phase)` for multiples m over the windows in which enough is known : (m, w).

    Peaks that saturate are missing N times a period, as the harmonic is that is looked for.
    """
    down, across = np.maximum(np.rint(width), 1).astype(int)

    def means(image: NDArray) -> Image:
        blurred = cv2.GaussianBlur(
            image.astype(np.float32), (0, 0), sigmaX=width[1], sigmaY=width[0], borderType=cv2.BORDER_CONSTANT
        )
        return blurred[down // 2 :: down, across // 2 :: across]

    share = means(known)
    whole = (share > WHOLE) & (means(saturated) < CUT_OFF)
    angles = [multiple * phase for multiple in multiples]
    found = [(means(known * np.cos(a)) + 1j * means(known * np.sin(a)))[whole] / share[whole] for a in angles]
    return np.array(found).reshape(len(multiples), np.count_nonzero(whole))
