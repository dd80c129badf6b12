"""The tip of a tool that pivots in a dimple: one point of the target's frame that stays at one place of the world.

With the pose `R_k, p_k` of frame k, the tip t in the target's frame and the dimple q in the world, `R_k t + p_k = q`. This is
linear and gives the start. Poses err by a turn r and a shift d, which move the tip by `r x R_k t + d`: by the lever of the tip, a
turn counts more than a shift. The likeliest tip and dimple leave the least squares of these errors, in units of their covariance,
with the rotations as corrected by them, so that their noise doesn't pull the tip (Gauss-Helmert's model).

Errors that all poses share are mostly the cameras', alike in the world: that of a pose is the symmetric root of its covariance
times the same six standard normal numbers, which are unknowns, too. An error of the target's own frame is in the tip by
definition, and cancels where the tip is used with that target.

What residuals have beyond this is the misfit: a tip that isn't round, a dimple too wide. It counts as one more error of each
frame, alike in all directions. Where neighbouring frames have like residuals, the frames count as fewer.

Sources: pivot calibration: Yaniv 2015; Gauss-Helmert: Mikhail 1976; start: least median of squares, Rousseeuw 1984; misfit:
Paule & Mandel 1982.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from recon.estimation.covariance import inverse, propagate, whitening
from recon.estimation.equations import Rows
from recon.estimation.levenberg_marquardt import Rules, descend
from recon.estimation.parameters import Blocks
from recon.estimation.persistence import persistence
from recon.geometry import rigid

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

UNKNOWNS = Blocks({"tip": 3, "dimple": 3, "alike": 6})  # mm, mm; standard normal numbers of the errors that all poses share
TIP, DIMPLE, ALIKE = (UNKNOWNS[name] for name in UNKNOWNS.sizes)
PLACE = slice(0, 6)  # tip and dimple
KNOWN = np.eye(6, len(UNKNOWNS), ALIKE.start)  # slopes of what is known beforehand
GATE = float(chi2.isf(1e-3, 3))  # squared normalised residual of an outlier
MEDIAN = float(chi2.median(3))  # of such squares
DRAWS = 400  # of three frames: at 40 % outliers a fifth of them is clean
ROUNDS = 10  # of fits, each with the outliers and the misfit of the one before
FLOOR_MM = 1e-3  # misfit of any tip
MOST_MISFIT = 1e9  # at which poses are nonsense
RULES = Rules(damping=0, rounding=1e-9, converged=1e-9, steps=30)


class Frames(NamedTuple):
    """Poses of n frames, all found."""

    poses: Array  # (n, 4, 4) world_from_target, mm
    covariance: Array  # (n, 6, 6) of each alone, as in recon.model.tracks; zeros where it isn't known
    shared: Array  # (n, 6, 6) by what errs alike in all

    def some(self, which: Mask | NDArray[np.intp]) -> "Frames":
        """Those of some."""
        return Frames(*(part[which] for part in self))


@dataclass(frozen=True)
class Pivot:
    """The tip and the dimple, with what n frames say of them."""

    frames: Frames
    unknowns: Array  # (12,) of UNKNOWNS
    misfit_mm: float  # standard deviation along each axis, beyond the poses' noise
    used: Mask  # (n,) frames that aren't outliers

    @property
    def tip(self) -> Array:
        """In the target's frame : (3,) mm."""
        return self.unknowns[TIP]

    @property
    def dimple(self) -> Array:
        """In the world : (3,) mm."""
        return self.unknowns[DIMPLE]

    @cached_property
    def residuals(self) -> Array:
        """Place of the tip less the dimple : (n, 3) mm, in the world, without the errors that all poses share."""
        return residuals(self.frames, self.unknowns)

    @cached_property
    def noise(self) -> Array:
        """Covariance of each residual : (n, 3, 3) mm^2."""
        return _tip_noise(self.frames, self.tip) + self.misfit_mm**2 * np.eye(3)

    @cached_property
    def whiten(self) -> Array:
        """Matrices : (n, 3, 3) by which residuals become independent, of variance 1."""
        return whitening(self.noise)

    @cached_property
    def turns(self) -> Array:
        """Rotations : (n, 3, 3), corrected."""
        return _corrected_turns(self.frames, self.unknowns, self.noise)

    @cached_property
    def slopes(self) -> Array:
        """Of the whitened residuals by the unknowns : (n, 3, 12)."""
        return self.whiten @ slopes(self.frames, self.unknowns, self.noise)

    @cached_property
    def normalised(self) -> Array:
        """Whitened residuals : (n, 3)."""
        return (self.whiten @ self.residuals[..., None])[..., 0]

    @property
    def rms_mm(self) -> float:
        """Root mean square distance of the tip from the dimple, outliers left out."""
        return float(np.sqrt((self.residuals[self.used] ** 2).sum(axis=1).mean()))

    @cached_property
    def persistence(self) -> float:
        """Frames that count as one, since the residuals of neighbours are alike; 1 of independent ones."""
        return persistence(self.normalised[self.used])

    @cached_property
    def covariance(self) -> Array:
        """Covariance : (6, 6) mm^2 of tip and dimple, by noise, misfit and the errors that poses share."""
        rows = self.slopes[self.used].reshape(-1, len(UNKNOWNS))
        return inverse(rows.T @ rows / self.persistence + KNOWN.T @ KNOWN)[PLACE, PLACE]

    @property
    def principal(self) -> tuple[Array, Array]:
        """Standard deviations : (3,) mm of the tip along principal axes : (3, 3), which are rows, the largest first."""
        variances, axes = np.linalg.eigh(self.covariance[TIP, TIP])
        return np.sqrt(np.maximum(variances, 0))[::-1], axes.T[::-1]


def calibrate(frames: Frames) -> Pivot:
    """Find the tip and the dimple of n frames, some of which may be wrong.

    Raises
    ------
    Undetermined
        If the poses don't turn.
    """
    unknowns, used = start(frames), np.zeros(len(frames.poses), bool)
    for _ in range(ROUNDS):
        left, noise = residuals(frames, unknowns), _tip_noise(frames, unknowns[TIP])
        misfit, before = _median_misfit(left, noise), used
        used = _squares(left, noise, misfit) < GATE
        unknowns = fit(frames.some(used), unknowns, misfit)
        if (used == before).all():
            break
    some = frames.some(used)
    for _ in range(2):
        misfit = mean_misfit(residuals(some, unknowns), _tip_noise(some, unknowns[TIP]), 6, FLOOR_MM)
        unknowns = fit(some, unknowns, misfit)
    return Pivot(frames, unknowns, misfit, used)


def start(frames: Frames) -> Array:
    """Unknowns : (12,) of those three frames, of many drawn ones, by which the median frame misfits least."""
    rng, n = np.random.default_rng(0), len(frames.poses)
    turns, places = frames.poses[:, :3, :3], frames.poses[:, :3, 3]
    trios = rng.integers(n, size=(DRAWS, 3))
    design = np.concatenate([turns[trios], np.broadcast_to(-np.eye(3), (DRAWS, 3, 3, 3))], axis=3).reshape(DRAWS, 9, 6)
    tried = (np.linalg.pinv(design, rcond=1e-6) @ -places[trios].reshape(DRAWS, 9, 1))[..., 0]
    misses = [np.median(((turns @ one[TIP] + places - one[DIMPLE]) ** 2).sum(axis=1)) for one in tried]
    return np.append(tried[int(np.argmin(misses))], np.zeros(6))


def fit(frames: Frames, start: Array, misfit_mm: float) -> Array:
    """Likeliest unknowns : (12,) from a start, with a misfit of each frame; Undetermined if the poses don't turn."""

    def linearise(unknowns: Array) -> tuple[Rows, float]:
        noise = _tip_noise(frames, unknowns[TIP]) + misfit_mm**2 * np.eye(3)
        whiten = whitening(noise)
        by_frame = (whiten @ slopes(frames, unknowns, noise)).reshape(-1, len(UNKNOWNS))
        left = np.append((whiten @ residuals(frames, unknowns)[..., None]).ravel(), unknowns[ALIKE])
        return Rows(np.vstack([by_frame, KNOWN]), -left), float(left @ left)

    return descend(start, linearise, np.add, rules=RULES).estimate


def _arms(frames: Frames, tip: Array) -> Array:
    """From the target's origin to the tip : (n, 3) mm, in the world."""
    return frames.poses[:, :3, :3] @ tip


def _alike(frames: Frames, tip: Array) -> Array:
    """Slopes : (n, 3, 6) mm of the tip's places by the standard normal numbers of the errors that all poses share."""
    return rigid.slopes(_arms(frames, tip)) @ symmetric_root(frames.shared)


def residuals(frames: Frames, unknowns: Array) -> Array:
    """Place of the tip less the dimple : (n, 3) mm, in the world, without the errors that all poses share."""
    tip, dimple, numbers = UNKNOWNS.split(unknowns)
    return _arms(frames, tip) + frames.poses[:, :3, 3] - dimple + _alike(frames, tip) @ numbers


def _tip_noise(frames: Frames, tip: Array) -> Array:
    """Covariance : (n, 3, 3) mm^2 of the tip's places by the poses' own noise."""
    return propagate(rigid.slopes(_arms(frames, tip)) @ symmetric_root(frames.covariance), np.eye(6))


def _corrected_turns(frames: Frames, unknowns: Array, noise: Array) -> Array:
    """Rotations : (n, 3, 3) of the poses without their own likeliest errors, by a covariance : (n, 3, 3) mm^2 of residuals."""
    by_pose = rigid.slopes(_arms(frames, unknowns[TIP]))
    normal = np.linalg.solve(noise, residuals(frames, unknowns)[..., None])
    errors = (frames.covariance @ np.swapaxes(by_pose, 1, 2) @ normal)[..., 0]
    return rigid.moved(frames.poses, -errors)[:, :3, :3]


def slopes(frames: Frames, unknowns: Array, noise: Array) -> Array:
    """Of the residuals by the unknowns : (n, 3, 12), by rotations that are corrected."""
    turns = _corrected_turns(frames, unknowns, noise)
    by_dimple = np.broadcast_to(-np.eye(3), turns.shape)
    return np.concatenate([turns, by_dimple, _alike(frames, unknowns[TIP])], axis=2)


def _squares(left: Array, noise: Array, misfit: float) -> Array:
    """Squares : (n,) of residuals : (n, k) in standard deviations, by a covariance : (n, k, k) and a misfit along each axis."""
    total = noise + misfit**2 * np.eye(left.shape[1])
    return np.einsum("ni,ni->n", left, np.linalg.solve(total, left[..., None])[..., 0])


def _median_misfit(left: Array, noise: Array) -> float:
    """The misfit, mm, with which the median of the squares is that of chi-square: outliers hardly count."""
    return _least_misfit(lambda misfit: float(np.median(_squares(left, noise, misfit))) < MEDIAN, FLOOR_MM)


def mean_misfit(left: Array, noise: Array, unknowns: int, floor: float) -> float:
    """The misfit with which the mean of the squares is that of chi-square, a number of unknowns taken off."""
    return _least_misfit(lambda misfit: float(_squares(left, noise, misfit).sum()) < left.size - unknowns, floor)


def _least_misfit(enough: Callable[[float], bool], floor: float) -> float:
    """The least misfit, from a floor on, that is enough, to 1 in 10 000; all beyond it are."""
    low, high = floor, floor
    while not enough(high) and high < MOST_MISFIT:
        low, high = high, 2 * high
    while high - low > 1e-4 * high:
        middle = (low + high) / 2
        low, high = (low, middle) if enough(middle) else (middle, high)
    return high


def symmetric_root(covariances: Array) -> Array:
    """Symmetric roots : (n, 6, 6) of covariances : (n, 6, 6), which change as evenly as these do."""
    values, vectors = np.linalg.eigh(covariances)
    return (vectors * np.sqrt(np.maximum(values, 0))[:, None]) @ np.swapaxes(vectors, 1, 2)
