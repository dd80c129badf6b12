"""A tool's mesh has the tip on it, or the cause is said."""

from pathlib import Path

import numpy as np
import pytest
import trimesh

from recon.errors import InputError
from recon.tip_calibration import model_check

NEEDLE = Path("needle.stl")
TIP = np.array([0.0, 0.0, -150.0])


def needle(scale=1.0) -> trimesh.Trimesh:
    """A cone of 150 mm with its tip at TIP, of few long triangles."""
    cone = trimesh.creation.cone(radius=2.0, height=150.0, sections=8)
    cone.apply_transform(np.diag([1.0, -1, -1, 1]))
    return cone.apply_scale(scale)


def test_the_distance_is_that_of_the_surface_not_of_corners():
    """Halfway down the cone's side, far from any corner."""
    beside = np.array([0.0, 0.0, -75.0])
    assert model_check.distance(needle(), beside) == pytest.approx(1.0, rel=0.1)
    assert model_check.check(NEEDLE, needle(), TIP - 0.5 * np.eye(3)[2], 0.02) == pytest.approx(0.5)


@pytest.mark.parametrize(
    ("mesh", "tip", "named"),
    [
        (needle(1e-3), TIP, "found it 149.8 mm away: is it in metres? Write it in mm"),
        (needle(1 / 25.4), TIP, "is it in inches?"),
        (needle(), [0, -150.0, 0], "is it in another frame than the target's, or of another tool?"),
    ],
)
def test_what_is_off_is_refused_by_its_cause(mesh, tip, named):
    with pytest.raises(InputError) as caught:
        model_check.check(NEEDLE, mesh, np.array(tip, float), 0.02)
    assert str(caught.value).startswith("needle.stl: expected a mesh with the tip [") and named in str(caught.value)
