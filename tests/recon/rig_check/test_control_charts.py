"""Control charts: false alarms as seldom as stated, whatever the calibration's error, and drift found when theory says."""

from datetime import UTC, datetime, timedelta

import numpy as np
import pytest
from scipy import stats

from recon.rig_check import control_charts
from recon.rig_check.check_log import Check, Entry, Estimate

FIRST = datetime(2026, 5, 4, 8, 12, tzinfo=UTC)
SIGMA = {"clock": np.array([1e-3]), "target": np.full(3, 0.02), "cam2": np.repeat([1e-4, 0.03], 3)}  # of a check


def estimates(rng, part, days, claimed=10.0, drift=None, calibration="first"):
    """Checks of one calibration, whose error is as claimed, in standard deviations of a check, which vary by a third."""
    sigma, k = SIGMA[part], len(SIGMA[part])
    axes = np.linalg.qr(rng.standard_normal((k, k)))[0]
    error = claimed * sigma * rng.standard_normal(k)
    drift, found = np.zeros(days) if drift is None else drift, []
    for moved in drift:
        noise = sigma[:, None] * axes * rng.uniform(2 / 3, 4 / 3, k)
        own = noise @ noise.T
        motion = error + noise @ rng.standard_normal(k) + moved * sigma * np.eye(k)[0]
        matrices = {"own": own.tolist(), "common": np.diag((claimed * sigma) ** 2).tolist()}
        found.append(Estimate.model_construct(motion=tuple(motion), **matrices, against=calibration))
    return found


def logged(part, course, first=0) -> list[Check]:
    """A log with a check a day; a day without an estimate is of an earlier version."""
    entries = [Entry.model_construct(part=part, state="good", sigma=0.5, estimate=one, rivals=()) for one in course]
    days = (FIRST + timedelta(days=first + day) for day in range(len(entries)))
    return [Check.model_construct(time=day, name="x", parts=(one,), rig=None) for day, one in zip(days, entries, strict=True)]


def first_beyond(values, limit):
    """The number of the first one beyond a limit."""
    return int(np.argmax(np.append(values, np.inf) > limit)) + 1


@pytest.mark.parametrize(
    ("dimension", "limit", "checks"), [(1, 3.73, 168), (2, 5.5, 200), (5, 9.46, 200), (10, 14.9, 200), (20, 24.7, 200)]
)
def test_run_lengths_are_those_of_tables(dimension, limit, checks):
    """Crosier 1986, 1988; the latter's limits are rounded, and were drawn: to 5 %."""
    assert control_charts.run_length(limit, dimension) == pytest.approx(checks, rel=0.05)


def test_a_chart_alarms_as_seldom_as_a_verdict():
    """Both together as seldom as a normal number is beyond 3.2: once in 728; the sum's limit is of this very run length."""
    limits = control_charts.limits(6, 3.2)
    assert limits.run_length == pytest.approx(2 * 728, rel=1e-3)
    assert control_charts.run_length(limits.cusum, 6) == pytest.approx(limits.run_length, rel=1e-3)
    assert control_charts.limits(1, 20.0).run_length == pytest.approx(1e6)


@pytest.mark.parametrize("part", ["clock", "target", "cam2"])
def test_in_control_run_lengths_are_as_stated(rng, part):
    """Of 150 rigs whose calibration errs by ten times a check's noise, to 4 standard deviations of their mean."""
    limits, lengths = control_charts.limits(len(SIGMA[part]), 1.2), []
    square = stats.chi2.isf(1 / limits.run_length, len(SIGMA[part]))
    for _ in range(150):
        steps = control_charts.innovations(estimates(rng, part, 45))
        sums = np.linalg.norm(control_charts.cumulative_sums(steps), axis=1)
        lengths.append((first_beyond(np.sum(steps**2, axis=1), square), first_beyond(sums, limits.cusum)))
    assert limits.run_length == pytest.approx(8.69, abs=0.01)
    mean, error = np.mean(lengths, axis=0), np.std(lengths, axis=0) / np.sqrt(150)
    assert (np.abs(mean - limits.run_length) < 4 * error).all() and (error < 1).all()


def test_the_calibrations_error_would_alarm_if_days_were_independent(rng):
    """By each check's own noise nine rigs of ten are beyond 3.2 sigma on a day; beside the days before few."""
    alone, charted = [], []
    for _ in range(100):
        course = estimates(rng, "cam2", 10)
        own = np.linalg.cholesky(np.array(course[-1].own))
        alone.append(np.linalg.norm(np.linalg.solve(own, np.array(course[-1].motion))) > np.sqrt(22.5))
        charted.append(control_charts.charts(logged("cam2", course), 3.2)[0].out)
    assert np.mean(alone) > 0.9 and np.mean(charted) < 0.05


def test_innovations_are_independent_standard_normal_numbers(rng):
    """Of 200 rigs over 10 days: mean squares, and products of neighbours, to 5 standard deviations."""
    steps = np.array([control_charts.innovations(estimates(rng, "target", 10)) for _ in range(200)])
    squares, products = np.mean(steps**2, axis=(0, 2)), np.mean(steps[:, 1:] * steps[:, :-1], axis=(0, 2))
    assert np.abs(squares - 1).max() < 5 * np.sqrt(2 / 600) and np.abs(products).max() < 5 / np.sqrt(600)


@pytest.mark.parametrize(("step", "drift"), [(2.0, 0.0), (0.0, 0.3)])
def test_a_step_and_drift_are_found_when_theory_says(rng, step, drift):
    """Of an exact calibration, to 8 %, which is three standard deviations of 400 rigs beside what the formulas neglect.

    A step of 2 sigma by Siegmund 1985; drift of 0.3 sigma a check where the sum of its means less the allowance is the limit.
    """
    limit = control_charts.limits(1, 3.2).cusum
    over = step - control_charts.ALLOWANCE
    by_step = (2 * over * (limit + 1.166) - 1) / (2 * over**2)
    by_drift = float(np.roots([drift / 2, drift / 2 - control_charts.ALLOWANCE, -limit]).max()) if drift else 0.0
    means = step + drift * np.arange(1, 41)[:, None]
    sums = [np.abs(control_charts.cumulative_sums(means + rng.standard_normal((40, 1))))[:, 0] for _ in range(400)]
    found = [first_beyond(one, limit) for one in sums]
    assert np.mean(found) == pytest.approx(by_step if step else by_drift, rel=0.08)


def test_drift_far_below_a_days_alarm_is_found_and_told(rng):
    """A tenth of a sigma a day for 30 days after 30 still ones: begun within 10 days of that, and as far as it went."""
    still, slow = np.zeros(30), 0.1 * np.arange(1, 31)
    course = estimates(rng, "cam2", 60, drift=np.concatenate([still, slow]))
    chart = control_charts.charts(logged("cam2", course), 3.2)[0]
    assert chart.out and chart.sigma.max() < chart.limits.sigma
    assert abs((chart.change.since - FIRST).days - 29) <= 10 and chart.change.even
    off = (chart.change.motion - slow[-1] * SIGMA["cam2"] * np.eye(6)[0]) / SIGMA["cam2"]
    assert np.abs(off).max() < 1.5
    assert chart.told.startswith(f"since {chart.change.since:%Y-%m-%d}, evenly in ") and "turned by 0.0" in chart.told


def test_a_step_is_told_from_drift(rng):
    course = estimates(rng, "clock", 40, drift=np.repeat([0.0, 4.0], 20))
    chart = control_charts.charts(logged("clock", course), 3.2)[0]
    assert chart.out and not chart.change.even and (chart.change.since - FIRST).days == 19
    assert chart.change.motion[0] == pytest.approx(4e-3, abs=5e-3 / np.sqrt(10)) and ", at once: +" in chart.told


def test_the_best_part_is_named_with_its_rivals(rng):
    """Camera 2 steps by 4 sigma; camera 1 seems to by as much, the target by less; the clock is of other measurements."""
    out = np.repeat([0.0, 4.0], 10)
    made = {part: estimates(rng, part, 20, 1.0, out * share) for part, share in (("cam2", 1.0), ("target", 0.6), ("clock", 1.0))}
    charts = [control_charts.charts(logged(part, course), 3.2)[0] for part, course in made.items()]
    twin = charts[0]._replace(part="cam1", change=charts[0].change._replace(gain=charts[0].change.gain - 1))
    named = [[one.part for one in rivals] for rivals in control_charts.drifting([twin, *charts])]
    assert named == [["cam2", "cam1"], ["clock"]]


@pytest.mark.parametrize(("likelihood", "named"), [(19.0, ["cam2", "cam1"]), (21.0, ["cam2"])])
def test_rivals_explain_all_within_20_to_1(rng, likelihood, named):
    """Camera 1 is out of control by a step of its own, of a likelihood below camera 2's: 2 log of it, of chi-square."""
    chart = control_charts.charts(logged("cam2", estimates(rng, "cam2", 20, 1.0, np.repeat([0.0, 4.0], 10))), 3.2)[0]
    gain = chart.change.gain - 2 * np.log(likelihood)
    other = chart._replace(part="cam1", change=chart.change._replace(gain=gain))
    assert other.out and [[one.part for one in rivals] for rivals in control_charts.drifting([other, chart])] == [named]


def test_a_new_calibration_begins_a_chart(rng):
    """Its error is another, by which the old chart would be out."""
    old, new = (estimates(rng, "clock", 10, calibration=name) for name in ("first", "second"))
    chart = control_charts.charts(logged("clock", [*old, *new]), 3.2)[0]
    assert len(chart.times) == 10 and chart.times[0] == FIRST + timedelta(days=10)
    mixed = [one for pair in zip(old, new, strict=True) for one in pair]
    assert len(control_charts.charts(logged("clock", mixed), 3.2)[0].times) == 10
    taken_for_one = [one.model_copy(update={"against": "first"}) for one in new]
    assert control_charts.charts(logged("clock", [*old, *taken_for_one]), 3.2)[0].out and not chart.out


def test_checks_without_motions_are_left_out(rng):
    """Of earlier versions; no chart is of a lone check, or of a part that the last check doesn't show."""
    course = estimates(rng, "clock", 5)
    assert len(control_charts.charts(logged("clock", [None, None, *course]), 3.2)[0].times) == 5
    for others in ([None, None], [None, course[0]], [*course, None]):
        assert control_charts.charts(logged("clock", others), 3.2) == []
    assert control_charts.charts([], 3.2) == []


def test_what_no_check_shows_stays_at_zero(rng):
    """A direction without variance, as of a projector along its fringes; and two checks of one second."""
    course = []
    for one in estimates(rng, "target", 6):
        blind = np.diag([1.0, 1.0, 0.0])
        parts = {"common": (blind @ one.common @ blind).tolist(), "own": (blind @ one.own @ blind).tolist()}
        course.append(one.model_copy(update={"motion": tuple(blind @ one.motion), **parts}))
    steps = control_charts.innovations(course)
    assert np.abs(steps[:, 2]).max() < 1e-6 and np.isfinite(steps).all()
    log = [made.model_copy(update={"time": FIRST}) for made in logged("target", course)]
    chart = control_charts.charts(log, 3.2)[0]
    assert np.isfinite(chart.change.motion).all()
    assert chart.limits == control_charts.limits(2, 3.2) != control_charts.limits(3, 3.2)


@pytest.mark.parametrize("turned", [False, True])
def test_a_blind_direction_is_no_freedom(rng, turned):
    """Along an axis or aslant, however small the directions are that are seen; sigmas as of a check, beside a calibration's."""
    axes = np.linalg.qr(rng.standard_normal((6, 6)))[0] if turned else np.eye(6)
    for variances, shown in (([1, 1, 1, 1, 1, 0], 5), ([1, 1, 1, 1, 1, 1e-4], 6), ([1, 0, 1, 0, 1, 1], 4)):
        unit = np.outer(SIGMA["cam2"], SIGMA["cam2"])
        assert control_charts.freedom(axes * variances @ axes.T * unit) == shown


def test_the_same_recording_checked_again_is_no_other_day(rng):
    """Of 20 rigs whose third day is 3 sigma off, checked 10 times more: taken for days, which differ by more, more alarm."""
    out = {1e-8: 0, 1e-3: 0}
    for _ in range(20):
        course = estimates(rng, "target", 3, 0.1, np.array([0.0, 0.0, 3.0]))
        log = logged("target", course)
        alone = control_charts.charts(log, 3.2)[0]
        for off, repeated in ((1e-8, 10), (1e-3, 0)):
            moved = course[-1].motion + off * SIGMA["target"] * rng.standard_normal((10, 3))
            again = [course[-1].model_copy(update={"motion": tuple(one)}) for one in moved]
            chart = control_charts.charts([*log, *logged("target", again, 3)], 3.2)[0]
            assert len(chart.repeated) == repeated and len(chart.times) == 13 - repeated
            assert chart.times == alone.times or not repeated
            out[off] += chart.out
    assert out[1e-3] >= out[1e-8] + 4


def test_a_recording_checked_twice_alone_makes_no_chart(rng):
    """Nor does another covariance of the same motion count as the same recording."""
    one = estimates(rng, "clock", 1)[0]
    surer = one.model_copy(update={"own": [[0.9 * one.own[0][0]]]})
    assert control_charts.charts(logged("clock", [one, one]), 3.2) == []
    assert len(control_charts.charts(logged("clock", [one, surer]), 3.2)[0].times) == 2
