"""The published networks must be told from the published weights' names and shapes alone; ours must fit in their place."""
# ruff: noqa: E402 - torch is asked for before what needs it

import pytest

torch = pytest.importorskip("torch")

from trainers.architectures import Detector, MassSegmenter, Segmenter, network


def double(prefix, inputs, middle, outputs):
    """Names and shapes of two convolutions with their norms."""
    return convolution(f"{prefix}.double_conv", 0, inputs, middle, 3) | convolution(
        f"{prefix}.double_conv", 3, middle, outputs, 3
    )


def convolution(prefix, at, inputs, outputs, size):
    names = {f"{prefix}.{at}.weight": (outputs, inputs, size, size), f"{prefix}.{at}.bias": (outputs,)}
    norm = {f"{prefix}.{at + 1}.{name}": (outputs,) for name in ("weight", "bias", "running_mean", "running_var")}
    return names | norm | {f"{prefix}.{at + 1}.num_batches_tracked": ()}


def head(prefix, outputs):
    return convolution(prefix, 0, 128, 256, 3) | {f"{prefix}.3.weight": (outputs, 256, 1, 1), f"{prefix}.3.bias": (outputs,)}


PUBLISHED = {
    "published_detector": {
        **double("conv1", 1, 64, 64),
        **double("conv2", 64, 64, 64),
        **double("conv3", 64, 128, 128),
        **double("conv4", 128, 128, 128),
        **head("convD", 65),
        **head("convC", 4),
    },
    "published_segmenter": {
        **double("inc", 1, 16, 16),
        **double("down1", 16, 32, 32),
        **double("down2", 32, 64, 64),
        **double("down3", 64, 64, 64),
        **double("up1", 128, 64, 32),
        **double("up2", 64, 32, 16),
        **double("up3", 32, 16, 16),
        "outc.weight": (1, 16, 1, 1),
        "outc.bias": (1,),
    },
}


@pytest.mark.parametrize("name", PUBLISHED)
def test_weights_have_the_published_names_and_shapes(name):
    assert {key: tuple(value.shape) for key, value in network(name, 3).state_dict().items()} == PUBLISHED[name]


@pytest.mark.parametrize("name", ["detector", "published_detector"])
@pytest.mark.parametrize(("width", "height"), [(320, 240), (160, 96)])
def test_detectors_answer_for_each_cell(name, width, height):
    with torch.no_grad():
        detection, identity = network(name, 3).eval()(torch.rand(1, 1, height, width))
    assert detection.shape == (1, 65, height // 8, width // 8)
    assert identity.shape == (1, 4, height // 8, width // 8)


@pytest.mark.parametrize("name", ["segmenter", "published_segmenter"])
def test_segmenters_answer_for_each_pixel(name):
    with torch.no_grad():
        assert network(name, 3).eval()(torch.rand(2, 1, 120, 120)).shape == (2, 1, 120, 120)


def reach(module, size, middle):
    """How far from a place of the answer a picture can matter to it, px."""
    picture = torch.zeros(1, 1, size, size, requires_grad=True)
    module.eval()
    answer = module(picture)
    (answer[1] if isinstance(answer, tuple) else answer)[0, :, middle, middle].sum().backward()
    rows = torch.nonzero(picture.grad[0, 0].abs().sum(1))[:, 0]
    return int(rows.max() - rows.min()) // 2


def test_our_detector_sees_the_whole_target_from_each_circle():
    """c1 and c2 are 47 mm apart, 60 px at the rig's distance; nearer by 1.6 it is 95 px."""
    torch.manual_seed(0)
    assert reach(Detector(3), 320, 20) >= 100


def test_our_segmenter_sees_a_whole_disc_from_its_middle():
    """A disc is 90 px wide, and up to 1.3 times that near the camera."""
    torch.manual_seed(0)
    assert reach(Segmenter(), 240, 120) >= 45


def test_the_network_of_masses_sees_a_whole_scan():
    """Of 40 x 50 mm from its middle; whatever the image's size, gain and offset."""
    torch.manual_seed(0)
    module = MassSegmenter().eval()
    assert reach(module, 192, 96) >= 62
    scan = torch.rand(2, 1, 128, 112)
    with torch.no_grad():
        answer = module(scan)
        assert answer.shape == scan.shape
        assert (module(0.5 * scan + 0.1) - answer).std() < 0.15 * answer.std()
