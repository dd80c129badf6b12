"""The sweep part of a capture: B-scans with their time stamps, and the poses of the probe's target, each by its own clock.

B-scans are read one at a time: a sweep of some minutes is larger than it needs to be in memory.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from recon.capture import manifest, probe_files, sweep_tables
from recon.capture.images import Size, frame_file, read_image
from recon.capture.manifest import MANIFEST, SCANNER, STAMPS, Purpose, image_name
from recon.errors import Implausible, InputError, did_you_mean
from recon.files.regular import check_there
from recon.model import pose_checks, tracks
from recon.model.probe import ProbeCalibration
from recon.model.tracks import Track

Array = NDArray[np.float64]


@dataclass(frozen=True)
class SweepCapture:
    """A sweep of n B-scans; its tables are checked and every image is there, but none is read yet."""

    name: str
    size: Size  # of the B-scans: width, height, px
    paths: tuple[Path, ...]  # (n,)
    frames: NDArray[np.int64]  # (n,) numbers of the B-scans, increasing; a scanner may have dropped some
    times: NDArray[np.int64]  # (n,) ns, of the scanner's clock
    track: Track  # of the target, of the tracker's clock
    probe: ProbeCalibration | None = None
    left_out: int = 0  # poses that no hand makes, which the track has no longer
    bodies: Mapping[str, Track] = field(default_factory=dict)  # of further bodies, such as a needle, by the tracker's clock

    @property
    def clocked(self) -> bool:
        """Whether all B-scans have a time stamp, as of any sequence that could stand in place of this."""
        return True

    def from_body(self, name: str) -> "SweepCapture":
        """The same with poses `body_from_target` in the frame of a further body; InputError if it has none."""
        if name not in self.bodies:
            there = ", ".join(self.bodies) or "none: `sonotwin track` finds those of rig.bodies"
            raise InputError(
                f"{self.name}: body: expected one of those tracked, {there}; found {name}{did_you_mean(name, list(self.bodies))}"
            )
        return replace(self, track=tracks.from_body(self.track, self.bodies[name]))

    def image(self, number: int) -> NDArray[np.uint8]:
        """Read one B-scan : (h, w), counted from 0 whatever its frame's number; InputError if it is damaged."""
        return read_image(self.paths[number], self.size, bits=8)

    def images(self) -> Iterator[NDArray[np.uint8]]:
        """Read all B-scans : (h, w), one by one."""
        return (self.image(number) for number in range(len(self.paths)))

    def poses(self, lag_s: float = 0.0) -> Array:
        """Poses `world_from_target` : (n, 4, 4) at which the B-scans were taken, NaN where the target wasn't tracked.

        Parameters
        ----------
        lag_s : float
            How late the B-scans' time stamps are; see `recon.probe_calibration.latency.Lag`.

        Raises
        ------
        InputError
            If no B-scan has a pose.
        """
        poses = tracks.poses_at(self.track, self.times, lag_s)
        if not np.isfinite(poses).any():
            found = self._unplaced(lag_s) if self.track.found.any() else "none found"
            raise InputError(f"{self.name}: expected poses of the target while the B-scans were taken, found {found}")
        return poses

    def _unplaced(self, lag_s: float) -> str:
        """The likely reason why no B-scan lies between poses."""
        taken, known = self.times - round(lag_s * 1e9), self.track.times[self.track.found]
        spans = f"B-scans at {_span(taken)} s and poses at {_span(known)} s"
        if taken[-1] < known[0] or taken[0] > known[-1] or len(known) < 2:
            return f"{spans}: are the clocks others?"
        apart = f"poses mostly {1e-9 * float(np.median(np.diff(known))):.3g} s apart"
        return f"{spans}, {apart}: between two of them that are more than {tracks.MAX_GAP_S:g} s apart the probe may be anywhere"

    def pose_covariance(self, lag_s: float = 0.0) -> Array | None:
        """Covariance : (n, 6, 6) of these poses; see `recon.model.tracks.covariance_at`."""
        return tracks.covariance_at(self.track, self.times, lag_s)

    def shared_covariance(self, lag_s: float = 0.0) -> Array | None:
        """Covariance : (n, 6, 6) of what errs alike in all these poses; see `recon.model.tracks.shared_at`."""
        return tracks.shared_at(self.track, self.times, lag_s)

    def pose_shares(self, lag_s: float = 0.0) -> Array:
        """Weights : (n, m) of the m poses that were found in those of the n B-scans; see `recon.model.tracks.shares_at`."""
        return tracks.shares_at(self.track, self.times, lag_s)


def read_sweep(folder: Path, name: str = "", purpose: Purpose | None = None, implausible: Implausible = "refuse") -> SweepCapture:
    """Open a sweep of a capture folder: that of a name, else the only one, else the only one that is for a purpose.

    Poses that no hand makes are left out, with a warning, or taken all the same; images are read only to look into poses that
    repeat.

    Raises
    ------
    InputError
        If the manifest is wrong or has no such sweep, a table or the probe's calibration is wrong, an image is not there, or too
        many poses are implausible; see `recon.model.pose_checks`.
    """
    folder = Path(folder)
    read = manifest.read_manifest(folder)
    place, part = read.sweep_of(folder / MANIFEST, "B-scans and the poses of the probe", name, purpose)
    root, entry = folder / read.root, manifest.field_of(place)
    for key, found, way in (
        (f"images.{SCANNER}", part.images.get(SCANNER), ""),
        ("track", part.track, "; find the poses by `sonotwin track` first, and give its folder as the capture"),
    ):
        if found is None:
            raise InputError(f"{folder / MANIFEST}: {entry}.{key}: expected a path, found none{way}")
    device = read.devices_of(place)[SCANNER]
    if device.bits != 8:
        raise InputError(f"{folder / MANIFEST}: devices.{SCANNER}.bits: expected 8, found {device.bits}")
    scans = root / part.images[SCANNER]
    frames, times = sweep_tables.read_stamps(scans / STAMPS)
    paths = tuple(frame_file(scans, image_name(frame)) for frame in frames.tolist())
    check_there(paths)
    listed = root / str(part.track)
    track, left_out = _believed(listed, sweep_tables.read_track(listed), paths, times, device.size, implausible)
    probe = None if read.probe is None else probe_files.read(folder / read.probe)
    bodies = {body: sweep_tables.read_track(root / path) for body, path in (part.bodies or {}).items()}
    return SweepCapture(read.name_of(folder), device.size, paths, frames, times, track, probe, left_out, bodies)


def _believed(
    listed: Path, track: Track, paths: tuple[Path, ...], times: NDArray[np.int64], size: Size, implausible: Implausible
) -> tuple[Track, int]:
    """The track without poses that no hand makes, and their number."""
    seconds, taken = ((each - track.times[0]) * 1e-9 for each in (track.times, times))

    def images() -> tuple[Array, NDArray[np.float32]]:
        return taken, pose_checks.small_images(read_image(path, size, bits=8) for path in paths)

    poses, found = pose_checks.without_implausible(str(listed), seconds, track.poses, implausible, images)
    pose_checks.check_motion(str(listed), seconds, poses, implausible)
    return replace(track, poses=poses), len(found.rows_left_out)


def _span(times: NDArray[np.int64]) -> str:
    return f"{times[0] * 1e-9:.3f} to {times[-1] * 1e-9:.3f}"
