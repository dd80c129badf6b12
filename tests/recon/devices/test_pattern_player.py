"""Whether each image shows its pattern, whatever projector and cameras do."""

import logging

import numpy as np
import pytest

from recon.artwork import projected_images
from recon.devices.interfaces import DeviceError
from recon.devices.pattern_player import Stage, Streamed, Triggered, play, refuse_faults, take
from recon.model.patterns import Fringes, GrayCode, Patterns
from tests.recon.devices.lit_scene import AMBIENT, GAIN, Wall, WallCamera

IMAGES = projected_images.images(
    Patterns(projector_size=(96, 64), unwrap="gray", parts=(Fringes(pitch=12, steps=4), GrayCode(pitch=12, bits=3)))
)
HALF = np.uint8(255 * (np.arange(96) // 24 % 2)) * np.ones((64, 1), np.uint8)  # in quarters
FIRST = 3  # exposures before the sequence: black, white and white again
TAKINGS = [Triggered(timeout_s=0.1), Streamed(wait_frames=1), Streamed(wait_frames=1, trigger="hardware")]


def on(wall, taking, *cameras):
    """The stage of a wall and its cameras."""
    return Stage(wall, {camera.name: camera for camera in cameras}, taking)


def shown_by(frame):
    """The pattern that an image shows, by its levels; None if it is none of them."""
    apart = [np.abs(frame.image - (AMBIENT + GAIN * pattern.astype(float))).mean() for pattern in IMAGES]
    return int(np.argmin(apart)) if min(apart) < 2 else None  # the noise of 1 DN is 0.8 in the mean


def shown(shots, camera="cam1"):
    """The patterns that a camera's images show."""
    return [shown_by(shot.frames[camera]) for shot in shots]


@pytest.mark.parametrize("taking", TAKINGS, ids=["software", "free", "hardware"])
def test_each_camera_gives_each_pattern_once(clock, rng, taking):
    wall = Wall(clock)
    cameras = [WallCamera(wall, rng, name) for name in ("cam1", "cam2")]
    shots = list(play(on(wall, taking, *cameras), IMAGES))
    assert [shot.number for shot in shots] == list(range(len(IMAGES)))
    assert shown(shots, "cam1") == shown(shots, "cam2") == list(range(len(IMAGES)))
    for shot in shots:
        assert shot.faults == () and min(frame.arrived_ns for frame in shot.frames.values()) > shot.lit_ns


def test_a_camera_ahead_of_a_slow_projector_waits_its_images(clock, rng):
    """The light comes 10 ms after `show`, an image each 4 ms."""
    wall = Wall(clock, delay_s=0.01)
    shots = list(play(on(wall, Streamed(wait_frames=4), WallCamera(wall, rng)), IMAGES))
    assert shown(shots) == list(range(len(IMAGES)))


def test_images_that_wait_in_the_driver_are_left_out(clock, rng):
    """A disk that takes 50 ms a pattern: a free camera has taken twelve images meanwhile."""
    wall, taken = Wall(clock), []
    for shot in play(on(wall, Streamed(wait_frames=1), WallCamera(wall, rng)), IMAGES):
        taken.append(shot)
        clock.sleep(0.05)
    assert shown(taken) == list(range(len(IMAGES)))


@pytest.mark.parametrize("taking", TAKINGS[:2], ids=["software", "free"])
@pytest.mark.parametrize("missed", range(len(IMAGES)))
def test_a_pattern_that_was_not_shown_is_found_and_shown_again(clock, rng, taking, missed, caplog):
    caplog.set_level(logging.INFO)
    wall = Wall(clock, frozen=[missed + FIRST])
    camera = WallCamera(wall, rng)
    shots = list(play(on(wall, taking, camera), IMAGES))
    assert shown(shots) == list(range(len(IMAGES)))
    assert f"pattern {missed} does not show in the images, try 1 of 3" in caplog.text
    assert not any(shot.faults for shot in shots)


def test_a_projector_that_stays_frozen_is_told_from_one_that_was_late(clock, rng):
    wall = Wall(clock, frozen=range(FIRST + 2, 100))
    shots = list(play(on(wall, Triggered(), WallCamera(wall, rng)), IMAGES[:4]))
    assert [len(shot.faults) for shot in shots] == [0, 0, 1, 1]
    refuse_faults(shots[1])
    with pytest.raises(DeviceError, match=r"^cam1: expected another image of pattern 2 than of the one before"):
        refuse_faults(shots[2])


class Eighth:
    """A part of a wall."""

    def __init__(self, wall, number):
        self.wall, self.clock, self.size = wall, wall.clock, (12, 64)
        self.columns = slice(12 * number, 12 * number + 12)

    def light(self, begin_ns, end_ns):
        return self.wall.light(begin_ns, end_ns)[:, self.columns]


def test_patterns_that_are_alike_where_a_camera_looks_are_not_taken_for_a_frozen_projector(clock, rng):
    """Cameras that see an eighth each, one of them dark and the other lit in a pattern that follows one alike."""
    wall, other = Wall(clock), HALF.copy()
    other[:, 48:] = 255 - HALF[:, 48:]
    cameras = [WallCamera(Eighth(wall, 0), rng, "cam1"), WallCamera(Eighth(wall, 3), rng, "cam2")]
    shots = list(play(on(wall, Triggered(), *cameras), [*IMAGES, HALF, other]))
    assert not any(shot.faults for shot in shots)
    levels = [[np.rint(frame.image.mean()) for frame in shot.frames.values()] for shot in shots[-2:]]
    assert levels == [[AMBIENT, AMBIENT + GAIN * 255]] * 2


@pytest.mark.parametrize("fault", ["lost", "late"])
@pytest.mark.parametrize("exposure", [0, FIRST - 1, FIRST, FIRST + 3])
def test_an_image_that_does_not_come_in_time_is_taken_again_by_both_cameras(clock, rng, caplog, fault, exposure):
    """One that comes late must not pass for the next pattern's."""
    wall = Wall(clock)
    cameras = [WallCamera(wall, rng, "cam1"), WallCamera(wall, rng, "cam2", **{fault: [exposure]})]
    shots = list(play(on(wall, Triggered(timeout_s=0.1), *cameras), IMAGES))
    assert shown(shots, "cam1") == shown(shots, "cam2") == list(range(len(IMAGES)))
    messages = [record.getMessage() for record in caplog.records if record.levelno >= logging.WARNING]
    assert len(messages) == 1
    assert messages[0].startswith("cam2: no image of ")


def test_lost_images_of_a_free_camera_change_nothing(clock, rng):
    wall = Wall(clock)
    camera = WallCamera(wall, rng, lost=rng.choice(200, 60, replace=False).tolist())
    shots = list(play(on(wall, Streamed(wait_frames=1), camera), IMAGES))
    assert shown(shots) == list(range(len(IMAGES)))


def test_a_camera_without_images_is_refused(clock, rng):
    wall = Wall(clock)
    cameras = [WallCamera(wall, rng, "cam1"), WallCamera(wall, rng, "cam2", lost=range(100))]
    with pytest.raises(DeviceError, match=r"^cam2: expected an image of black, found none in 3 tries"):
        next(play(on(wall, Triggered(timeout_s=0.02), *cameras), IMAGES))


@pytest.mark.parametrize("why", [{"gain": 0.0}, {"gain": 0.005}], ids=["covered lens", "hardly lit"])
def test_a_camera_that_does_not_see_the_projector_is_named(clock, rng, why):
    """In each shot, and without a verdict on the patterns."""
    wall = Wall(clock)
    shots = list(play(on(wall, Triggered(), WallCamera(wall, rng, **why)), IMAGES))
    assert len(shots) == len(IMAGES) and all(len(shot.faults) == 1 for shot in shots)
    with pytest.raises(DeviceError, match=r"^cam1: expected the projector's light, found white \d\.\d DN brighter"):
        refuse_faults(shots[0])


@pytest.mark.parametrize("taking", TAKINGS, ids=["software", "free", "hardware"])
def test_one_image_is_taken_of_what_is_lit(clock, rng, taking):
    """However often: nothing of the pattern before is left."""
    wall = Wall(clock)
    stage = on(wall, taking, WallCamera(wall, rng, "cam1"), WallCamera(wall, rng, "cam2"))
    for k in (0, 3, 5):
        assert [shown_by(frame) for frame in take(stage, IMAGES[k]).values()] == [k, k]


def test_a_lost_device_ends_the_sequence_and_keeps_what_was_taken(clock, rng):
    wall = Wall(clock)
    camera = WallCamera(wall, rng)
    taken = []
    with pytest.raises(DeviceError, match="expected a camera"):
        for shot in play(on(wall, Triggered(), camera), IMAGES):
            taken.append(shot.number)
            camera.unplugged = len(taken) == 3
    assert taken == [0, 1, 2]
