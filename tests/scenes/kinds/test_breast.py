"""The phantom: the paper's sizes, tumours within, seen by camera and projector, the look of a breast."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import LinearNDInterpolator

from recon.errors import InputError
from recon.geometry import rigid
from scenes.acoustics import TISSUES, tissue_of
from scenes.dome import disc
from scenes.kinds import breast
from scenes.tumour import caliper

PROJECTOR = np.array([-152.0, 62.0, 12.0])  # of the rig of Meza et al. 2021


@pytest.fixture(scope="module")
def scene():
    return breast.build(breast.Config())


@pytest.fixture(scope="module")
def skin(scene):
    """The breast's vertices in the phantom's frame, the base's middle left out, with their reflectance."""
    thing = scene.things[0]
    vertices = rigid.apply(rigid.invert(breast.world_from_phantom(breast.Config())), thing.mesh.vertices)
    return vertices[:-1], thing.albedo[:-1]


@settings(max_examples=8, deadline=None)
@given(
    size=st.tuples(st.floats(140, 200), st.floats(110, 160), st.floats(45, 70)),
    taper=st.floats(-0.3, 0.3),
    fullness=st.floats(0, 0.2),
    seed=st.integers(0, 1000),
)
def test_extents_are_exact_and_the_mesh_closed(size, taper, fullness, seed):
    config = breast.Config(size_mm=size, taper=taper, fullness=fullness, seed=seed, edge_mm=3.0, tumours=())
    mesh = breast.build(config).things[0].mesh
    np.testing.assert_allclose(mesh.extents, size, atol=1e-9)
    assert mesh.bounds[1, 2] == pytest.approx(config.table_mm)
    assert mesh.is_watertight and mesh.is_winding_consistent and mesh.volume > 0


def test_the_mesh_is_fine_enough(scene):
    mesh = scene.things[0].mesh
    assert len(mesh.faces) >= 60_000
    dome = mesh.edges_unique[(mesh.edges_unique != len(mesh.vertices) - 1).all(axis=1)]
    lengths = np.linalg.norm(np.diff(mesh.vertices[dome], axis=1)[:, 0], axis=1)
    assert np.median(lengths) < 0.8 and np.percentile(lengths, 99.9) < 1.7


def test_tumours_have_the_papers_sizes(scene):
    masses = [thing for thing in scene.things if thing.inside]
    assert [caliper(thing.mesh.vertices) for thing in masses] == pytest.approx([27, 14, 12])


def test_tumours_lie_within_tissue_and_apart(scene, skin):
    """Straight above every tumour vertex, and in the nearest direction, there are 5 mm of tissue; none meets another."""
    vertices, _ = skin
    height = LinearNDInterpolator(vertices[:, :2], vertices[:, 2])
    phantom_from_world = rigid.invert(breast.world_from_phantom(breast.Config()))
    masses = [rigid.apply(phantom_from_world, thing.mesh.vertices) for thing in scene.things if thing.inside]
    for mass in masses:
        assert (height(mass[:, :2]) - mass[:, 2]).min() > 5
        assert mass[:, 2].min() > 5
        assert np.linalg.norm(mass[::5, None] - vertices[::7], axis=2).min() > 5
    for k, mass in enumerate(masses):
        for other in masses[:k]:
            assert np.linalg.norm(mass[::3, None] - other[::3], axis=2).min() > 1


@pytest.mark.parametrize(
    ("tumours", "named"),
    [
        ([(20, (0, 0, 44))], "tumours.0"),  # under the skin
        ([(20, (0, 0, 8))], "tumours.0"),  # through the base
        ([(12, (0, 0, 90))], "tumours.0"),  # above the breast
        ([(20, (0, 0, 20)), (20, (8, 0, 20))], "tumours.1"),  # into each other
        ([(26, (0, 0, 20)), (5, (0, 0, 20))], "tumours.1"),  # one within the other
    ],
)
def test_misplaced_tumours_are_refused(tumours, named):
    wanted = tuple(breast.Tumour(size_mm=size, centre_mm=centre) for size, centre in tumours)
    with pytest.raises(InputError, match=named):
        breast.build(breast.Config(tumours=wanted, edge_mm=2.0))


def test_tumours_are_made_of_what_they_are_said_to_be():
    """A usual one keeps the tissue of its name; a cyst is free of echoes; what has no even border has no rim."""
    plain, cyst, bright = (
        breast.Tumour(size_mm=10, centre_mm=centre, **fields)
        for centre, fields in (
            ((-20, 0, 20), {}),
            ((0, 0, 20), {"form": "round", "echo_db": None, "loss_db": 0.05}),
            ((20, 0, 20), {"form": "spiculated", "echo_db": 8.0}),
        )
    )
    scene = breast.build(breast.Config(tumours=(plain, cyst, bright), edge_mm=2.0))
    hidden = [thing for thing in scene.things if thing.inside]
    usual, fluid, shining = (tissue_of(scene, thing) for thing in hidden)
    assert hidden[0].tissue is None and usual == TISSUES["tumour"]
    assert (fluid.echogenicity, fluid.attenuation) == (None, 0.05)
    assert shining == replace(TISSUES["tumour"], echogenicity=8.0)
    assert [thing.mirrors for thing in hidden] == [True, True, False]
    assert [caliper(thing.mesh.vertices) for thing in hidden] == pytest.approx([10, 10, 10])


def test_tumours_may_touch_or_reach_into_each_other_if_asked():
    """Balls of 20 mm, 2 mm within each other; but none may have another's middle in it."""
    balls = [breast.Tumour(size_mm=20, centre_mm=(x, 0, 20), form="round") for x in (-9, 9)]
    with pytest.raises(InputError, match=r"tumours\.1: expected at least 1 mm"):
        breast.build(breast.Config(tumours=balls, edge_mm=2.0))
    scene = breast.build(breast.Config(tumours=balls, edge_mm=2.0, apart_mm=-3.0))
    assert -3 < breast.gap(*(thing.mesh for thing in scene.things if thing.inside)) < 0
    inner = breast.Tumour(size_mm=4, centre_mm=(-1.5, 0, 20), form="round")  # 2.5 mm deep in the first
    with pytest.raises(InputError, match=r"tumours\.1: expected its middle outside of tumours\.0"):
        breast.build(breast.Config(tumours=(balls[0], inner), edge_mm=2.0, apart_mm=-5.0))


@pytest.mark.parametrize(("eye", "share"), [(np.zeros(3), 0.995), (PROJECTOR, 0.97)])
def test_camera_and_projector_face_nearly_all_the_skin(scene, eye, share):
    """By area; what is turned away are the rim and the far side of the nipple."""
    mesh = scene.things[0].mesh
    dome = (mesh.faces != len(mesh.vertices) - 1).all(axis=1)
    facing = ((eye - mesh.triangles_center) * mesh.face_normals).sum(axis=1) > 0
    assert mesh.area_faces[dome & facing].sum() / mesh.area_faces[dome].sum() > share


def test_the_skin_is_a_height_over_its_footprint(scene):
    """No overhang: no facet of the dome looks down at the table."""
    mesh = scene.things[0].mesh
    dome = (mesh.faces != len(mesh.vertices) - 1).all(axis=1)
    assert mesh.face_normals[dome, 2].max() < 0


def test_nipple_and_areola_have_their_sizes(skin):
    vertices, albedo = skin
    apex = vertices[0]
    away = np.linalg.norm(vertices[:, :2] - apex[:2], axis=1)
    shoulder = vertices[(away > 9.5) & (away < 10.5), 2].mean()
    assert apex[2] - shoulder == pytest.approx(7.0, abs=0.8)  # the dome itself falls off by some 0.4 mm
    half = away[(vertices[:, 2] > apex[2] - 3.6) & (away < 12)].max()
    assert 2 * half == pytest.approx(10, abs=2)  # at its widest, creases and all
    dark = away[albedo < 0.36]
    assert 2 * np.percentile(dark, 98) == pytest.approx(38, abs=3)


def test_the_breast_is_fuller_on_the_nipples_side(skin):
    vertices, _ = skin
    height = LinearNDInterpolator(vertices[:, :2], vertices[:, 2])
    assert height(60, 0) > height(-60, 0) + 3


def test_the_relief_is_as_fine_as_asked():
    """Two breasts that differ in relief alone: their difference is the relief, some hundredths of a mm."""
    rough, smooth = (breast.build(breast.Config(relief_mm=relief, tumours=())).things[0].mesh for relief in (0.03, 0.0))
    upper = smooth.vertices[:, 2] < 680
    assert (rough.vertices - smooth.vertices)[upper, 2].std() == pytest.approx(0.03, rel=0.3)


def test_another_seed_is_another_breast_of_the_same_size(scene):
    other = breast.build(breast.Config(seed=8)).things[0].mesh
    np.testing.assert_allclose(other.extents, scene.things[0].mesh.extents)
    assert 0.1 < np.abs(other.vertices - scene.things[0].mesh.vertices).max() < 5


@given(rings=st.integers(1, 12))
def test_the_disc_is_one_disc(rings):
    """Euler's formula, and every triangle anticlockwise when the rings are spread."""
    ring, theta, faces = disc(rings)
    assert len(faces) == 6 * rings**2 + 12 * rings
    points = ring[:, None] * np.column_stack([np.cos(theta), np.sin(theta)])
    a, b, c = (points[faces[:, k]] for k in range(3))
    turn = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]
    assert turn.min() > 0
