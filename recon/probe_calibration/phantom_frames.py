"""Frames of a probe's calibration: in which of them the phantom was found, and the reasons in the others."""

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray

from recon import registry
from recon.errors import InputError
from recon.model.probe import ProbeCalibration
from recon.probe_calibration.cross_wire import Appearance, Crossing
from recon.probe_calibration.movement import Movement
from recon.probe_calibration.point_calibration import NO_POSE, Sightings

PHANTOMS, CROSSED_WIRES = "recon.probe_calibration.phantoms", "crossed_wires"  # a module each; the usual one
STYLUS = "stylus"

Array = NDArray[np.float64]
Size = tuple[int, int]  # width, height, px


class Seen(Protocol):
    """A phantom in an image, or the reason of its rejection."""

    __dataclass_fields__: ClassVar[dict[str, Any]]

    @property
    def pixel(self) -> Array:
        """Of its point, or of the middle of several : (2,) px."""
        ...

    @property
    def contrast_db(self) -> float:
        """Of the strongest echo above the background; NaN without any."""
        ...

    @property
    def reason(self) -> str | None:
        """Of the rejection."""
        ...

    @property
    def found(self) -> bool:
        """Whether there is no such reason."""
        ...

    def shifted(self, corner: tuple[int, int]) -> "Seen":
        """The same in an image of which this one is a part, from a pixel on."""
        ...


class Adjusted(Protocol):
    """A calibration by n frames."""

    __dataclass_fields__: ClassVar[dict[str, Any]]

    @property
    def calibration(self) -> ProbeCalibration:
        """In the tank's water."""
        ...

    @property
    def rms_mm(self) -> float:
        """Distance from where the phantom is, outliers left out."""
        ...

    @property
    def distances_mm(self) -> Array:
        """The same of each frame : (n,)."""
        ...

    @property
    def normalised(self) -> Array:
        """The same over their standard deviations : (n,)."""
        ...

    @property
    def outliers(self) -> NDArray[np.bool_]:
        """Frames : (n,) that are left out."""
        ...

    @property
    def noise_factor(self) -> float:
        """Measured noise over the assumed."""
        ...

    @property
    def moved(self) -> Movement | None:
        """What moved while the frames were taken."""
        ...


@dataclass(frozen=True)
class PhantomFrames:
    """A phantom in n frames."""

    name: str  # of the capture or file, for messages
    size: Size
    sightings: Any  # of the m usable frames, as the phantom's kind has them
    numbers: NDArray[np.int64]  # (n,) of the frames
    seen: tuple[Seen, ...]  # (n,)
    first_row: int = 0  # px, of the part of the images that was looked at
    phantom: str = CROSSED_WIRES  # its kind
    known: Any = None  # of the phantom, by its kind's `read`
    poses: Array = field(kw_only=True)  # (n, 4, 4) NaN where there is none

    @property
    def usable(self) -> NDArray[np.int64]:
        """Indices of the frames with a sighting : (m,)."""
        return np.flatnonzero([each.found for each in self.seen])


def look(
    name: str,
    images: Iterable[NDArray[np.uint8]],
    size: Size,
    numbers: NDArray[np.int64],
    poses: Array,
    pose_covariance: Array | None = None,
    appearance: Appearance | None = None,
    corner: tuple[int, int] = (0, 0),
    phantom: str = CROSSED_WIRES,
    pose_rates: Array | None = None,
    lag_sigma_s: float = 0.0,
    known: Any = None,
) -> PhantomFrames:
    """Find the phantom in n B-scans, taken one by one, at poses : (n, 4, 4) with a covariance : (n, 6, 6).

    pose_rates : (n, 4, 4) change of the poses a second of the B-scans' lag.
    lag_sigma_s : s, its standard deviation.
    size, corner : of the whole images, and the column and row of the first pixel of the parts that are looked at; px.
    phantom : module of `recon.probe_calibration.phantoms` that finds it.
    known : of the phantom, by this module's `read`.
    """
    kind = registry.kind(PHANTOMS, phantom)
    seen = tuple(kind.find(image, appearance, known).shifted(corner) for image in images)
    frames = PhantomFrames(name, size, None, numbers, seen, corner[1], phantom, known, poses=poses)
    return at_poses(frames, poses, pose_covariance, pose_rates, lag_sigma_s)


def at_poses(
    frames: PhantomFrames,
    poses: Array,
    pose_covariance: Array | None = None,
    pose_rates: Array | None = None,
    lag_sigma_s: float = 0.0,
) -> PhantomFrames:
    """The same n frames at other poses, as those of another lag; arguments as of `look`."""
    tracked = np.isfinite(poses).all(axis=(1, 2))
    found = [replace(each, reason=None) if each.reason == NO_POSE else each for each in frames.seen]
    seen = tuple(
        each if there else replace(each, reason=each.reason or NO_POSE) for each, there in zip(found, tracked, strict=True)
    )
    usable = np.flatnonzero([each.found for each in seen])
    covariance, rates = (None if each is None else each[usable] for each in (pose_covariance, pose_rates))
    kind = registry.kind(PHANTOMS, frames.phantom)
    sightings = kind.sight([seen[k] for k in usable], poses[usable], covariance, rates, lag_sigma_s)
    return replace(frames, sightings=sightings, seen=seen, poses=poses)


def some(frames: PhantomFrames, chosen: NDArray[np.intp]) -> PhantomFrames:
    """Some of the frames, by number from 0 on, before they are put at poses."""
    seen = tuple(frames.seen[k] for k in chosen)
    return replace(frames, sightings=None, numbers=frames.numbers[chosen], seen=seen, poses=frames.poses[chosen])


def of_pairs(name: str, size: Size, poses: Array, pixels: Array) -> PhantomFrames:
    """Frames of n pairs of a pose and the crossing's pixel, found elsewhere."""
    crossings = tuple(Crossing(pixel, np.full((2, 2), np.nan), np.nan) for pixel in pixels)
    return PhantomFrames(name, size, Sightings(poses, pixels), np.arange(len(pixels)), crossings, poses=poses)


def rejected(frames: PhantomFrames) -> dict[str, list[int]]:
    """Numbers of the frames without the phantom, by kind of reason, the commonest first."""
    kinds: dict[str, list[int]] = {}
    for number, seen in zip(frames.numbers.tolist(), frames.seen, strict=True):
        if seen.reason is not None:
            kinds.setdefault(seen.reason.partition(":")[0], []).append(number)
    return dict(sorted(kinds.items(), key=lambda item: -len(item[1])))


def refuse_few(frames: PhantomFrames) -> None:
    """Refuse a capture with too few usable frames, naming the commonest reason.

    Raises
    ------
    InputError
        If there are fewer than the phantom needs.
    """
    phantom = registry.kind(PHANTOMS, frames.phantom)
    if len(frames.usable) < phantom.MIN_FRAMES:
        kind = next(iter(rejected(frames)), "no more were given")
        reason = next((each.reason for each in frames.seen if (each.reason or "").startswith(kind)), kind)
        way = f"; {phantom.WAYS[kind]}" if kind in phantom.WAYS else ""
        expected = f"{phantom.MIN_FRAMES} frames or more with a pose and the {phantom.SHOWS}"
        raise InputError(f"{frames.name}: expected {expected}, found {len(frames.usable)} (most often: {reason}{way})")
