"""Fringe order from two or more pitches: temporal unwrapping, coarse to fine."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit, prange

from recon.errors import InputError
from recon.graycode import Orders
from recon.patterns import Fringes
from recon.phase import Fringe

SLACK = 0.1  # cycle from the nearest whole order, besides noise: beyond, the phases contradict each other
SIGMAS = 5.0  # a decision must stand this many sigmas away from its tipping point
PLANNED_SIGMA = 0.02  # rad of phase noise that a sequence must stand, when its ladder is planned


@dataclass(frozen=True)
class Step:
    """One rung: `phase = sum of weights * phases` has the given pitch and is unwrapped by the rung before it."""

    pitch: float  # projector px, the beat's (equivalent) pitch or a pitch of the sequence
    weights: tuple[int, ...]  # of the phases of the sets, finest first


def ladder(pitches: Sequence[float], length: float) -> list[Step]:
    """Rungs from a wave that covers the axis down to the finest pitch.

    The candidates are the pitches themselves, the beats of two, `1 / (1/p - 1/q)` (heterodyne), and the beats of two beats. The
    way taken is the one whose worst decision has the widest margin: going from pitch P to pitch Q, noise is magnified by P / Q.

    Parameters
    ----------
    pitches : projector px, finest first, all different
    length : projector px of the axis

    Raises
    ------
    InputError
        If no combination covers the axis, or the noise of the phase would spoil a decision on the way.
    """
    units = np.eye(len(pitches), dtype=int)
    singles = [Step(float(p), tuple(map(int, unit))) for p, unit in zip(pitches, units, strict=True)]
    first = _beats(singles)
    # The third-order beat serves three pitches of nearly the same size (12, 13, 14 px).
    candidates = {step.weights: step for step in singles + first + (_beats(first) if len(pitches) > 2 else [])}.values()
    starts = [step for step in candidates if _span(step) >= length]
    if not starts:
        widest = max(_span(step) for step in candidates)
        raise InputError(
            f"patterns: pitches {_listed(pitches)} px are unambiguous over {widest:.0f} px, expected {length:.0f} px or more"
        )
    best = max((_widest(start, list(candidates), singles[0]) for start in starts), key=lambda found: found[0])
    sigmas, path = best
    if sigmas < SIGMAS:
        raise InputError(
            f"patterns: pitches {_listed(pitches)} px leave {sigmas:.1f} sigma at {PLANNED_SIGMA} rad, expected {SIGMAS:g}"
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


def _span(step: Step) -> float:
    """Projector px on which a wave is unambiguous: its pitch, less what noise can carry over both ends."""
    return step.pitch * (1 - SIGMAS * PLANNED_SIGMA * float(np.linalg.norm(step.weights)) / np.pi)


def _margin(coarse: Step, fine: Step) -> float:
    """Sigmas between a right decision and its tipping point, when `coarse` unwraps `fine`."""
    error = coarse.pitch / fine.pitch * np.array(coarse.weights) - np.array(fine.weights)
    return np.pi / (PLANNED_SIGMA * float(np.linalg.norm(error)))


def _widest(start: Step, candidates: list[Step], goal: Step) -> tuple[float, list[Step]]:
    """The path from start to goal, pitch descending, whose narrowest margin is widest."""
    chain = sorted(
        (s for s in candidates if goal.pitch <= s.pitch <= start.pitch and s not in (start, goal)), key=lambda s: -s.pitch
    )
    chain = [start, *chain, goal] if start != goal else [start]
    reach: list[tuple[float, list[Step]]] = [(np.inf, [start])]
    for fine in chain[1:]:
        options = [(min(sigmas, _margin(path[-1], fine)), [*path, fine]) for sigmas, path in reach if path[-1].pitch > fine.pitch]
        reach.append(max(options, key=lambda found: found[0]) if options else (0.0, [fine]))
    return reach[-1]


def fringe_order(sets: Sequence[tuple[Fringes, Fringe]], length: int) -> Orders:
    """Fringe order k of the finest pitch, so that `x = origin + pitch * (phase / 2 pi + k)`.

    Each rung of the ladder gives a coordinate that the next one refines. A pixel is not trusted where a phase ends further
    than 0.1 cycle and five predicted sigmas from a whole order, or closer than five sigmas to the tipping point.

    Parameters
    ----------
    sets : (fringes, decoded fringes) of one axis, any order
    length : projector px of the axis

    Raises
    ------
    InputError
        If the pitches cannot cover the axis (see `ladder`).

    Source: Zuo et al. 2016, temporal phase unwrapping (a comparative review).
    """
    sets = sorted(sets, key=lambda pair: pair[0].pitch)
    pitches = [fringes.pitch for fringes, _ in sets]
    path = ladder(pitches, length)
    pitch = np.array([step.pitch for step in path])
    weights = np.array([step.weights for step in path], float)
    # A combined phase is zero where its own sum is; shift every set so that all are zero at the middle of the axis.
    middle = (length - 1) / 2
    lead = np.array([2 * np.pi * (middle - fringes.zero(length)) / fringes.pitch for fringes, _ in sets])
    phases = np.stack([fringe.phase for _, fringe in sets])
    sigmas = np.stack([fringe.sigma for _, fringe in sets])
    origin = sets[0][0].zero(length)
    return Orders(*_climb(phases, sigmas, lead, pitch, weights, middle, origin))


@njit(cache=True, parallel=True)
def _climb(phases, sigmas, lead, pitch, weights, middle, origin):
    n, height, width = phases.shape
    rungs = pitch.size
    order = np.zeros((height, width), np.int32)
    trusted = np.zeros((height, width), np.bool_)
    for v in prange(height):
        for u in range(width):
            x, sure = 0.0, True  # projector px from the middle
            for r in range(rungs):
                cycles = 0.0
                for i in range(n):
                    cycles += weights[r, i] * (phases[i, v, u] - lead[i])
                cycles /= 2 * np.pi
                if r == 0:
                    x = pitch[0] * (cycles - np.floor(cycles + 0.5))
                    continue
                whole = x / pitch[r] - cycles
                nearest = np.floor(whole + 0.5)
                variance = 0.0
                for i in range(n):
                    variance += ((pitch[r - 1] / pitch[r] * weights[r - 1, i] - weights[r, i]) * sigmas[i, v, u]) ** 2
                residual, doubt = abs(whole - nearest), SIGMAS * np.sqrt(variance) / (2 * np.pi)
                if residual > SLACK + doubt or residual > 0.5 - doubt:
                    sure = False
                x = pitch[r] * (cycles + nearest)
            order[v, u] = np.floor((middle + x - origin) / pitch[rungs - 1] - phases[0, v, u] / (2 * np.pi) + 0.5)
            trusted[v, u] = sure
    return order, trusted
