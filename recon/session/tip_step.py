"""The tip of a tracked tool, from a film of it in a dimple: the settings of the step, the step, and the files of its result."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator
from scipy.linalg import block_diag

from recon.capture import stereo_frames, sweep_tables, target_files, tip_files
from recon.errors import Implausible, InputError, did_you_mean
from recon.files import atomic, meshes, metrics
from recon.files.metrics import Metrics
from recon.freehand import sequence_checks, sequences
from recon.freehand.sequences import FrameName
from recon.model import pose_checks
from recon.model.part import Vector
from recon.model.rig import PROBE
from recon.model.tip import Tip
from recon.session import poses_step
from recon.session.target_step import NO_COVARIANCE
from recon.session.tracker_settings import MeasuredTargetFields, make_tracker
from recon.session.watch import SILENT, Watch
from recon.tip_calibration import model_check, pivot_checks, spin
from recon.tip_calibration.pivot import TIP, Frames, Pivot
from recon.tip_calibration.pivot_checks import Demands
from recon.tip_calibration.spin import Spin
from recon.tracking import results

BY = "calibrate-tip"  # who writes
TIP_FILE = "tip.yaml"
FRAMES = "frames.csv"
HEADER = ("frame", "time_ns", "found", "x_mm", "y_mm", "z_mm", "used")
MOST_VARIANCE = 1e6  # of a pose in a table, mm^2 and rad^2
SOURCES = ("capture", "track", "sequence", "tip_mm")

Array = NDArray[np.float64]
Sigma = Annotated[float, Field(gt=0, le=20)]


class Settings(Demands, MeasuredTargetFields):
    """Source, and settings of the tracker and of the checks."""

    capture: Path | None = None
    """folder: frames of cam1 and cam2 with their time stamps, of the tool that pivots in a dimple. Or else:"""
    sweep: str = ""
    """name of the sweep with these frames, of a capture that holds several"""
    body: str = PROBE
    """which body of the rig the tool is: probe, or a name in rig.bodies, which tip.yaml gets; `target` is its measured target
    then"""
    track: Path | None = None
    """a table of the target's poses, as `sonotwin track` writes it: poses.csv. Or else:"""
    sequence: Path | None = None
    """a tracked sequence of the PLUS toolkit, .igs.mha or .igs.nrrd. Or else:"""
    tool: FrameName = "Stylus"
    """frame of the sequence that is fixed to the tool"""
    reference: FrameName = "Reference"
    """frame of the sequence in which the dimple rests, such as Tracker"""
    implausible: Implausible = "refuse"
    """poses of a table or sequence that no hand makes, as of `sonotwin freehand`: refuse or take"""
    tip_mm: Vector | None = None
    """mm, the tip in the target's frame by a drawing: [x,y,z], instead of a film"""
    tip_sigma_mm: Sigma = 0.2
    """mm, standard deviation of such a tip along each axis: of the drawing and of the target's mount"""
    axis: Vector | None = None
    """the shaft's direction in the target's frame by a drawing, from the handle to the tip: [x,y,z] of any length"""
    axis_sigma_deg: Sigma = 0.5
    """deg, standard deviation of such an axis about each axis across"""
    spin: Path | None = None
    """a second film, of the tool that turns about its shaft at rest by half a turn, which gives the axis: a capture's folder, a
    poses.csv, or a sequence"""
    model: Path | None = None
    """mesh of the tool in the target's frame, mm: STL, GLB or PLY; its path is kept in the file. The tip must lie on it"""

    @model_validator(mode="after")
    def _one_source(self) -> "Settings":
        given = [name for name in SOURCES if getattr(self, name) is not None]
        if len(given) != 1:
            raise ValueError(f"expected one of capture, track, sequence or tip_mm, found {' and '.join(given) or 'none'}")
        if self.body not in (names := list(self.rig.targets)):
            raise ValueError(f"body: expected one of {', '.join(names)}, found {self.body}{did_you_mean(self.body, names)}")
        if self.axis is not None and self.spin is not None:
            raise ValueError("axis: expected none beside spin, which gives it, found both")
        if self.axis is not None and not np.linalg.norm(self.axis) > 0:
            raise ValueError("axis: expected a direction, found zeros")
        return self

    @property
    def named_body(self) -> str:
        """The body's name; empty of a rig with one target, whatever carries it, and of poses whose body isn't named."""
        several = self.capture is not None and bool(self.rig.bodies)
        return self.body if several or self.body != PROBE else ""


@dataclass(frozen=True)
class Tracked:
    """A film, tracked: n frames, of which some have a pose."""

    name: str  # for messages
    numbers: NDArray[np.int64]  # (n,) of the frames
    times: Sequence[int | str]  # (n,) ns; empty where unknown
    poses: Array  # (n, 4, 4) world_from_target, mm; NaN where there is none
    covariance: Array  # (n, 6, 6) as in recon.model.tracks; zeros where it isn't known
    shared: Array  # (n, 6, 6)

    @property
    def found(self) -> NDArray[np.bool_]:
        """Where there is a pose : (n,)."""
        return np.isfinite(self.poses).all(axis=(1, 2))

    @property
    def frames(self) -> Frames:
        """Those with a pose."""
        return Frames(self.poses, self.covariance, self.shared).some(self.found)


@dataclass(frozen=True)
class Calibrated:
    """A tip, and what it is known by."""

    tip: Tip
    figures: Metrics
    tracked: Tracked | None = None
    pivot: Pivot | None = None


def run(settings: Settings, out: Path, watch: Watch = SILENT) -> Calibrated:
    """Track the film, find the tip and the axis, and write.

    Raises
    ------
    InputError
        If the input is incomplete or damaged, shows too little, or a tip that wasn't at rest; or `out` can't be written to.
    """
    sources = (*(getattr(settings, name) for name in SOURCES[:3]), settings.spin, settings.model, settings.calibration)
    atomic.check_folder(out, BY, inputs=(*sources, settings.target, settings.networks))
    mesh = None if settings.model is None else meshes.read_model(settings.model, "a model of the tool")
    made = by_drawing(settings) if settings.tip_mm is not None else by_film(settings, watch)
    made = with_axis(replace(made, tip=replace(made.tip, body=settings.named_body)), settings, watch)
    if settings.model is not None and mesh is not None:
        away = model_check.check(settings.model, mesh, made.tip.tip_mm, made.figures["sigma_mm"])
        watch.say(f"model       the tip is {away:.2f} mm from its surface")
        figures = made.figures | {"model_mm": away}
        made = replace(made, tip=replace(made.tip, model=settings.model), figures=figures)
    watch.say(f"wrote       {out}/{{{','.join(write(out, made))}}}")
    return made


def by_drawing(settings: Settings) -> Calibrated:
    """The tip as it is given."""
    sigma = settings.tip_sigma_mm
    tip = Tip(np.array(settings.tip_mm), sigma**2 * np.eye(3))
    return Calibrated(tip, {**_by_axes("tip", tip.tip_mm), "sigma_mm": sigma})


def by_film(settings: Settings, watch: Watch = SILENT) -> Calibrated:
    """The tip of a film of the tool that pivots in a dimple; InputError if it doesn't show it."""
    if settings.capture is not None:
        tracked = track_film(settings.capture, settings, watch, settings.sweep)
    elif settings.track is not None:
        tracked = read_table(settings.track, settings)
    else:
        assert settings.sequence is not None
        tracked = read_sequence(settings.sequence, settings)
    numbers = tracked.numbers[tracked.found]
    axis = None if settings.axis is None else np.array(settings.axis) / np.linalg.norm(settings.axis)
    found, warnings = pivot_checks.calibrate(tracked.frames, numbers, tracked.numbers, settings, tracked.name, axis)
    bent = pivot_checks.bend(found, axis)
    figures = measure(tracked, found) | {"bend_mm": bent.shift_mm, "sigma_if_bent_mm": bent.sigma_mm}
    for line in (*describe(found, figures), *(f"warning     {line}" for line in warnings)):
        watch.say(line)
    tip = Tip(found.tip, found.covariance, None, found.dimple, found.rms_mm, int(found.used.sum()))
    return Calibrated(tip, figures, tracked, found)


def track_film(capture: Path, settings: Settings, watch: Watch, sweep: str = "") -> Tracked:
    """Track a film's target."""
    film = stereo_frames.read_film(capture, settings.calibration, sweep)
    design = settings.rig.targets[settings.body]
    target = design if settings.target is None else target_files.read(settings.target, design)
    tracker = make_tracker(settings, target, film.cameras, film.optics, film.bits)
    if film.optics is None:
        watch.say(f"warning     {NO_COVARIANCE}")
    track = results.track_of(poses_step.track(film, tracker, None, watch)[PROBE])
    assert track.covariance is not None and track.shared is not None
    return Tracked(film.name, film.frames[:, 0], track.times.tolist(), track.poses, track.covariance, track.shared)


def read_table(path: Path, settings: Settings) -> Tracked:
    """Read a table of poses."""
    track = sweep_tables.read_track(path)
    pose_checks.check_motion(str(path), track.times * 1e-9, track.poses, settings.implausible)
    n, unknown = len(track.times), np.zeros((len(track.times), 6, 6))
    covariances = [unknown if value is None else value for value in (track.covariance, track.shared)]
    for matrices in covariances:
        if (largest := float(np.nanmax(np.abs(matrices), initial=0.0))) > MOST_VARIANCE:
            raise InputError(
                f"{path}: expected variances of poses up to {MOST_VARIANCE:g} mm^2, found {largest:.3g}: another unit?"
            )
    return Tracked(str(path), np.arange(n), track.times.tolist(), track.poses, *covariances)


def read_sequence(path: Path, settings: Settings) -> Tracked:
    """Read the poses of a sequence, with images or without."""
    frames, _ = sequence_checks.read_tracking(path, settings.reference, settings.tool, implausible=settings.implausible)
    poses = sequences.poses(frames, settings.reference, settings.tool)
    times = ["" if np.isnan(time) else round(time * 1e9) for time in frames.times_s.tolist()]
    unknown = np.zeros((len(poses), 6, 6))
    return Tracked(str(path), np.arange(len(poses)), times, poses, unknown, unknown)


def with_axis(made: Calibrated, settings: Settings, watch: Watch = SILENT) -> Calibrated:
    """The same with the shaft's direction, if a second film or a drawing gives it."""
    if settings.axis is not None:
        axis = np.array(settings.axis) / np.linalg.norm(settings.axis)
        if axis @ made.tip.tip_mm < 0:
            watch.say("warning     axis= points away from the tip, seen from the target: expected from the handle to the tip")
        covariance = np.radians(settings.axis_sigma_deg) ** 2 * (np.eye(3) - np.outer(axis, axis))
        return _joined(made, axis, covariance, {"sigma_axis_deg": settings.axis_sigma_deg * np.sqrt(2)})
    if settings.spin is None:
        return made
    if settings.spin.suffix == ".csv":
        tracked = read_table(settings.spin, settings)
    elif settings.spin.is_file():
        tracked = read_sequence(settings.spin, settings)
    else:
        tracked = track_film(settings.spin, settings, watch)
    pivot_checks.check_seen(tracked.numbers[tracked.found], tracked.numbers, settings, tracked.name)
    found = spin.calibrate(tracked.frames, tracked.name, made.tip.tip_mm)
    beside = spin.beside(tracked.frames.some(found.used), found.axis, made.tip.tip_mm)
    watch.say(_axis_line(found, beside))
    figures = {"sigma_axis_deg": found.sigma_deg, "wobble_deg": found.wobble_deg, "span_deg": found.span_deg, "beside_mm": beside}
    return _joined(made, found.axis, found.covariance, figures)


def _joined(made: Calibrated, axis: Array, covariance: Array, figures: Metrics) -> Calibrated:
    tip = replace(made.tip, axis=axis, covariance=block_diag(made.tip.covariance, covariance))
    return replace(made, tip=tip, figures=made.figures | _by_axes("axis", axis, "") | figures)


def measure(tracked: Tracked, found: Pivot) -> Metrics:
    """Figures of a tip by a film."""
    sigmas, _ = found.principal
    turns = pivot_checks.turns_deg(found.frames.some(found.used).poses)
    return {
        **_by_axes("tip", found.tip),
        **_by_axes("dimple", found.dimple),
        **_by_axes("sigma", np.sqrt(np.diag(found.covariance[TIP, TIP]))),
        "sigma_mm": float(sigmas[0]),
        "rms_mm": found.rms_mm,
        "misfit_mm": found.misfit_mm,
        "frames": len(tracked.poses),
        "frames_found": int(tracked.found.sum()),
        "frames_used": int(found.used.sum()),
        "frames_that_count_as_one": found.persistence,
        **{f"turns_{which}_deg": float(value) for which, value in zip(("first", "second", "third"), turns, strict=True)},
    }


def describe(found: Pivot, figures: Metrics) -> Iterator[str]:
    """Lines: the poses, the tip, the dimple."""
    turns = [f"{figures[f'turns_{which}_deg']:.0f}" for which in ("first", "second", "third")]
    used = f"{figures['frames_used']} of {figures['frames']} frames used, {figures['frames_found']} with a pose"
    yield f"found       {used}, turned by {turns[0]}, {turns[1]} and {turns[2]} deg (1 sigma)"
    tip = f"{_shown(found.tip)} mm in the target's frame"
    yield f"tip         {tip}, to {figures['sigma_mm']:.3f} mm in its least certain direction (1 sigma)"
    beyond = f"{figures['misfit_mm']:.3f} mm along each axis beyond the poses' noise"
    yield f"dimple      {_shown(found.dimple)} mm in the world; the tip keeps to it to {figures['rms_mm']:.3f} mm RMS, {beyond}"
    straight = f"if it may bend, the tip is known to {figures['sigma_if_bent_mm']:.2f} mm (1 sigma)"
    yield f"bend        of the shaft moves the tip by {figures['bend_mm']:.2f} mm; {straight}"


def _axis_line(found: Spin, beside: float) -> str:
    turned = f"turned by {found.span_deg:.0f} deg, to {found.sigma_deg:.3f} deg (1 sigma)"
    return f"axis        {_shown(found.axis, 4)} in the target's frame, {turned}; the tip lies {beside:.2f} mm beside its line"


def write(out: Path, made: Calibrated) -> list[str]:
    """Write all files, whole or not at all; returns their names."""
    with atomic.new_folder(out, BY) as folder:
        tip_files.write(folder / TIP_FILE, made.tip, out)
        if made.tracked is not None and made.pivot is not None:
            sweep_tables.write_rows(folder / FRAMES, HEADER, rows(made.tracked, made.pivot))
        metrics.write(folder / metrics.FILE, made.figures)
        return sorted(path.name for path in folder.iterdir())


def rows(tracked: Tracked, found: Pivot) -> Iterator[Sequence[object]]:
    """A row a frame, in the order of HEADER: residuals of the tip in the world; empty where there is no pose."""
    place = np.cumsum(tracked.found) - 1
    for k, there in enumerate(tracked.found):
        shown = [f"{value:.4f}" for value in found.residuals[place[k]]] if there else ["", "", ""]
        yield int(tracked.numbers[k]), tracked.times[k], int(there), *shown, int(there and found.used[place[k]])


def _by_axes(name: str, vector: Array, unit: str = "_mm") -> Metrics:
    return {f"{name}_{axis}{unit}": float(value) for axis, value in zip("xyz", vector, strict=True)}


def _shown(vector: Array, digits: int = 2) -> str:
    return f"[{' '.join(f'{value:.{digits}f}' for value in vector)}]"
