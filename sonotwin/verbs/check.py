"""Check whether the rig is still as it was calibrated: cameras, projector, target, probe and the scanner's clock.

Reads a capture folder with the calibrations in use and any of three parts, taken before a session in two minutes: a film in which
both cameras see the target moved about, tilted to all sides; a fringe sequence of anything smooth, seen by both cameras, best
with fringes along both axes; and ten seconds of tracked B-scans over a flat, rough bottom in water, the probe rolled, tilted and
moved up and down. Compares the rig that `sonotwin identify` made of today's captures, `today=FOLDER`, number by number with an
earlier one, `rig=FILE`; `capture` may then be left out. Writes into the folder `out` check.html, the verdicts with their course
over the days of `log`, and check.json. An error that the calibrations admit by their covariance, and usual drift, are no alarm;
where nothing else has moved, optics.yaml beside them is the calibration corrected for such drift. Control charts over the days of
`log` find drift that no single check shows. Exit status 1 if something has moved, drifted or changed. Takes some seconds.

    sonotwin check capture=outputs/morning out=outputs/check log=outputs/rig.jsonl lag=outputs/lag/lag.json
    sonotwin check capture=outputs/morning film=target tracked=outputs/tracked lag=outputs/lag/lag.json out=outputs/check
"""

from collections.abc import Collection, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
from pydantic import Field

from recon.capture import calibration_files, lag_files, manifest, probe_files, stereo_frames, sweep_part
from recon.capture.manifest import CAMERAS, MANIFEST, SCANNER, Manifest
from recon.errors import Implausible, InputError
from recon.files import atomic
from recon.model import circle_layout
from recon.model.calibration import Calibration, in_use
from recon.model.probe import ProbeCalibration
from recon.model.rig import NotNegative, Positive, Rig, Target
from recon.probe_calibration import sound_in_water
from recon.registry import Choice
from recon.rig_check import bottom_equations, check_log, check_page, control_charts, drift, rig_versions, verdicts
from recon.rig_check.bottom_equations import Known
from recon.rig_check.optics_equations import PROJECTOR
from recon.rig_check.rig_versions import Comparison
from recon.rig_check.verdicts import Optics, Verdict
from recon.session import drift_step, latency_step, poses_step, rig_step
from recon.session.tracker_settings import MeasuredTargetFields, make_tracker, target_of
from recon.target_calibration import target_poses
from recon.tracking import track_figures
from recon.tracking.pose_fit import Sighting
from sonotwin import choices
from sonotwin.console_watch import ConsoleWatch

DEVICES = (*CAMERAS, PROJECTOR, "target")  # what film and fringes show
CHECK, PAGE = "check.json", "check.html"
UNKNOWN_LAG_S = 1.0  # standard deviation of a lag that wasn't measured
LEAST_POSES = 3
FAR_MM = 2.0  # of a motion, beyond which equations are far from linear


class Config(MeasuredTargetFields):
    """Fields of `sonotwin check`."""

    rig: Annotated[Rig, Choice("meza2021")]
    """of it, the target's design: circles' distances and diameters, and their tolerance; with today, an earlier rig.yaml"""
    capture: Path | None = None
    """folder: what it holds of these is checked: a film of the target, fringes before both cameras, a bottom; null with today"""
    today: Path | None = None
    """folder of sonotwin identify, or its rig.yaml, whose numbers are compared with those measured in `rig`"""
    out: Path
    """folder: gets check.html, check.json, and optics.yaml, corrected for drift, where no device was moved"""
    log: Path | None = None
    """file of all checks, a line each, that this one is added to, such as rig.jsonl; null: no log, and no control charts"""
    film: manifest.SweepNameOrNone = ""
    """name of the sweep in which the target is moved about; "" takes the only one with frames and without B-scans"""
    bottom: manifest.SweepNameOrNone = ""
    """name of the tracked sweep over a tank's bottom; "" takes the only one with B-scans and poses"""
    tracked: Path | None = None
    """folder of sonotwin track, that has the bottom's poses; null: the capture has them itself"""
    implausible: Implausible = "refuse"
    """poses that no hand makes: refuse leaves them out, and refuses if they are many; take uses all of them"""
    probe: Path | None = None
    """file of the probe's calibration, used instead of the capture's own"""
    lag: Path | None = None
    """file lag.json, of measure-lag; null leaves the scanner's clock unchecked"""
    alarm_sigma: Annotated[float, Field(ge=1, le=20)] = 3.2
    """standard deviations beyond which a part has moved: one check of 120 by chance, over all six parts, or over all
    numbers; control charts over the days of `log` alarm at 4.9 at the latest"""
    water_c: Annotated[float, Field(ge=0, le=95)] = 22.0
    """deg C, of the tank"""
    water_sigma_c: NotNegative = 1.0
    """deg C, its standard deviation: 0.2 % of depths each"""
    top_px: Annotated[int, Field(ge=0)] = 40
    """rows at the probe's face that are left out, where reverberation ends"""
    speed_mm_s: Positive = 10.0
    """of the hand, by which an error of the clock becomes one of place"""
    most_poses: Annotated[int, Field(ge=LEAST_POSES, le=10_000)] = 40
    """of the target, evenly out of those that differ; 3 or more"""


class Held(NamedTuple):
    """Parts of the capture that can be checked: names of sweeps, None where there is none."""

    film: str | None
    fringes: bool
    bottom: str | None


def run(config: Config) -> int:
    """Read, test and write; returns 1 if something has moved, drifted or changed.

    Raises
    ------
    InputError
        If the capture is incomplete or damaged or holds nothing that can be checked, or a place can't be written to.
    """
    watch = ConsoleWatch()
    given = (
        config.capture,
        config.today,
        config.tracked,
        config.calibration,
        config.probe,
        config.lag,
        config.target,
        config.log,
    )
    atomic.check_folder(config.out, "check", inputs=given)  # the log, too: a folder that is replaced would take it along
    earlier = check_log.read(config.log) if config.log is not None and config.log.exists() else []
    rig = None if config.today is None else compared(config, config.today)
    found, corrected = [Verdict(part, "unseen") for part in verdicts.PARTS], None
    if config.capture is not None:
        name, found, corrected = checked(config, config.capture, watch)
    elif rig is not None:
        name = "numbers" if rig.today.identified is None else rig.today.identified.capture
    else:
        raise InputError("capture: expected a capture folder, or today=FOLDER of sonotwin identify, found neither")
    made = check_log.check(name, found, rig)
    for line in check_page.lines(made):
        watch.say(line)
    if any(one.state == "moved" and one.mm > FAR_MM for one in found if one.part in DEVICES):
        cause = "is it this rig's calibration, and are the images each camera's own?"
        watch.say(f"warning     motions of {FAR_MM:g} mm and more are told roughly, and others may be named for them: {cause}")
    log = [*earlier, made]
    charts = control_charts.charts(log, config.alarm_sigma)
    watch.say(f"verdict     {check_page.summary(made, charts)}")
    with atomic.new_folder(config.out, "check") as folder:
        (folder / CHECK).write_text(made.model_dump_json(indent=2) + "\n", encoding="utf-8")
        (folder / PAGE).write_text(check_page.write_text(made, log, config.alarm_sigma), encoding="utf-8")
        if corrected is not None:
            calibration_files.write(folder / drift_step.OPTICS, corrected)
        if config.log is not None:  # last, so that whatever fails leaves both as they were
            check_log.add(config.log, made)
    watch.say(f"wrote       {config.out}/{{{','.join([CHECK, PAGE, *([drift_step.OPTICS] if corrected else [])])}}}")
    moved = any(one.state == "moved" for one in found) or any(one.out for one in charts)
    return int(moved or (rig is not None and len(rig.changed) > 0))


def compared(config: Config, today: Path) -> Comparison:
    """Today's numbers against those of the rig's file; InputError if either has none, or as of `rig_versions.compare`."""
    if not config.rig.measured:
        raise InputError("rig: expected a rig's file that sonotwin identify wrote, found one of which no number was measured")
    file = today / rig_step.RIG if today.is_dir() else today
    if not file.is_file():
        raise InputError(f"{file}: expected a rig's file, found none; give today=FOLDER of sonotwin identify")
    return rig_versions.compare(config.rig, choices.read_rig(file), config.drift_px, config.alarm_sigma)


def checked(config: Config, capture: Path, watch: ConsoleWatch) -> tuple[str, list[Verdict], Calibration | None]:
    """A capture's name, the verdicts on all parts, and the calibration corrected for drift, if there is no more than that."""
    listed = manifest.read_manifest(capture)
    held = parts_of(config, capture, listed, listed if config.tracked is None else manifest.read_manifest(config.tracked))
    for line in left_out(held):
        watch.say(line)
    devices, corrected = optics(config, capture, listed, held, watch)
    found = [*devices, *verdicts.doubted(tank(config, capture, held, watch), devices)]
    return listed.name_of(capture), found, corrected


def parts_of(config: Config, capture: Path, listed: Manifest, tracked: Manifest) -> Held:
    """Parts that can be checked.

    tracked : of the folder that has the bottom's poses.

    Raises
    ------
    InputError
        If there is none, or a sweep that is named.
    """
    sweeps, followed = listed.named_sweeps, tracked.named_sweeps
    films = [name for name, part in sweeps.items() if set(CAMERAS) <= part.images.keys() and SCANNER not in part.images]
    bottoms = [name for name, part in followed.items() if SCANNER in part.images and part.track is not None]
    wanted = [name for name in bottoms if followed[name].purpose == "latency"] or bottoms
    film = _the_one("film", config.film, sweeps, films, capture)
    bottom = _the_one("bottom", config.bottom, followed, wanted, config.tracked or capture)
    fringes = listed.surface is not None and set(CAMERAS) <= listed.surface.images.keys()
    if film is None and bottom is None and not fringes:
        expected = "frames of the target, fringes before both cameras, or tracked B-scans of a bottom"
        way = "name a film that has B-scans, too, by film; sweeps are tracked by sonotwin track, whose folder is tracked"
        raise InputError(f"{capture / MANIFEST}: expected {expected}, found none of them; {way}")
    return Held(film, fringes, bottom)


def _the_one(field: str, given: str, there: Collection[str], fitting: Sequence[str], folder: Path) -> str | None:
    """The sweep that is given, else the only fitting one, if any; InputError if it isn't there, or several fit."""
    if given and given not in there:
        found = ", ".join(there) or "no sweep"
        raise InputError(f"{folder / MANIFEST}: {field}: expected one of its sweeps, found {given} beside {found}")
    if not given and len(fitting) > 1:
        raise InputError(f"{folder / MANIFEST}: expected one sweep for this, found {', '.join(fitting)}; give {field}=NAME")
    return given or next(iter(fitting), None)


def left_out(held: Held) -> list[str]:
    """Lines on parts that can't be checked, with the way on."""
    ways = {
        "film": (held.film is None, "no frames of the target alone; film=NAME takes those of a sweep with B-scans"),
        "fringes": (not held.fringes, "no fringes before both cameras"),
        "bottom": (held.bottom is None, "no B-scans with poses; tracked=FOLDER takes those of sonotwin track"),
    }
    return [f"{name:12}{way}" for name, (lacking, way) in ways.items() if lacking]


def optics(
    config: Config, capture: Path, listed: Manifest, held: Held, watch: ConsoleWatch
) -> tuple[list[Verdict], Calibration | None]:
    """Verdicts on cameras, projector and target, and the calibration corrected for drift, where they show no more than drift."""
    if held.film is None and not held.fringes:
        return [Verdict(part, "unseen") for part in DEVICES], None
    file = listed.calibration_file(capture, config.calibration)
    wanted = [*CAMERAS, *([PROJECTOR] if held.fringes else [])]
    sizes = {name: device.size for name, device in listed.devices.items() if name in wanted}
    calibration = calibration_files.read_for(file, sizes)
    if calibration.uncertainty is None:
        watch.say(f"warning     {file}: no covariance: an error of the calibration is taken for a motion")
    target = target_of(config)
    film = None if held.film is None else filmed(config, capture, held.film, target, calibration, watch)
    matches = drift_step.match_fringes(capture, config.calibration, listed, calibration, watch) if held.fringes else None
    known = in_use(calibration.uncertainty, calibration.cameras, config.board_scale, config.drift_px)
    if known is None:
        raise InputError("drift_px: expected more than 0 beside a calibration without covariance, found 0")
    daily = drift.usual_drift(calibration.cameras, config.drift_px) if config.drift_px > 0 else None
    found = verdicts.of_optics(Optics(film, matches), calibration, known, target, config.alarm_sigma, daily)
    kinds = np.array([film is not None, *(() if matches is None else matches.axes)])
    against = check_log.digest(*numbers_of(calibration, target), kinds)
    found = [one._replace(against=against) for one in found]
    if config.drift_px == 0 or any(one.state in ("moved", "maybe") for one in found):
        return found, None
    corrected = drift_step.correct(calibration, matches, film or (), target, config)
    for line in drift_step.describe(corrected):
        watch.say(line)
    if corrected.drift.size > drift.LARGEST:
        watch.say(f"warning     not corrected: {corrected.beyond(config.drift_px)}")
        return found, None
    return found, corrected.calibration


def numbers_of(calibration: Calibration | None, target: Target) -> list[np.ndarray]:
    """All numbers of devices and target."""
    devices = {} if calibration is None else calibration.cameras
    own = [(each.matrix, each.distortion, each.camera_from_world) for _, each in sorted(devices.items())]
    return [circle_layout.lengths(target), *(numbers for one in own for numbers in one)]


def filmed(
    config: Config, capture: Path, name: str, target: Target, calibration: Calibration, watch: ConsoleWatch
) -> list[tuple[Sighting, Sighting]]:
    """Pairs of frames in which both cameras see the target whole, in poses that differ."""
    film = stereo_frames.read_film(capture, config.calibration, name)
    wide = config.model_copy(update={"drift_px": drift_step.SEARCH_PX})
    tracker = make_tracker(wide, target, film.cameras, film.optics, film.bits)
    pairs = watch.follow(film.pairs(), len(film.times), "tracking")
    collected = target_poses.collect((found for _, found in poses_step.follow(tracker, film.times, pairs)), film.cameras)
    poses = target_poses.spread(target_poses.evenly_lit(collected.seen, LEAST_POSES), config.most_poses)
    if len(poses) < LEAST_POSES:
        found = f"{len(poses)} in {len(film.times)} pairs{collected.told}: move it about, clean, uncovered and well lit"
        found += "; or is the calibration another rig's, or a camera far from where it was?"
        raise InputError(f"{film.name}: expected {LEAST_POSES} poses in which both cameras see all circles whole, found {found}")
    tilt, reach = target_poses.tilt_deg(poses), target_poses.range_mm(poses)
    watch.say(f"film        {len(poses)} poses, tilts of {tilt:.0f} deg (1 sigma), over {reach:.0f} mm of depth")
    for line in track_figures.second_target(collected.apart_mm):
        watch.say(line)
    return [one.views for one in poses]


def tank(config: Config, capture: Path, held: Held, watch: ConsoleWatch) -> list[Verdict]:
    """Verdicts on probe and clock."""
    parts = (bottom_equations.PROBE, bottom_equations.CLOCK)
    lag = None if config.lag is None else lag_files.read(config.lag)
    given = None if config.probe is None else probe_files.read(config.probe)
    if held.bottom is None:
        return [Verdict(part, "unseen") for part in parts]
    sweep = sweep_part.read_sweep(config.tracked or capture, held.bottom, implausible=config.implausible)
    probe = given or sweep.probe
    if probe is None:
        raise InputError(f"{capture / MANIFEST}: expected probe, the path of the probe's calibration, found none; or give probe")
    if probe.uncertainty is None:
        watch.say("warning     probe: no covariance: an error of its calibration is taken for a bent bracket")
    placed = in_water(probe, config)
    thermometer = in_water(replace(probe, uncertainty=None), config).uncertainty
    known = Known(placed, *((lag.lag_s, lag.sigma_s) if lag else (0.0, UNKNOWN_LAG_S)), thermometer)
    lines = bottom_equations.lines_of(sweep.images(), sweep.times, sweep.size, config.top_px)
    found, lag_s = verdicts.of_bottom(lines, sweep.track, known, sweep.size, config.speed_mm_s, config.alarm_sigma)
    shown = int(np.isfinite(lines.pixels).all(axis=(1, 2)).sum())
    watch.say(f"bottom      in {shown} of {len(sweep.times)} B-scans, lag {1e3 * lag_s:.1f} ms")
    if shown < latency_step.MOSTLY * min(len(sweep.times), bottom_equations.MOST):
        watch.say(f"warning     {sweep.name}: most B-scans show no bottom: is it a sweep over a tank's?")
    devices = numbers_of(calibration_files.of_capture(capture, config.calibration), target_of(config))
    clock = None if lag is None else np.array([lag.lag_s])
    against = check_log.digest(*devices, probe.target_from_image, probe.scale, clock)
    found = [one._replace(against=against) for one in found]
    return found if lag else [one for one in found if one.part != bottom_equations.CLOCK] + [Verdict(parts[1], "unseen")]


def in_water(probe: ProbeCalibration, config: Config) -> ProbeCalibration:
    """The calibration for the tank's water, with the thermometer's error."""
    speed = float(sound_in_water.speed_of_sound(config.water_c))
    return sound_in_water.for_tissue(probe, speed, float(sound_in_water.speed_sigma(config.water_c, config.water_sigma_c)))
