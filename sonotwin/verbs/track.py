"""Track the probe's target through the frames of two cameras.

Reads a capture folder with frames of both cameras (sweep/cam1, sweep/cam2) and their calibration; frames are paired by their time
stamps. Writes into the folder `out`: poses.csv, poses with their covariance in the layout that all verbs read; frames.csv, the
way in which each pose was found, or the reason why not; overlays/, both views side by side with the rims found; and metrics.json.
Exit status 1 if no pair shows the target.
Frames are read one after the other, so a film may be of any length. Results that are there already are replaced. Takes some
seconds, the first time a minute to compile, and 20 to 60 frames a second from then on.

If the capture has B-scans too (sweep/us), `out` becomes a capture itself, those images with these poses, and the verbs that need
poses are given it instead:

    sonotwin film out=outputs/film
    sonotwin track capture=outputs/film/capture out=outputs/track
    sonotwin track capture=recorded calibration=calibration/optics.yaml out=tracked
    sonotwin track capture=recorded target=target/target.yaml out=tracked
    sonotwin freehand capture=tracked probe=probe.yaml lag_s=0.05 out=volume
"""

import sys
from pathlib import Path
from time import perf_counter

import numpy as np
from rich.console import Console
from rich.progress import Progress

from recon.capture import stereo_frames
from recon.capture.stereo_frames import Film
from recon.files import atomic, metrics
from recon.tracking import results, track_figures
from recon.tracking.results import Step
from recon.tracking.tracker import Tracker
from sonotwin.tracker_fields import MeasuredTargetFields, make_tracker, target_of


class Config(MeasuredTargetFields):
    """Fields of `sonotwin track`."""

    capture: Path
    """folder: frames of cam1 and cam2 with their time stamps, as docs/captures.md describes"""
    sweep: str = ""
    """name of the sweep with these frames, of a capture that holds several"""
    out: Path
    """folder: gets poses.csv, frames.csv, overlays/, metrics.json; and manifest.json if there are B-scans"""
    overlays: bool = True
    """pictures of every pair of frames, 0.1 MB and some hundredths of a second each"""


def run(config: Config) -> int:
    """Read, track and write; returns 1 if no pair shows the target.

    Raises
    ------
    InputError
        If the capture is incomplete or damaged, a network is missing, or `out` can't be written to.
    """
    console = Console(soft_wrap=True, highlight=False)
    inputs = [path for path in (config.capture, config.calibration, config.target, config.networks) if path is not None]
    atomic.check_folder(config.out, "track", inputs=inputs)
    film = stereo_frames.read_film(config.capture, config.calibration, config.sweep)
    target = target_of(config)
    tracker = make_tracker(config, target, film.cameras, film.optics, film.bits)
    rate = f", {film.rate_hz:.4g} a second" if np.isfinite(film.rate_hz) else ""
    sizes = " and ".join(dict.fromkeys("x".join(map(str, camera.size)) for camera in film.cameras))
    console.print(f"read        {len(film.times)} pairs of frames, {sizes}{rate}", markup=False)

    with atomic.new_folder(config.out, "track") as folder:
        start = perf_counter()
        steps = follow(film, tracker, folder if config.overlays else None, console)
        figures = track_figures.measure(steps, target)
        for line in (*track_figures.describe(steps, figures), *track_figures.causes(steps, target)):
            console.print(line, markup=False)
        results.write_poses(folder, film, steps)
        metrics.write(folder / metrics.FILE, figures | {"seconds_track": round(perf_counter() - start, 3)})
        results.hand_on(folder, config.capture, config.out, config.calibration, config.sweep)
        written = sorted(path.name + "/" * path.is_dir() for path in folder.iterdir())
    console.print(f"wrote       {config.out}/{{{','.join(written)}}}", markup=False)
    if figures["frames_found"] == 0:
        reason, number = track_figures.kinds([step.reason for step in steps])[0]
        print(f"sonotwin: {film.name}: no pose in {len(steps)} pairs: {reason} ({number}); see frames.csv", file=sys.stderr)
    return int(figures["frames_found"] == 0)


def follow(film: Film, tracker: Tracker, pictures: Path | None, console: Console) -> list[Step]:
    """Track a film from its first pair to its last, writing overlays into a folder if one is given."""
    steps = []
    with Progress(console=console, transient=True, disable=not console.is_terminal) as progress:
        pairs = progress.track(film.pairs(), total=len(film.times), description="tracking")
        for time, (number, _), pair in zip(film.times.tolist(), film.frames.tolist(), pairs, strict=True):
            found = tracker.step(*pair, time * 1e-9)
            steps.append(results.kept(found, time))
            if pictures is not None:
                results.write_overlay(pictures, number, results.overlay(pair, found, film.cameras))
    return steps
