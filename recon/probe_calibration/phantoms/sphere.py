"""A sphere of known radius: its arc by `echo_curve`, then `surface_calibration`."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from recon.errors import InputError
from recon.probe_calibration import echo_curve, surface_phantom
from recon.probe_calibration.cross_wire import Appearance
from recon.probe_calibration.echo_curve import Curve
from recon.probe_calibration.surface_calibration import MIN_FRAMES, CurveSightings
from recon.probe_calibration.surface_phantom import calibrate, describe, figures
from recon.probe_calibration.tank_calibration import Settings

Array = NDArray[np.float64]

__all__ = ["MIN_FRAMES", "SHOWS", "WAYS", "calibrate", "describe", "figures", "find", "read", "sight"]
SHOWS = "arc of the sphere"
WAYS = {
    echo_curve.NO_ECHO: "is the sphere in view? another scanner? give appearance.min_contrast_db",
    echo_curve.NO_ARC: "crossed wires or N-wires? give phantom=crossed_wires or phantom=n_wires",
    echo_curve.STRAIGHT: "a wall? give phantom=wall",
    echo_curve.HOLLOW: "are the images upside down?",
    echo_curve.SEVERAL: "give clip=[u,v,width,height] with one sphere",
}


def read(settings: Settings, reference: str | None) -> tuple[float, float]:
    """The radius, mm, and its standard deviation."""
    del reference
    if settings.sphere_radius_mm is None:
        raise InputError("sphere_radius_mm: expected the sphere's radius in mm, found none; give sphere_radius_mm=")
    return settings.sphere_radius_mm, settings.sphere_radius_sigma_mm


def find(image: NDArray, appearance: Appearance | None, known: tuple[float, float]) -> Curve:
    """Find the arc."""
    del known
    return echo_curve.find_arc(image, appearance)


def sight(
    seen: Sequence[Curve], poses: Array, covariance: Array | None, rates: Array | None, lag_sigma_s: float
) -> CurveSightings:
    """The arc in n frames, by three points."""
    return surface_phantom.sight(seen, poses, covariance, rates, lag_sigma_s, points=3)
