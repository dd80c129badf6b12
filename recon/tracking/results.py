"""Results of tracking: a step of a kilobyte for each pair of frames, the track that the steps make, its tables and pictures."""

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from recon.capture import manifest, sweep_tables
from recon.capture.manifest import SCANNER, image_name
from recon.capture.stereo_frames import Film, Pair
from recon.geometry.camera import Camera
from recon.model.tracks import Track
from recon.tracking import overlays
from recon.tracking.pose_fit import Triangulated
from recon.tracking.tracker import Tracking

Array = NDArray[np.float64]

POSES, FRAMES, OVERLAYS = manifest.POSES, "frames.csv", "overlays"
BODIES = manifest.BODIES  # folder of the same tables of further bodies, each in a folder of its name
COLUMNS = (
    "time_ns", "frame_cam1", "frame_cam2", "found", "how", "sigma_mm", "sigma_deg", "shared_mm", "shared_deg", "blur_px_cam1",
    "blur_px_cam2", "reason",
)  # fmt: skip
OVERLAY_WIDTH = 640  # px, of each view
QUALITY = 88  # of JPEG


@dataclass(frozen=True, slots=True)
class Step:
    """A pair of frames, tracked: without its images and rims."""

    time_ns: int
    world_from_target: Array  # (4, 4) mm; NaN if it wasn't found
    covariance: Array  # (6, 6) by the pair's noise, as in tracks.Track
    shared: Array  # (6, 6) by tolerances of target and cameras
    triangle: Triangulated | None  # of all circles in both views
    how: str | None  # as of Tracking
    reason: str | None  # None where the target was found
    blur_px: tuple[float, float]  # the longest of each view
    seconds: float  # that it took
    apart_mm: float | None = None  # as of Tracking

    @property
    def found(self) -> bool:
        """Whether there is a pose."""
        return self.reason is None

    @property
    def sigmas(self) -> tuple[float, float]:
        """Predicted standard deviations of the whole error, over all directions: mm and deg; NaN without a pose."""
        return _over_all_directions(self.covariance + self.shared)

    @property
    def shared_sigmas(self) -> tuple[float, float]:
        """Those of the part that all pairs share."""
        return _over_all_directions(self.shared)


def kept(found: Tracking, time_ns: int) -> Step:
    """The step that is kept of a pair."""
    pose, (first, second) = found.pose, found.views
    blurs = float(np.fmax.reduce(first.blur_px)), float(np.fmax.reduce(second.blur_px))
    seconds = sum(found.seconds.values())
    covariances = pose.covariance, pose.shared
    place = pose.world_from_target
    return Step(time_ns, place, *covariances, pose.triangle, found.how, pose.reason, blurs, seconds, found.apart_mm)


def track_of(steps: Sequence[Step]) -> Track:
    """The track that n pairs make, in order of time."""
    return Track(
        np.array([step.time_ns for step in steps], np.int64),
        np.array([step.world_from_target for step in steps]).reshape(-1, 4, 4),
        np.array([step.covariance for step in steps]).reshape(-1, 6, 6),
        np.array([step.shared for step in steps]).reshape(-1, 6, 6),
    )


def write_poses(folder: Path, film: Film, steps: Sequence[Step]) -> None:
    """Write `poses.csv`, the table that other verbs read, and `frames.csv`: how each pose was found, or why not."""
    sweep_tables.write_track(folder / POSES, track_of(steps))
    rows = (
        [step.time_ns, *numbers, int(step.found), step.how or "", *_numbers(step), step.reason or ""]
        for numbers, step in zip(film.frames.tolist(), steps, strict=True)
    )
    sweep_tables.write_rows(folder / FRAMES, COLUMNS, rows)


def overlay(pair: Pair, found: Tracking | Mapping[str, Tracking], cameras: Sequence[Camera]) -> NDArray[np.uint8]:
    """Both views side by side : (h, w, 3) BGR, scaled down, with the results drawn in, of several bodies with their names."""
    shown, bodies = [], {"": found} if isinstance(found, Tracking) else found
    for k, (image, camera) in enumerate(zip(pair, cameras, strict=True)):
        size = (OVERLAY_WIDTH, round(image.shape[0] * OVERLAY_WIDTH / image.shape[1]))
        drawn = overlays.bodies_drawn(image, {name: (one.views[k], one.pose) for name, one in bodies.items()}, camera)
        shown.append(cv2.resize(drawn, size, interpolation=cv2.INTER_AREA))
    tallest = max(len(each) for each in shown)
    return np.hstack([np.pad(each, ((0, tallest - len(each)), (0, 0), (0, 0))) for each in shown])


def write_overlay(folder: Path, number: int, picture: NDArray[np.uint8]) -> None:
    """Write an overlay as `overlays/0007.jpg`, making the folder."""
    (folder / OVERLAYS).mkdir(exist_ok=True)
    _, data = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
    (folder / OVERLAYS / overlay_name(number)).write_bytes(data.tobytes())


def overlay_name(number: int) -> str:
    """File name of the overlay of camera 1's frame of a number."""
    return image_name(number).replace(".png", ".jpg")


def hand_on(folder: Path, source: Path, out: Path, optics: Path | None = None, sweep: str = "") -> bool:
    """Make a folder of poses a capture: the one that they were found in, with them as its tracks. Only if it has B-scans.

    Parameters
    ----------
    folder : where to write.
    source : the capture.
    out : where the folder is going to be.
    optics : the calibration that they were found with, if it isn't the capture's own.
    sweep : name of the sweep that was tracked, of several; the others are left out.
    """
    read = manifest.read_manifest(source)
    place, part = read.sweep_of(source / manifest.MANIFEST, "tracked", sweep)
    if SCANNER not in part.images:
        return False
    source, out = source.resolve(), out.resolve()
    root = source / read.root
    files = {name: os.path.relpath(source / path, out) for name in ("calibration", "probe") if (path := getattr(read, name))}
    if optics is not None:
        files["calibration"] = os.path.relpath(optics.resolve(), out)
    bodies = {
        path.parent.name: os.path.relpath(out / path.relative_to(folder), root)
        for path in sorted((folder / BODIES).glob(f"*/{POSES}"))
    }
    tracked = part.model_copy(update={"track": os.path.relpath(out / POSES, root), "bodies": bodies or None})
    own = place.partition("/")[2]
    parts = {"sweeps": {own: tracked}} if own else {"sweep": tracked}
    manifest.write_manifest(folder, read.model_copy(update={"root": os.path.relpath(root, out), **parts, **files}))
    return True


def _over_all_directions(covariance: Array) -> tuple[float, float]:
    """Root of the sum of the three variances, of the shift, mm, and of the turn, deg."""
    turn, shift = (float(np.sqrt(np.trace(covariance[part, part]))) for part in (slice(0, 3), slice(3, 6)))
    return shift, float(np.rad2deg(turn))


def _numbers(step: Step) -> list[float | str]:
    """Standard deviations and blurs, in the order of COLUMNS; empty where they aren't known."""
    values = (*step.sigmas, *step.shared_sigmas, *step.blur_px)
    return [round(value, 5) if np.isfinite(value) else "" for value in values]
