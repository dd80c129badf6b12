"""Frames of covered lenses, an even light and a room are kept if they are so; else the operator is told why."""

import numpy as np
import pytest

from recon.acquisition import frames_recording
from recon.acquisition.frames_recording import FramesPlan, record_frames
from recon.acquisition.pictures import hidden
from recon.acquisition.recording import open_recording
from recon.capture.images import image_files, read_images
from recon.capture.manifest import SCHEMA, Device, Manifest, write_manifest
from recon.devices.pattern_player import Stage, Triggered
from tests.recon.acquisition.stand_ins import Scripted
from twin.devices.still_scenes import EvenLight
from twin.devices.virtual_clock import VirtualClock
from twin.devices.virtual_rig import VirtualRig


class Slanting(EvenLight):
    """Light that falls to a fifth across the image."""

    def radiance(self, camera, shown):
        even = super().radiance(camera, shown)
        return np.float32(even * np.linspace(1.0, 0.2, even.shape[1]))


def record(folder, rig, kind, level, answers, light=EvenLight):
    """Outcome, requests and lines of a recording of camera 1, of a quarter of its pixels, at 10 ms."""
    optics = rig.cam1.optics.model_copy(update={"size": (320, 256)})
    small = rig.model_copy(update={"cam1": rig.cam1.model_copy(update={"optics": optics})})
    virtual = VirtualRig(small, light(small, level), VirtualClock())
    stage = Stage(virtual.projector(), {"cam1": virtual.camera("cam1")}, Triggered())
    operator, said = Scripted(answers), []
    plan = FramesPlan(kind, {"cam1": Device(size=(320, 256), exposure_s=0.01, gain=1.0)})
    (folder / "out").mkdir(parents=True, exist_ok=True)
    write_manifest(folder / "out", Manifest(schema=SCHEMA, devices={}))  # of a capture that is there
    with open_recording(folder / "out") as recording:
        kept = record_frames(recording, stage, operator, plan, said.append, hidden)
        frames = {
            path.parent.relative_to(folder / "out").as_posix(): len(image_files(path.parent))
            for path in sorted((folder / "out").glob("*/**/0000.png"))
        }
    return kept, [step.text for step in operator.asked], said, frames


def test_dark_frames_are_as_the_sensor_is(rig, tmp_path):
    """In the mean its black level, over 80 000 pixels."""
    kept, asked, _, frames = record(tmp_path, rig, "dark", 0.0, ["wait", "take"])
    assert kept and frames == {"dark/cam1": 16} and asked == [frames_recording.WORDS["dark"]]
    images = read_images(image_files(tmp_path / "out/dark/cam1"), (320, 256), 8)
    assert images.mean() == pytest.approx(rig.cam1.sensor.black_level_dn, abs=0.3)


def test_flat_frames_have_two_levels_of_one_light(rig, tmp_path):
    """Half the exposure, half the light above black."""
    kept, asked, _, frames = record(tmp_path, rig, "flat", 0.3, ["take"])
    assert kept and frames == {"flat/cam1/full": 16, "flat/cam1/half": 16} and len(asked) == 1
    full, half = (
        read_images(image_files(tmp_path / f"out/flat/cam1/{level}"), (320, 256), 8).mean() for level in ("full", "half")
    )
    black = rig.cam1.sensor.black_level_dn
    assert (full - black) / (half - black) == pytest.approx(2, rel=0.02) and 150 < full < 210


@pytest.mark.parametrize(
    ("kind", "level", "light", "told"),
    [
        ("dark", 0.2, EvenLight, "cam1 isn't dark: 4"),
        ("dark", 0.03, Slanting, "cam1 sees light: "),
        ("flat", 0.3, Slanting, "cam1 uneven: "),
        ("flat", 0.001, EvenLight, "cam1 dark: "),
        ("room", 0.8, EvenLight, "cam1 bright: "),
    ],
)
def test_frames_that_are_not_so_are_told_and_kept_only_if_wanted(rig, tmp_path, kind, level, light, told):
    kept, asked, _, frames = record(tmp_path / "kept", rig, kind, level, ["take", "keep"], light)
    assert told in asked[1] and "take it again, or k keeps it" in asked[1] and kept and frames
    for answers in (["take", "end"], ["wait", "end"]):  # such as of a terminal that is closed
        kept, _, _, frames = record(tmp_path / "ended", rig, kind, level, answers, light)
        assert not kept and not frames


def test_better_frames_take_the_place_of_those_before(rig, tmp_path):
    assert record(tmp_path, rig, "room", 0.8, ["keep"])[0]
    before = (tmp_path / "out/room/cam1/0000.png").read_bytes()
    kept, _, _, frames = record(tmp_path, rig, "room", 0.05, ["take"])
    assert kept and frames == {"room/cam1": 16} and (tmp_path / "out/room/cam1/0000.png").read_bytes() != before
