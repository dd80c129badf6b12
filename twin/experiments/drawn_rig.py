"""Rigs drawn at random around a given one: cameras, lenses, projectors and light as laboratories have them.

All look at the same volume: focal lengths go with the number of pixels, and the devices stand where they stood.
"""

import numpy as np

from recon.model.rig import CameraDevice, Optics, ProjectorDevice, Rig
from twin.conditions import Conditions, Frames
from twin.ultrasound.transducer import Transducer

CAMERA_SIZES = ((640, 512), (800, 640), (960, 768), (1280, 1024))  # px; the smallest has 0.3 MP
PIXELS_UM = (2.4, 3.45, 4.8, 5.5, 6.9)
PROJECTOR_SIZES = ((854, 534), (1280, 800), (1920, 1200))
ADC_BITS = (8, 10, 12)


def draw(rig: Rig, seed: int) -> tuple[Rig, Conditions]:
    """Draw a rig and the conditions of its frames, the same for the same seed."""
    rng = np.random.default_rng([seed, 60])
    size, pixel_um = CAMERA_SIZES[rng.integers(len(CAMERA_SIZES))], PIXELS_UM[rng.integers(len(PIXELS_UM))]
    adc_bits = ADC_BITS[rng.integers(len(ADC_BITS))]
    cameras = {name: _camera(getattr(rig, name), size, pixel_um, adc_bits, rng) for name in ("cam1", "cam2")}
    projector = _projector(rig.projector, PROJECTOR_SIZES[rng.integers(len(PROJECTOR_SIZES))], rng)
    frames = Frames(flicker=rng.uniform(0.002, 0.02), stray_dn=rng.uniform(0.1, 1.0), shift=rng.uniform(0.002, 0.05))
    return rig.model_copy(update={**cameras, "projector": projector, "measured": {}, "optics_covariance": None}), Conditions(
        frames=frames
    )


def draw_scanner(rng: np.random.Generator) -> Transducer:
    """Draw a linear array of 4 to 12 MHz and a narrow image, with rows of half a wavelength at most."""
    u = rng.uniform
    frequency, depth = u(4, 12), u(30, 45)
    row = min(u(0.04, 0.09), 0.77 / frequency)
    band = u(0.4, 0.8)
    return Transducer(
        image_size=(128, int(depth / row)),
        scale_mm_per_px=(u(0.08, 0.14), row),
        frequency_mhz=frequency,
        bandwidth=(band, band * u(0.7, 1)),
        transmit_focus_mm=u(12, 30),
        transmit_f_number=u(1.8, 4),
        receive_f_number=u(1.5, 4),
        aperture_mm=u(12, 30),
        elevation_mm=u(3, 7),
        elevation_focus_mm=u(14, 30),
        face_ring_mm=u(0.15, 0.5),
        face_ring_db=u(-5, 8),
        tgc_db_per_cm_mhz=u(0.3, 0.7),
        gain_db=u(-35, -22),
        noise_db=u(-70, -40),
        dynamic_range_db=u(45, 80),
        scatterers_per_mm3=64 * max(1, (frequency / 7.5) ** 2),
    )


def _camera(
    device: CameraDevice, size: tuple[int, int], pixel_um: float, adc_bits: int, rng: np.random.Generator
) -> CameraDevice:
    """A camera of a kind, which both of a rig share."""
    optics = _resized(device.optics, size, rng)
    focal_length = optics.focal_px[0] * pixel_um * 1e-3
    lens = device.lens.model_copy(
        update={
            "focal_length_mm": focal_length,
            "f_number": _between(rng, 4, 11) * focal_length / device.lens.focal_length_mm,  # of like blur in px
            "focus_mm": rng.uniform(560, 800),
            "blur_px": rng.uniform(0.35, 0.8),
            "vignetting": rng.uniform(0.02, 0.25),
        }
    )
    sensor = device.sensor.model_copy(
        update={
            "pixel_um": pixel_um,
            "saturation_e": _between(rng, 3000, 30000),
            "dark_noise_e": _between(rng, 2, 25),
            "dsnu_e": _between(rng, 1, 10),
            "prnu": _between(rng, 0.002, 0.015),
            "black_level_dn": rng.uniform(1, 8),
            "adc_bits": adc_bits,
        }
    )
    return device.model_copy(update={"optics": optics, "lens": lens, "sensor": sensor, "serial": int(rng.integers(2**31))})


def _projector(device: ProjectorDevice, size: tuple[int, int], rng: np.random.Generator) -> ProjectorDevice:
    optics = _resized(device.optics, size, rng)
    share = size[0] / device.optics.size[0]  # of pixels, so that blur is like in mm
    lens = device.lens.model_copy(
        update={
            "f_number": _between(rng, 1.8, 4),
            "focus_mm": rng.uniform(560, 800),
            "blur_px": rng.uniform(0.3, 0.7) * share,
            "vignetting": rng.uniform(0.05, 0.3),
        }
    )
    drawn = {"gamma": rng.uniform(1.0, 2.6), "contrast": _between(rng, 200, 3000), "radiant_flux_w": _between(rng, 0.2, 1.5)}
    return device.model_copy(update={"optics": optics, "lens": lens, **drawn})


def _resized(optics: Optics, size: tuple[int, int], rng: np.random.Generator) -> Optics:
    """Optics of another number of pixels over the same view, up to some per cent."""
    share = np.divide(size, optics.size) * (1 + 0.02 * rng.standard_normal())
    middle, shift = (np.array(optics.size) - 1) / 2, 5 * rng.standard_normal(2)
    centre = (np.array(size) - 1) / 2 + (np.array(optics.centre_px) - middle) * share + shift
    distortion = tuple(float(k * (1 + 0.3 * rng.standard_normal())) for k in optics.distortion)
    focal = np.array(optics.focal_px) * share
    return optics.model_copy(
        update={"size": size, "focal_px": tuple(focal.tolist()), "centre_px": tuple(centre.tolist()), "distortion": distortion}
    )


def _between(rng: np.random.Generator, low: float, high: float) -> float:
    """Evenly in the logarithm."""
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))
