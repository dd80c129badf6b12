"""Sessions with a patient: all sweeps over it are told in one world, those over wires as they are."""

import numpy as np
import pytest

from recon.capture import sweep_tables
from recon.capture.manifest import CAMERAS, SCANNER, Device
from recon.capture.writer import new_capture
from recon.geometry import rigid
from recon.session import plan, poses_step
from sonotwin import choices
from tests.recon.session.test_poses_step import COUNT, MOVED, about, frames
from tests.recon.tracking import films

PLACES = {
    "probe": rigid.transform(np.diag([1.0, -1.0, -1.0]), [-75.0, 35.0, 650.0]),
    "patient": rigid.transform(np.diag([1.0, -1.0, -1.0]), [25.0, 5.0, 665.0]),
}


@pytest.fixture(scope="module")
def rig():
    whole = choices.read_rig("three_bodies")
    return whole.model_copy(update={"bodies": {"patient": whole.bodies["patient"]}})


def test_sweeps_without_fringes_share_the_first_ones_world(rig, tmp_path):
    """The patient moves by 20 mm between two sweeps; the probe stands still beside it, and so do its poses."""
    rng, devices = np.random.default_rng(0), {name: Device(size=getattr(rig, name).optics.size) for name in CAMERAS}
    with new_capture(tmp_path / "capture", "drawn") as made:
        made.add_calibration(films.optics(rig))
        for number, (name, purpose, step) in enumerate(
            (("first", "volume", np.eye(4)), ("second", "volume", MOVED), ("wires", "probe", MOVED))
        ):
            moved = about(PLACES["patient"], step)
            poses = {body: moved @ place for body, place in PLACES.items()}
            scans = [(SCANNER, np.zeros((8, 8), np.uint8)) for _ in range(COUNT)]
            film = [frames(rig, poses, rng) for _ in range(COUNT)]
            images = [each for pair, scan in zip(film, scans, strict=True) for each in (*zip(CAMERAS, pair, strict=True), scan)]
            stamps = dict.fromkeys((*CAMERAS, SCANNER), films.stamps(COUNT) + number * 10**10)
            made.add_sweep(stamps, iter(images), devices | {SCANNER: Device(size=(8, 8))}, name=name, purpose=purpose)
    settings = plan.Settings(rig=rig, capture=tmp_path / "capture", find="nothing")
    for _ in range(2):  # the second time kept results are found by the same inputs
        steps = plan.run(settings, tmp_path / "out", "code", rig.probe, lambda *_: "")
        assert {f"poses/{name}" for name in ("first", "second", "wires")} <= set(steps.done)
    read = {
        name: sweep_tables.read_track(tmp_path / "out" / "poses" / name / "poses.csv").poses
        for name in ("first", "second", "wires")
    }
    for name in ("first", "second"):
        assert np.linalg.norm(read[name][:, :3, 3] - PLACES["probe"][:3, 3], axis=1).max() < 0.2, name
    seen = about(PLACES["patient"], MOVED) @ PLACES["probe"]
    assert np.linalg.norm(read["wires"][:, :3, 3] - seen[:3, 3], axis=1).max() < 0.1
    assert (tmp_path / "out" / "poses" / "second" / poses_step.REFERENCE).is_file()
