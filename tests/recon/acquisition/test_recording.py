"""A capture that grows is whole at every moment, read by the ordinary readers."""

import os
import signal
import subprocess
import sys
import time
from datetime import date

import numpy as np
import pytest

from recon.acquisition import recording
from recon.board_detection.kinds.asymmetric_circles import AsymmetricCircles
from recon.capture import sweep_tables
from recon.capture.board_part import read_board
from recon.capture.images import read_image
from recon.capture.manifest import Device, read_manifest
from recon.errors import InputError
from recon.model.patterns import Fringes, GrayCode, Patterns

SIZE = (32, 24)
CAMERA, PROJECTOR = Device(size=SIZE, exposure_s=0.01, gain=1.0), Device(size=(64, 48))
BOARD = AsymmetricCircles(columns=4, rows=11, spacing_mm=15, diameter_mm=9)
PARTS = tuple(
    part
    for axis, bits in (("columns", 3), ("rows", 3))
    for part in (Fringes(axis=axis, pitch=8, steps=3), GrayCode(axis=axis, pitch=8, bits=bits))
)
PATTERNS = Patterns(projector_size=(64, 48), unwrap="gray", parts=PARTS)

THREE = Patterns(projector_size=(64, 48), unwrap="gray", parts=(Fringes(pitch=8, steps=3), GrayCode(pitch=8, bits=3)))
DEVICES = {"cam1": CAMERA, "projector": PROJECTOR}


def image(rng) -> np.ndarray:
    return rng.integers(0, 256, SIZE[::-1], np.uint8)


def test_every_frame_is_readable_as_soon_as_it_is_added(tmp_path, rng):
    images = [image(rng) for _ in range(5)]
    with recording.open_recording(tmp_path / "out") as capture, capture.sweep("scan", "volume", {"us": CAMERA}) as sweep:
        for k, one in enumerate(images):
            sweep.add("us", 2 * k, 100 + k, one)  # every second frame is lost
            part = read_manifest(tmp_path / "out").sweeps["scan"]
            frames, times = sweep_tables.read_stamps(tmp_path / "out" / part.images["us"] / "timestamps.csv")
            assert frames.tolist() == list(range(0, 2 * k + 1, 2)) and times.tolist() == list(range(100, 101 + k))
            assert (read_image(tmp_path / "out" / part.images["us"] / f"{2 * k:04d}.png", SIZE, 8) == one).all()


def test_a_capture_grows_over_several_recordings(tmp_path, rng):
    """Poses are numbered on, a second sweep comes beside the first, a second surface takes the first's place."""
    out = tmp_path / "out"
    for number in range(2):
        with recording.open_recording(out) as capture:
            lit, fringes = {"cam1": image(rng)}, {"cam1": np.stack([image(rng)] * PATTERNS.count)}
            name = capture.add_pose(lit, fringes, BOARD, PATTERNS, {"cam1": CAMERA, "projector": PROJECTOR})
            assert name == f"{number:02d}"
            capture.add_surface(fringes, PATTERNS, {"cam1": CAMERA, "projector": PROJECTOR})
            with capture.sweep(f"s{number}", None, {"cam1": CAMERA}) as sweep:
                sweep.add("cam1", 0, 5, image(rng))
    read = read_manifest(out)
    assert set(read.contents) == {"surface", "board", "sweep/s0", "sweep/s1"} and len(read_board(out).poses) == 2
    assert [entry.name for entry in (out / "surface").iterdir()] == ["take02"]
    assert read.surface.images["cam1"][0].startswith("surface/take02/")


def test_each_part_has_the_day_of_its_newest_images(tmp_path, rng, monkeypatch):
    """A surface of one day, and a board of the next."""
    out = tmp_path / "out"
    with recording.open_recording(out) as capture:
        for day, record in (
            (date(2026, 3, 1), lambda: capture.add_surface({"cam1": np.stack([image(rng)] * THREE.count)}, THREE, DEVICES)),
            (date(2026, 3, 2), lambda: capture.add_pose({"cam1": image(rng)}, {}, BOARD, None, DEVICES)),
        ):
            monkeypatch.setattr(recording, "_today", lambda day=day: day)
            record()
    read = read_manifest(out)
    assert read.days_of(["surface", "board"]) == {"surface": date(2026, 3, 1), "board": date(2026, 3, 2)}


def test_what_would_be_lost_or_mixed_is_refused(tmp_path, rng):
    out = tmp_path / "out"
    with recording.open_recording(out) as capture:
        with capture.sweep("scan", None, {"cam1": CAMERA}) as sweep:
            sweep.add("cam1", 0, 5, image(rng))
        with pytest.raises(InputError, match="another name=NAME"), capture.sweep("scan", None, {"cam1": CAMERA}):
            pass
        with pytest.raises(InputError, match="sweeps that all have names"), capture.sweep("", None, {"cam1": CAMERA}):
            pass
        other = {"cam1": CAMERA.model_copy(update={"size": (40, 24)})}
        with pytest.raises(InputError, match="another rig"), capture.sweep("next", None, other) as sweep:
            sweep.add("cam1", 0, 5, image(rng))
        lit, projector = {"cam1": image(rng)}, {"cam1": CAMERA, "projector": PROJECTOR}
        capture.add_pose(lit, {}, BOARD, None, projector)
        with pytest.raises(InputError, match=r"board\.board: expected the same"):
            capture.add_pose(lit, {}, BOARD.model_copy(update={"rows": 9}), None, projector)
    assert list(read_manifest(out).contents) == ["board", "sweep/scan"]
    (tmp_path / "letters").mkdir()
    (tmp_path / "letters" / "a.txt").write_text("kept")
    with (
        pytest.raises(InputError, match="a new folder or a capture folder"),
        recording.open_recording(tmp_path / "letters"),
    ):
        pass


def test_files_of_others_stay(tmp_path, rng):
    """In a take that another replaces, in the folder that the next pose would have, and where a sweep is to be recorded."""
    out, cameras = tmp_path / "out", {"cam1": CAMERA, "projector": PROJECTOR}
    lit = {"cam1": image(rng)}
    with recording.open_recording(out) as capture:
        capture.add_pose(lit, {}, BOARD, None, cameras)
        for name in ("board/01", "sweep/scan/cam1", "surface/take07"):
            (out / name).mkdir(parents=True)
            (out / name / "0000.png").write_bytes(b"years of work")
        assert capture.add_pose(lit, {}, BOARD, None, cameras) == "02"
        with (
            pytest.raises(InputError, match=r"sweep/scan/cam1: .*found 0000\.png"),
            capture.sweep("scan", None, {"cam1": CAMERA}),
        ):
            pass
    with recording.open_recording(out):
        pass
    assert all(
        (out / name / "0000.png").read_bytes() == b"years of work" for name in ("board/01", "sweep/scan/cam1", "surface/take07")
    )


def test_a_sweep_that_was_never_entered_is_begun_anew(tmp_path, rng, monkeypatch):
    """As after a kill between its first frame and the manifest."""
    out = tmp_path / "out"

    def killed(*_):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch, recording.open_recording(out) as capture:
        capture.add_pose({"cam1": image(rng)}, {}, BOARD, None, {"cam1": CAMERA, "projector": PROJECTOR})
        patch.setattr(recording.Recording, "_enter", killed)
        with pytest.raises(KeyboardInterrupt), capture.sweep("scan", None, {"cam1": CAMERA}) as sweep:
            sweep.add("cam1", 7, 5, image(rng))
    with recording.open_recording(out) as capture, capture.sweep("scan", None, {"cam1": CAMERA}) as sweep:
        sweep.add("cam1", 0, 5, image(rng))
    assert sorted(path.name for path in (out / "sweep/scan/cam1").iterdir()) == ["0000.png", "timestamps.csv"]


def test_nothing_is_left_of_a_recording_of_nothing(tmp_path):
    with pytest.raises(InputError, match="optics"), recording.open_recording(tmp_path / "out") as capture:
        capture.add_calibration(tmp_path / "optics.yaml", {})
    assert list(tmp_path.iterdir()) == []


def test_a_torn_row_is_mended_and_said(tmp_path, rng, caplog):
    out = tmp_path / "out"
    with recording.open_recording(out) as capture, capture.sweep("", None, {"us": CAMERA}) as sweep:
        sweep.add("us", 0, 5, image(rng))
        sweep.add("us", 1, 6, image(rng))
    table = out / "sweep/us/timestamps.csv"
    table.write_text(table.read_text() + "2,")
    (out / "sweep/us/.0003.png.part").write_bytes(b"half")
    with recording.open_recording(out):
        pass
    assert sweep_tables.read_stamps(table)[0].tolist() == [0, 1] and "mended" in caplog.text
    assert not list(out.glob("**/.*.part"))


def test_a_full_disk_leaves_the_rows_before(tmp_path, monkeypatch):
    table = recording.GrowingTable(tmp_path / "timestamps.csv")
    table.append(0, 5)
    write = os.write
    monkeypatch.setattr(os, "write", lambda file, row: write(file, row[:2]))
    with pytest.raises(OSError, match="No space left"):
        table.append(1, 6)
    table.close()
    assert sweep_tables.read_stamps(tmp_path / "timestamps.csv")[0].tolist() == [0]


RECORDER = """
import sys, numpy as np
from pathlib import Path
from recon.acquisition import recording
from recon.capture.manifest import Device
rng, devices = np.random.default_rng(0), {"cam1": Device(size=(32, 24)), "us": Device(size=(32, 24))}
with recording.open_recording(Path(sys.argv[1])) as capture, capture.sweep(sys.argv[2], None, devices) as sweep:
    for k in range(100_000):
        for device in devices:
            sweep.add(device, k, k, rng.integers(0, 256, (24, 32), np.uint8))
        print(k, flush=True)
"""


@pytest.mark.slow
def test_kill_9_loses_nothing(tmp_path, rng):
    """Killed at four moments, one after the other into one capture: all that was said to be recorded is there and whole."""
    out, said = tmp_path / "out", []
    for number in range(4):
        line = [sys.executable, "-c", RECORDER, str(out), f"s{number}"]
        process = subprocess.Popen(line, stdout=subprocess.PIPE, text=True)
        said.append(int(process.stdout.readline()))
        time.sleep(rng.uniform(0, 0.2))
        process.send_signal(signal.SIGKILL)
        said[-1] = max([said[-1], *map(int, process.communicate()[0].split("\n")[:-1])])
        part = read_manifest(out).sweeps[f"s{number}"]
        for place in part.paths():
            frames, _ = sweep_tables.read_stamps(out / place / "timestamps.csv")
            assert frames.tolist() == list(range(len(frames))) and len(frames) > said[-1]
            for frame in frames.tolist():
                read_image(out / place / f"{frame:04d}.png", (32, 24), 8)
    assert max(said) > 0, "some were killed amid their frames"
