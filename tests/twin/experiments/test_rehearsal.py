"""Rehearsed sessions: figures of made-up calibrations and detections whose answers are known, and one that is rendered."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.typing import NDArray

from recon.errors import InputError
from recon.geometry import rigid
from recon.probe_calibration import repeatability, sound_in_water
from recon.probe_calibration.cross_wire import Appearance
from recon.probe_calibration.point_calibration import Sightings
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

Array = NDArray[np.float64]
SIGMA_RAD, SIGMA_MM, SIGMA_PX = 3e-4, 0.02, 1.0
SEEN = Seen(circle_px=0.03, crossing_px=1.2, shown=0.6, tracked=0.8)


@pytest.fixture(scope="module")
def settings() -> Settings:
    return Settings.model_validate(settings_of(defaults("study")))


def shown(settings: Settings, number: int, rng: np.random.Generator) -> tuple[Array, Array, Array]:
    """Poses : (n, 4, 4) world_from_target, and pixels : (n, 2) of the crossing, with the scale of depths in water.

    Four of five poses show it, and the target is lost in some of these.
    """
    planned = rehearsal.wires(rehearsal.of_itself(settings, 3), number)
    poses = planned.plan.truth.poses
    poses = poses[rng.random(len(poses)) < 0.8][: rehearsal.IMAGES]
    poses = poses[rng.random(len(poses)) < 0.95]
    local = np.stack([rigid.apply(rigid.invert(pose), crossing(planned.scanned)) for pose in poses])
    scale = np.array(settings.rig.probe.scale_mm_per_px)
    return poses @ np.linalg.inv(settings.rig.probe.target_from_image.matrix()), local[:, :2] / scale, scale


def propagated(settings: Settings, poses: Array, pixels: Array, scale: Array, points: Array) -> Array:
    """Covariances : (k, 3, 3) of places of points by least squares, by slopes of the equation, which are differences."""
    held = settings.rig.probe.target_from_image.matrix()

    def place(x: Array, at: Array) -> Array:
        return rigid.apply(rigid.moved(held, x[2:8]), np.pad(at * (scale + x[:2]), [(0, 0), (0, 1)]))

    def residuals(x: Array) -> Array:
        return np.einsum("nij,nj->ni", poses[:, :3, :3], place(x, pixels)) + poses[:, :3, 3] - x[8:]

    steps = np.diag([1e-6] * 2 + [1e-5] * 3 + [1e-3] * 6)
    slopes = np.stack([(residuals(h) - residuals(-h)) / (2 * h.sum()) for h in steps], axis=-1)
    turns = poses[:, :3, :3] @ held[:3, :3]
    by_turn = np.stack([rigid.cross(poses[k, :3, :3] @ arm) for k, arm in enumerate(place(np.zeros(11), pixels))])
    noise = turns @ np.diag([*(SIGMA_PX * scale) ** 2, settings.wire_path.miss_mm**2]) @ np.swapaxes(turns, 1, 2)
    noise += SIGMA_MM**2 * np.eye(3) + SIGMA_RAD**2 * by_turn @ np.swapaxes(by_turn, 1, 2)
    known = np.linalg.inv(np.einsum("nij,nik,nkl->jl", slopes, np.linalg.inv(noise), slopes))[:8, :8]
    of_points = np.stack([(place(h, points) - place(-h, points)) / (2 * h.sum()) for h in steps[:8]], axis=-1)
    return of_points @ known @ np.swapaxes(of_points, 1, 2)


def test_cr1_of_mixtures_is_that_of_least_squares_however_few_are_mixed(settings, rng, monkeypatch):
    """Of eight calibrations by their own poses, and of these two by two, in the mean of four: to 10 %, 1 sigma.

    Frames from anywhere in the image would leave some corner empty, and their CR1 would be larger.
    """
    monkeypatch.setattr(rehearsal, "MIXTURES", 20)
    size, of_pose = settings.rig.probe.image_size, np.array([SIGMA_RAD] * 3 + [SIGMA_MM] * 3)
    sightings, covariances = [], []
    for number in range(8):
        poses, pixels, scale = shown(settings, number, rng)
        covariances.append(propagated(settings, poses, pixels, scale, repeatability.five_points(size)))
        steps, errors = rng.standard_normal((len(poses), 6)) * of_pose, SIGMA_PX * rng.standard_normal(pixels.shape)
        sightings.append(
            Sightings(
                np.stack([rigid.moved(*each) for each in zip(poses, steps, strict=True)]),
                pixels + errors,
                np.tile(np.diag(of_pose**2), (len(poses), 1, 1)),
                np.tile(SIGMA_PX**2 * np.eye(2), (len(poses), 1, 1)),
            )
        )

    def cr1(some: list[Sightings]) -> rehearsal.Repeatability:
        return rehearsal.repeatability_of(rehearsal.mixtures(some, settings.rig.probe), len(some), size)

    expected = repeatability.expected_cr1(np.array(covariances)).mean()
    found = cr1(sightings)
    assert found.mm == pytest.approx(expected, rel=0.2)
    assert 0.08 < found.of_few < 0.3 and found.known == pytest.approx(found.of_few * np.sqrt(4 / 7))
    by_two = [cr1(sightings[first : first + 2]).mm for first in range(0, 8, 2)]
    assert np.mean(by_two) == pytest.approx(expected, rel=0.2)


def test_mixtures_go_from_corner_to_corner_as_a_calibration_and_have_no_frame_twice(settings, rng, monkeypatch):
    mixed, middle = [], np.array(settings.rig.probe.image_size) / 2
    monkeypatch.setattr(
        rehearsal.point_calibration, "calibrate", lambda seen, *_, **__: mixed.append(seen) or SimpleNamespace(calibration=None)
    )
    sightings = [Sightings(*shown(settings, number, rng)[:2]) for number in range(3)]
    rehearsal.mixtures(sightings, settings.rig.probe)
    ways, expected = ([(one.pixels > middle).tolist() for one in some] for some in (mixed, sightings))
    assert all(way in expected for way in ways) and all(way in ways for way in expected)
    assert all(len(np.unique(one.poses, axis=0)) == len(one.poses) for one in mixed)


def test_calibrations_without_errors_place_the_image_where_it_is(settings, rng, monkeypatch):
    """The wires' echo comes from before their axes, in water, whose depths are shown too deep by 3.5 %."""
    monkeypatch.setattr(rehearsal, "MIXTURES", 2)
    exact = settings.model_copy(update={"wire_path": settings.wire_path.model_copy(update={"miss_mm": 0.0})})
    slower = TISSUES["water"].speed / settings.ultrasound.assumed_speed
    ahead, sightings = rehearsal.TANK.echo_ahead_mm, []
    for number in range(2):
        poses, pixels, scale = shown(exact, number, rng)
        sightings.append(Sightings(poses, (pixels - [0.0, ahead / scale[1]]) / [1.0, slower]))
    mixed = rehearsal.mixtures(sightings, settings.rig.probe)
    assert rehearsal.place_error(rehearsal.of_itself(exact, 3), mixed) < 1e-3 < ahead / 40


def test_noise_is_told_along_an_axis_whatever_a_few_fingers_cover(rng):
    errors = [0.02, 0.04] * rng.standard_normal((4000, 2)) + [0.3, -0.1]
    errors[:120] += rng.uniform(-5, 5, (120, 2))
    assert rehearsal.of_one_axis(errors) == pytest.approx(np.sqrt((0.02**2 + 0.04**2) / 2), rel=0.08)


def test_sessions_are_drawn_with_the_noise_of_the_rehearsal(settings):
    """Circles and crossings as seen, as many B-scans as are usable; the board's noise is still that of the rig's own images."""
    found = rehearsal.noise_of(settings, Wires((), SEEN, ()))
    assert (found.circle_px, found.crossing_px, found.wires) == (0.03, 1.2, round(0.8 * rehearsal.IMAGES))
    assert found.board_px == settings.noise.at(working_range(settings.rig)).board_px
    assert found.at(replace(working_range(settings.rig), noise=3.0)) == found, "it isn't scaled again"
    assert rehearsal.noise_of(settings, Wires((), SEEN._replace(tracked=0.1), ())).wires == 6


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
