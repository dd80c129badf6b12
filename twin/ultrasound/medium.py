"""Scatterers of the tissue, anchored in the world, and their echoes before the point spread.

Each cell of a lattice that fills the world holds one scatterer, whose place in the cell is a hash of the cell and the seed: the
same tissue from every pose, with nothing stored. Places are uniform in the cell, so that the density is even and the lattice
has no echo of its own. A scatterer's length f follows from the backscatter coefficient: `density f² = eta`.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter1d

from recon.compiled import kernel, njit
from recon.geometry import rigid
from twin.displacement import Displacement, carried_along
from twin.ultrasound.beam import STEP_MM, Beam
from twin.ultrasound.echo_field import BESIDE_MM, Field, deposit, field_like, laid, scanner_at, slab
from twin.ultrasound.echo_solids import (
    Body,
    Tissues,
    between,
    is_displaced,
    resting_distance,
    resting_label,
    turned,
)
from twin.ultrasound.grown_layers import layer_normal, layer_slope, strand_at, uneven_at
from twin.ultrasound.scan_lines import on_lines, widening
from twin.ultrasound.sound_paths import GRADIENT_MM, Paths
from twin.ultrasound.transducer import Transducer

Array = NDArray[np.float64]

TURNS = 4096  # entries of the table of phases, a power of two
MIX = np.array([0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9], np.uint64)  # of a cell's coordinates
BITS = 21  # of a hash for each coordinate of the place in a cell
RUN = 8  # cells in a row whose tissue is looked up at once, where no border is near
CLEAR = 1.15  # over a run's reach: distances of bent surfaces are true to second order
X, Y, Z = range(3)  # rows of `Lattice.face_from_world`, and of a column's places in the face's frame
LABEL, ALONG, DEPTH, P, Q, R = range(3, 9)  # the others: tissue, place on the lines, and place in the cell in steps of 2^-BITS
RESTED = 9  # and the two after it: where it rests in the world, of a displaced body
SPECK_MM = 0.05  # scattering length of a calcification of 0.2 mm: of a rigid sphere longer than a wave, half its radius
WIDTH = 0.26  # sine of the angle off the normal, over which fibres lose their brightness; assumed
NEAR_BORDER = -1  # a label that has to be looked up at each place


class _Lattice(NamedTuple):
    """Cells around the slice, in columns along one of the lattice's axes, and the strength of their scatterers."""

    edge_mm: float
    axes: NDArray[np.int64]  # (3,) the one most along the image's x, the other, and the columns': most across the plane
    low: NDArray[np.int64]  # (3,) first cell of the box around the slice
    high: NDArray[np.int64]  # (3,) last cell
    face_from_world: Array  # (3, 4) mm
    half_mm: NDArray[np.float32]  # (m,) half thickness of the slice that a column may meet which crosses the plane at a depth
    strength: NDArray[np.float32]  # (n + 1,) of a scatterer's echo, by label
    speck: np.float32  # of a calcification's
    tissues: Tissues
    turns: Field  # (TURNS,) phases of an echo


class _Columns(NamedTuple):
    """Columns of cells, side by side, and room for the scatterers of one: each thread's own."""

    first: int  # of them, along the lattice's first axis
    end: int
    places: Array  # (12, m) of its scatterers in the slice
    cell: NDArray[np.int64]  # (3,) its place on the lattice


def scatter(body: Body, transducer: Transducer, beam: Beam, paths: Paths, world_from_image: Array, seed: int) -> Field:
    """Demodulated echoes of the tissue's scatterers, weighed across the plane, before the point spread in the plane."""
    scanner = scanner_at(transducer, beam, paths, world_from_image, seed)
    lattice = _lattice(body, transducer, beam, scanner.world_from_face)
    first, solids = lattice.axes[0], body.packed()
    reach = lattice.half_mm.max() / solids.field.stretch / lattice.edge_mm
    most = 2 * RUN + int(4 * (reach + 2))  # cells of a column; its cosine is 0.57 at least

    def lay(field: Field, part: int) -> tuple[int, int]:
        begin, end = slab(part, int(lattice.high[first] - lattice.low[first] + 1))
        columns = _Columns(lattice.low[first] + begin, lattice.low[first] + end, np.empty((12, most)), np.zeros(3, np.int64))
        return _scatter(field, columns, solids, lattice, scanner, beam, paths)

    return laid(lay, field_like(transducer, beam))


def _lattice(body: Body, transducer: Transducer, beam: Beam, pose: Array) -> _Lattice:
    edge = transducer.scatterers_per_mm3 ** (-1 / 3)
    strength = np.sqrt(body.scattering() / transducer.scatterers_per_mm3) * transducer.wavelength_mm
    turns = np.exp(2j * np.pi * np.arange(TURNS) / TURNS).astype(np.complex64)
    axes = _axes(pose)
    low, high = _box(transducer, beam, pose, edge, body.field)
    face_from_world = np.ascontiguousarray(rigid.invert(pose)[:3])
    half = _half_thickness(beam, pose, axes[2], edge, transducer.face is not None)
    speck = np.float32(SPECK_MM * transducer.wavelength_mm)
    tissues = body.acoustics(transducer.frequency_mhz)
    return _Lattice(edge, axes, low, high, face_from_world, half, strength.astype(np.float32), speck, tissues, turns)


def _axes(pose: Array) -> NDArray[np.int64]:
    across = int(np.abs(pose[:3, 2]).argmax())
    along, other = sorted({0, 1, 2} - {across}, key=lambda axis: -abs(pose[axis, 0]))
    return np.array([along, other, across])


def _box(
    transducer: Transducer, beam: Beam, pose: Array, edge: float, field: Displacement
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """First and last cell of the box around the slice."""
    deepest = beam.depth_step_mm * (len(beam.core_mm) - 1)
    x, y = np.array([-BESIDE_MM, transducer.width_mm + BESIDE_MM]), np.array([0.0, deepest])
    if (face := transducer.face) is not None:
        aside = face.chord_mm / 2 * (1 + deepest * face.bend) + BESIDE_MM
        x, y = np.array([-aside, aside]), np.array([-face.sagitta_mm - BESIDE_MM, deepest])
    z = np.array([-1.0, 1.0]) * float(beam.core_mm.max())
    corners = np.stack(np.meshgrid(x, y, z), axis=-1).reshape(-1, 3) @ pose[:3, :3].T + pose[:3, 3]
    farthest = np.abs(field.moved).max(axis=(0, 1, 2), initial=0)
    low, high = (corners.min(axis=0) - farthest) / edge, (corners.max(axis=0) + farthest) / edge
    return np.floor(low).astype(np.int64), np.floor(high).astype(np.int64)


def _half_thickness(beam: Beam, pose: Array, main: int, edge: float, fanned: bool) -> NDArray[np.float32]:
    tilt = float(np.hypot(pose[main, 0] if fanned else 0, pose[main, 1]) / abs(pose[main, 2]))
    rows = int(np.ceil(((float(beam.core_mm.max()) + 2 * edge) * tilt + 2 * edge) / beam.depth_step_mm))
    return maximum_filter1d(beam.core_mm, 2 * rows + 1)


@njit(inline="always")
def hashed(i, j, k, seed):
    """64 random bits of a cell, by the finaliser of SplitMix64 (Steele, Lea and Flood 2014) over the mixed coordinates."""
    return _mix(np.uint64(i) * MIX[0] ^ np.uint64(j) * MIX[1] ^ np.uint64(k) * MIX[2], seed)


@njit(inline="always")
def _mix(x, seed):
    """64 random bits of folded coordinates."""
    x = x + seed * np.uint64(0xD6E8FEB86659FD93)
    x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return x ^ (x >> np.uint64(31))


@kernel(fastmath=True)
def _scatter(field, columns, solids, lattice, scanner, beam, paths):
    """Lay the echoes of all scatterers in the slice of some columns; the first line that they touch and the end."""
    places, cell = columns.places, columns.cell
    low, high = len(field), 0
    for i in range(columns.first, columns.end):
        cell[lattice.axes[0]] = i
        for j in range(lattice.low[lattice.axes[1]], lattice.high[lattice.axes[1]] + 1):
            cell[lattice.axes[1]] = j
            found = _places_in_slice(places, cell, solids, lattice, scanner, beam, paths)
            left, right = _lay_echoes(field, places, found, solids, lattice, scanner, beam, paths)
            low, high = min(low, left), max(high, right)
    return low, high


@njit(inline="always")
def _places_in_slice(places, cell, solids, lattice, scanner, beam, paths):
    """Find a column's scatterers in the slice: fills the rows of `places`; their number."""
    right = scanner.line_mm * (len(paths.labels) - 1) + BESIDE_MM
    low, high = _cells_in_slice(cell, solids, lattice, beam, scanner, right)
    displaced = is_displaced(solids)
    found, per_step = 0, 1 / beam.depth_step_mm
    for start in range(low, high + 1, RUN):
        label = _label_of_run(cell, start, solids, lattice)
        if label >= 0 and lattice.strength[label] == 0:
            continue
        _hash_places(places, found, cell, start, lattice, scanner.seed)
        end = found + min(RUN, high + 1 - start)
        if displaced:
            _carry(places, found, end, solids.field, lattice.face_from_world, scanner.world_from_face)
        for n in range(found, end):
            x, y, z = places[X, n], places[Y, n], places[Z, n]
            along, depth = on_lines(x, y, scanner.bend, scanner.middle_mm)
            inside = 0 <= depth < scanner.deepest_mm and -BESIDE_MM <= along <= right
            if inside and abs(z) < beam.core_mm[int(depth * per_step + 0.5)]:
                places[X, found], places[Y, found], places[Z, found], places[LABEL, found] = x, y, z, label
                places[ALONG, found], places[DEPTH, found] = along, depth
                places[P, found], places[Q, found], places[R, found] = places[P, n], places[Q, n], places[R, n]
                if displaced:
                    for row in range(RESTED, RESTED + 3):
                        places[row, found] = places[row, n]
                found += 1
    return found


@kernel
def _carry(places, first, end, field, face_from_world, world_from_face):
    """Carry scatterers from where they rest to where they are, in the face's frame."""
    to = face_from_world
    for n in range(first, end):
        rx, ry, rz = _in_world(world_from_face, places[X, n], places[Y, n], places[Z, n])
        places[RESTED, n], places[RESTED + 1, n], places[RESTED + 2, n] = rx, ry, rz
        x, y, z = carried_along(field.moved, field.first, field.per_mm, rx, ry, rz)
        for axis in range(3):
            places[axis, n] = to[axis, X] * x + to[axis, Y] * y + to[axis, Z] * z + to[axis, 3]


@kernel
def _crossing(field, to, axes, u, v, w):
    """Where a column of a displaced body crosses the image's plane, along it, and the crossing in the face's frame."""
    first, second, main = axes[0], axes[1], axes[2]
    px = py = 0.0
    for _ in range(4):
        rx = u if first == X else v if second == X else w
        ry = u if first == Y else v if second == Y else w
        rz = u if first == Z else v if second == Z else w
        x, y, z = carried_along(field.moved, field.first, field.per_mm, rx, ry, rz)
        px = to[X, X] * x + to[X, Y] * y + to[X, Z] * z + to[X, 3]
        py = to[Y, X] * x + to[Y, Y] * y + to[Y, Z] * z + to[Y, 3]
        w -= (to[Z, X] * x + to[Z, Y] * y + to[Z, Z] * z + to[Z, 3]) / to[Z, main]
    return w, px, py


@njit(inline="always")
def _cells_in_slice(cell, solids, lattice, beam, scanner, right):
    """First and last cell of a column that may hold scatterers in the slice; the last before the first if none may."""
    first, second, main = lattice.axes[0], lattice.axes[1], lattice.axes[2]
    to, edge = lattice.face_from_world, lattice.edge_mm
    u, v, normal = cell[first] * edge, cell[second] * edge, to[Z, main]
    w = -(u * to[Z, first] + v * to[Z, second] + to[Z, 3]) / normal  # where the column crosses the image's plane
    x = u * to[X, first] + v * to[X, second] + w * to[X, main] + to[X, 3]
    y = u * to[Y, first] + v * to[Y, second] + w * to[Y, main] + to[Y, 3]
    if is_displaced(solids):
        w, x, y = _crossing(solids.field, to, lattice.axes, u, v, w)
        normal *= solids.field.stretch
    along, depth = on_lines(x, y, scanner.bend, scanner.middle_mm)
    half = lattice.half_mm[min(max(int(depth / beam.depth_step_mm + 0.5), 0), len(lattice.half_mm) - 1)]
    most = (half + 2 * edge) / abs(normal)
    aside, deeper = most * abs(to[X, main]) + 2 * edge, most * abs(to[Y, main]) + 2 * edge
    if scanner.bend > 0:  # lines run to all sides
        aside = deeper = aside + deeper
    if depth < -deeper or depth > scanner.deepest_mm + deeper or along < -BESIDE_MM - aside or along > right + aside:
        return 0, -1
    before = edge * (min(to[Z, 0], 0.0) + min(to[Z, 1], 0.0) + min(to[Z, 2], 0.0))  # how far a cell reaches beside its corner
    beyond = edge * (max(to[Z, 0], 0.0) + max(to[Z, 1], 0.0) + max(to[Z, 2], 0.0))
    ends = (-half - beyond) / normal, (half - before) / normal
    return int(np.ceil((w + min(ends[0], ends[1])) / edge)), int(np.floor((w + max(ends[0], ends[1])) / edge))


@njit(inline="always")
def _label_of_run(cell, start, solids, lattice):
    """Label of a run of cells along a column, or NEAR_BORDER if a border may lie in one."""
    edge, main = lattice.edge_mm, lattice.axes[2]
    x = edge * (start + RUN / 2 if main == X else cell[X] + 0.5)
    y = edge * (start + RUN / 2 if main == Y else cell[Y] + 0.5)
    z = edge * (start + RUN / 2 if main == Z else cell[Z] + 0.5)
    radius = CLEAR * edge * np.sqrt((RUN / 2) ** 2 + 0.5)
    if solids.layers[0] < solids.layers[1]:
        return NEAR_BORDER  # borders are everywhere
    label = 0
    for solid in range(len(solids.grid)):
        d = resting_distance(solids, solid, x, y, z)
        if abs(d) <= radius:
            return NEAR_BORDER
        if d < 0:
            label = solid + 1
    return label


@njit(inline="always")
def _hash_places(places, found, cell, start, lattice, seed):
    """Places of the scatterers of a run of cells, after those that are found already."""
    first, second, main = lattice.axes[0], lattice.axes[1], lattice.axes[2]
    to, edge = lattice.face_from_world, lattice.edge_mm
    folded = np.uint64(cell[first]) * MIX[first] ^ np.uint64(cell[second]) * MIX[second]
    mix, mask, bit = MIX[main], np.uint64(2**BITS - 1), edge / 2**BITS
    p, q, r = places[P, found : found + RUN], places[Q, found : found + RUN], places[R, found : found + RUN]
    for n in range(RUN):
        bits = _mix(folded ^ np.uint64(start + n) * mix, seed)
        p[n], q[n], r[n] = bits & mask, (bits >> np.uint64(BITS)) & mask, (bits >> np.uint64(2 * BITS)) & mask
    for axis in range(3):
        corner = edge * (cell[first] * to[axis, first] + cell[second] * to[axis, second]) + to[axis, 3]
        onwards, a, b, c = edge * to[axis, main], bit * to[axis, X], bit * to[axis, Y], bit * to[axis, Z]
        place = places[axis, found : found + RUN]
        for n in range(RUN):
            place[n] = corner + (start + n) * onwards + p[n] * a + q[n] * b + r[n] * c


@njit(inline="always")
def _lay_echoes(field, places, found, solids, lattice, scanner, beam, paths):
    """Lay the echoes of a column's scatterers; the first line they touch and the end."""
    lines, depths = paths.labels.shape
    pad = (len(field) - lines) // 2
    to_turn = 2 * scanner.wavenumber / (2 * np.pi) * TURNS
    per_line, per_sample, per_level = 1 / scanner.line_mm, 1 / scanner.sample_mm, 1 / paths.step_mm
    per_row, per_column = 1 / beam.depth_step_mm, 1 / STEP_MM
    first, end = len(field), 0
    for n in range(found):
        along, y, z, label = places[ALONG, n], places[DEPTH, n], places[Z, n], int(places[LABEL, n])
        if label == NEAR_BORDER:
            wx, wy, wz = _resting_place(solids, places, n, scanner.world_from_face)
            label = resting_label(solids, wx, wy, wz, places[P, n] / 2 ** (BITS - 1) - 1)
        strength = lattice.strength[label]
        if solids.layers[0] < solids.layers[1]:
            strength = _uneven_strength(solids, lattice, label, places, n, scanner)
        if strength == 0:
            continue
        line, level = min(max(int(along * per_line + 0.5), 0), lines - 1), min(int(y * per_level), depths - 2)
        seen = between(paths.shown_mm[line, level], paths.shown_mm[line, level + 1], y * per_level - level)
        weight = beam.elevation[int(y * per_row + 0.5), int(abs(z) * per_column + 0.5)]
        value = strength * paths.amplitude[line, level] * weight
        across = (along - paths.shift_mm[line, level] / widening(y, scanner.bend)) * per_line + pad
        deposit(field, across, seen * per_sample, value * lattice.turns[int(seen * to_turn) & (TURNS - 1)])
        first, end = min(first, int(across)), max(end, int(across) + 2)
    return first, end


@njit(inline="always")
def _is_speck(places, n, lattice, label, seed):
    """Whether a scatterer is a calcification."""
    bits = np.uint64(places[P, n]) ^ np.uint64(places[Q, n]) << np.uint64(BITS) ^ np.uint64(places[R, n]) << np.uint64(2 * BITS)
    chance = (_mix(bits, seed) >> np.uint64(11)) / 9007199254740992.0
    return chance < lattice.tissues.specks[label] * lattice.edge_mm**3


@njit(inline="always")
def _in_world(pose, x, y, z):
    """A point of the face's frame in the world."""
    return (
        pose[0, 0] * x + pose[0, 1] * y + pose[0, 2] * z + pose[0, 3],
        pose[1, 0] * x + pose[1, 1] * y + pose[1, 2] * z + pose[1, 3],
        pose[2, 0] * x + pose[2, 1] * y + pose[2, 2] * z + pose[2, 3],
    )


@njit(inline="always")
def _resting_place(solids, places, n, pose):
    """Where a scatterer rests in the world."""
    if is_displaced(solids):
        return places[RESTED, n], places[RESTED + 1, n], places[RESTED + 2, n]
    return _in_world(pose, places[X, n], places[Y, n], places[Z, n])


@njit(inline="always")
def _uneven_strength(solids, lattice, label, places, n, scanner):
    """Strength of a scatterer of uneven tissue, of strands and fibres that lie along a layer's faces, or of a calcification."""
    if lattice.tissues.specks[label] > 0 and _is_speck(places, n, lattice, label, scanner.seed):
        return lattice.speck
    value = lattice.strength[label]
    if value == 0:
        return value
    pose, fibres, spread = scanner.world_from_face, lattice.tissues.fibres[label], lattice.tissues.strands[label]
    wx, wy, wz = _resting_place(solids, places, n, pose)
    grown = solids.grown
    value *= uneven_at(grown.uneven, grown.first, grown.per_mm, wx, wy, wz)
    if spread > 0:  # of the tissue's mean power
        strand = strand_at(grown.strata, grown.strands, grown.first, grown.per_mm, wx, wy, wz)
        value *= np.exp(np.float32(spread * (strand - spread)))
    if fibres > 0 and solids.layers[0] < label <= solids.layers[1]:
        value *= _fibres(solids, label - 1, pose, wx, wy, wz, fibres)
    return value


@njit(inline="always")
def _fibres(solids, solid, pose, x, y, z, fibres):
    """Amplitude of fibres along a layer's faces, brightest where sound meets them squarely: a Gaussian of WIDTH."""
    layer, grown = solid - solids.layers[0], solids.grown
    if grown.half_mm[layer] > 0:  # sheets bend within a cell
        nx, ny, nz = layer_normal(grown.distance, grown.half_mm, grown.first, grown.per_mm, layer, x, y, z, GRADIENT_MM)
    else:
        nx, ny, nz = layer_slope(grown.distance, grown.first, grown.per_mm, layer, x, y, z)
    nx, ny, nz = turned(solids, nx, ny, nz, x, y, z)
    cosine = nx * pose[0, 1] + ny * pose[1, 1] + nz * pose[2, 1]
    square = np.float32((cosine * cosine - 1) / (2 * WIDTH**2))
    return np.exp(np.float32(fibres) * np.exp(square))
