"""A sweep over the drawn session's ball, by the geometry of spheres alone: a breast with two tumours, of which one is found."""

from pathlib import Path

import cv2
import numpy as np
import trimesh
import yaml

from recon.capture import sweep_part
from recon.capture.sweep_part import SweepCapture
from recon.files.volumes import Volume
from recon.geometry import rigid
from recon.model.calibration import Uncertainty
from recon.model.probe import ProbeCalibration
from recon.model.rig import Rig
from recon.model.tracks import Track
from recon.probe_calibration import latency
from recon.segmentation import containment
from scenes.scene_types import Material, Scene, Thing
from tests.recon import captures, sweep_sets
from tests.twin.conftest import CENTRE, RADIUS
from twin.evaluation import sweep_errors
from twin.evaluation.sweep_errors import SweepTruth
from twin.reports.sweep_report import Inside
from twin.ultrasound.echo_solids import body
from twin.ultrasound.transducer import Transducer

TUMOURS = ((np.array([-4.0, 0.0, -5.0]) + CENTRE, 6.0), (np.array([9.0, 0.0, -6.0]) + CENTRE, 4.0))  # mm: middle and radius
SHIFT = np.array([0.3, 0.0, 0.4])  # mm, by which the found one is off
LAG_S = 0.05
COUNT = 13  # B-scans, 1 mm apart
SIZE, SCALE = (80, 110), (0.49, 0.4)  # of a B-scan: px, mm/px
TISSUE_M_S = 1450.0  # of silicone
IN_TISSUE = (SCALE[0], SCALE[1] * TISSUE_M_S / 1540.0)  # mm/px
PROBE_MM = 0.2  # error of the probe's calibration, along the array


def ball(middle: np.ndarray, radius: float) -> trimesh.Trimesh:
    return trimesh.creation.icosphere(subdivisions=4, radius=radius).apply_translation(middle)


def poses() -> np.ndarray:
    """World_from_image : (n, 4, 4), looking along z from 3 mm before the ball, its middle in the image's middle."""
    upright = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    across = np.arange(COUNT) - COUNT // 2
    corner = CENTRE - [SIZE[0] * SCALE[0] / 2, 0, RADIUS + 3]
    return np.stack([rigid.transform(upright, corner + np.array([0, y, 0])) for y in across])


def true_sweep(folder: Path, rig: Rig) -> SweepTruth:
    """The truth, and its labels as files."""
    root = Path(__file__).resolve().parents[2]
    settings = yaml.safe_load((root / "conf/ultrasound/linear.yaml").read_text(encoding="utf-8"))
    transducer = Transducer.model_validate(settings | {"image_size": SIZE, "scale_mm_per_px": SCALE})
    skin = Thing("breast", ball(CENTRE, RADIUS), Material(0.5))
    hidden = tuple(Thing(f"tumour{k}", ball(*one), Material(0.5), inside=True) for k, one in enumerate(TUMOURS))
    u, v = np.meshgrid(*map(np.arange, SIZE))
    folder.mkdir(parents=True)
    paths = []
    for number, pose in enumerate(poses()):
        places = rigid.apply(pose, np.stack([u * IN_TISSUE[0], v * IN_TISSUE[1], 0 * u], axis=-1))
        labels = np.zeros(u.shape, np.uint8)
        for label, (middle, radius) in enumerate(((CENTRE, RADIUS), *TUMOURS), 1):
            labels[np.linalg.norm(places - middle, axis=-1) < radius] = label
        paths.append(folder / f"{number:04d}.png")
        cv2.imwrite(str(paths[-1]), labels)
    true_probe = ProbeCalibration(rig.probe.target_from_image.matrix(), np.array(SCALE))
    scanned = body(Scene("breast", (skin, *hidden)))
    return SweepTruth(scanned, hidden, sweep_errors.facing(skin.mesh), transducer, true_probe, LAG_S, poses(), tuple(paths))


def calibrated(truth: SweepTruth) -> ProbeCalibration:
    """The probe, off by `PROBE_MM`, and how sure it takes itself to be."""
    off = truth.probe.target_from_image @ rigid.transform(np.eye(3), [PROBE_MM, 0, 0])
    names = ("sx", "sy", "rx", "ry", "rz", "tx", "ty", "tz")
    known = Uncertainty(names, np.diag([1e-4, 1e-4, 1e-3, 1e-3, 1e-3, 0.1, 0.1, 0.1]) ** 2)
    return ProbeCalibration(off, truth.probe.scale, known)


def bottom(rng: np.random.Generator) -> tuple[SweepCapture, np.ndarray]:
    """Six seconds up and down over a flat bottom, and its depth : (n,) px in each image, late by the lag; no image is drawn."""
    shown, tracked = np.arange(0.3, 5.9, 1 / 15), np.arange(0, 6.3, 1 / 40)
    track = Track(
        sweep_sets.nanoseconds(tracked),
        np.array([rigid.transform(np.eye(3), [5, -3, 700 - h]) for h in sweep_sets.height(tracked)]),
    )
    depths = (32 + sweep_sets.height(shown)) / SCALE[1] + 0.5 * rng.standard_normal(len(shown))
    times = sweep_sets.nanoseconds(shown + LAG_S)
    return SweepCapture("bottom", SIZE, (), np.arange(len(shown)), times, track), depths


def inside(folder: Path, rig: Rig, rng: np.random.Generator) -> Inside:
    """All that the report is told of: the first tumour found, off by `SHIFT`, the second not."""
    truth = true_sweep(folder / "labels", rig)
    grey = np.array([0, 140, 50, 50], np.uint8)
    images = (grey[truth.shown(k)] + rng.integers(0, 40, SIZE[::-1], np.uint8) for k in range(COUNT))
    times = sweep_sets.nanoseconds(np.arange(COUNT) / 20)
    track = Track(times, poses() @ rigid.invert(truth.probe.target_from_image))
    captures.write_sweep(folder / "sweep", images, times, track, SIZE)
    bob, depths = bottom(rng)
    found_lag = latency.estimate(bob.times, depths, bob.track)
    low = CENTRE - 20
    volume = Volume(rng.integers(1, 200, (40, 40, 40)).astype(np.uint8), low, np.ones(3))
    return Inside(
        sweep_part.read_sweep(folder / "sweep"),
        poses() @ np.diag([*IN_TISSUE, 1, 1]),
        volume,
        sweep_errors.compare([ball(TUMOURS[0][0] + SHIFT, TUMOURS[0][1])], truth.hidden),
        truth,
        calibrated(truth),
        bob,
        np.column_stack([depths, found_lag.residuals]),
        found_lag.seconds,
        TISSUE_M_S,
    )


def segmented(found: list[trimesh.Trimesh], truth: SweepTruth) -> dict[str, float | int]:
    """What segmentation says of masses under a skin that was measured without errors."""
    containments = containment.contain(found, truth.skin)
    depths = {f"mass{k}_depth_mm": one.least_mm for k, one in enumerate(containments)}
    inside = {f"mass{k}_inside": np.nan if one.inside is None else int(one.inside) for k, one in enumerate(containments)}
    return {"masses": len(found), **depths, **inside}


def figures(story: Inside) -> dict[str, float | int]:
    """What the steps of a demonstration found out beside."""
    found = [finding.found for finding in story.findings if finding.found is not None]
    measured = sweep_errors.measure(story.findings, story.truth, segmented(found, story.truth))
    probe = {"frames_used": 25, "frames_rejected": 5, "rms_mm": 0.4, "sy_measured_mm_per_px": SCALE[1]}
    sound = {"implied_speed_m_per_s": 1490.0, "implied_speed_sigma_m_per_s": 2.0, "water_speed_m_per_s": 1488.4}
    lags = {"ms": 1e3 * story.lag_s, "low_ms": 1e3 * story.lag_s - 3, "high_ms": 1e3 * story.lag_s + 3}
    return {
        **measured,
        **{f"probe_{name}": value for name, value in (probe | sound).items()},
        **{f"lag_{name}": value for name, value in lags.items()},
        "placement_rms_mm": 0.3,
    }
