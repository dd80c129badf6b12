"""The target's pose from its circles: exact, with an honest covariance, and not found where it isn't the target."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from recon.capture.manifest import CAMERAS
from recon.geometry import camera_jacobian, rigid
from recon.geometry.circle_projection import centre_offsets
from recon.model import circle_layout
from recon.model.calibration import FOCAL_DRIFT, Uncertainty, with_drift, with_scale
from recon.tracking import pose, pose_fit
from recon.tracking.pose_fit import Sighting
from tests.recon.tracking import drawings
from twin.optics.surface_session import calibration_of

SIGMA_PX = 0.03
POSES = 16


@pytest.fixture(scope="module")
def cameras(rig):
    known = calibration_of(rig).cameras
    return known["cam1"], known["cam2"]


@pytest.fixture(scope="module")
def target(rig):
    """As it is drawn, to the last digit."""
    return rig.target.model_copy(update={"tolerance_mm": 0.0})


def seen(cameras, target, world_from_target, rng=None):
    """What both cameras show of the target: centres of ellipses, with noise if there is a generator."""
    model, radius = circle_layout.circle_centres(target), target.outer_diameter_mm / 2
    views = []
    for camera in cameras:
        centres = camera.project(rigid.apply(world_from_target, model)) + centre_offsets(camera, world_from_target, model, radius)
        noise = 0 if rng is None else SIGMA_PX * rng.standard_normal((3, 2))
        shapes = drawings.shown(camera, world_from_target, target).shape
        views.append(Sighting(camera, centres + noise, np.tile(SIGMA_PX**2 * np.eye(2), (3, 1, 1)), shapes))
    return views


def error(found, true):
    """Turn (rad) and shift (mm) from the true pose to the one found : (6,)."""
    turn = Rotation.from_matrix(found[:3, :3] @ true[:3, :3].T).as_rotvec()
    return np.concatenate([turn, found[:3, 3] - true[:3, 3]])


def test_exact_where_there_is_no_noise(cameras, target, rng):
    """Circles are followed to rounding, although their ellipses' centres are a quarter of a pixel off the projected ones."""
    for _ in range(10):
        true = drawings.facing(rng)
        found = pose.estimate(*seen(cameras, target, true), target)
        assert np.abs(error(found.world_from_target, true)).max() < 1e-6
        assert found.misfit < 1e-6


def test_the_covariance_is_that_of_the_errors(cameras, target, rng):
    """Squared normalised errors of 16 poses and misfits follow chi-square: means within 4 standard errors."""
    squared, misfits = [], []
    for _ in range(POSES):
        true = drawings.facing(rng)
        found = pose.estimate(*seen(cameras, target, true, rng), target)
        off = error(found.world_from_target, true)
        squared.append(off @ np.linalg.solve(found.covariance, off))
        misfits.append(found.misfit)
    for values in (squared, misfits):
        assert abs(np.mean(values) - 6) < 4 * np.sqrt(12 / POSES)
    assert np.mean(np.array(squared) < chi2.ppf(0.95, 6)) > 0.85


def printed(design, rng):
    """A target of which each circle's place is off by the design's tolerance, in the frame of its own circles."""
    x, y = design.tolerance_mm * rng.standard_normal((2, 3)) + circle_layout.circle_centres(design)[:, :2].T
    axis, side = np.array([x[1] - x[0], y[1] - y[0]]), np.array([x[2] - x[0], y[2] - y[0]])
    c1 = np.hypot(*axis)
    aside, along = axis @ side / c1, (axis[0] * side[1] - axis[1] * side[0]) / c1
    return design.model_copy(update={"c1_mm": c1, "c2_aside_mm": aside, "c2_mm": along})


@pytest.mark.parametrize("missing", [None, (0, 1), (1, 2)])
def test_an_imprecise_print_is_found_with_an_honest_covariance(cameras, target, rng, missing):
    """Errors over the covariance, and misfits, are chi-square, while the design would refuse nearly all."""
    design, squared, misfits, refused = target.model_copy(update={"tolerance_mm": 0.1}), [], [], 0
    for _ in range(2 * POSES):
        true, actual = drawings.facing(rng), printed(design, rng)
        views = seen(cameras, actual, true, rng)
        if missing:
            views[missing[0]].centres[missing[1]] = np.nan
        found = pose.estimate(*views, design)
        refused += not pose.estimate(*views, target).found
        if missing is None or found.found:
            off = error(found.world_from_target, true)
            squared.append(off @ np.linalg.solve(found.total, off))
            misfits.append(found.misfit)
            freedom = found.freedom
    assert len(squared) > 0.9 * 2 * POSES and refused > POSES
    for values, expected in ((squared, 6), (misfits, freedom)):
        assert abs(np.mean(values) - expected) < 4 * np.sqrt(2 * expected / len(values))


def test_errors_of_the_cameras_are_in_the_shared_covariance(cameras, target, rng):
    """Cameras drawn from their covariance, the design exact: errors over the total are chi-square, over the noise's alone not."""
    names = tuple(f"cam2.{name}" for name in ("fx", "fy", "cx", "cy", "rx", "ry", "rz", "tx", "ty", "tz"))
    sigma = np.array([0.1, 0.1, 0.05, 0.05, 1e-5, 1e-5, 1e-5, 0.01, 0.01, 0.01])
    optics, squared, noise, misfits = Uncertainty(names, np.diag(sigma**2)), [], [], []
    for _ in range(2 * POSES):
        true = drawings.facing(rng)
        wrong = camera_jacobian.moved(cameras[1], [name.partition(".")[2] for name in names], sigma * rng.standard_normal(10))
        views = seen((cameras[0], wrong), target, true, rng)
        found = pose.estimate(views[0], replace(views[1], camera=cameras[1]), target, optics)
        off = error(found.world_from_target, true)
        squared.append(off @ np.linalg.solve(found.total, off))
        noise.append(off @ np.linalg.solve(found.covariance, off))
        misfits.append(found.misfit)
    for values in (squared, misfits):
        assert abs(np.mean(values) - 6) < 4 * np.sqrt(12 / len(values))
    assert np.mean(noise) > 6 + 4 * np.sqrt(12 / len(noise))


def drift(camera, rng, px=0.3):
    """Steps of cx, cy, fx and fy : (4,) px of a camera that has warmed."""
    return np.append(px * rng.standard_normal(2), px * FOCAL_DRIFT * rng.standard_normal() * np.diag(camera.matrix)[:2])


def test_focal_lengths_drift_together(cameras):
    """fx and fy by the same share, 4e-4 for each px of the principal point, apart from that."""
    known = with_drift(None, {"cam1": cameras[0]}, 0.05)
    fx, fy = np.diag(cameras[0].matrix)[:2]
    assert known.sigma("cam1.fx") == pytest.approx(2e-5 * fx) and known.sigma("cam1.cx") == pytest.approx(0.05)
    covariance = known.ordered(["cam1.fx", "cam1.fy", "cam1.cx", "cam1.cy"])
    assert covariance[0, 1] == pytest.approx(4e-10 * fx * fy) and not covariance[:2, 2:].any() and covariance[2, 3] == 0


def test_cameras_that_drifted_since_their_calibration_are_in_the_shared_covariance(cameras, target, rng):
    """By 0.3 px, ten times the noise: without a tolerance nearly all are refused; with it errors and misfits are chi-square."""
    squared, misfits, refused, names = [], [], 0, ["cx", "cy", "fx", "fy"]
    optics = with_drift(None, dict(zip(("cam1", "cam2"), cameras, strict=True)), 0.3)
    for _ in range(2 * POSES):
        true = drawings.facing(rng)
        warm = [camera_jacobian.moved(camera, names, drift(camera, rng)) for camera in cameras]
        views = [replace(view, camera=camera) for view, camera in zip(seen(warm, target, true, rng), cameras, strict=True)]
        refused += not pose.estimate(*views, target).found
        found = pose.estimate(*views, target, optics)
        off = error(found.world_from_target, true)
        squared.append(off @ np.linalg.solve(found.total, off))
        misfits.append(found.misfit)
    assert refused > POSES
    for values in (squared, misfits):
        assert abs(np.mean(values) - 6) < 4 * np.sqrt(12 / len(values))


def test_the_noise_is_apart_from_what_is_shared(cameras, target, rng):
    """Of one pose through one wrong camera, poses scatter by `covariance`."""
    optics = Uncertainty(("cam2.ry", "cam2.tz"), np.diag([1e-8, 1e-3]))
    design, true, found = target.model_copy(update={"tolerance_mm": 0.1}), drawings.facing(rng), []
    actual = printed(design, rng)
    for _ in range(4 * POSES):
        found.append(pose.estimate(*seen(cameras, actual, true, rng), design, optics))
    off = np.array([error(one.world_from_target, found[0].world_from_target) for one in found])
    off -= off.mean(axis=0)
    squared = np.einsum("ni,ij,nj->n", off, np.linalg.inv(found[0].covariance), off)
    assert abs(squared.mean() - 6) < 4 * np.sqrt(12 / len(squared))


@pytest.mark.parametrize("which", [0, 1, 2])
@pytest.mark.parametrize("hidden", [0, 1])
def test_a_circle_may_be_missing_in_one_view(cameras, target, rng, which, hidden):
    """Then the misfit has 4 degrees of freedom, and the covariance still is that of the errors."""
    squared, misfits = [], []
    for _ in range(POSES // 2):
        true = drawings.facing(rng)
        views = seen(cameras, target, true, rng)
        views[hidden].centres[which] = np.nan
        found = pose.estimate(*views, target)
        off = error(found.world_from_target, true)
        squared.append(off @ np.linalg.solve(found.covariance, off))
        misfits.append(found.misfit)
        assert found.freedom == 4
    for values, freedom in ((squared, 6), (misfits, 4)):
        assert abs(np.mean(values) - freedom) < 4 * np.sqrt(2 * freedom / (POSES // 2))


def face_on(camera, rng, tilt_deg):
    """A pose that a camera sees tilted by so much, to any side."""
    place = drawings.facing(rng)
    away = camera.centre - place[:3, 3]
    facing = Rotation.align_vectors(away, [0, 0, 1])[0] * Rotation.from_euler("z", rng.uniform(-180, 180), degrees=True)
    side = rng.uniform(0, 2 * np.pi)
    lean = Rotation.from_rotvec(np.radians(tilt_deg) * np.array([np.cos(side), np.sin(side), 0]))
    return rigid.transform((facing * lean).as_matrix(), place[:3, 3])


@pytest.mark.parametrize(("tilt_deg", "least"), [(0.0, 0.4), (2.5, 0.7), (10.0, 0.95)])
def test_two_tilts_are_told_apart_or_refused(cameras, target, rng, tilt_deg, least):
    """Where the whole view sees the target nearly face on, both tilts fit its centres; shapes are 0.1 px off."""
    squared = []
    for _ in range(60):
        true = face_on(cameras[0], rng, tilt_deg)
        views = seen(cameras, target, true, rng)
        views[1].centres[rng.integers(3)] = np.nan
        for view in views:
            noise = 0.1 * rng.standard_normal((3, 2, 2))
            view.shapes[:] += (noise + np.swapaxes(noise, 1, 2)) / 2
        found = pose.estimate(*views, target)
        reasons = ("two poses", "no pose fits", "a misfit", "turn uncertain")
        assert found.found or any(why in found.reason for why in reasons), found.reason
        if found.found:
            off = error(found.world_from_target, true)
            squared.append(off @ np.linalg.solve(found.covariance, off))
    assert len(squared) >= least * 60
    assert np.mean(np.array(squared) < chi2.ppf(0.95, 6)) > 0.85 and max(squared) < 100


def test_a_turn_that_is_hardly_determined_is_refused(cameras, target, rng):
    """Where two tilts merge, tolerances of the design leave the turn open by degrees; what is found keeps to its covariance."""
    design, squared, reasons = target.model_copy(update={"tolerance_mm": 0.1}), [], []
    for _ in range(2 * POSES):
        true = face_on(cameras[0], rng, rng.uniform(0, 6))
        views = seen(cameras, printed(design, rng), true, rng)
        views[1].centres[rng.integers(3)] = np.nan
        found = pose.estimate(*views, design)
        if found.found:
            off = error(found.world_from_target, true)
            squared.append(off @ np.linalg.solve(found.total, off))
        reasons.append(str(found.reason))
    assert len(squared) > POSES / 2
    assert any("turn uncertain" in reason for reason in reasons)
    assert np.mean(np.array(squared) < chi2.ppf(0.95, 6)) > 0.65 and max(squared) < 100  # to first order, 0.5 and 2000


def test_without_shapes_two_tilts_are_not_told_apart(cameras, target, rng):
    """Nothing but perspective would: some are refused, none is wrong."""
    reasons = []
    for _ in range(30):
        true = drawings.facing(rng)
        views = [replace(view, shapes=None) for view in seen(cameras, target, true, rng)]
        views[1].centres[2] = np.nan
        found = pose.estimate(*views, target)
        reasons.append(found.reason)
        assert not found.found or np.abs(error(found.world_from_target, true)).max() < 1.0
    assert any("two poses" in str(reason) for reason in reasons)


def test_sizes_that_no_distance_gives_are_not_the_target(cameras, target, rng):
    views = [replace(view, shapes=1.2 * view.shapes) for view in seen(cameras, target, drawings.facing(rng), rng)]
    assert "other sizes than at their distance: 20 %" in str(pose.estimate(*views, target).reason)


def test_one_view_alone_must_have_shapes_of_a_pose(cameras, target, rng):
    """Any three centres are those of some pose, but it tells the shapes too: three rings of a sheet aren't the target."""
    for _ in range(10):
        view, _ = seen(cameras, target, drawings.facing(rng), rng)
        plain, side = np.zeros(3, bool), 0.15 * (view.centres[1] - view.centres[0])
        assert pose.allowed(view, plain, target)
        assert not pose.allowed(replace(view, centres=view.centres + np.array([[0, 0], side, [0, 0]])), plain, target)
        assert not pose.allowed(replace(view, shapes=1.1 * view.shapes), plain, target)


def test_the_back_of_a_target_is_not_found(cameras, target, rng):
    """As through glass: the same circles, seen from behind."""
    flipped = drawings.facing(rng) @ np.diag([1.0, -1.0, -1.0, 1.0])
    assert "front" in str(pose.estimate(*seen(cameras, target, flipped, rng), target).reason)


@pytest.mark.parametrize("missing", [[(0, 0), (1, 0)], [(0, 0), (1, 1)], [(0, 0), (0, 1)]])
def test_with_fewer_circles_there_is_no_pose(cameras, target, rng, missing):
    """One hidden from both cameras, another from each, two from one: (camera, circle)."""
    views = seen(cameras, target, drawings.facing(rng), rng)
    for camera, which in missing:
        views[camera].centres[which] = np.nan
    found = pose.estimate(*views, target)
    assert not found.found and "fewer circles" in found.reason


def test_other_names_are_not_the_target(cameras, target, rng):
    for order in ([1, 0, 2], [2, 1, 0], [0, 2, 1], [1, 2, 0], [2, 0, 1]):
        views = [replace(view, centres=view.centres[order]) for view in seen(cameras, target, drawings.facing(rng), rng)]
        found = pose.estimate(*views, target)
        assert not found.found and "not as far apart" in found.reason and np.isnan(found.world_from_target).all()


def test_names_that_differ_between_the_views_are_not_the_target(cameras, target, rng):
    for order in ([1, 0, 2], [2, 1, 0], [0, 2, 1]):
        first, second = seen(cameras, target, drawings.facing(rng), rng)
        found = pose.estimate(first, replace(second, centres=second.centres[order]), target)
        assert not found.found


def test_swapped_cameras_are_noticed(cameras, target, rng):
    for _ in range(10):
        first, second = seen(cameras, target, drawings.facing(rng), rng)
        swapped = (replace(first, centres=second.centres), replace(second, centres=first.centres))
        assert not pose.estimate(*swapped, target).found


def test_exchanged_cameras_keep_the_uncertainty_of_their_calibrations(cameras, target):
    """Camera 1's principal point is 3 px off, as its calibration allows; camera 2, of a long lens, is exact."""
    optics = Uncertainty(("cam1.cy",), np.array([[4.0]]))
    wide, long = (
        replace(camera, matrix=np.diag([scale, scale, 1]) @ camera.matrix) for camera, scale in zip(cameras, (1, 6), strict=True)
    )
    moved = replace(wide, matrix=wide.matrix + np.array([[0, 0, 0], [0, 0, 3.0], [0, 0, 0]]))
    one, other = seen((moved, long), target, drawings.facing(np.random.default_rng(1)))
    assert pose.estimate(replace(one, camera=wide), other, target, optics).found
    assert pose.exchanged(replace(other, camera=wide), replace(one, camera=long), target, optics)


def test_a_centre_that_is_off_is_noticed(cameras, target, rng):
    """By half a pixel, 17 times what it is known to be."""
    first, second = seen(cameras, target, drawings.facing(rng), rng)
    first.centres[1] += [0.35, 0.35]
    found = pose.estimate(first, second, target)
    assert not found.found and "misfit" in found.reason


@pytest.mark.parametrize("hidden", [0, 1])
def test_a_doubtful_centre_that_is_off_is_left_out(cameras, target, rng, hidden):
    """By 20 times what it is known to be, in a view of which any circle may be; the covariance is that of the other five.

    Off along the other view's ray, it can't be told from that one, and there is no pose.
    """
    squared = []
    for _ in range(POSES):
        true, which = drawings.facing(rng), rng.integers(3)
        views = seen(cameras, target, true, rng)
        angle = rng.uniform(0, 2 * np.pi)
        views[hidden].centres[which] += 20 * SIGMA_PX * np.array([np.cos(angle), np.sin(angle)])
        views[hidden] = replace(views[hidden], doubtful=np.ones(3, bool))
        found = pose.estimate(*views, target)
        if not found.found:
            continue
        assert np.argwhere(~found.used).tolist() == [[hidden, which]]
        off = error(found.world_from_target, true)
        squared.append(off @ np.linalg.solve(found.covariance, off))
    assert len(squared) > 0.6 * POSES and abs(np.mean(squared) - 6) < 4 * np.sqrt(12 / len(squared))


def test_a_right_circle_is_not_left_out_for_a_wrong_one(cameras, target, rng):
    """One is off by 20 times its uncertainty, and those of the other view are doubtful: then there is no pose, or a right one."""
    squared = []
    for _ in range(POSES):
        true = drawings.facing(rng)
        views = seen(cameras, target, true, rng)
        angle = rng.uniform(0, 2 * np.pi)
        views[0].centres[rng.integers(3)] += 20 * SIGMA_PX * np.array([np.cos(angle), np.sin(angle)])
        found = pose.estimate(views[0], replace(views[1], doubtful=np.ones(3, bool)), target)
        if found.found:
            off = error(found.world_from_target, true)
            squared.append(off @ np.linalg.solve(found.covariance, off))
    assert np.sum(np.array(squared) > 30) <= 1


@pytest.mark.parametrize(("wider", "right"), [(1.0, True), (1.04, False)])
def test_a_doubtful_circle_of_one_view_must_have_the_shape_that_the_pose_gives_it(cameras, target, rng, wider, right):
    """Its centre alone agrees with any two tilts; of the edge of something else the size is off."""
    for _ in range(10):
        views, which = seen(cameras, target, drawings.facing(rng), rng), rng.integers(3)
        views[0].shapes[which] *= wider
        views[0] = replace(views[0], doubtful=np.arange(3) == which)
        views[1] = views[1].without(which)
        found = pose.estimate(*views, target)
        assert found.found == right
        assert right or "shapes that no pose gives" in found.reason


def test_a_doubtful_circle_that_is_another_thing_is_left_out(cameras, target, rng):
    """Its rays don't meet those of the other view's; the pose is that of the other five."""
    for _ in range(10):
        true, which = drawings.facing(rng), rng.integers(3)
        views = seen(cameras, target, true, rng)
        views[1].centres[which] += [0.0, 150.0]
        assert "miss each other" in pose.estimate(*views, target).reason
        views[1] = replace(views[1], doubtful=np.arange(3) == which)
        found = pose.estimate(*views, target)
        assert found.found and np.argwhere(~found.used).tolist() == [[1, which]]
        off = error(found.world_from_target, true)
        assert off @ np.linalg.solve(found.covariance, off) < chi2.ppf(0.9999, 6)


def test_whole_ellipses_of_two_circles_a_view_determine_the_pose(cameras, target, rng):
    """With noise of shapes as of centres: errors over the covariance, and misfits, are chi-square."""
    squared, misfits = [], []
    for _ in range(POSES):
        true, which = drawings.facing(rng), rng.integers(3)
        views = [view.without(which).by_shapes() for view in seen(cameras, target, true, rng)]
        for view in views:
            noise = np.sqrt(view.noise[0, 2, 2]) * rng.standard_normal((3, 3))
            view.shapes[:] += noise[:, [0, 1, 1, 2]].reshape(3, 2, 2)
            del view.__dict__["noise"]
        views = [replace(view) for view in views]
        found = pose_fit.refined(true, views, target)
        off = error(found.world_from_target, true)
        squared.append(off @ np.linalg.solve(found.covariance, off))
        misfits.append(found.misfit)
        assert found.freedom == 14
    for values, freedom in ((squared, 6), (misfits, 14)):
        assert abs(np.mean(values) - freedom) < 4 * np.sqrt(2 * freedom / POSES)


@pytest.mark.parametrize(("bow_per_m", "most"), [((0.0, 0.0, 0.0), 1e-6), ((0.3, -0.2, 0.4), 0.02)])
def test_slopes_of_shapes_are_those_of_a_pose_that_is_moved(cameras, target, rng, bow_per_m, most):
    """Against moving the pose itself, one way after the other; a board's slope of 1 % is neglected beside 1."""
    bowed = target.model_copy(update={"curvature_per_m": bow_per_m})
    problem = pose_fit._Problem([], np.eye(1), circle_layout.circles(bowed), circle_layout.deviations(bowed))
    for _ in range(5):
        true = drawings.facing(rng)
        view = seen(cameras, target, true)[0].without(rng.integers(3)).by_shapes()
        guess = pose_fit._Guess(true, np.zeros(problem.by_deviation.shape[2]))
        for k, fast in enumerate(np.moveaxis(pose_fit._shape_slopes(view, guess, problem), 2, 0)[:6]):
            way = pose_fit.STEPS[k]
            ahead, behind = (
                pose_fit._predicted(view, guess._replace(world_from_target=rigid.moved(true, side * way)), problem.circles)[:, 2:]
                for side in (1, -1)
            )
            size = 1.0 if k < 3 else 0.001  # of a disc, or of its change by 1 mm
            assert np.abs((ahead - behind) / (2 * way[k]) - fast).max() < most * size * np.trace(view.shapes[0]) / 2


def test_nonsense_is_not_found(cameras, target):
    view = Sighting(cameras[0], np.full((3, 2), np.nan), np.tile(np.eye(2), (3, 1, 1)))
    assert not pose.estimate(view, replace(view, camera=cameras[1]), target).found
    same = replace(view, centres=np.full((3, 2), 500.0))
    assert not pose.estimate(same, replace(same, camera=cameras[1]), target).found


def test_the_scale_of_the_board_moves_poses_as_predicted(cameras, rig, rng):
    """Along the ray from camera 1, by its share of the distance; the target, known to 0.1 mm of 40, says next to nothing."""
    ratio = 1 + 3e-4
    scaled = with_scale(None, dict(zip(CAMERAS, cameras, strict=True)), 3e-4)
    moved = cameras[1].camera_from_world.copy()
    moved[:3, 3] *= ratio
    for _ in range(10):
        true = drawings.facing(rng)
        views = seen(cameras, rig.target, true)
        right = pose.estimate(*views, rig.target)
        views[1] = replace(views[1], camera=replace(cameras[1], camera_from_world=moved))
        found, distance = pose.estimate(*views, rig.target, scaled), np.linalg.norm(true[:3, 3])
        shift = error(found.world_from_target, right.world_from_target)[3:]
        assert np.allclose(shift, (ratio - 1) * true[:3, 3], atol=0.03 * 3e-4 * distance)
        by_scale = (found.shared - right.shared)[3:, 3:]
        ray = true[:3, 3] / distance
        assert np.sqrt(ray @ by_scale @ ray) == pytest.approx(3e-4 * distance, rel=0.03)
