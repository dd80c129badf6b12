"""Each frame shows its own pattern, whatever begins the exposures, and lost frames are noticed."""

import numpy as np
import pytest

from recon.acquisition.exposure_setting import Exposing, set_exposure
from recon.acquisition.lit_frames import LostFrame, Stage, Triggering
from recon.devices.interfaces import DeviceError
from tests.recon.acquisition.stand_ins import RASTER, Bench, BenchCamera


def stage(by: str, **triggering) -> tuple[Bench, Stage]:
    bench = Bench()
    cameras = {name: BenchCamera(name, bench) for name in ("cam1", "cam2")}
    made = Stage(bench, cameras, Triggering(by=by, timeout_s=0.01, **triggering))
    made.start()
    return bench, made


def levels(count: int) -> list[np.ndarray]:
    return [np.full(RASTER[::-1], 40 * k, np.uint8) for k in range(count)]


@pytest.mark.parametrize("by", ["software", "hardware", "free"])
def test_frames_show_their_patterns(by):
    _, made = stage(by)
    if by == "free":
        for camera in made.cameras.values():  # frames of earlier light wait
            camera.expose()
    taken = made.sequence(levels(5), ["cam1", "cam2"])
    for stack in taken.values():
        expected = 255 * 0.4 * (0.02 + np.arange(5) * 40 / 255)
        assert stack.shape == (5, 96, 128) and np.abs(stack.mean(axis=(1, 2)) - expected).max() < 0.6


def test_a_sequence_with_a_lost_frame_is_taken_again(caplog):
    bench, made = stage("hardware")
    bench.lost = {3}
    assert len(made.sequence(levels(5), ["cam1"])["cam1"]) == 5
    assert bench.shows == 8 and "taken again" in caplog.text
    bench.lost = {bench.shows + 2, bench.shows + 4}
    with pytest.raises(LostFrame, match=r"cam1: expected a frame within 0\.01 s, found none"):
        made.sequence(levels(5), ["cam1"])


def test_a_late_frame_doesnt_stand_for_the_next():
    """A camera that gives a frame too much, as after a glitch on the wire."""
    _, made = stage("hardware")
    made.cameras["cam1"].expose()  # of black
    frame = made.take(levels(6)[5])["cam1"]
    assert frame.image.mean() > 50


def test_a_camera_that_runs_free_by_mistake_is_named():
    _, made = stage("hardware")
    made.cameras["cam1"].mode = "free"
    with pytest.raises(DeviceError, match="does it run free"):
        made.take(levels(1)[0])


@pytest.mark.parametrize("reflectance", [0.004, 0.03, 0.4, 1.0, 30.0])
def test_exposures_bring_white_to_its_level(reflectance):
    bench, made = stage("software")
    bench.reflectance = np.full((96, 128), reflectance)
    camera = made.cameras["cam1"]
    seconds = set_exposure(camera, lambda: made.take(made.white())["cam1"].image, Exposing(level=0.8, longest_s=5.0))
    level = made.take(made.white())["cam1"].image.max() / 255
    assert camera.exposure_s == seconds and level == pytest.approx(0.8, rel=0.06)


def test_a_given_exposure_is_kept_and_the_longest_not_exceeded():
    bench, made = stage("software")
    camera = made.cameras["cam1"]
    seen = lambda: made.take(made.white())["cam1"].image  # noqa: E731
    assert set_exposure(camera, seen, Exposing(exposure_s=0.123, gain=2.0)) == 0.123 and camera.gain == 2.0
    bench.reflectance[:] = 0.0
    assert set_exposure(camera, seen, Exposing(longest_s=0.05)) == 0.05
