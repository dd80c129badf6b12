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


def breast(rng, offset, step=STEP_MM):
    """A teardrop with a nipple, sampled by a grid with an offset in mm, measured with noise."""
    points, triangles = grid((110.0, 90.0), (round(110 / step), round(90 / step)))
    points = points + offset
    x, y = points.T
    z = (x / 11) ** 2 + (y / 9.5) ** 2 + 0.0004 * x**3 / 4 - 6 * np.exp(-((x - 8) ** 2 + (y + 5) ** 2) / 50)
    return trimesh.Trimesh(
        np.column_stack([x, y, PLANE_MM + z / 4 + NOISE_MM * rng.standard_normal(len(z))]), triangles[:, ::-1], process=False
    )


def test_the_motion_is_found(rng):
    motion = MIDDLE @ MOTION @ rigid.invert(MIDDLE)
    found = register(breast(rng, 0.3), breast(rng, -0.2).apply_transform(motion))
    assert np.linalg.norm(rigid.apply(found.new_from_old, MASS) - rigid.apply(motion, MASS)) < 3 * found.sigma_mm(MASS) < 0.2
    assert found.rms_mm == pytest.approx(NOISE_MM * np.sqrt(2 / PATCH), rel=0.5), "the means of two patches"


def test_predicted_errors_are_the_errors(rng):
    """Errors of 70 motions, each of six normalised by its covariance, are standard normal: five sigma of their spread."""
    motion, normalised = MIDDLE @ MOTION @ rigid.invert(MIDDLE), []
    for _ in range(70):
        old, new = (breast(rng, rng.uniform(-0.5, 0.5, 2), step=1.6) for _ in range(2))
        found = register(old, new.apply_transform(motion))
        error = rigid.difference(found.new_from_old, motion)
        normalised.append(np.linalg.solve(np.linalg.cholesky(found.covariance), error))
    z = np.array(normalised)
    assert abs(np.sqrt(np.mean(z**2)) - 1) < 5 / np.sqrt(2 * z.size)


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
