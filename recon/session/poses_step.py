"""Poses of the target from the frames of two cameras: the settings of the step, the step, and the files of its result."""

from collections.abc import Iterable, Iterator
from pathlib import Path
from time import perf_counter

import numpy as np
from numpy.typing import NDArray

from recon.capture import stereo_frames
from recon.capture.stereo_frames import Film, Pair
from recon.files import atomic, metrics
from recon.session.tracker_settings import MeasuredTargetFields, make_tracker, target_of
from recon.session.watch import SILENT, Watch
from recon.tracking import results, track_figures
from recon.tracking.results import Step
from recon.tracking.tracker import Tracker, Tracking

BY = "track"  # who writes


class Settings(MeasuredTargetFields):
    """Source, and settings of the tracker."""

    capture: Path
    """folder: frames of cam1 and cam2 with their time stamps, as docs/captures.md describes"""
    sweep: str = ""
    """name of the sweep with these frames, of a capture that holds several"""
    overlays: bool = True
    """pictures of every pair of frames, 0.1 MB and some hundredths of a second each"""


def run(settings: Settings, out: Path, watch: Watch = SILENT) -> list[Step]:
    """Read, track and write; returns a step for each pair of frames, with its pose, or the reason why there is none.

    Raises
    ------
    InputError
        If the capture is incomplete or damaged, a network is missing, or `out` can't be written to.
    """
    sources = (settings.capture, settings.calibration, settings.target, settings.networks)
    atomic.check_folder(out, BY, inputs=sources)
    film = stereo_frames.read_film(settings.capture, settings.calibration, settings.sweep)
    target = target_of(settings)
    tracker = make_tracker(settings, target, film.cameras, film.optics, film.bits)
    rate = f", {film.rate_hz:.4g} a second" if np.isfinite(film.rate_hz) else ""
    sizes = " and ".join(dict.fromkeys("x".join(map(str, camera.size)) for camera in film.cameras))
    watch.say(f"read        {len(film.times)} pairs of frames, {sizes}{rate}")
    with atomic.new_folder(out, BY) as folder:
        start = perf_counter()
        steps = track(film, tracker, folder if settings.overlays else None, watch)
        figures = track_figures.measure(steps, target)
        for line in (*track_figures.describe(steps, figures), *track_figures.causes(steps, target)):
            watch.say(line)
        results.write_poses(folder, film, steps)
        metrics.write(folder / metrics.FILE, figures | {"seconds_track": round(perf_counter() - start, 3)})
        results.hand_on(folder, settings.capture, out, settings.calibration, settings.sweep)
        written = sorted(path.name + "/" * path.is_dir() for path in folder.iterdir())
    watch.say(f"wrote       {out}/{{{','.join(written)}}}")
    if figures["frames_found"] == 0:
        reason, number = track_figures.kinds([step.reason for step in steps])[0]
        watch.warn(f"{film.name}: no pose in {len(steps)} pairs: {reason} ({number}); see frames.csv")
    return steps


def track(film: Film, tracker: Tracker, pictures: Path | None = None, watch: Watch = SILENT) -> list[Step]:
    """Track a film from its first pair to its last, writing overlays into a folder if one is given."""
    steps = []
    pairs = watch.follow(film.pairs(), len(film.times), "tracking")
    for time, (number, _), (pair, found) in zip(
        film.times.tolist(), film.frames.tolist(), follow(tracker, film.times, pairs), strict=True
    ):
        steps.append(results.kept(found, time))
        if pictures is not None:
            results.write_overlay(pictures, number, results.overlay(pair, found, film.cameras))
    return steps


def follow(tracker: Tracker, times: NDArray[np.int64], pairs: Iterable[Pair]) -> Iterator[tuple[Pair, Tracking]]:
    """Pairs of frames at times : (n,) ns, each with what the tracker finds in it."""
    for time, pair in zip(times.tolist(), pairs, strict=True):
        yield pair, tracker.step(*pair, time * 1e-9)
