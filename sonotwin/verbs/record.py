"""Record a part of a capture from devices: the calibration board pose by pose, a surface under fringes, a freehand sweep, frames.

Guides at the terminal, where Enter says that something is done, k keeps it whatever is wrong with it, and e ends; and shows in a
browser, at the address that it prints, what each device sees: exposure, saturation, focus, fringes, whether the target is found,
each fault and its remedy. Each next pose of the board is chosen as the one that adds most to those so far, and its outline is
shown over camera 1's image. OUT is a capture folder, a new one or one that grows: poses are added to those that are there, sweeps
have names, a new surface takes the place of the old one only with replace=true. Frames of covered lenses (dark), of an even light
(flat) and of the scene without the projector (room), which `sonotwin identify` finds in the folder, are recorded after the
surface, by whose exposure dark and room are. Later verbs take OUT itself: capture=OUT. All that was recorded is on the disk at
once and whole, whether the command is ended by Ctrl-C, by the system or by a lost cable; give it again to go on.

`devices=virtual` has the twin stand in for every device, and for the person: `scene`, `path` and the other fields at the end of
this list say what is before them. It takes as long as rendering takes: ten seconds a sequence and pose, a second a pair of
frames, on two cores. A laboratory's own devices stand in a YAML file
that begins with `defaults: [basler]`: devices=ours.yaml.

    sonotwin record part=board patterns=paper_calibration out=outputs/session
    sonotwin record part=surface devices=basler calibration=optics.yaml out=outputs/session
    sonotwin record part=dark devices=basler out=outputs/session
    sonotwin record part=sweep name=scan purpose=volume out=outputs/session
    sonotwin record part=sweep name=wires purpose=probe shots=true scene=crosswire path=wire out=outputs/session
"""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Literal, get_args

from pydantic import Field, model_validator
from rich.console import Console

from recon.acquisition import preview_server
from recon.acquisition.board_recording import BoardPlan, record_board
from recon.acquisition.exposure_setting import Exposing
from recon.acquisition.frame_checks import Limits
from recon.acquisition.frames_recording import FramesPlan, Kind, record_frames
from recon.acquisition.guidance import Operator
from recon.acquisition.pictures import Say, Show, hidden
from recon.acquisition.recording import SURFACE, Recording, open_recording
from recon.acquisition.shot_recording import record_shots
from recon.acquisition.still_session import as_set
from recon.acquisition.surface_recording import SurfacePlan, record_surface
from recon.acquisition.sweep_recording import SweepPlan, record_sweep
from recon.acquisition.target_checks import target_judge, target_places
from recon.artwork import projected_images
from recon.board_detection.kinds.asymmetric_circles import AsymmetricCircles
from recon.board_guidance.board_room import PoseLimits
from recon.capture.board_part import FRINGE_CAMERA
from recon.capture.manifest import MANIFEST, SCANNER, Device, Purpose, SweepNameOrNone, axes_not_encoded, sweep_part
from recon.devices.interfaces import Trigger
from recon.devices.pattern_player import Pattern, Stage, Streamed, Taking, Triggered
from recon.errors import InputError, validated
from recon.model.boards import Board
from recon.model.patterns import Patterns
from recon.model.rig import Part, Positive, Rig
from recon.registry import Choice
from recon.session.tracker_settings import NetworkFields
from sonotwin.console_watch import LineConsole
from sonotwin.open_devices import AnyDevices, Host, LiveDevices, Opened, open_still, open_sweep
from sonotwin.terminal_operator import TerminalOperator
from twin.session import CAPTURE, TRUTH
from twin.shooting import FrameShooting
from twin.ultrasound.sweep_session import AnyPath
from twin.ultrasound.timed_sweep import Clocks
from twin.ultrasound.transducer import Transducer

SWEEP_EXPOSURE_S = 0.01  # of frames of a sweep, where none is given: a tenth of a millimetre of blur at 10 mm/s

SLOWER = 1000  # times as long as in life, that rendering may take


class PreviewFields(Part):
    """Where the page is served."""

    serve: bool = True
    """a page with the images of all devices, and what is wrong with them"""
    host: Host = preview_server.LOOPBACK
    """this computer alone sees it; another address shows it to the network, to everybody there"""
    port: Annotated[int, Field(ge=0, le=65535)] = 0
    """0: any that is free; the address is printed"""


class Triggering(Part):
    """How pattern and exposure come together."""

    by: Trigger = "software"
    """of a board or a surface: software; free; hardware: by wire, with each image of the projector's display"""
    wait_frames: Annotated[int, Field(ge=0, le=100)] = 1
    """frames left out after a new pattern, unless by software: see docs/live-projector.md"""
    timeout_s: Positive = 2.0
    """s, after which a frame counts as lost"""

    @property
    def taking(self) -> Taking:
        """The player's way to take images."""
        if self.by == "software":
            return Triggered(self.timeout_s)
        return Streamed(self.wait_frames, self.by, self.timeout_s)


class Config(NetworkFields):
    """Fields of `sonotwin record`."""

    rig: Annotated[Rig, Choice("meza2021")]
    """rig.target is looked for in the frames of a sweep; of virtual devices, the instruments themselves"""
    devices: Annotated[AnyDevices, Choice("virtual")]
    """virtual: the twin; basler: two cameras, a projector, a scanner; a YAML file of your own for those of a laboratory"""
    patterns: Annotated[Patterns, Choice("paper_surface")]
    """what the projector shows; of a board along both axes, such as paper_calibration"""
    part: Literal["board", "surface", "dark", "flat", "room", "sweep"]
    """board, surface or sweep; or frames for identify: dark (covered lenses), flat (an even light), room (no projector)"""
    out: Path
    """the capture folder, a new one or one that grows"""
    cameras: Annotated[list[Literal["cam1", "cam2"]], Field(min_length=1, default=["cam1", "cam2"])]
    """of a board or a surface: which cameras take images; of a sweep both do"""
    calibration: Path | None = None
    """file: cameras and projector, copied into the capture"""
    probe: Path | None = None
    """file: the probe's calibration, copied into the capture"""
    replace: bool = False
    """true: a surface or frames take the place of those that are there; the truth beside a rendered one won't fit any more"""
    board: Board = AsymmetricCircles(columns=4, rows=11, spacing_mm=15.0, diameter_mm=9.0)
    """the calibration board's design: kind, columns, rows and lengths, see docs/captures.md"""
    count: Annotated[int, Field(ge=1, le=1000)] = 12
    """poses of the board that are recorded, unless ended before; those of an earlier run come on top"""
    reach: PoseLimits = PoseLimits()
    """of the poses of the board that are asked for, by which that one is chosen that adds most"""
    name: SweepNameOrNone = ""
    """of a sweep, where a capture is to hold several, such as wires, bottom, scan"""
    purpose: Purpose | None = None
    """of a sweep: probe (crossed wires), latency (a flat bottom), volume (what is to be seen)"""
    seconds: Positive | None = None
    """s between a device's first and newest frame by their time stamps, after which a sweep ends; null: when it is ended"""
    shots: bool = False
    """of a sweep: true takes shots of a probe at rest, one at a key, such as to calibrate it; another key deletes the last"""
    most_moved_px: Positive = 1.0
    """px, of the target's circles from the frames before a shot's B-scan to those after it: beyond, the probe moved"""
    silent_s: Positive = 5.0
    """s without a frame, after which a device counts as gone"""
    exposing: Exposing = Exposing()
    """of the cameras"""
    triggering: Triggering = Triggering()
    """by which a pattern and its images come together"""
    limits: Limits = Limits()
    """beyond which a frame is said to have a fault"""
    preview: PreviewFields = PreviewFields()
    """of what the devices see"""
    scene: Annotated[dict, Choice("breast")]
    """of virtual devices: what lies before them"""
    ultrasound: Annotated[Transducer, Choice("linear")]
    """of virtual devices: the array and the scanner"""
    path: Annotated[AnyPath | None, Choice("stroke")]
    """of virtual devices: how the probe is led"""
    tracing: Annotated[dict, Choice("default")]
    """of virtual devices: how light is traced"""
    clocks: Clocks = Clocks()
    """of virtual devices"""
    frames: FrameShooting = FrameShooting()
    """of virtual devices: frames of a sweep"""
    seed: Annotated[int, Field(ge=0, lt=2**32)] = 0
    """of the poses to choose from; of virtual devices, of noise, hand, tissue: the same gives the same images"""

    @model_validator(mode="after")
    def _fits(self) -> "Config":
        if self.part == "board" and (lacking := axes_not_encoded(self.patterns)):
            found = f"none along {' and '.join(lacking)}"
            raise ValueError(f"patterns: expected fringes or Gray code along both axes of a board, found {found}")
        if self.part == "board" and FRINGE_CAMERA not in self.cameras:
            raise ValueError(
                f"cameras: expected {FRINGE_CAMERA}, which sees the fringes of a board, found {', '.join(self.cameras)}"
            )
        if self.shots and (self.part != "sweep" or self.seconds is not None):
            found = f"part={self.part}" if self.part != "sweep" else f"seconds={self.seconds:g}"
            raise ValueError(f"shots: expected with part=sweep, and without seconds, found {found}")
        return self

    @model_validator(mode="after")
    def _bits_of_the_sensor(self) -> "Config":
        if isinstance(self.devices, LiveDevices) or self.part == "sweep":
            return self
        bits = self.devices.bits
        for camera in self.cameras:
            if bits > (adc := getattr(self.rig, camera).sensor.adc_bits):
                raise ValueError(f"devices.bits: expected at most the {adc} of rig.{camera}.sensor.adc_bits, found {bits}")
        return self


def run(config: Config) -> None:
    """Record, and say what was kept."""
    console = LineConsole()
    with open_recording(config.out, Path(os.path.realpath(config.out)).name) as recording:
        check_place(config, recording)
        console.print(f"devices     {in_words(config.devices)}", markup=False)
        with shown(config, console) as (say, show):
            record = sweep if config.part == "sweep" else still
            record(config, recording, console, say, show)
    if config.out.is_dir():  # nothing is left where nothing was kept
        console.print(f"wrote       {config.out}", markup=False)


def in_words(devices: AnyDevices) -> str:
    """Who records: cameras by their numbers, or the twin."""
    if not isinstance(devices, LiveDevices):
        return "virtual: a rendered rig, nothing is recorded from hardware"
    others = [name for name in ("projector", "scanner") if getattr(devices, name) is not None]
    return f"live: {', '.join([*(f'{name} {camera.serial}' for name, camera in devices.cameras.items()), *others])}"


def check_place(config: Config, recording: Recording) -> None:
    """Check, before anything is opened, that the part has a place in the capture; InputError else."""
    if config.part == "sweep":
        recording.check_new(sweep_part(config.name))
    if config.part == "board":
        recording.check_board(config.board, config.patterns)
    truth = recording.folder.parent / TRUTH / SURFACE
    if config.part == "surface" and recording.contents.surface and not config.replace:
        rendered = recording.folder.name == CAPTURE and truth.is_dir()
        found = f"found that of {recording.surface_day}"
        found += f", and {truth}, which a recorded one wouldn't fit" if rendered else ""
        raise InputError(f"{recording.folder}: surface: expected none yet, {found}; give another out=FOLDER, or replace=true")
    if config.part in get_args(Kind):
        exposures(config, recording)
        for place in (recording.folder / config.part / camera for camera in config.cameras):
            if place.is_dir() and not config.replace:
                raise InputError(f"{place}: expected none yet, found a folder; give another out=FOLDER, or replace=true")


def exposures(config: Config, recording: Recording) -> dict[str, Device]:
    """The cameras as fringes, or else a board, were taken; InputError if there is neither."""
    for part in ("surface", "board"):
        if getattr(recording.contents, part) is not None:
            found = recording.contents.devices_of(part)
            lacking = [name for name in config.cameras if name not in found or found[name].exposure_s is None]
            if not lacking:
                return {name: found[name] for name in config.cameras}
            raise InputError(
                f"{recording.folder / MANIFEST}: expected exposure_s of {lacking[0]}, as frames are exposed, found none"
            )
    expected = f"expected a surface or a board, as {config.part} frames are exposed"
    raise InputError(f"{recording.folder / MANIFEST}: {expected}, found neither; record part=surface first")


def check_bits(plan: FramesPlan, opened: Opened, recording: Recording) -> None:
    """Check that frames will have the bits of the images that they belong to; InputError else."""
    for name, device in plan.devices.items():
        if (bits := opened.cameras[name].bits) != device.bits:
            expected = f"expected {device.bits}, as {name} took {recording.folder}"
            raise InputError(f"devices.bits: {expected}, found {bits}: {plan.kind} frames are compared with it")


@contextmanager
def shown(config: Config, console: Console) -> Iterator[tuple[Say, Show]]:
    """Where lines and pictures go: to the terminal, and to the page if it is served."""
    if not config.preview.serve:
        yield (lambda text: console.print(f"{config.part:11} {text}", markup=False)), hidden
        return
    preview = preview_server.Preview()

    def say(text: str) -> None:
        console.print(f"{config.part:11} {text}", markup=False)
        preview.say(text)

    with preview_server.served(preview, config.preview.host, config.preview.port) as address:
        console.print(f"preview     {address}", markup=False)
        yield say, preview.show


def still(config: Config, recording: Recording, console: Console, say: Say, show: Show) -> None:
    """Record a board, a surface, or frames."""
    patterns = list(projected_images.images(config.patterns))
    if config.part == "surface" and recording.contents.surface:
        say(f"replaces the surface of {recording.surface_day}, which stays until the new one is whole")
    with still_devices(config, patterns, console) as (opened, operator):
        assert opened.projector is not None
        calibrations(
            config,
            recording,
            {name: camera.size for name, camera in opened.cameras.items()} | {"projector": opened.projector.size},
        )
        stage = Stage(opened.projector, opened.cameras, config.triggering.taking)
        if config.part == "surface":
            plan = SurfacePlan(config.patterns, patterns, config.exposing, config.limits)
            kept = record_surface(recording, stage, operator, plan, say, show)
            say(f"kept {config.patterns.count} images of {' and '.join(opened.cameras)}" if kept else "nothing kept")
        elif config.part in ("dark", "flat", "room"):
            plan = FramesPlan(config.part, exposures(config, recording))
            check_bits(plan, opened, recording)
            kept = record_frames(recording, stage, operator, plan, say, show)
            say(f"kept frames of {' and '.join(opened.cameras)}" if kept else "nothing kept")
        else:
            fields = {name: getattr(config, name) for name in ("board", "patterns", "exposing", "limits", "rig", "reach", "seed")}
            names = record_board(recording, stage, operator, BoardPlan(shown=patterns, poses=config.count, **fields), say, show)
            say(f"kept {len(names)} poses")


@contextmanager
def still_devices(config: Config, patterns: list[Pattern], console: Console) -> Iterator[tuple[Opened, Operator]]:
    """Cameras and projector, and who works before them."""
    names = list(dict.fromkeys(config.cameras))
    if isinstance(config.devices, LiveDevices):
        with open_still(config.devices, names) as opened:
            yield opened, TerminalOperator(console)
        return
    from twin.devices import virtual_session  # loads the ray tracer
    from twin.optics.light_transport import Tracing

    tracing = validated(Tracing, config.tracing, "record: tracing")
    settings = virtual_session.StillSettings(config.rig, tracing, names, config.devices.bits, config.devices.paced, config.seed)
    with console.status("setting up the scene"):
        if config.part == "surface":
            virtual = virtual_session.before_scene(settings, config.scene, patterns)
        elif config.part == "dark":
            virtual = virtual_session.covered(settings)
        elif config.part == "flat":
            virtual = virtual_session.before_paper(settings)
        elif config.part == "room":
            virtual = virtual_session.without_projector(settings, config.scene)
        else:
            virtual = virtual_session.before_board(settings, config.board, patterns, config.count)
    yield Opened(virtual.cameras, virtual.projector), virtual.operator


def sweep(config: Config, recording: Recording, console: Console, say: Say, show: Show) -> None:
    """Record a sweep."""
    exposure_s = config.exposing.exposure_s or SWEEP_EXPOSURE_S
    silent_s = config.silent_s * (1 if isinstance(config.devices, LiveDevices) else SLOWER)
    triggers = config.devices.sweep_triggers if isinstance(config.devices, LiveDevices) else ("hardware", "hardware")
    plan = SweepPlan(config.name, config.purpose, triggers, config.seconds, silent_s, config.limits)
    networks = config.load_networks(config.rig.target.kind, threads=1)
    judge = target_judge(networks, config.rig.target)
    with sweep_devices(config, exposure_s, console) as (opened, operator, cameras):
        devices = dict(cameras)
        calibrations(config, recording, {name: device.size for name, device in devices.items()})
        if opened.scanner is not None:
            devices[SCANNER] = Device(size=opened.scanner.size)
        judges = dict.fromkeys(cameras, judge)
        if not config.shots:
            record_sweep(recording, opened.pairs, opened.scanner, devices, operator, plan, judges, say, show)
            return
        if opened.pairs is None or opened.scanner is None:
            raise InputError("shots: expected two cameras and a scanner among the devices, found one of them missing")
        most, places = config.most_moved_px, target_places(networks, config.rig.target)
        record_shots(recording, opened.pairs, opened.scanner, devices, operator, plan, most, judges, places, say, show)


Cameras = dict[str, Device]  # by name, as they are set


@contextmanager
def sweep_devices(config: Config, exposure_s: float, console: Console) -> Iterator[tuple[Opened, Operator, Cameras]]:
    """Both cameras and the scanner, who leads the probe, and the cameras as they are set."""
    if isinstance(config.devices, LiveDevices):
        with open_sweep(config.devices, exposure_s, config.exposing.gain) as opened:
            yield opened, TerminalOperator(console), as_set(opened.cameras, exposure_s, config.exposing.gain)
        return
    from sonotwin.verbs.film import ranges
    from twin.devices import virtual_session
    from twin.filmed_sweep import SweepSettings

    brighter = exposure_s * config.exposing.gain / (config.frames.exposure_s * config.frames.gain)
    frames = config.frames.model_copy(
        update={"exposure_s": exposure_s, "gain": config.exposing.gain, "white_dn": config.frames.white_dn * brighter}
    )
    fields = {field: getattr(config, field) for field in ("rig", "scene", "ultrasound", "path", "clocks", "name", "seed")}
    settings = validated(SweepSettings, fields | {"filmed": True, "frames": frames}, "record")
    with console.status("setting up the scene"):
        virtual = virtual_session.during_sweep(settings, ranges(), config.devices.paced, config.shots)
    yield Opened(scanner=virtual.scanner, pairs=virtual.pairs), virtual.operator, dict(virtual.pairs.devices())


def calibrations(config: Config, recording: Recording, sizes: dict[str, tuple[int, int]]) -> None:
    """Copy the calibrations that are given."""
    if config.calibration is not None:
        recording.add_calibration(config.calibration, sizes)
    if config.probe is not None:
        recording.add_probe(config.probe)
