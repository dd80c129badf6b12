"""Errors of a tracker's poses against those that a film was rendered from."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from recon.capture import sweep_tables
from recon.capture.manifest import sweep_part
from recon.errors import InputError
from recon.files.metrics import Metrics
from recon.files.npz import Form
from recon.geometry import rigid
from recon.model.rig import PATIENT, PROBE
from recon.model.tracks import Track
from twin.session import TruthFolder
from twin.tracking.film_session import truth_name

Array = NDArray[np.float64]

LEVEL = 0.95  # of the bounds that errors are held against
FALSE_MM, FALSE_DEG = 2.0, 2.0  # beyond which what was found is something else


@dataclass(frozen=True)
class FilmTruth:
    """Ground truth of n frames."""

    times: NDArray[np.int64]  # (n,) ns
    poses: Array  # (n, 4, 4) world_from_target, mm, in the middle of the exposure
    blur_px: Array  # (n, 2, 3) of each view's circles
    visible: Array  # (n, 2, 3) part of each disc, 0 to 1, where it lies in the image
    inside: NDArray[np.bool_]  # (n, 2, 3) whether the whole disc lies in the image


@dataclass(frozen=True)
class Errors:
    """Of n frames, NaN where the target was not found: of the target's origin, mm, and of its turn, deg."""

    shift_mm: Array  # (n,)
    turn_deg: Array  # (n,)
    shift_bound_mm: Array  # (n,) which LEVEL of the errors should keep to, by the predicted covariance
    turn_bound_deg: Array  # (n,)
    shift_expected_mm: Array  # (n,) median of such errors, by the predicted covariance

    @property
    def found(self) -> NDArray[np.bool_]:
        """Where there is a pose : (n,)."""
        return np.isfinite(self.shift_mm)


def read_truth(folder: Path, name: str = "", body: str = PROBE) -> FilmTruth:
    """Read a film's truth folder.

    Parameters
    ----------
    name : of one of several sweeps.
    body : whose truth is read, one of the rig's.

    Raises
    ------
    InputError
        If it is missing or damaged.
    """
    forms = {
        "times_ns": Form("fiu", (None,)),
        "world_from_target": Form("f", (None, 4, 4)),
        "blur_px": Form("f", (None, 2, 3)),
        "visible": Form("f", (None, 2, 3)),
        "inside": Form("b", (None, 2, 3)),
    }
    part = sweep_part(name)
    content = TruthFolder(folder, part).arrays(f"{part}/{truth_name(body)}", forms)
    return FilmTruth(*(content[name] for name in forms))


def beside_patient(expected: FilmTruth, folder: Path, name: str = "") -> FilmTruth:
    """The truth of a sweep told as `sonotwin track` tells poses: as if the patient stood where it stood under the fringes.

    Without the patient's truth the same; without fringes the patient stood as in the first frame.

    Raises
    ------
    InputError
        If a file is damaged.
    """
    forms = {"world_from_target": Form("f", (None, 4, 4))}
    part, surface = sweep_part(name), f"surface/{truth_name(PATIENT)}"
    own = f"{part}/{truth_name(PATIENT)}"
    if not (folder / own).is_file():
        return expected
    seen = TruthFolder(folder, part).arrays(own, forms)["world_from_target"]
    reference = seen[0]
    if (folder / surface).is_file():
        reference = TruthFolder(folder, "surface").arrays(surface, {"world_from_target": Form("f", (4, 4))})["world_from_target"]
    return replace(expected, poses=reference @ np.linalg.inv(seen) @ expected.poses)


def read_track(poses: Path, expected: FilmTruth) -> Track:
    """Read the poses of all frames of a film.

    Raises
    ------
    InputError
        If the table is missing, damaged, or of other frames.
    """
    track = sweep_tables.read_track(poses)
    if not np.array_equal(track.times, expected.times):
        raise InputError(f"{poses}: expected the {len(expected.times)} frames of the film, found {len(track.times)} others")
    return track


def compare(track: Track, expected: FilmTruth) -> Errors:
    """Errors of a track, frame by frame, with those that its covariance predicts."""
    count = len(expected.times)
    shift, turn = np.full((2, count), np.nan)
    bounds, expected_mm = np.full((2, count), np.nan), np.full(count, np.nan)
    for k in np.flatnonzero(track.found):
        error = rigid.difference(expected.poses[k], track.poses[k])
        turn[k], shift[k] = np.linalg.norm(error[:3]), np.linalg.norm(error[3:])
        if track.covariance is not None:
            total = track.covariance[k] if track.shared is None else track.covariance[k] + track.shared[k]
            bounds[:, k] = length_bound(total[3:, 3:]), length_bound(total[:3, :3])
            expected_mm[k] = length_bound(total[3:, 3:], 0.5)
    return Errors(shift, np.rad2deg(turn), bounds[0], np.rad2deg(bounds[1]), expected_mm)


def length_bound(covariance: Array, level: float = LEVEL) -> float:
    """Length that a normal vector of mean zero and a covariance : (3, 3) keeps to, with a probability.

    Its square is a sum of weighted chi-squares, taken for one with the same mean and variance [Satterthwaite 1946].
    """
    mean, variance = np.trace(covariance), 2 * np.trace(covariance @ covariance)
    freedom = 2 * mean**2 / variance
    return float(np.sqrt(mean / freedom * chi2.ppf(level, freedom)))


def visible_whole(expected: FilmTruth) -> NDArray[np.bool_]:
    """Frames : (n,) in which all circles lie in both images, nearly uncovered."""
    return (expected.inside & (expected.visible > 0.9)).all(axis=(1, 2))


def measure(errors: Errors, expected: FilmTruth) -> Metrics:
    """Figures of a tracked film, each named with its unit."""
    found, whole = errors.found, visible_whole(expected)
    wrong = found & ~((errors.shift_mm < FALSE_MM) & (errors.turn_deg < FALSE_DEG))
    within = [bound[found] >= error[found] for error, bound in _pairs(errors)]
    figures: Metrics = {
        "track_frames": len(found),
        "track_found": int(found.sum()),
        "track_visible": int(whole.sum()),
        "track_visible_found": int((whole & found).sum()),
        "track_false": int(wrong.sum()),
        "track_blur_most_px": float(expected.blur_px.max()),
        "track_within_bound": float(np.mean(within)) if found.any() else np.nan,
    }
    for name, values in (("shift_mm", errors.shift_mm), ("turn_deg", errors.turn_deg)):
        kind, unit = name.split("_")
        known = values[found]
        figures[f"track_{kind}_median_{unit}"] = float(np.median(known)) if known.size else np.nan
        figures[f"track_{kind}_p95_{unit}"] = float(np.quantile(known, 0.95)) if known.size else np.nan
    predicted = errors.shift_expected_mm[np.isfinite(errors.shift_expected_mm)]
    figures["track_shift_expected_mm"] = float(np.median(predicted)) if predicted.size else np.nan
    return figures


def _pairs(errors: Errors) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    return (errors.shift_mm, errors.shift_bound_mm), (errors.turn_deg, errors.turn_bound_deg)
