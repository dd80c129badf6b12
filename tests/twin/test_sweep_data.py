"""Many sweeps: each of its own patient and hand, resumed, and of the same bytes on any engine."""

import hashlib
import json
import re
from contextlib import nullcontext
from copy import deepcopy

import pytest

from recon.capture.manifest import MANIFEST
from recon.errors import InputError
from scenes.kinds import patient
from twin import sweep_data
from twin.engine import Engine
from twin.filmed_sweep import SweepSettings
from twin.living.living_body import Living
from twin.ultrasound.probe_path import Hold
from twin.ultrasound.transducer import Transducer


@pytest.fixture
def settings(rig):
    return SweepSettings(rig=rig, scene={"kind": "breast"}, ultrasound=Transducer(), path=Hold(seconds=0.1), seed=4)


def digest(folder):
    found = hashlib.sha256()
    for path in sorted(folder.rglob("*")):
        if path.is_file():
            found.update(str(path.relative_to(folder)).encode() + path.read_bytes())
    return found.hexdigest()


def test_each_sweep_has_a_seed_and_a_patient_of_its_own(settings):
    later = sweep_data.numbered(settings, 3)
    assert (later.seed, later.scene["seed"]) == (7, 14), "of the seed 7 of scenes, and of 4 + 3"
    assert later.path == settings.path
    cut = sweep_data.numbered(settings.model_copy(update={"scene": {"kind": "sphere"}}), 3)
    assert cut.scene == {"kind": "sphere"}


def test_patients_have_drawn_masses_unless_they_are_given(settings):
    given = [{"size_mm": 9.0, "centre_mm": (0.0, 0.0, 20.0)}]
    usual = [one.model_dump(mode="json") for one in patient.USUAL]
    for masses in (None, given, usual, [], "drawn"):
        expected = "drawn" if masses is None else masses
        chosen = settings.model_copy(update={"scene": {"kind": "patient", "seed": 20, "masses": masses}})
        scenes = [sweep_data.numbered(chosen, number).scene for number in range(2)]
        assert [scene["seed"] for scene in scenes] == [24, 25] and [scene["masses"] for scene in scenes] == [expected] * 2


def test_sweeps_that_are_there_are_kept(settings, tmp_path):
    """None is made again, nor replaced by one of other settings."""
    assert sweep_data.missing(tmp_path, settings, 2) == [0, 1]
    assert list(sweep_data.make(tmp_path, settings, [0], Engine())) == [3]
    assert sweep_data.missing(tmp_path, settings, 2) == [1]
    for change, difference in (
        ({"seed": 5}, "seed: expected 5 as in this run, found 4"),
        ({"path": Hold(seconds=0.2)}, "path.seconds: expected 0.2 as in this run, found 0.1"),
        ({"scene": {"kind": "breast", "edge_mm": 1.0}}, "scene.edge_mm: expected 1.0 as in this run, found 0.75"),
    ):
        there = f"{tmp_path / '000000' / 'truth' / 'settings.json'}: {difference}, another sweep; choose another out"
        with pytest.raises(InputError, match=rf"^{re.escape(there)}$"):
            sweep_data.missing(tmp_path, settings.model_copy(update=change), 1)


def test_one_sweep_and_many_dont_mix(settings, tmp_path):
    sweep_data.check_alone(tmp_path)
    (tmp_path / "000000" / "capture").mkdir(parents=True)
    with pytest.raises(InputError, match="expected nothing, found the first of many sweeps; choose another out"):
        sweep_data.check_alone(tmp_path)
    (tmp_path / "capture").mkdir()
    with pytest.raises(InputError, match="expected nothing, found a single sweep"):
        sweep_data.missing(tmp_path, settings, 2)


def test_settings_that_a_set_was_begun_before_have_their_defaults_in_it(settings, tmp_path):
    """So that it goes on; a field that is gone, or one of another value, is another set's."""
    truth, capture = tmp_path / "000000" / "truth", tmp_path / "000000" / "capture"
    truth.mkdir(parents=True)
    capture.mkdir()
    (capture / MANIFEST).touch()
    chosen = settings.model_copy(update={"scene": {"kind": "breast", "seed": 7, "roughness": 0.5, "edge_mm": 0.75}})
    whole = sweep_data.numbered(chosen, 0).model_dump(mode="json")
    for change, found in (
        (lambda one: one["living"].pop("element_mm"), None),
        (lambda one: one["scene"].pop("edge_mm"), None),
        (lambda one: one["scene"].pop("roughness"), r"scene\.roughness: expected 0\.5 as in this run, found 0\.\d+,"),
        (lambda one: one["living"].update(element_mm=5.0), r"living\.element_mm: expected 3\.0 as in this run, found 5\.0,"),
        (lambda one: one["living"].update(gone=1), r"living\.gone: expected None as in this run, found 1,"),
    ):
        change(stored := deepcopy(whole))
        (truth / "settings.json").write_text(json.dumps(stored), encoding="utf-8")
        with nullcontext() if found is None else pytest.raises(InputError, match=found):
            assert sweep_data.missing(tmp_path, chosen, 1) == []


def test_foreign_files_are_not_replaced(settings, tmp_path):
    mine = tmp_path / "000001" / "capture"
    mine.mkdir(parents=True)
    (mine / "notes.txt").write_text("mine", encoding="utf-8")
    with pytest.raises(InputError, match=r"notes\.txt"):
        sweep_data.missing(tmp_path, settings, 2)


def test_what_workers_had_begun_goes_away_when_one_is_refused(settings, tmp_path, monkeypatch):
    """They are ended with what they hold; what others have put there stays."""

    def refused(engine, work, tasks):
        yield 3
        for number, (out, _, _) in enumerate(tasks):
            for name in ("truth", "capture"):
                (out / f"{number:06d}" / f".{name}.4194305.new").mkdir(parents=True)  # above the largest process number
                (out / f"{number:06d}" / f".{name}.lock").write_text("")
        raise InputError("refused")

    monkeypatch.setattr(sweep_data, "results", refused)
    (tmp_path / "shared" / "000001").mkdir(parents=True)
    (tmp_path / "shared" / "000001" / "notes.txt").write_text("mine", encoding="utf-8")
    for name in ("own", "shared"):
        with pytest.raises(InputError, match="refused"):
            list(sweep_data.make(tmp_path / name, settings, [0, 1], Engine()))
    assert [str(path.relative_to(tmp_path)) for path in sorted(tmp_path.rglob("*"))] == [
        "shared",
        "shared/000001",
        "shared/000001/notes.txt",
    ]


def test_a_run_that_is_refused_leaves_what_it_found(settings, tmp_path, monkeypatch):
    """Empty folders, too; not so its own, nor the lock of a worker that was ended before it had made more."""

    def refused(engine, work, tasks):
        for out, _, number in tasks:
            (out / f"{number:06d}").mkdir(parents=True, exist_ok=True)
            (out / f"{number:06d}" / ".capture.lock").write_text("")
        yield from ()
        raise InputError("refused")

    monkeypatch.setattr(sweep_data, "results", refused)
    (tmp_path / "mine" / "000001").mkdir(parents=True)
    for out in ("mine", "new/within"):
        with pytest.raises(InputError, match="refused"):
            list(sweep_data.make(tmp_path / out, settings, [0, 1], Engine()))
    assert [str(path.relative_to(tmp_path)) for path in sorted(tmp_path.rglob("*"))] == ["mine", "mine/000001"]


@pytest.mark.slow
def test_engines_give_the_same_bytes(settings, tmp_path):
    """Of patients who breathe and yield, whatever was worked out before in the same process."""
    living = Living(yields=True, breathing_mm=3.0, heartbeat_mm=0.3, drag_mm=1.0, element_mm=5.0)
    small = {"kind": "breast", "size_mm": (90.0, 70.0, 35.0), "apex_mm": (5.0, -3.0), "areola_width_mm": 25.0, "tumours": ()}
    held = Hold(place_mm=(4.0, -2.0), seconds=0.1, standoff_mm=-1.0)
    patients = settings.model_copy(update={"scene": small, "living": living, "path": held})
    for name, engine in (("one", Engine()), ("two", Engine(workers=2)), ("dask", Engine(name="dask", workers=2))):
        assert sorted(sweep_data.make(tmp_path / name, patients, [0, 1], engine)) == [3, 3]
    assert digest(tmp_path / "one") == digest(tmp_path / "two") == digest(tmp_path / "dask")
