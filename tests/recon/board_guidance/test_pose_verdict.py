"""A pose is kept when it adds information; else the reason is named, with the way on."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from recon.board_guidance.next_pose import suggest
from recon.board_guidance.pose_progress import SoFar, with_sighting
from recon.board_guidance.pose_verdict import Observation, judge, judge_lit
from recon.optical_calibration.sightings import Cause, Failure
from tests.recon.board_guidance.held_boards import kept, photograph, posed, seen, spread
from tests.recon.board_sets import BOARD, devices

POSES = [
    posed((40, 0, 606), (0, 35)),
    posed((-40, 30, 700), (-35, 0), 90),
    posed((40, -30, 650), (20, -25)),
    posed((-50, -20, 720)),
]


@pytest.fixture
def so_far(rig, rng):
    return kept(rig, POSES, rng)


def observed(rig, pose, rng):
    return Observation(replace(seen(rig, [pose], rng)[0], name="new"))


def test_a_new_pose_is_kept(rig, rng, so_far):
    asked = suggest(so_far.calibration, so_far.poses, rig, BOARD, rng, noise=so_far.noise)
    verdict = judge(replace(observed(rig, asked.world_from_board, rng), asked_gain=asked.gain), so_far)
    assert verdict.accepted and len(verdict.so_far.poses) == len(POSES) + 1
    assert verdict.gain == pytest.approx(asked.gain, rel=0.1) and verdict.reason == f"adds {100 * verdict.gain:.1f} %"


def test_the_first_pose_is_kept(rig, rng):
    assert judge(observed(rig, POSES[0], rng), SoFar(rig, BOARD)).accepted


def test_an_old_pose_is_refused_by_its_name(rig, rng, so_far):
    near = POSES[1].copy()
    near[:3, 3] += [3, 0, 2]
    verdict = judge(observed(rig, near, rng), so_far)
    assert not verdict.accepted and verdict.so_far is so_far
    assert verdict.reason.startswith("too like pose 01, 4 mm and 0 deg from it: adds ")


def test_a_pose_that_adds_little_is_refused(rig, rng):
    """A straight board in the middle, after ten of all kinds."""
    many = kept(rig, spread(rig, 10, rng), rng)
    verdict = judge(observed(rig, posed((0, 0, 660)), rng), many)
    assert not verdict.accepted and "% is possible" in verdict.reason


def test_who_wants_to_keeps_a_refused_pose(rig, rng, so_far):
    again = observed(rig, POSES[1], rng)
    assert not judge(again, so_far).accepted
    assert len(with_sighting(so_far, again.sighting).poses) == len(POSES) + 1


def test_a_device_that_does_not_find_the_board_is_named_with_its_reason(rig, rng, so_far):
    sighting = seen(rig, [posed((0, 20, 680), (20, 20))], rng)[0]
    failures = {"cam2": Failure(Cause.NO_BOARD, "30 of 44 discs usable")}
    blind = replace(sighting, pixels={k: v for k, v in sighting.pixels.items() if k != "cam2"}, failures=failures)
    verdict = judge(Observation(blind), so_far)
    assert not verdict.accepted and verdict.reason.startswith("cam2: board not found: 30 of 44 discs usable; ")


def test_the_projector_is_judged_last(rig, rng, so_far):
    """Before its fringes are taken, a pose is as good as the cameras see it."""
    sighting = seen(rig, [posed((0, 20, 680), (20, 20))], rng)[0]
    unlit = replace(sighting, pixels={k: v for k, v in sighting.pixels.items() if k != "projector"})
    lit = Observation(unlit, asked_gain=0.05)
    early = judge_lit(lit, so_far)
    assert early.accepted and early.so_far is so_far
    assert judge(lit, so_far).reason.startswith("projector: board not found; ")


def test_a_board_that_is_gone_afterwards_is_told(rig, rng, so_far):
    seen_once = observed(rig, posed((0, 20, 680), (20, 20)), rng)
    gone = {"cam1": np.full_like(seen_once.sighting.pixels["cam1"], np.nan)}
    assert "out of sight after the last frame" in judge(replace(seen_once, again=gone), so_far).reason


def test_one_camera_and_the_projector_are_guided_alone(rig, rng):
    so_far = SoFar(rig, BOARD, noise={"cam1": 0.01, "projector": 0.01})
    for one in seen(rig, POSES, rng):
        pixels = {name: at for name, at in one.pixels.items() if name != "cam2"}
        so_far = with_sighting(so_far, replace(one, pixels=pixels))
    assert so_far.calibration is not None and list(so_far.calibration.cameras) == ["cam1", "projector"]
    assert suggest(so_far.calibration, so_far.poses, rig, BOARD, rng, noise=so_far.noise).gain > 0


def test_a_board_that_moved_is_told(rig, rng, so_far):
    seen_once = observed(rig, posed((0, 20, 680), (20, 20)), rng)
    later = {"cam1": seen_once.sighting.pixels["cam1"] + [0.3, 0.1]}
    verdict = judge(replace(seen_once, again=later), so_far)
    assert not verdict.accepted and "moved by 0.32 px between the first frame and the last" in verdict.reason


def test_a_board_that_moved_before_the_fringes_contradicts_the_others(rig, rng, so_far):
    """The projector's coordinates are those of a place 1 mm away; no frame was taken twice."""
    asked = suggest(so_far.calibration, so_far.poses, rig, BOARD, rng, noise=so_far.noise)
    pose, moved = asked.world_from_board, asked.world_from_board.copy()
    moved[:3, 3] += [0, 1.0, 1.0]
    first, second = seen(rig, [pose, moved], rng)
    mixed = replace(first, pixels={**first.pixels, "projector": second.pixels["projector"]})
    verdict = judge(Observation(mixed, asked_gain=asked.gain), so_far)
    assert not verdict.accepted and "contradicts the other poses" in verdict.reason


@pytest.mark.parametrize(("how", "word"), [("still", None), ("defocus", "blurred"), ("motion", "smeared")])
def test_a_blurred_image_is_told_with_its_cause(rig, rng, so_far, how, word):
    pose = posed((0, 20, 680), (25, -30))
    image = photograph(replace(devices(rig)["cam1"], distortion=np.zeros(0)), BOARD, pose, rng)
    if how == "defocus":
        image = cv2.GaussianBlur(image, (0, 0), 4.0)
    if how == "motion":
        image = cv2.filter2D(image, -1, np.full((1, 12), 1 / 12))
    verdict = judge(replace(observed(rig, pose, rng), lit={"cam1": image}), so_far)
    assert (word in verdict.reason) if word else ("blurred" not in verdict.reason and "smeared" not in verdict.reason)
