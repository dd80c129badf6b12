"""Rehearsed sessions: figures of made-up calibrations and detections whose answers are known, and one that is rendered."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from recon.errors import InputError
from recon.geometry import rigid
from recon.model.calibration import Uncertainty
from recon.model.probe import NAMES, ProbeCalibration
from recon.probe_calibration import sound_in_water
from recon.probe_calibration.cross_wire import Appearance
from scenes.acoustics import TISSUES, WATER_C
from sonotwin.config import defaults
from sonotwin.experiment_settings import settings_of
from twin.experiments import drawn_rig, rehearsal
from twin.experiments.closed_forms import brightness_noise
from twin.experiments.experiment_runs import Settings
from twin.experiments.probe_accuracy import squared_length
from twin.experiments.rehearsal import Seen, Wires
from twin.sensor import Exposure
from twin.ultrasound.probe_path import crossing
from twin.ultrasound.sweep_session import calibration_of
from twin.working_range import working_range

SIZE = (321, 408)
HELD = rigid.from_rotation_vector(np.array([0.3, -1.2, 0.4]), np.array([20.0, -15.0, 60.0]))
SHIFT_MM = 0.1  # standard deviation along each axis
SEEN = Seen(circle_px=0.03, crossing_px=1.2, shown=0.6, tracked=0.8)


def shifting(count: int = 1, times: float = 1.0) -> Wires:
    """Calibrations that err by a shift alone, alike along all axes."""
    covariance = np.diag(np.where(np.arange(len(NAMES)) < 5, 1e-16, (times * SHIFT_MM) ** 2))
    one = ProbeCalibration(HELD, np.array([0.12, 0.12]), Uncertainty(NAMES, covariance))
    return Wires((SimpleNamespace(adjustment=SimpleNamespace(calibration=one)),) * count, SEEN)


@pytest.fixture(scope="module")
def settings() -> Settings:
    return Settings.model_validate(settings_of(defaults("study")))


def test_cr1_is_that_of_distances_of_shifts():
    """The distance of two places with normal errors along three axes is sqrt(2) sigma sqrt(8 / pi) in the mean."""
    expected = np.sqrt(2) * SHIFT_MM * np.sqrt(8 / np.pi)
    assert rehearsal.expected_cr1(shifting(), SIZE) == pytest.approx(expected, rel=0.02)
    mixed = Wires(shifting(1, 0.0).results + shifting(1, np.sqrt(2)).results, SEEN)
    assert rehearsal.expected_cr1(mixed, SIZE) == pytest.approx(expected, rel=0.02), "variances are averaged"


@pytest.mark.parametrize("count", [2, 5, 12])
def test_the_scatter_of_cr1_is_that_of_drawn_sets(count, rng):
    """Of 4000 sets of shifts; of two, that of one distance: sqrt(3 pi / 8 - 1) = 0.42."""
    places = rng.standard_normal((4000, count, 3))
    first, second = np.triu_indices(count, 1)
    drawn = np.linalg.norm(places[:, first] - places[:, second], axis=-1).mean(axis=1)
    assert rehearsal.scatter_of_cr1(shifting(3), count, SIZE) == pytest.approx(drawn.std() / drawn.mean(), rel=0.12)


def test_noise_is_told_along_an_axis_whatever_a_few_fingers_cover(rng):
    errors = [0.02, 0.04] * rng.standard_normal((4000, 2)) + [0.3, -0.1]
    errors[:120] += rng.uniform(-5, 5, (120, 2))
    assert rehearsal.of_one_axis(errors) == pytest.approx(np.sqrt((0.02**2 + 0.04**2) / 2), rel=0.08)


def test_sessions_are_drawn_with_the_noise_of_the_rehearsal(settings):
    """Circles and crossings as seen, as many B-scans as are usable; the board's noise is still that of the rig's own images."""
    found = rehearsal.noise_of(settings, Wires((), SEEN))
    assert (found.circle_px, found.crossing_px, found.wires) == (0.03, 1.2, round(0.8 * rehearsal.IMAGES))
    assert found.board_px == settings.noise.at(working_range(settings.rig)).board_px
    assert found.at(replace(working_range(settings.rig), noise=3.0)) == found, "it isn't scaled again"
    assert rehearsal.noise_of(settings, Wires((), SEEN._replace(tracked=0.1))).wires == 6


def test_crossings_err_from_where_they_are_in_the_image(settings):
    """Of wires in water, whose depths are shown too deep by 3.5 %."""
    planned = rehearsal.wires(rehearsal.of_itself(settings, 3), 1)
    poses = planned.plan.truth.poses[:4]
    local = np.stack([rigid.apply(rigid.invert(pose), crossing(planned.scanned)) for pose in poses])
    slower = TISSUES["water"].speed / planned.settings.ultrasound.assumed_speed
    pixels = local[[0, 2], :2] / planned.settings.ultrasound.scale_mm_per_px / [1, slower] + [[1.0, 0.0], [0.0, -2.0]]
    frames = SimpleNamespace(usable=np.array([0, 2]), sightings=SimpleNamespace(pixels=pixels))
    assert rehearsal.crossing_errors(planned, frames) == pytest.approx(np.array([[1.0, 0], [0, -2.0]]), abs=1e-9)
    assert np.abs(local[:, 2]).max() < 4 * settings.wire_path.miss_mm, "the crossing is near the image plane"
    assert planned.settings.ultrasound.gain_db == -40 and len(planned.plan.target.times) == 2 * rehearsal.POSES


def test_calibrations_are_of_poses_of_their_own(settings):
    stage = rehearsal.of_itself(settings, 3)
    turns = [rehearsal.wires(stage, number).plan.truth.poses[:, :3, :3] for number in (0, 1)]
    assert np.abs(turns[0] - turns[1]).max() > 0.1


def test_a_scanner_that_shows_no_crossing_is_refused(settings, monkeypatch):
    monkeypatch.setattr(rehearsal, "POSES", 3)
    planned = rehearsal.wires(rehearsal.of_itself(settings, 3), 0)
    narrow = Appearance(min_contrast_db=200.0)
    with pytest.raises(InputError, match=r"rehearsals: expected 6 B-scans or more .* found 0 in 3 poses"):
        rehearsal.showing(planned, narrow)


def test_poses_at_rest_keep_their_own_pairs_of_frames(settings):
    """Of the second and the fifth pose: two pairs each, at which the probe stands as in the B-scan."""
    planned = rehearsal.wires(rehearsal.of_itself(settings, 3), 0)
    some = rehearsal.at_some(planned, [1, 4])
    assert some.plan.truth.poses == pytest.approx(planned.plan.truth.poses[[1, 4]]) and len(some.plan.target.times) == 4
    held = settings.rig.probe.target_from_image.matrix()
    seen = some.plan.target.poses() @ held
    assert seen == pytest.approx(some.plan.truth.poses[[0, 0, 1, 1]], abs=1e-9)


@pytest.mark.slow
def test_a_rehearsed_calibration_has_the_noise_of_its_sensors_and_the_errors_that_it_says(settings):
    """Circles err by 1 to 5 times what noise alone leaves at their rims, at 690 mm, most of it by the rays of a pixel; the
    probe's eight parameters by 3 sigma at most, in the mean: a chi-square of 8 over 9 times its degrees has no chance.
    """
    rig, _ = drawn_rig.draw(settings.rig, 1)
    stage = rehearsal.of_itself(settings.model_copy(update={"rig": rig}), 1)
    found, exposure, levels = rehearsal.calibrate(stage, 1), Exposure(1.0), settings.film.white_dn * np.array([1.0, 0.05])
    device = rig.cam1
    noise = np.sqrt(np.mean([brightness_noise(device, level, exposure) ** 2 for level in levels]))
    radius = rig.target.outer_diameter_mm / 2 * device.optics.focal_px[0] / 690
    blur = np.hypot(device.lens.blur_px, np.sqrt(1 / 12))
    limit = noise / np.ptp(levels) * np.sqrt(2 * np.sqrt(np.pi) * blur / (np.pi * radius))
    assert 1 < found.seen.circle_px / limit < 5
    assert found.seen.tracked > 0.7 and 0.05 < found.seen.crossing_px < 3
    scanner = calibration_of(rig, settings.ultrasound)
    truth = sound_in_water.in_medium(scanner, scanner.speed_m_s, float(sound_in_water.speed_of_sound(WATER_C)))
    assert squared_length(found.results[0].adjustment.calibration, truth) / 8 < 9
