"""Windows of both cameras' maps: each pixel counts once, so that a small thing's noise isn't taken for drift."""

import numpy as np

from recon.model.calibration import DRIFT_PX
from recon.rig_check import drift, fringe_matches
from recon.rig_check.fringe_matches import HALF
from recon.structured_light.decode import ProjectorMap
from tests.recon.fringe_scenes import projector_map
from twin.optics.surface_session import calibration_of

SIDE_PX, DEPTH_MM, SIGMA_PX = 90, 650.0, 0.06


def patch(cameras, name: str, rng: np.random.Generator) -> ProjectorMap:
    """A camera's map of a plane, decoded in a square in the middle of the view, in the dark."""
    camera = cameras[name]
    width, height = camera.size
    corner = np.rint(camera.project(np.array([[0.0, 0.0, DEPTH_MM]]))[0] - SIDE_PX / 2).astype(int)
    across, down = (steps.ravel() for steps in np.meshgrid(*(start + np.arange(SIDE_PX) for start in corner)))
    rays = camera.rays(np.column_stack([across, down]).astype(float))
    points = camera.centre + rays * ((DEPTH_MM - camera.centre[2]) / rays[:, 2])[:, None]
    columns = np.full((height, width), np.nan)
    columns[down, across] = cameras["projector"].project(points)[:, 0] + SIGMA_PX * rng.standard_normal(len(points))
    return projector_map(columns, sigma_columns=np.where(np.isfinite(columns), SIGMA_PX, np.nan))


def test_a_small_dark_thing_shows_no_drift_that_is_none(rig, rng):
    """Windows share no pixel, and in ten captures none shows more than noise; overlapping ones would count it many times."""
    calibration = calibration_of(rig)
    for _ in range(10):
        maps = patch(calibration.cameras, "cam1", rng), patch(calibration.cameras, "cam2", rng)
        matches = fringe_matches.match(maps, calibration.cameras, rng, "dark")
        apart = np.abs(matches.pixels[:, None] - matches.pixels).max(axis=2)
        assert (apart[~np.eye(len(apart), dtype=bool)] > 2 * HALF).all()
        found = drift.estimate(calibration, None, matches, rig.target, 3e-4, DRIFT_PX)
        assert found.surprise < 3 and found.size < 2
