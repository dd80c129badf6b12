"""Poses of several bodies from a drawn film, told where the patient stood as the skin was measured."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from recon.capture import sweep_tables
from recon.capture.manifest import CAMERAS, SCANNER, Device
from recon.capture.writer import new_capture
from recon.errors import InputError
from recon.files import metrics
from recon.geometry import rigid
from recon.model.calibration import Calibration
from recon.model.patterns import Fringes, GrayCode, Patterns
from recon.model.rig import Rig
from recon.session import poses_step
from sonotwin import choices
from tests.recon.tracking import drawings, films

COUNT = 3
PATTERNS = Patterns(
    projector_size=(1280, 800),
    unwrap="gray",
    parts=(Fringes(axis="columns", pitch=640, steps=3), GrayCode(axis="columns", pitch=640, bits=1)),
)
MOVED = rigid.transform(Rotation.from_rotvec(np.deg2rad([2.0, -3.0, 3.5])).as_matrix(), [14.0, -9.0, 11.0])  # 20 mm, 5 deg


@pytest.fixture(scope="module")
def rig() -> Rig:
    whole = choices.read_rig("three_bodies")
    return whole.model_copy(update={"bodies": {"patient": whole.bodies["patient"]}})


@pytest.fixture(scope="module")
def places(rig) -> dict[str, np.ndarray]:
    """Poses at the fringes, with room for both to move."""
    turn = np.diag([1.0, -1.0, -1.0])
    return {"probe": rigid.transform(turn, [-75.0, 35.0, 650.0]), "patient": rigid.transform(turn, [25.0, 5.0, 665.0])}


def about(place, step):
    """A pose after a step about the patient's place, as if both were one body."""
    middle = rigid.transform(np.eye(3), place[:3, 3])
    return middle @ step @ rigid.invert(middle)


def frames(rig, poses, rng):
    cameras = [getattr(rig, name).optics.camera() for name in CAMERAS]
    return [
        drawings.together(camera, [([poses[name]], target) for name, target in rig.targets.items()], 65.0, rng)
        for camera in cameras
    ]


def capture(folder: Path, rig, places, step, rng, fringes=True) -> Path:
    """A surface with the patient in view of both cameras, and a film after patient and probe have moved by a step together."""
    moved = about(places["patient"], step)
    after = {name: moved @ place for name, place in places.items()}
    devices = {name: Device(size=getattr(rig, name).optics.size) for name in CAMERAS}
    with new_capture(folder, "drawn") as made:
        made.add_calibration(Calibration({name: getattr(rig, name).optics.camera() for name in (*CAMERAS, "projector")}))
        if fringes:
            lit = [frames(rig, places, rng) for _ in range(PATTERNS.count)]
            images = {name: np.array([pair[k] for pair in lit]) for k, name in enumerate(CAMERAS)}
            made.add_surface(images, PATTERNS, devices | {"projector": Device(size=PATTERNS.projector_size)})
        film = [frames(rig, after, rng) for _ in range(COUNT)]
        scans = [(SCANNER, np.zeros((8, 8), np.uint8)) for _ in range(COUNT)]
        images = [each for pair, scan in zip(film, scans, strict=True) for each in (*zip(CAMERAS, pair, strict=True), scan)]
        stamps = dict.fromkeys((*CAMERAS, SCANNER), films.stamps(COUNT))
        made.add_sweep(stamps, iter(images), devices | {SCANNER: Device(size=(8, 8))})
    return folder


def track(rig, source, out, **fields):
    return poses_step.run(poses_step.Settings(capture=source, rig=rig, overlays=True, **fields), out)


@pytest.fixture(scope="module")
def filmed(rig, places, tmp_path_factory) -> Path:
    return capture(tmp_path_factory.mktemp("bodies") / "capture", rig, places, MOVED, np.random.default_rng(1))


def test_a_patient_who_moved_changes_no_pose_of_the_probe(rig, places, filmed, tmp_path):
    """By 20 mm and 5 deg after the fringes: poses are those at the fringes, within what is claimed; raw poses stand beside."""
    steps = track(rig, filmed, tmp_path / "out")
    assert all(step.found for own in steps.values() for step in own)
    found = sweep_tables.read_track(tmp_path / "out" / "poses.csv")
    for pose, own, shared in zip(found.poses, found.covariance, found.shared, strict=True):
        off = rigid.difference(places["probe"], pose)
        assert np.linalg.norm(off[3:]) < 0.2
        assert off @ np.linalg.solve(own + shared, off) < 30  # chi-square, 6 degrees
    raw = sweep_tables.read_track(tmp_path / "out" / "bodies" / "patient" / "poses.csv")
    expected = about(places["patient"], MOVED) @ places["patient"]
    assert np.linalg.norm(raw.poses[:, :3, 3] - expected[:3, 3], axis=1).max() < 0.05
    figures = metrics.read(tmp_path / "out" / "metrics.json")
    assert figures["patient_moved_mm"] == pytest.approx(20, abs=0.3) and figures["patient_turned_deg"] == pytest.approx(
        5.0, abs=0.1
    )
    assert figures["poses_by_patient"] == figures["patient_frames_found"] == COUNT
    assert (tmp_path / "out" / "manifest.json").exists()


def test_without_fringes_the_first_pose_counts_or_the_one_given(rig, places, tmp_path):
    """A film without a surface is told as the patient stood at first; with `reference` as it stood in an earlier run."""
    rng = np.random.default_rng(2)
    early = capture(tmp_path / "early", rig, places, np.eye(4), rng, fringes=False)
    late = capture(tmp_path / "late", rig, places, MOVED, rng, fringes=False)
    track(rig, early, tmp_path / "first")
    reference = tmp_path / "first" / poses_step.REFERENCE
    track(rig, late, tmp_path / "alone")
    track(rig, late, tmp_path / "second", reference=reference)
    shifted = about(places["patient"], MOVED) @ places["probe"]
    for name, expected in (("first", places["probe"]), ("alone", shifted), ("second", places["probe"])):
        found = sweep_tables.read_track(tmp_path / name / "poses.csv").poses
        assert np.linalg.norm(found[:, :3, 3] - expected[:3, 3], axis=1).max() < 0.2, name


def test_a_reference_that_is_none_is_refused(rig, filmed, tmp_path):
    alone = rig.model_copy(update={"bodies": {"needle": choices.read_rig("three_bodies").bodies["needle"]}})
    given = tmp_path / "reference.csv"
    given.write_text("time_ns,found," + ",".join(f"m{i}{j}" for i in range(3) for j in range(4)) + "\n1,0" + "," * 12 + "\n")
    with pytest.raises(InputError, match="expected a pose of the patient, found none"):
        track(rig, filmed, tmp_path / "out", reference=given)
    with pytest.raises(InputError, match=r"reference: expected none without the body patient"):
        track(alone, filmed, tmp_path / "out", reference=given)
    assert not (tmp_path / "out").exists()


def test_fringes_that_do_not_show_the_patient_are_refused(rig, places, tmp_path):
    """Rather than telling all in a world that the skin isn't in."""
    away = places | {"patient": rigid.transform(np.eye(3), [0.0, 0.0, 5000.0])}
    source = capture(tmp_path / "capture", rig, away, np.eye(4), np.random.default_rng(3))
    with pytest.raises(InputError, match=r"surface: expected the target of the patient in the fringe images.*reference=FILE"):
        track(rig, source, tmp_path / "out")
