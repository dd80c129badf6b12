"""From YAML and overrides to a validated configuration, and the one line for each way to get it wrong."""

import re
import tempfile
from pathlib import Path
from typing import Annotated, Literal

import pytest
from pydantic import BaseModel, ConfigDict, Field, create_model

from recon.errors import InputError
from sonotwin import config

SURFACE = """\
defaults:
  - rig: narrow
  - _self_
capture: ???       # folder to read
out: outputs/x     # folder to write
pitch: 12          # projector px
unwrap: gray       # how
"""


class Rig(BaseModel):
    model_config = ConfigDict(extra="forbid")
    gamma: float = Field(gt=0)


class Surface(BaseModel):
    model_config = ConfigDict(extra="forbid")
    rig: Rig
    capture: Path
    out: Path
    pitch: float = Field(gt=1)
    unwrap: Literal["gray", "centre_line"]


@pytest.fixture(autouse=True)
def conf(tmp_path, monkeypatch):
    (tmp_path / "rig").mkdir()
    (tmp_path / "surface.yaml").write_text(SURFACE)
    (tmp_path / "rig" / "narrow.yaml").write_text("gamma: 2.2\n")
    (tmp_path / "rig" / "wide.yaml").write_text("gamma: 1.0\n")
    monkeypatch.setattr(config, "folder", lambda: tmp_path)


def load(*overrides: str) -> Surface:
    return config.load("surface", ["capture=c", *overrides], Surface)


def test_defaults_groups_and_fields():
    assert load().rig.gamma == 2.2
    assert load("rig=wide").rig.gamma == 1.0
    assert load("rig=wide", "rig.gamma=1.8", "pitch=18").rig.gamma == 1.8
    assert config.groups("surface") == {"rig": ["narrow", "wide"]}


def test_files_that_change_are_read_again(conf, tmp_path):
    """What choices give is kept between calls, and no field of an earlier call stays in it."""
    assert load("rig.gamma=1.8", "pitch=18").pitch == 18
    assert (load().rig.gamma, load().pitch) == (2.2, 12)
    (tmp_path / "rig" / "narrow.yaml").write_text("gamma: 2.25\n")
    (tmp_path / "surface.yaml").write_text(SURFACE.replace("pitch: 12", "pitch: 16"))
    assert (load().rig.gamma, load().pitch) == (2.25, 16)


@pytest.mark.parametrize(
    "path",
    [
        "outputs/my run",
        "/data/Müller, Zoë/run (2)",
        "a=b",
        "~/x",
        "C:/captures/one",
        "it's",
        "back\\slash é",
        "é\\",
        "é\\'",
        "a,b",
        "#1",
    ],
)
def test_paths_are_taken_as_they_stand(path):
    """Blanks are Hydra's own; the rest isn't in its grammar."""
    assert load(f"out={path}").out == Path(path)


@pytest.mark.parametrize(
    ("override", "line"),
    [
        ("pitchh=3", "surface: pitchh: unknown key; expected one of rig, capture, out, pitch, unwrap; did you mean pitch?"),
        ("rig.gama=3", "surface: rig.gama: unknown key; expected one of gamma; did you mean rig.gamma?"),
        ("rig.gam=3", "surface: rig.gam: unknown key; expected one of gamma; did you mean rig.gamma?"),
        ("rig.mma=3", "surface: rig.mma: unknown key; expected one of gamma; did you mean rig.gamma?"),
        ("rigg.gamma=3", "surface: rigg.gamma: unknown key; expected one of rig, capture, out, pitch, unwrap; did you mean rig?"),
        ("pitch.fine=3", "surface: pitch.fine: unknown key; expected none below pitch"),
        ("+extra=3", "surface: extra: unknown key; expected one of rig, capture, out, pitch, unwrap"),
        ("out=[a", "surface: out: expected balanced brackets and quotes, found [a"),
        ("out={a: [1, 2}", "surface: out: expected balanced brackets and quotes, found {a: [1, 2}"),
        ("out={a: 'b}", "surface: out: expected balanced brackets and quotes, found {a: 'b}"),
        ("out=[1]]", "surface: out: expected balanced brackets and quotes, found [1]]"),
        ("rig=narow", "surface: rig: expected one of narrow, wide, found narow; did you mean narrow?"),
        ("pitch=0", "surface: pitch: expected greater than 1, found 0"),
        ("unwrap=grey", "surface: unwrap: expected 'gray' or 'centre_line', found 'grey'"),
        ("~pitch", "surface: pitch: needs a value; give pitch=..."),
        ("capture=???", "surface: capture: needs a value; give capture=..."),
        ("outputs/demo", "surface: outputs/demo: expected field=value"),
        ("=3", "surface: =3: expected field=value"),
        ("pitch=" + 9999 * "9", "surface: pitch: expected numbers of at most 1000 digits, found more"),
        ("rig.gamma={a: 1}", "surface: rig.gamma: expected number, found {'a': 1}"),
        ("out={a: b}", "surface: out: expected a path, found {'a': 'b'}"),
    ],
)
def test_mistakes_name_key_expected_and_found(override, line):
    with pytest.raises(InputError) as caught:
        load(override)
    assert str(caught.value) == line


@pytest.mark.parametrize("override", ["out=[a", "pitch=${nothing}", "pitch.x=3", "out='open", "sur face=3", "rig@other=wide"])
def test_nonsense_is_one_line(override):
    with pytest.raises(InputError, match=r"^surface: [^\n]+$"):
        load(override)


@pytest.mark.parametrize("path", ["/home/me/mine.yaml", "mine.yaml", "./mine.yml", "~/rigs/mine", "rigs/mine"])
def test_a_path_without_a_file_is_said_so(path, tmp_path):
    """With the way on: a file to begin with."""
    with pytest.raises(InputError) as caught:
        load(f"rig={path}")
    way_on = f"begin with a copy of {tmp_path / 'rig' / 'narrow.yaml'}"
    assert str(caught.value) == f"surface: rig: expected one of narrow, wide, or a YAML file, found none at {path}; {way_on}"


def test_a_choice_may_be_a_file_of_ones_own(tmp_path_factory, tmp_path):
    """From anywhere, as after an installation, with fields of it changed on top; all else is refused in one line."""
    path = tmp_path_factory.mktemp("own") / "mine.yaml"
    path.write_text("gamma: 1.5\n")
    assert load(f"rig={path}").rig.gamma == 1.5 and load(f"rig={path}", "rig.gamma=1.8").rig.gamma == 1.8
    assert sorted(each.name for each in (tmp_path / "rig").iterdir()) == ["narrow.yaml", "wide.yaml"], "nothing is copied there"
    for text, found in (
        ("a: [", "expected YAML, found"),
        ("5", "expected a map of fields, found 5"),
        ("defaults: 5", "defaults: expected a list of choices, found 5"),
        ("defaults: [rig: 5]", "defaults: expected a list of choices, found"),
    ):
        path.write_text(text)
        with pytest.raises(InputError, match=rf"^{path}: {found}"):
            load(f"rig={path}")


def test_a_fault_in_a_file_of_ones_own_is_the_files_whatever_else_is_given(tmp_path):
    """But one that an override has put there, at the field, above or below it, is the verb's."""

    class Wide(Rig):
        steps: int = 1

    given, model = tmp_path / "mine.yaml", create_model("Model", rig=(Wide, ...), __base__=Surface)
    given.write_text("gamma: -1\nsteps: 2\n")
    for override, place in (("rig.steps=3", str(given)), ("rig.gamma=-2", "surface")):
        with pytest.raises(InputError, match=rf"^{re.escape(place)}: rig.gamma: "):
            config.load("surface", ["capture=c", f"rig={given}", override], model)


@pytest.mark.parametrize("kind", ["video", '"video"', "'video'"])
def test_the_kind_of_a_thing_may_stand_in_quotes(kind):
    """In a map that replaces a thing of another kind; a map within it has a kind of its own."""
    assert config._tag_in(f"{{kind: {kind}, source: 0}}", ["kind"]) == ("kind", "video")
    assert config._tag_in(f"{{inner: {{kind: {kind}}}}}", ["kind"]) is None


def test_a_choice_of_ones_own_may_start_from_a_shipped_one(tmp_path, tmp_path_factory, monkeypatch):
    """By a list of `defaults`, as Hydra has it; its own fields win. What is wrong in it is said of the file."""
    place = tmp_path_factory.mktemp("own")
    monkeypatch.chdir(place)
    (tmp_path / "rig" / "wide.yaml").write_text("gamma: 1.0\noffset: 3.0\n")
    model = create_model("Wide", __base__=Rig, offset=(float, 0.0))
    whole = create_model("Whole", __base__=Surface, rig=(model, ...))
    (place / "ours.yaml").write_text("defaults: [wide]\ngamma: 1.5\n")
    rig = config.load("surface", ["capture=c", "rig=ours.yaml"], whole).rig
    assert (rig.gamma, rig.offset) == (1.5, 3.0)
    assert config.read_choice("rig", Path("ours.yaml")) == {"gamma": 1.5, "offset": 3.0}
    with pytest.raises(InputError, match=r"^surface: rig: .*, found ours; did you mean ours.yaml\?$"):
        load("rig=ours")
    for text, line in (
        ("defaults: [wyde]\n", "ours.yaml: rig: expected one of narrow, wide, found wyde; did you mean wide?"),
        (
            "defaults: [_self_, wide]\n",
            "ours.yaml: defaults: expected _self_ last, as the file's own fields count, found it before wide",
        ),
        ("gama: 1\n", "ours.yaml: rig.gama: unknown key; expected one of gamma, offset; did you mean rig.gamma? (and 1 more)"),
    ):
        (place / "ours.yaml").write_text(text)
        with pytest.raises(InputError) as caught:
            config.load("surface", ["capture=c", "rig=ours.yaml"], whole)
        assert str(caught.value) == line


class Mono(BaseModel):
    model_config = ConfigDict(extra="forbid")
    kind: Literal["mono"]
    gain: float = 1.0


class Colour(BaseModel):
    model_config = ConfigDict(extra="forbid")
    kind: Literal["colour"]
    white: float = 1.0


class Lab(BaseModel):
    model_config = ConfigDict(extra="forbid")
    kind: Literal["lab"]
    features: dict[str, int] = Field(default_factory=dict)
    sensor: Annotated[Mono | Colour, Field(discriminator="kind")]


class Twin(BaseModel):
    model_config = ConfigDict(extra="forbid")
    kind: Literal["twin"]
    paced: bool = False


class Record(BaseModel):
    model_config = ConfigDict(extra="forbid")
    devices: Annotated[Lab | Twin, Field(discriminator="kind")]


@pytest.mark.parametrize(
    ("overrides", "found"),
    [
        (["devices=lab", "devices.features={Gain: 3}"], {"features": {"Gain": 3}}),
        (["devices=lab", "devices.features.Gain=3"], {"features": {"Gain": 3}}),
        (["devices=lab", "devices.sensor={gain: 2}"], {"sensor": Mono(kind="mono", gain=2)}),
        (["devices=lab", "devices.sensor={kind: mono}"], {"sensor": Mono(kind="mono", gain=4)}),
        (["devices=lab", "devices.sensor={kind: colour, white: 2}"], {"sensor": Colour(kind="colour", white=2)}),
        (["devices=lab", "devices.sensr.gain=3"], "devices.sensr.gain: unknown key; expected one of kind, features, sensor; "),
        (["devices=lab", "devices.sensor.gan=3"], "devices.sensor.gan: unknown key; expected one of kind, gain; "),
        (["devices=lab", "devices.sensor={gan: 3}"], "devices.sensor.gan: unknown key; expected one of kind, gain; "),
        (["devices=lab", "devices.sensor.gain=x"], "devices.sensor.gain: expected number, "),
        (["devices=lab", "devices.features={Gain: x}"], "devices.features.Gain: expected integer, "),
        (["devices=lab", "devices.paced=true"], "devices.paced: unknown key; expected one of kind, features, sensor"),
        (["devices.sensor={kind: mono}"], "devices.sensor: unknown key; expected one of kind, paced"),
        (["devices.features={Gain: 3}"], "devices.features: unknown key; expected one of kind, paced"),
    ],
)
def test_fields_of_a_choice_are_those_of_the_one_that_is_chosen(overrides, found, tmp_path):
    """Not of the usual choice; maps of free names take any, and a thing of another kind takes the whole place."""
    (tmp_path / "record.yaml").write_text("defaults: [devices: twin, _self_]\n")
    (tmp_path / "devices").mkdir()
    (tmp_path / "devices" / "twin.yaml").write_text("kind: twin\npaced: false\n")
    (tmp_path / "devices" / "lab.yaml").write_text("kind: lab\nfeatures: {}\nsensor: {kind: mono, gain: 4}\n")
    if isinstance(found, str):
        with pytest.raises(InputError, match=f"^record: {re.escape(found)}"):
            config.load("record", overrides, Record)
    else:
        devices = config.load("record", overrides, Record).devices
        assert {name: getattr(devices, name) for name in found} == found


def test_null_is_accepted_where_it_is_the_usual_choice(tmp_path):
    """As help shows it; beside another choice of the group it is a contradiction."""
    (tmp_path / "scan.yaml").write_text("defaults: [{rig: null}, _self_]\nout: x\n")
    model = create_model("Scan", rig=(Rig | None, None), out=(str, "x"))
    assert config.load("scan", ["rig=null"], model) == config.load("scan", [], model)
    assert config.load("scan", ["rig=wide"], model).rig.gamma == 1.0
    with pytest.raises(InputError, match=r"^scan: rig: expected one of narrow, wide, found null"):
        config.load("scan", ["rig=wide", "rig=null"], model)


def test_null_of_a_group_that_a_verb_has_not_is_an_unknown_key(tmp_path):
    """As any other value of it is; Hydra ends in a traceback there."""
    (tmp_path / "scan.yaml").write_text("out: x\n")
    with pytest.raises(InputError, match=r"^scan: rig: unknown key; expected .*out"):
        config.load("scan", ["rig=null"], create_model("Scan", out=(str, "x")))


def test_a_choice_of_ones_own_is_found_whatever_the_temporary_folders_name(tmp_path_factory, monkeypatch):
    place = tmp_path_factory.mktemp("a, b's [c]")
    (place / "mine.yaml").write_text("gamma: 1.5\n")
    monkeypatch.setattr(tempfile, "tempdir", str(place))
    assert load(f"rig={place / 'mine.yaml'}").rig.gamma == 1.5


def test_brackets_and_quotes_are_balanced():
    """As they open and close; in quotes all letters are text."""
    assert all(map(config._balanced, ["{a: [1, (2)]}", "['[', '}']", '{a: "it\'s"}', "['it\\'s']", ""]))
    assert not any(map(config._balanced, ["{a: [1}]", "]", "['a]", "[']'", "{"]))


def test_further_mistakes_are_counted():
    with pytest.raises(InputError, match=r"\(and 1 more\)$"):
        load("pitch=0", "unwrap=x")


def test_a_verb_without_file_has_no_fields():
    class Empty(BaseModel):
        model_config = ConfigDict(extra="forbid")

    assert config.load("nothing", [], Empty) == Empty()
    with pytest.raises(InputError, match="nothing: x: unknown key; expected none"):
        config.load("nothing", ["x=1"], Empty)
