"""A calibration: the devices of the rig in one world, and the covariance of their parameters."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from recon.geometry.camera import Array, Camera

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

    def sigma(self, name: str) -> float:
        """Standard deviation of one parameter; zero if it was held fixed."""
        if name not in self.names:
            return 0.0
        k = self.names.index(name)
        return float(np.sqrt(self.covariance[k, k]))


@dataclass(frozen=True)
class Calibration:
    """The calibrated devices by name: `cam1`, `cam2`, `projector`. World is the frame of camera 1."""

    cameras: Mapping[str, Camera]
    uncertainty: Uncertainty | None = None
