"""Strung bodies have the volumes of the solids they stand for, and are closed."""

import numpy as np
import pytest

from scenes.handheld import lofts


def test_a_box_and_a_rod_have_their_volumes():
    assert lofts.box([2, 3, 4], [5, 6, 7]).volume == pytest.approx(24)
    assert lofts.rod(10, 50, sides=200, bevel=0.01).volume == pytest.approx(np.pi * 100 * 50, rel=1e-3)


def test_a_bent_cord_has_its_length_s_volume():
    """Pappus: a disc swept along a path has the path's length times the disc's area, whatever the bends."""
    turn = np.linspace(0, np.pi, 80)
    path = np.stack([40 * np.cos(turn), 40 * np.sin(turn), 0 * turn], axis=-1)
    cord = lofts.cord(path, 4, sides=64)
    assert cord.is_watertight
    assert cord.volume == pytest.approx(np.pi * 16 * 40 * np.pi, rel=5e-3)


def test_a_frame_is_a_rotation(rng):
    for z in (*rng.normal(size=(5, 3)), np.array([1.0, 0.3, 0.2])):
        rotation = lofts.frame([0, 0, 0], z)[:3, :3]
        assert np.allclose(rotation.T @ rotation, np.eye(3)) and np.linalg.det(rotation) > 0
        assert np.allclose(rotation[:, 2], z / np.linalg.norm(z))
