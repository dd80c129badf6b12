"""Follow the probe live: the B-scan in place, skin and masses around it, in the browser.

Takes frames of both cameras and B-scans from a capture that is played back in real time, tracks the target, and shows where the
probe and its image are, within the measured skin and the masses that were found before; and how far the image's plane is from
each mass. A page in the browser shows it all. The latency from the exposure to the published pose is measured and shown. A device
that is lost is opened again every second. Goes on until it is interrupted, or for some seconds. Writes nothing.

    sonotwin navigate capture=session/capture skin=result/surface/surface.ply masses=result/masses/scan lag_s=0.05
"""

from collections.abc import Mapping
from pathlib import Path
from time import monotonic, sleep
from typing import Annotated

from pydantic import Field
from rich.console import Console

from recon.capture import calibration_files, manifest, probe_files, target_files
from recon.capture.manifest import CAMERAS, SCANNER
from recon.devices import playback
from recon.devices.interfaces import Size
from recon.devices.playback import PlayedCamera, PlayedScanner, Recorded
from recon.errors import InputError
from recon.model.calibration import DRIFT_PX, PRINT_SCALE, in_use
from recon.model.probe import ProbeCalibration, Speed
from recon.model.rig import Part, Rig
from recon.model.tracks import LagSeconds
from recon.navigation import mass_distances, still_scene
from recon.navigation.browser_view import LOOPBACK, BrowserView
from recon.navigation.feeds import Device
from recon.navigation.navigator import Navigator, warm_up
from recon.probe_calibration import sound_in_water
from recon.tracking import networks
from recon.tracking.tracker import Tracker

LOOK_S = 0.2  # between two looks whether all goes on


class View(Part):
    """The page in the browser."""

    host: str = LOOPBACK
    port: Annotated[int, Field(ge=1, le=65535)] = 8080


class Config(Part):
    """Fields of `conf/navigate.yaml`."""

    rig: Rig
    capture: Path
    sweep: str = ""
    speed: Annotated[float, Field(gt=0, le=10)] = 1.0
    calibration: Path | None = None
    drift_px: Annotated[float, Field(ge=0, le=10)] = DRIFT_PX
    board_scale: Annotated[float, Field(ge=0, le=0.1)] = PRINT_SCALE
    target: Path | None = None
    networks: Path | None = None
    threads: Annotated[int, Field(ge=0, le=1024)] = 0
    probe: Path | None = None
    lag_s: LagSeconds = 0.0
    tissue_m_s: Speed | None = None
    skin: Path | None = None
    part_table: bool = True
    masses: Path | None = None
    view: View = View()
    seconds: Annotated[float, Field(gt=0)] | None = None


def run(config: Config) -> int:
    """Navigate until interrupted, or for some seconds; returns 1 if a part of it ended by itself.

    Raises
    ------
    InputError
        If the capture is incomplete or damaged, a calibration or a network is missing, or a port is taken.
    """
    console = Console(soft_wrap=True, highlight=False)
    recorded = playback.read_recording(config.capture, config.sweep)
    probe = probe_of(config)
    tracker = tracker_of(config, {name: recorded[name].size for name in CAMERAS}, max(recorded[name].bits for name in CAMERAS))
    with console.status("reading skin and masses"):
        scene = still_scene.read_scene(
            config.skin, config.masses, tracker.target, probe, recorded[SCANNER].size[0], config.part_table
        )
    with console.status("getting ready to track"):
        warm_up(tracker)
    view = BrowserView(scene, config.view.port, config.view.host)
    cam1, cam2, scanner = played(recorded, config.speed)
    navigator = Navigator((cam1, cam2), scanner, tracker, probe, config.lag_s, mass_distances.bodies_of(scene.masses), [view])
    console.print(f"view        {view.address}", markup=False)
    navigator.start()
    try:
        until = monotonic() + (config.seconds or float("inf"))
        while navigator.running and monotonic() < until:
            sleep(LOOK_S)
        return int(not navigator.running)
    finally:
        navigator.stop()
        tell(navigator, console)


def tell(navigator: Navigator, console: Console) -> None:
    """Print how often and how late each publisher was, at last."""
    for outlet in navigator.outlets:
        if (late := outlet.latencies.figures()) is not None:
            figures = f"{late.median_ms:.0f} ms after the exposure, 99 % within {late.high_ms:.0f} ms"
            console.print(f"{outlet.publisher.name:11} {late.rate_hz:.1f} poses a second, {figures}", markup=False)


def probe_of(config: Config) -> ProbeCalibration:
    """The probe's calibration, for the tissue: from its file, else from the capture."""
    held = manifest.read_manifest(config.capture)
    if config.probe is None and held.probe is None:
        raise InputError(f"{config.capture}: expected the probe's calibration, found none; give probe=...")
    return sound_in_water.for_tissue(probe_files.read(config.probe or config.capture / str(held.probe)), config.tissue_m_s)


def tracker_of(config: Config, sizes: Mapping[str, Size], bits: int) -> Tracker:
    """The tracker, by the calibration of cameras of some sizes: from its file, else from the capture."""
    held = manifest.read_manifest(config.capture)
    if config.calibration is None and held.calibration is None:
        raise InputError(f"{config.capture}: expected the cameras' calibration, found none; give calibration=...")
    known = calibration_files.read_for(config.calibration or config.capture / str(held.calibration), sizes)
    cameras = {name: known.cameras[name] for name in CAMERAS}
    optics = in_use(known.uncertainty, cameras, config.board_scale, config.drift_px)
    design = config.rig.target
    target = design if config.target is None else target_files.read(config.target, design)
    loaded = networks.load(config.networks or networks.WEIGHTS, config.threads)
    return Tracker((cameras[CAMERAS[0]], cameras[CAMERAS[1]]), target, loaded, bits if bits > 8 else None, optics)


def played(recorded: Mapping[str, Recorded], speed: float) -> tuple[Device, Device, Device]:
    """Both cameras and the scanner, played back by one timeline."""
    line = playback.timeline_of(recorded, speed)

    def device(name: str, kind: type[PlayedCamera] | type[PlayedScanner]) -> Device:
        return Device(name, lambda: kind(recorded[name], line), lambda source: lambda frame: line.clock_of(frame.time_ns))

    cam1, cam2 = (device(name, PlayedCamera) for name in CAMERAS)
    return cam1, cam2, device(SCANNER, PlayedScanner)
