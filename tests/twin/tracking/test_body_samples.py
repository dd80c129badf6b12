"""Further bodies of a data set's samples are there as often as asked, apart from each other, and stand on what is below."""

import numpy as np
import pytest

from recon.geometry import rigid
from recon.model import circle_layout
from tests.twin.tracking.takes import ranges, rig_of_three
from twin.tracking.body_samples import with_bodies
from twin.tracking.mesh_bank import build_bodies
from twin.tracking.samples import draw
from twin.tracking.target_truth import board_hulls, overlap

RIG, COUNT, SEED = rig_of_three(), 120, 7


@pytest.fixture(scope="module")
def bank():
    return build_bodies(RIG, 2, SEED)


@pytest.fixture(scope="module")
def takes(bank):
    return [with_bodies(draw(ranges(), RIG, SEED, k), bank, ranges(), RIG, SEED) for k in range(COUNT)]


def middle(name, held):
    return rigid.apply(held.motion.world_from_target, circle_layout.middle(RIG.targets[name]))


def test_each_body_is_there_as_often_as_asked(takes):
    """In samples that aren't empty; 4 standard deviations of a binomial. A few find no room."""
    asked = ranges()
    empty = [not any(held.present for held in take.held.values()) for take in takes]
    share = asked.pose.empty_share + (1 - asked.pose.empty_share) * asked.bodies.absent_share**3
    assert abs(np.mean(empty) - share) < 4 * np.sqrt(share * (1 - share) / COUNT)
    filled = [take for take in takes if draw(asked, RIG, SEED, take.k).present]
    for name, most_without_room in (("probe", 0.0), ("needle", 0.06), ("patient", 0.15)):
        share = asked.bodies.absent_share
        absent = np.mean([not take.held[name].present for take in filled])
        off = 4 * np.sqrt(share * (1 - share) / len(filled))
        assert share - off < absent < share + off + most_without_room, name


def test_the_probe_and_its_surroundings_are_those_of_a_rig_without_others(takes):
    alone = RIG.model_copy(update={"bodies": {}})
    for take in takes[:40]:
        plain = draw(ranges(), alone, SEED, take.k)
        assert (take.motion.world_from_target == plain.motion.world_from_target).all() and take.noise_seed == plain.noise_seed
        assert (take.scene_from_world == plain.scene_from_world).all() and take.face.ink == plain.face.ink


def test_a_take_depends_on_seed_and_number_alone(takes, bank):
    for seed, same in ((SEED, True), (SEED + 1, False)):
        again = with_bodies(draw(ranges(), RIG, seed, 11), bank, ranges(), RIG, seed).others["needle"]
        assert (again.motion.world_from_target == takes[11].others["needle"].motion.world_from_target).all() == same


def test_boards_keep_apart_in_both_views_and_mostly_lie_in_them(takes):
    inside = []
    for take in takes:
        cameras = [device.optics.camera() for device in take.cameras]
        there = {name: held for name, held in take.held.items() if held.present}
        hulls = [board_hulls(held.motion, cameras, RIG.targets[name]) for name, held in there.items()]
        assert not any(overlap(hulls[i], hulls[j]) for i in range(len(hulls)) for j in range(i))
        for name, held in there.items():
            pixels = np.array([camera.project(middle(name, held)) for camera in cameras])
            inside.append(((pixels > 0) & (pixels < cameras[0].size)).all())
            towards = np.mean([camera.centre for camera in cameras], axis=0) - middle(name, held)
            assert held.motion.world_from_target[:3, 2] @ towards > 0.5 * np.linalg.norm(towards)
    assert np.mean(inside) > 0.9


def test_a_board_on_a_post_stands_on_the_table(takes, bank):
    """Its foot is on the plane below, upright, and it hardly moves; a hand's body doesn't stand."""
    heights, tilts, paths = [], [], []
    for take in takes:
        held = take.others["patient"]
        if held.present:
            stand = bank.stands["patient"][held.body - 2 * ranges().variants]
            place, into = middle("patient", held), take.scene_from_world
            heights.append(rigid.apply(into, place)[2] - stand.height_mm)
            tilts.append(rigid.rotate(into @ held.motion.world_from_target, stand.up))
            paths.append(np.linalg.norm(held.motion.shift_mm))
    assert len(heights) > COUNT / 2
    assert np.abs(heights).max() < 1e-6 and np.abs(np.array(tilts) - [0, 0, 1]).max() < 1e-9
    assert np.median(paths) < 0.1  # 0.3 px at most, along the image, at 1 m
    assert max(np.linalg.norm(take.others["needle"].motion.shift_mm) for take in takes) > 2
