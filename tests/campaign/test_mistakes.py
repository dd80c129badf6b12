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


def figures(value: float, sigma: float = 0.1, name: str = "length") -> mistake_figures.Figures:
    return {name: (np.array([value, np.nan]), np.array([sigma, sigma]))}


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
        (Run(0, "all is well", figures(5.0) | figures(1.0, name="another")), "silently wrong"),
        (Run(0, "all is well", {}), "silently wrong"),
    ],
)
def test_outcomes(made, kind):
    """Beside a right run that warns of few poses and finds 5.0; a value that isn't claimed doesn't count."""
    assert mistakes.judged(made, Run(0, "warning     few poses, 11", figures(5.0)), MISTAKE)[0] == kind


def test_a_few_wrong_points_among_many_and_one_mass_of_several_count():
    right = {"points": (np.zeros(100), np.full(100, 0.1)), "mass0": (np.ones(1), np.ones(1)), "masses": (np.ones(1), np.ones(1))}
    some = np.zeros(100)
    some[:8] = 1.0
    for made, far in (({"points": (some, np.full(100, 0.1))}, 10), ({"mass0": (np.full(1, 9.0), np.ones(1))}, 8), ({}, 0)):
        assert mistake_figures.distance(right | made, right) == pytest.approx(far)
