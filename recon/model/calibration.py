"""A calibration: the devices of the rig in one world, and the covariance of their parameters."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from recon import arguments
from recon.estimation.covariance import propagate
from recon.estimation.parameters import of_block
from recon.geometry import camera_jacobian
from recon.geometry.camera import Array, Camera
from recon.geometry.camera_jacobian import Linearised

DRIFT_PX = 0.05  # usual standard deviation of cameras' principal points since their calibration
FOCAL_DRIFT = 4.0e-4  # relative change of a focal length for each px of such a drift; assumed: 0.05 px go with a kelvin, by which
# aluminium, which lens barrels are of, expands by 2.3e-5
PRINT_SCALE = 3.0e-4  # usual relative standard deviation of the scale of a board printed on paper, which takes up moisture
WORLD = "cam1"  # the device whose frame the world is: it has no pose


@dataclass(frozen=True)
class Uncertainty:
    """Covariance of a calibration's parameters, by their names.

    A name is `DEVICE.PARAMETER`: `fx fy cx cy` in px; `k1 k2 p1 p2 k3 k4 k5 k6 s1 s2 s3 s4 tau_x tau_y`; and for all devices but
    the world's `rx ry rz` in rad and `tx ty tz` in mm, a turn and a shift of the calibrated `device_from_world`:
    `R = exp([r]) R_calibrated`, `t = t_calibrated + (tx, ty, tz)`. Parameters that were held fixed have no name here.
    """

    names: tuple[str, ...]  # (g,)
    covariance: Array  # (g, g)
    has_scale: bool = False  # whether the error of the scale is in it: that of the board's print, which no image shows

    def sigma(self, name: str) -> float:
        """Standard deviation of one parameter; zero if it was held fixed."""
        if name not in self.names:
            return 0.0
        k = self.names.index(name)
        return float(np.sqrt(self.covariance[k, k]))

    def ordered(self, names: Sequence[str]) -> Array:
        """Covariance : (n, n) of parameters in another order; zero of those that were held fixed."""
        order = [names.index(name) for name in self.names]
        covariance = np.zeros((len(names), len(names)))
        covariance[np.ix_(order, order)] = self.covariance
        return covariance


@dataclass(frozen=True)
class Calibration:
    """The calibrated devices by name: `cam1`, `cam2`, `projector`. World is the frame of camera 1."""

    cameras: Mapping[str, Camera]  # each with its name
    uncertainty: Uncertainty | None = None

    def __post_init__(self) -> None:
        arguments.of_kind("cameras", self.cameras, Mapping)
        arguments.of_kind("uncertainty", self.uncertainty, Uncertainty, type(None))
        for name, camera in self.cameras.items():
            arguments.of_kind(f"cameras: {name}", camera, Camera)
        named = {name: camera if camera.name == name else replace(camera, name=name) for name, camera in self.cameras.items()}
        object.__setattr__(self, "cameras", named)


def in_use(known: Uncertainty | None, cameras: Mapping[str, Camera], scale: float | None, drift_px: float) -> Uncertainty | None:
    """Uncertainty of cameras that are used some time after they were calibrated: `with_scale` and `with_drift`."""
    return with_drift(with_scale(known, cameras, scale), cameras, drift_px)


def with_drift(known: Uncertainty | None, cameras: Mapping[str, Camera], drift_px: float) -> Uncertainty | None:
    """Add that devices have warmed, or turned on their mounts, since they were calibrated.

    drift_px : standard deviation of each device's principal point along each axis; a turn by as much is all but the same. Its
        focal lengths change together, by FOCAL_DRIFT times as much.
    """
    if drift_px == 0:
        return known
    moved = [f"{device}.{name}" for device in cameras for name in ("cx", "cy", "fx", "fy")]
    wider = _extended(known, moved)
    for device, camera in cameras.items():
        centre, focal = ([wider.names.index(f"{device}.{name}") for name in pair] for pair in (("cx", "cy"), ("fx", "fy")))
        wider.covariance[centre, centre] += drift_px**2
        longer = drift_px * FOCAL_DRIFT * camera.matrix[[0, 1], [0, 1]]
        wider.covariance[np.ix_(focal, focal)] += np.outer(longer, longer)
    return wider


def with_scale(known: Uncertainty | None, cameras: Mapping[str, Camera], sigma: float | None) -> Uncertainty | None:
    """Make the scale of all places at least as uncertain as the print of the board that gave it.

    A board's aspect and shear, which images show, say little of its scale, which they don't. All translations grow or shrink
    together by it, and with them all that the devices measure.

    sigma : relative standard deviation of its scale; None for what the calibration has, and that of paper where it has none
    """
    if sigma is None:
        if known is not None and known.has_scale:
            return known
        sigma = PRINT_SCALE
    moved = [f"{device}.{name}" for device in cameras if device != WORLD for name in ("tx", "ty", "tz")]
    shift = np.concatenate([camera.camera_from_world[:3, 3] for device, camera in cameras.items() if device != WORLD])
    wider = _extended(known, moved)
    order = [wider.names.index(name) for name in moved]
    translations = np.ix_(order, order)
    found = shift @ wider.covariance[translations] @ shift / (shift @ shift) ** 2
    if sigma**2 <= found:
        return None if known is None else replace(known, has_scale=True)
    wider.covariance[translations] += (sigma**2 - found) * np.outer(shift, shift)
    return replace(wider, has_scale=True)


def _extended(known: Uncertainty | None, names: Sequence[str]) -> Uncertainty:
    """A copy that has parameters of these names, too; without error where they were held fixed."""
    own = () if known is None else known.names
    every = (*own, *(name for name in names if name not in own))
    if known is None:
        return Uncertainty(every, np.zeros((len(every), len(every))))
    return replace(known, names=every, covariance=known.ordered(every))


def moved(cameras: Mapping[str, Camera], names: Sequence[str], step: Array) -> dict[str, Camera]:
    """Devices with their parameters changed by a step : (g,), in the order of names as of `Uncertainty`."""
    own = {device: of_block(names, device) for device in cameras}
    return {device: camera_jacobian.moved(cameras[device], short, step[at]) for device, (at, short) in own.items()}


def linearise(cameras: Mapping[str, Camera], device: str, points: Array, names: Sequence[str]) -> Linearised:
    """A device's projection of points : (m, 3) mm, with derivatives by all parameters of names as of `Uncertainty`."""
    at, short = of_block(names, device)
    found = camera_jacobian.linearise(cameras[device], points, short)
    by_parameter = np.zeros((len(points), 2, len(names)))
    by_parameter[..., at] = found.by_parameter
    return replace(found, by_parameter=by_parameter)


def projection_slopes(cameras: Mapping[str, Camera], points: Sequence[Array], names: Sequence[str]) -> Array:
    """Derivatives : (m, g) px of all devices' projections, x and y of point after point, by the calibration's parameters.

    points : of each device, (n, 3) mm in the world.
    """
    slopes = [linearise(cameras, device, shown, names).by_parameter for device, shown in zip(cameras, points, strict=True)]
    return np.concatenate(slopes).reshape(-1, len(names))


def projection_covariance(cameras: Mapping[str, Camera], points: Sequence[Array], uncertainty: Uncertainty) -> Array:
    """Covariance : (m, m) px^2 of all devices' projections, in the order of `projection_slopes`, by the calibration's errors."""
    return propagate(projection_slopes(cameras, points, uncertainty.names), uncertainty.covariance)
