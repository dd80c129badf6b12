"""Cameras and projector from images of a board: the settings of the step, the step, and the files of its result."""

import re
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter
from typing import Literal

from recon.capture import board_part, calibration_files, manifest
from recon.capture.board_part import BoardCapture
from recon.capture.layouts import meza2021
from recon.errors import InputError
from recon.files import atomic, metrics
from recon.files.metrics import Metrics, shown
from recon.model.calibration import Calibration
from recon.optical_calibration import board_frames, calibration_report, figures_of_merit, joint_calibration, known_length
from recon.optical_calibration.board_frames import DeviceName
from recon.optical_calibration.distortion_selection import ModelName
from recon.optical_calibration.joint_calibration import Result
from recon.optical_calibration.observations import PROJECTOR
from recon.optical_calibration.sightings import Cause, Failure, light
from recon.pattern_trials import likely_patterns
from recon.session.settings import BoardField, BoardLengthField
from recon.session.watch import SILENT, Watch
from recon.structured_light import surface_figures

BY = "calibrate-optics"  # who writes
PAGE = "calibration.html"
OPTICS = "optics.yaml"
MANY, MOST_LISTED = 4, 40  # poses that are dropped alike, which are one line; and of these that it lists
CONTENTS = {
    OPTICS: "all devices with the covariance of their parameters; OpenCV FileStorage",
    meza2021.PARAMETERS: "camera 1 and projector in the rig authors' layout",
    meza2021.STEREO_PARAMETERS: "camera 1 and camera 2 in the rig authors' layout",
    meza2021.STEREO_XML: "the same as OpenCV FileStorage",
    metrics.FILE: "the figures of this page",
    PAGE: "this page",
}


class Settings(BoardLengthField, BoardField, joint_calibration.Settings):
    """Sources, and settings of the calibration."""

    capture: Path
    """a capture folder whose manifest has a board part"""
    truth: Path | None = None
    """truth/ folder of a rendered capture; only the report compares with it"""
    devices: tuple[DeviceName, ...] | None = None
    """that are calibrated, of cam1, cam2 and projector: [cam1,projector], [cam1]; null: all of the capture"""
    distortion: Literal["auto", ModelName] = "auto"  # as one list of choices, for the message
    """none, radial1, radial2, decentred, brown, rational, thin_prism, tilted; auto takes, for each device, brown, or rational
    if that predicts poses left out better"""


@dataclass(frozen=True)
class Optics:
    """Calibrated devices, with the covariance of their parameters."""

    result: Result
    figures: Metrics


def run(settings: Settings, out: Path, command: str, watch: Watch = SILENT) -> None:
    """Find the board in all poses, adjust, judge and write.

    Parameters
    ----------
    command : the command line that does the same, for the page

    Raises
    ------
    InputError
        If the capture is incomplete or damaged, doesn't determine the devices, or `out` can't be written to.
    """
    atomic.check_folder(out, BY, inputs=(settings.capture, settings.truth))
    captured = board_part.read_board(settings.capture)
    sizes = board_frames.sizes_of(captured, settings.devices)
    truth = None if settings.truth is None else calibration_files.read_for(settings.truth / manifest.OPTICS, sizes)
    found = calibrate(captured, settings, settings.devices, truth, watch, settings.board_scale, settings.board_length_mm)
    names = write(out, found, command, truth)
    watch.say(f"wrote       {out}/{{{','.join(names)}}}")


def calibrate(
    captured: BoardCapture,
    settings: joint_calibration.Settings | None = None,
    devices: tuple[DeviceName, ...] | None = None,
    truth: Calibration | None = None,
    watch: Watch = SILENT,
    board_scale: float | None = None,
    board_length_mm: tuple[float, float] | None = None,
) -> Optics:
    """Calibrate cameras and projector, all at once, by a board in many poses.

    Parameters
    ----------
    devices : that are calibrated; None for all of the capture
    truth : of a rendered capture, for the figures alone
    board_scale : relative standard deviation of the print's scale, which no image shows; 0 leaves what its shape says of it, None
        is that of paper
    board_length_mm : of its longest row or column as measured, and its standard deviation, which give the scale

    Raises
    ------
    InputError
        If the images don't determine the devices, or contradict the board's design.
    """
    sizes = board_frames.sizes_of(captured, devices)
    start = perf_counter()
    looking = board_frames.look_at_all(captured, sizes)
    sightings = list(watch.follow(looking, len(captured.poses), "looking for the board"))
    seconds = {"seconds_detect": round(perf_counter() - start, 3)}
    watch.say(f"detect      {board_frames.found_by(sightings, sizes)}, {seconds['seconds_detect']:.0f} s")
    missed = board_frames.not_found(sightings)
    for line in (*dropped(missed), *surface_figures.bent(light(sightings))):
        watch.say(line)

    start = perf_counter()
    try:
        board_frames.refuse_lonely(sightings, sizes, captured.name)
        with watch.busy("adjusting"):
            result = joint_calibration.calibrate(sightings, captured.board, sizes, settings, name=captured.name)
    except InputError as error:
        others = other_patterns(captured, sizes, watch)
        raise InputError(f"{error} ({others})" if others else str(error)) from None
    result = board_frames.with_absent(result, sizes, captured.cameras)
    if PROJECTOR not in result.observations.devices and (others := other_patterns(captured, sizes, watch)):
        result = replace(result, warnings=(*result.warnings, f"{PROJECTOR}: {others}"))
    if beyond := sum(failure.cause is Cause.CODE_OUTSIDE for failure in missed.values()):
        cause = "other patterns than those that were shown make a wrong calibration: are projector_size, pitch and start right?"
        result = replace(
            result, warnings=(f"{PROJECTOR}: the code leaves its image in {beyond} poses; {cause}", *result.warnings)
        )
    seconds["seconds_adjust"] = round(perf_counter() - start, 3)
    result, larger = known_length.with_length(result, board_scale, board_length_mm, captured.name)
    figures = figures_of_merit.measure(result, truth)
    if board_length_mm is not None:
        figures |= {"board_length_mm": board_length_mm[0], "scale_change_ppm": 1e6 * larger}
    contradicting = {name: reason for name, reason in result.dropped.items() if name not in missed}
    for line in (*dropped(contradicting), *turned(result), *describe(result, figures, seconds["seconds_adjust"])):
        watch.say(line)
    return Optics(result, figures | seconds)


def other_patterns(captured: BoardCapture, sizes: Collection[str], watch: Watch) -> str:
    """Fields of the patterns that would fit the images, for messages; nothing if none would, or no projector is calibrated."""
    if PROJECTOR not in sizes:
        return ""
    with watch.busy("trying other patterns"):
        fields = likely_patterns.likely(captured)
    return "" if fields is None else f"the images fit patterns with {fields} in each set of fringes"


def dropped(reasons: Mapping[str, str | Failure]) -> Iterator[str]:
    """Lines: poses and devices left out, with the reasons; one line for many that differ in numbers alone."""
    alike: dict[tuple[str, str], list[str]] = {}
    for name, reason in reasons.items():
        alike.setdefault((name.rpartition(" ")[2], re.sub(r"\d+(\.\d+)?", "#", str(reason))), []).append(name)
    for (device, _), names in alike.items():
        if len(names) < MANY:
            yield from (f"dropped     {name}: {reasons[name]}" for name in names)
            continue
        poses = [name.removesuffix(f" {device}") for name in names]
        listed = ", ".join(poses) if len(poses) <= MOST_LISTED else f"{', '.join(poses[:MOST_LISTED])} and others"
        yield f"dropped     {device} in {len(names)} poses alike, such as {names[0]}: {reasons[names[0]]} (poses {listed})"


def turned(result: Result) -> Iterator[str]:
    """Lines: poses in which a board that maps onto itself was taken for turned."""
    for device, poses in result.turned.items():
        yield f"turned      {', '.join(poses)}: {device} took the board the other way round than in other poses"


def describe(result: Result, figures: Metrics, seconds: float) -> Iterator[str]:
    """Lines: predicted errors of points, which are what a calibration is worth; residuals of the poses; true errors; warnings."""
    devices = result.observations.devices
    remaining = ", ".join(f"{device} {shown(figures[f'reprojection_rms_{device}_px'], '.4f')}" for device in devices)
    models = ", ".join(dict.fromkeys(result.model[device] for device in devices))
    if "point_sigma_mm" in figures:
        point, shape = (shown(figures[f"{name}_sigma_mm"], ".4f", " mm") for name in ("point", "shape"))
        scale = shown(figures["scale_sigma_ppm"], ".0f", " ppm")
        yield f"uncertain   point {point}, within a shape {shape}, scale {scale} (1 sigma)"
        length = known_length.length_of(result.adjustment.points, known_length.longest(result.observations.points))
        if "scale_change_ppm" in figures:
            change = float(figures["scale_change_ppm"])
            told = f"{figures['board_length_mm']:.3f} mm, {length / (1 + 1e-6 * change):.3f} by the images"
            yield f"scale       {change:+.0f} ppm by {told}"
        yield known_length.describe(1e-6 * float(figures["scale_sigma_ppm"]), length)
    else:
        seen = shown(figures[f"projection_sigma_{devices[0]}_px"], ".4f", " px")
        yield f"uncertain   projection {seen} (1 sigma); one camera alone measures no points"
    yield f"adjust      {figures['poses']} poses, {models}; reprojection RMS {remaining} px; {seconds:.0f} s"
    if "halves_rms_sigma" in figures:
        rms, worst = (shown(figures[f"halves_{name}_sigma"], ".1f") for name in ("rms", "worst"))
        yield f"halves      two halves of the poses differ by {rms} predicted sigma (RMS), at most {worst}; 1 is expected"
    yield f"board       {figures_of_merit.describe_board(result, figures)}"
    if "point_error_rms_mm" in figures:
        point, shape = (shown(figures[f"{name}_error_rms_mm"], ".4f", " mm") for name in ("point", "shape"))
        yield f"error       point {point}, within a shape {shape}, against the true calibration (RMS)"
    for line in result.warnings:
        yield f"warning     {line}"


def write(out: Path, found: Optics, command: str, truth: Calibration | None) -> list[str]:
    """Write all files, whole or not at all; returns their names."""
    calibration = found.result.adjustment.calibration
    with atomic.new_folder(out, BY) as folder:
        calibration_files.write(folder / OPTICS, calibration)
        names = [OPTICS, *meza2021.write_parameters(folder, calibration), metrics.FILE, PAGE]
        metrics.write(folder / metrics.FILE, found.figures)
        outputs = [(name, CONTENTS[name]) for name in names]
        calibration_report.write(folder / PAGE, found.result, found.figures, outputs, [command], truth)
    return names
