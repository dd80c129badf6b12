"""Pairs that a target can be measured from, and refusals that name what is missing."""

import dataclasses

import numpy as np
import pytest

from recon.errors import InputError
from recon.geometry import rigid
from recon.target_calibration import target_poses
from recon.tracking import pose_fit, views
from recon.tracking.tracker import Tracking
from tests.recon.target_calibration import target_pairs


@pytest.fixture(scope="module")
def cameras(rig):
    return rig.cam1.optics.camera(), rig.cam2.optics.camera()


def at(pair, x_mm=0.0, turn_deg=0.0):
    moved = rigid.moved(pair.world_from_target, [0, 0, np.radians(turn_deg), x_mm, 0, 0])
    return target_poses.Seen(pair.views, moved)


def places(some, given):
    return [next(k for k, other in enumerate(given) if other is one) for one in some]


def test_poses_that_differ_are_kept(cameras, rig, rng):
    (pair,) = target_pairs.many(cameras, rig.target, 1, rng)
    given = [at(pair), at(pair, 1.0, 0.5), at(pair, 3.0), at(pair, 0.0, 2.0), at(pair, 2.9)]
    kept = target_poses.distinct(given)
    assert places(kept, given) == [0, 2, 3]


def test_uneven_light_is_taken_where_even_is_lacking(cameras, rig, rng):
    pairs = target_pairs.many(cameras, rig.target, 10, rng)
    dim = [dataclasses.replace(pair, even=False) for pair in pairs]
    mixed = [*dim[:2], *pairs[2:]]
    assert places(target_poses.evenly_lit(mixed), mixed) == list(range(2, 10))
    assert places(target_poses.evenly_lit(mixed, 9), mixed) == places(target_poses.evenly_lit(dim), dim) == list(range(10))


def test_chosen_pairs_are_spread(cameras, rig, rng):
    pairs = target_pairs.many(cameras, rig.target, 9, rng)
    assert places(target_poses.spread(pairs, 3), pairs) == [0, 4, 8]
    assert places(target_poses.spread(pairs, 20), pairs) == list(range(9))


def test_spreads_are_those_of_the_poses(cameras, rig):
    """Tilts of 10 degrees to both sides about one axis leave the other; about both they are 10 / sqrt(2) each."""
    rng, place = np.random.default_rng(0), [0.0, 0.0, 660.0]
    flip = np.diag([1.0, -1.0, -1.0])

    def tilted(x_deg, y_deg):
        turn = rigid.from_rotation_vector(np.radians([x_deg, y_deg, 0]), place)
        turn[:3, :3] = turn[:3, :3] @ flip
        return target_pairs.seen(cameras, rig.target, turn, rng)

    about_x = [tilted(10, 0), tilted(-10, 0)]
    assert target_poses.tilt_deg([tilted(0, 0)] * 3) < 0.5
    assert target_poses.tilt_deg([*about_x, tilted(0, 10), tilted(0, -10)]) == pytest.approx(10 / np.sqrt(2), abs=0.5)
    assert target_poses.range_mm(about_x) == pytest.approx(0, abs=1e-9)
    near = target_poses.Seen(about_x[0].views, rigid.moved(about_x[0].world_from_target, [0, 0, 0, 0, 0, -30]))
    assert target_poses.range_mm([*about_x, near]) == pytest.approx(30)


def test_what_is_missing_is_named(cameras, rig, rng):
    pairs = target_pairs.many(cameras, rig.target, 10, rng)
    with pytest.raises(InputError, match=r"film: expected 8 different poses.* found 3, 9 pairs without a pose"):
        target_poses.check(pairs[:3], "film", target_poses.Collected(faults={"without a pose": 9}), 5, 20)
    two = target_poses.Collected(faults={"without a pose": 9}, apart_mm=(None, np.inf, 70.0))
    with pytest.raises(InputError, match=r"9 pairs without a pose, and a second target of this design: cover it$"):
        target_poses.check(pairs[:3], "film", two, 5, 20)
    flat = [at(pairs[0], 3.0 * k) for k in range(10)]
    with pytest.raises(
        InputError, match=r"expected tilts that differ by 5 deg .* found .*: turn .* set least_tilt_deg"
    ) as caught:
        target_poses.check(flat, "film", target_poses.Collected(), 5, 20)
    assert "distances over 20 mm, found 0" in str(caught.value)
    target_poses.check(flat, "film", target_poses.Collected(), 0, 0)
    target_poses.check(pairs, "film", target_poses.Collected(), 5, 20)


def test_pairs_that_are_not_whole_are_not_taken(cameras):
    nothing = views.nothing("no rim", 3)
    assert target_poses.whole(Tracking(pose_fit.lost("none"), (nothing, nothing)), cameras) == "without a pose"
