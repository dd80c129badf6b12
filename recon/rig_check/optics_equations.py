"""Equations of cameras and projector against each other: a target moved about before both cameras, and fringes that both see.

Each pair of frames gives four numbers a circle for a pose of six; each point of a surface two pixels and the projector's
coordinates in both cameras' maps, for a place of three. The rest tells whether the devices are where they were calibrated.
Vertical fringes show neither a motion of the projector along them nor that of camera 2 across its epipolar lines; the latter the
target shows.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from recon.estimation.covariance import root, whitening
from recon.estimation.equations import Rows, eliminate
from recon.estimation.levenberg_marquardt import Rules, descend
from recon.geometry import rigid
from recon.geometry.camera import Camera
from recon.geometry.camera_jacobian import MOTION, moved
from recon.geometry.circle_outline import ellipses_of, slopes_at
from recon.geometry.order_statistics import NORMAL_MAD
from recon.model import circle_layout
from recon.model.calibration import Calibration, Uncertainty, linearise
from recon.model.rig import Target
from recon.rig_check import fault_tests
from recon.rig_check.fault_tests import Equations, Fault
from recon.tracking.pose import aligned
from recon.tracking.pose_fit import Sighting, meet

Array = NDArray[np.float64]

CAMERAS, PROJECTOR, TARGET = ("cam1", "cam2"), "projector", "target"
USUAL_MOTION = np.repeat([np.deg2rad(0.03), 0.1], 3)  # rad and mm: a mount that creeps, a touch; larger ones show all the better
USUAL_LENGTH = 0.3  # mm: another print, a bent board
BEND_PX = 3.0  # from where a map is read, to which its bend is continued: beyond, its noise is
EXACT_PX = 1e-4  # of a camera's pixel at which a map is read
RULES = Rules(damping=0, rounding=1e-6, converged=0, steps=3)  # of a pose's fit, from where rays meet
OUTLYING = 5.0  # standard deviations, after the scale of all
TRIMS = 4  # rounds in which points that disagree are left out


class Matches(NamedTuple):
    """m points of a surface, seen under fringes by both cameras."""

    pixels: Array  # (m, 2) px of camera 1
    first: Array  # (m, k) projector px along each axis that is encoded, at those pixels
    seen_at: Array  # (m, 2) px of camera 2, where the points are to be seen by the calibration
    second: Array  # (m, k) projector px there
    gradient: Array  # (m, k, 2) of camera 2's map there
    bend: Array  # (m, k, 2, 2) its second derivatives
    sigma: Array  # (m, 2, k) projector px, of first and second
    axes: tuple[int, ...]  # (k,) 0 of columns, 1 of rows

    def some(self, chosen: NDArray) -> "Matches":
        """Those of a mask or of numbers."""
        arrays = (self.pixels, self.first, self.seen_at, self.second, self.gradient, self.bend, self.sigma)
        first, *others = (each[chosen] for each in arrays)
        return Matches(first, *others, axes=self.axes)


class DeviceRows(NamedTuple):
    """Equations free of poses and points."""

    residuals: Array  # (m,)
    by_optics: Array  # (m, g) by the calibration's parameters and all motions
    by_length: Array  # (m, 2 n - 3) by the target's lengths, mm

    def over(self, factor: float) -> "DeviceRows":
        """The same with noise that is larger by a factor."""
        return DeviceRows(*(each / factor for each in self))


def parameters(known: Uncertainty, devices: Sequence[str]) -> tuple[str, ...]:
    """Names of the calibration's parameters, and of the motions of all devices."""
    motions = (f"{device}.{name}" for device in devices for name in MOTION)
    return tuple(dict.fromkeys((*known.names, *motions)))


def of_film(pairs: Sequence[tuple[Sighting, Sighting]], target: Target, names: Sequence[str]) -> DeviceRows:
    """Equations of n pairs of frames that show all circles in both views: of n circles 4 n - 6 each."""
    rows = [_of_pair(pair, target, names) for pair in pairs]
    free = eliminate(*(np.stack(each) for each in zip(*rows, strict=True)))
    by_length = free[..., 1 + len(names) :]
    return DeviceRows(
        free[..., 0].ravel(), free[..., 1 : 1 + len(names)].reshape(-1, len(names)), by_length.reshape(-1, by_length.shape[-1])
    )


def _of_pair(pair: tuple[Sighting, Sighting], target: Target, names: Sequence[str]) -> tuple[Array, Array]:
    """Slopes by the pose : (4 n, 6), and the rest : (4 n, 1 + g + 2 n - 3), in standard deviations."""
    model, circles = circle_layout.circle_centres(target), circle_layout.circles(target)
    pose = aligned(model, meet([view.camera for view in pair], [view.centres for view in pair])[0])
    whiten = block_diag(*(whitening(noise) for view in pair for noise in view.covariance))

    def centre_rows(pose: Array) -> tuple[Rows, float]:
        """Of the ellipses' centres, by the pose."""
        points, arms = rigid.apply(pose, circles.centres), rigid.rotate(pose, circles.centres)
        slopes = np.concatenate([slopes_at(view.camera, points) @ rigid.slopes(arms) for view in pair])
        missing = np.concatenate([view.centres - ellipses_of(view.camera, pose, *circles)[0] for view in pair])
        left = whiten @ missing.ravel()
        return Rows(whiten @ slopes.reshape(-1, 6), left), float(left @ left)

    pose, (by_pose, left), *_ = descend(pose, centre_rows, rigid.moved, rules=RULES)
    points = rigid.apply(pose, circles.centres)
    cameras = {name: view.camera for name, view in zip(CAMERAS, pair, strict=True)}
    seen = [linearise(cameras, name, points, names) for name in CAMERAS]
    by_point, by_optics = (np.concatenate(each) for each in zip(*((one.by_point, one.by_parameter) for one in seen), strict=True))
    by_length = by_point @ np.concatenate([pose[:3, :3] @ circle_layout.by_length(target)] * 2)
    rest = whiten @ np.concatenate([by_optics, by_length], axis=2).reshape(len(whiten), -1)
    return by_pose, np.column_stack([left, rest])


def of_fringes(matches: Matches, cameras: Mapping[str, Camera], target: Target, names: Sequence[str]) -> DeviceRows:
    """Equations of m points: one each with fringes along one axis of the projector, three with both."""
    axes, (m, k) = list(matches.axes), matches.first.shape
    points = points_by_light(matches.pixels, matches.first, matches.axes, cameras)
    first, second, light = (linearise(cameras, name, points, names) for name in (*CAMERAS, PROJECTOR))
    shown, aside, rows = light.pixels[:, axes], second.pixels - matches.seen_at, []
    near = np.minimum(1, BEND_PX / np.maximum(np.linalg.norm(aside, axis=1), EXACT_PX))
    bent = np.einsum("mkij,mj,m->mki", matches.bend, aside, near**2)
    for by_first, by_second, by_light in (
        (first.by_point, second.by_point, light.by_point[:, axes]),
        (first.by_parameter, second.by_parameter, light.by_parameter[:, axes]),
    ):  # a map is read at camera 2's predicted pixel, not at that of the point
        rows.append(np.concatenate([by_first, by_light, by_light - (matches.gradient + bent) @ by_second], axis=1))
    elsewhere = np.einsum("mki,mi->mk", matches.gradient + bent / 2, aside)
    missing = np.concatenate([np.zeros((m, 2)), matches.first - shown, matches.second - shown + elsewhere], axis=1)
    sigma = np.concatenate([np.full((m, 2), EXACT_PX), matches.sigma.reshape(m, 2 * k)], axis=1)[..., None]
    free = eliminate(rows[0] / sigma, np.concatenate([missing[..., None], rows[1]], axis=2) / sigma)
    by_optics = free[..., 1:].reshape(-1, len(names))
    return DeviceRows(free[..., 0].ravel(), by_optics, np.zeros((len(by_optics), len(target.LENGTHS))))


def points_by_light(pixels: Array, shown: Array, axes: Sequence[int], cameras: Mapping[str, Camera]) -> Array:
    """Points : (m, 3) mm on camera 1's rays at which the projector's coordinate of the first axis is as decoded."""
    camera, projector, axis = cameras["cam1"], cameras[PROJECTOR], axes[0]
    rays, depth = camera.rays(pixels), np.full(len(pixels), float(np.linalg.norm(projector.centre - camera.centre)) * 4)
    for _ in range(20):
        points = camera.centre + depth[:, None] * rays
        slope = np.einsum("mi,mi->m", slopes_at(projector, points)[:, axis], rays)
        depth = depth + (shown[:, 0] - projector.project(points)[:, axis]) / slope
    return camera.centre + depth[:, None] * rays


def assemble(
    film: DeviceRows | None,
    fringes: DeviceRows | None,
    target: Target,
    known: Uncertainty,
    names: Sequence[str],
    daily: Uncertainty | None = None,
) -> Equations:
    """All equations with their faults: a motion of each device, and a target of other lengths."""
    rows = combine(film, fringes, target, known, names)
    equations = _equations(rows, target, known, names)
    return equations if daily is None else replace(equations, daily=rows.by_optics @ root(daily.ordered(names)))


def combine(
    film: DeviceRows | None, fringes: DeviceRows | None, target: Target, known: Uncertainty, names: Sequence[str]
) -> DeviceRows:
    """All rows. Noise is taken as found, of film and fringes each by itself; smaller than predicted by many equations alone."""
    parts = [rows for rows in (film, fringes) if rows is not None]
    parts = [rows.over(fault_tests.noise_factor(_equations(rows, target, known, names))) for rows in parts]
    return DeviceRows(*map(np.concatenate, zip(*parts, strict=True)))


def _equations(rows: DeviceRows, target: Target, known: Uncertainty, names: Sequence[str]) -> Equations:
    lengths = root(circle_layout.length_covariance(target))
    spread = np.column_stack([rows.by_optics @ root(known.ordered(names)), rows.by_length @ lengths])
    faults = {}
    for device in (*CAMERAS, PROJECTOR):
        columns = [list(names).index(f"{device}.{name}") for name in MOTION if f"{device}.{name}" in names]
        if columns:
            faults[device] = Fault(rows.by_optics[:, columns], USUAL_MOTION)
    return Equations(
        rows.residuals, spread, faults | {TARGET: Fault(rows.by_length, np.full(rows.by_length.shape[1], USUAL_LENGTH))}
    )


def agreeing(rows: DeviceRows, target: Target, known: Uncertainty, names: Sequence[str], each: int) -> DeviceRows:
    """Groups of `each` equations that agree with most others, whatever has moved: edges and stray light are left out.

    First by the residuals as they are: errors free to explain all of them would bend to the worst. Each equation of a group is
    judged by its like, since a part that moved shows in some of them alone.
    """
    equations = _equations(rows, target, known, names)
    left, used = equations.residuals, np.ones(len(rows.residuals) // each, bool)
    for _ in range(1 + TRIMS):
        groups = np.abs(left.reshape(-1, each))
        used = (groups < OUTLYING * np.maximum(NORMAL_MAD * np.median(groups, axis=0), 1e-12)).all(axis=1)
        left = fault_tests.unexplained(equations, np.repeat(used, each))
    return DeviceRows(*(part[np.repeat(used, each)] for part in rows))


def displacements(device: str, motion: Array, calibration: Calibration, points: Array, axes: Sequence[int]) -> Array:
    """Displacement : (n, 3) mm of measured points : (n, 3) mm caused by a motion : (6,) of a device.

    Of a camera points that both cameras measure; of the projector those that camera 1 measures by its light.
    """
    cameras = calibration.cameras
    used = {**cameras, device: moved(cameras[device], MOTION, motion)}
    if device == PROJECTOR:
        shown = used[PROJECTOR].project(points)[:, list(axes)]
        return points_by_light(cameras["cam1"].project(points), shown, axes, cameras) - points
    return meet([cameras[name] for name in CAMERAS], [used[name].project(points) for name in CAMERAS])[0] - points
