"""Scatterers of the tissue, anchored in the world, and their echoes before the point spread.

Each cell of a lattice that fills the world holds one scatterer, whose place in the cell is a hash of the cell and the seed: the
same tissue from every pose, with nothing stored. Places are uniform in the cell, so that the density is even and the lattice
has no echo of its own. A scatterer's length f follows from the backscatter coefficient: `density f² = eta`.
"""

import numpy as np
from numba import prange
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter1d

from recon.compiled import njit
from twin.ultrasound.beam import OVERSAMPLING, STEP_MM, Beam
from twin.ultrasound.echo_solids import Body, distance_at, label_at
from twin.ultrasound.sound_paths import Paths
from twin.ultrasound.transducer import Transducer

Field = NDArray[np.complex64]

BESIDE_MM = 2.0  # beside the image, from where scatterers still count
TURNS = 4096  # entries of the table of phases, a power of two
MIX = np.array([0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9], np.uint64)  # of a cell's coordinates
PARTS = 16  # in which echoes are summed: not the number of threads, on which the rounding would then depend
SPREAD = 7  # without a common factor with PARTS
RUN = 8  # cells in a row whose tissue is looked up at once, where no border is near
CLEAR = 1.15  # over a run's reach: distances of bent surfaces are true to second order


def field_like(transducer: Transducer, beam: Beam) -> Field:
    """An empty field of echoes : (w + taps - 1, OVERSAMPLING h), lines by shown depth, with room for the beam's width."""
    width, height = transducer.image_size
    return np.zeros((width + beam.lateral.shape[1] - 1, OVERSAMPLING * height), np.complex64)


def scatter(body: Body, transducer: Transducer, beam: Beam, paths: Paths, world_from_image: NDArray, seed: int) -> Field:
    """Demodulated echoes of the tissue's scatterers, weighed across the plane, before the point spread in the plane."""
    edge = transducer.scatterers_per_mm3 ** (-1 / 3)
    strength = np.sqrt(body.scattering() / transducer.scatterers_per_mm3) * transducer.wavelength_mm
    turns = np.exp(2j * np.pi * np.arange(TURNS) / TURNS).astype(np.complex64)
    pose = np.asarray(world_from_image, float)
    sx, sy = transducer.scale_mm_per_px
    axes = _lattice_axes(pose)
    fields = np.zeros((PARTS, *field_like(transducer, beam).shape), np.complex64)
    touched = _scatter(
        *body.packed(),
        pose,
        _lattice_box(transducer, beam, pose, edge),
        axes,
        edge,
        np.uint64(seed),
        strength.astype(np.float32),
        sx,
        sy / OVERSAMPLING,
        paths.step_mm,
        paths.shown_mm,
        paths.amplitude,
        paths.shift_mm,
        beam.elevation,
        beam.core_mm,
        _thickness(beam, pose, axes, edge),
        deepest_seen(transducer, beam, paths),
        beam.depth_step_mm,
        transducer.wavenumber,
        turns,
        fields,
    )
    return summed(fields, touched)


def _lattice_axes(pose: NDArray) -> tuple[int, int, int]:
    """The lattice's axis most along the image's x, the other one, and the one most across the image."""
    across = int(np.abs(pose[:3, 2]).argmax())
    along, other = sorted({0, 1, 2} - {across}, key=lambda axis: -abs(pose[axis, 0]))
    return along, other, across


def _lattice_box(transducer: Transducer, beam: Beam, pose: NDArray, edge: float) -> NDArray[np.int64]:
    """First and last cell : (2, 3) of the box around the slice."""
    x = np.array([-BESIDE_MM, transducer.width_mm + BESIDE_MM])
    y = np.array([0.0, beam.depth_step_mm * (len(beam.core_mm) - 1)])
    z = np.array([-1.0, 1.0]) * float(beam.core_mm.max())
    corners = np.stack(np.meshgrid(x, y, z), axis=-1).reshape(-1, 3) @ pose[:3, :3].T + pose[:3, 3]
    return np.stack([np.floor(corners.min(axis=0) / edge), np.floor(corners.max(axis=0) / edge)]).astype(np.int64)


def _thickness(beam: Beam, pose: NDArray, axes: tuple[int, int, int], edge: float) -> NDArray[np.float32]:
    """Half thickness of the slice that a column of cells may meet which crosses the image's plane at a depth, as `core_mm`."""
    tilt = abs(pose[axes[2], 1] / pose[axes[2], 2])
    rows = int(np.ceil(((float(beam.core_mm.max()) + 2 * edge) * tilt + 2 * edge) / beam.depth_step_mm))
    return maximum_filter1d(beam.core_mm, 2 * rows + 1)


def deepest_seen(transducer: Transducer, beam: Beam, paths: Paths) -> float:
    """Depth, mm, beyond which no line shows anything in the image."""
    last = transducer.depth_mm + transducer.scale_mm_per_px[1] * beam.axial.shape[1] / 2 / OVERSAMPLING
    levels = int(np.searchsorted(paths.shown_mm.min(axis=0), last))
    return min(paths.step_mm * levels, beam.depth_step_mm * (len(beam.core_mm) - 1))


@njit(inline="always")
def hashed(i, j, k, seed):
    """64 random bits of a cell, by the finaliser of SplitMix64 (Steele, Lea and Flood 2014) over the mixed coordinates."""
    return mixed(np.uint64(i) * MIX[0] ^ np.uint64(j) * MIX[1] ^ np.uint64(k) * MIX[2], seed)


@njit(inline="always")
def mixed(x, seed):
    """64 random bits of what the coordinates have been folded to."""
    x = x + seed * np.uint64(0xD6E8FEB86659FD93)
    x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return x ^ (x >> np.uint64(31))


@njit(inline="always")
def deposit(field, px, py, value):
    """Add an echo at a fractional place of the field, shared among the four samples around it."""
    i, j = int(np.floor(px)), int(np.floor(py))
    if i < 0 or j < 0 or i >= field.shape[0] - 1 or j >= field.shape[1] - 1:
        return
    a, b = np.float32(px - i), np.float32(py - j)
    field[i, j] += value * ((1 - a) * (1 - b))
    field[i, j + 1] += value * ((1 - a) * b)
    field[i + 1, j] += value * (a * (1 - b))
    field[i + 1, j + 1] += value * (a * b)


@njit(inline="always")
def uniform_label(flat, where, frame, x, y, z, radius):
    """Label of all points within a distance of one, or -1 if a border may come as near."""
    found = 0
    for k in range(len(where)):
        d = distance_at(flat, where[k], frame[k], x, y, z)
        if abs(d) <= radius:
            return -1
        if d < 0:
            found = k + 1
    return found


@njit(parallel=True, fastmath=True)
def _scatter(
    flat,
    where,
    frame,
    pose,
    box,
    axes,
    edge,
    seed,
    strength,
    sx,
    row,
    step,
    shown,
    amplitude,
    shift,
    elevation,
    half,
    thickness,
    deepest,
    depth_step,
    wavenumber,
    turns,
    fields,
):
    first, second, main = axes
    lines, depths = shown.shape
    parts = fields.shape[0]
    pad = (fields.shape[1] - lines) // 2
    mask = np.uint64(0x1FFFFF)
    to_turn = 2 * wavenumber / (2 * np.pi) * len(turns)
    turn = len(turns) - 1  # a mask, as their number is a power of two
    columns = box[1, first] - box[0, first] + 1
    normal = pose[main, 2]
    radius = CLEAR * edge * np.sqrt((RUN / 2) ** 2 + 0.5)  # of a run of cells, around its middle
    right = sx * (lines - 1) + BESIDE_MM
    per_line, per_row, per_step, per_plane, per_place = 1 / sx, 1 / row, 1 / step, 1 / depth_step, 1 / STEP_MM
    bit = edge / 2097152
    ax, ay, az = bit * pose[0, 0], bit * pose[0, 1], bit * pose[0, 2]  # image's x, y, z of a step of 2^-21 in the cell
    bx, by, bz = bit * pose[1, 0], bit * pose[1, 1], bit * pose[1, 2]
    cx, cy, cz = bit * pose[2, 0], bit * pose[2, 1], bit * pose[2, 2]
    mix_first, mix_second, mix_main = MIX[first], MIX[second], MIX[main]
    touched = np.zeros((parts, 2), np.int64)
    for part in prange(parts):
        field = fields[part]
        corner = np.zeros(3)  # of a cell, in the world
        off = np.full(3, 0.5 * edge)  # of a run's middle from it
        off[main] = 0.0
        low_line, high_line = lines + 2 * pad, 0
        slab = part * SPREAD % parts  # threads take parts in order: so each gets some from everywhere
        for column in range(columns * slab // parts, columns * (slab + 1) // parts):
            i = box[0, first] + column
            for j in range(box[0, second], box[1, second] + 1):
                u, v = i * edge - pose[first, 3], j * edge - pose[second, 3]
                w = -(u * pose[first, 2] + v * pose[second, 2]) / normal  # where the column crosses the image's plane
                x = u * pose[first, 0] + v * pose[second, 0] + w * pose[main, 0]
                y = u * pose[first, 1] + v * pose[second, 1] + w * pose[main, 1]
                level = min(max(int(y / depth_step + 0.5), 0), len(thickness) - 1)
                most = (thickness[level] + 2 * edge) / abs(normal)
                aside, deeper = most * abs(pose[main, 0]) + 2 * edge, most * abs(pose[main, 1]) + 2 * edge
                if y < -deeper or y > deepest + deeper or x < -BESIDE_MM - aside or x > right + aside:
                    continue
                low = int(np.floor((w - most + pose[main, 3]) / edge))
                high = int(np.floor((w + most + pose[main, 3]) / edge))
                corner[first], corner[second] = i * edge, j * edge
                folded = np.uint64(i) * mix_first ^ np.uint64(j) * mix_second
                for start in range(low, high + 1, RUN):
                    corner[main] = (start + RUN / 2) * edge
                    known = uniform_label(flat, where, frame, corner[0] + off[0], corner[1] + off[1], corner[2] + off[2], radius)
                    if known >= 0 and strength[known] == 0:
                        continue
                    for k in range(start, min(start + RUN, high + 1)):
                        w = k * edge - pose[main, 3]
                        bits = mixed(folded ^ np.uint64(k) * mix_main, seed)
                        p, q, r = float(bits & mask), float((bits >> np.uint64(21)) & mask), float((bits >> np.uint64(42)) & mask)
                        y = u * pose[first, 1] + v * pose[second, 1] + w * pose[main, 1] + p * ay + q * by + r * cy
                        z = abs(u * pose[first, 2] + v * pose[second, 2] + w * pose[main, 2] + p * az + q * bz + r * cz)
                        if y < 0 or y >= deepest:
                            continue
                        plane = int(y * per_plane + 0.5)
                        if z >= half[plane]:
                            continue
                        x = u * pose[first, 0] + v * pose[second, 0] + w * pose[main, 0] + p * ax + q * bx + r * cx
                        if x < -BESIDE_MM or x > right:
                            continue
                        label = known
                        if known < 0:
                            corner[main] = k * edge
                            label = label_at(flat, where, frame, corner[0] + p * bit, corner[1] + q * bit, corner[2] + r * bit)
                        f = strength[label]
                        if f == 0:
                            continue
                        line = min(max(int(x * per_line + 0.5), 0), lines - 1)
                        level = min(int(y * per_step), depths - 2)
                        share = np.float32(y * per_step - level)
                        seen = shown[line, level] * (1 - share) + shown[line, level + 1] * share
                        phase = turns[int(seen * to_turn) & turn]
                        value = f * amplitude[line, level] * elevation[plane, int(z * per_place + 0.5)] * phase
                        across = (x - shift[line, level]) * per_line + pad
                        deposit(field, across, seen * per_row, value)
                        low_line, high_line = min(low_line, int(across)), max(high_line, int(across) + 2)
        touched[part] = max(low_line, 0), min(high_line, lines + 2 * pad)
    return touched


@njit(fastmath=True)
def summed(fields, touched):
    """Sum over parts, always in the same order, of the lines that each has touched."""
    total = np.zeros(fields.shape[1:], fields.dtype)
    for part in range(len(fields)):
        for line in range(touched[part, 0], touched[part, 1]):
            for sample in range(total.shape[1]):
                total[line, sample] += fields[part, line, sample]
    return total
