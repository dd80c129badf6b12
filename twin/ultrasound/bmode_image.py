"""From echoes to grey levels: point spread, noise, gain over depth, envelope, logarithm, quantisation."""

import numpy as np
from numpy.typing import NDArray

from recon.compiled import kernel
from recon.threads import in_threads
from scenes.acoustics import BACKSCATTER
from twin.ultrasound.beam import OVERSAMPLING, Beam
from twin.ultrasound.scan_lines import lines_of
from twin.ultrasound.transducer import Transducer

Array = NDArray[np.float64]
Field = NDArray[np.complex64]


def focused(field: Field, beam: Beam) -> Field:
    """Echoes after pulse and beam : (h, w), from a field of echoes at their places: the coherent sum."""
    height, (lines, width) = len(beam.axial), (len(field), len(field) - beam.lateral.shape[1] + 1)
    pulses, focused = np.zeros((height, lines), np.complex64), np.zeros((height, width), np.complex64)
    in_threads(_in_depth, lines, pulses, field, beam.axial)
    in_threads(_along, height, focused, pulses, beam.lateral, beam.reach)
    return focused


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
def _in_depth(first, end, pulses, field, axial):
    rows, taps = axial.shape
    reach, samples = taps // 2, field.shape[1]
    for line in range(first, end):
        for r in range(rows):
            total = np.complex64(0)
            middle = OVERSAMPLING * r
            for t in range(max(0, reach - middle), min(taps, samples - middle + reach)):
                total += axial[r, t] * field[line, middle + t - reach]
            pulses[r, line] = total


@kernel(fastmath=True)
def _along(first, end, focused, pulses, lateral, reach):
    half = lateral.shape[1] // 2
    for r in range(first, end):
        for t in range(half - reach[r], half + reach[r] + 1):
            weight = lateral[r, t]
            for x in range(focused.shape[1]):
                focused[r, x] += weight * pulses[r, x + t]
