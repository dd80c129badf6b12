"""Basler cameras: pylon's emulator serves folders of images; wires, time stamps and chunks are those of a stand-in."""

import logging
import subprocess
import sys
import time
from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("pypylon")

from recon.devices.basler import BaslerCamera, BaslerSettings, open_camera, unwrapped
from recon.devices.basler_listing import find_cameras
from recon.devices.camera_pairs import CameraPair
from recon.devices.device_clocks import follow
from recon.devices.interfaces import DeviceError
from tests.recon.devices.emulated_cameras import SERIALS, digest, serve
from tests.recon.devices.pylon_stand_in import PylonStandIn

SMALL = (640, 512)


@pytest.fixture(autouse=True)
def emulator(monkeypatch):
    monkeypatch.setenv("PYLON_CAMEMU", "2")


@pytest.fixture
def opened():
    """Function that opens an emulated camera; they are closed in the end."""
    cameras = []

    def open_one(settings=None, serial=SERIALS[0], name="cam1"):
        cameras.append(open_camera(name, serial, settings or BaslerSettings(SMALL)))
        return cameras[-1]

    yield open_one
    for camera in cameras:
        camera.close()


def stand_in(settings=None, name="cam1", **fields):
    """A camera over a stand-in, and the stand-in."""
    device = PylonStandIn(**fields)
    return BaslerCamera(name, lambda: device, settings or BaslerSettings(device.size)), device


def pull_out(camera):
    """Let the emulator say that its cable was pulled out."""
    from pypylon import genicam

    camera._device.FirePnPCallbackValue.SetValue(1)
    with pytest.raises(genicam.RuntimeException):
        camera._device.FirePnPCallback.Execute()


def numbers(camera, n):
    return [camera.frame(2.0).number for _ in range(n)]


def test_frames_are_the_images_served(tmp_path, rng, opened):
    settings, hashes = serve(tmp_path / "images", 5, (1280, 1024), rng)
    camera = opened(settings)
    camera.start("free")
    frames = [camera.frame(2.0) for _ in range(12)]
    assert [digest(frame.image) for frame in frames] == [hashes[k % 5] for k in range(12)]
    assert [frame.number for frame in frames] == list(range(12))
    assert not frames[0].image.flags.writeable


@pytest.mark.slow
def test_hundreds_of_pairs_arrive_without_loss(tmp_path, rng, opened):
    """Two free-running cameras, 1280x1024, at the emulator's rate; where cores are short, one runs ahead by tens of frames."""
    first, hashes1 = serve(tmp_path / "first", 7, (1280, 1024), rng, held=250)
    second, hashes2 = serve(tmp_path / "second", 11, (1280, 1024), rng, held=250)
    pair = CameraPair((opened(first), opened(second, SERIALS[1], "cam2")))
    pair.start("free")
    for k in range(250):
        one = pair.pair(30.0)
        assert (one.number, one.lost) == (k, ())
        assert [digest(frame.image) for frame in one.frames] == [hashes1[k % 7], hashes2[k % 11]]


def test_a_software_trigger_gives_one_frame_of_each_camera(tmp_path, rng, opened):
    """Triggers that follow at once wait until the cameras are ready: none is missed."""
    settings, hashes = serve(tmp_path / "images", 5, SMALL, rng)
    pair = CameraPair((opened(settings), opened(settings, SERIALS[1], "cam2")))
    pair.start("software")
    assert pair.pair(0.05) is None
    for _ in range(12):
        pair.trigger()
    pairs = [pair.pair(2.0) for _ in range(12)]
    assert [[digest(frame.image) for frame in one.frames] for one in pairs] == [[hashes[k % 5]] * 2 for k in range(12)]
    assert not any(one.lost for one in pairs)
    assert pair.pair(0.05) is None


def test_damaged_frames_are_named(opened, caplog):
    """The emulator fails two buffers on demand: their numbers are missing, their partners are alone."""
    pair = CameraPair((opened(), opened(serial=SERIALS[1], name="cam2")))
    pair.start("free")
    assert pair.pair(2.0).lost == ()
    device = pair.cameras[0]._device
    device.ForceFailedBufferCount.SetValue(2)
    device.ForceFailedBuffer.Execute()
    lost = []
    while len(lost) < 2:
        lost += [one for one in pair.pair(2.0).lost if one not in lost]
    first = lost[0].first
    assert [str(one) for one in lost] == [
        f"cam1: frames {first} to {first + 1} never came",
        f"cam2: frames {first} to {first + 1} without a partner",
    ]
    assert f"cam1: frame {first} lost: The buffer was incompletely grabbed." in caplog.text


def test_frames_that_nobody_fetches_leave_a_gap(opened, caplog):
    camera = opened(BaslerSettings(SMALL, rate_hz=200, held=4))
    camera.start("free")
    time.sleep(0.2)
    camera.stop()
    found = numbers(camera, 4)
    assert found[0] > 4
    assert found == list(range(found[0], found[0] + 4))
    assert [record.message for record in caplog.records] == ["cam1: frame 0 lost: not fetched in time, 3 newer ones wait"]


def test_an_unplugged_camera_is_named_and_comes_back(opened):
    """What had arrived before is still given; afterwards the camera works with the settings it had."""
    camera = opened(replace(BaslerSettings(SMALL), bits=12))
    camera.set_exposure(0.003, 2.0)
    camera.start("free")
    assert numbers(camera, 2) == [0, 1]
    pull_out(camera)
    with pytest.raises(DeviceError, match=r"^cam1: unplugged; check cable and power, then open it again$"):
        numbers(camera, 1000)
    with pytest.raises(DeviceError, match=r"^cam1: The camera device has been physically removed\.$"):
        camera.start("free")
    camera.reopen(1.0)
    camera.start("free")
    frame = camera.frame(2.0)
    assert (frame.number, frame.image.dtype) == (0, np.uint16)
    assert frame.arrived_ns - frame.time_ns == pytest.approx(1.5e6)  # half the exposure


def test_a_pair_goes_on_after_one_camera_was_away(opened):
    pair = CameraPair((opened(), opened(serial=SERIALS[1], name="cam2")))
    pair.start("free")
    assert pair.pair(2.0)
    pull_out(pair.cameras[1])
    with pytest.raises(DeviceError, match="cam2: unplugged"):
        while pair.pair(2.0):
            pass
    pair.cameras[1].reopen(1.0)
    pair.start("free")
    assert [(one.number, one.lost) for one in (pair.pair(2.0) for _ in range(5))] == [(k, ()) for k in range(5)]


def test_a_camera_that_doesnt_come_back_in_time_is_named():
    found = [PylonStandIn()]

    def connect():
        if not found:
            raise DeviceError("cam1: none found")
        return found.pop()

    camera = BaslerCamera("cam1", connect, BaslerSettings((64, 48)))
    with pytest.raises(DeviceError, match="cam1: none found"):
        camera.reopen(0.15)


def test_a_camera_may_be_closed_twice_and_takes_no_frames_then(opened):
    camera = opened()
    camera.close()
    camera.close()
    with pytest.raises(DeviceError, match="expected a camera that was started"):
        camera.frame(0.1)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"size": (99999, 512)}, "cam1: Width: expected 1 to 4096, found 99999"),
        ({"rate_hz": 0.0}, "cam1: AcquisitionFrameRate: expected 0.01 to 5000 Hz, found 0.0"),
        ({"trigger_line": "Line9"}, "cam1: TriggerSource: expected Software or Line1 or .*, found Line9"),
        ({"features": {"Colour": 1}}, "cam1: Colour: expected a feature of this camera, found none that can be used now"),
        ({"features": {"GainAuto": "Perhaps"}}, "cam1: GainAuto: expected Off or Once or Continuous, found Perhaps"),
        ({"features": {"Width": "wide"}}, "cam1: Width: expected 1 to 4096, found wide"),
    ],
)
def test_a_setting_that_is_refused_is_named_with_its_range(opened, settings, message):
    with pytest.raises(DeviceError, match=f"^{message}$"):
        opened(replace(BaslerSettings(SMALL), **settings)).start("hardware" if "trigger_line" in settings else "free")


@pytest.mark.parametrize(
    ("exposure_s", "gain", "message"),
    [
        (100.0, 1.0, "cam1: ExposureTime: expected 1 to 1e[+]07 us, found 100000000.0"),
        (0.01, 1e6, "cam1: Gain: expected 0 to 48 dB, found 120.0"),
        (0.01, 0.0, "cam1: gain: expected a factor above 0, found 0.0"),
    ],
)
def test_an_exposure_beyond_the_range_is_refused(opened, exposure_s, gain, message):
    with pytest.raises(DeviceError, match=f"^{message}$"):
        opened().set_exposure(exposure_s, gain)


@pytest.mark.parametrize("failure", [KeyboardInterrupt(), DeviceError("cam1: refused"), ZeroDivisionError("in a driver")])
def test_a_camera_is_given_back_whatever_ends_its_set_up(monkeypatch, failure):
    def fails(*_):
        raise failure

    device = PylonStandIn()
    monkeypatch.setattr(BaslerCamera, "_set_up", fails)
    with pytest.raises(type(failure)):
        BaslerCamera("cam1", lambda: device, BaslerSettings(device.size))
    assert device.closed == 1


def test_a_camera_that_isnt_there_is_named_with_those_that_are():
    with pytest.raises(DeviceError, match=r"serial number 123, found 0815-0000, 0815-0001; cable, power\?"):
        open_camera("cam1", "123")
    assert [str(camera) for camera in find_cameras()] == [f"{serial}: Emulation, CamEmu, free" for serial in SERIALS]


def test_one_wire_triggers_both_cameras_once_a_pulse():
    """Whatever was set before, nothing but an edge at Line1 exposes, and a pulse that one camera misses shifts no other pair."""
    (first, device1), (second, device2) = stand_in(), stand_in(name="cam2", offset_ns=3 * 10**14)
    pair = CameraPair((first, second), within_s=0.004)
    pair.start("hardware")
    for k in range(40):
        at = time.monotonic_ns()
        for device in (device1, device2)[: 1 if k == 21 else 2]:  # the second is still busy: it numbers on without a gap
            device.pulse(at)
        time.sleep(0.01)
    pairs = [pair.pair(1.0) for _ in range(39)]
    assert [[int(one.frames[0].image[0, 0]), int(one.frames[1].image[0, 0])] for one in pairs[19:23]] == [
        [19, 19], [20, 20], [22, 21], [23, 22],
    ]  # fmt: skip
    assert [str(lost) for one in pairs for lost in one.lost] == ["cam1: frame 21 without a partner"]
    modes = device1.nodes["TriggerMode"].values
    assert modes == {"FrameBurstStart": "Off", "FrameStart": "On"}
    assert device1.nodes["TriggerSource"].values == {"FrameStart": "Line1"}
    assert device1.nodes["AcquisitionFrameRateEnable"].value is False
    pair.close()


def test_an_output_shows_exposures_to_another_camera():
    camera, device = stand_in(BaslerSettings((64, 48), exposure_line="Line3"))
    assert device.nodes["LineMode"].values == {"Line3": "Output"}
    assert device.nodes["LineSource"].values == {"Line3": "ExposureActive"}
    camera.close()


@pytest.mark.parametrize("gige", [False, True])
def test_a_frames_time_is_the_middle_of_its_exposure(gige):
    """By the camera's own clock; the exposure that was used comes with the frame, also just after it has been changed."""
    camera, device = stand_in(gige=gige)
    camera.set_exposure(0.004, 1.0)
    camera.start("hardware")
    at = time.monotonic_ns()
    device.pulse(at)
    camera.set_exposure(0.010, 1.0)
    first = camera.frame(1.0)
    device.pulse(at + 10**8)
    second = camera.frame(1.0)
    assert first.time_ns - at - device.offset_ns == pytest.approx(2e6, abs=8)  # a tick
    assert second.time_ns - at - 10**8 - device.offset_ns == pytest.approx(5e6, abs=8)
    camera.close()


def test_a_cameras_clock_is_read_between_two_of_the_computers():
    camera, device = stand_in(gige=True)
    reading = camera.read_clock()
    assert reading.before_ns - 8 <= reading.device_ns - device.offset_ns <= reading.after_ns
    assert follow(camera)._read is not None
    camera.close()


def test_the_emulator_has_no_clock_to_read(opened):
    assert opened().read_clock() is None


def test_lost_and_damaged_frames_of_the_bus_are_missing_in_the_numbers(caplog):
    camera, device = stand_in()
    camera.start("hardware")
    for k in range(6):
        device.pulse(lost=k == 2, whole=k != 4)
    assert numbers(camera, 4) == [0, 1, 3, 5]
    assert "cam1: frame 4 lost: wrong checksum; a bad cable?" in caplog.text
    camera.close()


def test_numbers_of_16_bits_go_on_behind_the_last():
    """Cameras of Gigabit Ethernet count from 1 to 65535 and begin again at 1; a loss across the end is counted, too."""
    camera, device = stand_in(gige=True)
    camera.start("hardware")
    device.pulse()
    device.block = 65535
    device.pulse()
    device.pulse(lost=True)
    device.pulse()
    assert numbers(camera, 3) == [0, 65534, 65536]
    camera.close()


def test_a_camera_that_doesnt_number_its_frames_gets_them_counted():
    assert unwrapped(2**64 - 1, 41, 0) == 42


def test_a_frame_of_another_size_is_named_not_given(caplog):
    camera, device = stand_in()
    camera.start("hardware")
    device.size = (0, 64)
    device.pulse()
    device.size = (64, 48)
    device.pulse()
    assert numbers(camera, 1) == [1]
    assert "cam1: frame 0 lost: expected 64x48, found 0x64" in caplog.text
    camera.close()


def test_waiting_ends_when_another_thread_stops_the_camera():
    camera, _ = stand_in()
    camera.start("hardware")
    begun = time.monotonic()
    assert camera.frame(0.2) is None
    assert time.monotonic() - begun > 0.15
    camera.close()


def test_no_pylon_words_reach_the_log_in_quiet_operation(caplog):
    camera, device = stand_in()
    with caplog.at_level(logging.WARNING):
        camera.start("hardware")
        for _ in range(5):
            device.pulse()
        numbers(camera, 5)
        camera.close()
    assert not caplog.records
    assert device.closed == 1


def test_a_program_that_ends_without_closing_ends_cleanly():
    """A thread within pylon's code would abort the process, and a line of it would hide the program's own."""
    program = f"""
from recon.devices.basler import BaslerSettings, open_camera
camera = open_camera("cam1", "{SERIALS[0]}", BaslerSettings({SMALL}))
camera.start("free")
raise SystemExit(camera.frame(5.0).number)
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
