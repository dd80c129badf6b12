"""A tool pivots about a tip that stays where it is, to all sides, before both cameras; a needle goes to an aim in a B-scan."""

import numpy as np
import pytest

from recon.errors import InputError
from recon.geometry import rigid
from recon.model.circle_layout import circle_centres
from scenes.handheld.looks import needle
from sonotwin.choices import read_rig
from sonotwin.config import groups, load
from sonotwin.verbs import sweep
from sonotwin.verbs.film import Config
from tests.twin.tracking import takes
from twin.conditions import Motion
from twin.tracking.film_path import Aimed
from twin.tracking.film_paths import insertion

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


def test_a_needle_pivots_about_its_own_tip():
    """Where no other is given; it stays in the dimple, where the path's usual tip doesn't."""
    body = "bodies.needle={path: {kind: pivot, middle_mm: [12, -28, 700]%s}}"
    for given, rests in (("", True), (", tip_mm: [0, -120, -30]", False)):
        config = load("film", ["out=unused", "rig=three_bodies", body % given], Config)
        target = config.rig.bodies["needle"]
        way = config.lead("needle", config.path_of("needle", 0), config.rig, np.eye(4), 0, Motion())
        tips = np.array([rigid.apply(way.pose(time), config.look("needle").tip_mm(target)) for time in SECONDS[::10]])
        assert (np.ptp(tips, axis=0).max() < 1e-9) == rests


def test_both_cameras_see_the_circles_whole(config):
    rig, way = takes.rig(), config.path.lead(config.rig.target, EYES, 3)
    cameras = [getattr(rig, name).optics.camera() for name in ("cam1", "cam2")]
    for time in SECONDS[::10]:
        for camera in cameras:
            pixels = camera.project(rigid.apply(way.pose(time), circle_centres(rig.target)))
            assert (pixels > 55).all() and (pixels < np.array(camera.size) - 55).all()


NEEDLE = needle.Kind()


def led_needle(seed: int = 0, **fields) -> tuple[np.ndarray, np.ndarray]:
    """Tip : (n, 3) and direction : (n, 3) of a needle in the face's frame, every 0.1 s of a round, for a tilted probe."""
    target = read_rig("three_bodies").bodies["needle"]
    face = rigid.from_rotation_vector([1.2, 0.3, -0.2], [10.0, -5.0, 650.0])
    path = insertion.Kind.model_validate(fields)
    way = path.lead(target, EYES, seed, aimed=Aimed(NEEDLE.line_mm(target), face))
    poses = np.linalg.inv(face) @ np.array([way.pose(time) for time in np.arange(100) * path.seconds / 100])
    ends = np.array([rigid.apply(pose, NEEDLE.line_mm(target)) for pose in poses])
    along = ends[:, 1] - ends[:, 0]
    return ends[:, 1], along / np.linalg.norm(along, axis=1)[:, None]


def test_a_needle_is_led_to_its_aim_along_its_shaft():
    """Steadily held: it stays in the B-scan's plane, rests 22 mm deep for two seconds, and slides along itself."""
    tip, along = led_needle(turn_deg=0, unsteady_mm=0)
    np.testing.assert_allclose(along, np.tile([np.cos(np.radians(35)), np.sin(np.radians(35)), 0], (100, 1)), atol=1e-9)
    np.testing.assert_allclose(tip[41:60], np.tile([0, 22, 0], (19, 1)), atol=1e-3)
    np.testing.assert_allclose(tip[0], [0, 22, 0] - 30 * along[0], atol=1e-9)
    np.testing.assert_allclose(np.cross(tip - tip[0], along), 0, atol=1e-2)


def test_a_needle_crosses_the_plane_or_passes_beside_it():
    across, along = led_needle(turn_deg=0, unsteady_mm=0, heading_deg=90, angle_deg=45, beside_mm=1.5)
    np.testing.assert_allclose(along[0], [0, np.sqrt(0.5), np.sqrt(0.5)], atol=1e-9)
    np.testing.assert_allclose(across[50], [0, 22, 1.5], atol=1e-6)
    face = rigid.from_rotation_vector([1.2, 0.3, -0.2], [10.0, -5.0, 650.0])
    entry, aim = (tuple(rigid.apply(face, place).tolist()) for place in ([-30.0, 5.0, 4.0], [5.0, 25.0, 2.0]))
    beside, along = led_needle(turn_deg=0, unsteady_mm=0, entry_mm=entry, aim_mm=aim, beside_mm=-1.0)
    np.testing.assert_allclose(beside[[0, 50]], [[-30, 5, 1], [5, 25, -1]], atol=1e-6)
    np.testing.assert_allclose(along[0], np.array([35, 20, -2]) / np.linalg.norm([35, 20, -2]), atol=1e-9)


def test_a_hand_wanders_about_the_line():
    """By its standard deviations: of 3 axes at 8 places, so to a fifth or so."""
    tip, along = zip(*(led_needle(seed, unsteady_mm=0.5, turn_deg=2.0) for seed in range(12)), strict=True)
    off = np.concatenate([one[41:60] - [0, 22, 0] for one in tip])
    assert off.std() == pytest.approx(0.5, rel=0.25)
    straight = np.array([np.cos(np.radians(35)), np.sin(np.radians(35)), 0])
    turned = np.degrees(np.concatenate(along) - straight)
    assert np.sqrt((turned**2).sum(axis=1).mean() / 2) == pytest.approx(2.0, rel=0.25)


def test_the_needles_target_faces_the_cameras():
    target = read_rig("three_bodies").bodies["needle"]
    for heading in (0, 70, 180):
        path = insertion.Kind(heading_deg=heading)
        aimed = Aimed(NEEDLE.line_mm(target), rigid.transform([[1, 0, 0], [0, 0, -1], [0, 1, 0]], [0, 0, 650.0]))
        way = path.lead(target, EYES, 0, aimed=aimed)
        towards = EYES - way.pose(5.0)[:3, 3]
        assert way.pose(5.0)[:3, 2] @ towards / np.linalg.norm(towards) > np.cos(np.radians(45)), (
            "its normal is 41 deg off the shaft"
        )


@pytest.mark.parametrize(("turn", "heading"), [(0, 180), (180, 0), (40, 180)])
def test_a_needle_comes_from_where_both_cameras_see_its_target(turn, heading):
    """In the B-scan's plane, whichever way the array is turned on the skin; what is given stays."""
    rig, turned = read_rig("three_bodies"), np.deg2rad(turn)
    across = [np.cos(turned), np.sin(turned), 0.0]
    face = rigid.transform(np.column_stack([across, [0, 0, 1], np.cross(across, [0, 0, 1])]), [4.0, -2.0, 650.0])
    target, cameras = rig.bodies["needle"], [device.optics.camera() for device in (rig.cam1, rig.cam2)]
    path, aimed = insertion.Kind(), Aimed(NEEDLE.line_mm(target), face, cameras)
    assert path.in_view(target, EYES, aimed).heading_deg == heading
    way = path.lead(target, EYES, 0, aimed=aimed)
    for time in SECONDS[::30]:
        pose = way.pose(time)
        for camera in cameras:
            pixels = camera.project(rigid.apply(pose, circle_centres(target)))
            assert (pixels > 30).all() and (pixels < np.array(camera.size) - 30).all()
            sight = camera.centre - pose[:3, 3]
            assert pose[:3, 2] @ sight > np.cos(np.radians(65)) * np.linalg.norm(sight)
    given = insertion.Kind(heading_deg=10, angle_deg=70).in_view(target, EYES, aimed)
    assert given.heading_deg == 10 and given.angle_deg == 70 and given.roll_deg is not None
    aside = aimed._replace(world_from_face=rigid.transform(face[:3, :3], [400.0, 0.0, 650.0]))
    led = path.in_view(target, EYES, aside)
    assert (led.heading_deg, led.angle_deg, led.roll_deg) == (0, 35, 0), "where none is in view"


def test_a_needle_that_is_filmed_hides_no_other_target():
    """By rays from each camera to the other target's circles, which meet no plate as large as a board with a hand."""
    rig = read_rig("three_bodies")
    face = rigid.transform(np.column_stack([[1, 0, 0], [0, 0, 1], [0, -1, 0]]), [4.0, -2.0, 650.0])
    target, cameras = rig.bodies["needle"], [device.optics.camera() for device in (rig.cam1, rig.cam2)]
    probe = face @ rigid.transform(np.eye(3), [-19.7, 0, 0]) @ rigid.invert(rig.probe.target_from_image.matrix())

    def hidden(way):
        away = []
        for time in SECONDS[::30]:
            pose = way.pose(time)
            for camera in cameras:
                places = rigid.apply(probe, circle_centres(rig.target))
                ways = places - camera.centre
                share = (pose[:3, 3] - camera.centre) @ pose[:3, 2] / (ways @ pose[:3, 2])
                met = rigid.apply(rigid.invert(pose), camera.centre + share[:, None] * ways)[:, :2]
                middle = circle_centres(target).mean(axis=0)[:2]
                away.append(np.abs(met - middle)[share < 1])
        return bool((np.concatenate(away) < np.array(target.board_mm) / 2).all(axis=1).any())

    alone = Aimed(NEEDLE.line_mm(target), face, cameras)
    assert hidden(insertion.Kind().lead(target, EYES, 0, aimed=alone)), "the usual way, in the B-scan's plane"
    assert not hidden(insertion.Kind().lead(target, EYES, 0, aimed=alone._replace(others=[(rig.target, probe[None])])))


def test_what_cannot_be_led_to_an_aim_is_refused(config):
    with pytest.raises(InputError, match="expected insertion for a body with a tip"):
        insertion.Kind().lead(config.rig.target, EYES, 0)
    with pytest.raises(InputError, match=r"path.entry_mm: expected one apart from the aim"):
        led_needle(entry_mm=(1.0, 2.0, 3.0), aim_mm=(1.0, 2.0, 3.0))
    needle = "bodies.needle={path: {kind: insertion%s}}"
    with pytest.raises(InputError, match=r"bodies.needle.path.depth_mm: expected greater than 0, found -5"):
        load("sweep", ["out=unused", "rig=three_bodies", needle % ", depth_mm: -5"], sweep.Config)
    with pytest.raises(InputError, match=r"bodies.needle.path.kind: .* a film has no B-scan .* sweep filmed=true"):
        load("film", ["out=unused", "rig=three_bodies", needle % ""], Config)
    load("film", ["out=unused", "rig=three_bodies", needle % ", aim_mm: [0, 0, 660], entry_mm: [20, 0, 640]"], Config)


def test_films_have_paths_of_their_own():
    assert groups("film")["path"] == ["hand", "pivot"]
    assert groups("sweep")["path"] == ["bob", "hold", "none", "raster", "rows", "stroke", "tilts", "wire"]
    with pytest.raises(InputError, match=r"path"):
        load("sweep", ["out=unused", "path=pivot"], sweep.Config)
    with pytest.raises(InputError, match=r"tip_mm"):
        load("film", ["out=unused", "path.tip_mm=[0,0,1]"], Config)
