"""B-scans of a sweep, each with the pair of frames nearest in time, for programs to which frame k of all devices is one moment.

The pose is that of the frames, from which such programs compute it anew. The B-scan was taken a little before or after.
"""

from collections.abc import Iterator
from dataclasses import dataclass

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
    """m B-scans, in order of time; the same frames may be nearest to two of them."""

    scans: NDArray[np.int64]  # (m,) which of the sweep
    pairs: NDArray[np.int64]  # (m,) which of the film
    apart_s: Array  # (m,) s, how much later the B-scan was taken than its frames
    poses: Array  # (m, 4, 4) world_from_target as the frames were taken, mm
    scan_poses: Array  # (m, 4, 4) the same as the B-scan was taken

    @property
    def moved_mm(self) -> Array:
        """Movement of the target's origin between frames and B-scan : (m,) mm."""
        return np.linalg.norm((self.scan_poses - self.poses)[:, :3, 3], axis=1)


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
    scan_poses, frame_poses = sweep.poses(lag_s), tracks.at(sweep.track, film.times)
    frame_poses[np.isin(film.times, sweep.track.times[~sweep.track.found])] = np.nan  # which show no target, whatever lies around
    scans, known = (np.flatnonzero(np.isfinite(poses).all(axis=(1, 2))) for poses in (scan_poses, frame_poses))
    if not len(known):
        raise InputError(
            f"{sweep.name}: expected poses of the target as the frames were taken, found none: are the clocks others?"
        )
    taken, moments = sweep.times[scans] - np.int64(round(lag_s * 1e9)), film.times[known]
    after = np.searchsorted(moments, taken).clip(0, len(moments) - 1)
    before = np.maximum(after - 1, 0)
    pairs = np.where(taken - moments[before] <= np.abs(moments[after] - taken), before, after)
    apart_s = (taken - moments[pairs]) * 1e-9
    near = np.abs(apart_s) <= (np.inf if most_apart_s is None else most_apart_s)
    if not near.any():
        found = f"the nearest {1e3 * np.abs(apart_s).min():.3g} ms away"
        raise InputError(f"{sweep.name}: expected frames within {1e3 * (most_apart_s or 0):g} ms of a B-scan, found {found}")
    scans, pairs = scans[near], known[pairs[near]]
    return PairedScans(scans, pairs, apart_s[near], frame_poses[pairs], scan_poses[scans])


def images(sweep: SweepCapture, film: Film, paired: PairedScans) -> Iterator[tuple[str, int, Grey]]:
    """Images of 8 bits, one by one: device, number from 0 on, (h, w)."""
    files = list(film.paths())
    for number, (scan, both) in enumerate(zip(paired.scans.tolist(), paired.pairs.tolist(), strict=True)):
        yield SCANNER, number, sweep.image(scan)
        for device, path, camera, bits in zip(CAMERAS, files[both], film.cameras, film.depths, strict=True):
            yield device, number, (read_image(path, camera.size, bits) >> (bits - 8)).astype(np.uint8)
