"""Drift of cameras and projector since their calibration, corrected by what the session shows of it: settings, step and files."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from recon.capture import calibration_files, manifest, stereo_frames, surface_part
from recon.capture.manifest import CAMERAS, MANIFEST, Manifest
from recon.errors import InputError
from recon.estimation.covariance import propagate
from recon.files import atomic, metrics
from recon.files.metrics import Metrics
from recon.geometry.camera_jacobian import difference
from recon.model import circle_layout
from recon.model.calibration import Calibration
from recon.model.rig import Target
from recon.optical_calibration import known_length, uncertainty
from recon.reports import page
from recon.reports.page import Opening, Section
from recon.rig_check import ball_bar, drift, fringe_matches
from recon.rig_check.ball_bar import Bars
from recon.rig_check.drift import LARGEST, Drift
from recon.rig_check.optics_equations import PROJECTOR, Matches, points_by_light
from recon.session import poses_step
from recon.session.settings import BarFields
from recon.session.tracker_settings import MeasuredTargetFields, make_tracker, target_of
from recon.session.watch import SILENT, Watch
from recon.structured_light import decode
from recon.target_calibration import target_poses
from recon.tracking.pose_fit import Sighting, meet

BY = "correct-optics"  # who writes
OPTICS, PAGE = "optics.yaml", "drift.html"
OPEN_SCALE = 0.01  # relative standard deviation of lengths that tell nothing of the scale
SEARCH_PX = 5.0  # of the cameras' principal points: the tracker is to find the target by cameras that have moved, too
SEED = 0  # of the points under the fringes
SHOWN = ("cx", "cy", "fx", "rx", "ry", "rz", "tx", "ty", "tz")  # parameters that a device's drift is told by

Array = NDArray[np.float64]


class Settings(BarFields, MeasuredTargetFields):
    """Sources, and what is usual."""

    capture: Path
    """a capture folder: fringes before both cameras, films of the target, or both"""
    views: Annotated[int, Field(ge=0, le=1000)] = 24
    """pairs of frames, out of all films of the target, in which it is looked for; 0 leaves films out"""

    @model_validator(mode="after")
    def _drifts(self) -> "Settings":
        if self.drift_px == 0:
            raise ValueError("drift_px: expected more than 0, found 0, by which nothing drifts")
        return self


@dataclass(frozen=True)
class Corrected:
    """A calibration as the session shows it."""

    drift: Drift
    matches: Matches | None
    views: int
    bars: Bars | None
    figures: Metrics

    @property
    def calibration(self) -> Calibration:
        """The corrected one; without a covariance where it had none, by which single errors would count as known."""
        return replace(self.drift.after, uncertainty=self.drift.after.uncertainty if self.drift.before.uncertainty else None)

    def beyond(self, drift_px: float) -> str:
        """A fault: more than drift."""
        expected = f"expected devices that drifted by some {drift_px:g} px since their calibration"
        cause = "was one pushed? `sonotwin check` names it; or is it another calibration?"
        return f"{expected}, found more than {LARGEST:g} times as much: {cause} drift_px=... is of a rig that drifts more"


def run(settings: Settings, out: Path, watch: Watch = SILENT) -> None:
    """Match the fringes of both cameras, find the target, estimate the drift, and write.

    Raises
    ------
    InputError
        If the capture is incomplete or damaged, shows nothing of the cameras' drift, or shows that something was moved; or `out`
        can't be written to.
    """
    given = (settings.calibration, settings.target, settings.networks, *settings.bars)
    atomic.check_folder(out, BY, inputs=(settings.capture, *given))
    held = manifest.read_manifest(settings.capture)
    file = held.calibration_file(settings.capture, settings.calibration)
    calibration = calibration_files.read_for(file, sizes(held))
    if calibration.uncertainty is None:
        watch.say("warning     no covariance in the calibration: its errors count as drift, and what is left of both isn't known")
    matches = match_fringes(settings.capture, settings.calibration, held, calibration, watch)
    film = look_at_target(settings, held, watch)
    if matches is None and not film:
        expected = f"fringes before {' and '.join(CAMERAS)}, or frames in which both see the target"
        raise InputError(f"{settings.capture / MANIFEST}: expected {expected}, found neither")
    bars = find_bars(settings, file, calibration, watch)
    with watch.busy("estimating the drift"):
        found = correct(calibration, matches, film, target_of(settings), settings, bars)
    if found.drift.size > LARGEST:
        raise InputError(f"{settings.capture}: {found.beyond(settings.drift_px)}")
    for line in describe(found):
        watch.say(line)
    with atomic.new_folder(out, BY) as folder:
        calibration_files.write(folder / OPTICS, found.calibration)
        metrics.write(folder / metrics.FILE, found.figures)
        (folder / PAGE).write_text(write_page(found, held.name_of(settings.capture)), encoding="utf-8")
    watch.say(f"wrote       {out}/{{{OPTICS},{PAGE},{metrics.FILE}}}")


def correct(
    calibration: Calibration,
    matches: Matches | None,
    film: Sequence[tuple[Sighting, Sighting]],
    target: Target,
    settings: MeasuredTargetFields,
    bars: Bars | None = None,
) -> Corrected:
    """Correct a calibration by points of the skin and views of the target, one of which may be missing, and by a ball bar.

    A target of known lengths tells the scale, too; not one that cameras measured, whose lengths have theirs.
    """
    known = target if settings.target is None else with_open_scale(target)
    found = drift.estimate(calibration, film or None, matches, known, settings.board_scale, settings.drift_px, bars)
    return Corrected(found, matches, len(film), bars, measure(found, matches, film))


def find_bars(settings: Settings, file: Path, calibration: Calibration, watch: Watch) -> Bars | None:
    """The ball bar in each of the settings' captures; says its length by the calibration as it was. None without.

    file : of the calibration

    Raises
    ------
    InputError
        If images are missing or damaged, can't be decoded, show no two balls, or a bar of another length.
    """
    if settings.bar_mm is None:
        return None
    length_mm, sigma_mm = settings.bar_mm
    known = drift.expected(calibration, settings.board_scale, settings.drift_px)
    seen = []
    for capture in settings.bars:
        shots = surface_part.read_surface(capture, CAMERAS[0], file)
        found = decode.decode(
            shots.images, shots.patterns, bits=shots.bits, name=f"{shots.name}: {CAMERAS[0]}", camera=CAMERAS[0]
        )
        seen.append(ball_bar.find(found, calibration.cameras, settings.ball_mm, str(capture)))
        by_light = ball_bar.measure(seen[-1], calibration.cameras, known.names)
        balls = " and ".join(f"{ball:.2f}" for ball in by_light.balls_mm)
        off = ball_bar.departure(by_light, settings.bar_mm, known)
        length = f"{by_light.length_mm:.3f} mm of {length_mm:g}, {off:+.1f} sigma of calibration and usual drift"
        if abs(off) > ball_bar.LIMITS.alarm_sigma:
            cause = "another bar, another distance of its balls, or devices that were pushed? board_scale=... is of a worse print"
            raise InputError(
                f"{capture}: bar_mm: expected a bar's length by calibration and usual drift, found {length}: {cause}"
            )
        watch.say(f"bar         {length}; balls of {balls} mm")
        if abs(off) > ball_bar.LIMITS.doubt_sigma:
            watch.say(
                "warning     the bar is taken at its word: is bar_mm as in its certificate, and the board as it is described?"
            )
    return Bars(tuple(seen), length_mm, sigma_mm)


def with_open_scale(target: Target) -> Target:
    """The target with lengths that may all be longer or shorter together."""
    lengths = circle_layout.lengths(target)
    covariance = circle_layout.length_covariance(target) + np.outer(*2 * (OPEN_SCALE * lengths,))
    return target.model_copy(update={"covariance_mm2": tuple(map(tuple, covariance.tolist()))})


def sizes(held: Manifest) -> dict[str, tuple[int, int]]:
    """Image sizes of cameras and projector."""
    return {name: device.size for name, device in held.devices.items() if name in (*CAMERAS, PROJECTOR)}


def match_fringes(capture: Path, file: Path | None, held: Manifest, calibration: Calibration, watch: Watch) -> Matches | None:
    """Points of the skin that both cameras see under the fringes; says why where the capture has none, and returns None.

    file : of the calibration, which takes the place of the capture's own

    Raises
    ------
    InputError
        If images are missing or damaged, can't be decoded, or show too little in common.
    """
    taken = () if held.surface is None else held.surface.images
    if missing := [name for name in CAMERAS if name not in taken]:
        watch.say(f"fringes     none before {' and '.join(missing)}: skin and target drift apart unseen")
        return None
    if PROJECTOR not in calibration.cameras:
        watch.say(f"fringes     not used: {PROJECTOR} isn't calibrated")
        return None
    maps = []
    for camera in CAMERAS:
        shots = surface_part.read_surface(capture, camera, file)
        name = f"{shots.name}: {camera}"
        maps.append(decode.decode(shots.images, shots.patterns, bits=shots.bits, name=name, camera=camera))
    given = (maps[0], maps[1]), calibration.cameras, np.random.default_rng(SEED)
    matches = fringe_matches.match(*given, str(capture))
    axes = " and ".join(("columns", "rows")[k] for k in matches.axes)
    watch.say(f"fringes     {len(matches.pixels)} points in both cameras, {axes}")
    return matches


def look_at_target(settings: Settings, held: Manifest, watch: Watch) -> list[tuple[Sighting, Sighting]]:
    """Views of the target by both cameras, in poses that differ, evenly out of all films."""
    swept = held.named_sweeps.items() if settings.views else ()
    names = [name for name, part in swept if set(CAMERAS) <= part.images.keys()]
    films = [stereo_frames.read_film(settings.capture, settings.calibration, name) for name in names]
    total = sum(len(film.times) for film in films)
    chosen = np.unique(np.linspace(0, total - 1, min(settings.views, total)).round().astype(int))
    seen, target, first = [], target_of(settings), 0
    wide = settings.model_copy(update={"drift_px": SEARCH_PX})
    for film in films:
        some = film.some(chosen[(chosen >= first) & (chosen < first + len(film.times))] - first)
        first += len(film.times)
        tracker = make_tracker(wide, target, film.cameras, film.optics, film.bits)
        pairs = watch.follow(some.pairs(), len(some.times), "looking at the target")
        found = (each for _, each in poses_step.follow(tracker, some.times, pairs))
        seen += target_poses.collect(found, film.cameras).seen
    kept = [each.views for each in target_poses.evenly_lit(seen)]
    if films:
        watch.say(f"target      {len(kept)} views by both cameras, out of {len(chosen)}")
    return kept


def measure(found: Drift, matches: Matches | None, film: Sequence[tuple[Sighting, Sighting]]) -> Metrics:
    """Figures of a correction; of the skin, by its columns, or rows, alone, where fringes were matched."""
    if matches is None:
        both = [[view.camera for view in pair] for pair in film]
        places = [meet(cameras, [view.centres for view in pair])[0] for cameras, pair in zip(both, film, strict=True)]
        measured_by, volume, decoded = CAMERAS[1], np.concatenate(places), np.ones(2)
    else:
        measured_by, decoded = PROJECTOR, np.where(np.isin([0, 1], matches.axes), 1.0, np.inf)
        volume = points_by_light(matches.pixels, matches.first, matches.axes[:1], found.after.cameras)
    figures: Metrics = {
        "matches": 0 if matches is None else len(matches.pixels),
        "views": len(film),
        "size": found.size,
        "surprise_sigma": found.surprise,
        "scale_sigma_ppm": 1e6 * uncertainty.scale(found.after, CAMERAS[0], measured_by, volume, (1.0, decoded)),
    }
    for name, (change, sigma) in changes(found).items():
        figures |= {f"{name.replace('.', '_')}_change": change, f"{name.replace('.', '_')}_sigma": sigma}
    if matches is not None:
        axes = matches.axes[:1]
        before = Calibration(found.before.cameras, found.prior)
        moved = drift.parting(before.cameras, found.after.cameras, volume, axes)
        figures |= {
            "skin_moved_mm": float(np.sqrt(np.mean(np.sum(moved**2, axis=1)))),
            "skin_sigma_before_mm": parting_sigma(before, volume, axes),
            "skin_sigma_mm": parting_sigma(found.after, volume, axes),
        }
    return figures


def parting_sigma(calibration: Calibration, points: Array, axes: Sequence[int]) -> float:
    """Standard deviation, mm, by which skin and target part, over points : (n, 3) mm."""
    assert calibration.uncertainty is not None
    covariances = propagate(uncertainty.parting(calibration, points, axes), calibration.uncertainty.covariance)
    return float(np.sqrt(np.mean(np.trace(covariances, axis1=-2, axis2=-1))))


def changes(found: Drift) -> dict[str, tuple[float, float]]:
    """Change and its standard deviation of each device's principal point, focal length and mount, px, rad and mm."""
    told: dict[str, tuple[float, float]] = {}
    assert found.after.uncertainty is not None
    for device, camera in found.after.cameras.items():
        step = difference(found.before.cameras[device], camera, SHOWN)
        names = {name: f"{device}.{name}" for name in SHOWN}
        told |= {
            names[name]: (float(value), found.after.uncertainty.sigma(names[name]))
            for name, value in zip(SHOWN, step, strict=True)
            if names[name] in found.after.uncertainty.names
        }
    return told


def describe(found: Corrected) -> Iterator[str]:
    """Lines: how much drifted, and what it would have cost."""
    size = "as usual" if found.drift.size == 1 else f"{found.drift.size:.1f} times the usual"
    yield f"drift       {size} ({found.drift.surprise:.1f} sigma by usual drift)"
    if found.drift.size > 1:
        cause = "was a device touched? `sonotwin check` tests each; a motion of all alike shows nowhere"
        yield f"warning     more than usual drift: {cause}"
    told = changes(found.drift)
    for device in found.drift.after.cameras:
        (x, x_sigma), (y, y_sigma) = (told[f"{device}.{name}"] for name in ("cx", "cy"))
        yield f"{device:12}principal point {x:+.3f}, {y:+.3f} px (1 sigma {x_sigma:.3f}, {y_sigma:.3f})"
    if "skin_moved_mm" in found.figures:
        moved, before, left = (found.figures[f"skin_{name}_mm"] for name in ("moved", "sigma_before", "sigma"))
        yield f"apart       skin from target by {moved:.3f} mm uncorrected (1 sigma {before:.3f}), and now 1 sigma {left:.3f} mm"
    if found.drift.before.uncertainty is not None:
        yield known_length.describe(1e-6 * float(found.figures["scale_sigma_ppm"]))


def write_page(found: Corrected, name: str) -> str:
    """The page as HTML."""
    told, rows = changes(found.drift), []
    for device in found.drift.after.cameras:
        for parameter, unit, factor in (("cx", "px", 1), ("cy", "px", 1), ("fx", "px", 1), *MOUNT):
            if f"{device}.{parameter}" in told:
                change, sigma = told[f"{device}.{parameter}"]
                rows.append((device, LABELS[parameter], f"{factor * change:+.3f} {unit}", f"{factor * sigma:.3f} {unit}"))
    blocks = [page.table(("device", "parameter", "change", "1 σ of the value"), rows)]
    if found.bars is not None:
        certified = f"{found.bars.length_mm:g} ± {found.bars.sigma_mm:g} mm"
        lengths = [ball_bar.measure(bar, found.drift.before.cameras, ()).length_mm for bar in found.bars.seen]
        told = [(str(place), certified, f"{length:.3f} mm") for place, length in enumerate(lengths, 1)]
        blocks.append(page.table(("ball bar, place", "certified", "as calibrated before"), told))
    lines = [page.paragraph(line) for line in READING]
    sections = [Section("Change since the calibration", blocks), Section("How to read this", lines)]
    figures = [("matched points", str(found.figures["matches"]), ""), ("views of the target", str(found.views), "")]
    usual = found.drift.size == 1
    result = "Devices drifted as usual, or less." if usual else f"Devices drifted {found.drift.size:.1f} times as far as usual."
    if "skin_moved_mm" in found.figures:
        moved, left = found.figures["skin_moved_mm"], found.figures["skin_sigma_mm"]
        figures += [("skin from target, uncorrected", f"{moved:.3f}", "mm"), ("left, 1 σ", f"{left:.3f}", "mm")]
    figures.append(("scale, 1 σ", f"{found.figures['scale_sigma_ppm']:.0f}", "ppm"))
    return page.render(Opening("Drift since the calibration", name, result, figures), sections, FOOTER)


MOUNT = (*((name, "mrad", 1e3) for name in ("rx", "ry", "rz")), *((name, "mm", 1) for name in ("tx", "ty", "tz")))
LABELS = {"cx": "principal point, x", "cy": "principal point, y", "fx": "focal length"}
LABELS |= {f"r{axis}": f"turn about {axis}" for axis in "xyz"} | {f"t{axis}": f"shift along {axis}" for axis in "xyz"}
READING = (
    "Estimated together with all other errors of the calibration, whose covariance is known. Single parameters stay uncertain "
    "where others do the same to the images; what all do together to the skin, beside the target, is in the figures above.",
    "A common motion of all devices shows nowhere, and a change of scale by known lengths alone: a ball bar, a measured target.",
)
FOOTER = "This file is complete: it fetches nothing."
