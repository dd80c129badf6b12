"""Figures of results with their predicted standard deviations, to be compared with those of others."""

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from recon.capture import calibration_files, lag_files, probe_files, sweep_tables
from recon.files import opencv_storage
from recon.freehand import scans, sequences
from recon.geometry import rigid

Array = NDArray[np.float64]
Figures = Mapping[str, tuple[Array, Array]]  # name -> values, and their standard deviations; NaN where there is none

UNKNOWN_MM, UNKNOWN_SHARE = 0.3, 0.03  # standard deviations of places and volumes for which a result has none
COMMON = 98  # %, of the values of a name: a few more wrong ones count
NEAREST = 1e-4  # relative: figures aren't told apart below it, whatever is claimed


def distance(made: Figures, right: Figures) -> float:
    """Distance of figures from the right ones in their own standard deviations: of the worst name, RMS or all but 2 % at most.

    Infinite where a name is claimed that the right ones don't have, or nothing that could be compared.
    """
    worst, compared = 0.0, 0
    for name, (values, sigma) in made.items():
        if name not in right or right[name][0].shape != values.shape:
            return np.inf
        off = np.abs(values - right[name][0])
        off[off < NEAREST * np.abs(right[name][0])] = 0
        with np.errstate(divide="ignore", invalid="ignore"):
            z = np.ravel(np.where(off == 0, off, off / np.broadcast_to(sigma, off.shape)))
        z = z[~np.isnan(z)]
        if z.size:
            worst = max(worst, float(np.sqrt((z**2).mean())), float(np.percentile(z, COMMON)))
        compared += z.size
    return worst if compared else np.inf


def surface(folder: Path) -> Figures:
    """Points of a surface, by pixel."""
    with np.load(folder / "points.npz") as stored:
        return {"points": (stored["points"].astype(float), stored["sigma"][..., None].astype(float))}


def optics(folder: Path) -> Figures:
    """Focal lengths and places of the devices."""
    found = calibration_files.read(folder / "optics.yaml")
    figures = {}
    for device, camera in found.cameras.items():
        known = {"fx": camera.matrix[0, 0], "fy": camera.matrix[1, 1]}
        known |= dict(zip(("tx", "ty", "tz"), camera.camera_from_world[:3, 3], strict=True)) if device != "cam1" else {}
        for name, value in known.items():
            sigma = np.nan if found.uncertainty is None else found.uncertainty.sigma(f"{device}.{name}")
            figures[f"{device}.{name}"] = np.array([value]), np.array([sigma])
    return figures


def probe(folder: Path) -> Figures:
    """Places of three pixels in the target's frame."""
    found = probe_files.read(folder / "probe.yaml")
    pixels = np.array([[0.0, 0], [300, 50], [150, 400]])
    if found.uncertainty is None:
        return {}
    right = found.to_target(pixels)
    slopes = []
    for name in found.uncertainty.names:
        k, step = ("sx", "sy", "rx", "ry", "rz", "tx", "ty", "tz").index(name), 1e-6
        scale, place = found.scale.copy(), found.target_from_image
        if k < 2:
            scale[k] += step
        else:
            place = rigid.moved(place, step * np.eye(6)[k - 2])
        slopes.append((type(found)(place, scale).to_target(pixels) - right) / step)
    slope = np.array(slopes)
    variance = np.einsum("gnk,gh,hnk->nk", slope, found.uncertainty.covariance, slope)
    return {"pixels": (right, np.sqrt(variance))}


def lag(folder: Path) -> Figures:
    """The lag."""
    found = lag_files.read(folder / "lag.json")
    return {"lag": (np.array([found.lag_s]), np.array([found.sigma_s]))}


def poses(folder: Path) -> Figures:
    """Places of the target, by moment."""
    found = sweep_tables.read_track(folder / "poses.csv")
    sigma = np.full((len(found.times), 3), np.nan)
    if found.covariance is not None:
        both = found.covariance if found.shared is None else found.covariance + found.shared
        sigma = np.sqrt(both[:, range(3, 6), range(3, 6)])
    return {str(time): (pose[:3, 3], one) for time, pose, one in zip(found.times, found.poses, sigma, strict=True)}


def target(folder: Path) -> Figures:
    """Places of the circles."""
    stored = opencv_storage.read(folder / "target.yaml", "a measured target") or {}
    names = opencv_storage.names(stored) or ()
    covariance = opencv_storage.covariance(folder / "target.yaml", stored, len(names))
    sigma = dict(zip(names, np.sqrt(np.diag(covariance)), strict=True))
    known = [name for name in ("c1_mm", "c2_mm", "c2_aside_mm") if name in sigma]
    return {name: (np.array([float(stored[name])]), np.array([sigma[name]])) for name in known}


def volume(folder: Path) -> Figures:
    """Where a volume has each B-scan's brightness: its centre, by the image's grey levels, mirrored or not."""
    path = folder / "sequence.igs.mha"
    placed = scans.of_sequence(path)
    figures = json.loads((folder / "metrics.json").read_text(encoding="utf-8"))
    sigma = np.array([figures.get("place_sigma_median_mm") or UNKNOWN_MM] * 3) / np.sqrt(3)
    result = {}
    for image, matrix in zip(sequences.stream_images(path), placed.world_from_pixel, strict=True):
        weight = image.astype(float) ** 2
        v, u = np.mgrid[: image.shape[0], : image.shape[1]]
        pixel = [(weight * u).sum() / weight.sum(), (weight * v).sum() / weight.sum(), 0, 1]
        levels = np.bincount(image.ravel(), minlength=256).tobytes()
        result[hashlib.sha256(levels).hexdigest()] = (matrix @ pixel)[:3], sigma
    return result


def masses(folder: Path) -> Figures:
    """Volumes and centres of masses, and their number, which is known for sure."""
    figures = json.loads((folder / "metrics.json").read_text(encoding="utf-8"))
    result = {"masses": (np.array([float(figures["masses"])]), np.array([0.3]))} if "masses" in figures else {}
    number = 0
    while f"mass{number}_volume_mm3" in figures:
        name = f"mass{number}"
        volume_mm3 = figures[f"{name}_volume_mm3"]
        sigma_mm3 = figures[f"{name}_volume_sigma_mm3"] or UNKNOWN_SHARE * volume_mm3
        sigma_mm = figures[f"{name}_centre_sigma_mm"] or UNKNOWN_MM
        result[name] = np.array([volume_mm3]), np.array([sigma_mm3])
        centre = np.array([figures[f"{name}_centre_{axis}_mm"] for axis in "xyz"])
        result[f"{name} centre"] = centre, np.full(3, sigma_mm / np.sqrt(3))
        number += 1
    return result
