"""The rows of the accuracy tables, as far as they are quick, and the statistic for surfaces without truth."""

from dataclasses import replace
from pathlib import Path

import pytest

from recon.capture.surface_part import read_patterns
from tests.twin.experiments.asked import missed
from tests.twin.small_rigs import cropped, shrunk
from twin.experiments import optics_accuracy, surface_accuracy
from twin.experiments.experiment_setup import Setup

ROOT = Path(__file__).resolve().parents[3]


@pytest.fixture
def setup(rig) -> Setup:
    """The rig, with images of half the size, and the sequences of `conf/patterns`."""
    half = rig.model_copy(update={"cam1": shrunk(rig.cam1, 2)})
    return Setup(half, {path.stem: read_patterns(path) for path in (ROOT / "conf" / "patterns").glob("*.yaml")})


def check(function, setup, **settings) -> None:
    """Every bar is met."""
    assert not missed(function, function(setup, **settings), **settings)


@pytest.mark.parametrize("number", [1, pytest.param(5, marks=pytest.mark.slow)])
def test_planes_of_the_paper(setup, number):
    """Nearest and farthest plane: RMS within 1.25 of what noise allows, errors as large as predicted."""
    check(surface_accuracy.planes, setup, number=number)


def test_sphere_of_the_paper(setup):
    """Radius within 0.02 mm, RMS within 0.04 mm."""
    check(surface_accuracy.sphere, setup)


@pytest.mark.slow
def test_breast(setup, rig):
    """Coverage, RMS, hardly a point off by more than 1 mm: amid the image, whose fringes can be followed everywhere."""
    check(surface_accuracy.breast, replace(setup, rig=rig.model_copy(update={"cam1": cropped(rig.cam1, (720, 600))})))


@pytest.mark.slow
def test_breast_by_both_cameras(setup):
    """Less noise, as predicted, by cameras of half the size, at whose borders not all fringes can be followed."""
    half = setup.rig.model_copy(update={"cam2": shrunk(setup.rig.cam2, 2)})
    found = surface_accuracy.breast_by_both(replace(setup, rig=half))
    assert found["noise_ratio"] < 0.6 and found["z_spread_off"] < 0.15 and found["coverage"] > 0.95


@pytest.mark.slow
@pytest.mark.parametrize("sequence", ["gray_surface", "multi_frequency", "paper_surface"])
def test_no_wrong_order_survives(setup, sequence):
    """Deep steps and shadows: no point on a wrong order, and what the centre line doesn't reach is said to be so."""
    check(surface_accuracy.orders_under_stress, setup, sequence=sequence)


def test_real_relief(setup, real):
    """A recording of others: enough points, in the right depth, and sigma as large as the local residual."""
    check(surface_accuracy.real_capture, replace(setup, real=real))


@pytest.mark.parametrize("lens", optics_accuracy.LENSES)
def test_round_trip(lens):
    """Pixel to ray to pixel through all 14 coefficients, everywhere in the image."""
    check(optics_accuracy.round_trip, None, lens=lens)
