"""Exposure times by what cameras see."""

from collections.abc import Callable
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from recon.acquisition.frame_checks import BRIGHTEST
from recon.devices.interfaces import Camera
from recon.model.rig import Part, Positive


class Exposing(Part):
    """How long cameras expose."""

    exposure_s: Positive | None = None
    """s; null sets it for what is seen, see level; of a sweep 0.01"""
    level: Annotated[float, Field(gt=0, lt=1)] = 0.9
    """of full scale, for the brightest thousandth of the pixels"""
    gain: Positive = 1.0
    """linear; 1 is the sensor's base gain"""
    longest_s: Positive = 0.2
    """s, of an exposure that is set for what is seen"""


def set_exposure(camera: Camera, seen: Callable[[], NDArray], exposing: Exposing) -> float:
    """Set a camera's exposure; returns it in s.

    seen : takes an image : (h, w) of the camera, under the brightest light that there will be
    """
    if exposing.exposure_s is not None:
        camera.set_exposure(exposing.exposure_s, exposing.gain)
        return exposing.exposure_s
    first_s = 0.01
    seconds, full = min(first_s, exposing.longest_s), 2**camera.bits - 1
    above_black = 0.02  # of full scale, that the brightest pixels must reach to say anything
    tries = 6
    near = 0.05  # relative, of the level that is wanted
    blind = 8.0  # times by which the exposure changes where an image is all black, or saturated
    for _ in range(tries):
        camera.set_exposure(seconds, exposing.gain)
        found = float(np.percentile(seen()[::4, ::4], BRIGHTEST)) / full
        if abs(found - exposing.level) <= near * exposing.level or (found < exposing.level and seconds == exposing.longest_s):
            break
        times = 1 / blind if found >= 1 else blind if found < above_black else exposing.level / found
        seconds = min(max(round(seconds * times, 6), 1e-5), exposing.longest_s)
    camera.set_exposure(seconds, exposing.gain)
    return seconds
