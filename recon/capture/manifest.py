"""`manifest.json`, the list of what is in a capture folder: devices, patterns, and which image belongs to which.

A capture holds one part or several: a surface, a board, a sweep or several with names. Parts share the devices.

Everything is checked on load; a fault is an `InputError` of one line that names the file, what was expected and what was found.
"""

import re
from collections.abc import Iterable, Iterator, Sequence
from datetime import date
from itertools import chain
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Annotated, Literal, NamedTuple

from pydantic import AfterValidator, Field, model_validator

from recon.capture.image_formats import SUFFIXES
from recon.errors import InputError, short, validated
from recon.files import json_text
from recon.files.regular import shown
from recon.model import rig
from recon.model.boards import Board
from recon.model.patterns import Axis, Patterns

SCHEMA: Literal["sonotwin-capture/1"] = "sonotwin-capture/1"
MANIFEST = "manifest.json"
OPTICS = "calibration/optics.yaml"
PROBE = "calibration/probe.yaml"
TRACK = "track.csv"  # in the folder of a sweep
BODIES, POSES = "bodies", "poses.csv"  # folder of further bodies, each in a folder of its name with its table of poses
STAMPS = "timestamps.csv"  # in each device's folder of a sweep
CAMERAS = ("cam1", "cam2")
IMAGES_BELOW = ("*", "*/*", "*/*/*")  # where images without a manifest lie: cam1/pose03/07.png at most
SCANNER = "us"

PartName = str  # "surface", "board", "sweep", or "sweep/NAME": the folder of the part's images
SWEEP: PartName = "sweep"


def _inside(path: str) -> str:
    """A path that stays below its folder: a manifest from others may name any file."""
    if PurePosixPath(path).is_absolute() or PureWindowsPath(path).anchor or ".." in re.split(r"[/\\]", path):
        raise ValueError(f"expected a path within the capture, without .., found {path}")
    return path


def _without_slash(name: str) -> str:
    """A name that a file may have."""
    if name in (".", "..") or not name.isprintable() or re.search(r"[/\\]", name):
        raise ValueError(f"expected a name without slashes, found {name!r}")
    return name


Name = Annotated[str, Field(min_length=1, max_length=200), AfterValidator(_without_slash)]
Inside = Annotated[str, Field(min_length=1), AfterValidator(_inside)]  # path below a folder
SweepName = Annotated[str, Field(pattern=r"^[a-z][a-z0-9_-]{0,63}$")]
SweepNameOrNone = Annotated[str, Field(pattern=r"^([a-z][a-z0-9_-]{0,63})?$")]  # "" of the only one
Purpose = Literal["probe", "latency", "volume"]  # of a sweep: crossed wires at rest, a flat bottom, or what is to be seen


class Device(rig.Part):
    """A camera or the projector, as it was set."""

    size: tuple[Annotated[int, Field(ge=8, le=20000)], Annotated[int, Field(ge=8, le=20000)]]  # width, height, px
    bits: Literal[8, 10, 12] = 8  # of the digital numbers; 10 and 12 are stored right-aligned in 16-bit PNG
    exposure_s: Annotated[float, Field(gt=0)] | None = None
    gain: Annotated[float, Field(gt=0)] | None = None  # linear; 1 is the sensor's base gain


class Part(rig.Part):
    """A part of a capture."""

    day: date | None = None  # in UTC, of its newest images; none of what wasn't recorded by `record`, such as renders
    devices: dict[Name, Device] | None = None  # those that were set otherwise for this part than the capture's; of the same sizes


class SurfacePart(Part):
    """The fringe sequence: the patterns, and each camera's images in the same order."""

    patterns: Patterns
    images: dict[str, tuple[Inside, ...]]  # camera: paths relative to the manifest's root

    def paths(self) -> Iterator[str]:
        """All paths that are named."""
        yield from chain.from_iterable(self.images.values())

    @model_validator(mode="after")
    def _one_image_a_pattern(self) -> "SurfacePart":
        for camera, paths in self.images.items():
            if len(paths) != self.patterns.count:
                raise ValueError(f"images.{camera}: expected {self.patterns.count} images, one a pattern, found {len(paths)}")
        return self


class BoardPose(rig.Part):
    """Images of the calibration board in one pose."""

    name: Name
    lit: dict[str, Inside] = Field(
        default_factory=dict
    )  # camera: path of the image with the projector fully on; if not given, its fringes' mean serves
    fringes: dict[str, tuple[Inside, ...]] = Field(default_factory=dict)  # camera: paths in the order of the patterns

    @property
    def cameras(self) -> tuple[str, ...]:
        """Those that took images."""
        return tuple(self.lit | self.fringes)

    @model_validator(mode="after")
    def _some_image(self) -> "BoardPose":
        if not self.cameras:
            raise ValueError("lit: expected an image of a camera here or fringes, found none of both")
        return self


class BoardPart(Part):
    """The calibration board, held in several poses, lit and perhaps under fringes."""

    board: Board
    patterns: Patterns | None = None  # along both axes of the projector; none if only cameras are to be calibrated
    poses: Annotated[tuple[BoardPose, ...], Field(min_length=1)]

    def paths(self) -> Iterator[str]:
        """All paths that are named."""
        for pose in self.poses:
            yield from chain(pose.lit.values(), *pose.fringes.values())

    @model_validator(mode="after")
    def _fringes_as_shown(self) -> "BoardPart":
        if self.patterns is not None and (lacking := axes_not_encoded(self.patterns)):
            raise ValueError(f"patterns: expected fringes or Gray code along both axes, found none along {' and '.join(lacking)}")
        for number, pose in enumerate(self.poses):
            if self.patterns is None and pose.fringes:
                raise ValueError(f"patterns: expected those of poses.{number}.fringes, found none")
            for camera, paths in pose.fringes.items():
                if self.patterns is not None and len(paths) != self.patterns.count:
                    expected = f"{self.patterns.count} images, one a pattern"
                    raise ValueError(f"poses.{number}.fringes.{camera}: expected {expected}, found {len(paths)}")
        return self

    @model_validator(mode="after")
    def _one_pose_a_name(self) -> "BoardPart":
        names = [pose.name for pose in self.poses]
        for number, name in enumerate(names):
            if name in names[:number]:
                raise ValueError(f"poses.{number}.name: expected another than that of poses.{names.index(name)}, found {name}")
        return self


class SweepPart(Part):
    """A freehand sweep: B-scans (`us`), frames of the tracking cameras, or both, by each device's clock; and the target's poses.

    Paths are relative to the manifest's root.
    """

    purpose: Purpose | None = None
    images: Annotated[dict[str, Inside], Field(min_length=1)]  # device: folder of its images and timestamps.csv
    track: str | None = None  # path of the poses; none if they are still to be found in the cameras' images
    bodies: dict[rig.BodyName, str] | None = None  # paths of the poses of further bodies, such as a needle

    def paths(self) -> Iterator[str]:
        """All paths that are named."""
        yield from self.images.values()
        if self.track is not None:
            yield self.track
        yield from (self.bodies or {}).values()


class SweepImages(NamedTuple):
    """A device's images of a sweep."""

    folder: Path  # of the images and timestamps.csv
    device: Device


class Manifest(rig.Part):
    """`manifest.json`. Parts are optional: a capture need not hold all of them."""

    version: Literal["sonotwin-capture/1"] = Field(alias="schema")
    name: str = ""
    root: str = "."  # folder of the images: absolute, or relative to the manifest
    devices: dict[Name, Device]
    calibration: str | None = None  # of cameras and projector; relative to the manifest's folder
    probe: str | None = None  # the ultrasound probe's calibration; relative to the manifest's folder
    surface: SurfacePart | None = None
    board: BoardPart | None = None
    sweep: SweepPart | None = None  # the only one
    sweeps: dict[SweepName, SweepPart] = Field(default_factory=dict)  # or several, in the order in which they were taken

    def name_of(self, folder: Path) -> str:
        """The capture's name: its own, or that of its folder."""
        return self.name or folder.resolve().name

    def days_of(self, parts: Iterable[PartName]) -> dict[PartName, date]:
        """Days on which parts were recorded; without those that don't say."""
        return {name: day for name in parts if (day := self.part(name).day) is not None}

    @model_validator(mode="after")
    def _one_or_named(self) -> "Manifest":
        if self.sweep is not None and self.sweeps:
            raise ValueError(f"sweep: expected none beside sweeps, which are {', '.join(self.sweeps)}, found one")
        return self

    @model_validator(mode="after")
    def _known_cameras(self) -> "Manifest":
        for part, field, cameras in self._places():
            for camera in cameras:
                if camera not in self.devices:
                    expected = f"one of the devices {', '.join(self.devices)}"
                    raise ValueError(f"{field_of(part)}.{field}.{camera}: expected {expected}, found {camera}")
        return self

    @model_validator(mode="after")
    def _one_size_a_device(self) -> "Manifest":
        for part in self.contents:
            for name, device in (self.part(part).devices or {}).items():
                if name not in self.devices or device.size != self.devices[name].size:
                    found = "x".join(map(str, device.size))
                    expected = "one of the devices, of the same size"
                    raise ValueError(f"{field_of(part)}.devices.{name}: expected {expected}, found {found}")
        return self

    @model_validator(mode="after")
    def _one_raster(self) -> "Manifest":
        for part, patterns in (
            ("surface", self.surface.patterns if self.surface else None),
            ("board", self.board.patterns if self.board else None),
        ):
            if patterns is None or "projector" not in self.devices:
                continue
            wanted, found = patterns.projector_size, self.devices["projector"].size
            if found != wanted:
                expected = f"{wanted[0]}x{wanted[1]} as in {part}.patterns"
                raise ValueError(f"devices.projector.size: expected {expected}, found {found[0]}x{found[1]}")
        return self

    @property
    def contents(self) -> dict[PartName, tuple[str, ...]]:
        """The parts that are there, each with the devices whose images it holds."""
        parts = [part for part in ("surface", "board", SWEEP) if getattr(self, part) is not None]
        found: dict[PartName, dict[str, None]] = {part: {} for part in (*parts, *map(sweep_part, self.sweeps))}
        for place, _, devices in self._places():
            found[place].update(dict.fromkeys(devices))
        return {part: tuple(devices) for part, devices in found.items()}

    def part(self, name: PartName) -> SurfacePart | BoardPart | SweepPart:
        """A part that is there."""
        folder, _, own = name.partition("/")
        return self.sweeps[own] if own else getattr(self, folder)

    def devices_of(self, part: PartName) -> dict[str, Device]:
        """All devices, as they were set for a part."""
        return self.devices | (self.part(part).devices or {})

    def sweep_of(self, path: Path, holds: str, name: str = "", purpose: Purpose | None = None) -> tuple[PartName, SweepPart]:
        """The sweep of a name; of none the only one, or the only one that is for a purpose.

        Parameters
        ----------
        path, holds : of the manifest, and the sweep's expected content, for messages.

        Raises
        ------
        InputError
            If there is none, or more than one.
        """
        there = {sweep_part(own): part for own, part in self.sweeps.items()} | ({SWEEP: self.sweep} if self.sweep else {})
        wanted = {part: one for part, one in there.items() if not name or part == sweep_part(name)}
        fitting = wanted
        if len(wanted) > 1 and purpose is not None:
            own = {part: one for part, one in wanted.items() if one.purpose == purpose}
            fitting = own or {part: one for part, one in wanted.items() if one.purpose is None and purpose == "volume"}
        if len(fitting) == 1:
            return next(iter(fitting.items()))
        if not there:
            raise InputError(f"{path}: expected sweep, {holds}, found none")
        if self.sweep:
            raise InputError(f"{path}: sweep: expected no name, as it is the only one, found {name}; leave sweep={name} out")
        names = ", ".join(self.sweeps)
        found = f"{name}, which isn't among them" if name else f"{len(fitting) or 'none'} for this"
        raise InputError(f"{path}: sweeps: expected the name of one of {names}, found {found}; give sweep=NAME")

    def images_of(
        self, folder: Path, names: Sequence[str], sweep: str = "", purpose: Purpose | None = None
    ) -> dict[str, SweepImages]:
        """Images of devices, each of which a sweep must have; the sweep as of `sweep_of`.

        Parameters
        ----------
        folder : of the manifest.

        Raises
        ------
        InputError
            If there is no such sweep, or it lacks images of a device.
        """
        place, part = self.sweep_of(folder / MANIFEST, f"with images of {', '.join(names)}", sweep, purpose)
        for name in names:
            if name not in part.images:
                raise InputError(f"{folder / MANIFEST}: {field_of(place)}.images.{name}: expected a path, found none")
        devices = self.devices_of(place)
        return {name: SweepImages(folder / self.root / part.images[name], devices[name]) for name in names}

    @property
    def named_sweeps(self) -> dict[str, SweepPart]:
        """Sweeps by name; the only one, which has none, under an empty one."""
        return dict(self.sweeps) if self.sweep is None else {"": self.sweep}

    def calibration_file(self, folder: Path, given: Path | None = None) -> Path:
        """The file of cameras and projector: the one given, or else the capture's own.

        Parameters
        ----------
        folder : of the manifest.

        Raises
        ------
        InputError
            If there is neither.
        """
        if given is not None:
            return given
        if self.calibration is None:
            raise InputError(
                f"{folder / MANIFEST}: expected calibration, the path of a calibration file, found none; give calibration=FILE"
            )
        return folder / self.calibration

    def _places(self) -> Iterator[tuple[PartName, str, Iterable[str]]]:
        """Parts and their fields in which devices are named, and these names."""
        if self.surface is not None:
            yield "surface", "images", self.surface.images
        for number, pose in enumerate(self.board.poses if self.board else ()):
            yield "board", f"poses.{number}.lit", pose.lit
            yield "board", f"poses.{number}.fringes", pose.fringes
        if self.sweep is not None:
            yield SWEEP, "images", self.sweep.images
        for name, sweep in self.sweeps.items():
            yield sweep_part(name), "images", sweep.images


def sweep_part(name: str) -> PartName:
    """The part that is the sweep of a name."""
    return f"{SWEEP}/{name}" if name else SWEEP


def body_track(part: PartName, body: str) -> str:
    """Where a capture holds the poses of a further body in a sweep."""
    return f"{part}/{BODIES}/{body}/{POSES}"


def is_sweep(part: PartName) -> bool:
    """Whether a part is a sweep."""
    return part.partition("/")[0] == SWEEP


def field_of(part: PartName) -> str:
    """The manifest's field of a part, for messages: `surface`, `sweeps.NAME`."""
    folder, _, own = part.partition("/")
    return f"{folder}s.{own}" if own else folder


def read_manifest(folder: Path) -> Manifest:
    """Read and check the manifest of a capture folder, leaving the files that it names alone.

    Raises
    ------
    InputError
        If it is missing, not JSON, of another version, or a field is wrong.
    """
    path = Path(folder) / MANIFEST
    for other in (Path(folder) / "capture", Path(folder).parent):  # of what was rendered, given as if recorded; and the reverse
        if not path.exists() and (other / MANIFEST).exists():
            raise InputError(f"{path}: expected a file, found none; is {other} meant?")
    if not path.parent.exists():
        raise InputError(f"{shown(path.parent)}: expected a capture, found no such folder")
    if not path.exists() and any(one.suffix.lower() in SUFFIXES for depth in IMAGES_BELOW for one in path.parent.glob(depth)):
        raise InputError(f"{shown(path)}: expected a file, found none; `sonotwin describe` makes a capture of images")
    return validated(Manifest, json_text.read(path), path)


def write_manifest(folder: Path, manifest: Manifest) -> None:
    """Write the manifest into a capture folder; raises InputError as of `manifest_text`."""
    (folder / MANIFEST).write_text(manifest_text(manifest), encoding="utf-8")


def manifest_text(manifest: Manifest) -> str:
    """The manifest as JSON; raises InputError if a name in it is none in UTF-8."""
    left_out = None if manifest.sweeps else {"sweeps"}
    try:
        text = manifest.model_dump_json(indent=2, by_alias=True, exclude_none=True, exclude=left_out)
    except ValueError:  # of half a letter
        strange = next((name for name in (manifest.name, manifest.root) if not _is_whole(name)), "others")
        raise InputError(f"{MANIFEST}: expected names of folders in UTF-8, found {short(strange)}: rename the folder") from None
    return text + "\n"


def _is_whole(name: str) -> bool:
    """Whether a name is text, and holds no byte that isn't part of any."""
    return name.encode("utf-8", "replace").decode("utf-8") == name


def image_name(frame: int) -> str:
    """File name of a frame, in its device's folder."""
    return f"{frame:04d}.png"


def axes_not_encoded(patterns: Patterns) -> list[Axis]:
    """Axes of the projector along which a sequence has neither fringes nor Gray code; a board's needs both."""
    axes: tuple[Axis, Axis] = ("columns", "rows")
    return [axis for axis in axes if axis not in patterns.axes]
