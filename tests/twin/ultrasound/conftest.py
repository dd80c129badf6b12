"""Transducers and tissue that tests of the B-mode model share."""

import pytest

from scenes.acoustics import Tissue
from twin.ultrasound.echo_solids import Body
from twin.ultrasound.transducer import Transducer

QUIET = {"noise_db": -200.0, "face_ring_mm": 0.0, "reverberations": 0, "tgc_db_per_cm_mhz": 0.0}


@pytest.fixture(scope="session")
def clean() -> Transducer:
    """The default array without noise, ringing, reverberation and gain over depth."""
    return Transducer(**QUIET)


@pytest.fixture(scope="session")
def small() -> Transducer:
    """The same with a narrow image, where statistics don't matter."""
    return Transducer(**QUIET, image_size=(96, 408))


@pytest.fixture
def speckle() -> Body:
    """Endless reference tissue without attenuation."""
    return Body(Tissue(1.6, 1540.0, 0.0, 0.0), (), ())
