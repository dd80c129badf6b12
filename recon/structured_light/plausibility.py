"""Checks that images follow their pattern sequence: errors of order, exposure or file are refused, in one line."""

import itertools
from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from recon.errors import InputError
from recon.model.patterns import Fringes, GrayCode
from recon.structured_light.phase import Fringe, pseudo_inverse, sample_pixels
from recon.structured_light.phase_bend import DEFOCUS, LINEAR_LIGHT, Bend, Hidden

Image = NDArray[np.float32]
Mask = NDArray[np.bool_]

CHECK_SAMPLES = 10_000  # pixels of a check
LIT_SHARE = 0.002  # share of the image that must carry fringes
SATURATED_SHARE = 0.5  # share of the lit image that may be saturated
HARMONIC_SHARE = 0.08  # of the modulation, in the high harmonics: beyond, it is no N-step sequence
EACH_WAY = 0.01  # share of the pixels in each eighth of the circle, where phases are seen all around
SLIM = 0.1  # of the contrast's square, in its second harmonic around: 1 of a line, 0.03 of a shift off by 5 % of a step
BLACK = 0.01  # of the samples: the rest is brighter than black
SPARSE_STEPS = 7  # at most, of which neighbours differ by a third of the swing; more have harmonics that show errors
ALIKE = 0.15  # of the swing: a median difference of two images that noise makes; share of the pixels of either phase; of the
# largest difference of neighbours, the RMS of two that are one: over all phases it is 0.8
STRONG = 0.15  # of full scale: the swing of fringes that show whether black is clipped
CLIPPED = 0.12  # share of black samples in these; of dark fringes that just reach black, and of rounding, it is 0.07
BENT = 0.02  # of a pitch, by which light bends phases, before it is suspected
LINE_SHARE = 0.3  # share of the fringes' area that may be lit in the image of a line
MIN_SIGHTINGS = 10  # least rows with the line
LINE_OFF = 0.06  # cycle, largest offset of the line from the fringes; a fringe image out of its place is a step, 1/8 or so
LOPSIDED = 0.05  # share of the pixels: largest excess of residuals of the Gray code on one side, beyond the cells' own
ASTRAY = 0.3  # share that may lie beyond on both sides; of fringes that run backwards it is 0.75
JUMPS = 0.025  # share of the code's borders at which the order may jump; the coarsest bits change at 3 % of them
CROWDED = 4.0  # times as often as elsewhere: steps of the surface lie anywhere, wrong bits at the borders
CONTINUES = 0.6 / (2 * np.pi)  # cycle between two pixels: less is taken for one surface
THIN = 3  # every so many rows and columns tell shares
FEW = 20  # pixels, too few for a decision
OUTSIDE_SHARE = 0.2  # of the lit pixels, that a code may place beyond the projector's image: shadows lit by what stands around
RUSH = 0.05  # of all cells, between one pixel and the next: more than any image of a surface shows in the mean
LEAPS = 3.0  # times the usual change of the cell: of two bits exchanged it is 3 at least, of most others hundreds
UNEXPLAINED = 0.15  # share likewise of the half of the pixels with less noise
CONTRADICTED = 0.7  # share of the pixels whose pitches contradict each other; of unrelated phases it is 0.8 or more


def check_fringes(images: NDArray, part: Fringes, fringe: Fringe, least: float, full: float, place: str, start: int) -> None:
    """Refuse black, saturated and out-of-order fringes."""
    samples, beside = (sample_pixels(view, CHECK_SAMPLES) for view in (images[:, :, :-1], images[:, :, 1:]))
    swing = np.ptp(samples, axis=0)
    if np.mean(swing > 2 * least) < LIT_SHARE:
        if np.median(samples) > 0.95 * full:
            raise InputError(f"{place} are saturated all over, expected fringes: shorten the exposure")
        level = np.median(swing) / 2
        raise InputError(f"{place} hold no fringes: expected a modulation of {least:.0f} DN or more, found {level:.1f} DN")
    bright, strong = (field[::THIN, ::THIN] for field in (fringe.saturated, fringe.modulation))
    saturated, lit = np.count_nonzero(bright), np.count_nonzero(bright | (strong > least))
    if saturated > SATURATED_SHARE * lit:
        share = 100 * saturated / lit
        raise InputError(f"{place} are saturated in {share:.0f} % of the lit pixels, expected under half: shorten the exposure")
    useful = (swing > 2 * least) & (samples.max(axis=0) < full)
    if useful.any():
        _check_steps(samples[:, useful], beside[:, useful], part, full, place, start)
        _check_order(samples[:, useful], beside[:, useful], part, full, place, start)


def _check_steps(samples: Image, beside: Image, part: Fringes, full: float, place: str, start: int) -> None:
    """Refuse a step that was taken twice, is late or far off: contrasts lie on a line or a slim ellipse, not around a circle.

    Three steps leave no residual by which an error shows, but phases all around show it, in contrasts over eighths of the circle
    that weigh the same: a bright object on something dark is no ellipse. Of a wave so wide that few phases are seen, two images
    that are one: a pixel is of one of two phases, and a difference is noise, which products with the pixels beside don't show.
    """
    if part.steps > SPARSE_STEPS or samples.shape[1] < FEW:
        return
    level, c, s = pseudo_inverse(part.shifts) @ samples
    swing = np.ptp(samples, axis=0)
    level = np.maximum(level - np.quantile(samples, BLACK), swing / 2)
    pairs = list(itertools.combinations(range(part.steps), 2))
    differences = [float(np.median(np.abs(samples[a] - samples[b]) / swing)) for a, b in pairs]
    a, b = pairs[int(np.argmin(differences))]
    others = [(samples[k] - samples[a]) / swing for k in range(part.steps) if k not in (a, b)]
    both = max(min(np.mean(other > 1 / 4), np.mean(other < -1 / 4)) for other in others)
    square = np.mean((samples[a] - samples[b]) * (beside[a] - beside[b]) / level**2) / np.mean((swing / level) ** 2)
    doubled = min(differences) < ALIKE and square < (ALIKE * np.sin(np.pi / part.steps)) ** 2 and both > ALIKE
    contrast = (c + 1j * s) / level
    sector = ((np.angle(contrast) + np.pi) * (4 / np.pi)).astype(int) % 8
    number = np.bincount(sector, minlength=8)
    power = np.bincount(sector, np.abs(contrast) ** 2, 8) / np.maximum(number, 1)
    slim = abs(power @ np.exp(0.5j * np.pi * np.arange(8))) > SLIM * power.sum()
    if doubled or (slim and number.min() > EACH_WAY * number.sum()):
        cause = f"images {start + a} and {start + b} show the same" if doubled else "the steps are uneven"
        black = f" {clip}? Or" if (clip := black_clipped(_clipped(samples, full))) else ""
        raise InputError(
            f"{place} do not follow the {part.steps}-step sequence, {cause}:{black} was one taken twice, or before the projector "
            "had changed, or with another exposure?"
        )


def _check_order(samples: Image, beside: Image, part: Fringes, full: float, place: str, start: int) -> None:
    """Refuse images that don't follow the N-step sequence: swapped images put power into the high temporal harmonics.

    A projector's gamma fills harmonic 2, binary fringes the odd ones; those are left out. Noise differs between the
    samples and the pixels beside them, swapped images do not: their product is free of noise.
    """
    n = part.steps
    harmonics = [k for k in range(3, n // 2 + 1) if part.waveform == "sine" or (n % 2 == 0 and k % 2 == 0)]
    if not harmonics:
        return
    spread = np.sum((samples - samples.mean(axis=0)) * (beside - beside.mean(axis=0)))

    def strange(order: NDArray[np.intp]) -> float:
        time = 2 * np.pi * np.outer(harmonics, np.arange(n)) / n
        waves = np.concatenate([np.cos(time), np.sin(time)])[:, order]
        return float(np.sqrt(max(np.sum((waves @ samples) * (waves @ beside)) * 2 / n / max(spread, 1.0), 0.0)))

    if strange(np.arange(n)) < HARMONIC_SHARE:
        return
    best, suspects = HARMONIC_SHARE, ""
    for a, b in itertools.combinations(range(n), 2):
        order = np.arange(n)
        order[[a, b]] = b, a
        if (left := strange(order)) < best:
            best, suspects = left, f", {start + a} and {start + b} look exchanged"
    black = "" if suspects else black_clipped(_clipped(samples, full))
    cause = f"{black}, or " if black else ""
    raise InputError(f"{place} do not follow the {n}-step sequence{suspects}: {cause}are they in the manifest's order?")


def clipped(images: NDArray, full: float) -> float:
    """Share of the samples of strong fringes : (n, h, w) that are black: of dark fringes that are clipped it is large."""
    return _clipped(sample_pixels(images, CHECK_SAMPLES), full)


def _clipped(samples: Image, full: float) -> float:
    strong = np.ptp(samples, axis=0) > STRONG * full
    return float(np.mean(samples[:, strong] == 0)) if np.count_nonzero(strong) >= FEW else 0.0


def black_clipped(share: float) -> str:
    """The cause of many black samples, in words; empty of few."""
    if share <= CLIPPED:
        return ""
    causes = "the camera's black level, a background subtracted or a gamma"
    return f"{100 * share:.0f} % of the samples are 0: is black clipped by {causes}"


def suspected(bends: Iterable[Bend], unknown: Iterable[tuple[Fringes, Hidden]], clipped: float) -> str:
    """A cause of phases that contradict each other, by what few steps show of their light, in words; empty as a rule."""
    if black := black_clipped(clipped):
        return black
    waveforms = [part.waveform for part, _ in unknown] + [bend.waveform for bend in bends if bend.most_px > BENT * bend.pitch]
    if "binary" in waveforms:
        return "are binary fringes too sharp for so few steps"
    return "is light too far from linear for so few steps (a gamma)" if waveforms else ""


def check_bends(bends: Iterable[Bend], clipped: float, place: str) -> None:
    """Refuse phases that are bent by more than can be undone."""
    for bend in bends:
        if not bend.undone:
            law = " as by no gamma (binary fringes?)"
            if bend.gamma is not None:
                law = f" as by light that goes with level^{bend.gamma:.1f} or more"
            law, way = (" by harmonics of binary fringes", DEFOCUS) if bend.waveform == "binary" else (law, LINEAR_LIGHT)
            cause = f" {black}? Else" if (black := black_clipped(clipped)) else ""
            raise InputError(
                f"{place}: {bend.steps} steps of {bend.pitch:g} px are bent{law}, by which phases can't be told:{cause} {way}"
            )


def check_light(image: NDArray, fringe: Fringe, valid: Mask, place: str) -> None:
    """Refuse an image in the place of the line that is lit all over."""
    image, offset, valid = (field[::THIN, ::THIN] for field in (image, fringe.offset, valid))
    bright = np.mean((image > offset)[valid]) if valid.any() else 0.0
    if bright > LINE_SHARE:
        raise InputError(
            f"{place} is bright over {100 * bright:.0f} % of the fringes, not a line: is it in the manifest's order?"
        )


def check_line(sightings: int, votes: int, residual: float, place: str) -> None:
    """Refuse a line that is missing, or whose middle has a wrong phase: fringes in a wrong order.

    Images shifted round by one change every phase by one step, reversed ones its sign; either is a perfect N-step sequence.
    """
    if sightings >= MIN_SIGHTINGS and abs(residual) > LINE_OFF:
        raise InputError(
            f"{place}: the line lies {abs(residual):.2f} period off the fringes: are the images in the manifest's order?"
        )
    if votes < MIN_SIGHTINGS:
        raise InputError(f"{place} shows no centre line: expected it in {MIN_SIGHTINGS} rows or more, found it in {votes}")


def check_code(
    order: NDArray[np.int32],
    residual: Image,
    code: GrayCode,
    fringes: Fringes,
    phase: Image,
    valid: Mask,
    length: int,
    light: str,
    place: str,
) -> None:
    """Refuse bits or fringes in a wrong order.

    Parameters
    ----------
    order, residual : (h, w)
        Of `gray_code.fringe_order`, trusted or not.
    code, fringes : GrayCode, Fringes
    phase : (h, w), rad
    valid : (h, w) bool
    length : int, projector px
    light : str
        What is suspected of it, in words; empty as a rule.
    place : str
        The code's images, for messages.
    """
    if code.complementary:
        _check_residuals(residual[valid], place)
    if code.axis == "rows":
        order, phase, valid = order.T, phase.T, valid.T
    # A cell's borders lie at these phases, in cycles; without the complementary bit noise moves the order by one at them.
    cells, slip = (2, 0) if code.complementary else (1, 1)
    border = (code.origin(length) - fringes.zero(length)) / fringes.pitch
    order, cycles, valid = order[::4], phase[::4] / np.float32(2 * np.pi), valid[::4]
    turn = np.diff(cycles, axis=1)
    whole = np.rint(turn)
    continues = valid[:, 1:] & valid[:, :-1] & (np.abs(turn - whole) < CONTINUES)
    jump = continues & (np.abs(np.diff(order, axis=1) + whole) > slip + 0.5)
    left, right = (np.floor((c - border) * cells) for c in (cycles[:, :-1], cycles[:, 1:] - whole))
    crossed = left != right
    near = crossed.copy()  # a blurred bit flips a pixel early or late
    near[:, 1:] |= crossed[:, :-1]
    near[:, :-1] |= crossed[:, 1:]
    borders, there, elsewhere = (np.count_nonzero(continues & m) for m in (crossed, near, ~near))
    wrong, chance = np.count_nonzero(jump & near), np.count_nonzero(jump & ~near) / max(elsewhere, 1) * there
    if wrong > max(JUMPS * borders, FEW, CROWDED * chance):
        share = 100 * min(wrong / max(borders, 1), 1)
        cause = f", or {light}" if light else ""
        raise InputError(
            f"{place}: fringe orders jump at {share:.0f} % of the code's borders: are they in the manifest's order{cause}?"
        )


def check_levels(modulation: Image, offset: Image, least: float, full: float, place: str) -> None:
    """Refuse a code without fringes whose images, or whose black and white ones, hardly differ.

    Parameters
    ----------
    modulation, offset : (h, w), DN
        Half the difference and the mean of black and white.
    """
    if np.mean(modulation > least) >= LIT_SHARE:
        return
    if np.median(offset) > 0.95 * full:
        raise InputError(f"{place} are saturated all over, expected Gray code: shorten the exposure")
    found = float(np.quantile(modulation, 1 - LIT_SHARE))
    expected = f"half of white less black of {least:.0f} DN or more"
    raise InputError(f"{place} hold no Gray code: expected {expected}, found {found:.1f} DN")


class CodeOutside(InputError):
    """A code that names places beyond the projector's image."""


def check_readings(middle: Image, valid: Mask, length: int, place: str) -> None:
    """Refuse a code without fringes that can be read nearly nowhere, or that names places that no light comes from.

    Parameters
    ----------
    middle : (h, w), projector px
        Of the cells, NaN where bits are uncertain.
    valid : (h, w) bool
    length : int, projector px
    """
    lit, unknown = np.count_nonzero(valid), np.count_nonzero(valid & np.isnan(middle))
    if unknown > max(CONTRADICTED * lit, FEW):
        raise InputError(
            f"{place}: bits are neither black nor white in {100 * unknown / lit:.0f} % of the pixels: is each image followed by "
            "its inverse, as in the manifest, and are the stripes in focus?"
        )
    outside = np.count_nonzero(valid & ((middle < -0.5) | (middle > length - 0.5)))
    if outside > max(OUTSIDE_SHARE * lit, FEW):
        raise CodeOutside(
            f"{place}: the code of {100 * outside / lit:.0f} % of the pixels lies beyond the projector's {length} px: are the "
            "images in the manifest's order, and are projector_size, pitch and start those projected?"
        )


def check_cells(number: NDArray[np.int32], code: GrayCode, place: str, start: int) -> None:
    """Refuse bits in a wrong order: where one of them flips between two pixels, the cell must change as little as elsewhere.

    Parameters
    ----------
    number : (h, w)
        Of the cells, negative where unknown.
    place, start : of the code's images, for messages.
    """
    number = number if code.axis == "columns" else number.T
    left, right = number[:, :-1], number[:, 1:]
    known = (left >= 0) & (right >= 0) & (left != right)
    left, right = left[known], right[known]
    if left.size < FEW:
        return
    steps, flipped = np.abs(right - left), (left ^ (left >> 1)) ^ (right ^ (right >> 1))
    count, usual = code.bits + code.complementary, float(np.median(steps))
    if usual > max(RUSH * 2**count, LEAPS):
        raise InputError(
            f"{place}: the code changes by {usual:.0f} cells from one pixel to the next: are they in the manifest's order, the "
            "coarsest bit first?"
        )
    for bit in range(count):
        alone = steps[flipped == 1 << bit]
        if alone.size >= FEW and np.median(alone) > LEAPS * usual:
            image = start + (count - 1 - bit) * (2 if code.inverted else 1)
            raise InputError(
                f"{place}: where image {image} changes the code leaps by {np.median(alone):.0f} cells, by {usual:.0f} elsewhere: "
                "are they in the manifest's order?"
            )


def _check_residuals(residual: Image, place: str) -> None:
    """Refuse fringes that don't fit the cells of the code; in the right order the residual spreads over +-0.25 cycle."""
    above, below = (np.count_nonzero(side) for side in (residual > 0.25, residual < -0.25))
    if max(abs(above - below) - LOPSIDED * residual.size, above + below - ASTRAY * residual.size) > FEW:
        off = abs(float(np.angle(np.mean(np.exp(2j * np.pi * residual))))) / (2 * np.pi)
        raise InputError(
            f"{place}: the code lies {off:.2f} period off the fringes in the mean, and over a quarter period in "
            f"{100 * (above + below) / residual.size:.0f} % of the pixels: are the images in the manifest's "
            "order, and are the fringes' origin and the code's start those projected?"
        )


def check_pitches(trusted: Mask, clear: Mask, sigma: Image, light: str, place: str) -> None:
    """Refuse sets of fringes whose phases contradict each other nearly everywhere, or in many pixels in which noise is small.

    trusted : (h, w) bool
    clear : (h, w) bool, where noise leaves the orders to be decided
    sigma : (h, w) rad, of the finest phase
    light : what is suspected of it, in words; empty as a rule
    """
    count = np.count_nonzero(clear)
    lost = count - np.count_nonzero(trusted & clear)
    clearest = clear & (sigma <= np.median(sigma[clear])) if count else clear
    contradicting, least_noise = np.count_nonzero(clearest & ~trusted), np.count_nonzero(clearest)
    cause = f"{light}, or " if light else ""
    if (all_over := lost > max(CONTRADICTED * count, FEW)) or contradicting > max(UNEXPLAINED * least_noise, FEW):
        share = lost / count if all_over else contradicting / least_noise
        which = "that noise leaves to be decided" if all_over else "with the least noise"
        raise InputError(
            f"{place} contradict each other in {100 * share:.0f} % of the pixels {which}: {cause}are they in the manifest's "
            "order, each step taken once, and are the pitches those projected?"
        )
