"""What happens to sound along each line: delay, loss, shadow, refraction, as tables over the image plane.

A line is followed straight down the image plane through the tissues. What it meets gives, as a function of true depth: the shown
depth (delay at the assumed speed), the amplitude that is left both ways (attenuation and transmission), and by how much
refraction has bent it sideways.
"""

from dataclasses import dataclass

import numpy as np
from numba import prange
from numpy.typing import NDArray

from recon.compiled import njit
from twin.ultrasound.beam import DEEPER
from twin.ultrasound.echo_solids import Body, distance_at, label_at
from twin.ultrasound.transducer import Transducer

Array = NDArray[np.float64]
Map = NDArray[np.float32]

LEAP_MM = 2.5  # at most, without a look at the tissue; less than the margin of the solids' grids
GRADIENT_MM = 0.3  # over which a surface's normal is taken


@dataclass(frozen=True, eq=False)
class Paths:
    """Tables over lines (the image's columns) and true depth in steps of `step_mm`."""

    step_mm: float
    labels: NDArray[np.uint8]  # (w, m)
    shown_mm: Map  # (w, m) depth at which the scanner shows it
    amplitude: Map  # (w, m) both ways
    shift_mm: Map  # (w, m) of the beam along the array, by refraction


def follow(body: Body, transducer: Transducer, world_from_image: Array) -> Paths:
    """Follow the lines of one pose : world_from_image (4, 4) mm."""
    sx, sy = transducer.scale_mm_per_px
    depths = int(np.ceil(DEEPER * transducer.depth_mm / sy)) + 1
    labels, shown, amplitude, shift = _follow(
        *body.packed(),
        np.asarray(world_from_image, float),
        transducer.image_size[0],
        depths,
        sx,
        sy,
        body.column("impedance"),
        body.column("speed"),
        body.column("attenuation") * transducer.frequency_mhz * np.log(10) / 100,  # dB/cm/MHz both ways to nepers a mm
        transducer.assumed_speed,
        transducer.refraction,
    )
    return Paths(sy, labels, shown, amplitude, shift)


@njit(inline="always")
def reflection(z1, z2, c1, c2, cosine):
    """Reflected over incident pressure at a plane border of two fluids; 1 beyond the critical angle [Kinsler, section 6.4]."""
    sine2 = (c2 / c1) ** 2 * (1 - cosine * cosine)
    if sine2 >= 1:
        return 1.0
    onwards = np.sqrt(1 - sine2)
    return (z2 * cosine - z1 * onwards) / (z2 * cosine + z1 * onwards)


@njit(inline="always")
def normal_at(flat, where, frame, x, y, z):
    """Outward normal of a solid at a point of the world, from central differences."""
    h = GRADIENT_MM
    a = distance_at(flat, where, frame, x + h, y, z) - distance_at(flat, where, frame, x - h, y, z)
    b = distance_at(flat, where, frame, x, y + h, z) - distance_at(flat, where, frame, x, y - h, z)
    c = distance_at(flat, where, frame, x, y, z + h) - distance_at(flat, where, frame, x, y, z - h)
    size = np.sqrt(a * a + b * b + c * c) + 1e-12
    return a / size, b / size, c / size


@njit(parallel=True)
def _follow(flat, where, frame, pose, lines, depths, sx, step, impedance, speed, loss, assumed, refract):
    labels = np.zeros((lines, depths), np.uint8)
    shown = np.zeros((lines, depths), np.float32)
    amplitude = np.ones((lines, depths), np.float32)
    shift = np.zeros((lines, depths), np.float32)
    dx, dy, dz = pose[0, 1], pose[1, 1], pose[2, 1]
    for line in prange(lines):
        x0, y0, z0 = pose[0, 0] * sx * line + pose[0, 3], pose[1, 0] * sx * line + pose[1, 3], pose[2, 0] * sx * line + pose[2, 3]
        here = label_at(flat, where, frame, x0, y0, z0)
        labels[line, 0] = here
        delay, left, slope, aside, clear = 0.0, 1.0, 0.0, 0.0, 0.0
        for k in range(1, depths):
            t = step * k
            x, y, z = x0 + dx * t, y0 + dy * t, z0 + dz * t
            there = here
            if t >= clear:  # a border may lie as near
                there = label_at(flat, where, frame, x, y, z)
                near = LEAP_MM
                for s in range(len(where)):
                    near = min(near, abs(distance_at(flat, where[s], frame[s], x, y, z)))
                clear = t + 0.9 * near
            part = 1.0  # of the step in the tissue that it started in
            if there != here:
                s = max(here, there) - 1
                back = distance_at(flat, where[s], frame[s], x - dx * step, y - dy * step, z - dz * step)
                ahead = distance_at(flat, where[s], frame[s], x, y, z)
                part = min(max(back / (back - ahead), 0.0), 1.0) if back != ahead else 0.5
                nx, ny, nz = normal_at(flat, where[s], frame[s], x, y, z)
                cosine = nx * dx + ny * dy + nz * dz
                size = max(abs(cosine), 0.02)
                r = reflection(impedance[here], impedance[there], speed[here], speed[there], size)
                left *= max(1 - r * r, 0.0)
                if refract:
                    along = (nx * pose[0, 0] + ny * pose[1, 0] + nz * pose[2, 0]) * (1.0 if cosine > 0 else -1.0)
                    slope += min(max((speed[there] / speed[here] - 1) * -along / size, -0.3), 0.3)
            delay += step * assumed * (part / speed[here] + (1 - part) / speed[there])
            left *= np.exp(-step * (part * loss[here] + (1 - part) * loss[there]))
            aside += slope * step
            here = there
            labels[line, k] = here
            shown[line, k] = delay
            amplitude[line, k] = left
            shift[line, k] = aside
    return labels, shown, amplitude, shift
