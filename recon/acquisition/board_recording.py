"""Guided recording of a calibration board, pose by pose: lit for every camera, under fringes for camera 1."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from recon.acquisition import frame_checks
from recon.acquisition.board_guide import BoardGuide, new_guide
from recon.acquisition.exposure_setting import Exposing
from recon.acquisition.frame_checks import Limits
from recon.acquisition.guidance import PENDING, Operator, sentence
from recon.acquisition.pictures import Say, Show
from recon.acquisition.recording import Recording
from recon.acquisition.still_session import StillSession
from recon.board_guidance.board_room import PoseLimits
from recon.board_guidance.pose_progress import held
from recon.capture.board_part import FRINGE_CAMERA, read_board
from recon.devices.pattern_player import Pattern, Stage
from recon.model.boards import Board
from recon.model.patterns import Patterns
from recon.model.rig import Rig


@dataclass(frozen=True)
class BoardPlan:
    """What is to be recorded."""

    board: Board
    patterns: Patterns
    shown: Sequence[Pattern]  # (n,) the patterns as images for the projector
    poses: int  # that are wanted
    exposing: Exposing
    limits: Limits
    rig: Rig  # as it is described: poses are asked for by it, until those so far determine the devices
    reach: PoseLimits
    seed: int = 0  # of the poses from which one is chosen


class _Outcome(NamedTuple):
    """What came of a pose that was held."""

    kept: bool
    text: str


def record_board(recording: Recording, stage: Stage, operator: Operator, plan: BoardPlan, say: Say, show: Show) -> list[str]:
    """Record poses until there are enough, or the operator ends; returns their names. Each is kept as soon as it is whole.

    Poses that the capture has already count for those that are asked for.
    """
    recording.check_board(plan.board, plan.patterns)
    rng = np.random.default_rng(plan.seed)
    guide = new_guide(plan.rig, stage.cameras, stage.projector.size, plan.board, plan.patterns, plan.reach, rng)
    if recording.contents.board is not None:
        guide.read(read_board(recording.folder), say)
    headroom = 0.75  # of the level, at the first pose: others come nearer, and turn to the projector
    darker = plan.exposing.model_copy(update={"level": headroom * plan.exposing.level})
    session = StillSession(stage, darker, plan.limits, say, show, frame_checks.light_faults, guide.over)
    names: list[str] = []
    operator.ask(guide.suggest())
    while len(names) < plan.poses:
        lit = session.look()
        answer = operator.answer()
        if answer == "end":
            break
        if answer in PENDING:
            continue
        if not names:
            lit = session.expose()
        name = recording.next_pose
        outcome = _held(recording, session, guide, plan, lit, answer == "keep")
        names += [name] if outcome.kept else []
        say(f"pose {name}, {len(names)} of {plan.poses}, {outcome.text}" if outcome.kept else outcome.text)
        if len(names) < plan.poses:
            operator.ask(guide.suggest() if outcome.kept else guide.insist())
    return names


def _held(
    recording: Recording, session: StillSession, guide: BoardGuide, plan: BoardPlan, lit: Mapping[str, NDArray], whatever: bool
) -> _Outcome:
    """Take a pose that is held, and keep it if nothing is wrong with it, or whatever is wrong if camera 1 can place it."""
    name = recording.next_pose
    sighting, faults = guide.sight(name, lit), session.faults(lit)
    verdict = guide.judge_lit(sighting, lit)
    reason = sentence(faults) or ("" if verdict.accepted else verdict.reason)
    if held(sighting, guide.so_far) is None:
        return _Outcome(False, f"not kept: {reason}")
    if reason and not whatever:
        return _refuse(reason)
    fringes, unlit = session.sequence(plan.shown, [FRINGE_CAMERA])
    bits = session.stage.cameras[FRINGE_CAMERA].bits
    contrast = frame_checks.contrast(fringes[FRINGE_CAMERA], plan.patterns, bits, plan.limits)
    again = guide.sight(name, session.look())
    sighting = guide.decode(sighting, lit, fringes[FRINGE_CAMERA])
    verdict = guide.judge(sighting, lit, again)
    faults = [*unlit, *frame_checks.fringe_faults(contrast, plan.limits)]
    reason = reason or sentence(faults) or ("" if verdict.accepted else verdict.reason)
    if reason and not whatever:
        return _refuse(reason)
    recording.add_pose(lit, fringes, plan.board, plan.patterns, session.devices(plan.patterns.projector_size))
    guide.accept(sighting, verdict)
    return _Outcome(True, f"kept though {reason}" if reason else verdict.reason)


def _refuse(reason: str) -> _Outcome:
    return _Outcome(False, f"not kept: {reason} (k takes the board as it is held, and keeps the pose)")
