"""The target as it was printed, from a film of it: the settings of the step, the step, and the files of its result."""

from pathlib import Path
from typing import Annotated

from pydantic import Field, model_validator

from recon.capture import stereo_frames, target_files
from recon.capture.stereo_frames import Film
from recon.errors import did_you_mean
from recon.files import atomic, metrics
from recon.model.rig import PROBE, Target
from recon.session import poses_step
from recon.session.tracker_settings import TrackerFields, make_tracker
from recon.session.watch import SILENT, Watch
from recon.target_calibration import target_bundle, target_figures, target_poses
from recon.target_calibration.target_bundle import Adjusted

BY = "calibrate-target"  # who writes
TARGET = "target.yaml"
NO_COVARIANCE = "the cameras' calibration has no covariance: its errors are not in these uncertainties"


class Settings(TrackerFields):
    """Source, and settings of the tracker and the adjustment."""

    capture: Path
    """folder: frames of cam1 and cam2 with their time stamps, as docs/captures.md describes"""
    sweep: str = ""
    """name of the sweep with these frames, of a capture that holds several"""
    body: str = PROBE
    """of which the target is measured: probe, or a name in rig.bodies"""
    most_poses: Annotated[int, Field(ge=target_poses.LEAST, le=10_000)] = 100
    """evenly out of those that differ by 2 mm or 1 deg; 8 or more"""
    least_tilt_deg: Annotated[float, Field(ge=0, le=45)] = 5.0
    """standard deviation of the directions in which it is seen; 0 takes any, the bow is unknown then"""
    least_range_mm: Annotated[float, Field(ge=0, le=1000)] = 20.0
    """from the nearest pose to the farthest; 0 takes any: the cameras' errors are averaged less then"""

    @model_validator(mode="after")
    def _known_body(self) -> "Settings":
        if self.body not in (names := list(self.rig.targets)):
            raise ValueError(f"body: expected one of {', '.join(names)}, found {self.body}{did_you_mean(self.body, names)}")
        return self

    @property
    def design(self) -> Target:
        """The target's design."""
        return self.rig.targets[self.body]


def run(settings: Settings, out: Path, watch: Watch = SILENT) -> None:
    """Track the film, adjust the target with a pose of each pair, and write.

    Raises
    ------
    InputError
        If the capture is incomplete or damaged, doesn't show the target from enough sides, or `out` can't be written to.
    """
    atomic.check_folder(out, BY, inputs=(settings.capture, settings.calibration, settings.networks))
    film = stereo_frames.read_film(settings.capture, settings.calibration, settings.sweep)
    adjusted = calibrate(film, settings, watch)
    figures = target_figures.measure(adjusted, settings.design)
    for line in (*target_figures.found(adjusted), *target_figures.describe(figures, settings.design)):
        watch.say(line)
    if film.optics is None:
        watch.say(f"warning     {NO_COVARIANCE}")
    with atomic.new_folder(out, BY) as folder:
        target_files.write(folder / TARGET, adjusted.target, adjusted.covariance)
        metrics.write(folder / metrics.FILE, figures)
    watch.say(f"wrote       {out}/{{{TARGET},{metrics.FILE}}}")


def calibrate(film: Film, settings: Settings, watch: Watch = SILENT) -> Adjusted:
    """Measure the target of a film, with its covariance.

    Raises
    ------
    InputError
        If the film doesn't show the target from enough sides, or a network is missing.
    """
    tracker = make_tracker(settings, settings.design, film.cameras, film.optics, film.bits)
    pairs = watch.follow(film.pairs(), len(film.times), "tracking")
    return target_bundle.calibrate(
        (found for _, found in poses_step.follow(tracker, film.times, pairs)),
        film.cameras,
        settings.design,
        tracker.optics_in_use,
        settings.most_poses,
        settings.least_tilt_deg,
        settings.least_range_mm,
        film.name,
    )
