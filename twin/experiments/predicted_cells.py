"""Errors of the projector's coordinates that a Gray code alone will give, from a rig's description.

A cell names a coordinate to its width over the root of 12, whatever the light, as long as its bits are read. Blur and noise make
bits uncertain, at borders of cells first, then all over the finest stripes, and the decoder then takes wider cells: so the code's
images are made for a row of positions at each place, and read by the decoder itself.
"""

from typing import NamedTuple

import numpy as np

from recon.geometry.camera import Array
from recon.model.patterns import GrayCode
from recon.model.rig import Rig
from recon.structured_light import decode, gray_cells
from recon.structured_light.phase import DEFAULT_NOISE
from twin.experiments import closed_forms
from twin.sensor import Exposure, digitise

WINDOW = 48  # projector px about a place of which the light counts; blur that reaches a quarter of it leaves no bits to be read
FINE = 12  # positions a projector px
SEED = 1  # of noise: the same for rigs that are compared


class Light(NamedTuple):
    """Electrons of a pixel at each place : (n,)."""

    projector: Array  # by a projector that is fully on
    room: Array  # by all else, dark current included


class Read(NamedTuple):
    """Coordinates as they will be read, at positions around each place, in any order : (n, m), NaN where none is."""

    error: Array  # projector px, from the true coordinate
    sigma: Array  # projector px, as the decoder has it


def read(rig: Rig, code: GrayCode, coordinate: Array, points: Array, light: Light, exposure: Exposure) -> Read:
    """Read a code at places of a surface.

    Parameters
    ----------
    coordinate : (n,) projector px
        Of the places, along the code's axis.
    points : (n, 3) mm
        The places.
    """
    length = rig.projector.optics.size[0 if code.axis == "columns" else 1]
    black, half = 1 / rig.projector.contrast, WINDOW // 2
    shown = np.pad(code.profiles(length), ((0, 0), (half, half)))
    nearest = np.clip(np.rint(coordinate).astype(int), 0, length - 1)
    lit = black + (1 - black) * np.repeat(shown[:, nearest[:, None] + np.arange(WINDOW)], FINE, axis=-1)
    transfer = closed_forms.transfer(rig, points, np.fft.rfftfreq(WINDOW * FINE, 1 / FINE))
    middle = slice(WINDOW * FINE // 4, 3 * WINDOW * FINE // 4)
    blurred = np.fft.irfft(np.fft.rfft(lit) * transfer, WINDOW * FINE)[..., middle]
    uniform = np.broadcast_to(np.array([black, 1.0])[:, None, None], (2, *blurred.shape[1:]))
    mean = np.concatenate([blurred, uniform]) * light.projector[:, None] + light.room[:, None]
    spread = np.sqrt(np.maximum(mean, 0) + rig.cam1.sensor.dark_noise_e**2)
    generator = np.random.default_rng((SEED, code.axis == "rows"))
    images = digitise(np.float32(mean + spread * generator.standard_normal(mean.shape, np.float32)), rig.cam1.sensor, exposure)
    full = 2.0**exposure.bits - 1
    levels = gray_cells.levels(images[:-2], code, images[-2:])
    cells = gray_cells.locate(images[:-2], code, levels, length, DEFAULT_NOISE.scaled(full / 255))
    true = (nearest[:, None] - half - 0.5 + (np.arange(WINDOW * FINE) + 0.5) / FINE)[:, middle]
    dark = levels.white - levels.black < 2 * decode.DARKEST * full / 255
    known = ~dark & (np.minimum(true, cells.middle) > -0.5) & (np.maximum(true, cells.middle) < length - 0.5)
    order = generator.permutation(known.shape[1])  # where a pixel lies in its column says nothing of its row
    return Read(np.where(known, cells.middle - true, np.nan)[:, order], np.where(known, cells.sigma, np.nan)[:, order])
