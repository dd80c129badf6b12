"""Propagation of sound along each line: delay, loss, shadow, refraction, as tables over the image plane.

A line is followed straight through the tissues in the image plane. Their borders give, as a function of true depth: the shown
depth (delay at the assumed speed), the amplitude that is left both ways (attenuation and transmission), and the sideways
bend by refraction.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from recon.compiled import kernel, njit
from recon.threads import in_threads
from twin.ultrasound.beam import DEEPER
from twin.ultrasound.echo_solids import (
    Body,
    between,
    distance_at,
    is_sheet,
    label_at,
    own_distance,
    resting_distance,
    resting_place,
    shrinking,
    turned,
)
from twin.ultrasound.grown_layers import layer_normal
from twin.ultrasound.scan_lines import lines_of, world_from_face, world_from_lines
from twin.ultrasound.transducer import Transducer

Array = NDArray[np.float64]
Map = NDArray[np.float32]

LEAP_MM = 2.5  # at most, without a look at the tissue; less than the margin of the solids' grids
LOWEST = 0.5  # share of its frequency by which the middle of an echo's spectrum sinks at most; assumed
RAGGED = 0.5  # cosine, by which a ragged border turns a line at most; assumed
GRADIENT_MM = 0.3  # over which a surface's normal is taken


class Paths(NamedTuple):
    """Tables over lines (a linear array's columns) and true depth in steps of `step_mm`."""

    step_mm: float
    labels: NDArray[np.uint8]  # (w, m)
    shown_mm: Map  # (w, m) depth at which the scanner shows it
    amplitude: Map  # (w, m) both ways
    shift_mm: Map  # (w, m) of the beam along the array, by refraction
    focus: Map  # (w, m) share of the energy that keeps its focus; see `aperture_paths`
    edges: Map  # (w, m) amplitude, after the beam, over that of its places: of edges of shadows that it blurs


class _Steps(NamedTuple):
    """Delay and loss of a step down a line, by label."""

    delay_mm: Array  # (n + 1,) shown depth
    kept: Array  # (n + 1,) amplitude, both ways
    refract: bool  # whether borders turn the line
    spread: Array  # (m,) variance of an echo's spectrum over its squared frequency; see `low_frequencies`


def follow(body: Body, transducer: Transducer, world_from_image: Array) -> Paths:
    """Follow the lines of one pose : world_from_image (4, 4) mm."""
    sy, lines = transducer.scale_mm_per_px[1], lines_of(transducer)
    size = lines.count, int(np.ceil(DEEPER * transducer.depth_mm / sy)) + 1
    tables = [np.full(size, start, np.float32) for start in (0, 1, 0, 1, 1)]
    paths = Paths(sy, np.zeros(size, np.uint8), *tables)
    along = lines.pitch_mm * np.arange(lines.count)
    poses = world_from_lines(lines, world_from_face(transducer, world_from_image), along)
    tissues = body.acoustics(transducer.frequency_mhz)
    delays, spread = sy * transducer.assumed_speed * (1 / tissues.speed), transducer.spectral_variance(sy * np.arange(size[1]))
    steps = _Steps(delays, np.exp(-sy * tissues.loss), transducer.refraction, spread)
    solids = body.packed()
    in_threads(_follow, size[0], paths, solids, tissues, steps, poses)
    lost = without_contact(paths, transducer)
    if lost.any():
        paths.amplitude[lost] = 0
    return paths


def without_contact(paths: Paths, transducer: Transducer) -> NDArray[np.bool_]:
    """Lines : (w,) whose skin lies beyond the gel."""
    if transducer.gel_mm is None:
        return np.zeros(len(paths.labels), bool)
    reach = int(transducer.gel_mm / paths.step_mm) + 1
    return ~(paths.labels[:, :reach] > 0).any(axis=1)


@njit(inline="always")
def reflection(z1, z2, c1, c2, cosine):
    """Reflected over incident pressure at a plane border of two fluids; 1 beyond the critical angle [Kinsler, section 6.4]."""
    sine2 = (c2 / c1) ** 2 * (1 - cosine * cosine)
    if sine2 >= 1:
        return 1.0
    onwards = np.sqrt(1 - sine2)
    return (z2 * cosine - z1 * onwards) / (z2 * cosine + z1 * onwards)


@njit(inline="always")
def low_frequencies(absorbed, spread):
    """Nepers by which an echo has lost less than its centre frequency: low ones last longer, and its middle sinks by as much.

    Loss rises with the frequency, and the spectrum is a Gaussian of the variance `spread` over its squared frequency.
    """
    sunk = min(spread * absorbed, LOWEST)
    return sunk * absorbed - sunk * sunk / (2 * spread) if spread > 0 else 0.0


@njit(inline="always")
def normal_at(solids, solid, x, y, z):
    """Outward normal of a solid at a point of the world."""
    x, y, z = resting_place(solids, x, y, z)
    nx, ny, nz = resting_normal(solids, solid, x, y, z)
    return turned(solids, nx, ny, nz, x, y, z)


@njit(inline="always")
def resting_normal(solids, solid, x, y, z):
    """Outward normal of a solid, at rest, at a point, from central differences."""
    h, grown = GRADIENT_MM, solids.grown
    if solids.layers[0] <= solid < solids.layers[1]:
        layer = solid - solids.layers[0]
        return layer_normal(grown.distance, grown.half_mm, grown.first, grown.per_mm, layer, x, y, z, h)
    a = own_distance(solids, solid, x + h, y, z) - own_distance(solids, solid, x - h, y, z)
    b = own_distance(solids, solid, x, y + h, z) - own_distance(solids, solid, x, y - h, z)
    c = own_distance(solids, solid, x, y, z + h) - own_distance(solids, solid, x, y, z - h)
    size = np.sqrt(a * a + b * b + c * c) + 1e-12
    return a / size, b / size, c / size


@njit(inline="always")
def table_at(table, line, depth, step_mm):
    """The value of a table over lines and depths at a depth, linear between its steps."""
    level = min(int(depth / step_mm), table.shape[1] - 2)
    return between(table[line, level], table[line, level + 1], depth / step_mm - level)


@njit(inline="always")
def _nearest(solids, x, y, z):
    """Distance to the nearest border, LEAP_MM at most."""
    near = shrinking(solids) * LEAP_MM
    x, y, z = resting_place(solids, x, y, z)
    for solid in range(len(solids.grid)):
        near = min(near, shrinking(solids) * abs(resting_distance(solids, solid, x, y, z)))
    return near


@kernel
def _share_before(solids, solid, pose, point, step_mm):
    """Share of the last step down to a point that lies before a solid's border."""
    x, y, z = point
    ahead = distance_at(solids, solid, x, y, z)
    back = distance_at(solids, solid, x - pose[0, 1] * step_mm, y - pose[1, 1] * step_mm, z - pose[2, 1] * step_mm)
    return min(max(back / (back - ahead), 0.0), 1.0) if back != ahead else 0.5


@njit(inline="always")
def squareness(solids, solid, cosine):
    """Cosine of the incidence on a border: 1 on a ragged one, as what its slanting faces take is the tissue's attenuation."""
    return max(abs(cosine), 0.02) if solids.mirrors[solid] else 1.0


@kernel
def _through_border(solids, tissues, pose, point, here, there):
    """Share of the amplitude that passes a border, there and back, and tangent by which the line turns along the array.

    A sheet is thinner than a wave: it turns and reflects nothing.
    """
    solid = max(here, there) - 1
    if is_sheet(solids, solid):
        return 1.0, 0.0
    nx, ny, nz = normal_at(solids, solid, point[0], point[1], point[2])
    cosine = nx * pose[0, 1] + ny * pose[1, 1] + nz * pose[2, 1]
    square = squareness(solids, solid, cosine)
    speed = tissues.speed[here], tissues.speed[there]
    r = reflection(tissues.impedance[here], tissues.impedance[there], speed[0], speed[1], square)
    along = (nx * pose[0, 0] + ny * pose[1, 0] + nz * pose[2, 0]) * (1.0 if cosine > 0 else -1.0)
    turn = (speed[1] / speed[0] - 1) * -along / max(abs(cosine), 0.02 if solids.mirrors[solid] else RAGGED)
    return max(1 - r * r, 0.0), min(max(turn, -0.3), 0.3)


@kernel
def _follow(first, end, paths, solids, tissues, steps, poses):
    step, delays = paths.step_mm, steps.delay_mm
    for line in range(first, end):
        pose = poses[line]
        x0, y0, z0 = pose[0, 3], pose[1, 3], pose[2, 3]
        here = label_at(solids, x0, y0, z0)
        paths.labels[line, 0] = here
        delay, left, absorbed, slope, aside, clear = 0.0, 1.0, 0.0, 0.0, 0.0, 0.0
        for level in range(1, paths.labels.shape[1]):
            t = step * level
            x, y, z = x0 + pose[0, 1] * t, y0 + pose[1, 1] * t, z0 + pose[2, 1] * t
            there = here
            if t >= clear:  # a border may lie as near
                there = label_at(solids, x, y, z)
                if solids.layers[0] == solids.layers[1]:  # else borders are everywhere
                    clear = t + 0.9 * _nearest(solids, x, y, z)
            if there == here:
                delay += delays[here]
                left *= steps.kept[here]
                absorbed += step * tissues.loss[here]
            else:
                part = _share_before(solids, max(here, there) - 1, pose, (x, y, z), step)
                passed, turn = _through_border(solids, tissues, pose, (x, y, z), here, there)
                delay += part * delays[here] + (1 - part) * delays[there]
                lost = step * (part * tissues.loss[here] + (1 - part) * tissues.loss[there])
                left *= passed * np.exp(-lost)
                absorbed += lost
                slope += turn if steps.refract else 0.0
            aside += slope * step
            here = there
            paths.labels[line, level] = here
            paths.shown_mm[line, level] = delay
            paths.amplitude[line, level] = left * np.exp(low_frequencies(absorbed, steps.spread[level]))
            paths.shift_mm[line, level] = aside
