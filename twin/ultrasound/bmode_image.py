"""From echoes to grey levels: point spread, noise, gain over depth, envelope, logarithm, quantisation."""

from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import fft
from scipy.signal import fftconvolve, lfilter
from scipy.signal.windows import gaussian

from recon.compiled import kernel
from recon.threads import in_threads
from scenes.acoustics import BACKSCATTER
from twin.ultrasound.beam import OVERSAMPLING, Beam
from twin.ultrasound.beam import beam as beam_of
from twin.ultrasound.scan_lines import converted, lines_of
from twin.ultrasound.scanner_picture import compressed_image, mapped_greys, processed
from twin.ultrasound.sound_paths import Paths
from twin.ultrasound.transducer import Transducer

Array = NDArray[np.float64]
Field = NDArray[np.complex64]


def envelope(echoes: Field, transducer: Transducer, beam: Beam, paths: Paths, rng: np.random.Generator) -> NDArray[np.float32]:
    """Envelope : (rows, lines) after the gain, 1 for the reference tissue, of echoes at their places.

    Looks of several bands and directions are averaged by power.
    """
    picture, looks = transducer.picture, transducer.picture.bands * transducer.picture.angles
    gain, ringing = gain_over_depth(transducer, beam).astype(np.float32), face(transducer).astype(np.float32)
    power = np.zeros((len(beam.axial), lines_of(transducer).count), np.float32)
    shares = _shares_of_focus(transducer, beam, paths)
    grain = noise(transducer, beam, rng)  # of one look; others have it elsewhere
    for band in range(picture.bands):
        pulses = in_depth(echoes, beam.axial if picture.bands == 1 else part_of_band(beam, transducer, band))
        spectrum = fft.fft(pulses)
        for angle in range(picture.angles):
            received = fft.ifft(spectrum * _spectra(transducer, angle))
            shift = (band * picture.angles + angle) * len(grain) // looks
            in_threads(_add_power, len(power), power, received, shares, grain, shift, gain, ringing)
    power /= looks
    return np.sqrt(power if picture.clutter_db == -100 else power + _clutter(power, transducer, rng))


def _shares_of_focus(transducer: Transducer, beam: Beam, paths: Paths) -> NDArray[np.float32]:
    """Amplitude of the sharp beam : (1, rows, lines); of several rays also of the blunt one, as tissues leave of it."""
    if transducer.aperture_rays == 1:
        return np.ones((1, len(beam.lateral), len(paths.focus)), np.float32)
    shares = np.empty((2, len(beam.lateral), len(paths.focus)), np.float32)
    alike, evened = _blunt_beside_sharp(transducer)
    in_threads(_share, len(paths.focus), shares, paths, transducer.rows_mm, lines_of(transducer).pitch_mm, alike, evened)
    return shares


@lru_cache(maxsize=8)
def _blunt_beside_sharp(transducer: Transducer) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Correlation of both beams' echoes of the same scatterers, and the root of their powers, sharp over blunt : (rows,)."""
    sharp, wide = beam_of(transducer), blunt(transducer)
    inner, energies = (sharp.lateral * wide.lateral.conj()).sum(axis=1).real, (np.abs(sharp.lateral) ** 2).sum(axis=1)
    alike = inner / np.sqrt(energies * (np.abs(wide.lateral) ** 2).sum(axis=1))
    return alike.astype(np.float32), np.sqrt(sharp.lateral_energy / wide.lateral_energy).astype(np.float32)


@lru_cache(maxsize=9)  # as many as the most directions
def _spectra(transducer: Transducer, angle: int) -> Field:
    """Spectra along the array of the sharp point spread of a look, and of the blunt one of several rays : (1 | 2, rows, n)."""
    beams = [beam_of(transducer)] if transducer.aperture_rays == 1 else [beam_of(transducer), blunt(transducer)]
    count = lines_of(transducer).count + beams[0].lateral.shape[1] - 1
    return np.stack([_spectrum_along(steered(one.lateral, transducer, angle), one.reach, count) for one in beams])


@lru_cache(maxsize=8)
def blunt(transducer: Transducer) -> Beam:
    """The beam of a third of the apertures: what a disturbed wave front leaves of it, whose patches agree no farther; assumed."""
    third = {name: 3 * getattr(transducer, name) for name in ("transmit_f_number", "receive_f_number")}
    return beam_of(transducer.model_copy(update=third | {"aperture_mm": transducer.aperture_mm / 3}))


def steered(lateral: Field, transducer: Transducer, angle: int) -> Field:
    """The point spread along the array of one of the directions that are compounded: its phase runs across it."""
    picture = transducer.picture
    if picture.angles == 1:
        return lateral
    tilt = np.deg2rad(picture.steered_deg) * (2 * angle / (picture.angles - 1) - 1)
    turn = 2 * transducer.wavenumber * np.sin(tilt) * lines_of(transducer).pitch_mm  # rad from line to line
    kept = 2 / 3 + np.cos(turn) / 3  # of the power, as echoes between two lines are shared by both
    lines = np.arange(lateral.shape[1]) - lateral.shape[1] // 2
    return (lateral * np.exp(1j * turn * lines) / np.sqrt(kept)).astype(np.complex64)


def part_of_band(beam: Beam, transducer: Transducer, band: int) -> Field:
    """The pulse of one of the parts of the band that are compounded : (rows, taps), as much longer as it is narrower."""
    bands, row = transducer.picture.bands, transducer.scale_mm_per_px[1] / OVERSAMPLING
    sigma = transducer.axial_sigma_mm(transducer.rows_mm)[:, None]
    taps = int(np.ceil(3.3 * bands**0.5 * sigma.max() / row))
    z = row * np.arange(-taps, taps + 1)
    middle = (band - (bands - 1) / 2) * 2.0 / np.sqrt(bands) / (2 * sigma)  # rad/mm from the band's middle
    narrow = bands**0.5
    pulse = np.exp(-(z**2) / (2 * (narrow * sigma) ** 2)) / narrow**0.5
    return (pulse * np.exp(2j * middle * z)).astype(np.complex64)


def _clutter(power: NDArray[np.float32], transducer: Transducer, rng: np.random.Generator) -> NDArray[np.float32]:
    """Power of what is smeared along the array, and trails in depth, with speckle of its own."""
    picture, sx, sy = transducer.picture, lines_of(transducer).pitch_mm, transducer.scale_mm_per_px[1]
    trail_mm = 3.0  # by which echoes between layers trail behind
    reach = int(3 * picture.clutter_mm / sx + 0.5)
    weights = gaussian(2 * reach + 1, picture.clutter_mm / sx).astype(np.float32)
    padded = np.pad(power, [(0, 0), (reach, reach)], mode="edge")
    decay, smeared = np.exp(-sy / trail_mm), fftconvolve(padded, weights[None] / weights.sum(), mode="valid", axes=1)
    smeared = np.asarray(lfilter([1 - decay], [1, -decay], np.maximum(smeared, 0), axis=0))  # Fourier's rounding may be below 0
    grain = rng.exponential(size=(len(power) // 2 + 1, power.shape[1] // 4 + 1)).astype(np.float32)
    grain = cv2.resize(grain, power.shape[::-1], interpolation=cv2.INTER_CUBIC).clip(0)
    return (10 ** (picture.clutter_db / 10) * smeared * grain).astype(np.float32)


def shown(envelope: NDArray[np.float32], transducer: Transducer) -> NDArray[np.float32]:
    """Shares of the grey scale : (rows, lines) of an envelope, before persistence and the grey map."""
    picture, lines = transducer.picture, lines_of(transducer)
    if picture.sliders_db:
        places = np.linspace(0, 1, len(picture.sliders_db))
        gain = 10 ** (np.interp(np.linspace(0, 1, len(envelope)), places, picture.sliders_db) / 20)
        envelope = envelope * np.float32(gain)[:, None]
    return processed(compressed(envelope, transducer), picture, lines.pitch_mm, transducer.scale_mm_per_px[1])


def image(share: NDArray[np.float32], transducer: Transducer) -> NDArray[np.uint8]:
    """The image (h, w) of shares of the grey scale : (rows, lines)."""
    mapped = converted(mapped_greys(share, transducer.picture), transducer, order=1)
    return compressed_image(grey(mapped, transducer), transducer.picture)


def focused(field: Field, beam: Beam) -> Field:
    """Echoes after pulse and beam : (h, w), from a field of echoes at their places: the coherent sum."""
    pulses = in_depth(field, beam.axial)
    count = len(field) - beam.lateral.shape[1] + 1
    return fft.ifft(fft.fft(pulses) * _spectrum_along(beam.lateral, beam.reach, len(field)))[:, :count]


def in_depth(field: Field, axial: NDArray) -> Field:
    """Echoes after the pulse : (rows, lines)."""
    pulses = np.zeros((len(axial), len(field)), np.complex64)
    in_threads(_in_depth, len(axial), pulses, np.ascontiguousarray(field.T), axial)
    return pulses


def _spectrum_along(lateral: Field, reach: NDArray[np.int64], count: int) -> Field:
    """Spectrum : (rows, n) of the point spread along the array, for n lines with room for its width."""
    half = lateral.shape[1] // 2
    within = np.abs(np.arange(-half, half + 1)) <= reach[:, None]
    return fft.ifft(lateral * within, count, norm="forward")


def _reference_power(transducer: Transducer, beam: Beam) -> Array:
    """Mean power : (h,) of the echo of the reference tissue, without attenuation; a perfect mirror has about 1."""
    row = transducer.scale_mm_per_px[1] / OVERSAMPLING
    pulse = (beam.axial**2).sum(axis=1) * row
    return BACKSCATTER * transducer.wavelength_mm**2 * beam.lateral_energy * beam.elevation_energy * pulse


def noise(transducer: Transducer, beam: Beam, rng: np.random.Generator) -> Field:
    """Electronic noise : (h, w), of the same power at every depth, before the gain."""
    height, width = len(beam.axial), lines_of(transducer).count
    focus = np.interp(transducer.transmit_focus_mm, transducer.rows_mm, _reference_power(transducer, beam))
    sigma = np.sqrt(focus / 2) * 10 ** (transducer.noise_db / 20)
    parts = rng.standard_normal((height, width, 2), dtype=np.float32)
    parts *= np.float32(sigma)
    return parts.view(np.complex64)[..., 0]


def gain_over_depth(transducer: Transducer, beam: Beam) -> Array:
    """Amplification : (h,) that shows the reference tissue, attenuated as assumed, with a mean power of 1 at every depth."""
    loss = transducer.tgc_db_per_cm_mhz * transducer.frequency_mhz * transducer.rows_mm / 5
    return 10 ** (np.minimum(loss, transducer.tgc_limit_db) / 20) / np.sqrt(_reference_power(transducer, beam))


def face(transducer: Transducer) -> Array:
    """Ringing of the transducer itself : (h,), after the gain, over the reference tissue."""
    if transducer.face_ring_mm == 0:
        return np.zeros(len(transducer.rows_mm))
    level = 10 ** ((transducer.face_ring_db - transducer.gain_db) / 20)
    depth = transducer.rows_mm
    ripple = 1 + 0.35 * np.cos(2 * np.pi * depth / (3.3 * transducer.wavelength_mm))
    return level * ripple * np.exp(-depth / transducer.face_ring_mm)


def compressed(envelope: NDArray[np.float32], transducer: Transducer) -> NDArray[np.float32]:
    """Share of the grey scale, 0 to 1, of an envelope after the gain, where 1 is the reference tissue: its logarithm."""
    db = 20 * np.log10(np.maximum(envelope, 1e-12)) + transducer.gain_db
    return np.clip(1 + db / transducer.dynamic_range_db, 0, 1)


def grey(share: NDArray[np.float32], transducer: Transducer) -> NDArray[np.uint8]:
    """Grey levels of shares of the grey scale."""
    levels = 2**transducer.bits - 1
    steps = np.rint(levels * share)
    return np.rint(steps * (255 / levels)).astype(np.uint8)


@kernel(fastmath=True)
def _in_depth(first, end, pulses, samples, axial):
    """Sum the echoes of samples : (OVERSAMPLING rows, lines) over the pulse of some rows."""
    taps = axial.shape[1]
    for r in range(first, end):
        start = OVERSAMPLING * r - taps // 2
        for t in range(max(0, -start), min(taps, len(samples) - start)):
            weight = axial[r, t]
            for line in range(pulses.shape[1]):
                pulses[r, line] += weight * samples[start + t, line]


@kernel(fastmath=True)
def _share(first, end, shares, paths, rows_mm, pitch_mm, alike, evened):
    """Share the echoes of some lines among both beams, by the focus of the places shown there: of other depths, and aside."""
    count, levels = paths.focus.shape
    for line in range(first, end):
        level, deep = 0, paths.shown_mm[line, 0]
        for row in range(len(rows_mm)):
            while level < levels - 1 and (deep + paths.shown_mm[line, level + 1]) / 2 < rows_mm[row]:
                level += 1
                deep = max(deep, paths.shown_mm[line, level])  # behind what slows sound down it may seem to turn back
            place = min(max(line + int(np.rint(paths.shift_mm[line, level] / pitch_mm)), 0), count - 1)
            focus = paths.focus[place, level]
            left = paths.edges[place, level] / np.sqrt(1 + 2 * np.sqrt(focus * (1 - focus)) * alike[row])
            shares[0, row, line] = np.sqrt(focus) * left
            shares[1, row, line] = evened[row] * np.sqrt(1 - focus) * left


@kernel(fastmath=True)
def _add_power(first, end, power, received, shares, grain, shift, gain, ringing):
    """Add the power of one look to some rows: of all beams' echoes, the noise, and the face."""
    for r in range(first, end):
        noisy = grain[r - shift]
        for x in range(power.shape[1]):
            echo = noisy[x]
            for beam in range(len(shares)):
                echo += shares[beam, r, x] * received[beam, r, x]
            echo = gain[r] * echo + ringing[r]
            power[r, x] += echo.real * echo.real + echo.imag * echo.imag
