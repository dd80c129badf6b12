"""Pixels inside closed surfaces, against closed forms."""

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from recon.geometry import rigid
from recon.segmentation.scan_masks import mask_of

SIZE, SCALE = (120, 100), np.array([0.3, 0.25])


@pytest.mark.parametrize("seed", range(3))
def test_a_ball_is_cut_to_a_disc(seed):
    """Of the radius that its distance from the plane leaves, wherever the probe stands."""
    rng = np.random.default_rng(seed)
    world_from_image = rigid.transform(Rotation.random(rng=seed).as_matrix(), rng.uniform(-50, 50, 3))
    centre = np.array([SIZE[0] * SCALE[0] / 2, SIZE[1] * SCALE[1] / 2, 3.0])
    ball = trimesh.creation.icosphere(subdivisions=5, radius=8.0)
    ball.apply_translation(rigid.apply(world_from_image, centre))
    found = mask_of([ball], world_from_image @ np.diag([*SCALE, 1.0, 1.0]), SIZE)
    u, v = np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1]))
    away = np.hypot(u * SCALE[0] - centre[0], v * SCALE[1] - centre[1])
    radius = np.sqrt(8.0**2 - 3.0**2)
    assert (found == (away < radius))[np.abs(away - radius) > 0.02].all()


def test_two_masses_are_joined_and_what_lies_beside_the_image_is_cut_off():
    world_from_pixel = np.diag([*SCALE, 1.0, 1.0])
    balls = [trimesh.creation.icosphere(subdivisions=4, radius=4.0) for _ in range(3)]
    for ball, place in zip(balls, ([0, 10, 0], [18, 12, 0], [18, 12, 40]), strict=True):
        ball.apply_translation(place)
    found = mask_of(balls, world_from_pixel, SIZE)
    area = found.sum() * SCALE.prod()
    assert area == pytest.approx(1.5 * np.pi * 16, rel=0.03), "half a disc at the edge, a whole one, and none of the third"
    assert not mask_of([], world_from_pixel, SIZE).any()
