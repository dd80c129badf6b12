"""The skin by both cameras: what is said of points that one of them contradicts."""

import numpy as np
import pytest

from recon.geometry.camera import Camera
from recon.session import skin_step
from recon.structured_light.decode import ProjectorMap
from recon.structured_light.second_view import Fused, View
from recon.structured_light.triangulate import PointMap


@pytest.mark.parametrize(("apart", "start"), [(4, "fuse"), (20_000, "warning")])
def test_a_thing_that_one_camera_alone_saw_is_said(apart, start):
    """Noise leaves out 4 of a million points, a finger some ten thousand."""
    shared, gone = np.ones((1000, 1300), bool), np.zeros((1000, 1300), bool)
    gone.ravel()[:apart] = True
    nothing = PointMap(np.zeros((1, 1, 3), np.float32), np.zeros((1, 1), np.float32))
    camera = Camera((1300, 1000), np.diag([3000.0, 3000, 1]), np.zeros(5), np.eye(4), name="cam2")
    found = ProjectorMap.__new__(ProjectorMap)  # of which nothing is said here
    fused = Fused(nothing, nothing, shared & ~gone, gone, np.zeros((1, 1), np.int64), 0.0)
    line = skin_step.describe_fusion(View(camera, found, nothing), fused)
    assert line.startswith(start) and f"{apart:,}".replace(",", " ") in line
    assert ("came or went" in line) == (start == "warning")
