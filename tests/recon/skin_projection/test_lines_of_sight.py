"""Do lines meet a surface where a plain search over all triangles says, and first what is nearest?"""

import numpy as np
import pytest
import trimesh

from recon.skin_projection.lines_of_sight import NOWHERE, Sight, covered, first_hits
from tests.recon.skin_projection.skin_shapes import BALL, BALL_MM, ball, dome, projector

SIGHTS = {
    "along": Sight.along([0.2, -0.1, 1.0], BALL),
    "eye": Sight.from_eye([200.0, -80.0, 250.0], BALL),
    "device": Sight.of_device(projector()),
}


def searched(sight, place, mesh):
    """First hit of one line by the triangles' planes and edges in space, all of them; None without."""
    chart = np.array([np.append(place, near) for near in sight.chart(np.array([BALL, BALL - 30.0]))[:, 2]])
    start, end = sight.world(chart)
    ahead = end - start if sight.chart(end[None])[0, 2] < sight.chart(start[None])[0, 2] else start - end
    corners = np.asarray(mesh.vertices)[mesh.faces]
    first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    side = np.cross(ahead, second)
    determinant = (first * side).sum(axis=1)
    off = start - corners[:, 0]
    u, other = (off * side).sum(axis=1) / determinant, np.cross(off, first)
    v, t = other @ ahead / determinant, (second * other).sum(axis=1) / determinant
    hit = (u >= 0) & (v >= 0) & (u + v <= 1)
    return start + t[hit].min() * ahead if hit.any() else None


@pytest.mark.parametrize("name", SIGHTS)
def test_hits_are_those_of_a_plain_search(name, rng):
    sight, mesh = (
        SIGHTS[name],
        trimesh.util.concatenate([dome(step=4.0), trimesh.creation.icosphere(3, BALL_MM).apply_translation(BALL)]),
    )
    places = sight.chart(BALL + rng.uniform(-60, 60, (80, 3)))[:, :2]
    found = first_hits(sight, places, mesh)
    for place, point, face in zip(places, found.points, found.faces, strict=True):
        expected = searched(sight, place, mesh)
        assert (expected is None) == (face == NOWHERE)
        if expected is not None:
            assert np.allclose(point, expected, atol=1e-6)
    assert 20 < np.count_nonzero(found.faces != NOWHERE) < 80, "the question is idle if all meet, or none"


@pytest.mark.parametrize("name", SIGHTS)
def test_a_place_and_its_nearness_are_a_point(name, rng):
    points = BALL + rng.uniform(-60, 60, (50, 3))
    assert np.allclose(SIGHTS[name].world(SIGHTS[name].chart(points)), points, atol=1e-6)


def test_what_lies_behind_an_eye_is_not_seen():
    sight = Sight.from_eye([0.0, 0.0, 800.0], [0.0, 0.0, 900.0])
    assert not covered(sight, np.zeros((1, 2)), ball(middle=np.array([0.0, 0, 700]))).any()
    assert covered(sight, np.zeros((1, 2)), ball(middle=np.array([0.0, 0, 900]))).all()


def test_a_place_that_is_not_a_number_meets_nothing():
    assert first_hits(SIGHTS["along"], np.array([[np.nan, 0.0], [0.0, 0.0]]), ball()).faces.tolist()[0] == NOWHERE
