"""The board's scale is the design's, whatever the sightings show of its shape."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from recon.board_detection.kinds.chessboard import Chessboard
from recon.geometry import rigid
from recon.geometry.camera import Camera
from recon.optical_calibration.joint_calibration import Settings, calibrate
from recon.optical_calibration.sightings import Sighting

BOARD = Chessboard(columns=14, rows=10, square_mm=10)
BASELINE_MM, FAR_MM, SIZE = 181.7, 500.0, (1280, 1024)


@pytest.fixture(scope="module")
def pair():
    """Two pinhole cameras whose axes meet at the board."""
    matrix = np.array([[1500.0, 0, SIZE[0] / 2], [0, 1500, SIZE[1] / 2], [0, 0, 1]])
    turn = Rotation.from_rotvec([0, np.arctan(BASELINE_MM / FAR_MM), 0]).as_matrix()
    place = rigid.transform(turn, -turn @ [BASELINE_MM, 0, 0])
    return {"cam1": Camera(SIZE, matrix, np.zeros(0)), "cam2": Camera(SIZE, matrix, np.zeros(0), place)}


def sightings(cameras, points, count, rng, noise, claimed):
    """Views of a board : (n, 3) mm near the middle of both images, with noise in px of which detection claims another size."""
    seen, claim = [], np.broadcast_to(claimed**2 * np.eye(2), (len(points), 2, 2)).copy()
    while len(seen) < count:
        way, tilt = rng.uniform(0, 2 * np.pi), np.deg2rad(rng.uniform(0, 40))
        turn = Rotation.from_rotvec(tilt * np.array([np.cos(way), np.sin(way), 0])) * Rotation.from_rotvec(
            [0, 0, rng.uniform(-0.7, 0.7)]
        )
        place = rng.uniform([-60, -50, 450], [60, 50, 600]) - turn.apply(points.mean(axis=0))
        world = turn.apply(points) + place
        pixels = {name: camera.project(world) for name, camera in cameras.items()}
        if all(((at > 10) & (at < np.array(SIZE) - 10)).all() for at in pixels.values()):
            noisy = {name: at + noise * rng.standard_normal(at.shape) for name, at in pixels.items()}
            nothing = np.zeros((len(points), 2, 2))
            seen.append(Sighting(f"{len(seen):02d}", noisy, dict.fromkeys(cameras, claim), nothing))
    return seen


def test_an_even_shrink_is_no_likelier_than_the_design(pair):
    """Exact views of a board of 130 mm, printed to 5 um: it shrank by 14 % where scale and stretch shared the evidence."""
    rng = np.random.default_rng(3)
    points = BOARD.points() + [0.005, 0.005, 0] * rng.standard_normal((140, 3))
    seen = sightings(pair, points, 6, rng, 0.001, 0.05)
    found = calibrate(seen, BOARD, dict.fromkeys(pair, SIZE), Settings(distortion="radial1"))
    place = found.adjustment.calibration.cameras["cam2"].camera_from_world
    assert np.linalg.norm(place[:3, 3]) == pytest.approx(BASELINE_MM, rel=3e-4)
    assert found.tolerances.stretch_mm < 0.01


def test_half_turns_are_found_pose_by_pose(pair):
    """A board of 9x7 corners, printed to 20 um: both cameras took poses 1 and 4 the other way, camera 2 also pose 2."""
    rng, board = np.random.default_rng(5), Chessboard(columns=9, rows=7, square_mm=15)
    points = board.points() + [0.02, 0.02, 0] * rng.standard_normal((63, 3))
    seen = sightings(pair, points, 8, rng, 0.02, 0.02)
    seen = [with_half_turns(one, (pair if k in (1, 4) else ["cam2"] if k == 2 else [])) for k, one in enumerate(seen)]
    found = calibrate(seen, board, dict.fromkeys(pair, SIZE), Settings(distortion="radial1"))
    assert found.turned == {"cam2": ["02"], "all devices": ["01", "04"]}
    assert not found.dropped and max(found.rms.values()) < 0.03
    assert found.tolerances.print_mm == pytest.approx(0.02, rel=0.2)


def with_half_turns(sighting, devices):
    """The same of which some devices took the last point for the first."""
    return replace(sighting, pixels={name: at[::-1] if name in devices else at for name, at in sighting.pixels.items()})
