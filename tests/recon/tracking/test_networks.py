"""Networks are loaded if they are the right ones, and their answers are read as published."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from recon.errors import InputError
from recon.geometry.ellipses import Ellipses
from recon.model.targets import three_circles
from recon.tracking import circle_detector, circle_segmenter, identity, networks
from recon.tracking.frames import grey
from tests.recon.tracking.stand_ins import Told

onnx = pytest.importorskip("onnx")


def write(path, source, outputs, stride):
    """A network of one convolution an output."""
    helper, kind = onnx.helper, onnx.TensorProto.FLOAT
    nodes, weights, infos = [], [], []
    for name, channels in outputs.items():
        kernel = np.ones((channels, 1, stride, stride), np.float32)
        weights.append(helper.make_tensor(f"w_{name}", kind, kernel.shape, kernel.ravel()))
        nodes.append(helper.make_node("Conv", [source, f"w_{name}"], [name], strides=[stride, stride]))
        infos.append(helper.make_tensor_value_info(name, kind, ["n", channels, "h", "w"]))
    given = helper.make_tensor_value_info(source, kind, ["n", 1, "height", "width"])
    graph = helper.make_graph(nodes, "g", [given], infos, weights)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9)
    path.write_bytes(model.SerializeToString())


@pytest.fixture
def folder(tmp_path):
    write(tmp_path / "detector.onnx", "image", {"detection": 65, "identity": 4}, 8)
    write(tmp_path / "segmenter.onnx", "patch", {"mask": 1}, 1)
    return tmp_path


def test_shapes_are_those_of_the_interface(folder):
    loaded = networks.load(folder, threads=1)
    places, names = loaded.detect(np.ones((2, 240, 320), np.float32))
    assert places.shape == (2, 65, 30, 40) and names.shape == (2, 4, 30, 40)
    assert loaded.segment(np.ones((3, 120, 120), np.float32)).shape == (3, 120, 120)


def test_wrong_files_are_refused_in_one_line(folder):
    write(folder / "segmenter.onnx", "image", {"detection": 65}, 8)
    with pytest.raises(InputError, match=r"segmenter\.onnx: inputs: expected patch \(nx1x120x120\), found image") as caught:
        networks.load(folder)
    assert "\n" not in str(caught.value)
    (folder / "segmenter.onnx").write_bytes(b"no network")
    with pytest.raises(InputError, match="expected an ONNX network"):
        networks.load(folder)
    (folder / "segmenter.onnx").unlink()
    with pytest.raises(InputError, match="expected a network, found none"):
        networks.load(folder)


@pytest.mark.parametrize("name", [b"patch", b"mask"])
def test_a_name_that_is_no_text_is_refused_in_one_line(folder, name):
    path = folder / "segmenter.onnx"
    path.write_bytes(path.read_bytes().replace(name, b"\xe6" + name[1:]))
    with pytest.raises(InputError, match=r"segmenter\.onnx: expected an ONNX network, found "):
        networks.load(folder)


def test_candidates_are_where_the_logits_are(rng):
    places = np.array([[400.0, 300.0], [520.0, 700.0], [900.0, 310.0]])
    found = circle_detector.detect([np.zeros((1024, 1280), np.uint8)], circle_detector.levels((1280, 1024))[0], Told([places]))[0]
    order = np.argmax(found.identity[:, :3], axis=1)
    assert np.abs(found.points[np.argsort(order)] - places).max() <= 2.2
    assert (found.scores > 0.5).all()


def test_geometry_alone_names_the_circles(rig, rng):
    """Ellipses of an affine view, in any order, tilted up to 50 degrees."""
    for _ in range(50):
        angle, tilt, axis = rng.uniform(0, 2 * np.pi), rng.uniform(0, np.radians(50)), rng.uniform(0, np.pi)
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        along = np.array([[np.cos(axis), -np.sin(axis)], [np.sin(axis), np.cos(axis)]])
        affine = 5 * along @ np.diag([1, np.cos(tilt)]) @ along.T @ turn @ np.diag([1, -1])
        centres = np.array([[0, 0], [25, 0], [0, 40]]) @ affine.T
        values, vectors = np.linalg.eigh(81 * affine @ affine.T)
        shape = np.tile((vectors * np.sqrt(values)) @ vectors.T, (3, 1, 1))
        shuffled = rng.permutation(3)
        order, off = identity.named(Ellipses(centres[shuffled], shape), rig.target)
        assert np.array_equal(shuffled[order], [0, 1, 2]) and off < 1e-9
        mirrored = Ellipses(centres[:, ::-1], shape[:, ::-1, ::-1])
        assert identity.disagreement(mirrored, rig.target) == np.inf


def test_masks_become_ellipses():
    v, u = np.mgrid[:120, :120]
    disc = np.hypot((u - 62) / 40, (v - 57) / 30) < 1
    large = np.hypot(u - 60, v - 60) < 63
    specks = np.zeros((120, 120), bool)
    specks[5:9, 5:9] = True
    masks = np.where(np.stack([disc | specks, large, specks, np.zeros_like(disc), np.ones_like(disc)]), 4.0, -4.0)
    found = circle_segmenter.read(
        masks, circle_segmenter.Patches(np.zeros((0, 120, 120), np.float32), np.array([[100, 200]] * 5))
    )
    assert np.abs(found.centre[0] - [162, 257]).max() < 0.1 and np.abs(found.semi_axes[0] - [40, 30]).max() < 0.5
    assert np.abs(found.centre[1] - [160, 260]).max() < 0.5 and np.abs(found.semi_axes[1] - 63).max() < 1
    assert np.isnan(found.centre[2:]).all()


def test_patches_go_on_beyond_the_border():
    image = np.arange(200 * 300).reshape(200, 300) % 251
    cut = circle_segmenter.patches(image.astype(np.uint8), np.array([[150.4, 99.6], [0, 0]]))
    assert np.array_equal(cut.corners, [[91, 41], [-59, -59]])
    assert np.allclose(cut.images[0] * 255, image[41:161, 91:211]) and np.allclose(cut.images[1][:59, :59] * 255, image[0, 0])


def test_coarse_patches_hold_large_discs_where_they_are():
    """A disc of 170 px, drawn and segmented by its darkness: centre and size come back in the image's pixels."""
    v, u = np.mgrid[:700, :900]
    image = np.where((u - 420.3) ** 2 + (v - 333.6) ** 2 < 85**2, 20, 200).astype(np.uint8)
    target = three_circles.Kind(c1_mm=25, c2_mm=40, outer_diameter_mm=18, inner_diameter_mm=7.2, board_mm=(60, 65))
    scale = 170 / 18
    points = np.array([[420.0, 334.0], [420.0, 334.0 + 25 * scale], [420.0 + 40 * scale, 334.0]])
    assert circle_segmenter.step_for(points, target) == 2
    cut = circle_segmenter.patches(image, points, 2)
    found = circle_segmenter.read(np.where(cut.images < 0.4, 5.0, -5.0), cut)
    assert np.abs(found.centre[0] - [420.3, 333.6]).max() < 0.6
    assert np.abs(found.semi_axes[0] - 85).max() < 1.5


def test_depths_become_0_to_255():
    ramp = np.linspace(0, 1, 50).reshape(5, 10)
    for levels in (1023, 4095, 65535):
        assert np.abs(grey(np.rint(ramp * levels).astype(np.uint16)) - 255 * ramp).max() < 0.2
    assert np.abs(grey(ramp) - 255 * ramp).max() < 1e-3
    assert np.abs(grey(np.full((4, 4), 300, np.uint16), bits=12) - 300 * 255 / 4095).max() < 1e-3


@pytest.mark.parametrize("size", [(640, 480), (1280, 1024), (1920, 1080), (4000, 3000), (1024, 1280)])
def test_each_level_of_windows_shows_all_of_a_frame(size):
    """And each target, of 3.6 circles' height, whole in one of them, as long as the level before doesn't show it large enough."""
    coarser, (whole, (around,), *finer) = None, circle_detector.levels(size)
    for windows in (whole, *finer):
        (scale,) = {window.scale for window in windows}
        wide, high = (length / scale for length in circle_detector.FRAME)
        largest = 3.6 * circle_detector.SEEN_PX / coarser if coarser else 0.0
        corners = np.array([[window.left, window.top] for window in windows])
        for place in np.stack(
            np.meshgrid(np.linspace(0, size[0] - largest, 23), np.linspace(0, size[1] - largest, 19)), -1
        ).reshape(-1, 2):
            assert ((corners <= place + 1) & (place + largest <= corners + np.array([wide, high]) + 1)).all(axis=1).any()
        coarser = scale
    assert coarser >= circle_detector.SEEN_PX / circle_detector.LEAST_PX * 0.99
    frame = np.add.outer(np.arange(size[1]), 2 * np.arange(size[0])) % 251
    for window in (around, whole[0], windows[-1]):
        assert window.cut(frame.astype(np.uint8)).shape == circle_detector.FRAME[::-1]


def test_onnx_runtime_reports_to_nobody(tmp_path):
    """What it would send it collects in the user's cache, with a number for this computer; there is none."""
    program = """
from recon.tracking import networks
networks.onnxruntime.InferenceSession(networks.WEIGHTS / "segmenter.onnx")
"""
    kept = {name: value for name, value in os.environ.items() if name not in ("ORT_DISABLE_TELEMETRY", "XDG_CACHE_HOME")}
    places = {"HOME": str(tmp_path), "LOCALAPPDATA": str(tmp_path), "PYTHONPATH": str(Path(__file__).resolve().parents[3])}
    subprocess.run([sys.executable, "-c", program], env=kept | places, cwd=tmp_path, check=True)
    assert not list(tmp_path.rglob("*onnxruntime*")) and not list(tmp_path.rglob("deviceid"))
