"""The published calibration of the probe and the contour of a tube's mask, on made-up frames whose answer is known."""

import numpy as np
import pytest

from recon.geometry import rigid
from recon.probe_calibration.point_calibration import motion
from recon.probe_calibration.repeatability import five_points
from twin.experiments.baselines import published_probe

SIZE, SCALE = (321, 408), np.array([0.1229, 0.1184])
TARGET_FROM_IMAGE = rigid.from_rotation_vector(np.array([0.3, -1.2, 0.4]), np.array([20.0, -15.0, 60.0]))
CROSSING = np.array([4.0, -2.0, 660.0])


def frames(count: int = 40) -> tuple[np.ndarray, np.ndarray]:
    """Poses of the target : (n, 4, 4) that bring pixels : (n, 2) to the crossing."""
    turns, pixels = motion(SIZE, count)
    poses = []
    for turn, pixel in zip(np.deg2rad(turns), pixels, strict=True):
        pose = rigid.from_rotation_vector(turn, np.zeros(3))
        place = rigid.apply(TARGET_FROM_IMAGE, np.append(pixel * SCALE, 0.0))
        pose[:3, 3] = CROSSING - pose[:3, :3] @ place
        poses.append(pose)
    return np.stack(poses), pixels


def test_exact_frames_give_the_exact_calibration():
    poses, pixels = frames()
    found = published_probe.calibrate(poses, pixels)
    assert found.calibration.scale == pytest.approx(SCALE, rel=1e-7) and found.rms_mm < 1e-6
    assert np.allclose(found.calibration.target_from_image, TARGET_FROM_IMAGE, atol=1e-5)


def test_frames_that_contradict_the_others_are_left_out():
    """Three of forty whose pose is off by ten millimetres and more."""
    poses, pixels = frames()
    poses[[3, 17, 30], :3, 3] += [[10.0, 0, 0], [0, 15.0, 0], [0, 0, -12.0]]
    found = published_probe.calibrate(poses, published_probe.clicked(pixels, 0.5, np.random.default_rng(1)))
    off = found.calibration.to_target(five_points(SIZE)) - rigid.apply(
        TARGET_FROM_IMAGE, np.column_stack([five_points(SIZE) * SCALE, np.zeros(5)])
    )
    assert found.rms_mm < 0.15 and np.linalg.norm(off, axis=1).max() < 0.3


def test_scattered_clicks_leave_the_equations_rms():
    """A third of the clicks' variance in each coordinate, less the share that parameters take up.

    Those of the eleven that move points along the image's normal take up none of a scatter within it: eight to eleven are gone.
    """
    poses, pixels = frames(30)
    squares = [
        published_probe.calibrate(poses, published_probe.clicked(pixels, 2.0, np.random.default_rng(seed))).rms_mm ** 2
        for seed in range(60)
    ]
    whole = 4.0 * (SCALE**2).sum() / 3
    assert 60 * (1 - np.mean(squares) / whole) == pytest.approx(9.5, abs=1.5 + 4 * 60 * np.sqrt(2 / (60 * 60)) / 3)


def test_matrices_are_taken_between_their_neighbours_as_they_are():
    """Shear and scale stay; nothing is taken across a gap, or outside."""
    matrices = np.stack([np.eye(4), np.full((4, 4), np.nan), np.eye(4) * 1.02, np.eye(4)])
    matrices[2, 0, 1] = 0.01
    times = np.array([0, 50, 100, 900]) * 10**6
    found = published_probe.matrices_at(times, matrices, np.array([-10, 50, 100, 500, 950]) * 10**6)
    assert np.isfinite(found).all(axis=(1, 2)).tolist() == [False, True, True, False, False]
    assert found[1, 0, 0] == pytest.approx(1.01) and found[1, 0, 1] == pytest.approx(0.005)
    assert found[2] == pytest.approx(matrices[2])
    assert np.isnan(published_probe.matrices_at(times, matrices * np.nan, times)).all()


def test_a_masks_contour_is_the_front_of_the_visible_wall():
    """An arch of some pixels' thickness with a small gap, bright ringing above, and a smaller bar inside."""
    image = np.zeros((408, 321), np.uint8)
    v, u = np.mgrid[:408, :321]
    away = np.hypot(u - 160, v - 220)
    image[(np.abs(away - 60) < 3) & (v < 220) & (np.abs(u - 130) > 1)] = 90
    image[:20] = 255
    image[210:213, 140:180] = 200
    contour = published_probe.mask_contour(image, 20)
    assert set(contour[:, 0]) >= set(range(105, 128)) | set(range(133, 216))
    middle = contour[np.abs(contour[:, 0] - 160) < 40]
    assert np.hypot(middle[:, 0] - 160, middle[:, 1] - 220) == pytest.approx(63, abs=1.5)
    assert len(published_probe.mask_contour(np.zeros_like(image), 20)) == 0
