"""Poses of several bodies from a drawn film, told where the patient stood as the skin was measured."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from recon.capture import manifest, sweep_tables
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


def deep(image, bits):
    """An image of so many bits, as bright."""
    return image if bits == 8 else (image.astype(np.uint16) << (bits - 8))


def frames(rig, poses, rng, away=()):
    cameras = [getattr(rig, name).optics.camera() for name in CAMERAS]
    return [
        drawings.together(
            camera, [([poses[name]], target) for name, target in rig.targets.items() if name not in away], 65.0, rng
        )
        for camera in cameras
    ]


def capture(folder: Path, rig, places, step, rng, fringes=CAMERAS, bits=8, away=()) -> Path:
    """A surface with the patient in view of cameras, and a film after patient and probe have moved by a step together.

    fringes : cameras that took them
    away : bodies that aren't in the film
    """
    moved = about(places["patient"], step)
    after = {name: moved @ place for name, place in places.items()}
    devices = {name: Device(size=getattr(rig, name).optics.size, bits=bits) for name in CAMERAS}
    with new_capture(folder, "drawn") as made:
        made.add_calibration(Calibration({name: getattr(rig, name).optics.camera() for name in (*CAMERAS, "projector")}))
        if fringes:
            lit = [frames(rig, places, rng) for _ in range(PATTERNS.count)]
            images = {name: np.array([deep(pair[k], bits) for pair in lit]) for k, name in enumerate(CAMERAS) if name in fringes}
            made.add_surface(images, PATTERNS, devices | {"projector": Device(size=PATTERNS.projector_size)})
        film = [[deep(one, bits) for one in frames(rig, after, rng, away)] for _ in range(COUNT)]
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
    assert figures["frames_found"] == figures["patient_frames_found"] == COUNT
    rows = (tmp_path / "out" / "frames.csv").read_text().splitlines()
    told, whole = (float(rows[1].split(",")[5]), np.sqrt(np.trace((found.covariance + found.shared)[0, 3:, 3:])))
    assert told == pytest.approx(whole, abs=1e-4)  # sigma_mm is that of the pose that is told
    assert (tmp_path / "out" / "manifest.json").exists()


def test_without_fringes_the_first_pose_counts_or_the_one_given(rig, places, tmp_path):
    """A film without a surface is told as the patient stood at first; with `reference` as it stood in an earlier run."""
    rng = np.random.default_rng(2)
    early = capture(tmp_path / "early", rig, places, np.eye(4), rng, fringes=())
    late = capture(tmp_path / "late", rig, places, MOVED, rng, fringes=())
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


@pytest.mark.parametrize("bits", [10, 12])
def test_deep_fringes_show_the_patient_as_well(rig, places, tmp_path, bits):
    source = capture(tmp_path / "capture", rig, places, MOVED, np.random.default_rng(5), bits=bits)
    track(rig, source, tmp_path / "out")
    found = sweep_tables.read_track(tmp_path / "out" / "poses.csv").poses
    assert np.linalg.norm(found[:, :3, 3] - places["probe"][:3, 3], axis=1).max() < 0.2


def test_fringes_of_one_camera_are_refused(rig, places, tmp_path):
    """They don't tell where the patient stood, and all would lie elsewhere than the skin."""
    source = capture(tmp_path / "capture", rig, places, MOVED, np.random.default_rng(6), fringes=("cam1",))
    with pytest.raises(InputError, match=r"surface: expected fringe images of both cameras.*none of cam2; give reference=FILE"):
        track(rig, source, tmp_path / "out")


def test_a_patient_who_is_lost_leaves_no_pose(rig, places, tmp_path):
    """In any table: neither a pose, nor a sigma, nor a motion of 0 mm."""
    source = capture(tmp_path / "capture", rig, places, MOVED, np.random.default_rng(7), away=("patient",))
    steps = track(rig, source, tmp_path / "out")
    assert not any(step.found for own in steps.values() for step in own)
    assert {step.reason for step in steps["probe"]} == {"the patient isn't seen"}
    assert not sweep_tables.read_track(tmp_path / "out" / "poses.csv").found.any()
    assert np.isnan(metrics.read(tmp_path / "out" / "metrics.json")["patient_moved_mm"])


def test_wires_and_bottoms_are_told_in_the_cameras_world(rig, places, tmp_path):
    """A patient who happens to be in view carries no tank."""
    source = capture(tmp_path / "capture", rig, places, MOVED, np.random.default_rng(8))
    read = manifest.read_manifest(source)
    of_wires = read.model_copy(update={"sweep": read.sweep.model_copy(update={"purpose": "probe"})})
    manifest.write_manifest(source, of_wires)
    track(rig, source, tmp_path / "out")
    found = sweep_tables.read_track(tmp_path / "out" / "poses.csv").poses
    expected = about(places["patient"], MOVED) @ places["probe"]
    assert np.linalg.norm(found[:, :3, 3] - expected[:3, 3], axis=1).max() < 0.1
    with pytest.raises(InputError, match="reference: expected none for a sweep of purpose probe"):
        track(rig, source, tmp_path / "again", reference=tmp_path / "reference.csv")


def test_a_patient_who_is_never_seen_leaves_no_pose_of_a_film_alone(rig, places, tmp_path):
    """Without fringes, too: which world that would be isn't known."""
    source = capture(tmp_path / "capture", rig, places, MOVED, np.random.default_rng(9), fringes=(), away=("patient",))
    steps = track(rig, source, tmp_path / "out")
    assert not any(step.found for step in steps["probe"])
    assert not (tmp_path / "out" / poses_step.REFERENCE).exists()


def test_a_films_table_is_no_reference(rig, filmed, tmp_path):
    track(rig, filmed, tmp_path / "out")
    with pytest.raises(InputError, match=r"poses\.csv: expected a pose of the patient, found 3: the table of a film"):
        track(rig, filmed, tmp_path / "again", reference=tmp_path / "out" / "poses.csv")
