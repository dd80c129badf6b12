"""Is the B-scan's line where its plane meets the skin, and does it come out on both sides of the array?"""

import numpy as np
import pytest

from recon.geometry import rigid
from recon.skin_projection.scan_line import BEYOND_MM, on_skin
from tests.recon.skin_projection.skin_shapes import DOME_MM, PLANE_MM, dome

WIDTH, STEP = 321, 0.12


def placed(above, tilt=(0.0, 0.0, 0.0)):
    """A B-scan whose face lies above the dome's top by some mm, its depth towards the dome."""
    pose = rigid.from_rotation_vector(tilt, [0.0, 0, PLANE_MM - above])
    upright = np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])  # u across, v in depth
    return pose @ rigid.transform(upright.T, [0, 0, 0]) @ np.diag([STEP, STEP, 1, 1]) @ rigid.transform(np.eye(3), [-160, 0, 0])


def test_the_line_lies_in_the_plane_and_on_the_skin():
    for tilt in ((0.0, 0.0, 0.0), (0.3, 0.0, 0.2)):
        matrix = placed(5.0, tilt)
        curve = on_skin("scan", matrix, WIDTH, dome(step=0.5))
        pixels = rigid.apply(np.linalg.inv(matrix), curve.points)
        assert np.abs(pixels[:, 2]).max() < 1e-6
        assert np.abs(np.linalg.norm(curve.points - [0, 0, PLANE_MM + DOME_MM], axis=1) - DOME_MM).max() < 0.01
        beyond = BEYOND_MM / STEP
        assert pixels[[0, -1], 0].tolist() == pytest.approx([-beyond, WIDTH - 1 + beyond], abs=1e-6)


def test_a_probe_pressed_in_has_the_same_line_as_one_held_over():
    over, pressed = (on_skin("scan", placed(above), WIDTH, dome()).points for above in (5.0, -2.0))
    assert np.allclose(over, pressed, atol=1e-6)
