"""The point spread: pulse in depth, two-way beam along the array and across the image plane, as a function of depth.

Fresnel diffraction of the aperture, separable in the two directions. With `|H| = 1` in front of an endless unfocused aperture,

    H(x, y) = (i lambda y)^(-1/2) ∫ A(s) exp(i k (x - s)²/(2 y) - i k s²/(2 F)) ds,

the echo of a scatterer of scattering length f, received as the mean over an aperture of D mm, is `f lambda H_t H_r / D` in each
direction, relative to that of a perfect mirror. A surface element dA of a mirror is a scatterer of length `R dA / lambda`.

What lies x beside a line of a curved array is nearer to it than at its own depth, by `x²/(2 (R + depth))`: the table along the
array has the phase of that, both ways.

Along the array, Hann windows leave little to interfere, and the centre frequency stands for the echo's band. Across, the edges of
the element send waves of their own; near the face their ripples differ from frequency to frequency, and the band averages them.
Source: Goodman, Introduction to Fourier Optics, chapter 4; reciprocity for the receiver.
"""

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import fresnel

from twin.ultrasound.scan_lines import lines_of, widening
from twin.ultrasound.transducer import Transducer

Array = NDArray[np.float64]
Complex = NDArray[np.complex64]

NEAREST_MM = 2.0  # where the beam at the face is taken; Fresnel's approximation fails nearer
OVERSAMPLING = 2  # axial samples a row of the image
STEP_MM = 0.025  # of the elevational table
BAND = np.linspace(-1.1, 1.1, 23)  # frequencies of an echo, in its full widths at half amplitude beside the centre
DEEPER = 1.2  # true depth that the tables reach, over the shown one


class Beam(NamedTuple):
    """Tables of the point spread of one transducer. Depths in rows of the image as shown."""

    lateral: Complex  # (h, taps) along the array, per row; taps odd, centred
    reach: NDArray[np.int64]  # (h,) taps on either side that matter
    axial: NDArray[np.float32]  # (h, taps) in depth, OVERSAMPLING samples a row; taps odd
    elevation: Complex  # (m, n) two-way, at depth m DEPTH_STEP and offset n STEP_MM
    half_mm: NDArray[np.float32]  # (m,) half thickness of the slice, for what is bright
    core_mm: NDArray[np.float32]  # (m,) the same without side lobes, for scatterers
    depth_step_mm: float
    lateral_energy: Array  # (h,) of a line of scatterers along the array
    elevation_energy: Array  # (h,)


def _diffract(
    offsets: Array, depth: float, aperture: float, focus: float, wavelength: float, apodised: bool
) -> NDArray[np.complex128]:
    """Field H : (n,) of an aperture at offsets : (n,) mm from its axis, at a depth; `apodised` by a Hann window."""
    elements = 400  # points of the aperture in the integral
    s = (np.arange(elements // 2) + 0.5) / elements  # of one half; the other adds its mirror image: exp(ia) + exp(-ia) = 2 cos(a)
    weight = (2 * np.cos(np.pi * s) ** 2 if apodised else np.ones(elements // 2)) * aperture / elements
    s = s * aperture
    k = 2 * np.pi / wavelength
    lens = weight * np.exp(1j * k * s**2 / 2 * (1 / depth - 1 / focus))
    field = 2 * np.cos(k / depth * np.outer(offsets, s)) @ lens
    return np.exp(1j * k * offsets**2 / (2 * depth)) * field / np.sqrt(1j * wavelength * depth)


@lru_cache(maxsize=8)
def beam(transducer: Transducer) -> Beam:
    """Tables of a transducer's point spread; they depend on its figures alone and are kept."""
    rows, lines = transducer.rows_mm, lines_of(transducer)
    lateral, reach = _lateral(transducer, rows)
    depths = np.arange(0, DEEPER * transducer.depth_mm + 0.5, 0.25)
    elevation, half, core = _elevation(transducer, depths)
    energy = 2 * (np.abs(elevation) ** 2).sum(axis=1) * STEP_MM
    return Beam(
        lateral.astype(np.complex64),
        reach,
        _axial(transducer, rows).astype(np.float32),
        elevation.astype(np.complex64),
        half.astype(np.float32),
        core.astype(np.float32),
        0.25,
        (np.abs(lateral) ** 2).sum(axis=1) * lines.pitch_mm * widening(rows, lines.bend),
        np.interp(rows, depths, energy),
    )


def receive_aperture(transducer: Transducer, depth: Array | float) -> Array:
    """Width of the dynamic receive aperture, mm, at a depth."""
    return np.clip(np.asarray(depth) / transducer.receive_f_number, NEAREST_MM / 2, transducer.aperture_mm)


def sent_aperture(transducer: Transducer, depth: Array) -> Array:
    """Width of the transmit aperture, mm, that adds to the beam's middle at depths : (n,).

    Beside the focus the phase grows along the aperture; Hann's weight of the width is a half where it is a quarter of a turn.
    """
    focus = transducer.focus_mm(depth)
    bend = np.abs(1 / np.maximum(depth, NEAREST_MM) - 1 / focus)
    return np.minimum(focus / transducer.transmit_f_number, np.sqrt(8 * transducer.wavelength_mm / np.maximum(bend, 1e-9)))


def _lateral(transducer: Transducer, rows: Array) -> tuple[NDArray[np.complex128], NDArray[np.int64]]:
    lines, wavelength = lines_of(transducer), transducer.wavelength_mm
    reach_mm = 4.0  # of the point spread along the array, at most
    taps = int(reach_mm / lines.pitch_mm)
    table = np.empty((len(rows), taps + 1), complex)
    for k, (depth, focus) in enumerate(zip(np.maximum(rows, NEAREST_MM), transducer.focus_mm(rows), strict=True)):
        offsets = lines.pitch_mm * widening(depth, lines.bend) * np.arange(taps + 1)
        receive = float(receive_aperture(transducer, depth))
        sent = _diffract(offsets, depth, focus / transducer.transmit_f_number, focus, wavelength, apodised=True)
        table[k] = sent * _diffract(offsets, depth, receive, depth, wavelength, apodised=True) / receive
        table[k] *= np.exp(-2j * transducer.wavenumber * offsets**2 / 2 * lines.bend / widening(depth, lines.bend))
    faint = 2e-3  # of the peak: the point spread ends there (-54 dB)
    seen = np.abs(table) >= faint * np.abs(table).max(axis=1, keepdims=True)
    reach = np.maximum((np.arange(taps + 1) * seen).max(axis=1), 1)
    return np.hstack([table[:, :0:-1], table]), reach


def through_lens(offsets: Array, depth: float, height: float, focus: float, wavelengths: Array) -> NDArray[np.complex128]:
    """Field H : (m, n) of an even aperture behind a lens, at offsets : (n,) mm, for m wavelengths; Fresnel's integrals."""
    bend = 1 / depth - 1 / focus
    bend = bend if abs(bend) > 1e-4 else 1e-4  # in focus: 0.01 rad at the edge
    k = 2 * np.pi / wavelengths[:, None]
    centre, scale = offsets / (bend * depth), np.sqrt(k * abs(bend) / np.pi)
    parts = [np.array(fresnel(scale * (edge - centre))) for edge in (height / 2, -height / 2)]
    sine, cosine = parts[0] - parts[1]
    integral = (cosine + 1j * np.sign(bend) * sine) / scale
    phase = k / 2 * (offsets**2 / depth - bend * centre**2)
    return integral * np.exp(1j * phase) / np.sqrt(1j * wavelengths[:, None] * depth)


def _elevation(transducer: Transducer, depths: Array) -> tuple[NDArray[np.complex128], Array, Array]:
    """Two-way amplitude, and where the slice ends: each place's echo, projected on the pulse that the image is made with."""
    offsets = np.arange(0, transducer.elevation_mm * 0.5 + 2.0, STEP_MM)
    height, focus = transducer.elevation_mm, transducer.elevation_focus_mm
    near, far = transducer.bandwidth
    weight = np.exp(-8 * np.log(2) * BAND**2)  # the echo's spectrum, squared
    weight /= weight.sum()
    table = np.empty((len(depths), len(offsets)), complex)
    for k, depth in enumerate(np.maximum(depths, NEAREST_MM)):
        share = BAND * (near + (far - near) * min(depth / transducer.depth_mm, 1.0))
        wavelengths = transducer.wavelength_mm / np.maximum(1 + share, 0.2)
        table[k] = weight @ through_lens(offsets, depth, height, focus, wavelengths) ** 2 / height
    level = np.abs(table) / np.abs(table).max(axis=1, keepdims=True)
    edges = (0.03, 0.06)  # of the peak across the plane, two-way: the slice's end for surfaces and wires, and for scatterers
    half, core = (np.where(level >= least, offsets, 0).max(axis=1) + STEP_MM for least in edges)
    return table, half, core


def _axial(transducer: Transducer, rows: Array) -> Array:
    sigma = transducer.axial_sigma_mm(rows)[:, None]
    step = transducer.scale_mm_per_px[1] / OVERSAMPLING
    taps = int(np.ceil(3.3 * sigma.max() / step))
    return np.exp(-((step * np.arange(-taps, taps + 1)) ** 2) / (2 * sigma**2))
