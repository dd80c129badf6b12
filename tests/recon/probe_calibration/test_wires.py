"""Which line is of which wire, where lines of wires one above the other meet, and what calibration makes of it."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from recon.geometry import rigid
from recon.probe_calibration import repeatability, wires
from recon.probe_calibration.point_calibration import Noise, calibrate
from tests.recon import bscans
from tests.recon.probe_motions import ANGLE_DEG, PIXEL_PX, POSITION_MM, SLICE_MM, motion, observe, true_probe

NOISE = Noise(ANGLE_DEG, POSITION_MM, PIXEL_PX, SLICE_MM)
SCALE = np.array([0.12, 0.11])
CROSSED = np.array([[1.0, 0.2, 0.1], [-0.3, 1.0, 0.0]]) / np.sqrt([[1.05], [1.09]])


def turned(count, rng):
    """Rotations (count, 3, 3) of a probe that looks along the world's z, tilted to all sides."""
    looking = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    return looking @ Rotation.from_euler("YXZ", rng.uniform([-90, -35, -20], [90, 35, 20], (count, 3)), degrees=True).as_matrix()


def lines(turns, along, rng, noise_deg=0.0):
    """Directions (n, 2, 2) px of wires in images, in any order and sense."""
    seen = (along @ turns)[..., :2] / SCALE
    angles = np.arctan2(seen[..., 1], seen[..., 0]) + np.radians(noise_deg) * rng.standard_normal(seen.shape[:2])
    seen = np.stack([np.cos(angles), np.sin(angles)], axis=-1) * rng.choice([-1, 1], (len(seen), 2, 1))
    swapped = rng.random(len(seen)) < 0.5
    return np.where(swapped[:, None, None], seen[:, ::-1], seen)


def same(found, true):
    """Whether directions are those of the wires, in any order and sense, to 3 degrees."""
    return np.sort(np.abs(found @ true.T).max(axis=1))[0] > np.cos(np.radians(3))


def test_wires_are_told_from_lines_in_any_order(rng):
    """A fifth of the frames have a wrong line, and all are off by 3 degrees."""
    turns = turned(30, rng)
    seen = lines(turns, CROSSED, rng, noise_deg=3)
    seen[::5, 0] = [0.6, 0.8]
    found = wires.directions_of(wires.planes(turns, SCALE, seen))
    assert found is not None and same(found, CROSSED) and abs(found[0] @ found[1]) < 0.2


@pytest.mark.parametrize("count", [0, 1, 5])
def test_too_few_frames_tell_no_wires(rng, count):
    turns = turned(count, rng) if count else np.zeros((0, 3, 3))
    assert wires.directions_of(wires.planes(turns, SCALE, np.ones((count, 2, 2)))) is None


def test_lines_meet_beside_the_middle_as_geometry_says(rng):
    """Against the lines themselves: two points of each wire, projected into the image."""
    turns = turned(20, rng)
    across = np.cross(*CROSSED) / np.linalg.norm(np.cross(*CROSSED))
    expected = []
    for turn in turns:
        ends = [(side * across / 2 + np.outer([-1, 1], along)) @ turn for side, along in zip((-1, 1), CROSSED, strict=True)]
        (a, b), (c, d) = (end[:, :2] / SCALE for end in ends)
        share = np.linalg.solve(np.column_stack([b - a, c - d]), c - a)
        expected.append(a + share[0] * (b - a))
    assert wires.beside(turns, SCALE, CROSSED) == pytest.approx(np.array(expected), rel=1e-6)


def test_lines_that_fall_together_meet_nowhere():
    """Seen from within the plane of the wires both are one line: nothing is said, rather than something infinite."""
    assert wires.beside(np.eye(3)[None], SCALE, np.array([[1.0, 0, 0], [0.6, 0, 0.8]])) == pytest.approx(0)


def test_the_distance_of_wires_is_found_and_taken_out(rig, rng):
    """Wires of 0.4 mm, one above the other: as single points the pixels contradict each other, as two wires they don't."""
    probe, apart = true_probe(rig), 0.4
    turns, pixels = motion(rig)
    sightings = observe(probe, turns, pixels, rng)
    world_from_image = sightings.poses[:, :3, :3] @ probe.target_from_image[:3, :3]
    flat = np.array([[1.0, 1, 0], [-1, 1, 0]]) / np.sqrt(2)
    seen = lines(world_from_image, flat, rng, noise_deg=2) * SCALE / probe.scale
    beside = wires.beside(world_from_image, probe.scale, flat)
    sightings = replace(sightings, pixels=np.clip(sightings.pixels + apart * beside, 0, np.array(bscans.SIZE) - 1))
    as_point = calibrate(sightings, bscans.SIZE, NOISE)
    found = calibrate(replace(sightings, directions=seen), bscans.SIZE, NOISE)
    assert found.apart_mm == pytest.approx(apart, abs=0.15)  # 3 sigma
    assert as_point.apart_mm == 0
    assert found.rms_mm < 0.8 * as_point.rms_mm
    points = repeatability.five_points(bscans.SIZE)
    assert np.linalg.norm(found.calibration.to_target(points) - probe.to_target(points), axis=1).max() < 0.3


def test_an_echo_ahead_of_the_axis_moves_the_image(rig, rng):
    """What is shown lies where the echo came from, above the axes: the image moves up by as much."""
    probe = true_probe(rig)
    sightings = observe(probe, *motion(rig), rng)
    plain, ahead = (calibrate(sightings, bscans.SIZE, NOISE, ahead_mm=each).calibration for each in (0.0, 0.1))
    moved = rigid.invert(plain.target_from_image) @ ahead.target_from_image
    assert moved == pytest.approx(rigid.transform(np.eye(3), [0, -0.1, 0]), abs=1e-9)


def test_the_echo_of_nylon_lies_between_front_and_axis():
    assert wires.echo_ahead(0.1, 2600, 1488) == pytest.approx(0.043, abs=0.001)
    assert wires.echo_ahead(0.1, 1e9, 1488) == pytest.approx(0.1, abs=1e-3)  # no echo from within: the front
