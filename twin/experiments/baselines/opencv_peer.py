"""The joint adjustment against OpenCV's calibration of pairs, on the same sightings."""

from collections.abc import Sequence

import cv2
import numpy as np

from recon.geometry import rigid
from recon.geometry.camera import Array, Camera
from recon.model.calibration import Calibration
from recon.optical_calibration import uncertainty
from recon.optical_calibration.joint_calibration import Result
from recon.optical_calibration.observations import Observations
from twin.experiments.board_sets import BoardSet
from twin.experiments.calibration_errors import DEPTHS, focal_error, motion_error, point_errors, rms_length
from twin.experiments.experiment_setup import Figures

FIGURES = ("shift_mm", "turn_deg", "focal_percent", "points_mm")
SECOND = ("cam2", "projector")
BY = ("ours", "corrected", "opencv")  # OpenCV with our corrections of the centres, and without


def in_one_render(seen: BoardSet, result: Result) -> Figures:
    """One rendered set's points. Chance has its part in a single set."""
    volume = uncertainty.working_volume(seen.truth, DEPTHS)
    found: Figures = {"poses": len(seen.sightings)}
    for name in SECOND:
        of = compare(seen.truth, result, name, volume)[:, -1]
        found |= {f"{name}_points_mm_{by}": value for by, value in zip(BY, of, strict=True)}
    return found


def in_many_draws(drawings: Sequence[tuple[BoardSet, Result]]) -> Figures:
    """RMS over calibrations of random poses and noise, also OpenCV's, with our corrections of the centres and without.

    For camera 2, which OpenCV calibrates from the same numbers, a draw as good may come out on either side: with corrections
    its figure has one standard error of the difference on top.
    """
    truth = drawings[0][0].truth
    volume = uncertainty.working_volume(truth, DEPTHS)
    found: Figures = {"draws": len(drawings)}
    for name in SECOND:
        squares = np.square([compare(truth, result, name, volume) for _, result in drawings])  # (draws, 3, figures)
        levels = squares.mean(axis=0)  # (3, figures)
        if name == "cam2":
            levels[1] += (squares[:, 0] - squares[:, 1]).std(axis=0, ddof=1) / np.sqrt(len(drawings))
        for of, values in zip(FIGURES, np.sqrt(levels).T, strict=True):
            found |= {f"{name}_{of}_{by}": value for by, value in zip(BY, values, strict=True)}
    return found


def compare(truth: Calibration, result: Result, name: str, volume: Array) -> Array:
    """FIGURES of ours, of OpenCV on corrected centres, and of OpenCV on the ellipses' : (3, 4)."""
    observations, offsets = result.observations, result.offsets
    peers = [stereo(observations, name, shift) for shift in (offsets, np.zeros_like(offsets))]
    return np.array([figures(found, truth, name, volume) for found in (result.adjustment.calibration, *peers)])


def figures(found: Calibration, truth: Calibration, name: str, volume: Array) -> tuple[float, ...]:
    """FIGURES of a calibration of camera 1 and another device."""
    turn, shift = motion_error(found, truth, name)
    return shift, turn, focal_error(found, truth, name), rms_length(point_errors(found, truth, ("cam1", name), volume))


def stereo(observations: Observations, name: str, offsets: Array) -> Calibration:
    """Camera 1 and another device by OpenCV: each alone, then both together, five coefficients each.

    offsets : (p, n, d, 2) px
        Subtracted from the sightings.
    """
    chosen = [0, observations.devices.index(name)]
    seen = observations.seen[:, :, chosen].all(axis=2)
    poses = np.flatnonzero(seen.sum(axis=1) >= 8)
    objects = [np.float32(observations.points[seen[p]]) for p in poses]
    pixels = [[np.float32((observations.pixels - offsets)[p, seen[p], d]) for p in poses] for d in chosen]
    size, second_size = (observations.sizes[d] for d in chosen)
    _, first, k1, *_ = cv2.calibrateCamera(objects, pixels[0], size, np.eye(3), np.zeros(5))
    _, second, k2, *_ = cv2.calibrateCamera(objects, pixels[1], second_size, np.eye(3), np.zeros(5))
    criteria = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 100, 1e-9)
    _, first, k1, second, k2, turn, shift, *_ = cv2.stereoCalibrate(
        objects, pixels[0], pixels[1], first, k1, second, k2, size, flags=cv2.CALIB_USE_INTRINSIC_GUESS, criteria=criteria
    )
    place = rigid.transform(turn, np.ravel(shift))
    return Calibration(
        {"cam1": Camera(size, first, np.ravel(k1)[:5]), name: Camera(second_size, second, np.ravel(k2)[:5], place)}
    )


def reprojection_rms(observations: Observations, name: str) -> float:
    """RMS reprojection error, px, of a device that OpenCV calibrates alone, from the ellipses' middles."""
    d = observations.devices.index(name)
    seen = observations.seen[:, :, d]
    poses = np.flatnonzero(seen.sum(axis=1) >= 8)
    objects = [np.float32(observations.points[seen[p]]) for p in poses]
    pixels = [np.float32(observations.pixels[p, seen[p], d]) for p in poses]
    return float(cv2.calibrateCamera(objects, pixels, observations.sizes[d], np.eye(3), np.zeros(5))[0])
