"""A perfect network has perfect figures, and each fault shows in its own."""
# ruff: noqa: E402 - torch is asked for before what needs it

import numpy as np
import pytest

torch = pytest.importorskip("torch")
from torch import nn

from trainers.labels import labels
from trainers.network_metrics import decode, measure_detector, measure_segmenter
from trainers.shard_reader import in_memory, read_patches, read_views


class Knowing(nn.Module):
    """Knows the answers by heart, in the order in which they are asked for, and may be told to err."""

    def __init__(self, *answers, swap=(0, 1, 2, 3), shift=0):
        super().__init__()
        self.answers, self.swap, self.shift, self.at = answers, list(swap), shift, 0

    def forward(self, images):
        now = slice(self.at, self.at + len(images))
        self.at += len(images)
        if len(self.answers) == 1:
            return torch.roll(self.answers[0][now], self.shift, 3)
        place, kind = (answer[now] for answer in self.answers)
        return torch.roll(place, self.shift, 3), torch.roll(kind[:, self.swap], self.shift, 3)


def known(views):
    places = torch.from_numpy(views.centres / views.scale[:, None])
    wanted = labels(places, torch.from_numpy(views.visible), torch.from_numpy(views.identity), (320, 240))
    one_hot = torch.nn.functional.one_hot
    pixel = one_hot(wanted.pixel.clamp(min=0), 65).permute(0, 3, 1, 2)
    return pixel * 30.0, one_hot(wanted.identity.clamp(min=0), 4).permute(0, 3, 1, 2) * 30.0


def test_a_perfect_detector_is_perfect(data_set):
    views = in_memory(read_views([data_set]))
    figures = measure_detector(Knowing(*known(views)), views)
    assert figures["recall"] == figures["all_three"] == figures["all_three_bright"] == figures["identity_accuracy"] == 1
    assert figures["false_per_empty_view"] == 0 and figures["empty_views"] == 8 and figures["wrong"] == 0
    assert figures["place_median_px"] < 0.6 and figures["place_95_full_px"] < 0.71 * 4.27


def test_figures_of_several_bodies_are_of_all_their_circles(set_of_bodies):
    """Names of circles of another kind of target are nobody's business; their places are."""
    views = in_memory(read_views([set_of_bodies]))
    place, kind = known(views)
    for named in (True, False):
        kind = kind if named else torch.where(at_unnamed(views)[:, None], kind.roll(1, 1), kind)
        figures = measure_detector(Knowing(place, kind), views)
        assert figures["recall"] == figures["all_three"] == 1 and figures["wrong"] == 0
    whole = sum(
        int((views.inside[:, cut] & (views.visible[:, cut] > 0)).all(1).sum()) for cut in (np.s_[:3], np.s_[3:6], np.s_[6:])
    )
    assert figures["all_three_views"] == whole
    lost = place.clone()
    lost[at_unnamed(views).nonzero(as_tuple=True)[0], :64] = 0.0  # a view without any circle
    assert measure_detector(Knowing(lost, kind), views)["recall"] < 0.5


def at_unnamed(views):
    """Cells (n, 30, 40) of circles without a name."""
    places = torch.from_numpy(views.centres / views.scale[:, None])
    return labels(places, torch.from_numpy(views.visible), torch.from_numpy(views.identity), (320, 240)).identity == -100


def test_swapped_identities_are_found_but_wrong(data_set):
    views = in_memory(read_views([data_set]))
    figures = measure_detector(Knowing(*known(views), swap=(1, 0, 2, 3)), views)
    assert figures["recall_c0"] == figures["recall_c1"] == 0 and figures["recall_c2"] == 1
    assert figures["all_three"] == 0 and figures["wrong"] > 0.6


def test_a_detector_that_errs_by_a_cell_finds_nothing(data_set):
    views = in_memory(read_views([data_set]))
    assert measure_detector(Knowing(*known(views), shift=1), views)["recall"] == 0


def test_of_near_peaks_the_best_stays_and_of_many_three():
    """Logits with five peaks, two of them 3 px apart."""
    detection, identity = torch.zeros(1, 65, 30, 40), torch.zeros(1, 4, 30, 40)
    detection[:, 64] = 20
    for column, row, logit, kind in ((2, 2, 20, 0), (9, 2, 19, 1), (20, 9, 18, 2), (30, 20, 17, 0)):
        detection[0, 8 * 4 + 7, row, column], identity[0, kind, row, column] = logit, 5
    detection[0, 8 * 4 + 2, 2, 3] = 19.5  # 3 px right of the first
    (found,) = decode(detection, identity, 3)
    assert found.places.tolist() == [[23, 20], [79, 20], [167, 76]]
    assert found.identities.tolist() == [0, 1, 2]
    assert (np.diff(found.scores) < 0).all()


def test_segmenters_errors_are_measured(data_set):
    patches = in_memory(read_patches([data_set]))
    logits = torch.from_numpy(np.where(patches.masks > 0, 9.0, -9.0).astype(np.float32))[:, None]
    perfect = measure_segmenter(Knowing(logits), patches)
    assert perfect["iou"] == perfect["empty_right"] == 1 and perfect["centre_95_px"] == 0 and perfect["missed"] == 0
    shifted = measure_segmenter(Knowing(logits, shift=2), patches)
    assert shifted["centre_median_px"] == pytest.approx(2, abs=0.01)
    assert 0.9 < shifted["iou"] < 0.99
