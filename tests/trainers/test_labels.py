"""Labels say where circles are such that the tracker, which decodes as published, gets the same places back."""
# ruff: noqa: E402 - torch is asked for before what needs it

import cv2
import numpy as np
import pytest

torch = pytest.importorskip("torch")

from trainers.labels import IGNORED, detector_loss, label_offset, labels, seen_in_view
from trainers.network_metrics import decode
from trainers.shard_truth import UNNAMED

SIZE = (320, 240)


def names(count):
    """Identities of one target's circles in so many views."""
    return torch.arange(3).repeat(count, 1)


def answers(wanted):
    """Logits of a network that is sure of its labels."""
    detection = torch.nn.functional.one_hot(wanted.pixel, 65).permute(0, 3, 1, 2) * 40.0
    return detection, torch.nn.functional.one_hot(wanted.identity, 4).permute(0, 3, 1, 2) * 40.0


def test_decoded_labels_are_the_rounded_places(rng):
    """Circles at least 20 px apart, anywhere in a small view, in all 64 places of a cell."""
    centres = rng.uniform([30, 30], [65, 65], (300, 1, 2))
    turned = rng.uniform(0, 2 * np.pi, (300, 1)) + np.array([0, 2.1, 4.2])
    places = torch.from_numpy(centres + 25 * np.stack([np.cos(turned), np.sin(turned)], -1))
    wanted = labels(places, torch.ones(300, 3), names(300), (96, 96))
    found = decode(*answers(wanted), 3)
    for peaks, place in zip(found, places.numpy(), strict=True):
        order = np.argsort(peaks.identities)
        assert peaks.identities[order].tolist() == [0, 1, 2]
        assert (peaks.places[order] == np.rint(place)).all()
    assert {int(value) for value in wanted.pixel.unique()} == set(range(65))


def test_a_place_times_the_scale_is_the_centre_in_full_resolution(rng):
    """A disc drawn in the full image, made smaller as the tracker does, is seen where `seen_in_view` says."""
    full = np.zeros((1024, 1280), np.uint8)
    centre = np.array([701.0, 333.0])
    cv2.circle(full, centre.astype(int).tolist(), 45, 255, -1)
    view = cv2.resize(full, SIZE, interpolation=cv2.INTER_AREA).astype(float)
    rows, columns = np.indices(view.shape)
    seen = np.array([(view * columns).sum(), (view * rows).sum()]) / view.sum()
    scale = torch.tensor([[4.0, 1024 / 240]])
    expected = seen_in_view(torch.from_numpy(centre)[None, None], scale)[0, 0]
    assert np.abs(seen - expected.numpy()).max() < 0.01
    coarse = expected + label_offset(scale)[0]
    assert np.abs((coarse * scale[0]).numpy() - centre).max() < 1e-3


def test_circles_that_one_can_hardly_see_count_neither_way():
    places = torch.tensor([[[50.0, 50.0], [100.0, 50.0], [50.0, 130.0]]])
    wanted = labels(places, torch.tensor([[1.0, 0.2, 0.01]]), names(1), SIZE)
    assert wanted.pixel[0, 6, 6] == 8 * 2 + 2
    assert wanted.pixel[0, 6, 12] == IGNORED and wanted.identity[0, 6, 12] == IGNORED
    assert wanted.pixel[0, 16, 6] == 64 and wanted.identity[0, 16, 6] == 3
    detection, identity = torch.randn(1, 65, 30, 40), torch.randn(1, 4, 30, 40)
    before = detector_loss(detection, identity, wanted)
    detection[0, :, 6, 12], identity[0, :, 6, 12] = 9.0, -9.0
    assert detector_loss(detection, identity, wanted) == before


def test_beyond_the_view_there_is_no_label():
    places = torch.tensor([[[-3.0, 50.0], [319.4, 50.0], [319.6, 130.0]], [[float("nan")] * 2] * 3])
    wanted = labels(places, torch.ones(2, 3), names(2), SIZE)
    assert (wanted.pixel != 64).sum() == 1 and wanted.pixel[0, 6, 39] == 8 * 2 + 7


def test_a_sure_right_answer_costs_nothing_and_a_swapped_identity_much():
    places = torch.tensor([[[50.0, 50.0], [100.0, 50.0], [50.0, 130.0]]])
    wanted = labels(places, torch.ones(1, 3), names(1), SIZE)
    detection, identity = answers(wanted)
    assert detector_loss(detection, identity, wanted) < 1e-6
    assert detector_loss(detection, identity[:, [1, 0, 2, 3]], wanted) > 1


def test_a_circle_without_a_name_is_learnt_by_its_place_alone():
    """Whatever the network calls it costs nothing, and that it is a circle counts."""
    places = torch.tensor([[[50.0, 50.0], [100.0, 50.0], [50.0, 130.0], [200.0, 130.0]]])
    wanted = labels(places, torch.ones(1, 4), torch.tensor([[0, 1, 2, UNNAMED]]), SIZE)
    assert wanted.pixel[0, 16, 25] == 8 * 2 and wanted.identity[0, 16, 25] == IGNORED
    assert wanted.identity.max() == 3 and (wanted.identity == 3).sum() > 1000  # none, of three identities
    detection = torch.nn.functional.one_hot(wanted.pixel, 65).permute(0, 3, 1, 2) * 40.0
    for name in range(4):
        called = torch.where(wanted.identity == IGNORED, name, wanted.identity)
        identity = torch.nn.functional.one_hot(called, 4).permute(0, 3, 1, 2) * 40.0
        assert detector_loss(detection, identity, wanted) < 1e-6
    detection[0, :, 16, 25] = 0.0
    assert detector_loss(detection, identity, wanted) > 0.5
