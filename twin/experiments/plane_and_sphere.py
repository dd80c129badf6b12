"""A plane and a sphere, measured with a calibration: the figures of the paper's experiments."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from recon.model.calibration import Calibration
from recon.model.patterns import Fringes, Patterns
from recon.structured_light.phase import wrapped_phase
from recon.structured_light.surface_mesh import clean
from recon.structured_light.triangulate import triangulate
from twin.evaluation import surface_errors
from twin.evaluation.surface_errors import rms
from twin.experiments.surface_accuracy import Experiment

Array = NDArray[np.float64]

FULL = 255.0  # DN
FORM_POWERS = [(i, j) for i in range(4) for j in range(4 - i)]  # of x and y: the smooth part of a plane's error


@dataclass(frozen=True)
class Measured:
    """A plane and a sphere measured with one calibration."""

    plane_rms_mm: float
    form_mm: float  # the smooth part of the plane's error
    radius_error_mm: float  # of the sphere
    sphere_rms_mm: float


def measured(shots: tuple[Experiment, Experiment], calibration: Calibration) -> Measured:
    """Measure a plane and a sphere with a calibration of camera 1 and projector."""
    flat, ball = (_on_shape(shot, calibration) for shot in shots)
    plate, sphere = (shot.truth.shapes[0] for shot in shots)
    first, second = surface_errors.fit(plate, flat), surface_errors.fit(sphere, ball)
    return Measured(
        first["plane_plate_rms_mm"],
        form_rms(flat),
        second["sphere_sphere_radius_error_mm"],
        second["sphere_sphere_rms_mm"],
    )


def _on_shape(shot: Experiment, calibration: Calibration) -> Array:
    """Measured points : (m, 3) mm of a shot's first shape, away from edges, some of many."""
    camera, projector = calibration.cameras["cam1"], calibration.cameras["projector"]
    points = clean(triangulate(shot.found, camera, projector), camera, shot.found.modulation).points
    used = shot.comparison.interior & np.isfinite(points[..., 0])
    used &= np.abs(shot.truth.shapes[0].distance(shot.truth.points)) < surface_errors.ON_SHAPE_MM
    chosen = np.float64(points[used])
    return chosen[:: max(len(chosen) // surface_errors.MOST_FITTED, 1)]


def form_rms(points: Array) -> float:
    """RMS of the smooth part of points' : (m, 3) mm distances from their plane: a polynomial of the third degree."""
    middle = points - points.mean(axis=0)
    axes = np.linalg.svd(middle[:: max(len(middle) // 20000, 1)], full_matrices=False)[2]
    x, y, z = (middle @ axes.T).T
    powers = np.stack([(x / 100) ** i * (y / 100) ** j for i, j in FORM_POWERS], axis=1)
    solved = np.linalg.lstsq(powers, z, rcond=None)[0]
    plain = [k for k, (i, j) in enumerate(FORM_POWERS) if i + j <= 1]
    smooth = powers @ solved
    return rms(smooth - powers[:, plain] @ np.linalg.lstsq(powers[:, plain], smooth, rcond=None)[0])


def as_published(shot: Experiment, patterns: Patterns) -> Experiment:
    """The same shot with columns from the phase of its images as they are; orders stay."""
    ((part, place),) = [(part, place) for part, place in patterns.slices() if isinstance(part, Fringes)]
    plain = wrapped_phase(shot.view.images[place], part.shifts, noise=shot.found.noise, saturation=FULL).phase
    assert shot.found.columns is not None
    change = part.pitch / (2 * np.pi) * np.angle(np.exp(1j * (plain - shot.found.phase)))
    return replace(shot, found=replace(shot.found, columns=np.float32(shot.found.columns + change)))
