"""Several bodies in one picture: each as if it were alone, but for what stands in its way and in its light."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from recon.geometry import rigid
from recon.model import circle_layout
from recon.model.circle_layout import circle_centres
from recon.model.rig import PROBE
from scenes.handheld import lofts
from scenes.handheld.mesh_parts import Part
from scenes.handheld.surroundings import Surroundings
from tests.twin.tracking.takes import bare_board, facing, plain_take, rig, rig_of_three
from twin.shooting import FilmQuality, Quality
from twin.tracking import rendered_views
from twin.tracking.mesh_bank import bank_of
from twin.tracking.moving_transport import NO_CIRCLE, Lanes, circle_number, render
from twin.tracking.pixel_selection import lanes_of
from twin.tracking.rendered_views import render_film, render_still, render_views, white_radiance
from twin.tracking.samples import Held, Motion, Take
from twin.tracking.target_truth import board_corners, view_truth

RIG = rig_of_three()
NEEDLE = RIG.bodies["needle"]
BESIDE = facing(10.0, (20.0, -10.0, 640.0), 80.0)  # a needle to the right of the probe
QUALITY = FilmQuality(view=2)


@pytest.fixture(scope="module")
def bank():
    bench = Part("bench", lofts.box([6000, 6000, 40], [0, 0, -20]), False)
    return bank_of([bare_board(RIG.target), bare_board(NEEDLE)], [Surroundings((bench,), ())])


def both(probe, needle, shift_mm=(0, 0, 0), turn_rad=(0, 0, 0)) -> Take:
    """A still probe and a needle, in light from all around."""
    take = replace(plain_take(probe), body=0, surroundings=0)
    motion = Motion(needle, np.array(shift_mm, float), np.array(turn_rad, float))
    return replace(take, others={"needle": Held(motion, 1, take.face)})


def lamp_at(take: Take, place) -> Take:
    """The take in the light of one small lamp alone."""
    lamps = np.zeros((4, 5))
    lamps[:, 3] = 0.01
    lamps[0] = [*place, 0.01, 600.0**2]
    return replace(take, lighting=replace(take.lighting, lamps=lamps, ambient=0.0))


def light_of(bank, take: Take, u, v, camera: int = 0, samples: int = 16, circle: int = NO_CIRCLE):
    one = np.ones(u.size, np.uint32)
    pixels = np.arange(u.size, dtype=np.uint32)
    lanes = Lanes(
        0 * one, camera * one, np.float32(u).ravel(), np.float32(v).ravel(), samples * one, pixels, 0 * one, circle * one
    )
    return render(bank, RIG, [take], lanes, 64, 1)


def on_board(take: Take, name: str, margin_px: int = 4) -> np.ndarray:
    """Pixels : (h, w) of a body's board in camera 1."""
    camera = take.cameras[0].optics.camera()
    corners = camera.project(rigid.apply(take.held[name].motion.world_from_target, board_corners(RIG.targets[name])))
    mask = cv2.fillConvexPoly(np.zeros(camera.size[::-1], np.uint8), np.rint(corners).astype(np.int32), 1)
    return cv2.erode(mask, np.ones((2 * margin_px + 1,) * 2)) > 0


def test_apart_each_is_rendered_as_if_it_were_alone(bank):
    """By the same rays, ray by ray; where there is nothing in the way the other changes nothing."""
    take = lamp_at(both(facing(20.0, (-70.0, -20.0, 650.0)), BESIDE), (30.0, 0.0, 0.0))
    alone = {PROBE: replace(take, others={}), "needle": replace(take, present=False)}
    for name in take.held:
        v, u = np.nonzero(on_board(take, name)[::5, ::5])
        together, by_itself = (light_of(bank, one, 5 * u, 5 * v).radiance for one in (take, alone[name]))
        assert u.size > 800 and by_itself.min() > 0
        np.testing.assert_allclose(together, by_itself, rtol=1e-4)


@pytest.mark.slow
def test_a_films_picture_is_that_of_each_alone(bank):
    """Digital numbers of the circles, noise and all."""
    take = lamp_at(both(facing(20.0, (-70.0, -20.0, 650.0)), BESIDE), (30.0, 0.0, 0.0))
    together, first, second = (
        render_film(bank, RIG, [one], QUALITY, 1)[0] for one in (take, replace(take, others={}), replace(take, present=False))
    )
    for name, alone in ((PROBE, first), ("needle", second)):
        board = on_board(take, name, 12)
        apart = together.views[0][board].astype(int) - alone.views[0][board]
        assert np.mean(apart != 0) < 1e-3
        for here, there in zip(together.bodies[name], alone.bodies[name], strict=True):
            assert here.visible == pytest.approx(np.ones(3), abs=1e-6)
            assert here.white_dn == pytest.approx(there.white_dn, rel=1e-3)
            np.testing.assert_array_equal(here.ellipses, there.ellipses)
    assert np.isnan(second.truth[0].centres).all() and np.isnan(second.truth[0].white_dn)


def free_share(ellipse, polygon) -> float:
    """Part of an ellipse's area outside a convex polygon : (4, 2) px, by points."""
    radius, angle = np.sqrt((np.arange(60) + 0.5) / 60)[:, None], np.arange(240) * np.pi / 120
    x, y = ellipse[2] * radius * np.cos(angle), ellipse[3] * radius * np.sin(angle)
    cos, sin = np.cos(ellipse[4]), np.sin(ellipse[4])
    points = np.stack([ellipse[0] + x * cos - y * sin, ellipse[1] + x * sin + y * cos], -1)
    sides = np.roll(polygon, -1, axis=0) - polygon
    away = points[..., None, :] - polygon
    turns = sides[:, 0] * away[..., 1] - sides[:, 1] * away[..., 0]
    return float(1 - np.mean((turns > 0).all(axis=-1) | (turns < 0).all(axis=-1)))


@pytest.mark.parametrize("front", [PROBE, "needle"])
def test_a_body_in_front_hides_what_its_board_covers(bank, front):
    """The visible part of each disc is what lies outside the other's projected board; both are seen by rays of either order."""
    near, far = 600.0, 650.0
    depth = {name: near if name == front else far for name in (PROBE, "needle")}
    camera = RIG.cam1.optics.camera()
    take = both(facing(0.0, (-15.0, 0.0, depth[PROBE]), 20.0), facing(0.0, (0.0, 20.0, depth["needle"]), 0.0))
    behind = "needle" if front == PROBE else PROBE
    seen = render_film(bank, RIG, [take], FilmQuality(disc=8), 1)[0].bodies
    cover = camera.project(rigid.apply(take.held[front].motion.world_from_target, board_corners(RIG.targets[front])))
    expected = [free_share(row, cover) for row in seen[behind][0].ellipses]
    assert 0.05 < np.median(expected) < 0.95 or (min(expected) < 0.05 and max(expected) > 0.3)
    assert seen[behind][0].visible == pytest.approx(expected, abs=0.015)
    assert seen[front][0].visible == pytest.approx(np.ones(3), abs=1e-6)


def test_a_body_throws_its_shadow_on_another(bank):
    """A needle's board between the lamp and the probe's face, out of the camera's sight, takes all the light and nothing else."""
    probe = facing(0.0, (-15.0, -15.0, 650.0), 0.0)
    lamp, to = np.array([300.0, 0.0, 250.0]), rigid.apply(probe, circle_layout.middle(RIG.target))
    between = lofts.frame(to + 0.5 * (lamp - to), lamp - to)
    between[:3, 3] -= between[:3, :3] @ circle_layout.middle(NEEDLE)
    take = lamp_at(both(probe, between), lamp)
    v, u = np.nonzero(on_board(take, PROBE, 60)[::9, ::9])
    shaded, lit = (light_of(bank, one, 9 * u, 9 * v) for one in (take, replace(take, others={})))
    assert lit.radiance.min() > 0.001 and shaded.radiance.max() == 0
    np.testing.assert_allclose(shaded.plain, lit.plain, rtol=1e-5)


@pytest.mark.parametrize(("camera", "late"), [(0, 0.0), (1, 0.4)])
def test_the_second_bodys_truth_is_where_its_rays_go(bank, camera, late):
    """By its own motion: discs' middles lie on the true ellipses', and are drawn out as an even motion over the path does."""
    shift = np.array([3.0, 2.0, 0.0])
    take = replace(both(facing(20.0, (-70.0, -20.0, 650.0)), BESIDE, shift_mm=shift), late=(0.0, late))
    truth = view_truth(take.others["needle"], take.cameras[camera], take.late[camera], NEEDLE)
    moved = BESIDE.copy()
    moved[:3, 3] += late * shift
    eye = take.cameras[camera].optics.camera()
    assert truth.centres == pytest.approx(eye.project(rigid.apply(moved, circle_centres(NEEDLE))), abs=1e-6)
    for k, row in enumerate(truth.ellipses):
        v, u = np.mgrid[-75:76, -75:76] + np.rint(row[1::-1]).astype(int)[:, None, None]
        weight = light_of(bank, take, u, v, camera, 32, circle_number(1, k)).disc
        assert not light_of(bank, take, u, v, camera, 4, circle_number(0, k)).disc.any()
        middle = np.array([(weight * u.ravel()).sum(), (weight * v.ravel()).sum()]) / weight.sum()
        assert middle == pytest.approx(row[:2], abs=0.05)
        spread = np.average((u.ravel() - middle[0]) ** 2 + (v.ravel() - middle[1]) ** 2, weights=weight)
        at_rest = (row[2] ** 2 + row[3] ** 2) / 4
        assert spread - at_rest == pytest.approx(truth.blur_px[k] ** 2 / 12, abs=0.01 * at_rest)


def test_white_is_that_of_each_bodys_own_paper(bank):
    """In light from all around, paper half as white is half as bright, in films and beside patches; the probe's stays."""
    take = both(facing(20.0, (-70.0, -20.0, 650.0)), BESIDE)
    grey = replace(take.others["needle"], face=replace(take.face, paper=take.face.paper / 2))
    takes = [take, replace(take, others={"needle": grey})]
    for pale, dark in (render_film(bank, RIG, takes, QUALITY, 1), render_views(bank, RIG, takes, Quality(), 1)):
        for name, share in ((PROBE, 1.0), ("needle", 0.5)):
            for one, other in zip(pale.bodies[name], dark.bodies[name], strict=True):
                assert other.white_dn / one.white_dn == pytest.approx(share, rel=0.01)


def test_patches_show_all_circles(bank):
    """Of all bodies, in their order; in the middle of each is a disc."""
    take = both(facing(20.0, (-70.0, -20.0, 650.0)), BESIDE)
    frames = render_views(bank, RIG, [take], Quality(), 1)[0]
    assert frames.patches.shape == (2, 6, 120, 120)
    for k, (patches, views) in enumerate(zip(frames.patches, zip(*frames.bodies.values(), strict=True), strict=True)):
        centres = np.concatenate([view.centres - view.patch_origins for view in views])
        assert np.abs(centres - 59.5).max() < 8, k
        dark = [
            patch[int(v) - 25 : int(v) + 26, int(u) - 25 : int(u) + 26].min()
            for patch, (u, v) in zip(patches, centres, strict=True)
        ]
        assert max(dark) < 0.4 * np.median(patches)


def test_takes_of_different_bodies_are_refused(bank):
    take = both(facing(), BESIDE)
    with pytest.raises(ValueError, match="takes: expected the bodies probe, needle in each, found others"):
        render_film(bank, RIG, [take, replace(take, others={})], QUALITY, 1)


def shaded() -> tuple:
    """A bank and a take of a board that moves over a block on a bench, by 20 px and in a turn, in light of a large lamp."""
    parts = (
        Part("bench", lofts.box([6000, 6000, 40], [0, 0, -20]), False),
        Part("phantom", lofts.box([120, 60, 50], [40, -30, 25]), False),
    )
    take = plain_take(facing(20.0, (-20.0, 10.0, 600.0)), shift_mm=(3.0, 1.5, 0.5), turn_rad=(0, 0.01, 0.02))
    lamps = np.zeros((4, 5))
    lamps[:, 3] = 1
    lamps[0] = [150, -300, 100, 90, 600.0**2]
    below = rigid.invert(rigid.from_rotation_vector([np.pi, 0, 0], [0, 0, 720]))
    lighting = replace(take.lighting, lamps=lamps, ambient=0.3 / np.pi)
    made = replace(take, body=0, surroundings=0, scene_from_world=below, lighting=lighting)
    return bank_of([bare_board(rig().target)], [Surroundings(parts, ())]), made


@pytest.fixture(scope="module")
def all_rays():
    """Each fourth pixel of the shaded scene by 64 rays, for some seeds, in shares of white: (4, 256, 320)."""
    bank, take = shaded()
    v, u = np.mgrid[2:1024:4, 2:1280:4]
    lanes = lanes_of(0, 0, u, v, 16, np.arange(u.size))
    made = [render(bank, rig(), [take], lanes, 64, seed).radiance.reshape(u.shape) for seed in range(10, 14)]
    return np.array(made) / white_radiance(take, rig())


@pytest.mark.parametrize("of_a_film", [True, False])
def test_a_frame_is_what_all_rays_would_make_of_it(of_a_film, all_rays, monkeypatch):
    """Blur and shadows against 64 rays in each fourth pixel, by both's scatter over seeds, and half a percent of white, which the
    averages over shadows cost; but for the still block's outlines, where they cost up to 4 %.
    """
    monkeypatch.setattr(rendered_views, "_exposed", lambda radiance, *_: radiance)
    bank, take = shaded()
    own, white, quality = rig(), white_radiance(take, rig()), FilmQuality()
    stills = [render_still(bank, own, take, quality, seed) if of_a_film else None for seed in range(4)]
    frames = np.array([render_film(bank, own, [take], quality, seed, still)[0].views[0] for seed, still in enumerate(stills)])
    frames = frames[:, 2::4, 2::4] / white
    apart = frames.mean(axis=0) - all_rays.mean(axis=0)
    variance = (frames.var(axis=0, ddof=1) + all_rays.var(axis=0, ddof=1)) / 4

    def tiles(image):
        return image.reshape(32, 8, 40, 8).sum(axis=(1, 3)) / 64

    z = tiles(apart) / np.sqrt(tiles(variance) / 64 + 0.005**2)
    assert abs(apart.mean()) < 0.002 and np.sqrt(np.mean(z**2)) < 1.3
    assert np.abs(tiles(apart)).max() < 0.04
    noise = np.sqrt(tiles(frames.var(axis=0, ddof=1)))
    assert np.median(noise) < 0.01, "half of the sensor's at 65 DN"


def test_beside_bodies_frames_are_the_still_scene(monkeypatch):
    """To the last digit without bodies, and but for a shadow without a step beside one: no noise of its own, no seam."""
    monkeypatch.setattr(rendered_views, "_exposed", lambda radiance, *_: radiance)
    bank, take = shaded()
    still = render_still(bank, rig(), take, FilmQuality(), 1)
    empty, held = render_film(bank, rig(), [replace(take, present=False), replace(take, k=1)], FilmQuality(), 1, still)
    for image, scene in zip(empty.views, still, strict=True):
        np.testing.assert_array_equal(image, scene)
    shade = held.views[0] / still[0]
    assert shade[:, 1150:] == pytest.approx(1, abs=0.05) and np.median(np.abs(shade[:, 1150:] - 1)) < 0.002
    assert np.abs(np.diff(shade[:200], axis=1)).max() < 0.02 and np.abs(np.diff(shade[:200], axis=0)).max() < 0.02


def test_a_frame_depends_on_its_own_number_alone():
    bank, take = shaded()
    takes = [replace(take, k=k, noise_seed=k) for k in range(2)]
    still = render_still(bank, rig(), take, FilmQuality(), 1)
    once = render_film(bank, rig(), takes, FilmQuality(), 1, still)[1]
    again = render_film(bank, rig(), takes[1:], FilmQuality(), 1, still)[0]
    for one, other in zip(once.views, again.views, strict=True):
        assert (one == other).all()
