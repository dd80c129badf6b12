"""Shadows of tools: the share of the beam to each place that a shaft before it blocks.

What arrives at a place is the sum over the aperture, with the phases of its focus. A ray from a point of the aperture that passes
at a distance d from the axis of an opaque rod of radius a, at a depth y0 on its way to y, loses of its wave (Fresnel diffraction)

    [F((d + a) / w) - F((d - a) / w)] / (1 + i),   F(t) = ∫_0^t exp(i pi u² / 2) du,   w² = lambda y0 (y - y0) / (2 y),

and beside the rod's end the part of a half plane as well. So shadows are deep close behind a rod and along one that lies in the
plane, where the beam is as thin as it, and fill up behind one that crosses the plane, by what passes on both sides.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates
from scipy.special import fresnel

from recon.compiled import kernel, njit
from recon.geometry import rigid
from recon.threads import in_threads
from twin.ultrasound.beam import NEAREST_MM
from twin.ultrasound.scan_lines import lines_of, world_from_face, world_from_lines
from twin.ultrasound.sound_paths import Paths
from twin.ultrasound.tool_echoes import Tool
from twin.ultrasound.transducer import Transducer

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

LINES, LEVELS = 4, 5  # lines and levels of depth from one place where shadows are summed to the next
POINTS = 10, 6  # of the aperture, along and across the array
BESIDE = 6.0  # widths of Fresnel's zone beside a rod, from where it hides nothing
FURTHEST, STEP = 12.0, 0.01  # of the table of Fresnel's integral
_TIMES = np.arange(0, FURTHEST + 2 * STEP, STEP)
FRESNEL = fresnel(_TIMES)[1] + 1j * fresnel(_TIMES)[0]


class _Aperture(NamedTuple):
    """Points of the aperture of a line, in its frame, and figures of the sound."""

    share: Array  # (n,) of half the width, along the array
    weight: Array  # (n,) Hann's
    across: Array  # (m,) mm
    transmit_mm: Array  # (k,) width, by level
    transmit_focus_mm: Array  # (k,)
    receive_f_number: float
    receive_most_mm: float
    lens_mm: float
    wavelength_mm: float


def shaded(paths: Paths, tools: Sequence[Tool], transducer: Transducer, world_from_image: Array) -> Paths:
    """Paths whose amplitude has the tools' shadows in it; the labels and delays stay."""
    count, depths = paths.labels.shape
    lines = lines_of(transducer)
    along = np.arange(0, count - 1 + LINES, LINES)
    poses = world_from_lines(lines, world_from_face(transducer, world_from_image), lines.pitch_mm * along)
    levels = paths.step_mm * LEVELS * np.arange(int(np.ceil(depths / LEVELS)) + 1)
    kept = np.ones((len(along), len(levels)))
    aperture = _aperture(transducer, levels)
    for tool in tools:
        ends = np.stack([rigid.apply(rigid.invert(pose), tool.shaft.ends) for pose in poses])
        one = np.ones_like(kept)
        in_threads(_shade, len(along), one, np.ascontiguousarray(ends), tool.shaft.radius, levels, aperture, FRESNEL)
        kept *= one
    places = np.meshgrid(np.arange(count) / LINES, np.arange(depths) / LEVELS, indexing="ij")
    return paths._replace(amplitude=paths.amplitude * map_coordinates(kept, places, order=1).astype(np.float32))


def _aperture(transducer: Transducer, levels: Array) -> _Aperture:
    share = (2 * np.arange(POINTS[0]) + 1) / POINTS[0] - 1
    across = transducer.elevation_mm / 2 * ((2 * np.arange(POINTS[1]) + 1) / POINTS[1] - 1)
    return _Aperture(
        share,
        np.cos(np.pi / 2 * share) ** 2,
        across,
        transducer.focus_mm(levels) / transducer.transmit_f_number,
        transducer.focus_mm(levels),
        transducer.receive_f_number,
        transducer.aperture_mm,
        transducer.elevation_focus_mm,
        transducer.wavelength_mm,
    )


@njit(inline="always")
def _integral(table, t):
    """Fresnel's integral, from a table."""
    place = min(abs(t) / STEP, FURTHEST / STEP)
    i = int(place)
    value = table[i] + (place - i) * (table[i + 1] - table[i])
    return value if t >= 0 else -value


@njit(inline="always")
def _passing(ends, x, z, y, wavelength):
    """Where a ray from a point (x, z) of the aperture to a depth y on the line passes a rod.

    Distance between their axes, and length of the rod from there to its tip and to its rear end, across the ray; all over the
    width w of Fresnel's zone, which is 0 where it doesn't pass.
    """
    ux, uy, uz = ends[0, 0] - ends[1, 0], ends[0, 1] - ends[1, 1], ends[0, 2] - ends[1, 2]
    length = np.sqrt(ux * ux + uy * uy + uz * uz)
    ux, uy, uz = ux / length, uy / length, uz / length
    far = np.sqrt(x * x + y * y + z * z)
    rx, ry, rz = -x / far, y / far, -z / far
    nx, ny, nz = uy * rz - uz * ry, uz * rx - ux * rz, ux * ry - uy * rx
    sine2 = max(nx * nx + ny * ny + nz * nz, 1e-6)
    px, py, pz = x - ends[1, 0], -ends[1, 1], z - ends[1, 2]  # from the tip to the point
    cosine = ux * rx + uy * ry + uz * rz
    on_ray, on_rod = px * rx + py * ry + pz * rz, px * ux + py * uy + pz * uz
    along, back = (cosine * on_rod - on_ray) / sine2, (on_rod - cosine * on_ray) / sine2
    if not (0 < along < far):
        return 0.0, 0.0, 0.0, 0.0
    sine, width = np.sqrt(sine2), np.sqrt(wavelength * along * (far - along) / (2 * far))
    return (px * nx + py * ny + pz * nz) / sine / width, back * sine / width, (length - back) * sine / width, width


@njit(inline="always")
def _is_clear(ends, radius, half_x, half_z, y, wavelength):
    """Whether the rod lies far beside all rays of an aperture, by those from its corners."""
    left, right, before = 0, 0, 0
    for i in (-1, 1):
        for j in (-1, 1):
            apart, back, _, width = _passing(ends, i * half_x, j * half_z, y, wavelength)
            size = radius / width if width > 0 else 0.0
            left += width > 0 and apart > size + BESIDE
            right += width > 0 and apart < -size - BESIDE
            before += width == 0 or back < -BESIDE
    return left == 4 or right == 4 or before == 4


@njit(inline="always")
def _left(table, ends, radius, y, width, bend, aperture):
    """Amplitude that is left of a beam with an aperture of some width, at a depth on its line, where the sum has curvature."""
    whole, lost = complex(0.0), complex(0.0)
    k = np.pi / aperture.wavelength_mm
    lens = 1 / y - 1 / aperture.lens_mm
    for i in range(len(aperture.share)):
        x = aperture.share[i] * width / 2
        for j in range(len(aperture.across)):
            z = aperture.across[j]
            phase = k * (x * x * bend + z * z * lens)
            wave = aperture.weight[i] * complex(np.cos(phase), np.sin(phase))
            whole += wave
            apart, back, front, zone = _passing(ends, x, z, y, aperture.wavelength_mm)
            if zone > 0:
                across = _integral(table, apart + radius / zone) - _integral(table, apart - radius / zone)
                lost += wave * across * (_integral(table, back) + _integral(table, front)) / complex(0.0, 2.0)
    return min(abs(1 - lost / whole), 1.0)


@kernel(fastmath=True)
def _shade(first, end, kept, ends, radius, levels, aperture, table):
    """What is left of the two-way beam, at places down some lines."""
    for line in range(first, end):
        top = min(ends[line, 0, 1], ends[line, 1, 1]) - radius
        for level in range(len(levels)):
            y = levels[level]
            if y <= max(top, NEAREST_MM):
                continue
            receive = min(max(y / aperture.receive_f_number, NEAREST_MM / 2), aperture.receive_most_mm)
            widest = max(receive, aperture.transmit_mm[level]) / 2
            if _is_clear(ends[line], radius, widest, aperture.across[-1], y, aperture.wavelength_mm):
                continue
            bend = 1 / y - 1 / aperture.transmit_focus_mm[level]
            transmit = _left(table, ends[line], radius, y, aperture.transmit_mm[level], bend, aperture)
            kept[line, level] = transmit * _left(table, ends[line], radius, y, receive, 0.0, aperture)
