"""What a calibration and speeds of sound leave open of a mass's place and volume."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from recon.files import meshes
from recon.freehand import sequences
from recon.freehand.place_uncertainty import PlaceErrors
from recon.freehand.scans import Scans
from recon.geometry import rigid
from recon.model.calibration import Uncertainty
from recon.model.probe import NAMES, ProbeCalibration
from recon.segmentation import mass_uncertainty
from recon.segmentation.containment import contain, read_skin
from recon.segmentation.mass_surface import Mass
from recon.segmentation.mass_uncertainty import Speeds
from recon.segmentation.rest import LIMITS, NODES, Rest
from scenes.solid_meshes import grid

STILL = Speeds(0.0, 0.0)
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


def by_speeds(mass, scans, tissue, within):
    """Standard deviations of centre and volume."""
    shown = mass_uncertainty.shown_by(np.asarray(mass.mesh.vertices), scans)
    found = mass_uncertainty.by_speeds(mass, mass_uncertainty.weights_of(mass), shown, scans, Speeds(tissue, within))
    return np.sqrt(np.trace(found[:3, :3])), np.sqrt(found[3, 3])


@pytest.fixture
def sharp(monkeypatch):
    """Borders without speckle."""
    monkeypatch.setattr(mass_uncertainty, "BORDER_MM", 0.0)


def probe_of(rig, covariance=None):
    known = None if covariance is None else Uncertainty(NAMES, covariance)
    return ProbeCalibration(rig.probe.target_from_image.matrix(), SCALE, known)


def test_a_speed_in_the_tissue_that_is_uncertain_by_2_percent(rig):
    """Then so is the depth of the front below the face, with a probe's calibration or without; the volume isn't."""
    scans, mass = sweep(probe_of(rig))
    for known in (scans, replace(scans, probe=None)):
        centre, volume = by_speeds(mass, known, 0.02, 0.0)
        assert centre == pytest.approx(0.02 * (DEPTH_MM - RADIUS_MM), rel=0.01) and volume == 0


def test_a_speed_in_the_mass_that_is_uncertain_by_2_percent(rig):
    """Then so is its extent along the beam, and with it the volume; the middle moves by half of that."""
    scans, mass = sweep(probe_of(rig))
    centre, volume = by_speeds(mass, scans, 0.0, 0.02)
    assert volume == pytest.approx(0.02 * mass.volume, rel=1e-6)
    assert centre == pytest.approx(0.02 * RADIUS_MM, rel=0.02)


def test_what_was_undone_is_uncertain_by_its_shares(rig):
    """Tissue that was pressed down by 1.2 mm at the mass, less by 5 % of each mm below, aside by none, and had risen by 2 mm.

    Its centre is uncertain by shares of these, along the beam and twice aside, and its volume by the share of 5 % (closed form).
    """
    scans, mass = sweep(probe_of(rig))
    count, down = len(scans.world_from_pixel), SCALE[1] * np.linspace(0, SIZE[1] - 1, NODES[0])
    fields = np.zeros((count, *NODES, 2), np.float32)
    fields[..., 1] = (1.2 - 0.05 * (down - DEPTH_MM))[:, None]
    axes = scans.world_from_pixel[:, :3, :3] / np.linalg.norm(scans.world_from_pixel[:, :3, :3], axis=1, keepdims=True)
    risen, pressed, nothing = np.full(count, 2.0), np.full(count, 2.5), np.zeros(count)
    scale = float(SCALE[0]), float(SCALE[1])
    moved = Rest(risen, pressed, -axes[0, :, 1], fields, axes, SIZE[::-1], scale, nothing, 0.0, nothing, nothing, None)
    weights, shown = mass_uncertainty.weights_of(mass), mass_uncertainty.shown_by(np.asarray(mass.mesh.vertices), scans)
    found = mass_uncertainty.by_rest(weights, shown, moved)
    along = np.hypot(1.2 * LIMITS.law, 2.0 * LIMITS.risen)
    expected = np.linalg.norm([along, 1.2 * LIMITS.aside, 1.2 * LIMITS.aside])
    assert np.sqrt(np.trace(found[:3, :3])) == pytest.approx(expected, rel=0.01)
    assert axes[0, :, 1] @ found[:3, :3] @ axes[0, :, 1] == pytest.approx(along**2, rel=0.02)
    assert np.sqrt(found[3, 3]) == pytest.approx(0.05 * LIMITS.law * mass.volume, rel=0.02)


def test_between_b_scans_that_are_far_apart_the_next_one_counts(rig, sharp):
    """3 mm apart, a third of the border is near none: the volume's uncertainty by sy is that of all of it."""
    covariance = np.zeros((8, 8))
    covariance[1, 1] = (0.02 * SCALE[1]) ** 2
    scans, mass = sweep(probe_of(rig, covariance))
    few = replace(scans, world_from_pixel=scans.world_from_pixel[2::6])
    sigma = mass_uncertainty.by_all(mass, few, STILL)
    assert sigma.volume_mm3 == pytest.approx(0.02 * mass.volume, rel=0.1)


def test_a_mass_at_the_edge_of_the_b_scans_has_an_uncertainty(rig, sharp):
    """Half of it lies beside all of them, and moves as their edge does: by sy as deep, so as a whole one of that place."""
    covariance = np.zeros((8, 8))
    covariance[1, 1] = (0.02 * SCALE[1]) ** 2
    scans, mass = sweep(probe_of(rig, covariance))
    narrow = replace(scans, shape=(scans.shape[0], SIZE[0] // 2))
    whole, cut = (mass_uncertainty.by_all(mass, one, STILL)[:2] for one in (scans, narrow))
    assert np.allclose(cut, whole, rtol=0.02)


def test_without_a_covariance_nothing_is_claimed(rig):
    """A part of an uncertainty isn't one."""
    scans, mass = sweep(probe_of(rig))
    assert np.isnan(mass_uncertainty.by_all(mass, scans, Speeds(0.01, 0.01))).all()


def test_the_parts_add_up_as_independent_errors(rig, sharp):
    covariance = np.diag([0, (0.01 * SCALE[1]) ** 2, 0, 0, 0, 0, 0, 0])
    scans, mass = sweep(probe_of(rig, covariance))
    volume = mass_uncertainty.by_all(mass, scans, Speeds(0.0, 0.02)).volume_mm3
    assert volume == pytest.approx(np.hypot(0.01, 0.02) * mass.volume, rel=0.01)


def test_masses_placed_by_calibrations_drawn_from_the_covariance_scatter_as_predicted(rig, rng, sharp):
    """Each vertex is moved as the B-scan that shows it; 400 draws of eight parameters that go together."""
    half = np.diag([2e-4, 4e-4, 2e-3, 2e-3, 2e-3, 0.1, 0.1, 0.1]) @ (np.eye(8) + 0.3 * rng.standard_normal((8, 8)))
    probe = probe_of(rig, half @ half.T)
    scans, mass = sweep(probe)
    sigma = mass_uncertainty.by_all(mass, scans, STILL)
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


def placed(scans, turn_rad=0.0, shift_mm=0.0, rates=0.0, lag_s=0.0, shared=False):
    """The B-scans with errors of their poses, of each or of all alike, or of the latency."""
    each = np.tile(np.diag([turn_rad**2] * 3 + [shift_mm**2] * 3), (len(scans.world_from_pixel), 1, 1))
    moving = np.zeros_like(scans.world_from_pixel)
    moving[:, 0, 3] = rates
    return replace(scans, errors=PlaceErrors(each * (not shared), np.eye(len(each)), each * shared, moving, lag_s))


def test_shifts_that_all_b_scans_share_move_a_mass_and_independent_ones_hardly(rig, sharp):
    """Shared: as the shift itself, and the volume stays. Independent: the mean of the 25 B-scans that pass through the ball."""
    scans, mass = sweep(probe_of(rig, np.zeros((8, 8))))
    together, apart = (
        mass_uncertainty.by_all(mass, placed(scans, shift_mm=0.1, shared=shared), STILL) for shared in (True, False)
    )
    assert together.centre_mm == pytest.approx(0.1 * np.sqrt(3), rel=0.01) and together.volume_mm3 < 1e-3 * mass.volume
    assert 0.1 * np.sqrt(3 / 60) < apart.centre_mm < 0.1 * np.sqrt(3 / 15)


def test_an_uncertain_latency_moves_a_mass_along_the_sweep(rig, sharp):
    scans, mass = sweep(probe_of(rig, np.zeros((8, 8))))
    sigma = mass_uncertainty.by_all(mass, placed(scans, rates=20.0, lag_s=0.002), STILL)
    assert sigma.centre_mm == pytest.approx(20 * 0.002, rel=1e-3)


def test_depth_below_the_skin_is_as_uncertain_as_skin_and_border(rig, tmp_path):
    """All B-scans may lie 0.1 mm off: across the skin that counts, in addition to the border's and the skin's own errors."""
    scans, mass = sweep(probe_of(rig, np.zeros((8, 8))))
    centre = mass.centre
    points, triangles = grid((60.0, 60.0), (120, 120))
    skin = trimesh.Trimesh(np.column_stack([points, np.full(len(points), -9.0)]) + centre, triangles, process=False)
    skin.vertex_attributes["sigma_mm"] = np.full(len(skin.vertices), 0.05)
    meshes.write_ply(tmp_path / "skin.ply", skin)
    skin = read_skin(tmp_path / "skin.ply")
    (under,) = contain([mass.mesh], skin, centre - [0, 0, 500])
    assert under.least_mm == pytest.approx(9 - RADIUS_MM, abs=0.05)
    sigma = mass_uncertainty.by_all(mass, placed(scans, shift_mm=0.1, shared=True), STILL, under)
    assert sigma.depth_mm == pytest.approx(np.sqrt(0.1**2 + 0.05**2 + mass_uncertainty.BORDER_MM**2), rel=0.02)
    del skin.vertex_attributes["sigma_mm"]  # as of other software: unknown, not exact
    (under,) = contain([mass.mesh], skin, centre - [0, 0, 500])
    unknown = mass_uncertainty.by_all(mass, placed(scans, shift_mm=0.1, shared=True), STILL, under)
    assert np.isnan(unknown.depth_mm) and unknown[:2] == sigma[:2]


def test_b_scans_between_the_same_poses_err_together(rig, sharp):
    """All 41 B-scans lie between two poses, half way: a mass moves by the mean of these two's errors, however many show it."""
    scans, mass = sweep(probe_of(rig, np.zeros((8, 8))))
    count = len(scans.world_from_pixel)
    poses, nothing = np.tile(np.diag([0, 0, 0, 0.01, 0.01, 0.01]), (2, 1, 1)), np.zeros((count, 6, 6))
    errors = PlaceErrors(poses, np.full((count, 2), 0.5), nothing, np.zeros((count, 4, 4)))
    sigma = mass_uncertainty.by_all(mass, replace(scans, errors=errors), STILL)
    assert sigma.centre_mm == pytest.approx(0.1 * np.sqrt(3 / 2), rel=0.01)


def test_the_volume_of_a_small_body_is_known_less_well(rig):
    """By its border's place, which below 6 mm of radius is uncertain in inverse proportion to that; the centre isn't."""
    scans, _ = sweep(probe_of(rig, np.zeros((8, 8))))
    for radius, outwards in ((12.0, 0.06), (6.0, 0.06), (2.0, 0.18)):
        ball = trimesh.creation.icosphere(4, radius)
        sigma = mass_uncertainty.by_all(Mass(ball), scans, STILL)
        assert sigma.volume_mm3 == pytest.approx(outwards * ball.area, rel=0.01)
        assert sigma.centre_mm == pytest.approx(np.sqrt(3) * 0.06, rel=0.01)
