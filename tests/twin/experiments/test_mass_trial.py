"""Masses are counted as what became of them, by balls in made-up findings, and the conditions are as they are called."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
import yaml

from recon.geometry import rigid
from recon.segmentation.left_out import LeftOut
from scenes.catalogue import parse_scene
from scenes.kinds import breast
from scenes.scene_types import Material, Thing
from twin.experiments import mass_conditions, mass_trial
from twin.experiments.mass_accuracy import PATH
from twin.experiments.mass_conditions import CONDITIONS, Condition
from twin.experiments.mass_trial import Findings

ROOT = Path(__file__).resolve().parents[3]
LARGE, SMALL = ((0.0, 0.0, 670.0), 10.0), ((40.0, 0.0, 670.0), 5.0)
AXES = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # the beam along z


def ball(place=LARGE, shift=(0.0, 0.0, 0.0), larger: float = 1.0) -> trimesh.Trimesh:
    """A body at a place, shifted by mm and of a share of its volume."""
    centre, radius = place
    return trimesh.creation.icosphere(4, radius * larger ** (1 / 3)).apply_translation(np.add(centre, shift))


TRUE = [Thing(f"tumour{k}", ball(place), Material(0.4), inside=True) for k, place in enumerate((LARGE, SMALL))]


def left_out(centre, extents=(0.0, 0.0, 0.0), reason="weak contrast") -> LeftOut:
    return LeftOut(reason=reason, volume_mm3=100.0, centre_mm=centre, extents_mm=extents, text="")


def judged(*masses: trimesh.Trimesh, left=(), doubted: bool = False, volume_sigmas=()):
    """Counts above zero by their short names, but for that of the true ones, which is two."""
    found = Findings(masses, [0.1] * len(masses), volume_sigmas or [1.0] * len(masses), left, doubted, AXES)
    figures = mass_trial.judge(TRUE, found)
    assert figures["masses_true"] == 2
    ends = ("right", "off", "named", "silent")
    assert sum(figures[f"masses_{end}"] for end in ends) == 2
    return {end: count for end in (*ends, "off_warned", "false", "false_warned") if (count := figures[f"masses_{end}"])}


@pytest.mark.parametrize(
    ("shift", "larger", "counted"),
    [
        ((0.0, 0.0, 0.0), 1.0, "right"),
        ((0.5, 0.3, 0.0), 1.1, "right"),
        ((0.5, 0.4, 0.0), 1.0, "off"),  # 0.64 mm
        ((0.0, 0.0, 0.0), 1.14, "off"),
        ((0.0, 0.0, 0.0), 0.86, "off"),
    ],
)
def test_found_masses_are_right_or_off(shift, larger, counted):
    assert judged(ball(SMALL), ball(LARGE, shift, larger)) == ({"right": 2} if counted == "right" else {"right": 1, "off": 1})


def test_errors_are_those_of_what_was_found():
    """One of two is found, 0.3 mm off, a tenth too large, with a standard deviation of its centre of 0.2 mm."""
    found = Findings([ball(LARGE, (0.0, 0.3, 0.0), 1.1)], [0.2], [1.0], [], False, AXES)
    figures = mass_trial.judge(TRUE, found)
    assert figures["centre_error_mm"] == figures["worst_centre_error_mm"] == pytest.approx(0.3, abs=1e-6)
    assert figures["volume_error_percent"] == pytest.approx(10, abs=1e-6)
    assert figures["centre_error_over_sigma"] == pytest.approx(1.5, abs=1e-5)
    none = mass_trial.judge(TRUE, replace(found, masses=[], sigmas_mm=[]))
    assert np.isnan([none["centre_error_mm"], none["volume_error_percent"]]).all()


def test_masses_that_are_off_are_warned_of_by_a_warning_of_all():
    moved = ball(LARGE, (0.0, 0.0, 2.0))
    assert judged(ball(SMALL), moved) == {"right": 1, "off": 1}
    assert judged(ball(SMALL), moved, doubted=True) == {"right": 1, "off": 1, "off_warned": 1}


@pytest.mark.parametrize(
    ("shift_mm", "larger", "sigma", "warned"),
    [(0.0, 0.86, 0.065, True), (0.0, 0.7, 0.065, False), (0.0, 0.86, 0.04, False), (0.7, 0.86, 0.065, False)],
)
def test_a_mass_whose_volume_is_said_to_be_uncertain_is_warned_of(shift_mm, larger, sigma, warned):
    """If it is off by no more than three sigma, and its centre is right; a volume known to 8 % (2 sigma) has no warning."""
    small = ball(SMALL, (shift_mm, 0.0, 0.0), larger)
    counts = judged(ball(LARGE), small, volume_sigmas=[1.0, sigma * small.volume])
    assert counts == {"right": 1, "off": 1} | ({"off_warned": 1} if warned else {})


@pytest.mark.parametrize(("beyond_mm", "named"), [(-8.0, True), (1.8, True), (2.2, False)])
def test_a_missing_mass_is_named_by_a_place_in_it_or_near_it(beyond_mm, named):
    left = [left_out((0.0, LARGE[1] + beyond_mm, 670.0))]
    assert judged(ball(SMALL), left=left) == ({"right": 1, "named": 1} if named else {"right": 1, "silent": 1})


def test_a_missing_mass_is_named_by_a_gap_that_covers_some_of_it():
    """The gap is 6 mm wide across the B-scans, y here, and 60 mm long along the array, x: its middle lies far from the mass."""
    gap = left_out((25.0, 5.0, 672.0), (60.0, 30.0, 6.0), "gap")
    assert judged(ball(SMALL), left=[gap]) == {"right": 1, "named": 1}
    assert judged(ball(SMALL), left=[gap.model_copy(update={"centre_mm": (25.0, 14.0, 672.0)})]) == {"right": 1, "silent": 1}
    assert judged(ball(SMALL), left=[gap.model_copy(update={"centre_mm": (41.0, 5.0, 672.0)})]) == {"right": 1, "silent": 1}


def test_what_is_found_where_nothing_is_is_false():
    """Also a second body in one mass; and one is warned of if something beside it is named."""
    elsewhere, piece = ball(SMALL, (0.0, 30.0, 0.0)), ball(LARGE, (6.0, 0.0, 0.0), 0.1)
    whole = (ball(LARGE), ball(SMALL))
    assert judged(*whole, elsewhere, piece) == {"right": 2, "false": 2}
    assert judged(*whole, elsewhere, piece, left=[left_out((40.0, 26.0, 670.0))]) == {"right": 2, "false": 2, "false_warned": 1}
    assert judged(*whole, elsewhere, piece, doubted=True) == {"right": 2, "false": 2, "false_warned": 2}


def test_what_is_named_where_no_mass_is_is_counted():
    """So that naming more than there is doesn't count as gain; gaps lie where they lie."""
    left = [left_out((0.0, 0.0, 670.0)), left_out((0.0, 40.0, 670.0)), left_out((0.0, 40.0, 670.0), (9.0, 9.0, 9.0), "gap")]
    figures = mass_trial.judge(TRUE, Findings([ball(LARGE), ball(SMALL)], [0.1, 0.1], [1.0, 1.0], left, False, AXES))
    assert (figures["masses_right"], figures["named_nowhere"]) == (2, 1)


def test_two_masses_found_as_one_are_one_that_is_off_and_one_that_is_silent():
    near = [TRUE[0], Thing("tumour1", ball(((14.0, 0.0, 670.0), 4.0)), Material(0.4), inside=True)]
    merged = trimesh.util.concatenate([thing.mesh for thing in near])
    figures = mass_trial.judge(near, Findings([merged], [0.1], [1.0], [], False, AXES))
    assert (figures["masses_off"], figures["masses_silent"], figures["masses_false"]) == (1, 1, 0)


def test_nothing_that_is_scanned_is_nothing_missed():
    figures = mass_trial.judge([], Findings([ball()], [0.1], [1.0], [], False, AXES))
    assert (figures["masses_true"], figures["masses_silent"], figures["masses_false"]) == (0, 0, 1)


def made_up_sweep(scanners) -> SimpleNamespace:
    """B-scans 0.8 mm apart along y at 20 a second, which look along z."""
    poses = np.stack([rigid.transform(AXES, [-20, y, 650]) for y in np.arange(-30, 30, 0.8)])
    times = (np.arange(len(poses)) * 5e7).astype(np.int64)
    plan = SimpleNamespace(truth=SimpleNamespace(times=times), times=times)
    return SimpleNamespace(settings=SimpleNamespace(ultrasound=scanners["linear"]), plan=plan, body_from_image=poses)


@pytest.mark.parametrize(
    ("condition", "count"),
    [
        (Condition(), 75),
        (Condition(share=0.5), 38),
        (Condition(lost_s=1.0), 55),
        (Condition(every_mm=4.0), 15),
    ],
)
def test_b_scans_that_keep_their_pose(condition, count, scanners, rng):
    sweep = made_up_sweep(scanners)
    kept = mass_trial.kept_scans(condition, sweep, TRUE, rng)
    assert kept.sum() == pytest.approx(count, abs=1)
    if condition.lost_s:
        y = sweep.body_from_image[~kept, 1, 3]
        assert y.min() < 0 < y.max(), "the poses that are lost are those over the largest mass"


def test_points_are_scanned_in_the_images_only(scanners):
    """40 mm wide from x = -20 on, 47 mm deep at the phantom's speed of sound from z = 650 on, and along y from -30 to 29."""
    sweep = made_up_sweep(scanners)
    points = np.array([[0, 0, 670], [0, 0, 696], [0, 0, 698], [-20.5, 0, 670], [0, -31.3, 670], [0, -31.6, 670.0], [0, 0, 649]])
    seen = mass_trial.seen(sweep, points, np.ones(75, bool))
    assert seen.tolist() == [True, True, False, False, True, False, False]
    assert not mass_trial.seen(sweep, points[:1], np.arange(75) < 30).any()


def test_the_study_has_all_conditions():
    study = yaml.safe_load((ROOT / "conf" / "study" / "masses.yaml").read_text(encoding="utf-8"))
    assert study["over"]["masses.condition"] == list(CONDITIONS)
    assert mass_trial.PATH == PATH


def test_masses_lie_as_a_condition_says():
    """Distances from vertex to vertex are known to some tenths of a mm."""
    for name, expected in {"touching": 0.0, "near": 1.0}.items():
        bodies = breast.bodies_of(parse_scene(mass_conditions.scene(CONDITIONS[name], 0))[1])
        assert breast.gap(*bodies) == pytest.approx(expected, abs=0.4)
    config = parse_scene(mass_conditions.scene(CONDITIONS["shallow"], 1))[1]
    depth = breast.depth_in(breast.open_mesh(breast.skin_of(config)))
    assert all(1.9 < breast.least_tissue(body, depth) < 3.1 for body in breast.bodies_of(config))


def test_another_seed_is_another_place_and_form():
    one, other = (mass_conditions.scene(CONDITIONS["usual"], seed) for seed in (0, 1))
    assert one["seed"] != other["seed"]
    moved = np.subtract(one["tumours"][0]["centre_mm"], other["tumours"][0]["centre_mm"])
    assert 0 < np.abs(moved).max() < 6
    assert mass_conditions.scene(CONDITIONS["usual"], 0) == one
