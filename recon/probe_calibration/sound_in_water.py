"""Speed of sound in water, and the depths shown at a speed other than the scanner's.

A scanner shows an echo of delay tau at the depth `c0 tau / 2`, with the speed c0 that it assumes, mostly 1540 m/s; it lies at
`c tau / 2`. In water of 22 degrees (1488 m/s) everything is 3.4 % nearer than shown: 1.7 mm at 50 mm. Along the array nothing
changes: the lines of a linear array stand where its elements do.

A calibration in water finds mm of water a pixel, with no need of the temperature: `sy = sy_scanner c_water / c0`. It is right for
sweeps through the same water. For tissue, or water of another temperature, it is converted by the ratio of the speeds; depths
scale about the probe's face, where the delay is zero. A calibration holds the speed that it is right for.
"""

from dataclasses import replace

import numpy as np
from numpy.polynomial.polynomial import polyder, polyval
from numpy.typing import ArrayLike, NDArray

from recon.errors import InputError
from recon.estimation.covariance import propagate
from recon.geometry import rigid
from recon.model.calibration import Uncertainty
from recon.model.probe import SCANNER_SPEED, ProbeCalibration, speed_fault

Array = NDArray[np.float64]

VALID_C = (0.0, 95.0)  # degrees Celsius
MARCZAK = (1402.385, 5.038813, -5.799136e-2, 3.287156e-4, -1.398845e-6, 2.787860e-9)  # m/s, by powers of degrees Celsius


def speed_of_sound(temperature_c: ArrayLike) -> Array:
    """Speed of sound : (...) m/s in pure water at atmospheric pressure, to 0.02 m/s.

    Raises
    ------
    InputError
        Outside 0 to 95 degrees Celsius.

    Source: Marczak 1997, J. Acoust. Soc. Am. 102(5) 2776, from Del Grosso and Mader, Kroebel and Mahrt, and Fujii and Masui.
    """
    temperature = np.asarray(temperature_c, float)
    inside = (temperature >= VALID_C[0]) & (temperature <= VALID_C[1])
    if not inside.all():
        found = np.extract(~inside, temperature)[0]
        raise InputError(f"temperature_c: expected {VALID_C[0]:g} to {VALID_C[1]:g} degrees Celsius, found {found:g}")
    return polyval(temperature, MARCZAK)


def speed_sigma(temperature_c: ArrayLike, sigma_c: ArrayLike) -> Array:
    """Standard deviation of the speed : (...) m/s that follows from one of the temperature: 2.8 m/s a degree at 22."""
    return np.abs(polyval(np.asarray(temperature_c, float), polyder(MARCZAK))) * np.asarray(sigma_c, float)


def true_over_shown(speed: ArrayLike, assumed: float = SCANNER_SPEED) -> Array:
    """True depth over the one shown : (...), in a medium of a speed : (...) m/s, on a scanner that assumes another."""
    return np.asarray(speed, float) / assumed


def shown_too_deep(depth_mm: ArrayLike, speed: ArrayLike, assumed: float = SCANNER_SPEED) -> Array:
    """Shown less true depth : (...) mm of an echo at a shown depth : (...) mm below the face."""
    return np.asarray(depth_mm, float) * (1 - true_over_shown(speed, assumed))


def implied_speed(calibration: ProbeCalibration, scanner_sy: float, assumed: float = SCANNER_SPEED) -> tuple[float, float]:
    """Speed of sound and its standard deviation, m/s, implied by a calibrated sy beside the scanner's own in mm/px.

    A difference from the speed at the water's temperature shows a wrong depth setting, or a wrong thermometer.
    """
    sigma = calibration.uncertainty.sigma("sy") if calibration.uncertainty is not None else 0.0
    return float(assumed * calibration.scale[1] / scanner_sy), float(assumed * sigma / scanner_sy)


def in_tissue(world_from_pixel: Array, calibrated: float, speed: float, face_row: float = 0.0) -> Array:
    """Convert matrices : (..., 4, 4) px to mm from a calibrated speed to that of another medium; the face keeps its place."""
    _check(calibrated=calibrated, speed=speed)
    ratio = speed / calibrated
    stretch = np.diag([1, ratio, 1, 1])
    stretch[1, 3] = (1 - ratio) * face_row
    return world_from_pixel @ stretch


def in_medium(calibration: ProbeCalibration, calibrated: float, speed: float, ratio_sigma: float = 0.0) -> ProbeCalibration:
    """A calibration made in a medium of one speed, for images of a medium of another.

    The face keeps its place, so the image's origin moves if the face isn't row 0.

    Parameters
    ----------
    calibrated, speed : float, m/s
        Of the medium of the calibration, and of that of the images: 1540 for the scanner's own scale.
    ratio_sigma : float
        Standard deviation of `speed / calibrated`, say from that of the temperature.
    """
    _check(calibrated=calibrated, speed=speed)
    ratio, face_row = speed / calibrated, calibration.face_row
    sx, sy = calibration.scale
    depth = calibration.target_from_image[:3, 1]
    origin = calibration.target_from_image[:3, 3] + depth * sy * (1 - ratio) * face_row
    uncertainty = calibration.uncertainty
    if uncertainty is not None:
        jacobian, by_ratio = _jacobian(uncertainty.names, depth, sy, ratio, face_row)
        covariance = propagate(jacobian, uncertainty.covariance) + ratio_sigma**2 * np.outer(by_ratio, by_ratio)
        uncertainty = Uncertainty(uncertainty.names, covariance)
    turn = calibration.target_from_image[:3, :3]
    return ProbeCalibration(rigid.transform(turn, origin), np.array([sx, sy * ratio]), uncertainty, speed, face_row)


def for_tissue(calibration: ProbeCalibration, speed: float | None, sigma: float = 0.0) -> ProbeCalibration:
    """A calibration converted from its speed to that of the images' medium, its own if that isn't given.

    sigma : of the medium's speed, m/s, added to the covariance as that of sy; a calibration without one is taken as exact.
    """
    if sigma and calibration.uncertainty is None:
        calibration = replace(calibration, uncertainty=Uncertainty(("sy",), np.zeros((1, 1))))
    calibrated = calibration.speed_m_s
    if speed is None and not sigma:
        return calibration
    return in_medium(calibration, calibrated, speed or calibrated, ratio_sigma=sigma / calibrated)


def _check(**speeds: float) -> None:
    for name, value in speeds.items():
        if fault := speed_fault(value):
            raise InputError(f"{name}: {fault}")


def _jacobian(names: tuple[str, ...], depth: Array, sy: float, ratio: float, face_row: float) -> tuple[Array, Array]:
    """Of the converted parameters by the calibrated ones : (g, g), and by the ratio of the speeds : (g,)."""
    columns = {name: np.zeros(len(names)) for name in names}
    for k, name in enumerate(names):
        columns[name][k] = ratio if name == "sy" else 1.0
    by_ratio = np.array([sy if name == "sy" else 0.0 for name in names])
    shift = ("tx", "ty", "tz")
    moved = {  # of the origin
        "sy": depth * (1 - ratio) * face_row,
        **{f"r{axis}": np.cross(np.eye(3)[k], depth) * sy * (1 - ratio) * face_row for k, axis in enumerate("xyz")},
    }
    for k, name in enumerate(names):
        if name in shift:
            by_ratio[k] = -depth[shift.index(name)] * sy * face_row
            for other, change in moved.items():
                if other in names:
                    columns[other][k] += change[shift.index(name)]
    return np.column_stack([columns[name] for name in names]), by_ratio
