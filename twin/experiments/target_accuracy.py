"""Accuracy with a target that isn't printed as designed: found, measured from a film, and tracked with what was measured."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import chain

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from recon.geometry import rigid
from recon.model import circle_layout
from recon.model.rig import Target
from recon.target_calibration import target_bundle, target_poses
from recon.tracking import networks as nets
from recon.tracking.networks import Networks
from recon.tracking.tracker import Tracker
from twin.experiments import tracking_frames
from twin.experiments.experiment_setup import Figures, Setup
from twin.experiments.pose_accuracy import LIT_DN, cameras_of, pose_errors
from twin.tracking.rendered_views import Frames
from twin.tracking.samples import Take

Array = NDArray[np.float64]
Shown = tuple[Take, Frames]

SEED, COUNT, RAYS = 3003, 40, 32  # of the frames, which show the target to be measured
PRINTS = range(200, 210)  # unseen seeds of designs
ERROR_MM = 0.3  # by which each circle's place is off at most, to all sides alike
UNSEEN, SAMPLES = (1051, 1061), 250  # seeds of frames as in a data set, and pairs of each
DESIGNS = 4  # that each of them is tracked with
WRONG_MM, WRONG_SIGMAS = 1.0, 5.0  # beyond both a pose is false: dark ones are uncertain by 0.3 mm


@dataclass(frozen=True)
class Tracked:
    """Poses of n pairs with one design; NaN where there is none."""

    shift_mm: Array  # (n,)
    turn_deg: Array  # (n,)
    squared: Array  # (n,) squared error over the whole covariance, chi-square with 6 degrees


def designs(setup: Setup) -> Figures:
    """Designs that the target differs from, before and after it was measured, beside the target's own."""
    shown, actual = list(tracking_frames.study(setup, SEED, COUNT, LIT_DN, 0.0, RAYS)), setup.rig.target
    found_by = nets.load(kind=setup.rig.target.kind)
    exact = [tracked(shown, actual.model_copy(update={"tolerance_mm": 0.0}), found_by)]
    before, after, errors, squared = [], [], [], []
    for seed in PRINTS:
        design = misprinted(actual, seed)
        before.append(tracked(shown, design, found_by))
        found = target_bundle.adjust(seen(shown, design, found_by), design, None)
        off = circle_layout.lengths(found.target) - circle_layout.lengths(actual)
        errors.append(off)
        squared.append(off @ np.linalg.solve(found.covariance[:3, :3], off))
        after.append(tracked(shown, found.target, found_by))
    figures: Figures = {"designs": len(PRINTS), "found_percent": 100 * np.isfinite([one.shift_mm for one in before]).mean()}
    figures |= dict(zip(actual.LENGTHS, np.abs(errors).max(axis=0).tolist(), strict=True)) | {"squared": np.mean(squared)}
    for figure in ("shift_mm", "turn_deg"):
        for name, results in (("exact", exact), ("before", before), ("after", after)):
            figures[f"{figure}_{name}"] = np.nanmedian([getattr(one, figure) for one in results])
        figures[f"{figure}_ratio"] = figures[f"{figure}_after"] / figures[f"{figure}_exact"]
    return figures | _honest("before", before) | _honest("after", after)


def false_poses(setup: Setup) -> Figures:
    """Poses that are wrong, in frames as in a data set, dark, moving and covered, tracked with wrong designs."""
    unseen = chain.from_iterable(tracking_frames.unseen(setup, seed, SAMPLES) for seed in UNSEEN)
    found_by, wrong = nets.load(kind=setup.rig.target.kind), [misprinted(setup.rig.target, seed) for seed in PRINTS[:DESIGNS]]
    false = sum(_wrong(one, design, found_by) for one in unseen for design in wrong)
    return {"false": false, "pairs": len(UNSEEN) * SAMPLES * len(wrong)}


def misprinted(actual: Target, seed: int) -> Target:
    """A design from which each circle of the actual target is off, anywhere within a disc."""
    rng = np.random.default_rng([seed, 3])
    count = circle_layout.count(actual)
    angle, away = rng.uniform(0, 2 * np.pi, count), ERROR_MM * np.sqrt(rng.uniform(0, 1, count))
    places = circle_layout.circle_centres(actual)[:, :2] + away[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    return circle_layout.with_lengths(actual, circle_layout.lengths_between(places))


def seen(shown: Sequence[Shown], design: Target, networks: Networks) -> list[target_poses.Seen]:
    """Pairs that the target can be measured from."""
    found = (target_poses.whole(_step(one, design, networks), cameras_of(one[0])) for one in shown)
    return target_poses.distinct([one for one in found if isinstance(one, target_poses.Seen)])


def tracked(shown: Sequence[Shown], design: Target, networks: Networks) -> Tracked:
    """Track pairs, each as if nothing were known before."""
    return Tracked(*np.array([_errors(one, design, networks) for one in shown]).T)


def _errors(one: Shown, design: Target, networks: Networks) -> tuple[float, float, float]:
    pose = _step(one, design, networks).pose
    errors = pose_errors(one[0], pose.world_from_target)
    if errors is None:
        return np.nan, np.nan, np.nan
    step = rigid.difference(one[0].motion.world_from_target, pose.world_from_target)
    return *errors, float(step @ np.linalg.solve(pose.total, step))


def _step(one: Shown, design: Target, networks: Networks):
    take, frames = one
    return Tracker(cameras_of(take), design, networks, drift_px=0, board_scale=0).step(*frames.views)


def _wrong(one: Shown, design: Target, networks: Networks) -> bool:
    """Whether there is a pose that isn't the target's."""
    pose = _step(one, design, networks).pose
    errors = pose_errors(one[0], pose.world_from_target)
    if errors is None:
        return False
    sigma = np.sqrt(np.trace(pose.total[3:, 3:]))
    return bool(not one[0].present or errors[0] > max(WRONG_MM, WRONG_SIGMAS * sigma))


def _honest(when: str, results: Sequence[Tracked]) -> Figures:
    """Whether poses' errors are as large as their covariance has it."""
    squared = np.concatenate([one.squared for one in results])
    squared = squared[np.isfinite(squared)]
    return {f"squared_{when}": squared.mean(), f"inside_{when}": 100 * np.mean(squared < chi2.ppf(0.95, 6))}
