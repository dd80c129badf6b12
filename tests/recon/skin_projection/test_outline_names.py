"""A mass's name stands beside its outline: upright for camera 1, off all curves, whole or not at all."""

import numpy as np
import pytest

from recon.skin_projection import mass_outline
from recon.skin_projection.outline_names import GAP, beside
from tests.recon.skin_projection.skin_shapes import PLANE_MM, ball, dome, plane

HEIGHT_MM = 5.0


def names_of(masses, skin, eye=None, reached=lambda name: True):
    curves = [*mass_outline.outlines(masses, skin, eye).values()]
    return curves, beside(curves, masses, skin, eye, HEIGHT_MM, reached)


def known(curve):
    return curve.points[np.isfinite(curve.points).all(axis=1)]


@pytest.mark.parametrize("eye", [None, (60.0, 40.0, 100.0)])
@pytest.mark.parametrize("skin", [plane(), plane(tilt=(0.3, -0.2, 0.0)), dome()], ids=["plane", "tilted", "dome"])
def test_a_name_reads_upright_from_camera_1(skin, eye):
    """The stem of an L is at its left, the foot at its bottom; its height on the skin is what was asked for, but for slopes."""
    _, (name,) = names_of({"L": ball()}, skin, eye)
    pixels = known(name)[:, :2] / known(name)[:, 2:]
    low, high = pixels.min(axis=0), pixels.max(axis=0)
    u, v = ((pixels - low) / (high - low)).T
    assert u[v < 0.7].max() < 0.5 < u[v > 0.95].max()
    assert (high - low)[1] * PLANE_MM == pytest.approx(HEIGHT_MM, rel=0.15)


def test_names_keep_off_all_curves_and_each_other():
    """Three masses side by side, of which each name would like the others' places."""
    masses = {f"mass{k}": ball(5.0, [12.0 * k - 12, 8.0 * (k % 2), 700.0]) for k in range(3)}
    curves, names = names_of(masses, plane())
    assert [name.name for name in names] == [f"name of {mass}" for mass in masses]
    for k, name in enumerate(names):
        for other in (*curves, *names[:k], *names[k + 1 :]):
            apart = np.linalg.norm(known(name)[:, None] - known(other)[None], axis=-1).min()
            assert apart > 0.7 * GAP * HEIGHT_MM, (name.name, other.name)


def test_a_name_that_isnt_lit_moves_on_and_at_last_is_left_out():
    usual = names_of({"mass0": ball()}, plane())[1][0]
    over = known(usual)[:, 1].mean()
    (moved,) = names_of({"mass0": ball()}, plane(), reached=lambda name: known(name)[:, 1].mean() > over + 1)[1]
    assert known(moved)[:, 1].mean() > over + 1
    assert names_of({"mass0": ball()}, plane(), reached=lambda name: False)[1] == []


def test_where_the_skin_ends_there_is_no_name():
    assert names_of({"mass0": ball()}, plane(size=(26.0, 24.0)))[1] == []
