"""The rig's parameters from its own captures: the settings of the step, the step, and the files of its result."""

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from datetime import UTC, date, datetime
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, ValidationError

from recon import linear_algebra
from recon.capture import board_part, calibration_files, surface_part
from recon.capture.board_part import BoardCapture
from recon.capture.image_formats import JPEG
from recon.capture.images import image_files, read_images
from recon.capture.manifest import MANIFEST, Device, Manifest, PartName, read_manifest, sweep_part
from recon.capture.surface_part import SurfaceCapture
from recon.errors import InputError, one_line
from recon.files import atomic, yaml_text
from recon.geometry import rigid
from recon.identification import calibrated_optics, lenses, projector, raw_images, rig_file, sensors, vignetting
from recon.identification.estimates import Estimate, Findings
from recon.identification.photon_transfer import has_free_dimensions
from recon.identification.projector import CameraBlur
from recon.identification.sensors import DarkStack, ImageSettings, PatternStack
from recon.model.boards import Discs
from recon.model.calibration import Calibration
from recon.model.part import Part, Positive
from recon.model.rig import Measured, Rig
from recon.optical_calibration.joint_calibration import Result
from recon.registry import Choice
from recon.session import hand_step, optics_step, scanner_step
from recon.session.scanner_step import ULTRASOUND, Found
from recon.session.watch import SILENT, Watch
from recon.structured_light.decode import decode
from recon.structured_light.triangulate import triangulate

BY = "identify"  # who writes
RIG, CONDITIONS, FIGURES = "rig.yaml", "conditions.yaml", "identified.json"
GROUP = "conditions."
CAMERAS = ("cam1", "cam2")
BLUR_SIGMA_PX = 0.15, 0.5  # of a camera's point spread where no board showed it, and with its defocus where none showed this
NOISE_POSES = 3  # of a board whose fringes tell the noise: tiles enough
BLACK_SIGMA_DN = 2.0  # of a black level that no dark frames showed

LENS = ("f_number", "focus_mm", "blur_px", "vignetting")
NOT_SEEN = {  # reasons of what no part of a capture shows
    **{f"{camera}.sensor.{name}": f"no images of {camera}" for camera in CAMERAS for name in sensors.FIELDS},
    **{f"{camera}.lens.{name}": f"no board of discs before {camera}" for camera in CAMERAS for name in LENS},
    **{f"projector.lens.{name}": "no surface under patterns before cam1" for name in LENS},
    "projector.lens.vignetting": "no board lit by the projector",
    **{f"projector.{name}": "no surface under patterns before cam1" for name in ("gamma", "contrast")},
    **{f"conditions.frames.{name}": "no surface under grey fringes before cam1" for name in ("flicker", "stray_dn", "shift")},
}

Images = NDArray[np.uint8] | NDArray[np.uint16]


class Settings(scanner_step.Fields):
    """Sources, and what is read off data sheets."""

    capture: Path
    """a capture folder with a board, a surface under fringes, or both; or with films, or sweeps by the scanner, or all of that"""
    rig: Annotated[Rig, Choice("meza2021")]
    """the rig to begin with: what isn't measured stays as it has it, such as the pixels' size; the new file is one version on"""
    conditions: Part | None = None
    """the conditions to begin with, such as an earlier conditions.yaml: what isn't measured stays as they have it"""
    day: date | None = None
    """of the capture, such as 2026-11-30; null: of those of its parts that the rig is identified from, on which the newest was
    recorded, else that of manifest.json, in UTC"""
    calibration: Path | None = None
    """calibration file, used instead of the capture's own; of a board in the capture it is made anew"""
    dark: Path | None = None
    """folder of images with covered lenses, in cam1/ and cam2/, exposed as the capture's: black level, dark noise, DSNU; null:
    dark/ in the capture, if it is there; likewise flat/ and room/"""
    flat: Path | None = None
    """the same of an even light, at one level, or at several in a folder each, such as cam1/half/: gain, PRNU"""
    room: Path | None = None
    """the same of the scene with the projector covered: tells the projector's black from the room's light"""
    gain: Positive | None = None
    """linear, of the cameras: 1 fills the range with the sensor's saturation charge; null: as the capture has it, else 1"""
    adc_bits: Annotated[int | None, Field(ge=8, le=16)] = None
    """of both cameras' converters, by the data sheet, if at hand; else as of `rig`, with a doubt"""
    processed: bool = False
    """take images that aren't raw (JPEG, demosaiced, filtered, with a gamma) for the sensor's; else they show no number of it"""
    still: tuple[str, ...] = ()
    """names of the capture's sweeps with frames of both cameras and the target in a stand: the tracker's noise"""
    hand: tuple[str, ...] = ()
    """the same with the target or the probe in a hand, 27 frames a second or more for its tremor"""
    probes: tuple[Path, ...] = ()
    """files that calibrate-probe wrote before and after a session, and so on of further ones: the bracket's giving"""


class Identification(NamedTuple):
    """The rig with what was measured in it, all that the captures show, and the scanner; and what the capture holds."""

    rig: Rig
    findings: Findings
    scanner: Found | None
    manifest: Manifest


def run(settings: Settings, out: Path, watch: Watch = SILENT) -> None:
    """Identify, and write the rig's file, that of its conditions, and all figures.

    Raises
    ------
    InputError
        If the capture is incomplete or damaged, holds neither a board, fringes nor films or sweeps that are named, the conditions
        to begin with are missing, or `out` can't be written to.
    """
    scans = (Path(name) for name in (settings.tissue, settings.air, settings.steps) if name)
    inputs = (settings.capture, settings.calibration, settings.dark, settings.flat, settings.room, *settings.probes, *scans)
    atomic.check_folder(out, BY, inputs=inputs)
    if settings.conditions is None:
        raise InputError("conditions: expected those to begin with, found none")
    _check_version(settings.rig, out / RIG)
    rig, found, scanned, manifest = identify(settings, watch)
    conditions = _conditions(settings.conditions, found)
    if settings.rig.measured and settings.conditions == type(conditions)():
        watch.say("conditions  begin from ideal ones; conditions=FILE keeps those of an earlier identification, as rig=FILE does")
    for line in describe(found):
        watch.say(line)
    name = manifest.name_of(settings.capture)
    if rig != settings.rig or any(name.partition(".")[0] in Rig.model_fields for name in found.estimates):
        days = manifest.days_of(_parts(settings, manifest))
        day = settings.day or max(days.values(), default=None) or _day(settings.capture / MANIFEST)
        if any(other != day for other in days.values()):
            recorded = ", ".join(f"{part} {one}" for part, one in days.items())
            watch.say(f"day         {day} for all of the rig; recorded: {recorded}")
        rig = rig_file.next_version(rig, name, day)
    heading = "\n".join(
        (
            f"A rig as last identified from {name}: numbers with an uncertainty (1 sigma) were measured, there or before,",
            "others are as in the rig that it began with, or in its calibration. `sonotwin VERB rig=FILE` takes it.",
        )
    )
    with atomic.new_folder(out, BY) as new:
        rig_file.write(new / RIG, rig, found.unknown, heading)
        _write_conditions(new / CONDITIONS, conditions, found, name)
        content = json.dumps(asdict(found), indent=2, ensure_ascii=False, allow_nan=False)
        (new / FIGURES).write_text(content + "\n", encoding="utf-8")
        if scanned is not None:
            scanner_step.write(new / ULTRASOUND, scanned, name)
    written = (RIG, CONDITIONS, *([] if scanned is None else [ULTRASOUND]), FIGURES)
    watch.say(f"wrote       {out}/{{{','.join(written)}}}, version {rig.version} of the rig")


def _check_version(rig: Rig, place: Path) -> None:
    """Check that the file which identification begins with, if it is one, isn't lost: `check` compares later ones with it."""
    if rig.version and place.is_file() and yaml_text.read(place).get("version") == rig.version:
        found = f"found version {rig.version}, as of rig, which would be lost"
        raise InputError(f"{place}: expected none, or another version of the rig, {found}; give another folder")


def _parts(settings: Settings, manifest: Manifest) -> list[PartName]:
    """Parts of the capture that the rig is identified from: films are of its conditions."""
    sweeps = [name for kind in scanner_step.KINDS if (name := getattr(settings, kind)) in manifest.sweeps]
    return [part for part in manifest.contents if part in ("board", "surface", *map(sweep_part, sweeps))]


def _day(path: Path) -> date:
    return datetime.fromtimestamp(path.stat().st_mtime, UTC).date()


@linear_algebra.on_one_thread()
def identify(settings: Settings, watch: Watch = SILENT) -> Identification:
    """Identify from the captures alone; raises InputError as `run` does."""
    manifest, settings = read_manifest(settings.capture), _with_own_frames(settings)
    seen = manifest.board is not None or manifest.surface is not None
    for name in ("dark", "flat", "room", "gain", "adc_bits"):
        if not seen and getattr(settings, name) is not None:
            raise InputError(f"{name}: expected a capture with a board or a surface under fringes beside it, found neither")
    scanned = scanner_step.identify(settings, settings.capture, manifest, settings.rig, watch)
    by_films = bool(settings.still or settings.hand or settings.probes)
    if not (seen or scanned is not None or by_films):
        names = ", ".join(filter(None, manifest.named_sweeps))
        there = f"neither, but sweeps {names}; give tissue=NAME, still=[NAME] or hand=[NAME]" if names else "neither"
        raise InputError(f"{settings.capture}: expected a board or a surface under fringes, found {there}")
    rig, found = settings.rig, Findings(unknown=NOT_SEEN if seen else {})
    if scanned is not None:
        rig, found = scanned.rig, found | scanned.findings
    if seen:
        rig, found = _optical(settings, manifest, rig, found, watch)
    elif by_films:
        found |= _films(settings, rig, None, watch)
    return Identification(rig_file.apply(rig, found), found, scanned, manifest)


def _optical(settings: Settings, manifest: Manifest, rig: Rig, found: Findings, watch: Watch) -> tuple[Rig, Findings]:
    """Cameras and projector by the board, the surface, or both; tracker and hand by their calibration."""
    part: PartName = "board" if manifest.surface is None else "surface"
    frames = {
        camera: _frames(settings, camera, device) for camera, device in manifest.devices_of(part).items() if camera in CAMERAS
    }
    for folder in (settings.dark, settings.flat, settings.room):
        if folder is not None and not any((folder / camera).is_dir() for camera in frames):
            there = "a file" if folder.is_file() else "none" if folder.is_dir() else "nothing"
            raise InputError(f"{folder}: expected a folder with images in {' or '.join(frames)}, found {there}")
    board = None
    if manifest.board is not None:
        captured = board_part.read_board(settings.capture)
        board = captured, optics_step.calibrate(captured, watch=watch).result
    shots = _shots(settings, manifest, None if board is None else board[1].adjustment.calibration)
    calibration = next(iter(shots.values())).calibration if board is None else board[1].adjustment.calibration
    rig = calibrated_optics.with_devices(rig, calibration)
    found |= calibrated_optics.findings(calibration)
    files = {camera: list(_files(camera, settings, manifest)) for camera in frames}
    for camera, own in frames.items():
        with watch.busy(f"measuring the sensor of {camera}"):
            found |= _sensor(camera, settings, own, list(_stacks(camera, own.device, shots.get(camera), board)), files[camera])
        why = found.unknown.get(f"{camera}.sensor.saturation_e", "")
        if why.startswith(sensors.NOT_RAW):
            watch.warn(f"{camera}: {why}; the light of lenses and projector is by these images, too")
    if board is not None:
        with watch.busy("measuring the lenses"):
            found |= _lenses(*board, settings, rig, found)
        adjusted = board[1].adjustment
        boards = [rigid.apply(pose, adjusted.points) for pose in adjusted.poses]
        rig, moved = lenses.focused_on(rig, calibration, boards, found)
        for line in moved:
            watch.say(f"focus       {line}")
    if CAMERAS[0] in shots:
        with watch.busy("measuring the projector"):
            found |= _projector(CAMERAS[0], shots[CAMERAS[0]], rig, found, frames[CAMERAS[0]].room)
    found |= _films(settings, rig, None if board is None else calibration, watch)
    if settings.adc_bits is not None:
        sensors_of = {camera: getattr(rig, camera).sensor.model_copy(update={"adc_bits": settings.adc_bits}) for camera in frames}
        rig = rig.model_copy(
            update={camera: getattr(rig, camera).model_copy(update={"sensor": one}) for camera, one in sensors_of.items()}
        )
    for camera, own in frames.items():
        if all(_known(f"{camera}.sensor.{name}", rig, found) is None for name in ("dark_noise_e", "black_level_dn")):
            device = getattr(rig, camera)
            image = ImageSettings(own.device.bits, _gain(settings, own.device), settings.adc_bits)
            sensor = sensors.with_noise_as_seen(getattr(rig_file.apply(rig, found), camera).sensor, camera, image, found)
            rig = rig.model_copy(update={camera: device.model_copy(update={"sensor": sensor})})
    if "projector.lens.focus_mm" not in rig.measured:
        rig = rig.model_copy(update={"projector": projector.with_blur_as_seen(rig.projector, found)})
    return rig, found


def _with_own_frames(settings: Settings) -> Settings:
    """Settings with the capture's own folders of further images, where no others are given."""
    own = {name: settings.capture / name for name in ("dark", "flat", "room") if getattr(settings, name) is None}
    return settings.model_copy(update={name: folder for name, folder in own.items() if folder.is_dir()})


@dataclass(frozen=True)
class _Frames:
    """Further images of one camera, and how it was set for the capture."""

    device: Device
    dark: Images | None
    flats: Sequence[Images]
    room: Images | None


def _frames(settings: Settings, camera: str, device: Device) -> _Frames:
    if settings.gain is not None and device.gain is not None and settings.gain != device.gain:
        raise InputError(f"gain: expected {device.gain:g}, as the capture has it for {camera}, found {settings.gain:g}")
    if settings.adc_bits is not None and settings.adc_bits < device.bits:
        raise InputError(f"adc_bits: expected {device.bits} or more, as {camera}'s images have, found {settings.adc_bits}")
    dark, room = (_stack(folder, camera, device) for folder in (settings.dark, settings.room))
    return _Frames(device, dark, list(_flats(settings.flat, camera, device)), room)


def _shots(settings: Settings, manifest: Manifest, calibration: Calibration | None) -> dict[str, SurfaceCapture]:
    """Fringes before each camera that took them, by a new calibration, if there is one."""
    if manifest.surface is None:
        return {}
    with _file_of(calibration, settings) as file:
        cameras = [name for name in CAMERAS if name in manifest.surface.images]
        return {camera: surface_part.read_surface(settings.capture, camera, file) for camera in cameras}


@contextmanager
def _file_of(calibration: Calibration | None, settings: Settings) -> Iterator[Path | None]:
    """A new calibration as a file; without one, the file given, if there is one."""
    if calibration is None:
        yield settings.calibration
        return
    with TemporaryDirectory() as folder:
        file = Path(folder) / "optics.yaml"
        calibration_files.write(file, calibration)
        yield file


def _films(settings: Settings, rig: Rig, calibration: Calibration | None, watch: Watch) -> Findings:
    """The tracker, the hand and the bracket; by a new calibration, if there is one."""
    with _file_of(calibration, settings) as file:
        found = hand_step.identify(settings.capture, rig, file, settings.still, settings.hand, watch)
    return found | hand_step.compare_probes(settings.probes)


def _stacks(
    camera: str, device: Device, shot: SurfaceCapture | None, board: tuple[BoardCapture, Result] | None
) -> Iterator[PatternStack]:
    """Sequences that a camera saw: of the surface, or where these show no noise, of the board's first poses, set alike."""
    if shot is not None:
        yield PatternStack(shot.images, shot.patterns)
        if any(map(has_free_dimensions, shot.patterns.parts)):
            return
    if board is not None and camera == board_part.FRINGE_CAMERA and board[0].patterns is not None:
        own = board[0].devices[camera]
        if (own.bits, own.gain) != (device.bits, device.gain):
            return
        lit = [number for number, record in enumerate(board[0].records) if camera in record.fringes]
        for number in lit[:NOISE_POSES]:
            fringes = board[0].pose(number).fringes
            if fringes is not None:
                yield PatternStack(fringes, board[0].patterns)


def _files(camera: str, settings: Settings, manifest: Manifest) -> Iterator[Path]:
    """Image files by which a camera's sensor is measured."""
    if manifest.surface is not None:
        yield from map(Path, manifest.surface.images.get(camera, ()))
    elif manifest.board is not None:
        yield from (Path(path) for pose in manifest.board.poses for path in pose.fringes.get(camera, ()))
    for folder in (settings.dark, settings.flat):
        if folder is not None:
            yield from (folder / camera).rglob("*.*")


def _sensor(
    camera: str, settings: Settings, frames: _Frames, sequences: Sequence[PatternStack], files: Sequence[Path]
) -> Findings:
    device, dark = frames.device, frames.dark
    compressed = next((file for file in files if file.suffix.lower() in JPEG), None)
    if compressed is not None and not settings.processed:
        return sensors.without_raw_images(camera, f"{compressed.name} is a JPEG: {raw_images.SET}")
    return sensors.identify_sensor(
        camera,
        ImageSettings(device.bits, _gain(settings, device), settings.adc_bits, settings.processed),
        dark=[] if dark is None else [DarkStack(dark, device.exposure_s)],
        flats=frames.flats,
        sequences=sequences,
    )


def _gain(settings: Settings, device: Device) -> float | None:
    return device.gain if settings.gain is None else settings.gain


def _lenses(captured: BoardCapture, optics: Result, settings: Settings, rig: Rig, known: Findings) -> Findings:
    """Blur and light of both cameras by the board's discs and its white."""
    found, calibration = Findings(), optics.adjustment.calibration
    places = dict(zip(optics.observations.poses, optics.adjustment.poses, strict=True))
    if not isinstance(captured.board, Discs):
        why = "needs a board of discs: edges of squares aren't measured"
        return Findings(unknown={f"{camera}.lens.{name}": why for camera in captured.cameras for name in LENS})
    rims = {camera: list[lenses.Rims]() for camera in captured.cameras if camera in calibration.cameras}
    whites = {camera: list[vignetting.Whites]() for camera in rims}
    for number, name in enumerate(captured.poses):
        if name not in places:
            continue
        pose = captured.pose(number)
        for camera, image in pose.lit.items():
            if camera not in rims:
                continue
            seen = (calibration.cameras[camera], places[name])
            full = 2.0 ** captured.devices[camera].bits - 1
            rims[camera].append(
                lenses.measure_rims(image, captured.board, *seen, points=optics.adjustment.points, pose=number, full=full)
            )
            if "projector" in calibration.cameras and not captured.board.white:
                lit = (calibration.cameras[camera], calibration.cameras["projector"], places[name])
                whites[camera].append(
                    vignetting.measure_whites(
                        image, captured.board, *lit, points=optics.adjustment.points, pose=number, full=full
                    )
                )
    numbers = [captured.poses.index(name) for name in optics.observations.poses]
    off = [(devices, dict(zip(numbers, poses, strict=True))) for devices, poses in calibrated_optics.one_sigma_off(optics)]
    for camera, parts in rims.items():
        length = getattr(rig, camera).lens.focal_length_mm
        nominal = Estimate(length, 0.0, "the calibrated focal length, and the pixels' size")
        found |= lenses.find_lens(lenses.joined(parts), camera, focal_length=nominal)
        if whites[camera]:
            white = vignetting.joined(whites[camera])
            otherwise = [vignetting.placed(white, devices[camera], devices["projector"], poses) for devices, poses in off]
            black = _black(camera, captured, settings, rig, known)
            light = vignetting.find_vignetting(white, camera, black=black, otherwise=otherwise)
            found |= replace(light, estimates=light.estimates | _agreed(found.estimates, light.estimates))
    return found


def _black(camera: str, captured: BoardCapture, settings: Settings, rig: Rig, known: Findings) -> Estimate:
    """A pixel without light, in DN of the board's images."""
    assumed = Estimate(getattr(rig, camera).sensor.black_level_dn, BLACK_SIGMA_DN, "assumed")
    level = _known(f"{camera}.sensor.black_level_dn", rig, known) or assumed
    return sensors.without_light(level, ImageSettings(captured.devices[camera].bits, adc_bits=settings.adc_bits))


def _known(name: str, rig: Rig, found: Findings) -> Estimate | None:
    """A number of the rig as it was measured, now or before."""
    before = rig.measured.get(name)
    earlier = None if before is None else Estimate(rig.number(name), before.sigma, before.source)
    return found.estimates.get(name, earlier)


def _agreed(first: Mapping[str, Estimate], second: Mapping[str, Estimate]) -> dict[str, Estimate]:
    """What both measured: weighed by variance, and as uncertain as they differ, if that is more."""
    found = dict[str, Estimate]()
    for name in first.keys() & second.keys():
        one, other = first[name], second[name]
        weights = np.array([one.sigma, other.sigma]) ** -2.0
        value = float(weights @ [one.value, other.value] / weights.sum())
        sigma = float(weights.sum() ** -0.5 * max(1.0, abs(one.value - other.value) / np.hypot(one.sigma, other.sigma)))
        found[name] = Estimate(value, sigma, f"{one.source}; {other.source}")
    return found


def _projector(camera: str, shot: SurfaceCapture, rig: Rig, found: Findings, room: Images | None) -> Findings:
    """The projector's light, as the camera saw it."""
    devices = shot.calibration.cameras[camera], shot.calibration.cameras["projector"]
    length = rig.projector.lens.focal_length_mm
    try:
        decoded = decode(shot.images, shot.patterns, bits=shot.bits, name=shot.name, camera=camera)
        points = triangulate(decoded, *devices)
        return projector.identify(
            shot.images, shot.patterns, decoded, points, devices, length, _blur(camera, rig, found), bits=shot.bits, room=room
        )
    except InputError as error:
        return Findings(unknown={name: str(error) for name in NOT_SEEN if name.startswith(("projector.", "conditions."))})


def _blur(camera: str, rig: Rig, found: Findings) -> CameraBlur:
    """A camera's blur as measured, or a point spread as the rig has it."""
    lens = getattr(rig, camera).lens
    number, focus, point = (_known(f"{camera}.lens.{name}", rig, found) for name in ("f_number", "focus_mm", "blur_px"))
    if number is None or focus is None:
        return CameraBlur(lens.blur_px, BLUR_SIGMA_PX[1])
    point = point or Estimate(lens.blur_px, BLUR_SIGMA_PX[0], "assumed")
    return CameraBlur(point.value, point.sigma, lens.focal_length_mm / number.value, focus.value)


def _stack(folder: Path | None, camera: str, device: Device) -> Images | None:
    """Images : (n, h, w) of a camera in a folder of its name; None without a folder."""
    return None if folder is None or not (folder / camera).is_dir() else _images(folder / camera, device)


def _flats(folder: Path | None, camera: str, device: Device) -> Iterator[Images]:
    """Images of each level, in folders of their own or in one."""
    if folder is None or not (folder / camera).is_dir():
        return
    levels = sorted(path for path in (folder / camera).iterdir() if path.is_dir())
    for level in levels or [folder / camera]:
        yield _images(level, device)


def _images(folder: Path, device: Device) -> Images:
    paths = image_files(folder)
    if len(paths) < 2:
        raise InputError(f"{folder}: expected two images or more of one thing, found {len(paths)}")
    return read_images(paths, device.size, device.bits)


def _conditions(before: Part, found: Findings) -> Part:
    """Conditions with what was measured of them; InputError if they can't be."""
    content = before.model_dump(mode="json")
    for name, one in found.estimates.items():
        if name.startswith(GROUP):
            rig_file.put(content, name.removeprefix(GROUP), one.value, "conditions")
    try:
        return type(before).model_validate(content)
    except ValidationError as error:
        raise InputError(f"conditions: as measured, they can't be: {one_line(error)}") from error


def _write_conditions(path: Path, conditions: Part, found: Findings, name: str) -> None:
    """Write conditions for `conditions=FILE`, a line a value, with what is known of it; name: of the capture."""
    own = {one.removeprefix(GROUP): each for one, each in found.estimates.items() if one.startswith(GROUP)}
    measured = {one: Measured(sigma=each.sigma, source=each.source) for one, each in own.items()}
    unknown = {one.removeprefix(GROUP): why for one, why in found.unknown.items()}
    heading = "\n".join(
        (
            f"Conditions as identified from {name}: numbers with an uncertainty (1 sigma) were measured there, others are",
            "as in the conditions that it began with. `sonotwin VERB conditions=FILE` takes them.",
        )
    )
    rig_file.write_fields(path, conditions.model_dump(mode="json"), measured, unknown, heading)


def describe(found: Findings) -> Iterator[str]:
    """Lines: a table a part of the rig, a field a line, with its source; and what isn't known for one reason.

    A source that all of a part have stands above them.
    """
    parts: dict[str, dict[str, list[Estimate]]] = {}
    for name, one in found.estimates.items():
        device, optics, field = name.partition(".optics.")
        part, _, field = (f"{device}.optics", "", field) if optics else name.rpartition(".")
        if name.startswith(scanner_step.GROUP):
            part, _, field = name.partition(".")
        parts.setdefault(part, {}).setdefault(re.sub(r"\.\d+$", "", field), []).append(one)
    for part, fields in parts.items():
        sources = {one.source for some in fields.values() for one in some}
        shared = len(sources) == 1 and len(fields) > 1
        yield f"measured    {part}{f': {sources.pop()}' if shared else ''}"
        numbers = {field: ", ".join(map(rig_file.in_words, some)) for field, some in fields.items()}
        names, width = max(map(len, numbers)), max(map(len, numbers.values()))
        for field, some in fields.items():
            line = f"  {field:{names}}  {numbers[field]:{width}}" + ("" if shared else f"  {some[0].source}")
            yield line.rstrip()
    reasons: dict[str, list[str]] = {}
    for name, why in found.unknown.items():
        reasons.setdefault(why, []).append(name)
    for why, names in reasons.items():
        yield f"unknown     {', '.join(names)}: {why}"
