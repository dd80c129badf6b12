"""Results as a session leaves them, small ones: a turned volume of noise, two balls in it, a plane of skin over them."""

from pathlib import Path

import numpy as np
import trimesh
from pydicom import dcmread
from pydicom.dataset import Dataset
from scipy.spatial.transform import Rotation

from recon.dicom import study_files
from recon.dicom.patient_fields import Patient
from recon.dicom.study_objects import Results
from recon.files.volumes import Volume
from recon.segmentation.mass_files import FoundMass

TURNED = Rotation.from_rotvec([0.3, -0.2, 1.1]).as_matrix()
SUPINE = Patient(axes=("left", "feet", "back"))  # seen from above, the head up in the image
FIGURES = {"volume_mm3": 268.1, "volume_sigma_mm3": 12.0, "centre_sigma_mm": 0.4, "depth_mm": 7.2, "depth_sigma_mm": 0.33}
RADII_MM = 4.0, 2.5


def volume() -> Volume:
    """Voxels (nz, ny, nx) of different spacings on turned axes."""
    voxels = np.random.default_rng(0).integers(0, 256, (14, 18, 22), np.uint8)
    return Volume(voxels, np.array([-30.1, 12.3, 650.7]), np.array([1.0, 1.1, 1.2]), TURNED)


def ball(at: tuple[float, float, float], radius: float) -> trimesh.Trimesh:
    """A ball about a voxel (i, j, k)."""
    grid = volume()
    middle = grid.origin + grid.directions @ (grid.spacing * at)
    return trimesh.creation.icosphere(4, radius).apply_translation(middle)


def results() -> Results:
    """All of it."""
    masses = {"mass0": FoundMass(ball((8, 9, 7), RADII_MM[0]), FIGURES), "mass1": FoundMass(ball((16, 9, 7), RADII_MM[1]), {})}
    skin = trimesh.creation.box((40, 40, 1)).subdivide().apply_translation([-20, 10, 640])
    skin.vertex_attributes["sigma_mm"] = np.full(len(skin.vertices), 0.05)
    return Results(volume(), masses, skin, ("Masses were looked for: 2 were measured.",))


def written(folder: Path, patient: Patient = SUPINE, found: Results | None = None) -> dict[str, Dataset]:
    """The study's objects, by their files' names."""
    study_files.write(folder, found or results(), patient, searched=True)
    return {path.name: dcmread(path) for path in sorted(folder.glob("*.dcm"))}


def places(one: Dataset, frame: int, pixels: np.ndarray) -> np.ndarray:
    """Places : (n, 3) of pixels (column, row) of a frame in the patient, by the equation of PS3.3, C.7.6.2.1.1."""
    shared, own = one.SharedFunctionalGroupsSequence[0], one.PerFrameFunctionalGroupsSequence[frame]
    along = np.array(shared.PlaneOrientationSequence[0].ImageOrientationPatient, float).reshape(2, 3)
    row_mm, column_mm = map(float, shared.PixelMeasuresSequence[0].PixelSpacing)
    at = np.array(own.PlanePositionSequence[0].ImagePositionPatient, float)
    return at + pixels[:, :1] * column_mm * along[0] + pixels[:, 1:] * row_mm * along[1]
