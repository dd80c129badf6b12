"""The tank's figures on made-up calibrations, B-scans and surfaces whose answers are known."""

from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from recon.geometry import rigid
from recon.model.probe import ProbeCalibration
from twin.experiments import tank_trial

SCALE = np.array([0.1229, 0.1184])
HELD = rigid.from_rotation_vector(np.array([0.3, -1.2, 0.4]), np.array([20.0, -15.0, 60.0]))


def test_cylinders_by_masks_and_surface():
    """A tube's wall is drawn half a millimetre thick about its radius, so its mask's radius is larger by a quarter of one.

    The surface is an arch about another axis, and the wall lies between both, towards the camera.
    """
    tube, outer, axis_z = 7.0, 25.0, 660.0
    probe = ProbeCalibration(HELD, SCALE)
    across = Rotation.from_matrix(np.column_stack([[0, 1.0, 0], [0, 0, 1.0], [1.0, 0, 0]])).as_matrix()  # x across, y deep
    images, matrices = [], []
    v, u = np.mgrid[:408, :321]
    for x in np.linspace(-15, 15, 13):
        world_from_image = rigid.transform(across, np.array([x, -19.7, axis_z - 30.0]))
        places = rigid.apply(world_from_image, np.stack([u * SCALE[0], v * SCALE[1], 0.0 * u], axis=-1).reshape(-1, 3))
        away = np.hypot(places[:, 1], places[:, 2] - axis_z).reshape(u.shape)
        front = places[:, 2].reshape(u.shape) < axis_z
        images.append(np.where((np.abs(away - tube) < 0.25) & front, 120, 0).astype(np.uint8))
        matrices.append(world_from_image @ rigid.invert(HELD))
    stack = np.stack(matrices)
    sweep = SimpleNamespace(ours=SimpleNamespace(images=lambda: iter(images)), published_at=lambda _: stack)
    angle, along = np.meshgrid(np.linspace(-1.3, 1.3, 100), np.linspace(-30, 30, 60))
    points = np.stack([along, outer * np.sin(angle) + 0.5, axis_z + 1.0 - outer * np.cos(angle)], axis=-1).reshape(-1, 3)
    surface = trimesh.Trimesh(points, process=False)
    found = tank_trial.published_cylinders(sweep, probe, 0.05, surface)
    assert found["tube_diameter"] == pytest.approx(2 * (tube + 0.25), abs=0.1)
    assert found["cover_diameter"] == pytest.approx(2 * outer, abs=1e-6)
    towards = np.sqrt(outer**2 - 0.25) - 1.0  # from the tube's axis to the surface, up to the camera's small angle
    assert found["cover_wall"] == pytest.approx(towards - tube - 0.25, abs=0.1)
    nowhere = tank_trial.published_cylinders(sweep, probe, 0.05, trimesh.Trimesh(points[:500] + 200.0, process=False))
    assert nowhere["tube_diameter"] == found["tube_diameter"] and np.isnan(nowhere["cover_wall"])
