"""Whether each image shows its pattern, whatever projector and cameras do."""

import logging

import numpy as np
import pytest

from recon.artwork import projected_images
from recon.devices.interfaces import DeviceError
from recon.devices.pattern_player import Streamed, Triggered, play, refuse_doubled
from recon.model.patterns import Fringes, GrayCode, Patterns
from tests.recon.devices.lit_scene import AMBIENT, GAIN, Wall, WallCamera

IMAGES = projected_images.images(
    Patterns(projector_size=(96, 64), unwrap="gray", parts=(Fringes(pitch=12, steps=4), GrayCode(pitch=12, bits=3)))
)
FIRST = 3  # exposures before the sequence: black, white and white again
TAKINGS = [Triggered(timeout_s=0.1), Streamed(wait_frames=1), Streamed(wait_frames=1, trigger="hardware")]


def shown_by(frame):
    """The pattern that an image shows, by its levels; None if it is none of them."""
    apart = [np.abs(frame.image - (AMBIENT + GAIN * pattern.astype(float))).mean() for pattern in IMAGES]
    return int(np.argmin(apart)) if min(apart) < 2 else None  # the noise of 1 DN is 0.8 in the mean


@pytest.mark.parametrize("taking", TAKINGS, ids=["software", "free", "hardware"])
def test_each_camera_gives_each_pattern_once(clock, rng, taking):
    wall = Wall(clock)
    cameras = [WallCamera(wall, rng, name) for name in ("cam1", "cam2")]
    shots = list(play(wall, IMAGES, cameras, taking))
    assert [shot.number for shot in shots] == list(range(len(IMAGES)))
    assert [[shown_by(frame) for frame in shot.frames] for shot in shots] == [[k, k] for k in range(len(IMAGES))]
    assert not any(shot.doubled for shot in shots)
    for shot in shots:
        assert min(frame.arrived_ns for frame in shot.frames) > shot.lit_ns


def test_a_camera_ahead_of_a_slow_projector_waits_its_images(clock, rng):
    """The light comes 10 ms after `show`, an image each 4 ms."""
    wall = Wall(clock, delay_s=0.01)
    shots = list(play(wall, IMAGES, [WallCamera(wall, rng)], Streamed(wait_frames=4)))
    assert [shown_by(shot.frames[0]) for shot in shots] == list(range(len(IMAGES)))


def test_images_that_wait_in_the_driver_are_left_out(clock, rng):
    """A disk that takes 50 ms a pattern: a free camera has taken twelve images meanwhile."""
    wall, shown = Wall(clock), []
    for shot in play(wall, IMAGES, [WallCamera(wall, rng)], Streamed(wait_frames=1)):
        shown.append(shown_by(shot.frames[0]))
        clock.sleep(0.05)
    assert shown == list(range(len(IMAGES)))


@pytest.mark.parametrize("taking", TAKINGS[:2], ids=["software", "free"])
@pytest.mark.parametrize("missed", range(len(IMAGES)))
def test_a_pattern_that_was_not_shown_is_found_and_shown_again(clock, rng, taking, missed, caplog):
    wall = Wall(clock, frozen=[missed + 2])  # after black and white
    camera = WallCamera(wall, rng)
    shots = list(play(wall, IMAGES, [camera], taking))
    assert [shown_by(shot.frames[0]) for shot in shots] == list(range(len(IMAGES)))
    assert f"pattern {missed} does not show in the images, try 1 of 3" in caplog.text
    assert not any(shot.doubled for shot in shots)


def test_a_projector_that_stays_frozen_is_told_from_one_that_was_late(clock, rng):
    wall = Wall(clock, frozen=range(4, 100))
    cameras = [WallCamera(wall, rng)]
    shots = list(play(wall, IMAGES[:4], cameras, Triggered()))
    assert [shot.doubled for shot in shots] == [False, False, True, True]
    refuse_doubled(shots[1], cameras)
    with pytest.raises(DeviceError, match=r"^cam1: expected another image of pattern 2 than of the one before"):
        refuse_doubled(shots[2], cameras)


@pytest.mark.parametrize("fault", ["lost", "late"])
@pytest.mark.parametrize("exposure", [0, FIRST - 1, FIRST, FIRST + 3])
def test_an_image_that_does_not_come_in_time_is_taken_again_by_both_cameras(clock, rng, caplog, fault, exposure):
    """One that comes late must not pass for the next pattern's."""
    wall = Wall(clock)
    cameras = [WallCamera(wall, rng, "cam1"), WallCamera(wall, rng, "cam2", **{fault: [exposure]})]
    shots = list(play(wall, IMAGES, cameras, Triggered(timeout_s=0.1)))
    assert [[shown_by(frame) for frame in shot.frames] for shot in shots] == [[k, k] for k in range(len(IMAGES))]
    messages = [record.getMessage() for record in caplog.records if record.levelno >= logging.WARNING]
    assert len(messages) == 1
    assert messages[0].startswith("cam2: no image of ")


def test_lost_images_of_a_free_camera_change_nothing(clock, rng):
    wall = Wall(clock)
    camera = WallCamera(wall, rng, lost=rng.choice(200, 60, replace=False).tolist())
    shots = list(play(wall, IMAGES, [camera], Streamed(wait_frames=1)))
    assert [shown_by(shot.frames[0]) for shot in shots] == list(range(len(IMAGES)))


def test_a_camera_without_images_is_refused(clock, rng):
    wall = Wall(clock)
    cameras = [WallCamera(wall, rng, "cam1"), WallCamera(wall, rng, "cam2", lost=range(100))]
    with pytest.raises(DeviceError, match=r"^cam2: expected an image of black, found none in 3 tries"):
        next(play(wall, IMAGES, cameras, Triggered(timeout_s=0.02)))


@pytest.mark.parametrize("why", [{"gain": 0.0}, {"gain": 0.005}], ids=["covered lens", "hardly lit"])
def test_a_camera_that_does_not_see_the_projector_is_refused(clock, rng, why):
    wall = Wall(clock)
    with pytest.raises(DeviceError, match=r"^cam1: expected the projector's light, found white \d\.\d DN brighter"):
        next(play(wall, IMAGES, [WallCamera(wall, rng, **why)], Triggered()))


def test_a_lost_device_ends_the_sequence_and_keeps_what_was_taken(clock, rng):
    wall = Wall(clock)
    camera = WallCamera(wall, rng)
    taken = []
    with pytest.raises(DeviceError, match="expected a camera"):
        for shot in play(wall, IMAGES, [camera], Triggered()):
            taken.append(shot.number)
            camera.unplugged = len(taken) == 3
    assert taken == [0, 1, 2]
