"""Errors of a sweep's results against the rendered truth: the probe's calibration, the lag, the places of pixels, the tumours."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray
from pydantic import ValidationError
from scipy.optimize import linear_sum_assignment

from recon.capture.images import read_grey
from recon.capture.manifest import image_name, sweep_part
from recon.errors import InputError, one_line
from recon.files import npz
from recon.files.metrics import Metrics
from recon.geometry import rigid
from recon.geometry.surface_tree import signed_distances
from recon.model.probe import ProbeCalibration
from recon.model.rig import Rig
from recon.probe_calibration import point_calibration
from recon.probe_calibration.repeatability import five_points
from recon.segmentation import containment
from recon.segmentation.scan_masks import within_lines
from scenes.catalogue import build_scene
from scenes.scene_types import Thing
from scenes.tumour import caliper
from twin.conditions import Sound
from twin.session import SETTINGS, TruthFolder
from twin.ultrasound import sweep_session
from twin.ultrasound.echo_solids import Body, at_speeds, body
from twin.ultrasound.timed_sweep import Clocks
from twin.ultrasound.transducer import Transducer

Array = NDArray[np.float64]

SIGMAS = ("centre_sigma_mm", "volume_sigma_mm3", "depth_sigma_mm")  # of `sonotwin segment`, a mass each
DICE_STEP_MM = 0.5  # of the grid on which volumes are laid over each other


@dataclass(frozen=True, eq=False)
class SweepTruth:
    """Ground truth of a sweep of n B-scans. Meshes are in the world, mm."""

    body: Body
    hidden: tuple[Thing, ...]  # what only ultrasound sees, in the scene's order
    skin: trimesh.Trimesh  # the side that faces the cameras of what they lie in; open
    transducer: Transducer
    probe: ProbeCalibration
    lag_s: float
    world_from_image: Array  # (n, 4, 4), mm
    labels: tuple[Path, ...]  # (n,) images

    def shown(self, frame: int) -> NDArray[np.uint8]:
        """Label of each pixel of a B-scan : (h, w), as of `twin.ultrasound.bscan_truth.labels`; InputError if it is missing."""
        return read_grey(self.labels[frame])


@dataclass(frozen=True, eq=False)
class Finding:
    """A hidden thing, and its match among the masses found."""

    name: str
    true: trimesh.Trimesh
    found: trimesh.Trimesh | None
    number: int = -1  # of what was found

    @property
    def centre_error_mm(self) -> float:
        """Distance of the centres of volume; NaN of what wasn't found."""
        return np.nan if self.found is None else float(np.linalg.norm(self.found.center_mass - self.true.center_mass))


def read_truth(folder: Path, name: str = "") -> SweepTruth:
    """Read the ground truth of a sweep from the `truth/` folder that it was rendered to, and build its scene again.

    Parameters
    ----------
    name : of one of several sweeps.

    Raises
    ------
    InputError
        If a file is missing or damaged, or the scene hides nothing.
    """
    kept = TruthFolder(Path(folder), sweep_part(name))
    path, settings = kept.described / SETTINGS, kept.settings()
    try:
        rig, clocks = Rig.model_validate(settings["rig"]), Clocks.model_validate(settings["clocks"])
        transducer, wanted = Transducer.model_validate(settings["ultrasound"]), dict(settings["scene"])
        sound, seed = Sound.model_validate(settings.get("conditions", {}).get("sound", {})), int(settings["seed"])
    except ValidationError as error:
        raise InputError(f"{path}: {one_line(error)}") from None
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise InputError(f"{path}: expected the settings of a rendered sweep, found them damaged at {error}") from None
    forms = {"world_from_image": npz.Form("f", (None, 4, 4))}
    poses = kept.arrays(f"{kept.part}/{sweep_session.POSES}", forms)["world_from_image"]
    labels = tuple(kept.own / sweep_session.LABELS / image_name(number) for number in range(len(poses)))
    if missing := [path for path in labels if not path.is_file()]:
        raise InputError(f"{missing[0]}: expected an image of labels, found none")
    scene = build_scene(wanted)
    hidden = tuple(thing for thing in scene.things if thing.inside)
    if not hidden:
        raise InputError(f"{path}: expected a scene with something inside, found {scene.name}")
    scanned = at_speeds(body(scene), sound, seed)
    return SweepTruth(
        scanned,
        hidden,
        facing(sweep_session.surface_of("", scanned).mesh),
        transducer,
        sweep_session.calibration_of(rig, transducer),
        clocks.lag_s,
        poses,
        labels,
    )


def facing(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """The part of a closed mesh that faces the cameras, against the world's z."""
    chosen = mesh.faces[mesh.face_normals[:, 2] < 0]
    used, faces = np.unique(chosen, return_inverse=True)
    return trimesh.Trimesh(mesh.vertices[used], faces.reshape(-1, 3), process=False)


def probe_errors(found: ProbeCalibration, truth: SweepTruth, pixels: Array) -> tuple[Array, Array]:
    """Errors : (n,) mm of where a calibration puts pixels : (n, 2) in the target's frame, and their predicted standard deviation.

    Both of the place in space: the distance, and the root of the sum of three variances; NaN where nothing was predicted.
    """
    error = np.linalg.norm(found.to_target(pixels) - truth.probe.to_target(pixels), axis=1)
    if found.uncertainty is None:
        return error, np.full(len(pixels), np.nan)
    covariance = point_calibration.point_covariance(found, pixels)
    return error, np.sqrt(np.trace(covariance, axis1=1, axis2=2))


def placement(world_from_pixel: Array, truth: SweepTruth) -> Array:
    """Distances : (n, 5) mm of where centre and corners of B-scans are put from where they were; NaN without a pose.

    Parameters
    ----------
    world_from_pixel : (n, 4, 4)
        From px to mm, by the tracked poses, the lag and the calibration together, for the speed of sound that the scanner
        assumes: what the medium's own does to depths is no error of theirs.
    """
    pixels = five_points(truth.transducer.image_size)
    flat = np.column_stack([pixels, np.zeros(len(pixels))])
    true = truth.world_from_image @ np.diag([*truth.transducer.scale_mm_per_px, 1.0, 1.0])
    return np.linalg.norm(_each(world_from_pixel, flat) - _each(true, flat), axis=-1)


def compare(found: Sequence[trimesh.Trimesh], hidden: Sequence[Thing]) -> list[Finding]:
    """Pair found with true masses, each with one at most, so that the sum of the centres' distances is least.

    A pair whose centres are farther apart than half the true one's greatest extent is none.

    Parameters
    ----------
    found : meshes in the world, mm; closed.
    hidden : true things, as of `SweepTruth`.
    """
    true = [thing.mesh for thing in hidden]
    pairs: dict[int, int] = {}
    if found:
        apart = np.linalg.norm(np.array([t.center_mass for t in true])[:, None] - [f.center_mass for f in found], axis=-1)
        reach = np.array([caliper(t.vertices) / 2 for t in true])
        cost = np.where(apart < reach[:, None], apart, 1e6)
        pairs = {t: f for t, f in zip(*linear_sum_assignment(cost), strict=True) if apart[t, f] < reach[t]}
    return [
        Finding(thing.name, thing.mesh, found[pairs[k]], pairs[k]) if k in pairs else Finding(thing.name, thing.mesh, None)
        for k, thing in enumerate(hidden)
    ]


def measure(findings: Sequence[Finding], truth: SweepTruth, segmented: Metrics) -> Metrics:
    """Put findings into numbers, with their units in their names; NaN is a figure of what wasn't found.

    The outline's error is of the found surface's vertices to the true one, positive outside; `bias` its mean. Dice is twice the
    shared volume over the sum of both. `under_skin` is the least tissue between a thing and the skin over it, and `inside` is 1
    where the found thing lies under the measured surface, NaN where that isn't known. `tumours_false` is what was found where
    nothing is.

    Parameters
    ----------
    segmented : figures of `sonotwin segment`, which says how masses lie under the measured surface
    """
    here = [finding for finding in findings if finding.found is not None]
    false = int(segmented["masses"]) - len(here)
    metrics: Metrics = {"tumours_true": len(findings), "tumours_found": len(here), "tumours_false": false}
    containments = containment.contain([finding.true for finding in findings], truth.skin)
    for finding, under in zip(findings, containments, strict=True):
        figures = {
            "true_extent_mm": caliper(finding.true.vertices),
            "true_volume_mm3": float(finding.true.volume),
            "true_under_skin_mm": under.least_mm,
            **_figures_of(finding),
            "under_skin_mm": segmented.get(f"mass{finding.number}_depth_mm", np.nan),
            "inside": segmented.get(f"mass{finding.number}_inside", np.nan),
            **{name: segmented.get(f"mass{finding.number}_{name}", np.nan) for name in SIGMAS},
        }
        metrics |= {f"{finding.name}_{name}": value for name, value in figures.items()}
    return metrics


def of_each(metrics: Metrics, figure: str) -> list[float]:
    """A figure of `measure`, such as `centre_error_mm`, of all things that were found."""
    mark = "_true_extent_mm"
    names = [key.removesuffix(mark) for key in metrics if key.endswith(mark)]
    values = [metrics[f"{name}_{figure}"] for name in names]
    return [value for value in values if np.isfinite(value)]


def dice(first: trimesh.Trimesh, second: trimesh.Trimesh) -> float:
    """Dice coefficient of two closed meshes' volumes, on a grid."""
    low, high = (edge([first.bounds, second.bounds], axis=0) for edge in (np.min, np.max))
    axes = [np.arange(low[0, k], high[1, k] + DICE_STEP_MM, DICE_STEP_MM) for k in range(3)]
    a, b = filled(first, axes), filled(second, axes)
    return float(2 * np.count_nonzero(a & b) / max(1, np.count_nonzero(a) + np.count_nonzero(b)))


def filled(mesh: trimesh.Trimesh, axes: Sequence[Array]) -> NDArray[np.bool_]:
    """Which points of a grid a closed mesh holds : (nz, ny, nx), by how often a line from outside along x enters and leaves.

    Parameters
    ----------
    axes : coordinates (nx,), (ny,), (nz,) mm, evenly increasing
    """
    x, y, z = axes
    sections = (trimesh.intersections.mesh_plane(mesh, (0.0, 0.0, 1.0), (0.0, 0.0, height)) for height in z)
    return np.stack([within_lines(np.asarray(lines).reshape(-1, 2, 3)[..., :2], x, y) for lines in sections])


def _figures_of(finding: Finding) -> Metrics:
    """Figures of a found thing against the true one."""
    mesh = finding.found
    if mesh is None:
        names = ("extent_mm", "volume_mm3", "centre_error_mm", "outline_rms_mm", "outline_bias_mm", "dice")
        return dict.fromkeys(names, np.nan)
    outline = signed_distances(mesh.vertices, finding.true)
    return {
        "extent_mm": caliper(mesh.vertices),
        "volume_mm3": float(mesh.volume),
        "centre_error_mm": finding.centre_error_mm,
        "outline_rms_mm": float(np.sqrt(np.mean(outline**2))),
        "outline_bias_mm": float(outline.mean()),
        "dice": dice(mesh, finding.true),
    }


def nearest_frame(point: Array, world_from_pixel: Array, size: tuple[int, int]) -> int | None:
    """Number of the B-scan whose plane passes nearest to a point : (3,) mm that lies over its image; None if it is over none."""
    pixels = np.full((len(world_from_pixel), 3), np.nan)
    placed = np.isfinite(world_from_pixel).all(axis=(1, 2))
    pixels[placed] = [rigid.apply(np.linalg.inv(matrix), point) for matrix in world_from_pixel[placed]]
    over = ((pixels[:, :2] >= 0) & (pixels[:, :2] <= np.array(size) - 1)).all(axis=1)
    return int(np.where(over, np.abs(pixels[:, 2]), np.inf).argmin()) if over.any() else None


def _each(matrices: Array, points: Array) -> Array:
    """Points : (k, 3) taken through matrices : (n, 4, 4), to (n, k, 3)."""
    return np.einsum("nij,kj->nki", matrices[:, :3, :3], points) + matrices[:, None, :3, 3]
