"""Virtual devices behave as the interfaces ask; what they show is what the renderer gives for what the projector shows."""

import numpy as np
import pytest

from recon.devices.interfaces import DeviceError
from recon.devices.pattern_player import Stage, Streamed, Triggered, play
from twin.devices.virtual_clock import Turns, VirtualClock
from twin.devices.virtual_rig import VirtualRig


class Wall:
    """Is as bright as the pattern's mean."""

    def radiance(self, camera, shown):
        return np.full((1024, 1280), 2e-7 * shown.mean() / 255, np.float32)


@pytest.fixture
def virtual(rig) -> VirtualRig:
    return VirtualRig(rig, Wall(), VirtualClock())


WAYS = [Triggered(), Streamed(wait_frames=0, trigger="hardware"), Streamed(wait_frames=1)]


@pytest.mark.parametrize("taking", WAYS, ids=["software", "hardware", "free"])
def test_frames_show_what_the_projector_shows_and_time_goes_on(virtual, taking):
    cameras = {name: virtual.camera(name) for name in ("cam1", "cam2")}
    stage = Stage(virtual.projector(), cameras, taking)
    for camera in cameras.values():
        camera.set_exposure(0.01, 1.0)
    levels, times = [], []
    for shot in play(stage, [np.full((800, 1280), level, np.uint8) for level in (0, 255, 128)]):
        frames = shot.frames
        assert shot.faults == () and shot.lit_ns <= min(frame.arrived_ns for frame in frames.values())
        levels.append([frame.image.mean() for frame in frames.values()])
        times.append([(frame.time_ns, frame.arrived_ns) for frame in frames.values()])
    assert (np.diff(np.array(levels)[[0, 2, 1]], axis=0) > 5).all()
    assert (np.diff([time for time, _ in np.array(times)[:, 0]]) > 0).all() and (
        np.diff(np.array(times), axis=2) > 5_000_000
    ).all()
    if taking.trigger != "free":
        assert (np.ptp(np.array(times)[:, :, 0], axis=1) == 0).all()  # both cameras at once


def test_settings_and_patterns_out_of_range_are_named(virtual):
    camera, projector = virtual.camera("cam1"), virtual.projector()
    with pytest.raises(DeviceError, match="cam1: expected an exposure of up to 10 s"):
        camera.set_exposure(100.0, 1.0)
    with pytest.raises(DeviceError, match="cam1: expected a camera that was started"):
        camera.frame(0.0)
    camera.start("hardware")
    with pytest.raises(DeviceError, match="software trigger, found hardware"):
        camera.trigger()
    camera.start("software")
    assert camera.frame(0.0) is None
    with pytest.raises(DeviceError, match="expected a pattern of 1280x800"):
        projector.show(np.zeros((10, 10), np.uint8))


def test_noise_differs_from_frame_to_frame(virtual):
    camera = virtual.camera("cam1")
    camera.start("software")
    taken = []
    for _ in range(2):
        camera.trigger()
        taken.append(camera.frame(0.0).image.astype(float))
    assert 0.1 < np.std(taken[1] - taken[0]) < 3 and not taken[0].base


def test_devices_take_turns_by_their_moments():
    turns = Turns(VirtualClock())
    turns.set_next("a", 10)
    turns.set_next("b", 20)
    assert turns.wait("a", 0.0) and not turns.wait("b", 0.0)
    turns.advance("a", 11, 30)
    assert turns.wait("b", 0.0) and not turns.wait("a", 0.0)
    turns.advance("b", 21, None)
    assert turns.wait("a", 0.0)


def test_devices_wait_for_a_hold_to_end():
    turns = Turns(VirtualClock(), [0, 15])
    turns.set_next("a", 10)
    turns.set_next("b", 20)
    assert not turns.wait("a", 0.0)
    turns.go_on()
    assert turns.wait("a", 0.0)
    turns.advance("a", 11, 30)
    assert not turns.wait("b", 0.0)
    turns.go_on()
    assert turns.wait("b", 0.0)


def test_a_paced_clock_is_no_faster_than_life():
    import time

    clock, begun = VirtualClock(paced=True), time.monotonic()
    for k in range(1, 6):
        clock.advance_to(k * 20_000_000)
    assert clock.now_ns == 100_000_000 and time.monotonic() - begun > 0.09
