"""Echoes of surfaces and wires: Kirchhoff's integral over small facets, with the phase of each.

The sum over facets does what mirrors do: a surface square to the beam is bright, a tilted one sends its echo past the aperture,
a curved one is seen where it is square. What its roughness takes from the coherent echo it scatters to all sides.
"""

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from twin.ultrasound.beam import OVERSAMPLING, STEP_MM, Beam
from twin.ultrasound.medium import BESIDE_MM, PARTS, deposit, field_like, hashed
from twin.ultrasound.paths import Paths, normal_at, reflection
from twin.ultrasound.solids import Body, distance_at
from twin.ultrasound.transducer import Transducer

Field = NDArray[np.complex64]

SUBLINES = 2  # rays a line
ACROSS_MM = 0.2  # between rays across the plane
STEPS_MM = (0.15, 2.5)  # of the march, least and most; less than the margin of the solids' grids
PATCH_MM = 0.1  # over which roughness keeps its height, about half a wavelength
ALONG_MM = 0.05  # between points of a wire
RINGS = 3  # echoes from within a wire


def surface_echoes(body: Body, transducer: Transducer, beam: Beam, paths: Paths, world_from_image: NDArray, seed: int) -> Field:
    """Demodulated echoes of all borders of tissues in the slice, before the point spread in the plane."""
    half = float(beam.half_mm.max())
    fields = np.zeros((PARTS, *field_like(transducer, beam).shape), np.complex64)
    if not body.solids:
        return fields[0]
    sx, sy = transducer.scale_mm_per_px
    across = ACROSS_MM * np.arange(-int(half / ACROSS_MM), int(half / ACROSS_MM) + 1)
    pieces = _surfaces(
        *body.packed(),
        np.asarray(world_from_image, float),
        across,
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
        transducer.wavenumber,
        transducer.assumed_speed,
        transducer.reverberations,
        transducer.face_reflection,
        np.uint64(seed),
        fields,
    )
    return pieces.sum(axis=0)


def wire_echoes(body: Body, transducer: Transducer, beam: Beam, paths: Paths, world_from_image: NDArray, seed: int) -> Field:
    """Demodulated echoes of wires in the slice, before the point spread in the plane.

    A wire of radius a, met square, reflects as a strip of the mirror `sqrt(a lambda / 2)` wide: Kirchhoff's integral round its
    front, by stationary phase. Along its length the phases of its points make it fade when it is tilted against the beam. A few
    echoes from its back follow, as it is a resonator.
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
            transducer.reverberations,
            transducer.face_reflection,
            np.uint64(seed),
            field,
        )
    return field


@njit(cache=True, inline="always")
def _sinc(x):
    return np.sin(x) / x if abs(x) > 1e-4 else 1.0


@njit(cache=True, inline="always")
def _phase_of_patch(x, y, z, seed):
    bits = hashed(int(np.floor(x / PATCH_MM)), int(np.floor(y / PATCH_MM)), int(np.floor(z / PATCH_MM)), seed)
    return 2 * np.pi * (bits >> np.uint64(11)) / 9007199254740992.0


@njit(cache=True, inline="always")
def _at(table, line, depth, step):
    level = min(int(depth / step), table.shape[1] - 2)
    part = depth / step - level
    return table[line, level] * (1 - part) + table[line, level + 1] * part


@njit(cache=True, inline="always")
def _echo(field, x, seen, depth, z, strength, line, pad, sx, row, step, shift, elevation, half, depth_step, wavenumber):
    plane = min(int(depth / depth_step + 0.5), len(half) - 1)
    if abs(z) >= half[plane]:
        return
    carrier = np.exp(2j * wavenumber * seen)
    value = np.complex64(strength * carrier) * elevation[plane, int(abs(z) / STEP_MM + 0.5)]
    level = min(int(depth / step), shift.shape[1] - 1)
    deposit(field, (x - shift[line, level]) / sx + pad, seen / row, value)


@njit(cache=True, parallel=True)
def _surfaces(
    flat,
    where,
    frame,
    pose,
    across,
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
    threads = fields.shape[0]
    deepest = step * (depths - 2)
    beside = int(SUBLINES * BESIDE_MM / sx)  # rays beside the image, or its edges would diffract
    last = fields.shape[2] * row
    area = sx / SUBLINES * ACROSS_MM
    diffuse = 2 * np.pi / wavenumber / np.sqrt(np.pi * area)  # Lambert: cos² / pi of the power a steradian, at the same angle
    dx, dy, dz = pose[0, 1], pose[1, 1], pose[2, 1]
    for thread in prange(threads):
        field = fields[thread]
        before, after = np.zeros(solids), np.zeros(solids)
        for subline in range(thread - beside, SUBLINES * lines + beside, threads):
            x = (subline + 0.5) * sx / SUBLINES - sx / 2
            line = min(max(int(x / sx + 0.5), 0), lines - 1)
            for z in across:
                wx = pose[0, 0] * x + pose[0, 2] * z + pose[0, 3]
                wy = pose[1, 0] * x + pose[1, 2] * z + pose[1, 3]
                wz = pose[2, 0] * x + pose[2, 2] * z + pose[2, 3]
                here, t, stride = -1, 0.0, 0.0
                while True:
                    there, near = 0, STEPS_MM[1]
                    for s in range(solids):
                        d = distance_at(flat, where[s], frame[s], wx + dx * t, wy + dy * t, wz + dz * t)
                        after[s] = d
                        near = min(near, 0.9 * abs(d))
                        if d < 0:
                            there = s + 1
                    if here >= 0 and there != here:
                        s = max(here, there) - 1
                        part = before[s] / (before[s] - after[s]) if before[s] != after[s] else 0.5
                        part = min(max(part, 0.0), 1.0)
                        y = t - stride + part * stride
                        px, py, pz = wx + dx * y, wy + dy * y, wz + dz * y
                        miss = distance_at(flat, where[s], frame[s], px, py, pz)
                        nx, ny, nz = normal_at(flat, where[s], frame[s], px, py, pz)
                        cosine = nx * dx + ny * dy + nz * dz
                        if abs(cosine) > 0.05:
                            if abs(miss) < 0.1:
                                y -= miss / cosine
                            size = abs(cosine)
                            r = reflection(impedance[here], impedance[there], speed[here], speed[there], size)
                            slope_x = (nx * pose[0, 0] + ny * pose[1, 0] + nz * pose[2, 0]) / size
                            slope_z = (nx * pose[0, 2] + ny * pose[1, 2] + nz * pose[2, 2]) / size
                            level = max(int(y / step) - 1, 0)  # before the border, where delays have a kink
                            seen = shown[line, level] + (y - level * step) * assumed / speed[here]
                            left = amplitude[line, level]
                            spread = 2 * wavenumber * roughness[s + 1]
                            patch = _phase_of_patch(px, py, pz, seed)
                            strength = r * area * left
                            for order in range(1, orders + 2):
                                if order * seen >= last or order * y >= deepest:
                                    break
                                smooth = np.exp(-0.5 * (order * spread) ** 2)
                                facet = _sinc(order * wavenumber * slope_x * sx / SUBLINES)
                                facet *= _sinc(order * wavenumber * slope_z * ACROSS_MM)
                                rough = diffuse * np.sqrt(1 - smooth * smooth) * size * np.exp(1j * patch) if order == 1 else 0j
                                _echo(
                                    field,
                                    x,
                                    order * seen,
                                    order * y,
                                    z,
                                    strength * (smooth * facet + rough),
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
                    if t >= deepest:
                        break
                    stride = min(max(near, STEPS_MM[0]), deepest - t + 1e-6)
                    t += stride
    return fields


@njit(cache=True)
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
    orders,
    face,
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
            bounce = 1.0
            for order in range(1, orders + 2):
                if order * seen + behind >= last or order * y >= deepest:
                    break
                smooth = np.exp(-0.5 * (2 * order * wavenumber * roughness) ** 2)
                rough = np.sqrt(1 - smooth * smooth) * np.exp(1j * patch) if order == 1 else 0j
                total = smooth * _sinc(order * wavenumber * rise) + rough
                _echo(
                    field,
                    x,
                    order * seen + behind,
                    order * y,
                    z,
                    strength * bounce * left * total,
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
                bounce *= np.sqrt(radius / (2 * max(y, radius))) * face * left  # a wire sends little back to the face
