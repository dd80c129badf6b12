"""Exact images of blurred discs for tests, by their Fourier transform: pixel, point spread and disc of confusion are factors."""

import numpy as np
from scipy.special import j1

SIDE, FINE = 48, 4  # px of a tile; points a pixel, beyond whose frequencies nothing is left of the narrowest blur
FREQUENCIES = np.fft.fftfreq(SIDE * FINE, 1 / FINE)
ACROSS, DOWN = np.meshgrid(FREQUENCIES, FREQUENCIES)  # periods a px


def airy(x):
    """The transform of a disc, 2 J1(x) / x."""
    return 2 * j1(x + 1e-9) / (x + 1e-9)


def share(centre, axes, turn, blur, disc, print_px=0.0):
    """Share of black : (SIDE, SIDE) in each pixel, of an ellipse; blur and print are standard deviations, the disc a diameter."""
    cos, sin = np.cos(turn), np.sin(turn)
    stretched = np.hypot(axes[0] * (cos * ACROSS + sin * DOWN), axes[1] * (cos * DOWN - sin * ACROSS))
    shape = np.pi * axes[0] * axes[1] * airy(2 * np.pi * stretched)
    frequency = np.hypot(ACROSS, DOWN)
    spread = np.exp(-2 * np.pi**2 * (blur**2 + print_px**2) * frequency**2) * airy(np.pi * disc * frequency)
    moved = np.exp(-2j * np.pi * (ACROSS * centre[0] + DOWN * centre[1]))
    return np.fft.ifft2(shape * spread * np.sinc(ACROSS) * np.sinc(DOWN) * moved).real[::FINE, ::FINE] * FINE**2
