"""Errors of a whole session: what `sonotwin reconstruct` made of a rendered capture, against what it was rendered from."""

from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray

from recon.capture import calibration_files, lag_files, manifest, probe_files, sweep_part
from recon.capture.manifest import CAMERAS, OPTICS, SCANNER, PartName
from recon.capture.manifest import sweep_part as sweep_path
from recon.files import meshes, metrics
from recon.files.metrics import Metrics
from recon.files.npz import Form
from recon.freehand import place_uncertainty
from recon.freehand import scans as freehand_scans
from recon.freehand.scans import Scans, Unsure
from recon.geometry import rigid
from recon.geometry.primitives import Cylinder
from recon.geometry.surface_tree import signed_distances
from recon.model.calibration import Calibration
from recon.optical_calibration import figures_of_merit
from recon.probe_calibration.repeatability import five_points
from recon.segmentation import tube_cover
from scenes.catalogue import build_scene
from twin.evaluation import sweep_errors, track_errors
from twin.evaluation.sweep_errors import Finding, SweepTruth
from twin.session import TruthFolder

Array = NDArray[np.float64]

FACE_POINTS = 9  # along the array
# figures of centre and corners, in the target's frame
PROBE_ERRORS = [f"probe_error{point}_{axis}_mm" for point in range(5) for axis in "xyz"]


def measure(result: Path, capture: Path, truth: Path) -> Metrics:
    """Figures of each step that has a truth, each named with its unit and, of a sweep, beginning with its name.

    Parameters
    ----------
    result, capture, truth : folders, as of `sonotwin reconstruct` and of the twin

    Raises
    ------
    InputError
        If a file is missing or damaged.
    """
    figures: Metrics = {}
    for name, part in manifest.read_manifest(capture).sweeps.items():
        poses = result / "poses" / name
        if poses.is_dir() and set(CAMERAS) <= part.images.keys():
            expected = track_errors.read_truth(truth, name)
            if part.purpose in ("volume", None):
                expected = track_errors.beside_patient(expected, truth, name)
            errors = track_errors.compare(track_errors.read_track(poses / "poses.csv", expected), expected)
            figures |= {f"{name}_{key}": value for key, value in track_errors.measure(errors, expected).items()}
        if part.purpose == "volume" and SCANNER in part.images and (result / "masses" / name).is_dir():
            figures |= {f"{name}_{key}": value for key, value in inside(result, truth, name).items()}
    return figures


def inside(result: Path, truth: Path, name: str) -> Metrics:
    """Figures of a sweep: latency, probe, places of its pixels, masses, and where the array's face met the skin."""
    true = sweep_errors.read_truth(truth, name)
    lag = lag_files.read(result / "latency" / lag_files.FILE)
    probe = probe_files.read(result / "probe" / "probe.yaml")
    pixels = five_points(true.transducer.image_size)
    error, sigma = sweep_errors.probe_errors(probe, true, pixels)
    apart_by_probe = probe.to_target(pixels) - true.probe.to_target(pixels)
    sweep = sweep_part.read_sweep(result / "poses" / name, name)
    scans = freehand_scans.of_sweep(sweep, probe, lag.lag_s, true.transducer.assumed_speed, Unsure(lag.sigma_s))
    shown, apart = scans.world_from_pixel, sweep_errors.placement(scans.world_from_pixel, true)
    masses, sigmas = metrics.read(result / "masses" / name / metrics.FILE), place_sigmas(scans)
    figures: Metrics = {
        "lag_error_ms": 1e3 * (lag.lag_s - true.lag_s),
        "lag_covered": float(lag.interval_s[0] <= true.lag_s <= lag.interval_s[1]),
        "probe_worst_error_mm": float(error.max()),
        "probe_worst_sigma_mm": float(sigma[error.argmax()]),
        **dict(zip(PROBE_ERRORS, apart_by_probe.ravel().tolist(), strict=True)),
        "placement_rms_mm": float(np.sqrt(np.nanmean(apart**2))),
        "placement_sigma_mm": float(np.sqrt(np.nanmean(sigmas**2))),
        "placement_over_sigma": float(np.sqrt(np.nanmean((apart / sigmas) ** 2))),
        **sweep_errors.measure(findings(result, true, name), true, masses),
    }
    skin = result / "surface" / "surface.ply"
    return figures | ({"contact_bias_mm": contact_bias(shown, true, skin)} if skin.is_file() else {})


def findings(result: Path, true: SweepTruth, name: str) -> list[Finding]:
    """The true masses of a sweep, each with its match among those that were found in it; InputError if a file is missing."""
    folder = result / "masses" / name
    count = int(metrics.read(folder / metrics.FILE)["masses"])
    found = [meshes.read_ply(folder / f"mass{number}.ply", "a mass") for number in range(count)]
    return sweep_errors.compare(found, true.hidden)


def optics(found: Calibration, truth: Path) -> Metrics:
    """Errors of a calibration against the true one, over what all devices see at the board's depths.

    Raises
    ------
    InputError
        If the truth of a board is missing or damaged.
    """
    forms = {"world_from_board": Form("f", (None, 4, 4)), "points": Form("f", (None, 3))}
    board = TruthFolder(truth, "board").arrays("board.npz", forms)
    points = np.concatenate([rigid.apply(pose, board["points"]) for pose in board["world_from_board"]])
    true = calibration_files.read_for(truth / OPTICS, {name: camera.size for name, camera in found.cameras.items()})
    return figures_of_merit.errors(found, true, figures_of_merit.volume_about(found, points))


def cylinders(result: Path, truth: Path, name: str) -> Metrics:
    """Errors, mm, of both cylinders' diameters and of the wall between them.

    Parameters
    ----------
    result, truth : folders, as of `sonotwin reconstruct find=tube` and of the twin; the outer cylinder in the surface, the inner
        one in the sweep of that name.

    Raises
    ------
    InputError
        If a file is missing or damaged.
    """
    found = metrics.read(result / "tube" / name / metrics.FILE)
    outer, inner = _cylinder(truth, "surface", "outer"), _cylinder(truth, sweep_path(name), "inner")
    true = {
        "tube_diameter_mm": 2 * inner.radius,
        "cover_diameter_mm": 2 * outer.radius,
        "cover_wall_mm": tube_cover.wall_between(outer, inner),
    }
    errors: Metrics = {f"{figure[:-3]}_error_mm": found.get(figure, np.nan) - value for figure, value in true.items()}
    return errors | {name: found.get(name, np.nan) for name in ("tube_diameter_sigma_mm", "cover_wall_sigma_mm")}


def _cylinder(truth: Path, part: PartName, name: str) -> Cylinder:
    """A cylinder of a part's scene."""
    scene = build_scene(TruthFolder(truth, part).settings()["scene"])
    return next(shape for shape in scene.shapes if isinstance(shape, Cylinder) and shape.name == name)


def place_sigmas(scans: Scans) -> Array:
    """Predicted standard deviations : (n, 5) mm of the places of centre and corners of each B-scan."""
    assert scans.probe is not None and scans.errors is not None
    forms = place_uncertainty.forms(scans.world_from_pixel, scans.probe, scans.errors)
    return place_uncertainty.sigmas(forms, five_points(scans.shape[::-1]))


def contact_bias(world_from_pixel: Array, true: SweepTruth, surface: Path) -> float:
    """Median distance, mm, by which the array's face seems to stand off the measured skin, less that by which it did.

    The face is known by ultrasound and tracking, the skin by light: a bias says that both don't share a frame.

    Parameters
    ----------
    world_from_pixel : (n, 4, 4)
        By the estimated calibrations and tracked poses; NaN without a pose.
    """
    measured = meshes.read_ply(surface, "a surface")
    flat = np.zeros((FACE_POINTS, 4))
    flat[:, 0], flat[:, 3] = np.linspace(0, true.transducer.image_size[0] - 1, FACE_POINTS), 1
    placed = np.isfinite(world_from_pixel).all(axis=(1, 2))
    shown = (world_from_pixel[placed] @ flat.T)[:, :3].transpose(0, 2, 1)
    scale = np.diag([*true.transducer.scale_mm_per_px, 1.0, 1.0])
    stood = (true.world_from_image[placed] @ scale @ flat.T)[:, :3].transpose(0, 2, 1)
    return float(np.median(_standoff(shown, measured) - _standoff(stood, true.skin)))


def _standoff(faces: Array, skin: trimesh.Trimesh) -> Array:
    """Least signed distance : (n,) mm of faces : (n, m, 3) to a skin, positive outside."""
    return signed_distances(faces.reshape(-1, 3), skin).reshape(faces.shape[:2]).min(axis=1)
