from dataclasses import replace

import numpy as np
import pytest
from scipy.special import chdtri

from recon.errors import InputError
from recon.estimation.equations import Step
from recon.geometry import rigid
from recon.model.probe import ProbeCalibration
from recon.probe_calibration import point_calibration, probe_checks, surface_calibration
from recon.probe_calibration.lateness import RATE_S
from recon.probe_calibration.point_calibration import Noise
from recon.probe_calibration.surface_calibration import CurveSightings, Wall
from tests.recon import surface_sights
from tests.recon.probe_motions import foreign_probe, true_probe
from tests.recon.surface_sights import BALL, RADIUS, SIZE, WALL

NINE = np.array([(u, v) for u in (0, 160, 320) for v in (0, 204, 407)], float)
LEVEL = Wall(np.array([0, 0, -1.0]), WALL.middle)
KINDS = [(WALL, None), (BALL, RADIUS)]
NAMES = ["wall", "sphere"]


def away(found: ProbeCalibration, true: ProbeCalibration) -> np.ndarray:
    """Errors : (9, 3) mm of the places of pixels at corners, edges and the middle."""
    return found.to_target(NINE) - true.to_target(NINE)


def exact(probe, surface, rng, mirror=0.0, **motion) -> CurveSightings:
    poses = surface_sights.poses_over(probe, surface, rng, **motion)
    pixels = surface_sights.curves_of(probe, surface, poses, mirror)
    n, k = pixels.shape[:2]
    return CurveSightings(poses, pixels, np.broadcast_to(1e-4 * np.eye(k), (n, k, k)).copy())


@pytest.mark.parametrize(("surface", "radius"), KINDS, ids=NAMES)
def test_exact_curves_give_the_probe_back(surface, radius, rig, rng):
    """No design is needed."""
    probe, radius = true_probe(rig), radius and (radius[0], 1e-3)
    found = surface_calibration.calibrate(exact(probe, surface, rng, count=40), SIZE, radius, Noise(0.01, 0.01))
    assert np.abs(away(found.calibration, probe)).max() < 1e-4
    assert found.mirror[0] == pytest.approx(0, abs=1e-4)
    assert not found.outliers.any() and found.rms_mm < 1e-4


@pytest.mark.parametrize(("surface", "radius"), KINDS, ids=NAMES)
def test_the_share_of_a_mirror_is_found(surface, radius, rig, rng):
    """A smooth surface is seen to some 12 degrees; its echo then comes from up to 0.7 mm nearer."""
    probe, radius = true_probe(rig), radius and (radius[0], 1e-3)
    seen = exact(probe, surface, rng, mirror=0.8, tilt=12.0, rock=12.0, miss=4.0)
    found = surface_calibration.calibrate(seen, SIZE, radius, Noise(0.01, 0.01))
    assert found.mirror[0] == pytest.approx(0.8, abs=0.03)
    assert np.abs(away(found.calibration, probe)).max() < 0.1


def test_probes_on_other_brackets_need_no_design(rng):
    """Any bracket and scale, from one image size to another."""
    for _ in range(3):
        _, probe = foreign_probe(rng)
        probe = replace(probe, scale=probe.scale * 48 / (probe.scale[1] * SIZE[1]))
        for surface, radius in KINDS:
            seen = exact(probe, surface, rng, tilt=25.0, rock=10.0, depth=(15.0, 30.0))
            found = surface_calibration.calibrate(seen, SIZE, radius, Noise(0.01, 0.01))
            assert np.abs(away(found.calibration, probe)).max() < 0.02


@pytest.mark.parametrize(("surface", "radius"), KINDS, ids=NAMES)
def test_slopes_are_those_of_differences(surface, radius, rig, rng):
    """With a mirror's share that goes with the tilt, but for what is of third order in that."""
    del radius
    probe, noise = true_probe(rig), Noise()
    frames = surface_sights.observe(probe, surface, rng, count=5)
    there = surface_calibration._Estimate(probe.target_from_image, probe.scale, surface, 0.7)
    slopes = surface_calibration._linear(there, frames, noise).slopes
    for k in range(slopes.shape[-1]):
        ends = []
        for side in (-1, 1):
            step = np.zeros(slopes.shape[-1])
            step[k] = side * 1e-5
            ends.append(surface_calibration._linear(there.moved(Step(step, np.zeros((0, 0)))), frames, noise).distances)
        assert slopes[..., k] == pytest.approx((ends[1] - ends[0]) / 2e-5, abs=3e-2 * np.abs(slopes[..., k]).max() + 1e-6)


def normalised_errors(surface, radius, rig, sets: int) -> tuple[np.ndarray, np.ndarray]:
    """Errors : (sets, 9, 3) of places over their standard deviations, and lengths : (sets,) mm of the greatest."""
    probe, errors, lengths = true_probe(rig), [], []
    for k in range(sets):
        rng = np.random.default_rng(k)
        true = surface if radius is None else replace(surface, radius=radius[0] + radius[1] * rng.standard_normal())
        nearer_mm = surface_calibration.NEARER_SIGMA_MM * rng.standard_normal()
        seen = surface_sights.observe(probe, true, rng, nearer_mm=nearer_mm)
        found = surface_calibration.calibrate(seen, SIZE, radius, max_sigma_mm=5.0).calibration
        off, covariance = away(found, probe), point_calibration.point_covariance(found, NINE)
        errors.append(off / np.sqrt(np.diagonal(covariance, axis1=1, axis2=2)))
        lengths.append(np.linalg.norm(off, axis=1).max())
    return np.array(errors), np.array(lengths)


@pytest.mark.slow
@pytest.mark.parametrize(("surface", "radius"), KINDS, ids=NAMES)
def test_sigma_is_the_error(surface, radius, rig):
    """Of 24 sets with a tracker's noise of 0.05 mm and 0.05 deg; numbers of one set go together, so RMS of 1 is known to 13 %.

    Half of all sets place the worst of nine pixels to 0.25 mm.
    """
    normalised, lengths = normalised_errors(surface, radius, rig, 24)
    assert 0.8 < np.sqrt(np.mean(normalised**2)) < 1.25
    assert np.median(lengths) < 0.25


@pytest.mark.parametrize(("surface", "radius"), KINDS, ids=NAMES)
def test_wrong_frames_are_left_out(surface, radius, rig, rng):
    """A fifth of the frames show another surface."""
    probe = true_probe(rig)
    seen = surface_sights.observe(probe, surface, rng)
    wrong = rng.permutation(100)[:20]
    seen.pixels[wrong, :, 1] += rng.uniform(20, 80, (20, 1))
    found = surface_calibration.calibrate(seen, SIZE, radius)
    assert found.outliers[wrong].all() and found.outliers.sum() < 23
    assert np.linalg.norm(away(found.calibration, probe), axis=1).max() < 0.6


@pytest.mark.parametrize(("surface", "radius", "motion", "lacks"), [
    (LEVEL, None, {"tilt": 0.5}, "hardly any tilts about the array, out of the image's plane, 0"),
    (LEVEL, None, {"rock": 0.05}, "hardly any tilts in the image's plane, 0"),
    (BALL, RADIUS, {"miss": 0.2, "roll": 0.5, "tilt": 0.5}, "turns about one axis only"),
])  # fmt: skip
def test_a_missing_motion_is_named(surface, radius, motion, lacks, rig, rng):
    seen = surface_sights.observe(true_probe(rig), surface, rng, **motion)
    with pytest.raises(InputError, match=f"^motion: expected pixels to be placed to 0.5 mm .*{lacks}"):
        surface_calibration.calibrate(seen, SIZE, radius, max_sigma_mm=0.5)


def mirrored(seen):
    pixels = seen.pixels * [-1, 1] + [SIZE[0] - 1, 0]
    return replace(seen, pixels=pixels[:, ::-1], row_covariance=seen.row_covariance[:, ::-1, ::-1])


def upside_down(seen):
    return replace(seen, pixels=seen.pixels * [1, -1] + [0, SIZE[1] - 1])


def in_metres(seen):
    poses = seen.poses.copy()
    poses[:, :3, 3] /= 1e3
    return replace(seen, poses=poses)


def inverted(seen):
    return replace(seen, poses=np.linalg.inv(seen.poses))


def late(seen, lag_s=0.2):
    """B-scans 0.2 s behind poses of a hand at some 20 mm/s and 10 deg/s."""
    rng = np.random.default_rng(0)
    speeds = rng.standard_normal((len(seen.poses), 6)) * np.repeat([np.radians(6), 12], 3)
    poses = np.stack([rigid.moved(pose, lag_s * speed) for pose, speed in zip(seen.poses, speeds, strict=True)])
    later = np.stack([rigid.moved(pose, 1e-3 * speed) for pose, speed in zip(poses, speeds, strict=True)])
    return replace(seen, poses=poses, pose_rates=(later - poses) / 1e-3)


@pytest.mark.parametrize(("wrong", "said"), [
    (mirrored, "as if the image is mirrored left to right"),
    (in_metres, "found poses in m: read so, they are"),
    pytest.param(late, "found B-scans late by about 0.20 s beyond lag_s", marks=pytest.mark.slow),
])  # fmt: skip
@pytest.mark.parametrize(("surface", "radius"), KINDS, ids=NAMES)
def test_mistakes_are_named(surface, radius, wrong, said, rig, rng):
    probe = true_probe(rig)
    seen = wrong(surface_sights.observe(probe, surface, rng, count=60))
    with pytest.raises(InputError, match=said):
        surface_calibration.calibrate(seen, SIZE, radius, expected=probe.target_from_image)


@pytest.mark.slow
def test_inverse_poses_are_named_of_a_wall_and_refused_of_a_sphere(rig, rng):
    probe = true_probe(rig)
    with pytest.raises(InputError, match="found poses of target_from_world, the inverse"):
        surface_calibration.calibrate(inverted(surface_sights.observe(probe, WALL, rng)), SIZE)
    with pytest.raises(InputError):
        surface_calibration.calibrate(inverted(surface_sights.observe(probe, BALL, rng)), SIZE, RADIUS)


def test_a_wall_upside_down_is_named_and_a_sphere_refused(rig, rng):
    """The hollow arcs of a sphere aren't even looked at where they come from images."""
    probe = true_probe(rig)
    with pytest.raises(InputError, match="as if the image is upside down"):
        surface_calibration.calibrate(upside_down(exact(probe, WALL, rng)), SIZE, expected=probe.target_from_image)
    with pytest.raises(InputError, match=r"expected frames of a sphere of 19\.8 mm at rest"):
        surface_calibration.calibrate(upside_down(exact(probe, BALL, rng)), SIZE, RADIUS, expected=probe.target_from_image)


@pytest.mark.parametrize("factor", [*(pytest.param(factor, marks=pytest.mark.slow) for factor in (0.5, 1.1, 2.0)), 0.9])
def test_a_wrong_radius_is_refused(factor, rig, rng):
    seen = surface_sights.observe(true_probe(rig), BALL, rng)
    with pytest.raises(
        InputError, match=r"^(sphere_radius_mm: expected the sphere's radius|sightings: expected frames of a sphere)"
    ):
        surface_calibration.calibrate(seen, SIZE, (factor * RADIUS[0], 0.05))


@pytest.mark.parametrize(("surface", "radius"), KINDS, ids=NAMES)
def test_a_small_lag_is_told_with_its_size(surface, radius, rig, rng):
    """20 ms at 20 mm/s: less than the noise of a frame."""
    seen = late(surface_sights.observe(true_probe(rig), surface, rng), 0.02)
    found = surface_calibration.calibrate(seen, SIZE, radius)
    assert found.late.sigma_s < 0.002 and abs(found.late.seconds - 0.02) < 4 * found.late.sigma_s
    assert any("the B-scans are late by" in doubt for doubt in found.doubts())


@pytest.mark.parametrize(("surface", "radius"), KINDS, ids=NAMES)
def test_a_probe_at_rest_leaves_the_lag_open(surface, radius, rig, rng):
    """Rates of noise alone, of poses 0.1 s apart, would seem to tell it to 10 ms."""
    seen = surface_sights.observe(true_probe(rig), surface, rng)
    before, after = (surface_sights.noisy(seen.poses, seen.pixels, rng).poses for _ in range(2))
    found = surface_calibration.calibrate(replace(seen, pose_rates=(after - before) / (2 * RATE_S)), SIZE, radius)
    assert found.late.sigma_s > 0.03 and not found.late.shown


@pytest.mark.slow
@pytest.mark.parametrize(("surface", "radius"), KINDS, ids=NAMES)
def test_sigma_of_the_lag_is_its_error(surface, radius, rig):
    """Of 18 sets with rates that have the noise of two poses; a larger lag would count as noise, too."""
    probe, noise, squared = true_probe(rig), Noise(surface_sights.ANGLE_DEG, surface_sights.POSITION_MM), 0.0
    for k in range(18):
        rng = np.random.default_rng([k, 9])
        seen = late(surface_sights.observe(probe, surface, rng), 0.001)
        before, after = (surface_sights.noisy(seen.poses, seen.pixels, rng).poses for _ in range(2))
        rates = seen.pose_rates + (after - before) / (2 * RATE_S)
        found = surface_calibration.calibrate(replace(seen, pose_rates=rates), SIZE, radius, noise, max_sigma_mm=5.0).late
        squared += ((found.seconds - 0.001) / found.sigma_s) ** 2
    assert chdtri(18, 1 - 1e-4) < squared < chdtri(18, 1e-4)


@pytest.mark.parametrize(("surface", "radius"), KINDS, ids=NAMES)
def test_a_slipping_bracket_is_told(surface, radius, rig, rng):
    """By 2 degrees and 2 mm half-way; the error that remains is in sigma."""
    probe = true_probe(rig)
    poses = surface_sights.poses_over(probe, surface, rng)
    slipped = replace(probe, target_from_image=rigid.moved(probe.target_from_image, [0.02, -0.02, 0.02, 1, 1, -1]))
    before, after = (surface_sights.curves_of(each, surface, poses) for each in (probe, slipped))
    seen = surface_sights.noisy(poses, np.concatenate([before[:50], after[50:]]), rng)
    found = surface_calibration.calibrate(seen, SIZE, radius, max_sigma_mm=20.0)
    assert any("the probe moved against its target" in doubt for doubt in found.doubts())
    assert found.persistence < 1.5  # what is left has the noise of each frame alone
    covariance = point_calibration.point_covariance(found.calibration, NINE)
    off = [away(found.calibration, each) / np.sqrt(np.diagonal(covariance, axis1=1, axis2=2)) for each in (probe, slipped)]
    assert max(np.sqrt(np.mean(each**2)) for each in off) < 2


def test_too_few_frames_and_no_poses_are_refused(rig, rng):
    seen = surface_sights.observe(true_probe(rig), WALL, rng, count=9)
    with pytest.raises(InputError, match="expected at least 10 frames with a pose and the surface, found 9"):
        surface_calibration.calibrate(seen, SIZE)
    seen = surface_sights.observe(true_probe(rig), WALL, rng)
    seen.poses[3, :3, 0] *= -1
    with pytest.raises(InputError, match=f"poses: frame 3: expected {probe_checks.rigid.RIGID}"):
        surface_calibration.calibrate(seen, SIZE)
