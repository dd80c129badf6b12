"""The observer: what it depends on, against closed forms, and coefficients that are found again."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.special import expit

from recon.errors import InputError
from recon.geometry import rigid
from recon.segmentation import detectability, insonation
from recon.segmentation.detectability import OBSERVER, Ball, Calibration, Features, Sought, Threshold
from recon.segmentation.mass_network import Looks
from tests.recon.pose_stacks import SHAPE, stack, sweep, voxel


@pytest.fixture(scope="module")
def where():
    return insonation.of_sweep(stack(np.arange(-15, 15.1, 0.5)), SHAPE)


def test_speckle_and_unevenness_limit_the_contrast():
    """Of 100 cells the mean scatters by 0.557 dB; unevenness is as wide within a lobule, and averages over more; 1 dB never."""
    volume = np.pi / 6 * 10**3
    even = detectability.features(Ball(np.ones(1), np.full(1, 100 / volume)), 0.5, Sought(10, 5.57), 0.0)
    assert np.exp(even.detectability) == pytest.approx(5.57 / np.hypot(0.557, 1))
    many = Ball(np.ones(1), np.full(1, 1e9))
    assert np.exp(detectability.features(many, 0.5, Sought(2, 6), 3.0).detectability) == pytest.approx(
        6 / np.hypot(3, 1), rel=1e-3
    )
    lobules = volume / OBSERVER.patch_mm**3
    found = np.exp(detectability.features(many, 0.5, Sought(10, 6), 3.0).detectability)
    assert found == pytest.approx(6 / np.hypot(3 / np.sqrt(lobules), 1), rel=1e-3)
    assert np.exp(even.resolved) == pytest.approx(10 / (2.3548 * 0.5), rel=1e-4)


def test_tissue_of_unknown_unevenness_counts_as_even():
    ball = Ball(np.ones(1), np.full(1, 10.0))
    unknown, even = (detectability.features(ball, 0.5, Sought(), db) for db in (np.nan, OBSERVER.even_db))
    assert unknown == even
    assert detectability.features(ball, 0.5, Sought(), np.inf).detectability == pytest.approx(np.log(OBSERVER.least))


@pytest.mark.parametrize("size", [1.0, 4.0, 8.0, 20.0])
def test_a_ball_has_its_volume(size):
    """The middle voxel's neighbours hold the rest of it; their second moment is that of a ball and of a voxel's parts."""
    weights = detectability.ball_weights(size, np.full(3, 2.0))
    assert weights.sum() == pytest.approx(1, abs=1e-5)
    z = 2.0 * (np.arange(weights.shape[0]) - weights.shape[0] // 2)
    moment = (weights.sum(axis=(1, 2)) * z**2).sum()
    assert moment == pytest.approx(size**2 / 20, abs=0.45), "and about that of a voxel, 4 / 12 mm^2, more at most"


@pytest.mark.parametrize("middle", [[20, 20, 0], [0.5, 20, 0], [20, 38, 12], [2, 5, -14]])
def test_the_seen_share_of_a_ball_is_that_of_its_points(middle, where, rng):
    """By Monte Carlo: points of the ball that lie in the hull below the ringing, to half of a part of a voxel at each side."""
    size, (k, j, i) = 10.0, voxel(where, middle)
    points = rng.uniform(-1, 1, (200_000, 3))
    points = insonation.centres(where.grid)[k, j, i] + size / 2 * points[(points**2).sum(axis=1) < 1]
    inside = (points > [-0.1, 3, -15.25]) & (points < [39.9, 39.9, 15.25])
    assert detectability.ball_means(where, size).seen[k, j, i] == pytest.approx(inside.all(axis=1).mean(), abs=0.04)


def test_larger_masses_of_more_contrast_are_found_sooner(where):
    """In the middle of what was scanned, where even the largest one is whole."""
    at = voxel(where, [20, 20, 0])
    sizes, contrasts = (2.0, 4.0, 6.0, 8.0, 12.0, 20.0), (0.5, 2.5, 5.0, 8.0, 15.0)
    table = np.empty((len(sizes), len(contrasts)))
    for row, size in enumerate(sizes):
        ball = Ball(*(field[at] for field in detectability.ball_means(where, size)))
        for column, contrast in enumerate(contrasts):
            given = detectability.features(ball, where.elevational_mm[at], Sought(size, contrast), 2.0)
            table[row, column] = detectability.probability(given)
    assert (np.diff(table, axis=0) > -1e-6).all() and (np.diff(table, axis=1) > 0).all()
    assert table[-1, -1] > 0.8 and table[0, 0] < 0.01


def test_more_b_scans_never_lower_the_probability(rng):
    matrices = sweep(rng, 24)
    tally = insonation.begin(insonation.grid_around(matrices, SHAPE), SHAPE)
    before = np.zeros(tally.sums.count.shape)
    for number, matrix in enumerate(matrices[rng.permutation(len(matrices))]):
        insonation.add(tally, matrix)
        if number % 4 == 3:
            found = insonation.insonation(tally)
            given = detectability.features(detectability.ball_means(found, 8.0), found.elevational_mm, Sought())
            after = detectability.probability(given)
            assert (after >= before - 1e-4).all()  # what single precision leaves
            before = after


def test_features_at_places_are_those_of_the_map(where):
    """Of trials; a mass beyond the grid was not seen."""
    places = np.array([[20.0, 20, 0], [20, 20, 0], [1, 20, 0], [500, 0, 0]])
    found = detectability.features_at(where, places, [8, 4, 8, 8], [8, 5, 8, 8], [False, True, False, False], 1.2)
    for n, (place, size, contrast, bright) in enumerate(zip(places[:3], (8, 4, 8), (8, 5, 8), (False, True, False), strict=True)):
        at = voxel(where, place)
        ball = Ball(*(field[at] for field in detectability.ball_means(where, size)))
        alone = detectability.features(ball, where.elevational_mm[at], Sought(size, contrast, bright), 1.2)
        np.testing.assert_allclose([one[n] for one in found], alone, atol=1e-6)
    assert found.unseen[3] == 1 and detectability.probability(found)[3] < 1e-6
    with pytest.raises(InputError, match="places: expected numbers of shape"):
        detectability.features_at(where, np.zeros(3), 8.0, 8.0)
    with pytest.raises(InputError, match="masses: expected sizes above 0 mm"):
        detectability.features_at(where, np.zeros((1, 3)), 0.0, 8.0)


def trials(rng, count=6000):
    """Features of masses that differ in all of them."""
    unseen = np.maximum(rng.normal(0, 0.08, count), 0)
    return Features(rng.normal(2, 1, count), rng.normal(1.5, 0.5, count), unseen, (rng.random(count) < 0.3).astype(float))


TRUE = Calibration(2.0, 0.5, Threshold(1.2, 3.0), Threshold(1.0, 4.0), Threshold(0.05, -60.0))


def flat(calibration):
    """All coefficients, in their order."""
    return np.array(list(calibration.coefficients.values()))


def test_coefficients_are_found_again(rng):
    """Each within four of its standard errors, by the information of the trials, from finite differences."""
    given, values = trials(rng), flat(TRUE)
    share = detectability.probability(given, TRUE)
    found = detectability.fit(given, rng.random(len(share)) < share)

    def of(values):
        thresholds = [Threshold(*values[n : n + 2]) for n in (2, 4, 6)]
        return detectability.probability(given, Calibration(*values[:2], *thresholds))

    steps = 1e-4 * np.abs(values)
    design = np.stack([(of(values + step) - of(values - step)) / 2 / step.sum() for step in np.diag(steps)])
    sigma = np.sqrt(np.diag(np.linalg.inv((design / (share * (1 - share))) @ design.T)))
    assert (np.abs(flat(found) - values) < 4 * sigma).all() and found.trials == len(share)
    assert sigma[0] < 0.5


def test_each_condition_has_to_hold():
    """A mass that is seen well is found but for what nothing explains; with one condition half met, in half of these."""
    best = Features(*(np.full(1, value) for value in (9.0, 9.0, -9.0, 0.0)))
    assert detectability.probability(best, TRUE) == pytest.approx(expit(TRUE.dark), rel=1e-6)
    assert detectability.probability(best._replace(bright=np.ones(1)), TRUE) == pytest.approx(expit(TRUE.bright), rel=1e-6)
    for name in ("detectability", "resolved", "unseen"):
        half = best._replace(**{name: np.full(1, getattr(TRUE, name).middle)})
        assert detectability.probability(half, TRUE) == pytest.approx(0.5 * detectability.probability(best, TRUE), rel=1e-6)


def test_a_fit_never_rewards_a_worse_view(rng):
    """Even where trials say so by chance."""
    given, odd = trials(rng, 400), Calibration(2.0, 2.0, Threshold(1.2, -3.0), Threshold(1.0, -4.0), Threshold(0.0, 20.0))
    found = detectability.fit(given, rng.random(400) < detectability.probability(given, odd))
    assert found.detectability.slope >= 0 and found.resolved.slope >= 0 and found.unseen.slope <= 0


def test_trials_that_say_nothing_are_refused(rng):
    given = trials(rng, 50)
    for outcome, why in ((np.ones(50), "some found and some not"), (np.ones(49), "and whether each was found")):
        with pytest.raises(InputError, match=why):
            detectability.fit(given, outcome)


def test_trials_parted_by_a_feature_give_a_finite_fit(rng):
    given = trials(rng, 300)
    found = detectability.fit(given, given.detectability > 2)
    assert np.isfinite(flat(found)).all() and found.detectability.slope > 5
    assert found.detectability.middle == pytest.approx(2, abs=0.2)


def test_grown_tissue_has_its_own_observer(monkeypatch):
    """A network, from the unevenness of breasts on; unless looks count always or never."""
    grown, even = replace(TRUE, trials=900), replace(TRUE, trials=0)
    monkeypatch.setattr(detectability, "GROWN", grown)
    monkeypatch.setattr(detectability, "EVEN", even)
    for uneven_db, when, which in (
        *((0.8, "auto", "even"), (2.4, "auto", "even"), (2.6, "auto", "grown"), (np.nan, "auto", "even")),
        *((0.8, "always", "grown"), (3.4, "never", "even")),
    ):
        chosen = detectability.calibration_for(uneven_db, Looks(when))
        assert chosen is (grown if which == "grown" else even)
    assert detectability.source(grown.trials) == "by coefficients fitted to 900 trials"
    assert detectability.source(even.trials) == "by assumed coefficients"


def test_a_turned_world_has_the_same_map(rng):
    """Probabilities are of places in the body, wherever camera 1 stands."""
    matrices, turn = sweep(rng), rigid.from_rotation_vector([0.4, 1.1, -0.3], [5, 6, 700])
    places = np.array([[20.0, 20, 0], [10, 30, 5], [35, 10, -9]])
    two = [
        detectability.features_at(insonation.of_sweep(turned @ matrices, SHAPE), rigid.apply(turned, places), 8.0, 8.0)
        for turned in (np.eye(4), turn)
    ]
    np.testing.assert_allclose(*two, atol=0.02)
