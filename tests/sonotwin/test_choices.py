"""What conf/ ships is found by its name, whatever lies in the working directory."""

from pathlib import Path

import pytest

import sonotwin
from recon.errors import InputError
from sonotwin import choices, config, study_plan


@pytest.mark.parametrize(("group", "name"), [("rig", "meza2021"), ("patterns", "paper_surface"), ("study", "budget")])
def test_a_folder_of_the_same_name_is_none_of_the_choices(group, name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / name).mkdir()
    assert choices.file_of(group, name) == config.folder() / group / f"{name}.yaml"


def test_a_file_comes_first(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine").write_text((config.folder() / "rig" / "meza2021.yaml").read_text())
    assert sonotwin.read_rig("mine") == sonotwin.read_rig()


@pytest.mark.parametrize("suffix", [".yaml", ".yml"])
def test_a_file_may_start_from_a_shipped_one(suffix, tmp_path, monkeypatch):
    """For the command, for Python and for a study's values alike."""
    monkeypatch.chdir(tmp_path)
    Path(f"ours{suffix}").write_text("defaults: [lifelike]\nsound: {tissue: 0.01}\n", encoding="utf-8")
    Path(f"rig{suffix}").write_text("defaults: [meza2021]\nprojector: {gamma: 1.5}\n", encoding="utf-8")
    usual, ours = sonotwin.read_rig(), sonotwin.read_rig(f"rig{suffix}")
    assert ours.projector.gamma == 1.5 and ours.cam1 == usual.cam1
    lifelike = study_plan.choice("conditions", "lifelike")
    assert study_plan.choice("conditions", f"ours{suffix}") == lifelike | {"sound": lifelike["sound"] | {"tissue": 0.01}}
    assert study_plan.choice("conditions", f"ours{suffix}.motion") == {"motion": lifelike["motion"]}
    Path(f"ours{suffix}").write_text("defaults: [lifelyke]\n", encoding="utf-8")
    with pytest.raises(
        InputError, match=rf"^ours{suffix}: defaults: expected one of ideal, lifelike, found lifelyke; did you mean"
    ):
        study_plan.choice("conditions", f"ours{suffix}")
