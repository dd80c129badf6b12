"""The patient: masses by their words, refused where they lie outside, layers that are grown only where they are asked for."""

from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
import yaml
from scipy.spatial import Delaunay, cKDTree

from recon.errors import InputError
from scenes.acoustics import TISSUES, tissue_of
from scenes.anatomy import Anatomy
from scenes.kinds import breast, patient
from scenes.mass_forms import CIRCUMSCRIBED
from twin.session import describe

COARSE = {"edge_mm": 3.0, "anatomy": Anatomy(voxel_mm=2.0)}


def built(**fields):
    return patient.build(patient.Config(**COARSE, **fields))


def test_masses_have_the_tissue_that_their_words_say():
    words = [{"pattern": "anechoic"}, {"pattern": "hyperechoic"}, {"behind": "shadow"}, {"behind": "enhancement"}]
    masses = [patient.Mass(size_mm=8, centre_mm=(-30 + 20 * k, 0, 20), **word) for k, word in enumerate(words)]
    scene = built(masses=masses)
    cyst, bright, shadow, clear = (tissue_of(scene, thing) for thing in scene.things if thing.inside)
    assert cyst.echogenicity is None and cyst.attenuation < 0.1
    assert bright.echogenicity > TISSUES["fat"].echogenicity > shadow.echogenicity
    assert shadow.attenuation > 2 * TISSUES["gland"].attenuation > 4 * clear.attenuation


def test_a_complex_cyst_has_a_solid_part():
    scene = built(masses=[patient.Mass(size_mm=14, centre_mm=(0, 0, 22), pattern="complex")])
    cyst, part = (thing for thing in scene.things if thing.inside)
    assert tissue_of(scene, cyst).echogenicity is None and tissue_of(scene, part).echogenicity is not None
    assert (Delaunay(cyst.mesh.vertices).find_simplex(part.mesh.vertices) >= 0).mean() > 0.7


@pytest.mark.parametrize(
    ("centre", "found"), [((0, 0, 48), "found -?[0-9.]+ mm"), ((0, 0, 2), "found -?[0-9.]+ mm"), ((95, 0, 10), "found -")]
)
def test_a_mass_outside_is_refused(centre, found):
    with pytest.raises(InputError, match=rf"masses\.0: expected at least 2 mm of tissue to skin and base, {found}"):
        built(masses=[patient.Mass(size_mm=10, centre_mm=centre)])


@pytest.mark.parametrize(("sizes", "apart"), [((12, 12), 0.0), ((12, 6), 4.0), ((6, 12), 4.0)])
def test_a_mass_about_anothers_middle_is_refused(sizes, apart):
    """Whichever of the two holds the other's: truth and labels would have one mass for two."""
    masses = [patient.Mass(size_mm=size, centre_mm=(apart * k, 0, 22), form="round") for k, size in enumerate(sizes)]
    with pytest.raises(
        InputError, match=r"^masses\.1: expected its middle outside of masses\.0, .* found one [0-9.]+ mm within$"
    ):
        built(masses=masses)


def test_masses_may_touch():
    """Round ones of 12 mm, 11 mm apart: a cluster."""
    cluster = [patient.Mass(size_mm=12, centre_mm=(11 * k, 0, 22), form="round") for k in range(2)]
    assert sum(thing.inside for thing in built(masses=cluster).things) == 2


def test_drawn_masses_are_the_seeds_and_are_told():
    """Other ones by another seed, and those that are told, given by hand, are the same bodies."""
    first = built(masses="drawn", seed=8)
    again = built(masses=first.filled["drawn"]["masses"], seed=8)
    pairs = zip(first.things, again.things, strict=True)
    assert all((one.mesh.vertices == two.mesh.vertices).all() and one.tissue == two.tissue for one, two in pairs)
    assert again.filled == {} and 2 <= len(first.filled["drawn"]["masses"]) <= 3
    config = patient.Config(**COARSE, seed=9)
    others = patient.draw_masses(config, patient.skin_of(config), np.random.default_rng([9, 2]))
    assert not {one.centre_mm[0] for one in others} & {one["centre_mm"][0] for one in first.filled["drawn"]["masses"]}


@pytest.fixture(scope="module")
def drawn():
    """Drawn masses of some patients."""
    configs = [patient.Config(**COARSE, seed=seed) for seed in range(10)]
    return [patient.draw_masses(one, patient.skin_of(one), np.random.default_rng([one.seed, 2])) for one in configs]


def test_drawn_masses_lie_apart(drawn):
    """By 3 mm: spheres of their sizes, and so the bodies, but for half a millimetre by which one isn't about its middle."""
    for seed, masses in enumerate(drawn[:5]):
        streams = patient._streams(patient.Config(seed=seed))[2].spawn(len(masses))
        bodies = [patient._lying(one, rng) for one, rng in zip(masses, streams, strict=True)]
        for (one, body), (two, other) in combinations(zip(masses, bodies, strict=True), 2):
            assert np.linalg.norm(np.subtract(one.centre_mm, two.centre_mm)) >= (one.size_mm + two.size_mm) / 2 + 3
            assert cKDTree(body.vertices).query(other.vertices)[0].min() > 2.5


def test_the_words_of_drawn_masses_go_together(drawn):
    """Round ones are cysts, which enhance; shadows lie behind dark ones; those with uneven borders are dark."""
    masses = [one for some in drawn for one in some]
    assert {one.form for one in masses} == set(patient.FORMS)
    assert {one.behind for one in masses} == {"none", "shadow", "enhancement"}
    for one in masses:
        assert (one.behind == "enhancement") == (one.pattern == "anechoic")
        assert one.pattern == "anechoic" or one.form != "round"
        assert one.pattern == "hypoechoic" or (one.behind != "shadow" and one.form in CIRCUMSCRIBED)


def test_any_words_may_be_drawn():
    """Also cysts before a shadow and spiculated bright ones; as many and as large as asked for."""
    drawn = {"any_words": True, "count": (3, 4), "size_mm": (6.0, 8.0), "tries": 2000}
    configs = [patient.Config(**COARSE, seed=seed, drawn=drawn) for seed in range(8)]
    masses = [patient.draw_masses(one, patient.skin_of(one), np.random.default_rng(one.seed)) for one in configs]
    assert all(3 <= len(some) <= 4 and all(6 <= one.size_mm <= 8 for one in some) for some in masses)
    assert len({(one.pattern, one.behind) for some in masses for one in some}) > 9  # of 15
    with pytest.raises(ValueError, match=r"expected the least and the most, found 4 and 3"):
        patient.DrawnMasses(count=(4, 3))


def test_a_draw_searches_one_tree(monkeypatch):
    """However many places it tries; no room is said if there is none."""
    made, tree = [], breast.surface_tree
    monkeypatch.setattr(breast, "surface_tree", lambda points: made.append(len(points)) or tree(points))
    config = patient.Config(**COARSE, least_mm=20.0, drawn={"size_mm": (10.0, 11.0), "tries": 4})
    with pytest.raises(InputError, match=r"^masses: expected room for [23] drawn ones, found it for 0; give them,"):
        patient.draw_masses(config, patient.skin_of(config), np.random.default_rng(5))
    assert len(made) == 1


def test_usual_masses_are_those_that_the_settings_show():
    """In a comment, and in the truth of scenes that none are given for."""
    lines = (Path(__file__).parents[3] / "conf" / "scene" / "patient.yaml").read_text(encoding="utf-8").splitlines()
    shown = yaml.safe_load("\n".join(line.strip()[2:] for line in lines if line.strip().startswith("# - {")))
    assert tuple(patient.Mass(**one) for one in shown) == patient.USUAL
    usual, given = built(), built(masses=shown)
    pairs = zip(usual.things, given.things, strict=True)
    assert all((one.mesh.vertices == two.mesh.vertices).all() and one.tissue == two.tissue for one, two in pairs)
    assert describe(usual)["usual"]["masses"] == [one.model_dump(mode="json") for one in patient.USUAL]
    assert "drawn" not in describe(usual) and not {"usual", "drawn"} & set(describe(given))


def test_layers_lie_in_the_world_and_are_the_same_each_time():
    scene = built(masses=[])
    first, second = scene.layers(), scene.layers()
    assert all((one.distance == other.distance).all() for one, other in zip(first.layers, second.layers, strict=True))
    breast = next(thing.mesh for thing in scene.things if thing.name == "breast")
    last = first.origin + first.step_mm * (np.array(first.layers[0].distance.shape) - 1)
    assert (first.origin < breast.bounds[0]).all() and (last > breast.bounds[1]).all()
    assert {tissue_of(scene, layer) for layer in first.layers} <= set(TISSUES.values())
