"""Whether a scanner's screen arrives as B-scans with their times, and a lost grabber is told and comes back."""

import contextlib
import time
from dataclasses import dataclass

import cv2
import numpy as np
import pytest

from recon.devices import video_grabber
from recon.devices.interfaces import DeviceError
from recon.devices.video_grabber import VideoGrabber
from tests.patience import PATIENCE_S

RATE, COUNT, SIZE = 50, 8, (64, 48)


@dataclass(frozen=True)
class MirroredPart:
    """A view of the right half, mirrored."""

    left: int = 32

    def size(self, sent):
        if sent[0] <= self.left:
            raise DeviceError("crop: expected a part of the image")
        return sent[0] - self.left, sent[1]

    def of(self, image):
        return np.ascontiguousarray(image[:, self.left :][:, ::-1])


@pytest.fixture
def scans(rng):
    """B-scans : (8, h, w)."""
    return rng.integers(0, 256, (COUNT, SIZE[1], SIZE[0])).astype(np.uint8)


@pytest.fixture
def video(tmp_path, scans):
    """A video of them, without loss."""
    path = tmp_path / "scans.mkv"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"FFV1"), RATE, SIZE)
    for scan in scans:
        writer.write(cv2.cvtColor(scan, cv2.COLOR_GRAY2BGR))
    writer.release()
    return path


def frames_of(grabber):
    """All frames until it is lost."""
    frames = []
    with pytest.raises(DeviceError) as caught:
        while True:
            if (frame := grabber.frame(PATIENCE_S)) is not None:
                frames.append(frame)
    grabber.close()
    return frames, str(caught.value)


def next_frame(grabber):
    """The first frame after it was lost."""
    end = time.monotonic() + PATIENCE_S
    while time.monotonic() < end:
        with contextlib.suppress(DeviceError):
            if (frame := grabber.frame(0.1)) is not None:
                return frame
    raise AssertionError("it did not come back")


class FakeGrabber:
    """A grabber of OpenCV: number 3 sends scans, each period, while it is plugged in."""

    period_s = 0.01

    def __init__(self, scans, stamped=True):
        self.scans, self.stamped = scans, stamped
        self.plugged, self.sent, self.size = True, 0, None
        self.opened = 0

    def __call__(self, source):
        self.opened += 1
        self.here = self.plugged and source == 3
        return self

    def isOpened(self):
        return self.here

    def set(self, key, value):
        self.size = {**(self.size or {}), key: int(value)}

    def get(self, key):
        return 1e3 * (100 + self.sent * self.period_s) if key == cv2.CAP_PROP_POS_MSEC and self.stamped else 0.0

    def read(self):
        time.sleep(self.period_s)
        if not self.plugged:
            return False, None
        self.sent += 1
        return True, cv2.cvtColor(self.scans[(self.sent - 1) % len(self.scans)], cv2.COLOR_GRAY2BGR)

    def release(self):
        self.here = False


@pytest.fixture
def fake(monkeypatch, scans):
    grabber = FakeGrabber(scans)
    monkeypatch.setattr(cv2, "VideoCapture", grabber)
    monkeypatch.setattr(video_grabber, "AGAIN_S", 0.02)
    return grabber


def test_a_video_plays_at_its_rate_to_its_last_image(video, scans):
    begin = time.monotonic()
    frames, message = frames_of(VideoGrabber("us", str(video)))
    assert time.monotonic() - begin >= (COUNT - 1) / RATE
    assert np.array_equal([frame.image for frame in frames], scans)
    assert [frame.number for frame in frames] == list(range(COUNT))
    assert [frame.time_ns / 1e9 for frame in frames] == pytest.approx(np.arange(COUNT) / RATE, abs=1e-3)
    arrived = np.array([frame.arrived_ns for frame in frames]) / 1e9
    assert np.all(np.diff(arrived) > 0)
    assert message == f"scanner us at video {video}: expected images, found the end of the file"


def test_the_view_gives_the_part_that_is_the_scan(video, scans):
    grabber = VideoGrabber("us", str(video), MirroredPart())
    assert grabber.size == (32, 48)
    frames, _ = frames_of(grabber)
    assert np.array_equal([frame.image for frame in frames], scans[:, :, :31:-1])
    assert not frames[0].image.flags.writeable


def test_a_part_outside_of_the_image_is_refused(video):
    with pytest.raises(DeviceError, match="crop"):
        VideoGrabber("us", str(video), MirroredPart(left=64))


@pytest.mark.parametrize("source", [23, "nowhere.avi"])
def test_what_is_not_there_is_refused_in_one_line(source, capfd):
    with pytest.raises(DeviceError, match=rf"^scanner us at video {source}: expected images, found none there: is it plugged in"):
        VideoGrabber("us", source)
    assert capfd.readouterr() == ("", "")


def test_times_are_those_of_the_driver(fake):
    grabber = VideoGrabber("us", 3)
    times = [grabber.frame(PATIENCE_S).time_ns / 1e9 for _ in range(4)]
    grabber.close()
    assert times == pytest.approx(100 + 0.01 * np.arange(1, 5))


def test_without_the_driver_s_times_those_of_arrival_count(fake):
    fake.stamped = False
    grabber = VideoGrabber("us", 3)
    frames = [grabber.frame(PATIENCE_S) for _ in range(4)]
    grabber.close()
    assert all(frame.time_ns == frame.arrived_ns for frame in frames)
    assert np.diff([frame.time_ns for frame in frames]).min() > 5e6


def test_the_resolution_is_set_and_must_be_what_comes(fake):
    VideoGrabber("us", 3, sent=SIZE).close()
    assert fake.size == {cv2.CAP_PROP_FRAME_WIDTH: SIZE[0], cv2.CAP_PROP_FRAME_HEIGHT: SIZE[1]}
    with pytest.raises(DeviceError, match="expected images of 1920x1080 px, found 64x48 px: set the scanner's output"):
        VideoGrabber("us", 3, sent=(1920, 1080))


def test_a_grabber_that_is_unplugged_is_told_and_comes_back(fake):
    """What had arrived before is given first; afterwards the numbers go on."""
    grabber = VideoGrabber("us", 3)
    before = grabber.frame(PATIENCE_S)
    fake.plugged = False
    lost = []
    with pytest.raises(DeviceError, match=r"^scanner us at video 3: expected images, found none"):
        while True:
            lost.append(grabber.frame(PATIENCE_S))
    fake.plugged = True
    after = next_frame(grabber)
    grabber.close()
    assert None not in lost
    assert after.number == before.number + len(lost) + 1


def test_no_image_in_time_is_none(fake):
    grabber = VideoGrabber("us", 3)
    fake.period_s = 1.0
    time.sleep(0.1)
    while grabber.frame(0.02) is not None:
        pass
    grabber.close()


def test_images_of_another_size_are_refused_until_they_are_as_before(fake, scans):
    """The scanner's output was switched."""
    grabber = VideoGrabber("us", 3)
    fake.scans = [cv2.resize(scans[0], (80, 60))]
    with pytest.raises(DeviceError, match="found 80x60 px where it sent 64x48 px before"):
        while True:
            grabber.frame(PATIENCE_S)
    fake.scans = scans
    assert next_frame(grabber).image.shape == (48, 64)
    grabber.close()


def test_images_that_nobody_takes_are_missing_in_the_numbers(fake, monkeypatch, caplog):
    monkeypatch.setattr(video_grabber, "WAITING", 4)
    fake.period_s = 0.002
    grabber = VideoGrabber("us", 3)
    end = time.monotonic() + PATIENCE_S
    while grabber._number < 9 and time.monotonic() < end:
        time.sleep(0.01)
    logged = caplog.text
    numbers = [grabber.frame(PATIENCE_S).number for _ in range(5)]
    grabber.close()
    assert numbers[:4] == [0, 1, 2, 3]
    assert numbers[4] >= 9
    assert logged.count("images lost") == logged.count("images lost from 4 on, since 4 wait to be taken") == 1
