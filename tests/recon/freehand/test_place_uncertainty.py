"""Are the predicted errors of pixels' places those that poses, probe, latency and speed of sound make?"""

import numpy as np
import pytest

from recon.freehand import place_uncertainty, sequences
from recon.freehand.place_uncertainty import PlaceErrors
from recon.freehand.volume_compounding import Grid
from recon.geometry import rigid
from recon.model.calibration import Uncertainty
from recon.model.probe import NAMES, ProbeCalibration
from recon.probe_calibration import point_calibration, sound_in_water

SHAPE = (408, 321)
PIXELS = np.array([[0.0, 0.0], [160.0, 200.0], [320.0, 407.0]])


@pytest.fixture
def pose():
    return rigid.from_rotation_vector([0.4, -0.3, 2.0], [30, -20, 640])


def probe_of(rig, half):
    scale = np.array(rig.probe.scale_mm_per_px)
    return ProbeCalibration(rig.probe.target_from_image.matrix(), scale, Uncertainty(NAMES, half @ half.T))


def test_places_scatter_as_predicted(rig, pose, rng):
    """4000 draws of all errors together, each part of which counts: to 4 %, four standard deviations of the draws' own."""
    half = np.diag([2e-4, 3e-4, 2e-3, 2e-3, 2e-3, 0.05, 0.05, 0.05]) @ (np.eye(8) + 0.3 * rng.standard_normal((8, 8)))
    own, shared = (np.diag([size] * 3 + [0.04] * 3) @ (np.eye(6) + 0.3 * rng.standard_normal((6, 6))) for size in (4e-4, 7e-4))
    probe, velocity = probe_of(rig, half), np.array([8.0, -15.0, 4.0])
    placed = pose @ sequences.target_from_pixel(probe)
    rates = np.zeros((1, 4, 4))
    rates[0, :3, 3] = velocity
    errors = PlaceErrors((own @ own.T)[None], np.eye(1), (shared @ shared.T)[None], rates, lag_s=0.003, depth=0.004)
    predicted = place_uncertainty.sigmas(place_uncertainty.forms(placed[None], probe, errors)[0], PIXELS)
    places = []
    for step in rng.standard_normal((4000, 22)):
        by_probe = half @ step[:8]
        drawn = ProbeCalibration(rigid.moved(probe.target_from_image, by_probe[2:]), probe.scale + by_probe[:2], speed_m_s=1540)
        drawn = sound_in_water.in_medium(drawn, 1540, 1540 * (1 + 0.004 * step[20]))
        moved = rigid.moved(rigid.moved(pose, own @ step[8:14]), shared @ step[14:20])
        moved[:3, 3] += velocity * 0.003 * step[21]
        places.append(rigid.apply(moved, drawn.to_target(PIXELS)))
    scatter = np.sqrt(np.var(places, axis=0).sum(axis=1))
    assert scatter == pytest.approx(predicted, rel=0.04)


def test_a_mean_over_b_scans_scatters_as_predicted(rig, pose, rng):
    """Of 3 B-scans of 5, with poses of their own and errors that all share: 4000 draws, to 4 %."""
    half = np.diag([2e-4, 3e-4, 2e-3, 2e-3, 2e-3, 0.05, 0.05, 0.05]) @ (np.eye(8) + 0.3 * rng.standard_normal((8, 8)))
    own = np.diag([4e-4] * 3 + [0.04] * 3) @ (np.eye(6) + 0.3 * rng.standard_normal((6, 6)))
    probe, used = probe_of(rig, half), np.array([0, 2, 3])
    true = np.stack([rigid.moved(pose, 0.1 * rng.standard_normal(6)) for _ in range(5)])
    placed, rates = true @ sequences.target_from_pixel(probe), np.zeros((5, 4, 4))
    rates[:, :3, 3] = [8.0, -15.0, 4.0]
    errors = PlaceErrors(np.tile(own @ own.T, (5, 1, 1)), np.eye(5), np.zeros((5, 6, 6)), rates, lag_s=0.003, depth=0.004)
    directions = rng.standard_normal((3, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    predicted = place_uncertainty.mean_sigma(placed, probe, errors, used, PIXELS, directions)
    means = []
    for _ in range(4000):
        step = rng.standard_normal(10)
        by_probe = half @ step[:8]
        drawn = ProbeCalibration(rigid.moved(probe.target_from_image, by_probe[2:]), probe.scale + by_probe[:2], speed_m_s=1540)
        at = sound_in_water.in_medium(drawn, 1540, 1540 * (1 + 0.004 * step[8])).to_target(PIXELS)
        lagged = rates[0, :3, 3] * 0.003 * step[9]
        places = [
            rigid.apply(rigid.moved(true[k], own @ rng.standard_normal(6)), at[[j]])[0] + lagged for j, k in enumerate(used)
        ]
        means.append(np.mean(np.sum(places * directions, axis=1)))
    assert np.std(means) == pytest.approx(predicted, rel=0.04)


def test_a_cut_image_keeps_its_places_and_their_errors(rig, pose, rng):
    half = np.diag([2e-4, 3e-4, 2e-3, 2e-3, 2e-3, 0.05, 0.05, 0.05]) @ (np.eye(8) + 0.3 * rng.standard_normal((8, 8)))
    whole = probe_of(rig, half)
    cut = place_uncertainty.from_pixel(whole, (60, 90))
    assert np.abs(cut.to_target(PIXELS - (60, 90)) - whole.to_target(PIXELS)).max() < 1e-9
    np.testing.assert_allclose(
        point_calibration.point_covariance(cut, PIXELS - (60, 90)), point_calibration.point_covariance(whole, PIXELS), atol=1e-12
    )


@pytest.mark.parametrize("part", ["own", "shared", "lag", "depth", "probe"])
def test_each_part_grows_the_prediction(rig, pose, part):
    half = np.diag([2e-4] * 2 + [2e-3] * 3 + [0.05] * 3) * (part == "probe")
    probe = probe_of(rig, half)
    placed = (pose @ sequences.target_from_pixel(probe))[None]
    errors = np.diag([1e-6] * 3 + [1e-3] * 3)[None]
    rates = np.zeros((1, 4, 4))
    rates[0, 0, 3] = 10.0
    made = PlaceErrors(
        errors * (part == "own"),
        np.eye(1),
        errors * (part == "shared"),
        rates,
        0.002 * (part == "lag"),
        0.01 * (part == "depth"),
    )
    found = place_uncertainty.sigmas(place_uncertainty.forms(placed, probe, made)[0], PIXELS)
    assert found[2] > 0.01
    assert (found[0] > 0) == (part != "depth"), "depths are right at the face"


def test_a_volume_of_sigmas_shows_those_of_its_pixels(rig, pose):
    """Two B-scans in one plane, a sigma twice the other's: the root of the mean square where both are, none where none is."""
    probe = probe_of(rig, np.zeros((8, 8)))
    placed = np.stack(2 * [np.diag([1.0, 1.0, 1.0, 1.0])])
    errors = np.stack([np.diag([0, 0, 0, s**2, 0, 0]) for s in (0.1, 0.2)])
    made = PlaceErrors(errors, np.eye(2), 0 * errors, np.zeros((2, 4, 4)))
    grid = Grid((60, 60, 2), np.zeros(3), np.ones(3), np.eye(3))
    volume = place_uncertainty.sigma_volume(place_uncertainty.forms(placed, probe, made), placed, (40, 50), grid)
    assert volume.voxels[0, :40, :50] == pytest.approx(np.sqrt((0.1**2 + 0.2**2) / 2), rel=1e-6)
    assert not volume.voxels[1].any() and not volume.voxels[0, 40:].any()


def test_a_b_scan_without_a_pose_has_no_prediction(rig, pose):
    probe = probe_of(rig, np.zeros((8, 8)))
    placed = np.stack([pose @ sequences.target_from_pixel(probe), np.full((4, 4), np.nan)])
    nothing = np.zeros((2, 6, 6))
    found = place_uncertainty.forms(placed, probe, PlaceErrors(nothing, np.eye(2), nothing, np.zeros((2, 4, 4))))
    assert np.isfinite(found[0]).all() and np.isnan(found[1]).all()
