"""Fringe order from two or more pitches: temporal unwrapping, coarse to fine.

The coarsest wave may be just as long as the axis: at its ends both ways are tried.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from recon.compiled import kernel, njit
from recon.errors import InputError
from recon.model.patterns import Fringes
from recon.structured_light.gray_code import Orders
from recon.structured_light.phase import Fringe
from recon.threads import in_threads

SLACK = 0.1  # cycle from the nearest whole order, besides noise: beyond, the phases contradict each other
SIGMAS = 5.0  # of noise, margin of the decision on a pixel
MARGIN = 4.0  # sigmas to the tipping point, least margin of a typical pixel: with 4, the decision fails for 3 % of them
PLANNED_SIGMA = 0.02  # rad of phase noise, if the sequence's own isn't known: three steps, noise 1/40 of modulation
BETTER = 13.8  # 2 ln 1000, of squared sigmas by which one end of the axis must fit better than the other
FRINGES = 0.3  # rad: pixels of more phase noise show none

Image = NDArray[np.float32]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Step:
    """One rung: `phase = sum of weights * phases` has the given pitch and is unwrapped by the rung before it."""

    pitch: float  # projector px, the beat's (equivalent) pitch or a pitch of the sequence
    weights: tuple[int, ...]  # of the phases of the sets, finest first


class Rungs(NamedTuple):
    """All rungs for compiled code, from the coarsest to the finest."""

    pitch: NDArray[np.float64]  # (rungs,) projector px
    weights: NDArray[np.float64]  # (rungs, sets)
    lead: NDArray[np.float64]  # (sets,) rad, phase of each set in the middle of the axis


class Span(NamedTuple):
    """An axis of the projector, px."""

    middle: float
    origin: float  # of the finest fringes
    half: float  # from the middle to the ends


def ladder(pitches: Sequence[float], length: float, sigmas: Sequence[float] | None = None) -> list[Step]:
    """Rungs from a wave that covers the axis down to the finest pitch.

    The candidates are the pitches themselves, the beats of two, `1 / (1/p - 1/q)` (heterodyne), and the beats of two beats. The
    path is the one with the widest margin of its worst decision: from pitch P to pitch Q, noise is magnified by P / Q.

    Parameters
    ----------
    pitches : projector px, finest first, all different
    length : projector px of the axis
    sigmas : rad of phase noise, one a pitch; 0.02 if not given

    Raises
    ------
    InputError
        If no combination covers the axis, or the noise of the phase would spoil a decision on the way.
    """
    noise = np.full(len(pitches), PLANNED_SIGMA) if sigmas is None else np.asarray(sigmas, float)
    units = np.eye(len(pitches), dtype=int)
    singles = [Step(float(p), tuple(map(int, unit))) for p, unit in zip(pitches, units, strict=True)]
    first = _beats(singles)
    # The third-order beat serves three pitches of nearly the same size (12, 13, 14 px).
    candidates = {step.weights: step for step in singles + first + (_beats(first) if len(pitches) > 2 else [])}.values()
    starts = [step for step in candidates if step.pitch >= length * (1 - 1e-9)]
    if not starts:
        widest = max(step.pitch for step in candidates)
        raise InputError(
            f"patterns: pitches {_listed(pitches)} px are unambiguous over {widest:.0f} px, expected {length:.0f} px or more"
        )
    margin, path = max((_widest(start, list(candidates), singles[0], noise) for start in starts), key=lambda found: found[0])
    if margin < MARGIN:
        raise InputError(
            f"patterns: pitches {_listed(pitches)} px leave {margin:.1f} sigma at {_listed(np.round(noise, 3))} rad of noise, "
            f"expected {MARGIN:g} or more: more light is needed, or a pitch in between"
        )
    return path


def _listed(pitches: Sequence[float]) -> str:
    return ", ".join(f"{pitch:g}" for pitch in pitches)


def _beats(steps: list[Step]) -> list[Step]:
    result = []
    for fine in steps:
        for coarse in steps:
            if fine.pitch < coarse.pitch * (1 - 1e-9):
                weights = tuple(a - b for a, b in zip(fine.weights, coarse.weights, strict=True))
                result.append(Step(1 / (1 / fine.pitch - 1 / coarse.pitch), weights))
    return result


def _margin(coarse: Step, fine: Step, noise: NDArray[np.float64]) -> float:
    """Sigmas between a right decision and its tipping point, when `coarse` unwraps `fine`."""
    error = coarse.pitch / fine.pitch * np.array(coarse.weights) - np.array(fine.weights)
    return np.pi / max(float(np.linalg.norm(error * noise)), 1e-9)


def _widest(start: Step, candidates: list[Step], goal: Step, noise: NDArray[np.float64]) -> tuple[float, list[Step]]:
    """The path from start to goal, pitch descending, whose narrowest margin is widest."""
    chain = sorted(
        (s for s in candidates if goal.pitch <= s.pitch <= start.pitch and s not in (start, goal)), key=lambda s: -s.pitch
    )
    chain = [start, *chain, goal] if start != goal else [start]
    reach: list[tuple[float, list[Step]]] = [(np.inf, [start])]
    for fine in chain[1:]:
        options = [
            (min(sigmas, _margin(path[-1], fine, noise)), [*path, fine]) for sigmas, path in reach if path[-1].pitch > fine.pitch
        ]
        reach.append(max(options, key=lambda found: found[0]) if options else (0.0, [fine]))
    return reach[-1]


def fringe_order(sets: Sequence[tuple[Fringes, Fringe]], length: int) -> tuple[Orders, Mask]:
    """Fringe order k of the finest pitch, so that `x = origin + pitch * (phase / 2 pi + k)`.

    Each rung of the ladder gives a coordinate that the next one refines. A pixel is not trusted where a phase ends further
    than 0.1 cycle and five predicted sigmas from a whole order, or within reach of an equal error from the next order; nor
    where it may as well lie at the other end of the axis.

    Parameters
    ----------
    sets : (fringes, decoded fringes) of one axis, any order
    length : projector px of the axis

    Returns
    -------
    orders : of all pixels
    clear : (h, w) bool, where noise leaves MARGIN sigmas to every rung, and the end of the axis is known: what isn't trusted
        there contradicts itself

    Raises
    ------
    InputError
        If the pitches cannot cover the axis (see `ladder`).

    Source: Zuo et al. 2016, temporal phase unwrapping (a comparative review).
    """
    sets = sorted(sets, key=lambda pair: pair[0].pitch)
    pitches = [fringes.pitch for fringes, _ in sets]
    phases = np.stack([fringe.phase for _, fringe in sets])
    sigmas = np.stack([fringe.sigma for _, fringe in sets])
    path = ladder(pitches, length, _least(sigmas))
    # A combined phase is zero where its own sum is; shift every set so that all are zero at the middle of the axis.
    middle = (length - 1) / 2
    lead = np.array([2 * np.pi * (middle - fringes.zero(length)) / fringes.pitch for fringes, _ in sets])
    rungs = Rungs(np.array([step.pitch for step in path]), np.array([step.weights for step in path], float), lead)
    span = Span(middle, float(sets[0][0].zero(length)), length / 2)
    orders = Orders(np.zeros(phases.shape[1:], np.int32), np.zeros(phases.shape[1:], np.bool_))
    clear = np.zeros(phases.shape[1:], np.bool_)
    in_threads(_climb, phases.shape[1], phases, sigmas, rungs, span, orders, clear)
    return orders, clear


def _least(sigmas: Image) -> NDArray[np.float64] | None:
    """Phase noise that a twentieth of the pixels that show fringes have at most : (sets,) rad; None if there are none.

    A small bright object on a dark table is measured though the table can't be.
    """
    seen = sigmas.reshape(len(sigmas), -1)
    seen = seen[:, (seen < FRINGES).all(axis=0)]
    return np.quantile(seen, 0.05, axis=1).astype(float) if seen.size else None


@kernel
def _climb(first, end, phases, sigmas, rungs: Rungs, span: Span, orders: Orders, clear):
    """Orders of rows `first` to `end`, not included; at the ends of the axis by both ways of unwrapping the coarsest wave."""
    pitch, weights = rungs.pitch, rungs.weights
    n, _, width = phases.shape
    for v in range(first, end):
        for u in range(width):
            start = _cycles(phases, rungs, 0, v, u)
            start -= np.floor(start + 0.5)
            x, sure, misfit, noise = _ascend(phases, sigmas, rungs, v, u, start)
            decided = noise <= 0.5 / MARGIN
            variance = 0.0
            for i in range(n):
                variance += (weights[0, i] * sigmas[i, v, u]) ** 2
            if 0.5 - abs(start) < SIGMAS * np.sqrt(variance) / (2 * np.pi):
                # The ends of the coarsest wave are one phase: only that which leads onto the axis can be right, or else that
                # which the finer waves fit much better. What isn't sure may have been led off the axis by noise.
                other, too, its_misfit, _ = _ascend(phases, sigmas, rungs, v, u, start - np.sign(start))
                reach = span.half + SIGMAS * pitch[-1] / (2 * np.pi) * sigmas[0, v, u]
                possible, other_possible = abs(x) <= reach or not sure, abs(other) <= reach or not too
                if other_possible and (not possible or its_misfit < misfit):
                    x, sure = other, too
                if possible and other_possible and abs(its_misfit - misfit) < BETTER:
                    sure = decided = False
                elif not possible and not other_possible:
                    sure = False
            orders.order[v, u] = np.floor((span.middle + x - span.origin) / pitch[-1] - phases[0, v, u] / (2 * np.pi) + 0.5)
            orders.trusted[v, u] = sure
            clear[v, u] = decided


@njit(inline="always")
def _cycles(phases, rungs: Rungs, r, v, u):
    """Phase of a rung, in cycles from the middle of the axis."""
    cycles = 0.0
    for i in range(phases.shape[0]):
        cycles += rungs.weights[r, i] * (phases[i, v, u] - rungs.lead[i])
    return cycles / (2 * np.pi)


@njit(inline="always")
def _ascend(phases, sigmas, rungs: Rungs, v, u, start):
    """Projector px from the middle by the finest rung, whether every rung could be decided, the sum of the squares of what is
    left of them over its variance, and the worst's noise in cycles.

    To the variance of noise belongs a slack for what bends phases, of which SLACK is three standard deviations.
    """
    pitch, weights = rungs.pitch, rungs.weights
    x, sure, misfit, worst = pitch[0] * start, True, 0.0, 0.0
    for r in range(1, pitch.size):
        cycles = _cycles(phases, rungs, r, v, u)
        whole = x / pitch[r] - cycles
        nearest = np.floor(whole + 0.5)
        variance = 0.0
        for i in range(phases.shape[0]):
            variance += ((pitch[r - 1] / pitch[r] * weights[r - 1, i] - weights[r, i]) * sigmas[i, v, u]) ** 2
        noise = np.sqrt(variance) / (2 * np.pi)
        residual, doubt, worst = abs(whole - nearest), SIGMAS * noise, max(worst, noise)
        # A wrong order comes from an error of over half a cycle, and leaves the rest to a whole one.
        if residual > min(SLACK + doubt, 1 - SLACK - doubt):
            sure = False
        misfit += residual**2 / (noise**2 + (SLACK / 3) ** 2)
        x = pitch[r] * (cycles + nearest)
    return x, sure, misfit, worst
