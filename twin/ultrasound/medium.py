"""Scatterers of the tissue, anchored in the world, and their echoes before the point spread.

Each cell of a lattice that fills the world holds one scatterer, whose place in the cell is a hash of the cell and the seed: the
same tissue from every pose, with nothing stored. Places are uniform in the cell, so that the density is even and the lattice
has no echo of its own. A scatterer's length f follows from the backscatter coefficient: `density f² = eta`.
"""

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from twin.ultrasound.beam import OVERSAMPLING, STEP_MM, Beam
from twin.ultrasound.paths import Paths
from twin.ultrasound.solids import Body, label_at
from twin.ultrasound.transducer import Transducer

Field = NDArray[np.complex64]

BESIDE_MM = 2.0  # beside the image, from where scatterers still count
TURNS = 4096  # entries of the table of phases
PARTS = 8  # in which echoes are summed: not the number of threads, on which the rounding would then depend


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
    pieces = _scatter(
        *body.packed(),
        pose,
        _lattice_box(transducer, beam, pose, edge),
        int(np.abs(pose[:3, 2]).argmax()),
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
        beam.depth_step_mm,
        transducer.wavenumber,
        turns,
        np.zeros((PARTS, *field_like(transducer, beam).shape), np.complex64),
    )
    return pieces.sum(axis=0)


def _lattice_box(transducer: Transducer, beam: Beam, pose: NDArray, edge: float) -> NDArray[np.int64]:
    """First and last cell : (2, 3) of the box around the slice."""
    x = np.array([-BESIDE_MM, transducer.width_mm + BESIDE_MM])
    y = np.array([0.0, beam.depth_step_mm * (len(beam.core_mm) - 1)])
    z = np.array([-1.0, 1.0]) * float(beam.core_mm.max())
    corners = np.stack(np.meshgrid(x, y, z), axis=-1).reshape(-1, 3) @ pose[:3, :3].T + pose[:3, 3]
    return np.stack([np.floor(corners.min(axis=0) / edge), np.floor(corners.max(axis=0) / edge)]).astype(np.int64)


@njit(cache=True, inline="always")
def hashed(i, j, k, seed):
    """64 random bits of a cell, by the finaliser of SplitMix64 (Steele, Lea and Flood 2014) over the mixed coordinates."""
    x = np.uint64(i) * np.uint64(0x9E3779B97F4A7C15) ^ np.uint64(j) * np.uint64(0xC2B2AE3D27D4EB4F)
    x = (x ^ np.uint64(k) * np.uint64(0x165667B19E3779F9)) + seed * np.uint64(0xD6E8FEB86659FD93)
    x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return x ^ (x >> np.uint64(31))


@njit(cache=True, inline="always")
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


@njit(cache=True, parallel=True, fastmath=True)
def _scatter(
    flat,
    where,
    frame,
    pose,
    box,
    main,
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
    depth_step,
    wavenumber,
    turns,
    fields,
):
    first, second = (main + 1) % 3, (main + 2) % 3
    lines, depths = shown.shape
    pad = (fields.shape[1] - lines) // 2
    threads = fields.shape[0]
    thickest = half.max()
    deepest = depth_step * (len(half) - 1)
    unit = np.float64(1 / 2097152)
    mask = np.uint64(0x1FFFFF)
    to_turn = 2 * wavenumber / (2 * np.pi) * len(turns)
    columns = box[1, first] - box[0, first] + 1
    normal = pose[main, 2]
    slack = edge
    for thread in prange(threads):
        field = fields[thread]
        cell = np.zeros(3, np.int64)
        place = np.zeros(3)
        for column in range(thread, columns, threads):
            for other in range(box[0, second], box[1, second] + 1):
                cell[first], cell[second] = box[0, first] + column, other
                u = (cell[first] + 0.5) * edge - pose[first, 3]
                v = (cell[second] + 0.5) * edge - pose[second, 3]
                across = u * pose[first, 2] + v * pose[second, 2] - pose[main, 3] * normal
                ends = (-thickest - slack - across) / normal, (thickest + slack - across) / normal
                low, high = int(np.floor(min(ends[0], ends[1]) / edge)), int(np.floor(max(ends[0], ends[1]) / edge))
                for k in range(low, high + 1):
                    w = (k + 0.5) * edge - pose[main, 3]
                    x = u * pose[first, 0] + v * pose[second, 0] + w * pose[main, 0]
                    y = u * pose[first, 1] + v * pose[second, 1] + w * pose[main, 1]
                    if y < 0 or y > deepest or x < -BESIDE_MM or x > sx * (lines - 1) + BESIDE_MM:
                        continue
                    cell[main] = k
                    bits = hashed(cell[0], cell[1], cell[2], seed)
                    place[0] = (cell[0] + (bits & mask) * unit) * edge
                    place[1] = (cell[1] + ((bits >> np.uint64(21)) & mask) * unit) * edge
                    place[2] = (cell[2] + ((bits >> np.uint64(42)) & mask) * unit) * edge
                    a, b, c = place[0] - pose[0, 3], place[1] - pose[1, 3], place[2] - pose[2, 3]
                    y = a * pose[0, 1] + b * pose[1, 1] + c * pose[2, 1]
                    if y < 0 or y >= deepest:
                        continue
                    z = abs(a * pose[0, 2] + b * pose[1, 2] + c * pose[2, 2])
                    plane = int(y / depth_step + 0.5)
                    if z >= half[plane]:
                        continue
                    f = strength[label_at(flat, where, frame, place[0], place[1], place[2])]
                    if f == 0:
                        continue
                    x = a * pose[0, 0] + b * pose[1, 0] + c * pose[2, 0]
                    line = min(max(int(x / sx + 0.5), 0), lines - 1)
                    level = min(int(y / step), depths - 2)
                    part = np.float32(y / step - level)
                    seen = shown[line, level] * (1 - part) + shown[line, level + 1] * part
                    turn = seen * to_turn
                    phase = turns[int(turn) % len(turns)]
                    value = f * amplitude[line, level] * elevation[plane, int(z / STEP_MM + 0.5)] * phase
                    deposit(field, (x - shift[line, level]) / sx + pad, seen / row, value)
    return fields
