"""Poses of all bodies from the frames of two cameras: the settings of the step, the step, and the files of its result."""

from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from time import perf_counter
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from recon.capture import manifest, stereo_frames, surface_part, sweep_tables
from recon.capture.manifest import CAMERAS
from recon.capture.stereo_frames import Film, Pair
from recon.errors import InputError
from recon.files import atomic, metrics
from recon.files.metrics import Metrics, shown
from recon.geometry import rigid
from recon.model import tracks
from recon.model.rig import PATIENT, PROBE, Target
from recon.model.tracks import Track
from recon.session.tracker_settings import MeasuredTargetFields, make_body_tracker, make_tracker, target_of
from recon.session.watch import SILENT, Watch
from recon.tracking import results, track_figures
from recon.tracking.bodies import BodyTracker
from recon.tracking.results import BODIES, Step
from recon.tracking.tracker import Tracker, Tracking

BY = "track"  # who writes
REFERENCE = f"{BODIES}/{PATIENT}/reference.csv"


class Settings(MeasuredTargetFields):
    """Source, and settings of the tracker."""

    capture: Path
    """folder: frames of cam1 and cam2 with their time stamps, as docs/captures.md describes"""
    sweep: str = ""
    """name of the sweep with these frames, of a capture that holds several"""
    overlays: bool = True
    """pictures of every pair of frames, 0.1 MB and some hundredths of a second each"""
    reference: Path | None = None
    """file: the pose of the body `patient` at which the skin was measured, reference.csv of an earlier run. null: its pose in the
    capture's own fringe images by both cameras, or else its first one in this film"""


class Reference(NamedTuple):
    """Where the patient stood when the world that all is told in was seen."""

    pose: Track  # of one moment
    source: str


def run(settings: Settings, out: Path, watch: Watch = SILENT) -> dict[str, list[Step]]:
    """Read, track and write; returns a step for each body and pair of frames, with its pose, or the reason why there is none.

    Raises
    ------
    InputError
        If the capture is incomplete or damaged, a network is missing, or `out` can't be written to.
    """
    sources = (settings.capture, settings.calibration, settings.target, settings.networks, settings.reference)
    atomic.check_folder(out, BY, inputs=sources)
    film = stereo_frames.read_film(settings.capture, settings.calibration, settings.sweep)
    targets = settings.rig.targets | {PROBE: target_of(settings)}
    tracker = _tracker(settings, film)
    rate = f", {film.rate_hz:.4g} a second" if np.isfinite(film.rate_hz) else ""
    sizes = " and ".join(dict.fromkeys("x".join(map(str, camera.size)) for camera in film.cameras))
    watch.say(f"read        {len(film.times)} pairs of frames, {sizes}{rate}")
    with atomic.new_folder(out, BY) as folder:
        start = perf_counter()
        at_rest = first_reference(settings, tracker, film) if isinstance(tracker, BodyTracker) else None
        steps = track(film, tracker, folder if settings.overlays else None, watch)
        figures = report(steps, targets, watch)
        reference = at_rest or _first_seen(steps)
        poses = results.track_of(steps[PROBE])
        if reference is not None:
            poses = tracks.relative(poses, results.track_of(steps[PATIENT]), reference.pose)
            figures |= _moved(steps[PATIENT], reference, poses, watch)
        results.write_poses(folder, film, steps[PROBE], poses)
        for name in steps.keys() - {PROBE}:
            (folder / BODIES / name).mkdir(parents=True)
            results.write_poses(folder / BODIES / name, film, steps[name])
        if reference is not None:
            sweep_tables.write_track(folder / REFERENCE, reference.pose)
        metrics.write(folder / metrics.FILE, figures | {"seconds_track": round(perf_counter() - start, 3)})
        results.hand_on(folder, settings.capture, out, settings.calibration, settings.sweep)
        written = sorted(path.name + "/" * path.is_dir() for path in folder.iterdir())
    watch.say(f"wrote       {out}/{{{','.join(written)}}}")
    for name, own in steps.items():
        if not any(step.found for step in own):
            reason, number = track_figures.kinds([step.reason for step in own])[0]
            body = f" of the {name}" if len(steps) > 1 else ""
            watch.warn(f"{film.name}: no pose{body} in {len(own)} pairs: {reason} ({number}); see frames.csv")
    return steps


def _tracker(settings: Settings, film: Film) -> Tracker | BodyTracker:
    """A tracker of the probe alone, or of all bodies of the rig."""
    if settings.rig.bodies:
        return make_body_tracker(settings, film.cameras, film.optics, film.bits)
    return make_tracker(settings, target_of(settings), film.cameras, film.optics, film.bits)


def report(steps: Mapping[str, list[Step]], targets: Mapping[str, Target], watch: Watch) -> Metrics:
    """Say what was found of each body, and return the figures: the probe's, and those of others with their names before them."""
    figures: Metrics = {}
    for name, own in steps.items():
        measured = track_figures.measure(own, targets[name])
        if len(steps) > 1:
            watch.say(f"body        {name}")
        for line in (*track_figures.describe(own, measured), *track_figures.causes(own, targets[name])):
            watch.say(line)
        figures |= measured if name == PROBE else {f"{name}_{key}": value for key, value in measured.items()}
    return figures


def track(
    film: Film, tracker: Tracker | BodyTracker, pictures: Path | None = None, watch: Watch = SILENT
) -> dict[str, list[Step]]:
    """Track a film from its first pair to its last; steps of each body by its name. Overlays go into a folder if one is given."""
    names = list(tracker.trackers) if isinstance(tracker, BodyTracker) else [PROBE]
    steps: dict[str, list[Step]] = {name: [] for name in names}
    pairs = watch.follow(film.pairs(), len(film.times), "tracking")
    for time, (number, _), pair in zip(film.times.tolist(), film.frames.tolist(), pairs, strict=True):
        found = tracker.step(*pair, time * 1e-9)
        bodies = {PROBE: found} if isinstance(found, Tracking) else found
        for name, one in bodies.items():
            steps[name].append(results.kept(one, time))
        if pictures is not None:
            results.write_overlay(pictures, number, results.overlay(pair, found, film.cameras))
    return steps


def follow(tracker: Tracker, times: NDArray[np.int64], pairs: Iterable[Pair]) -> Iterator[tuple[Pair, Tracking]]:
    """Pairs of frames at times : (n,) ns, each with what the tracker finds in it."""
    for time, pair in zip(times.tolist(), pairs, strict=True):
        yield pair, tracker.step(*pair, time * 1e-9)


def first_reference(settings: Settings, tracker: BodyTracker, film: Film) -> Reference | None:
    """Where the patient stood when the skin was measured: as given, or in the fringe images of both cameras; None without either.

    Raises
    ------
    InputError
        If there is a reference but no body of that name, or the fringe images don't show it.
    """
    if PATIENT not in tracker.trackers:
        if settings.reference is not None:
            raise InputError(f"reference: expected none without the body {PATIENT} in rig.bodies, found {settings.reference}")
        return None
    if settings.reference is not None:
        given = sweep_tables.read_track(settings.reference)
        if not given.found.any():
            raise InputError(f"{settings.reference}: expected a pose of the {PATIENT}, found none")
        return Reference(given, str(settings.reference))
    held = manifest.read_manifest(settings.capture).surface
    if held is None or not set(CAMERAS) <= held.images.keys():
        return None
    means = [mean_image(settings.capture, camera, settings.calibration) for camera in CAMERAS]
    found = tracker.trackers[PATIENT].step(*means)
    tracker.forget()
    if not found.found:
        expected = f"expected the target of the {PATIENT} in the fringe images of both cameras, found none"
        way = "give reference=FILE, or a rig without that body"
        raise InputError(f"{settings.capture}: surface: {expected}: {found.pose.reason}; {way}")
    return Reference(results.track_of([results.kept(found, int(film.times[0]))]), "the fringe images")


def mean_image(capture: Path, camera: str, calibration: Path | None = None) -> NDArray[np.float32]:
    """Mean : (h, w) DN of 255 of a camera's images of the fringe sequence, in which fringes even out."""
    shots = surface_part.read_surface(capture, camera, calibration)
    return shots.images.mean(axis=0, dtype=np.float32) * np.float32(255 / (2**shots.bits - 1))


def _first_seen(steps: Mapping[str, list[Step]]) -> Reference | None:
    """The first pose of the patient in a film; None if there is no such body, or it isn't seen."""
    first = next((step for step in steps.get(PATIENT, ()) if step.found), None)
    return None if first is None else Reference(results.track_of([first]), "its first pose in this film")


def _moved(steps: list[Step], reference: Reference, poses: Track, watch: Watch) -> Metrics:
    """Say how far the patient moved since the reference, which is taken out of the probe's poses; returns the figures."""
    first = reference.pose.poses[int(np.argmax(reference.pose.found))]
    moves = np.array([rigid.difference(first, step.world_from_target) for step in steps if step.found]).reshape(-1, 6)
    turns, shifts = np.rad2deg(np.linalg.norm(moves[:, :3], axis=1)), np.linalg.norm(moves[:, 3:], axis=1)
    figures = {
        "patient_moved_mm": float(shifts.max(initial=0.0)),
        "patient_turned_deg": float(turns.max(initial=0.0)),
        "poses_by_patient": int(poses.found.sum()),
    }
    moved = f"{shown(figures['patient_moved_mm'], '.2f', ' mm')} and {shown(figures['patient_turned_deg'], '.2f', ' deg')}"
    watch.say(f"patient     moved by up to {moved} since {reference.source}; poses are told as if it stood there")
    watch.say(f"relative    {figures['poses_by_patient']} poses of the probe beside the patient")
    return figures
