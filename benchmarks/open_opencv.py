"""Plain OpenCV on the open benchmark, an example to begin from: optics by its calibration, tracking by contours and ellipses.

python benchmarks/open_opencv.py SESSIONS RESULTS
"""

import csv
import json
import sys
from itertools import permutations
from pathlib import Path

import cv2
import numpy as np

COLUMNS, ROWS, SPACING_MM = 4, 11, 15.0  # of the board of all sessions: asymmetric circles, OpenCV's layout


def grey(path: Path) -> np.ndarray:
    """An image : (h, w)."""
    return np.array(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE))


def optics(session: Path, out: Path) -> None:
    """Calibrate both cameras from the board's lit images."""
    board = np.float32([[(2 * i + j % 2) * SPACING_MM, j * SPACING_MM, 0] for j in range(ROWS) for i in range(COLUMNS)])
    seen, size = [], (0, 0)
    for pose in sorted((session / "board").iterdir()):
        images = [grey(pose / camera / "lit.png") for camera in ("cam1", "cam2")]
        grids = [cv2.findCirclesGrid(image, (COLUMNS, ROWS), flags=cv2.CALIB_CB_ASYMMETRIC_GRID) for image in images]
        size = images[0].shape[::-1]
        if all(found for found, _ in grids):
            seen.append([grid for _, grid in grids])
    if len(seen) < 3:
        return
    boards, first, second = [board] * len(seen), [one[0] for one in seen], [one[1] for one in seen]
    _, m1, d1, *_ = cv2.calibrateCamera(boards, first, size, None, None)
    _, m2, d2, *_ = cv2.calibrateCamera(boards, second, size, None, None)
    _, m1, d1, m2, d2, turn, shift, *_ = cv2.stereoCalibrate(
        boards, first, second, m1, d1, m2, d2, size, flags=cv2.CALIB_USE_INTRINSIC_GUESS
    )
    out.mkdir(parents=True, exist_ok=True)
    file = cv2.FileStorage(str(out / "calibration.yml"), cv2.FILE_STORAGE_WRITE)
    for name, value in {"M1": m1, "D1": d1, "M2": m2, "D2": d2, "R": turn, "T": shift}.items():
        file.write(name, value)
    file.release()


def rings(image: np.ndarray) -> list[np.ndarray]:
    """Centres of dark rings with a bright hole: contours in contours, both ellipses about one centre."""
    dark = cv2.adaptiveThreshold(cv2.equalizeHist(image), 255, cv2.ADAPTIVE_THRESH_MEAN_C, cv2.THRESH_BINARY_INV, 101, 5)
    contours, tree = cv2.findContours(dark, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    found = []
    for k, contour in enumerate(contours):
        parent = tree[0][k][3] if tree is not None else -1
        if parent < 0 or len(contour) < 20 or len(contours[parent]) < 40:
            continue
        outer, inner = cv2.fitEllipse(contours[parent]), cv2.fitEllipse(contour)
        filled = cv2.contourArea(contours[parent]) / (np.pi / 4 * outer[1][0] * outer[1][1] + 1e-9)
        ratio = np.sqrt(np.prod(inner[1]) / (np.prod(outer[1]) + 1e-9))
        if np.hypot(*np.subtract(outer[0], inner[0])) < 0.1 * outer[1][0] and 0.95 < filled < 1.05 and 0.2 < ratio < 0.8:
            found.append(np.array(outer[0]))
    return found


def tracking(session: Path, out: Path) -> None:
    """Triangulate the rings' centres in all orders, and take the three whose distances fit the target."""
    about = json.loads((session / "session.json").read_text(encoding="utf-8"))
    design, devices = np.array(about["circles_mm"]), about["devices"]
    cameras = [{key: np.array(value) for key, value in devices[name].items()} for name in ("cam1", "cam2")]
    lines = [camera["matrix_px"] @ camera["device_from_world"][:3] for camera in cameras]
    with (session / "sweep/cam1/timestamps.csv").open(encoding="utf-8") as file:
        times = [row["time_ns"] for row in csv.DictReader(file)]
    rows = []
    for k, time in enumerate(times):
        sets = []
        for name, camera in zip(("cam1", "cam2"), cameras, strict=True):
            image = grey(session / "sweep" / name / f"{k:04d}.png")
            seen = np.array(rings(image)[:8]).reshape(-1, 1, 2)
            straight = (
                cv2.undistortPoints(seen, camera["matrix_px"], camera["distortion"], P=camera["matrix_px"]) if len(seen) else seen
            )
            sets.append(straight.reshape(-1, 2))
        best, pose = 1.0, None  # mm
        for first in permutations(range(len(sets[0])), 3):
            for second in permutations(range(len(sets[1])), 3):
                met = cv2.triangulatePoints(lines[0], lines[1], sets[0][list(first)].T, sets[1][list(second)].T)
                points = (met[:3] / met[3]).T
                misfit = np.abs(
                    np.linalg.norm(points - np.roll(points, 1, 0), axis=1)
                    - np.linalg.norm(design - np.roll(design, 1, 0), axis=1)
                )
                if misfit.max() < best:
                    best, pose = misfit.max(), kabsch(design, points)
        rows.append([time, int(pose is not None), *([""] * 12 if pose is None else pose.ravel())])
    out.mkdir(parents=True, exist_ok=True)
    with (out / "poses.csv").open("w", encoding="utf-8", newline="") as file:
        names = [f"m{row}{column}" for row in range(3) for column in range(4)]
        csv.writer(file).writerows([["time_ns", "found", *names], *rows])


def sides(points: np.ndarray) -> np.ndarray:
    """Lengths : (3,) of a triangle's sides."""
    return np.linalg.norm(points - np.roll(points, 1, 0), axis=1)


def kabsch(design: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Pose : (3, 4) that takes the design : (n, 3) to points : (n, 3) best."""
    u, _, vt = np.linalg.svd((points - points.mean(0)).T @ (design - design.mean(0)))
    turn = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
    return np.column_stack([turn, points.mean(0) - turn @ design.mean(0)])


if __name__ == "__main__":
    given, results = map(Path, sys.argv[1:3])
    for one in sorted(given.iterdir()):
        if one.name.endswith("optics"):
            optics(one, results / one.name)
        elif one.name.endswith("tracking"):
            tracking(one, results / one.name)
