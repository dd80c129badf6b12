"""Movement of the probe against its target, or of the wires, while the B-scans of a calibration are taken.

A bracket gives under its load or slips, wires are pushed or sag: then the crossing isn't at one place in all frames. Such a
movement is described by its course, evenly from the first frame to the last or all at once after one of them, and by its
size: six numbers of the bracket, three of the wires.

`find` names one. Squared residuals that fall by more with it than by noise, as F has it, show a movement; of two that may be,
Schwarz's criterion chooses.

Frames count as fewer where the residuals that a movement leaves are alike in neighbours.

`average` takes what may have moved into parameters and covariance, as a movement that isn't shown can't be excluded either.
Nothing moved, the probe did, or the wires did, evenly or all at once after any frame. Half of a movement is normal, with its size
as standard deviation. Size and noise aren't known: each course and size is weighed by its evidence, which is the likelihood
integrated over parameters, movement and noise. The outcome is the mean over all of them, and its covariance that of their
mixture, with the movement itself; so the errors that the residuals leave open are in it. Residuals are left + slopes x +
moving h, linear in the parameters x and a movement h; with h ~ N(0, noise^2 size^2) all integrals are closed.

Sources: criterion: Schwarz 1978; evidence of a size: MacKay 1992; unknown noise: Gelman 2013; mean over models: Hoeting 1999.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import fdtrc

from recon.estimation.covariance import inverse, root
from recon.estimation.persistence import persistence

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

STILL, GIVES, SLIP = 0.25, 0.5, 0.25  # probability beforehand that nothing moves, the probe does, the wires do; assumed:
# a bracket that carries a probe by hand gives more often than not, and does harm later
EVEN = 0.5  # probability beforehand that a movement is even; else it is sudden, after any frame
LEAST, LARGEST = 0.03, 1.0  # mm and deg along each axis, of half of a movement: less is lost in noise, more is refused
SIZES = np.geomspace(LEAST, LARGEST, 16)  # all as likely beforehand, so that no magnitude is preferred
PROPORTIONS = np.diag([*np.radians(np.ones(3)), *np.ones(3)])  # rad and mm of the probe's turn and shift: 1 deg to 1 mm
NO_NOISE = 1e-12  # sum of squares of residuals that are none


class FrameEquations(NamedTuple):
    """Whitened equations of the adjustment, at its solution, of n frames in the order in which they were taken."""

    slopes: Array  # (n, m, g) of the residuals by the parameters, m residuals a frame
    residuals: Array  # (n, m)
    by_probe: slice  # parameters of the probe's turn and shift against its target
    by_wires: slice  # and of the wires' place
    known: Array  # (g,) information about each parameter from elsewhere, as the inverse of a variance


class Course(NamedTuple):
    """A movement's growth over the frames, and the adjustment of those that it is looked for in, if nothing moved."""

    growth: Array  # (n,) from -1 to 1
    frames: Mask  # (n,), of which k
    spanned: Array  # (m k, r) orthonormal columns: residuals that parameters may explain
    left: Array  # (m k,) residuals that they don't


@dataclass(frozen=True)
class Movement:
    """What moved between the first frame and the last."""

    what: str  # PROBE or WIRES
    growth: Array  # (6,) rad and mm of the probe's pose, or (3,) mm of the wires' place: half of the movement
    log_chance: float  # of so much less residuals by noise alone, in any of the trials
    evidence: float  # logarithm of the likelihood, less Schwarz's penalty
    frames: Mask  # (n,) that it was estimated from
    alike: float = 1.0  # frames that count as one, by what residuals it leaves

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


def find(equations: FrameEquations, used: Mask) -> Movement | None:
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


def _likeliest(equations: FrameEquations, what: str, courses: list[Course], used: Mask) -> Movement | None:
    """Of one kind, over all courses; None where noise may be all."""
    fits = (_fit(equations, what, course, used, 2 * len(courses)) for course in courses)
    sure = [one for one in fits if one is not None and one.chance < CHANCE]
    return min(sure, key=lambda one: one.log_chance, default=None)


def _courses(equations: FrameEquations, used: Mask) -> Iterator[Course]:
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


def _still(equations: FrameEquations, frames: Mask) -> tuple[Array, Array]:
    """Orthonormal columns : (m n, r) that span the slopes of n frames, and the residuals : (m n,) that no parameters explain."""
    left = equations.residuals[frames].ravel()
    columns, sizes, _ = np.linalg.svd(equations.slopes[frames].reshape(len(left), -1), full_matrices=False)
    spanned = columns[:, sizes > np.finfo(float).eps * max(columns.shape) * sizes[0]]
    return spanned, left - spanned @ (spanned.T @ left)


def _fit(equations: FrameEquations, what: str, course: Course, used: Mask, trials: int) -> Movement | None:
    """The movement by least squares, and the chance of as good a fit by noise in any of some trials."""
    which = equations.by_probe if what == PROBE else equations.by_wires
    frames, left = course.frames, course.left
    slopes = equations.slopes[frames]
    moving = (course.growth[frames][:, None, None] * slopes[:, :, which]).reshape(len(left), -1)
    more = moving.shape[1]
    unknowns = slopes.shape[2] + more
    if len(left) - unknowns < LEAST_FREEDOM:
        return None
    moving -= course.spanned @ (course.spanned.T @ moving)  # what the parameters don't explain of it
    solution = np.linalg.lstsq(moving, left)[0]
    rest = left - moving @ solution
    if not _explained(rest, frames & ~used, frames):
        return None
    alike = persistence(rest.reshape(int(frames.sum()), -1))
    freedom = (len(left) - unknowns) / alike
    if freedom < LEAST_FREEDOM:
        return None
    before, after = float(left @ left), float(rest @ rest)
    chance = fdtrc(more, freedom, max(before - after, 0) / alike / more / (after / alike / freedom))
    return Movement(
        what,
        growth=-solution,
        log_chance=float(np.log(trials) + np.log(np.maximum(chance, np.finfo(float).tiny))),
        evidence=-(len(left) * np.log(after) + unknowns * np.log(len(left))) / 2,
        frames=frames,
        alike=alike,
    )


def _explained(left: Array, doubtful: Mask, frames: Mask) -> bool:
    """Whether residuals : (m n,) of frames that were outliers before are as small as the others'."""
    before = doubtful[frames]
    lengths = np.linalg.norm(left.reshape(len(before), -1), axis=1)
    return not before.any() or bool(np.mean(lengths[before] < USUAL * np.median(lengths[~before])) > 1 - LOST / 2)


def alike(slopes: Array, left: Array, known: Array) -> float:
    """Frames that count as one, as neighbours pull the parameters alike; arguments as fields of `FrameEquations`.

    Errors that are alike in neighbours do no harm where the probe is turned so far between them that they pull to other sides.
    """
    flat = slopes.reshape(-1, slopes.shape[2])
    pulls = np.einsum("nij,ni->nj", slopes, left)
    return persistence(pulls @ root(inverse(flat.T @ flat + np.diag(known))))


class Rigid(NamedTuple):
    """Least squares of k residuals of frames without a movement, each divided by the root of the frames that count as one."""

    slopes: Array  # (k, g)
    left: Array  # (k,) residuals after the step
    step: Array  # (g,) of the parameters
    spread: Array  # (g, g) covariance by noise of variance 1
    freedom: float  # residuals beyond the unknowns, of frames that count


class Outcomes(NamedTuple):
    """The parameters, if movements are of one kind and course, for s sizes."""

    evidence: Array  # (s,) logarithm, with the probability beforehand, but for a constant of all
    steps: Array  # (s, g)
    covariances: Array  # (s, g, g), with the movement of the probe


def average(equations: FrameEquations, used: Mask, frames: Mask, noise: float = 1.0, alike: float = 1.0) -> tuple[Array, Array]:
    """Parameters and their covariance over all movements.

    Parameters
    ----------
    used : (n,)
        Frames whose least squares the equations' solution is.
    frames : (n,)
        Frames to adjust: these, and others that are as right if something moved.
    noise : float
        Standard deviation of the equations' residuals, roughly, by which sizes in mm and deg become those in units of it.
    alike : float
        Frames that count as one.

    Returns
    -------
    step : (g,)
        Of the parameters, to those of the middle between both ends.
    covariance : (g, g)
        Of either end, so with the movement of the probe.
    """
    rigid = _rigid(equations, used, frames, alike)
    probe, wires = (np.zeros((len(rigid.step), size)) for size in (6, 3))
    probe[equations.by_probe], wires[equations.by_wires] = PROPORTIONS, np.eye(3)
    still = _outcomes(rigid, rigid.slopes @ probe, probe, np.zeros(1), STILL)
    moving = [
        _outcomes(
            rigid,
            np.repeat(course, equations.residuals.shape[1])[:, None] * (rigid.slopes @ by),
            at_ends,
            SIZES / noise,
            chance * share,
        )
        for course, share in _likely_courses(frames)
        for by, at_ends, chance in ((probe, probe, GIVES), (wires, 0 * wires, SLIP))
    ]
    return _mixture([still, *moving])


def _likely_courses(frames: Mask) -> Iterator[tuple[Array, float]]:
    """Courses : (k,) of the k frames from -1 to 1, even or sudden, and the probability of each."""
    number, n = np.flatnonzero(frames), len(frames)
    yield np.linspace(-1, 1, n)[frames], EVEN
    for first in number[1:]:
        yield np.where(number >= first, 1.0, -1.0), (1 - EVEN) / (len(number) - 1)


def _rigid(equations: FrameEquations, used: Mask, frames: Mask, alike: float) -> Rigid:
    """Of some frames; those used have no slope left, as the equations are at their solution."""
    g, added = equations.slopes.shape[2], frames & ~used
    slopes, left = (each[frames] / np.sqrt(alike) for each in (equations.slopes.reshape(len(frames), -1), equations.residuals))
    slopes, left = slopes.reshape(-1, g), left.ravel()
    spread = inverse(slopes.T @ slopes + np.diag(equations.known))
    step = -spread @ equations.slopes[added].reshape(-1, g).T @ equations.residuals[added].ravel() / alike
    return Rigid(slopes, left + slopes @ step, step, spread, (len(left) - g) / alike)


def _outcomes(rigid: Rigid, moving: Array, at_ends: Array, sizes: Array, chance: float) -> Outcomes:
    """The outcomes for all sizes of movements of one kind and course.

    moving : (k, m)
        Slopes of the residuals by the movement's numbers.
    at_ends : (g, m)
        Change of the parameters at either end by these numbers.
    chance : float
        Probability beforehand of this kind and course.
    """
    pull = rigid.spread @ rigid.slopes.T @ moving  # of rigid parameters, by the movement
    shown, axes = np.linalg.eigh(moving.T @ (moving - rigid.slopes @ pull))
    shown = np.maximum(shown, 0)  # rounding may make it less
    along = -axes.T @ moving.T @ rigid.left
    ratio = sizes[:, None] ** 2 / (1 + sizes[:, None] ** 2 * shown)  # (s, m) of the movement's variance to the noise's
    rest = np.maximum(rigid.left @ rigid.left - ratio @ along**2, NO_NOISE)
    noise = (rest / max(rigid.freedom - 2, 1.0))[:, None, None]  # variance of Student's t
    growth, spread = (ratio * along) @ axes.T, noise * (axes * ratio[:, None]) @ axes.T
    squared = spread + growth[:, :, None] * growth[:, None]
    covariances = noise * rigid.spread + pull @ spread @ pull.T + at_ends @ squared @ at_ends.T
    evidence = -(np.log1p(sizes[:, None] ** 2 * shown).sum(axis=1) + rigid.freedom * np.log(rest)) / 2
    return Outcomes(evidence + np.log(chance / len(sizes)), rigid.step - growth @ pull.T, covariances)


def _mixture(outcomes: list[Outcomes]) -> tuple[Array, Array]:
    """Mean : (g,) and covariance : (g, g), each outcome weighed by its evidence."""
    evidence, steps, covariances = (np.concatenate(each) for each in zip(*outcomes, strict=True))
    weights = np.exp(evidence - evidence.max())
    weights /= weights.sum()
    mean = weights @ steps
    around = steps - mean
    return mean, np.tensordot(weights, covariances, 1) + (weights * around.T) @ around
