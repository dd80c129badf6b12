"""Echoes of surfaces and wires: Kirchhoff's integral over small facets, with the phase of each.

The sum over facets does what mirrors do: a surface square to the beam is bright, a tilted one sends its echo past the aperture,
a curved one is seen where it is square. What its roughness takes from the coherent echo it scatters to all sides. Facets so
tilted that their phases alias reach no aperture, and are left out of the coherent sum.
"""

import numpy as np
from numba import prange
from numpy.typing import NDArray

from recon.compiled import njit
from twin.ultrasound import borders
from twin.ultrasound.beam import OVERSAMPLING, STEP_MM, Beam
from twin.ultrasound.echo_solids import Body, distance_at
from twin.ultrasound.medium import BESIDE_MM, PARTS, SPREAD, deepest_seen, deposit, field_like, hashed, summed
from twin.ultrasound.sound_paths import Paths, normal_at, reflection
from twin.ultrasound.transducer import Transducer

Field = NDArray[np.complex64]

SUBLINES = 2  # rays a line
ACROSS_MM = 0.2  # between rays across the plane
STEPS_MM = (0.15, 2.5)  # of the march, least and most; less than the margin of the solids' grids
PATCH_MM = 0.1  # over which roughness keeps its height, about half a wavelength
ALONG_MM = 0.05  # between points of a wire
RINGS = 3  # echoes from within a wire
TAPER = (2.2, 4.4)  # rad of phase from line to line: coherent echoes fade; more than apertures accept, less than aliases in them


def surface_echoes(body: Body, transducer: Transducer, beam: Beam, paths: Paths, world_from_image: NDArray, seed: int) -> Field:
    """Demodulated echoes of all borders of tissues in the slice, before the point spread in the plane."""
    half = float(beam.half_mm.max())
    deepest = deepest_seen(transducer, beam, paths)
    fields = np.zeros((PARTS, *field_like(transducer, beam).shape), np.complex64)
    if not body.solids:
        return fields[0]
    sx, sy = transducer.scale_mm_per_px
    across = ACROSS_MM * np.arange(-int(half / ACROSS_MM), int(half / ACROSS_MM) + 1)
    beside = int(SUBLINES * BESIDE_MM / sx)  # rays beside the image, or its edges would diffract
    aside = (np.arange(-beside, SUBLINES * transducer.image_size[0] + beside) + 0.5) * sx / SUBLINES - sx / 2
    pose = np.asarray(world_from_image, float)
    touched = _surfaces(
        *body.packed(),
        pose,
        aside,
        across,
        *borders.spans(body, pose, aside, across, _first_depths(transducer, beam, across), deepest),
        body.column("impedance"),
        body.column("speed"),
        body.column("roughness"),
        sx,
        sy / OVERSAMPLING,
        paths.step_mm,
        paths.shown_mm,
        paths.amplitude,
        paths.shift_mm,
        beam.elevation,
        beam.half_mm,
        beam.depth_step_mm,
        deepest,
        transducer.wavenumber,
        transducer.assumed_speed,
        transducer.reverberations,
        transducer.face_reflection,
        np.uint64(seed),
        fields,
    )
    return summed(fields, touched)


def _first_depths(transducer: Transducer, beam: Beam, across: NDArray) -> NDArray:
    """Depths, mm, from which rays across the plane, or the repeats of what they meet, are in the slice : as `across`."""
    thick = beam.half_mm > np.abs(across)[:, None]
    first = np.where(thick.any(axis=1), thick.argmax(axis=1), len(beam.half_mm))
    return np.maximum(first - 1, 0) * beam.depth_step_mm / (transducer.reverberations + 1)


def wire_echoes(body: Body, transducer: Transducer, beam: Beam, paths: Paths, world_from_image: NDArray, seed: int) -> Field:
    """Demodulated echoes of wires in the slice, before the point spread in the plane.

    A wire of radius a, met square, reflects as a strip of the mirror `sqrt(a lambda / 2)` wide: Kirchhoff's integral round its
    front, by stationary phase. Along its length the phases of its points make it fade when it is tilted against the beam. A few
    echoes from its back follow, as it is a resonator. What comes again from the probe's face is too weak to be seen: a wire sends
    little back, and from half the depth that the scanner focuses on.
    """
    field = field_like(transducer, beam)
    image_from_world = np.linalg.inv(world_from_image)
    sx, sy = transducer.scale_mm_per_px
    for wire in body.wires:
        length = float(np.linalg.norm(wire.ends[1] - wire.ends[0]))
        count = max(int(length / ALONG_MM), 2)
        share = (np.arange(count) + 0.5)[:, None] / count
        points = wire.ends[0] * (1 - share) + wire.ends[1] * share
        direction = (wire.ends[1] - wire.ends[0]) / length @ image_from_world[:3, :3].T
        local = points @ image_from_world[:3, :3].T + image_from_world[:3, 3]
        bounce = (wire.tissue.impedance - body.medium.impedance) / (wire.tissue.impedance + body.medium.impedance)
        strength = np.sqrt(wire.radius * transducer.wavelength_mm / 2) * length / count
        ring = 2 * wire.radius * transducer.assumed_speed / wire.tissue.speed
        echoes = [(0.0, bounce)] + [(ring * n, -bounce * (1 - bounce**2) * bounce ** (2 * n - 2)) for n in range(1, RINGS + 1)]
        _wire(
            points,
            local,
            direction[1] * length / count,
            wire.radius,
            wire.tissue.roughness,
            np.array(echoes) * [1, strength],
            sx,
            sy / OVERSAMPLING,
            paths.step_mm,
            paths.shown_mm,
            paths.amplitude,
            paths.shift_mm,
            beam.elevation,
            beam.half_mm,
            beam.depth_step_mm,
            transducer.wavenumber,
            np.uint64(seed),
            field,
        )
    return field


@njit(inline="always")
def _sinc(x):
    return np.sin(x) / x if abs(x) > 1e-4 else 1.0


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


@njit(inline="always")
def _at(table, line, depth, step):
    level = min(int(depth / step), table.shape[1] - 2)
    part = depth / step - level
    return table[line, level] * (1 - part) + table[line, level + 1] * part


@njit(inline="always")
def _echo(field, x, seen, depth, z, strength, line, pad, sx, row, step, shift, elevation, half, depth_step, wavenumber):
    plane = min(int(depth / depth_step + 0.5), len(half) - 1)
    if abs(z) >= half[plane]:
        return
    carrier = np.exp(2j * wavenumber * seen)
    value = np.complex64(strength * carrier) * elevation[plane, int(abs(z) / STEP_MM + 0.5)]
    level = min(int(depth / step), shift.shape[1] - 1)
    deposit(field, (x - shift[line, level]) / sx + pad, seen / row, value)


@njit(inline="always")
def _in_slice(y, z, orders, half, depth_step):
    """Whether a place across the image's plane lies in the slice, at its depth or at that of one of its repeats."""
    for order in range(1, orders + 2):
        plane = min(int(order * y / depth_step + 0.5), len(half) - 1)
        if abs(z) < half[plane]:
            return True
    return False


@njit(parallel=True, fastmath=True)
def _surfaces(
    flat,
    where,
    frame,
    pose,
    aside,
    across,
    spans,
    counts,
    close,
    impedance,
    speed,
    roughness,
    sx,
    row,
    step,
    shown,
    amplitude,
    shift,
    elevation,
    half,
    depth_step,
    deepest,
    wavenumber,
    assumed,
    orders,
    face,
    seed,
    fields,
):
    lines, depths = shown.shape
    solids = len(where)
    pad = (fields.shape[1] - lines) // 2
    parts = fields.shape[0]
    deepest = min(deepest, step * (depths - 2))
    last = fields.shape[2] * row
    area = sx / SUBLINES * ACROSS_MM
    diffuse = 2 * np.pi / wavenumber / np.sqrt(np.pi * area)  # Lambert: cos / pi of the power a steradian
    dx, dy, dz = pose[0, 1], pose[1, 1], pose[2, 1]
    touched = np.zeros((parts, 2), np.int64)
    for thread in prange(parts):
        field = fields[thread]
        slab = thread * SPREAD % parts
        first, end = len(aside) * slab // parts, len(aside) * (slab + 1) // parts
        touched[thread, 0] = max(int(np.floor((aside[first] - shift.max()) / sx)) + pad - 1, 0)
        touched[thread, 1] = min(int(np.floor((aside[end - 1] - shift.min()) / sx)) + pad + 3, fields.shape[1])
        before, after = np.zeros(solids), np.zeros(solids)
        for ray in range(first, end):
            x = aside[ray]
            line = min(max(int(x / sx + 0.5), 0), lines - 1)
            for k in range(len(across)):
                z, bundle = across[k], (ray // borders.BUNDLE[0], k // borders.BUNDLE[1])
                wx = pose[0, 0] * x + pose[0, 2] * z + pose[0, 3]
                wy = pose[1, 0] * x + pose[1, 2] * z + pose[1, 3]
                wz = pose[2, 0] * x + pose[2, 2] * z + pose[2, 3]
                for span in range(counts[bundle]):
                    here, t, stride, stop = -1, spans[bundle][span, 0], 0.0, spans[bundle][span, 1]
                    while True:
                        there, near = 0, STEPS_MM[1]
                        for s in range(solids):
                            if here < 0 or close[bundle][s]:
                                after[s] = distance_at(flat, where[s], frame[s], wx + dx * t, wy + dy * t, wz + dz * t)
                                near = min(near, 0.9 * abs(after[s]))
                            if after[s] < 0:
                                there = s + 1
                        if here >= 0 and there != here and _in_slice(t, z, orders, half, depth_step):
                            s = max(here, there) - 1
                            part = before[s] / (before[s] - after[s]) if before[s] != after[s] else 0.5
                            y = t - stride + min(max(part, 0.0), 1.0) * stride
                            px, py, pz = wx + dx * y, wy + dy * y, wz + dz * y
                            miss = distance_at(flat, where[s], frame[s], px, py, pz)
                            nx, ny, nz = normal_at(flat, where[s], frame[s], px, py, pz)
                            cosine = nx * dx + ny * dy + nz * dz
                            if abs(cosine) > 0.05:
                                if abs(miss) < 0.1:
                                    y -= miss / cosine
                                size = abs(cosine)
                                slope_x = (nx * pose[0, 0] + ny * pose[1, 0] + nz * pose[2, 0]) / size
                                slope_z = (nx * pose[0, 2] + ny * pose[1, 2] + nz * pose[2, 2]) / size
                                level = max(int(y / step) - 1, 0)  # before the border, where delays have a kink
                                seen = shown[line, level] + (y - level * step) * assumed / speed[here]
                                left = amplitude[line, level]
                                r = reflection(impedance[here], impedance[there], speed[here], speed[there], size)
                                square = (impedance[there] - impedance[here]) / (impedance[there] + impedance[here])
                                spread = 2 * wavenumber * roughness[s + 1] * size
                                lost = np.sqrt(1 - np.exp(-spread * spread))
                                rough = square * diffuse * lost * np.sqrt(size) * np.exp(1j * _phase_of_patch(px, py, pz, seed))
                                strength = area * left
                                for order in range(1, orders + 2):
                                    if order * seen >= last or order * y >= deepest:
                                        break
                                    facet = _unaliased(2 * order * wavenumber * slope_x * sx)
                                    facet *= _unaliased(2 * order * wavenumber * slope_z * ACROSS_MM)
                                    value = r * facet * np.exp(-0.5 * (order * spread) ** 2) + (rough if order == 1 else 0j)
                                    if value != 0:
                                        _echo(
                                            field,
                                            x,
                                            order * seen,
                                            order * y,
                                            z,
                                            strength * value,
                                            line,
                                            pad,
                                            sx,
                                            row,
                                            step,
                                            shift,
                                            elevation,
                                            half,
                                            depth_step,
                                            wavenumber,
                                        )
                                    strength *= r * face * left
                        here = there
                        for s in range(solids):
                            before[s] = after[s]
                        if t >= stop:
                            break
                        stride = min(max(near, STEPS_MM[0]), stop - t + 1e-6)
                        t += stride
    return touched


@njit
def _wire(
    points,
    local,
    rise,
    radius,
    roughness,
    echoes,
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
    seed,
    field,
):
    lines, depths = shown.shape
    pad = (field.shape[0] - lines) // 2
    deepest, last = step * (depths - 2), field.shape[1] * row
    for k in range(len(points)):
        x, y, z = local[k, 0], local[k, 1] - radius, local[k, 2]
        if y < 0 or y >= deepest or abs(z) > half.max() or x < -pad * sx or x > (lines - 1 + pad) * sx:
            continue
        line = min(max(int(x / sx + 0.5), 0), lines - 1)
        seen, left = _at(shown, line, y, step), _at(amplitude, line, y, step)
        patch = _phase_of_patch(points[k, 0], points[k, 1], points[k, 2], seed)
        for behind, strength in echoes:
            if seen + behind >= last:
                break
            smooth = np.exp(-0.5 * (2 * wavenumber * roughness) ** 2)
            rough = np.sqrt(1 - smooth * smooth) * np.exp(1j * patch)
            _echo(
                field,
                x,
                seen + behind,
                y,
                z,
                strength * left * (smooth * _sinc(wavenumber * rise) + rough),
                line,
                pad,
                sx,
                row,
                step,
                shift,
                elevation,
                half,
                depth_step,
                wavenumber,
            )
