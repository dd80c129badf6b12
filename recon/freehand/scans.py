"""B-scans in space, of a capture or of a PLUS sequence, and the volume that they are compounded into."""

import logging
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from itertools import repeat
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import model_validator

from recon.capture import probe_files
from recon.capture.images import read_image
from recon.capture.sweep_part import SweepCapture
from recon.errors import Implausible, InputError, refuse_or_warn
from recon.files.metrics import Metrics
from recon.files.volumes import Volume
from recon.freehand import (
    hole_filling,
    place_uncertainty,
    scan_checks,
    sequence_checks,
    sequence_sweep,
    sequences,
    volume_compounding,
)
from recon.freehand.place_uncertainty import PlaceErrors
from recon.freehand.plus_arithmetic import Arithmetic
from recon.freehand.sequence_sweep import SequenceFields
from recon.freehand.sequences import FrameName, FrameNames
from recon.freehand.volume_compounding import MOST_BYTES, Clip, Compounding, Interpolation, Mask, Reconstruction, grid_of
from recon.geometry import rigid
from recon.model import fan, lengths, pose_checks, tracks
from recon.model.fan import Fan
from recon.model.probe import SCANNER_SPEED, ProbeCalibration, Speed, SpeedSigma
from recon.model.rig import NotNegative, Part
from recon.model.tracks import LagSeconds
from recon.probe_calibration import sound_in_water

log = logging.getLogger(__name__)

Array = NDArray[np.float64]
Extent = Literal["aligned", "principal"]

MOST_KEPT = 512 << 20  # bytes of images that are kept in memory


class Unsure(NamedTuple):
    """Standard deviations of settings that are told."""

    lag_s: float = 0.0
    tissue_m_s: float = 0.0


ASSUMED = Unsure(0.1, 50.0)  # of a lag that is taken as none: scanners show images 0 to 200 ms late; and of any tissue's sound


class TissueFields(Part):
    """The sound in what was scanned, by which echoes have their depths."""

    tissue_m_s: Speed | None = None
    """m/s, of sound in what was scanned: 1540 on average, 1440 to 1480 in fat, 1450 in soft silicone, 1488 in water of 22 deg C.
    Null leaves depths as of the speed that the probe's calibration holds for; a sequence's own: 1540"""
    tissue_sigma_m_s: SpeedSigma | None = None
    """m/s, standard deviation of the former, of which masses' places are uncertain; null: 25 where that is given, as of tissue
    that is known by its kind alone, and 50 else; fat has 1440 to 1480, glands 1510 to 1570"""


class ScansFields(TissueFields, SequenceFields):
    """Fields of a verb that places the B-scans of a capture or of a sequence in the world."""

    capture: Path | None = None
    """a capture folder with a sweep"""
    sweep: str = ""
    """its name, of a capture that holds several; "" takes the only one for the volume"""
    probe: Path | None = None
    """the probe's calibration, probe.yaml or US_params.npz; takes the place of that of the capture or sequence"""
    lag_s: LagSeconds | None = None
    """s, delay of the B-scans' time stamps, as of `sonotwin measure-lag`; null takes none, to 0.1 s"""
    lag_sigma_s: NotNegative | None = None
    """s, standard deviation of the former, 0 where that is given and 0.1 else, of which the places of pixels are uncertain; of
    a capture only"""
    image: FrameName | None = None
    """frame of the sequence that its pixels are in; null is the configuration's, or else Image"""
    config: Path | None = None
    """PLUS configuration (XML) that came with the sequence: its transforms, which go before the sequence's own, its
    frames and clip, and its settings of the volume. What is given here goes before both"""

    @model_validator(mode="after")
    def _one_source(self) -> "ScansFields":
        if (self.capture is None) == (self.sequence is None):
            raise ValueError(f"expected capture or sequence, found {'neither' if self.capture is None else 'both'}")
        if self.capture is not None and self.config is not None:
            raise ValueError("config: expected a configuration with a sequence only, found one with a capture")
        if self.sequence is not None and self.lag_sigma_s:
            raise ValueError(f"lag_sigma_s: expected none with a sequence, without covariances, found {self.lag_sigma_s:g}")
        if self.target is not None and self.probe is None:
            raise ValueError(
                f"target: expected a probe with it, whose calibration holds in that frame, found {self.target} alone"
            )
        return self

    @property
    def lag(self) -> float:
        """Lag of the B-scans, s; none where it isn't given."""
        return self.lag_s or 0.0

    @property
    def unsure(self) -> Unsure:
        """Standard deviations, wider of what isn't given but assumed."""
        lag = self.lag_sigma_s if self.lag_sigma_s is not None else ASSUMED.lag_s if self._lag_assumed else 0.0
        known_tissue_m_s = 25.0  # m/s, standard deviation of the speed of sound in tissue that is known by its kind
        known = ASSUMED.tissue_m_s if self.tissue_m_s is None else known_tissue_m_s
        return Unsure(lag, known if self.tissue_sigma_m_s is None else self.tissue_sigma_m_s)

    @property
    def _lag_assumed(self) -> bool:
        return self.capture is not None and self.lag_s is None

    def assumptions(self, speed_m_s: float, poses_exact: bool = False) -> Iterator[str]:
        """Lines on what was assumed, as it wasn't given."""
        if poses_exact:
            yield "poses without errors, as they have no covariance: standard deviations of places leave out the tracking's"
        if self._lag_assumed:
            yield f"no lag of the B-scans, ± {1e3 * self.unsure.lag_s:g} ms (1 sigma); measure-lag finds it, give lag_s"
        if self.tissue_m_s is None:
            sigma = f"{self.unsure.tissue_m_s:g} m/s (1 sigma)"
            yield f"sound of {speed_m_s:.0f} m/s in what was scanned, as calibrated, ± {sigma}; give tissue_m_s"


@dataclass(frozen=True)
class VolumeSettings:
    """Settings of the volume that B-scans are put into."""

    spacing_mm: float | tuple[float, float, float] = 0.5  # of the voxels
    extent: Extent = "principal"  # or along the world's axes
    compounding: Compounding = "mean"
    interpolation: Interpolation = "nearest"
    clip: Clip | None = None
    hole_voxels: int = hole_filling.MOST_VOXELS  # longest stick across a hole; 0 leaves holes open
    hole_sticks: int = 1  # the shortest ones that count
    fan: Fan | None = None  # within the clip
    arithmetic: Arithmetic = "floating"  # or that of the PLUS toolkit
    weights: Path | None = None  # image of the pixels' weights, of the weighted compounding

    def box(self, shape: tuple[int, int]) -> Clip | None:
        """Rectangle, of images (h, w), that is used; without a clip the one about the fan."""
        return self.clip or (None if self.fan is None else Clip(*fan.box(self._mask(self.fan, shape))))

    def part(self, shape: tuple[int, int]) -> tuple[Clip | None, Mask | None, NDArray[np.uint8] | None]:
        """Rectangle and pixels, of images (h, w), that are used, and their weights."""
        weights = self.weights_of(shape)
        masks = [*([] if weights is None else [weights > 0]), *([] if self.fan is None else [self._mask(self.fan, shape)])]
        return self.box(shape), np.logical_and.reduce(masks) if masks else None, weights

    def _mask(self, of: Fan, shape: tuple[int, int]) -> Mask:
        mask = of.mask(shape, 0 if self.arithmetic == "plus_none" else 1)
        if not mask.any():
            raise InputError(f"fan: expected a part of an image of {shape[1]}x{shape[0]}, found {of}")
        return mask

    def weights_of(self, shape: tuple[int, int]) -> NDArray[np.uint8] | None:
        """Weights of the pixels of images (h, w), if they have any; InputError without a file of theirs, or of another size."""
        if (self.weights is None) == (self.compounding == "weighted"):
            found = f"{self.weights or 'none'} with compounding={self.compounding}"
            raise InputError(f"weights: expected an image with compounding=weighted, and only then, found {found}")
        if self.weights is None:
            return None
        weights = read_image(self.weights, shape[::-1], 8)
        if not weights.any():
            raise InputError(f"{self.weights}: expected weights above 0, found none")
        return weights


@dataclass(frozen=True)
class Scans:
    """n B-scans in space, of any source."""

    shape: tuple[int, int]  # height, width
    world_from_pixel: Array  # (n, 4, 4); NaN where there is no pose
    stream: Callable[[], Iterator[NDArray[np.uint8]]]  # the images (h, w), one by one, from the first at each call
    speed_m_s: float  # of the sound for which the depths hold
    calibrated_m_s: float  # of that for which the calibration holds
    probe: ProbeCalibration | None = None  # converted likewise; None where the sequence has its own
    errors: PlaceErrors | None = None  # of their places; None where nothing is known of them
    elsewhere: bool = False  # 3D Slicer shows their sequence elsewhere than results in the world
    left_out: int = 0  # poses of their track that no hand makes
    times_s: Array | None = None  # (n,) when they were taken, by their own clock; None where it isn't known

    @property
    def placed(self) -> int:
        """Number of B-scans with a pose."""
        return int(np.isfinite(self.world_from_pixel).all(axis=(1, 2)).sum())

    @property
    def poses_exact(self) -> bool:
        """Whether poses count as without errors, as their track has no covariance."""
        return self.errors is not None and not self.errors.known


def probe_of(sweep: SweepCapture, capture: Path, given: Path | None) -> ProbeCalibration:
    """The probe's calibration: from the given file, else from the capture.

    Raises
    ------
    InputError
        If there is neither.
    """
    if given is not None:
        return probe_files.read(given)
    if sweep.probe is None:
        raise InputError(f"{capture}: expected the probe's calibration, found none; give probe=...")
    return sweep.probe


def of_sweep(
    sweep: SweepCapture, probe: ProbeCalibration, lag_s: float, tissue_m_s: float | None, sigmas: Unsure | None = None
) -> Scans:
    """Place the B-scans of a capture in the world, with depths as of the tissue's speed of sound, if it is given."""
    converted = sound_in_water.for_tissue(probe, tissue_m_s)
    target_from_pixel, unsure = sequences.target_from_pixel(converted), sigmas or Unsure()
    covariance, shared, found = sweep.track.covariance, sweep.shared_covariance(lag_s), sweep.track.found
    errors = PlaceErrors(
        np.zeros((found.sum(), 6, 6)) if covariance is None else covariance[found],
        sweep.pose_shares(lag_s),
        np.zeros((len(sweep.paths), 6, 6)) if shared is None else shared,
        tracks.rates_at(sweep.track, sweep.times, lag_s) @ target_from_pixel,
        unsure.lag_s,
        unsure.tissue_m_s / converted.speed_m_s,
        covariance is not None,
    )
    placed = sweep.poses(lag_s) @ target_from_pixel
    times_s = (sweep.times - sweep.times[:1]) * 1e-9
    return Scans(sweep.size[::-1], placed, sweep.images, converted.speed_m_s, probe.speed_m_s, converted, errors, times_s=times_s)


def of_sequence(
    path: Path,
    names: FrameNames | None = None,
    probe: ProbeCalibration | None = None,
    fixed: Mapping[str, Array] | None = None,
    lag_s: float = 0.0,
    tissue_m_s: float | None = None,
    tracker: Path | None = None,
    implausible: Implausible = "refuse",
) -> Scans:
    """Place the B-scans of a PLUS sequence in its reference frame.

    Parameters
    ----------
    probe : ProbeCalibration, optional
        Takes the place of the sequence's own, which counts as one for 1540 m/s.
    fixed : (4, 4) by name, optional
        Transforms that go before those of the sequence, such as "ImageToProbe".
    tracker : Path, optional
        The sequence file of the poses, where they were saved apart from the images.
    implausible : "refuse" or "take"
        Whether poses and lengths that no hand and no scanner makes are used all the same.

    Raises
    ------
    InputError
        If the file is damaged, no transforms lead from the images to the reference frame, or that is RAS, which results aren't
        written in.
    """
    image, target, reference = names or FrameNames()
    if reference.upper() == sequences.RAS:
        expected = f"{sequences.LPS}, which files of volumes and surfaces are declared to be in; 3D Slicer turns them to RAS"
        raise InputError(f"{path}: reference: expected {expected}, found {reference}")
    shape, start = sequences.image_shape(path), image if probe is None else target
    hint = "" if probe or fixed else "; no calibration of the probe among them? give probe=... or config=..."
    frames, left_out = sequence_checks.read_tracking(path, reference, start, fixed, tracker, implausible, hint)
    world_from_start = sequences.poses(frames, reference, start, fixed)
    world_from_pixel = world_from_start if probe is None else world_from_start @ sequences.target_from_pixel(probe)
    placed = sequence_sweep.lagged(str(path), frames.times_s, world_from_pixel, lag_s)
    calibrated, face_row = (SCANNER_SPEED, 0.0) if probe is None else (probe.speed_m_s, probe.face_row)
    speed = tissue_m_s or calibrated
    matrices = sound_in_water.in_tissue(
        np.where(frames.valid["Image"][:, None, None], placed, np.nan), calibrated, speed, face_row
    )
    converted = None if probe is None else sound_in_water.for_tissue(probe, tissue_m_s)
    elsewhere = sequences.lies_elsewhere(frames, reference)
    images = partial(sequences.stream_images, path)
    return Scans(shape, matrices, images, speed, calibrated, converted, None, elsewhere, left_out, frames.times_s)


def cut(scans: Scans, clip: Clip) -> Scans:
    """The part of each B-scan within a clip, in its place, as if the scanner had shown no more."""
    left, right, top, bottom = clip.bounds(scans.shape)
    pixel_from_cut = rigid.transform(np.eye(3), [left, top, 0])
    errors = None if scans.errors is None else replace(scans.errors, rates=scans.errors.rates @ pixel_from_cut)
    return replace(
        scans,
        shape=(bottom - top + 1, right - left + 1),
        world_from_pixel=scans.world_from_pixel @ pixel_from_cut,
        stream=lambda: (clip.cut(image) for image in scans.stream()),
        probe=None if scans.probe is None else place_uncertainty.from_pixel(scans.probe, (left, top)),
        errors=errors,
    )


def in_memory(scans: Scans, most_bytes: int = MOST_KEPT) -> Scans:
    """Read the images once and keep them; where they are more than `most_bytes`, they are read anew at each call."""
    if len(scans.world_from_pixel) * scans.shape[0] * scans.shape[1] > most_bytes:
        return scans
    images = list(scans.stream())
    return replace(scans, stream=lambda: iter(images))


def summary(scans: Scans) -> str:
    """One line: number and size of the B-scans, and number of those with a pose."""
    height, width = scans.shape
    return f"{len(scans.world_from_pixel)} B-scans, {width}x{height}, {scans.placed} with a pose"


def depths(scans: Scans) -> str:
    """One line: the speed of sound for which the depths hold."""
    calibrated, speed = scans.calibrated_m_s, scans.speed_m_s
    how = "as calibrated" if speed == calibrated else f"converted from {calibrated:.0f} m/s, for which the probe is calibrated"
    return f"right for sound of {speed:.0f} m/s, {how}"


def cautions(scans: Scans) -> Iterator[str]:
    """Lines of warning about where results lie, of what they are made, and what is unlike a sweep; none as a rule."""
    if line := pose_checks.coverage(np.isfinite(scans.world_from_pixel).all(axis=(1, 2))):
        yield line
    if scans.elsewhere:
        yield "3D Slicer shows the sequence where its transforms to RAS put it, and these results elsewhere: give reference=LPS"
    soft_m_s = (900.0, 1800.0)  # of soft tissues, water, silicone and gels
    if not soft_m_s[0] <= scans.speed_m_s <= soft_m_s[1]:
        found = f"sound of {scans.speed_m_s:g} m/s in all that was scanned"
        yield f"{found}: of bone or gas? Soft tissues, water and silicone have {soft_m_s[0]:g} to {soft_m_s[1]:g} m/s"
    yield from scan_checks.faults(scans.stream(), scans.world_from_pixel)


def _pixel_sides(scans: Scans) -> Array:
    """Width and height : (2,) mm of a pixel, in the median; NaN without a pose."""
    placed = scans.world_from_pixel[np.isfinite(scans.world_from_pixel).all(axis=(1, 2))]
    return np.median(np.linalg.norm(placed[:, :3, :2], axis=1), axis=0) if len(placed) else np.full(2, np.nan)


def sides(scans: Scans, clip: Clip | None = None) -> list[float]:
    """Width and height of the B-scans, or of their part within a clip, mm."""
    left, right, top, bottom = (clip or Clip(0, 0, scans.shape[1], scans.shape[0])).bounds(scans.shape)
    return (_pixel_sides(scans) * [right - left + 1, bottom - top + 1]).tolist()


def _size_faults(scans: Scans, clip: Clip | None = None) -> list[str]:
    """Faults of the size of the B-scans, or of their part within a clip, and of their axes; none as a rule."""
    placed = scans.world_from_pixel[np.isfinite(scans.world_from_pixel).all(axis=(1, 2))]
    if not len(placed):
        return []
    faults = []
    wrong = [fault for side in sides(scans, clip) if (fault := lengths.B_SCAN.fault(side))]
    if wrong:
        same = np.abs(_pixel_sides(scans) - 1).max() < 1e-6
        cause = ", pixels of 1 mm: the identity in place of the probe's calibration?" if same else ""
        faults.append(f"sides of {lengths.B_SCAN}, found {wrong[0]}{cause}")
    if found := lengths.axes_fault(placed[0]):
        faults.append(f"square axes, found {found}")
    return faults


def check_size(scans: Scans, place: str, clip: Clip | None, implausible: Implausible) -> None:
    """Refuse B-scans of a size or with axes that no scanner's have, or warn of them.

    Raises
    ------
    InputError
        If they are, and not to be taken.
    """
    for fault in _size_faults(scans, clip):
        refuse_or_warn(place, f"B-scans: expected {fault}", implausible)
    if doubt := next(filter(None, map(lengths.B_SCAN.doubt, sides(scans, clip))), None):
        log.warning("%s: a side of the B-scans is %s", place, doubt)


def volume(scans: Scans, settings: VolumeSettings, most_bytes: int = MOST_BYTES) -> tuple[Reconstruction, Reconstruction]:
    """Put all B-scans into a volume.

    Returns
    -------
    Reconstruction, Reconstruction
        Before its holes are filled, and after; the same if they are left open.

    Raises
    ------
    InputError
        If no B-scan has a pose, or as `recon.freehand.volume_compounding.reconstruct`.
    """
    clip, mask, weights = settings.part(scans.shape)
    around = volume_compounding.corners(scans.world_from_pixel, scans.shape, clip)
    grid_along = volume_compounding.aligned_grid if settings.extent == "aligned" else volume_compounding.principal_grid
    pasted = volume_compounding.reconstruct(
        scans.stream(),
        scans.world_from_pixel,
        grid_along(around, settings.spacing_mm),
        settings.compounding,
        settings.interpolation,
        clip,
        None if mask is None else repeat(mask, len(scans.world_from_pixel)),
        most_bytes=most_bytes,
        arithmetic=settings.arithmetic,
        weights=weights,
    )
    if settings.hole_voxels == 0:
        return pasted, pasted
    return pasted, hole_filling.fill_holes(pasted, settings.hole_voxels, settings.hole_sticks, settings.arithmetic != "floating")


def sigma_volume(scans: Scans, volume: Volume, settings: VolumeSettings) -> Volume | None:
    """Standard deviations, mm over all directions, of the place of what each voxel shows; None where they aren't known."""
    if scans.probe is None or scans.probe.uncertainty is None or scans.errors is None or not scans.errors.known:
        return None
    forms = place_uncertainty.forms(scans.world_from_pixel, scans.probe, scans.errors)
    return place_uncertainty.sigma_volume(
        forms, scans.world_from_pixel, scans.shape, grid_of(volume), *settings.part(scans.shape)[:2]
    )


def measure(scans: Scans, pasted: Reconstruction, filled: Reconstruction) -> Metrics:
    """Figures of a volume, before its holes are filled and after, each named with its unit."""
    volume = filled.volume
    nz, ny, nx = volume.voxels.shape
    return {
        "frames": len(scans.world_from_pixel),
        "frames_placed": scans.placed,
        "poses_left_out": scans.left_out,
        "speed_m_per_s": scans.speed_m_s,
        **dict(zip(("voxels_x", "voxels_y", "voxels_z"), (nx, ny, nz), strict=True)),
        **{f"spacing_{axis}_mm": float(step) for axis, step in zip("xyz", volume.spacing, strict=True)},
        "pasted_fraction": float(pasted.filled.mean()),
        "filled_fraction": float(filled.filled.mean()),
        "mean_level": float(volume.voxels[filled.filled].mean()) if filled.filled.any() else np.nan,
    }


def measure_sigma(sigma: Volume | None) -> Metrics:
    """Figures of the places' standard deviations, as of `sigma_volume`."""
    if sigma is None or not sigma.voxels.any():
        return {}
    seen = sigma.voxels[sigma.voxels > 0]
    return {"place_sigma_median_mm": float(np.median(seen)), "place_sigma_most_mm": float(seen.max())}


def write_sequence(path: Path, sweep: SweepCapture, probe: ProbeCalibration, lag_s: float) -> None:
    """Write the B-scans with their poses as a PLUS sequence, by way of a file, so that they are never all in memory."""
    store = path.with_name("images.raw")
    with store.open("wb") as file:  # a full disk ends this in an error, but a write to a mapped file in a signal
        for image in sweep.images():
            file.write(image.tobytes())
    images = np.memmap(store, np.uint8, "r", shape=(len(sweep.paths), *sweep.size[::-1]))
    try:
        times_s = sweep.times * 1e-9 - lag_s
        sequences.write_sequence(path, sequences.sequence_of(images, sweep.poses(lag_s), probe, times_s))
    finally:
        del images
        store.unlink()
