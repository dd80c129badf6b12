"""The field of echoes before the point spread: its raster, how echoes are laid on it, and their sum.

Echoes are laid by threads, part by part of the slice, and the lines that each part touched are kept. The parts' number is
fixed, and so is the order of their sum: the same bytes from any number of threads.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from recon.compiled import njit
from recon.threads import in_threads
from twin.ultrasound.beam import OVERSAMPLING, Beam
from twin.ultrasound.scan_lines import lines_of, world_from_face
from twin.ultrasound.sound_paths import Paths
from twin.ultrasound.transducer import Transducer

Array = NDArray[np.float64]
Field = NDArray[np.complex64]

BESIDE_MM = 2.0  # beside the image, from where echoes still count
PARTS = 16  # in which echoes are summed


class Scanner(NamedTuple):
    """The image's plane in the world, and figures of the scanner, for compiled code."""

    world_from_face: Array  # (4, 4) mm
    line_mm: float  # between lines, on the face
    bend: float  # 1/mm, of the face; see `scan_lines`
    middle_mm: float  # of the face, along it
    sample_mm: float  # between samples of the field, as shown
    deepest_mm: float  # beyond which no line shows anything
    wavenumber: float  # rad/mm, one way
    assumed_speed: float  # m/s
    repeats: int  # of a border's echo, between it and the probe's face
    face_reflection: float
    seed: np.uint64  # of the tissue


def scanner_at(transducer: Transducer, beam: Beam, paths: Paths, world_from_image: Array, seed: int) -> Scanner:
    """The scanner's figures with the image's plane at a pose."""
    lines = lines_of(transducer)
    return Scanner(
        np.ascontiguousarray(world_from_face(transducer, world_from_image), float),
        lines.pitch_mm,
        lines.bend,
        lines.middle_mm,
        transducer.scale_mm_per_px[1] / OVERSAMPLING,
        _deepest_seen(transducer, beam, paths),
        transducer.wavenumber,
        transducer.assumed_speed,
        transducer.reverberations,
        transducer.face_reflection,
        np.uint64(seed),
    )


def field_like(transducer: Transducer, beam: Beam) -> Field:
    """An empty field of echoes : (lines + taps - 1, OVERSAMPLING h), by shown depth, with room for the beam's width."""
    lines = lines_of(transducer).count + beam.lateral.shape[1] - 1
    return np.zeros((lines, OVERSAMPLING * len(beam.axial)), np.complex64)


def _deepest_seen(transducer: Transducer, beam: Beam, paths: Paths) -> float:
    last = transducer.depth_mm + transducer.scale_mm_per_px[1] * beam.axial.shape[1] / 2 / OVERSAMPLING
    levels = int(np.searchsorted(paths.shown_mm.min(axis=0), last))
    return min(paths.step_mm * levels, beam.depth_step_mm * (len(beam.core_mm) - 1))


def laid(lay: Callable[[Field, int], tuple[int, int]], empty: Field) -> Field:
    """Sum of the echoes that `lay(field, part)` lays on an empty field for each part, in the order of the parts.

    `lay` returns the first line that it touched, and the end.
    """
    lines: list[tuple[int, Field]] = [(0, empty[:0])] * PARTS

    def lay_parts(begin: int, stop: int) -> None:
        field = np.zeros_like(empty)
        for part in range(begin, stop):
            first, end = np.clip(lay(field, part), 0, len(empty))
            lines[part] = first, field[first:end].copy()
            field[first:end] = 0

    in_threads(lay_parts, PARTS)
    total = np.zeros_like(empty)
    for first, echoes in lines:
        total[first : first + len(echoes)] += echoes
    return total


def slab(part: int, count: int) -> tuple[int, int]:
    """First and end of a part's share of a count. Threads take parts in order: so each gets some from everywhere."""
    spread = 7  # without a common factor with PARTS
    place = part * spread % PARTS
    return count * place // PARTS, count * (place + 1) // PARTS


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
