"""Detection rates in frames like the training's, of another seed: found, misnamed, missed, false alarms."""

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import chain

import numpy as np
from numpy.typing import NDArray

from recon.model.rig import Target
from recon.tracking.networks import Networks
from recon.tracking.tracker import Tracker
from recon.tracking.views import View
from twin.experiments import tracking_frames
from twin.experiments.table_rows import Row, Setup
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


def rows(setup: Setup, networks: Networks, samples: int = SAMPLES) -> list[Row]:
    """Rates of finding, of wrong names and of false alarms."""
    unseen = chain.from_iterable(tracking_frames.unseen(setup, seed, samples) for seed in SEEDS)
    seen = list(scored(unseen, setup.rig.target, networks))
    there = [view for view in seen if view.shows_target and view.blur_px <= BLURRED_PX]
    lit = [view for view in there if view.white_dn >= LIT_DN]
    dim = [view for view in there if DIM_DN <= view.white_dn < LIT_DN]
    covered = [view for view in seen if view.covered and sharp_and_lit(view)]
    found = [view for view in seen if view.found]
    empty = [view for view in seen if view.empty]
    return [
        Row("b", f"target views found rightly, white >= 15, blur <= 12 px ({len(lit)} views)",
            percent(view.right for view in lit), 99.5, None, "%", at_least=True),
        Row("b", f"target views found rightly, white 8 to 15, blur <= 12 px ({len(dim)} views)",
            percent(view.right for view in dim), 95.0, None, "%", at_least=True),
        Row("b", f"the same of views in which up to half of a disc is covered, white >= 15, blur <= 12 px ({len(covered)} views)",
            percent(view.right for view in covered), 95.0, None, "%", at_least=True),
        Row("b", f"wrong identity, of views found ({len(found)} views)",
            percent(view.exchanged for view in found), 0.02, 0.0, "%"),
        Row("b", f"false alarms on frames without target ({len(empty)} views)",
            percent(view.found for view in empty), 0.1, 0.0, "%"),
        Row("b", f"found, but neither right nor exchanged ({len(found)} views)",
            percent(not view.right and not view.exchanged for view in found), 0.1, 0.0, "%"),
    ]  # fmt: skip


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
