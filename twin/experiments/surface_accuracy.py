"""Accuracy of the surface: the paper's planes and sphere, the breast, unwrapping under stress, and a real relief."""

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from recon.capture import calibration_files
from recon.capture.images import read_images
from recon.capture.surface_part import SurfaceCapture
from recon.geometry.order_statistics import NORMAL_MAD
from recon.geometry.surface_tree import surface_tree
from recon.model.patterns import Fringes, GrayCode, Patterns
from recon.model.rig import Rig
from recon.session import skin_step
from recon.structured_light.decode import ProjectorMap, Status, decode
from recon.structured_light.surface_mesh import clean
from recon.structured_light.triangulate import PointMap, triangulate
from scenes.catalogue import build_scene
from scenes.kinds import plane
from scenes.scene_types import Scene
from twin.conditions import IDEAL, Conditions
from twin.evaluation import surface_errors
from twin.evaluation.local_residuals import smooth_noise_ratio
from twin.evaluation.surface_errors import Comparison, Metrics, Truth
from twin.experiments.experiment_setup import Figures, Setup
from twin.optics.light_transport import Tracing
from twin.optics.ray_world import visible
from twin.optics.surface_session import CameraName, Shooting, View, calibration_of, shoot

TRACING, SHOOTING = Tracing(samples=16, room_lux=20), Shooting()
REAL_DEPTH_MM = (690.0, 780.0)
CAMERAS: tuple[CameraName, ...] = ("cam1", "cam2")
EVERY, NEAR_MM = 7, 0.5  # of the true points one is looked at; from the surface, within which it has that point


@dataclass(frozen=True)
class Experiment:
    """One rendered capture, reconstructed, and compared with its truth."""

    view: View
    truth: Truth
    found: ProjectorMap
    points: PointMap
    comparison: Comparison
    metrics: Metrics


def experiment(
    rig: Rig,
    scene: Scene,
    patterns: Patterns,
    seed: int = 1,
    tracing: Tracing = TRACING,
    shooting: Shooting = SHOOTING,
    conditions: Conditions = IDEAL,
    calibrated: Rig | None = None,
) -> Experiment:
    """Render, decode, triangulate, clean and compare, as the commands do, without the files between.

    calibrated : the rig as it is known where surfaces are reconstructed, if that isn't the true one
    """
    view = shoot(rig, scene, patterns, "cam1", tracing, shooting, seed, conditions)
    cameras, known = (calibration_of(one).cameras for one in (rig, calibrated or rig))
    found = decode(view.images, patterns, name=scene.name)
    points = clean(triangulate(found, known["cam1"], known["projector"]), known["cam1"], found.modulation)
    truth = Truth(
        **{field.name: getattr(view.truth, field.name) for field in fields(view.truth) if field.name != "projector"},
        limit_px=view.limit_px,
        camera=cameras["cam1"],
        projector=cameras["projector"],
        scene=scene.name,
        things=tuple(thing.name for thing in visible(scene)),
        shapes=scene.shapes,
    )
    comparison = surface_errors.compare(points.points, points.sigma, truth)
    return Experiment(view, truth, found, points, comparison, surface_errors.measure(points.points, comparison, truth))


def planes(setup: Setup, number: int) -> Figures:
    """One plane of the paper's protocol, from 1: RMS about the fitted plane, and residuals over predicted sigma."""
    pose = number - 1
    metrics = experiment(setup.rig, plane.build(plane.PAPER_POSES[pose]), setup.sequences["paper_surface"], seed=pose).metrics
    return {
        "rms_mm": metrics["plane_plate_rms_mm"],
        "limit_mm": metrics["limit_rms_mm"],
        "z_spread_off": abs(metrics["z_std"] - 1),
    }


def sphere(setup: Setup) -> Figures:
    """The paper's sphere."""
    found = experiment(setup.rig, build_scene({"kind": "sphere"}), setup.sequences["paper_surface"], seed=10).metrics
    names = {"rms_mm": "rms_mm", "limit_mm": "limit_rms_mm", "radius_error_mm": "radius_error_mm"}
    return {name: abs(found[f"sphere_sphere_{figure}"]) for name, figure in names.items()}


def breast(setup: Setup) -> Figures:
    """The breast phantom on its table."""
    return experiment(setup.rig, build_scene({"kind": "breast"}), setup.sequences["paper_surface"], seed=20).metrics


def breast_by_both(setup: Setup) -> Figures:
    """The breast phantom, by both cameras beside one: noise, its prediction, and what of all that either sees became surface."""
    scene, patterns, calibration = build_scene({"kind": "breast"}), setup.sequences["paper_surface"], calibration_of(setup.rig)
    views = {name: shoot(setup.rig, scene, patterns, name, TRACING, SHOOTING, 20) for name in CAMERAS}
    shots = {name: SurfaceCapture(view.images, patterns, 8, calibration, scene.name) for name, view in views.items()}
    one = skin_step.reconstruct(shots["cam1"])
    both = skin_step.reconstruct(shots["cam1"], others={"cam2": lambda: shots["cam2"]})
    truth = views["cam1"].truth
    errors = [np.sum((skin.points.points - truth.points) * truth.normals, axis=-1) for skin in (one, both)]
    normal = errors[1] / (both.points.sigma * np.abs(np.sum(calibration.cameras["cam1"].pixel_rays() * truth.normals, axis=-1)))
    inner = np.isfinite(errors).all(axis=0) & (np.abs(errors) < surface_errors.GROSS_MM).all(axis=0)
    seen = np.concatenate([view.truth.points[view.truth.lit][::EVERY] for view in views.values()]).astype(float)
    away = surface_tree(both.mesh.vertices).query(seen)[0]
    return {
        "noise_ratio": _spread(errors[1][inner]) / _spread(errors[0][inner]),
        "z_spread_off": abs(_spread(normal[inner]) - 1),
        "coverage": float(np.mean(away < NEAR_MM)),
    }


def _spread(values: NDArray[np.floating]) -> float:
    """Standard deviation, by the median distance from the median: edges have errors of other kinds."""
    return float(NORMAL_MAD * np.median(np.abs(values - np.median(values))))


def orders_under_stress(setup: Setup, sequence: str) -> Figures:
    """Two separated objects with deep steps and shadows, unwrapped by a sequence."""
    result = experiment(setup.rig, build_scene({"kind": "two_objects"}), setup.sequences[sequence], seed=30)
    return {
        "wrong_orders": wrong_orders(result, 12),
        "unreachable": np.count_nonzero(result.found.status == Status.UNREACHABLE),
        "coverage": result.metrics["coverage"],
    }


def bent_light(setup: Setup, gamma: float) -> Figures:
    """A plane by three steps under a gamma that the pipeline isn't given, against the same under linear light."""
    fringes = Fringes(pitch=18, steps=3)
    code = GrayCode(pitch=18, bits=7, complementary=True)
    patterns = Patterns(projector_size=setup.rig.projector.optics.size, unwrap="gray", parts=(fringes, code))

    def shot(gamma: float) -> Metrics:
        rig = setup.rig.model_copy(update={"projector": setup.rig.projector.model_copy(update={"gamma": gamma})})
        return experiment(rig, plane.build(plane.PAPER_POSES[2]), patterns, seed=40).metrics

    linear, bent = shot(1.0), shot(gamma)
    return {"rms_ratio": bent["surface_rms_mm"] / linear["surface_rms_mm"], "z_spread_off": abs(bent["z_std"] - 1)}


def wrong_orders(result: Experiment, pitch: float) -> int:
    """Points whose decoded projector column is half a period or more off from all that the pixel can see.

    A pixel at an edge sees more than its centre does: the truth of the eight pixels around it counts too.
    """
    found = result.found.columns
    assert found is not None
    true = np.pad(result.view.truth.projector[..., 0], 1, constant_values=np.nan)
    height, width = found.shape
    around = [true[i : i + height, j : j + width] for i in range(3) for j in range(3)]
    nearest = np.fmin.reduce([np.abs(found - column) for column in around])
    return int(np.count_nonzero(np.isfinite(result.points.points[..., 0]) & ~(nearest < pitch / 2)))


def real_capture(setup: Setup) -> Figures:
    """A plaster relief recorded by others (12 steps of 60 px, Gray code)."""
    points, centre = relief(setup)
    depth = points.points[..., 2]
    known = depth[np.isfinite(depth)]
    inside = np.mean((known > REAL_DEPTH_MM[0]) & (known < REAL_DEPTH_MM[1]))
    ratio = smooth_noise_ratio(np.linalg.norm(points.points - centre, axis=-1), points.sigma)
    return {"points": known.size, "inside": inside, "noise_ratio": max(ratio, 1 / ratio)}


def relief(setup: Setup) -> tuple[PointMap, NDArray[np.float64]]:
    """The real relief's points, and the centre of its camera : (3,) mm."""
    assert setup.real is not None
    folder, patterns = setup.real / "fringe_capture", setup.sequences["twelve_step_gray"]
    paths = sorted(folder.glob("*.png"))
    optics = calibration_files.read(folder / "calibration.yml", {"projector": patterns.projector_size}).cameras
    camera, projector = optics["cam1"], optics["projector"]
    found = decode(read_images(paths, camera.size, 8), patterns, name=folder.name)
    return clean(triangulate(found, camera, projector), camera, found.modulation), camera.centre
