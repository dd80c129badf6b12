"""Frames are paired by their exposures, in whatever order they arrive; those whose partner is lost are left out."""

import numpy as np

from recon.devices.interfaces import Frame
from recon.navigation.feeds import Arrival
from recon.navigation.frame_pairs import Pairing
from recon.navigation.newest import Newest

PERIOD_NS = 40_000_000


def arrival(number, late_ns=0):
    time_ns = number * PERIOD_NS + late_ns
    return Arrival(Frame(np.zeros((1, 1), np.uint8), number, time_ns, time_ns), time_ns)


def paired(events):
    """Numbers of the pairs that are made of events (camera, number), with a millisecond between the cameras."""
    newest, made = Newest(), []
    pairing = Pairing(newest)
    for camera, number in events:
        pairing.add(camera, arrival(number, camera * 1_000_000))
        if (pair := newest.take(0)) is not None:
            made.append((pair.left.frame.number, pair.right.frame.number))
    return made


def test_partners_are_found_in_any_order():
    assert paired([(0, 0), (1, 0), (1, 1), (0, 1), (0, 2), (1, 2)]) == [(0, 0), (1, 1), (2, 2)]


def test_a_camera_that_is_ahead_by_some_frames_loses_none():
    assert paired([(0, 0), (0, 1), (0, 2), (1, 0), (1, 1), (1, 2)]) == [(0, 0), (1, 1), (2, 2)]
    assert paired([(0, 0), (0, 1), (1, 1)]) == [(1, 1)]


def test_no_pair_comes_after_a_newer_one():
    assert paired([(0, 0), (0, 1), (1, 1), (1, 0), (0, 2), (1, 2)]) == [(1, 1), (2, 2)]


def test_frames_without_a_partner_are_left_out():
    assert paired([(0, 0), (1, 1), (0, 2), (1, 2), (0, 3), (0, 4), (1, 4)]) == [(2, 2), (4, 4)]


def test_pairs_are_of_camera_one_and_camera_two():
    newest = Newest()
    pairing = Pairing(newest)
    first, second = arrival(5), arrival(5, 1_000_000)
    pairing.add(1, second)
    pairing.add(0, first)
    pair = newest.take(0)
    assert pair.left is first and pair.right is second and pair.exposed_ns == first.exposed_ns
