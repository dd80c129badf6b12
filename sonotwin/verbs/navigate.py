"""Follow the probe and tools live: the B-scan in place, skin and masses around it, in the browser and in 3D Slicer.

Takes frames of both cameras and B-scans from the devices of conf/devices, or from a capture that is played back in real time;
tracks the target, and shows where the probe and its image are, within the measured skin and the masses that were found before;
and how far the image's plane is from each mass. A page in the browser shows it all, and an OpenIGTLink server sends it. The
latency from the exposure to the published pose is measured and shown. A device that is lost is opened again every second. Goes on
until it is interrupted, or for some seconds. Writes nothing, but for a table with record=FILE.

Further bodies of the rig are followed, too. A tool's tip is measured against masses, a planned path and the B-scan's plane. With
a body called patient all is told as it stood at reference=FILE: skin, masses and plan are of that world.

    sonotwin navigate capture=session/capture skin=result/surface/surface.ply masses=result/masses/scan lag_s=0.05
    sonotwin navigate devices=basler calibration=optics.yaml probe=probe.yaml skin=surface.ply masses=masses lag_s=0.05
    sonotwin navigate capture=session/capture rig=three_bodies tips.needle=tip.yaml reference=reference.csv masses=masses
"""

from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path
from time import monotonic, sleep
from typing import Annotated, NamedTuple

import numpy as np
from pydantic import Field, field_validator
from rich.console import Console

from recon.capture import calibration_files, probe_files, tip_files
from recon.capture.manifest import CAMERAS, SCANNER
from recon.devices import playback
from recon.devices.device_clocks import ClockFollower
from recon.devices.interfaces import DeviceError, Size
from recon.devices.openigtlink.igtl_server import PORT, Server
from recon.errors import InputError, did_you_mean
from recon.model.part import Vector
from recon.model.probe import ProbeCalibration, Speed
from recon.model.rig import PATIENT, PROBE, Part
from recon.model.tip import Tip
from recon.model.tracks import LagSeconds, Track
from recon.navigation import mass_distances, still_scene, tool_distances
from recon.navigation.browser_view import LOOPBACK, BrowserView
from recon.navigation.feeds import Device, FollowedClock
from recon.navigation.moving_bodies import MovingBodies
from recon.navigation.navigation_record import RecordTable
from recon.navigation.navigator import Navigator, warm_up
from recon.navigation.publishing import Publisher, StillScene
from recon.navigation.seen_so_far import Mapper, RunningMap
from recon.navigation.slicer_publisher import IgtlSender, SlicerPublisher
from recon.navigation.tool_figures import Alarms
from recon.probe_calibration import sound_in_water
from recon.session import poses_step
from recon.session.settings import SoughtFields
from recon.session.tracker_settings import BodyFields, make_rig_tracker, targets_of
from recon.tracking.bodies import BodyTracker
from recon.tracking.tracker import Tracker
from sonotwin import live_sources
from sonotwin.console_watch import LineConsole
from sonotwin.live_sources import LiveFields, View, given_or_held
from sonotwin.open_devices import Host, LiveDevices, open_scanner

LOOK_S = 0.2  # between two looks whether all goes on
SEARCH_S = 0.2  # between two searches for bodies that are lost; each pair takes a part of one
PLAN_MM = 1.0, 1000.0  # least and most from a planned path's entry to its aim: others are in another unit


class Igtl(Part):
    """The OpenIGTLink server."""

    serve: bool = True
    """false: none, where nobody watches in 3D Slicer, or PLUS has its port"""
    host: Host = LOOPBACK
    """likewise; the protocol knows no password either"""
    port: Annotated[int, Field(ge=0, le=65535)] = PORT
    """of TCP: the one registered for OpenIGTLink; give another beside a PlusServer; 0 takes any that is free"""


class Config(LiveFields, BodyFields, SoughtFields):
    """Fields of `sonotwin navigate`."""

    probe: Path | None = None
    """file: the probe's calibration, in place of the capture's own"""
    lag_s: LagSeconds = 0.0
    """s, delay of the B-scans' time stamps, as of `sonotwin measure-lag`"""
    tissue_m_s: Speed | None = None
    """m/s, of sound in what is scanned; null leaves depths as the probe is calibrated"""
    skin: Path | None = None
    """the skin, as of `sonotwin surface`, a .ply"""
    part_table: bool = True
    """leave out the plane that the skin stands on; false shows all of the surface"""
    masses: Path | None = None
    """folder of `sonotwin segment`"""
    reference: Path | None = None
    """file: the pose of the body `patient` at which skin and masses were measured, reference.csv of `sonotwin track`; null: its
    first one, which is said"""
    tips: dict[str, Path] = Field(default_factory=dict)
    """files of `sonotwin calibrate-tip` by names of rig.bodies: tips.needle=FILE"""
    plan: tuple[Vector, Vector] | None = None
    """mm in the world, a path's entry and aim: [[x,y,z],[x,y,z]]"""
    alarm: Alarms = Alarms()
    """when a tool's row on the page is an alarm"""
    unseen: bool = True
    """show what is still to be scanned: under the skin, or around what was touched; false: not"""
    record: Path | None = None
    """table, a new .csv: each moment's poses of all bodies, and tools' figures"""
    view: View = View()
    """the page in the browser"""
    igtl: Igtl = Igtl()
    """the OpenIGTLink server, for 3D Slicer"""
    seconds: Annotated[float, Field(gt=0)] | None = None
    """s, after which it ends; null goes on until Ctrl-C"""

    @field_validator("plan")
    @classmethod
    def _two_points(cls, given: tuple[Vector, Vector] | None) -> tuple[Vector, Vector] | None:
        least, most = PLAN_MM
        if given is not None and not least <= (apart := np.linalg.norm(np.subtract(*given))) <= most:
            raise ValueError(f"expected an entry and an aim {least:g} to {most:g} mm apart, found {apart:.3g} mm")
        return given


class Sources(NamedTuple):
    """Devices, and what is known of them before they are opened."""

    cam1: Device
    cam2: Device
    scanner: Device | None
    sizes: dict[str, Size]  # of the cameras
    bits: int  # of their digital numbers
    width: int  # of the B-scans, px


def run(config: Config) -> int:
    """Navigate until interrupted, or for some seconds; returns 1 if a part of it ended by itself.

    Raises
    ------
    InputError
        If the capture is incomplete or damaged, a calibration or a network is missing, or a port is taken.
    """
    console = LineConsole()
    sources = sources_of(config)
    probe = probe_of(config)
    tools, reference = tools_of(config), reference_of(config)
    plan = None if config.plan is None else np.array(config.plan)
    tracker = tracker_of(config, sources.sizes, sources.bits)
    target = tracker.trackers[PROBE].target if isinstance(tracker, BodyTracker) else tracker.target
    with console.status("reading skin and masses"):
        scene = still_scene.read_scene(config.skin, config.masses, target, probe, sources.width, config.part_table, tools, plan)
    with console.status("getting ready to track"):
        warm_up(tracker)
    masses = mass_distances.bodies_of(scene.masses)
    measured = masses if any(tools.values()) else {}
    surfaces = {name: tool_distances.surface_of(mass.vertices, mass.faces) for name, mass in measured.items()}
    moving = MovingBodies(tools, surfaces, plan, reference)
    publishers, recorders = publishers_of(config, scene, console)
    cameras = sources.cam1, sources.cam2
    more = {"moving": moving, "recorders": recorders, "mapper": mapper_of(config, scene, probe)}
    navigator = Navigator(cameras, sources.scanner, tracker, probe, config.lag_s, masses, publishers, **more)
    try:
        navigator.start()
        until = monotonic() + (config.seconds or float("inf"))
        while navigator.running and monotonic() < until:
            sleep(LOOK_S)
        return int(not navigator.running)
    finally:
        navigator.stop()
        tell(navigator, console)


def mapper_of(config: Config, scene: StillScene, probe: ProbeCalibration) -> Mapper | None:
    """The map of what was seen, for the mass that is sought; None where it isn't to be shown."""
    return Mapper(RunningMap(scene.skin, config.sought, face_row=probe.face_row)) if config.unseen else None


def publishers_of(config: Config, scene: StillScene, console: Console) -> tuple[list[Publisher], list[Publisher]]:
    """Open the page and the OpenIGTLink server, and begin the record; if one is refused, none of them stays open."""
    with ExitStack() as stack:
        slicer: list[Publisher] = []
        told: list[str] = []
        if config.igtl.serve:
            server = opened_server(config.igtl)
            stack.callback(server.close)
            told.append(f"OpenIGTLink {config.igtl.host}:{server.port}")
            slicer = [SlicerPublisher(scene, IgtlSender(server), config.alarm)]
        view = BrowserView(scene, config.view.port, config.view.host, config.alarm)
        stack.callback(view.close)
        record: list[Publisher] = []  # last, as it leaves a file
        if config.record is not None:
            record = [RecordTable(config.record, list(config.rig.bodies), list(scene.masses))]
            told.append(f"record      {config.record}")
        for line in (f"view        {view.address}", *told):
            console.print(line, markup=False)
        stack.pop_all()  # they are the navigator's now
        return [view, *slicer], record


def tools_of(config: Config) -> dict[str, Tip | None]:
    """Tips of the rig's bodies besides probe and patient by name; None of one that isn't calibrated.

    Raises
    ------
    InputError
        As of `recon.capture.tip_files.read`, or if a tip is of no such body.
    """
    names = [name for name in config.rig.bodies if name != PATIENT]
    for name, path in config.tips.items():
        if name not in names:
            expected = f"a tool of rig.bodies, {', '.join(names)}" if names else "none, as rig.bodies names no tool"
            raise InputError(f"tips.{name}: expected {expected}, found {path}{did_you_mean(name, names)}")
    return {name: tip_files.read(config.tips[name], name) if name in config.tips else None for name in names}


def reference_of(config: Config) -> Track | None:
    """The patient's pose at which skin and masses were measured; InputError if there is no such body, or no pose in the file."""
    if config.reference is None:
        return None
    if PATIENT not in config.rig.bodies:
        raise InputError(f"reference: expected none without the body {PATIENT} in rig.bodies, found {config.reference}")
    return poses_step.read_reference(config.reference).pose


def opened_server(chosen: Igtl) -> Server:
    """Open the OpenIGTLink server; DeviceError if it can't listen there."""
    try:
        return Server(chosen.host, chosen.port)
    except DeviceError as error:
        raise DeviceError(f"{error}; give another igtl.port, of which 0 is any that is free, or another igtl.host") from None


def tell(navigator: Navigator, console: Console) -> None:
    """Print how often and how late each publisher was, at last."""
    for outlet in navigator.outlets:
        if (late := outlet.latencies.figures()) is not None:
            figures = f"{late.median_ms:.0f} ms after the exposure, 99 % within {late.high_ms:.0f} ms"
            console.print(f"{outlet.publisher.name:11} {late.rate_hz:.1f} poses a second, {figures}", markup=False)


def sources_of(config: Config) -> Sources:
    """The devices, or the capture that takes their place."""
    if config.devices is not None:
        return opened(config, config.devices)
    assert config.capture is not None  # one of both is given
    return played(config, config.capture)


def probe_of(config: Config) -> ProbeCalibration:
    """The probe's calibration, for the tissue: from its file, else from the capture."""
    path = given_or_held(config.probe, config.capture, "probe", "the probe's calibration", "navigate")
    return sound_in_water.for_tissue(probe_files.read(path), config.tissue_m_s)


def tracker_of(config: Config, sizes: Mapping[str, Size], bits: int) -> Tracker | BodyTracker:
    """The tracker, by the calibration of cameras of some sizes: from its file, else from the capture."""
    path = given_or_held(config.calibration, config.capture, "calibration", "the cameras' calibration", "navigate")
    known = calibration_files.read_for(path, sizes)
    cameras, deep = (known.cameras[CAMERAS[0]], known.cameras[CAMERAS[1]]), bits if bits > 8 else None
    return make_rig_tracker(config, targets_of(config), cameras, known.uncertainty, deep, SEARCH_S)


def played(config: Config, capture: Path) -> Sources:
    """Both cameras and the scanner of a capture, played back by one timeline."""
    recorded = playback.read_recording(capture, config.sweep)
    devices = live_sources.played(recorded, config)
    sizes, bits = live_sources.sizes_of(recorded, CAMERAS)
    return Sources(devices[CAMERAS[0]], devices[CAMERAS[1]], devices[SCANNER], sizes, bits, recorded[SCANNER].size[0])


def opened(config: Config, devices: LiveDevices) -> Sources:
    """A laboratory's devices, opened when they are used, and again after a loss."""
    cameras = live_sources.opened(devices, CAMERAS, config)
    chosen = devices.scanner
    scanner = (
        None
        if chosen is None
        else Device(SCANNER, lambda: open_scanner(chosen), lambda source: FollowedClock(ClockFollower(SCANNER)))
    )
    sizes, bits = live_sources.sizes_of(devices, CAMERAS)
    return Sources(cameras[CAMERAS[0]], cameras[CAMERAS[1]], scanner, sizes, bits, config.rig.probe.image_size[0])
