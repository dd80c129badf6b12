"""Measures a projector's light over its levels by a camera, and what a bent response does to fringes.

Gamma, colour profiles and a projector's picture modes stand between a pattern and its light, most of them where no program can
read them. Sinusoidal fringes then have harmonics, which bend their phase: by three or four steps visibly, by eight hardly.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from recon.devices.interfaces import Camera, DeviceError, Image, Projector
from recon.devices.pattern_player import Stage, Taking, play, refuse_faults
from recon.model.patterns import Fringes, Patterns

Array = NDArray[np.float64]

STEPS = 17  # grey levels, of 8 bits: every 16th
LIT = 0.25  # share of the brightest pixels' light from which on a pixel counts


class Response(NamedTuple):
    """A projector's light over its levels."""

    levels: Array  # (n,) 0 to 1, ascending
    light: Array  # (n,) 0 to 1, in the mean over the lit pixels

    @property
    def gamma(self) -> float:
        """The exponent of `light = level ** gamma`, by least squares."""
        gammas = (0.2, 5.0)
        return float(minimize_scalar(lambda g: np.sum((self.levels**g - self.light) ** 2), bounds=gammas).x)

    @property
    def bend(self) -> float:
        """Largest difference from light that goes with the level, as a share of white."""
        return float(np.abs(self.light - self.levels).max())


def measure(projector: Projector, camera: Camera, taking: Taking, steps: int = STEPS) -> Response:
    """Project grey steps and measure their light.

    Parameters
    ----------
    camera : with exposure and gain set so that white isn't saturated, and linear
    steps : of grey levels from black to white, 3 or more

    Raises
    ------
    DeviceError
        If the camera doesn't see the projector or its steps, or white is saturated.
    """
    width, height = projector.size
    order = _far_apart(steps)
    levels = np.uint8(np.rint(np.linspace(0, 255, steps)))
    shown = (np.full((height, width), levels[k], np.uint8) for k in order)
    images = {}
    for k, shot in zip(order, play(Stage(projector, {camera.name: camera}, taking), shown), strict=True):
        refuse_faults(shot)
        images[k] = shot.frames[camera.name].image
    return _response(levels / 255, [images[k] for k in range(steps)], 2**camera.bits - 1, camera.name)


def _response(levels: Array, images: Sequence[Image], full: float, name: str) -> Response:
    """The response by images : (h, w) of ascending grey levels : (n,), black first and white last.

    full : DN of a saturated pixel
    name : of the camera, for messages
    """
    black, white = np.float32(images[0]), np.float32(images[-1])
    light = white - black
    lit = light > LIT * np.percentile(light, 99)
    saturated = 0.98  # share of full scale
    if np.mean(white[lit] >= saturated * full) > 0.01:
        raise DeviceError(f"{name}: expected white below {saturated * full:.0f} DN, found it saturated: shorten the exposure")
    total = light[lit].sum()
    if not total > 0:
        raise DeviceError(f"{name}: expected the projector's light, found white as dark as black: is the lens covered?")
    return Response(levels, np.array([np.sum(np.float32(image)[lit] - black[lit]) / total for image in images], float))


def fringe_error(measured: Response, part: Fringes) -> float:
    """Largest error of a set of fringes by a projector's response, in projector px.

    The phasor of N steps is summed as they would be seen: harmonics N - 1, N + 1 and so on are taken for the fundamental.
    """
    if part.waveform == "binary":
        return 0.0
    phase, shifts = np.linspace(-np.pi, np.pi, 720, endpoint=False), part.shifts[:, None]
    seen = np.interp((1 + np.cos(phase + shifts)) / 2, measured.levels, measured.light)
    error = np.angle(np.sum(seen * np.exp(-1j * shifts), axis=0) * np.exp(-1j * phase))
    return float(np.abs(error).max() * part.pitch / (2 * np.pi))


def bent_fringes(measured: Response, patterns: Patterns) -> str:
    """One line on what a response does to a sequence, with the way on; empty where it does nothing."""
    errors = {fringe_error(measured, part): part for part in patterns.parts if isinstance(part, Fringes)}
    worst = max(errors, default=0.0)
    bent_px = 0.05  # projector px by which fringes may bend before it is said
    if worst <= bent_px:
        return ""
    part = errors[worst]
    return (
        f"projector: its light goes with level^{measured.gamma:.2f}, which bends {part.steps} fringes of {part.pitch:g} px by up "
        f"to {worst:.2f} px: set the projector and the display to linear, take more steps, or project patterns of "
        f"linearise_gamma={measured.gamma:.2f}"
    )


def _far_apart(steps: int) -> list[int]:
    """An order of steps in which neighbours are about half the range apart, so that each one shows: white, then 0, n/2, 1, ..."""
    half = steps // 2
    mixed = [k for pair in zip(range(half), range(half, 2 * half), strict=True) for k in pair]
    return [steps - 1, *(k for k in [*mixed, 2 * half] if k < steps - 1)]
