"""A recording that is played back comes as it was recorded, in real time, and loses what nobody fetches."""

from dataclasses import replace
from time import monotonic_ns, sleep

import numpy as np
import pytest

from recon.capture.manifest import SCANNER
from recon.devices import playback
from recon.devices.interfaces import DeviceError
from recon.devices.playback import PlayedCamera, PlayedScanner, Recorded, Timeline
from recon.errors import InputError
from tests.recon import sweep_sets

PERIOD_NS = 20_000_000


@pytest.fixture(scope="module")
def recorded(rig, tmp_path_factory) -> Recorded:
    """Nine B-scans of a ball, of a quarter of a second each."""
    folder = sweep_sets.ball(tmp_path_factory.mktemp("ball"), rig, count=9)
    return playback.read_recording(folder, names=(SCANNER,))[SCANNER]


def line_of(recorded, period_ns=PERIOD_NS) -> Timeline:
    speed = float(np.diff(recorded.times).mean()) / period_ns
    return playback.timeline_of({SCANNER: recorded}, speed)


def test_frames_come_when_they_are_due_and_round_after_round(recorded):
    line = line_of(recorded)
    scanner = PlayedScanner(recorded, line)
    frames = [scanner.frame(1.0) for _ in range(12)]
    assert [frame.number for frame in frames] == list(range(12))
    np.testing.assert_array_equal(np.diff([frame.time_ns for frame in frames]), np.diff(recorded.times)[0])
    late = np.array([frame.arrived_ns - line.clock_of(frame.time_ns) for frame in frames])
    assert (late >= playback.DELIVERY_NS).all() and np.median(late) < playback.DELIVERY_NS + PERIOD_NS
    np.testing.assert_array_equal(frames[1].image, frames[10].image)
    assert (frames[0].image != frames[4].image).any()


def test_devices_share_one_timeline(recorded):
    """Frames of two devices that were exposed together come with the same times, also of one that was opened later."""
    line = line_of(recorded)
    first, second = PlayedCamera(recorded, line), PlayedCamera(recorded, line)
    for _ in range(3):
        early = first.frame(1.0)
    late = second.frame(1.0)
    assert late.number == 0 and late.time_ns > early.time_ns
    assert late.time_ns == first.frame(1.0).time_ns


def test_what_nobody_fetches_is_lost_from_the_oldest_on(recorded):
    scanner = PlayedScanner(recorded, line_of(recorded, 4_000_000))
    before = scanner.frame(1.0)
    sleep(0.1)
    after = scanner.frame(1.0)
    assert after.number - before.number >= 25 - playback.BUFFERED - 2
    assert (after.time_ns - before.time_ns) == (after.number - before.number) * int(np.diff(recorded.times)[0])


def test_nothing_comes_before_its_time(recorded):
    scanner = PlayedScanner(recorded, line_of(recorded, 10_000_000_000))
    scanner.frame(0.1)
    start = monotonic_ns()
    assert scanner.frame(0.05) is None
    assert monotonic_ns() - start >= 0.05e9


def test_a_recording_refuses_what_only_a_camera_can_do(recorded):
    camera = PlayedCamera(recorded, line_of(recorded))
    for refused in (lambda: camera.set_exposure(0.01, 1.0), lambda: camera.start("software"), camera.trigger):
        with pytest.raises(DeviceError, match=r"^us: expected"):
            refused()
    camera.start("hardware")
    camera.close()
    camera.close()
    with pytest.raises(DeviceError, match="closed"):
        camera.frame(0.1)


def test_a_damaged_image_is_named(recorded, tmp_path):
    (tmp_path / "0000.png").write_bytes(b"no image")
    damaged = Recorded("us", recorded.size, 8, (tmp_path / "0000.png",), recorded.times[:1])
    with pytest.raises(DeviceError, match=f"us: {tmp_path}/0000.png: expected"):
        PlayedScanner(damaged, line_of(recorded)).frame(1.0)


def test_a_device_that_was_not_recorded_is_named(rig, tmp_path):
    folder = sweep_sets.ball(tmp_path / "ball", rig, count=3)
    with pytest.raises(InputError, match=r"sweep\.images\.cam1: expected a path, found none"):
        playback.read_recording(folder)


@pytest.mark.parametrize("step_s", [-1.5, 1.5])
def test_devices_that_begin_long_after_others_are_refused_unless_told(recorded, step_s):
    """Of two seconds: clocks of their own that overlap by chance, or a scanner that was switched on later."""
    times = recorded.times[0] + np.arange(9) * 250_000_000
    first, later = replace(recorded, times=times), replace(recorded, times=times + round(1e9 * step_s))
    late = "us" if step_s < 0 else "cam1"
    with pytest.raises(InputError, match=rf"that begin within 1\.2 s, found {late} to begin 1\.5 s after .* allow apart_s=2"):
        playback.timeline_of({SCANNER: first, "cam1": later})
    assert playback.timeline_of({SCANNER: first, "cam1": later}, apart_s=2).length == 2_250_000_000 + 1_500_000_000
    cut = replace(recorded, times=times[:3])
    with pytest.raises(InputError, match=r"found us to end 1\.5 s after cam1"):
        playback.timeline_of({SCANNER: first, "cam1": cut})


def test_devices_of_clocks_of_their_own_have_no_timeline(recorded):
    """A camera's clock began when it got power, a scanner's in 1970: no round would hold both."""
    other = replace(recorded, times=recorded.times + 1_795_000_000 * 10**9)
    with pytest.raises(InputError, match=r"expected one clock of us, cam1, found times 1.795e\+09 s apart"):
        playback.timeline_of({SCANNER: recorded, "cam1": other})
