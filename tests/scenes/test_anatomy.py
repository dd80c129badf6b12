"""Tissues that have grown: in their order from the skin to the lung, as thick as set, the same wherever the patient lies."""

import numpy as np
import pytest
from scipy.ndimage import map_coordinates
from scipy.spatial.transform import Rotation

from recon.geometry import rigid
from scenes.anatomy import GLANDULAR, Anatomy, Grid, grow, in_world, redistance
from scenes.dome import dome
from scenes.kinds.breast import form_of
from scenes.kinds.patient import Config

STEP_MM = 1.5
COARSE_MM = 2.0  # where no tissue's thickness is asked for


def grown(step_mm=STEP_MM, seed=2, **fields):
    skin = dome(form_of(Config(edge_mm=2.0)), np.random.default_rng(1))
    return grow(Anatomy(voxel_mm=step_mm, **fields), skin, np.random.default_rng(seed))


@pytest.fixture(scope="module")
def breast():
    return grown()


@pytest.fixture(scope="module")
def coarse():
    return grown(COARSE_MM)


def labels(found) -> np.ndarray:
    """Names of the tissues at the grid's points, by the rule of `Layers`."""
    names = np.full(found.grid.shape, "skin", dtype="<U12")
    for layer in found.layers:
        names[np.abs(layer.distance) <= layer.half_mm if layer.half_mm else layer.distance <= 0] = layer.name
    names[found.layers[0].distance > 0] = "skin"
    return names


def distance(found, name: str) -> np.ndarray:
    return next(layer.distance for layer in found.layers if layer.name == name)


def test_the_skin_is_as_thick_as_set(breast):
    """Away from the areola, by a fine walk along the normals of the dome's upper part."""
    depth, fat = breast.depth, distance(breast, "fat")
    beside = (np.abs(breast.grid.axes()[0]) > 35) & (breast.grid.axes()[2] > 8) & (np.abs(fat) < 1)
    thickness = (depth + fat)[beside]  # of some 300 patches, each 22 % off
    assert np.median(thickness) == pytest.approx(1.6, abs=0.08)
    assert 0.15 < thickness.std() / 1.6 < 0.3
    even = grown(skin_uneven=0.0)
    assert np.median((even.depth + distance(even, "fat"))[beside]) == pytest.approx(1.6, abs=0.02)


def test_strata_lie_along_the_skin_and_the_muscle(breast):
    """Across strata is down from the skin in the fat, and down from the muscle's face in it: slopes agree but for waves."""
    slopes = np.array(np.gradient(breast.strata_mm, STEP_MM))
    slopes /= np.linalg.norm(slopes, axis=0)
    down = np.array(np.gradient(breast.depth, STEP_MM))
    under = (breast.depth > 3) & (breast.depth < 8) & (breast.grid.axes()[2] > 15)
    assert np.median((slopes * down).sum(axis=0)[under]) > 0.87
    assert np.median(-slopes[2][distance(breast, "muscle") < -2]) > 0.9


def test_septa_are_many_thin_and_broken(breast):
    """Under the skin, one every 4 mm; some thinner than 0.15 mm, some thicker than twice that."""
    septum, strata = distance(breast, "ligament1"), breast.strata_mm
    under = (breast.depth > 3) & (breast.depth < 9) & (breast.grid.axes()[2] > 10)
    crossed = (np.diff(np.signbit(septum), axis=2) & under[:, :, 1:]).sum() / under.sum() / STEP_MM
    assert 0.15 < crossed < 0.45
    steep = np.linalg.norm(np.gradient(septum, STEP_MM), axis=0)[under & (np.abs(septum) < 1)]
    thick = 0.25 / np.maximum(steep, 1e-3)  # mm
    assert (thick < 0.15).mean() > 0.08 and (thick > 0.3).mean() > 0.1 and np.isfinite(strata).all()


def test_depth_is_that_under_the_skin(breast):
    """Within a tenth of a millimetre near it, and within a voxel deeper."""
    skin = dome(form_of(Config(edge_mm=2.0)), np.random.default_rng(1))
    centre = skin.vertices[(skin.vertices[:, 2] > 25)]
    normals = centre - [0, 0, -80]
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    for inwards in (2.0, 10.0):
        places = (centre - inwards * normals - breast.grid.first) / breast.grid.step
        found = map_coordinates(breast.depth, places.T, order=1)
        assert np.median(found / inwards) == pytest.approx(1, abs=0.12)


def test_tissues_come_in_order(breast):
    """Down from the skin: no gland within the skin or the muscle, ribs within the muscle, the lung below all."""
    names = labels(breast)
    gland, muscle, rib, lung = (names == name for name in ("gland", "muscle", "rib", "lung"))
    assert breast.depth[gland].min() > 0.5 and distance(breast, "muscle")[gland].min() > 0
    z = breast.grid.axes()[2] + np.zeros(breast.grid.shape)
    assert z[gland].min() > z[rib].max() > z[lung].max() and z[muscle].max() < 10
    assert gland.any() and (names == "duct").any() and (names == "ligament0").any() and (names == "nipple").any()


@pytest.mark.parametrize("density", list(GLANDULAR))
def test_density_classes_have_their_shares(density, coarse):
    found = coarse if density == Anatomy().density else grown(COARSE_MM, density=density)
    breast = (found.depth > 1.6) & (distance(found, "muscle") > 0)
    share = ((labels(found) == "gland") & breast).sum() / breast.sum()
    assert 0.55 < share / GLANDULAR[density] < 1.3


def test_the_same_seed_grows_the_same_and_another_another(coarse):
    again = grown(COARSE_MM)
    assert all((one.distance == other.distance).all() for one, other in zip(coarse.layers, again.layers, strict=True))
    assert (coarse.uneven_db == again.uneven_db).all()
    assert (labels(grown(COARSE_MM, seed=3)) != labels(coarse)).mean() > 0.02


def test_ligaments_part_lobules_and_are_as_thin_as_set(breast):
    """The stretched distance is never beyond the true one: sheets have their thickness at least, and four times at most."""
    sheet = distance(breast, "ligament0")
    near = np.abs(sheet) < 1.0
    slope = np.linalg.norm(np.gradient(sheet, STEP_MM), axis=0)[near]
    assert 0.2 < np.median(slope) <= 1.0
    fat = (labels(breast) == "fat") & (breast.depth > 2)
    assert 0.1 < (sheet[fat] > 0).mean() < 0.9


@pytest.mark.parametrize("turn_deg", [0.0, 90.0, 25.0])
def test_tissue_turns_with_the_patient(breast, turn_deg):
    """A field on the grid, seen in the world, has its values where the body's points have gone."""
    turn = (Rotation.from_euler("z", turn_deg, degrees=True) * Rotation.from_euler("x", 180, degrees=True)).as_matrix()
    world_from_phantom = rigid.transform(turn, [4.0, -2.0, 700.0])
    values, first = in_world(breast.depth, breast.grid, world_from_phantom)
    rng = np.random.default_rng(0)
    places = breast.grid.first + rng.uniform(0.3, 0.7, (200, 3)) * STEP_MM * (np.array(breast.grid.shape) - 1)
    own = map_coordinates(breast.depth, ((places - breast.grid.first) / STEP_MM).T, order=1)
    seen = map_coordinates(values, ((rigid.apply(world_from_phantom, places) - first) / STEP_MM).T, order=1)
    worst = 1e-4 if turn_deg in (0.0, 90.0) else 0.8
    assert np.abs(own - seen).max() < worst


def test_distances_of_a_field_are_those_to_its_zero_level():
    """Of a ball, given by a field that is none of distances."""
    grid = Grid(np.full(3, -12.0), 1.0, (25, 25, 25))
    radius = np.sqrt(sum(axis**2 for axis in grid.axes()))
    found = redistance((np.exp(radius / 4) - np.exp(2.0)).astype(np.float32), 1.0)
    near = np.abs(radius - 8) < 1
    assert np.abs(found - (radius - 8))[near].max() < 0.25
    assert ((found > 0) == (radius > 8)).all()
