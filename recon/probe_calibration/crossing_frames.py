"""Frames of a probe's calibration: in which of them the crossing of the wires was found, and the reasons in the others."""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from recon.errors import InputError
from recon.probe_calibration import cross_wire, point_calibration
from recon.probe_calibration.cross_wire import Appearance, Crossing
from recon.probe_calibration.point_calibration import MIN_FRAMES, Sightings

Array = NDArray[np.float64]
Size = tuple[int, int]  # width, height, px

FIELDS = {  # of an appearance, by the reason of a rejection that another scanner makes of them
    "blurred": "max_sigma_px",
    "only drawn-out echoes": "max_extent_px",
    "no echo stands out": "min_contrast_db",
    "two candidates": "rival_db",
}
ONE_CROSSING = "only two crossed wires can be found: use such a phantom, or give pairs=FILE with one point's pixels"


@dataclass(frozen=True)
class CrossingFrames:
    """The crossing in n frames."""

    name: str  # of the capture or file, for messages
    size: Size
    sightings: Sightings  # of the m usable frames
    numbers: NDArray[np.int64]  # (n,) of the frames
    crossings: tuple[Crossing, ...]  # (n,)
    first_row: int = 0  # px, of the part of the images that was looked at

    @property
    def usable(self) -> NDArray[np.int64]:
        """Indices of the frames with a sighting : (m,)."""
        return np.flatnonzero([crossing.found for crossing in self.crossings])


def look(
    name: str,
    images: Iterable[NDArray[np.uint8]],
    size: Size,
    numbers: NDArray[np.int64],
    poses: Array,
    pose_covariance: Array | None = None,
    appearance: Appearance | None = None,
    corner: tuple[int, int] = (0, 0),
    phantom: str = point_calibration.CROSSED_WIRES,
    pose_by_lag: Array | None = None,
) -> CrossingFrames:
    """Find the crossing in n B-scans, taken one by one, at poses : (n, 4, 4) with a covariance : (n, 6, 6).

    pose_by_lag : (n, 4, 4) change of the poses by one standard deviation of the B-scans' lag.
    size, corner : of the whole images, and the column and row of the first pixel of the parts that are looked at; px.
    phantom : module of `recon.probe_calibration.phantoms` that finds it.
    """
    sightings, crossings = point_calibration.from_images(images, poses, appearance, phantom)
    sightings = replace(sightings, pixels=sightings.pixels + corner)
    whole = tuple(replace(crossing, pixel=crossing.pixel + corner) for crossing in crossings)
    frames = CrossingFrames(name, size, sightings, numbers, whole, corner[1])
    of_poses = {"pose_covariance": pose_covariance, "pose_by_lag": pose_by_lag}
    usable = {field: None if value is None else value[frames.usable] for field, value in of_poses.items()}
    return replace(frames, sightings=replace(sightings, **usable))


def of_pairs(name: str, size: Size, poses: Array, pixels: Array) -> CrossingFrames:
    """Frames of n pairs of a pose and the crossing's pixel, found elsewhere."""
    crossings = tuple(Crossing(pixel, np.full((2, 2), np.nan), np.nan) for pixel in pixels)
    return CrossingFrames(name, size, Sightings(poses, pixels), np.arange(len(pixels)), crossings)


def rejected(frames: CrossingFrames) -> dict[str, list[int]]:
    """Numbers of the frames without a crossing, by kind of reason, the commonest first."""
    kinds: dict[str, list[int]] = {}
    for number, crossing in zip(frames.numbers.tolist(), frames.crossings, strict=True):
        if crossing.reason is not None:
            kinds.setdefault(crossing.reason.partition(":")[0], []).append(number)
    return dict(sorted(kinds.items(), key=lambda item: -len(item[1])))


def refuse_few(frames: CrossingFrames) -> None:
    """Refuse a capture with too few usable frames, naming the commonest reason.

    Raises
    ------
    InputError
        If there are fewer than six.
    """
    if len(frames.usable) < MIN_FRAMES:
        kind = next(iter(rejected(frames)), "no more were given")
        reason = next((each.reason for each in frames.crossings if (each.reason or "").startswith(kind)), kind)
        way = f"; another scanner? give appearance.{FIELDS[kind]}" if kind in FIELDS else ""
        if kind == cross_wire.SEVERAL:
            way = f"; N-wires? {ONE_CROSSING}; reverberations? give appearance.rival_db"
        expected = f"{MIN_FRAMES} frames or more with a pose and the crossing"
        raise InputError(f"{frames.name}: expected {expected}, found {len(frames.usable)} (most often: {reason}{way})")
