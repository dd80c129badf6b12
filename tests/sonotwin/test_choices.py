"""What conf/ ships is found by its name, whatever lies in the working directory."""

import pytest

import sonotwin
from sonotwin import choices, config


@pytest.mark.parametrize(("group", "name"), [("rig", "meza2021"), ("patterns", "paper_surface"), ("study", "budget")])
def test_a_folder_of_the_same_name_is_none_of_the_choices(group, name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / name).mkdir()
    assert choices.file_of(group, name) == config.folder() / group / f"{name}.yaml"


def test_a_file_comes_first(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine").write_text((config.folder() / "rig" / "meza2021.yaml").read_text())
    assert sonotwin.read_rig("mine") == sonotwin.read_rig()
