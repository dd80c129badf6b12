"""The direction of a tool's shaft, from a film in which the tool turns about it.

With the rotation `R_k` of frame k, the shaft's direction a in the target's frame and its direction d in the world, at rest,
`R_k a = d`. The mean rotation's first singular vectors are the likeliest directions of equal weights; weighted least squares do
the rest, two numbers of each. What residuals have beyond the poses' noise is the misfit: a shaft that wobbles in its bearing. An
error that poses share in the world turns d alone.

Source: spin calibration: Yaniv 2015.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from recon.errors import InputError
from recon.estimation.covariance import inverse, propagate, whitening
from recon.estimation.persistence import persistence
from recon.geometry import rigid
from recon.tip_calibration.pivot import Frames, mean_misfit

Array = NDArray[np.float64]

LEAST_SPAN_DEG = 60.0  # of the turn about the shaft
MOST_WOBBLE_DEG = 1.0  # standard deviation of the shaft's direction about each of two axes
MOST_SIGMA_DEG = 0.5
OUTLYING = 4.0  # times the median residual
ROUNDS = 5
FLOOR_RAD = 1e-5


@dataclass(frozen=True)
class Spin:
    """A shaft's direction."""

    axis: Array  # (3,) in the target's frame, of length 1
    direction: Array  # (3,) in the world, of length 1
    covariance: Array  # (3, 3) of the axis, of rank 2
    wobble_deg: float  # standard deviation of its direction about each of two axes, beyond the poses' noise
    span_deg: float  # of the turn about it
    used: NDArray[np.bool_]  # (n,) frames that aren't outliers

    @property
    def sigma_deg(self) -> float:
        """Standard deviation over both axes."""
        return float(np.degrees(np.sqrt(np.trace(self.covariance))))


def calibrate(frames: Frames, name: str, tip: Array | None = None) -> Spin:
    """Find the direction of a shaft about which a tool turns, towards its tip : (3,) mm of the target's frame.

    Raises
    ------
    InputError
        If it turns too little, or not about one axis that keeps its direction.
    """
    used = np.ones(len(frames.poses), bool)
    axis, direction = _mean_axis(frames)
    for _ in range(ROUNDS):
        angles = np.linalg.norm(frames.poses[:, :3, :3] @ axis - direction, axis=1)
        used = angles <= OUTLYING * np.median(angles) + FLOOR_RAD
        axis, direction = _mean_axis(frames.some(used))
    some = frames.some(used)
    span = _span_deg(some, axis)
    if span < LEAST_SPAN_DEG:
        expected = f"a tool that turns about its shaft by {LEAST_SPAN_DEG:g} deg or more"
        raise InputError(f"{name}: expected {expected}, found {span:.0f}: turn it farther")
    equations = _Equations(some, axis, direction)
    for _ in range(ROUNDS):
        axis, direction = equations.solved()
        equations = _Equations(some, axis, direction)
    wobble = float(np.degrees(equations.misfit))
    if wobble > MOST_WOBBLE_DEG:
        found = f"{wobble:.1f} deg: lay it into a groove or a bearing, and turn it there"
        expected = f"a shaft that keeps its direction to {MOST_WOBBLE_DEG:g} deg while the tool turns about it"
        raise InputError(f"{name}: expected {expected}, found {found}")
    covariance = equations.covariance()
    if tip is not None and axis @ tip < 0:
        axis, direction = -axis, -direction
    found = Spin(axis, direction, covariance, wobble, span, used)
    if found.sigma_deg > MOST_SIGMA_DEG:
        expected, way = f"a shaft whose direction is known to {MOST_SIGMA_DEG:g} deg", "turn the tool farther, and film longer"
        raise InputError(f"{name}: expected {expected}, found {found.sigma_deg:.2f}: {way}")
    return found


def beside(frames: Frames, axis: Array, tip: Array) -> float:
    """Distance, mm, of a tip : (3,) from the line about which the tool turns, along an axis : (3,)."""
    turned = frames.poses[:, :3, :3]
    across = np.linalg.svd(axis[None])[2][1:].T
    places = turned @ tip + frames.poses[:, :3, 3]
    along = turned @ axis
    design = np.concatenate([turned @ across, np.broadcast_to(-np.eye(3), turned.shape)], axis=2)
    free = np.eye(3) - along[:, :, None] * along[:, None]  # a tool may slide along its shaft meanwhile
    solution = np.linalg.lstsq((free @ design).reshape(-1, 5), -(free @ places[..., None]).ravel())[0]
    return float(np.linalg.norm(solution[:2]))


class _Equations:
    """Linear equations of a small turn of both directions, two numbers of each."""

    def __init__(self, frames: Frames, axis: Array, direction: Array) -> None:
        self.axis, self.direction = axis, direction
        self.about, self.across = (np.linalg.svd(one[None])[2][1:] for one in (axis, direction))
        turns = frames.poses[:, :3, :3]
        left = (turns @ axis - direction) @ self.across.T
        noise = propagate(self.across @ rigid.cross(direction), frames.covariance[:, :3, :3])
        self.misfit = mean_misfit(left, noise, 4, FLOOR_RAD)
        whiten = whitening(noise + self.misfit**2 * np.eye(2))
        slopes = np.concatenate([self.across @ turns @ self.about.T, np.broadcast_to(-np.eye(2), noise.shape)], axis=2)
        self.rows = (whiten @ slopes).reshape(-1, 4)
        self.normalised = (whiten @ left[..., None])[..., 0]

    def solved(self) -> tuple[Array, Array]:
        """Both directions after the step."""
        step = np.linalg.lstsq(self.rows, -self.normalised.ravel())[0]
        return _unit(self.axis + step[:2] @ self.about), _unit(self.direction + step[2:] @ self.across)

    def covariance(self) -> Array:
        """Covariance : (3, 3) of the axis."""
        alone = persistence(self.normalised) * inverse(self.rows.T @ self.rows)[:2, :2]
        return self.about.T @ alone @ self.about


def _mean_axis(frames: Frames) -> tuple[Array, Array]:
    """Directions in the target's frame and in the world, which the mean rotation shortens least."""
    left, _, right = np.linalg.svd(frames.poses[:, :3, :3].mean(axis=0))
    return right[0], left[:, 0]


def _span_deg(frames: Frames, axis: Array) -> float:
    """The smallest arc that holds all turns about an axis."""
    turned = Rotation.from_matrix(frames.poses[0, :3, :3].T @ frames.poses[:, :3, :3]).as_quat()
    angles = np.sort(np.degrees(2 * np.arctan2(turned[:, :3] @ axis, turned[:, 3])) % 360)
    return 360 - float(np.diff([*angles, angles[0] + 360]).max())


def _unit(vector: Array) -> Array:
    return vector / np.linalg.norm(vector)
