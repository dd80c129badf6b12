"""Detection rates in frames like the training's, of another seed: found, misnamed, missed, false alarms."""

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import chain

import numpy as np
from numpy.typing import NDArray

from recon.model.rig import Target
from recon.tracking import networks as nets
from recon.tracking.networks import Networks
from recon.tracking.tracker import Tracker
from recon.tracking.views import View
from twin.experiments import tracking_frames
from twin.experiments.experiment_setup import Figures, Setup
from twin.experiments.tracking_frames import exactly_printed
from twin.tracking.rendered_views import Frames
from twin.tracking.samples import Take
from twin.tracking.target_truth import ViewTruth

SEEDS = (1031, 1033, 1037, 1039)  # each of its own bodies and surroundings; never used to train or to choose by
SAMPLES = 250  # stereo frames of each
WHOLE, PARTLY = 0.95, 0.5  # of each disc: what is seen of a target that nothing covers, and of one that is covered in part
CLOSE_PX, CLOSE_BLURS = 3.0, 0.5  # a circle is right within this, plus this part of its blur
BLURRED_PX = 12.0
LIT_DN, DIM_DN = 15.0, 8.0


@dataclass(frozen=True)
class Seen:
    """One view: the truth, and the detection."""

    shows_target: bool  # all three discs inside the image, nothing before them
    covered: bool  # the same, but a finger or cable covers up to half of a disc
    empty: bool  # of a frame without target
    white_dn: float
    blur_px: float
    found: bool
    right: bool
    exchanged: bool  # circles of the target, under wrong names


def rates(setup: Setup, samples: int = SAMPLES) -> Figures:
    """Rates of finding, of wrong names and of false alarms, in %."""
    setup = exactly_printed(setup)
    unseen = chain.from_iterable(tracking_frames.unseen(setup, seed, samples) for seed in SEEDS)
    seen = list(scored(unseen, setup.rig.target, nets.load(kind=setup.rig.target.kind)))
    there = [view for view in seen if view.shows_target and view.blur_px <= BLURRED_PX]
    lit = [view for view in there if view.white_dn >= LIT_DN]
    dim = [view for view in there if DIM_DN <= view.white_dn < LIT_DN]
    covered = [view for view in seen if view.covered and sharp_and_lit(view)]
    found = [view for view in seen if view.found]
    empty = [view for view in seen if view.empty]
    counts = {
        name: len(views) for name, views in {"lit": lit, "dim": dim, "covered": covered, "found": found, "empty": empty}.items()
    }
    return counts | {
        "lit_percent": percent(view.right for view in lit),
        "dim_percent": percent(view.right for view in dim),
        "covered_percent": percent(view.right for view in covered),
        "exchanged_percent": percent(view.exchanged for view in found),
        "alarms_percent": percent(view.found for view in empty),
        "elsewhere_percent": percent(not view.right and not view.exchanged for view in found),
    }


def sharp_and_lit(view: Seen) -> bool:
    """Whether a view of the target is neither blurred nor dark beyond what is asked for."""
    return view.blur_px <= BLURRED_PX and view.white_dn >= LIT_DN


def scored(samples: Iterable[tuple[Take, Frames]], target: Target, networks: Networks) -> Iterable[Seen]:
    """Track each sample as if nothing were known before, with the usual allowance for drift, and score both views."""
    for take, given in samples:
        first, second = (device.optics.camera() for device in take.cameras)
        result = Tracker((first, second), target, networks).step(*given.views)
        for view, truth in zip(result.views, given.truth, strict=True):
            yield score(view, truth, take.present)


def score(view: View, truth: ViewTruth, present: bool) -> Seen:
    """Compare a view with its truth."""
    right = exchanged = False
    if view.found and present:
        apart = np.linalg.norm(view.outlines.ellipses.centre[:, None] - truth.ellipses[None, :, :2], axis=-1)
        close = apart < CLOSE_PX + CLOSE_BLURS * truth.blur_px
        right = bool(close.diagonal().all())
        exchanged = not right and bool(close.any(axis=1).all())
    inside, least = present and bool(truth.inside.all()), float(truth.visible.min())
    return Seen(
        shows_target=inside and least >= WHOLE,
        covered=inside and PARTLY <= least < WHOLE,
        empty=not present,
        white_dn=truth.white_dn,
        blur_px=float(np.nanmax(truth.blur_px)) if present else float("nan"),
        found=view.found,
        right=right,
        exchanged=exchanged,
    )


def percent(flags: Iterable[bool]) -> float:
    """Share of what is true, in %; not a number without any."""
    values: NDArray[np.bool_] = np.array(list(flags), bool)
    return float(100 * values.mean()) if len(values) else float("nan")
