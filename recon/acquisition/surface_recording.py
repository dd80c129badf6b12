"""Guided recording of a surface under a fringe sequence, which must lie still meanwhile."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from recon.acquisition import frame_checks
from recon.acquisition.exposure_setting import Exposing
from recon.acquisition.frame_checks import Limits
from recon.acquisition.guidance import PENDING, Operator, Step, sentence
from recon.acquisition.pictures import Say, Show
from recon.acquisition.recording import Recording
from recon.acquisition.still_session import StillSession
from recon.devices.pattern_player import Pattern, Stage
from recon.model.patterns import Patterns


@dataclass(frozen=True)
class SurfacePlan:
    """What is to be recorded."""

    patterns: Patterns
    shown: Sequence[Pattern]  # (n,) the patterns as images for the projector
    exposing: Exposing
    limits: Limits


def record_surface(recording: Recording, stage: Stage, operator: Operator, plan: SurfacePlan, say: Say, show: Show) -> bool:
    """Record the sequence when the operator is ready; returns whether it was kept.

    A sequence with faults is kept only if the operator then keeps it, or ends, rather than takes it again.
    """
    session = StillSession(stage, plan.exposing, plan.limits, say, show)
    operator.ask(Step("lay down what is to be measured, in the projector's light, and let nothing move"))
    taken: dict[str, NDArray] = {}
    while True:
        lit = session.look()
        answer = operator.answer()
        if answer in PENDING:
            continue
        if answer in ("end", "keep"):
            break
        lit = session.expose()
        taken, unlit = session.sequence(plan.shown, list(stage.cameras))
        faults = [*session.faults(lit), *unlit, *_faults(session, plan, taken), *_moved(lit, session.look())]
        if not faults:
            break
        operator.ask(Step(f"{sentence(faults)}; take it again, or end to keep it as it is"))
    if taken:
        recording.add_surface(taken, plan.patterns, session.devices(plan.patterns.projector_size))
    return bool(taken)


def _faults(session: StillSession, plan: SurfacePlan, taken: dict[str, NDArray]) -> list[str]:
    """Faults of the fringes, each with its camera."""
    faults = []
    for name, images in taken.items():
        found = frame_checks.contrast(images, plan.patterns, session.stage.cameras[name].bits, plan.limits)
        session.say(f"{name} {found.text}")
        faults += [f"{name} {fault}" for fault in frame_checks.fringe_faults(found, plan.limits)]
    return faults


def _moved(before: dict[str, NDArray], after: dict[str, NDArray]) -> list[str]:
    """Faults of what moved, or was covered, while the fringes were taken."""
    still = 0.02  # relative RMS change of the lit image, beyond noise, between before the sequence and after it
    return [
        f"{name} moved: its image changed by {100 * change:.1f} % meanwhile; lay all things still"
        for name in before
        if (change := _change(before[name], after[name])) > still
    ]


def _change(before: NDArray, after: NDArray) -> float:
    """Relative RMS change between two images : (h, w), of means of blocks."""
    first, second = (_blocks(image) for image in (before, after))
    return float(np.sqrt(np.mean((second - first) ** 2)) / max(np.sqrt(np.mean(first**2)), 1e-9))


def _blocks(image: NDArray) -> NDArray[np.float64]:
    grain_px = 8  # blocks whose means are compared, so that noise counts little
    height, width = (side - side % grain_px for side in image.shape)
    return image[:height, :width].reshape(height // grain_px, grain_px, width // grain_px, grain_px).mean(axis=(1, 3))
