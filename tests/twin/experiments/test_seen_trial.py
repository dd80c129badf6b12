"""Masses are drawn as asked, a sweep is taken in four ways, and pairs say what was found, by balls in made-up B-scans."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh

from recon.freehand.scans import Scans
from recon.segmentation import detectability
from scenes.catalogue import build_scene, parse_scene
from scenes.scene_types import Material, Thing
from tests.recon.pose_stacks import MM, SHAPE, stack
from twin.experiments import seen_trial
from twin.experiments.seen_trial import SILICONE, WAYS, Pair

PLACES = np.arange(-15, 15.1, 0.5)
GREY = 120
DB = 60 / 255  # a grey level


def ball(centre, radius: float, larger: float = 1.0) -> trimesh.Trimesh:
    return trimesh.creation.icosphere(4, radius * larger ** (1 / 3)).apply_translation(centre)


def thing(*place) -> Thing:
    return Thing("mass0", ball(*place), Material(0.3), inside=True)


def made_up(balls=()) -> Scans:
    """B-scans 0.5 mm apart along z, of tissue with balls of other grey levels : (centre, radius, grey)."""
    v, u = np.mgrid[: SHAPE[0], : SHAPE[1]] * MM
    images = np.full((len(PLACES), *SHAPE), GREY, np.uint8)
    for (x, y, z), radius, grey in balls:
        for image, height in zip(images, PLACES, strict=True):
            image[(u - x) ** 2 + (v - y) ** 2 + (height - z) ** 2 < radius**2] = grey
    return Scans(SHAPE, stack(PLACES), lambda: iter(images), 1540.0, 1540.0)


def test_silicone_breasts_have_the_masses_that_are_asked_for():
    """Apart from each other and under the skin, which the scene checks."""
    fields = seen_trial.silicone(1)
    hidden = [thing for thing in build_scene(fields).things if thing.inside]
    assert SILICONE.count[0] <= len(hidden) <= SILICONE.count[1]
    sizes = [seen_trial.ball_mm(thing.mesh) for thing in hidden]
    assert all(SILICONE.size_mm[0] <= size <= SILICONE.size_mm[1] for size in sizes) and sizes == sorted(sizes, reverse=True)
    contrasts = np.abs(seen_trial.set_levels(hidden, made_up()))
    assert ((contrasts >= SILICONE.contrast_db[0]) & (contrasts <= SILICONE.contrast_db[1])).all()
    assert {one["form"] for one in fields["tumours"]} <= set(SILICONE.forms)


def test_patients_have_masses_of_any_words():
    config = parse_scene(seen_trial.patient(3))[1]
    assert (config.masses, config.drawn.any_words, config.drawn.count) == ("drawn", True, (2, 5))


def test_a_sweep_is_taken_in_four_ways():
    """134 B-scans at 20 a second: every 2nd to 5th, all but a gap of 6 to 20, fewer at ends, and a first half or two thirds."""
    every, lost, part = set(), [], set()
    for seed in range(60):
        whole, thinned, gap, first = seen_trial.kept_scans(np.arange(134) / 20, np.random.default_rng(seed))
        assert whole.all()
        (step,) = set(np.diff(np.flatnonzero(thinned)).tolist())
        every.add(step)
        missing = np.flatnonzero(~gap)
        assert (np.diff(missing) == 1).all()
        lost.append(len(missing))
        assert first[: first.sum()].all()
        part.add(int(first.sum()))
    assert every == {2, 3, 4, 5} and part == {67, 90}
    assert 14 < max(lost) <= 20 and np.median(lost) > 6


def test_levels_are_those_that_b_scans_show():
    """A dark ball and a bright one 1.5 mm apart, each without the other's part of the shell; what none shows has no level.

    Trilinear voxels of 0.5 mm blur borders, by which bodies of 12 and 8 mm lose some tenths of a dB.
    """
    places = ((15.0, 20.0, 0.0), 6.0), ((26.5, 20.0, 0.0), 4.0), ((20.0, 20.0, 90.0), 5.0)
    scans = made_up([(*places[0], GREY - 26), (*places[1], GREY + 20)])
    dark, bright, unseen = seen_trial.shown_levels([thing(*place) for place in places], scans)
    assert dark == pytest.approx(-26 * DB, abs=0.7) and bright == pytest.approx(20 * DB, abs=0.7)
    assert np.isnan(unseen)
    alone = seen_trial.shown_levels([thing(*places[0])], scans)
    assert alone[0] < dark, "the bright one counts as tissue where it isn't told"


@pytest.mark.parametrize(
    ("shift", "larger", "found"),
    [(0.0, 1.0, 1), (2.4, 1.0, 1), (2.6, 1.0, 0), (0.0, 1.28, 1), (0.0, 0.72, 1), (0.0, 1.32, 0), (0.0, 0.68, 0)],
)
def test_a_mass_is_found_within_half_its_radius_and_30_percent(shift, larger, found, monkeypatch):
    """One of 10 mm; beside it one that is missed, 8 mm large, of which less than half was scanned."""
    hidden = [thing((20.0, 20.0, 0.0), 5.0), thing((20.0, 20.0, 16.0), 4.0)]
    meshes = {"mass0": ball((20.0 + shift, 20.0, 0.0), 5.0, larger)}
    said = SimpleNamespace(meshes=meshes, figures={"tissue_uneven_db": 1.5}, scans=None)
    monkeypatch.setattr(seen_trial.masses_step, "find", lambda *_: said)
    one, other = seen_trial.pairs_of(2, hidden, np.array([-6.0, 4.0]), made_up(), trimesh.Trimesh())
    assert (one.found, other.found) == (found, 0) and (one.way, one.uneven_db) == (2, 1.5)
    assert (one.contrast_db, one.bright, other.contrast_db, other.bright) == (6, 0, 4, 1)
    assert one.size_mm == pytest.approx(10, abs=0.05) and one.unseen == 0 and other.unseen > 0.5
    assert one.centre_error_mm == pytest.approx(shift, abs=1e-6) and np.isnan(other.centre_error_mm)
    assert one.volume_error_percent == pytest.approx(100 * (larger - 1), abs=1e-6)


def test_a_large_dark_mass_is_not_its_own_shadow(monkeypatch):
    """One of 20 mm that is 15 dB darker: its place was seen, whatever it looks like; what a breast shows none of has no pair."""
    place = (20.0, 20.0, 0.0), 10.0
    said = SimpleNamespace(meshes={}, figures={}, scans=None)
    monkeypatch.setattr(seen_trial.masses_step, "find", lambda *_: said)
    scans = made_up([(*place, GREY - 64)])
    (one,) = seen_trial.pairs_of(0, [thing(*place)], np.array([-15.0]), scans, trimesh.Trimesh())
    assert one.unseen < 0.02
    assert seen_trial.pairs_of(0, [], np.array([]), scans, trimesh.Trimesh()) == []


def test_columns_hold_the_pairs():
    """Two, of which one was found: sums of chances by the coefficients for their tissue, and their mean squared error."""
    pairs = [Pair(0, 10, 8, 1.0, *place, np.nan, np.nan, found) for *place, found in ((4, 2, 0, 0, 1), (2, 1, 0.1, 1, 0))]
    figures = seen_trial.figures(pairs)
    chance = [float(detectability.probability(pair.features)) for pair in pairs]
    assert (figures["pairs"], figures["found"]) == (2, 1) and figures["expected"] == pytest.approx(sum(chance))
    assert figures["brier"] == pytest.approx(((1 - chance[0]) ** 2 + chance[1] ** 2) / 2)
    assert [figures[f"pair01_{name}"] for name in ("detectability", "resolved", "unseen", "bright", "found")] == [2, 1, 0.1, 1, 0]


def test_a_breast_that_shows_no_mass_has_no_pairs():
    assert seen_trial.figures([]) == {"pairs": 0, "found": 0, "expected": 0, "brier": 0}


@pytest.mark.slow
def test_a_dark_mass_is_found_where_all_of_it_was_seen(settings, scanners, monkeypatch):
    """One of 12 mm and 12 dB in a short stroke, the first half of which leaves most of it out."""
    kind = seen_trial.KINDS["silicone"]
    stroke = kind.path.model_copy(update={"start_mm": (4.0, -26.0), "end_mm": (4.0, 8.0), "strokes": 1})
    middle = (0.0, 0.0, 30.0)
    drawn = replace(SILICONE, count=(1, 1), size_mm=(12, 12.01), contrast_db=(12, 12.01), bright=0, low_mm=middle, high_mm=middle)
    monkeypatch.setitem(seen_trial.KINDS, "silicone", replace(kind, path=stroke))
    monkeypatch.setattr(seen_trial, "SILICONE", drawn)
    figures = seen_trial.measure(settings.model_copy(update={"ultrasound": scanners["linear"]}), 2)
    assert figures["pairs"] == len(WAYS)
    whole, cut = f"pair{WAYS.index('all'):02d}", f"pair{WAYS.index('first'):02d}"
    assert figures[f"{whole}_found"] == 1 and figures[f"{whole}_unseen"] < 0.02
    assert figures[f"{cut}_found"] == 0 and figures[f"{cut}_unseen"] > 0.3
