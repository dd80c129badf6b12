"""Measure the probe's target as it was printed: places and diameter of its circles, and the bow of its board.

Reads a capture folder with frames of both cameras (sweep/cam1, sweep/cam2) and their calibration, as `sonotwin track` does: any
film in which both cameras see the target whole, slowly moved, tilted to all sides, nearer and farther. Writes into the folder
`out`: target.yaml (with the covariance) and metrics.json. What is there already is replaced. Takes half a second a pose, besides
tracking the film.

    sonotwin film out=outputs/turned path.turn_deg=20 white_dn=120
    sonotwin calibrate-target capture=outputs/turned/capture out=outputs/target
    sonotwin track capture=outputs/film/capture target=outputs/target/target.yaml out=outputs/track

Both films are of one seed: those of another show another print, of which this one's measures are wrong.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

from pydantic import Field
from rich.console import Console
from rich.progress import Progress

from recon.capture import stereo_frames, target_files
from recon.capture.stereo_frames import Film
from recon.files import atomic, metrics
from recon.target_calibration import target_bundle, target_figures, target_poses
from recon.tracking.tracker import Tracker, Tracking
from sonotwin.tracker_fields import TrackerFields, make_tracker

TARGET = "target.yaml"
NO_COVARIANCE = "the cameras' calibration has no covariance: its errors are not in these uncertainties"


class Config(TrackerFields):
    """Fields of `sonotwin calibrate-target`."""

    capture: Path
    """folder: frames of cam1 and cam2 with their time stamps, as docs/captures.md describes"""
    sweep: str = ""
    """name of the sweep with these frames, of a capture that holds several"""
    out: Path
    """folder: gets target.yaml and metrics.json"""
    most_poses: Annotated[int, Field(ge=target_poses.LEAST, le=10_000)] = 100
    """evenly out of those that differ by 2 mm or 1 deg; 8 or more"""
    least_tilt_deg: Annotated[float, Field(ge=0, le=45)] = 5.0
    """standard deviation of the directions in which it is seen; 0 takes any, the bow is unknown then"""
    least_range_mm: Annotated[float, Field(ge=0, le=1000)] = 20.0
    """from the nearest pose to the farthest; 0 takes any: the cameras' errors are averaged less then"""


def run(config: Config) -> None:
    """Track the film, adjust the target with a pose of each pair, and write.

    Raises
    ------
    InputError
        If the capture is incomplete or damaged, doesn't show the target from enough sides, or `out` can't be written to.
    """
    console = Console(soft_wrap=True, highlight=False)
    inputs = [path for path in (config.capture, config.calibration, config.networks) if path is not None]
    atomic.check_folder(config.out, "calibrate-target", inputs=inputs)
    film = stereo_frames.read_film(config.capture, config.calibration, config.sweep)
    design = config.rig.target
    tracker = make_tracker(config, design, film.cameras, film.optics, film.bits)
    adjusted = target_bundle.calibrate(
        tracked(film, tracker, console),
        film.cameras,
        design,
        tracker.optics_in_use,
        config.most_poses,
        config.least_tilt_deg,
        config.least_range_mm,
        film.name,
    )
    for line in target_figures.found(adjusted):
        console.print(line, markup=False)
    figures = target_figures.measure(adjusted, design)
    for line in target_figures.describe(figures, design):
        console.print(line, markup=False)
    if film.optics is None:
        console.print(f"warning     {NO_COVARIANCE}", markup=False)
    with atomic.new_folder(config.out, "calibrate-target") as folder:
        target_files.write(folder / TARGET, adjusted.target, adjusted.covariance)
        metrics.write(folder / metrics.FILE, figures)
    console.print(f"wrote       {config.out}/{{{TARGET},{metrics.FILE}}}", markup=False)


def tracked(film: Film, tracker: Tracker, console: Console) -> Iterator[Tracking]:
    """The tracker's result of each pair of a film, with a bar of progress."""
    with Progress(console=console, transient=True, disable=not console.is_terminal) as progress:
        pairs = progress.track(film.pairs(), total=len(film.times), description="tracking")
        for time, pair in zip(film.times.tolist(), pairs, strict=True):
            yield tracker.step(*pair, time * 1e-9)
