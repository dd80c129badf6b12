"""Hands: closed skins of human size that close around what they hold."""

import numpy as np
import pytest

from scenes.handheld import hand, lofts

ROD = lofts.superellipse((18, 14), 3, 48)


@pytest.mark.parametrize("left", [False, True])
def test_a_grip_is_closed_and_closes_around_the_rod(rng, left):
    """Fingers touch the rod without going through its middle, and surround it."""
    skin = hand.skin(hand.gripping(rng, ROD, left, rng.uniform(0, 6)), 0)
    assert skin.is_watertight and skin.volume > 0
    assert len(skin.split()) == 1
    beside = skin.vertices[np.abs(skin.vertices[:, 2]) < 25]
    distance = np.hypot(*beside[:, :2].T)
    assert 9 < distance.min() < 24
    near = beside[distance < 45]
    turn = np.histogram(np.arctan2(near[:, 1], near[:, 0]), 12, (-np.pi, np.pi))[0]
    assert (turn > 0).sum() >= 9


def test_a_hand_has_the_size_of_a_hand(rng):
    """From wrist to finger tip 165 to 215 mm, 75 to 130 mm broad with its thumb, some 300 to 500 ml (a man's: about 400)."""
    skeleton = hand.lying(rng, False)
    skin = hand.skin(skeleton, 0)
    assert 150 < skin.vertices[:, 1].max() - skeleton.wrist[1] < 220
    assert 75 < np.ptp(skin.vertices[:, 0]) < 170
    assert 250e3 < skin.volume - np.pi * 24**2 * hand.STUMP_MM < 600e3


def test_a_left_hand_mirrors_a_right_one():
    right, left = (hand.skin(hand.lying(np.random.default_rng(4), side), 0) for side in (False, True))
    assert right.volume == pytest.approx(left.volume, rel=0.03)
    assert right.centroid[0] * left.centroid[0] < 0


def test_a_lying_hand_stays_on_the_table(rng):
    for side in (False, True):
        skin = hand.skin(hand.lying(rng, side), 0)
        assert skin.bounds[0, 2] > -12  # the palm's heel may sink in a little, as flesh flattens


def test_a_thumb_pinches_from_the_front_and_fingers_from_behind(rng):
    skin = hand.skin(hand.pinching(rng, False, 4.0), 0)
    tip = skin.vertices[np.hypot(*skin.vertices[:, :2].T) < 6]
    front, back = tip[tip[:, 2] > 0], tip[tip[:, 2] < -4]
    assert len(front) and front[:, 2].min() < 5
    assert len(back) and back[:, 2].max() > -9
    assert not ((skin.vertices[:, 1] > -12) & (skin.vertices[:, 2] < -0.5) & (skin.vertices[:, 2] > -3.5)).any()


def test_the_forearm_is_closed_too(rng):
    skin = hand.skin(hand.lying(rng, True), 300)
    assert skin.is_watertight and skin.volume > 0
    assert np.linalg.norm(skin.vertices - hand.lying(rng, True).wrist, axis=1).max() > 250


@pytest.mark.parametrize("left", [False, True])
def test_a_hand_looked_at_closely_has_the_same_shape_in_finer_detail(rng, left):
    """Closed; off the plain skin by creases, tendons and nails alone; reflecting within bounds, the same from the same seed."""
    skeleton = hand.gripping(rng, ROD, left, 1.0)
    plain = hand.skin(skeleton, 0, hand.CLOSE_MM)
    (mesh, albedo), (_, again) = (hand.look(np.random.default_rng(3), skeleton, plain) for _ in range(2))
    assert mesh.is_watertight and mesh.volume == pytest.approx(plain.volume, rel=0.03)
    moved = np.linalg.norm(mesh.vertices - plain.vertices, axis=1)
    assert 0.6 < moved.max() < 2.5 and np.median(moved) < 0.2
    assert albedo.min() > 0.1 and albedo.max() < 0.8 and 0.05 < albedo.std() / albedo.mean() < 0.2
    np.testing.assert_array_equal(albedo, again)


def test_nails_are_paler_and_lie_on_the_back_of_the_fingers(rng):
    """The palest patch of each digit's last bone lies outside of its bend, away from the rod that it closes around."""
    skeleton = hand.gripping(rng, ROD, False, 1.0)
    mesh, albedo = hand.look(rng, skeleton, hand.skin(skeleton, 0, hand.CLOSE_MM))
    outside = []
    for *_, last in skeleton.digits:
        middle = last.end + 0.3 * (last.start - last.end)
        near = np.linalg.norm(mesh.vertices - middle, axis=1) < 1.4 * max(last.radii)
        palest = mesh.vertices[near][np.argsort(albedo[near])[-15:]].mean(axis=0)
        outside.append(np.hypot(*palest[:2]) - np.hypot(*middle[:2]))
    assert min(outside) > 1 and np.mean(outside) > 4


def test_clothes_fit_a_hand_of_either_detail():
    """The same kind of clothes from the same seed; only what is looked at closely has its own reflectance."""
    skeleton = hand.lying(np.random.default_rng(1), False)
    far, close = (hand.clothed(np.random.default_rng(5), skeleton, voxel) for voxel in (hand.VOXEL_MM, hand.CLOSE_MM))
    assert [part.slot for part in far] == [part.slot for part in close]
    assert far[0].albedo is None and close[0].albedo is not None and len(close[0].albedo) == len(close[0].mesh.vertices)
