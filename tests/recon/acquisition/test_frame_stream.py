"""Whatever ends one half of a recording, the reader or the writer, ends the other, and comes out."""

import threading
import time
from itertools import count

import cv2
import numpy as np
import pytest

from recon.acquisition import frame_stream
from recon.acquisition.frame_stream import FrameStream, Taken
from recon.devices.interfaces import Frame
from tests.patience import PATIENCE_S

IMAGE = np.zeros((2, 3), np.uint8)


def frames_for_ever():
    """A reader of a device at 1 kHz."""
    numbers = count()

    def read(timeout_s):
        time.sleep(0.001)
        number = next(numbers)
        return [Taken("us", Frame(IMAGE, number, 10**6 * number, 10**6 * number), 10**6 * number)]

    return read


def ended(stream: FrameStream) -> bool:
    """Whether a stream ends when it is asked to."""
    ending = threading.Thread(target=stream.end, daemon=True)
    ending.start()
    ending.join(PATIENCE_S)
    return not ending.is_alive()


@pytest.mark.parametrize("error", [cv2.error("no memory"), OSError(28, "No space left on device", "0010.png"), ValueError("odd")])
def test_an_error_of_the_writer_ends_the_reader_and_comes_out(monkeypatch, error):
    """Also while frames wait for the disk, as many as may."""
    monkeypatch.setattr(frame_stream, "WAITING", 2)

    def write(taken):
        if taken.frame.number >= 3:
            time.sleep(0.05)  # the queue is full then
            raise error

    stream = FrameStream(frames_for_ever(), write, 5.0, print)
    until = time.monotonic() + PATIENCE_S
    while stream.alive and time.monotonic() < until:
        time.sleep(0.005)
    assert not stream.alive and ended(stream)
    with pytest.raises(type(error)) as caught:
        stream.check()
    assert caught.value is error


def test_an_unforeseen_error_of_the_reader_comes_out_and_what_came_is_written():
    written, read = [], frames_for_ever()

    def fails(timeout_s):
        taken = read(timeout_s)
        if taken[0].frame.number == 5:
            raise ZeroDivisionError("in a driver")
        return taken

    stream = FrameStream(fails, lambda taken: written.append(taken.frame.number), 5.0, print)
    until = time.monotonic() + PATIENCE_S
    while stream.alive and time.monotonic() < until:
        time.sleep(0.005)
    assert ended(stream) and written == [0, 1, 2, 3, 4]
    with pytest.raises(ZeroDivisionError, match="in a driver"):
        stream.check()
