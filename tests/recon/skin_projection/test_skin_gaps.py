"""Are curves carried over small holes of the skin as the skin around them bends, and over nothing else?"""

import numpy as np
import trimesh

from recon.skin_projection import skin_curve
from recon.skin_projection.lines_of_sight import Sight
from recon.skin_projection.skin_curve import laid
from tests.recon.skin_projection.skin_shapes import DOME_MM, PLANE_MM, dome

SIGHT = Sight.along([0, 0, 1.0], [0, 0, PLANE_MM])
CENTRE = np.array([0.0, 0, PLANE_MM + DOME_MM])


def holed(middle, radius):
    skin = dome()
    kept = np.linalg.norm(skin.triangles_center[:, :2] - middle, axis=1) > radius
    return trimesh.Trimesh(skin.vertices, skin.faces[kept], process=False)


def ring(radius, start=0.0):
    """Places of a closed chain about the dome's top."""
    angle = start + np.linspace(0, 2 * np.pi, 200)
    angle[-1] = angle[0]
    return radius * np.column_stack([np.cos(angle), np.sin(angle)])


def test_a_hole_is_bridged_with_the_bend_around_it():
    """Also where the chain begins; a chord over 7 mm of 60 mm would be off by 0.1 mm."""
    for start in (0.0, 1.0):
        curve = laid("mass", "mass", ring(12.0, start), SIGHT, holed([12.0, 0], 4.0))
        assert curve.on_skin == 1
        assert np.abs(np.linalg.norm(curve.points - CENTRE, axis=1) - DOME_MM).max() < 0.02
        assert ((curve.points - CENTRE) / DOME_MM * curve.normals).sum(axis=1).min() > 0.99


def test_a_wide_hole_and_what_lies_beyond_the_rim_stay_open():
    wide = laid("mass", "mass", ring(12.0), SIGHT, holed([12.0, 0], 11.0))
    assert 0.3 < wide.on_skin < 0.8
    beyond = laid("mass", "mass", np.add(ring(12.0), [40.0, 0]), SIGHT, dome())
    assert 0.2 < beyond.on_skin < 0.8
    assert np.nanmax(np.hypot(*beyond.points[:, :2].T)) < 0.8 * DOME_MM + 0.1


def test_an_edge_is_not_bridged():
    """Around this hole the skin isn't smooth: no quadratic tells what is within."""
    skin = holed([12.0, 0], 4.0)
    stepped = np.asarray(skin.vertices) - np.outer(3.0 * (skin.vertices[:, 1] > 0), [0, 0, 1.0])
    curve = laid("mass", "mass", ring(12.0), SIGHT, trimesh.Trimesh(stepped, skin.faces, process=False))
    assert curve.on_skin < 0.95


def test_dashes_and_strips_follow_the_skin():
    curve = laid("cut", "cut", skin_curve.evenly([[-20.0, 5], [20.0, 5]]), SIGHT, dome())
    drawn = skin_curve.dashed(curve, (3.0, 1.0))
    assert abs(drawn.mean() - 0.75) < 0.02
    strip = skin_curve.strip(curve, 2.0)
    assert abs(strip.area / (2.0 * curve.length_mm) - 1) < 0.01
    assert np.abs(np.linalg.norm(strip.vertices - CENTRE, axis=1) - DOME_MM).max() < 0.02
