"""`sonotwin print`: sheets are written whole, said how to be used, and refused with a way on where they don't fit."""

import re
import shlex
from pathlib import Path

import pytest
import yaml

from recon.artwork.protocol_card import AFTER, STEPS
from recon.model.rig import Rig
from sonotwin import choices
from sonotwin.cli import main
from sonotwin.config import load
from sonotwin.verbs import identify, record
from tests.recon.artwork.rasters import raster

WIDE = "board={kind: chessboard, columns: 9, rows: 6, square_mm: 25}"


@pytest.fixture(autouse=True)
def place(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def refusal(capsys, *fields: str) -> str:
    """The line that refuses; nothing is written."""
    assert main(["print", *fields]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    return line.removeprefix("sonotwin: ")


def test_a_board_and_a_target_are_written(place, capsys):
    """Of the usual design, on A4; the same bytes again."""
    assert main(["print", "part=board", "out=sheets/board.pdf"]) == 0
    assert "board={kind: asymmetric_circles, columns: 4, rows: 11, spacing_mm: 15, diameter_mm: 9}" in (
        capsys.readouterr().out.replace("'", "")
    )
    assert main(["print", "part=target", "rig.target.c1_mm=30", "out=sheets/target.pdf"]) == 0
    for name in ("board", "target"):
        image, pixel = raster(place / "sheets" / f"{name}.pdf", 50)
        assert image.shape[1] * pixel[0] == pytest.approx(210, abs=0.01)
    before = (place / "sheets/board.pdf").read_bytes()
    assert main(["print", "part=board", "out=sheets/board.pdf"]) == 0
    assert (place / "sheets/board.pdf").read_bytes() == before
    assert sorted(path.name for path in (place / "sheets").iterdir()) == ["board.pdf", "target.pdf"]


def test_the_protocol_is_a_page_and_refused_on_less_paper(place, capsys):
    assert main(["print", "part=protocol", "paper=letter", "out=protocol.pdf"]) == 0
    assert "6 steps, 20 minutes" in capsys.readouterr().out and (place / "protocol.pdf").is_file()
    said = refusal(capsys, "part=protocol", "paper=[148,210]", "out=small.pdf")
    assert said.startswith("paper: expected 210x279.4 mm or more, upright") and not (place / "small.pdf").exists()
    assert "family: expected none with part=protocol, found 3" in refusal(capsys, "part=protocol", "family=3", "out=small.pdf")


def test_commands_of_the_protocol_are_whole(place):
    """Each is valid once both files are there and letters are numbers: by these devices and this rig, in one folder."""
    (place / "ours.yaml").write_text("defaults: [basler]\n")
    (place / "our_rig.yaml").write_text("defaults: [meza2021]\nprojector: {wavelength_nm: 460}\n")
    for step in [step for step in STEPS if step.command]:
        _, verb, *fields = shlex.split(step.place)
        config = load(verb, fields, record.Config)
        assert config.part == step.name.lower() and config.out == Path("session")
        assert config.devices.kind == "live" and config.rig.projector.wavelength_nm == 460
    numbers = AFTER.replace("[U,V,W,H]", "[40,60,320,400]").replace("[X,Z]", "[0.12,0.08]").replace("=F ", "=7.5 ")
    _, verb, *fields = shlex.split(numbers)
    config = load(verb, fields, identify.Config)
    assert config.capture == Path("session") and config.rig.projector.wavelength_nm == 460 and config.step_mm == 0.2
    into = STEPS[-1].place
    assert all(folder.startswith("session/us/") and folder in into for folder in (config.tissue, config.air, config.steps))


def test_a_board_too_large_is_refused_with_paper_and_lengths_that_fit(place, capsys):
    """And what the message offers fits: the smallest paper, and the largest squares to a tenth of a mm."""
    said = refusal(capsys, "part=board", WIDE, "out=board.pdf")
    assert said.startswith("paper: expected ") and "found 210x297 mm; give paper=a3, or at most square " in said
    side = float(said.rpartition("square ")[2].removesuffix(" mm"))
    assert not list(place.iterdir())
    assert main(["print", "part=board", WIDE.replace("25", f"{side}"), "out=board.pdf"]) == 0
    refusal(capsys, "part=board", WIDE.replace("25", f"{side + 0.1:.1f}"), "out=other.pdf")
    assert main(["print", "part=board", WIDE, "paper=a3", "out=board.pdf"]) == 0
    assert main(["print", "part=board", WIDE, "paper=[240,320]", "out=board.pdf"]) == 0


def test_of_a_board_too_large_the_lengths_alone_are_offered(capsys):
    """A dictionary, which stands in the board's words too, changes nothing about its size."""
    board = "board={kind: charuco, columns: 12, rows: 9, square_mm: 30, marker_mm: 22}"
    assert re.search(r"or at most square [\d.]+ mm, marker [\d.]+ mm$", refusal(capsys, "part=board", board, "out=board.pdf"))


@pytest.mark.parametrize(
    ("fields", "said"),
    [
        (["part=target", WIDE, "out=x.pdf"], "print: board: expected none with part=target, which draws rig.target"),
        (
            ["part=board", "out=x.pdf", "paper=a9"],
            "print: paper: expected 'a4', 'letter', 'a3', 'tabloid', 'a2', 'a1' or 'a0', found 'a9' (and 1 more)",
        ),
        (["part=board", "out=x.png"], "out: expected the name of a PDF, such as board.pdf, found x.png"),
        (
            ["part=board", "out=x.pdf", "board={kind: symmetric_circles, columns: 4, rows: 4, spacing_mm: 9, diameter_mm: 9}"],
            "board.diameter_mm: expected less than the 9.00 mm between centres, found 9",
        ),
        (
            ["part=target", "out=x.pdf", "paper=[100,150]"],
            "paper: expected 200x127 mm or more for a target of 60x65 mm with its rulers, found 100x150 mm; give paper=a4",
        ),
        (
            [
                "part=board",
                "out=x.pdf",
                "board={kind: charuco, columns: 5, rows: 7, square_mm: 9, marker_mm: 7, dictionary: DICT_X}",
            ],
            "dictionary: expected one of OpenCV's, such as DICT_5X5_100, found 'DICT_X'",
        ),
    ],
)
def test_mistakes_are_refused(fields, said, place, capsys):
    assert refusal(capsys, *fields) == said
    assert not list(place.iterdir())


def test_a_file_isnt_taken_for_a_folder(place, capsys):
    (place / "text").write_text("a note")
    assert refusal(capsys, "part=target", "out=text/x.pdf") == "text/x.pdf: expected a place in a folder, found text to be a file"


def test_a_pdf_of_others_is_left_alone(tmp_path, capsys):
    """One of ours is replaced."""
    (tmp_path / "thesis.pdf").write_bytes(b"%PDF-1.4 years of work")
    assert main(["print", "part=board", f"out={tmp_path / 'thesis.pdf'}"]) == 2
    assert "thesis.pdf: expected nothing or a sheet as it was written, found a file of others" in capsys.readouterr().err
    assert (tmp_path / "thesis.pdf").read_bytes() == b"%PDF-1.4 years of work"
    for _ in range(2):
        assert main(["print", "part=board", f"out={tmp_path / 'board.pdf'}"]) == 0


def test_a_family_of_targets_is_drawn_that_makes_a_rig(tmp_path, capsys):
    """Three pages; the lines printed describe bodies that the rig's check takes; another body's target is drawn by its name."""
    out = tmp_path / "targets.pdf"
    assert main(["print", "part=target", "family=3", f"out={out}"]) == 0
    printed = capsys.readouterr().out
    assert out.read_bytes().count(b"/Type /Page\n") == 3 or b"/Count 3" in out.read_bytes()
    bodies = yaml.safe_load(printed[printed.index("            bodies:") :])["bodies"]
    rig = choices.read_rig()
    assert len(Rig.model_validate(rig.model_dump() | {"bodies": bodies}).targets) == 3
    assert main(["print", "part=target", "family=3", "rig=three_bodies", f"out={out}"]) == 0
    printed, three = capsys.readouterr().out, choices.read_rig("three_bodies").bodies
    bodies = yaml.safe_load(printed[printed.index("            bodies:") :])["bodies"]
    assert {name: body["c1_mm"] for name, body in bodies.items()} == {name: body.c1_mm for name, body in three.items()}
    assert main(["print", "part=target", "rig=three_bodies", "body=needle", f"out={tmp_path / 'needle.pdf'}"]) == 0
    assert "59 x 57 mm" in capsys.readouterr().out


def test_bodies_that_are_not_there_and_families_of_boards_are_refused(tmp_path, capsys):
    for fields, said in (
        (["part=target", "rig=three_bodies", "body=nedle"], "body: expected one of probe, needle, patient, found nedle"),
        (["part=target", "family=9"], "family: expected less than or equal to 6"),
        (["part=board", "family=2"], "family: expected none with part=board"),
    ):
        assert main(["print", *fields, f"out={tmp_path / 'x.pdf'}"]) == 2
        assert said in capsys.readouterr().err
        assert not (tmp_path / "x.pdf").exists()
