"""Accuracy with frames and targets of life: flicker, stray light, shifts that are off, imprecise prints, covered circles."""

from itertools import chain

import numpy as np

from recon.errors import InputError
from recon.tracking import networks as nets
from scenes.catalogue import build_scene
from scenes.kinds import plane
from twin.conditions import Conditions, Frames, Skin
from twin.evaluation.surface_errors import rms
from twin.experiments import detection_rates, tracking_frames
from twin.experiments.experiment_setup import Figures, Setup
from twin.experiments.surface_accuracy import experiment
from twin.optics.surface_session import Shooting

SEEDS = range(100, 110)  # unseen seeds of conditions
EXPOSURES_S = (2e-4, 5e-4, 1e-3, 1.4e-3, 2e-3, 4e-3, 8e-3, 1.6e-2)
FEWEST = 2000  # points whose spread is known to 5 %, though neighbours share theirs
COVERED, SAMPLES = range(1083, 1093), 100  # seeds of frames as in a data set, each of its own bodies, and pairs of each
DISTURBED = Conditions(frames=Frames(flicker=0.03, stray_dn=1.0, shift=0.01))


def compared(setup: Setup, scene: str) -> Figures:
    """Planes in turn, or the breast, under a steady lamp and a disturbed one, as long exposed."""
    scenes = [plane.build(pose) for pose in plane.PAPER_POSES] if scene == "planes" else [build_scene({"kind": "breast"})]
    figure, patterns = "plane_plate_rms_mm" if scene == "planes" else "surface_rms_mm", setup.sequences["paper_surface"]
    ratios, spreads, means = [], [], []
    for seed in SEEDS:
        steady = experiment(setup.rig, scenes[seed % len(scenes)], patterns, seed)
        shooting = Shooting(exposure_s=steady.view.exposure.time_s)
        disturbed = experiment(setup.rig, scenes[seed % len(scenes)], patterns, seed, shooting=shooting, conditions=DISTURBED)
        ratios.append(disturbed.metrics[figure] / steady.metrics[figure])
        spreads.append(disturbed.metrics["z_std"])
        means.append(float(np.nanmean(disturbed.comparison.error)))
    ratio = {"scenes": len(SEEDS), "ratio": np.mean(ratios), "worst_ratio": max(ratios)}
    return ratio | {"least_spread": min(spreads), "largest_spread": max(spreads), "mean_mm": rms(np.array(means))}


def exposed(setup: Setup) -> Figures:
    """Exposures from fringes of a digital number to those that fill the range, on planes, a sphere and the breast."""
    scenes = [plane.build(plane.PAPER_POSES[0]), build_scene({"kind": "sphere"}), build_scene({"kind": "breast"})]
    spreads, differences, refused = [], [], 0
    for seed in SEEDS:
        for time_s in EXPOSURES_S:
            shooting = Shooting(exposure_s=time_s)
            try:
                shot = experiment(setup.rig, scenes[seed % 3], setup.sequences["paper_surface"], seed, shooting=shooting)
            except InputError:
                refused += 1
                continue
            points = np.isfinite(shot.points.sigma)
            differences.append(np.count_nonzero(points) / np.count_nonzero(shot.found.lit) - shot.metrics["coverage"])
            if np.count_nonzero(points) >= FEWEST:
                spreads.append(shot.metrics["z_std"])
    figures = {"exposures": len(SEEDS) * len(EXPOSURES_S), "refused": refused, "coverage_off": np.abs(differences).max()}
    return figures | {"least_spread": min(spreads), "largest_spread": max(spreads)}


def skins(setup: Setup, spread_mm: float, wet: float) -> Figures:
    """Breasts of which light spreads beneath the skin, and some is wet, beside what noise leaves of such fringes."""
    scene, patterns, life = build_scene({"kind": "breast"}), setup.sequences["paper_surface"], Skin(spread_mm=spread_mm, wet=wet)
    found = [experiment(setup.rig, scene, patterns, seed, conditions=Conditions(skin=life)).metrics for seed in SEEDS]
    spreads = [one["z_std"] for one in found]
    return {
        "breasts": len(found),
        "breast_mm": np.mean([one["thing_breast_rms_mm"] for one in found]),
        "ratio": max(one["surface_rms_mm"] / one["limit_rms_mm"] for one in found),
        "least_spread": min(spreads),
        "largest_spread": max(spreads),
        "gross": max(one["gross_error_fraction"] for one in found),
    }


def covered(setup: Setup) -> Figures:
    """Views in which up to half of a disc is covered, lit and blurred as those that tracking is asked for."""
    unseen = chain.from_iterable(tracking_frames.unseen(setup, seed, SAMPLES) for seed in COVERED)
    seen = list(detection_rates.scored(unseen, setup.rig.target, nets.load(kind=setup.rig.target.kind)))
    partly = [view for view in seen if view.covered and detection_rates.sharp_and_lit(view)]
    false = sum(view.found and not view.right for view in seen)
    rightly = detection_rates.percent(view.right for view in partly)
    return {"covered": len(partly), "seeds": len(COVERED), "rightly_percent": rightly, "views": len(seen), "false": false}
