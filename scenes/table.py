"""The dark wooden table that things lie on."""

import numpy as np

from recon.geometry import rigid
from scenes import solid_meshes
from scenes.noise import smooth_noise
from scenes.scene_types import Material, Thing


def table(depth_mm: float, seed: int) -> Thing:
    """A table whose top lies at z = depth_mm, facing the camera, with the grain along x."""
    size_mm = (420.0, 340.0)  # beyond the view of both cameras
    points, triangles = solid_meshes.grid(size_mm, (60, 240))
    thickness_mm = 20.0
    mesh = solid_meshes.slab(points, triangles, thickness_mm)
    rng = np.random.default_rng(seed)
    wave_mm = 1.2  # standard deviation of the stripes from straight
    bent = points + np.column_stack([np.zeros(len(points)), wave_mm * smooth_noise(points, 150, rng)])
    reflectance = 0.12  # dark stained wood, in the green
    grain = 0.18  # relative standard deviation of the grain's reflectance
    grain_mm = (140.0, 5.0)  # typical length along x and width along y of a stripe
    top = reflectance * np.exp(grain * smooth_noise(bent / grain_mm, 1, rng))
    albedo = np.tile(np.clip(top, 0.03, 0.3), 2).astype(np.float32)
    mesh = solid_meshes.moved(mesh, rigid.transform(np.eye(3), (0, 0, depth_mm)))
    return Thing("table", mesh, Material(reflectance), albedo, smooth=False)
