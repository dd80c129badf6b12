"""Calibrate cameras and projector, all at once, from images of a board in many poses.

Reads the board part of a capture folder: in each pose the lit board and, for the projector, a fringe sequence along both axes.
Writes into the folder `out`: optics.yaml (with the covariance); the same in the rig authors' layout, cam1_proj_params.npz,
cam1_cam2_params.npz and StereoParams.xml; metrics.json; and calibration.html (open it in a browser; it needs no network). A
calibration that is there already is replaced. Takes some seconds a pose, and about a minute for the adjustment.

    sonotwin calibrate-optics capture=outputs/board/capture out=outputs/board/calibration
    sonotwin calibrate-optics capture=outputs/board/capture truth=outputs/board/truth out=outputs/board/calibration
"""

import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from time import perf_counter
from typing import Any, Literal

import numpy as np
from pydantic import PrivateAttr
from rich.console import Console

from recon.capture import board_part, calibration_files, manifest, meza2021
from recon.capture.board_part import BoardCapture
from recon.errors import InputError
from recon.files import atomic, metrics
from recon.files.metrics import Metrics, shown
from recon.model.calibration import Calibration
from recon.optical_calibration import calibration_report, figures_of_merit
from recon.optical_calibration.distortion_selection import ModelName
from recon.optical_calibration.joint_calibration import Result, Settings, calibrate
from recon.optical_calibration.observations import Size
from recon.optical_calibration.sightings import Sighting, sight

PAGE = "calibration.html"  # by which the folder of a calibration is known
OPTICS = "optics.yaml"
DEVICES = ("cam1", "cam2", "projector")  # in the order in which they are adjusted; the first is the world
CONTENTS = {
    OPTICS: "all devices with the covariance of their parameters; OpenCV FileStorage",
    meza2021.PARAMETERS: "camera 1 and projector in the rig authors' layout",
    meza2021.STEREO_PARAMETERS: "camera 1 and camera 2 in the rig authors' layout",
    meza2021.STEREO_XML: "the same as OpenCV FileStorage",
    metrics.FILE: "the figures of this page",
    PAGE: "this page",
}


class Config(Settings):
    """Fields of `conf/calibrate-optics.yaml`: what is read and written, and how the calibration is done."""

    capture: Path
    out: Path
    truth: Path | None = None
    distortion: Literal["auto", ModelName] = "auto"  # as one list of choices, for the message
    _overrides: Sequence[str] = PrivateAttr(())  # field=value as they were given

    def model_post_init(self, context: Any) -> None:
        """Keep the overrides, for the command that the page shows."""
        if context:
            self._overrides = context["overrides"]


def run(config: Config) -> None:
    """Find the board in all poses, adjust, judge and write.

    Raises
    ------
    InputError
        If the capture is incomplete or damaged, doesn't determine the devices, or `out` can't be written to.
    """
    console = Console(soft_wrap=True, highlight=False)
    inputs = [path for path in (config.capture, config.truth) if path is not None]
    atomic.check_folder(config.out, PAGE, inputs=inputs)
    captured = board_part.read_board(config.capture)
    sizes = sizes_of(captured)
    truth = None if config.truth is None else calibration_files.read_for(config.truth / manifest.OPTICS, sizes)

    start = perf_counter()
    sightings = []
    with console.status("") as status:
        for number, name in enumerate(captured.poses):
            status.update(f"looking for the board, pose {name}, {number + 1} of {len(captured.poses)}")
            sightings.append(look(captured, number))
    seconds = {"seconds_detect": round(perf_counter() - start, 3)}
    console.print(f"detect      {found_by(sightings, sizes)}, {seconds['seconds_detect']:.0f} s", markup=False)
    missed = not_found(sightings)
    for line in dropped(missed):
        console.print(line, markup=False)
    refuse_lonely(sightings, captured.name)

    start = perf_counter()
    with console.status("adjusting"):
        settings = Settings(**{name: getattr(config, name) for name in Settings.model_fields})
        result = calibrate(sightings, captured.board, sizes, settings, name=captured.name)
        result = with_absent(result, sizes, captured.cameras)
    seconds["seconds_adjust"] = round(perf_counter() - start, 3)
    figures = figures_of_merit.measure(result, truth)
    contradicting = {name: reason for name, reason in result.dropped.items() if name not in missed}
    for line in (*dropped(contradicting), *describe(result, figures, seconds["seconds_adjust"])):
        console.print(line, markup=False)
    written = write(config, result, figures | seconds, truth)
    console.print(f"wrote       {config.out}/{{{','.join(written)}}}", markup=False)


def sizes_of(captured: BoardCapture) -> dict[str, Size]:
    """Image sizes of the devices that take part, in the order in which they stand in the calibration.

    Raises
    ------
    InputError
        If camera 1, whose frame is the world, is not among them.
    """
    sizes = {name: captured.devices[name].size for name in captured.cameras}
    if captured.patterns is not None:
        sizes["projector"] = captured.patterns.projector_size
    if DEVICES[0] not in sizes:
        raise InputError(f"{captured.name}: expected images of {DEVICES[0]}, the world's frame, found {', '.join(sizes)}")
    return {name: sizes[name] for name in DEVICES if name in sizes}


def look(captured: BoardCapture, number: int) -> Sighting:
    """Read the images of one pose and find the board in those of the cameras that can be calibrated."""
    pose = captured.pose(number)
    lit = {camera: image for camera, image in pose.lit.items() if camera in DEVICES}
    bits = {name: device.bits for name, device in captured.devices.items()}
    return sight(pose.name, captured.board, lit, pose.fringes, captured.patterns, bits)


def sees(sighting: Sighting, device: str) -> bool:
    """Whether a device sees any point of a pose."""
    return device in sighting.pixels and bool(np.isfinite(sighting.pixels[device]).all(axis=-1).any())


def found_by(sightings: Sequence[Sighting], devices: Mapping[str, Size]) -> str:
    """How many poses each device saw."""
    counts = (f"{device} {sum(sees(sighting, device) for sighting in sightings)}" for device in devices)
    return f"{len(sightings)} poses: {', '.join(counts)}"


def not_found(sightings: Sequence[Sighting]) -> dict[str, str]:
    """Pose and device -> why it saw nothing of the board there."""
    return {f"{sighting.name} {device}": reason for sighting in sightings for device, reason in sighting.failures.items()}


def dropped(reasons: Mapping[str, str]) -> Iterator[str]:
    """Lines that say what was left out."""
    for name, reason in reasons.items():
        yield f"dropped     {name}: {reason}"


def refuse_lonely(sightings: Sequence[Sighting], name: str) -> None:
    """Refuse a capture in which fewer than two devices see the board: nothing can be measured with one.

    Raises
    ------
    InputError
        With the commonest reason.
    """
    seeing = {device for sighting in sightings for device in sighting.pixels if sees(sighting, device)}
    if len(seeing) >= 2:
        return
    reasons = [f"{device}: {reason}" for sighting in sightings for device, reason in sighting.failures.items()]
    why = f" ({max(set(reasons), key=reasons.count)})" if reasons else ""
    raise InputError(f"{name}: expected two devices or more that see the board, found {', '.join(seeing) or 'none'}{why}")


def with_absent(result: Result, devices: Mapping[str, Size], cameras: Sequence[str]) -> Result:
    """A result with a warning for each device of the capture that it doesn't have, and each camera without a place in it."""
    absent = [device for device in devices if device not in result.observations.devices]
    lines = [f"{device}: not calibrated, as it saw the board in no pose" for device in absent]
    lines += [f"{name}: not calibrated, as only {', '.join(DEVICES)} can be" for name in cameras if name not in DEVICES]
    return replace(result, warnings=(*lines, *result.warnings))


def describe(result: Result, figures: Metrics, seconds: float) -> Iterator[str]:
    """Lines that say how well the poses fit, what the result is good for, and what is doubtful."""
    devices = result.observations.devices
    remaining = ", ".join(f"{device} {shown(figures[f'reprojection_rms_{device}_px'], '.4f')}" for device in devices)
    models = ", ".join(dict.fromkeys(result.model[device] for device in devices))
    yield f"adjust      {figures['poses']} poses, {models}; reprojection RMS {remaining} px; {seconds:.0f} s"
    point, shape = (shown(figures[f"{name}_sigma_mm"], ".4f", " mm") for name in ("point", "shape"))
    yield f"uncertain   point {point}, within a shape {shape}, scale {shown(figures['scale_sigma_ppm'], '.0f', ' ppm')} (1 sigma)"
    if "point_error_rms_mm" in figures:
        point, shape = (shown(figures[f"{name}_error_rms_mm"], ".4f", " mm") for name in ("point", "shape"))
        yield f"error       point {point}, within a shape {shape}, against the true calibration (RMS)"
    for line in result.warnings:
        yield f"warning     {line}"


def write(config: Config, result: Result, figures: Metrics, truth: Calibration | None) -> list[str]:
    """Write all files, whole or not at all; returns their names."""
    found = result.adjustment.calibration
    with atomic.new_folder(config.out, PAGE) as folder:
        calibration_files.write(folder / OPTICS, found)
        names = [OPTICS, *meza2021.write_parameters(folder, found), metrics.FILE, PAGE]
        metrics.write(folder / metrics.FILE, figures)
        outputs = [(name, CONTENTS[name]) for name in names]
        command = shlex.join(["sonotwin", "calibrate-optics", *config._overrides])
        calibration_report.write(folder / PAGE, result, figures, outputs, [command], truth)
    return names
