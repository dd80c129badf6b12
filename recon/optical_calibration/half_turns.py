"""Half turns of boards that map onto themselves: which point a device took for the first one, pose by pose.

A detector can't say which of both ways a symmetric grid lies in the image. In a pose that was taken the other way by one camera
than by another, these contradict each other. If all devices took it the other way than in the other poses, nothing contradicts
the design; but no print is as symmetric as its design, and its errors are seen turned.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from recon.geometry import board_shape, rigid
from recon.geometry.camera_jacobian import linearise
from recon.model.boards import Board
from recon.optical_calibration.adjustment import Adjustment, adjust, fit
from recon.optical_calibration.bundle import Array, Estimate, Problem, linear_system
from recon.optical_calibration.initial_estimate import alone
from recon.optical_calibration.observations import PROJECTOR, Observations

Turn = NDArray[np.intp]

CLEAR = 25.0  # fall of a pose's cost by which it counts as turned: odds of 3e5
SHARE = 1 / 3  # of the cost of all poses, that it falls at least: errors of detection may look like those of a print
STANDS_OUT = 1.9  # times the last eigenvalue's size, of the first: of noise it is 1 to 2, of errors that p poses share p - 1
ROUNDS = 5  # in which poses are turned one by one, until none is
ALMOST = 1e-7  # relative change of the cost of poses alone
NEAR = 1e-6  # of a board's size: points on each other


def half_turn(board: Board) -> Turn | None:
    """The number of the point : (n,) on which half a turn puts each point; None of a board that isn't mapped onto itself."""
    if not board.half_turn_is_alike:
        return None
    points = board.points()
    turned = points.min(axis=0) + points.max(axis=0) - points
    distances, numbers = KDTree(points).query(turned)
    return numbers if distances.max() < NEAR * np.ptp(points) else None


def turned(observations: Observations, poses: Sequence[int], turn: Turn, devices: Sequence[int] | None = None) -> Observations:
    """Observations whose points are numbered the other way in some poses, of all devices or of some.

    The projector's points are camera 1's: they turn with these.
    """
    pixels, covariance, gradient = (each.copy() for each in (observations.pixels, observations.covariance, observations.gradient))
    for pose in poses:
        for device in range(len(observations.devices)) if devices is None else devices:
            pixels[pose, :, device] = pixels[pose, turn, device]
            covariance[pose, :, device] = covariance[pose, turn, device]
        if devices is None:
            gradient[pose] = gradient[pose, turn]
    return replace(observations, pixels=pixels, covariance=covariance, gradient=gradient)


def agreeing(observations: Observations, turn: Turn) -> tuple[Observations, dict[str, list[str]]]:
    """Observations in which each camera numbers the points as camera 1 does, and the poses that were turned, by device.

    Of both places that a pose gives a camera beside the first, the right ones are the same in all poses.
    """
    done: dict[str, list[str]] = {}
    back = _about_the_middle(observations.points)
    _, reference = alone(observations, 0)
    for number, device in enumerate(observations.devices):
        if number == 0 or device == PROJECTOR:
            continue
        _, boards = alone(observations, number)
        both = np.flatnonzero(np.isfinite(boards[:, 0, 0]) & np.isfinite(reference[:, 0, 0]))
        if not len(both):
            continue
        first = np.array([rigid.invert(pose) for pose in reference[both]])
        places = np.stack([boards[both] @ first, boards[both] @ back @ first], axis=1)  # (p, 2, 4, 4)
        turns = Rotation.from_matrix(places[:, :, :3, :3].reshape(-1, 3, 3))
        angles = np.array([(turns * one.inv()).magnitude() for one in turns]).reshape(-1, len(both), 2)
        best = int(np.argmin(angles.min(axis=2).sum(axis=1) + NEAR * np.tile([0, 1], len(both))))
        other = both[angles[best].argmin(axis=1) == 1]
        if len(other):
            observations = turned(observations, other, turn, [number])
            done[device] = [observations.poses[pose] for pose in other]
    return observations, done


def consistent(
    observations: Observations, adjusted: Adjustment, free: Mapping[str, Sequence[str]], offsets: Array, turn: Turn
) -> tuple[Observations, Estimate, list[str]]:
    """Observations in which all poses number the points of one print alike, an estimate of these, and the poses that were turned.

    Poses are turned one by one, each if the print that all show together fits it better turned, from their numbers as they are
    and from those that the likeness of their residuals proposes.

    Parameters
    ----------
    adjusted : Adjustment
        Of the board as designed, with the offsets : (p, n, d, 2) px.
    """
    start = _Views(observations, offsets, Estimate(adjusted.calibration.cameras, adjusted.poses, adjusted.points))
    proposed, noise = _alike(observations, adjusted, turn), adjusted.levels
    found = [_settled(start, flips, free, turn, noise) for flips in (np.zeros_like(proposed), proposed)[: 1 + proposed.any()]]
    views, chosen, cost = min(found, key=lambda each: each[2])
    if chosen.any():
        unturned = _settled(start, np.zeros_like(chosen), free, turn, noise, rounds=1)
        views, chosen, _ = (views, chosen, cost) if cost < (1 - SHARE) * unturned[2] else unturned
    if 2 * chosen.sum() > len(chosen):  # which of both ways is the first doesn't matter: that of most poses
        chosen = ~chosen
        views = _turned(views, range(len(chosen)), turn)
    return (
        views.observations,
        replace(views.estimate, points=observations.points),
        [name for name, other in zip(observations.poses, chosen, strict=True) if other],
    )


class _Views(NamedTuple):
    """Observations, offsets that belong to them, and their estimate."""

    observations: Observations
    offsets: Array
    estimate: Estimate


def _settled(
    views: _Views, flips: NDArray[np.bool_], free: Mapping[str, Sequence[str]], turn: Turn, noise: Array, rounds: int = ROUNDS
) -> tuple[_Views, NDArray[np.bool_], float]:
    """Views with some poses turned, and others until none fits better the other way; which these are, and the cost of all."""
    chosen = np.zeros_like(flips)
    for _ in range(rounds):
        views, chosen = _turned(views, np.flatnonzero(flips), turn), chosen ^ flips
        adjusted = adjust(views.observations, views.estimate, free, views.offsets, board_shape.WIDE, released=True)
        views, finer = views._replace(estimate=adjusted.estimate), adjusted.levels
        costs = _costs(views, finer)
        flips = costs - _costs(_turned(views, range(len(flips)), turn), finer) > CLEAR
        if not flips.any():
            break
    return views, chosen, float(_costs(views, noise).sum())


def _turned(views: _Views, poses: Sequence[int] | NDArray[np.intp], turn: Turn) -> _Views:
    """Views with some poses turned."""
    observations, offsets, estimate = views
    moved, placed = offsets.copy(), estimate.poses.copy()
    for pose in poses:
        moved[pose], placed[pose] = offsets[pose, turn], estimate.poses[pose] @ _about_the_middle(observations.points)
    return _Views(turned(observations, poses, turn), moved, replace(estimate, poses=placed))


def _about_the_middle(points: Array) -> Array:
    """Half a turn : (4, 4) of a board : (n, 3) mm about the normal in its middle."""
    return rigid.transform(np.diag([-1.0, -1.0, 1.0]), (points.min(axis=0) + points.max(axis=0)) * [1, 1, 0])


def _costs(views: _Views, noise: Array) -> Array:
    """Huber's loss of each pose : (p,), placed anew on a print and devices that are held."""
    problem = Problem(views.observations, views.offsets, {})
    placed = fit(problem, views.estimate, noise, converged=ALMOST).estimate
    return linear_system(problem, placed, noise).losses.sum(axis=(1, 2))


def _alike(observations: Observations, adjusted: Adjustment, turn: Turn) -> NDArray[np.bool_]:
    """Poses : (p,) bool whose residuals, drawn back onto the board, are like the others' the other way round.

    The part of a print's errors that half a turn changes has another sign in poses that were taken the other way: that of the
    first eigenvector of the products of all pairs of poses. None are where that one doesn't stand out, as of noise alone.
    """
    count, points = observations.pixels.shape[:2]
    information, pull = np.zeros((count, points, 2, 2)), np.zeros((count, points, 2))
    for d, device in enumerate(observations.devices):
        for p, pose in enumerate(adjusted.poses):
            lines = linearise(adjusted.calibration.cameras[device], rigid.apply(pose, adjusted.points), ())
            slopes = lines.by_point @ pose[:3, :2]  # (n, 2, 2) px/mm
            used = observations.used[p, :, d] & ~adjusted.outliers[p, :, d]
            weights = np.linalg.inv(observations.covariance[p, used, d]) / adjusted.noise[device] ** 2
            weighted = slopes[used].swapaxes(1, 2) @ weights
            information[p, used] += weighted @ slopes[used]
            pull[p, used] += np.einsum("nij,nj->ni", weighted, adjusted.residuals[p, used, d])
    seen = np.linalg.det(information) > 0
    off = np.zeros_like(pull)
    off[seen] = np.linalg.solve(information[seen], pull[seen, :, None])[..., 0]
    both = seen & seen[:, turn]
    reversed_part = np.where(both[..., None], off + off[:, turn], 0.0).reshape(count, -1)
    products = reversed_part @ reversed_part.T
    np.fill_diagonal(products, 0.0)
    shares, vectors = np.linalg.eigh(products)
    signs = vectors[:, -1] if shares[-1] > STANDS_OUT * -shares[0] else np.ones(count)
    return (signs < 0) != (np.count_nonzero(signs < 0) * 2 > count)
