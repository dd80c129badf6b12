"""Predicted errors of the places of a sweep's pixels: by each pose, and by what all B-scans share.

A pixel (u, v) of B-scan k lies at `world_from_target @ target_from_pixel @ [u, v, 0, 1]`. To first order each of the errors moves
it by `D0 + u D1 + v D2` times the error: the pose by its turn and shift, the probe's calibration by its eight parameters, the
latency by the pixel's speed, the speed of sound by its depth. So the variance of its place, over all directions, is a quadratic
form of [1, u, v] with six numbers a B-scan. The errors count as independent of each other.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from recon.compiled import njit
from recon.estimation.covariance import propagate
from recon.files.volumes import Volume
from recon.freehand import sequences
from recon.freehand.volume_compounding import Clip, Grid, Mask, Sums
from recon.geometry import rigid
from recon.model.calibration import Uncertainty
from recon.model.probe import NAMES, ProbeCalibration, place_slopes

Array = NDArray[np.float64]

COLUMNS = (3, 0, 1)  # of a matrix from pixels: the origin, u, v


@dataclass(frozen=True)
class PlaceErrors:
    """Standard deviations and covariances of what places n B-scans, by m poses of a track."""

    poses: Array  # (m, 6, 6) of each pose, by the noise of its pair, as in recon.model.tracks
    shares: Array  # (n, m) of the poses in those of the B-scans
    shared: Array  # (n, 6, 6) of the B-scans' poses, by what errs alike in all of them
    rates: Array  # (n, 4, 4) mm/s, of world_from_pixel
    lag_s: float = 0.0  # of the latency
    depth: float = 0.0  # of the ratio of all depths, by the speed of sound in the tissue
    known: bool = True  # whether the track had a covariance; without one its poses count as exact

    @property
    def own(self) -> Array:
        """Covariance : (n, 6, 6) of the B-scans' poses by the noise of those that they lie between."""
        return np.einsum("nm,mij->nij", self.shares**2, self.poses)


def forms(world_from_pixel: Array, probe: ProbeCalibration, errors: PlaceErrors) -> Array:
    """Variances of places : (n, 3, 3) mm^2, as forms of [1, u, v]; NaN without a pose.

    Parameters
    ----------
    world_from_pixel : (n, 4, 4)
        As of `probe`, with its depths.
    """
    by_pose = pose_slopes(world_from_pixel, probe)
    total = _form(by_pose, errors.own + errors.shared)
    total += _form(rate_slopes(errors.rates), np.array([[errors.lag_s**2]]))
    total += _form(depth_slopes(world_from_pixel, probe.face_row), np.array([[errors.depth**2]]))
    if probe.uncertainty is not None:
        total += _form(probe_slopes(world_from_pixel, probe), probe.uncertainty.ordered(NAMES))
    return np.where(np.isfinite(world_from_pixel).all(axis=(1, 2))[:, None, None], total, np.nan)


def pose_slopes(world_from_pixel: Array, probe: ProbeCalibration) -> Array:
    """Coefficients : (n, 3, 3, 6) of places by the pose: of 1, u and v; mm; by a turn and a shift."""
    turns = _world_from_target(world_from_pixel, probe)[:, :3, :3]
    arms = turns @ sequences.target_from_pixel(probe)[:3, COLUMNS]
    result = rigid.slopes(arms.transpose(0, 2, 1))
    result[:, 1:, :, 3:] = 0  # the shift moves all pixels alike
    return result


def probe_slopes(world_from_pixel: Array, probe: ProbeCalibration) -> Array:
    """Coefficients : (n, 3, 3, 8) of places by the probe's calibration, in the order of its NAMES."""
    in_target = place_slopes(probe.target_from_image, probe.scale, [(0, 0), (1, 0), (0, 1)])
    in_target[1:] -= in_target[0]
    return _world_from_target(world_from_pixel, probe)[:, None, :3, :3] @ in_target


def from_pixel(probe: ProbeCalibration, pixel: tuple[int, int]) -> ProbeCalibration:
    """The calibration, with its covariance, of images that begin at a pixel (u, v) of those it was made for."""
    placed = sequences.target_from_pixel(probe)
    origin = rigid.apply(placed, [*pixel, 0.0])
    turn = probe.target_from_image[:3, :3]
    moved = replace(probe, target_from_image=rigid.transform(turn, origin), face_row=probe.face_row - pixel[1])
    if probe.uncertainty is None:
        return moved
    jacobian = np.eye(len(NAMES))
    jacobian[5:] = np.tensordot([1, *pixel], probe_slopes(placed[None], probe)[0], axes=1)
    return replace(moved, uncertainty=Uncertainty(NAMES, propagate(jacobian, probe.uncertainty.ordered(NAMES))))


def rate_slopes(rates: Array) -> Array:
    """Coefficients : (n, 3, 3, 1) of places by the latency, from rates : (n, 4, 4) mm/s of their matrices."""
    return rates[:, :3, COLUMNS].transpose(0, 2, 1)[..., None]


def depth_slopes(world_from_pixel: Array, face_row: float = 0.0) -> Array:
    """Coefficients : (n, 3, 3, 1) of places by the ratio of all depths, which count from the face's row."""
    result = np.zeros((len(world_from_pixel), 3, 3, 1))
    result[:, 2, :, 0] = world_from_pixel[:, :3, 1]
    result[:, 0, :, 0] = -face_row * world_from_pixel[:, :3, 1]
    return result


def sigmas(form: Array, pixels: Array) -> Array:
    """Standard deviations : (..., n) mm over all directions, of pixels : (n, 2) u, v, by forms : (..., 3, 3)."""
    terms = np.column_stack([np.ones(len(pixels)), pixels])
    return np.sqrt(np.einsum("ni,...ij,nj->...n", terms, form, terms))


def mean_sigma(
    world_from_pixel: Array,
    probe: ProbeCalibration,
    errors: PlaceErrors | None,
    used: NDArray[np.intp],
    pixels: Array,
    directions: Array,
) -> float:
    """Standard deviation, mm, of the mean displacement of a pixel in each of some B-scans.

    What errs alike in places by light isn't in it: the frame of the optics, and the target's print, which the probe's calibration
    has in it. Nor is what parts light from both cameras.

    Parameters
    ----------
    world_from_pixel, errors : of all n B-scans
    used : (m,) numbers of those that count
    pixels, directions : (m, 2) u, v in each of these, and unit vectors : (m, 3) along which displacements count
    """
    terms = np.column_stack([np.ones(len(pixels)), pixels])

    def along(slopes: Array) -> Array:
        """Derivatives : (m, k) of the displacements, from slopes : (m, 3, 3, k) of places."""
        return np.einsum("nt,ntik,ni->nk", terms, slopes, directions)

    world, variance = world_from_pixel[used], 0.0
    if probe.uncertainty is not None:
        by_probe = along(probe_slopes(world, probe)).mean(axis=0)
        variance += float(propagate(by_probe[None], probe.uncertainty.ordered(NAMES))[0, 0])
    if errors is not None:
        by_lag = along(rate_slopes(errors.rates[used])).mean(axis=0)
        by_depth = along(depth_slopes(world, probe.face_row)).mean(axis=0)
        by_each = errors.shares[used].T @ along(pose_slopes(world, probe)) / len(used)
        variance += float(errors.lag_s**2 * by_lag @ by_lag + errors.depth**2 * by_depth @ by_depth)
        variance += float(np.einsum("mk,mkl,ml->", by_each, errors.poses, by_each))
    return float(np.sqrt(variance))


def sigma_volume(
    form: Array, world_from_pixel: Array, shape: tuple[int, int], grid: Grid, clip: Clip | None = None, mask: Mask | None = None
) -> Volume:
    """Root mean square of the standard deviations of all pixels in a voxel, mm, float32; 0 in voxels that none falls into, filled
    holes among them.

    Parameters
    ----------
    form, world_from_pixel : (n, 3, 3) and (n, 4, 4)
        As of `forms`; B-scans with a NaN are left out.
    shape : (h, w)
        Of the B-scans.
    clip, mask : optional
        Rectangle and pixels : (h, w) that are used.
    """
    sums = Sums(np.zeros(grid.size[::-1], np.float32), np.zeros(grid.size[::-1], np.float32))
    voxel_from_world = np.linalg.inv(Volume(sums.value, grid.origin, grid.spacing, grid.directions).world_from_voxel)
    bounds = (clip or Clip(0, 0, shape[1], shape[0])).bounds(shape)
    used = np.ones(shape, bool) if mask is None else mask
    for one, matrix in zip(form, voxel_from_world @ world_from_pixel, strict=True):
        if np.isfinite(one).all() and np.isfinite(matrix).all():
            _paste_variance(one, used, bounds, matrix, sums)
    np.divide(sums.value, sums.weight, out=sums.value, where=sums.weight > 0)
    return Volume(np.sqrt(sums.value, out=sums.value), grid.origin, grid.spacing, grid.directions)


@njit
def _paste_variance(form, used, bounds, m, sums: Sums):
    left, right, top, bottom = bounds
    nz, ny, nx = sums.value.shape
    for v in range(top, bottom + 1):
        for u in range(left, right + 1):
            if not used[v, u]:
                continue
            i = int(np.floor(m[0, 0] * u + m[0, 1] * v + m[0, 3] + 0.5))
            j = int(np.floor(m[1, 0] * u + m[1, 1] * v + m[1, 3] + 0.5))
            k = int(np.floor(m[2, 0] * u + m[2, 1] * v + m[2, 3] + 0.5))
            if 0 <= i < nx and 0 <= j < ny and 0 <= k < nz:
                by_u = form[0, 0] + 2 * form[0, 1] * u + form[1, 1] * u * u
                sums.value[k, j, i] += by_u + 2 * v * (form[0, 2] + form[1, 2] * u) + form[2, 2] * v * v
                sums.weight[k, j, i] += 1


def _world_from_target(world_from_pixel: Array, probe: ProbeCalibration) -> Array:
    return world_from_pixel @ np.linalg.inv(sequences.target_from_pixel(probe))


def _form(slopes: Array, covariance: Array) -> Array:
    """Traces over space : (n, 3, 3) of slopes : (n, 3, 3, k), of the terms 1, u, v, with covariances : (n or 1, k, k)."""
    spread = np.einsum("nixk,...kl->nixl", slopes, covariance) if covariance.ndim == 2 else slopes @ covariance[:, None]
    return np.einsum("nixk,njxk->nij", spread, slopes)
