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
