"""Opens a laboratory's devices as `conf/devices` describes them; a library is loaded when its device is opened."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

from pydantic import Field

from recon.acquisition.sweep_recording import PairSource, ScanSource
from recon.capture.manifest import CAMERAS, SCANNER, Name
from recon.devices import basler
from recon.devices.camera_pairs import CameraPair
from recon.devices.igtl_scanner import IgtlScanner
from recon.devices.interfaces import Camera, DeviceError, Projector, Scanner
from recon.devices.scan_view import ScanView
from recon.devices.timed_frames import TimedScanner
from recon.devices.video_grabber import VideoGrabber
from recon.model.rig import NotNegative, Part, Positive

Side = Annotated[int, Field(ge=8, le=20000)]
Port = Annotated[int, Field(ge=1, le=65535)]
Host = Annotated[str, Field(min_length=1)]  # an empty one would stand for all of the network


class BaslerDevice(Part):
    """A Basler camera."""

    kind: Literal["basler"]
    serial: str  # number on its label
    size: tuple[Side, Side]  # width, height, px, from the sensor's upper left corner
    bits: Literal[8, 10, 12] = 8
    rate_hz: Positive | None = None  # of a camera that runs free
    trigger_line: str = "Line1"
    exposure_line: str | None = None  # output that is high during exposures
    features: dict[str, bool | int | float | str] = Field(default_factory=dict)  # others, by their GenICam names


class WindowDevice(Part):
    """A projector as a second display."""

    kind: Literal["window"]
    size: tuple[Side, Side]  # width, height, px
    display: Annotated[int, Field(ge=0)]  # number of the display
    delay_s: NotNegative | None = None  # from drawing to light


class View(Part):
    """The B-scan's part of what a scanner sends."""

    crop: tuple[int, int, int, int] | None = None  # left, top, width, height, px
    orientation: str = "MF"
    scale: Positive = 1.0


class IgtlDevice(Part):
    """A scanner that sends by OpenIGTLink."""

    kind: Literal["igtl"]
    host: Host
    port: Port
    device: str | None = None  # name of the images
    view: View = View()


class VideoDevice(Part):
    """A scanner whose screen a video grabber takes."""

    kind: Literal["video"]
    source: int | str  # number of the grabber, or a path or address
    sent: tuple[Side, Side] | None = None  # width, height, px that it is to send; None: whatever it does by itself
    view: View = View()


class LiveDevices(Part):
    """Devices of a laboratory."""

    kind: Literal["live"]
    cameras: dict[Name, Annotated[BaslerDevice, Field(discriminator="kind")]]
    projector: Annotated[WindowDevice, Field(discriminator="kind")] | None = None
    scanner: Annotated[IgtlDevice | VideoDevice, Field(discriminator="kind")] | None = None
    sweep_triggers: tuple[Literal["free", "hardware"], Literal["free", "hardware"]] = ("free", "hardware")  # of cam1 and cam2
    pairs_within_s: Positive | None = None  # of frames that belong together; None: those of one number, triggered by one wire


class VirtualDevices(Part):
    """Devices that the twin stands in for."""

    kind: Literal["virtual"]
    paced: bool = False  # wait where rendering is faster than life
    bits: Literal[8, 10, 12] = 8  # of images of things at rest


def of_a_laboratory(given: Any, otherwise: str) -> Any:
    """Devices as they are given, unless the twin is to stand in for them: then a ValueError says what to do `otherwise`."""
    if isinstance(given, Mapping) and given.get("kind") == "virtual":
        expected = "those of a laboratory, as conf/devices/basler.yaml has them"
        raise ValueError(f"expected {expected}, found virtual, which stands in for them in `record` alone; {otherwise}")
    return given


AnyDevices = Annotated[VirtualDevices | LiveDevices, Field(discriminator="kind")]


@dataclass(frozen=True)
class Opened:
    """Devices that are open."""

    cameras: Mapping[str, Camera] = field(default_factory=dict)
    projector: Projector | None = None
    scanner: ScanSource | None = None
    pairs: PairSource | None = None


@contextmanager
def open_still(devices: LiveDevices, names: Sequence[str]) -> Iterator[Opened]:
    """Open the cameras of these names and the projector; DeviceError if one isn't there."""
    with ExitStack() as stack:
        if devices.projector is None:
            raise DeviceError("devices.projector: expected one, which lights what is recorded, found none; see conf/devices")
        cameras = {name: stack.enter_context(closing(open_camera(devices, name))) for name in names}
        yield Opened(cameras, stack.enter_context(closing(open_projector(devices.projector))))


@contextmanager
def open_sweep(devices: LiveDevices, exposure_s: float, gain: float) -> Iterator[Opened]:
    """Open both cameras as a pair, and the scanner if there is one, all timed by one clock; DeviceError if one isn't there."""
    with ExitStack() as stack:
        cameras = {name: stack.enter_context(closing(open_camera(devices, name))) for name in CAMERAS}
        for camera in cameras.values():
            camera.set_exposure(exposure_s, gain)
        pair = CameraPair((cameras[CAMERAS[0]], cameras[CAMERAS[1]]), devices.pairs_within_s)
        scanner = None if devices.scanner is None else stack.enter_context(closing(TimedScanner(open_scanner(devices.scanner))))
        yield Opened(cameras, scanner=scanner, pairs=pair)


def open_camera(devices: LiveDevices, name: str) -> Camera:
    """Open the camera of a name; DeviceError if it isn't there."""
    if name not in devices.cameras:
        found = ", ".join(devices.cameras) or "none"
        raise DeviceError(f"devices.cameras: expected {name}, found {found}; see conf/devices")
    chosen = devices.cameras[name]
    settings = basler.BaslerSettings(**chosen.model_dump(exclude={"kind", "serial"}))
    return basler.open_camera(name, chosen.serial, settings)


def open_projector(chosen: WindowDevice) -> Projector:
    """Open the projector; DeviceError if its display isn't there."""
    from recon.devices.projector_window import ProjectorWindow  # loads pyglet, of the extra `live`

    delay = {} if chosen.delay_s is None else {"delay_s": chosen.delay_s}
    return ProjectorWindow(chosen.size, chosen.display, **delay)


def open_scanner(chosen: IgtlDevice | VideoDevice) -> Scanner:
    """Open the scanner; DeviceError if it isn't there."""
    view = ScanView(**chosen.view.model_dump())
    if isinstance(chosen, IgtlDevice):
        return IgtlScanner(SCANNER, chosen.host, chosen.port, chosen.device, view)
    return VideoGrabber(SCANNER, chosen.source, view, chosen.sent)
