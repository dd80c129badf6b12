"""Mistakes are drawn evenly, and judged by what was said and by the figures' own standard deviations."""

import numpy as np
import pytest

from campaign import mistake_figures, mistakes
from campaign.mistaken_tasks import TASKS
from campaign.mistakes import Run

MISTAKE = TASKS[0].mistakes[0]  # two images exchanged


def test_every_mistake_is_drawn_once_before_any_is_again():
    for place, task in enumerate(TASKS):
        turns = [mistakes.drawn(place + len(TASKS) * k) for k in range(len(task.mistakes))]
        assert all(found is task for found, _ in turns)
        assert sorted(mistake.what for _, mistake in turns) == sorted(mistake.what for mistake in task.mistakes)


def figures(value: float, sigma: float = 0.1) -> mistake_figures.Figures:
    return {"length": (np.array([value, np.nan]), np.array([sigma, sigma]))}


@pytest.mark.parametrize(
    ("made", "kind"),
    [
        (Run(2, "sonotwin: a/b: images 1 and 2 look exchanged", {}), "refused by its cause"),
        (Run(2, "sonotwin: a/b: expected more light", {}), "refused"),
        (Run(-1, "Traceback\nKeyError: 3", {}), "traceback"),
        (Run(0, "warning     few poses\nwarning     the order of 12 images", figures(9.0)), "warned"),
        (Run(0, "warning     few poses, 12", figures(5.2)), "harmless"),
        (Run(0, "all is well", figures(5.4)), "silently wrong"),
        (Run(0, "all is well", figures(5.4, 0.2)), "harmless"),
    ],
)
def test_outcomes(made, kind):
    """Beside a right run that warns of few poses and finds 5.0; a value that isn't claimed doesn't count."""
    assert mistakes.judged(made, Run(0, "warning     few poses, 11", figures(5.0)), MISTAKE)[0] == kind
