"""The lag between images and poses is found far below a frame, with an interval that holds it."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from recon.errors import InputError
from recon.geometry import rigid
from recon.model import tracks
from recon.model.fan import Fan
from recon.model.tracks import Track
from recon.probe_calibration import latency
from tests.recon import bscans

FRAME_S = 0.05
START_NS = 10**18  # of a clock: seconds since 1970
POSE_NOISE_MM, DEPTH_NOISE_PX = 0.05, 0.3


def height(t):
    """Of the probe, mm: up and down by 15 mm in about 2.5 s, at an uneven pace."""
    return 15 * np.sin(2 * np.pi * (0.4 * t + 0.25 * np.sin(0.5 * t))) + 4 * np.sin(1.4 * t + 1)


def nanoseconds(seconds):
    return START_NS + np.round(np.asarray(seconds) * 1e9).astype(np.int64)


def track_of(seconds, heights):
    return Track(nanoseconds(seconds), np.array([rigid.transform(np.eye(3), [5, -3, 700 + h]) for h in heights]))


def streams(true_lag, rng, jitter_s=0.005, dropped=0.1, outliers=0.0):
    """Time stamps and depths of the images, and the track, of 20 s at 20 frames/s; each stream loses frames of its own."""
    moments = np.arange(0.013, 20, FRAME_S)
    heights = height(moments) + POSE_NOISE_MM * rng.standard_normal(len(moments))
    heights[rng.random(len(moments)) < 0.05] = np.nan
    tracked = rng.random(len(moments)) > dropped
    shown = np.arange(0, 20, FRAME_S)
    depths = (60 - height(shown)) / bscans.MM_PER_PX + DEPTH_NOISE_PX * rng.standard_normal(len(shown))
    wrong = rng.random(len(shown)) < outliers
    depths[wrong] = rng.uniform(50, 400, wrong.sum())
    kept = rng.random(len(shown)) > dropped
    stamps = shown + true_lag + jitter_s * rng.standard_normal(len(shown))
    return nanoseconds(stamps[kept]), depths[kept], track_of(moments[tracked], heights[tracked])


@pytest.mark.parametrize("true_lag", [0.0, 0.033, 0.1, 0.2])
def test_the_lag_is_found_to_a_tenth_of_a_frame(rng, true_lag):
    found = latency.estimate(*streams(true_lag, rng))
    assert abs(found.seconds - true_lag) < 0.002  # 5 sigma; the bar is 0.005
    assert found.sigma_s < 0.0006  # 5 ms of jitter in 360 frames are 0.3 ms
    assert found.jitter_s == pytest.approx(0.005, abs=0.0012)


@pytest.mark.parametrize("outliers", [0.0, 0.1])
def test_the_interval_holds_the_truth(rng, outliers):
    """At least 20 of 24 intervals of 95 %: fewer have a chance of 0.6 %."""
    inside = 0
    for _ in range(24):
        true_lag = rng.uniform(0, 0.2)
        found = latency.estimate(*streams(true_lag, rng, outliers=outliers))
        assert abs(found.seconds - true_lag) < 0.005
        inside += found.interval_s[0] <= true_lag <= found.interval_s[1]
    assert inside >= 20


def test_clocks_that_started_apart(rng):
    times, depths, track = streams(0.1, rng)
    late = np.int64(4_000_000_000_000)
    found = latency.estimate(times + late, depths, track, (3999.0, 4001.0))
    assert found.seconds == pytest.approx(4000.1, abs=0.005)
    with pytest.raises(InputError, match="are the clocks others"):
        latency.estimate(times + late, depths, track)


def test_images_are_put_where_the_probe_was(rng):
    """Within the poses' noise and 2 ms of a motion of up to 60 mm/s."""
    times, depths, track = streams(0.15, rng, jitter_s=0.0)
    poses = tracks.poses_at(track, times, latency.estimate(times, depths, track).seconds)
    truth = 700 + height((times - START_NS) * 1e-9 - 0.15)
    off = poses[:, 2, 3] - truth
    assert np.nanmax(np.abs(off)) < 1.0  # a straight line across a gap of 0.2 s
    assert np.sqrt(np.nanmean(off**2)) < 0.2
    uncorrected = tracks.poses_at(track, times, 0.0)[:, 2, 3] - truth
    assert np.sqrt(np.nanmean(uncorrected**2)) > 2.0


def test_a_hand_that_tilts_moves_the_target_and_not_the_lag(rng):
    """The target stands 120 mm off the array; tilts of 1 deg in step with the motion alone would shift the lag by 20 ms."""
    t = np.arange(0.013, 20, 0.025)

    def pose(t):
        turn = np.deg2rad(np.column_stack([np.sin(0.9 * t), 1.0 * np.cos(2.5 * t + 1.5 * np.sin(0.5 * t)), np.sin(0.7 * t)]))
        made = np.array([rigid.from_rotation_vector(each, [0, 0, 0]) for each in turn])
        made[:, :3, 3] = (
            np.column_stack([0 * t, 0 * t, 700 + height(t)]) + made[:, :3, 0] * 120
        )  # the array's middle moves up and down
        return made

    noisy = pose(t)
    noisy[:, :3, 3] += POSE_NOISE_MM * rng.standard_normal((len(t), 3))
    shown = np.arange(0, 20, FRAME_S)
    depths = (60 - height(shown)) / bscans.MM_PER_PX + DEPTH_NOISE_PX * rng.standard_normal(len(shown))
    stamps = shown + 0.1 + 0.005 * rng.standard_normal(len(shown))
    found = latency.estimate(nanoseconds(stamps), depths, Track(nanoseconds(t), noisy))
    assert abs(found.seconds - 0.1) < 0.003
    assert found.interval_s[0] <= 0.1 <= found.interval_s[1]
    assert found.depth_sigma < 1.5


def carried(faces, turns: Rotation):
    """Poses : (n, 4, 4) of a target that stands 120 mm off the array's faces : (n, 3) mm."""
    targets = faces - turns.apply([10, 120, -20])
    return np.array([rigid.transform(*each) for each in zip(turns.as_matrix(), targets, strict=True)])


def test_tilts_of_some_degrees_within_a_second_do_not_shift_the_lag():
    """Over twelve hands that tilt by 4 deg about a probe held at 10 deg; without products the lag is off by 1.2 ms."""
    errors, normal = [], []
    for seed in range(12):
        rng, t = np.random.default_rng(seed), np.arange(0, 12, 0.025)
        paces, begins = rng.uniform(0.3, 1.0, (3, 1)), rng.uniform(0, 2 * np.pi, (3, 1))
        turns = Rotation.from_rotvec(np.deg2rad(4 * np.sin(2 * np.pi * paces * t + begins).T + 10 * rng.standard_normal(3)))
        faces = np.column_stack([0 * t, 0 * t, height(t)])  # 45 mm above a bottom that is level
        depths = (45 - faces[:, 2]) / turns.as_matrix()[:, 2, 2]
        poses = carried(faces, turns)
        poses[:, :3, 3] += POSE_NOISE_MM * rng.standard_normal((len(t), 3))
        shown = np.arange(0.2, 11.8, FRAME_S)
        seen = np.interp(shown, t, depths) / bscans.MM_PER_PX + DEPTH_NOISE_PX * rng.standard_normal(len(shown))
        found = latency.estimate(nanoseconds(shown + 0.05), seen, Track(nanoseconds(t), poses))
        errors.append(found.seconds - 0.05)
        normal.append(errors[-1] / found.sigma_s)
    assert np.sqrt(np.mean(np.square(errors))) < 0.0004 and np.sqrt(np.mean(np.square(normal))) < 1.6


@pytest.mark.parametrize("gives_mm", [-0.3, 0.3])
def test_a_bracket_that_gives_moves_the_bottom_and_not_the_lag(rng, gives_mm):
    """By 0.3 mm over 5 s of an uneven motion; without a trend it would look like a lag of 0.65 ms."""
    t, found = np.arange(0, 5, FRAME_S), []
    for given in (0.0, gives_mm):
        depths = (60 - height(t) + given * t / 5) / bscans.MM_PER_PX
        found.append(latency.estimate(nanoseconds(t + 0.05), depths, track_of(t, height(t))))
    assert [one.seconds for one in found] == pytest.approx([0.05, 0.05], abs=1e-4)
    assert [one.trend_mm for one in found] == pytest.approx([0.0, gives_mm], abs=0.02)


@pytest.mark.parametrize(("stroke", "seconds"), [
    (lambda t: 6 * (t - 2) ** 2, 4.0),  # whose speed is a trend
    (lambda t: 15 * np.sin(np.pi * t / 3), 3.0),
])  # fmt: skip
def test_one_stroke_is_not_taken_for_a_bracket_that_gives(stroke, seconds):
    """Of some strokes a trend can't be told from a lag: what a bracket usually gives bounds the error, and is in its sigma."""
    normal, errors = [], []
    for seed in range(10):
        rng, t = np.random.default_rng(seed), np.arange(0, seconds, FRAME_S)
        depths = (60 - stroke(t)) / bscans.MM_PER_PX + DEPTH_NOISE_PX * rng.standard_normal(len(t))
        stamps = t + 0.05 + 0.005 * rng.standard_normal(len(t))
        found = latency.estimate(nanoseconds(stamps), depths, track_of(t, stroke(t)))
        errors.append(found.seconds - 0.05)
        normal.append(errors[-1] / found.sigma_s)
    assert np.abs(errors).max() < 0.012 and np.sqrt(np.mean(np.square(normal))) < 1.6


def test_errors_that_neighbours_share_widen_the_interval(rng):
    """Depths that are off alike for 0.15 s, by 1 px: the lag's standard deviation is that of its errors, in 40 sweeps of 10 s."""
    normal = []
    for _ in range(40):
        t = np.arange(0, 10, FRAME_S)
        noise = np.repeat(rng.standard_normal(-(-len(t) // 3)), 3)[: len(t)]
        depths = (60 - height(t)) / bscans.MM_PER_PX + noise
        found = latency.estimate(nanoseconds(t + 0.05), depths, track_of(t, height(t)))
        normal.append((found.seconds - 0.05) / found.sigma_s)
    assert np.sqrt(np.mean(np.square(normal))) < 1.4  # 3.5 sigma of chi-square; by independent errors it would be 1.9


def refused(named, heights, depths, search_s=latency.SEARCH_S):
    t = np.arange(0, 20, FRAME_S)
    with pytest.raises(InputError, match=named) as raised:
        latency.estimate(nanoseconds(t), depths(t), track_of(t, heights(t)), search_s)
    assert "\n" not in str(raised.value)


def test_a_probe_at_rest_has_no_lag():
    refused("up-and-down motion of at least", lambda t: 0 * t, height)


def test_a_motion_that_repeats_itself_is_ambiguous():
    refused("repeats itself", lambda t: 10 * np.sin(9.4 * t), lambda t: 10 * np.sin(9.4 * (t - 0.1)))


def test_depths_of_another_motion_are_refused(rng):
    refused("follow the probe's height", height, lambda t: 10 * np.sin(1.9 * t + 2))
    refused("follow the probe's height", height, lambda t: rng.standard_normal(len(t)))


def test_tilts_do_not_explain_depths_of_another_motion():
    """A hand that tilts by 4 deg has up to fifteen slopes; of 20 sweeps with 12 mm of another motion two may look like a lag."""
    refused = 0
    for seed in range(20):
        rng, t = np.random.default_rng(seed), np.arange(0, 6, 0.025)
        paces, begins = rng.uniform(0.3, 1.0, (5, 1)), rng.uniform(0, 2 * np.pi, (5, 1))
        swings = np.sin(2 * np.pi * paces * t + begins)
        turns = Rotation.from_rotvec(np.deg2rad(4 * swings[:3].T))
        poses = carried(np.column_stack([0 * t, 0 * t, height(t)]), turns)
        depths = (60 - height(t) + 12 * swings[3] + 6 * swings[4]) / bscans.MM_PER_PX
        try:
            latency.estimate(nanoseconds(t[::2] + 0.05), depths[::2], Track(nanoseconds(t), poses))
        except InputError:
            refused += 1
    assert refused >= 18


def test_a_lag_outside_the_search_is_refused():
    refused("lag within -0.1 to 0.1 s", height, lambda t: height(t - 0.15), (-0.1, 0.1))


def test_a_lag_that_does_not_settle_or_leaves_the_search_is_refused(rng):
    """Begun 1 s off, the fit goes 50 ms a round; begun within a search that ends before the lag, it goes to the lag."""
    times, depths, track = streams(0.1, rng)
    (coordinates, sizes), seconds = latency._coordinates(track), (times - track.times[0]) * 1e-9
    moments = (track.times[track.found] - track.times[0]) * 1e-9
    spline = latency._smooth(moments, coordinates)
    with pytest.raises(InputError, match="depths: expected "):
        latency._refined(seconds, depths, moments, spline, sizes, 1.1, (-2, 2))
    with pytest.raises(InputError, match=r"search_s: expected the lag within -0.5 to 0.09 s, found 0.\d+ s"):
        latency._refined(seconds, depths, moments, spline, sizes, 0.08, (-0.5, 0.09))


def test_too_few_images_are_refused():
    refused("at least 20 images", height, lambda t: np.where(t < 0.9, height(t), np.nan))


@pytest.mark.parametrize("slope", [0.0, 0.15, -0.1])
def test_the_bottom_is_followed_to_a_tenth_of_a_pixel(rng, slope):
    """But for a constant: what lies behind the bottom draws its echo down by the same at all depths."""
    depths = rng.uniform(100, 370, 8)
    found = [latency.bottom_depth(bscans.image(bscans.bottom(depth, slope, -10) + bscans.face(), rng)) for depth in depths]
    off = np.array(found) - depths
    assert np.abs(off - np.median(off)).max() < 0.1
    assert abs(np.median(off)) < 0.5


def test_of_a_fan_the_columns_under_its_face_tell_the_bottom(rng):
    """What lies beside the fan is bright on the screen; where the fan begins the face rings; its corners lie too low."""
    fan = Fan(160.0, -100.0, 130.0, 480.0, -30.0, 30.0)
    part = fan.mask((bscans.SIZE[1], bscans.SIZE[0]))
    v, u = np.mgrid[: bscans.SIZE[1], : bscans.SIZE[0]]
    ring = 0.8 * np.exp(-(np.hypot(u - fan.u, v - fan.v) - fan.first_px) / 10)
    for depth in (110, 200, 330):
        image = bscans.image(bscans.bottom(depth, 0.05) + ring, rng)
        image[~part] = 240
        assert abs(latency.bottom_depth(image, part=part) - depth) < 0.5
        assert np.isnan(latency.bottom_depth(np.where(part, 20, image).astype(np.uint8), part=part))


def test_where_there_is_no_bottom(rng):
    for amplitude in (0 * bscans.face(), bscans.face(), bscans.spot((160, 200))):
        assert np.isnan(latency.bottom_depth(bscans.image(amplitude, rng)))


def test_the_bottom_is_found_behind_a_wire_and_before_its_own_reverberation(rng):
    amplitude = bscans.spot((160, 150)) + bscans.bottom(200) + bscans.bottom(400, peak_db=-10)
    assert abs(latency.bottom_depth(bscans.image(amplitude, rng)) - 200) < 0.5
