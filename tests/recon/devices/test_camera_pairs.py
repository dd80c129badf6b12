"""Frames of two cameras find their partners whatever is lost or late, and everything without one is named."""

import re
import time
from collections import deque

import numpy as np
import pytest

from recon.devices.camera_pairs import CameraPair, Lost, PairQueue
from recon.devices.device_clocks import LATE
from recon.devices.interfaces import DeviceError, Frame

IMAGE = np.zeros((2, 2), np.uint8)
PERIOD_NS = 20_000_000
NAMES = ("cam1", "cam2")


def frame(number, time_ns=0, arrived_ns=0):
    return Frame(IMAGE, number, time_ns, arrived_ns)


class Recorded:
    """A camera that gives frames from a list, all of them at once."""

    def __init__(self, name, frames):
        self.name, self.size, self.bits = name, (2, 2), 8
        self.frames, self.calls = deque(frames), []

    def start(self, trigger):
        self.calls.append(trigger)

    def trigger(self):
        self.calls.append("triggered")

    def frame(self, timeout_s):
        if self.frames:
            return self.frames.popleft()
        time.sleep(timeout_s)
        return None

    def stop(self):
        self.calls.append("stopped")

    def close(self):
        self.calls.append("closed")


class Gone(Recorded):
    def frame(self, timeout_s):
        raise DeviceError(f"{self.name}: unplugged")


def all_pairs(pair):
    """Of cameras whose frames are in lists, however long a busy machine takes from one to the next."""
    found = []
    while (one := pair.pair(0.01)) or any(camera.frames for camera in pair.cameras):
        found += [one] if one else []
    return found


def numbered(numbers):
    return [frame(number, number * PERIOD_NS, (number + 1) * PERIOD_NS) for number in numbers]


def test_partners_have_the_same_number():
    """Of 200 frames, a tenth is lost in each camera: exactly those that both have are pairs, all others are named once."""
    rng = np.random.default_rng(5)
    kept = [np.flatnonzero(rng.random(200) > 0.1) for _ in range(2)]
    pair = CameraPair(tuple(Recorded(name, numbered(map(int, one))) for name, one in zip(NAMES, kept, strict=True)))
    pair.start("software")
    found = all_pairs(pair)
    both = np.intersect1d(*kept)
    assert [(one.frames[0].number, one.frames[1].number) for one in found] == [(k, k) for k in both]
    assert [one.number for one in found] == list(range(len(both)))
    named = [lost for one in found for lost in one.lost] + list(pair.stop())
    for name, one, other in zip(NAMES, kept, kept[::-1], strict=True):
        gone = [k for lost in named if lost.camera == name for k in range(lost.first, lost.last + 1)]
        assert sorted(gone) == sorted(set(range(one[-1] + 1)) - set(both))
        alone = [k for lost in named if (lost.camera, lost.cause) == (name, "alone") for k in range(lost.first, lost.last + 1)]
        assert set(alone) == {k for k in one if k not in other}


def test_lost_frames_in_words():
    assert str(Lost("cam1", 4, 4, "lost")) == "cam1: frame 4 never came"
    assert str(Lost("cam2", 4, 6, "alone")) == "cam2: frames 4 to 6 without a partner"


def free_running(rng, n, phase_ns, missing=(), offset_ns=0, start_ns=5 * 10**12, rate=1.0):
    """Frames every 20 ms by a clock of its own, which arrive late at random, numbered on over those that were never taken."""
    taken = [k for k in range(n) if k not in missing]
    true = [start_ns + phase_ns + k * PERIOD_NS for k in taken]
    late = rng.exponential(300e3, len(true)) + (rng.random(len(true)) < 0.1) * rng.exponential(15e6, len(true))
    arrived = np.maximum.accumulate(np.int64(true) + np.int64(late) + 5_000_000)
    times = [offset_ns + round(rate * (at - start_ns)) for at in true]
    return [frame(k, *both) for k, both in enumerate(zip(times, map(int, arrived), strict=True))]


def test_partners_of_clocks_of_their_own_were_taken_at_one_time(rng):
    """Two clocks, years apart, 100 ppm fast and slow; a third of a frame between exposures; each misses frames silently."""
    first = free_running(rng, 600, 0, {100, 101, 300}, 10**18, rate=1 + 1e-4)
    second = free_running(rng, 600, 7_000_000, {200, 300}, 3 * 10**9, rate=1 - 1e-4)
    pair = CameraPair((Recorded("cam1", first), Recorded("cam2", second)), within_s=0.01)
    pair.start("free")
    found = all_pairs(pair)
    assert len(found) == 596
    assert np.allclose([one.apart_ns for one in found], 7e6, atol=1e6)  # both clocks are known to some 0.1 ms
    named = [str(lost) for one in found for lost in one.lost]
    assert named == ["cam2: frames 100 to 101 without a partner", "cam1: frame 198 without a partner"]


@pytest.mark.parametrize(("step_ns", "most"), [(3_000_000_000, 200), (-500_000_000, 200), (-12_000_000, 200 + LATE // 4)])
def test_a_clock_that_jumps_ends_the_pairs_and_makes_no_wrong_one(rng, step_ns, most):
    """A step that shows at once ends them there; of one that looks like late frames at first, some are left without a partner."""
    first, second = free_running(rng, 400, 0), free_running(rng, 400, 0)
    second[200:] = [frame(one.number, one.time_ns + step_ns, one.arrived_ns) for one in second[200:]]
    pair, found = CameraPair((Recorded("cam1", first), Recorded("cam2", second)), within_s=0.005), []
    pair.start("free")
    with pytest.raises(DeviceError, match="cam2: its clock jumped by") as fault:
        while one := pair.pair(10.0):
            found.append(one)
    assert all(one.frames[0].number == one.frames[1].number for one in found)
    assert 195 <= len(found) <= most
    (step_s,) = re.findall(r"jumped by (\S+) s", str(fault.value))
    assert float(step_s) == pytest.approx(step_ns / 1e9, abs=0.1)  # the delay of a frame


def test_a_silent_camera_costs_no_memory():
    """Of 10000 frames without a partner the newest wait, and one line says which are gone."""
    queue = PairQueue(NAMES, 0, held=8)
    for k in range(10_000):
        queue.add(0, k, frame(k))
    assert queue.pair() is None
    assert [str(lost) for lost in queue.lost()] == ["cam1: frames 0 to 9991 without a partner"]
    queue.add(1, 9995, frame(9995))
    assert [str(lost) for lost in queue.pair().lost] == [
        "cam2: frames 0 to 9994 never came",
        "cam1: frames 9992 to 9994 without a partner",
    ]


def test_frames_of_both_are_fetched_while_one_is_silent():
    """Else the other camera's own queue would overflow."""
    cameras = Recorded("cam1", numbered(range(40))), Recorded("cam2", [])
    pair = CameraPair(cameras, held=100)
    pair.start("free")
    assert pair.pair(0.3) is None
    cameras[1].frames.extend(numbered(range(40)))
    assert len(all_pairs(pair)) == 40
    assert not pair.stop()


def test_a_look_without_waiting_fetches_what_is_there():
    pair = CameraPair(tuple(Recorded(name, numbered(range(2))) for name in NAMES))
    pair.start("software")
    assert [pair.pair(0.0).number for _ in range(2)] == [0, 1] and pair.pair(0.0) is None


def test_no_pair_comes_in_time():
    pair = CameraPair((Recorded("cam1", []), Recorded("cam2", [])))
    begun = time.monotonic()
    assert pair.pair(0.15) is None
    assert time.monotonic() - begun > 0.1


def test_a_camera_that_is_gone_is_named():
    pair = CameraPair((Recorded("cam1", numbered(range(5))), Gone("cam2", [])))
    with pytest.raises(DeviceError, match="cam2: unplugged"):
        pair.pair(1.0)


def test_both_cameras_are_driven_together():
    """The second is ready before the first begins, whose exposures may trigger it."""
    order = []
    cameras = tuple(Recorded(name, []) for name in NAMES)
    for camera in cameras:
        camera.start = lambda trigger, name=camera.name: order.append((name, trigger))
    pair = CameraPair(cameras)
    pair.start("software")
    pair.trigger()
    pair.stop()
    pair.close()
    assert order == [("cam2", "software"), ("cam1", "software")]
    assert [camera.calls for camera in cameras] == [["triggered", "stopped", "closed"]] * 2
    pair.start("software", "hardware")
    pair.trigger()
    assert order[2:] == [("cam2", "hardware"), ("cam1", "software")]
    assert [camera.calls.count("triggered") for camera in cameras] == [2, 1]


def test_a_new_start_counts_anew():
    cameras = tuple(Recorded(name, numbered(range(3))) for name in NAMES)
    pair = CameraPair(cameras)
    pair.start("software")
    assert len(all_pairs(pair)) == 3
    for camera in cameras:
        camera.frames.extend(numbered(range(3)))
    pair.start("software")
    assert [(one.number, one.lost) for one in all_pairs(pair)] == [(k, ()) for k in range(3)]
