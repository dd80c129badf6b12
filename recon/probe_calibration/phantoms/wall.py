"""A flat wall, such as a tank's bottom (Prager et al. 1998): its line by `echo_curve`, then `surface_calibration`."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from recon.probe_calibration import echo_curve, surface_phantom
from recon.probe_calibration.cross_wire import Appearance
from recon.probe_calibration.echo_curve import Curve
from recon.probe_calibration.surface_calibration import MIN_FRAMES, CurveSightings
from recon.probe_calibration.surface_phantom import calibrate, describe, figures
from recon.probe_calibration.tank_calibration import Settings

Array = NDArray[np.float64]

__all__ = ["MIN_FRAMES", "SHOWS", "WAYS", "calibrate", "describe", "figures", "find", "read", "sight"]
SHOWS = "line of the wall"
WAYS = {
    echo_curve.NO_ECHO: "is the wall in view? another scanner? give appearance.min_contrast_db",
    echo_curve.NO_LINE: "crossed wires or N-wires? give phantom=crossed_wires or phantom=n_wires",
    echo_curve.SHORT: "crossed wires? give phantom=crossed_wires; a sphere? give phantom=sphere",
    echo_curve.CURVED: "a sphere? give phantom=sphere and sphere_radius_mm=",
    echo_curve.SEVERAL: "side walls? give clip=[u,v,width,height] without them",
}


def read(settings: Settings, reference: str | None) -> None:
    """Nothing is known beforehand."""
    del settings, reference


def find(image: NDArray, appearance: Appearance | None, known: None) -> Curve:
    """Find the line."""
    del known
    return echo_curve.find_line(image, appearance)


def sight(
    seen: Sequence[Curve], poses: Array, covariance: Array | None, rates: Array | None, lag_sigma_s: float
) -> CurveSightings:
    """The line in n frames, by two points."""
    return surface_phantom.sight(seen, poses, covariance, rates, lag_sigma_s, points=2)
