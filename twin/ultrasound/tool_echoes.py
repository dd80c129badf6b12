"""Echoes of tools: needles, styluses and other round shafts that are led through the slice by a hand.

The shaft is a line of strips of a mirror, as wide as `tool_resonance` has it, at the depth of its front; the tip is facets. Both
are laid with their phases, so that a shaft is bright where it is square to the beam, and else is seen by its ends and roughness
alone. Echoes that are laid at places between lines pass a filter that lets through all that apertures accept, and nothing that
the lines' raster would fold back: a steep shaft leaves only what its ends diffract.

The tissue at the tip stands for all that lies about the shaft, in its bounce and in its ringing: of one that passes from fat into
a mass, both are those of the mass all along.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from recon.compiled import kernel, njit
from recon.geometry import rigid
from scenes.handheld.shaft import Shaft
from scenes.tissue import Tissue
from twin.ultrasound.beam import DEEPER, STEP_MM, Beam
from twin.ultrasound.echo_field import Field, Scanner, field_like, scanner_at
from twin.ultrasound.echo_solids import Body, label_at
from twin.ultrasound.scan_lines import on_lines, widening, world_from_face
from twin.ultrasound.sound_paths import Paths, table_at
from twin.ultrasound.tool_resonance import BEFORE, TILT_STEP, Layers, resonance
from twin.ultrasound.tool_surface import SEEN_MM, blunt_mm, facets, form_of, frame_of
from twin.ultrasound.transducer import Transducer

Array = NDArray[np.float64]

ALONG = 1 / 5  # wavelengths between points of a shaft's line: 2.5 rad of phase both ways where it is steepest
TAPS, PLACES = 12, 64  # of the filter between lines, and places between two lines that it is tabled for
FILTER_EDGE, FILTER_BETA = 0.5, 5.65  # cycles a line, in the middle of its slope from 0.35 to 0.65; Kaiser's, for -60 dB
FAINTEST = 2e-3  # of the strongest sample of a shaft's echo, where it ends
FRONT = 5  # samples from the front's own on: what comes later rings
REPEATED = 0.3, 0.45  # slopes times a repeat's order, over which it fades: more than apertures accept
FADE_MM = 0.6  # at the ends of the table across the plane, and below the face
NEAR_MM = 8.0  # beside the slice, from where a shaft counts


@dataclass(frozen=True, eq=False)
class Tool:
    """A shaft where it is: in the world."""

    shaft: Shaft

    def is_near(self, transducer: Transducer, world_from_image: Array) -> bool:
        """Whether some of it may be in the slice or shade it."""
        deepest_mm = DEEPER * transducer.depth_mm
        face_from_world = rigid.invert(world_from_face(transducer, world_from_image))
        ends = rigid.apply(face_from_world, self.shaft.ends)
        points = ends[1] + np.linspace(0, 1, 400)[:, None] * (ends[0] - ends[1])
        aside = transducer.foot_mm + deepest_mm
        return bool(((np.abs(points[:, 2]) < NEAR_MM) & (points[:, 1] < deepest_mm) & (np.abs(points[:, 0]) < aside)).any())


class _Line(NamedTuple):
    """A shaft's axis in the face's frame, for compiled code."""

    first: Array  # (3,) mm, where the tip begins
    back: Array  # (3,) unit, from there to the rear
    count: int
    step_mm: float
    radius: float
    smooth: Array  # (count,) logarithm of the amplitude that roughness leaves, square to the beam
    echo: NDArray[np.complex64]  # (tilts, n) mm
    last: NDArray[np.int64]  # (tilts,) samples that count
    bounce: float  # of amplitude at its front


class _Surface(NamedTuple):
    """Facets for compiled code, as of `tool_surface.Facets`."""

    pose: Array  # (4, 4) of their frame in the face's
    place: Array
    normal: Array
    area: Array
    roughness: Array
    phase: Array
    smooth: NDArray[np.bool_]
    bounce: float
    wavelength_mm: float


def tool_echoes(tool: Tool, body: Body, transducer: Transducer, beam: Beam, paths: Paths, world_from_image: Array) -> Field:
    """Demodulated echoes of a tool in the slice, before the point spread in the plane."""
    field, scanner = field_like(transducer, beam), scanner_at(transducer, beam, paths, world_from_image, 0)
    around = body.tissues[label_at(body.packed(), *tool.shaft.ends[1])]
    shaft, between = tool.shaft.moved(rigid.invert(scanner.world_from_face)), _between_lines()
    _lay_line(field, _line(shaft, around, transducer, scanner), between, scanner, beam, paths)
    _lay_facets(field, _surface(shaft, around, transducer), between, scanner, beam, paths)
    return field


def _line(shaft: Shaft, around: Tissue, transducer: Transducer, scanner: Scanner) -> _Line:
    """The whole cylinder behind the tip."""
    blunt, step = blunt_mm(form_of(shaft, transducer.wavelength_mm)), ALONG * transducer.wavelength_mm
    count = int(max(min(shaft.length, SEEN_MM) - blunt, 0.0) / step)
    behind = blunt + step * (np.arange(count) + 0.5)
    rough = np.where(behind < shaft.etched, shaft.etched_roughness, shaft.material.roughness)
    echo = resonance(layers_of(shaft, around, transducer, scanner.sample_mm))
    smooth = -0.5 * (2 * scanner.wavenumber * rough) ** 2
    first = shaft.ends[1] - blunt * shaft.along
    loud = np.abs(echo) > FAINTEST * np.abs(echo).max()
    last = echo.shape[1] - loud[:, ::-1].argmax(axis=1)
    return _Line(first, -shaft.along, count, step, shaft.radius, smooth, echo, last, _bounce(shaft, around))


def layers_of(shaft: Shaft, around: Tissue, transducer: Transducer, step_mm: float) -> Layers:
    """A shaft in a medium, as its echo depends on it."""
    outside, wall, filling = (_medium(each, transducer) for each in (around, shaft.material, shaft.filling or around))
    sound = transducer.wavenumber, transducer.assumed_speed
    return Layers(shaft.radius, shaft.bore, outside, wall, filling, *sound, step_mm)


def _medium(tissue: Tissue, transducer: Transducer) -> tuple[float, float, float]:
    return tissue.impedance, tissue.speed, tissue.attenuation * transducer.frequency_mhz * np.log(10) / 200


def _bounce(shaft: Shaft, around: Tissue) -> float:
    return (shaft.material.impedance - around.impedance) / (shaft.material.impedance + around.impedance)


def _surface(shaft: Shaft, around: Tissue, transducer: Transducer) -> _Surface:
    wavelength = transducer.wavelength_mm * around.speed / transducer.assumed_speed
    return _Surface(frame_of(shaft), *facets(form_of(shaft, transducer.wavelength_mm)), _bounce(shaft, around), wavelength)


def _between_lines() -> NDArray[np.float32]:
    """Weights : (PLACES + 1, TAPS) of the lines about a place between two, which is tabled in steps."""
    offset = np.arange(TAPS) - (TAPS // 2 - 1) - np.linspace(0, 1, PLACES + 1)[:, None]
    window = np.i0(FILTER_BETA * np.sqrt(np.maximum(1 - (2 * offset / TAPS) ** 2, 0))) / np.i0(FILTER_BETA)
    return (2 * FILTER_EDGE * np.sinc(2 * FILTER_EDGE * offset) * window).astype(np.float32)


@njit(inline="always")
def _fade(inside_mm):
    """Weight of a place so far within a border, over which echoes fade in."""
    return np.sin(np.pi / 2 * min(max(inside_mm / FADE_MM, 0.0), 1.0)) ** 2


@njit(inline="always")
def _across(beam, y, z):
    """Two-way amplitude of the beam across the plane, between the places of its table."""
    rows, columns = beam.elevation.shape
    a, b = y / beam.depth_step_mm, abs(z) / STEP_MM
    if a < 0 or a >= rows - 1 or b >= columns - 1:
        return complex(0.0)
    i, j = int(a), int(b)
    a, b = a - i, b - j
    near = beam.elevation[i, j] * (1 - b) + beam.elevation[i, j + 1] * b
    far = beam.elevation[i + 1, j] * (1 - b) + beam.elevation[i + 1, j + 1] * b
    return complex(near * (1 - a) + far * a) * _fade((columns - 1 - b - j) * STEP_MM)


@njit(inline="always")
def _lay(field, weights, px, py, value):
    """Add an echo at a fractional place of the field, filtered between its lines."""
    i, j = int(np.floor(px)), int(np.floor(py))
    if j < 0 or j >= field.shape[1] - 1:
        return
    row, b = int((px - i) * PLACES + 0.5), py - j
    near, far = np.complex64(value * (1 - b)), np.complex64(value * b)
    for tap in range(TAPS):
        line = i + tap - (TAPS // 2 - 1)
        if 0 <= line < field.shape[0]:
            weight = weights[row, tap]
            field[line, j] += weight * near
            field[line, j + 1] += weight * far


@kernel(fastmath=True)
def _lay_line(field, shaft, between, scanner, beam, paths):
    """Lay the echoes of a shaft's line, those from within it, and their repeats between it and the probe's face."""
    lines, depths = paths.labels.shape
    pad = (len(field) - lines) // 2
    deepest, k = paths.step_mm * (depths - 2), scanner.wavenumber
    tilts = len(shaft.echo)
    for n in range(shaft.count):
        s = (n + 0.5) * shaft.step_mm
        x, y, z = shaft.first[0] + s * shaft.back[0], shaft.first[1] + s * shaft.back[1], shaft.first[2] + s * shaft.back[2]
        along, depth = on_lines(x, y, scanner.bend, scanner.middle_mm)
        angle = (along - scanner.middle_mm) * scanner.bend
        bx, by = np.sin(angle), np.cos(angle)
        rise = shaft.back[0] * bx + shaft.back[1] * by
        cosine = np.sqrt(max(1 - rise * rise, 0.0))
        if cosine < 1e-3:
            continue
        out = shaft.radius / cosine  # from the axis to the front, along its normal
        fx, fy = x - out * (bx - rise * shaft.back[0]), y - out * (by - rise * shaft.back[1])
        fz = z + out * rise * shaft.back[2]
        along, depth = on_lines(fx, fy, scanner.bend, scanner.middle_mm)
        if not (0 < depth < deepest):
            continue
        line = min(max(int(along / scanner.line_mm + 0.5), 0), lines - 1)
        seen = table_at(paths.shown_mm, line, depth, paths.step_mm)
        part = _across(beam, depth, fz) * _fade(depth) * table_at(paths.amplitude, line, depth, paths.step_mm)
        part *= np.exp(shaft.smooth[n] * cosine * cosine) * shaft.step_mm
        turn = k * rise * shaft.step_mm
        part *= np.sin(turn) / turn if abs(turn) > 1e-4 else 1.0
        if abs(part) < 1e-12:
            continue
        level = min(int(depth / paths.step_mm), depths - 1)
        across = (along - paths.shift_mm[line, level] / widening(depth, scanner.bend)) / scanner.line_mm + pad
        tilt = np.arccos(min(cosine, 1.0)) / TILT_STEP
        row, steep = min(int(tilt + 0.5), tilts - 1), 1.0
        if tilt > tilts - 1:
            steep = np.sqrt(cosine / np.cos(TILT_STEP * (tilts - 1)))
        last = shaft.last[row]
        value = part * steep * complex(np.cos(2 * k * seen), np.sin(2 * k * seen))
        rung = np.sin(np.pi / 2 * min(s / (4 * shaft.radius), 1.0)) ** 2  # beside the cut end of the tip nothing rings yet
        for ring in range(last):
            whole = 1.0 if ring < BEFORE + FRONT else rung
            _lay(field, between, across, seen / scanner.sample_mm + ring - BEFORE, whole * value * shaft.echo[row, ring])
        once = shaft.bounce * scanner.face_reflection * np.sqrt(shaft.radius / (4 * depth)) * cosine
        once *= table_at(paths.amplitude, line, depth, paths.step_mm)
        again = part * shaft.bounce * np.sqrt(shaft.radius * np.pi / k * cosine) * complex(np.sqrt(0.5), np.sqrt(0.5))
        for order in range(2, scanner.repeats + 2):
            again *= once
            slope = (order * abs(rise) - REPEATED[0]) / (REPEATED[1] - REPEATED[0])
            if slope >= 1:
                break
            turned = 2 * k * order * seen
            steep = np.cos(np.pi / 2 * max(slope, 0.0)) ** 2
            _lay(
                field, between, across, order * seen / scanner.sample_mm, steep * again * complex(np.cos(turned), np.sin(turned))
            )


@kernel(fastmath=True)
def _lay_facets(field, tool, between, scanner, beam, paths):
    """Lay the echoes of facets that face the probe: what they reflect, and what their roughness scatters by Lambert's law."""
    lines, depths = paths.labels.shape
    pad = (len(field) - lines) // 2
    deepest, k = paths.step_mm * (depths - 2), scanner.wavenumber
    pose = tool.pose
    for n in range(len(tool.area)):
        a, b, c = tool.place[n]
        x = pose[0, 0] * a + pose[0, 1] * b + pose[0, 2] * c + pose[0, 3]
        y = pose[1, 0] * a + pose[1, 1] * b + pose[1, 2] * c + pose[1, 3]
        z = pose[2, 0] * a + pose[2, 1] * b + pose[2, 2] * c + pose[2, 3]
        along, depth = on_lines(x, y, scanner.bend, scanner.middle_mm)
        if not (0 < depth < deepest):
            continue
        angle = (along - scanner.middle_mm) * scanner.bend
        a, b, c = tool.normal[n]
        nx, ny = pose[0, 0] * a + pose[0, 1] * b + pose[0, 2] * c, pose[1, 0] * a + pose[1, 1] * b + pose[1, 2] * c
        cosine = -(nx * np.sin(angle) + ny * np.cos(angle))
        if cosine <= 0:
            continue
        weight = _across(beam, depth, z) * _fade(depth)
        if abs(weight) < 1e-9:
            continue
        line = min(max(int(along / scanner.line_mm + 0.5), 0), lines - 1)
        seen = table_at(paths.shown_mm, line, depth, paths.step_mm)
        mirror = np.exp(-0.5 * (2 * k * tool.roughness[n] * cosine) ** 2)
        scattered = tool.wavelength_mm * cosine * np.sqrt(tool.area[n] / np.pi * (1 - mirror * mirror))
        value = scattered * complex(np.cos(tool.phase[n]), np.sin(tool.phase[n]))
        if tool.smooth[n]:
            value += cosine * tool.area[n] * mirror
        value *= tool.bounce * weight * table_at(paths.amplitude, line, depth, paths.step_mm)
        level = min(int(depth / paths.step_mm), depths - 1)
        across = (along - paths.shift_mm[line, level] / widening(depth, scanner.bend)) / scanner.line_mm + pad
        value *= complex(np.cos(2 * k * seen), np.sin(2 * k * seen))
        _lay(field, between, across, seen / scanner.sample_mm, value)
