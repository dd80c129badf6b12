"""The scanner's parameters from B-scans of even tissue, in air, and side by side: fields of the step, the step, and its file."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, ValidationError
from scipy.spatial.transform import Rotation

from recon.capture import probe_files, sweep_part, sweep_tables
from recon.capture.image_formats import decode_image, luma
from recon.capture.images import frame_file, image_files
from recon.capture.manifest import MANIFEST, SCANNER, STAMPS, Manifest, image_name
from recon.errors import InputError, did_you_mean, one_line
from recon.files.regular import read_bytes
from recon.freehand.volume_compounding import Clip, Rectangle
from recon.geometry import rigid
from recon.identification import rig_file, scanner
from recon.identification.estimates import Estimate, Findings
from recon.identification.scanner import Recordings, Sheet
from recon.model.part import NotNegative, Part, Positive
from recon.model.probe import ProbeCalibration
from recon.model.rig import Measured, Pose, Probe, Rig
from recon.session.watch import SILENT, Watch

Array = NDArray[np.float64]
Images = NDArray[np.uint8]

ULTRASOUND = "ultrasound.yaml"
GROUP = "ultrasound."
KINDS = {"tissue": (3, 24), "air": (2, 12), "steps": (4, 40)}  # B-scans of each recording: at least, and at most as many are used
OF_TISSUE = ("frequency_mhz", "frequency_sigma_mhz", "mm_per_px", "clip", "attenuation_db_per_cm_mhz", "echo_db", "air", "steps")
FREQUENCY_SIGMA = 0.05  # relative, of a label's
STEP_SIGMA = 0.01  # relative, of steps that are given
STEP_MM = 0.2  # between B-scans that are used, about
SMOOTH = 3  # degree of the polynomial over time that a probe on a slide follows
LED = (0.2, 0.15)  # mm and deg, standard deviations off that: more is no tracking's, but a hand's
COLOURED = 16, 0.01  # difference of a pixel's colours, and share of such pixels, beyond which an image is coloured


class Fields(Part):
    """Fields of the scanner: its recordings, and what is read off the probe's label, the screen and the phantom's sheet."""

    ultrasound: Part | None = None
    """the scanner's description to begin with, of a linear array: what isn't measured stays as it has it"""
    tissue: str = ""
    """B-scans of even tissue, such as a phantom's, each elsewhere: a sweep of the capture, or a folder of images. As the scanner
    is set for all of the following: grey map, gain, beam, grains, dead columns, clock"""
    air: str = ""
    """the same of the probe in air: noise, and the ringing of its face"""
    steps: str = ""
    """the same of even tissue from a probe on a slide that moves it across its image plane: height and focus of the elements"""
    step_mm: Positive | None = None
    """mm from each of `steps` to the next; null: by the tracking of a sweep, and the probe's calibration in the capture"""
    clip: Rectangle | None = None
    """[u, v, width, height] px, the part of each image that is the B-scan, whose first row is the probe's face; null: all of it,
    from the row on that the probe's calibration has as the face"""
    mm_per_px: tuple[Positive, Positive] | None = None
    """mm, of a pixel along the array and in depth, as the scanner shows them; null: by the probe's calibration in the capture, or
    as of `ultrasound` if that has images of the same size"""
    frequency_mhz: Annotated[float, Field(ge=0.5, le=40)] | None = None
    """centre of an echo, by the probe's label; null: as of `ultrasound`"""
    frequency_sigma_mhz: Positive | None = None
    """its standard deviation; null: a twentieth of it. Apertures, heights and bandwidths are known no better than that"""
    attenuation_db_per_cm_mhz: NotNegative | None = None
    """of the tissue, by its sheet; null leaves gain over depth and noise unknown"""
    attenuation_sigma: Positive = 0.03
    """dB/cm/MHz, its standard deviation"""
    echo_db: Annotated[float, Field(ge=-60, le=60)] | None = None
    """backscatter of the tissue, by its sheet, over 1e-3 /cm/sr; null leaves gain and noise unknown"""
    echo_sigma_db: Positive = 1.0
    """its standard deviation"""


class _Recording(NamedTuple):
    """B-scans of one kind, and the sweep that they are from."""

    paths: tuple[Path, ...]
    sweep: str | None  # its name in the capture; None of a folder
    frames: NDArray[np.int64]  # numbers of the scanner's
    times: NDArray[np.int64]  # ns, of a sweep


@dataclass(frozen=True)
class Found:
    """What recordings show of a scanner, and its description with that."""

    findings: Findings
    rig: Rig  # with the probe as it was recorded
    description: Mapping[str, Any]


def identify(settings: Fields, capture: Path, manifest: Manifest, rig: Rig, watch: Watch = SILENT) -> Found | None:
    """Find the scanner's parameters; None without a recording.

    Raises
    ------
    InputError
        If a recording isn't there, has coloured images or too few, or shows no even tissue, or its pixels' size isn't known.
    """
    if not settings.tissue:
        if given := [name for name in OF_TISSUE if getattr(settings, name) not in (None, "")]:
            raise InputError(f"tissue: expected a sweep or a folder of even tissue with {given[0]}, found none")
        return None
    if settings.ultrasound is None:
        raise InputError("ultrasound: expected the description of a linear array, found none")
    if faces := settings.ultrasound.model_extra:
        raise InputError(f"ultrasound: expected the description of a linear array, found one that is {' and '.join(faces)}")
    base = settings.ultrasound.model_dump(mode="json")
    recordings = {kind: one for kind in KINDS if (one := _recording(kind, getattr(settings, kind), capture, manifest))}
    calibration = None if manifest.probe is None else probe_files.read(capture / manifest.probe)
    with watch.busy("reading B-scans"):
        chosen = {kind: _spread(kind, one) for kind, one in recordings.items() if kind != "steps"}
        clip = _clip(settings, calibration)
        images = {kind: _images([recordings[kind].paths[k] for k in which], clip) for kind, which in chosen.items()}
    for kind, stack in images.items():
        _check_size(kind, stack, images["tissue"])
    rig = _with_probe(rig, settings, base, calibration, images["tissue"])
    sheet = _sheet(settings, base, rig)
    _check_tissue(settings, images, sheet)
    found = _clocks(recordings)
    stepped = ()
    if "steps" in recordings:
        placed = _placed(settings, recordings["steps"], capture, calibration)
        if isinstance(placed, str):
            found |= Findings(unknown=dict.fromkeys((f"{GROUP}elevation_mm", f"{GROUP}elevation_focus_mm"), placed))
        else:
            which, at = placed
            stepped = _images([recordings["steps"].paths[k] for k in which], clip), at.poses, at.errors_mm
            _check_size("steps", stepped[0], images["tissue"])
    else:
        why = "no B-scans of even tissue side by side"
        found |= Findings(unknown=dict.fromkeys((f"{GROUP}elevation_mm", f"{GROUP}elevation_focus_mm"), why))
    with watch.busy("measuring the scanner"):
        found |= scanner.identify(Recordings(images["tissue"], images.get("air"), *stepped), sheet)
        found |= _dark_columns(images, sheet)
    return Found(found, rig, described(settings, base, rig, found))


def described(settings: Fields, base: Mapping[str, Any], rig: Rig, found: Findings) -> Mapping[str, Any]:
    """The scanner's description, with what was measured; InputError if it can't be."""
    assert settings.ultrasound is not None
    content = json.loads(json.dumps(base))  # a deep copy
    content |= {"image_size": list(rig.probe.image_size), "scale_mm_per_px": list(rig.probe.scale_mm_per_px)}
    if settings.frequency_mhz is not None:
        content["frequency_mhz"] = settings.frequency_mhz
    for name, one in found.estimates.items():
        if name.startswith(GROUP):
            rig_file.put(content, name.removeprefix(GROUP), one.value, "ultrasound")
    try:
        return type(settings.ultrasound).model_validate(content).model_dump(mode="json")
    except ValidationError as error:
        raise InputError(f"ultrasound: as measured, it can't be: {one_line(error)}") from error


def write(path: Path, found: Found, name: str) -> None:
    """Write the description for `ultrasound=FILE`, a line a value, with what is known of it."""
    own = {one.removeprefix(GROUP): each for one, each in found.findings.estimates.items() if one.startswith(GROUP)}
    measured = {one: Measured(sigma=each.sigma, source=each.source) for one, each in own.items()}
    unknown = {one.removeprefix(GROUP): why for one, why in found.findings.unknown.items()}
    heading = "\n".join(
        (
            f"A scanner as identified from {name}: numbers with an uncertainty (1 sigma) were measured, others are as in the",
            "description that it began with. `sonotwin VERB ultrasound=FILE` takes it, with the rig.yaml beside it as rig=FILE.",
        )
    )
    rig_file.write_fields(path, found.description, measured, unknown, heading)


def _recording(kind: str, given: str, capture: Path, manifest: Manifest) -> _Recording | None:
    """B-scans of a sweep of the capture by its name, else of a folder; as many as it takes."""
    if not given:
        return None
    least, _ = KINDS[kind]
    if given in manifest.named_sweeps:
        scans = manifest.images_of(capture, [SCANNER], given)[SCANNER]
        if scans.device.bits != 8:
            raise InputError(f"{capture / MANIFEST}: devices.{SCANNER}.bits: expected 8, found {scans.device.bits}")
        frames, times = sweep_tables.read_stamps(scans.folder / STAMPS)
        paths = tuple(frame_file(scans.folder, image_name(frame)) for frame in frames.tolist())
        found = _Recording(paths, given, frames, times)
    elif Path(given).is_dir():
        paths = tuple(image_files(Path(given)))
        found = _Recording(paths, None, np.arange(len(paths)), np.zeros(0, np.int64))
    else:
        names = [name for name in manifest.named_sweeps if name]
        there = (
            f"one of the capture's sweeps {', '.join(names)}" if names else "the name of a sweep, of which the capture has none,"
        )
        raise InputError(f"{kind}: expected {there} or a folder of images, found {given}{did_you_mean(given, names)}")
    if len(found.paths) < least:
        raise InputError(f"{kind}: expected {least} B-scans or more, found {len(found.paths)} in {given}")
    return found


def _spread(kind: str, recording: _Recording) -> NDArray[np.int64]:
    """Numbers of B-scans, evenly over the recording."""
    count = len(recording.paths)
    return np.unique(np.linspace(0, count - 1, min(count, KINDS[kind][1])).round().astype(np.int64))


def _clip(settings: Fields, calibration: ProbeCalibration | None) -> Clip | None:
    """The B-scan's part of an image."""
    if settings.clip is not None:
        return Clip(*settings.clip)
    face = 0 if calibration is None else round(calibration.face_row)
    return Clip(0, face, 1 << 20, 1 << 20) if face > 0 else None


def _images(paths: list[Path], clip: Clip | None) -> Images:
    """Grey B-scans : (n, h, w); InputError if one is coloured, deeper than 8 bits, or of another size."""
    found = list[Images]()
    for path in paths:
        image = decode_image(path, read_bytes(path))
        if image.dtype != np.uint8:
            raise InputError(f"{path}: expected 8 bits a pixel, found {8 * image.dtype.itemsize}")
        image = image if clip is None else clip.cut(image)
        if image.ndim == 3:
            coloured = float((np.ptp(image.astype(np.int16), axis=2) > COLOURED[0]).mean())
            if coloured > COLOURED[1]:
                way = "; clip=[u,v,width,height] leaves out what is around the B-scan" if clip is None else ""
                raise InputError(f"{path}: expected a grey B-scan, found {100 * coloured:.0f} % of it coloured{way}")
        if found and image.shape[:2] != found[0].shape:
            (height, width), (h, w) = found[0].shape, image.shape[:2]
            raise InputError(f"{path}: expected {width}x{height} as of those before, found {w}x{h}")
        found.append(np.asarray(luma(image, 255), np.uint8))
    return np.stack(found)


def _check_size(kind: str, images: Images, tissue: Images) -> None:
    (height, width), (h, w) = tissue.shape[1:], images.shape[1:]
    if (h, w) != (height, width):
        raise InputError(f"{kind}: expected B-scans of {width}x{height} as those of tissue, found {w}x{h}")


def _with_probe(rig: Rig, settings: Fields, base: Mapping[str, Any], calibration: ProbeCalibration | None, images: Images) -> Rig:
    """The rig with the probe as it was recorded: its image, and the place of that if it was calibrated."""
    size, speed = (images.shape[2], images.shape[1]), base["assumed_speed"]
    target_from_image = rig.probe.target_from_image
    if settings.mm_per_px is not None:
        scale = settings.mm_per_px
    elif calibration is not None:
        scale = (float(calibration.scale[0]), float(calibration.scale[1] * speed / calibration.speed_m_s))
    elif size == tuple(base["image_size"]):
        scale = tuple(base["scale_mm_per_px"])
    else:
        found = f"none, for B-scans of {size[0]}x{size[1]} px"
        raise InputError(
            f"mm_per_px: expected the size of a pixel, which neither a calibrated probe nor ultrasound has, found {found}"
        )
    if calibration is not None:
        corner = np.array([0, 0] if (clip := _clip(settings, calibration)) is None else clip.corner)
        matrix = calibration.target_from_image @ rigid.transform(np.eye(3), (*(corner * calibration.scale), 0.0))
        turn = np.rad2deg(Rotation.from_matrix(matrix[:3, :3]).as_rotvec())
        target_from_image = Pose(rotation_deg=tuple(turn.tolist()), translation_mm=tuple(matrix[:3, 3].tolist()))
    return with_image(rig, size, scale, target_from_image)


def with_image(rig: Rig, size: tuple[int, int], scale_mm_per_px: tuple[float, float], target_from_image: Pose) -> Rig:
    """The rig whose probe gives images of a size, at a place."""
    probe = Probe(image_size=size, scale_mm_per_px=scale_mm_per_px, target_from_image=target_from_image)
    return rig.model_copy(update={"probe": probe})


def _sheet(settings: Fields, base: Mapping[str, Any], rig: Rig) -> Sheet:
    frequency = base["frequency_mhz"] if settings.frequency_mhz is None else settings.frequency_mhz
    sigma = settings.frequency_sigma_mhz or FREQUENCY_SIGMA * frequency
    absorbed, echo = settings.attenuation_db_per_cm_mhz, settings.echo_db
    return Sheet(
        rig.probe.scale_mm_per_px,
        Estimate(frequency, sigma, "label"),
        None if absorbed is None else Estimate(absorbed, settings.attenuation_sigma, "sheet"),
        None if echo is None else Estimate(echo, settings.echo_sigma_db, "sheet"),
        base["assumed_speed"],
    )


def _check_tissue(settings: Fields, images: Mapping[str, Images], sheet: Sheet) -> None:
    """Refuse what can't be tissue, below the face."""
    first = int(scanner.USUAL.face_mm / sheet.mm_per_px[1])
    tissue = images["tissue"][:, first:]
    if tissue.shape[1] < 4 * first:
        found = f"{sheet.mm_per_px[1] * (tissue.shape[1] + first):.0f} mm"
        raise InputError(f"tissue: expected B-scans of {5 * scanner.USUAL.face_mm:.0f} mm or more in depth, found {found}")
    black, most_black = float((tissue == 0).mean()), 0.8
    if black > most_black:
        raise InputError(
            f"tissue: expected even tissue all over, found {100 * black:.0f} % black in {settings.tissue}: no contact?"
        )
    if "air" in images:
        mean, air = float(tissue.mean()), float(images["air"][:, first:].mean())
        least_greys = 3.0
        if mean < air + least_greys:
            found = f"a mean grey of {mean:.0f} in {settings.tissue}, and {air:.0f}"
            raise InputError(f"tissue: expected B-scans brighter than those in air, found {found}: no contact?")


class Placed(NamedTuple):
    """Places of n B-scans from a probe on a slide."""

    poses: Array  # (n, 4, 4) mm, in the frame of the middle one
    errors_mm: Array  # (q, n) of the places across the plane: q independent errors of one standard deviation


def _placed(
    settings: Fields, recording: _Recording, capture: Path, calibration: ProbeCalibration | None
) -> tuple[NDArray[np.int64], Placed] | str:
    """Numbers of B-scans side by side, and their places; else a reason."""
    count = len(recording.paths)
    if settings.step_mm is not None:
        poses = np.tile(np.eye(4), (count, 1, 1))
        poses[:, 2, 3] = settings.step_mm * np.arange(count)
        which, placed = np.arange(count), Placed(poses, STEP_SIGMA * poses[None, :, 2, 3])
    elif recording.sweep is None:
        raise InputError("step_mm: expected mm from one B-scan to the next with a folder of steps, found none")
    elif calibration is None:
        raise InputError(
            "step_mm: expected mm from one B-scan to the next, or the probe's calibration in the capture, found neither"
        )
    else:
        track = sweep_part.read_sweep(capture, recording.sweep).track
        during = track.found & (track.times >= recording.times[0]) & (track.times <= recording.times[-1])
        times = track.times[during]
        which = np.flatnonzero((recording.times >= times[0]) & (recording.times <= times[-1])) if len(times) else np.zeros(0, int)
        led = on_slide(track.poses[during] @ calibration.target_from_image, times, recording.times[which])
        if isinstance(led, str):
            return led
        placed = led
    used = beside(placed.poses)
    return which[used], Placed(placed.poses[used], placed.errors_mm[:, used])


def on_slide(world_from_image: Array, times: NDArray[np.int64], taken: NDArray[np.int64]) -> Placed | str:
    """Places, at moments : (n,) ns, of a probe on a slide, without most of the noise of its poses : (m, 4, 4) at times : (m,) ns.

    A slide goes a smooth way, a polynomial of the time, off which tracked poses scatter. A way that isn't is named as the reason.
    """
    count, parameters = len(times), SMOOTH + 1
    if min(count, len(taken)) < 2 * parameters:
        return f"{min(count, len(taken))} B-scans of steps have a pose, of {2 * parameters} or more"
    middle = world_from_image[count // 2]
    turns = np.rad2deg(Rotation.from_matrix(middle[:3, :3].T @ world_from_image[:, :3, :3]).as_rotvec())
    local = (world_from_image[:, :3, 3] - middle[:3, 3]) @ middle[:3, :3]
    design, there = (
        np.polynomial.polynomial.polyvander((each - times[0]) / (times[-1] - times[0]) - 0.5, SMOOTH) for each in (times, taken)
    )
    weights = np.linalg.lstsq(design, np.column_stack([local, turns]))[0]
    rest = np.column_stack([local, turns]) - design @ weights
    scatter = np.sqrt((rest**2).sum(axis=0) / (count - parameters))
    off_mm, off_deg = float(scatter[:3].max()), float(scatter[3:].max())
    if off_mm > LED[0] or off_deg > LED[1]:
        return f"steps were led unevenly, by {off_mm:.2f} mm and {off_deg:.2f} deg off a smooth way: put the probe on a slide"
    smooth = there @ weights
    poses = np.tile(np.eye(4), (len(taken), 1, 1))
    poses[:, :3, 3] = smooth[:, :3]
    poses[:, :3, :3] = Rotation.from_rotvec(np.deg2rad(smooth[:, 3:])).as_matrix()
    return Placed(poses, scatter[2] * (there @ np.linalg.cholesky(np.linalg.inv(design.T @ design))).T)


def beside(poses: Array) -> NDArray[np.int64]:
    """Numbers of B-scans of poses : (n, 4, 4) that are used: of the middle, about a fifth of a millimetre apart."""
    pace, most = float(np.median(np.abs(np.diff(poses[:, 2, 3])))), KINDS["steps"][1]
    stride = int(np.clip(round(STEP_MM / max(pace, 1e-6)), 1, max(len(poses) // 4, 1)))
    which = np.arange(0, len(poses), stride)
    first = max((len(which) - most) // 2, 0)
    return which[first : first + most]


def _clocks(recordings: Mapping[str, _Recording]) -> Findings:
    """Rate and jitter of the scanner's stamps, of the longest sweep."""
    names = ("clocks.scanner_hz", "clocks.scanner_jitter_s")
    longest = max(recordings.values(), key=lambda one: len(one.times))
    count, least = len(longest.times), 8
    if count < least:
        return Findings(unknown=dict.fromkeys(names, f"{count} B-scans with times, of {least} or more"))
    frames = longest.frames - longest.frames.mean()
    seconds = (longest.times - longest.times[0]) * 1e-9
    period = float(frames @ seconds / (frames @ frames))
    rest = seconds - seconds.mean() - period * frames
    jitter = float(np.sqrt((rest**2).sum() / (count - 2)))
    if jitter > period / 4:
        return Findings(unknown=dict.fromkeys(names, f"B-scans of {longest.sweep} weren't taken at an even rate"))
    source = f"times of {count} B-scans"
    rate, sigma = 1 / period, jitter / np.sqrt(frames @ frames) / period**2
    return Findings(
        {
            names[0]: Estimate(rate, float(sigma), source),
            names[1]: Estimate(jitter, float(jitter / np.sqrt(2 * (count - 2))), source),
        },
        {"clocks.lag_s": "images show no clock beside theirs: `sonotwin measure-lag` finds it"},
    )


def _dark_columns(images: Mapping[str, Images], sheet: Sheet) -> Findings:
    """Columns that stay dark, of dead elements: in tissue, and in the ringing of the face in air, if that was recorded."""
    dark = scanner.dark_columns(images["tissue"])
    if not dark or "air" not in images:
        return Findings({f"dark_columns.{column}": one for column, one in dark.items()})
    face = int(scanner.USUAL.face_mm / sheet.mm_per_px[1])
    both = dark.keys() & scanner.dark_columns(images["air"][:, :face]).keys()
    others = ", ".join(map(str, sorted(dark.keys() - both)))
    why = {"dark_columns": f"{others} are dark in tissue, but ring in air: poor contact?"} if others else {}
    return Findings({f"dark_columns.{column}": dark[column] for column in sorted(both)}, why)
