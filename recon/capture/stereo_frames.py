"""Stereo frames of a sweep: images that two cameras took of a moving target, read as a stream.

A film is the sweep part of a capture with images of both cameras, `sweep/cam1` and `sweep/cam2`, each with its `timestamps.csv`.
The cameras share a clock. Frames belong together by their time stamps, whatever their numbers. Three pairs at most are in memory.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from recon.capture import calibration_files, manifest, sweep_tables
from recon.capture.images import Images, frame_file, read_image
from recon.capture.manifest import CAMERAS, MANIFEST, STAMPS, image_name
from recon.errors import InputError
from recon.files.regular import check_there
from recon.geometry.camera import Camera
from recon.model.calibration import Uncertainty
from recon.threads import mapped

AT_ONCE = 2  # pairs that are read, while one more waits or is worked on
ALONE_NS = 33_000_000  # taken for the period where a single frame tells none
Pair = tuple[Images, Images]


@dataclass(frozen=True)
class Film:
    """n pairs of frames; tables and calibration are checked and every image is there, but none is read yet."""

    name: str
    cameras: tuple[Camera, Camera]
    optics: Uncertainty | None  # of the cameras' calibration; None where the file has none
    depths: tuple[int, int]  # bits of each camera
    folders: tuple[Path, Path]  # of each camera's frames
    frames: NDArray[np.int64]  # (n, 2) their numbers
    times: NDArray[np.int64]  # (n,) ns, of camera 1's frames

    @property
    def bits(self) -> int | None:
        """Of whole numbers beyond 8 bits; None if there are none."""
        return max(self.depths) if max(self.depths) > 8 else None

    def paths(self) -> Iterator[tuple[Path, Path]]:
        """Of both frames, pair by pair."""
        first, second = self.folders
        return ((frame_file(first, image_name(a)), frame_file(second, image_name(b))) for a, b in self.frames.tolist())

    @property
    def rate_hz(self) -> float:
        """Pairs a second; NaN of a single one."""
        return 1e9 / float(np.median(np.diff(self.times))) if len(self.times) > 1 else np.nan

    def pairs(self) -> Iterator[Pair]:
        """Read the frames, camera 1's and camera 2's : (h, w), pair by pair; InputError at one that is damaged."""

        def read(both: tuple[Path, Path]) -> Pair:
            first, second = map(read_image, both, (camera.size for camera in self.cameras), self.depths)
            return first, second

        return mapped(read, self.paths(), most=AT_ONCE)


def read_film(folder: Path, calibration_file: Path | None = None, sweep: str = "") -> Film:
    """Open the film of a capture folder, with a calibration from elsewhere if one is given.

    Parameters
    ----------
    sweep : name of one of several.

    Raises
    ------
    InputError
        If the manifest, the calibration or a table is wrong, a camera or a frame is missing, or frames have no partner. The very
        last frame needs none: a recording may have been ended between both cameras.
    """
    folder = Path(folder)
    read = manifest.read_manifest(folder)
    listed, images = folder / MANIFEST, read.images_of(folder, CAMERAS, sweep)
    file = read.calibration_file(folder, calibration_file)
    depths = images[CAMERAS[0]].device.bits, images[CAMERAS[1]].device.bits
    if min(depths) > 8 and depths[0] != depths[1]:
        raise InputError(f"{listed}: devices.cam2.bits: expected {depths[0]}, as of cam1, found {depths[1]}")
    sizes = {name: each.device.size for name, each in images.items()}
    known = calibration_files.read_for(file, sizes)
    cameras = known.cameras[CAMERAS[0]], known.cameras[CAMERAS[1]]
    places = [each.folder for each in images.values()]
    tables = [sweep_tables.read_stamps(place / STAMPS) for place in places]
    first, second = _partners(places, tables)
    frames = np.column_stack([tables[0][0][first], tables[1][0][second]])
    name, folders = read.name or folder.resolve().name, (places[0], places[1])
    film = Film(name, cameras, known.uncertainty, depths, folders, frames, tables[0][1][first])
    check_there(path for both in film.paths() for path in both)
    return film


def _partners(
    places: Sequence[Path], tables: Sequence[tuple[NDArray[np.int64], NDArray[np.int64]]]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Rows : (n,), (n,) of both tables that belong together: each the other's nearest in time, within half a period."""
    tables = _without_a_last_one(tables)
    times = [table[1] for table in tables]
    periods = [float(np.median(np.diff(each))) for each in times if len(each) > 1]
    allowed = (min(periods) if periods else ALONE_NS) / 2
    nearest = [_nearest(times[0], times[1]), _nearest(times[1], times[0])]
    for one, other in ((0, 1), (1, 0)):
        own = np.arange(len(times[one]))
        alone = (nearest[other][nearest[one]] != own) | (np.abs(times[other][nearest[one]] - times[one]) > allowed)
        if alone.any():
            k = int(np.flatnonzero(alone)[0])
            away = abs(int(times[other][nearest[one][k]]) - int(times[one][k])) * 1e-6
            wanted = f"a frame of its own within {allowed * 1e-6:.1f} ms of {CAMERAS[one]}'s frame {tables[one][0][k]}"
            counts = " and ".join(f"{len(each)} frames of {name}" for each, name in zip(times, CAMERAS, strict=True))
            raise InputError(
                f"{places[other] / STAMPS}: expected {wanted}, found the nearest {away:.1f} ms away ({alone.sum()} such, "
                f"in {counts}); leave frames without a partner out of both tables"
            )
    return np.arange(len(times[0])), nearest[0]


def _without_a_last_one(
    tables: Sequence[tuple[NDArray[np.int64], NDArray[np.int64]]],
) -> list[tuple[NDArray[np.int64], NDArray[np.int64]]]:
    """The tables, less a frame at the end that one camera has more than the other: a recording that was cut off there."""
    counts = [len(frames) for frames, _ in tables]
    most = min(counts) if max(counts) - min(counts) == 1 and min(counts) > 0 else max(counts)
    return [(frames[:most], times[:most]) for frames, times in tables]


def _nearest(wanted: NDArray[np.int64], times: NDArray[np.int64]) -> NDArray[np.int64]:
    """Row of the time nearest to each of those wanted."""
    after = np.clip(np.searchsorted(times, wanted), 1, max(len(times) - 1, 1)) % len(times)
    before = np.maximum(after - 1, 0)
    return np.where(np.abs(times[before] - wanted) <= np.abs(times[after] - wanted), before, after)
