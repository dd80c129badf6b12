"""The predicted scatter of a surface is that across it; little coverage is reported first, with its cause."""

from pathlib import Path

import numpy as np
import pytest
import yaml

from recon.geometry.camera import Camera
from recon.model.patterns import Patterns
from recon.structured_light import surface_mesh
from recon.structured_light.decode import decode
from recon.structured_light.phase import Noise
from recon.structured_light.surface_figures import describe_decoding, predicted_rms
from recon.structured_light.triangulate import PointMap
from tests.recon.fringe_scenes import photograph


def test_the_prediction_is_across_the_surface():
    """On a plane seen at 60 deg from its normal, half of sigma along the ray is across it."""
    camera = Camera((64, 48), np.array([[5000.0, 0, 32], [0, 5000, 24], [0, 0, 1]]), np.zeros(5))  # nearly parallel rays
    normal = np.array([0.0, np.sqrt(0.75), -0.5])
    rays = camera.rays(camera.pixel_grid())
    points = rays * ((normal @ [0, 0, 700]) / (rays @ normal))[..., None]
    mesh = surface_mesh.mesh(PointMap(np.float32(points), np.full((48, 64), 0.04, np.float32)), camera)
    assert predicted_rms(mesh, camera) == pytest.approx(0.02, rel=0.01)  # the view spans 0.7 deg


@pytest.mark.parametrize(("light", "cause"), [(100.0, None), (6.0, "too dark")])
def test_little_coverage_is_reported_first(rng, light, cause):
    """Where a fifth of a plane is lit by 100 DN, and the rest by as much or by 6."""
    sequence = Patterns(**yaml.safe_load(Path("conf/patterns/paper_surface.yaml").read_text(encoding="utf-8")))
    columns = np.tile(639.5 + 0.8 * (np.arange(300) - 150.0), (200, 1))
    bright = np.abs(np.arange(300) - 150) < 30
    images = photograph(sequence, {"columns": columns}, rng, light=np.where(bright, 100.0, light), noise=Noise(0.2, 0.033))
    lines = list(describe_decoding(sequence, decode(images, sequence)))
    assert (cause is None) == lines[0].startswith("decode")
    assert cause is None or ("only 19 %" in lines[0] and cause in lines[0])
