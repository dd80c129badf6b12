"""Signed distances of what echoes come from."""

import numpy as np
import pytest
import trimesh

from recon.errors import InputError
from recon.geometry import rigid
from recon.probe_calibration.sound_in_water import speed_of_sound
from scenes.acoustics import TISSUES, faster
from scenes.catalogue import build_scene
from scenes.scene_types import Material, Thing
from tests.twin.ultrasound import plain_sound
from twin import conditions
from twin.conditions import Sound
from twin.ultrasound.echo_solids import Body, at_speeds, body, distance_at, label_at, solid


def distances(one, points):
    packed = Body(TISSUES["water"], (one,), ()).packed()
    return np.array([distance_at(packed, 0, *point) for point in points])


def test_a_meshs_distance_is_that_of_the_shape(rng):
    """A ball of fine facets, known by its vertices alone; the grid's own error is spacing² / (8 R) = 2 µm."""
    ball = trimesh.creation.icosphere(subdivisions=5, radius=15.0)
    made = solid(Thing("ball", ball, Material(0.5)), TISSUES["tumour"], None)
    way = rng.standard_normal((500, 3))
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    for radius in (14.0, 15.0, 16.0):
        assert distances(made, radius * way) == pytest.approx(np.full(500, radius - 15.0), abs=0.03)
    assert (distances(made, 5.0 * way) < 0).all()
    assert (distances(made, 17.9 * way) > 0).all()


BOX = trimesh.creation.box((40.0, 40.0, 20.0))
TURN = rigid.from_rotation_vector([0.2, 0.3, 0.1], [5.0, -3.0, 60.0])


def to_box(points):
    """Signed distances to BOX: by the nearest point of it, inside by the nearest face."""
    beyond = np.abs(points) - [20.0, 20.0, 10.0]
    return np.where((beyond > 0).any(axis=1), np.linalg.norm(np.maximum(beyond, 0), axis=1), beyond.max(axis=1))


def test_a_boxs_distance_is_exact_at_its_edges_too(rng):
    made = solid(Thing("block", BOX, Material(0.5)), TISSUES["silicone"], None)
    near_edges = np.array([20.0, 20.0, 10.0]) * rng.choice([-1, 1], (300, 3)) + rng.uniform(-2, 2, (300, 3))
    assert distances(made, near_edges) == pytest.approx(to_box(near_edges), abs=1e-12)
    assert made.distances(near_edges) == pytest.approx(to_box(near_edges), abs=1e-12)
    assert distances(made, [(20.0, 3.0, 10.0), (19.5, 3.0, 10.0), (70.0, 0.0, 0.0)]) == pytest.approx([0.0, 0.0, 50.0], abs=1e-12)


def test_a_turned_boxs_distance_is_that_of_its_faces_however_few_its_vertices(rng):
    """Twelve facets: exact off the edges, where a plane's distance is linear; a cell's half diagonal off at most beside them."""
    turned = BOX.copy()
    turned.apply_transform(TURN)
    made = solid(Thing("block", turned, Material(0.5)), TISSUES["silicone"], None)
    points = rng.uniform((-22.0, -22.0, -12.0), (22.0, 22.0, 12.0), (4000, 3))
    true, found = to_box(points), distances(made, rigid.apply(TURN, points))
    _, second, first = np.sort(np.abs(points) - [20.0, 20.0, 10.0], axis=1).T
    one_face = (np.abs(first) < 2.0) & (second < np.minimum(first, 0.0) - 1.0)  # for all points of a cell
    assert np.abs(found - true)[one_face].max() < 1e-5
    assert np.abs(found - true)[np.abs(true) < 2.0].max() < 0.5 * np.sqrt(3) / 2
    assert ((found < 0) == (true < 0))[np.abs(true) > 0.4].all()


def test_a_hollow_meshs_hole_is_outside():
    """A ring, on its axis, within its wall, and beside it."""
    ring = Thing("ring", trimesh.creation.annulus(5.0, 15.0, 20.0), Material(0.5))
    made = solid(ring, TISSUES["silicone"], None)
    assert distances(made, [(0.0, 0.0, 0.0), (10.0, 0.0, 0.0), (4.0, 0.0, 0.0), (16.0, 0.0, 0.0)]) == pytest.approx(
        [3, -3, 1, 1], abs=0.05
    )


def test_an_open_mesh_is_refused():
    opened = trimesh.Trimesh(BOX.vertices, BOX.faces[BOX.face_normals[:, 2] < 0.5])  # whose volume trimesh gives as a box's
    with pytest.raises(InputError, match="scene: bowl: expected a closed mesh, found open edges"):
        solid(Thing("bowl", opened, Material(0.5)), TISSUES["silicone"], None)


def test_a_rods_wall_is_where_it_is(rng):
    """To 2 µm between the points of its grid; a micrometre is an hundredth of a wavelength's phase there and back."""
    scene = build_scene({"kind": "inner_cylinder"})
    (inner,) = (one for one in body(scene).solids if one.name == "inner")
    (rod,) = scene.shapes
    angle, along = rng.uniform(0, 2 * np.pi, 400), rng.uniform(-40, 40, 400)
    points = rod.point + np.column_stack([along, rod.radius * np.cos(angle), rod.radius * np.sin(angle)])
    assert np.abs(distances(inner, points)).max() < 0.002
    assert inner.distance.size < 1e6


@pytest.fixture(scope="module")
def breast():
    return body(build_scene({"kind": "breast"}))


def test_the_breast_is_full(breast):
    """Downwards from its skin to the table there is tissue and no gap, though its flat base has no vertices of its own."""
    packed = breast.packed()
    names = ["", *(one.name for one in breast.solids)]
    for x, y in ((4.0, -2.0), (26.0, 20.0), (-30.0, 10.0), (40.0, 2.0), (-25.0, 1.0)):
        column = [names[label_at(packed, x, y, z)] for z in np.arange(640.0, 705.0, 0.25)]
        first, last = column.index("breast"), len(column) - 1 - column[::-1].index("breast")
        assert set(column[:first]) == {""}
        assert "" not in column[first:]
        assert 640.0 + 0.25 * last == pytest.approx(700.0, abs=0.5)


def test_tumours_lie_within_the_breast(breast):
    packed = breast.packed()
    names = ["", *(one.name for one in breast.solids)]
    for name, (x, y, z) in (("tumour0", (-10, -8, 680)), ("tumour1", (28, -18, 676)), ("tumour2", (26, 20, 681))):
        assert names[label_at(packed, float(x), float(y), float(z))] == name


def test_distances_and_labels_are_those_of_plain_interpolation(breast, rng):
    """At places in and around the breast, by SciPy."""
    places = rng.uniform((-60, -60, 640), (60, 60, 720), (3000, 3))
    packed = breast.packed()
    expected = plain_sound.distances(breast, places)
    assert len({*plain_sound.labels(breast, places)}) > 3
    for k in range(len(breast.solids)):
        assert np.array([distance_at(packed, k, *place) for place in places]) == pytest.approx(expected[k], abs=1e-5)
    clear = np.abs(expected).min(axis=0) > 1e-4
    found = np.array([label_at(packed, *place) for place in places])
    assert (found == plain_sound.labels(breast, places))[clear].all()


def test_a_scene_without_acoustics_is_refused():
    with pytest.raises(InputError, match="expected one with acoustics"):
        body(build_scene({"kind": "ball_bar"}))


def test_speeds_of_tissue_and_water_are_drawn_and_steel_keeps_its_own():
    """One ratio for all soft tissues, the water's by its temperature; impedances go along, as densities stay."""
    tank = body(build_scene({"kind": "tank"}))
    assert at_speeds(tank, Sound(), 1) is tank
    errors = Sound(tissue=0.02, water_c=2.0)
    ratio, warmer = conditions.speeds(errors, 1)
    assert at_speeds(tank, errors, 1).medium.speed == pytest.approx(speed_of_sound(22.0 + warmer), abs=0.1)
    assert at_speeds(tank, errors, 1).solids[0].tissue == tank.solids[0].tissue
    for name in ("silicone", "tumour", "gel"):
        before, after = TISSUES[name], faster(TISSUES[name], ratio, warmer)
        assert after.speed == pytest.approx(ratio * before.speed) and after.impedance == pytest.approx(ratio * before.impedance)
    assert faster(TISSUES["steel"], ratio, warmer) == TISSUES["steel"]
