"""Several calibrations of one probe: their repeatability, their mean, and each crossing by the calibration of the others."""

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from recon.capture import manifest, probe_files, sweep_part, sweep_tables
from recon.capture.manifest import MANIFEST, SCANNER
from recon.errors import InputError
from recon.estimation.covariance import propagate
from recon.files import atomic, metrics
from recon.files.metrics import Metrics
from recon.geometry import rigid
from recon.model.probe import ProbeCalibration, place_slopes
from recon.model.rig import Probe
from recon.probe_calibration import (
    movement,
    phantom_frames,
    point_calibration,
    probe_checks,
    probe_figures,
    repeatability,
    sound_in_water,
    tank_calibration,
)
from recon.probe_calibration.point_calibration import Adjustment
from recon.probe_calibration.repeatability import Mean
from recon.session import probe_step
from recon.session.probe_step import BY, FRAMES, PROBE, CalibratedProbe, Settings
from recon.session.watch import SILENT, Watch

Array = NDArray[np.float64]
Size = tuple[int, int]  # width, height, px

RUNS = "runs.csv"
COLUMNS = (
    *("run", "source", "frames", "frames_used", "rms_mm", "noise_mm", "held_out_mm"),
    *("shift_mm", "turn_deg", "sx_mm_per_px", "sy_mm_per_px", "chance"),
)
SAME_MM = 1e-3  # between the places of all corners: another run never comes as near
SAME_SPEED = 0.01  # relative; water that is 5 degrees warmer


@dataclass(frozen=True)
class Run:
    """One calibration of the probe."""

    name: str  # of its source, for messages and tables
    calibration: ProbeCalibration  # for the medium of later sweeps
    found: CalibratedProbe | None = None  # None for a result of before, whose frames aren't read

    @property
    def adjustment(self) -> Adjustment | None:
        """To the crossing in its frames; None for a result of before."""
        adjusted = None if self.found is None else self.found.result.adjustment
        return adjusted if isinstance(adjusted, Adjustment) else None


@dataclass(frozen=True)
class Repeated:
    """Several runs and their agreement."""

    runs: tuple[Run, ...]
    mean: Mean
    held_out_mm: Array  # (n,) of each run's crossing by the mean of the others; NaN without frames
    chances: Array  # (n,) that a run lies as far from the others or farther; NaN without covariances
    size: Size  # of the B-scans, px

    @property
    def noise_mm(self) -> Array:
        """As of `Adjustment.noise_mm` : (n,); NaN without frames."""
        return np.array([np.nan if run.adjustment is None else run.adjustment.noise_mm for run in self.runs])


def run(settings: Settings, out: Path, usual: Probe, watch: Watch = SILENT) -> None:
    """Calibrate each run, compare, and write their mean.

    Parameters
    ----------
    usual : as of `recon.session.probe_step.run`

    Raises
    ------
    InputError
        If a run is incomplete or damaged, doesn't determine its calibration, is the same as another or of another probe or
        medium, or `out` can't be written to.
    """
    atomic.check_folder(out, BY, inputs=(*settings.runs, settings.earlier))
    earlier = None if settings.earlier is None else probe_files.read(settings.earlier)
    if settings.temperature_c is not None:
        sound_in_water.speed_of_sound(settings.temperature_c)  # a mistake shows before the work
    runs = list(read_runs(settings, usual, watch))
    repeated = compare(runs, settings)
    figures = measure(repeated)
    for line in describe(repeated, figures):
        watch.say(line)
    if earlier is not None:
        figures |= probe_figures.compare(repeated.mean.calibration, earlier)
        watch.say(probe_figures.describe_comparison(figures, settings.earlier))
    written = write(out, repeated, figures)
    watch.say(f"wrote       {out}/{{{','.join(written)}}}")


def read_runs(settings: Settings, usual: Probe, watch: Watch = SILENT) -> Iterator[Run]:
    """The calibration of each run, one by one; what is wrong with their number or sources shows before the work."""
    sources = [source for path in settings.runs for source in sources_of(path)]
    if len(sources) < 2:
        expected = f"runs: expected two or more of one probe, found {len(sources)}"
        raise InputError(f"{expected}: a capture counts once for each sweep with purpose probe; one calibrates by capture=")
    places = [(os.path.realpath(path), sweep) for path, sweep in sources]
    if len(set(places)) < len(places):
        twice = next(sources[k] for k, place in enumerate(places) if place in places[:k])
        raise InputError(f"runs: expected each once, found {name_of(*twice)} twice: its repeatability would be 0")
    design = settings.rig.probe
    if settings.phantom != phantom_frames.CROSSED_WIRES and (filmed := [one for one in sources if not _is_result(one[0])]):
        expected = f"results of before, as {settings.phantom} shows no one point whose scatter is held out"
        raise InputError(
            f"runs: expected {expected}, found {name_of(*filmed[0])}: calibrate by each, and give the folders written"
        )
    if any((path / MANIFEST).is_file() for path, _ in sources):
        probe_step.say_assumed(settings, watch)
    for path, sweep in sources:
        name = name_of(path, sweep)
        if (path / MANIFEST).is_file():
            opened = sweep_part.read_sweep(path, sweep, "probe", settings.implausible)
            lag = settings.taken_lag_s, settings.clip, watch, settings.lag_sigma
            frames = replace(probe_step.look(opened, settings, *lag), name=name)
        elif path.suffix.lower() == ".csv":
            frames = phantom_frames.of_pairs(name, design.image_size, *sweep_tables.read_pairs(path))
        else:
            yield Run(name, probe_files.read(path))
            continue
        found = probe_step.calibrate(frames, design, settings, settings.scanner_sy(design, usual))
        for line in probe_figures.describe(frames, found.result, found.figures, design, settings):
            if line.startswith("warning"):
                watch.say(f"{line} ({name})")
        yield Run(name, found.result.calibration, found)


def _is_result(path: Path) -> bool:
    return not (path / MANIFEST).is_file() and path.suffix.lower() != ".csv"


def sources_of(path: Path) -> list[tuple[Path, str]]:
    """The runs of a path : its captured sweeps over crossed wires by name, or the one file of poses or of a result.

    Raises
    ------
    InputError
        If nothing is there, or a folder that holds neither.
    """
    if not path.is_dir():
        if path.suffixes[-2:] in ([".igs", ".mha"], [".igs", ".nrrd"]):
            raise InputError(f"{path}: expected a capture, pairs or a result, found a sequence: calibrate by each, give results")
        return [(path, "")]
    if (path / MANIFEST).is_file():
        sweeps = manifest.read_manifest(path).named_sweeps
        for_probe = [name for name, part in sweeps.items() if part.purpose == "probe" and SCANNER in part.images]
        return [(path, name) for name in (for_probe if len(sweeps) > 1 else sweeps)] or [(path, "")]
    if (path / PROBE).is_file():
        return [(path / PROBE, "")]
    raise InputError(f"{path}: expected a capture, or a folder that {BY} wrote, found neither {MANIFEST} nor {PROBE}")


def name_of(path: Path, sweep: str) -> str:
    """Name of a run for people."""
    return f"{path} {sweep}".rstrip()


def compare(runs: Sequence[Run], settings: Settings) -> Repeated:
    """Find the mean of some runs, and how each agrees with the others.

    Raises
    ------
    InputError
        If two are the same, or one is of another probe, scanner or speed of sound.
    """
    sizes = {run.name: run.found.frames.size for run in runs if run.found is not None}
    size = next(iter(sizes.values()), settings.rig.probe.image_size)
    for name, other in sizes.items():
        if other != size:
            raise InputError(f"{name}: expected B-scans of {size[0]}x{size[1]} px as before, found {other[0]}x{other[1]}")
    calibrations = [run.calibration for run in runs]
    refuse_unlike(runs, repeatability.five_points(size))
    shared = shared_errors(runs, settings)
    others = repeatability.against_others(calibrations, shared)
    held_out = [held_out_mm(run, mean, settings) for run, (mean, _) in zip(runs, others, strict=True)]
    chances = np.array([chance for _, chance in others])
    return Repeated(tuple(runs), repeatability.mean(calibrations, shared), np.array(held_out), chances, size)


def refuse_unlike(runs: Sequence[Run], points: Array) -> None:
    """Refuse runs that are one and the same, or that differ by more than one probe, scanner and medium do.

    points : (5, 2) px
    """
    first = runs[0]
    for k, run in enumerate(runs):
        there = run.calibration.to_target(points)
        for before in runs[:k]:
            if np.abs(there - before.calibration.to_target(points)).max() < SAME_MM:
                found = f"the same as {before.name}: the same frames twice? Their repeatability would be 0"
                raise InputError(f"{run.name}: expected another run, found {found}")
        speeds = run.calibration.speed_m_s, first.calibration.speed_m_s
        if abs(speeds[0] / speeds[1] - 1) > SAME_SPEED:
            found = f"{speeds[0]:.0f} m/s: calibrate all with temperature_c, or all without"
            raise InputError(f"{run.name}: speed_m_s: expected some {speeds[1]:.0f} m/s as of {first.name}, found {found}")
        scale, usual = run.calibration.scale, first.calibration.scale
        if (np.abs(scale / usual - 1) > tank_calibration.SAME_WIDTH).any():
            found = f"{scale[0]:.5f}, {scale[1]:.5f}: another depth setting or scanner?"
            raise InputError(f"{run.name}: scale: expected some {usual[0]:.5f}, {usual[1]:.5f} mm/px, found {found}")
        step = rigid.difference(first.calibration.target_from_image, run.calibration.target_from_image)
        turn, shift = np.degrees(np.linalg.norm(step[:3])), np.linalg.norm(step[3:])
        if turn > probe_checks.ALIKE_DEG or shift > probe_checks.ALIKE_MM:
            found = f"{turn:.0f} deg and {shift:.0f} mm from it: another probe, bracket or target?"
            raise InputError(f"{run.name}: expected the probe of {first.name}, found it {found}")


def shared_errors(runs: Sequence[Run], settings: Settings) -> Array:
    """Change : (n, 3, 8) of each run by one standard deviation of the wires' radius, of the tank's speed and of the lag."""
    found = np.zeros((len(runs), 3, 8))
    speed, sigma = settings.water_speed, settings.water_speed_sigma
    for k, run in enumerate(runs):
        calibration = run.calibration
        found[k, 0, 5:] = settings.echo_ahead_sigma_mm * calibration.target_from_image[:3, 1]
        if settings.tank_known:
            faster = sound_in_water.in_medium(calibration, speed, speed + sigma)
            found[k, 1] = repeatability.step_between(calibration, faster)
        adjusted = run.adjustment
        if adjusted is not None and adjusted.by_lag is not None:
            late = repeatability.after(adjusted.calibration, adjusted.by_lag)
            found[k, 2] = repeatability.step_between(*(in_medium_of(each, settings) for each in (adjusted.calibration, late)))
    return found


def in_medium_of(measured: ProbeCalibration, settings: Settings) -> ProbeCalibration:
    """A calibration in the tank's water, for the medium of later sweeps."""
    if not settings.tank_known:
        return measured
    return sound_in_water.in_medium(measured, settings.water_speed, settings.wanted_speed)


def held_out_mm(run: Run, others: ProbeCalibration, settings: Settings) -> float:
    """Distance, mm, of a run's crossing from one place by the mean of the others; NaN of one without frames."""
    if run.found is None or run.adjustment is None:
        return np.nan
    if settings.tank_known:
        others = sound_in_water.in_medium(others, settings.wanted_speed, settings.water_speed)
    return point_calibration.held_out_mm(
        run.found.frames.sightings, run.adjustment, others, settings.noise, settings.echo_ahead_mm
    )


def measure(repeated: Repeated) -> Metrics:
    """Figures of the runs together, each named with its unit."""
    points = repeatability.five_points(repeated.size)
    calibrations, mean = [run.calibration for run in repeated.runs], repeated.mean
    figures: Metrics = {"runs": len(calibrations)}
    for name, values in (("cr1", repeatability.cr1(calibrations, points)), ("cr2", repeatability.cr2(calibrations, points))):
        figures |= {f"{name}_{place}_mm": value for place, value in repeatability.at_places(values).items()}
    expected = {"cr1": np.full(5, np.nan), "cr2": np.full(5, np.nan)}
    if mean.singles is not None:
        slopes = place_slopes(mean.calibration.target_from_image, mean.calibration.scale, points)
        covariances = propagate(slopes, mean.singles[:, None])
        expected = {"cr1": repeatability.expected_cr1(covariances), "cr2": repeatability.expected_cr2(covariances)}
    for name, values in expected.items():
        figures |= {f"{name}_{place}_expected_mm": value for place, value in repeatability.at_places(values).items()}
    figures |= {"chi_square": mean.chi_square, "chi_square_freedom": mean.freedom, "chi_square_chance": mean.chance}
    both = np.isfinite(repeated.held_out_mm)
    for name, values in (("noise", repeated.noise_mm), ("held_out", repeated.held_out_mm)):
        figures[f"{name}_mm"] = float(np.sqrt(np.mean(values[both] ** 2))) if both.any() else np.nan
    found, uncertainty = mean.calibration, mean.calibration.uncertainty
    assert uncertainty is not None
    sigma = np.sqrt(np.trace(point_calibration.point_covariance(found, points), axis1=1, axis2=2))
    return figures | {
        **{f"sigma_{name}_mm": float(value) for name, value in zip(probe_figures.FIVE_POINTS, sigma, strict=True)},
        "sx_mm_per_px": float(found.scale[0]),
        "sy_mm_per_px": float(found.scale[1]),
        "sx_sigma_mm_per_px": uncertainty.sigma("sx"),
        "sy_sigma_mm_per_px": uncertainty.sigma("sy"),
        "speed_m_per_s": found.speed_m_s,
    }


def rows(repeated: Repeated) -> Iterator[tuple[object, ...]]:
    """A row a run, in the order of COLUMNS; empty where a run has no such value."""
    middle, mean = repeatability.five_points(repeated.size)[0], repeated.mean.calibration
    numbers = zip(repeated.runs, repeated.noise_mm, repeated.held_out_mm, repeated.chances, strict=True)
    for number, (run, noise, held_out, chance) in enumerate(numbers, 1):
        figures = {} if run.found is None else run.found.figures
        shift = np.linalg.norm(run.calibration.to_target(middle) - mean.to_target(middle))
        turn = Rotation.from_matrix(mean.target_from_image[:3, :3].T @ run.calibration.target_from_image[:3, :3]).magnitude()
        counts = figures.get("frames", ""), figures.get("frames_used", "")
        distances = [figures.get("rms_mm", np.nan), noise, held_out, shift, np.degrees(turn)]
        scale = [f"{value:.6f}" for value in run.calibration.scale]
        shown = [f"{value:.4f}" if np.isfinite(value) else "" for value in distances]
        yield number, run.name, *counts, *shown, *scale, f"{chance:.3g}" if np.isfinite(chance) else ""


def describe(repeated: Repeated, figures: Metrics) -> Iterator[str]:
    """Lines: a table of the runs, their repeatability, and the mean with its uncertainty."""
    yield "run          used     RMS  noise  held out   shift    turn  chance  source"
    yield "                       mm     mm        mm      mm     deg"
    for row in rows(repeated):
        number, name, frames, used, rms, noise, held_out, shift, turn, _, _, chance = row
        counted = f"{used}/{frames}" if frames else ""
        cells = f"{_short(rms):>6} {_short(noise):>6} {_short(held_out):>9} {_short(shift):>7} {_short(turn):>7} {chance:>7}"
        yield f"{number!s:11} {counted:>5}  {cells}  {name}"
    width, height = repeated.size
    for name in ("cr1", "cr2"):
        places = [_with_expected(figures, name, place) for place in ("centre", "corners", "mean")]
        text = "centre {}, corners {}, mean of the five {} mm".format(*places)
        yield f"repeats     {name.upper()}, {width}x{height} px: {text} (expected)"
    yield _agreement(figures)
    if np.isfinite(figures["held_out_mm"]):
        text = f"by the other runs' calibration {figures['held_out_mm']:.3f} mm, by noise alone {figures['noise_mm']:.3f} mm"
        yield f"held out    crossing of a run about one place: {text} (rms)"
    mean = repeated.mean.calibration
    corners = [figures[f"sigma_{name}_mm"] for name in probe_figures.FIVE_POINTS[1:]]
    scales = ", ".join(
        f"{name} {figures[f'{name}_mm_per_px']:.5f} ± {figures[f'{name}_sigma_mm_per_px']:.5f}" for name in ("sx", "sy")
    )
    yield f"mean        {scales} mm/px, for {mean.speed_m_s:.0f} m/s"
    yield f"pose        {probe_checks.described(mean)}"
    edge = f"{min(corners):.3f} to {max(corners):.3f} mm"
    yield f"uncertain   image centre {figures['sigma_centre_mm']:.3f} mm, corners {edge} (1 sigma, of the place in space)"


def _short(value: object) -> str:
    return str(value)[:-1]  # of four digits three


def _with_expected(figures: Metrics, name: str, place: str) -> str:
    expected = figures[f"{name}_{place}_expected_mm"]
    return f"{figures[f'{name}_{place}_mm']:.3f}" + (f" ({expected:.3f})" if np.isfinite(expected) else "")


def _agreement(figures: Metrics) -> str:
    """One line: whether the runs scatter as their covariances predict."""
    chi, freedom, chance = (figures[name] for name in ("chi_square", "chi_square_freedom", "chi_square_chance"))
    if np.isnan(chi):
        return "agree       not judged, as a run has no covariance; that of the mean is by the scatter alone"
    found = f"chi-square {chi:.1f} of {freedom}, chance {chance:.2g}"
    if chance >= movement.CHANCE:
        return f"agree       the runs scatter as their covariances predict: {found}"
    likely = "a bracket that was taken off or slipped between runs, or water of another temperature"
    return f"warning     the runs scatter more than their covariances predict: {found}: {likely}"


def write(out: Path, repeated: Repeated, figures: Metrics) -> list[str]:
    """Write all files, whole or not at all; returns their names."""
    with atomic.new_folder(out, BY) as folder:
        probe_files.write(folder / PROBE, repeated.mean.calibration)
        probe_files.write_authors(folder / probe_files.AUTHORS, repeated.mean.calibration)
        sweep_tables.write_rows(folder / RUNS, COLUMNS, rows(repeated))
        sweep_tables.write_rows(folder / FRAMES, ("run", *probe_figures.COLUMNS), _frames(repeated.runs))
        metrics.write(folder / metrics.FILE, figures)
    return [PROBE, probe_files.AUTHORS, RUNS, FRAMES, metrics.FILE]


def _frames(runs: Sequence[Run]) -> Iterator[tuple[object, ...]]:
    """A row a frame of all runs."""
    for number, run in enumerate(runs, 1):
        if run.found is not None:
            for row in probe_figures.rows(run.found.frames, run.found.result.adjustment):
                yield number, *row
