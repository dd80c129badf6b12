"""A result with a mass and what was left out, and its folder for 3D Slicer."""

import numpy as np
import pytest
import trimesh

from recon.files import volumes
from recon.files.volumes import Volume
from recon.freehand import sequences
from recon.freehand.scans import Scans
from recon.fusion import slicer_folder
from recon.fusion.fused_scene import FusedScene
from recon.geometry import rigid
from recon.model.probe import ProbeCalibration
from recon.segmentation.left_out import LeftOut
from recon.segmentation.mass_files import FoundMass

FIGURES = {"centre_sigma_mm": 0.21, "volume_sigma_mm3": 12.0, "depth_mm": 7.5, "depth_sigma_mm": 0.19}


@pytest.fixture
def scene(rig, rng) -> FusedScene:
    probe = ProbeCalibration(rig.probe.target_from_image.matrix(), np.array(rig.probe.scale_mm_per_px))
    poses = np.array([rigid.from_rotation_vector([0.2, -0.1, 1 + 0.01 * k], [10 + k, -20, 640]) for k in range(5)])
    scans = Scans((40, 30), poses @ sequences.target_from_pixel(probe), lambda: iter(()), 1540, 1540, probe)
    images = {k: rng.integers(0, 256, (40, 30), dtype=np.uint8) for k in (0, 2, 4)}
    ball = trimesh.creation.icosphere(3, 5.0).apply_translation([10, -20, 660])
    skin = trimesh.creation.icosphere(3, 50.0).apply_translation([0, 0, 690])
    missing = LeftOut(reason="small", volume_mm3=4.0, centre_mm=(1.0, 2.0, 660.0), extents_mm=(2.0, 2.0, 2.0), text="is left out")
    masses = {"mass0": FoundMass(ball, FIGURES)}
    return FusedScene(images, scans, poses, rig.target, skin, None, masses, left_out=[missing])


@pytest.fixture
def folder(scene, tmp_path):
    volumes.write_volume(tmp_path / "volume.nrrd", Volume(np.zeros((3, 4, 5), np.uint8), np.array([1.0, 2, 3]), np.ones(3)))
    slicer_folder.write(tmp_path / "slicer", scene, {"volume": tmp_path / "volume.nrrd"}, scans=2)
    return tmp_path / "slicer"
