"""Probe paths, clocks and the poses of a sweep."""

import numpy as np
import pytest

from recon.errors import InputError
from recon.geometry import rigid
from recon.model import tracks
from recon.probe_calibration import latency
from scenes.catalogue import build_scene
from twin.conditions import Motion, given, trembling
from twin.ultrasound.echo_solids import body
from twin.ultrasound.probe_path import (
    Bob,
    Hand,
    RowPath,
    SurfacePath,
    TiltPath,
    along_surface,
    bobbing,
    over_rows,
    over_surface,
    top,
)
from twin.ultrasound.timed_sweep import Clocks, PoseNoise, moments, plan, sweep

STILL = Hand(shift_mm=0.0, turn_deg=0.0)


@pytest.fixture(scope="module")
def cylinders():
    return body(build_scene({"kind": "cylinders"}))


def outer(made):
    return next(one for one in made.solids if one.name == "outer")


def test_the_probe_touches_the_surface(cylinders, clean):
    """On the crest of the cylinder, z = 640, with the array across its axis: contact in the middle, square to the surface."""
    path = SurfacePath(start_mm=(-20.0, -2.0), end_mm=(20.0, -2.0), speed_mm_s=40.0, turn_deg=90.0, hand=STILL)
    poses = along_surface(path, outer(cylinders), clean, 1).poses
    middle = np.stack([rigid.apply(pose, [clean.width_mm / 2, 0, 0]) for pose in poses])
    assert middle[:, 2] == pytest.approx(np.full(len(poses), 640.0), abs=0.1)
    assert poses[:, 2, 1] == pytest.approx(np.ones(len(poses)), abs=1e-4)
    assert middle[[0, -1], 0] == pytest.approx([-20, 20], abs=0.01)


def test_a_stroke_beside_the_solid_is_refused(cylinders, clean):
    with pytest.raises(InputError, match="expected the probe over outer"):
        along_surface(SurfacePath(start_mm=(0.0, 60.0), end_mm=(0.0, 70.0)), outer(cylinders), clean, 1)


def test_the_surface_is_where_the_cylinder_says(cylinders):
    y = np.linspace(-20, 15, 8)
    expected = 670 - np.sqrt(30.0**2 - (y + 2) ** 2)
    assert top(outer(cylinders), np.column_stack([np.zeros(8), y])) == pytest.approx(expected, abs=0.02)
    assert np.isnan(top(outer(cylinders), np.array([[0.0, 60.0]]))).all()


def test_the_hand_is_as_unsteady_as_asked(clean):
    """Over two minutes, some 400 correlation times, the standard deviation is within 10 % of the one asked for."""
    bob = Bob(height_mm=1e-6, seconds=120.0, hand=Hand(shift_mm=0.4, turn_deg=0.0))
    places = bobbing(bob, clean, 3).poses[:, :3, 3]
    assert places.std(axis=0) == pytest.approx(np.full(3, 0.4), rel=0.15)


def test_a_sweep_keeps_its_clocks(rig, small):
    """The lag of the scanner's stamps is found by the pipeline from the images and the poses alone."""
    tank = body(build_scene({"kind": "tank"}))
    path = bobbing(Bob(middle_mm=(4.0, -2.0, 672.0), height_mm=6.0, seconds=5.0, hand=STILL), small, 1)
    clocks = Clocks(scanner_hz=12.0, camera_hz=30.0, lag_s=0.08, scanner_jitter_s=0.003)
    recorded = sweep(tank, small, rig.probe, path, clocks, PoseNoise(turn_deg=0.0, shift_mm=0.0), 1)
    depths = np.array([latency.bottom_depth(one) for one in recorded.images])
    assert latency.estimate(recorded.times, depths, recorded.track).seconds == pytest.approx(0.08, abs=0.005)
    at_images = tracks.at(recorded.track, recorded.truth.times)
    seen = np.isfinite(at_images).all(axis=(1, 2))
    error = at_images[seen] @ rig.probe.target_from_image.matrix() - recorded.truth.poses[seen]
    assert np.abs(error).max() < 0.1  # mm; interpolated over a camera period


def test_a_bracket_that_gives_moves_the_target_against_the_image(rig, small):
    """As designed in the middle; at the end the image is where the bent bracket holds it, and truth is the image's."""
    path = bobbing(Bob(seconds=2.0), small, 1)
    errors, exact = Motion(bracket_mm=1.0, bracket_deg=1.0), PoseNoise(turn_deg=0.0, shift_mm=0.0)
    taken, clocks = moments(path, 10.0), Clocks(scanner_hz=10.0, camera_hz=20.0, lag_s=0.0, scanner_jitter_s=0.0)
    stiff, soft = (plan(rig.probe, path, taken, clocks, exact, 3, each) for each in (Motion(), errors))
    assert (stiff.truth.poses == soft.truth.poses).all()
    steps = given(errors, moments(path, 20.0), 3)
    for k in (0, len(steps) // 2, -1):
        bent = rigid.moved(rig.probe.target_from_image.matrix(), steps[k])
        image = stiff.track.poses[k] @ rig.probe.target_from_image.matrix()
        np.testing.assert_allclose(soft.track.poses[k] @ bent, image, atol=1e-9)


def test_a_probe_trembles_about_its_face(small):
    """Above the hand's own unsteadiness, by the standard deviation asked for, at the middle of the array."""
    bob = Bob(height_mm=1e-6, seconds=20.0, hand=STILL)
    moves = [bobbing(bob, small, 1, trembling(Motion(tremor_mm=0.1, tremor_deg=0.5), seed)).poses for seed in range(8)]
    middle = np.array([rigid.apply(pose, [small.width_mm / 2, 0, 0]) for poses in moves for pose in poses])
    assert middle.std(axis=0) == pytest.approx(np.full(3, 0.1), rel=0.15)


def test_the_target_moves_over_an_exposure_as_the_path_leads_it(rig):
    """Later along the path, earlier before it, and nowhere beyond its ends."""
    times = 10_000_000 * np.arange(50)
    poses = np.stack([rigid.transform(np.eye(3), [0.2 * k, 0, 0]) for k in range(50)])  # 20 mm/s
    planned = plan(rig.probe, tracks.Track(times, poses), times[5:40:5], Clocks(camera_hz=20), PoseNoise(), 0)
    at_once, later, earlier = (planned.target.poses(step) for step in (0.0, 0.005, -0.005))
    moved = later[:, :3, 3] - earlier[:, :3, 3]
    assert moved[1:-1] == pytest.approx(np.tile([0.2, 0, 0], (len(moved) - 2, 1)))
    assert moved[0] == pytest.approx([0.1, 0, 0]) and np.isfinite(moved).all(), "at the start it was at rest before"
    assert at_once == pytest.approx((later + earlier)[:, :4, :4] / 2, abs=0.06)


def test_all_n_wires_stay_in_view(cylinders, clean):
    """Where each wire meets the image's plane, by line and plane, lies in the image of the slower water."""
    wired = body(build_scene({"kind": "n_wires", "turn_deg": 25.0}))
    ends = np.stack([wire.ends for wire in wired.wires])
    course, taken = over_rows(RowPath(), wired, clean)
    scale = np.array(clean.scale_mm_per_px) * [1.0, wired.medium.speed / clean.assumed_speed]
    inside = []
    for pose in tracks.poses_at(course, taken, 0.0):
        front, back = np.moveaxis(rigid.apply(rigid.invert(pose), ends), 1, 0)
        places = front - front[:, 2:] / (back - front)[:, 2:] * (back - front)
        pixels = places[:, :2] / scale
        inside.append(((pixels > 0) & (pixels < np.array(clean.image_size) - 1)).all())
    assert np.mean(inside) > 0.9
    with pytest.raises(InputError, match="expected a scene of N-wires, such as scene=n_wires, found no wires"):
        over_rows(RowPath(), cylinders, clean)


@pytest.mark.parametrize("scene", [{"kind": "plane", "tilt_deg": [3.0, -4.0]}, {"kind": "tank"}, {"kind": "sphere"}])
def test_the_surface_lies_at_depths_of_the_path_before_the_tilted_array(scene, clean):
    """By marching down the line in the array's middle, and beside a sphere's top by as much as its arc is lower."""
    scanned, path = body(build_scene(scene)), TiltPath(count=30)
    course, taken = over_surface(path, scanned, clean)
    poses = tracks.poses_at(course, taken, 0.0)
    assert len(poses) == 30
    depth = np.arange(0, 60, 0.05)
    middle = np.array([clean.face_mm[0], 0, 0]) + depth[:, None] * [0, 1, 0]
    lines = [rigid.apply(pose, middle) for pose in poses]
    met = np.array([depth[(np.min([solid.distances(line) for solid in scanned.solids], axis=0) < 0).argmax()] for line in lines])
    lower = 4.0 if scene["kind"] == "sphere" else 1.0  # mm, of an arc 11 mm aside, or of a wall that isn't level
    assert (met > path.depth_mm[0] - 1).all() and (met < path.depth_mm[1] + lower).all()
    straight = np.degrees(np.arccos(poses[:, 2, 1]))
    assert 30 < straight.max() < 50 and np.ptp(met) > 15


def test_a_scene_without_a_surface_to_tilt_over_is_refused(cylinders, clean):
    with pytest.raises(InputError, match="expected a scene of a wall or a sphere, such as scene=plane or scene=sphere, found"):
        over_surface(TiltPath(), cylinders, clean)
    with pytest.raises(InputError, match=r"found tank, wire0, wire1"):
        over_surface(TiltPath(), body(build_scene({"kind": "crosswire"})), clean)


def test_a_probe_that_keeps_moving_stays_over_the_wires(clean):
    """Without rests it goes through the poses of one that rests, smoothly, and has a pose at any moment."""
    wired = body(build_scene({"kind": "n_wires"}))
    rests, middles = over_rows(RowPath(count=6), wired, clean)
    course, none = over_rows(RowPath(count=6, rest_s=0, move_s=2.0), wired, clean)
    assert len(none) == 0 and course.times[-1] == 10_000_000_000
    through = tracks.at(course, np.arange(6) * 2_000_000_000)
    assert through == pytest.approx(tracks.at(rests, middles), abs=1e-9)
    steps = np.linalg.norm(np.diff(course.poses[:, :3, 3], axis=0), axis=1)
    assert np.abs(np.diff(steps)).max() < 0.05 * steps.max() + 1e-3, "mm in 10 ms: no jerk"
