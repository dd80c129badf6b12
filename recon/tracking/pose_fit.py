"""Least squares of the target's pose on the ellipses of its views, its circles' places held within their tolerance.

Of each ellipse the centre counts, or all five numbers. Ellipses are predicted as those of the projected outlines, of which the
centres aren't the projected ones. Besides the pose's six numbers the
lengths of the target are found, as far as they aren't known: they are measured once more, by the design, with its covariance.
Errors of the cameras' calibration are common to all centres: their covariance is added to that of the rims' noise.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag
from scipy.special import chdtri

from recon.estimation.covariance import propagate, whitening
from recon.estimation.equations import Rows, Undetermined
from recon.estimation.levenberg_marquardt import Rules, descend
from recon.geometry import rigid
from recon.geometry.camera import Camera
from recon.geometry.circle_outline import ellipses_of, slopes_at
from recon.geometry.pose_hypotheses import POINTS
from recon.model import circle_layout
from recon.model.calibration import Uncertainty, projection_covariance
from recon.model.circle_layout import Circles
from recon.model.rig import Target

Array = NDArray[np.float64]

RULES = Rules(damping=0, rounding=1e-6, converged=0, steps=20)  # two or three steps from where rays meet, more from one view
SETTLED = 1e-4  # squared standard deviations of the last step
IMPLAUSIBLE = 1e-6  # chance of a misfit so large, by chi-square, below which it isn't the target
SUSPICIOUS = 1e-3  # chance of a misfit below which circles that are doubtful are left out, one by one
PARAMETERS = 6
MISFITTING = "views that no pose fits: other circles, or cameras swapped or moved"
CURVED = 0.05  # standard deviations by which the second order may shift a pose along its least certain direction
SHAPES = 0.005  # of a disc's size: what blur and gradients leave of a shape, one standard deviation
CENTRE, WHOLE = 2, 5  # numbers of an ellipse: x and y, and these with a, b and c
STEPS = np.diag([1e-4] * 3 + [1e-2] * 3)  # rad and mm, by which slopes of shapes are found


@dataclass(frozen=True)
class Sighting:
    """The circles in one view."""

    camera: Camera
    centres: Array  # (n, 2) px, of the ellipses of c0, c1 and on; NaN where one isn't seen
    covariance: Array  # (n, 2, 2) px^2
    shapes: Array | None = None  # (n, 2, 2) px, of the ellipses, as ellipses.Ellipses has them; None if they aren't known
    doubtful: NDArray[np.bool_] = field(default_factory=partial(np.zeros, 1, bool))  # (n,) as in rims.Outlines, or (1,) of all
    joint: Array | None = None  # (n, 5, 5) px^2, of x, y, a, b, c, as in rims.Outlines; None if only that of centres is known
    counted: int = CENTRE  # numbers of each ellipse that a pose is fitted to: its centre, or the whole

    @cached_property
    def seen(self) -> NDArray[np.bool_]:
        """Which circles are seen : (n,)."""
        return np.isfinite(self.centres).all(axis=1)

    @cached_property
    def measured(self) -> Array:
        """Numbers of the m circles seen that count : (m, 2 or 5) px."""
        shapes = np.full((len(self.centres), 2, 2), np.nan) if self.shapes is None else self.shapes
        return _numbers(self.centres, shapes)[self.seen, : self.counted]

    @cached_property
    def noise(self) -> Array:
        """Their covariances : (m, 2 or 5, 2 or 5) px^2, of a shape with what blur and gradients leave of it."""
        joint = np.zeros((len(self.centres), 5, 5)) if self.joint is None else self.joint.copy()
        joint[:, :CENTRE, :CENTRE] = self.covariance
        if self.shapes is not None:
            size = np.trace(self.shapes, axis1=1, axis2=2) / 2
            left = (SHAPES * size) ** 2
            if self.joint is None:  # a shape's noise is about its centre's
                left = left + np.trace(self.covariance, axis1=1, axis2=2)
            joint[:, CENTRE:, CENTRE:] += left[:, None, None] * np.eye(3)
        return joint[self.seen, : self.counted, : self.counted]

    def only(self, which: NDArray[np.bool_]) -> "Sighting":
        """The same with no other circles seen than some : (n,)."""
        return replace(self, centres=np.where(which[:, None], self.centres, np.nan))

    def without(self, which: int) -> "Sighting":
        """The same with one circle not seen."""
        return self.only(np.arange(len(self.centres)) != which)

    def by_shapes(self) -> "Sighting":
        """The same, of which whole ellipses count."""
        return replace(self, counted=WHOLE)


class Triangulated(NamedTuple):
    """The n centres as two views triangulate them, the offsets of ellipses' centres taken off, without the design."""

    lengths_mm: Array  # (2 n - 3,) as `circle_layout.lengths`
    gaps_mm: Array  # (n,) by which both rays miss each other, along their common normal


def _untold() -> None:
    """No circles."""


@dataclass(frozen=True)
class TargetPose:
    """Where the target is, or why that isn't known."""

    world_from_target: Array  # (4, 4) mm; NaN if it isn't known
    covariance: (
        Array  # (6, 6) by the noise of this pair; of a turn (rad) after the pose's own, and a shift (mm), as in tracks.Track
    )
    misfit: float  # squared normalised residuals, chi-square with `freedom` degrees; NaN where it isn't told
    reason: str | None = None
    freedom: int = PARAMETERS  # numbers that were measured beyond the pose's own
    used: NDArray[np.bool_] = field(
        default_factory=partial(np.ones, (2, 1), bool)
    )  # (2, n) of each view's circles, fitted to; (2, 1) of all
    shared: Array = field(
        default_factory=partial(np.zeros, (6, 6))
    )  # the same by tolerances of target and cameras: like in all pairs
    triangulate: Callable[[], Triangulated | None] = _untold  # gives `triangle`
    merging: bool = False  # with another pose that fits, so that its error isn't linear in the centres'

    @cached_property
    def triangle(self) -> Triangulated | None:
        """All circles in both views, also where they fit no pose; by need, as it takes a fifth of the time of a fit."""
        return self.triangulate()

    @property
    def found(self) -> bool:
        """Whether there is a pose."""
        return self.reason is None

    @property
    def total(self) -> Array:
        """Covariance : (6, 6) of the whole error, by noise and by tolerances."""
        return self.covariance + self.shared


def lost(reason: str, misfit: float = np.nan, triangulate: Callable[[], Triangulated | None] = _untold) -> TargetPose:
    """No pose, for a reason."""
    nothing = np.full((6, 6), np.nan)
    used = np.zeros((2, 1), bool)
    return TargetPose(np.full((4, 4), np.nan), nothing, misfit, reason, used=used, shared=nothing, triangulate=triangulate)


class _Guess(NamedTuple):
    """The unknowns."""

    world_from_target: Array  # (4, 4) mm
    deviations: Array  # (k,) independent standard normal numbers of the lengths, see `circle_layout.deviations`


class _Problem(NamedTuple):
    """Two views to be fitted."""

    views: Sequence[Sighting]
    whiten: Array  # (m, m) by which residuals of the m coordinates seen become independent, of variance 1
    circles: Circles  # by design
    by_deviation: Array  # (n, 3, k) mm, as `circle_layout.deviations`


def refined(start: Array, views: Sequence[Sighting], target: Target, optics: Uncertainty | None = None) -> TargetPose:
    """The pose by least squares from a start : (4, 4) mm, by Gauss-Newton, damped where that leads uphill.

    optics : of the cameras' calibration, `cam1` and `cam2`, whose views these are; None where it isn't known, or exact.
    """
    noise = _independent([one for view in views for one in view.noise])
    circles = circle_layout.circles(target)
    cameras = _optics_covariance(start, views, circles, optics)
    whiten = whitening(noise + cameras)
    problem = _Problem(views, whiten, circles, circle_layout.deviations(target))

    def finite_rows(guess: _Guess) -> tuple[Rows, float]:
        rows = _rows(guess, problem)
        if not all(np.isfinite(part).all() for part in rows):
            raise _Astray(MISFITTING)
        return rows, rows.left @ rows.left

    try:
        first = _Guess(start, np.zeros(problem.by_deviation.shape[2]))
        guess, (design, residual), step, _ = descend(first, finite_rows, _move, _settled, RULES)
    except Undetermined:
        return lost("views that do not determine the pose")
    except _Astray as astray:
        return lost(str(astray))
    if step is None:
        return lost(MISFITTING)
    guess = _move(guess, step)
    misfit, freedom = float(np.sum((residual - design @ step) ** 2)), len(noise) - PARAMETERS
    triangulate = partial(_triangulated, guess, problem)
    every = len(noise) == 2 * CENTRE * len(circles.centres)  # circle, by its centre in both views
    if not misfit < chdtri(freedom, IMPLAUSIBLE if every else SUSPICIOUS):
        times = np.sqrt(misfit / freedom)
        reason = f"a misfit of centres: {times:.0f} times their uncertainty; other circles, or cameras swapped or moved"
        return lost(reason, misfit, triangulate)
    pose = guess.world_from_target
    if not all(pose[:3, 2] @ (pose[:3, 3] - view.camera.centre) < 0 for view in views):
        return lost("a target whose front does not face both cameras")
    gain = np.linalg.inv(design.T @ design)[:PARAMETERS] @ design.T
    by_centre, by_deviation = gain[:, : len(noise)] @ whiten, gain[:, len(noise) :]
    covariance = propagate(by_centre, noise)
    shared = propagate(by_centre, cameras) + by_deviation @ by_deviation.T
    merging = False
    if any(view.counted == CENTRE and view.seen.sum() < POINTS for view in views):
        step, bend = _bend(guess, problem)
        merging = not abs(bend @ step) < CURVED * (step @ step)
        shared = shared + 2 * np.outer(bend, bend)[:PARAMETERS, :PARAMETERS]  # 2 is the variance of a normal number's square
    used = np.stack([view.seen for view in views])
    return TargetPose(pose, covariance, misfit, None, freedom, used, shared, triangulate, merging)


def _independent(covariances: Sequence[Array]) -> Array:
    """Covariance : (m, m) of independent measurements; `scipy.linalg.block_diag` takes 20 times as long."""
    ends = np.cumsum([len(one) for one in covariances]).tolist()
    whole = np.zeros((ends[-1], ends[-1]))
    for end, one in zip(ends, covariances, strict=True):
        whole[end - len(one) : end, end - len(one) : end] = one
    return whole


def _optics_covariance(pose: Array, views: Sequence[Sighting], circles: Circles, optics: Uncertainty | None) -> Array:
    """Covariance : (m, m) px^2 of all numbers that count, by errors of the cameras: they move ellipses as a whole."""
    moved = np.concatenate([(np.indices(view.measured.shape)[1] < CENTRE).ravel() for view in views])
    covariance = np.zeros((len(moved), len(moved)))
    if optics is not None:
        points = [rigid.apply(pose, circles.centres[view.seen]) for view in views]
        cameras = {f"cam{k}": view.camera for k, view in enumerate(views, start=1)}
        covariance[np.ix_(moved, moved)] = projection_covariance(cameras, points, optics)
    return covariance


def _placed(guess: _Guess, problem: _Problem) -> Circles:
    """The circles with their deviations from the design."""
    return problem.circles._replace(centres=problem.circles.centres + problem.by_deviation @ guess.deviations)


def _rows(guess: _Guess, problem: _Problem) -> Rows:
    """Slopes : (m + k, 6 + k) and residuals : (m + k,), in standard deviations; ellipses' offsets follow the pose."""
    circles, k = _placed(guess, problem), len(guess.deviations)
    rows, left = [], []
    for view in problem.views:
        slopes = _centre_slopes(view, guess, circles, problem)
        if view.counted == WHOLE:
            slopes = np.concatenate([slopes, _shape_slopes(view, guess, problem)], axis=1)
        rows.append(slopes.reshape(-1, PARAMETERS + k))
        left.append((view.measured - _predicted(view, guess, circles)[:, : view.counted]).ravel())
    design = np.vstack([problem.whiten @ np.concatenate(rows), np.eye(k, PARAMETERS + k, PARAMETERS)])
    return Rows(design, np.concatenate([problem.whiten @ np.concatenate(left), -guess.deviations]))


def _predicted(view: Sighting, guess: _Guess, circles: Circles) -> Array:
    """Numbers of the ellipses of the n circles seen : (n, 5) px."""
    return _numbers(*ellipses_of(view.camera, guess.world_from_target, *circles.some(view.seen)))


def _numbers(centres: Array, shapes: Array) -> Array:
    """Of n ellipses, x, y, a, b, c : (n, 5) px."""
    return np.concatenate([centres, shapes.reshape(-1, 4)[:, [0, 1, 3]]], axis=1)


def _centre_slopes(view: Sighting, guess: _Guess, circles: Circles, problem: _Problem) -> Array:
    """Of the centres by the unknowns : (n, 2, 6 + k)."""
    centres = circles.centres[view.seen]
    by_point = slopes_at(view.camera, rigid.apply(guess.world_from_target, centres))
    arms = rigid.rotate(guess.world_from_target, centres)
    by_deviation = guess.world_from_target[:3, :3] @ problem.by_deviation[view.seen]
    return by_point @ np.concatenate([rigid.slopes(arms), by_deviation], axis=2)


def _shape_slopes(view: Sighting, guess: _Guess, problem: _Problem) -> Array:
    """Of the shapes by the unknowns : (n, 3, 6 + k), by differences; a circle's place on the target hardly changes its shape.

    Circles are moved instead of the pose, all ways at once: turned about their normals they look the same. The slopes of a bowed
    board, a percent at most, are neglected beside 1.
    """
    pose, circles = guess.world_from_target, _placed(guess, problem).some(view.seen)
    moves = np.concatenate([STEPS, -STEPS]) @ block_diag(pose[:3, :3], pose[:3, :3])  # in the target's axes
    turns, shifts = moves[:, None, :3], moves[:, None, 3:]
    centres = circles.centres + np.cross(turns, circles.centres) + shifts
    planes = circles.slopes + turns[..., [1, 0]] * [-1, 1]
    ellipses = ellipses_of(view.camera, pose, centres.reshape(-1, 3), circles.radius_mm, planes.reshape(-1, 2))
    ahead, behind = _numbers(*ellipses)[:, CENTRE:].reshape(2, PARAMETERS, -1, 3)
    slopes = np.zeros((len(circles.centres), 3, PARAMETERS + len(guess.deviations)))
    slopes[:, :, :PARAMETERS] = np.moveaxis((ahead - behind) / (2 * np.diag(STEPS)[:, None, None]), 0, 2)
    return slopes


def _move(guess: _Guess, step: Array) -> _Guess:
    return _Guess(rigid.moved(guess.world_from_target, step[:PARAMETERS]), guess.deviations + step[PARAMETERS:])


def _settled(rows: Rows, step: Array) -> bool:
    return bool(np.sum((rows.slopes @ step) ** 2) < SETTLED)


def _bend(guess: _Guess, problem: _Problem) -> tuple[Array, Array]:
    """Standard deviation along the least certain direction : (6 + k,), and the second order's shift over it : (6 + k,).

    By two circles in one view two tilts fit, and merge where the other view sees the target face on: the shift is large there.
    Source: Bates and Watts 1980 (parameter-effects curvature).
    """
    design, residual = _rows(guess, problem)
    left, singular, directions = np.linalg.svd(design, full_matrices=False)
    step = directions[-1] / singular[-1]
    ahead, behind = (_rows(_move(guess, side * step), problem)[1] for side in (1, -1))
    return step, directions.T @ (left.T @ ((ahead + behind) / 2 - residual) / singular)


def _triangulated(guess: _Guess, problem: _Problem) -> Triangulated | None:
    """The circles' places as both views show them; None where one isn't seen."""
    if len(problem.views) < 2 or not all(view.seen.all() for view in problem.views):
        return None
    circles = _placed(guess, problem)
    points = rigid.apply(guess.world_from_target, circles.centres)
    pixels = [
        view.centres - ellipses_of(view.camera, guess.world_from_target, *circles)[0] + view.camera.project(points)
        for view in problem.views
    ]
    met, gaps = meet([view.camera for view in problem.views], pixels)
    x, side = met[1] - met[0], met[2] - met[0]
    c1 = float(np.linalg.norm(x))
    aside = float(side @ x) / c1
    lengths = [c1, aside, np.sqrt(side @ side - aside**2)]
    for further in met[3:] - met[0]:
        lengths += [further @ x / c1, further @ (side - x * aside / c1) / lengths[2]]
    return Triangulated(np.array(lengths), gaps)


def meet(cameras: Sequence[Camera], pixels: Sequence[Array]) -> tuple[Array, Array]:
    """Midpoints : (n, 3) mm of the shortest lines between two cameras' rays of n pixels, and their signed lengths : (n,) mm.

    NaN where rays are parallel or meet behind a camera.
    """
    origins = [camera.centre for camera in cameras]
    rays = [camera.rays(each) for camera, each in zip(cameras, pixels, strict=True)]
    base = origins[1] - origins[0]
    cosine = np.einsum("ni,ni->n", *rays)
    along = [ray @ base for ray in rays]
    (x, y, z), (u, v, w) = (ray.T for ray in rays)
    normal = np.column_stack([y * w - z * v, z * u - x * w, x * v - y * u])  # `numpy.cross` takes four times as long
    with np.errstate(divide="ignore", invalid="ignore"):
        s = (along[0] - cosine * along[1]) / (1 - cosine**2)
        t = (cosine * along[0] - along[1]) / (1 - cosine**2)
        gaps = normal @ base / np.linalg.norm(normal, axis=1)
    near = [origins[0] + s[:, None] * rays[0], origins[1] + t[:, None] * rays[1]]
    behind = ~((s > 0) & (t > 0))
    return np.where(behind[:, None], np.nan, (near[0] + near[1]) / 2), np.where(behind, np.nan, gaps)


class _Astray(Exception):
    """The reason why a start leads to no pose."""
