"""Several bodies in one pair of frames: each found as itself, or not at all, and why."""

import cv2
import numpy as np
import pytest

from recon.geometry import rigid
from recon.model import circle_layout
from recon.model.rig import Rig
from recon.tracking import constellations, networks
from recon.tracking.bodies import BodyTracker
from recon.tracking.tracker import Tracker, is_beside
from sonotwin import choices
from tests.recon.tracking import drawings


@pytest.fixture(scope="module")
def rig() -> Rig:
    return choices.read_rig("three_bodies")


@pytest.fixture(scope="module")
def cameras(rig):
    return rig.cam1.optics.camera(), rig.cam2.optics.camera()


@pytest.fixture(scope="module")
def found_by():
    return networks.load(by_geometry=True)


@pytest.fixture
def tracker(rig, cameras, found_by):
    return of(rig, cameras, found_by)


def of(rig, cameras, found_by, **settings) -> BodyTracker:
    return BodyTracker({name: Tracker(cameras, target, found_by) for name, target in rig.targets.items()}, **settings)


def pair(cameras, bodies, rng, white=65.0):
    """Frames of bodies : pairs of a pose and a target."""
    return [drawings.together(camera, [([place], target) for place, target in bodies], white, rng) for camera in cameras]


def off_mm(found, place):
    return np.linalg.norm(found.pose.world_from_target[:3, 3] - place[:3, 3])


@pytest.fixture(scope="module")
def places(rig):
    return dict(zip(rig.targets, drawings.apart(np.random.default_rng(3), list(rig.targets.values())), strict=True))


@pytest.fixture(scope="module")
def frames(rig, cameras, places):
    return pair(cameras, [(places[name], target) for name, target in rig.targets.items()], np.random.default_rng(3))


class Counted:
    """Networks that count how often they look at whole frames, and at patches."""

    def __init__(self, networks):
        self.networks, self.detections, self.segmentations = networks, 0, 0

    def detect(self, images):
        self.detections += 1
        return self.networks.detect(images)

    def segment(self, patches):
        self.segmentations += 1
        return self.networks.segment(patches)


def test_all_are_found_in_one_pass_and_then_followed(rig, cameras, found_by, places, frames):
    """Each as itself, to the noise of its rims; the detector looks at each camera's frame once, then at none."""
    counted = Counted(found_by)
    tracker = of(rig, cameras, counted)
    for time_s, how in ((0.0, "detected"), (1 / 60, "predicted"), (2 / 60, "predicted")):
        for name, found in tracker.step(*frames, time_s).items():
            assert found.how == how, f"{name}: {found.pose.reason}"
            assert off_mm(found, places[name]) < 0.05
            assert found.pose.total.shape == (6, 6) and np.linalg.eigvalsh(found.pose.total).min() > 0
    assert counted.detections == 2


def test_each_is_as_exact_as_if_it_were_alone(rig, cameras, found_by, places, frames):
    """The same rims give the same pose, whoever else is in view."""
    together = of(rig, cameras, found_by).step(*frames)
    for name, target in rig.targets.items():
        alone = Tracker(cameras, target, found_by).step(*pair(cameras, [(places[name], target)], np.random.default_rng(3)))
        assert alone.found
        off = rigid.difference(alone.pose.world_from_target, together[name].pose.world_from_target)
        assert off @ np.linalg.solve(alone.pose.covariance + together[name].pose.covariance, off) < 30  # chi-square, 6 degrees


def test_bodies_followed_at_once_are_followed_as_each_alone(rig, cameras, found_by, rng):
    """The same rims to the last digit: those of other bodies, of other numbers and sizes, are measured in the same call."""
    small = rig.target.model_dump() | {"outer_diameter_mm": 13.0, "inner_diameter_mm": 6.5}
    other = Rig.model_validate(rig.model_dump() | {"bodies": {"needle": small}})
    places = dict(zip(other.targets, drawings.apart(rng, list(other.targets.values())), strict=True))
    shown = pair(cameras, [(places[name], target) for name, target in other.targets.items()], rng)
    alone = {name: Tracker(cameras, target, found_by) for name, target in other.targets.items()}
    together = of(other, cameras, found_by)
    for name, one in alone.items():
        for each in (one, together.trackers[name]):
            each.remember(places[name], 0.0)
    for time_s in (0.02, 0.04):
        found = together.step(*shown, time_s)
        for name, one in alone.items():
            by_itself = one.step(*shown, time_s)
            assert found[name].how == by_itself.how == "predicted"
            np.testing.assert_array_equal(found[name].pose.world_from_target, by_itself.pose.world_from_target)
            np.testing.assert_array_equal(found[name].pose.total, by_itself.pose.total)
            assert found[name].pose.triangle.lengths_mm == pytest.approx(circle_layout.lengths(other.targets[name]), abs=0.1)


@pytest.mark.parametrize("missing", ["probe", "needle", "patient"])
def test_one_that_is_away_is_lost_and_no_other_is_taken_for_it(rig, cameras, tracker, places, missing):
    bodies = [(places[name], target) for name, target in rig.targets.items() if name != missing]
    found = tracker.step(*pair(cameras, bodies, np.random.default_rng(4)))
    assert [name for name, one in found.items() if not one.found] == [missing]
    assert found[missing].pose.reason


def test_a_second_one_of_a_design_is_told_with_its_place(rig, cameras, tracker, places):
    """The needle is away; a second probe lies in its place."""
    bodies = [(places["probe"], rig.target), (places["needle"], rig.target), (places["patient"], rig.bodies["patient"])]
    found = tracker.step(*pair(cameras, bodies, np.random.default_rng(5)))
    assert found["probe"].found and found["patient"].found and not found["needle"].found
    assert is_beside(found["probe"].apart_mm) and found["patient"].apart_mm == np.inf
    expected = np.linalg.norm(places["probe"][:3, 3] - places["needle"][:3, 3])
    assert found["probe"].apart_mm == pytest.approx(expected, abs=0.2)


def test_two_bodies_of_one_design_are_told_neither(rig, cameras, found_by, places):
    """Where the rig's file insists on them: which is which nothing tells, until one was known."""
    twin = rig.target.model_dump() | {"unusual": True}
    twins = Rig.model_validate(rig.model_dump() | {"bodies": {"needle": twin}})
    tracker = of(twins, cameras, found_by)
    shown = pair(cameras, [(places["probe"], rig.target)], np.random.default_rng(6))
    found = tracker.step(*shown, 0.0)
    assert {one.pose.reason for one in found.values()} == {"circles of the probe, or of the needle: no distance tells which"}
    tracker.trackers["probe"].remember(places["probe"], 0.01)
    found = tracker.step(*shown, 0.02)
    assert found["probe"].found and not found["needle"].found


@pytest.fixture
def needle_away(cameras, rig, places):
    bodies = [(places["probe"], rig.target), (places["patient"], rig.bodies["patient"])]
    return pair(cameras, bodies, np.random.default_rng(7))


def live(rig, cameras, found_by, places, *known):
    """A tracker that searches in parts, with bodies that it knows at time 0."""
    tracker = of(rig, cameras, found_by, search_s=0.2)
    for name in known:
        tracker.trackers[name].remember(places[name], 0.0)
    return tracker


def test_a_pair_takes_a_part_of_a_search_while_another_body_is_followed(rig, cameras, found_by, places):
    """The first looks at all rings, each 0.2 s; the others at a naming each, of rings that no body has."""
    other = circle_layout.with_lengths(rig.target, np.array([46.0, 20.0, 36.0]))
    bodies = [(places["probe"], rig.target), (places["patient"], rig.bodies["patient"]), (places["needle"], other)]
    shown, counted = pair(cameras, bodies, np.random.default_rng(7)), Counted(found_by)
    tracker, looks = live(rig, cameras, counted, places, "probe", "patient"), []
    for k in range(1, 40):
        counted.detections = counted.segmentations = 0
        found = tracker.step(*shown, k / 60)
        assert found["probe"].how == found["patient"].how == "predicted" and not found["needle"].found
        looks.append((counted.detections, counted.segmentations))
    detections, segmentations = np.array(looks).T
    begun = np.flatnonzero((detections > 0) & (segmentations > 0))
    assert begun[0] == 0 and (np.diff(begun) >= 12).all() and len(begun) == 4  # each 0.2 s at 60 pairs a second
    later = np.delete(segmentations, begun)
    assert segmentations[begun].max() <= 6 and later.max() == 1  # three sizes of patches in both views, then a naming
    counted.segmentations = 0
    of(rig, cameras, counted).step(*shown, 1.0)
    assert counted.segmentations > 2 * segmentations.max()


def test_a_lost_body_in_whole_view_is_found_in_the_pair_of_the_search(rig, cameras, found_by, places, frames):
    found = live(rig, cameras, found_by, places, "patient").step(*frames, 0.02)
    assert [one.how for one in found.values()] == ["detected", "detected", "predicted"]
    for name, one in found.items():
        assert off_mm(one, places[name]) < 0.05


def test_a_lost_body_seen_in_part_is_found_by_parts_of_a_search(rig, cameras, found_by, places, needle_away):
    """Within half a second, as itself, while the patient is followed in each pair."""
    left, right = needle_away
    left = covered(left, cameras[0], places["probe"], rig.target, 1)
    tracker = live(rig, cameras, found_by, places, "patient")
    for k in range(1, 31):
        found = tracker.step(left, right, k / 60)
        assert found["patient"].how == "predicted" and not found["needle"].found
        if found["probe"].found:
            break
    assert off_mm(found["probe"], places["probe"]) < 0.3


def test_further_bodies_of_a_design_are_told_by_parts_of_a_search(rig, cameras, found_by, places):
    """A second probe in the needle's place, while the probe and the patient are followed."""
    bodies = [(places["probe"], rig.target), (places["needle"], rig.target), (places["patient"], rig.bodies["patient"])]
    shown, tracker = pair(cameras, bodies, np.random.default_rng(5)), live(rig, cameras, found_by, places, "probe", "patient")
    found = [tracker.step(*shown, k / 60) for k in range(1, 31)]
    assert all(each["probe"].how == each["patient"].how == "predicted" for each in found)
    told = [each["probe"].apart_mm for each in found if each["probe"].apart_mm is not None]
    expected = np.linalg.norm(places["probe"][:3, 3] - places["needle"][:3, 3])
    assert told and told == pytest.approx([expected] * len(told), abs=0.2)


def test_rings_that_no_body_has_are_no_body(rig, cameras, found_by, places):
    """Points as far apart as another target's circles."""
    other = circle_layout.with_lengths(rig.target, np.array([46.0, 20.0, 36.0]))
    found = of(rig, cameras, found_by).step(*pair(cameras, [(places["probe"], other)], np.random.default_rng(8)))
    assert not any(one.found for one in found.values())


def test_points_are_chosen_by_distances_alone(rig, rng):
    """Among 12 points at random the circles of a moved target are found in their order, the surest first."""
    model = circle_layout.circle_centres(rig.target)
    place = drawings.facing(rng)
    others = rng.uniform([-100, -80, 600], [100, 80, 700], (9, 3))
    places = np.concatenate([others[:4], rigid.apply(place, model), others[4:]])
    numbers = np.arange(len(places))
    points = constellations.Points(np.column_stack([numbers, numbers]), places, np.full(len(places), 9.0))
    assert constellations.choices(points, rig.target)[0].tolist() == [4, 5, 6]
    wider = points.__class__(points.rings, places, np.full(len(places), 14.0))
    assert not constellations.choices(wider, rig.target)


def test_frames_of_another_size_are_refused_for_all(tracker):
    found = tracker.step(np.zeros((10, 10), np.uint8), np.zeros((10, 10), np.uint8))
    assert all("expected an image of 1280x1024" in one.pose.reason for one in found.values())


def test_bodies_may_have_circles_of_other_sizes(rig, cameras, found_by, places):
    """A needle with the probe's distances, but circles of 13 mm whose holes are wider: sizes tell them."""
    small = rig.target.model_dump() | {"outer_diameter_mm": 13.0, "inner_diameter_mm": 6.5}
    other = Rig.model_validate(rig.model_dump() | {"bodies": {"needle": small}})
    shown = pair(cameras, [(places[name], target) for name, target in other.targets.items()], np.random.default_rng(9))
    tracker = of(other, cameras, found_by)
    for time_s in (0.0, 0.02):
        found = tracker.step(*shown, time_s)
        for name, one in found.items():
            assert one.found, f"{name}: {one.pose.reason}"
            assert off_mm(one, places[name]) < 0.05


def covered(image, camera, place, target, circle):
    """A frame in which a grey disc lies over most of a circle."""
    centre = camera.project(rigid.apply(place, circle_layout.circle_centres(target)))[circle]
    shown = image.copy()
    cv2.circle(shown, tuple(np.rint(centre + np.array([14, 0])).astype(int).tolist()), 52, 30, -1)
    return shown


@pytest.mark.parametrize("circle", [0, 1, 2])
def test_a_lost_body_of_which_a_circle_is_covered_is_found(rig, cameras, tracker, places, circle):
    """In one view, the needle away: no other body fits what is seen."""
    bodies = [(places["probe"], rig.target), (places["patient"], rig.bodies["patient"])]
    left, right = pair(cameras, bodies, np.random.default_rng(10 + circle))
    left = covered(left, cameras[0], places["probe"], rig.target, circle)
    found = tracker.step(left, right)
    assert found["probe"].found, found["probe"].pose.reason
    assert off_mm(found["probe"], places["probe"]) < 0.3 and not found["needle"].found
    assert found["patient"].found


def test_a_body_seen_in_part_is_not_taken_for_one_that_is_away(rig, cameras, found_by, places):
    """Parted by 2.1 mm, as little as a rig takes: the probe with a covered circle is never the patient, who is away."""
    near = rig.target.model_dump() | {"c2_mm": rig.target.c2_mm + 2.2}
    twins = Rig.model_validate(rig.model_dump() | {"bodies": {"patient": near}})
    for number, circle in enumerate((0, 1, 2, 2)):
        place = drawings.apart(np.random.default_rng(20 + number), [rig.target] * 3)[0]
        frames = pair(cameras, [(place, rig.target)], np.random.default_rng(number))
        frames[number % 2] = covered(frames[number % 2], cameras[number % 2], place, rig.target, circle)
        found = of(twins, cameras, found_by).step(*frames)
        assert not found["patient"].found


def test_a_second_one_seen_in_part_is_told(rig, cameras, tracker, places):
    """A circle of it is covered in one view: two points and the circles about them are enough."""
    bodies = [(places["probe"], rig.target), (places["needle"], rig.target)]
    left, right = pair(cameras, bodies, np.random.default_rng(12))
    left = covered(left, cameras[0], places["needle"], rig.target, 1)
    found = tracker.step(left, right)
    assert found["probe"].found and is_beside(found["probe"].apart_mm)
