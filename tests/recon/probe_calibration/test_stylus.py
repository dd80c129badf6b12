"""A probe is calibrated by the tip of a tracked stylus, known or not; another tip or another meaning of poses is named."""

from dataclasses import replace

import numpy as np
import pytest

from recon.capture import tip_files
from recon.errors import InputError
from recon.freehand.sequence_sweep import SequenceSweep
from recon.model import tracks
from recon.model.tip import Tip
from recon.model.tracks import Track
from recon.probe_calibration import needle_echo, point_calibration, repeatability, tank_calibration
from recon.probe_calibration.needle_echo import NeedleEcho
from recon.probe_calibration.phantom_frames import PhantomFrames
from recon.probe_calibration.phantoms import stylus
from recon.probe_calibration.tank_calibration import Settings
from recon.session import probe_step
from tests.recon import needle_scans
from tests.recon.probe_motions import true_probe
from tests.recon.stylus_motions import PIXEL_PX, known_tip, lead, tracked

KNOWN = Settings(phantom="stylus", body="stylus", tip="tip.yaml", tip_radius_sigma_mm=0.0, temperature_c=22)
FREE = Settings(phantom="stylus", body="stylus", tip_radius_sigma_mm=0.0, temperature_c=22)


@pytest.fixture
def probe(rig):
    return true_probe(rig)


@pytest.fixture
def calibrate(rig):
    """A calibration by poses of the target in the stylus' frame and pixels."""

    def by(relative: Track, pixels, tip: Tip | None, settings=KNOWN):
        covariance = np.diag(PIXEL_PX**2)
        seen = [NeedleEcho(pixel, covariance, 30.0) for pixel in pixels]
        sightings = stylus.sight(seen, relative.poses, relative.covariance, None, 0.0)
        numbers, size = np.arange(len(seen)), rig.probe.image_size
        frames = PhantomFrames("stylus", size, sightings, numbers, tuple(seen), 0, "stylus", tip, poses=relative.poses)
        return tank_calibration.calibrate(frames, rig.probe, settings).adjustment

    return by


@pytest.fixture
def led(probe, rig):
    def of(rng, **motion):
        one = lead(probe, rig.probe.image_size, rng, **motion)
        return tracks.from_body(tracked(one.probe, rng), tracked(one.stylus, rng)), one.pixels

    return of


def errors(calibration, probe, rig):
    points = repeatability.five_points(rig.probe.image_size)
    return calibration.to_target(points) - probe.to_target(points)


@pytest.mark.parametrize(("known", "turned"), [(True, 1.0), (False, 1.0), (True, 0.05)])
def test_pixels_are_placed_to_a_quarter_of_a_millimetre(calibrate, led, probe, rig, rng, known, turned):
    """A tip that is known needs no turns."""
    tip = known_tip(rng) if known else None
    found = calibrate(*led(rng, turned=turned), tip, KNOWN if known else FREE)
    assert np.linalg.norm(errors(found.calibration, probe, rig), axis=1).max() < 0.25


@pytest.mark.slow
@pytest.mark.parametrize(("known", "turned"), [(True, 1.0), (False, 1.0), (True, 0.05)])
def test_the_covariance_is_honest(calibrate, led, probe, rig, known, turned):
    """Errors of 24 drawn calibrations in standard deviations: rms of 0.75 to 1.25, less of what may have moved and hasn't."""
    z = []
    for seed in range(24):
        rng = np.random.default_rng(seed)
        tip = known_tip(rng) if known else None
        found = calibrate(*led(rng, turned=turned), tip, KNOWN if known else FREE).calibration
        covariance = point_calibration.point_covariance(found, repeatability.five_points(rig.probe.image_size))
        z.append(errors(found, probe, rig) / np.sqrt(np.diagonal(covariance, axis1=1, axis2=2)))
    assert 0.75 < np.sqrt(np.mean(np.square(z))) < 1.25


def test_noise_of_the_stylus_counts_where_no_pose_has_a_covariance(calibrate, led, rng):
    """0.08 degrees at 150 mm are 0.2 mm: as in poses of both bodies with the same assumed noise."""
    relative, pixels = led(rng)
    noise = np.tile(KNOWN.noise.of_pose, (len(pixels), 1, 1))
    both = tracks.from_body(
        Track(relative.times, relative.poses, noise), Track(relative.times, np.tile(np.eye(4), (len(pixels), 1, 1)), noise)
    )
    without = replace(relative, covariance=None)
    tip = known_tip(rng)
    one, other = (calibrate(each, pixels, tip).calibration.uncertainty.covariance for each in (both, without))
    np.testing.assert_allclose(one, other, rtol=1e-6)


def test_noise_of_the_stylus_counts_at_another_lag_too(led, rig, rng):
    """Of poses at the B-scans' own moments the covariance is the one that is taken without a lag to find."""
    relative, pixels = led(rng)
    numbers, size = np.arange(len(pixels)), rig.probe.image_size
    sweep = SequenceSweep("stylus", size, numbers, 0.1 * numbers, relative.poses, lambda: iter(()))
    seen = tuple(NeedleEcho(pixel, np.diag(PIXEL_PX**2), 30.0) for pixel in pixels)
    frames = PhantomFrames("stylus", size, None, numbers, seen, 0, "stylus", poses=relative.poses)
    found = probe_step.at_lag(frames, sweep, 0.0, 0.0, 0.0, KNOWN.noise).sightings.pose_covariance
    np.testing.assert_allclose(found, KNOWN.noise.from_body(relative.poses), atol=1e-12)


def test_few_frames_have_no_held_out_error_to_describe(calibrate, led, rng):
    """Halves of nine frames are too few for a calibration."""
    relative, pixels = led(rng, count=9)
    found = calibrate(relative, pixels, known_tip(rng))
    assert not any("nan" in line for line in stylus.describe(found, KNOWN))


def test_a_tip_that_is_elsewhere_is_named(calibrate, led, rng):
    relative, pixels = led(rng)
    tip = known_tip(rng)
    with pytest.raises(
        InputError, match=r"tip: expected the tip in the B-scans where its file has it, found it 2\.\d ± 0\.\d mm"
    ):
        calibrate(relative, pixels, replace(tip, tip_mm=tip.tip_mm + np.array([0, 0, 3.0])))


def test_another_bodys_tip_is_refused_by_its_name(tmp_path, rng):
    tip_files.write(tmp_path / "tip.yaml", known_tip(rng))
    given = {"phantom": "stylus", "tip": tmp_path / "tip.yaml"}
    assert stylus.read(Settings(**given, body="stylus"), None).body == "stylus"
    with pytest.raises(InputError, match="body: expected the tip of needle, found that of stylus"):
        stylus.read(Settings(**given, body="needle"), None)
    with pytest.raises(InputError, match="body: expected the stylus' name"):
        stylus.read(Settings(phantom="stylus"), None)
    assert stylus.read(Settings(phantom="stylus"), "Stylus") is None


@pytest.mark.parametrize(("name", "value", "owner"), [
    ("tip_radius_mm", 0.5, "stylus"),
    ("tip_radius_sigma_mm", 0.1, "stylus"),
    ("sphere_radius_mm", 19.8, "sphere"),
    ("sphere_radius_sigma_mm", 0.1, "sphere"),
])  # fmt: skip
def test_fields_of_another_phantom_are_refused(name, value, owner):
    with pytest.raises(ValueError, match=f"{name}: expected none with phantom=crossed_wires, found {value}: phantom={owner}"):
        Settings(**{name: value})
    assert getattr(Settings(phantom=owner, **{name: value}), name) == value


def _metres(poses):
    poses[:, :3, 3] *= 1e-3
    return poses


@pytest.mark.slow
@pytest.mark.parametrize(("change", "named"), [
    (lambda poses, pixels: (poses, [320, 0] + pixels * [-1, 1]), "but as if the image is mirrored left to right"),
    (lambda poses, pixels: (poses, [0, 407] + pixels * [1, -1]), "but as if the image is upside down"),
    (lambda poses, pixels: (_metres(poses), pixels), "are the poses in mm"),
    (lambda poses, pixels: (np.linalg.inv(poses), pixels), "likely poses of target_from_world, the inverse"),
    (lambda poses, pixels: (np.roll(poses, 2, axis=0), pixels), "likely B-scans (late|early) by 2 of the poses"),
])  # fmt: skip
def test_other_meanings_of_poses_and_images_are_refused(calibrate, led, rng, change, named):
    relative, pixels = led(rng)
    poses, seen = change(relative.poses.copy(), pixels)
    with pytest.raises(InputError, match=named):
        calibrate(replace(relative, poses=poses), seen, known_tip(rng))


def test_the_phantom_finds_a_needles_tip():
    tip = np.array([22.0, 28.0, 0.0])
    scan = needle_scans.image("water", needle_scans.rod(tip, 30.0))
    seen = stylus.find(scan, None, None)
    assert isinstance(seen, needle_echo.NeedleEcho)
    assert np.linalg.norm((seen.pixel - needle_scans.echo_of(tip, "water")) * needle_scans.SCALE) < 0.3
