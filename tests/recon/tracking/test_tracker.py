"""The tracker finds, follows and loses a drawn target, and says why where it isn't found."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from recon.geometry import rigid
from recon.geometry.camera import Camera
from recon.geometry.ellipses import Ellipses
from recon.model import circle_layout
from recon.tracking import networks, overlays, photographs, results, track_figures, views
from recon.tracking import tracker as tracking
from recon.tracking.rims import Outlines
from recon.tracking.tracker import Tracker
from tests.recon.tracking import drawings
from tests.recon.tracking.stand_ins import Told

FACING = rigid.transform(
    np.diag([1.0, -1.0, -1.0]) @ Rotation.from_euler("xyz", [8, -12, 30], degrees=True).as_matrix(), [0, 20, 660]
)


@pytest.fixture(scope="module")
def cameras(rig):
    return rig.cam1.optics.camera(), rig.cam2.optics.camera()


def centres(camera, place, target):
    return camera.project(rigid.apply(place, circle_layout.circle_centres(target)))


@pytest.fixture(scope="module")
def pair(cameras, rig):
    rng = np.random.default_rng(7)
    return [drawings.frame(camera, [FACING], rig.target, 65.0, rng) for camera in cameras]


@pytest.fixture
def told(cameras, rig):
    return Told([centres(camera, FACING, rig.target) for camera in cameras])


@pytest.fixture
def tracker(cameras, rig, told):
    return Tracker(cameras, rig.target, told)


def off_mm(found, place=FACING):
    return np.linalg.norm(found.pose.world_from_target[:3, 3] - place[:3, 3])


def test_it_detects_then_follows_without_a_network(tracker, pair, told):
    first = tracker.step(*pair)
    assert first.found, first.pose.reason
    assert first.how == "detected"
    second = tracker.step(*pair)  # in which a second target is looked for, once
    assert second.how == tracker.step(*pair).how == "predicted" and (told.detections, told.segmentations) == (2, 1)
    for found in (first, second):
        assert off_mm(found) < 0.05
        assert all(view.found and 0 <= view.blur_px.max() < 1.5 for view in found.views)


def test_it_follows_a_moving_target_as_a_track(tracker, cameras, rig, rng, told):
    """400 mm/s and a turn of 200 deg/s, at 60 frames/s."""
    places = []
    for k in range(4):
        turn = Rotation.from_rotvec([0, 0, np.radians(200) * k / 60]).as_matrix()
        places.append(rigid.transform(turn @ FACING[:3, :3], FACING[:3, 3] + np.array([300.0, 200, 150]) * k / 60))
    found = []
    for k, place in enumerate(places):
        frames = (drawings.frame(camera, [place], rig.target, 65.0, rng) for camera in cameras)
        found.append(tracker.step(*frames, k / 60))
    assert [each.pose.reason for each in found] == [None] * 4
    assert [each.how for each in found][2:] == ["predicted"] * 2
    track = results.track_of([results.kept(each, k * 16_666_667) for k, each in enumerate(found)])
    assert track.found.all() and track.covariance is not None
    assert max(off_mm(each, place) for each, place in zip(found, places, strict=True)) < 0.1


def test_wrong_names_are_put_right_by_geometry(cameras, rig, pair):
    """A network that turns all names round, the same in both views or not."""
    for names in ((1, 2, 0), (2, 0, 1), (0, 2, 1), (3, 3, 3)):
        found = Tracker(cameras, rig.target, Told([centres(camera, FACING, rig.target) for camera in cameras], names=names)).step(
            *pair
        )
        assert not found.found or off_mm(found) < 0.05
        assert found.found or names == (0, 2, 1), found.pose.reason


def test_false_candidates_do_not_distract(cameras, rig, pair, rng):
    places = [np.vstack([centres(camera, FACING, rig.target), rng.uniform(50, 950, (6, 2))]) for camera in cameras]
    found = Tracker(cameras, rig.target, Told(places, names=(0, 1, 2, 0, 1, 2, 3, 3, 3))).step(*pair)
    assert found.found and off_mm(found) < 0.05


@pytest.mark.parametrize("left_out", [0, 1, 2])
def test_two_candidates_a_view_are_enough(cameras, rig, pair, left_out):
    """The third is looked for where these two ask for it."""
    names = [k for k in range(3) if k != left_out]
    found = Tracker(cameras, rig.target, Told([centres(c, FACING, rig.target)[names] for c in cameras], names=names)).step(*pair)
    assert found.found and off_mm(found) < 0.05, found.pose.reason


@pytest.mark.parametrize(("seen", "names"), [([0, 2], [0, 1]), ([0, 1], [1, 0]), ([1, 2], [2, 1]), ([0, 2], [1, 0])])
def test_two_candidates_under_wrong_names_are_enough(cameras, rig, pair, seen, names):
    """Their distance tells which two they are, and the third where it is seen the end."""
    told = Told([centres(camera, FACING, rig.target)[seen] for camera in cameras], names=names)
    found = Tracker(cameras, rig.target, told).step(*pair)
    assert found.found and off_mm(found) < 0.05, found.pose.reason


def test_one_view_is_enough_to_detect_it(cameras, rig, pair):
    """It tells where to look in the other."""
    places = [centres(camera, FACING, rig.target) for camera in cameras]
    for known in ([places[0], []], [[], places[1]]):
        found = Tracker(cameras, rig.target, Told(known)).step(*pair)
        assert found.found and off_mm(found) < 0.05, found.pose.reason


def covered(image, place):
    """With a hand over the whole of the circle at a place."""
    v, u = np.mgrid[:1024, :1280]
    return np.where(np.hypot(u - place[0], v - place[1]) < 62, np.uint8(30), image)


@pytest.mark.parametrize("which", [0, 1, 2])
def test_a_circle_that_one_camera_does_not_see_is_told_by_the_pose(cameras, rig, pair, which):
    """Found from nothing, and followed; not if the other camera doesn't see it either."""
    hidden = covered(pair[1], centres(cameras[1], FACING, rig.target)[which])
    tracker = Tracker(cameras, rig.target, Told([centres(camera, FACING, rig.target) for camera in cameras]))
    for how in ("detected", "predicted"):
        found = tracker.step(pair[0], hidden)
        assert found.found and found.how == how, found.pose.reason
        assert off_mm(found) < 0.05 and found.pose.freedom == 4
        view = found.views[1]
        assert view.found and not view.outlines.found[which]
        true = drawings.shown(cameras[1], FACING, rig.target)
        assert np.abs(view.outlines.ellipses.centre - true.centre).max() < 0.3
        assert np.isfinite(results.kept(found, 0).blur_px).all()
    neither = tracker.step(covered(pair[0], centres(cameras[0], FACING, rig.target)[which]), hidden)
    assert not neither.found and str(neither.pose.reason).count(f"c{which}: ") == 2, neither.pose.reason


def shifted(found: Outlines, which: int, by, doubtful: bool) -> Outlines:
    """With one rim that was fitted beside its place."""
    some = np.arange(len(found.reasons)) == which
    ellipses = Ellipses(found.ellipses.centre + some[:, None] * by, found.ellipses.shape)
    return replace(found, ellipses=ellipses, doubtful=found.doubtful | (some & doubtful))


@pytest.mark.parametrize("doubtful", [True, False])
def test_a_doubtful_rim_that_is_off_is_told_by_the_pose(cameras, rig, pair, monkeypatch, doubtful):
    """Half a pixel: the other five tell the pose, and that where it is; a rim that nothing speaks against spoils the frame."""
    tracker = Tracker(cameras, rig.target.model_copy(update={"tolerance_mm": 0.0}))
    tracker.remember(FACING, 0.0)
    real = tracking.measure_all
    monkeypatch.setattr(tracking, "measure_all", lambda *given: [shifted(real(*given)[0], 4, [0.5, -0.3], doubtful)])
    found = tracker.step(*pair, time_s=0.02)
    assert found.found == doubtful
    if doubtful:
        assert found.pose.used.tolist() == [[True] * 3, [True, False, True]]
        assert off_mm(found) < 0.05
        assert found.views[1].outlines.reasons == (None, views.ELSEWHERE, None)
        assert found.views[1].found and np.isnan(found.views[1].blur_px[1])
        true = drawings.shown(cameras[1], FACING, rig.target)
        assert np.abs(found.views[1].outlines.ellipses.centre - true.centre).max() < 0.1


def test_a_camera_that_was_moved_is_told_from_one_that_sees_nothing(cameras, rig, pair):
    """By 9 rows, within reach of the fit; the detector sees camera 1's view alone."""
    moved = np.roll(pair[1], 9, axis=0)
    found = Tracker(cameras, rig.target, Told([centres(cameras[0], FACING, rig.target), []])).step(pair[0], moved)
    assert not found.found and "moved" in str(found.pose.reason)


def test_of_two_poses_the_one_of_more_circles_is_taken_then_the_better_fit(tracker, pair):
    found = tracker.step(*pair)
    worse = replace(found, pose=replace(found.pose, misfit=found.pose.misfit + 1))
    fewer = replace(found, pose=replace(found.pose, misfit=0.0, freedom=found.pose.freedom - 2))
    for order in ([worse, fewer, found], [found, fewer, worse]):
        assert min(order, key=tracking.rank) is found


def test_circles_that_one_view_shows_are_looked_at_once(cameras, rig, pair):
    """Whatever names they may have."""
    told = Told([centres(cameras[0], FACING, rig.target), []], names=(3, 3, 3))
    assert not Tracker(cameras, rig.target, told).step(pair[0], np.full_like(pair[0], 20)).found
    assert told.segmentations == 1


def test_one_camera_alone_is_said_so(tracker, pair):
    blank = np.full_like(pair[0], 20)
    seen = tracker.step(pair[0], blank)
    assert not seen.found and seen.pose.reason.startswith("only camera 1 sees the target")
    assert seen.views[0].found and not seen.views[1].found
    other = tracker.step(blank, pair[1])
    assert other.pose.reason.startswith("only camera 2 sees the target")


def test_one_cameras_images_for_both_are_named(tracker, pair):
    found = tracker.step(pair[0], pair[0])
    assert not found.found and "both cameras show the same image" in found.pose.reason


def test_swapped_cameras_are_not_found(cameras, rig, pair):
    places = [centres(camera, FACING, rig.target) for camera in cameras]
    found = Tracker(cameras, rig.target, Told(places[::-1])).step(pair[1], pair[0])
    assert not found.found and found.pose.reason == tracking.EXCHANGED
    assert not any(view.found for view in found.views)
    tracker, aside = Tracker(cameras, rig.target, Told(places[::-1])), FACING.copy()
    aside[0, 3] -= 120
    tracker.remember(aside, 0)
    assert tracker.step(pair[1], pair[0]).pose.reason == tracking.EXCHANGED, "a last pose beyond the view explains nothing here"


@pytest.mark.parametrize(
    ("size", "disc_px"), [((640, 480), 17), ((640, 480), 23), ((1280, 1024), 18), ((2448, 2048), 24), ((1000, 750), 180)]
)
def test_circles_of_any_size_are_found_by_cameras_of_any_resolution(rig, rng, size, disc_px):
    """From nothing, by the networks that are shipped: what they and the fit of rims look at is scaled to the circles."""
    focal, place = 1.3 * size[0], FACING.copy()
    place[:3, 3] = [0, 0.01 * focal, focal * rig.target.outer_diameter_mm / disc_px]
    matrix = np.array([[focal, 0, size[0] / 2], [0, focal, size[1] / 2], [0, 0, 1]])
    aside = rigid.from_rotation_vector([0, 0.15, 0], [-0.15 * place[2, 3], 0, 0])
    pair = Camera(size, matrix, np.zeros(5), np.eye(4)), Camera(size, matrix, np.zeros(5), aside)
    place[:2, 3] -= place[:2, :2] @ circle_layout.circle_centres(rig.target)[1:, :2].mean(axis=0)
    tracker = Tracker(pair, rig.target, networks.load(threads=1))
    images = [drawings.frame(camera, [place], rig.target, 90.0, rng) for camera in pair]
    for how in ("detected", "predicted"):
        found = tracker.step(*images)
        assert found.found and found.how == how, found.pose.reason
        assert off_mm(found, place) < 1e-3 * place[2, 3]


def test_a_lost_target_has_its_true_reason(tracker, pair):
    """Out of camera 2's view, and an image that is dark; not that circles are missing."""
    gone, aside = [np.full_like(image, 20) for image in pair], FACING.copy()
    assert tracker.step(*pair).found
    aside[0, 3] -= 120
    tracker.remember(aside)
    assert "camera 1: out of view: c" in str(tracker.step(*gone).pose.reason)
    tracker.forget()
    assert "too dark" in str(tracker.step(*gone).pose.reason)


def test_a_second_target_of_the_design_is_named_and_the_followed_one_stays(cameras, rig, rng):
    """In the pair after the first; and after a loss it is the one nearer to the last pose, which the network is less sure of."""
    beside = FACING.copy()
    beside[:3, 3] += [70, 5, 10]
    images = []
    for camera in cameras:
        one, other = (drawings.frame(camera, [place], rig.target, 65.0) for place in (FACING, beside))
        images.append(drawings.read_out(np.where(np.abs(other - other[0, 0]) > 0.5, other, one) - drawings.BLACK_DN, rng))
    places = [np.vstack([centres(camera, place, rig.target) for place in (FACING, beside)]) for camera in cameras]
    tracker = Tracker(cameras, rig.target, Told(places, names=(0, 1, 2, 0, 1, 2)))
    tracker.remember(beside, 0.0)
    seen = [tracker.step(*images, 0.03 * k) for k in (1, 2)]
    assert off_mm(seen[0], beside) < 0.05 and off_mm(seen[1], beside) < 0.05
    assert len(seen[0].others) == 1 and seen[1].others is None  # searched now and then
    assert np.linalg.norm(seen[0].others[0][:3, 3] - FACING[:3, 3]) < 0.05
    again = tracker.step(*images, 5.0)
    assert again.how == "detected" and off_mm(again, beside) < 0.05 and len(again.others) == 1
    kept = [results.kept(one, 0) for one in (*seen, again)]
    (line,) = (line for line in track_figures.causes(kept, rig.target) if "second" in line)
    assert "in 2 of 2 pairs searched for one, first in pair 0, 71 mm from the one" in line


def test_a_mirrored_target_is_not_found(cameras, rig, pair):
    """As a camera that flips its images would show it."""
    flipped = [np.ascontiguousarray(image[:, ::-1]) for image in pair]
    places = [centres(camera, FACING, rig.target) for camera in cameras]
    found = Tracker(cameras, rig.target, Told([np.column_stack([1279 - p[:, 0], p[:, 1]]) for p in places])).step(*flipped)
    assert not found.found


@pytest.mark.parametrize("kind", ["blank", "black", "saturated", "noise", "nan", "half"])
def test_images_without_a_target_are_not_found(tracker, pair, rng, kind):
    images = {
        "blank": np.full((1024, 1280), 40, np.uint8),
        "black": np.zeros((1024, 1280), np.uint8),
        "saturated": np.full((1024, 1280), 255, np.uint8),
        "noise": rng.integers(0, 255, (1024, 1280)).astype(np.uint8),
        "nan": np.full((1024, 1280), np.nan, np.float32),
        "half": np.where(np.arange(1280) < 620, pair[0], 30).astype(np.uint8),
    }
    seen = tracker.step(images[kind], images[kind])
    assert not seen.found and seen.pose.reason
    tracker.remember(FACING)
    seen = tracker.step(images[kind], images[kind])
    assert not seen.found and np.isnan(seen.pose.world_from_target).all()


def test_a_wrong_size_is_refused_by_name(tracker, pair):
    seen = tracker.step(pair[0], pair[1][:512, :640])
    assert seen.pose.reason == "camera 2: expected an image of 1280x1024, found 640x512"
    for nonsense in (np.array(None), np.zeros((1024, 1280, 7), np.uint8), np.zeros(0), np.array("text")):
        assert "expected an image" in str(tracker.step(pair[0], nonsense).pose.reason)


@pytest.mark.parametrize("drift_px", [None, 0.0])
def test_cameras_that_have_warmed_see_the_target_by_default(cameras, rig, pair, told, drift_px):
    """Principal points 0.06 px off the calibration, a kelvin's worth, along opposite ways, which exact cameras refuse.

    The same frames, so the calibration is what moves.
    """
    warm = []
    for camera, sign in zip(cameras, (1, -1), strict=True):
        matrix = camera.matrix.copy()
        matrix[:2, 2] += sign * np.array([0.03, 0.06])
        warm.append(replace(camera, matrix=matrix))
    exact = {} if drift_px is None else {"drift_px": drift_px, "board_scale": 0.0}
    found = Tracker((warm[0], warm[1]), rig.target, told, **exact).step(*pair)
    assert found.found == (drift_px is None), found.pose.reason


def test_a_setting_that_is_changed_counts_from_then_on(cameras, rig):
    tracker = Tracker(cameras, rig.target, drift_px=0.05)
    first = tracker.optics_in_use
    assert first.sigma("cam1.cx") == pytest.approx(0.05) and tracker.optics_in_use is first
    tracker.drift_px = 0.5
    assert tracker.optics_in_use.sigma("cam1.cx") == pytest.approx(0.5)


def test_a_pose_that_is_remembered_has_the_unit_of_time_that_it_is_given_in(cameras, rig):
    """Poses of two frames give a velocity, of half a second apart none, of whatever number."""
    tracker, moved = Tracker(cameras, rig.target), FACING.copy()
    moved[0, 3] += 5
    tracker._clock = 3.0
    tracker.remember(FACING)
    tracker._clock = 4.0
    tracker.remember(moved)
    assert tracker._predicted(5.0)[0, 3] == pytest.approx(FACING[0, 3] + 10)
    tracker.forget()
    tracker.remember(FACING, 3.5)
    tracker.remember(moved, 4.0)  # the number of the frame, but in seconds
    assert tracker._predicted(4.1)[0, 3] == moved[0, 3]


def test_two_poses_that_fit_as_well_are_no_detection(tracker, pair):
    """As of rims that are already measured; a worse one, or one by fewer circles, is no rival."""
    found = tracker.step(*pair)
    turned = rigid.from_rotation_vector([0.3, 0, 0], [0, 0, 0])
    other = replace(found.pose, world_from_target=found.pose.world_from_target @ turned)
    worse, fewer = replace(other, misfit=found.pose.misfit + 17), replace(other, freedom=found.pose.freedom - 2)
    for pose, told in ((other, False), (worse, True), (fewer, True), (found.pose, True)):
        result = tracking._likeliest([replace(found, pose=pose), found])
        assert result.found == told and (told or "do not tell apart" in result.pose.reason)


def test_colour_and_depth_make_no_difference(cameras, rig, pair, told):
    deep = [(image.astype(np.uint16) * 16).clip(0, 4095) for image in pair]
    for images in ([np.repeat(i[..., None], 3, axis=2) for i in pair], deep, [i.astype(np.float32) / 255 for i in pair]):
        found = Tracker(cameras, rig.target, told, bits=12 if images is deep else None).step(*images)
        assert found.found and off_mm(found) < 0.05, found.pose.reason


def test_without_networks_it_says_so(cameras, rig, pair):
    lonely = Tracker(cameras, rig.target)
    assert "no networks" in str(lonely.step(*pair).pose.reason)
    lonely.remember(FACING)
    assert lonely.step(*pair).how == "predicted"


def test_a_lost_target_is_detected_again(tracker, pair, cameras, rig, rng, told):
    assert tracker.step(*pair).found
    moved = FACING.copy()
    moved[:3, 3] += [25, -10, 15]
    told.places = [centres(camera, moved, rig.target) for camera in cameras]
    seen = tracker.step(*(drawings.frame(camera, [moved], rig.target, 65.0, rng) for camera in cameras))
    assert seen.how == "detected" and off_mm(seen, moved) < 0.05


def test_photographs_of_any_size(cameras, rig, pair):
    """Down to thumbnails: the same circles, in the image's own pixels."""
    import cv2

    true = centres(cameras[0], FACING, rig.target)
    for width, height, limit in ((1280, 1024, 0.4), (320, 256, 0.4), (2560, 2048, 1.0)):
        image = cv2.resize(pair[0], (width, height), interpolation=cv2.INTER_AREA)
        view = photographs.find(image, Told([true]), rig.target)
        assert view.found, view.reason
        expected = (true + 0.5) * width / 1280 - 0.5
        assert np.hypot(*(view.outlines.ellipses.centre - expected).T).max() < limit
    assert not photographs.find(np.zeros((50, 70), np.uint8), Told([[]]), rig.target).found
    assert "expected an image" in str(photographs.find(np.zeros(3), Told([[]]), rig.target).reason)


def test_pictures_show_what_was_seen(tracker, pair, cameras):
    found = tracker.step(*pair)
    picture = overlays.drawn(pair[0], found.views[0], found.pose, cameras[0])
    assert picture.shape == (1024, 1280, 3) and (picture.max(axis=2) != picture.min(axis=2)).sum() > 500
    missed = tracker.step(np.zeros_like(pair[0]), np.zeros_like(pair[0]))
    assert overlays.drawn(np.zeros_like(pair[0]), missed.views[0], missed.pose).any()
