"""B-scans and frames that belong together by time, with the pose of the frames."""

from pathlib import Path

import numpy as np
import pytest

from recon.capture import paired_scans
from recon.capture.manifest import CAMERAS, SCANNER, Device
from recon.capture.stereo_frames import Film, read_film
from recon.capture.sweep_part import SweepCapture, read_sweep
from recon.capture.writer import new_capture
from recon.errors import InputError
from recon.geometry import rigid
from recon.geometry.camera import Camera
from recon.model.calibration import Calibration
from recon.model.tracks import Track

SIZE, SCAN = (64, 48), (40, 30)
SPEED = 100.0  # mm/s, of the target along x
LAG_S = 0.05


def written(folder: Path, scan_s: np.ndarray, frame_s: np.ndarray, lost: list[int]) -> tuple[SweepCapture, Film]:
    """A sweep along x; image k of a device is of value k. Frames `lost` show no target."""
    matrix = np.array([[200.0, 0, 31.5], [0, 200, 23.5], [0, 0, 1]])
    beside = rigid.from_rotation_vector([0, -0.2, 0], [-150, 0, 0])
    optics = Calibration({"cam1": Camera(SIZE, matrix, np.zeros(5)), "cam2": Camera(SIZE, matrix, np.zeros(5), beside)})
    poses = np.stack([rigid.from_rotation_vector([3, 0, 0], [SPEED * s, 1, 600]) for s in frame_s])
    poses[lost] = np.nan
    times = {name: np.rint(1e9 * s).astype(np.int64) for name, s in ((SCANNER, scan_s + LAG_S), *((c, frame_s) for c in CAMERAS))}
    sizes = {SCANNER: SCAN, **dict.fromkeys(CAMERAS, SIZE)}
    images = [(name, np.full(sizes[name][::-1], k, np.uint8)) for name, each in times.items() for k in range(len(each))]
    with new_capture(folder, "rig") as made:
        made.add_calibration(optics)
        made.add_sweep(times, images, {n: Device(size=s) for n, s in sizes.items()}, Track(times["cam1"], poses), "", "volume")
    return read_sweep(folder, implausible="take"), read_film(folder)


def test_the_pose_is_that_of_the_nearest_frames_that_have_one(tmp_path):
    """By brute force over all pairs; between frame and B-scan the target moves by its speed times their distance."""
    rng = np.random.default_rng(0)
    frame_s = np.cumsum(rng.uniform(0.03, 0.07, 30))
    scan_s = np.sort(rng.uniform(frame_s[0], frame_s[-1], 40))
    lost = [7, 12, 13]
    sweep, film = written(tmp_path / "capture", scan_s, frame_s, lost)
    paired = paired_scans.pair(sweep, film, LAG_S)
    known = [k for k in range(30) if k not in lost]
    assert paired.scans.tolist() == list(range(40))
    assert paired.pairs.tolist() == [min(known, key=lambda k: abs(frame_s[k] - s)) for s in scan_s]
    assert paired.poses[:, 0, 3] == pytest.approx(SPEED * frame_s[paired.pairs], abs=1e-6)
    assert paired.scan_poses[:, 0, 3] == pytest.approx(SPEED * scan_s, abs=1e-6)
    assert paired.moved_mm == pytest.approx(SPEED * np.abs(paired.apart_s), abs=1e-5) and paired.moved_mm.max() > 1
    values = {(device, number): int(image[0, 0]) for device, number, image in paired.images()}
    assert values == {
        key: int(value) for m in range(40) for key, value in (((SCANNER, m), m), *(((c, m), paired.pairs[m]) for c in CAMERAS))
    }


def test_those_too_far_from_frames_are_left_out(tmp_path):
    frame_s, scan_s = 0.1 * np.arange(8), np.array([0.11, 0.24, 0.31, 0.455])
    sweep, film = written(tmp_path / "capture", scan_s, frame_s, [])
    paired = paired_scans.pair(sweep, film, LAG_S, most_apart_s=0.02)
    assert paired.scans.tolist() == [0, 2] and paired.pairs.tolist() == [1, 3]
    with pytest.raises(InputError, match="expected frames within 1 ms of a B-scan, found the nearest 10 ms away"):
        paired_scans.pair(sweep, film, LAG_S, most_apart_s=0.001)
