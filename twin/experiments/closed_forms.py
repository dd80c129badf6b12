"""Closed forms of the errors that a rig can't do better than, from its description alone.

Fringe projection: `sigma_phase = sqrt(2 / N) sigma / B`, `sigma_u = pitch / (2 pi) sigma_phase`, and a point's distance from its
surface by the slope of the projector's column along the camera's ray. Tracking: the Cramer-Rao bound of the pose from the six
circles' centres. Sources: Greivenkamp 1984; docs/physics-optics.md, docs/tracking.md.
"""

import numpy as np
from scipy.special import j1

from recon.geometry import rigid
from recon.geometry.camera import Array, Camera
from recon.geometry.camera_jacobian import linearise
from recon.geometry.primitives import Plane
from recon.model import circle_layout
from recon.model.patterns import Axis, Fringes, Patterns
from recon.model.rig import CameraDevice, ProjectorDevice, Rig, Target
from twin.sensor import Exposure, noise_dn, number_per_electron

GRID = (9, 7)  # places over camera 1's image, across and down
STEP_MM = 0.5  # of the central difference along a ray
EXACT_MM2 = 1e-8  # variance of a length that is known
WAVE = 4096  # steps of a period, of which the first harmonic is taken


def fringes_of(patterns: Patterns, axis: Axis = "columns") -> Fringes:
    """The finest fringes along an axis, which measure; raises ValueError without any."""
    found = [part for part in patterns.parts if isinstance(part, Fringes) and part.axis == axis]
    if not found:
        raise ValueError(f"patterns: expected fringes along the {axis}, found none")
    return min(found, key=lambda part: part.pitch)


def phase_sigma(steps: int, noise_dn: float, modulation_dn: float) -> float:
    """Standard deviation of the least-squares phase of N steps, rad."""
    return float(np.sqrt(2 / steps) * noise_dn / modulation_dn)


def phase_sigma_of_frames(steps: int, flicker: float, stray: Array, shift: float, level: Array) -> Array:
    """Standard deviation of the phase of N steps, rad, over a surface, by errors that each frame has anew, before correction.

    A frame's error dI moves the phase by `-2 / (N B) dI sin(phase + shift)`; the squares' means over all phases add up. The mean
    of the shifts moves the whole surface, and isn't counted.

    Parameters
    ----------
    flicker : standard deviation of the light, relative
    stray : (n,) standard deviation of light from elsewhere, over the modulation B
    shift : standard deviation of the shifts, in steps
    level : (n,) mean light of the projector over B
    """
    by_light = 2 / steps * (stray**2 + flicker**2 * (level**2 + 1 / 4))
    return np.sqrt(by_light + (2 * np.pi / steps * shift) ** 2 / (2 * steps))


def contrast(rig: Rig, fringes: Fringes, place: Array) -> Array:
    """Modulation of fringes over their mean brightness, B / A, in camera 1's images of a surface at places : (..., 3) mm.

    The first harmonic of the waveform behind the projector's gamma, less what blurs it: the mirrors, `sinc(1 / pitch)`, and
    `transfer`.
    """
    turn, light = 2 * np.pi * np.arange(WAVE) / WAVE, waveform(rig, fringes, WAVE)
    first = 2 * np.mean(light * np.cos(turn))
    wave = np.array([1 / fringes.pitch])
    return first / light.mean() * (np.sinc(wave) * transfer(rig, place, wave))[..., 0]


def waveform(rig: Rig, fringes: Fringes, steps: int) -> Array:
    """Light of the fringes over a period : (steps,), 1 for a pixel that is fully on, behind gamma and black, without blur."""
    turn = 2 * np.pi * np.arange(steps) / steps
    shown = (np.cos(turn) >= 0).astype(float) if fringes.waveform == "binary" else ((1 + np.cos(turn)) / 2) ** rig.projector.gamma
    black = 1 / rig.projector.contrast
    return black + (1 - black) * shown


def raster_sigma(rig: Rig, fringes: Fringes, place: Array) -> Array:
    """RMS error of the phase, rad, at places : (..., 3) mm by the projector's mirrors.

    Fringes on mirrors have replicas at 1 -+ 1 / pitch cycles a px. Sampling makes them as strong as the fringes; a mirror's
    width, sinc(f), and all blur weaken them. Over a mirror's width both turn once against the fringes, one forwards and one
    backwards, whatever the shift: no number of steps takes them out. As sinc has other signs for them, their errors
    `sin(2 pi x)` add up.
    """
    wave = 1 / fringes.pitch
    waves = np.array([wave, 1 - wave, 1 + wave])
    own, backwards, forwards = np.moveaxis(np.sinc(waves) * transfer(rig, place, waves), -1, 0)
    return np.abs(backwards - forwards) / own / np.sqrt(2)


def transfer(rig: Rig, place: Array, waves: Array) -> Array:
    """Share : (..., n) of waves : (n,), cycles per projector px, that comes through both lenses and camera 1's pixels.

    Of a surface at places : (..., 3) mm that faces the devices. Point spreads are normal, what is out of focus is an even disc,
    `2 J1(x) / x` with x = pi times its diameter in cycles, which is below zero beyond 1.22 cycles, and pixels are squares.
    """
    of_projector, disc, at = _lens_blur(rig.projector, place)
    of_camera, camera_disc, before = _lens_blur(rig.cam1, place)
    pixel = at / before  # of the camera, in projector px
    normal = np.exp(-2 * np.pi**2 * (of_projector**2 + (pixel * of_camera) ** 2) * waves**2)
    return normal * _disc(disc * waves) * _disc(pixel * camera_disc * waves) * np.sinc(pixel * waves)


def _disc(cycles: Array) -> Array:
    x = np.maximum(np.pi * cycles, 1e-6)
    return 2 * j1(x) / x


def _lens_blur(device: CameraDevice | ProjectorDevice, place: Array) -> tuple[float, Array, Array]:
    """A lens's point spread (standard deviation), own px, its disc (diameter) at places : (..., 3), and px for a mm."""
    depth = rigid.apply(device.optics.device_from_world.matrix(), np.asarray(place, float))[..., 2:]
    disc = device.optics.focal_px[0] * device.lens.aperture_mm * np.abs(1 / depth - 1 / device.lens.focus_mm)
    return device.lens.blur_px, disc, device.optics.focal_px[0] / depth


def plane_sigma(rig: Rig, plane: Plane, column_sigma: float) -> float:
    """RMS distance of a plane's points from it, mm, for a standard deviation of the projector's column, px."""
    camera, projector = rig.cam1.optics.camera(), rig.projector.optics.camera()
    return float(column_sigma * np.sqrt(np.mean(np.square(_mm_a_column(camera, projector, plane)))))


def _mm_a_column(camera: Camera, projector: Camera, plane: Plane) -> Array:
    """Distance from a plane, mm, by which a point moves a column of the projector, over what both see of it."""
    across, down = (np.linspace(0, length - 1, steps) for length, steps in zip(camera.size, GRID, strict=True))
    return seen_points(camera, projector, plane, np.stack(np.meshgrid(across, down), axis=-1).reshape(-1, 2))[1][:, 0]


def seen_points(camera: Camera, projector: Camera, plane: Plane, pixels: Array) -> tuple[Array, Array]:
    """Points : (n, 3) mm of a plane at those pixels : (m, 2) of a camera that the projector reaches.

    And by how much, mm, a point leaves the plane for a px of the projector's column, and of its row : (n, 2).
    """
    rays = camera.rays(pixels)
    cosine = rays @ plane.normal
    points = camera.centre + rays * (((plane.point - camera.centre) @ plane.normal) / cosine)[:, None]
    places = [projector.project(points + side * STEP_MM * rays) for side in (-1, 0, 1)]
    seen = ((places[1] > -0.5) & (places[1] < np.array(projector.size) - 0.5)).all(axis=1)
    slope = (places[2] - places[0]) / (2 * STEP_MM)
    with np.errstate(divide="ignore"):  # an axis beside which the camera stands shows no depth
        return points[seen], (np.abs(cosine)[:, None] / np.abs(slope))[seen]


def brightness_noise(camera: CameraDevice, brightness_dn: float, exposure: Exposure) -> float:
    """Noise of an image, DN, at a brightness above black."""
    electrons = np.float32(max(brightness_dn, 0.0) / number_per_electron(camera.sensor, exposure))
    return float(noise_dn(electrons, camera.sensor, exposure))


def pose_covariance(cameras: tuple[Camera, Camera], pose: Array, target: Target, sigma_px: Array) -> Array:
    """Cramer-Rao bound of a target's pose : (6, 6), rad and mm, as of `rigid.difference`.

    The lengths between the circles are unknown too, but for what the target's tolerance says of them.

    Parameters
    ----------
    pose : (4, 4), world_from_target
    sigma_px : (2, n), standard deviation of a circle's centre in u and in v, in each camera
    """
    circles = circle_layout.circle_centres(target)
    world = rigid.apply(pose, circles)
    by_length = np.einsum("ij,njk->nik", pose[:3, :3], circle_layout.by_length(target))
    slopes = np.concatenate([rigid.slopes(world - pose[:3, 3]), by_length], axis=-1)
    unknowns = slopes.shape[-1]
    information = np.zeros((unknowns, unknowns))
    information[6:, 6:] = np.linalg.inv(circle_layout.length_covariance(target) + EXACT_MM2 * np.eye(unknowns - 6))
    for camera, sigmas in zip(cameras, sigma_px, strict=True):
        seen = linearise(camera, world, ()).by_point @ slopes / sigmas[:, None, None]
        information += np.einsum("nij,nik->jk", seen, seen)
    return np.linalg.inv(information)[:6, :6]
