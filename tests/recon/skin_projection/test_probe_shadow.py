"""Is each pixel dark whose light would fall on the probe, and hardly any other?"""

import numpy as np
import trimesh

from recon.skin_projection.lines_of_sight import Sight, covered
from recon.skin_projection.projector_image import probe_shadow
from tests.recon.skin_projection.skin_shapes import projector


def body(middle):
    parts = [trimesh.creation.box([45.0, 20.0, 45.0]), trimesh.creation.box([60.0, 65.0, 3.0]).apply_translation([70.0, 0, -20])]
    return trimesh.util.concatenate(parts).apply_translation(middle)


def rays_meet(mesh, device):
    """Whether the ray of each pixel meets a mesh : (h, w), and places of the pixels on the sight's chart."""
    places = device.undistort(device.pixel_grid()).reshape(-1, 2)
    return covered(Sight.of_device(device), places, mesh).reshape(device.size[::-1])


def test_the_shadow_is_the_body_as_the_projector_sees_it():
    device, mesh = projector(), body([10.0, -20.0, 640.0])
    met, dark = rays_meet(mesh, device), probe_shadow(mesh, device, 0.0)
    assert met.any() and dark[met].all()
    assert (dark & ~met).sum() < 4 * np.sqrt(met.sum()), "a row of pixels around, at most"


def test_the_margin_is_in_mm_at_the_body():
    device, mesh = projector(), trimesh.creation.icosphere(5, 20.0).apply_translation([0.0, 0, 640.0])
    narrow, wide = (probe_shadow(mesh, device, margin).sum() for margin in (0.0, 5.0))
    assert abs(np.sqrt(wide / narrow) - 25 / 20) < 0.02


def test_the_shadow_moves_with_the_probe_and_ends_with_the_image():
    device = projector()
    first, second = (probe_shadow(body([x, 0, 640.0]), device) for x in (0.0, 30.0))
    shift = np.nonzero(second)[1].mean() - np.nonzero(first)[1].mean()
    assert 60 < shift < 100, "30 mm, 2.9 px/mm at 650 mm"
    assert not probe_shadow(body([0, 0, -500.0]), device).any(), "behind the projector"
    assert not probe_shadow(body([2000.0, 0, 640.0]), device).any()
