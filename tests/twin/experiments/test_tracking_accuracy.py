"""How findings are scored, on findings that are made up."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from recon.geometry import rigid
from recon.geometry.ellipses import Ellipses
from recon.geometry.rigid import difference
from recon.tracking import views
from tests.twin.tracking.takes import facing, plain_take, ranges, rig, rig_of_three
from twin.experiments import rivals, tracking_reach
from twin.experiments.detection_rates import percent, score
from twin.experiments.experiment_setup import Setup
from twin.experiments.pose_accuracy import centre_limit, pose_errors
from twin.experiments.tracking_frames import several
from twin.tracking.target_truth import view_truth

RIG = rig()
TAKE = plain_take(facing())
TRUTH = replace(view_truth(TAKE, RIG.cam1, 0.0, RIG.target), visible=np.ones(3), white_dn=100.0)


def found(centres: np.ndarray) -> views.View:
    nothing = views.nothing("nothing", 3)
    outlines = replace(nothing.outlines, ellipses=Ellipses(centres, np.tile(40.0 * np.eye(2), (3, 1, 1))))
    return views.View(outlines)


def test_right_exchanged_and_other_circles_are_told_apart():
    centres = TRUTH.ellipses[:, :2]
    right = score(found(centres + 1.0), TRUTH, True)
    assert right.shows_target and right.found and right.right and not right.exchanged
    swapped = score(found(centres[[1, 0, 2]]), TRUTH, True)
    assert swapped.exchanged and not swapped.right
    elsewhere = score(found(centres + 200.0), TRUTH, True)
    assert elsewhere.found and not elsewhere.right and not elsewhere.exchanged
    missed = score(views.nothing("dark", 3), TRUTH, True)
    assert missed.shows_target and not missed.found and not missed.right


def test_a_hidden_or_cut_target_is_not_asked_for():
    hidden = score(views.nothing("", 3), replace(TRUTH, visible=np.array([1, 0.4, 1])), True)
    assert not hidden.shows_target and not hidden.covered
    partly = score(views.nothing("", 3), replace(TRUTH, visible=np.array([1, 0.7, 1])), True)
    assert partly.covered and not partly.shows_target
    assert not score(views.nothing("", 3), replace(TRUTH, inside=np.array([True, False, True])), True).shows_target
    empty = score(found(TRUTH.ellipses[:, :2]), TRUTH, False)
    assert empty.empty and empty.found and not empty.right and not empty.shows_target


def test_shares():
    assert percent([True, False, False, True]) == 50
    assert np.isnan(percent([]))


def test_errors_of_a_pose_are_its_shift_and_turn():
    pose = TAKE.motion.world_from_target
    off = rigid.from_rotation_vector([0, 0.01, 0], [0, 0, 0]) @ pose
    off[:3, 3] = pose[:3, 3] + [0.03, 0.04, 0]
    assert pose_errors(TAKE, off) == pytest.approx((0.05, np.rad2deg(0.01)))
    assert difference(pose, off) == pytest.approx([0, 0.01, 0, 0.03, 0.04, 0], abs=1e-9)
    assert pose_errors(TAKE, None) is None


def test_the_limit_of_a_centre_is_what_least_squares_on_an_edge_leaves(rng):
    """Against the Fisher information of a drawn disc's centre, summed over its pixels."""
    limit = centre_limit(TAKE, 0, TRUTH, RIG.target)[0]
    radius = float(np.sqrt(TRUTH.ellipses[0, 2] * TRUTH.ellipses[0, 3]))
    v, u = np.mgrid[-90:91, -90:91]
    sigma = np.sqrt(RIG.cam1.lens.blur_px**2 + 1 / 12)
    away = np.hypot(u, v)
    contrast = 100.0 * (1 - TAKE.face.ink / TAKE.face.paper)
    slope = contrast / np.sqrt(2 * np.pi) / sigma * np.exp(-((away - radius) ** 2) / 2 / sigma**2)
    information = np.sum((slope * u / np.maximum(away, 1)) ** 2)
    electrons = np.array([100.0, 100.0 * TAKE.face.ink / TAKE.face.paper]) * 7700 / 253
    noise = np.sqrt(np.mean((253 / 7700) ** 2 * (electrons + RIG.cam1.sensor.dark_noise_e**2)) + 1 / 12)
    assert limit == pytest.approx(np.sqrt(2) * noise / np.sqrt(information), rel=0.03)


def test_rivals_are_summed_up_over_the_grid_and_drawn(tmp_path):
    """One that finds half of what isn't dark, twice as far off where it is blurred."""
    shift = np.full((len(rivals.WHITES), len(rivals.BLURS), 4), np.nan)
    shift[2:, :, :2] = 0.1
    shift[2:, 3:] *= 2
    tried = rivals.Tried("half", shift, 3 * shift)
    assert list(rivals.summary(tried).values()) == pytest.approx([100 * 3 / 10, 0, 100 * 3 / 10, 0.1, 0.3])
    nothing = rivals.Tried("nothing", np.full_like(shift, np.nan), np.full_like(shift, np.nan))
    assert list(rivals.summary(nothing).values()) == [0, 0, 0]
    rivals.draw([tried, nothing], tmp_path / "rivals.png")
    assert cv2.imread(str(tmp_path / "rivals.png")).shape[1] > 600


@pytest.mark.slow
def test_drawn_rigs_of_any_resolution_are_tracked(monkeypatch):
    """Four of the experiment's rigs, of up to 1.3 MP: all are found, and none wrongly; of 60 of all sizes all were."""
    monkeypatch.setattr(tracking_reach, "VARIANTS", 2)  # of bodies, which take as long as the frames
    setup = Setup(RIG, {}, frames=ranges(variants=2))
    assert tracking_reach.drawn_rigs(setup, 4, 1_400_000) == {"pairs": 4, "found_percent": 100.0, "wrong": 0}


@pytest.mark.slow
def test_several_bodies_are_rendered_as_drawn():
    """Pair k is the same alone and among others; both views see all circles whole, about as bright as asked."""
    setup = Setup(rig_of_three(), frames=ranges())
    first = [frames for _, frames in several(setup, 4, 2, (50.0, 50.0), (0.0, 6.0))]
    take, again = next(several(setup, 4, 1, (50.0, 50.0), (0.0, 6.0)))
    assert list(again.bodies) == list(take.held) == ["probe", "needle", "patient"]
    for view, same in zip(first[0].views, again.views, strict=True):
        assert (view == same).all()
    for both in (both for frames in first for both in frames.bodies.values()):
        for truth in both:
            assert truth.visible.min() > 0.99 and truth.inside.all() and 20 < truth.white_dn < 90
