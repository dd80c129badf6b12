"""The fringes of an axis without the bends of their phases: each set by itself, else by a gamma that all have in common."""

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from recon.errors import InputError
from recon.model.patterns import Fringes
from recon.structured_light import multi_frequency, phase_bend
from recon.structured_light.phase import Fringe
from recon.structured_light.phase_bend import Bend, Hidden

Mask = NDArray[np.bool_]
Measured = tuple[Fringes, Fringe]

GAMMAS = np.geomspace(0.4, 3.3, 25)  # tried on fringes that hide their bend
FINER = 9  # more, about the best
SAMPLES = 5_000  # pixels
AGREES = 0.01  # by which the agreement of all sets, at most 1, must grow
LEAST = 0.3  # of the agreement: less is chance, or noise


class Straight(NamedTuple):
    """Sets of fringes without their bends."""

    sets: list[Measured]
    bends: tuple[Bend, ...]  # of the sets with few steps that show theirs
    unknown: tuple[tuple[Fringes, Hidden], ...]  # sets with few steps that don't, and why


def straighten(sets: Sequence[Measured], valid: Mask, length: int) -> Straight:
    """Undo the bends of an axis's sets of fringes that have few steps.

    Parameters
    ----------
    sets : (fringes, decoded fringes), any order
    valid : (h, w) bool
        Pixels that count.
    length : projector px of the axis
    """
    done, bends, hidden = dict(enumerate(sets)), {}, {}
    for number, (part, fringe) in enumerate(sets):
        if part.steps > phase_bend.MOST_STEPS:
            continue
        bend = phase_bend.measure(fringe, part, valid)
        if not isinstance(bend, Bend):
            hidden[number] = bend
        else:
            bends[number] = bend
            done[number] = (part, bend.straightened(fringe))
    bendable = [number for number in hidden if sets[number][0].waveform == "sine"]  # by a gamma
    if bendable and len(sets) > 1 and (common := _common_gamma(list(done.values()), bendable, valid, length)):
        for number in bendable:
            part, fringe = sets[number]
            best, *others = (phase_bend.by_gamma(part.steps, gamma) for gamma in common)
            left = max(float(np.std(other[:, 0] - best[:, 0])) for other in others) / np.sqrt(3)  # of anything up to there
            bends[number] = Bend(best, part.steps, part.pitch, float(left), common[0])
            done[number] = (part, bends[number].straightened(fringe))
    return Straight(
        list(done.values()), tuple(bends.values()), tuple((sets[k][0], why) for k, why in hidden.items() if k not in bends)
    )


def _common_gamma(sets: Sequence[Measured], hidden: Sequence[int], valid: Mask, length: int) -> tuple[float, float, float] | None:
    """The gamma by which sets that hide their bend, by their numbers, agree best with all others; None if noise hides it.

    With the least and the largest that agree as well.
    """
    every = max(1, int(np.sqrt(valid.size / SAMPLES)))
    thin = np.s_[every // 2 :: every, every // 2 :: every]
    use = valid[thin]
    if not use.any():
        return None
    few = [(part, Fringe(*(np.ascontiguousarray(image[thin][use][None]) for image in fringe))) for part, fringe in sets]

    def agreement(gamma: float) -> float:
        tried = list(few)
        for number in hidden:
            part, fringe = few[number]
            seen = phase_bend.straight(fringe.phase, phase_bend.by_gamma(part.steps, gamma), part.steps)
            tried[number] = (part, fringe._replace(phase=np.float32(seen)))
        return _agreement(tried, length)

    try:
        usual, found = agreement(1.0), [agreement(gamma) for gamma in GAMMAS]
    except InputError:  # the sets can't be unwrapped at all, which is refused later
        return None
    k = int(np.argmax(found))
    near = np.geomspace(GAMMAS[max(k - 1, 0)], GAMMAS[min(k + 1, len(GAMMAS) - 1)], FINER)
    tried, agreements = np.array([1.0, *GAMMAS, *near]), np.array([usual, *found, *map(agreement, near)])
    best = agreements.max()
    if best < LEAST:
        return None
    as_well = tried[agreements > best - AGREES]
    gamma = tried[agreements.argmax()] if best > usual + AGREES else 1.0
    return float(gamma), float(as_well.min()), float(as_well.max())


def _agreement(sets: Sequence[Measured], length: int) -> float:
    """Agreement of each set's phases with the next finer one's, at most 1, the mean over sets.

    A coordinate by the finest phase may be off by periods, which the next phase doesn't show but those after it do.
    """
    sets = sorted(sets, key=lambda pair: pair[0].pitch)
    finest, fringe = sets[0]
    order = multi_frequency.fringe_order(sets, length)[0].order
    x = finest.zero(length) + finest.pitch * (fringe.phase.astype(float) / (2 * np.pi) + order)
    shares = []
    for (finer, _), (part, its) in pairwise(sets):
        off = its.phase - 2 * np.pi * (x - part.zero(length)) / part.pitch
        off = (off + np.pi) % (2 * np.pi) - np.pi
        shares.append(np.abs(np.mean(np.exp(1j * part.pitch / finer.pitch * off))))
    return float(np.mean(shares))
