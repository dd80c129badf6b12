"""Stereo frames of a sweep: images that two cameras took of a moving target, read as a stream.

A film is the sweep part of a capture with images of both cameras, `sweep/cam1` and `sweep/cam2`, each with its `timestamps.csv`.
The cameras share a clock. Frames belong together by their time stamps, whatever their numbers. Three pairs at most are in memory.
"""

import logging
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
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

log = logging.getLogger(__name__)

AT_ONCE = 2  # pairs that are read, while one more waits or is worked on
APART, APART_NS = 0.1, 2_000_000  # of the period, and in time, that pairs are apart before it is said
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

    def some(self, chosen: NDArray[np.intp]) -> "Film":
        """The film of some of its pairs, by their places."""
        return replace(self, frames=self.frames[chosen], times=self.times[chosen])

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
        If the manifest, the calibration or a table is wrong, a camera or a frame is missing, or more than a quarter of the frames
        have no partner. The very last frame needs none: a recording may have been ended between both cameras.
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
    name, folders = read.name_of(folder), (places[0], places[1])
    film = Film(name, cameras, known.uncertainty, depths, folders, frames, tables[0][1][first])
    check_there(path for both in film.paths() for path in both)
    return film


def _partners(
    places: Sequence[Path], tables: Sequence[tuple[NDArray[np.int64], NDArray[np.int64]]]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Rows : (n,), (n,) of both tables that belong together: in order, as many and as near as can be.

    Cameras that run freely drift against each other, so that the nearest frame may be nearer to another; single frames that one
    of them lost leave the other's without a partner.
    """
    times = [table[1] for table in tables]
    periods = [float(np.median(np.diff(each))) for each in times if len(each) > 1]
    alone_ns = 33_000_000  # taken for the period where a single frame tells none
    period = min(periods) if periods else alone_ns
    near = 0.75  # of a period, that frames of a pair are apart at most: half, where cameras run freely, and their jitter
    first, second = _matched(times[0], times[1], near * period)
    most_alone = 0.25  # share of a camera's frames that may be without a partner
    for one, other, paired in ((0, 1, first), (1, 0, second)):
        alone = np.setdiff1d(np.arange(len(times[one])), paired)
        ended = alone.tolist() == [len(times[one]) - 1] and times[one][-1] > times[other][-1]  # between both cameras
        if not len(alone) or ended:
            continue
        k = int(alone[0])
        away = abs(int(times[other][_nearest(times[one][[k]], times[other])[0]]) - int(times[one][k])) * 1e-6
        if len(alone) > most_alone * len(times[one]):
            wanted = f"a frame of its own within {near * period * 1e-6:.1f} ms of {CAMERAS[one]}'s frame {tables[one][0][k]}"
            counts = " and ".join(f"{len(each)} frames of {name}" for each, name in zip(times, CAMERAS, strict=True))
            found = f"the nearest {away:.1f} ms away ({len(alone)} such, in {counts})"
            raise InputError(
                f"{places[other] / STAMPS}: expected {wanted}, found {found}; leave frames without a partner out of both tables"
            )
        text = "%s: left out %d of %d frames, without a partner in %s; the first is frame %d, %.1f ms from the nearest"
        log.warning(text, places[one] / STAMPS, len(alone), len(times[one]), CAMERAS[other], tables[one][0][k], away)
    apart = float(np.median(np.abs(times[0][first] - times[1][second])))
    if apart > max(APART * period, APART_NS):
        way = "a moving target is seen at two places. Trigger both cameras by hardware: sweep_triggers"
        log.warning("%s: pairs are %.1f ms apart (median); %s", places[0].parent, apart * 1e-6, way)
    return first, second


def _matched(first: NDArray[np.int64], second: NDArray[np.int64], most_ns: float) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Pairs of rows, both rising, less than `most_ns` apart, of which the sum of what is left of twice that is the greatest.

    Twice, so that one more pair always counts more than another's distance, but not more than those of a whole film.
    """
    low = np.searchsorted(second, first - most_ns, "right").tolist()
    high = np.searchsorted(second, first + most_ns, "left").tolist()
    pairs: list[tuple[int, int, int]] = []  # row of each table, and the pair before
    best = [(0.0, -1)]  # sum and last pair, by the number of the second table's rows that may be used
    for i, (start, end) in enumerate(zip(low, high, strict=True)):
        best += [best[-1]] * (end + 1 - len(best))
        gains = (2 * most_ns - np.abs(second[start:end] - first[i])).tolist()
        before = greatest = best[start]
        for j, gain in enumerate(gains, start):
            here = best[j + 1]
            if here[0] > greatest[0]:
                greatest = here
            if before[0] + gain > greatest[0]:
                greatest = before[0] + gain, len(pairs)
                pairs.append((i, j, before[1]))
            before, best[j + 1] = here, greatest
    rows, last = [], best[-1][1]
    while last >= 0:
        i, j, last = pairs[last]
        rows.append((i, j))
    found = np.array(rows[::-1], np.int64).reshape(-1, 2)
    return found[:, 0], found[:, 1]


def _nearest(wanted: NDArray[np.int64], times: NDArray[np.int64]) -> NDArray[np.int64]:
    """Row of the time nearest to each of those wanted."""
    after = np.clip(np.searchsorted(times, wanted), 1, max(len(times) - 1, 1)) % len(times)
    before = np.maximum(after - 1, 0)
    return np.where(np.abs(times[before] - wanted) <= np.abs(times[after] - wanted), before, after)
