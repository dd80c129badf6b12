"""Optics calibration: from the images of 34 poses to the parameters of three devices, against OpenCV with its own detection."""

from collections.abc import Callable, Mapping
from time import perf_counter

import cv2
import numpy as np

from recon.capture.surface_part import read_patterns
from recon.model.rig import Rig
from recon.optical_calibration.joint_calibration import calibrate
from recon.threads import mapped
from sonotwin.config import compose, folder
from twin.experiments import calibration_accuracy
from twin.experiments.board_sets import BoardSet, rendered
from twin.experiments.table_rows import Measurement, Row, Setup
from twin.sensor import Numbers


def measurements() -> list[Measurement]:
    """The rows of the group."""
    return [whole_calibration]


def whole_calibration() -> list[Row]:
    """Row h: images in memory to calibration. The peer calibrates the two cameras only; the projector it leaves to others."""
    rig = Rig.model_validate(compose("render", ["out=unused"])["rig"])
    setup = Setup(rig, {"paper_calibration": read_patterns(folder() / "patterns" / "paper_calibration.yaml")})
    seen = rendered(calibration_accuracy.session(setup))
    adjusting = seconds(lambda: calibrate(seen.sightings, seen.board, seen.sizes))
    finding, pair = opencv_pair(seen)
    what = f"{len(seen.sightings)} poses, 52 images 1280x1024 each"
    together = seen.seconds + adjusting
    return [
        Row("h", f"{what}: three devices, all together (peer: two cameras, OpenCV)", together, 20, finding + pair, "s"),
        Row("h", f"{what}: of that, find the board and decode the fringes", seen.seconds, 16, finding, "s"),
        Row("h", f"{what}: of that, choose the lens models and adjust", adjusting, 4, pair, "s"),
    ]


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
