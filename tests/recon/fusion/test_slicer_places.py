"""Does what 3D Slicer opens together lie together? One landmark of the world, through each kind of file."""

import json

import numpy as np
import pytest
import trimesh

from recon.files import meshes, volumes
from recon.files.volumes import Volume
from recon.freehand import sequences
from recon.freehand.sequences import Frames
from recon.fusion import slicer_folder
from recon.geometry import rigid
from recon.model.probe import ProbeCalibration
from recon.segmentation.mass_files import FoundMass
from tests.recon.fusion import slicer_stand_in

PROBE = ProbeCalibration(rigid.from_rotation_vector([0.3, -0.2, 1.1], [12, -40, 7]), np.array([0.11, 0.125]))
POSES = np.array([rigid.from_rotation_vector([0.2, -0.1, 1 + 0.1 * k], [10 + k, -20, 640]) for k in range(4)])
PIXEL, FRAME = (6.0, 4.0), 2
LANDMARK = (POSES[FRAME] @ sequences.target_from_pixel(PROBE) @ [*PIXEL, 0, 1])[:3]  # of the world, where frame 2 shows it
RAS = LANDMARK * (-1, -1, 1)  # by the files that are declared LPS
IN_IMAGE = np.array([*PIXEL, 0, 1])


@pytest.fixture(params=[".igs.mha", ".igs.nrrd"])
def sequence(request, rng, tmp_path):
    """Ours, with a frame that has no pose."""
    poses = POSES.copy()
    poses[3] = np.nan
    images = rng.integers(0, 256, (4, 5, 7), np.uint8)
    path = tmp_path / f"sequence{request.param}"
    sequences.write_sequence(path, sequences.sequence_of(images, poses, PROBE, np.arange(4) / 30))
    return path


@pytest.mark.parametrize("suffix", [".nrrd", ".mha"])
def test_a_voxel_at_the_landmark(tmp_path, suffix):
    directions = rigid.from_rotation_vector([0.4, 0.1, -2], [0, 0, 0])[:3, :3]
    spacing = np.array([0.5, 0.7, 0.9])
    origin = LANDMARK - directions @ (spacing * (3, 1, 2))
    volumes.write_volume(tmp_path / f"v{suffix}", Volume(np.zeros((4, 4, 5), np.uint8), origin, spacing, directions))
    assert slicer_stand_in.of_volume(tmp_path / f"v{suffix}") @ [3, 1, 2, 1] == pytest.approx([*RAS, 1], abs=1e-9)


def test_a_vertex_at_the_landmark(tmp_path):
    meshes.write_ply(tmp_path / "m.ply", trimesh.Trimesh([LANDMARK, LANDMARK + 1, LANDMARK - (1, 0, 0)], [[0, 1, 2]]))
    assert np.abs(slicer_stand_in.of_mesh(tmp_path / "m.ply") - RAS).max(axis=1).min() < 1e-4, "of float32"


def test_a_mass_about_the_landmark(tmp_path):
    ball = trimesh.creation.icosphere(2, 5.0).apply_translation(LANDMARK)
    figures = {"centre_sigma_mm": 0.2, "volume_sigma_mm3": 12.0, "depth_mm": 7.5, "depth_sigma_mm": 0.2}
    (tmp_path / "masses.mrk.json").write_text(json.dumps(slicer_folder.markups({"mass0": FoundMass(ball, figures)})))
    assert slicer_stand_in.of_markups(tmp_path / "masses.mrk.json")["mass0"] == pytest.approx(RAS, abs=1e-6)


def test_a_point_of_the_target_under_its_transform(tmp_path):
    slicer_folder.write_transform(tmp_path / "t.tfm", POSES[FRAME])
    in_file = np.append(PROBE.to_target(PIXEL), 1.0)
    shown = slicer_stand_in.of_transform(tmp_path / "t.tfm") @ slicer_stand_in.TURNED @ in_file  # a model, itself turned
    assert shown[:3] == pytest.approx(RAS, abs=1e-6)


def test_a_pixel_at_the_landmark_as_the_sequence_is_opened(sequence):
    """Nothing has to be dragged anywhere; a frame without a pose has no place."""
    shown = slicer_stand_in.of_sequence(sequence)
    assert (shown.images[FRAME] @ IN_IMAGE)[:3] == pytest.approx(RAS, abs=1e-9)
    assert np.array_equal(shown.images[3], np.eye(4))


def test_under_the_transforms_a_pointer_lies_beside_it(sequence):
    """A model of the probe under ProbeToTracker, and that under ReferenceToRAS; both frames are the world."""
    nodes = slicer_stand_in.of_sequence(sequence).transforms
    assert "ImageToPhysical" not in nodes
    assert np.array_equal(nodes["ReferenceToTracker"][FRAME], np.eye(4))
    to_ras = nodes["ReferenceToRAS"][FRAME] @ nodes["ProbeToTracker"][FRAME]
    assert (to_ras @ np.append(PROBE.to_target(PIXEL), 1))[:3] == pytest.approx(RAS, abs=1e-9)
    assert (to_ras @ nodes["ImageToProbe"][FRAME] @ IN_IMAGE)[:3] == pytest.approx(RAS, abs=1e-9)


def test_a_sequence_of_before_lay_half_a_turn_away(sequence):
    """The reason for ReferenceToRAS: what stands at the top is taken as RAS, and the world was declared LPS everywhere else."""
    nodes = slicer_stand_in.of_sequence(sequence).transforms
    shown = (nodes["ProbeToTracker"][FRAME] @ nodes["ImageToProbe"][FRAME] @ IN_IMAGE)[:3]
    assert shown == pytest.approx(LANDMARK, abs=1e-9) and np.linalg.norm(shown - RAS) > 10


def test_our_own_reader_has_the_same_world_and_lps(sequence):
    """To the last bit as before; in LPS too, since half a turn twice is none."""
    read = sequences.read_tracking(sequence)
    ours = sequences.poses(read, "Reference", "Image")[:3]
    assert np.array_equal(ours, POSES[:3] @ sequences.target_from_pixel(PROBE))
    assert np.array_equal(sequences.poses(read, "LPS", "Image")[:3], ours)
    assert not sequences.lies_elsewhere(read, "Reference") and not sequences.lies_elsewhere(read, "LPS")


@pytest.mark.parametrize("name", ["ReferenceToRAS", "ReferenceToRas", "RASToReference"])
def test_anothers_sequence_lies_in_lps_where_slicer_shows_it(rng, tmp_path, name):
    """Its reference frame stays what it was, and is said to lie elsewhere."""
    ras_from_reference = rigid.from_rotation_vector([0.3, 1.2, -0.4], [80, -35, 12])
    stored = np.linalg.inv(ras_from_reference) if name.startswith("RAS") else ras_from_reference
    transforms = {"ImageToReference": POSES @ sequences.target_from_pixel(PROBE), name: np.tile(stored, (4, 1, 1))}
    frames = Frames(np.arange(4.0), transforms, dict.fromkeys([*transforms, "Image"], np.ones(4, bool)))
    in_ras = ras_from_reference @ transforms["ImageToReference"][FRAME] @ IN_IMAGE
    in_lps = sequences.poses(frames, "LPS", "Image")[FRAME] @ IN_IMAGE
    volumes.write_volume(tmp_path / "v.nrrd", Volume(np.zeros((1, 1, 1), np.uint8), in_lps[:3], np.ones(3)))
    assert slicer_stand_in.of_volume(tmp_path / "v.nrrd") @ [0, 0, 0, 1] == pytest.approx(in_ras, abs=1e-9)
    assert np.array_equal(sequences.poses(frames, "Reference", "Image"), transforms["ImageToReference"])
    assert sequences.lies_elsewhere(frames, "Reference") and not sequences.lies_elsewhere(frames, "LPS")


def test_a_recording_without_ras_lies_nowhere_in_particular(rng):
    transforms = {"ProbeToReference": POSES}
    frames = Frames(np.arange(4.0), transforms, dict.fromkeys(transforms, np.ones(4, bool)))
    assert not sequences.lies_elsewhere(frames, "Reference")
