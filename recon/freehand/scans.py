"""B-scans in space, of a capture or of a PLUS sequence, and the volume that they are compounded into."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from recon.capture import probe_files
from recon.capture.sweep_part import SweepCapture
from recon.errors import InputError
from recon.files.metrics import Metrics
from recon.files.volumes import Volume
from recon.freehand import hole_filling, place_uncertainty, plus_config, sequences, volume_compounding
from recon.freehand.place_uncertainty import PlaceErrors
from recon.freehand.volume_compounding import Clip, Grid, Reconstruction, grid_of
from recon.model import tracks
from recon.model.probe import SCANNER_SPEED, ProbeCalibration
from recon.probe_calibration import sound_in_water

Array = NDArray[np.float64]
Extent = Literal["aligned", "principal"]

MOST_KEPT = 512 << 20  # bytes of images that are kept in memory
STEP_S = 0.005  # of the poses' rates


class Unsure(NamedTuple):
    """Standard deviations of settings that are told."""

    lag_s: float = 0.0
    tissue_m_s: float = 0.0


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

    @property
    def placed(self) -> int:
        """Number of B-scans with a pose."""
        return int(np.isfinite(self.world_from_pixel).all(axis=(1, 2)).sum())


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
        _rates(sweep, lag_s) @ target_from_pixel,
        unsure.lag_s,
        unsure.tissue_m_s / converted.speed_m_s,
        covariance is not None,
    )
    placed = sweep.poses(lag_s) @ target_from_pixel
    return Scans(sweep.size[::-1], placed, sweep.images, converted.speed_m_s, probe.speed_m_s, converted, errors)


def _rates(sweep: SweepCapture, lag_s: float) -> Array:
    """Change of the poses : (n, 4, 4) per s, zero where there is none."""
    before, at, after = (tracks.poses_at(sweep.track, sweep.times, lag_s + step) for step in (STEP_S, 0.0, -STEP_S))
    rates = np.where(np.isfinite(before), at - before, after - at) / STEP_S
    both = np.isfinite(before) & np.isfinite(after)
    return np.nan_to_num(np.where(both, (after - before) / (2 * STEP_S), rates))


def of_sequence(path: Path, probe: Path | None, config: Path | None, tissue_m_s: float | None) -> Scans:
    """Place the B-scans of a PLUS sequence in its reference frame; its own calibration counts as one for 1540 m/s."""
    frames, shape = sequences.read_tracking(path), sequences.image_shape(path)
    fixed, to, of = {}, "Reference", "Image"
    given = None if probe is None else probe_files.read(probe)
    if given is not None:
        fixed = {"ImageToProbe": sequences.target_from_pixel(given)}
    elif config is not None:
        wanted = plus_config.read_config(config)
        fixed, to, of = wanted.transforms, wanted.reference, wanted.image
    try:
        world_from_pixel = sequences.poses(frames, to, of, fixed)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    valid = frames.valid["Image"][:, None, None]
    calibrated = SCANNER_SPEED if given is None else given.speed_m_s
    speed = tissue_m_s or calibrated
    matrices = sound_in_water.in_tissue(np.where(valid, world_from_pixel, np.nan), calibrated, speed)
    converted = None if given is None else sound_in_water.for_tissue(given, tissue_m_s)
    return Scans(shape, matrices, lambda: sequences.stream_images(path), speed, calibrated, converted)


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
    return f"right where sound makes {speed:.0f} m/s, {how}"


def grid_around(scans: Scans, extent: Extent, spacing_mm: float, clip: Clip | None = None) -> Grid:
    """The grid of a volume that takes in all B-scans, along the world's axes or along the principal axes of the sweep."""
    grid_along = volume_compounding.aligned_grid if extent == "aligned" else volume_compounding.principal_grid
    return grid_along(volume_compounding.corners(scans.world_from_pixel, scans.shape, clip), spacing_mm)


def sigma_volume(scans: Scans, volume: Volume, clip: Clip | None = None) -> Volume | None:
    """Standard deviations, mm over all directions, of the place of what each voxel shows; None where they aren't known."""
    if scans.probe is None or scans.probe.uncertainty is None or scans.errors is None or not scans.errors.known:
        return None
    forms = place_uncertainty.forms(scans.world_from_pixel, scans.probe, scans.errors)
    return place_uncertainty.sigma_volume(forms, scans.world_from_pixel, scans.shape, grid_of(volume), clip)


def filled(pasted: Reconstruction, most_voxels: int, sticks: int) -> Reconstruction:
    """A volume with its holes filled, or as it is where `most_voxels` is 0; see `recon.freehand.hole_filling`."""
    return hole_filling.fill_holes(pasted, most_voxels, sticks) if most_voxels else pasted


def measure(scans: Scans, pasted: Reconstruction, filled: Reconstruction) -> Metrics:
    """Figures of a volume, before its holes are filled and after, each named with its unit."""
    volume = filled.volume
    nz, ny, nx = volume.voxels.shape
    return {
        "frames": len(scans.world_from_pixel),
        "frames_placed": scans.placed,
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
    store = path.with_name("images.npy")
    images = np.lib.format.open_memmap(store, "w+", np.uint8, (len(sweep.paths), *sweep.size[::-1]))
    try:
        for stored, image in zip(images, sweep.images(), strict=True):
            stored[:] = image
        times_s = sweep.times * 1e-9 - lag_s
        sequences.write_sequence(path, sequences.sequence_of(images, sweep.poses(lag_s), probe, times_s))
    finally:
        del images
        store.unlink()
