"""Propagation of a calibration's covariance to measurements: millimetres of a point, pixels of a projection.

All of it is linear propagation of the parameters' covariance, which holds as long as the second derivatives are small over a
standard deviation; for calibrations in use they are. The world is camera 1's frame, so a part of a point's uncertainty is only a
common shift and turn of everything: `triangulation` has it in, `shape` leaves out what a rigid motion of the working volume
explains, and keeps what distances and shapes suffer from. A projection is left unchanged where the frame and the intrinsics move
together, as they do in a calibration; `projection` therefore takes the frame's motion out too.

Source: the propagation is the implicit function theorem at the least-squares solution; that intrinsics and frame compensate each
other, and what to do about it: D. Kogan, mrcal, "How uncertain is a projection".
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from recon.estimation.covariance import propagate
from recon.geometry.camera import Array, Camera
from recon.model.calibration import Calibration, Uncertainty, linearise, moved

GRID = (9, 7)  # points of the working volume a depth, across and down
MAP_STEP_PX = 16  # of maps over an image


def apply(calibration: Calibration, change: Array) -> Calibration:
    """Move the parameters of a calibration by change : (g,), in the order and the units of its uncertainty's names."""
    return replace(calibration, cameras=moved(calibration.cameras, _known(calibration).names, np.asarray(change, float)))


def working_volume(calibration: Calibration, depths: Sequence[float]) -> Array:
    """Points that all devices see : (m, 3) mm in the world, on a grid over camera 1's image at each depth (z, mm).

    Raises
    ------
    ValueError
        If the devices have fewer than three such points in common.
    """
    camera = next(iter(calibration.cameras.values()))
    across, down = (np.linspace(0, length - 1, steps) for length, steps in zip(camera.size, GRID, strict=True))
    rays = camera.rays(np.stack(np.meshgrid(across, down), axis=-1).reshape(-1, 2))
    points = np.concatenate([camera.centre + rays * ((z - camera.centre[2]) / rays[:, 2:]) for z in depths])
    points = points[seen(calibration, points)]
    if len(points) < 3:
        raise ValueError(f"depths: expected some at which the devices' views overlap, found {list(depths)}")
    return points


def seen(calibration: Calibration, points: Array) -> Array:
    """Whether all devices have a point of points : (m, 3) mm in their image : (m,) bool."""
    inside = np.ones(len(points), bool)
    for camera in calibration.cameras.values():
        pixels = camera.project(points)
        with np.errstate(invalid="ignore"):
            inside &= ((pixels > -0.5) & (pixels < np.array(camera.size) - 0.5)).all(axis=-1)
    return inside


def triangulation(
    calibration: Calibration, first: str, second: str, points: Array, pixel_sigma: tuple[ArrayLike, ArrayLike] = (1.0, 1.0)
) -> Array:
    """Uncertainty of points triangulated from exact pixels of two devices, by that of all calibrated parameters.

    Parameters
    ----------
    first, second : str
        Names of the devices. A point is where the squares of its distances in both images, u and v, add up to least.
    points : (m, 3), mm
        In the world.
    pixel_sigma : (2,), px
        Weighs the devices' pixels against each other as `1 / sigma^2`; a pair for a device weighs its u and v, infinite where
        it has one alone. The pixels' own noise is not in the result.

    Returns
    -------
    (m, 3, 3), mm^2
        Covariance of each point in the world.

    Raises
    ------
    ValueError
        If the calibration has no uncertainty.
    """
    return _covariances(calibration, point_slopes(calibration, first, second, points, pixel_sigma))


def parting(calibration: Calibration, points: Array, axes: Sequence[int] = (0,)) -> Array:
    """Derivatives : (m, 3, g) mm of what parts points : (m, 3) mm, as measured by camera 1 and light, from both cameras' own.

    Skin is measured the one way, the probe the other: an error of the frame that both share moves neither against the other.

    axes : of the projector's coordinates that are decoded, 0 of columns and 1 of rows
    """
    decoded = np.where(np.isin([0, 1], axes), 1.0, np.inf)
    by_light = point_slopes(calibration, "cam1", "projector", points, (1.0, decoded))
    return by_light - point_slopes(calibration, "cam1", "cam2", points, (1.0, 1.0))


def shape(
    calibration: Calibration,
    first: str,
    second: str,
    points: Array,
    volume: Array,
    pixel_sigma: tuple[float, float] = (1.0, 1.0),
) -> Array:
    """The same as `triangulation`, less the rigid motion that fits the working volume best.

    Parameters
    ----------
    volume : (k, 3), mm
        Points that stand for the working volume, as from `working_volume`: the motion is fitted to these.
    """
    motion = _modes(calibration, first, second, volume, rigid_modes(volume), pixel_sigma)
    slopes = point_slopes(calibration, first, second, points, pixel_sigma)
    return _covariances(calibration, slopes - rigid_modes(points) @ motion)


def scale(
    calibration: Calibration, first: str, second: str, volume: Array, pixel_sigma: tuple[ArrayLike, ArrayLike] = (1.0, 1.0)
) -> float:
    """Standard deviation of the scale of lengths in a volume : (k, 3) mm, as a ratio: 1e-4 is 0.1 mm in 1 m."""
    stretch = _modes(calibration, first, second, volume, similarity_modes(volume), pixel_sigma)[-1]
    variance = stretch @ _known(calibration).covariance @ stretch
    return float(np.sqrt(max(variance, 0.0)))  # rounding may leave a zero below zero


def similarity_modes(points: Array) -> Array:
    """Displacements : (m, 3, 7) of points : (m, 3) mm by small turns and shifts of all, and by a growth about their middle."""
    return np.concatenate([rigid_modes(points), (points - points.mean(axis=0))[..., None]], axis=-1)


def mean_squares(calibration: Calibration, first: str, second: str, volume: Array) -> tuple[Array, Array]:
    """Quadratic forms : (g, g) that turn a covariance of the parameters into mean variances of points over a volume : (k, 3) mm.

    The trace of a form's product with any covariance of the same parameters is the mean over the volume of the summed variances
    of a point, mm^2: the first form's of `triangulation`, the second's of `shape`. The calibration's own covariance isn't used.
    """
    slopes = point_slopes(calibration, first, second, volume, (1.0, 1.0))
    within = slopes - rigid_modes(volume) @ _fit(rigid_modes(volume), slopes)
    forms = [np.einsum("kig,kih->gh", part, part) / len(volume) for part in (slopes, within)]
    return forms[0], forms[1]


def projection(calibration: Calibration, device: str, points: Array, volume: Array) -> Array:
    """Uncertainty of where a device sees a point, the motion of the world's frame taken out.

    The frame moves with the parameters so that all devices together see the working volume with the least change.

    Parameters
    ----------
    points : (m, 3), mm
        In the world.
    volume : (k, 3), mm
        Points that stand for the working volume.

    Returns
    -------
    (m, 2, 2), px^2
        Covariance of each point's pixel.
    """
    modes, slopes = [], []
    for name in calibration.cameras:
        by_point, by_parameter = _slopes(calibration, name, volume)
        modes.append(by_point @ rigid_modes(volume))
        slopes.append(by_parameter)
    motion = -_fit(np.concatenate(modes), np.concatenate(slopes))
    by_point, by_parameter = _slopes(calibration, device, points)
    return _covariances(calibration, by_parameter + by_point @ rigid_modes(points) @ motion)


def projection_map(calibration: Calibration, device: str, depth: float, volume: Array) -> Array:
    """Standard deviation of `projection` over a device's image, of points of the world's plane z = depth : (h, w) px, thinned."""
    points, form = _points_at(calibration.cameras[device], depth)
    return _total(projection(calibration, device, points, volume)).reshape(form)


def point_maps(calibration: Calibration, first: str, second: str, depth: float, volume: Array) -> tuple[Array, Array]:
    """Standard deviations of `triangulation` and of `shape` over the first device's image, thinned.

    Of points of the world's plane z = depth : (h, w) mm each, NaN where the second device doesn't see them.
    """
    points, form = _points_at(calibration.cameras[first], depth)
    both = replace(calibration, cameras={name: calibration.cameras[name] for name in (first, second)})
    common = seen(both, points)
    maps = np.full((2, len(points)), np.nan)
    maps[0, common] = _total(triangulation(calibration, first, second, points[common]))
    maps[1, common] = _total(shape(calibration, first, second, points[common], volume))
    return maps[0].reshape(form), maps[1].reshape(form)


def _points_at(camera: Camera, depth: float) -> tuple[Array, tuple[int, int]]:
    """Points : (h * w, 3) mm of the world's plane z = depth on the rays of a grid of pixels, and the grid's shape."""
    width, height = camera.size
    u, v = (np.arange(MAP_STEP_PX / 2 - 0.5, length, MAP_STEP_PX) for length in (width, height))
    rays = camera.rays(np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2))
    return camera.centre + rays * ((depth - camera.centre[2]) / rays[:, 2:]), (len(v), len(u))


def _total(covariances: Array) -> Array:
    """Root of the summed variances of covariances : (m, k, k)."""
    return np.sqrt(np.trace(covariances, axis1=-2, axis2=-1))


def _covariances(calibration: Calibration, slopes: Array) -> Array:
    """Covariances : (m, k, k) of values that depend on the parameters by slopes : (m, k, g)."""
    return propagate(slopes, _known(calibration).covariance)


def point_slopes(
    calibration: Calibration, first: str, second: str, points: Array, pixel_sigma: tuple[ArrayLike, ArrayLike]
) -> Array:
    """Derivatives of triangulated points by the parameters : (m, 3, g): `d(point) = -(A^T A)^-1 A^T B d(parameters)`.

    Points and weights are those of `triangulation`.
    """
    pairs = [_slopes(calibration, device, points) for device in (first, second)]
    by_point, by_parameter = (
        np.concatenate([pair[k] / np.reshape(sigma, (-1, 1)) for pair, sigma in zip(pairs, pixel_sigma, strict=True)], axis=-2)
        for k in (0, 1)
    )
    return -np.linalg.pinv(by_point) @ by_parameter


def _modes(
    calibration: Calibration, first: str, second: str, volume: Array, modes: Array, pixel_sigma: tuple[float, float]
) -> Array:
    """Shares of the modes : (k, 3, j) of a volume in the effect of each parameter : (j, g), by least squares."""
    return _fit(modes, point_slopes(calibration, first, second, volume, pixel_sigma))


def _fit(modes: Array, slopes: Array) -> Array:
    """Least squares of slopes : (k, c, g) by modes : (k, c, j), over all k and c : (j, g)."""
    return np.linalg.lstsq(modes.reshape(-1, modes.shape[-1]), slopes.reshape(-1, slopes.shape[-1]), rcond=None)[0]


def rigid_modes(points: Array) -> Array:
    """Derivatives of points : (m, 3) by small shifts along and turns about the three axes : (m, 3, 6), mm / mm and mm / rad."""
    modes = np.zeros((len(points), 3, 6))
    modes[:, :, :3] = np.eye(3)
    x, y, z = points.T
    modes[:, 1, 3], modes[:, 2, 3] = -z, y
    modes[:, 0, 4], modes[:, 2, 4] = z, -x
    modes[:, 0, 5], modes[:, 1, 5] = -y, x
    return modes


def _slopes(calibration: Calibration, device: str, points: Array) -> tuple[Array, Array]:
    """Derivatives of a device's pixels by the points : (m, 2, 3), px/mm, and by all parameters : (m, 2, g)."""
    found = linearise(calibration.cameras, device, points, _known(calibration).names)
    return found.by_point, found.by_parameter


def _known(calibration: Calibration) -> Uncertainty:
    if calibration.uncertainty is None:
        raise ValueError("expected a calibration with the covariance of its parameters, found one without")
    return calibration.uncertainty
