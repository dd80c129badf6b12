"""The command `sonotwin dataset`: what it refuses in one line, before anything is rendered."""

import os

import pytest

from recon.files.occupied import occupied

pytest.importorskip("mitsuba")

from sonotwin.cli import main


def test_a_second_run_into_the_folder_is_refused_at_once(tmp_path, capsys):
    out = tmp_path / "out"
    with occupied(out):
        assert main(["dataset", f"out={out}", "samples=2"]) == 2
    said = capsys.readouterr().err
    assert f"found process {os.getpid()} on " in said and said.count("\n") == 1
    assert not out.exists()


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (["first=-1"], "dataset: first: expected greater than or equal to 0, found -1"),
        (["first=x"], "dataset: first: expected integer"),
    ],
)
def test_refuses_in_one_line(tmp_path, capsys, more, message):
    assert main(["dataset", f"out={tmp_path / 'out'}", "samples=2", *more]) == 2
    said = capsys.readouterr().err
    assert message in said and said.count("\n") == 1
    assert not (tmp_path / "out").exists()
