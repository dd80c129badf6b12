"""Figures of a calibration: what they say of sets whose noise and truth are known."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from recon.model.calibration import Calibration
from recon.optical_calibration import adjustment, figures_of_merit, joint_calibration, uncertainty
from tests.recon import board_sets

DEPTHS = (606.0, 660.0, 713.0)  # mm, where the sets of poses are
MODEL = ("k1", "k2", "p1", "p2")


@pytest.fixture(scope="module")
def cameras(rig):
    return board_sets.devices(rig)


@pytest.fixture(scope="module")
def result(cameras):
    rng = np.random.default_rng(7)
    sightings = board_sets.sightings(cameras, board_sets.random_poses(cameras, 14, rng), rng)
    sizes = {name: camera.size for name, camera in cameras.items()}
    return joint_calibration.calibrate(sightings, board_sets.BOARD, sizes, joint_calibration.Settings(distortion="decentred"))


def adjusted(cameras, rng, poses=10) -> Calibration:
    """A calibration from fresh poses and fresh noise, the descent begun at the truth."""
    placed = board_sets.random_poses(cameras, poses, rng)
    seen = board_sets.observe(cameras, placed, rng)
    free = adjustment.free_parameters(seen.devices, dict.fromkeys(seen.devices, MODEL))
    return adjustment.adjust(seen, adjustment.Estimate(cameras, placed, seen.points), free).calibration


def test_residuals_have_the_size_of_the_noise(result, cameras):
    """Both coordinates count; the unknowns take a little. The projector's residuals have camera 1's noise in them as well."""
    found = figures_of_merit.measure(result)
    for device in ("cam1", "cam2"):
        assert found[f"reprojection_rms_{device}_px"] == pytest.approx(np.sqrt(2) * board_sets.NOISE[device], rel=0.1)
        assert found[f"noise_ratio_{device}"] == pytest.approx(1, abs=0.1)
    assert found["reprojection_rms_projector_px"] > np.sqrt(2) * board_sets.NOISE["projector"]
    assert found["outliers"] == 0 and found["poses"] == 14 and found["sightings"] == 14 * 44 * 3


def test_errors_without_truth_are_not_spoken_of(result):
    assert not [name for name in figures_of_merit.measure(result) if "error" in name]


def test_only_the_papers_rig_is_compared_with_the_paper(result, cameras):
    """Told by the image sizes and focal lengths of all devices, which are those of its file."""
    published = figures_of_merit.published_rms
    assert published(result.adjustment.calibration) == {"cam1": 0.138, "cam2": 0.151, "projector": 0.131}
    assert published(Calibration({"cam1": cameras["cam1"]})) == {"cam1": 0.138}
    for device, paper in figures_of_merit.PAPER.items():
        assert cameras[device].size == paper.size and cameras[device].matrix[0, 0] == pytest.approx(paper.focal_px, rel=1e-3)
        longer = replace(cameras[device], matrix=cameras[device].matrix * [[1.2, 1, 1], [1, 1.2, 1], [1, 1, 1]])
        larger = replace(cameras[device], size=(1920, 1200))
        assert published(Calibration(cameras | {device: longer})) == published(Calibration(cameras | {device: larger})) == {}


def test_a_pattern_in_the_residuals_stands_out(result):
    """Random residuals have none; a whirl of half their size has, though their RMS hardly changes."""
    assert figures_of_merit.pattern_ratio(result, "cam1") == pytest.approx(1, abs=0.35)
    pixels, size = result.observations.pixels[:, :, 0], np.array(result.observations.sizes[0])
    whirl = ((pixels - size / 2) / size)[..., ::-1] * [-1, 1]
    residuals = result.adjustment.residuals.copy()
    residuals[:, :, 0] += 0.007 * whirl / np.sqrt(np.nanmean(np.sum(whirl**2, axis=-1)))
    turned = replace(result, adjustment=replace(result.adjustment, residuals=residuals))
    assert turned.rms["cam1"] < 1.2 * result.rms["cam1"]
    assert figures_of_merit.pattern_ratio(turned, "cam1") > 1.6, (
        "17 points a cell reduce noise fourfold, and the whirl not at all"
    )


def test_rms_of_poses_make_up_that_of_the_device(result):
    by_pose = figures_of_merit.pose_rms(result)
    assert np.sqrt((by_pose**2).mean(axis=0)) == pytest.approx(list(result.rms.values()), rel=1e-9), "all see all points"


def test_places_of_the_board(result, cameras):
    """Tilt and depth of a pose are those of the board's plane in camera 1."""
    world = np.einsum("pij,nj->pni", result.adjustment.poses[:, :3, :3], result.adjustment.points)
    world += result.adjustment.poses[:, None, :3, 3]
    normals = np.cross(world[:, 3] - world[:, 0], world[:, -1] - world[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    assert np.cos(figures_of_merit.tilts(result)) == pytest.approx(
        np.abs(normals[:, 2]), abs=1e-5
    )  # three of its points, found with the rest
    assert figures_of_merit.board_centres(result) == pytest.approx(world.mean(axis=1))


def test_depths_are_those_of_the_board(result):
    """One twentieth of its points is nearer than the first, and one farther than the last; the rest of the rig doesn't count."""
    depth = figures_of_merit.board_points(result)[..., 2]
    low, middle, high = figures_of_merit.working_depths(result)
    assert [np.mean(depth < z) for z in (low, middle, high)] == pytest.approx([0.05, 0.5, 0.95], abs=0.02), "whole mm"
    narrow = result.adjustment.poses.copy()
    narrow[:, 2, 3] = 600
    depths = figures_of_merit.working_depths(replace(result, adjustment=replace(result.adjustment, poses=narrow)))
    assert max(depths) < 713, "the paper's rig is not everybody's"
    poses = result.adjustment.poses.copy()
    poses[:, 2, 3] += 1000
    far = figures_of_merit.working_depths(replace(result, adjustment=replace(result.adjustment, poses=poses)))
    assert np.subtract(far, (low, middle, high)) == pytest.approx(1000)


def test_poses_left_out_are_told_from_single_sightings(result):
    """A pose may be left out whole, be missed by one device, or by all."""
    dropped = {"first try": "contradicts", "00 cam2": "dark", "01 projector": "dark", "blank cam1": "dark", "blank cam2": "dark"}
    figures = figures_of_merit.measure(replace(result, dropped=dropped))
    assert figures["poses_dropped"] == 2 and figures["sightings_dropped"] == 4


def test_errors_are_as_large_as_predicted(cameras, rng):
    """Six calibrations against the truth: parameters, and shapes measured with them.

    The normalised error's square is chi square over its degrees of freedom: 36 a calibration. Errors of shape are fewer numbers,
    some eight a calibration, as all points share them.
    """
    truth, volume = Calibration(cameras), None
    squares, shapes, positions = [], [], []
    for _ in range(6):
        found = adjusted(cameras, rng)
        volume = uncertainty.working_volume(found, DEPTHS) if volume is None else volume
        errors = figures_of_merit.errors(found, truth, volume)
        squares.append(errors["parameters_error_sigma"] ** 2)
        traces = [
            np.trace(covariance, axis1=1, axis2=2).mean()
            for covariance in (
                uncertainty.shape(found, "cam1", "projector", volume, volume),
                uncertainty.triangulation(found, "cam1", "projector", volume),
            )
        ]
        shapes.append(errors["shape_error_rms_mm"] ** 2 / traces[0])
        positions.append(errors["point_error_rms_mm"] ** 2 / traces[1])
    assert np.mean(squares) == pytest.approx(1, abs=4 * np.sqrt(2 / (6 * 36)))
    assert np.mean(shapes) == pytest.approx(1, abs=4 * np.sqrt(2 / (6 * 8)))
    assert np.mean(positions) == pytest.approx(1, abs=4 * np.sqrt(2 / (6 * 3)))


def test_errors_are_of_the_size_put_in(cameras):
    truth = Calibration(cameras)
    turned = cameras["cam2"].camera_from_world.copy()
    turned[:3, :3] = Rotation.from_rotvec(np.deg2rad([0, 0.3, 0])).as_matrix() @ turned[:3, :3]
    turned[:3, 3] += [0, 3, 4]
    known = uncertainty.Uncertainty(("cam2.ry", "cam2.ty", "cam2.tz"), np.diag([np.deg2rad(0.1), 1.0, 4.0]) ** 2)
    found = Calibration(cameras | {"cam2": replace(cameras["cam2"], camera_from_world=turned)}, known)
    errors = figures_of_merit.errors(found, truth, uncertainty.working_volume(truth, DEPTHS))
    assert errors["cam2_rotation_error_deg"] == pytest.approx(0.3)
    assert errors["cam2_translation_error_mm"] == pytest.approx(5)
    assert errors["projector_rotation_error_deg"] == pytest.approx(0, abs=1e-5)
    assert errors["parameters_error_sigma"] == pytest.approx(np.sqrt((3**2 + 3**2 + 1) / 3))
    assert errors["point_error_rms_mm"] == pytest.approx(0, abs=1e-9), "camera 1 and the projector, which measure, are right"


def test_parameters_are_told_with_their_scatter(result, cameras, rng):
    """What is derived, rotation vectors and distances, scatters as said when parameters are drawn from their covariance."""
    found = result.adjustment.calibration
    rows = figures_of_merit.parameters(found, Calibration(cameras))
    assert not [row for row in rows if row.device == "cam1" and row.label in ("rx", "tx", "distance")], "it is the world"
    assert not [row for row in rows if row.label in ("k3", "tau_x")], "held at zero, and true"
    draws = rng.multivariate_normal(np.zeros(len(found.uncertainty.names)), found.uncertainty.covariance, 400, method="cholesky")
    drawn = [figures_of_merit.parameters(uncertainty.apply(found, draw)) for draw in draws]
    for number, row in enumerate(rows):
        scatter = np.std([sample[number].value for sample in drawn])
        assert scatter == pytest.approx(row.sigma, rel=4.5 / np.sqrt(2 * 400)), (row.device, row.label)
    turn = next(row for row in rows if (row.device, row.label) == ("cam2", "ry"))
    assert (turn.unit, turn.true) == ("deg", pytest.approx(15.155))
    distance = next(row for row in rows if (row.device, row.label) == ("projector", "distance"))
    assert distance.true == pytest.approx(np.linalg.norm(cameras["projector"].centre))


def test_one_camera_has_figures_but_none_of_points(cameras):
    """Nothing is triangulated with one; how well it is known is said in pixels."""
    alone = {"cam1": cameras["cam1"]}
    rng = np.random.default_rng(1)
    sightings = board_sets.sightings(alone, board_sets.random_poses(alone, 14, rng), rng)
    sizes = {"cam1": cameras["cam1"].size}
    found = joint_calibration.calibrate(sightings, board_sets.BOARD, sizes, joint_calibration.Settings(distortion="decentred"))
    figures = figures_of_merit.measure(found, Calibration(cameras))
    known = found.adjustment.calibration.uncertainty
    assert abs(found.adjustment.calibration.cameras["cam1"].matrix[0, 0] - 3320) < 4 * known.sigma("cam1.fx") < 40
    assert 0 < figures["projection_sigma_cam1_px"] < 0.1 and figures["parameters_error_sigma"] < 2
    assert not [name for name in figures if name.startswith(("point", "shape", "scale"))]


def test_two_cameras_measure_without_a_projector(cameras):
    both = {name: cameras[name] for name in ("cam1", "cam2")}
    rng = np.random.default_rng(1)
    sightings = board_sets.sightings(both, board_sets.random_poses(both, 12, rng), rng)
    sizes = {name: camera.size for name, camera in both.items()}
    found = joint_calibration.calibrate(sightings, board_sets.BOARD, sizes, joint_calibration.Settings(distortion="decentred"))
    figures = figures_of_merit.measure(found, Calibration(cameras))
    assert figures_of_merit.devices_that_measure(found.adjustment.calibration) == ("cam1", "cam2")
    assert figures["shape_error_rms_mm"] < 4 * figures["shape_sigma_mm"] and "reprojection_rms_projector_px" not in figures
