"""Poses that a person is asked for have room in all views, and are sharp and not too oblique there."""

from dataclasses import replace

import numpy as np
import pytest

from recon.board_detection.kinds.asymmetric_circles import AsymmetricCircles
from recon.board_detection.kinds.charuco import Charuco
from recon.board_detection.kinds.chessboard import Chessboard
from recon.board_detection.kinds.symmetric_circles import SymmetricCircles
from recon.board_guidance import board_room
from recon.board_guidance.board_room import PoseLimits, candidates, fits, middles, outline, reach_of
from recon.errors import InputError
from recon.geometry import rigid
from tests.recon.board_guidance.held_boards import posed
from tests.recon.board_sets import BOARD, devices


def test_all_devices_see_all_points_of_candidates(rig, rng):
    reach = reach_of(rig)
    poses = candidates(BOARD, devices(rig), reach, 100, rng)
    assert len(poses) == 100
    for pose in poses:
        for camera in devices(rig).values():
            pixels = camera.project(rigid.apply(pose, BOARD.points()))
            assert (pixels > reach.margin_px).all() and (pixels < np.array(camera.size) - 1 - reach.margin_px).all()
    assert np.rad2deg(np.arccos(poses[:, 2, 2])).max() < reach.tilt_deg + 1e-6


def test_candidates_fill_the_views(rig, rng):
    """Near and far, in all quarters of camera 1's view, straight and tilted to all sides."""
    poses = candidates(BOARD, devices(rig), reach_of(rig), 200, rng)
    at = middles(poses, BOARD)
    assert len(set(np.round(at[:, 2]))) == board_room.LEVELS
    assert {(x > 0, y > 0) for x, y in at[:, :2]} == {(a, b) for a in (True, False) for b in (True, False)}
    assert {(x > 0.1, y > 0.1) for x, y in poses[:, :2, 2]} == {(a, b) for a in (True, False) for b in (True, False)}


def test_a_board_outside_one_view_or_seen_from_the_side_does_not_fit(rig):
    reach, cameras = reach_of(rig), devices(rig)
    poses = np.array([posed((0, 0, 660)), posed((150, 0, 660)), posed((0, 0, 660), (0, 70)), posed((0, 0, 660), (0, 180))])
    assert fits(poses, BOARD, cameras, reach).tolist() == [True, False, False, False]


def test_a_board_larger_than_the_views_is_refused_with_the_way_on(rig, rng):
    large = AsymmetricCircles(columns=4, rows=11, spacing_mm=60, diameter_mm=30)
    with pytest.raises(InputError, match="smaller board"):
        candidates(large, devices(rig), reach_of(rig), 10, rng)


def test_depths_end_where_a_lens_blurs_too_much(rig):
    """At both ends the worst device has just the allowed disc of confusion, by the thin lens's exact formula."""
    for z in reach_of(rig).depth_mm:
        shares = []
        for part, most in ((rig.cam1, 2.5), (rig.cam2, 2.5), (rig.projector, 5.0)):
            f, focus = part.lens.focal_length_mm, part.lens.focus_mm
            disc_mm = part.lens.aperture_mm * f * abs(z - focus) / (z * (focus - f))  # on the sensor
            pitch_mm = f / part.optics.focal_px[0]
            shares.append(disc_mm / pitch_mm / most)
        assert max(shares) == pytest.approx(1, abs=0.05)  # focal_px is that of the focused lens, f that at infinity


def test_lenses_focused_apart_are_refused(rig):
    lens = rig.projector.lens.model_copy(update={"focus_mm": 2000.0})
    apart = rig.model_copy(update={"projector": rig.projector.model_copy(update={"lens": lens})})
    with pytest.raises(InputError, match="focus_mm"):
        reach_of(apart)


def test_depths_that_are_given_stand_for_those_of_the_lenses(rig):
    """Lenses that are described as focused apart don't matter then."""
    lens = rig.projector.lens.model_copy(update={"focus_mm": 2000.0})
    apart = rig.model_copy(update={"projector": rig.projector.model_copy(update={"lens": lens})})
    given = reach_of(apart, PoseLimits(depth_mm=(500, 800), volume_mm=(600, 700), tilt_deg=20))
    assert (given.depth_mm, given.volume_mm, given.tilt_deg) == ((500, 800), (600, 700), 20)
    assert reach_of(rig, PoseLimits(depth_mm=(500, 800))).volume_mm == reach_of(rig).volume_mm


@pytest.mark.parametrize("board", [BOARD, Chessboard(columns=7, rows=5, square_mm=20)])
def test_the_outline_runs_around_all_points(board):
    rim, points = outline(board), board.points()
    assert (rim.min(axis=0)[:2] < points.min(axis=0)[:2]).all() and (rim.max(axis=0)[:2] > points.max(axis=0)[:2]).all()
    x, y, _ = rim.T
    area = abs(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1))) / 2
    assert area == pytest.approx(np.prod(np.ptp(rim, axis=0)[:2]))  # of a closed rectangle, its points in order


def test_boards_that_half_a_turn_leaves_alike():
    assert not BOARD.half_turn_is_alike
    assert BOARD.model_copy(update={"rows": 10}).half_turn_is_alike
    assert SymmetricCircles(columns=5, rows=4, spacing_mm=10, diameter_mm=5).half_turn_is_alike
    assert Chessboard(columns=7, rows=5, square_mm=10).half_turn_is_alike
    assert not Chessboard(columns=7, rows=6, square_mm=10).half_turn_is_alike
    assert not Charuco(columns=7, rows=5, square_mm=10, marker_mm=7).half_turn_is_alike


def test_margins_keep_candidates_from_the_borders(rig, rng):
    wide = replace(reach_of(rig), margin_px=80)
    for pose in candidates(BOARD, devices(rig), wide, 30, rng):
        pixels = devices(rig)["cam2"].project(rigid.apply(pose, outline(BOARD)))
        assert pixels.min() >= 80
