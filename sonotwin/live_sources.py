"""Cameras and scanner of verbs that watch live: a laboratory's devices, or a recorded sweep that is played back instead."""

from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Annotated, Any, Literal, Self, cast

from pydantic import Field, field_validator, model_validator

from recon.capture import manifest
from recon.capture.manifest import CAMERAS, SCANNER
from recon.devices import playback
from recon.devices.device_clocks import follow
from recon.devices.interfaces import Camera, Size
from recon.devices.playback import PlayedCamera, PlayedScanner, Recorded
from recon.errors import InputError
from recon.model.rig import Part, Positive
from recon.navigation.feeds import Device, FollowedClock
from recon.own_requests import LOOPBACK
from recon.registry import Choice
from sonotwin.open_devices import Host, LiveDevices, of_a_laboratory, open_camera


class View(Part):
    """The page in the browser."""

    host: Host = LOOPBACK
    """where it can be opened: on this computer alone; 0.0.0.0 lets all of the network in, without a password"""
    port: Annotated[int, Field(ge=0, le=65535)] = 8080
    """of TCP, another one for a second page, or where another program has this one; 0 takes any that is free"""


class LiveFields(Part):
    """Fields of a verb that watches live."""

    devices: Annotated[LiveDevices | None, Choice(None)] = None
    """basler: two cameras and a scanner; copy conf/devices/basler.yaml for those of a laboratory"""
    exposure_s: Positive = 0.01
    """s, of cameras among the devices"""
    gain: Positive = 1.0
    """linear; 1 is the sensor's base gain"""
    trigger: Literal["free", "hardware"] = "hardware"
    """hardware: camera 1 runs free, its exposures trigger camera 2 by a wire; free: both run free"""
    capture: Path | None = None
    """folder, instead of devices: a sweep's frames are played back in real time, round and round"""
    sweep: str = ""
    """name of the sweep with these, of a capture that holds several; "" takes the only one for the volume"""
    speed: Annotated[float, Field(gt=0, le=10)] = 1.0
    """of the playback, as a multiple of real time"""
    apart_s: Positive | None = None
    """s, by which a device of the capture may begin or end after another; null: a tenth of the sweep, and 1 s"""

    @field_validator("devices", mode="before")
    @classmethod
    def _no_stand_ins(cls, given: Any) -> Any:
        return of_a_laboratory(given, "a recorded or rendered sweep is played back by capture=FOLDER")

    @model_validator(mode="after")
    def _one_source(self) -> Self:
        if (self.capture is None) == (self.devices is None):
            raise ValueError(f"capture: expected it or devices, found {'neither' if self.capture is None else 'both'}")
        return self


def played(recorded: dict[str, Recorded], fields: LiveFields) -> dict[str, Device]:
    """Recorded devices by name, played back by one timeline."""
    line = playback.timeline_of(recorded, fields.speed, fields.apart_s)

    def device(name: str) -> Device:
        kind = PlayedScanner if name == SCANNER else PlayedCamera
        return Device(name, lambda: kind(recorded[name], line), lambda source: lambda frame: line.clock_of(frame.time_ns))

    return {name: device(name) for name in recorded}


def opened(devices: LiveDevices, names: Sequence[str], fields: LiveFields) -> dict[str, Device]:
    """A laboratory's cameras by name, opened when they are used, and again after a loss."""

    def camera(name: str) -> Device:
        def begun() -> Camera:
            with ExitStack() as stack:
                found = open_camera(devices, name)
                stack.callback(found.close)
                found.set_exposure(fields.exposure_s, fields.gain)
                # camera 1's exposures trigger camera 2
                found.start("hardware" if fields.trigger == "hardware" and name != CAMERAS[0] else "free")
                stack.pop_all()  # it is open, and its feed's to close
                return found

        return Device(name, begun, lambda source: FollowedClock(follow(cast(Camera, source))))

    if lacking := [name for name in names if name not in devices.cameras]:
        raise InputError(f"devices.cameras: expected {' and '.join(names)}, found no {lacking[0]}; see conf/devices")
    return {name: camera(name) for name in names}


def sizes_of(source: dict[str, Recorded] | LiveDevices, names: Sequence[str]) -> tuple[dict[str, Size], int]:
    """Sizes of cameras' images by name, and the bits of the deepest."""
    known = source.cameras if isinstance(source, LiveDevices) else source
    return {name: known[name].size for name in names}, max(known[name].bits for name in names)


def given_or_held(given: Path | None, capture: Path | None, field: Literal["calibration", "probe"], what: str, verb: str) -> Path:
    """The file that a field names, else the capture's own."""
    if given is not None:
        return given
    held = None if capture is None else getattr(manifest.read_manifest(capture), field)
    if capture is None or held is None:
        raise InputError(f"{capture or verb}: expected {what}, found none; give {field}=...")
    return capture / held
