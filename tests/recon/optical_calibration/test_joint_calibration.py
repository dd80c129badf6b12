"""The whole calibration, from sightings to a result that knows how sure it is; and captures that must not be trusted."""

from dataclasses import replace
from functools import partial
from types import SimpleNamespace
from typing import NamedTuple

import numpy as np
import pytest
from scipy.stats import chi2

from recon.board_detection.kinds.asymmetric_circles import AsymmetricCircles
from recon.board_detection.kinds.charuco import Charuco
from recon.board_detection.kinds.chessboard import Chessboard
from recon.errors import InputError
from recon.estimation.levenberg_marquardt import Rules
from recon.geometry import rigid
from recon.model.calibration import Calibration
from recon.model.patterns import Fringes
from recon.optical_calibration import adjustment, joint_calibration
from recon.optical_calibration.adjustment import adjust, free_parameters
from recon.optical_calibration.bundle import Estimate
from recon.optical_calibration.joint_calibration import Settings, Shape, departure, deviation
from recon.optical_calibration.sightings import Cause, Failure
from recon.structured_light.decode import Linearity
from tests.recon.board_sets import BOARD, DEVICES, corners, devices, observe, random_poses, sightings

QUICK = Settings(distortion="decentred")


@pytest.fixture(scope="module")
def cameras(rig):
    return devices(rig)


@pytest.fixture(scope="module")
def sizes(cameras):
    return {name: camera.size for name, camera in cameras.items()}


@pytest.fixture(scope="module")
def good(cameras):
    """Sightings of 12 sensible poses."""
    rng = np.random.default_rng(12)
    return sightings(cameras, random_poses(cameras, 12, rng), rng)


def test_a_good_set_is_calibrated_to_its_noise_without_a_warning(cameras, sizes, good):
    found = joint_calibration.calibrate(good, BOARD, sizes)
    assert found.dropped == {} and found.warnings == ()
    for name, model in found.model.items():
        assert model in ("decentred", "brown"), name
    # the projector's points carry half of camera 1's noise beside the fringes': its pixels are twice as wide on the board
    for name, expected in {"cam1": 0.0141, "cam2": 0.0141, "projector": 0.0108}.items():
        assert found.rms[name] == pytest.approx(expected, rel=0.15)
    error = deviation(found.adjustment.calibration, Calibration(cameras))
    assert error @ np.linalg.solve(found.adjustment.calibration.uncertainty.covariance, error) < chi2.ppf(0.999, len(error))


def test_without_the_correction_of_centres_the_baseline_is_off(cameras, sizes, monkeypatch):
    """Ellipses' centres taken for circles' centres give a calibration that is sure of itself and wrong."""
    rng = np.random.default_rng(13)
    good = sightings(cameras, random_poses(cameras, 12, rng), rng, noise=dict.fromkeys(DEVICES, 0.002))
    corrected = joint_calibration.calibrate(good, BOARD, sizes, QUICK).adjustment.calibration
    monkeypatch.setattr(joint_calibration, "circle_offsets", lambda observations, *_: np.zeros_like(observations.pixels))
    ignored = joint_calibration.calibrate(good, BOARD, sizes, QUICK).adjustment.calibration

    def squared_error(calibration):
        error = deviation(calibration, Calibration(cameras))
        return error @ np.linalg.solve(calibration.uncertainty.covariance, error) / len(error)

    assert squared_error(corrected) < 2
    assert squared_error(ignored) > 4


def test_the_projector_carries_the_correction_along(cameras):
    """The fringes are read at the ellipse's centre: a point there has the projector's coordinate that the offset predicts."""
    rng = np.random.default_rng(3)
    pose = random_poses(cameras, 1, rng)
    seen = observe(cameras, pose, rng, noise=dict.fromkeys(DEVICES, 0.0))
    offsets = joint_calibration.circle_offsets(seen, Estimate(cameras, pose, seen.points), BOARD)[0]
    rays = cameras["cam1"].rays(seen.pixels[0, :, 0] + offsets[:, 0])
    normal, point = pose[0][:3, 2], pose[0][:3, 3]
    on_board = rays * (point @ normal / (rays @ normal))[:, None]
    np.testing.assert_allclose(cameras["projector"].project(on_board), seen.pixels[0, :, 2] + offsets[:, 2], atol=1e-4)
    assert np.abs(offsets[:, 0]).max() > 0.01


def test_a_pose_whose_images_were_mixed_up_is_left_out_by_name(sizes, good):
    mixed = replace(good[5], pixels={**good[5].pixels, "cam2": good[6].pixels["cam2"]})
    found = joint_calibration.calibrate([*good[:5], mixed, *good[6:]], BOARD, sizes, QUICK)
    assert list(found.dropped) == ["05"] and "cam2" in found.dropped["05"]
    assert len(found.observations.poses) == 11 and found.rms["cam2"] < 0.02


def test_poses_that_mostly_contradict_each_other_are_refused(sizes, good):
    order = np.roll(np.arange(12), 1)
    shuffled = [replace(one, pixels={**one.pixels, "cam2": good[k].pixels["cam2"]}) for one, k in zip(good, order, strict=True)]
    with pytest.raises(InputError, match=r"stand still beside the first device.*mixed up"):
        joint_calibration.calibrate(shuffled, BOARD, sizes, QUICK)


def test_mistakes_of_the_program_are_not_blamed_on_sightings(sizes, good, monkeypatch):
    def mistaken(*_):
        raise ValueError("operands could not be broadcast together")

    monkeypatch.setattr(joint_calibration.initial_estimate, "estimate", mistaken)
    with pytest.raises(ValueError, match=r"^operands could not be broadcast") as raised:
        joint_calibration.calibrate(good, BOARD, sizes)
    assert not isinstance(raised.value, InputError)


def test_the_device_that_most_poses_contradict_is_named(monkeypatch):
    """Four poses of nine: three contradict in camera 2, by more and more, and the last that is left out in the projector."""
    misfits = np.ones((9, 1, 3))
    misfits[:4, 0] = [[1, 90, 1], [1, 80, 1], [1, 70, 1], [1, 1, 60]]

    class Poses(NamedTuple):
        poses: list[int]
        devices: tuple[str, ...] = DEVICES

        def of_poses(self, kept):
            return Poses([self.poses[k] for k in kept])

    def adjusted(observations, *_):
        normalised, count = misfits[observations.poses], len(observations.poses)
        values = {"normalised": normalised, "residuals": np.ones((count, 1, 3, 2)), "poses": np.arange(count), "points": None}
        return SimpleNamespace(calibration=Calibration({}), **values)

    monkeypatch.setattr(joint_calibration, "circle_offsets", lambda *_: None)
    monkeypatch.setattr(joint_calibration, "adjust", adjusted)
    with pytest.raises(InputError, match=r"found 4 of 9 that don't, most in cam2: "):
        joint_calibration._consistent(Poses(list(range(9))), None, {}, BOARD, "board", "")


@pytest.mark.parametrize(("device", "named"), [("projector", True), ("cam2", False)])
def test_light_that_is_not_linear_is_named_where_the_projector_contradicts(sizes, good, device, named):
    """Phases that a gamma bends put the projector's points off, pose by pose otherwise; a camera's not."""
    order, hidden = np.roll(np.arange(12), 1), Linearity(unknown=((Fringes(pitch=320, steps=3), "few"),))
    mixed = [
        replace(one, pixels={**one.pixels, device: good[k].pixels[device]}, linearity=hidden)
        for one, k in zip(good, order, strict=True)
    ]
    with pytest.raises(InputError, match=r"contradict|stand still") as caught:
        joint_calibration.calibrate(mixed, BOARD, sizes, QUICK)
    assert ("light too far from linear for so few steps (a gamma), or were images mixed up" in str(caught.value)) == named


def test_too_few_poses_are_refused_and_few_are_warned_of(sizes, good):
    with pytest.raises(InputError, match="expected 3 poses of the board or more for cam1, found 2"):
        joint_calibration.calibrate(good[:2], BOARD, sizes, QUICK)
    assert any("only 5 poses" in warning for warning in joint_calibration.calibrate(good[:5], BOARD, sizes, QUICK).warnings)


def test_an_adjustment_that_ends_too_early_is_warned_of(sizes, good, monkeypatch):
    """Such as by steps that are too short to arrive."""
    monkeypatch.setattr(adjustment, "FINE", Rules(steps=2, damping=1e6))
    found = joint_calibration.calibrate(good, BOARD, sizes, QUICK)
    assert any("before it converged" in warning for warning in found.warnings)


def test_a_board_found_nowhere_says_why(sizes, good):
    blind = [replace(one, pixels={}, failures={"cam1": Failure(Cause.NO_BOARD, "found 12 of 44 circles")}) for one in good]
    with pytest.raises(InputError, match="found it in none: found 12 of 44 circles"):
        joint_calibration.calibrate(blind, BOARD, sizes, QUICK)


@pytest.mark.parametrize("tilt_deg", [0.0, 25.0])
def test_parallel_boards_are_refused(cameras, sizes, tilt_deg):
    """All in one plane's direction, upright or tilted alike: any focal length fits."""
    rng = np.random.default_rng(4)
    turn = rigid.from_rotation_vector(np.deg2rad([tilt_deg, 0, 0]), [0, 0, 0])[:3, :3]
    poses = random_poses(cameras, 10, rng, tilt_deg=0)
    for pose in poses:
        middle = rigid.apply(pose, BOARD.points().mean(axis=0))
        pose[:3, :3] = turn @ pose[:3, :3]
        pose[:3, 3] += middle - rigid.apply(pose, BOARD.points().mean(axis=0))
    with pytest.raises(InputError, match=r"tilted against each other|all parallel"):
        joint_calibration.calibrate(sightings(cameras, poses, rng), BOARD, sizes, QUICK)


def test_a_wrong_spacing_is_refused_by_the_discs_size(sizes, good):
    wrong = AsymmetricCircles(columns=4, rows=11, spacing_mm=14, diameter_mm=9)
    with pytest.raises(InputError, match=r"discs of 0\.600 times the spacing.*is 0\.643"):
        joint_calibration.calibrate(good, wrong, sizes, QUICK)


def test_a_flipped_image_is_refused(sizes, good):
    flipped = [replace(one, pixels={**one.pixels, "cam2": one.pixels["cam2"] * [-1, 1] + [1279, 0]}) for one in good]
    with pytest.raises(InputError, match="expected cam2 to see the board's front, found it mirrored"):
        joint_calibration.calibrate(flipped, BOARD, sizes, QUICK)


def test_a_flipped_camera_1_is_refused_by_the_projector(sizes, good):
    flipped = []
    for one in good:  # a detector can't tell: the board's design is its own mirror image, rows counted from the other end
        order = np.arange(44).reshape(11, 4)[::-1].ravel()
        pixels = {**one.pixels, "cam1": one.pixels["cam1"] * [1, -1] + [0, 1023]}
        flipped.append(
            replace(
                one,
                pixels={name: at[order] if name != "cam2" else at for name, at in pixels.items()},
                gradient=(one.gradient @ np.diag([1, -1]))[order],
            )
        )
    with pytest.raises(InputError, match="mirrored"):
        joint_calibration.calibrate(flipped, BOARD, sizes, QUICK)


def test_cameras_that_expose_at_different_moments_are_told_by_one_alone(sizes, good):
    """A board that moves by a tenth of a millimetre meanwhile; each camera by itself has a still board in every image."""
    moments = np.random.default_rng(14).normal(0, 0.2, (len(good), 2))
    seen = [
        replace(one, pixels={"cam1": one.pixels["cam1"], "cam2": one.pixels["cam2"] + moved})
        for one, moved in zip(good, moments, strict=True)
    ]
    pair = joint_calibration.calibrate(seen, BOARD, {name: sizes[name] for name in ("cam1", "cam2")}, QUICK)
    assert "did both cameras expose at the same moment? devices=[cam1] shows one alone" in pair.warnings[0]
    alone = [replace(one, pixels={"cam1": one.pixels["cam1"]}) for one in seen]
    assert not any(
        "residuals are" in w for w in joint_calibration.calibrate(alone, BOARD, {"cam1": sizes["cam1"]}, QUICK).warnings
    )


def test_a_board_in_one_corner_is_warned_of(cameras, sizes):
    rng = np.random.default_rng(6)
    poses = [pose for pose in random_poses(cameras, 120, rng) if (pose[:3, :3] @ [52.5, 75, 0] + pose[:3, 3])[0] < -40][:10]
    found = joint_calibration.calibrate(sightings(cameras, np.array(poses), rng), BOARD, sizes, QUICK)
    assert any(warning.startswith("cam1: points surround") and "right" in warning for warning in found.warnings)


def test_a_bent_board_takes_its_shape_by_itself(cameras, sizes):
    """A saddle of 0.2 mm, printed to 0.02 mm, is found to some micrometres; a board as designed leaves larger residuals."""
    rng = np.random.default_rng(7)
    points = BOARD.points()
    half = points.max(axis=0)[:2] / 2
    x, y = ((points[:, :2] - half) / half).T
    bent = points + np.column_stack([0.02 * rng.standard_normal((44, 2)), 0.2 * (x**2 - y**2)])
    seen = sightings(cameras, random_poses(cameras, 15, rng), rng, points=bent)
    trusting = joint_calibration.calibrate(seen, BOARD, sizes, Settings(distortion="decentred", shape=Shape(released=False)))
    found = joint_calibration.calibrate(seen, BOARD, sizes, QUICK)
    assert max(found.rms.values()) < 0.02 < max(trusting.rms.values())
    assert any("not flat" in warning for warning in trusting.warnings)
    assert not any("not flat" in warning for warning in found.warnings)
    in_plane, out_of_plane = departure(found.adjustment.points, bent)
    assert in_plane < 0.005 and out_of_plane < 0.02
    assert found.tolerances.print_mm == pytest.approx(0.02, rel=0.3) and found.tolerances.bow_mm > 0.05


def test_departure_sees_shape_and_not_place(rng):
    design = BOARD.points()
    placed = rigid.apply(rigid.from_rotation_vector([0.1, 0.2, -0.3], [1, 2, 3]), design)
    np.testing.assert_allclose(departure(placed, design), 0, atol=1e-12)
    wavy = design + np.column_stack([np.zeros((44, 2)), 0.1 * rng.standard_normal(44)])
    assert departure(wavy, design)[1] == pytest.approx(0.1, rel=0.3)


def test_halves_agree_as_predicted(cameras):
    """Differences between two halves, over their predicted sigma, are standard normal: 3 sets, 99.9 %, for correlated numbers."""
    free = free_parameters(DEVICES, dict.fromkeys(DEVICES, ("k1", "k2", "p1", "p2")))
    found = []
    for seed in range(3):
        rng = np.random.default_rng(seed)
        poses = random_poses(cameras, 14, rng)
        whole = adjust(observe(cameras, poses, rng), Estimate(cameras, poses, BOARD.points()), free)
        found.append(np.mean(joint_calibration.compare_halves(whole) ** 2))
    assert 0.4 < np.mean(found) < 2.0


def test_one_camera_and_projector_are_enough(cameras):
    rng = np.random.default_rng(8)
    pair = {name: cameras[name] for name in ("cam1", "projector")}
    seen = sightings(pair, random_poses(cameras, 12, rng), rng)
    found = joint_calibration.calibrate(seen, BOARD, {name: camera.size for name, camera in pair.items()}, QUICK)
    assert list(found.adjustment.calibration.cameras) == ["cam1", "projector"]


@pytest.mark.parametrize("hidden", [{"cam2": [1]}, {"cam2": [3, 8]}, {"cam2": [0, 2, 4, 6, 8, 10]}, {"projector": [3]}])
def test_devices_may_miss_poses(sizes, good, hidden):
    """The distortion's choice, which takes long, so of eight poses, the halves and the noise all live with what is there."""
    quick = len(hidden.get("cam2", [])) > 1
    partly = []
    for number, one in enumerate(good if quick else good[:8]):
        gone = [device for device, poses in hidden.items() if number in poses]
        partly.append(replace(one, pixels={device: at for device, at in one.pixels.items() if device not in gone}))
    found = joint_calibration.calibrate(partly, BOARD, sizes, QUICK if quick else None)
    assert max(found.rms.values()) < 0.02
    np.testing.assert_allclose(list(found.adjustment.noise.values()), 1, atol=0.2)


def test_a_scrap_of_a_board_is_left_out_with_the_reason(sizes, good):
    scrap = good[4].pixels["cam2"].copy()
    scrap[7:] = np.nan
    found = joint_calibration.calibrate(
        [*good[:4], replace(good[4], pixels={**good[4].pixels, "cam2": scrap}), *good[5:]], BOARD, sizes, QUICK
    )
    assert found.dropped == {"04 cam2": "only 7 of 44 points, 8 are needed"}


def test_evidence_of_lens_and_board_is_weighed_by_the_last_offsets(sizes, good, monkeypatch):
    """Those of circles as the adjusted lenses show them, with which all is adjusted once more; not those from before."""
    weighed = {}

    def weigh(name, of, adjusted):
        weighed[name] = adjusted.problem
        return of(adjusted)

    for name in ("board_information", "lens_information"):
        monkeypatch.setattr(joint_calibration, name, partial(weigh, name, getattr(joint_calibration, name)))
    found = joint_calibration.calibrate(good, BOARD, sizes, QUICK)
    assert all(problem.offsets is found.offsets for problem in weighed.values()) and len(weighed) == 2
    assert weighed["lens_information"].tolerances == found.tolerances


def test_with_few_poses_the_lens_is_not_made_poorer_than_it_is(cameras, sizes):
    """Sets of four: no parameter is off by more than five of its standard deviations."""
    for seed in range(2):
        rng = np.random.default_rng(seed)
        found = joint_calibration.calibrate(
            sightings(cameras, random_poses(cameras, 4, rng), rng), BOARD, sizes
        ).adjustment.calibration
        error = deviation(found, Calibration(cameras)) / np.sqrt(np.diag(found.uncertainty.covariance))
        assert np.abs(error).max() < 5


def test_a_flat_board_stays_flat(cameras, sizes):
    """Within the micrometres that ten poses can't exclude; errors of points are predicted to grow by less than a third."""
    for seed in range(1):
        rng = np.random.default_rng(seed)
        seen = sightings(cameras, random_poses(cameras, 10, rng), rng)
        found = joint_calibration.calibrate(seen, BOARD, sizes, QUICK)
        assert found.released and found.tolerances.sigmas.max() < 0.01
        assert max(departure(found.adjustment.points, BOARD.points())) < 0.003


def test_a_board_of_too_few_sightings_is_taken_as_designed(cameras, sizes):
    rng = np.random.default_rng(3)
    one = {"cam1": cameras["cam1"]}
    found = joint_calibration.calibrate(sightings(one, random_poses(cameras, 3, rng), rng), BOARD, {"cam1": sizes["cam1"]}, QUICK)
    assert not found.released and (found.adjustment.points == BOARD.points()).all()


def test_outliers_of_camera_1_do_not_count_as_the_projectors(sizes, good):
    """Two of its points off by a pixel: the projector's figure stays what it is, for it was read there."""
    off = good[2].pixels["cam1"].copy()
    off[[5, 20]] += 1.0
    spoilt = [*good[:2], replace(good[2], pixels={**good[2].pixels, "cam1": off}), *good[3:]]
    before, after = (joint_calibration.calibrate(those, BOARD, sizes, QUICK).rms["projector"] for those in (good, spoilt))
    assert after == pytest.approx(before, rel=0.1)


@pytest.mark.parametrize(
    "board, share",
    [(Chessboard(columns=9, rows=6, square_mm=16), 1.0), (Charuco(columns=10, rows=7, square_mm=16, marker_mm=12), 0.6)],
    ids=["chessboard", "charuco in part"],
)
def test_corners_calibrate_a_projector_too_and_need_not_all_be_seen(cameras, sizes, board, share):
    """No centres to correct; of the ChArUco board each camera sees another part, and the projector what camera 1 sees."""
    rng = np.random.default_rng(15)
    seen = corners(cameras, random_poses(cameras, 14, rng, points=board.points()), board, rng, share)
    found = joint_calibration.calibrate(seen, board, sizes, QUICK)
    assert len(found.observations.poses) == 14 and found.dropped == {} and not found.offsets.any()
    assert np.isfinite(found.observations.pixels[..., 0]).mean(axis=(0, 1)) == pytest.approx(share, abs=0.02)
    error = deviation(found.adjustment.calibration, Calibration(cameras))
    length = error @ np.linalg.solve(found.adjustment.calibration.uncertainty.covariance, error)
    assert chi2.ppf(0.001, len(error)) < length < chi2.ppf(0.999, len(error))
