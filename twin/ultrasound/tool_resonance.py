"""Echo of an endless round shaft, front and all that rings within it: a series of partial waves for concentric fluids.

With the radial wavenumbers of the media at a tilt, waves are `J_n + A_n H_n` outside, `J_n + q_n H_n` in the wall, and `J_n` in
the bore; pressure and the radial velocity `(1 / rho) dp/dr` are continuous at each border. At high orders J_n is too small and
H_n too large for numbers, so that logarithmic derivatives and ratios stand for both. What comes back is that of a strip of a
perfect mirror of the width

    W = lambda / pi sum_n eps_n (-1)^n A_n,

which tends to `R sqrt(a lambda cos(tilt) / 2)` for the front alone. Over frequencies, W is the spectrum of an echo in depth.
Beyond the critical angle, 15 deg for steel in water, the wall lets next to nothing in. Shear waves of the wall are left out, as
everywhere in the twin. Source: Morse and Ingard, Theoretical Acoustics, section 8.2.
"""

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import hankel1, jv

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

TILT_STEP, TILTS = float(np.deg2rad(2.0)), 9  # between a table's rows, rad, and their number; the last stands for steeper ones
RANGE_MM = 12.0  # as shown, over which echoes are sampled; what rings longer fades out over the last two thirds
BEFORE = 16  # samples before the front, and after the last: where the band's own ripples are
FAINTEST = 1e-3  # of the strongest, where a row ends
DAMPED = 0.03  # amplitude over the range, by complex wavenumbers: what comes later doesn't fold back
FLAT, BAND = 0.6, 0.8  # shares of the raster's band: where it begins to fade, and where it ends; a pulse fills less


class Layers(NamedTuple):
    """A round shaft in a medium, and the raster on which its echo is sampled."""

    radius: float  # mm
    bore: float  # mm, radius; 0 is solid
    around: tuple[float, float, float]  # impedance, MRayl, speed, m/s, and loss, nepers a mm one way
    wall: tuple[float, float, float]
    filling: tuple[float, float, float]
    wavenumber: float  # rad/mm at the assumed speed
    assumed_speed: float  # m/s
    step_mm: float  # as shown


@lru_cache(maxsize=64)
def resonance(layers: Layers) -> NDArray[np.complex64]:
    """Echo of a shaft by tilt and depth, demodulated : (TILTS, n) mm, width of a mirror's strip; its front at sample BEFORE."""
    count = int(RANGE_MM / layers.step_mm)
    bins = np.arange(-int(BAND * count / 2), int(BAND * count / 2) + 1)
    damping = -np.log(DAMPED) / (2 * count * layers.step_mm)
    k = layers.wavenumber + np.pi * bins / (count * layers.step_mm)
    fade = np.clip((2 * np.abs(bins) / count - FLAT) / (BAND - FLAT), 0, 1)
    width = strip_width(k + 1j * damping, TILT_STEP * np.arange(TILTS)[:, None], layers) * np.cos(np.pi / 2 * fade) ** 2
    depths = layers.step_mm * (np.arange(count) - BEFORE)
    echo = width @ np.exp(-2j * np.outer(k - layers.wavenumber, depths)) / count * np.exp(2 * damping * depths)
    echo *= np.cos(np.pi / 2 * np.clip(1.5 * depths / RANGE_MM - 0.5, 0, 1)) ** 2
    loud = np.abs(echo[:, :-BEFORE]).max(axis=0)
    last = int(np.flatnonzero(loud > FAINTEST * loud.max())[-1])
    return echo[:, : last + 1].astype(np.complex64)


def strip_width(k: Complex, tilt: Array | float, layers: Layers) -> Complex:
    """Width of a mirror's strip with the same echo, mm, its front at depth 0; k in rad/mm at the assumed speed, tilt in rad."""
    slowed = k * layers.assumed_speed
    along = np.sin(tilt) * slowed / layers.around[1]
    radial = [np.sqrt((slowed / speed + 1j * loss) ** 2 - along**2) for _, speed, loss in _media(layers)]
    radial = [np.where(root.imag < 0, -root, root) for root in radial]  # H decays outwards, where the wall's waves do, too
    density = [impedance / speed for impedance, speed, _ in _media(layers)]
    orders = np.arange(int(np.abs(radial[0]).max() * layers.radius) + 12)
    push = [each[..., None] / rho for each, rho in zip(radial, density, strict=True)]
    outside, wall = (_Waves.at(orders, radial[k][..., None] * layers.radius) for k in (0, 1))
    stiff = push[1] * wall.standing
    if layers.bore:
        inner, bore = (_Waves.at(orders, radial[k][..., None] * layers.bore) for k in (1, 2))
        filled, across = push[2] * bore.standing, np.cumprod(inner.steps / wall.steps, axis=-1)
        q = -across * (push[1] * inner.standing - filled) / (push[1] * inner.outgoing - filled)  # times H / J at the front
        stiff = push[1] * (wall.standing + q * wall.outgoing) / (1 + q)
    scattered = -np.cumprod(outside.steps, axis=-1) * (push[0] * outside.standing - stiff) / (push[0] * outside.outgoing - stiff)
    total = (np.where(orders == 0, 1, 2) * (-1.0) ** orders * scattered).sum(axis=-1)
    return 2 * layers.around[1] / slowed * total * np.exp(2j * radial[0] * layers.radius)


class _Waves(NamedTuple):
    """Bessel functions J and Hankel functions H of the orders n at a border."""

    standing: Complex  # (..., n) J' / J
    outgoing: Complex  # (..., n) H' / H
    steps: Complex  # (..., n) J / H over that of the order before; of order 0 J / H

    @classmethod
    def at(cls, orders: NDArray[np.int64], x: Complex) -> "_Waves":
        """Of all orders from 0 on at x : (..., 1), by recurrences each in the direction in which it is stable."""
        twice = 2 / x[..., 0]
        reach = float(np.abs(x).max())
        rising = [np.zeros_like(twice)]  # J_n / J_(n-1), from far beyond the orders that the waves reach
        for n in range(max(len(orders), int(reach + 10 * np.cbrt(reach)) + 20), 0, -1):
            rising.append(1 / (n * twice - rising[-1]))
        more = np.stack(rising[::-1], axis=-1)[..., : len(orders)]  # of the order after each
        first, second = hankel1(0, x[..., 0]), hankel1(1, x[..., 0])
        falling = [first / second]  # H_(n-1) / H_n
        for n in orders[1:-1]:
            falling.append(1 / (n * twice - falling[-1]))
        less = np.stack(falling, axis=-1)
        steps = np.concatenate([(jv(0, x[..., 0]) / first)[..., None], more[..., :-1] * less], axis=-1)
        outgoing = np.concatenate([-(second / first)[..., None], less - orders[1:] / x], axis=-1)
        return cls(orders / x - more, outgoing, steps)


def _media(layers: Layers) -> tuple[tuple[float, float, float], ...]:
    return layers.around, layers.wall, layers.filling
