"""Rays, motion and light against closed forms and independent code."""

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from recon.board_detection.discs import measure
from recon.geometry import rigid
from recon.geometry.ellipses import Ellipses
from recon.model.circle_layout import circle_centres
from scenes.handheld.surroundings import surroundings
from tests.twin.tracking.takes import facing, plain_take, ranges, rig
from twin.optics.sampling import sobol_pair
from twin.shooting import FilmQuality
from twin.tracking import mesh_bank as bank_module
from twin.tracking import rendered_views
from twin.tracking.mesh_bank import build_bank
from twin.tracking.moving_transport import NO_CIRCLE, Lanes, _Path, render
from twin.tracking.rendered_views import render_film, white_radiance
from twin.tracking.samples import draw
from twin.tracking.target_truth import view_truth

RIG = rig()
MOST = 64  # sample points in a set; another number would be compiled anew


@pytest.fixture(scope="module")
def bank():
    return build_bank(RIG.target, 2, 3)


def window(truth, circle: int, margin: int = 14) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pixels about a circle : u, v of a square, and its first pixel."""
    half = int(np.ceil(truth.ellipses[circle, 2] + truth.blur_px[circle])) + margin
    first = np.rint(truth.centres[circle]).astype(int) - half
    v, u = np.mgrid[: 2 * half + 1, : 2 * half + 1]
    return u + first[0], v + first[1], first


def light_of(bank, take, camera: int, u, v, samples: int = 64, circle: int = NO_CIRCLE, seed: int = 1):
    n = u.size
    one = np.ones(n, np.uint32)
    lanes = Lanes(0 * one, camera * one, np.float32(u.ravel()), np.float32(v.ravel()), samples * one,
                  np.arange(n, dtype=np.uint32), 0 * one, circle * one)  # fmt: skip
    return render(bank, RIG, [take], lanes, MOST, seed)


def unhidden(bank, camera: int = 0, **motion):
    """A take with a body whose discs nothing covers in a view."""
    for body in (0, 1):
        take = replace(plain_take(facing(), **motion), body=body)
        truth = view_truth(take, take.cameras[camera], 0.0, RIG.target)
        shown = []
        for circle in range(3):
            u, v, _ = window(truth, circle)
            light = light_of(bank, take, camera, u, v, 4, circle)
            shown.append(light.seen.sum() / light.disc.sum())
        if min(shown) > 0.999:
            return take, truth
    pytest.skip("both bodies cover a disc")


@pytest.mark.parametrize(("camera", "path_px"), [(0, 0.0), (1, 12.0)])
def test_discs_lie_where_they_are_projected(bank, camera, path_px):
    """The rim, found in the light itself, is the true ellipse to 0.01 px: rays, distortion, motion and print agree with recon."""
    shift = np.array([0.8, 0.6, 0]) * path_px * 650 / 3320
    take, truth = unhidden(bank, camera, shift_mm=shift)
    for circle in (1, 2):
        u, v, first = window(truth, circle)
        light = light_of(bank, take, camera, u, v)
        image = light.radiance.reshape(u.shape) / light.radiance.max() * 200
        row = truth.ellipses[circle]
        turn = np.array([[np.cos(row[4]), -np.sin(row[4])], [np.sin(row[4]), np.cos(row[4])]])
        rough = Ellipses((row[:2] - first)[None], (turn @ np.diag(row[2:4]) @ turn.T)[None])
        found = measure(image, rough, np.array([10.0])).fit.ellipses
        assert np.abs(found.centre[0] + first - row[:2]).max() < (0.01 if path_px == 0 else 0.05)
        assert found.semi_axes[0] == pytest.approx(row[2:4], abs=0.05 if path_px == 0 else 1.5)


def test_rays_undo_the_lens_as_recon_does(bank):
    """A grid of targets' centres seen through strong distortion: the light's middle stays where `Camera.project` puts it."""
    take = plain_take(facing(0, (60, 45, 600)))
    strong = take.cameras[0].optics.model_copy(update={"distortion": (-0.3, 0.2, 0.001, -0.002, 0.1)})
    take = replace(take, cameras=(take.cameras[0].model_copy(update={"optics": strong}), take.cameras[1]))
    truth = view_truth(take, take.cameras[0], 0.0, RIG.target)
    for circle in range(3):
        u, v, _ = window(truth, circle, 4)
        aimed = light_of(bank, take, 0, u, v, 16, circle).disc
        middle = np.array([(aimed * u.ravel()).sum(), (aimed * v.ravel()).sum()]) / aimed.sum()
        assert np.abs(middle - truth.ellipses[circle, :2]).max() < 0.02


def test_a_camera_that_exposes_later_sees_the_target_farther_on(bank):
    """By half an exposure: as of a target that is there; the other camera sees no difference."""
    shift, turn = np.array([3.0, 1.0, 2.0]), np.array([0.02, -0.01, 0.05])
    punctual = replace(plain_take(facing(), shift_mm=shift, turn_rad=turn), body=0)
    late = replace(punctual, late=(0.0, 0.5))
    there = replace(punctual, motion=punctual.motion.later(0.5))
    truth = view_truth(late, late.cameras[1], 0.5, RIG.target)
    np.testing.assert_allclose(truth.ellipses, view_truth(there, there.cameras[1], 0.0, RIG.target).ellipses)
    u, v, _ = window(truth, 1)
    seen, expected, early = (light_of(bank, take, 1, u, v, 16).radiance for take in (late, there, punctual))
    assert np.sqrt(np.mean((seen - expected) ** 2)) < 0.02 * np.ptp(expected) < np.sqrt(np.mean((seen - early) ** 2))
    first, same = (light_of(bank, take, 0, u, v, 4).radiance for take in (late, punctual))
    assert (first == same).all()


def test_a_moved_target_is_the_mean_of_still_ones(bank):
    """Blur is what a camera adds up: the moving frame equals the mean of still frames along the way."""
    shift, turn = np.array([3.0, 1.0, 2.0]), np.array([0.02, -0.01, 0.05])
    moving = replace(plain_take(facing(), shift_mm=shift, turn_rad=turn), body=0)
    truth = view_truth(moving, moving.cameras[0], 0.0, RIG.target)
    u, v, _ = window(truth, 1)
    blurred = light_of(bank, moving, 0, u, v, 64).radiance
    times = (np.arange(10) + 0.5) / 10 - 0.5
    still = np.mean([
        light_of(bank, replace(plain_take(moving.motion.at(time)), body=0), 0, u, v, 16).radiance for time in times
    ], axis=0)  # fmt: skip
    contrast = still.max() - still.min()
    assert np.sqrt(np.mean((blurred - still) ** 2)) < 0.03 * contrast
    sharp = light_of(bank, replace(plain_take(facing()), body=0), 0, u, v, 16).radiance
    assert np.sqrt(np.mean((sharp - still) ** 2)) > 0.1 * contrast  # the test can tell


def test_white_shines_as_the_closed_form_says(bank):
    """One lamp, no light from around: paper * I cos / (pi d^2)."""
    take = plain_take(facing(10))
    pose = take.motion.world_from_target
    lamps = np.zeros((4, 5))
    lamps[:, 3] = 0.01
    lamps[0, :3] = pose[:3, 3] + pose[:3, :3] @ [200, 300, 900]
    lamps[0, 4] = 900.0**2
    take = replace(take, lighting=replace(take.lighting, lamps=lamps, ambient=0.0))
    truth = view_truth(take, take.cameras[0], 0.0, RIG.target)
    u, v, _ = window(truth, 0, 10)
    light = light_of(bank, take, 0, u, v, 16)
    shadowless = light.white_radiance[light.white > 0] / light.white[light.white > 0]
    shadowless = shadowless[shadowless > 0]
    assert np.median(shadowless) == pytest.approx(white_radiance(take, RIG), rel=0.06)  # 13 mm off the middle; vignetting


def lit_by(take, *names: str):
    """The take with these of its sources: a lamp as large as a window, the uneven light from around, the projector."""
    lamps = np.zeros((4, 5))
    lamps[:, 3] = 1
    lamps[0] = [250, -150, 0, 120, 650.0**2 * ("lamp" in names)]
    projector = np.array([650.0**2 * 0.5 * ("projector" in names), 0.5, 0.4, 40.0, 0.0])
    gradient = np.array([0.5, -0.5, 0.5])
    lighting = replace(take.lighting, lamps=lamps, projector=projector, ambient=0.4 * ("around" in names), gradient=gradient)
    return replace(take, lighting=lighting)


def test_paper_under_a_large_lamp_has_no_lattice_in_a_film(bank, monkeypatch):
    """Nothing stands before the face, so brightness varies over paper as smoothly as the lamp's light."""
    take, truth = unhidden(bank)
    pose = take.motion.world_from_target
    lamps = np.zeros((4, 5))
    lamps[:, 3] = 1
    lamps[0] = [*(pose[:3, 3] + pose[:3, :3] @ [100, 200, 700]), 80, 700.0**2]
    take = replace(take, lighting=replace(take.lighting, lamps=lamps, ambient=0.1))
    monkeypatch.setattr(rendered_views, "_exposed", lambda radiance, *_: radiance)
    image = render_film(bank, RIG, [take], FilmQuality(), 1)[0].views[0]
    v, u = np.mgrid[: image.shape[0], : image.shape[1]]
    a, b = (truth.centres[k] - truth.centres[0] for k in (1, 2))
    along, across = np.linalg.solve(np.column_stack([a, b]), (np.stack([u, v], -1) - truth.centres[0])[..., None])[..., 0].T
    on_face = ((along > 0) & (along < 1) & (across > 0) & (across < 1)).T
    for row in truth.ellipses:
        on_face &= np.hypot(u - row[0], v - row[1]) > row[2] + 5
    x, y = (u - truth.centres[0, 0])[on_face] / 200, (v - truth.centres[0, 1])[on_face] / 200
    terms = np.column_stack([np.ones_like(x), x, y, x * x, x * y, y * y])
    paper = image[on_face]
    smooth = terms @ np.linalg.lstsq(terms, paper)[0]
    assert (paper / smooth).std() < 0.005


def test_light_of_several_sources_adds_up_in_their_shadows(bank):
    """Superposition: which source a shadow ray is sent to changes the noise alone."""
    take = draw(ranges(), RIG, 0, 1)
    v, u = np.mgrid[4:1024:10, 4:1280:10]
    names = "lamp", "around", "projector"
    tiles = np.ravel_multi_index(np.indices(u.shape) // 6, np.array(u.shape) // 6 + 1).ravel()
    whole, *parts = (
        np.array(
            [np.bincount(tiles, light_of(bank, lit_by(take, *sources), 0, u, v, 16, seed=4 * j + k).radiance) for k in range(4)]
        )
        for j, sources in enumerate((names, *((name,) for name in names)))
    )
    missing = whole.mean(axis=0) - sum(part.mean(axis=0) for part in parts)
    variance = sum(one.var(axis=0, ddof=1) for one in (whole, *parts)) / 4
    assert abs(missing.sum() / np.sqrt(variance.sum())) < 4
    z = missing / np.sqrt(variance)
    assert 0.7 < np.sqrt(np.mean(np.clip(z, -5, 5) ** 2)) < 1.3


def test_uneven_light_comes_from_where_it_is():
    """Of light 1 + g x + h z over a place that faces z, weighted by cosines, 1/2 + 2 g / (3 pi) + h / 3 comes from x > 0, and
    1 + 2 h / 3 on the whole."""
    g, h, count = 0.6, 0.4, 1 << 16
    path = _Path.__new__(_Path)
    path.gradient = mi.Vector3f(g, 0, h)
    where = sobol_pair(dr.arange(mi.UInt32, count), 16, mi.UInt32(1))
    expected = (0.5 + 2 * g / (3 * np.pi) + h / 3) / (1 + 2 * h / 3)
    pick = sobol_pair(dr.arange(mi.UInt32, count), 16, mi.UInt32(2)).x
    way, light = path._towards_one(mi.Float(1), [], pick, mi.Vector3f(0, 0, 1), where)
    assert dr.mean(dr.select(way.x > 0, light, 0))[0] == pytest.approx(expected, abs=1e-3)
    assert dr.mean(light)[0] == pytest.approx(1, abs=1e-3)


def test_launches_of_any_size_are_one_kernel(bank):
    """Compiled anew for each window, rendering would take three times as long; a process's first launch has its own."""
    take, hashes = plain_take(facing()), set()
    light_of(bank, take, 0, np.zeros(1), np.zeros(1), 4)
    for count in (100, 160, 1007):
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            light_of(bank, take, 0, np.linspace(0, 1279, count), np.linspace(0, 1023, count), 4)
            hashes |= {kernel["hash"] for kernel in dr.kernel_history() if kernel["type"] == dr.KernelType.JIT}
    assert len(hashes) == 1


def test_projected_fringes_stand_where_the_projector_puts_them(bank):
    """Along the target's face the light follows the projector's columns."""
    take = plain_take(facing(5))
    fringes = np.array([650.0**2 * 5, 0.5, 0.5, 40.0, 0.0])
    take = replace(take, lighting=replace(take.lighting, ambient=1e-9, projector=fringes))
    truth = view_truth(take, take.cameras[0], 0.0, RIG.target)
    line = truth.centres[0] + np.linspace(-60, 60, 200)[:, None] * [0.7, 0.7]
    u, v = np.rint(line).T
    light = light_of(bank, take, 0, u, v, 64)
    pose, camera = take.motion.world_from_target, RIG.cam1.optics.camera()
    rays = camera.rays(np.column_stack([u, v]))
    distance = ((pose[:3, 3] - camera.centre) @ pose[:3, 2]) / (rays @ pose[:3, 2])
    columns = RIG.projector.optics.camera().project(camera.centre + rays * distance[:, None])[:, 0]
    distortion_px = 3.0  # the data sets' projector is a pinhole
    expected = 0.5 + 0.5 * np.cos(2 * np.pi * columns / 40)
    lit = light.white > 32
    assert lit.sum() > 30
    assert np.corrcoef(light.radiance[lit], expected[lit])[0, 1] > np.cos(2 * np.pi * distortion_px / 40) - 0.05


def test_surroundings_without_a_poster_are_rendered(monkeypatch):
    """As few variants may have none."""

    def bare(stream):
        drawn = surroundings(stream)
        return replace(drawn, parts=[part for part in drawn.parts if part.slot != "poster"], posters=[])

    monkeypatch.setattr(bank_module, "surroundings", bare)
    few = build_bank(RIG.target, 1, 3)
    take = replace(draw(ranges(), RIG, 0, 1), body=0, surroundings=0)
    v, u = np.mgrid[4:1024:40, 4:1280:40]
    light = light_of(few, take, 0, u, v, 4)
    assert np.isfinite(light.radiance).all() and (light.radiance > 0).mean() > 0.9


def test_a_face_turned_away_shows_no_circle(bank):
    away = facing() @ rigid.from_rotation_vector([np.pi, 0, 0], [0, 0, 0])
    take = plain_take(away)
    camera = take.cameras[0].optics.camera()
    middle = camera.project(rigid.apply(away, circle_centres(RIG.target)))[0]
    v, u = np.mgrid[-30:30, -30:30] + np.rint(middle[::-1]).astype(int)[:, None, None]
    light = light_of(bank, take, 0, u, v, 4, 0)
    assert light.disc.sum() == light.seen.sum() == light.white.sum() == 0
