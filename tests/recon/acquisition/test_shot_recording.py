"""Single shots are frames around one moment at rest; one that is deleted leaves nothing behind."""

import time
from collections import deque
from itertools import count
from pathlib import Path

import numpy as np
import pytest

from recon.acquisition.frame_checks import Limits
from recon.acquisition.pictures import hidden
from recon.acquisition.recording import Recording, open_recording
from recon.acquisition.shot_recording import record_shots
from recon.acquisition.sweep_recording import SweepPlan
from recon.capture import manifest, sweep_tables
from recon.capture.images import read_image
from recon.capture.manifest import Device
from recon.devices.interfaces import DeviceError, Frame
from twin.devices.virtual_sweep import FramePair

SIZE = (32, 24)
DEVICES = {name: Device(size=SIZE) for name in ("cam1", "cam2", "us")}
NOW = 10**15


class Source:
    """Frames every `period_ms` of their own time, as fast as they are read; a pixel is where the target is."""

    name, size = "us", SIZE

    def __init__(self, period_ms: float = 50.0, moves_px: float = 0.0, late_ms: float = 0.0, last: int = 10**9) -> None:
        self.period_ns, self.moves_px, self.late_ns, self.last = round(1e6 * period_ms), moves_px, round(1e6 * late_ms), last
        self.numbers = count()

    def frame(self, timeout_s):
        time.sleep(0.002)
        number = next(self.numbers)
        if number >= self.last:
            raise DeviceError("us: unplugged; check cable and power")
        image = np.full(SIZE[::-1], round(self.moves_px * number) % 256, np.uint8)
        moment = NOW + number * self.period_ns + self.late_ns
        return Frame(image, number, moment, moment + 1_000_000)

    def pair(self, timeout_s):
        frame = self.frame(timeout_s)
        return FramePair((frame, frame))

    def start(self, trigger, second=None):
        pass

    def rest(self):
        return ()

    def stop(self):
        return ()


class Presses:
    """Presses one key after each request, then ends."""

    def __init__(self, *keys: str) -> None:
        self.asked: list[str] = []
        self._keys, self._answered = deque(keys), 0

    def ask(self, step):
        self.asked.append(step.text)

    def answer(self):
        if self._answered == len(self.asked):
            return "wait"
        self._answered += 1
        return self._keys.popleft() if self._keys else "end"


def places(image, bits):
    """Of one circle, found where the image isn't of full scale."""
    return np.array([[float(image[0, 0]), 0.0]]) if image[0, 0] < 255 else np.full((1, 2), np.nan)


def record(out: Path, operator, pairs=None, scanner=None, name="wires", silent_s=20.0, said=None) -> int:
    plan = SweepPlan(name, "probe", ("free", "hardware"), None, silent_s, Limits())
    say = [].append if said is None else said.append
    pairs, scanner = pairs or Source(), scanner or Source(late_ms=20)
    with open_recording(out) as recording:
        return record_shots(recording, pairs, scanner, DEVICES, operator, plan, 1.0, {}, places, say, hidden)


def table(out: Path, device: str, name="wires"):
    return sweep_tables.read_stamps(out / "sweep" / name / device / "timestamps.csv")


def images(out: Path, device: str, name="wires") -> list[int]:
    return sorted(int(path.stem) for path in (out / "sweep" / name / device).glob("*.png"))


def test_a_shot_is_a_scan_between_two_pairs(tmp_path):
    """The B-scan's stamp may be late by a tenth of a second, and all three frames lie within what poses are interpolated over."""
    said: list[str] = []
    assert record(tmp_path / "out", Presses("take", "take", "take"), said=said) == 3
    out = tmp_path / "out"
    (first, pairs), (second, others), (scans, times) = (table(out, device) for device in DEVICES)
    assert len(pairs) == 6 and (pairs == others).all() and (first == second).all() and len(times) == 3
    before, after = pairs.reshape(3, 2).T
    assert (before <= times - 10**8).all() and (after >= times).all() and (after - before <= 0.25e9).all()
    assert images(out, "us") == scans.tolist() and images(out, "cam1") == first.tolist()
    assert read_image(out / f"sweep/wires/us/{scans[0]:04d}.png", SIZE, 8).shape == SIZE[::-1]
    assert manifest.read_manifest(out).sweeps["wires"].purpose == "probe" and "recorded 3 shots" in said
    assert not list(out.rglob(".*.part")) + list(out.rglob(".sonotwin.json"))


@pytest.mark.parametrize(("key", "kept"), [("take", 0), ("keep", 1)])
def test_a_probe_that_moves_is_kept_only_if_told(tmp_path, key, kept):
    """2 px from frame to frame: some 6 px from the pair before to that after."""
    said: list[str] = []
    assert record(tmp_path / "out", Presses(key), Source(moves_px=2), said=said) == kept
    assert (tmp_path / "out").exists() == bool(kept)
    assert any("not kept: cam1 target moved by" in line for line in said) == (not kept)
    assert said[-1] == ("recorded 1 shots" if kept else "recorded 0 shots, 1 not kept")


@pytest.mark.parametrize(
    ("pairs", "reason"),
    [(Source(period_ms=300), "beyond 0.25 s no pose lies between them"), (Source(moves_px=1e-9), "")],
    ids=["slow cameras", "none"],
)
def test_the_reason_of_a_refusal_is_said(tmp_path, pairs, reason):
    said: list[str] = []
    assert record(tmp_path / "out", Presses("take"), pairs, said=said) == (not reason)
    assert any(reason in line for line in said)


def test_an_unseen_target_is_named(tmp_path, monkeypatch):
    blind = Source()
    monkeypatch.setattr(blind, "frame", lambda timeout_s: (time.sleep(0.002), frame_of_white(blind))[1])
    said: list[str] = []
    assert record(tmp_path / "out", Presses("take"), blind, said=said) == 0
    assert any("cam1 target not found" in line for line in said)


def frame_of_white(source: Source) -> Frame:
    number = next(source.numbers)
    moment = NOW + number * source.period_ns
    return Frame(np.full(SIZE[::-1], 255, np.uint8), number, moment, moment + 1)


def test_a_deleted_shot_leaves_nothing_behind(tmp_path):
    """Of three shots the second and third go, and another one comes: tables and images hold just the two that are left."""
    out = tmp_path / "out"
    assert record(out, Presses("take", "take", "take", "drop", "drop", "take")) == 2
    for device, each in (("cam1", 2), ("cam2", 2), ("us", 1)):
        numbers, times = table(out, device)
        assert len(numbers) == 2 * each and images(out, device) == numbers.tolist() and (np.diff(times) > 0).all()


def test_with_the_only_shot_the_sweep_goes(tmp_path):
    """Nothing stays of a new capture; the sweep's name is free, and with the next shot it is there again."""
    out = tmp_path / "out"
    operator = Presses("drop", "take", "drop")
    assert record(out, operator) == 0 and not out.exists()
    assert operator.asked[1] == operator.asked[3] == "no shot is there"
    assert record(out, Presses("take"), name="other") == 1
    assert record(out, Presses("take", "drop", "take", "take", "drop")) == 1
    assert len(table(out, "us")[0]) == 1 and set(manifest.read_manifest(out).sweeps) == {"other", "wires"}
    before = sorted(path for path in out.rglob("*"))
    assert record(out, Presses("take", "drop"), name="third") == 0
    assert sorted(path for path in out.rglob("*")) == before


class Killed(BaseException):
    """The process ends here."""


def test_a_process_that_is_killed_while_it_deletes_leaves_a_readable_sweep(tmp_path, monkeypatch):
    """Between a row and its image: the tables name whole images alone."""
    out = tmp_path / "out"
    for kill_at in range(5):
        name, unlinked, real = f"wires{kill_at}", count(), Path.unlink

        def unlink(path, *args, real=real, unlinked=unlinked, kill_at=kill_at, **kinds):
            if path.suffix == ".png" and next(unlinked) == kill_at:
                raise Killed
            real(path, *args, **kinds)

        with monkeypatch.context() as patch, pytest.raises(Killed):
            patch.setattr(Path, "unlink", unlink)
            record(out, Presses("take", "take", "drop"), name=name)
        for device in DEVICES:
            numbers, _ = table(out, device, name)
            assert set(numbers.tolist()) <= set(images(out, device, name)) and len(numbers) >= 1
    assert record(out, Presses("take"), name="next") == 1


@pytest.mark.parametrize("when", ["before the manifest", "after the manifest"])
def test_a_process_that_is_killed_while_the_last_shot_goes_can_be_begun_again(tmp_path, monkeypatch, when):
    out = tmp_path / "out"
    assert record(out, Presses("take"), name="other") == 1
    step = "_exchange" if when == "before the manifest" else "_clear_unentered"
    real = getattr(Recording, step)

    def killed(self, given):
        if step == "_exchange" and "wires" in self.contents.sweeps and "wires" not in given.sweeps:
            raise Killed
        if step == "_clear_unentered" and "wires" in str(given) and list(Path(given).glob("*.png")):
            raise Killed
        real(self, given)

    with monkeypatch.context() as patch, pytest.raises(Killed):
        patch.setattr(Recording, step, killed)
        record(out, Presses("take", "drop"))
    there = "wires" in manifest.read_manifest(out).sweeps
    assert there == (when == "before the manifest")
    if there:
        assert len(table(out, "us")[0]) == 1
    else:
        assert record(out, Presses("take", "take")) == 2 and images(out, "us") == table(out, "us")[0].tolist()


def test_a_device_that_is_gone_ends_it_and_the_shots_stay(tmp_path):
    with pytest.raises(DeviceError, match="unplugged"):
        record(tmp_path / "out", Presses("take", *["take"] * 100), scanner=Source(late_ms=20, last=60))
    assert len(table(tmp_path / "out", "us")[0]) >= 1


def test_clocks_that_do_not_meet_are_named(tmp_path):
    said: list[str] = []
    operator = Presses("take")
    assert record(tmp_path / "out", operator, scanner=Source(late_ms=1e9), silent_s=0.5, said=said) == 0
    assert any("are cameras and scanner on one clock?" in line for line in said)
