"""Poses of a board come back as written, one at a time; what is wrong with a set is said in one line before images are read."""

import json
from pathlib import Path

import numpy as np
import pytest

from recon.capture import board_part, manifest, writer
from recon.capture.manifest import BoardPart, Device
from recon.errors import InputError
from tests.recon.captures import BOARD, PATTERNS, PROJECTOR

SIZE = (64, 48)
NAMES = ("00", "01", "02")


def images(name: str, bits: int = 8) -> tuple[dict, dict]:
    """Lit images of two cameras, and the fringes of the first; noise, other for each pose."""
    rng = np.random.default_rng(int(name))
    stack = rng.integers(0, 1 << bits, (PATTERNS.count + 2, SIZE[1], SIZE[0])).astype(np.uint8 if bits == 8 else np.uint16)
    return {"cam1": stack[-2], "cam2": stack[-1]}, {"cam1": stack[:-2]}


def write(folder: Path, bits: int = 8) -> Path:
    devices = {
        "cam1": Device(size=SIZE, bits=bits),
        "cam2": Device(size=SIZE, bits=bits),
        "projector": Device(size=PROJECTOR),
    }
    with writer.new_capture(folder, "set") as capture:
        records = tuple(writer.write_pose(capture.folder, name, *images(name, bits)) for name in NAMES)
        capture.add_board(BoardPart(board=BOARD, patterns=PATTERNS, poses=records), devices)
    return folder


@pytest.fixture
def folder(tmp_path) -> Path:
    return write(tmp_path / "capture")


@pytest.mark.parametrize("bits", [8, 12])
def test_a_set_comes_back(tmp_path, bits):
    found = board_part.read_board(write(tmp_path / "capture", bits))
    assert (found.board, found.patterns, found.poses, found.cameras) == (BOARD, PATTERNS, NAMES, ("cam1", "cam2"))
    for number, name in enumerate(NAMES):
        pose = found.pose(number)
        lit, fringes = images(name, bits)
        assert pose.name == name and list(pose.lit) == ["cam1", "cam2"]
        np.testing.assert_array_equal(pose.fringes, fringes["cam1"])
        for camera, image in lit.items():
            np.testing.assert_array_equal(pose.lit[camera], image)


def edit(folder: Path, change) -> None:
    content = json.loads((folder / "manifest.json").read_text())
    change(content)
    (folder / "manifest.json").write_text(json.dumps(content))


def test_cameras_alone_make_a_set(folder):
    """Without fringes, and with a second camera that missed a pose."""
    edit(folder, lambda m: m["board"].pop("patterns"))
    edit(folder, lambda m: [pose.pop("fringes") for pose in m["board"]["poses"]])
    edit(folder, lambda m: m["board"]["poses"][1]["lit"].pop("cam2"))
    edit(folder, lambda m: m["devices"].pop("projector"))
    found = board_part.read_board(folder)
    assert found.patterns is None and found.pose(0).fringes is None
    assert [list(found.pose(k).lit) for k in range(3)] == [["cam1", "cam2"], ["cam1"], ["cam1", "cam2"]]


@pytest.mark.parametrize("bits", [8, 12])
def test_without_a_lit_image_the_mean_of_the_fringes_serves(tmp_path, bits):
    """Of those images alone that together light all alike, so that the code's stripes don't show; full scale stays full scale."""
    folder = write(tmp_path / "capture", bits)
    edit(folder, lambda m: m["board"]["poses"][1]["lit"].pop("cam1"))
    edit(folder, lambda m: m["board"]["poses"][2].pop("lit"))
    found = board_part.read_board(folder)
    assert found.cameras == ("cam1", "cam2") and list(found.pose(2).lit) == ["cam1"]
    lit, stack = found.pose(1).lit["cam1"], images("01", bits)[1]["cam1"]
    fringes = stack[[0, 1, 2, 6, 7, 8]]  # the others are Gray code
    saturated = (fringes == 2**bits - 1).any(axis=0)
    assert np.allclose(lit, np.where(saturated, 2**bits - 1, fringes.mean(axis=0)), rtol=1e-5)
    assert found.pose(1).fringes is not None


def test_a_pose_without_lit_images_is_written_and_read(tmp_path):
    with writer.new_capture(tmp_path / "capture") as capture:
        records = (writer.write_pose(capture.folder, "00", {}, images("00")[1]),)
        devices = {"cam1": Device(size=SIZE), "projector": Device(size=PROJECTOR)}
        capture.add_board(BoardPart(board=BOARD, patterns=PATTERNS, poses=records), devices)
    assert list(board_part.read_board(tmp_path / "capture").pose(0).lit) == ["cam1"]


def test_a_failed_write_leaves_no_half_pose(tmp_path, monkeypatch):
    """What was written of a pose before the disk was full goes away; poses before it stay."""
    writer.write_pose(tmp_path, "00", *images("00"))
    calls = iter([writer.write_images])

    def fail_later(*arguments):
        next(calls, fail)(*arguments)

    def fail(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(writer, "write_images", fail_later)
    with pytest.raises(OSError, match="No space"):
        writer.write_pose(tmp_path, "01", *images("01"))
    assert [path.name for path in (tmp_path / "board").iterdir()] == ["00"]


FAULTS = {
    "no board": (
        lambda f: edit(f, lambda m: m.pop("board")),
        "manifest.json: expected board, the poses of a calibration board, found none",
    ),
    "unknown camera": (
        lambda f: edit(f, lambda m: m["devices"].pop("cam2")),
        "manifest.json: board.poses.0.lit.cam2: expected one of the devices cam1, projector, found cam2",
    ),
    "unknown camera of fringes": (
        lambda f: edit(f, lambda m: m["board"]["poses"][2]["fringes"].update(cam3=m["board"]["poses"][2]["fringes"]["cam1"])),
        "manifest.json: board.poses.2.fringes.cam3: expected one of the devices cam1, cam2, projector, found cam3",
    ),
    "an image short": (
        lambda f: edit(f, lambda m: m["board"]["poses"][1]["fringes"]["cam1"].pop()),
        "manifest.json: board.poses.1.fringes.cam1: expected 12 images, one a pattern, found 11",
    ),
    "two of a name": (
        lambda f: edit(f, lambda m: m["board"]["poses"][2].update(name="00")),
        "manifest.json: board.poses.2.name: expected another than that of poses.0, found 00",
    ),
    "no poses": (lambda f: edit(f, lambda m: m["board"].update(poses=[])), "manifest.json: board.poses: expected"),
    "no image": (
        lambda f: edit(f, lambda m: m["board"]["poses"][0].update(lit={}, fringes={})),
        "manifest.json: board.poses.0.lit: expected an image of a camera here or fringes, found none of both",
    ),
    "one axis": (
        lambda f: edit(f, lambda m: m["board"]["patterns"].update(parts=m["board"]["patterns"]["parts"][:2])),
        "manifest.json: board.patterns: expected fringes or Gray code along both axes, found none along rows",
    ),
    "fringes of no patterns": (
        lambda f: edit(f, lambda m: m["board"].pop("patterns")),
        "manifest.json: board.patterns: expected those of poses.0.fringes, found none",
    ),
    "another raster": (
        lambda f: edit(f, lambda m: m["devices"]["projector"].update(size=[200, 100])),
        "manifest.json: devices.projector.size: expected 128x80 as in board.patterns, found 200x100",
    ),
    "another kind of board": (
        lambda f: edit(f, lambda m: m["board"]["board"].update(kind="triangles")),
        "manifest.json: board.board",
    ),
    "lost image": (lambda f: (f / "board/02/cam2/lit.png").unlink(), "02/cam2/lit.png: expected a file, found none"),
    "folder for an image": (
        lambda f: ((f / "board/02/cam1/0000.png").unlink(), (f / "board/02/cam1/0000.png").mkdir()),
        "02/cam1/0000.png: expected a file, found a folder",
    ),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_faults_are_said_before_images_are_read(folder, fault):
    spoil, complaint = FAULTS[fault]
    spoil(folder)
    with pytest.raises(InputError) as caught:
        board_part.read_board(folder)
    assert complaint in str(caught.value) and "\n" not in str(caught.value)


def test_a_damaged_image_is_named_with_its_pose(folder):
    path = folder / "board" / "01" / "cam1" / "0004.png"
    path.write_bytes(path.read_bytes()[:-20])
    found = board_part.read_board(folder)
    found.pose(0)
    with pytest.raises(InputError, match=r"board/01/cam1/0004\.png: expected a whole PNG image, found it cut short"):
        found.pose(1)


def test_a_surface_and_a_board_share_a_manifest(folder):
    """Parts are independent: one that is not there is none."""
    assert manifest.read_manifest(folder).surface is None
