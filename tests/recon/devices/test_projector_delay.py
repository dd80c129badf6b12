"""Whether the measured delay is that of the projector."""

import pytest

from recon.devices import projector_delay
from recon.devices.interfaces import DeviceError
from recon.devices.pattern_player import Streamed, Triggered, play
from tests.recon.devices.lit_scene import Wall, WallCamera
from tests.recon.devices.test_pattern_player import IMAGES, on, shown


@pytest.fixture(autouse=True)
def impatient(monkeypatch):
    """A projector may take 60 ms here."""
    monkeypatch.setattr(projector_delay, "LONGEST_S", 0.06)


@pytest.mark.parametrize("delay_s", [0.0, 0.013, 0.04])
def test_a_trigger_after_the_measured_time_sees_the_new_picture_alone(clock, rng, delay_s):
    """By 2 ms of exposure and 0.5 ms of transfer, a camera's period is 2.5 ms."""
    wall = Wall(clock, delay_s=delay_s)
    found = projector_delay.seconds_to_wait(wall, WallCamera(wall, rng), flashes=8)
    assert delay_s <= found <= delay_s + 0.0026


@pytest.mark.parametrize("delay_s", [0.0, 0.013, 0.03])
def test_images_after_the_measured_number_show_each_pattern(clock, rng, delay_s):
    """Of images of 2 ms, one each 4 ms."""
    wall = Wall(clock, delay_s=delay_s)
    camera = WallCamera(wall, rng)
    found = projector_delay.frames_to_wait(wall, camera, flashes=8)
    assert delay_s / 0.004 - 1 <= found <= delay_s / 0.004 + 3
    shots = list(play(on(wall, Streamed(wait_frames=found), camera), IMAGES))
    assert shown(shots) == list(range(len(IMAGES)))


def test_the_largest_of_several_flashes_counts(clock, rng, monkeypatch):
    """A picture that comes late once in a while."""
    wall = Wall(clock, delay_s=0.005)
    show = wall.show

    def sometimes_late(pattern):
        wall.delay_s = 0.03 if wall.calls == 5 else 0.005
        return show(pattern)

    monkeypatch.setattr(wall, "show", sometimes_late)
    assert projector_delay.seconds_to_wait(wall, WallCamera(wall, rng), flashes=8) > 0.028


def test_a_projector_that_is_too_slow_is_refused(clock, rng):
    wall = Wall(clock, delay_s=0.07)
    with pytest.raises(DeviceError, match=r"expected a flash to settle within 0.06 s|expected flashes"):
        projector_delay.seconds_to_wait(wall, WallCamera(wall, rng), flashes=4)


def test_without_flashes_in_the_image_there_is_no_delay(clock, rng):
    wall = Wall(clock)
    with pytest.raises(DeviceError, match=r"^cam1: expected flashes of the projector, found black and white 0.\d DN apart"):
        projector_delay.seconds_to_wait(wall, WallCamera(wall, rng, gain=0.0), flashes=4)


def test_a_camera_without_images_is_refused(clock, rng):
    wall = Wall(clock)
    with pytest.raises(DeviceError, match="expected images during a flash, found none"):
        projector_delay.frames_to_wait(wall, WallCamera(wall, rng, lost=range(10_000)), flashes=4)


def test_a_sequence_by_the_measured_delay_is_whole(clock, rng):
    """Without it, all images would show the pattern before."""
    wall = Wall(clock, delay_s=0.02)
    camera = WallCamera(wall, rng)
    delay_s = projector_delay.seconds_to_wait(wall, camera, flashes=8)

    class Waiting:
        size = wall.size

        def show(self, pattern):
            wall.show(pattern)
            clock.sleep(delay_s)
            return clock.monotonic_ns()

    shots = list(play(on(Waiting(), Triggered(), camera), IMAGES))
    assert shown(shots) == list(range(len(IMAGES)))
