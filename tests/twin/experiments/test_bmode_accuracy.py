"""The B-mode model against PyMUST's figures and against diffraction, as far as they are quick."""

from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from tests.twin.experiments.asked import missed
from twin.experiments import bmode_accuracy
from twin.experiments.experiment_runs import PACKAGES


def test_widths_are_those_of_the_peer():
    """Near the face and beyond the foci; within 15 %, of which some 10 in depth are the shape of the peer's pulse."""
    assert not missed(bmode_accuracy.widths, bmode_accuracy.widths(None, (5.0, 35.0)))


def test_the_peers_figures_count_as_code():
    """Else rows that were kept would survive other figures of the peer."""
    assert any(bmode_accuracy.PEER.is_relative_to(Path(find_spec(name).origin).parent) for name in PACKAGES)


def test_speckle_and_lesions():
    """Fully developed speckle, and a lesion as dark as its echogenicity."""
    for function in (bmode_accuracy.speckle, bmode_accuracy.lesions):
        assert not missed(function, function(None))


def test_decorrelation_near_the_lens_focus():
    """Twenty pairs of slices; at 0.239 the correlation's own error is about 3 %."""
    assert not missed(bmode_accuracy.decorrelation, bmode_accuracy.decorrelation(None, (22.0,), 3))


@pytest.mark.parametrize("shift", [0.2, 0.5])
def test_correlation_of_a_narrow_band_at_the_focus(shift):
    """Two-way, the aperture is a triangle; moved by d it is moved by 2 d against itself and turned by its waves' curvature."""
    array = bmode_accuracy.QUIET.model_copy(update={"bandwidth": (0.05, 0.05)})
    focus, height = array.elevation_focus_mm, array.elevation_mm
    u = np.linspace(-height - 2, height + 2, 40001)
    triangle = np.maximum(1 - np.abs(u) / height, 0)
    moved = np.maximum(1 - np.abs(u + 2 * shift) / height, 0)
    turn = np.exp(1j * array.wavenumber * u * shift / focus)
    expected = abs((triangle * moved * turn).sum()) / (triangle**2).sum()
    assert bmode_accuracy.lens_correlation(array, focus, shift) == pytest.approx(expected, abs=0.01)


def test_width_of_a_known_profile():
    """A Gaussian of 0.4 mm, sampled at uneven places."""
    places = np.sort(np.random.default_rng(1).uniform(-1, 1, 60))
    assert bmode_accuracy.width(places, np.exp(-4 * np.log(2) * (places / 0.4) ** 2)) == pytest.approx(0.4, rel=0.01)
