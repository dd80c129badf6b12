"""A session's errors from board to mass, by drawn measurements: points of the surface, pixels of B-scans, a mass's centre.

Beside them stand the errors that the software predicts, by their parts.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from recon.files.metrics import Metrics
from recon.freehand import place_uncertainty, sequences
from recon.freehand.place_uncertainty import PlaceErrors
from recon.geometry import rigid
from recon.geometry.camera import Camera
from recon.geometry.camera_jacobian import linearise
from recon.optical_calibration import uncertainty
from twin.studies import drawn_session
from twin.studies.drawn_session import Noise, Session
from twin.studies.experiments import Experiment, Settings
from twin.studies.layout import laid_out

Array = NDArray[np.float64]

MEASURING = ("cam1", "projector")
NEWTON_STEPS = 5
DEPTHS_MM = (620.0, 660.0, 700.0)  # z of the surface's points
GRID = (7, 7)  # pixels of a B-scan, across and down
MASS_MM, DEEP_MM = 7.0, 25.0  # radius of the mass, depth of its middle in the image


def measure(settings: Settings, seed: int) -> Metrics:
    """Figures of one session: root mean squares over points and pixels."""
    rig, noise = laid_out(settings.rig, settings.layout), settings.noise
    found = drawn_session.draw(rig, settings.conditions, noise, settings.ultrasound, settings.poses, seed)
    points, sigmas = surface_errors(found, noise, seed)
    width, height = rig.probe.image_size
    pixels = np.stack(np.meshgrid(np.linspace(0, width - 1, GRID[0]), np.linspace(0, height - 1, GRID[1])), axis=-1).reshape(
        -1, 2
    )
    places = np.stack([place_errors(found, k, pixels) for k in range(len(found.true_poses))])
    predicted = predicted_places(found, noise.latency_s, settings.conditions.sound.tissue, pixels)
    return {
        "surface_rms_mm": _rms(points),
        "pixel_rms_mm": _rms(np.linalg.norm(places, axis=-1)),
        "mass_error_mm": float(np.linalg.norm(mass_error(found))),
        "surface_predicted_mm": _rms(sigmas),
        "pixel_predicted_mm": float(np.sqrt(sum(sigma**2 for sigma in predicted.values()))),
        **{f"pixel_predicted_by_{name}_mm": sigma for name, sigma in predicted.items()},
    }


def surface_errors(found: Session, level: Noise, seed: int) -> tuple[Array, Array]:
    """Errors along z : (m,) mm of points that camera 1 and projector measure by columns alone, and their predicted sigmas.

    The devices that are used see the points, and the calibration places them.
    """
    (camera, projector), known = ([of.cameras[name] for name in MEASURING] for of in (found.used, found.optics))
    points = uncertainty.working_volume(found.used, DEPTHS_MM)
    noise = level.drawn.column * level.column_px * np.random.default_rng([seed, 26]).standard_normal(len(points))
    rays = known[0].rays(camera.project(points))
    placed = on_rays(known, rays, projector.project(points)[:, 0] + noise, points)
    slope = np.einsum("mi,mi->m", linearise(known[1], points, ()).by_point[:, 0], rays)
    by_optics = uncertainty.triangulation(found.optics, *MEASURING, points)[:, 2, 2]
    return (placed - points)[:, 2], np.sqrt((level.column_px * rays[:, 2] / slope) ** 2 + by_optics)


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
    middle, errors = np.add(drawn_session.MIDDLE_MM, (0.0, 0.0, DEEP_MM)), []
    for k, pose in enumerate(found.true_poses):
        x, y, beside = rigid.apply(rigid.invert(pose), middle)
        inside = (offsets**2).sum(axis=1) + beside**2 < MASS_MM**2
        errors.append(place_errors(found, k, ([x, y] + offsets[inside]) / found.true_probe.scale))
    return np.concatenate(errors).mean(axis=0)


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
        name: _rms(place_uncertainty.sigmas(form if name == "probe" else form - by_probe, pixels)) for name, form in forms.items()
    }


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


EXPERIMENT = Experiment(
    ("rig", "layout", "conditions", "noise", "poses", "ultrasound"),
    measure,
    {"surface_rms_mm": "surface_predicted_mm", "pixel_rms_mm": "pixel_predicted_mm", "mass_error_mm": ""},
)
