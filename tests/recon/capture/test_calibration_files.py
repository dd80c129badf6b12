"""Calibration files of every dialect come back as they were, and bad ones are refused in one line."""

import re
from dataclasses import replace

import cv2
import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.io import savemat

from recon import registry
from recon.capture import calibration_files
from recon.capture.layouts import meza2021
from recon.errors import InputError
from recon.geometry import rigid
from recon.geometry.camera import Camera
from recon.model.calibration import Calibration, Uncertainty

SIZES = {"cam1": (1280, 1024), "cam2": (1280, 1024), "projector": (1280, 800)}


def device(name: str, seed: int, coefficients: int = 5) -> Camera:
    rng = np.random.default_rng(seed)
    matrix = np.array([[3320.0 + rng.normal(), 0, 618.0], [0, 3331 + rng.normal(), 523], [0, 0, 1]])
    pose = np.eye(4) if name == "cam1" else rigid.from_rotation_vector(rng.normal(0, 0.2, 3), rng.normal(0, 100, 3))
    return Camera(SIZES[name], matrix, rng.normal(0, 0.05, coefficients), pose)


@pytest.fixture
def optics() -> Calibration:
    return Calibration({"cam1": device("cam1", 1), "cam2": device("cam2", 2, 14), "projector": device("projector", 3, 8)})


def dialect(name: str):
    return registry.kind(calibration_files.DIALECTS, name)


def uncertain(names: tuple[str, ...], seed: int = 0) -> Uncertainty:
    """A covariance over many powers of ten, as those of focal lengths and of distortions are."""
    rng = np.random.default_rng(seed)
    mixed = rng.normal(size=(len(names), len(names) + 2)) * 10 ** rng.uniform(-6, 1, (len(names), 1))
    return Uncertainty(names, mixed @ mixed.T)


NAMES = ("cam1.fx", "cam1.k2", "cam2.tau_x", "cam2.rz", "projector.cy", "projector.tx")


def same(a: Camera, b: Camera) -> bool:
    parts = ((a.matrix, b.matrix), (a.distortion, b.distortion), (a.camera_from_world, b.camera_from_world))
    return a.size == b.size and all(np.allclose(x, y, rtol=0, atol=1e-12) for x, y in parts)


def write_storage(path, values):
    storage = cv2.FileStorage(str(path), cv2.FileStorage_WRITE)
    for key, value in values.items():
        storage.write(key, value)
    storage.release()


def slmaster(optics: Calibration) -> dict:
    camera, projector = optics.cameras["cam1"], optics.cameras["projector"]
    rotation, translation = projector.camera_from_world[:3, :3].copy(), projector.camera_from_world[:3, 3:].copy()
    matrices = {"M1": camera.matrix, "D1": camera.distortion.reshape(1, -1), "S": np.array([[1280.0], [1024.0]])}
    return matrices | {"M4": projector.matrix, "D4": projector.distortion.reshape(1, -1), "Rlp": rotation, "Tlp": translation}


def test_own_format_comes_back(optics, tmp_path):
    calibration_files.write(tmp_path / "optics.yaml", optics)
    found = calibration_files.read(tmp_path / "optics.yaml").cameras
    assert list(found) == list(optics.cameras)
    assert all(same(found[name], camera) for name, camera in optics.cameras.items())
    first = (tmp_path / "optics.yaml").read_bytes()
    calibration_files.write(tmp_path / "optics.yaml", optics)
    assert (tmp_path / "optics.yaml").read_bytes() == first and len(list(tmp_path.iterdir())) == 1


@pytest.mark.parametrize("motion", [("Rlr", "Tlr"), ("R", "T")])
def test_two_cameras_of_slmaster_and_stereo_calib(motion, optics, tmp_path):
    """Whose world is camera 1, too; without the motion between both, the file to copy it from is named."""
    first, second = optics.cameras["cam1"], optics.cameras["cam2"]
    values = {"M1": first.matrix, "D1": first.distortion[None], "M2": second.matrix, "D2": second.distortion[None]}
    write_storage(tmp_path / "intrinsics.yml", values)
    with pytest.raises(InputError, match=r"expected Rlr and Tlr, or R and T, .*found M1, D1, M2, D2; .*extrinsics.yml"):
        calibration_files.read(tmp_path / "intrinsics.yml", SIZES)
    values |= {motion[0]: second.camera_from_world[:3, :3].copy(), motion[1]: second.camera_from_world[:3, 3:].copy()}
    write_storage(tmp_path / "pair.yml", values)
    found = calibration_files.read(tmp_path / "pair.yml", SIZES).cameras
    assert list(found) == ["cam1", "cam2"] and same(found["cam1"], first) and same(found["cam2"], second)


def test_own_format_is_opencvs(optics, tmp_path):
    """Any OpenCV program finds the values by name."""
    calibration_files.write(tmp_path / "optics.yaml", optics)
    storage = cv2.FileStorage(str(tmp_path / "optics.yaml"), cv2.FileStorage_READ)
    node = storage.getNode("projector")
    assert np.array_equal(node.getNode("matrix").mat(), optics.cameras["projector"].matrix)
    assert [node.getNode("size").at(i).real() for i in range(2)] == [1280, 800]


def test_the_covariance_comes_back(optics, tmp_path):
    path = tmp_path / "optics.yaml"
    known = Calibration(optics.cameras, uncertain(NAMES))
    calibration_files.write(path, known)
    found = calibration_files.read(path)
    assert list(found.cameras) == list(optics.cameras), "neither names nor covariance are taken for a device"
    assert found.uncertainty.names == NAMES
    assert np.array_equal(found.uncertainty.covariance, known.uncertainty.covariance)
    storage = cv2.FileStorage(str(path), cv2.FileStorage_READ)
    assert storage.getNode("parameters").at(3).string() == "cam2.rz"
    assert storage.getNode("covariance").mat().shape == (6, 6)


def test_cameras_whose_names_are_exchanged_are_named(optics, tmp_path, caplog):
    """The world is camera 1's frame: no other camera stands where it begins."""
    calibration_files.write(tmp_path / "optics.yaml", optics)
    calibration_files.read(tmp_path / "optics.yaml")
    assert not caplog.text
    cameras = dict(optics.cameras)
    cameras["cam1"], cameras["cam2"] = cameras["cam2"], cameras["cam1"]
    calibration_files.write(tmp_path / "exchanged.yaml", Calibration(cameras))
    calibration_files.read(tmp_path / "exchanged.yaml")
    assert "expected cam1 where the world begins, found cam2 there: are their names exchanged?" in caplog.text


def test_a_lens_that_folds_within_its_image_is_named(optics, tmp_path, caplog):
    """k1 and k2 exchanged: r (1 - 8 r^2) turns back at 0.2, and the image's corner lies at 0.25; r (1 - 8 r^4) turns at 0.4."""
    for k, said in (([-0.4, -8, 0, 0], 0), ([-8, -0.4, 0, 0], 1)):
        bent = replace(optics.cameras["cam2"], distortion=np.array(k))
        calibration_files.write(tmp_path / "optics.yaml", Calibration({"cam1": optics.cameras["cam1"], "cam2": bent}))
        calibration_files.read(tmp_path / "optics.yaml")
        assert caplog.text.count("cam2: the lens folds within the image, where pixels have no ray") == said


def test_lenses_that_were_left_out_are_named(optics, tmp_path, caplog):
    """Of a rectified pair, both of one matrix, there are none."""
    straight = {name: replace(camera, distortion=np.zeros(5)) for name, camera in optics.cameras.items()}
    pair = {name: replace(straight[name], matrix=straight["cam1"].matrix) for name in ("cam1", "cam2")}
    for cameras, said in ((pair, 0), (straight, 1)):
        calibration_files.write(tmp_path / "optics.yaml", Calibration(cameras))
        calibration_files.read(tmp_path / "optics.yaml")
        assert caplog.text.count("no lens has any distortion: was it left out") == said


def test_a_file_from_before_covariances_has_none(optics, tmp_path):
    calibration_files.write(tmp_path / "optics.yaml", optics)
    assert "covariance" not in (tmp_path / "optics.yaml").read_text()
    assert calibration_files.read(tmp_path / "optics.yaml").uncertainty is None


@settings(max_examples=30, deadline=None)
@given(data=st.data())
def test_any_calibration_comes_back(data, tmp_path_factory):
    """Whatever the numbers, however few or many parameters are uncertain."""
    number = st.floats(-1e6, 1e6)
    small = st.floats(-10, 10)
    cameras = {}
    for name in data.draw(st.sampled_from([("cam1",), ("cam1", "cam2"), ("cam1", "projector"), ("cam1", "cam2", "projector")])):
        focal = data.draw(st.tuples(*[st.floats(1e-3, 1e6)] * 2))
        matrix = np.array([[focal[0], data.draw(small), data.draw(number)], [0, focal[1], data.draw(number)], [0, 0, 1]])
        count = data.draw(st.sampled_from([4, 5, 8, 12, 14]))
        distortion = np.array(data.draw(st.lists(small, min_size=count, max_size=count)))
        pose = rigid.from_rotation_vector(data.draw(st.tuples(small, small, small)), data.draw(st.tuples(number, number, number)))
        size = data.draw(st.tuples(*[st.integers(1, 20000)] * 2))
        cameras[name] = Camera(size, matrix, distortion, np.eye(4) if name == "cam1" else pose)
    choice = [f"{device}.{name}" for device in cameras for name in ("fx", "fy", "cx", "cy", "k1", "k5", "tau_y")]
    names = tuple(data.draw(st.lists(st.sampled_from(choice), min_size=1, unique=True)))
    path = tmp_path_factory.mktemp("any") / "optics.yaml"
    written = Calibration(cameras, uncertain(names, data.draw(st.integers(0, 1000))))
    calibration_files.write(path, written)
    found = calibration_files.read(path)
    assert list(found.cameras) == list(cameras) and found.uncertainty.names == names
    assert np.array_equal(found.uncertainty.covariance, written.uncertainty.covariance)
    for name, camera in cameras.items():
        assert found.cameras[name].size == camera.size
        for part in ("matrix", "distortion", "camera_from_world"):
            assert np.array_equal(getattr(found.cameras[name], part), getattr(camera, part))


PLACES = {"kalibr": (4, 3), "ros": (8, 2), "mrcal": (12, 3), "slstudio": (5, 2)}  # coefficients and devices, at most


@pytest.mark.parametrize("layout", PLACES)
@settings(max_examples=10, deadline=None)
@given(data=st.data())
def test_any_calibration_comes_back_from_other_programs_files(layout, data, tmp_path_factory):
    """As far as they have places: metres, chains and rectified pairs are ours again, whatever the devices' order and numbers."""
    small, number = st.floats(-3, 3), st.floats(-900, 900)
    most, several = PLACES[layout]
    second = "projector" if layout == "slstudio" else data.draw(st.sampled_from(["cam2", "projector"]))
    cameras = {}
    for name in ["cam1", second, "projector"][: several if second == "cam2" else 2]:
        focal = data.draw(st.tuples(*[st.floats(500, 5000)] * 2))
        matrix = np.array([[focal[0], 0, data.draw(number)], [0, focal[1], data.draw(number)], [0, 0, 1]])
        k = np.array(data.draw(st.lists(st.floats(-0.1, 0.1), max_size=most)))
        k = np.pad(k, (0, next(count for count in (0, 4, 5, 8, 12) if count >= len(k)) - len(k)))
        turn, shift = data.draw(st.tuples(small, small, small)), data.draw(st.tuples(st.floats(2, 900), number, number))
        pose = np.eye(4) if name == "cam1" else rigid.from_rotation_vector(turn, shift)
        if layout == "ros" and pose[2, 2] < 0.1:
            pose[:3, :3] = np.eye(3)  # a pair that looks to opposite sides has no common image
        cameras[name] = Camera(data.draw(st.tuples(*[st.integers(8, 9000)] * 2)), matrix, k, pose)
    folder = tmp_path_factory.mktemp(layout)
    names = dialect(layout).write(folder, Calibration(cameras))
    found = calibration_files.read(folder / names[0] if len(names) == 1 else folder).cameras
    assert list(found) == list(cameras)
    for name, camera in cameras.items():
        long = np.pad(found[name].distortion, (0, 14 - found[name].distortion.size))
        assert found[name].size == camera.size and np.array_equal(found[name].matrix, camera.matrix)
        assert np.array_equal(long, np.pad(camera.distortion, (0, 14 - camera.distortion.size)))
        assert found[name].camera_from_world == pytest.approx(camera.camera_from_world, abs=1e-9)


@pytest.mark.parametrize(
    ("layout", "coefficients", "complaint"),
    [
        ("kalibr", 5, "cam1.distortion: expected k1 k2 p1 p2 alone, all that Kalibr's radtan has, found k3 = "),
        ("ros", 12, "expected k1 k2 p1 p2 k3 k4 k5 k6 alone, .* found s1 = .*: calibrate-optics distortion=rational"),
        ("mrcal", 14, "cam1.distortion: .* found tau_x = "),
        ("slstudio", 8, "cam1.distortion: .* all that SLStudio has, found k4 = "),
    ],
)
def test_what_a_layout_has_no_place_for_is_refused(layout, coefficients, complaint, tmp_path):
    optics = Calibration({"cam1": device("cam1", 1, coefficients), "projector": device("projector", 3)})
    with pytest.raises(InputError, match=complaint):
        dialect(layout).write(tmp_path, optics)
    plain = device("cam1", 1, 4)
    skew = replace(plain, matrix=plain.matrix + 0.5 * np.eye(3, k=1) * [[1], [0], [0]])
    if layout != "slstudio":
        with pytest.raises(InputError, match=r"cam1.matrix: expected no skew, .* found 0.5"):
            dialect(layout).write(tmp_path, Calibration({"cam1": skew, "projector": device("projector", 3, 4)}))
    assert not list(tmp_path.iterdir())


def test_a_rectified_pair_has_its_shift_along_x_and_one_focal_length(optics, tmp_path):
    """As ROS has them: points of both, turned by R, differ by P[0, 3] over the focal length, in metres; so rows are alike."""
    beside = rigid.from_rotation_vector([0.05, -0.2, 0.02], [-150, 20, 5])
    second = device("cam2", 4)
    few = Calibration({"cam1": device("cam1", 3), "cam2": Camera(second.size, second.matrix, second.distortion, beside)})
    dialect("ros").write(tmp_path, few)
    files = [yaml.safe_load((tmp_path / f"{name}.yaml").read_text()) for name in few.cameras]
    projections = [np.reshape(file["projection_matrix"]["data"], (3, 4)) for file in files]
    turns = [np.reshape(file["rectification_matrix"]["data"], (3, 3)) for file in files]
    assert np.array_equal(projections[0][:, :3], projections[1][:, :3]) and not projections[0][:, 3].any()
    assert projections[1][1:, 3] == pytest.approx([0, 0]) and projections[1][0, 3] < 0, "camera 2 stands to the right"
    points = np.random.default_rng(5).normal([0, 0, 900], 60, (20, 3))
    seen = []
    for camera, turn, projection in zip(few.cameras.values(), turns, projections, strict=True):
        local = rigid.apply(camera.camera_from_world, points) @ turn.T / 1000
        seen.append((local @ projection[:, :3].T)[:, 1] / local[:, 2])
    assert seen[0] == pytest.approx(seen[1])


KALIBR = """
cam0:
  camera_model: pinhole
  intrinsics: [461.6, 460.1, 362.6, 246.0]
  distortion_model: radtan
  distortion_coeffs: [-0.277, 0.067, 8.0e-04, 1e-05]
  rostopic: /cam0/image_raw
  resolution: [752, 480]
cam1:
  camera_model: pinhole
  intrinsics: [458.6, 457.2, 367.2, 248.3]
  distortion_model: none
  distortion_coeffs: []
  T_cn_cnm1: [[1.0, 0.0, 0.0, -0.11], [0.0, 1.0, 0.0, 0.0005], [0.0, 0.0, 1.0, -0.0002], [0.0, 0.0, 0.0, 1.0]]
  rostopic: /cam1/image_raw
  resolution: [752, 480]
"""
MRCAL = """# generated with a program, 'extrinsics': in vain
{
    'lensmodel':  'LENSMODEL_OPENCV4',

    # intrinsics are fx,fy,cx,cy,distortion0,distortion1,....
    'intrinsics': [ 1766.07, 1765.89, 1944.06, 1064.52, 2.1, -1.1, -9.3e-05, 0.0007,],
    'valid_intrinsics_region': [ [ 0, 0 ], [ 10, 0 ], [ 10, 10 ], [ 0, 0 ] ],
    'rt_cam_ref': [ 0.1, 0., 0, -.25, 0, 0,],
    'imagersize': [ 3840, 2160,],
    'optimization_inputs': b'P)h>@6aWAK2mk;8ApigX00;'
}
"""


def test_files_as_kalibr_and_mrcal_write_them(tmp_path):
    """Their first camera is camera 1, its frame the world; metres become mm."""
    (tmp_path / "camchain.yaml").write_text(KALIBR)
    found = calibration_files.read(tmp_path / "camchain.yaml").cameras
    assert found["cam2"].camera_from_world[:3, 3] == pytest.approx([-110, 0.5, -0.2]) and found["cam1"].distortion[3] == 1e-5
    folder = tmp_path / "models"
    folder.mkdir()
    (folder / "camera-0.cameramodel").write_text(MRCAL.replace("-.25", "30.25"))  # of a reference that lies far away
    (folder / "camera-1.cameramodel").write_text(MRCAL.replace("-.25", "30."))
    both = calibration_files.read(folder).cameras
    assert list(both) == ["cam1", "cam2"] and both["cam1"].size == (3840, 2160)
    assert np.array_equal(both["cam1"].camera_from_world, np.eye(4))
    assert both["cam2"].camera_from_world == pytest.approx(rigid.transform(np.eye(3), [-250, 0, 0]))


@pytest.mark.parametrize(
    ("first", "second", "expected"),
    [
        ("left", "right", ("cam1", "cam2")),
        ("stereo/right", "stereo/left", ("cam2", "cam1")),
        ("Camera_right", "camera_left", ("cam2", "cam1")),
        ("cam0", "cam1", ("cam1", "cam2")),
        ("cam1", "cam0", ("cam2", "cam1")),
        ("cam1", "projector", ("cam1", "projector")),
        ("a", "b", ("cam1", "cam2")),
        ("left", "camera", None),
        ("camera", "projector", None),
        ("cam1", "proj", None),
        ("right", "cam0", None),
        ("cam2", "cam3", None),
        ("left", "cam1", None),
    ],
)
def test_devices_are_told_by_words_or_not_at_all(tmp_path, first, second, expected):
    """A pair of which one word alone tells isn't taken in another order."""
    (tmp_path / "camchain.yaml").write_text(KALIBR.replace("/cam0/", "/%s/").replace("/cam1/", "/%s/") % (first, second))
    if expected is None:
        with pytest.raises(InputError, match=r"expected names with cam1, left, cam2, .*; rename them"):
            calibration_files.read(tmp_path / "camchain.yaml")
        return
    cameras = calibration_files.read(tmp_path / "camchain.yaml").cameras
    assert {name: camera.matrix[0, 0] for name, camera in cameras.items()} == dict(zip(expected, (461.6, 458.6), strict=True))


@pytest.mark.parametrize(
    ("text", "old", "new", "complaint"),
    [
        (KALIBR, "distortion_model: radtan", "distortion_model: equidistant", "cam0: .*none, found .*'equidistant'"),
        (KALIBR, "-0.11]", "-110.0]", r"cam2: expected it within 20 m of cam1, found 110 m: are its translations in mm\?"),
        (KALIBR, "[752, 480]", "[752]", r"cam0.resolution: expected 2 numbers, found \[752\]"),
        (KALIBR, "461.6, ", "", "cam0.intrinsics: expected 4 numbers"),
        (KALIBR, "T_cn_cnm1", "T_cam_imu", "cam1.T_cn_cnm1: expected 4 rows of 4 numbers, found None"),
        (KALIBR, "[1.0, 0.0, 0.0, -0.11]", "[0.9, 0.0, 0.0, -0.11]", "cam2.camera_from_world: expected a rigid transform"),
        (MRCAL, "OPENCV4", "SPLINED_STEREOGRAPHIC_order=3", "lensmodel: expected one of .*mrcal-convert-lensmodel"),
        (MRCAL, "2.1, -1.1,", "2.1,", "intrinsics: expected 8 numbers"),
        (MRCAL, "'imagersize'", "'imagesize'", "imagersize: expected a list of numbers once, found none"),
        (MRCAL, "-.25", "__import__('os')", "extrinsics: expected a list of numbers once, found something else"),
    ],
)  # fmt: skip
def test_other_programs_files_are_refused_by_field(text, old, new, complaint, tmp_path):
    path = tmp_path / "theirs.txt"
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(InputError, match=complaint) as refusal:
        calibration_files.read(path)
    assert str(refusal.value).startswith(f"{path}: ") and "\n" not in str(refusal.value)


def test_a_standard_deviation_is_asked_for_by_name():
    assert Uncertainty(("cam1.fx", "cam1.fy"), np.diag([4.0, 9.0])).sigma("cam1.fy") == 3
    assert Uncertainty(("cam1.fx",), np.eye(1)).sigma("cam1.k1") == 0, "held fixed"


def spoilt(names=("cam1.fx", "projector.rx"), covariance=((1.0, 0.5), (0.5, 2.0))) -> dict:
    return {"parameters": list(names), "covariance": np.array(covariance)}


@pytest.mark.parametrize(
    ("values", "complaint"),
    [
        ({"parameters": ["cam1.fx"]}, "covariance: expected a matrix, found none"),
        ({"covariance": np.eye(2)}, "parameters: expected names of the covariance's parameters, found something else"),
        ({"parameters": 3.0, "covariance": np.eye(1)}, "parameters: expected names of the covariance's parameters"),
        ({"parameters": "cam1.fx", "covariance": np.eye(1)}, "parameters: expected names of the covariance's parameters"),
        (spoilt(("cam1.fx", "cam3.fx")), "parameters: expected a device's parameter like projector.fx, each once, found cam3.fx"),
        (spoilt(("cam1.fx", "cam1.focal")), "parameters: expected a device's parameter like projector.fx, each once"),
        (spoilt(("cam1.fx", "cam1.rx")), "parameters: expected a device's parameter like projector.fx, each once, found cam1.rx"),
        (spoilt(("cam1.fx", "cam1.fx")), "parameters: expected a device's parameter like projector.fx, each once, found cam1.fx"),
        (
            spoilt(covariance=np.eye(3)),
            "covariance: expected 2x2 variances and covariances of the parameters, found shape (3, 3)",
        ),
        (
            spoilt(covariance=[[1, 0.5], [0.4, 2]]),
            "covariance: expected 2x2 variances and covariances of the parameters, found a mat",
        ),
        (
            spoilt(covariance=[[np.nan, 0], [0, 1]]),
            "covariance: expected 2x2 variances and covariances of the parameters, found val",
        ),
        (
            spoilt(covariance=[[-1, 0], [0, 1]]),
            "covariance: expected 2x2 variances and covariances of the parameters, found a vari",
        ),
        (
            spoilt(covariance=[[1, 2], [2, 1]]),
            "covariance: expected 2x2 variances and covariances of the parameters, found a variance",
        ),
    ],
)
def test_a_wrong_covariance_is_refused_in_one_line(optics, tmp_path, values, complaint):
    path = tmp_path / "optics.yaml"
    calibration_files.write(path, optics)
    storage = cv2.FileStorage(str(path), cv2.FileStorage_APPEND)
    for key, value in values.items():
        storage.write(key, value)
    storage.release()
    with pytest.raises(InputError) as refusal:
        calibration_files.read(path)
    assert str(refusal.value).startswith(f"{path}: {complaint}") and "\n" not in str(refusal.value)


def test_a_camera_without_distortion_comes_back_as_such_in_effect(tmp_path):
    plain = Camera((64, 48), np.diag([50.0, 50, 1]), np.zeros(0))
    calibration_files.write(tmp_path / "optics.yaml", Calibration({"cam1": plain}))
    assert not calibration_files.read(tmp_path / "optics.yaml").cameras["cam1"].distortion.any()


@pytest.mark.parametrize("suffix", ["yml", "xml", "json"])
def test_slmaster_dialect(optics, tmp_path, suffix):
    write_storage(tmp_path / f"calibration.{suffix}", slmaster(optics))
    found = calibration_files.read(tmp_path / f"calibration.{suffix}", SIZES).cameras
    assert same(found["cam1"], optics.cameras["cam1"]) and same(found["projector"], optics.cameras["projector"])


@pytest.mark.parametrize(
    ("name", "second"),
    [
        *(("cam1_proj_params.npz", "projector"), ("cam1_cam2_params.npz", "cam2"), ("StereoParams.xml", "cam2")),
        *(("Params.mat", "cam2"), ("cam1_proj_params.mat", "projector")),
    ],
)
def test_authors_dialects(optics, tmp_path, name, second):
    values = meza2021.parameters(optics, second)
    if name.endswith("npz"):
        np.savez(tmp_path / name, **values)
    elif name.endswith("mat"):
        savemat(tmp_path / name, values)
    else:
        write_storage(tmp_path / name, {key: np.ascontiguousarray(value) for key, value in values.items()})
    found = calibration_files.read(tmp_path / name, SIZES).cameras
    assert list(found) == ["cam1", second]
    assert same(found["cam1"], optics.cameras["cam1"]) and same(found[second], optics.cameras[second])


def test_first_files_of_the_authors_name_distortions_otherwise(optics, tmp_path):
    values = meza2021.parameters(optics, "cam2")
    old = {{"dist1": "distCoeffs1", "dist2": "distCoeffs2"}.get(key, key): value for key, value in values.items()}
    savemat(tmp_path / "Params.mat", old, do_compression=True)
    assert same(calibration_files.read(tmp_path / "Params.mat", SIZES).cameras["cam2"], optics.cameras["cam2"])


def test_the_fundamental_matrix_holds_the_epipolar_constraint(optics):
    """Distortion-free pixels of the same point: x2' F x1 = 0, in units of the distance to the epipolar line, px."""
    points = np.random.default_rng(0).uniform((-100, -80, 600), (100, 80, 700), (50, 3))
    first, second = (optics.cameras[name] for name in ("cam1", "projector"))
    pixels = []
    for camera in (first, second):
        local = rigid.apply(camera.camera_from_world, points)
        pixels.append(local / local[:, 2:] @ camera.matrix.T)
    lines = pixels[0] @ meza2021.parameters(optics)["F"].T
    assert np.abs((pixels[1] * lines).sum(axis=1) / np.linalg.norm(lines[:, :2], axis=1)).max() < 1e-6


def test_few_digits_of_a_file_give_an_exact_rotation(optics, tmp_path):
    """A turn about one axis with five decimals; with four it is refused, and the matrix is shown."""
    turn = rigid.from_rotation_vector([0, 0.3, 0], [0, 0, 0])[:3, :3]
    write_storage(tmp_path / "five.yml", slmaster(optics) | {"Rlp": np.round(turn, 5)})
    found = calibration_files.read(tmp_path / "five.yml", SIZES).cameras["projector"].camera_from_world
    assert np.abs(found[:3, :3] - turn).max() < 1e-5
    assert np.abs(found[:3, :3] @ found[:3, :3].T - np.eye(3)).max() < 1e-12
    write_storage(tmp_path / "four.yml", slmaster(optics) | {"Rlp": np.round(turn, 4)})
    with pytest.raises(
        InputError, match=r"projector\.camera_from_world: .*no rotation: 0\.9553 0 0\.2955; 0 1 0; -0\.2955 0 0\.9553$"
    ):
        calibration_files.read(tmp_path / "four.yml", SIZES)


def without(values, key):
    return {name: value for name, value in values.items() if name != key}


@pytest.mark.parametrize(
    ("fault", "complaint"),
    [
        (lambda v: without(v, "Tlp"), "Tlp: expected a matrix, found none"),
        (lambda v: v | {"M1": np.full((3, 3), np.nan)}, "cam1.matrix: expected a finite 3x3 matrix"),
        (lambda v: v | {"D4": np.zeros((1, 7))}, "projector.distortion: expected 0, 4, 5, 8, 12 or 14"),
        (lambda v: v | {"Rlp": 2 * np.eye(3)}, "projector.camera_from_world: expected a rigid transform of a right-"),
        (lambda v: v | {"Rlp": np.eye(2)}, "Rlp, Tlp: expected a 3x3 rotation"),
        (lambda v: v | {"S": np.array([[0.0], [10.0]])}, "S: expected the camera's width and height"),
        (lambda v: v | {"M4": "text"}, "M4: expected a matrix, found something else"),
        (
            lambda v: {"A": np.eye(3)},
            "expected a file of Kalibr, or a file of mrcal, or schema, or a file of ROS, or M1 and M4, or Kc and Kp, "
            "or K1 and K2, or M1 and M2, found A",
        ),
    ],
)
def test_wrong_values_are_refused_in_one_line(optics, tmp_path, fault, complaint):
    path = tmp_path / "calibration.yml"
    write_storage(path, fault(slmaster(optics)))
    with pytest.raises(InputError) as refusal:
        calibration_files.read(path, SIZES)
    assert str(refusal.value).startswith(f"{path}: {complaint}") and "\n" not in str(refusal.value)


def test_a_file_of_line_breaks_is_refused(tmp_path):
    """At once: a search that takes any blank for a line's beginning would go on for minutes."""
    (tmp_path / "optics.xml").write_text("\n" * 4096, encoding="ascii")
    with pytest.raises(InputError, match=r"optics\.xml: expected an npz file or OpenCV's YAML"):
        calibration_files.read(tmp_path / "optics.xml")


def test_damaged_files_are_refused_in_one_line(optics, tmp_path):
    """Cut at every tenth of its length, or not a calibration at all."""
    calibration_files.write(tmp_path / "optics.yaml", Calibration(optics.cameras, uncertain(NAMES)))
    whole = (tmp_path / "optics.yaml").read_bytes()
    np.savez(tmp_path / "a.npz", **meza2021.parameters(optics))
    archive = (tmp_path / "a.npz").read_bytes()
    np.savez_compressed(tmp_path / "a.npz", **meza2021.parameters(optics))
    spoilt = bytearray((tmp_path / "a.npz").read_bytes())
    spoilt[60:80] = 20 * b"\xff"  # within the first matrix
    savemat(tmp_path / "a.mat", meza2021.parameters(optics), do_compression=True)
    matlab = (tmp_path / "a.mat").read_bytes()
    cut = [bytes(spoilt), *(data[: len(data) * i // 10] for data in (whole, archive, matlab) for i in range(1, 10))]
    newer = whole.replace(b"sonotwin-optics/1", b"sonotwin-optics/2")
    path = tmp_path / "damaged.yaml"
    for data in [b"", b"hello", b"\xff\xfe\x00", b"%YAML:1.0\n---\n- 3\n", b"PK\x03\x04", newer, *cut]:
        path.write_bytes(data)
        with pytest.raises(InputError, match=r"^[^\n]*damaged\.yaml: [^\n]*expected [^\n]*found [^\n]*$"):
            calibration_files.read(path)


@pytest.mark.parametrize(
    ("content", "complaint"),
    [
        ("", "expected at least one device, found none"),
        ("cam1: 3\n", "cam1: expected size, matrix, distortion and camera_from_world, found something else"),
        ("cam1: [ 1, 2 ]\n", "cam1: expected size, matrix, distortion and camera_from_world, found something else"),
    ],
)
def test_a_file_of_ours_without_devices_is_refused(tmp_path, content, complaint):
    path = tmp_path / "optics.yaml"
    path.write_text(f'%YAML:1.0\n---\nschema: "sonotwin-optics/1"\n{content}')
    with pytest.raises(InputError) as refusal:
        calibration_files.read(path)
    assert str(refusal.value) == f"{path}: {complaint}"


@pytest.mark.parametrize("has_scale", [False, True])
def test_a_file_says_whether_the_scales_error_is_in_its_covariance(optics, tmp_path, has_scale):
    """And one of before, without the key, that it isn't; another value is refused."""
    path, known = tmp_path / "optics.yaml", Uncertainty(("cam2.tx",), np.eye(1), has_scale)
    calibration_files.write(path, Calibration(optics.cameras, known))
    assert calibration_files.read(path).uncertainty.has_scale is has_scale
    text = re.sub(r"has_scale: \d\n", "", path.read_text())
    path.write_text(text)
    assert calibration_files.read(path).uncertainty.has_scale is False
    path.write_text(text + "has_scale: 3\n")
    with pytest.raises(InputError, match=r"optics\.yaml: has_scale: expected 0 or 1, found 3$"):
        calibration_files.read(path)


def test_a_missing_file_or_size_is_named(optics, tmp_path):
    with pytest.raises(InputError, match=r"none\.yaml: expected a calibration file, found none"):
        calibration_files.read(tmp_path / "none.yaml")
    write_storage(tmp_path / "c.yml", slmaster(optics))
    with pytest.raises(InputError, match="expected a file that stores the image size of projector"):
        calibration_files.read(tmp_path / "c.yml")
