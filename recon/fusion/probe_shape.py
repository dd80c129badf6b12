"""The probe as a simple body in the target's frame, drawn from the target's design and the probe's calibration."""

import numpy as np
import trimesh
from numpy.typing import NDArray

from recon.geometry import rigid
from recon.model import circle_layout
from recon.model.circle_layout import circle_centres
from recon.model.probe import ProbeCalibration
from recon.model.rig import Target

Array = NDArray[np.float64]

BOARD_MM, INK_MM = 3.0, 0.2  # thickness of the board, and of the circles on it


def of(target: Target, probe: ProbeCalibration, width: int) -> tuple[trimesh.Trimesh, trimesh.Trimesh]:
    """Board, bracket and housing; and the circles' ink. The array's face is the middle of B-scans `width` px wide."""
    x, y = target.board_mm
    middle = circle_layout.middle(target) - [0, 0, BOARD_MM / 2]
    board = trimesh.creation.box([x, y, BOARD_MM], rigid.transform(np.eye(3), middle))
    array = (width - 1) * probe.scale[0]
    housing_mm = (6.0, 45.0, 20.0)  # wider than the array, long and thick
    wider, length, thick = housing_mm
    face = probe.face_row * probe.scale[1]
    held = probe.target_from_image @ rigid.transform(np.eye(3), np.array([array / 2, face - length / 2, 0.0]))
    housing = trimesh.creation.box([array + wider, length, thick], held)
    strut_mm = 4.0  # radius of the bracket
    strut = trimesh.creation.cylinder(strut_mm, segment=[middle, held[:3, 3]], sections=16)
    body = trimesh.util.concatenate([board, housing, strut])
    rings = trimesh.util.concatenate([_ring(target, centre) for centre in circle_centres(target)])
    assert isinstance(body, trimesh.Trimesh) and isinstance(rings, trimesh.Trimesh)
    return body, rings


def _ring(target: Target, centre: Array) -> trimesh.Trimesh:
    radii = target.inner_diameter_mm / 2, target.outer_diameter_mm / 2
    ring = trimesh.creation.annulus(*radii, INK_MM, sections=48)
    return ring.apply_translation(centre + np.array([0.0, 0.0, INK_MM / 2]))
