"""Drift of the devices since their calibration, as a session shows it, and the calibration that corrects it.

Devices warm up, and creep on their mounts: their principal points move by some hundredths of a pixel, and what two cameras see
parts from what one sees with the projector. Unknown are the errors of all calibrated parameters, those by drift included, with
the covariance of both as their prior. They are measured by fringes on the skin that both cameras see, and by views of the target
in both; a ball bar tells the scale. What these leave open, such as a motion of all devices alike, keeps its prior.

The size of the usual drift is a guess. Where a session surely shows more, the prior of drift, not that of the calibration, grows
to the size of greatest evidence (MacKay 1992, Bayesian interpolation), up to a limit beyond which a device was rather pushed. A
session that usual drift explains says little of the size: its evidence is flat, and a map's small errors may tip it anywhere.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from recon.estimation.covariance import root
from recon.geometry import rigid
from recon.geometry.camera import Camera
from recon.geometry.camera_jacobian import MOTION
from recon.model import circle_layout
from recon.model.calibration import WORLD, Calibration, Uncertainty, moved, with_drift, with_scale
from recon.model.rig import Target
from recon.rig_check import ball_bar, fault_tests, optics_equations
from recon.rig_check.ball_bar import Bars
from recon.rig_check.optics_equations import CAMERAS, PROJECTOR, DeviceRows, Matches
from recon.tracking.pose_fit import Sighting, meet

Array = NDArray[np.float64]

TURN_PER_PX, SHIFT_PER_PX = 3e-4, 0.2  # rad and mm of a mount for each px of drift; assumed: 15 urad and 10 um for 0.05 px
SIZES = 2.0 ** (np.arange(17) / 4)  # of drift over the usual one, that are compared
LARGEST = 8.0  # of these, that is still drift: 0.4 px
SURE_SIGMA = 3.0  # of surprise, from which on a session surely shows more than usual drift
ROUNDS = 3  # of linearising anew: a drift of a tenth of a pixel is all but linear


class Evidence(NamedTuple):
    """Measurements of the parameters and of the target's lengths, reduced to as many rows as unknowns, of variance 1 each."""

    slopes: Array  # (k, g + l)
    left: Array  # (k,) measured less predicted, by the calibration as it was

    def logarithm(self, prior: Array) -> float:
        """Logarithm of the likelihood, less a constant, where unknowns are a prior's root : (g + l, j) times normal numbers."""
        inner = self.slopes @ prior
        precision = np.eye(inner.shape[1]) + inner.T @ inner
        right = inner.T @ self.left
        explained = right @ np.linalg.solve(precision, right)
        return float(0.5 * (explained - self.left @ self.left) - 0.5 * np.linalg.slogdet(precision)[1])

    def posterior(self, prior: Array) -> tuple[Array, Array]:
        """Mean : (g + l,) and covariance : (g + l, g + l) of the unknowns."""
        inner = self.slopes @ prior
        within = np.linalg.inv(np.eye(inner.shape[1]) + inner.T @ inner)
        covariance = prior @ within @ prior.T
        return prior @ (within @ (inner.T @ self.left)), (covariance + covariance.T) / 2

    def surprise(self, prior: Array) -> float:
        """Standard deviations of a normal number as unlikely as what is measured, by what the prior shows above noise."""
        axes, sizes, _ = np.linalg.svd(self.slopes @ prior, full_matrices=False)
        shown = sizes > 1
        if not shown.any():
            return 0.0
        statistic = float(np.sum((axes.T @ self.left)[shown] ** 2 / (1 + sizes[shown] ** 2)))
        return fault_tests.as_sigma(statistic, int(shown.sum()))


@dataclass(frozen=True)
class Drift:
    """A calibration, corrected by what a session shows of it."""

    before: Calibration
    prior: Uncertainty  # of the calibration as it was, after drift of the size below
    after: Calibration  # with the covariance that is left
    size: float  # of drift over the usual one, 1 where a session shows no more
    surprise: float  # standard deviations of a normal number as unlikely as what the session shows, by usual drift


def estimate(
    calibration: Calibration,
    film: Sequence[tuple[Sighting, Sighting]] | None,
    matches: Matches | None,
    target: Target,
    scale: float | None,
    drift_px: float,
    bars: Bars | None = None,
) -> Drift:
    """Estimate the drift, and correct the calibration.

    Parameters
    ----------
    film : views of the target by both cameras; None without
    matches : points of the skin that both cameras see under fringes; None without
    scale : relative standard deviation of the board's print, as in `recon.model.calibration.with_scale`
    drift_px : standard deviation of principal points by usual drift
    bars : a ball bar under the fringes of camera 1
    """
    made, usual = calibration_uncertainty(calibration, scale), usual_drift(calibration.cameras, drift_px)
    names = optics_equations.parameters(made, list(calibration.cameras))
    names = (*names, *(name for name in usual.names if name not in names))
    fixed, drifting = made.ordered(names), usual.ordered(names)
    lengths = root(circle_layout.length_covariance(target))

    priors = {float(size): block_diag(root(fixed + size**2 * drifting), lengths) for size in SIZES}

    def solve(step: Array) -> tuple[Array, Array, float, float]:
        """The next step from the calibration, its covariance, the size of drift, and how surprising it is as usual."""
        cameras = moved(calibration.cameras, names, step)
        rows = measure(cameras, film, matches, target, Uncertainty(names, fixed + drifting))
        if bars is not None:
            certified = ball_bar.equations(bars, cameras, names, len(lengths))
            rows = DeviceRows(*map(np.concatenate, zip(rows, certified, strict=True)))
        seen = reduce(np.column_stack([rows.by_optics, rows.by_length]), rows.residuals + rows.by_optics @ step)
        surprise = seen.surprise(priors[1.0])
        size = 1.0 if surprise < SURE_SIGMA else max(priors, key=lambda size: seen.logarithm(priors[size]))
        mean, covariance = seen.posterior(priors[size])
        return mean[: len(names)], covariance[: len(names), : len(names)], size, surprise

    step, left, size, surprise = solve(np.zeros(len(names)))
    for _ in range(ROUNDS - 1):
        step, left, size, surprise = solve(step)
    free = np.flatnonzero(np.diag(fixed + drifting) > 0)
    before, known = (
        Uncertainty(tuple(names[k] for k in free), each[np.ix_(free, free)], True) for each in (fixed + size**2 * drifting, left)
    )
    after = Calibration(moved(calibration.cameras, names, step), known)
    return Drift(calibration, before, after, size, surprise)


def expected(calibration: Calibration, scale: float | None, drift_px: float) -> Uncertainty:
    """Uncertainty of a calibration after usual drift; parameters as of `estimate`."""
    made, usual = calibration_uncertainty(calibration, scale), usual_drift(calibration.cameras, drift_px)
    names = (*made.names, *(name for name in usual.names if name not in made.names))
    return Uncertainty(names, made.ordered(names) + usual.ordered(names), has_scale=True)


def parting(known: Mapping[str, Camera], true: Mapping[str, Camera], points: Array, axes: Sequence[int]) -> Array:
    """Displacement : (n, 3) mm of points : (n, 3) mm by light against the same by both cameras.

    known, true : devices that they are measured by, and that see them
    """
    seen = {name: camera.project(points) for name, camera in true.items()}
    by_light = optics_equations.points_by_light(seen[CAMERAS[0]], seen[PROJECTOR][:, list(axes)], axes, known)
    return by_light - meet([known[name] for name in CAMERAS], [seen[name] for name in CAMERAS])[0]


def calibration_uncertainty(calibration: Calibration, scale: float | None) -> Uncertainty:
    """Uncertainty of a calibration when it was made; nothing is uncertain of one without covariance but its scale."""
    known = with_scale(calibration.uncertainty, calibration.cameras, scale)
    return Uncertainty((), np.zeros((0, 0))) if known is None else known


def usual_drift(cameras: Mapping[str, Camera], drift_px: float) -> Uncertainty:
    """Uncertainty by usual drift alone: of principal points and focal lengths, and of mounts that turn and shift.

    The world goes with camera 1: a motion of its mount is one of all others, the other way.
    """
    others = [device for device in cameras if device != WORLD]
    sizes = drift_px * np.repeat([TURN_PER_PX, SHIFT_PER_PX], 3)
    effects = np.zeros((6 * len(others), 6 + 6 * len(others)))
    for k, device in enumerate(others, 1):
        turn, shift = cameras[device].camera_from_world[:3, :3], cameras[device].camera_from_world[:3, 3]
        rows = slice(6 * k - 6, 6 * k)
        effects[rows, :6] = -block_diag(turn, turn)
        effects[rows, 6 * k : 6 * k + 6] = np.block([[np.eye(3), np.zeros((3, 3))], [-rigid.cross(shift), np.eye(3)]])
    effects *= np.tile(sizes, 1 + len(others))
    warmed = with_drift(None, cameras, drift_px)
    assert warmed is not None
    names = (*warmed.names, *(f"{device}.{name}" for device in others for name in MOTION))
    return Uncertainty(names, block_diag(warmed.covariance, effects @ effects.T))


def measure(
    cameras: Mapping[str, Camera],
    film: Sequence[tuple[Sighting, Sighting]] | None,
    matches: Matches | None,
    target: Target,
    known: Uncertainty,
) -> DeviceRows:
    """Rows of film and fringes by devices, less points of the skin that disagree with most others."""
    first, second = (cameras[name] for name in CAMERAS)
    seen = lit = None
    if film is not None:
        views = [(replace(one, camera=first), replace(other, camera=second)) for one, other in film]
        seen = optics_equations.of_film(views, target, known.names)
    if matches is not None:
        rows = optics_equations.of_fringes(matches, cameras, target, known.names)
        lit = optics_equations.agreeing(rows, target, known, known.names, 2 * len(matches.axes) - 1)
    return optics_equations.combine(seen, lit, target, known, known.names)


def reduce(slopes: Array, left: Array) -> Evidence:
    """Rows : (m, k), (m,) by as many rows as unknowns, which say all the same of these."""
    basis, triangle = np.linalg.qr(slopes)
    return Evidence(triangle, basis.T @ left)
