"""Further bodies in a sweep: led over its time, tracked with the cameras' noise by their clock, and truth at both clocks."""

import numpy as np
import pytest

from recon.capture.sweep_part import read_sweep
from recon.geometry import rigid
from recon.model import tracks
from recon.model.circle_layout import circle_centres
from sonotwin import config
from sonotwin.cli import main
from sonotwin.verbs.sweep import Config, places
from twin.filmed_sweep import PlannedSweep, plan_sweep
from twin.swept_bodies import mean_pose

FIELDS = [
    "rig=three_bodies", "scene=test_object", "path=hold", "path.seconds=4", "rig.probe.image_size=[48,128]",
    "ultrasound.image_size=[48,128]", "bodies.needle={look: {kind: needle, gauge: 18}, path: {kind: insertion, seconds: 4}}",
]  # fmt: skip


def planned(*fields: str) -> PlannedSweep:
    return plan_sweep(config.load("sweep", [*FIELDS, "out=unused", *fields], Config))


def test_the_needle_is_in_the_b_scan_and_tracked_to_the_noise():
    made = planned("path.hand.shift_mm=0", "path.hand.turn_deg=0")
    one = made.bodies["needle"]
    assert list(made.bodies) == ["needle", "patient"]
    tips = np.array([rigid.apply(pose, one.look.tip_mm(one.target)) for pose in one.scanned.poses])
    shown = np.array([rigid.apply(rigid.invert(pose), tip) for pose, tip in zip(made.plan.truth.poses, tips, strict=True)])
    middle = made.settings.ultrasound.width_mm / 2
    assert np.abs(shown[:, 2]).max() < 0.5 and np.abs(shown[40] - [middle, 22, 0]).max() < 0.5, "unsteady by 0.15 mm"
    np.testing.assert_array_equal(one.track.times, made.plan.track.times)
    steps = np.array([rigid.difference(true, seen) for true, seen in zip(one.truth.poses, one.track.poses, strict=True)])
    count = steps[:, :3].size
    assert np.degrees(steps[:, :3]).std() == pytest.approx(0.05, rel=4 / np.sqrt(2 * count))
    assert steps[:, 3:].std() == pytest.approx(0.03, rel=4 / np.sqrt(2 * count))
    between = tracks.at(one.truth, one.scanned.times[:-1])
    np.testing.assert_allclose(between, one.scanned.poses[:-1], atol=0.05)


def test_it_is_said_where_one_target_may_hide_another():
    """A patient's board between the probe's and camera 1; the usual bodies hide none, and what isn't filmed can't."""
    before = 0.85 * planned().plan.target.poses()[0][:3, 3]
    given = f"bodies.patient={{path: {{kind: still, place_mm: {before.round().tolist()}}}}}"
    for fields, said in (((given, "filmed=true"), True), (("filmed=true",), False), ((given,), False)):
        lines = [line for line, _ in places(planned(*fields))]
        assert any("one of it and the probe may hide the other at" in line for line in lines) == said, (fields, lines)


def test_poses_that_a_camera_has_not_in_view_are_not_found():
    """A board led sideways out of the image: found where the calibrated projection of all its circles lies inside."""
    led = "bodies.patient={path: {kind: hand, seconds: 4, places_mm: [[0,60,650],[-70,60,650],[-160,60,650]], turn_deg: 0}}"
    made = planned(led)
    one, rig = made.bodies["patient"], made.settings.rig
    inside = np.ones(len(one.truth.poses), bool)
    for device in (rig.cam1, rig.cam2):
        camera = device.optics.camera()
        pixels = np.array([camera.project(rigid.apply(pose, circle_centres(one.target))) for pose in one.truth.poses])
        radius = 0.5 * one.target.outer_diameter_mm * camera.matrix[0, 0] / 650
        inside &= ((pixels > radius) & (pixels < np.array(camera.size) - 1 - radius)).all(axis=(1, 2))
    assert 20 < inside.sum() < len(inside) - 20
    assert np.count_nonzero(one.track.found != inside) <= 4, "of a pixel at the edges"
    np.testing.assert_array_equal(one.track.found, one.in_view(rig))
    assert np.isfinite(one.truth.poses).all() and np.isfinite(one.scanned.poses).all()


def test_it_is_said_how_often_cameras_and_scanner_see_a_body(tmp_path, capsys):
    """The needle that nothing is said of is in view throughout; one beside both views is not found, and is warned of."""
    fields = ["path.seconds=1", "clocks.scanner_hz=4", "clocks.camera_hz=10"]
    for name, way, said in (
        (
            "seen",
            "seconds: 1, rest_s: 0.6, depth_mm: 12, unsteady_mm: 0",
            "view of both cameras at 11 of 11 poses; tip in the slice in",
        ),
        (
            "unseen",
            "heading_deg: 0, angle_deg: 35",
            "needle      target in view of both cameras at 0 of 11 poses; tip in the slice in 0 of 5 B-scans",
        ),
    ):
        body = f"bodies.needle={{path: {{kind: insertion, {way}}}}}"
        assert main(["sweep", f"out={tmp_path / name}", *FIELDS[:-1], *fields, body]) == 0
        printed = capsys.readouterr()
        assert said in (printed.out if name == "seen" else printed.err) and said not in (
            printed.err if name == "seen" else printed.out
        )
        found = read_sweep(tmp_path / name / "capture").bodies["needle"].found
        assert found.all() if name == "seen" else not found.any()


def test_a_tip_is_in_the_slice_within_the_image_and_near_its_plane():
    """5 mm beside the plane it isn't; nor below the image, which is 15 mm deep."""
    counts = []
    for aim in ("depth_mm: 12", "depth_mm: 12, beside_mm: 5", "depth_mm: 22"):
        made = planned(f"bodies.needle={{path: {{kind: insertion, seconds: 4, rest_s: 3.8, travel_mm: 6, {aim}}}}}")
        counts.append(made.bodies["needle"].in_slice(made.plan.truth.poses, made.settings.rig).mean())
    assert counts[0] > 0.9 and counts[1:] == [0, pytest.approx(0, abs=0.1)]
    assert made.bodies["patient"].in_slice(made.plan.truth.poses, made.settings.rig) is None


def test_the_hand_trembles_and_the_post_does_not():
    still, shaken = (planned(f"conditions.motion.tremor_mm={size}").bodies for size in (0, 0.3))
    moved = {name: shaken[name].truth.poses[:, :3, 3] - still[name].truth.poses[:, :3, 3] for name in still}
    assert moved["needle"].std() > 0.1 and not moved["patient"].any()


def test_the_probes_own_poses_stay():
    """Whether other bodies are there or not."""
    fields = [field for field in FIELDS if not field.startswith(("bodies", "rig="))]
    with_them, without = planned().plan, plan_sweep(config.load("sweep", [*fields, "out=unused"], Config)).plan
    np.testing.assert_array_equal(with_them.track.poses, without.track.poses)
    np.testing.assert_array_equal(with_them.truth.poses, without.truth.poses)


def test_a_capture_has_their_poses_and_the_truth_has_both_clocks(tmp_path):
    assert main(["sweep", f"out={tmp_path}", *FIELDS, "path.seconds=1"]) == 0
    found = read_sweep(tmp_path / "capture")
    assert sorted(found.bodies) == ["needle", "patient"] and len(found.bodies["needle"].times) == len(found.track.times)
    own = tmp_path / "truth" / "sweep"
    with np.load(own / "bodies" / "needle.npz") as truth, np.load(own / "scans" / "needle.npz") as scans:
        assert truth["world_from_target"].shape == (len(found.track.times), 4, 4)
        off = found.bodies["needle"].poses[:, :3, 3] - truth["world_from_target"][:, :3, 3]
        assert 0.01 < off.std() < 0.05
        assert scans["reference_from_target"].shape == (len(found.times), 4, 4)
        assert scans["tip_px"].shape == (len(found.times), 2) and scans["axis_mm"].shape == (len(found.times), 2, 3)
        np.testing.assert_allclose(found.times - scans["times_ns"], 50_000_000, atol=20_000_000)


def test_the_needle_is_seen_in_the_b_scans_at_its_tip(tmp_path):
    """Within 5 px of the true tip, at the rest, all is brighter than without it."""
    fields = ["rig=three_bodies", "scene=test_object", "path=hold", "path.seconds=1", "clocks.scanner_hz=3"]
    path = "{kind: insertion, seconds: 1, rest_s: 0.9, travel_mm: 5, depth_mm: 12, angle_deg: 35, heading_deg: 0}"
    needle = f"{{look: {{kind: needle, etched_mm: 3}}, path: {path}}}"
    for name, body in (("with", needle), ("without", "{path: {kind: insertion, beside_mm: 40}}")):
        assert main(["sweep", f"out={tmp_path / name}", f"bodies.needle={body}", *fields]) == 0
    shown, plain = (list(read_sweep(tmp_path / name / "capture").images()) for name in ("with", "without"))
    with np.load(tmp_path / "with" / "truth" / "sweep" / "scans" / "needle.npz") as truth:
        for image, other, (u, v), (_, _, beside) in zip(shown, plain, truth["tip_px"], truth["tip_mm"], strict=True):
            near = np.s_[round(v) - 5 : round(v) + 6, round(u) - 5 : round(u) + 6]
            assert abs(beside) < 0.8 and image[near].max() > other[near].max() + 15


def test_a_patient_who_moved_carries_scene_probe_and_bodies(tmp_path):
    """The scanner sees the same, the cameras see all moved by one step about the phantom's middle."""
    still, moved = planned("filmed=true"), planned("filmed=true", "moved={turn_deg: [0, 3, 4], shift_mm: [12, -16, 0]}")
    step, middle = moved.world_from_reference, still.scene.things[0].mesh.bounds.mean(axis=0)
    np.testing.assert_array_equal(still.world_from_reference, np.eye(4))
    np.testing.assert_allclose(rigid.apply(step, middle) - middle, [12, -16, 0], atol=1e-9)
    assert np.degrees(np.linalg.norm(rigid.difference(np.eye(4), step)[:3])) == pytest.approx(5)
    np.testing.assert_array_equal(moved.plan.truth.poses, still.plan.truth.poses)
    np.testing.assert_allclose(moved.plan.track.poses, step @ still.plan.track.poses)
    for name, one in moved.bodies.items():
        np.testing.assert_allclose(one.truth.poses, step @ still.bodies[name].truth.poses)
        np.testing.assert_allclose(one.track.poses, step @ still.bodies[name].track.poses)
        np.testing.assert_array_equal(one.scanned.poses, still.bodies[name].scanned.poses)


def test_what_stands_beside_the_scene_keeps_still():
    """As the phantom does, whose motion it is to tell; unless a path is given."""
    one, led = (
        planned().bodies["patient"],
        planned("bodies.patient={path: {kind: hand, places_mm: [[0,0,650],[9,0,650],[0,9,650]]}}"),
    )
    assert np.ptp(one.truth.poses, axis=0).max() < 1e-9
    assert np.ptp(led.bodies["patient"].truth.poses[:, :3, 3], axis=0).max() > 3


def test_the_mean_of_poses_is_the_one_they_scatter_about(rng):
    pose = rigid.from_rotation_vector([0.3, -2.0, 0.8], [3.0, -40.0, 600.0])
    scattered = np.stack(
        [pose @ rigid.from_rotation_vector(0.05 * rng.standard_normal(3), rng.standard_normal(3)) for _ in range(900)]
    )
    off = rigid.difference(pose, mean_pose(scattered))
    assert np.abs(off[:3]).max() < 4 * 0.05 / 30 and np.abs(off[3:]).max() < 4 / 30
