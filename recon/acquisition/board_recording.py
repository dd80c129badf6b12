"""Guided recording of a calibration board, pose by pose: lit for every camera, under fringes for camera 1."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from recon.acquisition import frame_checks
from recon.acquisition.exposure_setting import Exposing
from recon.acquisition.frame_checks import Limits
from recon.acquisition.guidance import BoardGuide, Operator, sentence
from recon.acquisition.pictures import Say, Show
from recon.acquisition.recording import Recording
from recon.acquisition.still_session import StillSession
from recon.board_detection.detect import BoardNotFound, detect
from recon.capture.board_part import FRINGE_CAMERA, read_board
from recon.devices.pattern_player import Pattern, Stage
from recon.model.boards import Board
from recon.model.patterns import Patterns

HEADROOM = 0.75  # of the level, at the first pose: others come nearer, and turn to the projector
HELD_PX = 0.3  # by which the board's points may move, in the mean, while the fringes are taken


@dataclass(frozen=True)
class BoardPlan:
    """What is to be recorded."""

    board: Board
    patterns: Patterns
    shown: Sequence[Pattern]  # (n,) the patterns as images for the projector
    poses: int  # that are wanted
    exposing: Exposing
    limits: Limits


def record_board(
    recording: Recording, stage: Stage, operator: Operator, guide: BoardGuide, plan: BoardPlan, say: Say, show: Show
) -> list[str]:
    """Record poses until there are enough, or the operator ends; returns their names. Each is kept as soon as it is whole.

    Poses that the capture has already are shown to the guide first.
    """
    names: list[str] = []
    darker = plan.exposing.model_copy(update={"level": HEADROOM * plan.exposing.level})
    session = StillSession(stage, darker, plan.limits, say, show)
    if recording.contents.board is not None:
        captured = read_board(recording.folder)
        for number in range(len(captured.poses)):
            guide.accept(captured.pose(number).lit)
    operator.ask(guide.suggest())
    while len(names) < plan.poses:
        lit = session.look()
        answer = operator.answer()
        if answer == "end":
            break
        if answer == "wait":
            continue
        if not names:
            lit = session.expose()
        reason = _recorded(recording, session, guide, plan, lit, names)
        say(reason or f"pose {names[-1]}, {len(names)} of {plan.poses}")
        if len(names) < plan.poses:
            operator.ask(guide.suggest())
    return names


def _recorded(
    recording: Recording, session: StillSession, guide: BoardGuide, plan: BoardPlan, lit: Mapping[str, NDArray], names: list[str]
) -> str:
    """Take one pose; returns why it isn't kept, or nothing."""
    if faults := session.faults(lit):
        return f"not kept: {sentence(faults)}"
    verdict = guide.judge(lit)
    if not verdict.accepted:
        return f"not kept: {verdict.text}"
    fringes, faults = session.sequence(plan.shown, [FRINGE_CAMERA])
    bits = session.stage.cameras[FRINGE_CAMERA].bits
    contrast = frame_checks.contrast(fringes[FRINGE_CAMERA], plan.patterns, bits, plan.limits)
    if faults := [*faults, *frame_checks.fringe_faults(contrast, plan.limits)]:
        return f"not kept: {sentence(faults)}"
    after = session.look()
    moved = moved_px(lit[FRINGE_CAMERA], after[FRINGE_CAMERA], plan.board, 2**bits - 1)
    if not moved <= HELD_PX:
        return f"not kept: the board moved by {moved:.1f} px under the fringes; put it down, or lean it against something"
    names.append(recording.add_pose(lit, fringes, plan.board, plan.patterns, session.devices(plan.patterns.projector_size)))
    guide.accept(lit)
    return ""


def moved_px(before: NDArray, after: NDArray, board: Board, full: float) -> float:
    """Mean displacement of the board's points between two images : (h, w); infinite if the board is gone."""
    try:
        first, second = (detect(image, board, full=full).pixels for image in (before, after))
    except BoardNotFound:
        return np.inf
    return float(np.linalg.norm(np.nanmean(second - first, axis=0)))
