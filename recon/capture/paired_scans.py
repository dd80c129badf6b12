"""B-scans of a sweep, each with the pair of frames nearest in time, for programs to which frame k of all devices is one moment.

The pose is that of the frames, from which such programs compute it anew. The B-scan was taken a little before or after.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from recon.capture.images import read_image
from recon.capture.manifest import CAMERAS, SCANNER
from recon.capture.stereo_frames import Film
from recon.capture.sweep_part import SweepCapture
from recon.errors import InputError
from recon.model import tracks

Array = NDArray[np.float64]
Grey = NDArray[np.uint8]


@dataclass(frozen=True)
class PairedScans:
    """m B-scans of a sweep, in order of time; the same frames may be nearest to two of them. Without a film they stand alone."""

    sweep: SweepCapture
    film: Film | None
    scans: NDArray[np.int64]  # (m,) which of the sweep
    pairs: NDArray[np.int64]  # (m,) which of the film
    apart_s: Array  # (m,) s, how much later the B-scan was taken than its frames
    poses: Array  # (m, 4, 4) world_from_target as the frames were taken, mm
    scan_poses: Array  # (m, 4, 4) the same as the B-scan was taken

    @property
    def moved_mm(self) -> Array:
        """Movement of the target's origin between frames and B-scan : (m,) mm."""
        return np.linalg.norm((self.scan_poses - self.poses)[:, :3, 3], axis=1)

    def chosen(self, which: NDArray) -> "PairedScans":
        """Those that a mask or an index selects."""
        columns = ("scans", "pairs", "apart_s", "poses", "scan_poses")
        return replace(self, **{name: getattr(self, name)[which] for name in columns})

    def images(self) -> Iterator[tuple[str, int, Grey]]:
        """Images of 8 bits, one by one: device, number from 0 on, (h, w)."""
        files = [] if self.film is None else list(self.film.paths())
        for number, (scan, both) in enumerate(zip(self.scans.tolist(), self.pairs.tolist(), strict=True)):
            yield SCANNER, number, self.sweep.image(scan)
            if self.film is not None:
                for device, path, camera, bits in zip(CAMERAS, files[both], self.film.cameras, self.film.depths, strict=True):
                    yield device, number, (read_image(path, camera.size, bits) >> (bits - 8)).astype(np.uint8)


def alone(sweep: SweepCapture, lag_s: float = 0.0) -> PairedScans:
    """B-scans that have a pose, without frames; InputError if there is none."""
    poses = sweep.poses(lag_s)
    scans = np.flatnonzero(np.isfinite(poses).all(axis=(1, 2)))
    return PairedScans(sweep, None, scans, np.full_like(scans, -1), np.zeros(len(scans)), poses[scans], poses[scans])


def pair(sweep: SweepCapture, film: Film, lag_s: float = 0.0, most_apart_s: float | None = None) -> PairedScans:
    """Pair B-scans that have a pose with the frames, of those with a pose too, that were taken nearest to each.

    Parameters
    ----------
    lag_s : s, delay of the B-scans' time stamps
    most_apart_s : s, most between a B-scan and its frames; None for any

    Raises
    ------
    InputError
        If no B-scan, or no frame, has a pose, or none is near enough.
    """
    placed, frame_poses = alone(sweep, lag_s), tracks.at(sweep.track, film.times)
    frame_poses[np.isin(film.times, sweep.track.times[~sweep.track.found])] = np.nan  # which show no target, whatever lies around
    known = np.flatnonzero(np.isfinite(frame_poses).all(axis=(1, 2)))
    if not len(known):
        raise InputError(
            f"{sweep.name}: expected poses of the target as the frames were taken, found none: are the clocks others?"
        )
    taken, moments = sweep.times[placed.scans] - np.int64(round(lag_s * 1e9)), film.times[known]
    after = np.searchsorted(moments, taken).clip(0, len(moments) - 1)
    before = np.maximum(after - 1, 0)
    nearest = np.where(taken - moments[before] <= np.abs(moments[after] - taken), before, after)
    pairs, apart_s = known[nearest], (taken - moments[nearest]) * 1e-9
    paired = replace(placed, film=film, pairs=pairs, apart_s=apart_s, poses=frame_poses[pairs])
    if most_apart_s is None:
        return paired
    near = np.abs(apart_s) <= most_apart_s
    if not near.any():
        found = f"the nearest {1e3 * np.abs(apart_s).min():.3g} ms away"
        raise InputError(f"{sweep.name}: expected frames within {1e3 * most_apart_s:g} ms of a B-scan, found {found}")
    return paired.chosen(near)
