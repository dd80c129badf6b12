"""Checks of a pivoting tool: motion, moments without a pose, a tip that slips, a target that is loose, a shaft that bends.

A tip that slips or a target that is loose moves evenly or all at once, as `recon.probe_calibration.movement` has it: the dimple
in the world, or the tip in the target's frame.

A shaft bends by the load across it. Of a load f that is fixed in the world, the part across the shaft's direction u bends it: the
tip moves by `f - (f.u) u`, of which the first is a dimple elsewhere. What is left moves the tip along the shaft by the square of
the tilt. A bend that isn't in proportion to the tilt moves it across the shaft, too. Both are few numbers, found with the tip by
least squares, held to usual bends. Squared residuals that fall by more than by noise, as F has it, show a bend; what it does to
the tip is its size. To first order a bend looks like a shorter shaft, and only its second order shows: small tilts hide it, and
tilts that are all alike.
"""

from collections.abc import Iterator
from typing import Annotated, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy.spatial.transform import Rotation
from scipy.special import fdtrc

from recon.errors import InputError
from recon.estimation.covariance import inverse
from recon.estimation.equations import Undetermined
from recon.model.part import Fraction, Part
from recon.probe_calibration import movement
from recon.probe_calibration.movement import PROBE, FrameEquations
from recon.tip_calibration import pivot
from recon.tip_calibration.pivot import DIMPLE, KNOWN, TIP, UNKNOWNS, Frames, Pivot

Array = NDArray[np.float64]

LEAST_POSES = 20
CHANCE = 1e-3  # of so much less residuals by noise alone, below which something bends
ASIDE_DEG = 15.0  # of the shaft from the way between the target's origin and the tip
BEND_MM = 1.0  # one standard deviation of a usual bend's numbers beforehand
MOST_COURSES = 500  # frames in which a movement is looked for, evenly out of all
MOST_OUTLIERS = 0.25  # of the poses
NO_PIVOT_MM = 5.0  # of a motion, beyond which a tool didn't pivot, and nobody means it
ALIKE = 4.0  # neighbours whose residuals are alike, from which on it is said
NAMED = 5  # frames, of a message


class Demands(Part):
    """What a film must show."""

    least_turn_deg: Annotated[float, Field(ge=0, le=90)] = 5.0
    """deg, standard deviation of the tool's turns, about the second of their axes: in one plane alone they don't give a tip"""
    most_sigma_mm: Annotated[float, Field(gt=0, le=100)] = 0.3
    """mm, of the tip in its least certain direction, one standard deviation"""
    most_motion_mm: Annotated[float, Field(gt=0, le=100)] = 0.2
    """mm that tip, dimple or target may have moved, the shaft bent, or the tip fit its dimple (one standard deviation); less than
    that is said where it shows"""
    least_seen: Fraction = 0.6
    """share of the film's pairs of frames with a pose"""


class Bend(NamedTuple):
    """A shaft's bend, as far as a film shows it."""

    chance: float  # of so much less residuals by noise alone
    shift_mm: float  # of the tip, if the bend is taken off
    sigma_mm: float  # of the tip in its least certain direction, if the shaft may bend


def calibrate(
    frames: Frames,
    numbers: NDArray[np.int64],
    every: NDArray[np.int64],
    demands: Demands,
    name: str,
    axis: Array | None = None,
) -> tuple[Pivot, list[str]]:
    """Find the tip and the dimple, and what is to be said of them.

    Parameters
    ----------
    frames : those with a pose
    numbers, every : (n,) and (m,) of these, and of all frames of the film
    name : of the film, for messages
    axis : (3,) of the shaft, in the target's frame, where it is known

    Raises
    ------
    InputError
        If the film shows too little, or that the tip wasn't at rest.
    """
    check_seen(numbers, every, demands, name)
    try:
        found = pivot.calibrate(frames)
    except Undetermined:
        _check_turns(frames, demands, name)
        raise InputError(f"{name}: expected a tool that turns about its tip, found poses that don't tell it") from None
    if (~found.used).mean() <= MOST_OUTLIERS:  # else turns are anything
        _check_turns(frames.some(found.used), demands, name)
    bent = bend(found, axis)
    shown = sorted(_motions(found, bent))
    _check_rest(found, shown, numbers, demands, name)
    sigmas, axes = found.principal
    if sigmas[0] > demands.most_sigma_mm:
        found_to = f"{sigmas[0]:.2f} mm along [{' '.join(f'{value:.2f}' for value in axes[0])}] of the target"
        way = f"tilt the tool farther, to all sides, and film longer, or give most_sigma_mm={1.2 * sigmas[0]:.2g}"
        raise InputError(f"{name}: expected a tip that is known to {demands.most_sigma_mm:g} mm, found {found_to}; {way}")
    return found, list(_warnings(found, bent, shown, numbers, demands))


def check_seen(numbers: NDArray[np.int64], every: NDArray[np.int64], demands: Demands, name: str) -> None:
    """Refuse a film that shows the target too rarely: in frames of some numbers : (n,), out of all : (m,)."""
    seen, count = len(numbers), len(every)
    if seen < demands.least_seen * count:
        edges = np.concatenate([[-1], np.flatnonzero(np.isin(every, numbers)), [count]])
        longest = int(np.argmax(np.diff(edges)))
        first, last = every[edges[longest] + 1], every[edges[longest + 1] - 1]
        found = f"it in {seen} of {count}, and in none from {first} to {last}"
        way = f"film again in view of both cameras, or give least_seen={np.floor(100 * seen / count) / 100:g} if that is enough"
        raise InputError(f"{name}: expected the target in {100 * demands.least_seen:.0f} % of the frames, found {found}; {way}")
    if seen < LEAST_POSES:
        raise InputError(f"{name}: expected {LEAST_POSES} poses or more of a tool that turns, better 200, found {seen}")


def turns_deg(poses: Array) -> Array:
    """Standard deviations : (3,) deg of turns, the largest first, about the principal axes of poses : (n, 4, 4)."""
    turned = Rotation.from_matrix(poses[:, :3, :3])
    vectors = (turned * turned.mean().inv()).as_rotvec()
    return np.degrees(np.linalg.svd(vectors - vectors.mean(axis=0), compute_uv=False) / np.sqrt(len(poses)))


def _check_turns(frames: Frames, demands: Demands, name: str) -> None:
    first, second, _ = turns_deg(frames.poses)
    if second < demands.least_turn_deg:
        cause = "in one plane only, or about one axis" if first > 2 * second else "too little"
        found = f"{first:.2f} and {second:.2f}: it turned {cause}"
        way = f"tilt it by 30 deg to all sides about its tip, or give least_turn_deg={0.8 * second:.2g}"
        expected = f"a tool that turns about two axes by {demands.least_turn_deg:g} deg each (standard deviation)"
        raise InputError(f"{name}: expected {expected}, found {found}; {way}")


def _check_rest(
    found: Pivot, shown: list[tuple[float, float, str]], numbers: NDArray[np.int64], demands: Demands, name: str
) -> None:
    """Refuse a tip that wasn't at rest, by the motion that residuals show most clearly of those too large."""
    most, film = demands.most_motion_mm, "film again"
    if large := [(size, text) for _, size, text in shown if size > most]:
        size, text = large[0]
        expected = f"a tip at rest in its dimple, and a target firm on a stiff tool, to {most:g} mm"
        way = f", or give most_motion_mm={1.2 * size:.2g} to take it" if size < NO_PIVOT_MM else ""
        raise InputError(f"{name}: expected {expected}, found {text}; {film}{way}")
    outliers = ~found.used
    if outliers.mean() > MOST_OUTLIERS:
        expected = f"poses that agree on a tip, but for {100 * MOST_OUTLIERS:.0f} %"
        contradict = f"{outliers.sum()} of {len(outliers)} that contradict the others, {_listed(numbers[outliers])}"
        cause = "a tip that left its dimple, or a target that is loose"
        raise InputError(f"{name}: expected {expected}, found {contradict}: {cause}; {film}")
    if found.misfit_mm > most:
        cause = "a dimple too wide, a shaft that bends, or a target that is loose"
        size = f"{found.misfit_mm:.2f} mm beyond the poses' noise: {cause}"
        way = f"{film}, or give most_motion_mm={1.2 * found.misfit_mm:.2g} to take it"
        raise InputError(f"{name}: expected a tip that keeps to its place to {most:g} mm along each axis, found {size}; {way}")


def bend(found: Pivot, axis: Array | None = None) -> Bend:
    """The likeliest bend, held to usual ones, of a shaft along an axis : (3,) of the target's frame.

    Where the axis isn't known it is about the way from the target's origin to the tip: some are tried, and the worst counts.
    """
    tried = [_bend(found, one) for one in (_about(found.tip) if axis is None else [axis])]
    likeliest = min(tried, key=lambda one: one.chance)
    chance = min(likeliest.chance * len(tried), 1.0)
    return Bend(chance, likeliest.shift_mm, max(one.sigma_mm for one in tried))


def _about(way: Array) -> Array:
    """Unit vectors : (7, 3), along a way and ASIDE_DEG aside of it, to all sides."""
    along = way / np.linalg.norm(way)
    across = np.linalg.svd(along[None])[2][1:]
    rounds = np.radians(60 * np.arange(6))
    aside = np.tan(np.radians(ASIDE_DEG)) * np.column_stack([np.cos(rounds), np.sin(rounds)]) @ across
    return np.vstack([along, (along + aside) / np.linalg.norm(along + aside, axis=1, keepdims=True)])


def _bend(found: Pivot, axis: Array) -> Bend:
    turned = found.turns[found.used]  # whose noise isn't that of the residuals any more
    shaft = turned @ axis
    upright = shaft.mean(axis=0) / np.linalg.norm(shaft.mean(axis=0))
    along = shaft @ upright
    across = (1 - along)[:, None] * (shaft - along[:, None] * upright)
    by_bend = found.whiten[found.used] @ np.concatenate([-shaft[:, :, None] * shaft[:, None], across[..., None]], axis=2)
    g, m = len(UNKNOWNS), by_bend.shape[2]
    straight = np.vstack([found.slopes[found.used].reshape(-1, g), KNOWN])
    bent = np.hstack([straight, np.vstack([by_bend.reshape(-1, m), np.zeros((len(KNOWN), m))])])
    left = np.append(found.normalised[found.used].ravel(), KNOWN @ found.unknowns)
    usual = np.eye(m, g + m, g) / BEND_MM
    spread = inverse(bent.T @ bent + usual.T @ usual)
    step = -spread @ bent.T @ left
    rest = left - straight @ np.linalg.lstsq(straight, left)[0]
    less = rest - bent @ np.linalg.lstsq(bent, rest, 1e-6)[0]
    freedom = 3 * len(turned) - 6 - m
    ratio = max(float(rest @ rest - less @ less), 0) / m / (float(less @ less) / freedom)
    variances = np.linalg.eigvalsh(spread[TIP, TIP])
    return Bend(float(fdtrc(m, freedom, ratio)), float(np.linalg.norm(step[TIP])), float(np.sqrt(variances[-1])))


def _motions(found: Pivot, bent: Bend) -> Iterator[tuple[float, float, str]]:
    """Motions that the residuals show: logarithm of the chance, size in mm, and words."""
    some = np.unique(np.linspace(0, len(found.used) - 1, MOST_COURSES).round().astype(int))
    equations = FrameEquations(found.slopes[some], found.normalised[some], TIP, DIMPLE, np.zeros(len(UNKNOWNS)))
    moved = movement.find(equations, found.used[some])
    if moved is not None:
        causes = ["a target that is loose on the tool", "a tip that slipped, or a dimple that moved"]
        likely, other = causes if moved.what == PROBE else causes[::-1]
        text = f"that it moved by {moved.shift_mm:.2f} mm between the first frame and the last: {likely}; else {other}"
        yield moved.log_chance, moved.shift_mm, text
    if bent.chance < CHANCE:
        text = f"that it moves in the target's frame with the tilt, by {bent.shift_mm:.2f} mm: a shaft that bends under its load"
        yield float(np.log(max(bent.chance, np.finfo(float).tiny))), bent.shift_mm, text


def _warnings(
    found: Pivot, bent: Bend, shown: list[tuple[float, float, str]], numbers: NDArray[np.int64], demands: Demands
) -> Iterator[str]:
    outliers = ~found.used
    if outliers.any():
        yield f"left out {outliers.sum()} of {len(outliers)} poses that contradict the others: {_listed(numbers[outliers])}"
    for _, _, text in shown:
        yield f"the residuals show {text}"
    if found.persistence > ALIKE:
        cause = "something moves slowly, or poses err alike"
        yield f"{found.persistence:.0f} neighbouring frames count as one, since their residuals are alike: {cause}"
    if bent.sigma_mm > demands.most_motion_mm:
        hidden = f"if it does, the tip is known to {bent.sigma_mm:.2f} mm only (1 sigma)"
        yield f"the tilts are too small, or too much alike, to show whether the shaft bends; {hidden}"


def _listed(frames: NDArray[np.int64]) -> str:
    shown = ", ".join(str(number) for number in frames[:NAMED])
    return f"frame{'s' * (len(frames) > 1)} {shown}" + (" and more" if len(frames) > NAMED else "")
