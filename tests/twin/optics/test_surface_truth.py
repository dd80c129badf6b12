"""Ground truth against geometry that is known in closed form."""

import numpy as np
import pytest

from scenes.catalogue import build_scene
from twin.optics.ray_world import build_world
from twin.optics.surface_truth import NOTHING, surface_truth


@pytest.fixture
def cameras(rig):
    return rig.cam1.optics.camera(), rig.projector.optics.camera()


def test_points_of_a_plane(cameras):
    """Points lie on the tilted plane, on their pixels' rays, and normals are its normal (float32 rays: 5e-4 mm)."""
    scene = build_scene({"kind": "plane", "tilt_deg": [5.0, -8.0]})
    truth = surface_truth(build_world(scene), *cameras)
    plane = scene.shapes[0]
    hit = truth.objects != NOTHING
    assert hit.mean() > 0.95
    assert np.abs((truth.points[hit] - plane.point) @ plane.normal).max() < 5e-4
    np.testing.assert_allclose(truth.normals[hit], np.broadcast_to(plane.normal, (hit.sum(), 3)), atol=1e-5)
    np.testing.assert_allclose(cameras[0].project(truth.points[hit]), cameras[0].pixel_grid()[hit], atol=1e-3)
    np.testing.assert_allclose(cameras[1].project(truth.points[hit]), truth.projector[hit], atol=2e-3)


def test_points_of_a_sphere_and_its_shadow(cameras):
    """Points of the sphere have its radius; what the projector can't see past it is dark, by a ray of our own."""
    scene = build_scene({"kind": "sphere"})
    truth = surface_truth(build_world(scene), *cameras)
    sphere = next(shape for shape in scene.shapes if type(shape).__name__ == "Sphere")
    number = [thing.name for thing in scene.things].index(sphere.name)
    on = truth.objects == number
    assert on.sum() > 10_000
    assert np.abs(np.linalg.norm(truth.points[on] - sphere.centre, axis=1) - sphere.radius).max() < 5e-4
    behind = (truth.objects != number) & (truth.objects != NOTHING)
    source = cameras[1].centre
    ray = truth.points[behind].astype(float) - source
    along = np.clip(((sphere.centre - source) @ ray.T) / (ray**2).sum(axis=1), 0, 1)
    miss = np.linalg.norm(source + ray * along[:, None] - sphere.centre, axis=1) - sphere.radius
    clear = np.abs(miss) > 0.01
    inside = ((truth.projector[behind] > 0) & (truth.projector[behind] < np.array(cameras[1].size) - 1)).all(axis=1)
    differs = truth.lit[behind][clear & inside] != (miss[clear & inside] > 0)
    assert differs.mean() < 2e-5  # float32 rays that graze the sphere
