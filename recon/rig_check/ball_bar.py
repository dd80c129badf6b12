"""A ball bar under fringes: two balls, whose centres stand apart by a certified length, tell the scale of a calibration.

Balls are found by their normals: from each point of a ball, its centre lies a radius inwards, so that all points of a ball vote
for one place. Spheres of free radius are fitted, since paint makes balls larger, but not their distance.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from recon.errors import InputError
from recon.estimation.covariance import whitening
from recon.geometry.camera import Camera
from recon.geometry.primitives import Fit, Sphere, fit_sphere
from recon.model.calibration import Uncertainty, linearise
from recon.rig_check.optics_equations import CAMERAS, PROJECTOR, DeviceRows, points_by_light
from recon.structured_light.decode import ProjectorMap
from recon.structured_light.triangulate import Triangulator

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Limits:
    """When points are a ball's."""

    window: float = 0.15  # of a ball's radius: half the side of the windows, in which normals are measured; they bend by 9 deg
    vote: float = 0.1  # of the radius: side of the cells in which votes are counted, as far as normals err by noise
    near: float = 0.1  # of the radius: distance from a ball's surface, within which points are its
    facing: float = (
        0.6  # cosine of the angle from the line of sight, below which a ball's rim is left out: fringes thin out there
    )
    roundness: float = 0.05  # relative, by which a diameter may differ from that given
    least: int = 300  # points of a ball: fewer than of one of 20 px across
    most: int = 20_000  # of these that are fitted
    slopes: int = 500  # of these by which slopes are taken
    doubt_sigma: float = 3.0  # of what calibration and usual drift leave, from which on a length is doubted
    alarm_sigma: float = 5.0  # of what calibration and usual drift leave, from which on a length isn't this bar's


LIMITS = Limits()
SHARED = 9  # pixels whose errors go together, by the optics' blur and the paint
COMMON_PX = (
    0.03  # projector px, by which a sequence's phases err alike, against another's: gratings' shifts of some 5 % of a step
)


class BallBar(NamedTuple):
    """A bar with two balls, as camera 1 sees them under fringes, in one place."""

    pixels: tuple[Array, Array]  # of each ball (n, 2) px of camera 1
    shown: tuple[Array, Array]  # of each ball (n, 1) projector px there
    axes: tuple[int, ...]  # 0 of columns, 1 of rows


class Bars(NamedTuple):
    """One bar in some places."""

    seen: tuple[BallBar, ...]
    length_mm: float  # from centre to centre, certified
    sigma_mm: float  # standard deviation of the certificate


class Measured(NamedTuple):
    """The bar's length by a calibration."""

    length_mm: float
    sigma_mm: float  # by noise of the fringes, and by what they err alike
    by_optics: Array  # (g,) mm by the calibration's parameters
    balls_mm: tuple[float, float]  # diameters


def find(
    found: ProjectorMap,
    cameras: Mapping[str, Camera],
    ball_mm: float,
    name: str,
    limits: Limits = LIMITS,
) -> BallBar:
    """Find two balls in camera 1's map of the projector.

    Parameters
    ----------
    ball_mm : their diameter, roughly
    name : of the capture, for messages

    Raises
    ------
    InputError
        If there are no two balls of this size.
    """
    axis, image = (0, found.columns) if found.columns is not None else (1, found.rows)
    assert image is not None
    rows, columns = np.nonzero(np.isfinite(image))
    pixels, shown = np.column_stack([columns, rows]).astype(float), image[rows, columns, None].astype(float)
    camera, radius = cameras[CAMERAS[0]], ball_mm / 2
    grid = Triangulator(camera, cameras[PROJECTOR])(found).points.astype(float)
    places, votes = grid[rows, columns], _votes(grid, camera, radius, limits)
    balls, diameters = [], []
    for _ in range(2):
        own, sphere = _ball(places, votes, camera, radius, limits)
        if sphere is not None:
            diameters.append(2 * sphere.radius)
            votes = votes[np.linalg.norm(votes - sphere.centre, axis=1) > radius]
        if sphere is None or abs(2 * sphere.radius / ball_mm - 1) > limits.roundness:
            sizes = ", ".join(f"{diameter:.2f} mm" for diameter in diameters) or "none"
            raise InputError(
                f"{name}: expected two balls of {ball_mm:g} mm before {CAMERAS[0]} and {PROJECTOR}, found {sizes}: is ball_mm "
                "their diameter, do both see them, and do the patterns put separate things in place, as gray_surface does?"
            )
        balls.append(own)
    chosen = [own[:: -(-len(own) // limits.most)] for own in balls]
    first, second = ((pixels[own], shown[own]) for own in chosen)
    return BallBar((first[0], second[0]), (first[1], second[1]), (axis,))


def measure(bar: BallBar, cameras: Mapping[str, Camera], names: Sequence[str], limits: Limits = LIMITS) -> Measured:
    """Measure the bar's length by devices, with its slopes by parameters of names as of `Uncertainty`."""
    fits, slopes, shifted, centre = [], [], [], (f"{PROJECTOR}.{('cx', 'cy')[bar.axes[0]]}",)
    for pixels, shown in zip(bar.pixels, bar.shown, strict=True):
        fits.append(fit_sphere(points_by_light(pixels, shown, bar.axes, cameras)))
        some = slice(None, None, -(-len(pixels) // limits.slopes))
        places = points_by_light(pixels[some], shown[some], bar.axes, cameras)
        slopes.append(_centre_slopes(places, bar.axes, cameras, names))
        shifted.append(_centre_slopes(places, bar.axes, cameras, centre)[:, 0])
    apart = fits[1].shape.centre - fits[0].shape.centre
    length = float(np.linalg.norm(apart))
    along = apart / length
    variance = SHARED * sum(along @ fit.covariance[:3, :3] @ along for fit in fits)
    variance += (COMMON_PX * float(along @ (shifted[1] - shifted[0]))) ** 2
    balls = (2 * fits[0].shape.radius, 2 * fits[1].shape.radius)
    return Measured(length, float(np.sqrt(variance)), along @ (slopes[1] - slopes[0]), balls)


def departure(found: Measured, certified_mm: tuple[float, float], known: Uncertainty) -> float:
    """Measured less certified length, in standard deviations of what the calibration's uncertainty, noise and certificate leave.

    found : with slopes by the uncertainty's parameters
    """
    length_mm, sigma_mm = certified_mm
    variance = found.by_optics @ known.covariance @ found.by_optics + found.sigma_mm**2 + sigma_mm**2
    return float((found.length_mm - length_mm) / np.sqrt(variance))


def equations(bars: Bars, cameras: Mapping[str, Camera], names: Sequence[str], lengths: int) -> DeviceRows:
    """Equations of the bar's length in all places, of variance 1, beside `lengths` of a target that they say nothing of.

    An error of the certificate is the same in all.
    """
    found = [measure(bar, cameras, names) for bar in bars.seen]
    noise = np.array([one.sigma_mm for one in found])
    whiten = whitening(np.diag(noise**2) + bars.sigma_mm**2)
    left = bars.length_mm - np.array([one.length_mm for one in found])
    return DeviceRows(whiten @ left, whiten @ np.stack([one.by_optics for one in found]), np.zeros((len(found), lengths)))


def _votes(grid: Array, camera: Camera, radius: float, limits: Limits) -> Array:
    """Centres : (m, 3) mm of balls of a radius on which points : (h, w, 3) mm would lie, by their normals."""
    known = np.isfinite(grid).all(axis=-1)
    if not known.any():
        return np.zeros((0, 3))
    distance = float(np.median(np.linalg.norm(grid[known] - camera.centre, axis=1)))
    half = max(1, round(limits.window * radius * camera.matrix[0, 0] / distance))
    smooth = ndimage.uniform_filter(np.where(known[..., None], grid, 0.0), (half, half, 0))
    smooth[ndimage.uniform_filter(known.astype(float), half) < 1 - 1e-6] = np.nan
    across, down = (np.roll(smooth, -half, axis) - np.roll(smooth, half, axis) for axis in (1, 0))
    normals = np.cross(across, down)[half:-half:half, half:-half:half].reshape(-1, 3)
    places = smooth[half:-half:half, half:-half:half].reshape(-1, 3)
    with np.errstate(invalid="ignore", divide="ignore"):
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        inwards = np.sign(np.sum(normals * (places - camera.centre), axis=1, keepdims=True))
    votes = places + radius * inwards * normals
    return votes[np.isfinite(votes).all(axis=1)]


def _ball(places: Array, votes: Array, camera: Camera, radius: float, limits: Limits) -> tuple[NDArray[np.intp], Sphere | None]:
    """Numbers of the points : (n, 3) mm on the ball that most votes are for, and the ball; None where it has too few points."""
    none = np.zeros(0, np.intp)
    if not len(votes):
        return none, None
    cells, counts = np.unique(np.floor(votes / (limits.vote * radius)).astype(int), axis=0, return_counts=True)
    middle = (cells[counts.argmax()] + 0.5) * limits.vote * radius
    near = np.linalg.norm(votes - middle, axis=1) < 2 * limits.vote * radius
    sphere, own = Sphere("", votes[near].mean(axis=0), radius), none
    for _ in range(3):
        away = places - sphere.centre
        distance = np.linalg.norm(away, axis=1)
        sight = camera.centre - sphere.centre
        with np.errstate(invalid="ignore", divide="ignore"):
            facing = away @ sight / (distance * np.linalg.norm(sight)) > limits.facing
        own = np.flatnonzero(facing & (np.abs(distance - sphere.radius) < limits.near * radius))
        if len(own) < limits.least:
            return none, None
        try:
            fit: Fit[Sphere] = fit_sphere(places[own[:: -(-len(own) // limits.most)]])
        except ValueError:  # a plane
            return none, None
        sphere = fit.shape
    return own, sphere


def _centre_slopes(points: Array, axes: Sequence[int], cameras: Mapping[str, Camera], names: Sequence[str]) -> Array:
    """Derivatives : (3, g) mm of a sphere's centre, fitted to points : (m, 3) mm by light, by the calibration's parameters."""
    camera, light = (linearise(cameras, name, points, names) for name in (CAMERAS[0], PROJECTOR))
    axis = axes[0]
    by_point = np.concatenate([camera.by_point, light.by_point[:, [axis]]], axis=1)
    by_optics = np.concatenate([camera.by_parameter, light.by_parameter[:, [axis]]], axis=1)
    moved = -np.linalg.solve(by_point, by_optics)  # (m, 3, g), with pixel and projector's coordinate as they are
    centre = fit_sphere(points).shape.centre
    normals = (points - centre) / np.linalg.norm(points - centre, axis=1, keepdims=True)
    outwards = np.einsum("mi,mig->mg", normals, moved)
    return (np.linalg.pinv(np.column_stack([normals, np.ones(len(points))])) @ outwards)[:3]
