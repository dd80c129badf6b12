"""Closed forms of a linear array's echo: its pulse in depth, its beam along the array, and its slice across the plane.

What they leave in images is `widths * wavelength`: without the frequency, apertures are known in wavelengths alone.
Source: Goodman, Introduction to Fourier Optics, chapter 4; docs/physics-ultrasound.md, sections 1 to 3.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

NEAREST_MM = 2.0  # Fresnel's approximation fails nearer
REACH_MM = 4.0  # of the beam along the array, to either side
STEP_MM = 0.05  # of the beam's table
POINTS = 96  # of half an aperture along the array
POINTS_ACROSS = 64
BAND = np.linspace(-0.8, 0.8, 5)  # frequencies of an echo, in its full widths at half amplitude beside the centre


class Along(NamedTuple):
    """The beam along the array."""

    wavelength_mm: float
    transmit_focus_mm: float
    transmit_f_number: float
    receive_f_number: float
    aperture_mm: float  # widest in receive


class Across(NamedTuple):
    """The slice across the image plane."""

    wavelength_mm: float
    elevation_mm: float
    focus_mm: float


def pulse_sigma_mm(band_mhz: Array | float, speed: float) -> Array | float:
    """Standard deviation in depth of an echo's Gaussian envelope, by its band's full width at half amplitude.

    band_mhz : frequency x bandwidth
    speed : m/s, that the scanner assumes
    """
    return 1e-3 * speed / 2 * np.sqrt(8 * np.log(2)) / (2 * np.pi * np.asarray(band_mhz))


def field_along(beam: Along, depth: float, offsets: Array) -> Complex:
    """Two-way field : (n,) beside a line at offsets : (n,) mm, of a Hann aperture with one focus and one focused at the depth.

    Its scale is free.
    """
    depth = max(depth, NEAREST_MM)
    k = 2 * np.pi / beam.wavelength_mm
    sent = beam.transmit_focus_mm / beam.transmit_f_number
    s = (np.arange(POINTS) + 0.5) / POINTS / 2 * sent
    lens = np.cos(np.pi * s / sent) ** 2 * np.exp(1j * k * s**2 / 2 * (1 / depth - 1 / beam.transmit_focus_mm))
    transmit = np.cos(k / depth * np.outer(offsets, s)) @ lens
    received = np.clip(depth / beam.receive_f_number, NEAREST_MM / 2, beam.aperture_mm)
    u = offsets * received / (beam.wavelength_mm * depth)
    u = np.where(np.abs(np.abs(u) - 1) < 1e-6, u + 2e-6, u)
    return np.exp(1j * k * offsets**2 / depth) * transmit * np.sinc(u) / (1 - u**2)


def alike_along(beam: Along, depth: float) -> Callable[[Array], Array]:
    """Correlation of echoes of even tissue by lags, mm, along the array."""
    return _between(_alike(field_along(beam, depth, np.arange(0, REACH_MM + STEP_MM / 2, STEP_MM))))


def alike_deep(band_mhz: float, speed: float, lags_mm: Array) -> Array:
    """Correlation : (n,) of echoes of even tissue at lags : (n,) mm in depth, of a Gaussian pulse."""
    return np.exp(-(np.asarray(lags_mm) ** 2) / (4 * pulse_sigma_mm(band_mhz, speed) ** 2))


def interpolated(alike: Callable[[Array], Array], lags_mm: Array, step_mm: float, share: float) -> Array:
    """Correlation : (n,) of echoes that are interpolated between samples a step apart, with a share of either neighbour's.

    share : 0 of none; 1/6 of a linear one, over all places between two samples
    """
    here, before, after = (alike(lags_mm + shift) for shift in (0.0, -step_mm, step_mm))
    own = (1 - 2 * share) + 2 * share * alike(np.array([step_mm]))
    return ((1 - 2 * share) * here + share * (before + after)) / own


def field_across(slab: Across, depth: float, offsets: Array, bandwidth: float) -> Complex:
    """Two-way field : (n,) across the plane at offsets : (n,) mm, of an even aperture behind a lens, over the echo's band."""
    depth = max(depth, NEAREST_MM)
    s = (np.arange(POINTS_ACROSS) + 0.5) / POINTS_ACROSS / 2 * slab.elevation_mm
    total = np.zeros(len(offsets), complex)
    for share, weight in zip(BAND * bandwidth, np.exp(-8 * np.log(2) * BAND**2), strict=True):
        k = 2 * np.pi / slab.wavelength_mm * max(1 + share, 0.2)
        field = np.cos(k / depth * np.outer(offsets, s)) @ np.exp(1j * k * s**2 / 2 * (1 / depth - 1 / slab.focus_mm))
        total += weight * k * np.exp(1j * k * offsets**2 / depth) * field**2
    return total


def alike_across(slab: Across, depth: float, steps_mm: Array, bandwidth: float) -> Array:
    """Correlation : (n,) of echoes of even tissue after steps : (n,) mm of the probe across the plane.

    The probe takes its curved waves along: less is left than of van Cittert and Zernike's theorem for a fixed aperture.
    """
    z = np.arange(0, slab.elevation_mm / 2 + 1.5, STEP_MM)
    return _between(_alike(field_across(slab, depth, z, bandwidth)))(np.asarray(steps_mm))


def _alike(half: Complex) -> Array:
    """Autocorrelation at lags of whole steps, of an even field's table from its middle on."""
    field = np.concatenate([half[:0:-1], half])
    count = len(field)
    found = np.abs(np.fft.ifft(np.abs(np.fft.fft(field, 2 * count)) ** 2)[:count])
    return found / found[0]


def _between(alike: Array) -> Callable[[Array], Array]:
    """A correlation's table as a function of lags, mm; 0 beyond it."""
    spline, last = CubicSpline(np.arange(len(alike)), alike), len(alike) - 1
    return lambda lags: np.where(np.abs(lags) < last * STEP_MM, spline(np.minimum(np.abs(lags) / STEP_MM, last)), 0.0)
