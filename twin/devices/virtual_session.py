"""Virtual devices of a recording, with what stands before them and the hand that moves it."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from recon.acquisition.guidance import Answer, Operator, Step
from recon.board_detection.kinds.asymmetric_circles import AsymmetricCircles
from recon.errors import InputError
from recon.geometry import rigid
from recon.model.boards import Board
from recon.model.rig import Rig
from recon.model.tracks import MAX_GAP_S
from scenes.catalogue import build_scene
from scenes.kinds import board
from twin.devices.shown_light import Pattern
from twin.devices.still_scenes import EvenLight, HeldBoard, StillScene, known_to_board, known_to_scene
from twin.devices.virtual_clock import Turns, VirtualClock
from twin.devices.virtual_rig import Still, VirtualCamera, VirtualProjector, VirtualRig
from twin.devices.virtual_sweep import VirtualPair, VirtualScanner
from twin.filmed_sweep import SweepSettings, plan_sweep
from twin.optics.light_transport import Tracing
from twin.optics.surface_session import CameraName
from twin.tracking.sampling_ranges import DataRanges

COVERED = 1e9  # contrast of a projector behind a card


@dataclass(frozen=True)
class StillDevices:
    """Cameras and projector before something at rest."""

    cameras: Mapping[str, VirtualCamera]
    projector: VirtualProjector
    operator: Operator


@dataclass(frozen=True)
class SweepDevices:
    """Both cameras and the scanner, before a hand that leads the probe."""

    pairs: VirtualPair
    scanner: VirtualScanner
    operator: Operator


@dataclass(frozen=True)
class StillSettings:
    """How things at rest are rendered."""

    rig: Rig
    tracing: Tracing
    cameras: Sequence[CameraName]
    bits: int = 8
    paced: bool = False
    seed: int = 0


def before_scene(settings: StillSettings, scene: Mapping[str, object], patterns: Sequence[Pattern]) -> StillDevices:
    """Devices before a scene, to which a sequence of patterns : (h, w) will be shown; InputError if there is no such scene."""
    rig = settings.rig
    still = StillScene(rig, build_scene(scene), known_to_scene(patterns, rig), settings.tracing, settings.seed)
    return _devices(settings, still, OneTake())


def covered(settings: StillSettings) -> StillDevices:
    """Devices whose lenses are covered."""
    return _devices(settings, EvenLight(settings.rig, 0.0), OneTake())


def before_paper(settings: StillSettings) -> StillDevices:
    """Devices before white paper that is held near the lenses."""
    return _devices(settings, EvenLight(settings.rig, 0.6), OneTake())


def without_projector(settings: StillSettings, scene: Mapping[str, object]) -> StillDevices:
    """Devices before a scene, and a black card before the projector; InputError if there is no such scene."""
    dark = settings.rig.projector.model_copy(update={"contrast": COVERED})
    rig = settings.rig.model_copy(update={"projector": dark})
    return before_scene(replace(settings, rig=rig), scene, ())


def before_board(settings: StillSettings, design: Board, patterns: Sequence[Pattern], count: int) -> StillDevices:
    """Devices before a hand that holds a board where it is asked to; InputError of one other than of dark, asymmetric circles."""
    if not isinstance(design, AsymmetricCircles) or design.white:
        raise InputError("board.kind: expected asymmetric_circles, dark ones, as the twin prints no others, found another board")
    printed = board.Config(**design.model_dump(exclude={"kind", "white", "unusual"}))
    held = HeldBoard(settings.rig, printed, known_to_board(patterns, settings.rig), settings.tracing, settings.seed)
    patience = 3  # times as often as poses are wanted, the hand holds the board: some may be refused
    return _devices(settings, held, _BoardHand(held.hold, patience * count))


def during_sweep(settings: SweepSettings, ranges: DataRanges, paced: bool = False, shots: bool = False) -> SweepDevices:
    """Devices before a hand that leads the probe, or takes one shot wherever it rests; InputError as of `plan_sweep`."""
    planned = plan_sweep(settings)
    times = planned.plan.track.times
    rests = [int(times[0]), *times[1:][np.diff(times) > 1e9 * MAX_GAP_S].tolist()] if shots else []
    turns = Turns(VirtualClock(paced), rests)
    pairs, scanner = VirtualPair(planned, ranges, turns), VirtualScanner(planned, turns)
    return SweepDevices(pairs, scanner, EachRest(turns, len(rests)) if shots else OneTake(lambda: pairs.over and scanner.over))


def _devices(settings: StillSettings, still: Still, operator: Operator) -> StillDevices:
    rig = VirtualRig(settings.rig, still, VirtualClock(settings.paced), settings.bits, settings.seed)
    return StillDevices({name: rig.camera(name) for name in settings.cameras}, rig.projector(), operator)


class _BoardHand:
    """Holds the board where it is asked to, some times at most, and then ends."""

    def __init__(self, hold: Callable[[rigid.Array], None], most: int) -> None:
        self._hold, self._left = hold, most

    def ask(self, step: Step) -> None:
        """Hold the board."""
        self._left -= 1
        if step.world_from_board is not None:
            self._hold(step.world_from_board)

    def answer(self) -> Answer:
        """`take`, or `end` after too many requests."""
        return "end" if self._left < 0 else "take"


class OneTake:
    """Takes once, and keeps what came of it, whatever is wrong with it; of a sweep, ends when its path is over."""

    def __init__(self, over: Callable[[], bool] | None = None) -> None:
        self._over, self._asked = over, 0

    def ask(self, step: Step) -> None:
        """Count the requests: the first begins, a second one follows when it has been done."""
        self._asked += 1

    def answer(self) -> Answer:
        """`take` at first, then `keep`, or `end` of a sweep as soon as it is over."""
        if self._asked < 2:
            return "take"
        if self._over is None:
            return "keep"
        return "end" if self._over() else "wait"


class EachRest:
    """Takes one shot at each rest of the probe, to which it is led while frames are awaited; then ends."""

    def __init__(self, turns: Turns, rests: int) -> None:
        self._turns, self._left = turns, rests
        self._asked, self._led = False, True

    def ask(self, step: Step) -> None:
        """Hear that another shot is to be taken."""
        self._asked = True

    def answer(self) -> Answer:
        """`take` once a request, `wait` meanwhile, `end` where it is asked for more than rests."""
        if not self._led:
            self._led = True
            self._turns.go_on()
        elif self._asked:
            self._asked = False
            if self._left == 0:
                return "end"
            self._left, self._led = self._left - 1, False
            return "take"
        return "wait"
