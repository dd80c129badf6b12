"""Pairs of views of a target that differs from its design: ellipses with noise, without images."""

import numpy as np

from recon.geometry.circle_outline import ellipses_of
from recon.model import circle_layout
from recon.target_calibration.target_poses import Seen
from recon.tracking.pose_fit import Sighting
from tests.recon.tracking import drawings

CENTRE_PX, SHAPE = 0.01, 4e-4  # standard deviations, of centres and of shapes as a share of the disc's size


def printed(design, rng, tolerance_mm=0.1, diameter_mm=0.03, curvature_per_m=0.2):
    """A target as a printer makes it of a design."""
    deviation = rng.multivariate_normal(np.zeros(3), circle_layout.length_covariance(design)) * tolerance_mm / 0.1
    c1, aside, c2 = (circle_layout.lengths(design) + deviation).tolist()
    curvature = tuple((curvature_per_m * rng.standard_normal(3)).tolist())
    diameter = design.outer_diameter_mm + diameter_mm * rng.standard_normal()
    update = {"c1_mm": c1, "c2_aside_mm": aside, "c2_mm": c2, "outer_diameter_mm": diameter, "curvature_per_m": curvature}
    return design.model_copy(update=update)


def seen(cameras, actual, pose, rng, shown_by=None):
    """One pair; through other cameras than the calibrated ones if some are given."""
    views = []
    for camera, real in zip(cameras, shown_by or cameras, strict=True):
        centres, shapes = ellipses_of(real, pose, *circle_layout.circles(actual))
        size = np.trace(shapes, axis1=1, axis2=2)[:, None, None] / 2
        skew = SHAPE * size * rng.standard_normal((3, 2, 2))
        shapes = shapes + np.triu(skew) + np.swapaxes(np.triu(skew, 1), 1, 2)
        covariance = np.tile(CENTRE_PX**2 * np.eye(2), (3, 1, 1))
        views.append(Sighting(camera, centres + CENTRE_PX * rng.standard_normal((3, 2)), covariance, shapes))
    return Seen((views[0], views[1]), pose)


def many(cameras, actual, count, rng, shown_by=None, tilt_deg=35.0):
    """Pairs over the working volume."""
    return [seen(cameras, actual, drawings.facing(rng, tilt_deg), rng, shown_by) for _ in range(count)]
