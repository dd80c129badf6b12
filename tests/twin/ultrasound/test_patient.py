"""A patient by sound: tissues in their order, masses as their words say, the same bytes from any number of threads."""

from pathlib import Path
from types import SimpleNamespace

import numba
import numpy as np
import pytest
import yaml

from recon.geometry import rigid
from scenes.catalogue import build_scene
from scenes.tumour import caliper
from sonotwin.config import folder
from twin.reports.sweep_pictures import tissue_speed
from twin.ultrasound.bscan import scan
from twin.ultrasound.bscan_truth import labels
from twin.ultrasound.echo_solids import MARGINS_MM, body, resting_label
from twin.ultrasound.probe_path import Hand, Hold, resting
from twin.ultrasound.sweep_session import surface_of
from twin.ultrasound.transducer import Transducer

STILL = Hand(shift_mm=0, turn_deg=0)
OVER_CYST = (32.0, -27.0)  # x, y of the face's middle, of which the image meets the cyst


@pytest.fixture(scope="module")
def breast():
    return body(build_scene({"kind": "patient", "seed": 8, "edge_mm": 1.5, "anatomy": {"density": "scattered", "voxel_mm": 1.5}}))


@pytest.fixture(scope="module")
def clinic():
    return Transducer(**yaml.safe_load((Path(folder()) / "ultrasound" / "clinic.yaml").read_text(encoding="utf-8")))


@pytest.fixture(scope="module")
def pose(breast, clinic):
    return resting(Hold(place_mm=OVER_CYST, hand=STILL), surface_of("breast", breast), clinic, 1).poses[0]


@pytest.fixture(scope="module")
def taken(breast, clinic, pose):
    return scan(breast, clinic, pose, 3)


def shown(breast, clinic, taken) -> np.ndarray:
    """Names of what each pixel shows."""
    return np.array(["gel", *(solid.name for solid in breast.solids)])[labels(taken.paths, clinic)]


def test_tissues_are_shown_in_their_order(breast, clinic, taken):
    names = shown(breast, clinic, taken)
    rows = {name: float(np.median(np.nonzero(names == name)[0])) for name in ("breast", "fat", "gland", "muscle", "mass1")}
    assert rows["breast"] < 40 and rows["breast"] < rows["gland"] < rows["muscle"]
    assert (names == "breast").any(axis=0).all()  # skin in every column


def test_a_cyst_is_free_of_echoes_and_brightens_what_lies_behind(breast, clinic, taken):
    """The same tissues, behind it and beside."""
    names = shown(breast, clinic, taken)
    cyst, below = names == "mass1", np.cumsum(names == "mass1", axis=0) > 20
    behind = below & (names == "gland") & ~cyst
    beside = (np.arange(408)[:, None] > np.nonzero(cyst)[0].max()) & ~below & (names == "gland")
    image = taken.image.astype(float)
    inside = cyst & np.roll(cyst, 8, axis=0) & np.roll(cyst, -8, axis=0)
    assert image[inside].mean() < 0.3 * image[names == "fat"].mean()
    assert image[behind].mean() > 1.1 * image[beside].mean()


def test_the_bytes_are_the_same_from_one_thread(breast, clinic, pose, taken):
    threads = numba.get_num_threads()
    numba.set_num_threads(1)
    try:
        assert (scan(breast, clinic, pose, 3).image == taken.image).all()
    finally:
        numba.set_num_threads(threads)


def test_the_speed_of_a_breast_is_a_mean_of_its_tissues(breast):
    assert 1450 < tissue_speed(SimpleNamespace(body=breast)) < 1520


def test_calcifications_stay_where_they_are():
    """In a cyst, where nothing else echoes: seen from a tenth of a millimetre aside, they are the same, and hardly changed."""
    cyst = {"size_mm": 20, "centre_mm": [-16, 8, 25], "form": "round", "pattern": "anechoic", "calcified": True}
    fields = {"seed": 8, "edge_mm": 2.0, "anatomy": {"voxel_mm": 2.0}, "masses": [cyst]}
    calcified, array = body(build_scene({"kind": "patient", **fields})), Transducer(noise_db=-200.0)
    pose = resting(Hold(place_mm=(-12.0, -16.0), hand=STILL), surface_of("breast", calcified), array, 1).poses[0]
    first, second = (scan(calcified, array, pose @ rigid.transform(np.eye(3), (0, 0, aside)), 3) for aside in (0.0, 0.1))
    mass = shown(calcified, array, first) == "mass0"
    inside = mass & np.roll(mass, 12, axis=0) & np.roll(mass, -12, axis=0)
    assert inside.sum() > 5000
    assert np.corrcoef(first.envelope[inside] ** 2, second.envelope[inside] ** 2)[0, 1] > 0.95


def test_backscatter_has_its_mean_and_spread(breast):
    """In fat as set, in gland and muscle twice that; its mean power is the tissue's own."""
    layers = {layer.name: layer.distance for layer in breast.grown.layers}
    fat = (layers["fat"] < -2) & (layers["gland"] > 1) & (layers["muscle"] > 1)
    for inside, spread in ((fat, 2.2), (layers["gland"] < 0, 4.4), (layers["muscle"] < 0, 4.4)):
        levels = breast.grown.uneven_db[inside]
        assert levels.std() == pytest.approx(spread, rel=0.2)
        assert 10 * np.log10(np.mean(10 ** (levels / 10))) == pytest.approx(0, abs=1.2)


def test_margins_of_masses_are_blurred():
    """Of scatterers near a ragged border, some of those outside count to the mass, and some inside don't; of even ones, fewer."""
    assert MARGINS_MM[0] > 2 * MARGINS_MM[1]
    fields = {"seed": 8, "edge_mm": 2.0, "anatomy": {"voxel_mm": 2.0}}
    mass = {"size_mm": 20, "centre_mm": [-16, 8, 25], "form": "irregular"}
    found = body(build_scene({"kind": "patient", **fields, "masses": [mass]}))
    number = [solid.name for solid in found.solids].index("mass0")
    rng = np.random.default_rng(1)
    points = found.solids[number].mesh.vertices[::40] + rng.uniform(-0.9, 0.9, found.solids[number].mesh.vertices[::40].shape)
    distance = found.solids[number].distances(points)
    for beside in (-1.0, 0.0, 1.0):
        held = np.array([resting_label(found.packed(), *point, beside) for point in points]) == number + 1
        assert (held == (distance <= beside * MARGINS_MM[0])).mean() > 0.99


def test_masses_lie_wider_than_tall():
    oval = {"size_mm": 20, "centre_mm": [-16, 8, 25], "form": "oval"}
    extents = []
    for seed in range(4):
        things = build_scene({"kind": "patient", "seed": seed, "edge_mm": 3.0, "masses": [oval]}).things
        mesh = next(thing.mesh for thing in things if thing.name == "mass0")
        assert caliper(mesh.vertices) == pytest.approx(20, abs=1e-6)
        extents.append(mesh.extents)
    wide, _, tall = np.mean(extents, axis=0)
    assert tall < 0.8 * wide
