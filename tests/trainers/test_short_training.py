"""The loss by which sets are compared, against closed forms."""
# ruff: noqa: E402 - torch is asked for before what needs it

import math

import pytest

torch = pytest.importorskip("torch")

from trainers import short_training
from trainers.shard_reader import in_memory, read_views


class Knowing(torch.nn.Module):
    """Answers that all of a view's cells are alike, by the logit of no circle."""

    def __init__(self, nothing: float) -> None:
        super().__init__()
        self.nothing = nothing

    def forward(self, images):
        n, _, height, width = images.shape
        detection = torch.zeros(n, 65, height // 8, width // 8)
        detection[:, 64] = self.nothing
        return detection, torch.zeros(n, 4, height // 8, width // 8)


class Told(torch.nn.Module):
    """Gives the answers for views in their order."""

    def __init__(self, detection) -> None:
        super().__init__()
        self.rest = detection

    def forward(self, images):
        now, self.rest = self.rest.split([len(images), len(self.rest) - len(images)])
        return now, torch.zeros(len(images), 4, *now.shape[2:])


@pytest.mark.parametrize("nothing", [0.0, 6.0])
def test_the_loss_of_views_is_that_of_their_cells(nothing, data_set):
    """Cells with a circle cost ln(64 + e^a), others a less; the identities, all as likely, ln 4. All discs are seen or not."""
    views = in_memory(read_views([data_set]))
    u, v = ((views.centres / views.scale[:, None]).round()).transpose(2, 0, 1)
    counts = (views.visible == 1) & (u >= 0) & (u < 320) & (v >= 0) & (v < 240)
    circles, cells = counts.sum(), 30 * 40 * len(views)
    each = math.log(64 + math.exp(nothing))
    expected = (circles * each + (cells - circles) * (each - nothing)) / (circles + len(views)) + math.log(4)
    assert set(views.visible.ravel()) == {0, 1} and circles > 50
    assert short_training.loss(Knowing(nothing), views) == pytest.approx(expected, rel=1e-5)


def test_who_names_the_places_loses_nothing_by_them(data_set):
    """Logits of 30 at the pixel next to c / s, or of no circle elsewhere; a pixel beside it costs 30 a circle."""
    views = in_memory(read_views([data_set]))
    u, v = (views.centres / views.scale[:, None]).round().transpose(2, 0, 1)
    counts = (views.visible == 1) & (u >= 0) & (u < 319) & (v >= 0) & (v < 240)
    assert counts.sum() == (views.visible == 1).sum()  # none at the border
    answers = [torch.zeros(len(views), 65, 30, 40) for _ in range(2)]
    for aside, answer in enumerate(answers):
        answer[:, 64] = 30
        for view, circle in zip(*counts.nonzero(), strict=True):
            x, y = int(u[view, circle]), int(v[view, circle])
            beside = x + aside if (x + aside) // 8 == x // 8 else x - aside
            answer[view, 64, y // 8, x // 8] = 0
            answer[view, 8 * (y % 8) + beside % 8, y // 8, x // 8] = 30
    exact, off = (short_training.loss(Told(answer), views) for answer in answers)
    assert exact == pytest.approx(math.log(4), abs=1e-4)
    assert off - exact == pytest.approx(30 * counts.sum() / (counts.sum() + len(views)), rel=1e-3)
