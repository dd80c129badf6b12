"""Recording of a board: a calibration by guided poses before virtual devices, beside one by the same poses, rendered."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from recon.acquisition.board_recording import BoardPlan, record_board
from recon.acquisition.exposure_setting import Exposing
from recon.acquisition.frame_checks import Limits
from recon.acquisition.guidance import Operator, Step
from recon.acquisition.pictures import hidden
from recon.acquisition.recording import open_recording
from recon.artwork.projected_images import images
from recon.board_guidance.board_room import PoseLimits
from recon.capture.board_part import read_board
from recon.capture.manifest import Device, read_manifest
from recon.devices.pattern_player import Stage, Triggered
from recon.geometry.rigid import Array
from recon.model.calibration import Calibration
from recon.model.patterns import Patterns
from recon.model.rig import Rig
from recon.optical_calibration import board_frames, uncertainty
from recon.optical_calibration.joint_calibration import Result, Settings, calibrate
from scenes.board_poses import Config as Poses
from scenes.kinds import board
from twin import board_session
from twin.board_session import CAMERAS
from twin.devices.virtual_session import StillSettings, before_board
from twin.experiments.calibration_errors import DEPTHS, PAIRS, point_errors, rms_length
from twin.experiments.experiment_setup import Figures, Setup
from twin.experiments.surface_accuracy import TRACING
from twin.optics.surface_session import Shooting
from twin.sensor import Exposure

POSES, SEED = 8, 5


def guided_board(setup: Setup) -> Figures:
    """How well the board's points fit, and where the calibrations have points of the volume, recorded beside rendered."""
    patterns = setup.sequences["paper_calibration"]
    with TemporaryDirectory() as folder:
        recorded, rendered = Path(folder) / "recorded", Path(folder) / "rendered"
        poses = record(recorded, setup.rig, patterns)
        render(rendered, setup.rig, patterns, poses, read_manifest(recorded).devices)
        first, second = (calibrated(each) for each in (recorded, rendered))
    change = max(abs(first.rms[device] / second.rms[device] - 1) for device in second.rms)
    return {
        "poses": len(poses),
        "rms_change": change,
        "apart": apart(first.adjustment.calibration, second.adjustment.calibration),
    }


class Watched:
    """A hand whose latest pose is remembered."""

    def __init__(self, hand: Operator) -> None:
        self._hand, self.answer = hand, hand.answer
        self.pose = np.eye(4)

    def ask(self, step: Step) -> None:
        """Hold the board, if that is asked for."""
        self.pose = self.pose if step.world_from_board is None else step.world_from_board
        self._hand.ask(step)


def record(folder: Path, rig: Rig, patterns: Patterns) -> list[Array]:
    """Record a board's poses as a person is guided to them; returns those kept : (4, 4) mm."""
    design, shown = board.design(board.Config()), list(images(patterns))
    devices = before_board(StillSettings(rig, TRACING, list(CAMERAS), seed=SEED), design, shown, POSES)
    plan = BoardPlan(design, patterns, shown, POSES, Exposing(), Limits(), rig, PoseLimits(), SEED)
    hand, kept = Watched(devices.operator), list[Array]()

    def say(text: str) -> None:
        if text.startswith("pose "):
            kept.append(hand.pose)

    with open_recording(folder) as recording:
        record_board(recording, Stage(devices.projector, devices.cameras, Triggered()), hand, plan, say, hidden)
    return kept


def render(folder: Path, rig: Rig, patterns: Patterns, poses: Sequence[Array], taken: Mapping[str, Device]) -> None:
    """Render a capture of a board in some poses, exposed as another capture was."""
    settings = board_session.Settings(rig, board.Config(), Poses(), patterns, CAMERAS, TRACING, Shooting(), SEED + 1)
    stage = board_session.set_up(settings)
    exposures = {name: exposed(taken[name]) for name in CAMERAS}
    with open_recording(folder) as recording:
        for number, pose in enumerate(poses):
            lit, fringes = board_session.shoot_pose(stage, settings, exposures, number, pose)
            recording.add_pose(lit, fringes, board.design(board.Config()), patterns, taken)


def exposed(camera: Device) -> Exposure:
    """A camera's exposure, as a capture has it."""
    assert camera.exposure_s is not None and camera.gain is not None
    return Exposure(camera.exposure_s, camera.gain, camera.bits)


def calibrated(folder: Path) -> Result:
    """A capture's calibration, as the command makes it."""
    captured = read_board(folder)
    sizes = {name: device.size for name, device in read_manifest(folder).devices.items()}
    return calibrate(list(board_frames.look_at_all(captured, sizes)), captured.board, sizes, Settings(distortion="brown"))


def apart(first: Calibration, second: Calibration) -> float:
    """RMS distance of points that two calibrations measure, over its standard deviation as both predict it."""
    volume = uncertainty.working_volume(first, DEPTHS)
    distances = np.concatenate([point_errors(first, second, pair, volume) for pair in PAIRS])
    variances = [uncertainty.triangulation(each, *pair, volume) for each in (first, second) for pair in PAIRS]
    return rms_length(distances) / float(np.sqrt(2 * np.trace(np.concatenate(variances), axis1=1, axis2=2).mean()))
