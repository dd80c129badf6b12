"""Scenes as the command line asks for them: by kind and fields, refused in one line where they make no sense."""

from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
import yaml

from recon.errors import InputError
from scenes.catalogue import build_scene, kinds

CONF = Path(__file__).parents[2] / "conf" / "scene"
KINDS = tuple(kinds())


@pytest.fixture(scope="module", params=KINDS)
def scene(request):
    return build_scene(yaml.safe_load((CONF / f"{request.param}.yaml").read_text()))


def test_every_kind_has_a_configuration():
    assert {"board", "breast", "crosswire", "tank"} <= set(KINDS)
    assert {yaml.safe_load(path.read_text())["kind"] for path in CONF.glob("*.yaml")} == set(KINDS)


@pytest.mark.parametrize("kind", KINDS)
def test_every_configuration_says_what_the_code_defaults_to(kind):
    """The YAML files document all the defaults; the two must not drift apart."""
    fields = yaml.safe_load((CONF / f"{kind}.yaml").read_text())
    del fields["kind"]
    model = import_module(f"scenes.kinds.{kind}").Config
    assert model(**fields) == model() and set(fields) == set(model.model_fields)


def test_every_thing_is_a_closed_body(scene):
    for thing in scene.things:
        assert thing.mesh.is_watertight, thing.name
        assert thing.mesh.is_winding_consistent, thing.name
        assert thing.mesh.volume > 0, thing.name
        assert thing.mesh.area_faces.min() > 1e-6, thing.name  # mm2; a sliver has no normal in float32


def test_everything_stands_before_the_camera_and_reflects_some_light(scene):
    assert len({thing.name for thing in scene.things}) == len(scene.things)
    for thing in scene.things:
        assert thing.mesh.bounds[0, 2] > 550, thing.name
        reflectance = thing.material.reflectance if thing.albedo is None else thing.albedo
        assert np.all((np.asarray(reflectance) > 0.02) & (np.asarray(reflectance) < 0.9)), thing.name


def test_shapes_carry_unit_directions_towards_the_camera(scene):
    for shape in scene.shapes:
        if hasattr(shape, "normal"):
            assert np.linalg.norm(shape.normal) == pytest.approx(1)
            assert shape.normal @ shape.point < 0, shape.name


def test_the_same_configuration_gives_the_same_scene(scene):
    for first, second in zip(scene.things, build_scene({"kind": scene.name}).things, strict=True):
        np.testing.assert_array_equal(first.mesh.vertices, second.mesh.vertices)
        np.testing.assert_array_equal(first.mesh.faces, second.mesh.faces)
        if first.albedo is not None:
            np.testing.assert_array_equal(first.albedo, second.albedo)


@pytest.mark.parametrize(
    ("config", "named"),
    [
        ({"kind": "teapot"}, ["kind", "teapot", "two_objects"]),
        ({"kind": "solids"}, ["kind", "solids", "two_objects"]),  # a module of the package, but no scene
        ({}, ["kind", "two_objects"]),
        ({"kind": "sphere", "radius": 3}, ["sphere", "radius"]),
        ({"kind": "sphere", "radius_mm": 0}, ["radius_mm", "0"]),
        ({"kind": "sphere", "radius_mm": -1}, ["radius_mm", "-1"]),
        ({"kind": "sphere", "radius_mm": float("nan")}, ["radius_mm", "nan"]),
        ({"kind": "sphere", "background_mm": 640.0}, ["background_mm", "669.8"]),
        ({"kind": "plane", "size_mm": [0, 10]}, ["size_mm.0"]),
        ({"kind": "plane", "centre_mm": [0, 0, float("inf")]}, ["centre_mm.2"]),
        ({"kind": "plane", "reflectance": 1.2}, ["reflectance", "1.2"]),
        ({"kind": "cylinders", "wall_mm": 50}, ["wall_mm", "44.18"]),
        ({"kind": "board", "diameter_mm": 22}, ["diameter_mm", "21.08"]),
        ({"kind": "board", "diameter_mm": 16.5, "print_error_mm": 0.5}, ["diameter_mm", "15.46"]),
        ({"kind": "board", "margin_mm": 4}, ["margin_mm"]),
        ({"kind": "board", "rows": 1}, ["rows", "1"]),
        ({"kind": "breast", "nipple_height_mm": 60}, ["nipple_height_mm", "60"]),
        ({"kind": "breast", "edge_mm": 0}, ["edge_mm", "0"]),
        *(({"kind": kind, "seed": -1}, [kind, "seed", "-1"]) for kind in ("board", "breast", "cylinders")),
    ],
)
def test_nonsense_is_refused_by_name(config, named):
    with pytest.raises(InputError) as refusal:
        build_scene(config)
    message = str(refusal.value)
    assert "\n" not in message
    for word in named:
        assert word in message
