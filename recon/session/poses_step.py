"""Poses of all bodies from the frames of two cameras: the settings of the step, the step, and the files of its result."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
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
from recon.files.metrics import Metrics
from recon.geometry import rigid
from recon.model import tracks
from recon.model.rig import PATIENT, PROBE, Target
from recon.model.tracks import Track
from recon.session.tracker_settings import BodyFields, make_rig_tracker, targets_of
from recon.session.watch import SILENT, Watch
from recon.tracking import results, track_figures
from recon.tracking.bodies import BodyTracker
from recon.tracking.results import BODIES, Step
from recon.tracking.tracker import Tracker, Tracking, is_beside

BY = "track"  # who writes
FAR_MM, FAR_DEG = 60.0, 30.0  # of a patient from the reference, beyond which it is hardly the same patient, or session
REFERENCE = f"{BODIES}/{PATIENT}/reference.csv"


class Settings(BodyFields):
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
        If the capture is incomplete or damaged, a network is missing, the patient's reference can't be had, or `out` can't be
        written to.
    """
    given = (settings.calibration, settings.target, *settings.measured.values(), settings.networks, settings.reference)
    atomic.check_folder(out, BY, inputs=(settings.capture, *given))
    film = stereo_frames.read_film(settings.capture, settings.calibration, settings.sweep)
    targets = targets_of(settings)
    tracker = make_rig_tracker(settings, targets, film.cameras, film.optics, film.bits)
    rate = f", {film.rate_hz:.4g} a second" if np.isfinite(film.rate_hz) else ""
    sizes = " and ".join(dict.fromkeys("x".join(map(str, camera.size)) for camera in film.cameras))
    watch.say(f"read        {len(film.times)} pairs of frames, {sizes}{rate}")
    beside_patient = is_of_patient(settings)
    reference = find_reference(settings, tracker, film) if beside_patient and isinstance(tracker, BodyTracker) else None
    with atomic.new_folder(out, BY) as folder:
        start = perf_counter()
        steps = track(film, tracker, folder if settings.overlays else None, watch)
        reference = reference or (first_seen(steps[PATIENT]) if beside_patient else None)
        moved = describe_motion(steps[PATIENT], reference, watch) if beside_patient else {}
        if beside_patient:
            steps |= beside(steps, reference)
        figures = report(steps, targets, watch) | moved
        results.write_poses(folder, film, steps[PROBE])
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


def is_of_patient(settings: Settings) -> bool:
    """Whether poses are told beside the patient: where the rig has one, but for sweeps over wires or a flat bottom, which stand
    elsewhere at rest.

    Raises
    ------
    InputError
        If a reference is given and they aren't.
    """
    _, part = manifest.read_manifest(settings.capture).sweep_of(settings.capture / manifest.MANIFEST, "frames", settings.sweep)
    elsewhere = part.purpose not in ("volume", None)
    if settings.reference is not None and PATIENT not in settings.rig.bodies:
        raise InputError(f"reference: expected none without the body {PATIENT} in rig.bodies, found {settings.reference}")
    if settings.reference is not None and elsewhere:
        raise InputError(f"reference: expected none for a sweep of purpose {part.purpose}, found {settings.reference}")
    return PATIENT in settings.rig.bodies and not elsewhere


def find_reference(settings: Settings, tracker: BodyTracker, film: Film) -> Reference | None:
    """Where the patient stood when the skin was measured: as given, or in the fringe images of both cameras; None of a capture
    without any.

    Raises
    ------
    InputError
        If the given file has no pose, or the fringe images don't show the patient to both cameras, or show two.
    """
    if settings.reference is not None:
        return read_reference(settings.reference)
    held = manifest.read_manifest(settings.capture).surface
    if held is None:
        return None
    place = f"{settings.capture}: surface"
    way = "give reference=FILE, or a rig without that body"
    if lacking := [name for name in CAMERAS if name not in held.images]:
        raise InputError(
            f"{place}: expected fringe images of both cameras, by which the {PATIENT} stands, found none of {lacking[0]}; {way}"
        )
    found = tracker.step(*(mean_image(settings.capture, camera, settings.calibration) for camera in CAMERAS))[PATIENT]
    tracker.forget()
    if not found.found:
        expected = f"expected the target of the {PATIENT} in the fringe images of both cameras, found none"
        raise InputError(f"{place}: {expected}: {found.pose.reason}; {way}")
    if is_beside(found.apart_mm):
        raise InputError(
            f"{place}: expected one target of the {PATIENT}, found two, {found.apart_mm:.0f} mm apart; cover one, or {way}"
        )
    return Reference(results.track_of([results.kept(found, int(film.times[0]))]), "the fringe images")


def read_reference(path: Path) -> Reference:
    """A reference of an earlier run, whose cameras and target may have been known otherwise: all of its error is its own.

    Raises
    ------
    InputError
        If the file is missing or damaged, or has no pose.
    """
    given = sweep_tables.read_track(path)
    if (count := int(given.found.sum())) != 1:
        found = "none" if not count else f"{count}: the table of a film? reference.csv stands beside the patient's"
        raise InputError(f"{path}: expected a pose of the {PATIENT}, found {found}")
    whole = given.covariance if given.covariance is None or given.shared is None else given.covariance + given.shared
    return Reference(Track(given.times, given.poses, whole), str(path))


def mean_image(capture: Path, camera: str, calibration: Path | None = None) -> NDArray[np.float32]:
    """Mean : (h, w), 1 is full, of a camera's images of the fringe sequence, in which fringes even out."""
    shots = surface_part.read_surface(capture, camera, calibration)
    return shots.images.mean(axis=0, dtype=np.float32) / np.float32(2**shots.bits - 1)


def first_seen(steps: Sequence[Step]) -> Reference | None:
    """The first pose of the patient in a film; None if it isn't seen."""
    first = next((step for step in steps if step.found), None)
    return None if first is None else Reference(results.track_of([first]), "its first pose in this film")


def beside(steps: Mapping[str, Sequence[Step]], reference: Reference | None) -> dict[str, list[Step]]:
    """Steps of all bodies but the patient, as if that stood where it stood at the reference; without one no pose is known."""
    patient, told = results.track_of(steps[PATIENT]), {}
    nowhere = Track(np.zeros(1, np.int64), np.eye(4)[None])
    for name in steps.keys() - {PATIENT}:
        own = tracks.relative(results.track_of(steps[name]), patient, nowhere if reference is None else reference.pose)
        assert own.covariance is not None and own.shared is not None
        lost = np.full((6, 6), np.nan)
        told[name] = [
            replace(step, world_from_target=pose, covariance=covariance, shared=shared)
            if found
            else replace(
                step, world_from_target=pose, covariance=lost, shared=lost, reason=step.reason or f"the {PATIENT} isn't seen"
            )
            for step, pose, covariance, shared, found in zip(
                steps[name], own.poses, own.covariance, own.shared, own.found, strict=True
            )
        ]
    return told


def describe_motion(steps: Sequence[Step], reference: Reference | None, watch: Watch) -> Metrics:
    """Say how far the patient moved since the reference, which is taken out of poses; returns the figures, NaN of one unseen."""
    seen = [step.world_from_target for step in steps if step.found]
    if reference is None or not seen:
        watch.say(f"{'patient':11} never seen: no pose is told, as where skin and masses lie beside the cameras isn't known")
        return {"patient_moved_mm": np.nan, "patient_turned_deg": np.nan}
    first = reference.pose.poses[int(np.argmax(reference.pose.found))]
    moves = np.array([rigid.difference(first, pose) for pose in seen])
    turn, shift = (float(np.linalg.norm(part, axis=1).max()) for part in (moves[:, :3], moves[:, 3:]))
    watch.say(f"{'patient':11} moved since {reference.source} by up to {shift:.2f} mm and {np.rad2deg(turn):.2f} deg")
    watch.say(f"{'world':11} all poses but the patient's are told as if it had stayed there")
    if shift > FAR_MM or np.rad2deg(turn) > FAR_DEG:
        watch.say(f"{'warning':11} the patient is far from {reference.source}: is that another session's, or another body's?")
    return {"patient_moved_mm": shift, "patient_turned_deg": float(np.rad2deg(turn))}
