"""Is the predicted scatter of a surface that across it?"""

import numpy as np
import pytest

from recon.geometry.camera import Camera
from recon.structured_light import surface_mesh
from recon.structured_light.surface_figures import predicted_rms
from recon.structured_light.triangulate import PointMap


def test_the_prediction_is_across_the_surface():
    """On a plane seen at 60 deg from its normal, half of sigma along the ray is across it."""
    camera = Camera((64, 48), np.array([[5000.0, 0, 32], [0, 5000, 24], [0, 0, 1]]), np.zeros(5))  # nearly parallel rays
    normal = np.array([0.0, np.sqrt(0.75), -0.5])
    rays = camera.rays(camera.pixel_grid())
    points = rays * ((normal @ [0, 0, 700]) / (rays @ normal))[..., None]
    mesh = surface_mesh.mesh(PointMap(np.float32(points), np.full((48, 64), 0.04, np.float32)), camera)
    assert predicted_rms(mesh, camera) == pytest.approx(0.02, rel=0.01)  # the view spans 0.7 deg
