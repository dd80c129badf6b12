"""Echoes of surfaces and wires: Kirchhoff's integral over small facets, with the phase of each.

The sum over facets does what mirrors do: a surface square to the beam is bright, a tilted one sends its echo past the aperture,
a curved one is seen where it is square. What its roughness takes from the coherent echo it scatters to all sides. Facets so
tilted that their phases alias reach no aperture, and are left out of the coherent sum.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from recon.compiled import kernel, njit
from twin.trilinear import cell_at
from twin.ultrasound import borders
from twin.ultrasound.beam import STEP_MM, Beam
from twin.ultrasound.borders import BUNDLE, NEAR, START, STOP
from twin.ultrasound.echo_field import BESIDE_MM, Field, deposit, field_like, laid, scanner_at, slab
from twin.ultrasound.echo_solids import (
    Body,
    Wire,
    own_distance,
    resting_distance,
    resting_label,
    resting_place,
    resting_step,
    shrinking,
    turned,
)
from twin.ultrasound.grown_layers import in_cell, patch_at
from twin.ultrasound.medium import hashed
from twin.ultrasound.scan_lines import lines_of, on_lines, widening, world_from_lines
from twin.ultrasound.sound_paths import Paths, reflection, resting_normal, table_at
from twin.ultrasound.transducer import Transducer

Array = NDArray[np.float64]

SUBLINES = 2  # rays a line
ACROSS_MM = 0.2  # between rays across the plane
STEPS_MM = (0.15, 2.5)  # of the march, least and most; less than the margin of the solids' grids
GLANCING = 0.05  # cosine, below which a facet sends nothing back
PATCH_MM = 0.1  # over which roughness keeps its height, about half a wavelength
ALONG_MM = 0.05  # between points of a wire
RINGS = 3  # echoes from within a wire
TAPER = (2.2, 4.4)  # rad of phase from line to line: coherent echoes fade; more than apertures accept, less than aliases in them


FROM, TO, DEPTH = range(3)  # columns of a ray's crossings: labels before and behind the border, mm
CROSSINGS = 256  # of a ray, at most
BEFORE, AFTER, LAST = range(3)  # rows of the solids' distances, of a step of the march and at the end of a span
SURE = 0.9  # of a distance: no border is nearer
BONE = 0.4  # reflection, from which a border in grown tissue is whole; those of soft tissues are patchy
BESIDE_BORDER_MM = 0.05  # on either side of which tissues are looked up


class Rays(NamedTuple):
    """Places of rays on the probe's face, in the image's frame, and room for the way of one: each thread's own."""

    first: int  # number of the first of them along the array, of all
    along: Array  # (n,) mm
    across: Array  # (m,) mm
    poses: Array  # (n, 4, 4) of lines through them; see `scan_lines.world_from_lines`
    distances: Array  # (3, k) mm to the solids, BEFORE and AFTER a step, and LAST
    crossings: Array  # (CROSSINGS, 3) of borders


class _Ray(NamedTuple):
    """One of them, down a line: its place on the face, and its start and direction in the world."""

    along: float
    across: float
    x: float
    y: float
    z: float
    dx: float
    dy: float
    dz: float


class _Strand(NamedTuple):
    """Points of a wire, and the echoes of each."""

    world: Array  # (n, 3) mm
    front: Array  # (n, 3) mm: along the face, depth, and across the plane
    rise_mm: Array  # (n,) from point to point, into the depth
    roughness: float  # mm
    echoes: Array  # (m, 2) mm behind the front, and strength


def surface_echoes(body: Body, transducer: Transducer, beam: Beam, paths: Paths, world_from_image: Array, seed: int) -> Field:
    """Demodulated echoes of all borders of tissues in the slice, before the point spread in the plane."""
    if not body.solids:
        return field_like(transducer, beam)
    scanner = scanner_at(transducer, beam, paths, world_from_image, seed)
    half, lines = float(beam.half_mm.max()), lines_of(transducer)
    across = ACROSS_MM * np.arange(-int(half / ACROSS_MM), int(half / ACROSS_MM) + 1)
    beside = int(SUBLINES * BESIDE_MM / lines.pitch_mm)  # rays beside the image, or its edges would diffract
    along = ((np.arange(-beside, SUBLINES * lines.count + beside) + 0.5) / SUBLINES - 0.5) * lines.pitch_mm
    poses = world_from_lines(lines, scanner.world_from_face, along)
    first = _first_depths(transducer, beam, across)
    spans = borders.spans(body, lines, scanner.world_from_face, along, across, first, scanner.deepest_mm)
    tissues = body.acoustics(transducer.frequency_mhz)
    solids, outer = body.packed(), (paths.shift_mm.max(), paths.shift_mm.min())

    def lay(field: Field, part: int) -> tuple[int, int]:
        begin, end = slab(part, len(along))
        rays = Rays(begin, along[begin:end], across, poses[begin:end], np.zeros((3, len(solids.grid))), np.empty((CROSSINGS, 3)))
        _border_echoes(field, solids, tissues, rays, spans, scanner, beam, paths)
        left, right = (along[[begin, end - 1]] - outer) / lines.pitch_mm + (len(field) - len(paths.labels)) // 2
        return int(np.floor(left)) - 1, int(np.floor(right)) + 3

    return laid(lay, field_like(transducer, beam))


def _first_depths(transducer: Transducer, beam: Beam, across: Array) -> Array:
    """Depths, mm, from which rays across the plane, or the repeats of what they meet, are in the slice : as `across`."""
    thick = beam.half_mm > np.abs(across)[:, None]
    first = np.where(thick.any(axis=1), thick.argmax(axis=1), len(beam.half_mm))
    return np.maximum(first - 1, 0) * beam.depth_step_mm / (transducer.reverberations + 1)


def wire_echoes(body: Body, transducer: Transducer, beam: Beam, paths: Paths, world_from_image: Array, seed: int) -> Field:
    """Demodulated echoes of wires in the slice, before the point spread in the plane.

    A wire of radius a, met square, reflects as a strip of the mirror `sqrt(a lambda / 2)` wide: Kirchhoff's integral round its
    front, by stationary phase. Along its length the phases of its points make it fade when it is tilted against the beam. A few
    echoes from its back follow, as it is a resonator. What comes again from the probe's face is too weak to be seen: a wire sends
    little back, and from half the depth that the scanner focuses on.
    """
    field = field_like(transducer, beam)
    scanner = scanner_at(transducer, beam, paths, world_from_image, seed)
    for wire in body.wires:
        _lay_wire(field, _strand(wire, body.medium.impedance, transducer, scanner.world_from_face), scanner, beam, paths)
    return field


def _strand(wire: Wire, around: float, transducer: Transducer, world_from_face: Array) -> _Strand:
    """A wire's points, every ALONG_MM, in a medium of an impedance."""
    face_from_world, lines = np.linalg.inv(world_from_face), lines_of(transducer)
    length = float(np.linalg.norm(wire.ends[1] - wire.ends[0]))
    count = max(int(length / ALONG_MM), 2)
    share = (np.arange(count) + 0.5)[:, None] / count
    points = wire.ends[0] * (1 - share) + wire.ends[1] * share
    direction = (wire.ends[1] - wire.ends[0]) / length @ face_from_world[:3, :3].T
    local = points @ face_from_world[:3, :3].T + face_from_world[:3, 3]
    along, depth = on_lines.py_func(local[:, 0], local[:, 1], lines.bend, lines.middle_mm)
    angle = (along - lines.middle_mm) * lines.bend
    rise = (np.sin(angle) * direction[0] + np.cos(angle) * direction[1]) * length / count
    front = np.column_stack([along, depth - wire.radius, local[:, 2]])
    bounce = (wire.tissue.impedance - around) / (wire.tissue.impedance + around)
    ring = 2 * wire.radius * transducer.assumed_speed / wire.tissue.speed
    echoes = [(0.0, bounce)] + [(ring * n, -bounce * (1 - bounce**2) * bounce ** (2 * n - 2)) for n in range(1, RINGS + 1)]
    strength = np.sqrt(wire.radius * transducer.wavelength_mm / 2) * length / count
    return _Strand(points, front, rise, wire.tissue.roughness, np.array(echoes) * [1, strength])


@njit(inline="always")
def _sinc(x):
    return np.sin(x) / x if abs(x) > 1e-4 else 1.0


@njit(inline="always")
def _turned(phase):
    """A complex number of length 1."""
    return complex(np.cos(phase), np.sin(phase))


@njit(inline="always")
def _unaliased(phase):
    """Weight of a coherent facet, by the phase between its line and the next: 1 for all that apertures accept."""
    share = (abs(phase) - TAPER[0]) / (TAPER[1] - TAPER[0])
    if share >= 1:
        return 0.0
    return 1.0 if share <= 0 else np.cos(np.pi / 2 * share) ** 2


@njit(inline="always")
def _phase_of_patch(x, y, z, seed):
    bits = hashed(int(np.floor(x / PATCH_MM)), int(np.floor(y / PATCH_MM)), int(np.floor(z / PATCH_MM)), seed)
    return 2 * np.pi * (bits >> np.uint64(11)) / 9007199254740992.0


@kernel(fastmath=True)
def _border_echoes(field, solids, tissues, rays, spans, scanner, beam, paths):
    """Lay the echoes of all borders that some rays meet in the slice."""
    for i in range(len(rays.along)):
        for j in range(len(rays.across)):
            ray = _ray(rays.along[i], rays.across[j], rays.poses[i])
            bundle = (rays.first + i) // BUNDLE[0], j // BUNDLE[1]
            met = _crossings_of(ray, rays.crossings, rays.distances, solids, spans, bundle, beam, scanner.repeats)
            for n in range(met):
                _lay_facet(field, ray, rays.poses[i], rays.crossings[n], solids, tissues, scanner, beam, paths)


@njit(inline="always")
def _ray(along, across, pose):
    return _Ray(
        along,
        across,
        pose[0, 2] * across + pose[0, 3],
        pose[1, 2] * across + pose[1, 3],
        pose[2, 2] * across + pose[2, 3],
        pose[0, 1],
        pose[1, 1],
        pose[2, 1],
    )


@njit(inline="always")
def _crossings_of(ray, crossings, distances, solids, spans, bundle, beam, repeats):
    """March a ray through the spans of its bundle; the number of borders between tissues that it crosses in the slice."""
    met = 0
    for span in range(spans.counts[bundle]):
        start, stop = spans.depths[bundle[0], bundle[1], span, START], spans.depths[bundle[0], bundle[1], span, STOP]
        sides = spans.sides[bundle[0], bundle[1], span]
        _measure(ray, stop, solids, sides, distances)
        for solid in range(len(sides)):
            distances[LAST, solid] = distances[AFTER, solid]
        t, near = start, _measure(ray, start, solids, sides, distances)
        here = _tissue(distances)
        while t < stop and not _clear_to_end(sides, distances, stop - t):
            stride = min(max(near, STEPS_MM[0]), stop - t + 1e-6)
            t += stride
            near = _measure(ray, t, solids, sides, distances)
            there = _tissue(distances)
            if there != here and met < CROSSINGS and _in_slice(t, ray.across, repeats, beam):
                solid = max(here, there) - 1
                before, after = distances[BEFORE, solid], distances[AFTER, solid]
                part = before / (before - after) if before != after else 0.5
                crossings[met, FROM], crossings[met, TO] = here, there
                crossings[met, DEPTH] = t - stride + min(max(part, 0.0), 1.0) * stride
                met += 1
            here = there
    return met


@njit(inline="always")
def _measure(ray, t, solids, sides, distances):
    """Measure the distances at a depth of a ray; returns a step that crosses no border."""
    near, (first, end), grown = STEPS_MM[1], solids.layers, solids.grown
    x, y, z = resting_place(solids, ray.x + ray.dx * t, ray.y + ray.dy * t, ray.z + ray.dz * t)
    cell = cell_at(grown.first, grown.per_mm, grown.distance.shape, x, y, z)
    for solid in range(len(sides)):
        distances[BEFORE, solid] = distances[AFTER, solid]
        distances[AFTER, solid] = sides[solid]  # its sign counts, where the span has none of its borders
        if sides[solid] == NEAR:
            layered = first <= solid < end  # all in one cell
            own = in_cell(grown.distance, grown.half_mm, cell, solid - first) if layered else own_distance(solids, solid, x, y, z)
            d = shrinking(solids) * own
            distances[AFTER, solid] = d
            near = min(near, SURE * abs(d))
    return near


@njit(inline="always")
def _tissue(distances):
    """Label at the place that distances were measured last."""
    label = 0
    for solid in range(distances.shape[1]):
        if distances[AFTER, solid] <= 0:
            label = solid + 1
    return label


@njit(inline="always")
def _clear_to_end(sides, distances, left_mm):
    """Whether the distances here and at a span's end are too long for a border in between; far ones may be a grid's end."""
    for solid in range(len(sides)):
        if sides[solid] == NEAR:
            here, last = distances[AFTER, solid], distances[LAST, solid]
            certain = min(SURE * abs(here), STEPS_MM[1]) + min(SURE * abs(last), STEPS_MM[1])
            if (here < 0) != (last < 0) or certain < left_mm:
                return False
    return True


@njit(inline="always")
def _in_slice(y, z, repeats, beam):
    """Whether a place across the image's plane lies in the slice, at its depth or at that of one of its repeats."""
    for order in range(1, repeats + 2):
        row = min(int(order * y / beam.depth_step_mm + 0.5), len(beam.half_mm) - 1)
        if abs(z) < beam.half_mm[row]:
            return True
    return False


@njit(inline="always")
def _at_rest(ray, t, solids):
    """A ray at a depth as it was at rest: its place there, and its steps."""
    x, y, z = resting_place(solids, ray.x + ray.dx * t, ray.y + ray.dy * t, ray.z + ray.dz * t)
    dx, dy, dz = resting_step(solids, ray.dx, ray.dy, ray.dz, x, y, z)
    return _Ray(ray.along, ray.across, x, y, z, dx, dy, dz)


@njit(inline="always")
def _facet(ray, rested, y, solids, solid, pose):
    """Depth of a solid's border on a ray, cosine to its normal, and slopes along the array and across the plane."""
    nx, ny, nz = resting_normal(solids, solid, rested.x, rested.y, rested.z)
    onwards = nx * rested.dx + ny * rested.dy + nz * rested.dz
    nx, ny, nz = turned(solids, nx, ny, nz, rested.x, rested.y, rested.z)
    cosine = nx * ray.dx + ny * ray.dy + nz * ray.dz
    square = max(abs(cosine), 1e-6)
    miss = resting_distance(solids, solid, rested.x, rested.y, rested.z)
    depth = y - miss / onwards if abs(miss) < 0.1 and abs(cosine) > GLANCING else y
    slope_x = (nx * pose[0, 0] + ny * pose[1, 0] + nz * pose[2, 0]) / square
    slope_z = (nx * pose[0, 2] + ny * pose[1, 2] + nz * pose[2, 2]) / square
    return depth, square, slope_x, slope_z


@kernel
def _label_on(rested, solids, t):
    """Label some mm on along a ray at rest."""
    return resting_label(solids, rested.x + rested.dx * t, rested.y + rested.dy * t, rested.z + rested.dz * t)


@njit(inline="always")
def _lay_facet(field, ray, pose, crossing, solids, tissues, scanner, beam, paths):
    """Lay the echo of a border's facet, and its repeats between border and face."""
    here, there, solid = int(crossing[FROM]), int(crossing[TO]), int(max(crossing[FROM], crossing[TO])) - 1
    depth = crossing[DEPTH]
    rested = _at_rest(ray, depth, solids)
    y, square, slope_x, slope_z = _facet(ray, rested, depth, solids, solid, pose)
    if square <= GLANCING:
        return
    if solids.layers[0] < solids.layers[1]:  # borders without an echo of their own may lie as near
        beside = BESIDE_BORDER_MM / square
        here, there = _label_on(rested, solids, y - beside - depth), _label_on(rested, solids, y + beside - depth)
        if here == there:
            return
    lines, depths = paths.labels.shape
    line = min(max(int(ray.along / scanner.line_mm + 0.5), 0), lines - 1)
    level = max(int(y / paths.step_mm) - 1, 0)  # before the border, where delays have a kink
    speed, impedance = tissues.speed, tissues.impedance
    seen = paths.shown_mm[line, level] + (y - level * paths.step_mm) * scanner.assumed_speed / speed[here]
    left = paths.amplitude[line, level]
    r = reflection(impedance[here], impedance[there], speed[here], speed[there], square)
    whole = 1.0
    if solids.layers[0] < solids.layers[1] and abs(r) < BONE:
        miss = y - depth
        x0, y0, z0 = rested.x + rested.dx * miss, rested.y + rested.dy * miss, rested.z + rested.dz * miss
        whole = patch_at(solids.grown.strands, x0, y0, z0)
    mirror = np.exp(-0.5 * (2 * scanner.wavenumber * tissues.roughness[solid + 1] * square) ** 2)
    line_mm = scanner.line_mm * widening(y, scanner.bend)
    area, carrier = line_mm / SUBLINES * ACROSS_MM, _turned(2 * scanner.wavenumber * seen)
    strength, once = area * left * carrier, r * scanner.face_reflection * left * carrier
    last, deepest = field.shape[1] * scanner.sample_mm, min(scanner.deepest_mm, paths.step_mm * (depths - 2))
    for order in range(1, scanner.repeats + 2):
        if order * seen >= last or order * y >= deepest:
            break
        row = min(int(order * y / beam.depth_step_mm + 0.5), len(beam.half_mm) - 1)
        if abs(ray.across) < beam.half_mm[row]:
            value = complex(r * mirror ** (order * order))
            value *= _unaliased(2 * order * scanner.wavenumber * slope_x * line_mm)
            value *= _unaliased(2 * order * scanner.wavenumber * slope_z * ACROSS_MM)
            if order == 1 and mirror < 1:
                phase = _phase_of_patch(rested.x, rested.y, rested.z, scanner.seed)
                value += _scatter(mirror, impedance[here], impedance[there], square, area, scanner) * _turned(phase)
            if value != 0:
                echo = np.complex64(whole * strength * value) * beam.elevation[row, int(abs(ray.across) / STEP_MM + 0.5)]
                beside = paths.shift_mm[line, min(int(order * y / paths.step_mm), depths - 1)]
                across = (ray.along - beside / widening(order * y, scanner.bend)) / scanner.line_mm + (len(field) - lines) // 2
                deposit(field, across, order * seen / scanner.sample_mm, echo)
        strength *= once


@njit(inline="always")
def _scatter(mirror, z1, z2, square, area, scanner):
    """Amplitude that roughness sends to all sides, by Lambert's law: cos / pi of the power a steradian."""
    diffuse = 2 * np.pi / scanner.wavenumber / np.sqrt(np.pi * area)
    return (z2 - z1) / (z2 + z1) * diffuse * np.sqrt(1 - mirror * mirror) * np.sqrt(square)


@njit
def _lay_wire(field, strand, scanner, beam, paths):
    """Lay the echoes of a wire's points."""
    lines, depths = paths.labels.shape
    pad = (len(field) - lines) // 2
    deepest, last = paths.step_mm * (depths - 2), field.shape[1] * scanner.sample_mm
    smooth = np.exp(-0.5 * (2 * scanner.wavenumber * strand.roughness) ** 2)
    rough = np.sqrt(1 - smooth * smooth)
    for k in range(len(strand.front)):
        x, y, z = strand.front[k]
        if not (0 <= y < deepest and -pad <= x / scanner.line_mm <= lines - 1 + pad):
            continue
        row = min(int(y / beam.depth_step_mm + 0.5), len(beam.half_mm) - 1)
        if abs(z) >= beam.half_mm[row]:
            continue
        line = min(max(int(x / scanner.line_mm + 0.5), 0), lines - 1)
        seen = table_at(paths.shown_mm, line, y, paths.step_mm)
        patch = _phase_of_patch(strand.world[k, 0], strand.world[k, 1], strand.world[k, 2], scanner.seed)
        part = smooth * _sinc(scanner.wavenumber * strand.rise_mm[k]) + rough * _turned(patch)
        part *= table_at(paths.amplitude, line, y, paths.step_mm) * beam.elevation[row, int(abs(z) / STEP_MM + 0.5)]
        beside = paths.shift_mm[line, min(int(y / paths.step_mm), depths - 1)] / widening(y, scanner.bend)
        across = (x - beside) / scanner.line_mm + pad
        for behind, strength in strand.echoes:
            if seen + behind < last:
                value = strength * part * _turned(2 * scanner.wavenumber * (seen + behind))
                deposit(field, across, (seen + behind) / scanner.sample_mm, np.complex64(value))
