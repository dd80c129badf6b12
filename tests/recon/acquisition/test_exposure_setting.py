"""Exposures bring what is seen to its level, and stay within their limits."""

import numpy as np
import pytest

from recon.acquisition.exposure_setting import Exposing, set_exposure
from recon.devices.pattern_player import Stage, Triggered, take
from tests.recon.acquisition.stand_ins import Bench, BenchCamera


def seen(bench, camera):
    """What a camera sees under even light."""
    stage = Stage(bench, {"cam1": camera}, Triggered())
    return lambda: take(stage, stage.white)["cam1"].image


@pytest.mark.parametrize("reflectance", [0.004, 0.03, 0.4, 1.0, 30.0])
def test_exposures_bring_white_to_its_level(reflectance):
    bench = Bench(reflectance)
    camera = BenchCamera("cam1", bench)
    white = seen(bench, camera)
    seconds = set_exposure(camera, white, Exposing(level=0.8, longest_s=5.0))
    assert camera.exposure_s == seconds and white().max() / 255 == pytest.approx(0.8, rel=0.06)


def test_a_given_exposure_is_kept_and_the_longest_not_exceeded():
    bench = Bench()
    camera = BenchCamera("cam1", bench)
    assert set_exposure(camera, seen(bench, camera), Exposing(exposure_s=0.123, gain=2.0)) == 0.123 and camera.gain == 2.0
    bench.reflectance = np.zeros_like(bench.reflectance)
    assert set_exposure(camera, seen(bench, camera), Exposing(longest_s=0.05)) == 0.05
