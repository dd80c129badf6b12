"""Layers on one grid, against a slow version: each layer looked up by itself, the last one that holds a point counts."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, map_coordinates

from scenes.scene_types import Layer, Layers
from twin.ultrasound import grown_layers
from twin.ultrasound.grown_layers import (
    FAR_MM,
    NONE,
    layer_at,
    layer_distance,
    layer_normal,
    layer_slope,
    packed,
    patch_at,
    strand_at,
    uneven_at,
)

STEP_MM = 0.8
FIRST = np.array([-5.0, 3.0, 600.0])
SHAPE = (14, 12, 16)


@pytest.fixture(scope="module")
def layers():
    rng = np.random.default_rng(3)
    fields = [gaussian_filter(rng.standard_normal(SHAPE), 2.0) for _ in range(4)]
    fields = [(2 * field / field.std()).clip(-3, 3).astype(np.float32) for field in fields]
    grown = [
        Layer("whole", fields[0] - 1),
        Layer("sheet", fields[1], half_mm=0.4),
        Layer("lump", fields[2]),
        Layer("last", fields[3] + 2),
    ]
    uneven, strata = (gaussian_filter(rng.standard_normal(SHAPE), 1).astype(np.float32) for _ in range(2))
    return Layers("body", FIRST, STEP_MM, tuple(grown), uneven, strata)


@pytest.fixture(scope="module")
def points():
    return FIRST + np.random.default_rng(4).uniform(-1, np.array(SHAPE) * STEP_MM + 0.2, (4000, 3))


def plain(layer: Layer, points: np.ndarray) -> np.ndarray:
    """Distances : (n,) to a layer, of a sheet to its middle; FAR_MM beside the grid."""
    return map_coordinates(layer.distance, ((points - FIRST) / STEP_MM).T, order=1, cval=FAR_MM, output=float)


def grid_of(layers: Layers):
    grown = packed(layers)
    return grown, (grown.distance, grown.half_mm, grown.first, grown.per_mm)


def test_the_last_layer_that_holds_a_point_counts_within_the_first(layers, points):
    grown, grid = grid_of(layers)
    expected = np.full(len(points), NONE)
    for k, layer in enumerate(layers.layers):
        d = plain(layer, points)
        expected[np.abs(d) <= layer.half_mm if layer.half_mm else d <= 0] = k
    expected[plain(layers.layers[0], points) > 0] = NONE
    found = [layer_at(grown.sure, grown.among, *grid, *point) for point in points]
    assert (found == expected).all() and set(expected) == {NONE, 0, 1, 2, 3}
    assert 0.1 < (grown.sure == -2).mean() < 0.95  # both ways of looking were tried


def test_distances_are_those_of_faces(layers, points):
    _, grid = grid_of(layers)
    for k, layer in enumerate(layers.layers):
        d = plain(layer, points)
        expected = np.where(d == FAR_MM, FAR_MM - layer.half_mm, np.abs(d) - layer.half_mm) if layer.half_mm else d
        np.testing.assert_allclose([layer_distance(*grid, k, *point) for point in points], expected, atol=1e-4)


def test_slopes_are_those_of_the_cell(layers):
    """Differences over 0.01 mm: distances in float32 leave 1e-5 of them."""
    _, (distance, _, *place) = grid_of(layers)
    for share in np.random.default_rng(5).uniform(0.1, 0.9, (50, 3)):
        point = FIRST + STEP_MM * (share + 4)
        across = np.array([np.diff(plain(layers.layers[2], point + np.outer([-0.005, 0.005], axis)))[0] for axis in np.eye(3)])
        np.testing.assert_allclose(layer_slope(distance, *place, 2, *point), across / np.linalg.norm(across), atol=1e-4)


def test_normals_point_outwards_from_both_faces_of_a_sheet():
    """A level sheet: up above its middle, down below it; and outside the grid none fails."""
    height = np.broadcast_to(STEP_MM * (np.arange(SHAPE[2]) - 7.6), SHAPE).astype(np.float32)
    still = Layers("body", FIRST, STEP_MM, (Layer("sheet", height, half_mm=0.3),), height, height)
    _, grid = grid_of(still)
    middle = FIRST[2] + 7.6 * STEP_MM
    for above, sign in ((0.2, 1), (-0.2, -1)):
        assert layer_normal(*grid, 0, 0.0, 6.0, middle + above, 0.3) == pytest.approx((0, 0, sign), abs=1e-6)
    assert np.isfinite(layer_normal(*grid, 0, -100.0, 6.0, middle, 0.3)).all()


def test_unevenness_is_that_of_the_nearest_grid_point(layers):
    grown = packed(layers)
    place = FIRST + STEP_MM * np.array([3, 4, 5]) + 0.2
    found = uneven_at(grown.uneven, grown.first, grown.per_mm, *place)
    assert found == pytest.approx(10 ** (layers.uneven_db[3, 4, 5] / 20), rel=1e-5)
    assert uneven_at(grown.uneven, grown.first, grown.per_mm, *(FIRST - 9)) == 1


def test_strands_follow_strata():
    """On tilted strata: along one the unevenness stays for millimetres, across it changes within one; its variance is 1."""
    axes = np.meshgrid(*(STEP_MM * np.arange(n) for n in SHAPE), indexing="ij")
    strata = (axes[2] - 0.4 * axes[0]).astype(np.float32)
    tilted = packed(Layers("body", FIRST, STEP_MM, (Layer("whole", axes[0]),), axes[0], strata))
    rng = np.random.default_rng(5)
    places = FIRST + rng.uniform(2, 7, (3000, 3))

    def found(aside: tuple[float, float, float]) -> np.ndarray:
        return np.array([strand_at(tilted.strata, tilted.strands, tilted.first, tilted.per_mm, *p) for p in places + aside])

    here, along, across = found((0, 0, 0)), found((0.7, 0, 0.28)), found((0, 0, 0.7))
    assert here.std() == pytest.approx(1, abs=0.25)
    assert np.corrcoef(here, along)[0, 1] > 0.8 and abs(np.corrcoef(here, across)[0, 1]) < 0.5
    assert strand_at(tilted.strata, tilted.strands, tilted.first, tilted.per_mm, *(FIRST - 9)) == 0


def test_patches_of_a_border_send_back_a_share():
    """Some nearly all, many hardly any, and those 0.3 mm apart the same."""
    strands, rng = grown_layers._strands(), np.random.default_rng(6)
    places = rng.uniform(-40, 40, (4000, 3))
    here, near, far = (np.array([patch_at(strands, *p) for p in places + aside]) for aside in (0, (0.3, 0, 0), (15, 0, 0)))
    assert here.min() >= 0 and here.max() <= 1 and (here < 0.1).mean() > 0.15 and (here > 0.8).mean() > 0.03
    assert np.corrcoef(here, near)[0, 1] > 0.8 and abs(np.corrcoef(here, far)[0, 1]) < 0.3
