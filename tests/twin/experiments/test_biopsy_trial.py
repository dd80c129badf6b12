"""Virtual biopsies: misses whose distribution is known, and the parts that they are made of."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy import stats

from scenes.acoustics import TISSUES
from sonotwin.config import defaults
from sonotwin.experiment_settings import settings_of
from twin.experiments import biopsy_trial
from twin.experiments.drawn_session import Drawn
from twin.experiments.experiment_runs import Biopsy, Settings

MANY = 4000
EXACT = Drawn(**dict.fromkeys(Drawn.model_fields, 0.0))


@pytest.fixture(scope="module")
def settings() -> Settings:
    return Settings.model_validate(settings_of(defaults("study")))


@pytest.fixture
def apart(monkeypatch):
    """Sessions and needles without errors: what is left is the patient's, the hand's and the needle's own."""
    session = SimpleNamespace(true_probe=SimpleNamespace(scale=np.ones(2)))
    monkeypatch.setattr(biopsy_trial.drawn_session, "draw", lambda *_: session)
    monkeypatch.setattr(biopsy_trial, "in_tissue", lambda found, *_: found)
    monkeypatch.setattr(biopsy_trial.chain_trial, "mass_error", lambda _: np.zeros(3))
    monkeypatch.setattr(biopsy_trial, "tip_error", lambda *_: np.zeros(3))


def z_of_share(values: list[float], expected: float) -> float:
    return (np.mean(values) - expected) / np.sqrt(expected * (1 - expected) / len(values))


def test_shares_by_the_hand_alone_are_maxwells(settings, apart, monkeypatch):
    """Of normal errors along three axes; no error at all is within any distance."""
    for name in ("DEFLECTED_MM", "PRESSED_MM", "HELD_MM"):
        monkeypatch.setattr(biopsy_trial, name, 0.0)
    monkeypatch.setattr(biopsy_trial, "PUSHED_MM", {"mixed": 0.0})
    for hand, sigma in (("novice", biopsy_trial.AIM_MM["novice"]), ("exact", 0.0)):
        biopsy = Biopsy(hand=hand, segmented_mm=0.0)
        trials = [biopsy_trial.measure(settings.model_copy(update={"biopsy": biopsy}), seed) for seed in range(MANY)]
        for limit in (2, 3):
            share = [one[f"within_{limit}mm"] for one in trials]
            if sigma:
                assert abs(z_of_share(share, float(stats.maxwell.cdf(limit / sigma)))) < 4
            else:
                assert all(share) and max(one["miss_mm"] for one in trials) == 0


def test_a_needle_bends_across_its_way_and_pushes_along_it(settings, apart):
    """By 0.9 mm in the mean, across; the mass moves along the needle and towards the cameras, farther in soft tissue."""
    parts = [biopsy_trial.draw(settings, seed) for seed in range(MANY)]
    bent, moved = (np.array([getattr(one, name) for one in parts]) for name in ("deflected", "moved"))
    assert np.linalg.norm(bent, axis=1).mean() == pytest.approx(0.9, rel=4 * 0.52 / np.sqrt(MANY))
    assert abs(np.einsum("ni,ni->n", bent, moved).mean()) < 0.05, "by chance alone"
    fatty = settings.model_copy(update={"biopsy": Biopsy(tissue="fatty")})
    softer = np.array([biopsy_trial.draw(fatty, seed).moved for seed in range(500)])
    assert softer[:, 0].std() > 1.2 * moved[:500, 0].std()


def test_the_speed_of_sound_of_a_breast_is_that_of_its_fat_and_gland(monkeypatch):
    """Of a mixed one as it is taken; a fatty one is slower by 2 %, so that its depths are shown too deep."""
    monkeypatch.setattr(biopsy_trial, "GLAND_SIGMA", 0.0)
    monkeypatch.setattr(biopsy_trial, "replace", lambda thing, **new: SimpleNamespace(**vars(thing) | new))
    found = SimpleNamespace(true_probe=SimpleNamespace(scale=np.array([0.1, 0.1])))
    rng, fat, gland = np.random.default_rng(0), TISSUES["fat"].speed, TISSUES["gland"].speed
    seen = {kind: biopsy_trial.in_tissue(found, Biopsy(tissue=kind), rng).true_probe.scale for kind in biopsy_trial.GLAND}
    assert seen["mixed"] == pytest.approx([0.1, 0.1])
    assert seen["fatty"] == pytest.approx([0.1, 0.1 * (0.85 * fat + 0.15 * gland) / (0.55 * fat + 0.45 * gland)])
    assert seen["fatty"][1] < 0.1 < seen["dense"][1]


def test_exact_measurements_place_mass_and_needle(settings):
    """To 0.02 mm, but for the speed of this patient's tissue, which shows her mass up to 0.5 mm off in depth."""
    exact = settings.model_copy(
        update={"noise": settings.noise.model_copy(update={"drawn": EXACT}), "biopsy": Biopsy(hand="exact")}
    )
    parts = [biopsy_trial.draw(exact, seed) for seed in range(2)]
    assert max(np.linalg.norm(one.tip) for one in parts) < 0.02
    for one in parts:
        assert np.linalg.norm(one.planned[:2]) < 0.02 and abs(one.planned[2]) < 0.5


def test_a_tool_turns_about_its_tip(rng):
    """To each side, its face within 55 degrees of the cameras."""
    place, eyes = np.array([3.0, -4.0, 650.0]), np.array([50.0, 0.0, 0.0])
    poses = biopsy_trial.about(np.array(biopsy_trial.TIP_MM), place, eyes, 200, rng)
    tips = poses[:, :3, :3] @ biopsy_trial.TIP_MM + poses[:, :3, 3]
    assert tips == pytest.approx(np.tile(place, (200, 1)))
    towards = (eyes - place) / np.linalg.norm(eyes - place)
    tilts = np.degrees(np.arccos(poses[:, :3, 2] @ towards))
    assert tilts.max() < 55 and np.ptp(tilts) > 20
