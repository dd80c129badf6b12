"""The paper's breast in one laboratory: its skin by light and its tumours by ultrasound, by our method and by the paper's.

The paper's masks are drawn by a steady hand: along the tumours as each B-scan shows them.
"""

from dataclasses import replace

import cv2
import numpy as np
import trimesh
from numpy.typing import NDArray

from recon.files.metrics import Metrics
from recon.freehand import scans as freehand_scans
from recon.freehand.scans import Unsure
from recon.geometry import rigid
from recon.model.probe import ProbeCalibration
from recon.segmentation.containment import contain
from recon.session import masses_step
from recon.session.masses_step import Method
from scenes.acoustics import TISSUES
from scenes.catalogue import build_scene
from scenes.scene_types import Thing
from twin.evaluation import sweep_errors
from twin.experiments import filmed_laboratory, mass_accuracy
from twin.experiments.experiment_runs import Experiment, Settings
from twin.experiments.filmed_laboratory import FilmedLaboratory
from twin.experiments.plane_and_sphere import as_published
from twin.experiments.tracked_sweep import TrackedSweep
from twin.ultrasound.timed_sweep import Clocks
from twin.ultrasound.transducer import Transducer

Array = NDArray[np.float64]

BREAST = {"kind": "breast"}
LEAST_POINTS = 100  # of a mask's contours in all B-scans, for a body


def measure(settings: Settings, seed: int) -> Metrics:
    """Figures of one laboratory, by both methods."""
    hidden = [thing for thing in build_scene(BREAST).things if thing.inside]
    with filmed_laboratory.opened(settings, seed) as lab:
        wires = filmed_laboratory.wires(lab, 0)
        found = filmed_laboratory.crossings(lab, wires)
        ours = filmed_laboratory.calibrated(lab, found).calibration
        paper = filmed_laboratory.published(lab, found, wires, np.random.default_rng([seed, 32])).calibration
        sweep = filmed_laboratory.swept(lab, "scan", BREAST, mass_accuracy.PATH, Clocks(), Transducer())
        shot = filmed_laboratory.by_light(lab, BREAST)
        skin = filmed_laboratory.meshed(shot, lab.optics.ours)
        plain = filmed_laboratory.meshed(as_published(shot, settings.patterns), lab.optics.light)
        return {
            **figures("ours", segmented(lab, sweep, ours), skin, hidden),
            **figures("paper", from_masks(lab, sweep, paper), plain, [convex(thing) for thing in hidden]),
        }


def segmented(lab: FilmedLaboratory, sweep: TrackedSweep, probe: ProbeCalibration) -> list[trimesh.Trimesh]:
    """Masses that our software finds, told the usual speed of sound in silicone."""
    speed = TISSUES["silicone"].speed
    scans = freehand_scans.in_memory(
        freehand_scans.of_sweep(sweep.ours, probe, lab.latency_s, speed, Unsure(lab.settings.noise.latency_s))
    )
    return list(masses_step.find(scans, Method(overlays=0)).meshes.values())


def from_masks(lab: FilmedLaboratory, sweep: TrackedSweep, probe: ProbeCalibration) -> list[trimesh.Trimesh]:
    """Convex hull of each tumour's masks' contours, by the published poses and calibration."""
    outlined: dict[str, list[Array]] = {name: [] for name in sweep.solids if name.startswith("tumour")}
    for labels, matrix in zip(sweep.labels, sweep.published_at(lab.latency_s), strict=True):
        for name, points in outlined.items() if np.isfinite(matrix).all() else ():
            mask = np.uint8(labels == 1 + sweep.solids.index(name))
            contours, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
            points += [rigid.apply(matrix, probe.to_target(contour[:, 0].astype(float))) for contour in contours]
    together = [np.concatenate(points) for points in outlined.values() if sum(map(len, points)) > LEAST_POINTS]
    return [trimesh.PointCloud(points).convex_hull for points in together]


def convex(thing: Thing) -> Thing:
    """A thing's convex hull, which hulls of its masks are compared with."""
    return replace(thing, mesh=thing.mesh.convex_hull)


def figures(name: str, found: list[trimesh.Trimesh], skin: trimesh.Trimesh, hidden: list[Thing]) -> Metrics:
    """Tumours found and inside the skin, and the largest errors of their centres and volumes; NaN if one is missing."""
    pairs = sweep_errors.compare(found, hidden)
    inside = sum(one.inside is True for one in contain([pair.found for pair in pairs if pair.found is not None], skin))
    volumes = [np.nan if pair.found is None else 100 * abs(pair.found.volume / pair.true.volume - 1) for pair in pairs]
    return {
        f"tumours_inside_{name}": inside,
        f"tumours_false_{name}": len(found) - sum(pair.found is not None for pair in pairs),
        f"tumour_centre_error_{name}_mm": float(np.max([pair.centre_error_mm for pair in pairs])),
        f"tumour_volume_error_{name}_percent": float(np.max(volumes)),
    }


EXPERIMENT = Experiment(
    filmed_laboratory.READS,
    measure,
    {"tumour_centre_error_ours_mm": "", "tumour_centre_error_paper_mm": "", "tumour_volume_error_ours_percent": ""},
)
