"""Images of a projector's patterns on a ruled surface, row by row by transfer functions: another way than the fit's, in space."""

from typing import NamedTuple

import numpy as np
from scipy.special import j1

from recon.geometry.camera import Camera
from recon.model.patterns import Patterns
from recon.model.rig import ProjectorDevice, Sensor
from recon.structured_light.triangulate import PointMap
from twin.conditions import Frames, draw
from twin.optics.disturbed_light import emitted
from twin.sensor import Exposure, digitise, fixed_pattern, number_per_electron, read_out

FINE, MARGIN = 16, 64  # steps a projector px, and px beyond the raster
SHAPE = (32, 384)
ACROSS, DOWN = 0.58, 0.07  # projector px a camera px
CAMERA = Camera(SHAPE[::-1], np.array([[3320.0, 0, 192], [0, 3320, 16], [0, 0, 1]]), np.zeros(0))
PROJECTOR = Camera((1280, 800), np.array([[1921.0, 0, 614], [0, 1927, 772], [0, 0, 1]]), np.zeros(0))


class Shown(NamedTuple):
    """What a camera saw, and where that is."""

    images: np.ndarray  # (n, h, w)
    room: np.ndarray  # (m, h, w), the projector covered
    points: PointMap


def photograph(
    device: ProjectorDevice,
    frames: Frames,
    patterns: Patterns,
    sensor: Sensor,
    depths_mm: tuple[float, float],
    blur_px: float,
    rng: np.random.Generator,
) -> Shown:
    """Photograph patterns by a camera of a point spread, on a surface whose rows lie at other depths each."""
    drawn = draw(frames, patterns.count, int(rng.integers(2**31)))
    sharp = device.model_copy(update={"lens": device.lens.model_copy(update={"blur_px": 0.0})})
    profiles = np.pad(np.array(emitted(patterns, sharp, drawn).profiles, float), ((0, 0), (MARGIN, MARGIN)))
    fine = np.repeat(profiles, FINE, axis=1)
    spectrum, waves = np.fft.rfft(fine, axis=1), np.fft.rfftfreq(fine.shape[1], 1 / FINE)
    (h, w), first, depths = SHAPE, rng.uniform(100, 800), np.linspace(*depths_mm, SHAPE[0])
    light = np.empty((patterns.count, h, w))
    for row in range(h):
        disc = device.lens.aperture_mm * device.optics.focal_px[0] * abs(1 / device.lens.focus_mm - 1 / depths[row])
        variance = device.lens.blur_px**2 + (ACROSS**2 + DOWN**2) * blur_px**2
        edge = np.maximum(np.pi * disc * waves, 1e-9)
        passed = (
            np.exp(-2 * np.pi**2 * waves**2 * variance) * 2 * j1(edge) / edge * np.sinc(waves * ACROSS) * np.sinc(waves * DOWN)
        )
        blurred = np.fft.irfft(spectrum * passed, fine.shape[1], axis=1)
        place = (first + ACROSS * np.arange(w) + DOWN * row + 0.5 + MARGIN) * FINE - 0.5
        low = np.floor(place).astype(int)
        light[:, row] = blurred[:, low] * (1 - place + low) + blurred[:, low + 1] * (place - low)
    albedo = 170.0 * rng.uniform(0.3, 1) * (1 + 0.3 * np.sin(np.arange(w) / 50)) / 1.3
    exposure, room_dn = Exposure(0.01), 3.0
    response, offset = fixed_pattern(sensor, SHAPE, 5)

    def taken(mean: np.ndarray) -> np.ndarray:
        electrons = np.float32(np.maximum(mean, 0) / number_per_electron(sensor, exposure)) * response
        return digitise(read_out(electrons, sensor.dark_noise_e, rng) + offset, sensor, exposure)

    images = np.stack([taken(albedo * one + room_dn + stray) for one, stray in zip(light, drawn.stray_dn, strict=True)])
    covered = draw(frames, 8, int(rng.integers(2**31))).stray_dn
    points = np.zeros((h, w, 3), np.float32)
    points[..., 2] = depths[:, None]
    room = np.stack([taken(np.full(SHAPE, room_dn + stray)) for stray in covered])
    return Shown(images, room, PointMap(points, np.full(SHAPE, 0.03, np.float32)))
