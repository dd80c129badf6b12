"""A session's errors from board to mass, by drawn measurements: points of the surface, pixels of B-scans, a mass's centre.

Errors of points and pixels are those in camera 1's frame; the mass's also against the skin over it, as light measures that.

Beside them stand the errors that the software predicts, by their parts.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from recon.errors import InputError
from recon.files.metrics import Metrics
from recon.freehand import place_uncertainty, sequences
from recon.freehand.place_uncertainty import PlaceErrors
from recon.geometry import rigid
from recon.geometry.camera import Camera
from recon.geometry.camera_jacobian import linearise
from recon.model import calibration
from recon.model.calibration import DRIFT_PX, PRINT_SCALE, in_use
from recon.optical_calibration import uncertainty
from twin.evaluation.surface_errors import rms
from twin.experiments import drawn_session
from twin.experiments.drawn_session import Noise, Session
from twin.experiments.experiment_runs import Experiment, Settings
from twin.experiments.layout import laid_out
from twin.working_range import working_range

Array = NDArray[np.float64]

MEASURING = ("cam1", "projector")
CONDITIONS = (  # that act on drawn measurements
    *(f"conditions.board.{name}" for name in ("place_mm", "stretch", "bow_mm", "flex_mm")),
    *(f"conditions.motion.{name}" for name in ("trigger_s", "bracket_mm", "bracket_deg")),
    "conditions.target",
    "conditions.sound",
    "conditions.drift",
)
NEWTON_STEPS = 5
DEPTHS_MM = (620.0, 660.0, 700.0)  # z of the surface's points in the paper's rig
GRID = (7, 7)  # pixels of a B-scan, across and down
MASS_MM, DEEP_MM = 7.0, 25.0  # radius of the mass, depth of its middle in the image


def measure(settings: Settings, seed: int) -> Metrics:
    """Figures of one session: root mean squares over points and pixels."""
    where = working_range(settings.rig)
    rig, noise = laid_out(settings.rig, settings.layout), settings.noise.at(where)
    found = drawn_session.draw(rig, settings.conditions, noise, settings.ultrasound, settings.poses, seed, where)
    points, sigmas = surface_errors(found, noise, seed)
    width, height = rig.probe.image_size
    pixels = np.stack(np.meshgrid(np.linspace(0, width - 1, GRID[0]), np.linspace(0, height - 1, GRID[1])), axis=-1).reshape(
        -1, 2
    )
    places = np.stack([place_errors(found, k, pixels) for k in range(len(found.true_poses))])
    predicted = predicted_places(found, noise.latency_s, settings.conditions.sound.tissue, pixels)
    return {
        "surface_rms_mm": rms(points),
        "pixel_rms_mm": rms(np.linalg.norm(places, axis=-1)),
        "mass_error_mm": float(np.linalg.norm(mass_error(found))),
        "mass_to_skin_mm": float(np.linalg.norm(mass_error(found) - skin_error(found))),
        "surface_predicted_mm": rms(sigmas),
        "pixel_predicted_mm": float(np.sqrt(sum(sigma**2 for sigma in predicted.values()))),
        **{f"pixel_predicted_by_{name}_mm": sigma for name, sigma in predicted.items()},
    }


def surface_errors(found: Session, level: Noise, seed: int) -> tuple[Array, Array]:
    """Errors along z : (m,) mm of points that camera 1 and projector measure by columns alone, and their predicted sigmas.

    The devices that are used see the points, and the calibration places them.
    """
    points = uncertainty.working_volume(found.used, [found.where.depth(z) for z in DEPTHS_MM])
    noise = level.drawn.column * level.column_px * np.random.default_rng([seed, 26]).standard_normal(len(points))
    by_noise, by_optics = predicted_points(found, points, level.column_px)
    return (measured(found, points, noise) - points)[:, 2], np.sqrt(by_noise + by_optics)


def measured(found: Session, points: Array, noise_px: Array | float = 0.0) -> Array:
    """Points : (m, 3) mm as camera 1 and projector measure them, with errors of their columns."""
    (camera, projector), known = ([of.cameras[name] for name in MEASURING] for of in (found.used, found.optics))
    return on_rays(known, known[0].rays(camera.project(points)), projector.project(points)[:, 0] + noise_px, points)


def skin_error(found: Session) -> Array:
    """Error : (3,) mm of the skin under the array's face, by light."""
    face = np.array([found.face_mm])
    return (measured(found, face) - face)[0]


def predicted_points(found: Session, points: Array, column_px: float) -> tuple[Array, Array]:
    """Predicted variances along z : (m,) mm^2 of points by the noise of columns, and by the optics with scale and drift.

    A point is where camera 1 sees it, u and v, and where the projector's column is: `d(point) = -A^-1 B d(parameters)`.
    """
    cameras = found.optics.cameras
    known = in_use(found.optics.uncertainty, cameras, PRINT_SCALE, DRIFT_PX)
    assert known is not None
    by_point, by_parameter = np.zeros((len(points), 3, 3)), np.zeros((len(points), 3, len(known.names)))
    for device, rows, axes in ((MEASURING[0], slice(0, 2), slice(0, 2)), (MEASURING[1], slice(2, 3), slice(0, 1))):
        seen = calibration.linearise(cameras, device, points, known.names)
        by_point[:, rows], by_parameter[:, rows] = seen.by_point[:, axes], seen.by_parameter[:, axes]
    to_z = np.linalg.inv(by_point)[:, 2]
    by_optics = np.einsum("mr,mrg->mg", to_z, by_parameter)
    return (to_z[:, 2] * column_px) ** 2, np.einsum("mg,gh,mh->m", by_optics, known.covariance, by_optics)


def on_rays(devices: list[Camera], rays: Array, columns: Array, start: Array) -> Array:
    """Points : (m, 3) mm on rays : (m, 3) of a camera where a projector's columns : (m,) px are, by Newton from points nearby."""
    camera, projector = devices
    distance = np.einsum("mi,mi->m", start - camera.centre, rays)
    for _ in range(NEWTON_STEPS):
        seen = linearise(projector, camera.centre + distance[:, None] * rays, ())
        distance = distance + (columns - seen.pixels[:, 0]) / np.einsum("mi,mi->m", seen.by_point[:, 0], rays)
    return camera.centre + distance[:, None] * rays


def place_errors(found: Session, k: int, pixels: Array) -> Array:
    """Errors : (p, 3) mm of the places of pixels : (p, 2) in B-scan k."""
    placed = rigid.apply(found.tracked.poses[k], found.probe.to_target(pixels))
    in_image = np.column_stack([pixels * found.true_probe.scale, np.zeros(len(pixels))])
    return placed - rigid.apply(found.true_poses[k], in_image) + found.latency_s * found.velocity[k]


def mass_error(found: Session) -> Array:
    """Error : (3,) mm of the centre of a ball: the mean error of its pixels, of all B-scans that cut it."""
    offsets = np.stack(np.meshgrid(*2 * [np.arange(-MASS_MM, MASS_MM + 1.0)]), axis=-1).reshape(-1, 2)
    middle, errors = np.add(found.face_mm, (0.0, 0.0, DEEP_MM)), []
    for k, pose in enumerate(found.true_poses):
        x, y, beside = rigid.apply(rigid.invert(pose), middle)
        inside = (offsets**2).sum(axis=1) + beside**2 < MASS_MM**2
        errors.append(place_errors(found, k, ([x, y] + offsets[inside]) / found.true_probe.scale))
    together = np.concatenate(errors)
    if not len(together):
        raise InputError(f"noise.span_mm: expected a scan of which B-scans cut a mass of {MASS_MM:g} mm radius, found none")
    return together.mean(axis=0)


def predicted_places(found: Session, latency_s: float, tissue: float, pixels: Array) -> dict[str, float]:
    """Predicted sigma, mm, of the places of pixels : (p, 2), root mean square over all B-scans, by what it comes from."""
    poses, own, shared = found.tracked
    placed, count = poses @ sequences.target_from_pixel(found.probe), len(poses)
    rates = np.zeros((count, 4, 4))
    rates[:, :3, 3] = found.velocity
    none = PlaceErrors(np.zeros_like(own), np.eye(count), np.zeros_like(shared), rates)
    parts = {
        "probe": none,
        "poses": replace(none, poses=own),
        "tolerances": replace(none, shared=shared),
        "latency": replace(none, lag_s=latency_s),
        "sound": replace(none, depth=tissue),
    }
    forms = {name: place_uncertainty.forms(placed, found.probe, errors) for name, errors in parts.items()}
    by_probe = forms["probe"]  # in all of them
    return {
        name: rms(place_uncertainty.sigmas(form if name == "probe" else form - by_probe, pixels)) for name, form in forms.items()
    }


EXPERIMENT = Experiment(
    ("rig", "layout", *CONDITIONS, "noise", "poses", "ultrasound"),
    measure,
    {"surface_rms_mm": "surface_predicted_mm", "pixel_rms_mm": "pixel_predicted_mm", "mass_error_mm": "", "mass_to_skin_mm": ""},
    "predicted by the software's covariances",
)
