"""A tool pivots about a tip that stays where it is, to all sides, before both cameras."""

import numpy as np
import pytest

from recon.errors import InputError
from recon.geometry import rigid
from recon.model.circle_layout import circle_centres
from sonotwin.config import groups, load
from sonotwin.verbs import sweep
from sonotwin.verbs.film import Config
from tests.twin.tracking import takes
from twin.conditions import Motion

EYES = np.array([80.0, 0.0, 0.0])
SECONDS = np.arange(300) / 30


@pytest.fixture(scope="module")
def config() -> Config:
    return load("film", ["out=unused", "path=pivot"], Config)


@pytest.mark.parametrize("seed", [0, 1])
def test_the_tip_stays_where_it_is(config, seed):
    """However the hand trembles, and by its velocity, too."""
    target = config.rig.target
    way = config.path.lead(target, EYES, seed, Motion(tremor_mm=0.3, tremor_deg=0.3))
    tip = config.path.truth(target)["tip_mm"]
    tips = np.array([rigid.apply(way.pose(time), tip) for time in SECONDS])
    np.testing.assert_allclose(tips, np.tile(config.path.dimple_mm(target, EYES), (300, 1)), atol=1e-9)
    for time in (0.3, 4.7):
        speed, spin = way.velocity(time)
        np.testing.assert_allclose(speed + np.cross(spin, way.pose(time)[:3, :3] @ tip), 0, atol=1e-6)


def test_it_tilts_to_all_sides_and_turns(config):
    """Tilts up to 35 degrees by both, in all four quarters, some upright; the turn about the shaft by 20."""
    target = config.rig.target
    way = config.path.lead(target, EYES, 2)
    tip = np.array(config.path.tip_mm)
    places = np.array([way.pose(time)[:3, 3] for time in SECONDS]) - config.path.dimple_mm(target, EYES)
    upright = places.mean(axis=0) / np.linalg.norm(places.mean(axis=0))
    tilt = np.degrees(np.arccos(places @ upright / np.linalg.norm(tip)))
    assert 30 < tilt.max() < 40 and tilt.min() < 12
    across = places @ np.linalg.svd(upright[None])[2][1:].T
    assert len({tuple(side) for side in np.sign(across[tilt > 20]).tolist()}) == 4


def test_both_cameras_see_the_circles_whole(config):
    rig, way = takes.rig(), config.path.lead(config.rig.target, EYES, 3)
    cameras = [getattr(rig, name).optics.camera() for name in ("cam1", "cam2")]
    for time in SECONDS[::10]:
        for camera in cameras:
            pixels = camera.project(rigid.apply(way.pose(time), circle_centres(rig.target)))
            assert (pixels > 55).all() and (pixels < np.array(camera.size) - 55).all()


def test_films_have_paths_of_their_own():
    assert groups("film")["path"] == ["hand", "pivot"]
    assert groups("sweep")["path"] == ["bob", "none", "raster", "rows", "stroke", "wire"]
    with pytest.raises(InputError, match=r"path"):
        load("sweep", ["out=unused", "path=pivot"], sweep.Config)
    with pytest.raises(InputError, match=r"tip_mm"):
        load("film", ["out=unused", "path.tip_mm=[0,0,1]"], Config)
