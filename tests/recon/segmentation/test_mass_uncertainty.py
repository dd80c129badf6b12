"""What a calibration and speeds of sound leave open of a mass's place and volume."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from recon.freehand import sequences
from recon.freehand.scans import Scans
from recon.geometry import rigid
from recon.model.calibration import Uncertainty
from recon.model.probe import ProbeCalibration
from recon.probe_calibration.point_calibration import NAMES
from recon.segmentation import mass_uncertainty
from recon.segmentation.mass_surface import Mass

SIZE, SCALE = (320, 400), np.array([0.12, 0.12])
DEPTH_MM, RADIUS_MM = 30.0, 6.0


def sweep(probe):
    """B-scans side by side, 0.5 mm apart, across a ball under their middle."""
    steps = np.arange(-10, 10.1, 0.5)
    world_from_target = [rigid.transform(np.eye(3), -step * probe.target_from_image[:3, 2]) for step in steps]
    matrices = np.array(world_from_target) @ sequences.target_from_pixel(probe)
    centre = probe.to_target([SIZE[0] / 2, DEPTH_MM / SCALE[1]])
    ball = trimesh.creation.icosphere(3, RADIUS_MM)
    ball.apply_translation(centre)
    return Scans(SIZE[::-1], matrices, lambda: iter(()), 1540, 1540, probe), Mass(ball)


def slopes_of(mass, scans):
    return mass_uncertainty.point_slopes(np.asarray(mass.mesh.vertices), scans)


def probe_of(rig, covariance=None):
    known = None if covariance is None else Uncertainty(NAMES, covariance)
    return ProbeCalibration(rig.probe.target_from_image.matrix(), SCALE, known)


def test_a_speed_in_the_tissue_that_is_uncertain_by_2_percent(rig):
    """Then so is the depth of the front below the face, with a probe's calibration or without; the volume isn't."""
    scans, mass = sweep(probe_of(rig))
    for known in (scans, replace(scans, probe=None)):
        sigma = mass_uncertainty.by_speeds(mass, slopes_of(mass, known), 0.02, 0.0)
        assert sigma.centre_mm == pytest.approx(0.02 * (DEPTH_MM - RADIUS_MM), rel=0.01) and sigma.volume_mm3 == 0


def test_a_speed_in_the_mass_that_is_uncertain_by_2_percent(rig):
    """Then so is its extent along the beam, and with it the volume; the middle moves by half of that."""
    scans, mass = sweep(probe_of(rig))
    sigma = mass_uncertainty.by_speeds(mass, slopes_of(mass, scans), 0.0, 0.02)
    assert sigma.volume_mm3 == pytest.approx(0.02 * mass.volume, rel=1e-6)
    assert sigma.centre_mm == pytest.approx(0.02 * RADIUS_MM, rel=0.02)


def test_between_b_scans_that_are_far_apart_the_next_one_counts(rig):
    """3 mm apart, a third of the border is near none: the volume's uncertainty by sy is that of all of it."""
    covariance = np.zeros((8, 8))
    covariance[1, 1] = (0.02 * SCALE[1]) ** 2
    scans, mass = sweep(probe_of(rig, covariance))
    few = replace(scans, world_from_pixel=scans.world_from_pixel[2::6])
    sigma = mass_uncertainty.by_all(mass, few, 0.0, 0.0)
    assert sigma.volume_mm3 == pytest.approx(0.02 * mass.volume, rel=0.1)


def test_a_mass_at_the_edge_of_the_b_scans_has_an_uncertainty(rig):
    """Half of it lies beside all of them, and moves as their edge does: by sy as deep, so as a whole one of that place."""
    covariance = np.zeros((8, 8))
    covariance[1, 1] = (0.02 * SCALE[1]) ** 2
    scans, mass = sweep(probe_of(rig, covariance))
    narrow = replace(scans, shape=(scans.shape[0], SIZE[0] // 2))
    whole, cut = (mass_uncertainty.by_all(mass, one, 0.0, 0.0) for one in (scans, narrow))
    assert np.allclose(cut, whole, rtol=0.02)


def test_without_a_covariance_nothing_is_claimed(rig):
    """A part of an uncertainty isn't one."""
    scans, mass = sweep(probe_of(rig))
    assert np.isnan(mass_uncertainty.by_all(mass, scans, 0.01, 0.01)).all()


def test_the_parts_add_up_as_independent_errors(rig):
    covariance = np.diag([0, (0.01 * SCALE[1]) ** 2, 0, 0, 0, 0, 0, 0])
    scans, mass = sweep(probe_of(rig, covariance))
    volume = mass_uncertainty.by_all(mass, scans, 0.0, 0.02).volume_mm3
    assert volume == pytest.approx(np.hypot(0.01, 0.02) * mass.volume, rel=0.01)


def test_masses_placed_by_calibrations_drawn_from_the_covariance_scatter_as_predicted(rig, rng):
    """Each vertex is moved as the B-scan that shows it; 400 draws of eight parameters that go together."""
    half = np.diag([2e-4, 4e-4, 2e-3, 2e-3, 2e-3, 0.1, 0.1, 0.1]) @ (np.eye(8) + 0.3 * rng.standard_normal((8, 8)))
    probe = probe_of(rig, half @ half.T)
    scans, mass = sweep(probe)
    sigma = mass_uncertainty.by_all(mass, scans, 0.0, 0.0)
    local = rigid.apply(rigid.invert(probe.target_from_image), np.asarray(mass.mesh.vertices))
    pixels, beside = local[:, :2] / SCALE, local[:, 2:] * probe.target_from_image[:3, 2]
    centres, volumes = [], []
    for step in rng.standard_normal((400, 8)) @ half.T:
        drawn = ProbeCalibration(rigid.moved(probe.target_from_image, step[2:]), SCALE + step[:2])
        mesh = trimesh.Trimesh(drawn.to_target(pixels) + beside, mass.mesh.faces, process=False)
        centres.append(mesh.center_mass)
        volumes.append(mesh.volume)
    assert np.sqrt(np.trace(np.cov(np.array(centres).T))) == pytest.approx(sigma.centre_mm, rel=0.12)
    assert np.std(volumes) == pytest.approx(sigma.volume_mm3, rel=0.12)
