"""Several bodies in rendered pairs of frames: how many are found, as themselves, and how exactly."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from recon.model import target_family
from recon.model.rig import PROBE, Rig
from recon.tracking import networks as nets
from recon.tracking.bodies import BodyTracker
from recon.tracking.tracker import Tracker, is_beside
from twin.experiments.experiment_setup import Figures, Setup
from twin.experiments.tracking_frames import exactly_printed, several

SEED = 2047
BODIES = (PROBE, "needle", "patient")
WRONG_MM = 2.0  # from its place: another body's circles were taken for it


class Found(NamedTuple):
    """A body in a pair of frames."""

    found: bool
    off_mm: float  # of its origin; NaN where it isn't found
    beside: bool  # whether a second one of its design was told


def rig_of(setup: Setup, alike: bool = False) -> Rig:
    """The rig with two more bodies that can be told from the probe, or with one that can't."""
    rig = exactly_printed(setup).rig
    if alike:
        return rig.model_copy(update={"bodies": {"twin": rig.target.model_copy(update={"unusual": True})}})
    return rig.model_copy(update={"bodies": dict(zip(BODIES[1:], target_family.propose(rig.target, 3)[1:], strict=True))})


def three(setup: Setup, pairs: int = 2000) -> Figures:
    """Figures of three bodies in pairs lit to dark, blurred by up to 12 px, each searched for from nothing."""
    rig = rig_of(setup)
    seen = list(searched(setup, rig, list(rig.targets), pairs))
    off = np.array([one.off_mm for one in seen if one.found])
    return {
        "pairs": pairs,
        "found_percent": 100 * float(np.mean([one.found for one in seen])),
        "wrong": int(np.sum(off > WRONG_MM)),
        "off_median_mm": float(np.median(off)),
        "off_95_mm": float(np.quantile(off, 0.95)),
        "second_told_percent": 100 * float(np.mean([one.beside for one in seen])),
    }


def alike(setup: Setup, pairs: int = 200) -> Figures:
    """Share of pairs with two bodies of one design, of which the second is told."""
    results = list(searched(setup, rig_of(setup, alike=True), [PROBE], pairs))
    return {"pairs": pairs, "told_percent": 100 * float(np.mean([one.beside for one in results]))}


def searched(setup: Setup, rig: Rig, tracked: Sequence[str], pairs: int) -> Iterator[Found]:
    """Results of tracked bodies, each pair by itself, by cameras that may have drifted as usual."""
    known = nets.load(kind=rig.target.kind, by_geometry=True)
    for take, frames in several(Setup(rig, frames=setup.frames), SEED, pairs):
        first, second = (device.optics.camera() for device in take.cameras)
        tracker = BodyTracker({name: Tracker((first, second), rig.targets[name], known) for name in tracked})
        for name, found in tracker.step(*frames.views).items():
            true = take.held[name].motion.world_from_target
            off = float(np.linalg.norm(found.pose.world_from_target[:3, 3] - true[:3, 3]))  # NaN of one that is lost
            yield Found(found.found, off, is_beside(found.apart_mm))
