"""Is the motion of a skin found from two measurements of it, to what its uncertainty says; and is another skin refused?"""

import numpy as np
import pytest
import trimesh

from recon.errors import InputError
from recon.geometry import rigid
from recon.skin_projection.skin_registration import PATCH, register
from scenes.solid_meshes import grid
from tests.recon.skin_projection.skin_shapes import PLANE_MM, dome, plane

NOISE_MM, STEP_MM = 0.05, 1.0
MASS = np.array([10.0, 5.0, PLANE_MM + 25])
MOTION = rigid.from_rotation_vector([0.01, -0.02, 0.03], [5.0, -25.0, -10.0])  # moves the skin by some mm
MIDDLE = rigid.transform(np.eye(3), [0, 0, PLANE_MM])


def breast(rng, offset):
    """A teardrop with a nipple, sampled by a grid with an offset in mm, measured with noise."""
    points, triangles = grid((110.0, 90.0), (110, 90))
    points = points + offset
    x, y = points.T
    z = (x / 11) ** 2 + (y / 9.5) ** 2 + 0.0004 * x**3 / 4 - 6 * np.exp(-((x - 8) ** 2 + (y + 5) ** 2) / 50)
    return trimesh.Trimesh(
        np.column_stack([x, y, PLANE_MM + z / 4 + NOISE_MM * rng.standard_normal(len(z))]), triangles[:, ::-1], process=False
    )


def test_the_motion_is_found_as_exactly_as_is_said(rng):
    """Normalised errors of the pose over 10 pairs: squared, in six dimensions, six on average.

    The noise of these is each vertex's own, so the variance, which allows for noise that is shared, is larger than it need be,
    and the mean smaller; a fit that finds another motion is far out.
    """
    squares, off = [], []
    motion = MIDDLE @ MOTION @ rigid.invert(MIDDLE)
    for _ in range(10):
        old, new = breast(rng, rng.uniform(-0.5, 0.5, 2)), breast(rng, rng.uniform(-0.5, 0.5, 2)).apply_transform(motion)
        found = register(old, new)
        error = rigid.difference(found.new_from_old, motion)
        squares.append(error @ np.linalg.solve(found.covariance, error))
        off.append(np.linalg.norm(rigid.apply(found.new_from_old, MASS) - rigid.apply(motion, MASS)) / found.sigma_mm(MASS))
        assert found.rms_mm == pytest.approx(NOISE_MM * np.sqrt(2 / PATCH), rel=0.5), "the means of two patches"
    assert 0.5 < np.mean(squares) < 6
    assert np.mean(off) < 1 and found.sigma_mm(MASS) < 0.1


def test_a_sphere_may_slide_in_itself_and_that_is_said(rng):
    """Its turns about its middle are unknown, so a place off the middle is; the breast's is known."""
    cap = dome(step=1.0)
    noisy = [trimesh.Trimesh(cap.vertices + NOISE_MM * rng.standard_normal(cap.vertices.shape), cap.faces) for _ in range(2)]
    sphere = register(*noisy)
    assert sphere.sigma_mm(MASS) > 4 * register(breast(rng, 0.0), breast(rng, 0.3)).sigma_mm(MASS)


def test_a_bump_of_its_own_does_not_pull(rng):
    """A hand's breadth of the new skin stands 5 mm out, as under a dressing: robust weights leave it aside."""
    old, new = breast(rng, 0.0), breast(rng, 0.3)
    out = np.linalg.norm(new.vertices[:, :2] - [30.0, 20.0], axis=1) < 12
    new.vertices[out, 2] -= 5.0
    found = register(old, new)
    assert np.linalg.norm(rigid.apply(found.new_from_old, MASS) - MASS) < 3 * found.sigma_mm(MASS) < 0.2


def test_a_plane_is_refused_and_so_is_next_to_nothing():
    flat, points = plane(), np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    for skin in (flat, trimesh.Trimesh(points, [[0, 1, 2]], process=False)):
        with pytest.raises(InputError, match="expected one that is bent in all directions"):
            register(skin, flat)


def test_another_skin_is_refused(rng):
    with pytest.raises(InputError, match="expected the earlier skin, moved by up to 15 mm, found"):
        register(breast(rng, 0.0), breast(rng, 0.0).apply_translation([0, 0, 60.0]))
