"""Whether the scene really has the steps, shadows and islands that it is for."""

import numpy as np
import pytest

from scenes.kinds import two_objects

CAMERA = np.zeros(3)
PROJECTOR = np.array([-152.0, 62.0, 12.0])  # of the rig of Meza et al. 2021


@pytest.fixture(scope="module")
def meshes():
    return {thing.name: thing.mesh for thing in two_objects.build(two_objects.Config()).things}


def hidden(points, eye, mesh):
    """Whether a box, aligned to the axes, stands between an eye and points : (n,), by the slab method."""
    with np.errstate(divide="ignore"):
        near, far = ((bound - eye) / (points - eye) for bound in mesh.bounds)
    enter, leave = np.minimum(near, far).max(axis=1), np.maximum(near, far).min(axis=1)
    return (enter < leave) & (enter < 1 - 1e-9) & (leave > 0)


@pytest.fixture(scope="module")
def row(meshes):
    """Points along the plate's front, through the middle of the box; seen by the camera, lit by the projector."""
    low, high = meshes["plate"].bounds
    x = np.linspace(low[0] + 0.1, high[0] - 0.1, 1500)
    points = np.column_stack([x, np.full_like(x, -4), np.full_like(x, low[2])])
    boxes = [meshes["box"], meshes["block"]]
    seen = ~np.any([hidden(points, CAMERA, box) for box in boxes], axis=0)
    lit = ~np.any([hidden(points, PROJECTOR, box) for box in boxes], axis=0)
    return x, seen, lit


def test_the_box_throws_a_shadow_that_the_camera_sees(row):
    x, seen, lit = row
    shadow = x[seen & ~lit & (x > 0)]
    assert np.ptp(shadow) > 8  # mm, some 40 px: no neighbourhood bridges it


def test_a_lit_strip_lies_beyond_the_shadow(row):
    x, seen, lit = row
    right = x > 25
    strip = x[right & seen & lit]
    assert np.ptp(strip) > 10 and strip.min() > x[right & seen & ~lit].max()


def test_the_strip_is_joined_to_the_rest_around_the_box(meshes):
    """Above and below the box the plate is lit and seen from end to end, past the centre column."""
    low, high = meshes["plate"].bounds
    x = np.linspace(low[0] + 0.1, high[0] - 0.1, 500)
    points = np.column_stack([x, np.full_like(x, 75), np.full_like(x, low[2])])
    for eye in (CAMERA, PROJECTOR):
        assert not any(hidden(points, eye, meshes[name]).any() for name in ("box", "block"))


def test_the_sphere_is_an_island_off_the_centre_column(meshes):
    """In the camera's view nothing touches the sphere, and it is lit in full."""
    ball = meshes["sphere"].vertices
    across = ball[:, 0] / ball[:, 2]
    others = np.concatenate([meshes[name].vertices for name in ("plate", "box", "block")])
    assert across.min() > (others[:, 0] / others[:, 2]).max() + 0.005  # over 15 px
    assert across.max() < (1279 - 618) / 3320  # within the view of camera 1
    assert not any(hidden(ball, PROJECTOR, meshes[name]).any() for name in ("plate", "box", "block"))


def test_steps_are_from_20_to_60_mm_within_reach(meshes):
    fronts = {name: mesh.bounds[0, 2] for name, mesh in meshes.items()}
    for name in ("box", "block"):  # the sphere stands beside the plate, so there is no step between them
        assert 20 <= fronts["plate"] - fronts[name] <= 60
    assert min(fronts.values()) >= 606 and max(fronts.values()) <= 713


def test_the_centre_column_meets_the_box_and_the_plate(meshes):
    for name in ("box", "plate"):
        assert meshes[name].bounds[0, 0] < 0 < meshes[name].bounds[1, 0]
