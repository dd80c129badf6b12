"""Calibrate the ultrasound probe: where the pixels of its B-scans lie in the frame of the target that it carries.

Reads the sweep part of a capture folder, B-scans of the crossing of two wires at rest in water, seen from many sides; or pairs
of a pose and the crossing's pixel, found elsewhere. Writes into the folder `out`: probe.yaml (with its covariance); the same in
the rig authors' layout, US_params.npz; frames.csv, what became of each frame; and metrics.json. A calibration that is there
already is replaced. Takes a second for thirty B-scans.

Let the probe rest at each frame, or give the lag. Tilt it by 35 degrees, mostly forward and backward, roll it as far as the
target is seen, and bring the crossing near all corners of the image in turn.

    sonotwin calibrate-probe capture=outputs/wires/capture out=outputs/probe
    sonotwin calibrate-probe capture=outputs/wires/capture temperature_c=22.4 out=outputs/probe
    sonotwin calibrate-probe pairs=pairs.csv out=outputs/probe
"""

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator
from rich.console import Console
from scipy.spatial.transform import Rotation

from recon.capture import probe_files, sweep_part, sweep_tables
from recon.capture.images import Size
from recon.capture.sweep_part import SweepCapture
from recon.errors import InputError
from recon.files import atomic, metrics
from recon.files.metrics import Metrics
from recon.model.probe import ProbeCalibration, Speed
from recon.model.rig import Finite, NotNegative, Probe, Rig
from recon.probe_calibration import point_calibration, probe_checks, repeatability, sound_in_water, wires
from recon.probe_calibration.cross_wire import Appearance, Crossing
from recon.probe_calibration.point_calibration import MIN_FRAMES, Adjustment, Noise, Sightings
from sonotwin.verbs.measure_lag import LagSeconds

PROBE = "probe.yaml"
FRAMES = "frames.csv"  # by which the folder of a probe's calibration is known
HEADER = ("frame", "status", "u", "v", "contrast_db", "residual_mm", "normalised", "reason")
ORDINARY_C = 22.0  # of water, where no temperature is given
SHOWN_DEPTH_MM = 50.0  # at which a wrong speed of sound is shown


class Config(BaseModel):
    """Fields of `conf/calibrate-probe.yaml`: what is read and written, and what is known beforehand."""

    model_config = ConfigDict(extra="forbid")

    rig: Rig
    out: Path
    capture: Path | None = None
    pairs: Path | None = None
    lag_s: LagSeconds = 0.0
    temperature_c: Finite | None = None
    temperature_sigma_c: NotNegative = 0.5
    assumed_speed: Speed = sound_in_water.SCANNER_SPEED
    medium_speed: Speed | None = None
    wire_radius_mm: NotNegative = 0.1
    wire_speed: Annotated[float, Field(ge=300, le=10000)] = 2600.0
    appearance: Appearance = Appearance()
    noise: Noise = Noise()
    seed: Annotated[int, Field(ge=0)] = 0

    @field_validator("appearance", "noise")
    @classmethod
    def _above_zero(cls, value: Appearance | Noise) -> Appearance | Noise:
        for name, numbers in dataclasses.asdict(value).items():
            if not (np.isfinite(numbers).all() and np.min(numbers) >= 0):
                raise ValueError(f"{name}: expected finite numbers from 0 on, found {numbers}")
        return value

    @field_validator("appearance")
    @classmethod
    def _of_a_scanner(cls, value: Appearance) -> Appearance:
        if not 20 <= value.dynamic_range_db <= 120:
            raise ValueError(f"dynamic_range_db: expected 20 to 120 dB, found {value.dynamic_range_db:g}")
        return value

    @field_validator("noise")
    @classmethod
    def _some(cls, value: Noise) -> Noise:
        if not any(dataclasses.astuple(value)):
            raise ValueError("expected one standard deviation above zero at least, found none: their proportions count")
        return value

    @model_validator(mode="after")
    def _one_source(self) -> "Config":
        if (self.capture is None) == (self.pairs is None):
            raise ValueError(f"expected capture or pairs, found {'neither' if self.capture is None else 'both'}")
        if self.medium_speed is not None and self.temperature_c is None:
            raise ValueError("medium_speed: expected temperature_c with it, found none")
        return self


@dataclass(frozen=True)
class Seen:
    """The crossing as it was seen, and what became of each of n frames."""

    name: str  # of the capture or file, for messages
    size: Size
    sightings: Sightings  # of the m frames that are usable
    frames: NDArray[np.int64]  # (n,) their numbers
    crossings: tuple[Crossing, ...]  # (n,)

    @property
    def usable(self) -> NDArray[np.int64]:
        """Which of the frames the sightings are of : (m,)."""
        return np.flatnonzero([crossing.found for crossing in self.crossings])


def run(config: Config) -> None:
    """Find the crossing in all frames, calibrate, judge and write.

    Raises
    ------
    InputError
        If the input is incomplete or damaged, doesn't determine the calibration, or `out` can't be written to.
    """
    console = Console(soft_wrap=True, highlight=False)
    source = config.capture or config.pairs
    assert source is not None
    atomic.check_folder(config.out, FRAMES, inputs=[source])
    if config.temperature_c is not None:
        sound_in_water.speed_of_sound(config.temperature_c)  # a mistake shows before the work
    start = perf_counter()
    seen = _look(config, console)
    seconds = {"seconds_find": round(perf_counter() - start, 3)}
    for line in report(seen, seconds["seconds_find"]):
        console.print(line, markup=False)
    refuse_few(seen)

    start = perf_counter()
    expected = config.rig.probe.target_from_image.matrix()
    try:
        found = point_calibration.calibrate(
            seen.sightings, seen.size, config.noise, expected, config.seed, ahead_mm=echo_ahead(config)
        )
        probe_checks.speed(implied_speed(found.calibration, config)[0])
    except InputError as error:
        raise InputError(f"{seen.name}: {error}") from None
    seconds["seconds_calibrate"] = round(perf_counter() - start, 3)
    calibration = with_speed(found.calibration, config)
    figures = measure(seen, found, calibration, config)
    for line in describe(seen, found, figures, config):
        console.print(line, markup=False)
    written = write(config.out, seen, found, calibration, figures | seconds)
    console.print(f"wrote       {config.out}/{{{','.join(written)}}}", markup=False)


def _look(config: Config, console: Console) -> Seen:
    if config.pairs is not None:
        return read_pairs(config.pairs, config.rig.probe)
    assert config.capture is not None
    sweep = sweep_part.read_sweep(config.capture)
    with console.status("") as status:
        return look(sweep, config.lag_s, config.appearance, status.update)


def look(sweep: SweepCapture, lag_s: float, appearance: Appearance, tell: Callable[[str], object]) -> Seen:
    """Find the crossing in the B-scans of a sweep, read one by one."""
    poses, covariance = sweep.poses(lag_s), sweep.pose_covariance(lag_s)

    def images() -> Iterator[NDArray[np.uint8]]:
        for number, image in enumerate(sweep.images()):
            tell(f"looking for the crossing, B-scan {number + 1} of {len(sweep.paths)}")
            yield image

    sightings, crossings = point_calibration.from_images(images(), poses, appearance)
    seen = Seen(sweep.name, sweep.size, sightings, sweep.frames, tuple(crossings))
    if covariance is None:
        return seen
    return replace(seen, sightings=replace(sightings, pose_covariance=covariance[seen.usable]))


def read_pairs(path: Path, design: Probe) -> Seen:
    """Read pairs of a pose and a pixel, of images as large as the rig's."""
    poses, pixels = sweep_tables.read_pairs(path)
    crossings = tuple(Crossing(pixel, np.full((2, 2), np.nan), np.nan) for pixel in pixels)
    return Seen(str(path), design.image_size, Sightings(poses, pixels), np.arange(len(pixels)), crossings)


def report(seen: Seen, seconds: float) -> Iterator[str]:
    """Lines that say in how many frames the crossing is, and why it isn't in the others."""
    width, height = seen.size
    found, count = len(seen.usable), len(seen.frames)
    yield f"find        {count} frames, {width}x{height}: crossing in {found}, {count - found} rejected, {seconds:.0f} s"
    for reason, frames in rejected(seen).items():
        yield f"rejected    {len(frames)} {reason}: frame{'s' if len(frames) > 1 else ''} {_listed(frames)}"


def rejected(seen: Seen) -> dict[str, list[int]]:
    """Numbers of the frames without a crossing, by kind of reason, the commonest first."""
    kinds: dict[str, list[int]] = {}
    for frame, crossing in zip(seen.frames.tolist(), seen.crossings, strict=True):
        if crossing.reason is not None:
            kinds.setdefault(crossing.reason.partition(":")[0], []).append(frame)
    return dict(sorted(kinds.items(), key=lambda item: -len(item[1])))


def refuse_few(seen: Seen) -> None:
    """Refuse a capture in which too few frames are usable, with the commonest reason.

    Raises
    ------
    InputError
        If fewer than six are.
    """
    if len(seen.usable) < MIN_FRAMES:
        reason = next(iter(rejected(seen)), "no more were given")
        expected = f"{MIN_FRAMES} frames or more with a pose and the crossing"
        raise InputError(f"{seen.name}: expected {expected}, found {len(seen.usable)} (most often: {reason})")


def echo_ahead(config: Config) -> float:
    """By how much the wires' echo lies before their axes, mm."""
    temperature = ORDINARY_C if config.temperature_c is None else config.temperature_c
    return wires.echo_ahead(config.wire_radius_mm, config.wire_speed, float(sound_in_water.speed_of_sound(temperature)))


def implied_speed(calibration: ProbeCalibration, config: Config) -> tuple[float, float]:
    """Speed of sound and its standard deviation, m/s, that sy tells beside the design's."""
    return sound_in_water.implied_speed(calibration, config.rig.probe.scale_mm_per_px[1], config.assumed_speed)


def with_speed(calibration: ProbeCalibration, config: Config) -> ProbeCalibration:
    """For the medium that will be scanned, where the water's temperature is known; else as it is, for the speed that sy tells."""
    if config.temperature_c is None:
        return replace(calibration, speed_m_s=implied_speed(calibration, config)[0])
    in_water = float(sound_in_water.speed_of_sound(config.temperature_c))
    wanted = config.medium_speed or config.assumed_speed
    sigma = wanted / in_water**2 * float(sound_in_water.speed_sigma(config.temperature_c, config.temperature_sigma_c))
    return sound_in_water.in_medium(calibration, in_water, wanted, ratio_sigma=sigma)


def measure(seen: Seen, found: Adjustment, calibration: ProbeCalibration, config: Config) -> Metrics:
    """Figures of a calibration, each named with its unit."""
    design = config.rig.probe
    expected = design.target_from_image.matrix()
    pixels = repeatability.five_points(seen.size)
    sigma = np.sqrt(np.trace(point_calibration.point_covariance(calibration, pixels), axis1=1, axis2=2))
    speed, speed_sigma = implied_speed(found.calibration, config)
    turn = Rotation.from_matrix(expected[:3, :3].T @ calibration.target_from_image[:3, :3]).magnitude()
    away = calibration.to_target(pixels[0]) - ProbeCalibration(expected, np.array(design.scale_mm_per_px)).to_target(pixels[0])
    known = calibration.uncertainty
    assert known is not None
    names = ("centre", "top_left", "top_right", "bottom_left", "bottom_right")
    return {
        "frames": len(seen.frames),
        "frames_rejected": len(seen.frames) - len(seen.usable),
        "frames_outliers": int(found.outliers.sum()),
        "frames_used": int((~found.outliers).sum()),
        "rms_mm": found.rms_mm,
        "noise_factor": found.noise_factor,
        "wires_apart_mm": found.apart_mm,
        "echo_ahead_mm": echo_ahead(config),
        "sx_mm_per_px": float(calibration.scale[0]),
        "sy_mm_per_px": float(calibration.scale[1]),
        "sx_sigma_mm_per_px": known.sigma("sx"),
        "sy_sigma_mm_per_px": known.sigma("sy"),
        "sy_measured_mm_per_px": float(found.calibration.scale[1]),
        **{f"sigma_{name}_mm": float(value) for name, value in zip(names, sigma, strict=True)},
        "implied_speed_m_per_s": speed,
        "implied_speed_sigma_m_per_s": speed_sigma,
        "water_speed_m_per_s": np.nan
        if config.temperature_c is None
        else float(sound_in_water.speed_of_sound(config.temperature_c)),
        "speed_m_per_s": calibration.speed_m_s,
        "design_turn_deg": float(np.degrees(turn)),
        "design_centre_mm": float(np.linalg.norm(away)),
    }


def describe(seen: Seen, found: Adjustment, figures: Metrics, config: Config) -> Iterator[str]:
    """Lines that say how well the frames agree, what came out, how sure it is, and what the speed of sound does to it."""
    frames = seen.frames[seen.usable][found.outliers].tolist()
    left_out = f", {len(frames)} outlier{'s' if len(frames) > 1 else ''} left out ({_listed(frames)})" if frames else ""
    rms, factor = figures["rms_mm"], figures["noise_factor"]
    yield f"calibrate   {figures['frames_used']} frames{left_out}; RMS {rms:.3f} mm, noise {factor:.2f} times the assumed"
    if found.apart_mm:
        ahead = f"their echo taken {figures['echo_ahead_mm']:.2f} mm before their axes"
        yield f"wires       seen as lines, the axes {found.apart_mm:.2f} mm apart; {ahead}"
    scales = ", ".join(
        f"{name} {figures[f'{name}_mm_per_px']:.5f} ± {figures[f'{name}_sigma_mm_per_px']:.5f}" for name in ("sx", "sy")
    )
    turn, away = figures["design_turn_deg"], figures["design_centre_mm"]
    yield f"probe       {scales} mm/px; {turn:.1f} deg and {away:.1f} mm from its design"
    corners = [figures[name] for name in figures if name.startswith(("sigma_top", "sigma_bottom"))]
    centre, edge = f"{figures['sigma_centre_mm']:.3f} mm", f"{min(corners):.3f} to {max(corners):.3f} mm"
    yield f"uncertain   image centre {centre}, corners {edge} (1 sigma, of the place in space)"
    speed, sigma = figures["implied_speed_m_per_s"], figures["implied_speed_sigma_m_per_s"]
    implied = f"{speed:.0f} ± {sigma:.0f} m/s by sy, if the scanner's is {config.rig.probe.scale_mm_per_px[1]:g} mm/px"
    yield f"sound       {implied} for {config.assumed_speed:g} m/s"
    if config.temperature_c is None:
        same = f"as in the medium of the calibration, {figures['speed_m_per_s']:.0f} m/s, right for sweeps through the same"
        yield f"depth       {same}; temperature_c=... converts it"
        return
    in_water, assumed = figures["water_speed_m_per_s"], config.assumed_speed
    deep = float(sound_in_water.shown_too_deep(SHOWN_DEPTH_MM, in_water, assumed))
    shown = f"{abs(deep):.2f} mm too {'deep' if deep > 0 else 'shallow'} at {SHOWN_DEPTH_MM:g} mm"
    yield f"water       {config.temperature_c:g} °C, {in_water:.1f} m/s: assuming {assumed:g}, the scanner shows echoes {shown}"
    scales = f"sy {figures['sy_measured_mm_per_px']:.5f} to {figures['sy_mm_per_px']:.5f} mm/px"
    yield f"depth       converted from this water to {config.medium_speed or assumed:g} m/s: {scales}"


def write(out: Path, seen: Seen, found: Adjustment, calibration: ProbeCalibration, figures: Metrics) -> list[str]:
    """Write all files, whole or not at all; returns their names."""
    with atomic.new_folder(out, FRAMES) as folder:
        probe_files.write(folder / PROBE, calibration)
        probe_files.write_authors(folder / probe_files.AUTHORS, calibration)
        sweep_tables.write_rows(folder / FRAMES, HEADER, rows(seen, found))
        metrics.write(folder / metrics.FILE, figures)
    return [PROBE, probe_files.AUTHORS, FRAMES, metrics.FILE]


def rows(seen: Seen, found: Adjustment) -> Iterator[Sequence[object]]:
    """What became of each frame, in the order of HEADER; empty where a frame has no such value."""
    place = {int(k): m for m, k in enumerate(seen.usable)}
    distances = np.linalg.norm(found.residuals, axis=1)
    for k, (frame, crossing) in enumerate(zip(seen.frames.tolist(), seen.crossings, strict=True)):
        contrast = f"{crossing.contrast_db:.1f}" if np.isfinite(crossing.contrast_db) else ""
        if k not in place:
            yield frame, "rejected", "", "", contrast, "", "", crossing.reason
            continue
        m = place[k]
        status = "outlier" if found.outliers[m] else "used"
        pixel = [f"{value:.3f}" for value in crossing.pixel]
        yield frame, status, *pixel, contrast, f"{distances[m]:.4f}", f"{found.normalised[m]:.3f}", ""


def _listed(frames: Sequence[int], most: int = 10) -> str:
    more = f" and {len(frames) - most} more" if len(frames) > most else ""
    return ", ".join(map(str, frames[:most])) + more
