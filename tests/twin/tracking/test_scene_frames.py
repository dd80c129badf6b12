"""Frames of a sweep show the scene with its own reflectances, and the target where the path leads it."""

from dataclasses import replace

import numpy as np
import pytest

from recon.geometry import rigid
from recon.model.rig import PROBE
from scenes.handheld import standing_things
from scenes.handheld.body_look import look_of
from scenes.kinds import breast
from scenes.scene_types import Material, Scene, Thing
from scenes.solid_meshes import grid, slab
from tests.twin.tracking.takes import bare_board, facing, plain_take, ranges, rig, rig_of_three
from twin.conditions import Motion as Errors
from twin.shooting import FrameShooting, Quality
from twin.tracking import scene_frames
from twin.tracking.film_paths import still
from twin.tracking.rendered_views import render_views, white_radiance

RIG = rig()
PALE, DARK = 0.6, 0.2
EYES = np.array([90.0, 0.0, 0.0])  # mm, between the cameras


def plate() -> Scene:
    """A plate at 700 mm, dark on the left and pale on the right."""
    points, triangles = grid((900.0, 900.0), (30, 30))
    mesh = slab(points, triangles, 10.0)
    mesh.apply_translation([0, 0, 700.0])
    albedo = np.where(mesh.vertices[:, 0] < 0, DARK, PALE).astype(np.float32)
    return Scene("plate", (Thing("plate", mesh, Material(0.5), albedo, smooth=False),))


def staged(motions: list) -> scene_frames.SceneStage:
    return scene_frames.SceneStage(plate(), np.eye(4), {PROBE: motions}, {})


def led(count: int = 3) -> list:
    poses = np.stack([facing(10.0, (20.0 + 8 * k, -20.0, 590.0)) for k in range(count)])
    return scene_frames.motions(poses, poses, poses)


@pytest.fixture
def no_hand(monkeypatch):
    """The probe's board alone, where it isn't shown: a hand that covers no circle takes seconds to find."""
    monkeypatch.setattr(scene_frames, "as_designed", lambda *_: bare_board(RIG.target))


@pytest.fixture(scope="module")
def bank():
    return scene_frames.make_bank(staged(led(6)), RIG, 0)


@pytest.mark.usefixtures("no_hand")
def test_things_keep_their_reflectance():
    """In light that comes evenly from all around, radiance is in proportion to it, whatever the slot would have drawn."""
    bank = scene_frames.make_bank(staged(led()), RIG, 0)
    take = replace(plain_take(facing()), present=False, scene_from_world=np.eye(4), surroundings=0, body=0)
    take = replace(take, surfaces=take.surfaces * [1, 1, 1, 1, 0, 1])  # no gloss
    view = render_views(bank, RIG, [take], Quality(view=4, patch=2), 1)[0].views[0].astype(float) - 2.0
    left, right = view[60:180, 40:120].mean(), view[60:180, 200:280].mean()
    assert right / left == pytest.approx(PALE / DARK, rel=0.03)


def test_the_phantom_and_its_table_are_seen_and_tumours_are_not():
    parts = scene_frames.parts_of(breast.build(breast.Config()))
    assert [part.slot for part in parts] == ["phantom", "table", "bench"]
    assert parts[0].albedo is not None and np.ptp(parts[0].albedo) > 0.1, "the areola is darker"
    assert parts[2].mesh.bounds[0, 2] > parts[1].mesh.bounds[1, 2], "the bench lies under the table"


def test_motions_are_those_of_the_poses_over_the_exposure():
    begin, middle, end = (facing(10.0 + k, (20.0 + k, -20.0, 590.0)) for k in (-1, 0, 1))
    (motion,) = scene_frames.motions(middle[None], begin[None], end[None])
    assert motion.at(0.0) == pytest.approx(middle)
    assert motion.at(0.5) == pytest.approx(end, abs=2e-3) and motion.at(-0.5) == pytest.approx(begin, abs=2e-3)


@pytest.mark.parametrize("light", ["room", "projector"])
def test_one_light_and_one_exposure(light, bank):
    """The target's white is as bright as asked for on the whole, by one light; triggers may be late, frame by frame."""
    shooting = FrameShooting(white_dn=80.0, light=light)
    motions = led(6)
    made = scene_frames.takes(staged(motions), bank, RIG, ranges(), shooting, 3, Errors(trigger_s=1e-4))
    assert np.mean([take.white_dn for take in made]) == pytest.approx(80.0)
    falls = [white_radiance(take, RIG) for take in made]
    assert np.allclose(np.ptp([take.white_dn / fall for take, fall in zip(made, falls, strict=True)]), 0, atol=1e-6)
    assert all(take.lighting is made[0].lighting and take.body == made[0].body for take in made)
    assert len({take.noise_seed for take in made}) == len(made) and np.std([take.late for take in made]) > 0
    assert (made[0].lighting.projector[0] > 0) == (light == "projector")


def test_the_chosen_body_covers_no_circle():
    motions = led(6)
    bank = scene_frames.make_bank(staged(motions), RIG, 1)
    made = scene_frames.takes(staged(motions), bank, RIG, ranges(), FrameShooting(), 1)
    centres = [device.optics.camera().centre for device in (RIG.cam1, RIG.cam2)]
    eyes = np.array([rigid.apply(rigid.invert(take.motion.world_from_target), eye) for take in made for eye in centres])
    assert scene_frames.uncovered(bank, made[0].body, RIG.target, eyes) > 0.99


@pytest.mark.usefixtures("no_hand")
def test_scene_and_bodies_move_with_the_patient():
    """The plate's edge between dark and pale, and the rings of a board on its post, are where one rigid step takes them."""
    rig, step = rig_of_three(), rigid.from_rotation_vector([0, 0, np.deg2rad(5)], [18, -60, 0])
    way = still.Kind(place_mm=(-70.0, 30.0, 640.0)).lead(rig.bodies["patient"], EYES, 0)
    looks = {"patient": look_of("patient")}
    for moved in (np.eye(4), step):
        motions = {PROBE: led(), "patient": [way.motion(0.0, 0.01).carried(moved)] * 3}
        stage = scene_frames.SceneStage(plate(), moved, motions, looks)
        bank = scene_frames.make_bank(stage, rig, 0)
        first = scene_frames.takes(stage, bank, rig, ranges(), FrameShooting(), 1)[0]
        take = replace(plain_take(facing()), present=False, scene_from_world=first.scene_from_world, surroundings=0, body=0)
        take = replace(take, others=first.others, surfaces=take.surfaces * [1, 1, 1, 1, 0, 1])
        frames = render_views(bank, rig, [take], Quality(view=4, patch=2), 1)[0]
        view = frames.views[0].astype(float) - 2.0
        truth = frames.others["patient"][0]
        assert (truth.visible > 0.99).all()
        for (u, v), (_, _, radius, _, _) in zip(truth.centres / 4, truth.ellipses / 4, strict=True):
            v *= 240 / 256  # of views, which are lower than a quarter of the image
            hole, ring = view[round(v), round(u)], view[round(v), round(u + 0.7 * radius)]
            assert hole > 3 * ring
        left, right = (
            rig.cam1.optics.camera().project(rigid.apply(moved, [x, -40.0, 700.0])) / [4, 1024 / 240] for x in (-45, 15)
        )
        ratio = view[round(right[1]), round(right[0])] / view[round(left[1]), round(left[0])]
        assert ratio == pytest.approx(PALE / DARK, rel=0.1)


def test_a_board_is_as_high_as_it_stands():
    heights = [standing_things.height_over([thing.mesh for thing in plate().things], [x, 20.0, 640.0]) for x in (0, 300, 600)]
    assert heights == [pytest.approx(60.0), pytest.approx(60.0), 0.0]
