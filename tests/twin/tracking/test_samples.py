"""What is drawn at random keeps to its ranges and shares."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from recon.geometry import rigid
from recon.model.circle_layout import circle_centres
from tests.twin.small_rigs import half
from tests.twin.tracking.takes import ranges, rig, rig_of_three
from twin.tracking.mesh_bank import build_bodies, uncovered_share
from twin.tracking.samples import draw, facing
from twin.tracking.sampling_ranges import PoseRanges
from twin.tracking.study_samples import HALF_MM, MARGIN_PX, TILT_DEG, bodies_take, study_take
from twin.tracking.target_truth import board_corners, view_truth

RIG, COUNT = rig(), 150


@pytest.fixture(scope="module")
def takes():
    return [draw(ranges(), RIG, 7, k) for k in range(COUNT)]


def share(flags, expected: float) -> None:
    """Within 4 standard deviations of a binomial."""
    assert abs(np.mean(flags) - expected) < 4 * np.sqrt(expected * (1 - expected) / len(flags))


def test_shares_are_as_asked(takes):
    asked = ranges()
    share([not take.present for take in takes], asked.pose.empty_share)
    share([take.cameras[0] == RIG.cam1 for take in takes], asked.cameras.own_share)
    share([take.lighting.projector[0] > 0 for take in takes], asked.light.projector_share)


def test_a_take_depends_on_seed_and_number_alone(takes):
    again = draw(ranges(), RIG, 7, 11)
    assert again.noise_seed == takes[11].noise_seed
    assert (again.motion.world_from_target == takes[11].motion.world_from_target).all()
    assert draw(ranges(), RIG, 8, 11).noise_seed != again.noise_seed


def test_foreign_cameras_see_as_much_whatever_the_rigs_pixels():
    """Focal lengths over the image's width are the same for a rig of half as many pixels; of the usual rig they are as asked."""
    asked = ranges()
    foreign = asked.model_copy(update={"cameras": asked.cameras.model_copy(update={"own_share": 0.0})})
    usual, small = (
        np.array(
            [device.optics.focal_px[0] / device.optics.size[0] for k in range(20) for device in draw(foreign, one, 3, k).cameras]
        )
        for one in (RIG, half(RIG))
    )
    assert RIG.cam1.optics.size[0] == 1280 == 2 * half(RIG).cam1.optics.size[0]
    np.testing.assert_allclose(small, usual, rtol=1e-12)
    least, most = asked.cameras.focal_px
    assert 0.995 * least < 1280 * usual.min() < 1.2 * least and 0.8 * most < 1280 * usual.max() < 1.005 * most


def test_targets_face_both_cameras_and_mostly_lie_in_their_images(takes):
    inside = []
    for take in takes:
        pose = take.motion.world_from_target
        middle = rigid.apply(pose, circle_centres(RIG.target)).mean(axis=0)
        for device in take.cameras:
            camera = device.optics.camera()
            assert (camera.centre - middle) @ pose[:3, 2] > 0
            pixel = camera.project(middle)
            inside.append(((pixel > 0) & (pixel < np.array(camera.size))).all())
    assert np.mean(inside) > 0.9


def test_blur_is_the_path_that_was_asked_for(takes):
    still, moving = [], []
    for take in takes:
        length = np.median(view_truth(take, take.cameras[0], 0.0, RIG.target).blur_px) if take.present else np.nan
        (still if np.linalg.norm(take.motion.shift_mm) < 0.3 * take.motion.world_from_target[2, 3] / 3320 else moving).append(
            length
        )
    assert np.nanmax(still) < 1
    assert 1.7 < np.nanmedian(moving) < 5  # log-uniform from 0.3 to 24: 2.7; turns add


def test_tilts_fill_the_cone_evenly(rng):
    cosines = [facing(np.array([0.2, -0.1, -1]), 58, rng)[:, 2] @ np.array([0.2, -0.1, -1]) / np.sqrt(1.05) for _ in range(2000)]
    low = np.cos(np.deg2rad(58))
    assert min(cosines) >= low - 1e-12
    assert abs(np.mean(cosines) - (1 + low) / 2) < 4 * (1 - low) / np.sqrt(12 * 2000)


def test_studies_keep_to_the_working_volume():
    low, high = np.array([-HALF_MM[0], -HALF_MM[1], 606]), np.array([*HALF_MM, 713])
    for k in range(20):
        take = study_take(RIG, ranges(), 3, k, 100.0, 12.0)
        pose = take.motion.world_from_target
        middle = rigid.apply(pose, [RIG.target.c1_mm / 2, RIG.target.c2_mm / 2, 0])
        eyes = (RIG.cam1.optics.camera().centre + RIG.cam2.optics.camera().centre) / 2
        assert ((middle - [eyes[0], 0, 0] >= low - 1) & (middle - [eyes[0], 0, 0] <= high + 1)).all()
        towards = (eyes - middle) / np.linalg.norm(eyes - middle)
        assert np.rad2deg(np.arccos(pose[:3, 2] @ towards)) <= TILT_DEG + 1e-9
        for device in take.cameras:
            truth = view_truth(take, device, 0.0, RIG.target)
            assert truth.inside.all()
            assert truth.blur_px == pytest.approx(12, abs=5)


@pytest.fixture(scope="module")
def three():
    rig = rig_of_three()
    bank = build_bodies(rig, 1, 2)
    return rig, bank, [bodies_take(bank, rig, ranges(variants=1), 2, k, (20.0, 90.0), (0.0, 12.0)) for k in range(12)]


def test_several_bodies_stand_apart_in_both_views(three):
    """No two boards share a pixel; all lie within the images, and within the working volume."""
    rig, _, takes = three
    for take in takes:
        for device in take.cameras:
            count = np.zeros(device.optics.size[::-1], np.uint8)
            for name, held in take.held.items():
                corners = device.optics.camera().project(
                    rigid.apply(held.motion.world_from_target, board_corners(rig.targets[name]))
                )
                assert (corners > MARGIN_PX).all() and (corners < np.array(device.optics.size) - 1 - MARGIN_PX).all()
                count += cv2.fillConvexPoly(np.zeros_like(count), np.floor(corners + 0.5).astype(np.int32), 1)
            assert count.max() == 1
        assert all(600 < held.motion.world_from_target[2, 3] < 760 for held in take.held.values())


def test_several_bodies_move_each_by_itself(three):
    """Blur is even from 0 to 12 px, light log-even: means within 4 standard deviations; turns add a little."""
    rig, _, takes = three
    blur = np.array([
        [view_truth(held, take.cameras[0], 0.0, rig.targets[name]).blur_px.mean() for name, held in take.held.items()]
        for take in takes
    ])  # fmt: skip
    assert blur.max() < 16 and abs(blur.mean() - 6.3) < 4 * 12 / np.sqrt(12 * blur.size)
    assert np.abs(np.corrcoef(blur.T)[np.triu_indices(3, 1)]).max() < 0.85
    whites = np.log([take.white_dn for take in takes])
    assert abs(whites.mean() - np.log(20 * 90) / 2) < 4 * np.log(90 / 20) / np.sqrt(12 * len(takes))


def test_nothing_covers_the_circles_of_several_bodies(three):
    """By the check that they are drawn with; a needle's board that is moved before the probe's fails it."""
    rig, bank, takes = three
    eyes = np.array([device.optics.camera().centre for device in takes[0].cameras])
    for take in takes:
        assert uncovered_share(bank, take, rig.targets, eyes) == 1
    needle = takes[0].others["needle"]
    before = takes[0].motion.world_from_target.copy()
    before[:3, 3] -= 0.1 * before[:3, 3]
    covering = replace(needle, motion=replace(needle.motion, world_from_target=before))
    assert uncovered_share(bank, replace(takes[0], others={"needle": covering}), rig.targets, eyes) < 0.9


def test_a_take_of_several_bodies_depends_on_seed_and_number_alone(three):
    rig, bank, takes = three
    again = bodies_take(bank, rig, ranges(variants=1), 2, 7, (20.0, 90.0), (0.0, 12.0))
    for name, held in again.held.items():
        assert (held.motion.world_from_target == takes[7].held[name].motion.world_from_target).all()
    assert (again.scene_from_world == takes[7].scene_from_world).all() and again.white_dn == takes[7].white_dn


def test_ranges_the_wrong_way_round_are_refused_by_name():
    fields = ranges().pose.model_dump()
    with pytest.raises(ValueError, match="working_mm: expected the least first"):
        PoseRanges(**{**fields, "working_mm": (730, 590)})
