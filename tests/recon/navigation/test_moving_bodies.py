"""Bodies beside a patient who moves: told where the patient stood, or not at all; and what is said of it."""

import numpy as np
import pytest
import trimesh

from recon.geometry import rigid
from recon.model.tip import Tip
from recon.model.tracks import Track
from recon.navigation.moving_bodies import AT_FIRST, MovingBodies
from recon.navigation.placed_scans import PlacedScan
from recon.navigation.tool_distances import surface_of, tip_at
from tests.recon.navigation.bodies_seen import NEEDLE, OWN, PATIENT, PROBE, SHARED, seen, three, unseen

STEP = rigid.from_rotation_vector([0.03, -0.05, 0.06], [14, -9, 30])  # of the patient, and of all that is beside
TIP = Tip(np.array([0.0, 5, -150]), np.diag([0.01] * 3 + [1e-6] * 3), np.array([0.0, 0, -1]))
REFERENCE = Track(np.array([5]), PATIENT[None], OWN[None], SHARED[None])
PLAN = np.array([[-50.0, 20, 700], [-40, 10, 760]])


@pytest.fixture
def mass():
    ball = trimesh.creation.icosphere(4, 8.0).apply_translation([-60, 0, 780])
    return surface_of(np.asarray(ball.vertices), np.asarray(ball.faces))


def moved(found):
    """All bodies after the patient's step."""
    return {name: seen(STEP @ one.pose.world_from_target) if one.found else one for name, one in found.items()}


def test_a_patient_who_moves_with_all_changes_no_figure(mass):
    moving = MovingBodies({"needle": TIP}, {"mass0": mass}, PLAN, REFERENCE)
    before, after = (moving.place(found, 10**9) for found in (three(), moved(three())))
    for placed in (before, after):
        np.testing.assert_allclose(placed.world_from_target, PROBE, atol=1e-9)
        needle, patient = placed.bodies
        np.testing.assert_allclose(needle.world_from_body, NEEDLE, atol=1e-9)
        np.testing.assert_allclose(patient.world_from_body, PATIENT, atol=1e-9)
    np.testing.assert_allclose(after.bodies[1].camera_from_body, STEP @ PATIENT, atol=1e-9)
    scan = PlacedScan(np.zeros((20, 10), np.uint8), 0, 0, PROBE)
    (one, _), (other, _) = (moving.measure(placed, scan) for placed in (before, after))
    np.testing.assert_allclose(one.figures.tip, rigid.apply(NEEDLE, TIP.tip_mm), atol=1e-9)
    np.testing.assert_allclose(other.figures.tip, one.figures.tip, atol=1e-9)
    assert other.figures.masses["mass0"].mm == pytest.approx(one.figures.masses["mass0"].mm, abs=1e-9)
    assert other.figures.path.off_mm == pytest.approx(one.figures.path.off_mm, abs=1e-9)
    assert before.state == "target predicted"


def test_where_the_patient_is_not_seen_no_body_is_placed(mass):
    moving = MovingBodies({"needle": TIP}, {"mass0": mass}, PLAN, REFERENCE)
    placed = moving.place(three(patient=unseen()), 10**9)
    assert placed.world_from_target is None
    assert placed.state == "patient not found: camera 1: 2 of 3 circles; no body is placed"
    for body in moving.measure(placed, PlacedScan(np.zeros((20, 10), np.uint8), 0, 0, PROBE)):
        assert body.world_from_body is None and body.figures is None
    assert placed.bodies[0].state == "patient not found"
    np.testing.assert_allclose(placed.bodies[0].camera_from_body, NEEDLE)


def test_without_a_reference_the_first_sight_counts_and_is_said():
    moving = MovingBodies({"needle": TIP})
    assert moving.place(three(patient=unseen()), 1).world_from_target is None
    first = moving.place(three(), 2)
    later = moving.place(moved(three()), 3)
    np.testing.assert_allclose(first.world_from_target, PROBE, atol=1e-9)
    np.testing.assert_allclose(later.world_from_target, PROBE, atol=1e-9)
    assert AT_FIRST in first.state and AT_FIRST in later.state


def test_without_a_patient_all_stays_in_the_cameras_frame():
    found = {name: one for name, one in three().items() if name != "patient"}
    placed = MovingBodies({"needle": None}).place(found, 1)
    np.testing.assert_array_equal(placed.world_from_target, PROBE)
    (needle,) = MovingBodies({"needle": None}).measure(placed, None)
    np.testing.assert_array_equal(needle.world_from_body, NEEDLE)
    assert needle.figures is None and placed.state == "target predicted", "of a tool without a tip there is a pose alone"


def test_the_tips_covariance_is_of_the_whole_error():
    """By noise and by tolerances: of a drawing's tip, at the lever arm."""
    found = {name: one for name, one in three().items() if name != "patient"}
    moving = MovingBodies({"needle": TIP})
    (needle,) = moving.measure(moving.place(found, 1), None)
    _, expected = tip_at(NEEDLE, OWN + SHARED, TIP.tip_mm, TIP.covariance[:3, :3])
    np.testing.assert_allclose(needle.figures.covariance, expected)


def test_a_tool_that_is_not_seen_has_a_reason_and_no_figures():
    moving = MovingBodies({"needle": TIP}, reference=REFERENCE)
    placed = moving.place(three(needle=unseen("camera 2: 0 of 3 circles")), 1)
    needle, _ = moving.measure(placed, None)
    assert needle.state == "not found: camera 2: 0 of 3 circles" and needle.world_from_body is None and needle.figures is None
    np.testing.assert_allclose(placed.world_from_target, PROBE, atol=1e-9)


def test_the_tips_covariance_holds_the_patients_part(rng):
    """Against sampled poses of tool and patient, whose errors, alike in all or not, are independent of each other's here."""
    moving = MovingBodies({"needle": TIP}, reference=Track(np.array([5]), PATIENT[None]))  # which is exact
    no_shared = np.zeros((6, 6))

    def noisy(pose, own):
        tracked = seen(rigid.moved(pose, rng.multivariate_normal(np.zeros(6), own)))
        object.__setattr__(tracked.pose, "covariance", own)
        object.__setattr__(tracked.pose, "shared", no_shared)
        return tracked

    own = {"needle": 4 * OWN, "patient": OWN + np.diag([9e-8] * 3 + [1e-4] * 3)}
    tips, covariance = [], None
    for k in range(1500):
        found = three() | {"needle": noisy(STEP @ NEEDLE, own["needle"]), "patient": noisy(STEP @ PATIENT, own["patient"])}
        needle, _ = moving.measure(moving.place(found, k), None)
        tips.append(needle.figures.tip)
        covariance = needle.figures.covariance
    covariance = covariance - NEEDLE[:3, :3] @ TIP.covariance[:3, :3] @ NEEDLE[:3, :3].T  # the tip itself wasn't sampled
    whitened = np.linalg.solve(np.linalg.cholesky(covariance), (np.array(tips) - rigid.apply(NEEDLE, TIP.tip_mm)).T)
    np.testing.assert_allclose(np.cov(whitened), np.eye(3), atol=5 * np.sqrt(2 / 1500))


def test_a_second_one_of_a_tools_design_is_said():
    beside = seen(NEEDLE)
    object.__setattr__(beside, "others", (PROBE,))
    placed = MovingBodies({"needle": TIP}).place(three(needle=beside), 1)
    assert placed.bodies[0].state == "predicted, beside a second one of its design"
