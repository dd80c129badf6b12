"""Have a colleague elsewhere draw on camera 1's picture, and light it on the skin, also of a patient who moves.

The colleague opens the address that is printed, sees camera 1's newest picture and draws strokes and texts on it. Each is cast
onto the measured skin and lit there by the projector, together with outlines of masses and a planned cut, if they are given.
Where the rig has a body `patient`, its target is followed: all stays on the skin while the patient moves, and where the target
isn't seen the projector goes dark. Writes into `out` as it goes: log.jsonl, all that was drawn, from which the same command
restores it; and of a capture that is played back, without a projector, lit.png, its newest picture. Goes on until it is
interrupted, or for some seconds.

    sonotwin mentor capture=session/capture skin=result/surface/surface.ply calibration=result/optics/optics.yaml out=mentored
    sonotwin mentor devices=basler calibration=optics.yaml skin=surface.ply rig=three_bodies reference=first out=mentored
"""

import re
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path
from time import monotonic, sleep
from typing import Annotated, Literal, NamedTuple

import cv2
import numpy as np
import trimesh
from numpy.typing import NDArray
from pydantic import Field, StringConstraints

from recon import page_server
from recon.capture import calibration_files, manifest, sweep_tables
from recon.capture.manifest import CAMERAS
from recon.devices import playback
from recon.devices.interfaces import DeviceError, Size
from recon.errors import InputError
from recon.files import atomic
from recon.fusion import skin as skin_parts
from recon.geometry.camera import Camera
from recon.mentoring import drawing_log, mentor_site
from recon.mentoring.drawing_log import DrawingLog
from recon.mentoring.drawings import Drawings
from recon.mentoring.mentor_site import MentorSite
from recon.mentoring.sightings import Follow, Sighting, Sightings, by_patient
from recon.mentoring.skin_light import Shows, SkinLight
from recon.model.calibration import Calibration
from recon.model.rig import PATIENT
from recon.navigation.feeds import Device
from recon.segmentation import containment, mass_files
from recon.session import poses_step
from recon.session.tracker_settings import BodyFields, make_body_tracker, targets_of
from recon.skin_projection import mass_outline, outline_names, planned_cut, projector_image
from recon.skin_projection.live_picture import LivePicture, Strips
from recon.skin_projection.projector_image import Lines, lit_share
from recon.skin_projection.skin_curve import SkinCurve
from recon.tracking.bodies import BodyTracker
from sonotwin import live_sources
from sonotwin.console_watch import LineConsole
from sonotwin.live_sources import LiveFields, View
from sonotwin.open_devices import open_projector

BY = "mentor"
LOG, LIT = "log.jsonl", "lit.png"
LOOK_S = 0.2  # between two looks whether all goes on
WRITE_S = 0.5  # between two pictures that are written in place of a projector
MOST_VISITORS = 4 * mentor_site.MOST_CLIENTS  # connections at once: a page asks for several things

Mentor = Annotated[str, StringConstraints(pattern=r"^[\w.-]{1,40}$")]


class Config(LiveFields, BodyFields):
    """Fields of `sonotwin mentor`."""

    skin: Path
    """the skin, as of `sonotwin surface`, a .ply"""
    out: Path
    """folder; gets log.jsonl, and lit.png without a projector. A log that is there is restored, and goes on"""
    part_table: bool = True
    """leave out the plane that the skin stands on"""
    reference: Path | Literal["first"] | None = None
    """file: the pose of the body `patient` when the skin was measured, reference.csv of `sonotwin track`; first: its first one
    now, of a patient who hasn't moved since. null: its pose in the capture's own fringe images"""
    masses: Path | None = None
    """folder of `sonotwin segment`: their outlines are lit, too, along the skin's normal over each"""
    cut: Path | None = None
    """a planned cut: curves or lines drawn in 3D Slicer, .mrk.json"""
    names_mm: Annotated[float, Field(ge=0, le=50)] = 5.0
    """mm, height of the letters of masses' names; 0 draws none"""
    lines: Lines = Lines()
    """of masses, their names and the cut: width in mm, share of the projector's full light, [drawn, left out] in mm or null"""
    hold_s: Annotated[float, Field(ge=0, le=1)] = 0.5
    """s, for which the light stays where a patient was who is no longer seen"""
    mentors: Annotated[tuple[Mentor, ...], Field(min_length=1, max_length=mentor_site.MOST_CLIENTS)] = ("mentor",)
    """who may draw: each gets an address of their own, and is named in the log"""
    view: View = View()
    """the page in the browser; with 0.0.0.0 all of the network can reach it, and who has the address can draw"""
    seconds: Annotated[float, Field(gt=0)] | None = None
    """s, after which it ends; null goes on until Ctrl-C"""


class Sources(NamedTuple):
    """Cameras, and what is known of them before they are opened."""

    cameras: list[Device]  # camera 1, or both where the patient is followed
    sizes: dict[str, Size]
    bits: int


class PictureFile:
    """Shows pictures as a file, in a folder that is filled as it goes: some a second, whatever comes."""

    def __init__(self, folder: Path) -> None:
        self._folder, self._written = folder, -np.inf

    def show(self, pattern: NDArray[np.uint8]) -> None:
        """Write a picture : (h, w), unless the last one was written just now."""
        if monotonic() - self._written > WRITE_S:
            self._written = monotonic()
            with atomic.listed_file(self._folder, LIT, BY) as temporary:
                temporary.write_bytes(cv2.imencode(".png", pattern)[1].tobytes())


def run(config: Config) -> int:
    """Light what is drawn until interrupted, or for some seconds; returns 1 if a part of it ended by itself.

    Raises
    ------
    InputError
        If a file is missing or damaged, the log in `out` is of another skin, or a port is taken.
    DeviceError
        If the projector's display isn't there, or goes.
    """
    console = LineConsole()
    given = (config.skin, config.calibration, config.masses, config.cut, config.capture)
    atomic.check_filled_folder(config.out, BY, inputs=given)
    names = CAMERAS if PATIENT in config.rig.bodies else CAMERAS[:1]
    sources = sources_of(config, names)
    known = calibration_of(config, sources.sizes)
    camera, projector = known.cameras[CAMERAS[0]], known.cameras["projector"]
    with console.status("reading"):
        skin = read_skin(config)
        still = [(curve, config.lines.of(curve)) for curve in still_curves(config, skin, projector)]
        drawings = restored(config)
    with console.status("getting ready to track"):
        follow = None if len(names) == 1 else follower(config, known, sources.bits)
    with ExitStack() as stack:
        shows, delay_s = stack.enter_context(opened(config))
        server = page_server.listen("view", config.view.host, config.view.port, MOST_VISITORS)
        stack.callback(server.server_close)
        log = stack.enter_context(closing(begun(config)))
        strips = Strips.joined([Strips.of(curve, line) for curve, line in still])
        picture = LivePicture(skin, projector, config.rig.projector.gamma)
        light = SkinLight(picture, strips, drawings, shows, None if follow is None else config.hold_s, delay_s)

        def say(words: str) -> None:
            console.print(f"mentor      {words}", markup=False)

        tokens = mentor_site.new_tokens(config.mentors)
        site = MentorSite(skin, camera, sources.bits, drawings, log, tokens, lambda: light.state.words, say)

        def deliver(sighting: Sighting) -> None:
            site.offer(sighting)
            light.sightings.put(sighting)

        sightings = Sightings(sources.cameras, follow, deliver)
        address = stack.enter_context(server.serving(site))
        for name, token in tokens.items():
            console.print(f"view        {name}: {address}{token}/", markup=False)
        if len(drawings):
            console.print(f"restored    {len(drawings)} drawings of {config.out / LOG}", markup=False)
        stack.callback(tell, light, console)
        for each in (light, sightings):
            stack.callback(each.stop)
            each.start()
        watch(config, light, sightings, log, console)
        if light.fault is not None:
            raise light.fault
        return int(not (light.alive and sightings.running))


def watch(config: Config, light: SkinLight, sightings: Sightings, log: DrawingLog, console: LineConsole) -> None:
    """Wait for the end, and say when the light comes and goes."""
    until, told = monotonic() + (config.seconds or float("inf")), ""
    while light.alive and sightings.running and monotonic() < until:
        words = light.state.words
        kind = ":".join(re.sub(r"[\d.]+", "", words).split(":")[:2])  # not each age, nor all of a reason
        if kind != told:
            told = kind
            console.print(f"light       {words}", markup=False)
            log.noted(words)
        sleep(LOOK_S)


def tell(light: SkinLight, console: LineConsole) -> None:
    """Print how fast and how late it was."""
    drawn = f"{light.pictures} pictures, {1e3 * light.drawing_s / max(light.pictures, 1):.1f} ms of a core each"
    late = light.latencies.figures()
    figures = "" if late is None else (
        f", {late.rate_hz:.1f} a second, lit {late.median_ms:.0f} ms after the exposure, 99 % within {late.high_ms:.0f} ms"
    )  # fmt: skip
    console.print(f"projector   {drawn}{figures}", markup=False)


def sources_of(config: Config, names: tuple[str, ...]) -> Sources:
    """The cameras of these names, or the capture that takes their place."""
    if config.devices is not None:
        cameras, source = live_sources.opened(config.devices, names, config), config.devices
    else:
        assert config.capture is not None  # one of both is given
        source = playback.read_recording(config.capture, config.sweep, names)
        cameras = live_sources.played(source, config)
    return Sources([cameras[name] for name in names], *live_sources.sizes_of(source, names))


def calibration_of(config: Config, sizes: Mapping[str, Size]) -> Calibration:
    """The calibration of the cameras in use, and of the projector."""
    path = live_sources.given_or_held(config.calibration, config.capture, "calibration", "the devices' calibration", BY)
    projector = config.devices.projector if config.devices is not None else None
    known = calibration_files.read_for(path, sizes if projector is None else {**sizes, "projector": projector.size})
    if "projector" not in known.cameras:
        found = ", ".join(known.cameras)
        raise InputError(f"{path}: expected the projector, too, found {found}; give calibration=FILE of the whole rig")
    return known


def read_skin(config: Config) -> trimesh.Trimesh:
    """The skin, parted from the plane that it stands on if it is to be."""
    whole = containment.read_skin(config.skin)
    return (skin_parts.by_plane(whole).skin or whole) if config.part_table else whole


def still_curves(config: Config, skin: trimesh.Trimesh, projector: Camera) -> list[SkinCurve]:
    """Outlines of masses with their names, and the planned cut, on the skin."""
    found = {} if config.masses is None else mass_files.read_masses(config.masses)
    masses = {name: mass.mesh for name, mass in found.items()}
    chains = [] if config.cut is None else planned_cut.read(config.cut)
    curves = [*mass_outline.outlines(masses, skin).values()]
    curves += [planned_cut.on_skin(f"cut{k}", chain, skin) for k, chain in enumerate(chains)]
    if not config.names_mm:
        return curves

    def reached(name: SkinCurve) -> bool:
        return lit_share(name, projector_image.in_sight([name], skin, projector)) == 1

    return curves + outline_names.beside(curves, masses, skin, None, config.names_mm, reached)


def follower(config: Config, known: Calibration, bits: int) -> Follow:
    """Where the patient carries the skin."""
    cameras = known.cameras[CAMERAS[0]], known.cameras[CAMERAS[1]]
    tracker = make_body_tracker(config, targets_of(config), cameras, known.uncertainty, bits if bits > 8 else None)
    alone = BodyTracker({PATIENT: tracker.trackers[PATIENT]}, further=False)
    reference = reference_of(config, alone)
    return by_patient(alone, reference)


def reference_of(config: Config, tracker: BodyTracker) -> NDArray[np.float64] | None:
    """The patient's pose : (4, 4) mm when the skin was measured; None to take the first one.

    Raises
    ------
    InputError
        If it isn't known.
    """
    if config.reference == "first":
        return None
    if config.reference is not None:
        given = sweep_tables.read_track(config.reference)
        if not given.found.any():
            raise InputError(f"{config.reference}: expected a pose of the {PATIENT}, found none")
        return given.poses[int(np.argmax(given.found))]
    way = "give reference=FILE, reference.csv of `sonotwin track`, or reference=first if the patient hasn't moved since"
    held = None if config.capture is None else manifest.read_manifest(config.capture).surface
    if config.capture is None or held is None or not set(CAMERAS) <= held.images.keys():
        raise InputError(f"{BY}: reference: expected the pose of the {PATIENT} when the skin was measured, found none; {way}")
    found = tracker.step(*(poses_step.mean_image(config.capture, name, config.calibration) for name in CAMERAS))[PATIENT]
    tracker.forget()
    if not found.found:
        expected = f"expected the target of the {PATIENT} in the fringe images of both cameras, found none"
        raise InputError(f"{config.capture}: surface: {expected}: {found.pose.reason}; {way}")
    return found.pose.world_from_target


def restored(config: Config) -> Drawings:
    """What an earlier run into the same folder left lit."""
    if not (config.out / LOG).exists():
        return Drawings()
    atomic.check_listed(config.out, LOG, BY)
    return drawing_log.restore(config.out / LOG, config.skin)


def begun(config: Config) -> DrawingLog:
    """The log, begun or to go on."""
    atomic.begin_filled(config.out, BY)
    if not (config.out / LOG).exists():
        with atomic.listed_file(config.out, LOG, BY, grows=True) as temporary:
            drawing_log.begin(temporary, config.skin)
    return DrawingLog(config.out / LOG)


@contextmanager
def opened(config: Config) -> Iterator[tuple[Shows, float]]:
    """The projector with its delay from drawing to light, or what takes its place.

    Raises
    ------
    DeviceError
        If the devices have no projector, or its display isn't there.
    """
    if config.devices is None:
        yield PictureFile(config.out), 0.0
        return
    chosen = config.devices.projector
    if chosen is None:
        raise DeviceError("devices.projector: expected one, which lights what is drawn, found none; see conf/devices")
    with closing(open_projector(chosen.model_copy(update={"delay_s": 0.0}))) as projector:  # nobody waits for the light
        yield projector, projector_delay(chosen.delay_s)


def projector_delay(given_s: float | None) -> float:
    """The delay that was measured, or the usual one."""
    from recon.devices.projector_window import DELAY_S  # loads pyglet, of the extra `live`

    return DELAY_S if given_s is None else given_s
