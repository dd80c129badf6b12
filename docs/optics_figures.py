"""Compute the figures of docs/physics-optics.md from conf/rig/meza2021.yaml: `.venv/bin/python docs/optics_figures.py`."""

import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import yaml
from scipy.constants import c, h
from scipy.special import j1

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))  # the packages beside these pages, whatever is installed

from recon.model.rig import Rig  # noqa: E402

RIG = Rig(**yaml.safe_load((ROOT / "conf" / "rig" / "meza2021.yaml").read_text(encoding="utf-8")))
CAMERA, PROJECTOR = RIG.cam1.optics.camera(), RIG.projector.optics.camera()
SENSOR, LENS = RIG.cam1.sensor, RIG.cam1.lens
FX = RIG.projector.optics.focal_px[0]
PIXEL = FX / CAMERA.matrix[0, 0]  # of the camera, projector px
LENSES = np.hypot(RIG.projector.lens.blur_px, LENS.blur_px * PIXEL)  # both point spreads, projector px
STEPS, PITCH, MODULATION = 8, 12.0, 90.0  # the fringes: px, DN


def light() -> str:
    """A white surface (albedo 0.8) that faces the projector at 655 mm."""
    (width, height), (fx, fy) = RIG.projector.optics.size, RIG.projector.optics.focal_px
    intensity = RIG.projector.radiant_flux_w * fx * fy / (width * height)  # W/sr, on the axis
    surface = intensity / 0.655**2  # W/m^2
    on_sensor = np.pi * (0.8 * surface / np.pi) / (4 * LENS.f_number**2)  # W/m^2
    photons = on_sensor * (SENSOR.pixel_um * 1e-6) ** 2 * RIG.projector.wavelength_nm * 1e-9 / (h * c)  # 1/s
    exposure = 0.8 * SENSOR.saturation_e / (photons * SENSOR.quantum_efficiency)  # s
    return f"light    {intensity:.2f} W/sr, {surface:.2f} W/m^2, {photons:.3g} photons/s, 80 % full after {1e3 * exposure:.1f} ms"


def noise() -> tuple[float, str]:
    """Noise at a mean of 100 DN, in DN."""
    gain = (256 - SENSOR.black_level_dn) / SENSOR.saturation_e  # DN/e
    electrons = (100 - SENSOR.black_level_dn) / gain
    sigma = float(np.sqrt(gain**2 * (electrons + SENSOR.dark_noise_e**2) + 1 / 12))
    shot = gain * np.sqrt(electrons)
    return sigma, f"sensor   {1 / gain:.1f} e/DN, {electrons:.0f} e, sigma {sigma:.2f} DN, shot noise alone {shot:.2f} DN"


def fringes(sigma: float) -> Iterator[str]:
    """Noise of phase, column and depth along the rays of the image's middle row; and of a heterodyne order."""
    phase = np.sqrt(2 / STEPS) * sigma / MODULATION
    column = PITCH / (2 * np.pi) * phase
    yield f"fringes  sigma_phi {1e3 * phase:.1f} mrad, sigma_u {column:.4f} px"
    rays = CAMERA.rays(np.stack([np.linspace(0, 1279, 9), np.full(9, 511.5)], axis=-1))
    rays /= rays[:, 2:]
    baseline = np.hypot(PROJECTOR.centre[0], PROJECTOR.centre[2])  # across the fringes
    for depth in (606.0, 655.0, 713.0):
        near, far = (PROJECTOR.project(rays * z)[:, 0] for z in (depth - 0.5, depth + 0.5))
        mm_per_px = (1 / np.abs(far - near)).mean()
        yield (
            f"  at {depth:.0f} mm: {mm_per_px:.2f} mm/px (rule {depth**2 / (baseline * FX):.2f}), "
            f"sigma_z {1e3 * mm_per_px * column:.0f} um, one period {PITCH * mm_per_px:.1f} mm"
        )
    ratio = 1280 / 18  # a beat of the whole axis from fringes of 18 px
    yield f"beat     sigma_k {phase / (2 * np.pi) * np.hypot(ratio, ratio - 1):.2f}"


def transfer(frequency, disc: float, blur: float):
    """Modulation that pixel, point spreads and a blur disc (px) leave of a frequency, 1/px."""
    x = np.pi * disc * frequency
    return np.sinc(PIXEL * frequency) * np.exp(-2 * (np.pi * blur * frequency) ** 2) * (2 * j1(x) / x if disc > 0 else 1)


def ripple(disc: float, blur: float) -> float:
    """Ripple of the mirrors, px RMS."""
    u = np.linspace(0, 1, 200, endpoint=False)
    frequencies = np.arange(-40, 41) + 1 / PITCH
    field = sum(np.sinc(f) * transfer(f, disc, blur) * np.exp(2j * np.pi * f * u) for f in frequencies)
    return float(np.std(np.angle(field * np.exp(-2j * np.pi * u / PITCH))) * PITCH / (2 * np.pi))


def defocus() -> Iterator[str]:
    """Blur discs, the modulation that they leave, the ripple of resolved mirrors, and harmonics of binary fringes."""
    for focus in (RIG.projector.lens.focus_mm, 540.0):
        for depth in (606.0, 655.0, 713.0):
            disc = RIG.projector.lens.aperture_mm * FX * abs(1 / focus - 1 / depth)
            yield (
                f"focus {focus:.0f} at {depth:.0f} mm: disc {disc:.2f} px, modulation {transfer(1 / PITCH, disc, LENSES):.3f}, "
                f"ripple {ripple(disc, LENSES):.4f} px rms, ideal lenses {ripple(disc, 0):.4f}"
            )
    for period, disc, orders in ((12, 0, (7, 9)), (12, 1.4, (7, 9)), (12, 2.3, (7, 9)), (18, 0, (17, 19)), (18, 2.3, (17, 19))):
        left = [1e3 * transfer(k / period, disc, LENSES) / transfer(1 / period, disc, LENSES) / k for k in orders]
        yield f"binary {period} px, disc {disc} px: harmonics {orders} {left[0]:.1f}, {left[1]:.1f} mrad"


def circle() -> str:
    """Bias of the target's ellipse against its circle's centre, and the noise of a centre."""
    radius, depth, tilt = RIG.target.outer_diameter_mm / 2, 690.0, np.deg2rad(30)
    bias = CAMERA.matrix[0, 0] * radius**2 * np.sin(tilt) * np.cos(tilt) / depth**2
    radius_px = CAMERA.matrix[0, 0] * radius / depth
    of_noise = 1 / 50 * np.sqrt(2 * np.sqrt(np.pi) * 0.7 / (np.pi * radius_px))
    return f"circle   bias {bias:.2f} px, noise {of_noise:.4f} px"


def lines() -> Iterator[str]:
    """All figures, a line each."""
    sigma, of_sensor = noise()
    yield light()
    yield of_sensor
    yield from fringes(sigma)
    yield from defocus()
    yield circle()


if __name__ == "__main__":
    sys.stdout.writelines(f"{line}\n" for line in lines())
