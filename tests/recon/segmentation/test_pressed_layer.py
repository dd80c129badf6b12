"""An elastic layer under a foot, against closed forms, and its waves against their differential equation."""

import numpy as np
import pytest
from scipy.integrate import solve_bvp

from recon.segmentation import pressed_layer
from recon.segmentation.pressed_layer import Patches

DEEP_MM = 1e4  # of a base that counts as none


def patches_over(x_mm: float, y_mm: float, counts: tuple[int, int]) -> Patches:
    """Patches over a rectangle of half sides about the origin."""
    halves = x_mm / counts[0], y_mm / counts[1]
    x, y = (half * (2 * np.arange(count) + 1 - count) for half, count in zip(halves, counts, strict=True))
    along, across = np.meshgrid(x, y, indexing="ij")
    return Patches(along.ravel(), across.ravel(), halves)


def test_under_a_round_punch_tissue_follows_as_in_closed_form():
    """On the axis of a flat punch of radius a, over a deep layer: `2/pi (atan(a/z) + a z / (a^2 + z^2))` of its depth.

    Sneddon 1965, from the pressure `1 / sqrt(a^2 - r^2)` and Hankel's transform at Poisson's ratio 1/2.
    """
    radius, depths = 10.0, np.array([0.0, 2.0, 5.0, 10.0, 20.0, 40.0])
    square = patches_over(radius, radius, (22, 22))
    inside = np.hypot(square.x, square.y) < radius
    disc = Patches(square.x[inside], square.y[inside], square.half_mm)
    force = pressed_layer.pressures(pressed_layer.compliance(disc, DEEP_MM), np.full(len(disc.x), 2.0))
    found = (pressed_layer.respond(disc, np.zeros(1), depths, DEEP_MM).down @ force)[0]
    expected = 2 * 2 / np.pi * (np.arctan2(radius, depths) + radius * depths / (radius**2 + depths**2))
    assert found == pytest.approx(expected, rel=0.015)


def test_under_even_pressure_the_skin_gives_way_as_love_found():
    """In the middle of a rectangle of half sides a and b: `4 (a asinh(b/a) + b asinh(a/b))`, and half of it at its side's."""
    a, b = 6.0, 2.0
    one, two = patches_over(a, b, (1, 1)), patches_over(a, b, (2, 1))
    middle = pressed_layer.respond(one, np.zeros(1), np.zeros(1), DEEP_MM).down[0, 0, 0]
    assert middle == pytest.approx(4 * (a * np.arcsinh(b / a) + b * np.arcsinh(a / b)), rel=1e-3)
    both = pressed_layer.respond(two, np.zeros(1), np.zeros(1), DEEP_MM).down[0, 0].sum()
    assert both == pytest.approx(middle, rel=1e-9)


@pytest.mark.parametrize("base_mm", [20.0, 45.0])
def test_a_layer_keeps_its_volume_and_rests_on_its_base(base_mm):
    """Below a square, stretches along and across are alike: twice the one makes up for what is pressed together."""
    square, step = patches_over(3.0, 3.0, (1, 1)), 1e-3
    for depth in (3.0, 8.0, 15.0):
        found = pressed_layer.respond(square, np.array([-step, 0, step]), depth + np.array([-step, 0, step]), base_mm)
        along = (found.along[2, 1, 0] - found.along[0, 1, 0]) / (2 * step)
        down = (found.down[1, 2, 0] - found.down[1, 0, 0]) / (2 * step)
        assert down < 0 < along and 2 * along == pytest.approx(-down, rel=2e-3)
    held = pressed_layer.respond(square, np.linspace(0, 30, 7), np.array([0.0, base_mm]), base_mm)
    assert np.abs([held.down[:, 1], held.along[:, 1]]).max() < 0.01 * held.down[0, 0, 0]


@pytest.mark.parametrize("height", [0.5, 2.0, 6.0])
def test_waves_of_a_layer_solve_their_equation(height):
    """A slow, plain solution of `w'''' - 2 w'' + w = 0` of a wave's displacement over s = k z, for a layer of height k h."""

    def slopes(_, w):
        return np.stack([w[1], w[2], w[3], 2 * w[2] - w[0]])

    def ends(top, bottom):
        no_shear, pressure = top[2] + top[0], 3 * top[1] - top[3] + 2
        return np.array([no_shear, pressure, bottom[0], bottom[1]])

    s = np.linspace(0, height, 200)
    solved = solve_bvp(slopes, ends, s, np.zeros((4, len(s))), tol=1e-8).sol(s)
    down, outwards = pressed_layer._held(np.ones(1), s, height)
    assert down + (1 + s) * np.exp(-s) == pytest.approx(solved[0], abs=1e-6)
    assert outwards + s * np.exp(-s) == pytest.approx(-solved[1], abs=1e-6)


def test_a_foot_pushes_where_it_touches_alone():
    """On a round skin: no patch pulls, the skin lies in the face where one pushes, and below it elsewhere."""
    foot = patches_over(20.0, 5.0, (12, 3))
    depths = 1.5 - (foot.x**2 + foot.y**2) / 120
    skin = pressed_layer.compliance(foot, 45.0)
    force = pressed_layer.pressures(skin, depths)
    over = skin @ force - depths
    assert (force >= 0).all() and 0 < (force > 0).sum() < len(force)
    assert np.abs(over[force > 0]).max() < 1e-9 and over.min() > -1e-9
