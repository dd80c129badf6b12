"""Forms of masses: closed, of their size, and as ragged as their names say."""

from typing import get_args

import numpy as np
import pytest

from scenes.mass_forms import MassForm, mass
from scenes.tumour import caliper


def sphericity(body) -> float:
    """Area of the ball of the same volume over the body's; 1 of a ball."""
    return (36 * np.pi * body.volume**2) ** (1 / 3) / body.area


@pytest.mark.parametrize("form", get_args(MassForm))
def test_masses_are_closed_and_of_their_size(form):
    for seed in range(3):
        body = mass(form, 13.0, np.random.default_rng(seed))
        assert body.is_watertight and body.volume > 0
        assert caliper(body.vertices) == pytest.approx(13.0, abs=1e-9)


def test_words_go_from_even_to_ragged():
    mean = {
        form: np.mean([sphericity(mass(form, 13.0, np.random.default_rng(seed))) for seed in range(5)])
        for form in get_args(MassForm)
    }
    assert mean["round"] > 0.98 and mean["round"] > mean["oval"] > 0.9
    assert mean["oval"] > mean["irregular"] > mean["spiculated"] and mean["spiculated"] < 0.75
