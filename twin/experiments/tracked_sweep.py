"""A filmed sweep whose frames aren't kept: each pair is rendered, and tracked by our method and by the paper's."""

from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from recon.capture.images import write_images
from recon.capture.manifest import image_name
from recon.capture.sweep_part import SweepCapture
from recon.model.calibration import Calibration
from recon.session import poses_step
from recon.tracking import results
from recon.tracking.networks import Networks
from recon.tracking.tracker import Tracker
from twin.experiments.baselines import published_probe
from twin.experiments.drawn_session import pair
from twin.experiments.pose_accuracy import published_recipe
from twin.filmed_sweep import PlannedSweep
from twin.tracking.sampling_ranges import DataRanges
from twin.ultrasound.bscan_truth import labels

Array = NDArray[np.float64]


class Optics(NamedTuple):
    """Calibrations of one board: ours of all devices, and the paper's of pairs."""

    ours: Calibration
    cameras: Calibration  # camera 1 and camera 2
    light: Calibration  # camera 1 and the projector


@dataclass(frozen=True)
class TrackedSweep:
    """B-scans, and the poses of the target by both methods."""

    ours: SweepCapture
    times: NDArray[np.int64]  # (m,) ns, of the pairs
    published: Array  # (m, 4, 4) world_from_target by the published recipe, no rotations; NaN where it finds none
    labels: NDArray[np.uint8]  # (n, h, w) of what each B-scan shows: 0 the surroundings, k + 1 the solid k
    solids: tuple[str, ...]  # their names

    def published_at(self, lag_s: float) -> Array:
        """The published matrices : (n, 4, 4) at which the B-scans were taken."""
        return published_probe.matrices_at(self.times, self.published, self.ours.times - np.int64(round(lag_s * 1e9)))


def track(planned: PlannedSweep, optics: Optics, networks: Networks, ranges: DataRanges, folder: Path) -> TrackedSweep:
    """Render a sweep and track it.

    Parameters
    ----------
    ranges : of body, surroundings and light
    folder : for the B-scans
    """
    settings, plan = planned.settings, planned.plan
    tracker = Tracker(pair(optics.ours), settings.rig.target, networks, optics=optics.ours.uncertainty)
    recipe, theirs = published_recipe(networks), pair(optics.cameras)
    steps, matrices = [], []
    film = planned.film(ranges)
    followed = poses_step.follow(tracker, film.times, (frames.views for frames in film.frames()))
    for time, (views, found) in zip(film.times.tolist(), followed, strict=True):
        steps.append(results.kept(found, time))
        matrix = recipe(theirs, views)
        matrices.append(np.full((4, 4), np.nan) if matrix is None else matrix)
    paths = tuple(folder / settings.name / image_name(number) for number in range(len(plan.times)))
    shown = []
    for path, scan in zip(paths, planned.scans(), strict=True):
        write_images([path], scan.image[None])
        shown.append(labels(scan.paths, settings.ultrasound))
    numbers = np.arange(len(paths))
    ours = SweepCapture(settings.name, settings.ultrasound.image_size, paths, numbers, plan.times, results.track_of(steps))
    solids = tuple(solid.name for solid in planned.scanned.solids)
    return TrackedSweep(ours, film.times, np.stack(matrices), np.stack(shown), solids)
