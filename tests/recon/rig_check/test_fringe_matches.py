"""Windows of both cameras' maps: each pixel counts once, and a curved surface is read on itself: neither is taken for drift."""

import numpy as np
import pytest

from recon.model import calibration
from recon.rig_check import drift, fringe_matches, optics_equations
from recon.rig_check.fringe_matches import HALF
from recon.structured_light.decode import ProjectorMap
from tests.recon.fringe_scenes import projector_map
from twin.optics.surface_session import calibration_of

SIDE_PX, TOP_MM, AXIS = 90, np.array([0.0, 0.0, 650.0]), np.array([0.0, 0.0, 1.0])


def seen(cameras, name: str, radius_mm: float, sigma_px: float, rng: np.random.Generator) -> ProjectorMap:
    """A camera's map of a sphere, decoded in a square about its top."""
    camera = cameras[name]
    corner = np.rint(camera.project(TOP_MM[None])[0] - SIDE_PX / 2).astype(int)
    across, down = (steps.ravel() for steps in np.meshgrid(*(start + np.arange(SIDE_PX) for start in corner)))
    rays = camera.rays(np.column_stack([across, down]).astype(float))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    middle = TOP_MM + radius_mm * AXIS - camera.centre
    along = rays @ middle
    points = camera.centre + rays * (along - np.sqrt(along**2 - middle @ middle + radius_mm**2))[:, None]
    columns = np.full(camera.size[::-1], np.nan)
    columns[down, across] = cameras["projector"].project(points)[:, 0] + sigma_px * rng.standard_normal(len(points))
    return projector_map(columns, sigma_columns=np.where(np.isfinite(columns), sigma_px, np.nan))


def matched(cameras, radius_mm: float, sigma_px: float, rng: np.random.Generator) -> optics_equations.Matches:
    maps = (seen(cameras, "cam1", radius_mm, sigma_px, rng), seen(cameras, "cam2", radius_mm, sigma_px, rng))
    return fringe_matches.match(maps, cameras, rng, "sphere")


def test_a_small_dark_thing_shows_no_drift_that_is_none(rig, rng):
    """Windows share no pixel of camera 1, and of ten captures none shows more than noise, which overlapping ones count anew."""
    known = calibration_of(rig)
    for _ in range(10):
        matches = matched(known.cameras, 1e4, 0.06, rng)
        apart = np.abs(matches.pixels[:, None] - matches.pixels).max(axis=2)
        assert (apart[~np.eye(len(apart), dtype=bool)] > 2 * HALF).all()
        found = drift.estimate(known, None, matches, rig.target, 3e-4, calibration.DRIFT_PX)
        assert found.surprise < 3 and found.size == 1


@pytest.mark.parametrize("radius_mm", [1e4, 19.8])
def test_a_curved_surface_is_read_on_itself(rig, rng, radius_mm):
    """Without noise both cameras agree, to 5 % of what maps are taken to err by at least; planes put them 0.006 px apart."""
    known = calibration_of(rig)
    matches = matched(known.cameras, radius_mm, 0.0, rng)
    names = optics_equations.parameters(drift.usual_drift(known.cameras, calibration.DRIFT_PX), list(known.cameras))
    left = optics_equations.of_fringes(matches, known.cameras, rig.target, names).residuals
    assert np.abs(left).max() < 0.05


def test_points_that_moved_are_read_where_they_are_now(rig, rng):
    """Camera 2 is off by 2 px: by the true cameras residuals are noise; a map's gradient alone would leave one sigma."""
    known = calibration_of(rig).cameras
    true = calibration.moved(known, ("cam2.cx",), np.array([2.0]))
    maps = tuple(seen(true, name, 19.8, 0.02, rng) for name in ("cam1", "cam2"))
    matches = fringe_matches.match(maps, known, rng, "sphere")
    names = optics_equations.parameters(drift.usual_drift(known, calibration.DRIFT_PX), list(known))
    left, straight = (
        optics_equations.of_fringes(each, true, rig.target, names).residuals
        for each in (matches, matches._replace(bend=0 * matches.bend))
    )
    assert abs(np.mean(left)) < 0.3 < abs(np.mean(straight))


def test_a_narrow_strip_is_matched_wherever_it_lies(rig, rng):
    """21 columns hold three windows side by side, on whatever raster they lie."""
    known = calibration_of(rig).cameras
    counts = []
    for shift in range(7):
        maps = [seen(known, name, 1e4, 0.02, rng) for name in ("cam1", "cam2")]
        first = np.flatnonzero(np.isfinite(maps[0].columns).any(axis=0))[0] + shift
        maps[0].columns[:, :first], maps[0].columns[:, first + 21 :] = np.nan, np.nan
        counts.append(len(fringe_matches.match(tuple(maps), known, rng, "strip").pixels))
    assert min(counts) >= 30
