"""Guidance of one recording of a board: the pose to ask for, the way there from where the board is held, and what is kept."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from recon.acquisition.guidance import Step
from recon.acquisition.pictures import Over, Say
from recon.board_guidance import pose_verdict
from recon.board_guidance.board_room import PoseLimits, Reach, reach_of
from recon.board_guidance.next_pose import NOISE_PX, Suggestion, described, suggest
from recon.board_guidance.pose_progress import SoFar, held, with_sighting
from recon.board_guidance.pose_verdict import Observation, Verdict
from recon.board_guidance.pose_words import moves, there
from recon.capture.board_part import FRINGE_CAMERA, BoardCapture
from recon.devices.interfaces import Camera, Size
from recon.errors import InputError
from recon.geometry.camera import Array
from recon.model.boards import Board
from recon.model.patterns import Patterns
from recon.model.rig import Rig
from recon.optical_calibration.observations import PROJECTOR
from recon.optical_calibration.sightings import Sighting, sight, with_projector

Images = Mapping[str, NDArray]  # camera: (h, w)


@dataclass
class BoardGuide:
    """Guidance of whoever holds the board. Its state is the poses so far, the one that is asked for, and the one that is held."""

    so_far: SoFar
    patterns: Patterns
    bits: Mapping[str, int]  # of each camera's digital numbers
    reach: Reach
    rng: np.random.Generator
    _asked: Suggestion | None = None
    _tries: int = field(default=0, init=False)  # of the asked pose
    _held: Array | None = field(default=None, init=False)  # (4, 4) world_from_board, as camera 1 saw it last

    def read(self, captured: BoardCapture, say: Say) -> None:
        """Take note of the poses that a capture has already; those that camera 1 can't place count for nothing."""
        for number, name in enumerate(captured.poses):
            pose = captured.pose(number)
            sighting = sight(name, self.so_far.board, pose.lit, pose.fringes, captured.patterns, self.bits)
            if held(sighting, self.so_far) is None:
                say(f"pose {name} of before: not found by {FRINGE_CAMERA}, so it doesn't count for the guidance")
                continue
            self.so_far = with_sighting(self.so_far, sighting)
            say(f"pose {name} of before: found by {', '.join(sighting.pixels)}")

    def suggest(self) -> Step:
        """Ask for the pose that adds most."""
        so_far, self._tries = self.so_far, 0
        self._asked = suggest(
            so_far.calibration, so_far.poses, so_far.rig, so_far.board, self.rng, self.reach, noise=so_far.noise
        )
        return self._step(self._asked)

    def insist(self) -> Step:
        """Ask for the same pose after a try that was refused, for another one after some."""
        self._tries += 1
        patience = 2  # tries of an asked pose, after which another is asked for: it may be one that can't be held
        return self.suggest() if self._asked is None or self._tries == patience else self._step(self._asked)

    def over(self, camera: str, image: NDArray) -> Over | None:
        """The asked pose's outline over camera 1's image : (h, w), and the way there from where the board is seen."""
        if camera != FRINGE_CAMERA or self._asked is None:
            return None
        asked, sighting = self._asked, self.sight("held", {camera: image})
        pose = held(sighting, self.so_far)
        if pose is None:
            reason = sighting.failures.get(camera)
            return Over(f"{asked.words}; board not found{f': {reason}' if reason else ''}", asked.outline, asked.points[0], False)
        arrived = there(asked.world_from_board, pose, self.so_far.board)
        return Over(moves(asked.world_from_board, pose, self.so_far.board), asked.outline, asked.points[0], arrived)

    def sight(self, name: str, lit: Images) -> Sighting:
        """Find the board in the cameras' lit images."""
        return sight(name, self.so_far.board, lit, None, None, self.bits)

    def decode(self, sighting: Sighting, lit: Images, fringes: NDArray) -> Sighting:
        """Add the projector's sighting, by camera 1's fringes : (n, h, w)."""
        board, bits = self.so_far.board, self.bits[FRINGE_CAMERA]
        return with_projector(sighting, board, lit[FRINGE_CAMERA], fringes, self.patterns, bits)

    def judge_lit(self, sighting: Sighting, lit: Images) -> Verdict:
        """Judge what can be judged before the fringes are taken."""
        self._held = held(sighting, self.so_far)
        return pose_verdict.judge_lit(Observation(sighting, lit, asked_gain=self._gain), self.so_far, self.reach)

    def judge(self, sighting: Sighting, lit: Images, again: Sighting) -> Verdict:
        """Judge all of a pose, found once more after the fringes."""
        nowhere = np.full((len(self.so_far.board.points()), 2), np.nan)
        later = {camera: again.pixels.get(camera, nowhere) for camera in lit}
        return pose_verdict.judge(Observation(sighting, lit, later, self._gain), self.so_far, self.reach)

    def accept(self, sighting: Sighting, verdict: Verdict) -> None:
        """Take note of a pose that was kept, whatever the verdict."""
        self.so_far = verdict.so_far if verdict.accepted else with_sighting(self.so_far, sighting)

    @property
    def _gain(self) -> float | None:
        return None if self._asked is None else self._asked.gain

    def _step(self, asked: Suggestion) -> Step:
        where, board = asked.world_from_board, self.so_far.board
        return Step(asked.words if self._held is None else moves(where, self._held, board), where)


def new_guide(
    rig: Rig,
    cameras: Mapping[str, Camera],
    projector: Size,
    board: Board,
    patterns: Patterns,
    limits: PoseLimits,
    rng: np.random.Generator,
) -> BoardGuide:
    """A guide that has seen no pose yet, for these cameras and a projector of that size.

    Raises
    ------
    InputError
        If the devices aren't of the sizes that the rig describes, or no depth suits all lenses.
    """
    sizes = {name: camera.size for name, camera in cameras.items()} | {PROJECTOR: projector}
    for name, camera in described(rig, sizes).items():
        if camera.size != tuple(sizes[name]):
            (width, height), (own_width, own_height) = sizes[name], camera.size
            raise InputError(
                f"rig.{name}.optics.size: expected {width}x{height} px as the device has, found {own_width}x{own_height}; "
                "poses are asked for by the rig's description: give rig=NAME of this one, or correct its optics"
            )
    so_far = SoFar(rig, board, noise={name: NOISE_PX[name] for name in sizes})
    return BoardGuide(so_far, patterns, {name: one.bits for name, one in cameras.items()}, reach_of(rig, limits), rng)
