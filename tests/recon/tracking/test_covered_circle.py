"""A circle that is covered is looked for, and found, where the other two of its view ask for it."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from recon.geometry import rigid
from recon.geometry.ellipses import Ellipses
from recon.tracking import covered_circle, pose, rims
from recon.tracking.pose_fit import TargetPose
from recon.tracking.tracker import Tracker
from tests.recon.tracking import drawings


@pytest.fixture(scope="module")
def cameras(rig):
    return rig.cam1.optics.camera(), rig.cam2.optics.camera()


def painted(image, part, level, rng):
    """With something of a brightness over a part : (h, w) bool."""
    image = image.copy()
    image[part] = np.clip(level + 2 * rng.standard_normal(part.sum()), 0, 255).astype(np.uint8)
    return image


def crossed(image, ellipse, rng):
    """With a cable of 25 DN over an ellipse, which hides its white middle."""
    u = np.arange(image.shape[1])[None]
    v = np.arange(image.shape[0])[:, None]
    radius = np.sqrt(np.linalg.det(ellipse.shape[0]))
    cable = (np.abs(u - ellipse.centre[0, 0]) < 0.45 * radius) & (np.abs(v - ellipse.centre[0, 1]) < 1.8 * radius)
    return painted(image, cable, 25, rng)


def followed(cameras, target, place, frames):
    tracker = Tracker(cameras, target)
    tracker.remember(place, 0.0)
    return tracker.step(*frames, time_s=0.02)


@pytest.mark.parametrize("which", [0, 1, 2])
def test_the_third_place_follows_from_two_discs(cameras, rig, rng, which):
    """As far as a view is affine: perspective across the target is the rest."""
    away = []
    for _ in range(20):
        true = drawings.shown(cameras[0], drawings.facing(rng), rig.target)
        told = covered_circle.further(true, np.arange(3) != which, which, rig.target)
        away.append(np.linalg.norm(told.centre[0] - true.centre[which]))
        assert np.abs(told.shape[0] - true.shape[which]).max() < 0.15 * np.trace(true.shape[which]) / 2
    assert np.median(away) < 5 and max(away) < 10


def test_two_discs_as_far_apart_as_others_tell_no_third(cameras, rig, rng):
    """c0 and c2 are 40 mm apart, c0 and c1 25."""
    true = drawings.shown(cameras[0], drawings.facing(rng), rig.target)
    assert np.isnan(covered_circle.further(true[np.array([0, 2, 1])], np.arange(3) != 1, 1, rig.target).centre).all()


@pytest.mark.parametrize("which", [0, 1, 2])
def test_a_target_with_a_middle_that_is_hidden_is_found(cameras, rig, rng, which, monkeypatch):
    """In both views, by looking again; without that it isn't."""
    place = drawings.facing(rng, 25.0)
    clear = [drawings.frame(camera, [place], rig.target, 80.0, rng) for camera in cameras]
    ellipses = [drawings.shown(camera, place, rig.target)[[which]] for camera in cameras]
    frames = [crossed(frame, one, rng) for frame, one in zip(clear, ellipses, strict=True)]
    found = followed(cameras, rig.target, place, frames)
    assert found.found, found.pose.reason
    assert all(0.4 < view.outlines.seen[which] < 0.8 for view in found.views)
    error = found.pose.world_from_target[:3, 3] - place[:3, 3]
    assert np.linalg.norm(error) < 0.1
    assert error @ np.linalg.solve(found.pose.covariance[3:, 3:], error) < 20
    monkeypatch.setattr(covered_circle, "completed", lambda image, outlines, target: outlines)
    monkeypatch.setattr(covered_circle, "sought_again", lambda *_: ())
    assert "no white middle" in followed(cameras, rig.target, place, frames).pose.reason


def halved(image, ellipse, level, rng):
    """With something over more than half of an ellipse, to one side, and over what is around it there."""
    angle, radius = rng.uniform(0, 2 * np.pi), np.sqrt(np.linalg.det(ellipse.shape[0]))
    left, top = np.maximum(np.floor(ellipse.centre[0] - 1.5 * radius), 0).astype(int)
    about = np.s_[top : top + int(3 * radius) + 2, left : left + int(3 * radius) + 2]
    v, u = np.mgrid[about]
    hidden = np.zeros(image.shape, bool)
    part = hidden[about]
    x, y = (axis[: part.shape[0], : part.shape[1]] for axis in (u - ellipse.centre[0, 0], v - ellipse.centre[0, 1]))
    part[:] = (x * np.cos(angle) + y * np.sin(angle) > -0.1 * radius) & (np.hypot(x, y) < 1.4 * radius)
    return painted(image, hidden, level, rng)


def test_a_known_shape_steadies_a_rim_of_which_half_is_covered(cameras, rig, rng):
    """In the dark, with shapes that are off by 0.3 % and known to be: centres are more exact, and as exact as they say."""
    errors, squared = {0.003: [], np.inf: []}, []
    for _ in range(14):
        place = drawings.facing(rng, 25.0)
        one = drawings.shown(cameras[0], place, rig.target)[[1]]
        image = halved(drawings.frame(cameras[0], [place], rig.target, 6.0, rng), one, 3.5, rng)
        size = np.trace(one.shape[0]) / 2
        a, b, c = 0.003 * size * rng.standard_normal(3)
        rough = Ellipses(one.centre + rng.uniform(-3, 3, (1, 2)), one.shape + np.array([[a, b], [b, c]]))
        for known, found in errors.items():
            rim = rims.measure_covered(image, rough, 8.0, rims.Known(np.inf, known), rig.target)
            off = rim.ellipses.centre[0] - one.centre[0]
            found.append(np.linalg.norm(off))
            if known == 0.003:
                squared.append(off @ np.linalg.solve(rim.covariance[0], off))
    assert 1.5 * np.median(errors[0.003]) < np.median(errors[np.inf])
    assert np.mean(np.array(squared) < chi2.ppf(0.95, 2)) > 0.85


def test_shapes_of_the_others_are_not_trusted_too_far(cameras, rig, rng, monkeypatch):
    """Perspective takes them from the covered one's: trusted to 3.5 %, more rims are found, and as exactly; to 1 % it would bend
    them."""
    errors = {covered_circle.SHAPE: [], 1e6: []}
    for _ in range(12):
        place = drawings.facing(rng, 25.0)
        true = drawings.shown(cameras[0], place, rig.target)
        image = halved(drawings.frame(cameras[0], [place], rig.target, 6.0, rng), true[[1]], 3.5, rng)
        seen = rims.measure(image, true, 3.0, rig.target)
        seen = replace(seen, reasons=(seen.reasons[0], "covered", seen.reasons[2]))
        for known, off in errors.items():
            monkeypatch.setattr(covered_circle, "SHAPE", known)
            again = covered_circle.completed(image, seen, rig.target)
            off.append(np.linalg.norm(again.ellipses.centre[1] - true.centre[1]) if again.found[1] else np.nan)
    trusted, free = (np.array(off) for off in errors.values())
    assert np.isfinite(trusted).sum() >= max(np.isfinite(free).sum(), 11)
    assert np.nanmedian(trusted) < 1.3 * np.nanmedian(free)


def test_one_camera_is_enough_for_half_a_rim_if_it_is_exact(cameras, rig, rng):
    """What looks like a rim may be the edge of what covers it: one camera's ellipses must be those that a pose gives them."""
    found, off = [], []
    for _ in range(8):
        place = drawings.facing(rng, 25.0)
        true = drawings.shown(cameras[0], place, rig.target)
        image = halved(drawings.frame(cameras[0], [place], rig.target, 80.0, rng), true[[1]], 45, rng)
        half = followed(cameras, rig.target, place, (image, np.full_like(image, 40))).views[0]
        found.append(half.found)
        off.append(np.linalg.norm(half.outlines.ellipses.centre[1] - true.centre[1]))
    found, off = np.array(found), np.array(off)
    assert found.mean() > 0.7 and off[found].max() < 3.0
    assert not found[off > 3.0].any()


@pytest.mark.parametrize(("away", "fewest", "most"), [(1, 0.9, 1.0), (8, 0.0, 0.05)])
def test_a_rim_that_is_covered_must_have_the_shape_of_a_pose(cameras, rig, rng, away, fewest, most):
    """One camera's, too large by some standard deviations: by one it is what noise does, by many it is another thing's edge."""
    allowed, covered = [], np.array([False, True, False])
    for _ in range(12):
        place = drawings.facing(rng, 25.0)
        frame = drawings.frame(cameras[0], [place], rig.target, 80.0, rng)
        seen = rims.measure(frame, drawings.shown(cameras[0], place, rig.target), 3.0, rig.target)
        seen.joint[1] += 0.25 * np.eye(5)
        seen.ellipses.shape[1] += away * 0.5 * np.eye(2)
        allowed.append(pose.allowed(seen.sighting(cameras[0]), covered, rig.target))
    assert fewest <= np.mean(allowed) <= most


@pytest.mark.parametrize("level", [15, 37])
def test_a_fingertip_near_a_rings_place_is_not_taken_for_it(cameras, rig, rng, level):
    """As large as a disc and a millimetre from where c2 should be: skin isn't ink, and one as dark as ink is off."""
    for _ in range(2):
        place, angle, frames = drawings.facing(rng, 25.0), rng.uniform(0, 2 * np.pi), []
        aside = rigid.transform(np.eye(3), np.array([np.cos(angle), np.sin(angle), 0]))
        for camera in cameras:
            image = drawings.frame(camera, [place], rig.target, 80.0, rng)
            for at, size in ((place, 1.0), (place @ aside, 1.03)):
                one = drawings.shown(camera, at, rig.target)[[2]]
                v, u = np.ogrid[:1024, :1280]
                (a, b), (_, d) = np.linalg.inv(one.shape[0] * size)
                x, y = u - one.centre[0, 0], v - one.centre[0, 1]
                inside = (a * x + b * y) ** 2 + (b * x + d * y) ** 2 < 1
                image = painted(image, inside, level if size > 1 else 80, rng)
            frames.append(image)
        found = followed(cameras, rig.target, place, frames)
        assert not any(view.found for view in found.views)


def inked(image, one, rng):
    """With a cable as dark as ink along a side of an ellipse, in noise of 12 DN: its far edge, 4 px beyond, looks like a rim."""
    radius, angle = np.sqrt(np.linalg.det(one.shape[0])), rng.uniform(0, 2 * np.pi)
    v, u = np.ogrid[: image.shape[0], : image.shape[1]]
    across = (u - one.centre[0, 0]) * np.cos(angle) + (v - one.centre[0, 1]) * np.sin(angle)
    crossed = painted(image, (across > 0.4 * radius) & (across < 1.08 * radius), 5, rng)
    return np.clip(crossed + 12 * rng.standard_normal(image.shape, np.float32), 0, 255).astype(np.uint8)


def test_a_rim_that_is_held_is_not_bent_by_an_edge_beside_it(cameras, rig, rng):
    """It is as exact as it says, where the free one takes a part of that edge for its own."""
    free, held, squared = [], [], []
    for _ in range(10):
        place = drawings.facing(rng, 25.0)
        true = drawings.shown(cameras[0], place, rig.target)
        image = inked(drawings.frame(cameras[0], [place], rig.target, 80.0, rng), true[[0]], rng)
        seen = rims.measure(image, true, 3.0, rig.target).without([0])
        told = TargetPose(place, 1e-9 * np.eye(6), 0.0)
        again = covered_circle._sought(image, seen, cameras[0], told, rig.target)
        off = again.ellipses.centre[0] - true.centre[0]
        squared.append(off @ np.linalg.solve(again.covariance[0], off))
        held.append(np.linalg.norm(off))
        free.append(np.linalg.norm(seen.ellipses.centre[0] - true.centre[0]))
    assert max(free) > 1.5 and np.mean(free) > 2 * np.mean(held)
    assert max(held) < 1.0
    assert max(squared) < chi2.ppf(0.999, 2)


def test_what_was_known_of_a_rim_is_not_widened_with_its_noise(rng):
    """An image of no use, a hundred times as noisy as it seems, leaves what was known before."""
    before = np.array([[4.0, 4.0, 100.0, 100.0, 100.0]])
    seen = rng.standard_normal((1, 5, 5))
    seen = seen @ np.swapaxes(seen, 1, 2) + np.eye(5)
    both = np.linalg.inv(seen + before[:, :, None] * np.eye(5))
    wide = rims._widened(both, np.array([1e6]), before)
    assert np.allclose(np.diagonal(wide[0]), 1 / before[0], rtol=1e-4)
    assert np.allclose(rims._widened(both, np.array([1.0]), before), both)


def test_rims_that_are_bent_in_both_views_are_found_again(cameras, rig, rng, monkeypatch):
    """The other circles tell the pose, and that where they are: most that isn't found at first is, most as exactly as it says.

    A rim bent by the edge beside it isn't always noticed: of 16 poses in three draws 6 were 8 to 10 standard deviations off.
    """
    second_look, squared, missed = covered_circle.sought_again, [], 0
    for _ in range(6):
        place, which = drawings.facing(rng, 25.0), rng.integers(3)
        ones = [drawings.shown(camera, place, rig.target)[[which]] for camera in cameras]
        clear = [drawings.frame(camera, [place], rig.target, 80.0, rng) for camera in cameras]
        frames = [inked(frame, one, rng) for frame, one in zip(clear, ones, strict=True)]
        monkeypatch.setattr(covered_circle, "sought_again", lambda *_: ())
        if followed(cameras, rig.target, place, frames).found:
            continue
        missed += 1
        monkeypatch.setattr(covered_circle, "sought_again", second_look)
        found = followed(cameras, rig.target, place, frames).pose
        if found.found:
            error = rigid.difference(place, found.world_from_target)
            squared.append(error @ np.linalg.solve(found.total, error))
    assert missed >= 2 and len(squared) >= 0.7 * missed
    assert np.mean(np.array(squared) < chi2.ppf(0.9999, 6)) >= 0.5 and max(squared) < 150


def test_the_target_is_not_half_a_turn_away(cameras, rig, rng):
    """Of two circles a view, whose third is wholly covered, there are two poses, and nothing tells which one it is."""
    place, rims_seen = drawings.facing(rng, 25.0), []
    frames = [drawings.frame(camera, [place], rig.target, 80.0, rng) for camera in cameras]
    for camera, frame in zip(cameras, frames, strict=True):
        seen = rims.measure(frame, drawings.shown(camera, place, rig.target), 3.0, rig.target)
        rims_seen.append(seen.without([2]))
    blank = [np.full_like(frame, 60) for frame in frames]
    assert not any(covered_circle.sought_again(blank, rims_seen, cameras, rig.target))
    (again,) = next(covered_circle.sought_again(frames, rims_seen, cameras, rig.target))
    assert all(outlines.found.all() for outlines in again)


@pytest.mark.parametrize("unseen", [0, 1, 2])
def test_two_discs_tell_their_names_by_their_distance(cameras, rig, rng, unseen):
    """25 mm or 40 mm: under other names they are renamed, under their own they keep them."""
    for _ in range(3):
        place = drawings.facing(rng, 15.0)
        frame = drawings.frame(cameras[0], [place], rig.target, 80.0, rng)
        seen = rims.measure(frame, drawings.shown(cameras[0], place, rig.target), 3.0, rig.target).without([unseen])
        assert covered_circle.by_distance(seen, rig.target).reasons == seen.reasons
        if unseen != 0:
            other = seen[np.array([0, 2, 1])]
            assert covered_circle.by_distance(other, rig.target).reasons == seen.reasons


@pytest.mark.parametrize("which", [[0, 0], [1, 1], [2, 2], [0, 1], [2, 1]])
def test_the_third_place_follows_from_two_circles_of_each_view(cameras, rig, rng, which):
    """Under one naming, to a pixel; half a turn away there is another pose where it is the same circle that is missing."""
    for _ in range(2):
        place, halves = drawings.facing(rng, 25.0), []
        for camera, k in zip(cameras, which, strict=True):
            frame = drawings.frame(camera, [place], rig.target, 80.0, rng)
            seen = rims.measure(frame, drawings.shown(camera, place, rig.target), 3.0, rig.target)
            halves.append(replace(seen, reasons=tuple("covered" if k == j else None for j in range(3))))
        poses = [found.world_from_target for _, found in covered_circle.named_poses(halves, cameras, rig.target)]
        assert 1 <= len(poses) <= 2
        expected = [drawings.shown(cameras[0], found, rig.target).centre for found in poses]
        off = [np.linalg.norm(one - drawings.shown(cameras[0], place, rig.target).centre, axis=1).max() for one in expected]
        assert min(off) < 1.0
        assert len(poses) == 1 or max(off) > 20


@pytest.mark.parametrize("which", [0, 1, 2])
def test_a_circle_that_is_covered_in_both_views_is_found_by_a_second_look(cameras, rig, rng, which, monkeypatch):
    """By a dark finger over its middle; without that look, and where nothing of it is seen, there is no pose."""

    def covered(hidden):
        place = drawings.facing(rng, 25.0)
        frames = []
        for camera in cameras:
            one = drawings.shown(camera, place, rig.target)[[which]]
            frames.append(hidden(drawings.frame(camera, [place], rig.target, 80.0, rng), one))
        return place, frames

    def in_part(image, one):
        radius, angle = np.sqrt(np.linalg.det(one.shape[0])), rng.uniform(0, 2 * np.pi)
        v, u = np.ogrid[: image.shape[0], : image.shape[1]]
        x, y = u - one.centre[0, 0], v - one.centre[0, 1]
        along, across = x * np.cos(angle) + y * np.sin(angle), y * np.cos(angle) - x * np.sin(angle)
        finger = (np.abs(across) < 0.6 * radius) & (along > -0.6 * radius) & (along < 2 * radius)
        return painted(image, finger, 16, rng)

    def wholly(image, one):
        radius = np.sqrt(np.linalg.det(one.shape[0]))
        v, u = np.ogrid[: image.shape[0], : image.shape[1]]
        return painted(image, np.hypot(u - one.centre[0, 0], v - one.centre[0, 1]) < 1.6 * radius, 45, rng)

    seen = [covered(in_part) for _ in range(4)]
    results = [(place, followed(cameras, rig.target, place, frames)) for place, frames in seen]
    found = [(place, result.pose) for place, result in results if result.found]
    assert len(found) >= 3
    for place, each in found:
        error = rigid.difference(place, each.world_from_target)
        assert error @ np.linalg.solve(each.total, error) < chi2.ppf(0.9999, 6)
    assert not any(followed(cameras, rig.target, *covered(wholly)).found for _ in range(2))
    monkeypatch.setattr(covered_circle, "sought_again", lambda *_: ())
    assert sum(followed(cameras, rig.target, place, frames).found for place, frames in seen) < len(found)
