"""The network sees B-scans in its own pixels, answers in theirs, and its answers are averaged in space."""

from types import SimpleNamespace

import numpy as np
import pytest

from recon.errors import InputError
from recon.freehand.volume_compounding import Clip
from recon.segmentation import echo_power, mass_network
from recon.tracking import networks

PIXEL_MM = (0.13, 0.11)


def bright(inputs):
    """Stands in for the network: a mass is what is brighter than half of white."""
    return [20 * (inputs["scan"] - 0.5)]


STAND_IN = SimpleNamespace(run=lambda _, inputs: bright(inputs))


def disc(centre_mm, radius_mm, shape=(400, 300)):
    """A B-scan with a white disc."""
    v, u = np.indices(shape)
    return (255 * (np.hypot(u * PIXEL_MM[0] - centre_mm[0], v * PIXEL_MM[1] - centre_mm[1]) < radius_mm)).astype(np.uint8)


def test_what_is_made_smaller_comes_back_in_place():
    """A pixel p of the network's image shows what lies about s (p + 1/2) - 1/2 for a scale s; sizes are multiples of 16."""
    image = np.zeros((400, 300), np.uint8)
    image[200:240, 90:120] = 255  # centre (104.5, 219.5)
    small = mass_network.reduced(image, PIXEL_MM).astype(float)
    assert small.shape == (112, 112)
    v, u = (np.average(axis, weights=small) for axis in np.indices(small.shape))
    assert abs((u + 0.5) * 300 / 98 - 0.5 - 104.5) < 0.05 and abs((v + 0.5) * 400 / 110 - 0.5 - 219.5) < 0.05


def test_answers_are_of_the_scans_own_pixels():
    """Disc for disc, of the same place and size."""
    centre, radius = (21.0, 17.0), 6.0
    (found,) = mass_network.probabilities([disc(centre, radius)], PIXEL_MM, STAND_IN)
    assert found.shape == (400, 300) and found.dtype == np.float32
    v, u = np.nonzero(found > 0.5)
    np.testing.assert_allclose([u.mean() * PIXEL_MM[0], v.mean() * PIXEL_MM[1]], centre, atol=0.1)
    assert len(u) * np.prod(PIXEL_MM) == pytest.approx(np.pi * radius**2, rel=0.02)


def test_answers_are_averaged_in_space():
    """A ball in B-scans 1 mm apart is the ball in the world, below the clip; images without a pose count nothing."""
    z = np.arange(-12.0, 12.1)
    poses = np.tile(np.diag([*PIXEL_MM, 1.0, 1.0]), (len(z), 1, 1))
    poses[:, 2, 3] = z
    poses[3] = np.nan
    scans = [disc((20.0, 18.0), np.sqrt(max(64 - one**2, 0))) for one in z]
    scans[3] = np.full((400, 300), 255, np.uint8)
    grid = echo_power.beam_grid(poses, (400, 300), (0.5, 0.5, 1.0))
    chance = mass_network.averaged(scans, poses, grid, Clip(0, 100, 300, 400), STAND_IN)
    inside = (chance.volume.voxels > 0.5) & (chance.weight > 0)
    k, j, i = np.nonzero(inside)
    middle = chance.volume.world_from_voxel @ [i.mean(), j.mean(), k.mean(), 1]
    assert abs(middle[0] - 20) < 0.1 and abs(middle[2]) < 0.1 and (chance.weight > 0).any(axis=(0, 2)).argmax() >= 20
    cut = np.pi / 3 * (8 + 18 - 11) ** 2 * (3 * 8 - (8 + 18 - 11))  # of the ball, below 11 mm
    assert inside.sum() * 0.25 == pytest.approx(cut, rel=0.04)


def test_scans_without_a_pose_arent_looked_at():
    """And as many images as poses are asked for, as elsewhere."""
    asked = list[int]()

    def run(_, inputs):
        asked.append(int(inputs["scan"].max() * 255))
        return bright(inputs)

    poses = np.tile(np.diag([*PIXEL_MM, 1.0, 1.0]), (6, 1, 1))
    poses[:, 2, 3] = np.arange(6)
    poses[[0, 4]] = np.nan
    scans = [np.full((400, 300), 10 * k, np.uint8) for k in range(6)]
    grid = echo_power.beam_grid(poses, (400, 300), (0.5, 0.5, 1.0))
    clip, counting = Clip(0, 0, 300, 400), SimpleNamespace(run=run)
    mass_network.averaged(scans, poses, grid, clip, counting)
    assert sorted(asked) == [10, 20, 30, 50]
    for some in (scans[:-1], [*scans, scans[0]]):
        with pytest.raises(InputError, match=r"^images: expected as many as poses, 6, found"):
            mass_network.averaged(some, poses, grid, clip, counting)


def test_sizes_are_those_of_what_is_made_smaller():
    """Before the rim on to a multiple of 16; never none."""
    assert mass_network.reduced_size((400, 300), PIXEL_MM) == (110, 98)
    assert mass_network.reduced_size((3, 1), (0.02, 0.05)) == (1, 1)


def test_another_network_is_refused():
    with pytest.raises(InputError, match=r"detector.onnx: inputs: expected scan \(nx1xnxn\), found image"):
        mass_network.opened(networks.WEIGHTS / "detector.onnx")


@pytest.mark.parametrize("length", [0, 200, 100_000])
def test_a_network_that_was_cut_short_is_refused(tmp_path, length):
    path = tmp_path / "masses.onnx"
    path.write_bytes(mass_network.WEIGHTS.read_bytes()[:length])
    with pytest.raises(InputError, match=rf"^{path}: expected .*, found ") as caught:
        mass_network.opened(path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("shape", "stride", "message"),
    [
        ((1, 1, 16, 32), 1, r"expected a network of B-scans of any size, found "),
        ((1, 1, "h", "w"), 2, r"expected an answer for each pixel, 1x1x16x32, found 1x1x8x16$"),
    ],
)
def test_a_network_of_another_shape_is_refused(tmp_path, shape, stride, message):
    """Of images of one size, or with coarser answers: it would fail in the middle of a sweep."""
    onnx = pytest.importorskip("onnx")
    tensor = onnx.helper.make_tensor_value_info
    node = onnx.helper.make_node("MaxPool", ["scan"], ["mask"], kernel_shape=[1, 1], strides=[stride, stride])
    ends = [tensor("scan", onnx.TensorProto.FLOAT, shape)], [tensor("mask", onnx.TensorProto.FLOAT, (1, 1, "hm", "wm"))]
    graph = onnx.helper.make_graph([node], "g", *ends)
    opset = [onnx.helper.make_opsetid("", 17)]
    onnx.save(onnx.helper.make_model(graph, opset_imports=opset, ir_version=8), tmp_path / "other.onnx")
    with pytest.raises(InputError, match=rf"^{tmp_path}/other.onnx: {message}"):
        mass_network.opened(tmp_path / "other.onnx")


def test_a_black_image_holds_no_mass():
    """Whatever the levels that the network makes of nothing."""
    (found,) = mass_network.probabilities([np.zeros((400, 300), np.uint8)], PIXEL_MM)
    assert found.max() < 0.2
