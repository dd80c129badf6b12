"""What is lit is restored from the log alone, whatever was undone; a log that was cut off is whole up to there."""

import errno
import json

import numpy as np
import pytest

from recon.errors import InputError
from recon.files import meshes
from recon.mentoring import drawing_log
from recon.mentoring.drawing_log import DrawingLog, restore
from recon.mentoring.drawings import Drawing, Drawings
from recon.mentoring.posts import Stroke
from recon.mentoring.stroke_casting import cast, look
from recon.skin_projection.live_picture import LivePicture
from tests.recon.mentoring import desk
from tests.recon.skin_projection import skin_shapes


@pytest.fixture
def files(tmp_path):
    meshes.write_ply(tmp_path / "skin.ply", skin_shapes.plane(step=2.0))
    drawing_log.begin(tmp_path / "log.jsonl", tmp_path / "skin.ply")
    return tmp_path / "log.jsonl", tmp_path / "skin.ply"


def drawn(number, who="anna", places=((300.0, 250.0), (340.0, 262.0)), **others):
    stroke = Stroke(kind="stroke", picture=5, places=list(places), **others)
    curve = cast(f"drawing{number}", stroke, desk.camera(), skin_shapes.plane(step=2.0))
    return Drawing(number, who, 1_700_000_000_000_000_000, "", look(stroke), curve), stroke


def draw_some(path):
    """Three strokes, of which the second is undone; the third leaves the skin. Returns what is lit."""
    log, lit = DrawingLog(path), Drawings()
    for number in range(3):
        drawing, stroke = drawn(number, places=((300.0, 250.0 + 4 * number), (300.0 + 160 * number, 252.0)), dashed=number == 2)
        log.drawn(drawing, 5, stroke.places)
        lit.add(drawing)
    log.removed("undone", "anna", [1])
    lit.remove([1])
    log.noted("anna has left")
    log.close()
    return lit


def test_it_is_restored_as_it_was(files):
    lit = draw_some(files[0])
    again = restore(*files)
    assert [drawing.number for drawing in again] == [0, 2] and again.next_number == 3
    for one, other in zip(lit, again, strict=True):
        np.testing.assert_allclose(one.curve.points, other.curve.points, atol=1e-4)
        assert (one.who, one.line, one.time_ns, one.curve.kind) == (other.who, other.line, other.time_ns, other.curve.kind)
    picture = LivePicture(skin_shapes.plane(), skin_shapes.projector())
    before, after = (picture.draw(each.strips, np.eye(4)).astype(int) for each in (lit, again))
    assert before.any() and np.abs(before - after).max() <= 1


def test_who_drew_what_on_which_picture_stands_in_it(files):
    draw_some(files[0])
    lines = [json.loads(line) for line in files[0].read_text().splitlines()]
    assert [line["event"] for line in lines] == ["begun", "drawn", "drawn", "drawn", "undone", "noted"]
    assert lines[1]["who"] == "anna" and lines[1]["picture"] == 5 and lines[1]["pixels"] == [[300, 250], [300, 252]]
    assert lines[1]["time"] == "2023-11-14T22:13:20.000+00:00" and len(lines[1]["points"][0]) == 3
    assert None in lines[3]["points"], "where there is no skin"


@pytest.mark.parametrize("cut", [1, 40])
def test_a_last_line_in_part_is_left_out_and_written_over(files, cut):
    """As of a computer that stopped; the same number is given again."""
    draw_some(files[0])
    log = DrawingLog(files[0])
    drawing, stroke = drawn(3)
    log.drawn(drawing, 5, stroke.places)
    log.close()
    with files[0].open("r+b") as file:
        file.truncate(files[0].stat().st_size - cut)
    assert [drawing.number for drawing in restore(*files)] == [0, 2]
    log = DrawingLog(files[0])
    log.drawn(drawing, 5, stroke.places)
    log.close()
    assert [drawing.number for drawing in restore(*files)] == [0, 2, 3]


@pytest.mark.parametrize(("old", "new", "complaint"), [
    (b'"event": "drawn"', b'"event": "drawm"', r"line 2: line.event: expected one of"),
    (b'"points": [[', b'"points": [[NaN, 0, 0], [', "line 2.*NaN"),
    (b'"points": [[', b'"points": [[1e300, 0, 0], [', "line 2.*points.*expected numbers of up to"),
    (b'"points": [[', b'"points": [[1, 2, 3], [', "line 2: points: expected as many as normals"),
    (b'"number": 0', b'"number": -1', "line 2: .*number"),
    (b'"begun"', b'"noted"', "line 1"),
    (b'2023-11', b'2023-99', "line 2: time: expected one as"),
    (b'"who": "anna", "picture": 5', b'"who": "anna"', "line 2: .*picture: expected a value, found none"),
    (b"{", b"", "line 1: expected JSON"),
])  # fmt: skip
def test_damage_is_named_by_its_line(files, old, new, complaint):
    draw_some(files[0])
    content = files[0].read_bytes()
    assert old in content
    files[0].write_bytes(content.replace(old, new, 1))
    with pytest.raises(InputError, match=complaint):
        restore(*files)


def test_a_log_of_another_skin_is_refused(files, tmp_path):
    meshes.write_ply(tmp_path / "other.ply", skin_shapes.plane(step=2.5))
    with pytest.raises(InputError, match=r"expected a log of .*other\.ply, found one of another skin"):
        restore(files[0], tmp_path / "other.ply")


def test_a_full_disk_leaves_no_part_of_a_line(files, monkeypatch):
    log = DrawingLog(files[0])
    before = files[0].read_bytes()

    class Full:
        """A file that takes half of what is written."""

        def __init__(self, file):
            self._file, self.name = file, file.name

        def write(self, content):
            return self._file.write(content[: len(content) // 2])

        def __getattr__(self, name):
            return getattr(self._file, name)

    log._file = Full(log._file)
    with pytest.raises(OSError) as error:
        log.noted("something")
    assert error.value.errno == errno.ENOSPC and files[0].read_bytes() == before
