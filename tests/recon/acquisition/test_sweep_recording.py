"""Sweeps are recorded by threads, whatever their devices do."""

import errno
import time
from itertools import count

import numpy as np
import pytest

from recon.acquisition import frame_stream, sweep_recording
from recon.acquisition.frame_checks import Limits
from recon.acquisition.pictures import Picture, hidden
from recon.acquisition.recording import open_recording
from recon.acquisition.sweep_recording import SweepPlan, record_sweep
from recon.capture import sweep_tables
from recon.capture.images import read_image
from recon.capture.manifest import Device
from recon.devices.camera_pairs import CameraPair
from recon.devices.interfaces import DeviceError, Frame
from recon.devices.timed_frames import TimedScanner
from tests.recon.acquisition.stand_ins import Scripted
from twin.devices.virtual_session import OneTake
from twin.devices.virtual_sweep import FramePair

SIZE = (32, 24)
DEVICES = {name: Device(size=SIZE) for name in ("cam1", "cam2", "us")}
NOW = 10**15


def image(number: int) -> np.ndarray:
    return np.full(SIZE[::-1], number % 256, np.uint8)


class Source:
    """Frames at 200 Hz, until `last`; some numbers are left out, some times are off by ns, some frames late by ns."""

    name, size = "us", SIZE

    def __init__(self, last=40, lost=(), off=None, then=None, late=None) -> None:
        self.last, self.off, self.then, self.late, self.over = last, off or {}, then, late or {}, False
        self.numbers = iter([k for k in range(last) if k not in lost])

    def frame(self, timeout_s):
        number = next(self.numbers, None)
        self.over = number is None
        time.sleep(0.005)
        if number is None:
            if self.then is not None:
                raise self.then
            time.sleep(timeout_s)
            return None
        moment = NOW + number * 5_000_000
        return Frame(image(number), number, moment + self.off.get(number, 0), moment + self.late.get(number, 1_000_000))

    def pair(self, timeout_s):
        frame = self.frame(timeout_s)
        return None if frame is None else FramePair((frame, frame), 0, ("cam2: frame 7 never came",) if frame.number == 8 else ())

    def start(self, trigger, second=None):
        self.trigger = trigger, second

    def rest(self):
        return ()

    def stop(self):
        self.trigger = None
        return ("cam1: frame 41 without a partner",)


def record(tmp_path, pairs=None, scanner=None, silent_s=20, seconds=None, said=None, show=hidden):
    plan = SweepPlan("scan", "volume", ("free", "hardware"), seconds, silent_s, Limits())
    devices = {name: DEVICES[name] for name in (("cam1", "cam2") if pairs else ()) + (("us",) if scanner else ())}
    operator = OneTake(lambda: all(source.over for source in (pairs, scanner) if source is not None))
    with open_recording(tmp_path / "out") as recording:
        said = [] if said is None else said
        return record_sweep(recording, pairs, scanner, devices, operator, plan, {}, said.append, show)


def frames(tmp_path, device) -> np.ndarray:
    return sweep_tables.read_stamps(tmp_path / "out/sweep/scan" / device / "timestamps.csv")[0]


def test_all_frames_are_kept_with_their_numbers_and_times(tmp_path):
    said: list[str] = []
    counts = record(tmp_path, Source(), Source(60, lost=(5, 6)), said=said)
    assert counts == {"cam1": 40, "cam2": 40, "us": 58}
    assert 5 not in frames(tmp_path, "us") and "lost cam2: frame 7 never came" in said
    assert "lost cam1: frame 41 without a partner" in said  # after the last pair
    for device in DEVICES:
        numbers, times = sweep_tables.read_stamps(tmp_path / "out/sweep/scan" / device / "timestamps.csv")
        assert (times == NOW + numbers * 5_000_000).all()
        for number in numbers.tolist():
            assert (read_image(tmp_path / f"out/sweep/scan/{device}/{number:04d}.png", SIZE, 8) == image(number)).all()


@pytest.mark.parametrize(
    ("scanner", "silent_s", "reason"),
    [
        (Source(20, then=DeviceError("us: unplugged; check its cable")), 20, "us: unplugged"),
        (Source(20), 1, "us: expected a frame within 1 s"),
        (Source(20, off={19: 5 * 10**9}), 20, "us: expected a clock that goes on, found it 5.000 s ahead of arrival at frame 19"),
        (Source(20, off={19: -(10**10)}), 20, "us: expected a clock that goes on, found it 9.995 s back"),
    ],
    ids=["unplugged", "silent", "clock forward", "clock back"],
)
def test_a_device_that_fails_ends_the_recording_and_what_came_stays(tmp_path, scanner, silent_s, reason):
    with pytest.raises(DeviceError, match=reason):
        record(tmp_path, Source(10_000), scanner, silent_s)
    assert len(frames(tmp_path, "us")) >= 19 and len(frames(tmp_path, "cam1")) > 0


@pytest.mark.parametrize(
    ("late", "named"),
    [
        ({19: 2 * 10**9}, ["us: frame 19 came 2.0 s late", "frames of us that came late: 1, by up to 2.0 s"]),
        (
            {k: 3 * 10**9 - k * 5_000_000 for k in range(10, 30)},
            ["us: frame 10 came 2.9 s late", "frames of us that came late: 20, by up to 2.9 s"],
        ),
        ({0: 2 * 10**9}, []),
    ],
    ids=["one", "a row that comes at once", "the first"],
)
def test_a_late_frame_is_recorded_and_named(tmp_path, late, named):
    """The computer was busy: the device's clock has gone on all the same."""
    said: list[str] = []
    assert record(tmp_path, scanner=Source(40, late=late), said=said)["us"] == 40
    numbers, times = sweep_tables.read_stamps(tmp_path / "out/sweep/scan/us/timestamps.csv")
    assert (times == NOW + numbers * 5_000_000).all()
    found = [line for line in said if "late" in line]
    assert len(found) == len(named) and all(line.startswith(start) for line, start in zip(found, named, strict=True))


def test_a_full_disk_ends_the_recording_and_what_came_stays(tmp_path, monkeypatch):
    written, real = count(), sweep_recording.GrowingSweep.add

    def add(self, *frame):
        if next(written) >= 10:
            raise OSError(errno.ENOSPC, "No space left on device", "x.png")
        real(self, *frame)

    monkeypatch.setattr(sweep_recording.GrowingSweep, "add", add)
    with pytest.raises(OSError, match="No space left"):
        record(tmp_path, scanner=Source(400))
    assert frames(tmp_path, "us").tolist() == list(range(10))


def test_a_slow_disk_loses_frames_and_says_so(tmp_path, monkeypatch):
    monkeypatch.setattr(frame_stream, "WAITING", 2)
    real = sweep_recording.GrowingSweep.add
    monkeypatch.setattr(sweep_recording.GrowingSweep, "add", lambda self, *frame: (time.sleep(0.03), real(self, *frame))[1])
    said: list[str] = []
    counts = record(tmp_path, scanner=Source(60), said=said)
    assert counts["us"] < 60 and any("the disk was too slow" in line for line in said)
    assert len(frames(tmp_path, "us")) == counts["us"]


class Slow(Source):
    """A virtual device: each frame takes a twentieth of a second, between frames lie 5 ms of its time."""

    def frame(self, timeout_s):
        time.sleep(0.05)
        return super().frame(timeout_s)


def test_a_recording_ends_after_its_time_of_the_devices_own(tmp_path):
    """Forty milliseconds are eight periods of five, and at most a look later; the clock on the wall shows half a second."""
    counts = record(tmp_path, scanner=Slow(10_000), seconds=0.04)
    assert 9 <= counts["us"] <= 11


def test_what_is_seen_before_the_start_is_shown_and_not_kept(tmp_path):
    shown: list[Picture] = []
    plan = SweepPlan("", None, ("free", "hardware"), None, 5.0, Limits())
    source = Source(10_000)
    with open_recording(tmp_path / "out") as recording:
        operator = Scripted([*["wait"] * 5, "take", *["wait"] * 5])
        counts = record_sweep(recording, None, source, {"us": DEVICES["us"]}, operator, plan, {}, print, shown.append)
    numbers = sweep_tables.read_stamps(tmp_path / "out/sweep/us/timestamps.csv")[0]
    assert numbers[0] == 5 and len(numbers) == counts["us"] > 0 and shown[0].image[0, 0] == 0


def test_the_preview_gets_every_device(tmp_path):
    shown: list[Picture] = []
    record(tmp_path, Source(10_000), Source(10_000), seconds=2.5, show=shown.append)
    assert {picture.device for picture in shown} == set(DEVICES)


class Film:
    """A camera of its own clock at 100 Hz, which shows a time after power-on, until `last`."""

    size, bits, over = SIZE, 8, False

    def __init__(self, name, shown_ns, last=40, jump_ns=0) -> None:
        self.name, self.shown_ns, self.last, self.jump_ns, self.numbers = name, shown_ns, last, jump_ns, count()
        self.begun, self.taken = time.monotonic_ns(), []

    def start(self, trigger):
        pass

    def stop(self):
        pass

    def close(self):
        pass

    def frame(self, timeout_s):
        time.sleep(0.01)
        if self.over:
            return None
        number, now = next(self.numbers), time.monotonic_ns()
        self.over = number == self.last - 1
        self.taken.append(now)
        shown = now - self.begun + self.shown_ns + (self.jump_ns if number >= 30 else 0)
        return Frame(image(number), number, shown, now)


def test_devices_of_a_laboratory_lie_on_one_clock(tmp_path):
    """Cameras that count from power-on and a scanner that counts from 1970."""
    films = Film("cam1", 10**9), Film("cam2", 7 * 10**9)
    pairs, scanner = CameraPair(films), Film("us", 1_795_000_000 * 10**9)
    pairs.over = False
    devices = {name: DEVICES[name] for name in ("cam1", "cam2", "us")}
    operator = OneTake(lambda: all(one.over for one in (*films, scanner)))
    plan = SweepPlan("scan", "volume", ("free", "hardware"), None, 20, Limits())
    with open_recording(tmp_path / "out") as recording:
        counts = record_sweep(recording, pairs, TimedScanner(scanner), devices, operator, plan, {}, print, hidden)
    assert set(counts.values()) == {40}
    times = {name: sweep_tables.read_stamps(tmp_path / "out/sweep/scan" / name / "timestamps.csv")[1] for name in devices}
    now = time.monotonic_ns()
    assert all(films[0].begun - 0.1e9 < at[0] < at[-1] < now + 0.1e9 for at in times.values())
    assert (times["cam1"] == times["cam2"]).all()


@pytest.mark.parametrize("count", [1, 3, 7, 20])
def test_short_recordings_keep_all_frames(tmp_path, count):
    """Of seven frames no clock is known yet when it ends: they are timed by the fastest of them, here to some milliseconds."""
    films = Film("cam1", 10**9, count), Film("cam2", 7 * 10**9, count)
    scanner = Film("us", 1_795_000_000 * 10**9, count)
    devices = {name: DEVICES[name] for name in ("cam1", "cam2", "us")}
    operator = OneTake(lambda: all(one.over for one in (*films, scanner)))
    plan = SweepPlan("scan", "volume", ("free", "hardware"), None, 20, Limits())
    said: list[str] = []
    with open_recording(tmp_path / "out") as recording:
        record_sweep(recording, CameraPair(films), TimedScanner(scanner), devices, operator, plan, {}, said.append, hidden)
    assert said == [f"recorded {count} frames of cam1, {count} frames of cam2, {count} frames of us"]
    for name, film in (("cam1", films[0]), ("us", scanner)):
        numbers, times = sweep_tables.read_stamps(tmp_path / "out/sweep/scan" / name / "timestamps.csv")
        assert numbers.tolist() == list(range(count))
        assert np.abs(times - film.taken).max() < 20e6


def test_frames_without_a_partner_at_the_end_are_named(tmp_path):
    films = Film("cam1", 10**9, 5), Film("cam2", 7 * 10**9, 3)
    operator = OneTake(lambda: all(one.over for one in films))
    plan = SweepPlan("scan", "volume", ("free", "hardware"), None, 20, Limits())
    said: list[str] = []
    with open_recording(tmp_path / "out") as recording:
        devices = {name: DEVICES[name] for name in ("cam1", "cam2")}
        counts = record_sweep(recording, CameraPair(films), None, devices, operator, plan, {}, said.append, hidden)
    assert counts == {"cam1": 3, "cam2": 3} and "lost cam1: frames 3 to 4 without a partner" in said


def test_a_scanners_clock_that_jumps_ends_the_recording(tmp_path):
    scanner = TimedScanner(Film("us", 0, jump_ns=5 * 10**9))
    scanner.over = False
    with pytest.raises(DeviceError, match=r"us: its clock jumped by \+5\.0\d+ s"):
        record(tmp_path, scanner=scanner)
    assert len(frames(tmp_path, "us")) == 30
