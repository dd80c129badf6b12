"""A target of four circles is one module, found by its name: print, film, pose, calibration, training and networks follow."""

import json
from pathlib import Path

import numpy as np
import pytest
import yaml

from recon import registry
from recon.capture import target_files
from recon.errors import InputError
from recon.geometry import rigid
from recon.geometry.circle_outline import ellipses_of
from recon.model import circle_layout
from recon.model.rig import Rig
from recon.tracking import networks
from recon.tracking.pose import estimate
from recon.tracking.pose_fit import Sighting
from recon.tracking.tracker import Tracker
from sonotwin import config
from sonotwin.cli import main
from sonotwin.verbs import record
from sonotwin.verbs.print import Config
from tests import added
from tests.recon import captures
from tests.recon.tracking import drawings, films

FOUR = '''"""Four circles: as the usual three, and c3 between c1 and c2."""

from typing import Literal

from recon.model.rig import Finite, Positive, Target


class Kind(Target):
    """A target of four circles."""

    LENGTHS = ("c1_mm", "c2_aside_mm", "c2_mm", "c3_aside_mm", "c3_mm")
    kind: Literal["four_circles"] = "four_circles"
    c1_mm: Positive
    c2_mm: Positive
    c2_aside_mm: Finite = 0.0
    c3_mm: Positive
    c3_aside_mm: Positive
'''
C3 = {"kind": "four_circles", "c3_aside_mm": 22.0, "c3_mm": 33.0}
COUNT = 9


@pytest.fixture
def four(rig, tmp_path, monkeypatch) -> Rig:
    """The rig with the target of four circles; the others lie where the usual target has them."""
    added.add(monkeypatch, tmp_path / "ours", "recon.model.targets", "four_circles", FOUR)
    return Rig.model_validate(rig.model_dump() | {"target": rig.target.model_dump() | C3})


@pytest.fixture
def described(four, tmp_path) -> str:
    """The field of the command line that names the rig's file."""
    path = tmp_path / "ours.yaml"
    path.write_text(yaml.safe_dump(json.loads(four.model_dump_json())), encoding="utf-8")
    return f"rig={path}"


@pytest.fixture
def drawn(four, tmp_path) -> Path:
    """A film of the target, turned to all sides, led nearer and farther."""
    rng, folder = np.random.default_rng(11), tmp_path / "drawn"
    first = drawings.facing(rng, 5.0)
    turns = np.radians(8.0) * np.array([[np.sin(a), np.cos(a), 0.3] for a in np.linspace(0, 2 * np.pi, COUNT)])
    poses = [films.moved(first, turn, np.array([2.0 * k, 0.0, 4.0 * k])) for k, turn in enumerate(turns)]
    captures.write_film(
        folder, films.draw(four, poses, rng), films.stamps(COUNT), films.optics(four), films.devices(four), "drawn"
    )
    return folder


def sightings(rig, pose, rng, sigma_px):
    """Both views of a pose, with noise of centres."""
    views = []
    for name in ("cam1", "cam2"):
        camera = getattr(rig, name).optics.camera()
        centres, shapes = ellipses_of(camera, pose, *circle_layout.circles(rig.target))
        noisy = centres + sigma_px * rng.standard_normal(centres.shape)
        views.append(Sighting(camera, noisy, np.tile(sigma_px**2 * np.eye(2), (len(centres), 1, 1)), shapes))
    return views


def test_a_kinds_fields_are_given_as_any_others(four):
    """With the kind, before it or after it; without it they are none."""
    fields = ["part=target", "out=t.pdf", "rig.target.c3_mm=33", "rig.target.c3_aside_mm=22"]
    kind = "rig.target.kind=four_circles"
    usual = ("c1_mm", "c2_mm", "outer_diameter_mm", "inner_diameter_mm", "board_mm")
    whole = ", ".join(f"{name}: {list(x) if isinstance(x := getattr(four.target, name), tuple) else x}" for name in usual)
    for overrides in ([kind, *fields], [*fields, kind], [f"rig.target={{kind: four_circles, {whole}}}", *fields]):
        assert config.load("print", overrides, Config).rig.target == four.target
    with pytest.raises(InputError, match=r"rig\.target\.c3_mm: unknown key"):
        config.load("print", fields, Config)
    with pytest.raises(InputError, match=r"rig\.target\.c3_asid_mm: unknown key.*did you mean rig\.target\.c3_aside_mm"):
        config.load("print", [kind, "rig.target.c3_asid_mm=33"], Config)


@pytest.mark.parametrize(
    ("lengths", "said"),
    [
        ('("c1_mm", "c2_mm", "c2_aside_mm", "c3_mm", "c3_aside_mm")', "of c1_mm c2_aside_mm c2_mm c3_aside_mm c3_mm, "),
        ('("c1_mm", "c2_aside_mm", "c2_mm", "c3_aside_mm")', "of c1_mm c2_aside_mm c2_mm c3_aside_mm c3_mm, in this order"),
        ('("c1_mm", "x2_mm", "y2_mm")', "of c1_mm c2_aside_mm c2_mm, in this order, found c1_mm x2_mm y2_mm"),
        ('("c1_mm", "c2_aside_mm", "c2_mm", "c3_aside_mm", "c3_mm", "c4_aside_mm", "c4_mm")', "found none for c4_aside_mm c4_mm"),
    ],
)
def test_a_kind_of_lengths_in_another_order_is_refused(lengths, said, rig, tmp_path, monkeypatch):
    """It would be another target: with along and aside exchanged c2 lies on the x axis."""
    source = FOUR.replace('("c1_mm", "c2_aside_mm", "c2_mm", "c3_aside_mm", "c3_mm")', lengths)
    added.add(monkeypatch, tmp_path / "ours", "recon.model.targets", "four_circles", source)
    with pytest.raises(InputError, match=f"in recon.model.targets.four_circles.*{said}"):
        registry.kind("recon.model.targets", "four_circles")
    with pytest.raises(ValueError, match=f"target\n.*in recon.model.targets.four_circles.*{said}"):
        Rig.model_validate(rig.model_dump() | {"target": rig.target.model_dump() | C3})


def test_circles_on_a_line_are_refused(rig, tmp_path, monkeypatch):
    """Even of a kind that allows it, and of an unusual target: a plane through c0, c1 and c2 is divided by c2's distance."""
    source = FOUR.replace("c2_mm: Positive", "c2_mm: Finite")
    added.add(monkeypatch, tmp_path / "ours", "recon.model.targets", "four_circles", source)
    for c2 in (0.0, -40.0):
        target = rig.target.model_dump() | C3 | {"c2_mm": c2, "unusual": True}
        with pytest.raises(ValueError, match="c2_mm: expected more than 0"):
            Rig.model_validate(rig.model_dump() | {"target": target})


def test_four_circles_place_the_target_better_than_three(rig, four, rng):
    """By sqrt(3/4) at the circles' mean; 400 poses' errors are those predicted: chi-square of 6 each within 4 standard errors."""
    sigmas, squares = {}, []
    for each in (rig, four):
        each = each.model_copy(update={"target": each.target.model_copy(update={"tolerance_mm": 0.0})})
        shift = []
        for _ in range(200):
            pose = drawings.facing(rng, 25.0)
            found = estimate(*sightings(each, pose, rng, 0.1), each.target)
            assert found.found, found.reason
            off = rigid.difference(pose, found.world_from_target)
            squares.append(off @ np.linalg.solve(found.covariance, off))
            arm = pose[:3, :3] @ circle_layout.circle_centres(each.target).mean(axis=0)
            slopes = rigid.slopes(arm[None])[0]
            shift.append(np.sqrt(np.trace(slopes @ found.covariance @ slopes.T)))
        sigmas[each.target.kind] = np.mean(shift)
    assert sigmas["four_circles"] / sigmas["three_circles"] == pytest.approx(np.sqrt(3 / 4), rel=0.03)
    assert np.mean(squares) == pytest.approx(6, abs=4 * np.sqrt(12 / len(squares)))


def test_one_circle_of_four_may_be_missing_in_both_views(four, rng):
    pose = drawings.facing(rng, 25.0)
    views = [view.without(k) for k, view in enumerate(sightings(four, pose, rng, 0.05))]
    found = estimate(*views, four.target)
    assert found.found and np.linalg.norm(rigid.difference(pose, found.world_from_target)[3:]) < 0.3
    assert found.used.tolist() == [[False, True, True, True], [True, False, True, True]]


def test_the_lengths_covariance_is_that_of_circles_off_their_places(four, rng):
    target = four.target.model_copy(update={"tolerance_mm": 0.05})
    places = circle_layout.circle_centres(target)[:, :2] + 0.05 * rng.standard_normal((20_000, 4, 2))
    drawn, expected = (
        np.cov(np.array([circle_layout.lengths_between(each) for each in places]).T),
        circle_layout.length_covariance(target),
    )
    sigma = np.sqrt(np.diag(expected))
    assert np.abs((drawn - expected) / np.outer(sigma, sigma)).max() < 4 * np.sqrt(2 / 20_000)


def test_the_verbs_take_it(drawn, described, four, tmp_path, capsys):
    """The shipped networks were trained for three circles: they are refused, or find circles that get their names by geometry."""
    assert main(["print", "part=target", described, f"out={tmp_path / 'target.pdf'}"]) == 0
    assert main(["track", f"capture={drawn}", described, f"out={tmp_path / 'refused'}"]) == 2
    said = capsys.readouterr().err
    assert "expected a detector of four_circles" in said and "found one of three_circles" in said and "naming=geometry" in said
    out = tmp_path / "target"
    assert main(["calibrate-target", f"capture={drawn}", described, "naming=geometry", f"out={out}"]) == 0
    said = capsys.readouterr().out
    assert f"found       {COUNT} of {COUNT} pairs whole" in said and "\nc3 aside" in said
    found = target_files.read(out / "target.yaml", four.target)
    off = circle_layout.lengths(found) - circle_layout.lengths(four.target)
    assert len(off) == 5 and np.abs(off).max() < 0.005
    assert np.all(np.abs(off) < 4 * np.sqrt(np.diag(found.covariance_mm2)))
    fields = [f"capture={drawn}", described, "naming=geometry", f"target={out / 'target.yaml'}", f"out={tmp_path / 'track'}"]
    assert main(["track", *fields]) == 0
    assert f"found       {COUNT} of {COUNT} frames" in capsys.readouterr().out
    assert main(["track", f"capture={drawn}", f"target={out / 'target.yaml'}", f"out={tmp_path / 'other'}"]) == 2
    assert "parameters: expected c1_mm c2_aside_mm c2_mm outer_diameter_mm" in capsys.readouterr().err


def test_networks_of_three_circles_are_no_others(rig, four, rng):
    """A tracker with them refuses four circles, whose fourth would be taken for none; by geometry they are taken."""
    pair = (rig.cam1.optics.camera(), rig.cam2.optics.camera())
    left, right = rng.integers(0, 255, (2, *pair[0].size[::-1]), dtype=np.uint8)
    with pytest.raises(InputError, match=r"expected a detector of 4 circles, .* found one of 3: .*kind=four_circles"):
        Tracker(pair, four.target, networks.load(threads=1)).step(left, right)
    by_geometry = networks.load(threads=1, kind="four_circles", by_geometry=True)
    assert not Tracker(pair, four.target, by_geometry).step(left, right).found
    with pytest.raises(InputError, match="found one of 4"):
        Tracker(pair, rig.target, by_geometry).step(left, right)


def test_what_looks_for_the_target_refuses_them_at_once(described, tmp_path, capsys):
    """Before devices are opened or a scene is rendered; recording can name circles by geometry, as tracking."""
    out = tmp_path / "out"
    assert main(["demo", described, f"out={out}", f"board={tmp_path / 'board'}"]) == 2
    said = capsys.readouterr().err
    assert "expected a detector of four_circles" in said and "naming" not in said
    recorded = ["part=sweep", described, "preview.serve=false", f"out={out}"]
    assert main(["record", *recorded]) == 2
    assert "or give naming=geometry" in capsys.readouterr().err and not out.exists()
    known = config.load("record", [*recorded, "naming=geometry"], record.Config).load_networks("four_circles", threads=1)
    assert known.detect(np.zeros((1, 240, 320), np.float32))[1].shape == (1, 5, 30, 40)


@pytest.mark.slow
def test_a_data_set_trains_a_network_of_five_identities(described, tmp_path):
    """Two steps of training; the network is one of four circles, and refused for three."""
    pytest.importorskip("mitsuba")
    pytest.importorskip("torch")
    data, out = tmp_path / "data", tmp_path / "detector"
    assert main(["dataset", described, "samples=4", "shard=4", f"out={data}"]) == 0
    for name in ("detector", "segmenter"):
        fields = [f"network={name}", f"data={data}", f"out={out}", "steps=2", "batch=2", "validation=0.5", "memory_gb=1"]
        assert main(["train", *fields, "resume=false"]) == 0
    known = networks.load(out, 1, "four_circles")
    assert known.detect(np.zeros((1, 240, 320), np.float32))[1].shape == (1, 5, 30, 40)
    with pytest.raises(InputError, match="found one of four_circles"):
        networks.load(out, 1)
