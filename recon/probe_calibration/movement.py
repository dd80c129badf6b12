"""Movement of the probe against its target, or of the wires, while the B-scans of a calibration are taken.

A bracket gives under its load or slips, wires are pushed or sag: then the crossing isn't at one place in all frames. Such a
movement is described by its course, evenly from the first frame to the last or all at once after one of them, and by its
size: six numbers of the bracket, three of the wires. Squared residuals that fall by more with it than by noise, as F has it, show
a movement; of two that may be, Schwarz's criterion chooses. It is named here only: parameters and covariance are those of
`open_movement`, as a movement that isn't shown can't be excluded either. Source of the criterion: Schwarz 1978.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import fdtrc

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

CHANCE = 1e-3  # of so much less residuals by noise alone, below which something moved
CAUTION = np.log(100.0)  # log likelihood by which wires must be likelier than a bracket: a bracket's movement does harm later
LEAST_FREEDOM = 12  # numbers measured beyond the unknowns; with fewer a movement can't be separated from noise
LEAST_FRAMES = 3  # before and after a sudden movement
LEAST_LOST = 5  # frames of an end whose outliers may be right: fewer fit any movement of a bracket
USUAL = 4.0  # times the typical length of residuals: what is longer isn't explained
LOST = 0.6  # of the frames after a sudden movement, or before it, that are outliers without it
PROBE, WIRES = "probe", "wires"


class Equations(NamedTuple):
    """Whitened equations of the adjustment, at its solution, of n frames in the order in which they were taken."""

    slopes: Array  # (n, 3, g) of the residuals by the parameters
    residuals: Array  # (n, 3)
    by_probe: slice  # parameters of the probe's turn and shift against its target
    by_wires: slice  # and of the wires' place
    known: Array  # (g,) information about each parameter from elsewhere, as the inverse of a variance


class Course(NamedTuple):
    """A movement's growth over the frames, and the adjustment of those that it is looked for in, if nothing moved."""

    growth: Array  # (n,) from -1 to 1
    frames: Mask  # (n,), of which k
    spanned: Array  # (3 k, r) orthonormal columns: residuals that parameters may explain
    left: Array  # (3 k,) residuals that they don't


@dataclass(frozen=True)
class Movement:
    """What moved between the first frame and the last."""

    what: str  # PROBE or WIRES
    growth: Array  # (6,) rad and mm of the probe's pose, or (3,) mm of the wires' place: half of the movement
    log_chance: float  # of so much less residuals by noise alone, in any of the trials
    evidence: float  # logarithm of the likelihood, less Schwarz's penalty
    frames: Mask  # (n,) that it was estimated from

    @property
    def described(self) -> str:
        """What moved, by how much, and the likely cause."""
        if self.what == PROBE:
            by = f"{self.turn_deg:.2f} deg and {self.shift_mm:.2f} mm"
            cause = "a bracket that gives, or slips"
            return f"the probe moved against its target by {by} between the first frame and the last: {cause}"
        cause = "wires that sag or slip, or a tank that was pushed"
        return f"the crossing moved by {self.shift_mm:.2f} mm between the first frame and the last: {cause}"

    @property
    def chance(self) -> float:
        """Of so much less residuals by noise alone, whatever kind and course."""
        return float(np.exp(min(self.log_chance, 0.0)))

    @property
    def shift_mm(self) -> float:
        """From the first frame to the last."""
        return 2 * float(np.linalg.norm(self.growth[-3:]))

    @property
    def turn_deg(self) -> float:
        """The same of the probe; 0 of wires."""
        return 2 * float(np.degrees(np.linalg.norm(self.growth[:-3])))


def find(equations: Equations, used: Mask) -> Movement | None:
    """The likeliest movement; None where noise may explain the residuals as well.

    used : (n,) frames that aren't outliers. Those of a whole end of the session may be right, and after a sudden movement.
    """
    courses = list(_courses(equations, used))
    kinds = [found for what in (PROBE, WIRES) if (found := _likeliest(equations, what, courses, used)) is not None]
    if len(kinds) < 2:
        return kinds[0] if kinds else None
    probe, wires = kinds
    same = (probe.frames == wires.frames).all()
    likelier = wires.evidence - CAUTION > probe.evidence if same else wires.frames.sum() > probe.frames.sum()
    return wires if likelier else probe


def _likeliest(equations: Equations, what: str, courses: list[Course], used: Mask) -> Movement | None:
    """Of one kind, over all courses; None where noise may be all."""
    fits = (_fitted(equations, what, course, used, 2 * len(courses)) for course in courses)
    sure = [one for one in fits if one is not None and one.chance < CHANCE]
    return min(sure, key=lambda one: one.log_chance, default=None)


def _courses(equations: Equations, used: Mask) -> Iterator[Course]:
    """Even, and all at once after each frame, with the frames that each is looked for in."""
    n = len(used)
    number, stills = np.arange(n), {}

    def course(growth: Array, frames: Mask) -> Course:
        if frames.tobytes() not in stills:
            stills[frames.tobytes()] = _still(equations, frames)
        return Course(growth, frames, *stills[frames.tobytes()])

    yield course(np.linspace(-1, 1, n), used)
    for first in range(LEAST_FRAMES, n - LEAST_FRAMES + 1):
        after = number >= first
        frames = used.copy()
        for end in (after, ~after):
            if end.sum() >= LEAST_LOST and np.mean(~used[end]) > LOST:
                frames |= end
        if min((frames & after).sum(), (frames & ~after).sum()) >= LEAST_FRAMES:
            yield course(np.where(after, 1.0, -1.0), frames)


def _still(equations: Equations, frames: Mask) -> tuple[Array, Array]:
    """Orthonormal columns : (3 n, r) that span the slopes of n frames, and the residuals : (3 n,) that no parameters explain."""
    left = equations.residuals[frames].ravel()
    columns, sizes, _ = np.linalg.svd(equations.slopes[frames].reshape(len(left), -1), full_matrices=False)
    spanned = columns[:, sizes > np.finfo(float).eps * max(columns.shape) * sizes[0]]
    return spanned, left - spanned @ (spanned.T @ left)


def _fitted(equations: Equations, what: str, course: Course, used: Mask, trials: int) -> Movement | None:
    """The movement by least squares, and the chance of as good a fit by noise in any of some trials."""
    which = equations.by_probe if what == PROBE else equations.by_wires
    frames, left = course.frames, course.left
    slopes = equations.slopes[frames]
    moving = (course.growth[frames][:, None, None] * slopes[:, :, which]).reshape(len(left), -1)
    more = moving.shape[1]
    unknowns = slopes.shape[2] + more
    freedom = len(left) - unknowns
    if freedom < LEAST_FREEDOM:
        return None
    moving -= course.spanned @ (course.spanned.T @ moving)  # what the parameters don't explain of it
    solution = np.linalg.lstsq(moving, left)[0]
    rest = left - moving @ solution
    if not _explained(rest, frames & ~used, frames):
        return None
    before, after = float(left @ left), float(rest @ rest)
    chance = fdtrc(more, freedom, max(before - after, 0) / more / (after / freedom))
    return Movement(
        what,
        growth=-solution,
        log_chance=float(np.log(trials) + np.log(np.maximum(chance, np.finfo(float).tiny))),
        evidence=-(len(left) * np.log(after) + unknowns * np.log(len(left))) / 2,
        frames=frames,
    )


def _explained(left: Array, doubtful: Mask, frames: Mask) -> bool:
    """Whether residuals : (3 n,) of frames that were outliers before are as small as the others'."""
    lengths = np.linalg.norm(left.reshape(-1, 3), axis=1)
    before = doubtful[frames]
    return not before.any() or bool(np.mean(lengths[before] < USUAL * np.median(lengths[~before])) > 1 - LOST / 2)
