"""Optics calibration: from the images of 34 poses to the parameters of three devices, against OpenCV with its own detection."""

from collections.abc import Callable, Mapping
from time import perf_counter

import cv2
import numpy as np

from recon.optical_calibration.joint_calibration import calibrate
from recon.threads import mapped
from twin.experiments import calibration_accuracy
from twin.experiments.board_sets import BoardSet, rendered
from twin.experiments.experiment_setup import Figures, Setup
from twin.sensor import Numbers


def whole_calibration(setup: Setup) -> Figures:
    """Images in memory to calibration. The peer calibrates the two cameras only; the projector it leaves to others."""
    seen = rendered(calibration_accuracy.session(setup))
    adjusting = seconds(lambda: calibrate(seen.sightings, seen.board, seen.sizes))
    finding, pair = opencv_pair(seen)
    ours = {"together_s": seen.seconds + adjusting, "finding_s": seen.seconds, "adjusting_s": adjusting}
    return ours | {"poses": len(seen.sightings), "peer_s": finding + pair, "peer_finding_s": finding, "peer_adjusting_s": pair}


def opencv_pair(seen: BoardSet) -> tuple[float, float]:
    """Seconds that OpenCV takes to find the circles in both cameras' lit images, and to calibrate the pair."""
    start = perf_counter()
    design = seen.board
    form, layout = (design.columns, design.rows), cv2.CALIB_CB_ASYMMETRIC_GRID

    def look(lit: Mapping[str, Numbers]) -> list[tuple[bool, np.ndarray]]:
        return [cv2.findCirclesGrid(lit[camera], form, flags=layout, blobDetector=blobs()) for camera in ("cam1", "cam2")]

    found = list(mapped(look, seen.lit))
    finding = perf_counter() - start
    both = [views for views in found if all(ok for ok, _ in views)]
    if len(both) < 3:
        raise RuntimeError(f"findCirclesGrid: expected the board in most of {len(found)} poses, found it in {len(both)}")
    objects = [np.float32(design.points())] * len(both)
    first, second = ([np.float32(views[k][1]) for views in both] for k in (0, 1))
    size, criteria = seen.sizes["cam1"], (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 100, 1e-9)

    def pair() -> None:
        _, matrix, lens, *_ = cv2.calibrateCamera(objects, first, size, np.eye(3), np.zeros(5))
        _, matrix2, lens2, *_ = cv2.calibrateCamera(objects, second, size, np.eye(3), np.zeros(5))
        flags = cv2.CALIB_USE_INTRINSIC_GUESS
        cv2.stereoCalibrate(objects, first, second, matrix, lens, matrix2, lens2, size, flags=flags, criteria=criteria)

    return finding, seconds(pair)


def blobs() -> cv2.SimpleBlobDetector:
    """OpenCV's detector of blobs, for discs of some 1500 px; by default it stops at 5000, in case of larger views."""
    parameters = cv2.SimpleBlobDetector.Params()
    parameters.maxArea = 20000
    return cv2.SimpleBlobDetector.create(parameters)


def seconds(work: Callable[[], object]) -> float:
    """Seconds that some work takes."""
    start = perf_counter()
    work()
    return perf_counter() - start
