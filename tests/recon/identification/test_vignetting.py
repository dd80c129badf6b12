"""Light over the image: do white patches of a board tell both vignettings and the room, within their sigma?"""

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from recon.geometry import rigid
from recon.identification.calibrated_optics import one_sigma_off
from recon.identification.estimates import Estimate
from recon.identification.vignetting import USUAL, find_vignetting, joined, measure_whites, placed
from recon.optical_calibration.joint_calibration import calibrate
from scenes import board_poses
from scenes.kinds import board
from tests.recon.identification import lit_boards
from tests.twin.small_rigs import half
from twin.experiments import board_sets
from twin.optics.surface_session import calibration_of

BOARD = board.design(board.Config())
BLACK = Estimate(2.0, 0.2, "dark frames")
FIELDS = ("cam1.lens.vignetting", "projector.lens.vignetting", "room.over_projector")


@pytest.fixture(scope="module")
def stand(rig):
    """Camera, projector, and the board in eight poses."""
    small = half(rig)
    devices = [device.optics.camera() for device in (small.cam1, small.cam2, small.projector)]
    return devices[0], devices[2], board_poses.random_poses(board_poses.Config(count=8, margin_px=4), BOARD, devices)


@pytest.fixture(scope="module")
def rays(stand):
    """Directions of all pixels' rays : (h, w, 3), and the camera's own share of the light."""
    camera, _, _ = stand
    ideal = camera.undistort(camera.pixel_grid())
    axis = np.concatenate([ideal, np.ones((*ideal.shape[:2], 1))], axis=-1)
    return axis, (axis**2).sum(axis=-1) ** -2.0


def corner2(camera, pixels):
    middle = (np.array(camera.size) - 1) / 2
    return ((pixels - middle) ** 2).sum(axis=-1) / (middle @ middle)


def image(stand, rays, pose, truth, rng, gain=1.0, tint=0.0, power=1.0):
    """White paper, pixel by pixel, where its plane meets the rays; noise as of shot noise. The paper's white may have a slope."""
    camera, projector, _ = stand
    axis, cosine4 = rays
    normal, origin = pose[:3, 2], pose[:3, 3]
    points = axis * (normal @ origin / (axis @ normal))[..., None]
    local = rigid.apply(projector.camera_from_world, points)
    away2 = (local**2).sum(axis=-1)
    aslant = np.abs((points - projector.centre) @ normal) / np.sqrt(away2)
    view = np.abs(points @ normal) / np.linalg.norm(points, axis=-1)
    facing = 1e6 * aslant / (local[..., 2] / np.sqrt(away2)) ** 3 / away2 * (aslant * view) ** (power - 1)
    lens, shown, room = truth
    light = facing * (1 - shown * corner2(projector, projector.project(points))) + room
    white = 1 + tint * rigid.apply(rigid.invert(pose), points)[..., 0] / 90
    level = BLACK.value + gain * 50 * white * cosine4 * (1 - lens * corner2(camera, camera.pixel_grid())) * light
    return np.rint(level + np.sqrt(level / 30) * rng.normal(size=level.shape))


def whites(stand, rays, truth, rng, gains=(1.0,) * 8, **paper):
    camera, projector, poses = stand
    return joined([
        measure_whites(image(stand, rays, pose, truth, rng, gains[k], **paper), BOARD, camera, projector, pose, pose=k)
        for k, pose in enumerate(poses)
    ])  # fmt: skip


def scores(found, truth):
    return np.array([(found.estimates[f].value - t) / found.estimates[f].sigma for f, t in zip(FIELDS, truth, strict=True)])


def test_both_vignettings_and_the_room_are_found(stand, rays, rng):
    truth = (0.2, 0.12, 0.2)
    found = find_vignetting(whites(stand, rays, truth, rng), black=BLACK)
    assert np.abs(scores(found, truth)).max() < 3.5
    assert found.estimates[FIELDS[0]].sigma < 0.01 and found.estimates[FIELDS[1]].sigma < 0.03


def test_paper_that_is_neither_matt_nor_even_and_a_lamp_that_drifts_are_no_matter(stand, rays, rng):
    """Taken for matt, even and steady, each of the three moves one of the estimates by many sigma."""
    truth = (0.2, 0.12, 0.2)
    patches = whites(stand, rays, truth, rng, rng.normal(1, 0.01, 8), tint=0.01, power=1.05)
    assert np.abs(scores(find_vignetting(patches, black=BLACK), truth)).max() < 3.5


def test_a_dark_room_is_not_told_from_black(stand, rays, rng):
    found = find_vignetting(whites(stand, rays, (0.1, 0.1, 0.0), rng), black=BLACK)
    assert "not told from black" in found.unknown[FIELDS[2]] and "tracing.room_lux" in found.unknown


def test_one_pose_is_too_few(stand, rays, rng):
    patches = whites(stand, rays, (0.1, 0.1, 0.1), rng)
    assert set(find_vignetting(patches[patches.pose == 0], black=BLACK).unknown) == {*FIELDS, "tracing.room_lux"}


@pytest.mark.slow
def test_intervals_cover_the_light(stand, rays, rng):
    """Of 12 rigs as in 999 of 1000 drawings; squares to 4 sigma of chi-square, and not below 1 in 1000 of that of 12 numbers.

    Paper and the error of black are drawn as widely as the fit takes them to be. The three numbers of a rig err together, so the
    lower bound counts them as one: sigmas that are 2.5 times too wide fall below it.
    """
    z = []
    for _ in range(12):
        truth = rng.uniform([0, 0, 0.1], [0.3, 0.3, 0.4])
        paper = {"tint": rng.normal(0, USUAL.white), "power": rng.normal(1, USUAL.minnaert)}
        black = replace(BLACK, value=rng.normal(BLACK.value, BLACK.sigma))
        z.append(scores(find_vignetting(whites(stand, rays, truth, rng, rng.normal(1, 0.003, 8), **paper), black=black), truth))
    covered = np.count_nonzero(np.abs(z) < 1.96, axis=0)
    assert (covered >= stats.binom.ppf(0.001, len(z), 0.95)).all()
    assert stats.chi2.ppf(0.001, len(z)) / len(z) < np.mean(np.square(z)) < 1 + 4 * np.sqrt(2 / np.size(z))


@pytest.mark.slow
def test_errors_of_the_calibration_are_in_the_interval(rig):
    """Light without noise on boards that were calibrated with noise: what is off is so by the optics alone.

    Squares of 12 drawn calibrations to 4 sigma of chi-square, and not below 1 in 1000 of that of 12 numbers, as both of a rig
    err together. Without the optics' errors in the sigmas they are ten times too large.
    """
    small, truth, z, alone = half(rig), (0.2, 0.12, 0.1), [], []
    true = calibration_of(small)
    noise = {"cam1": 0.05, "cam2": 0.05, "projector": 0.05}
    for seed in range(12):
        rng = np.random.default_rng([7, seed])
        poses = board_poses.random_poses(board_poses.Config(count=8, margin_px=4, seed=seed), BOARD, list(true.cameras.values()))
        seen = board_sets.drawn(true, BOARD, poses, noise, rng)
        optics = calibrate(seen.sightings, BOARD, seen.sizes)
        calibrated = optics.adjustment.calibration.cameras
        camera, projector = calibrated["cam1"], calibrated["projector"]
        grey = np.full(camera.size[::-1], 100.0)
        patches = joined(
            [measure_whites(grey, BOARD, camera, projector, pose, pose=k) for k, pose in enumerate(optics.adjustment.poses)]
        )
        lit = placed(patches, true.cameras["cam1"], true.cameras["projector"], dict(enumerate(poses)))
        light = lit.light * (1 - truth[1] * lit.shown2) + truth[2]
        level = BLACK.value + 50 * lit.cosine4 * (1 - truth[0] * lit.corner2) * light
        patches = replace(patches, level=level, sigma=1e-4 * level)
        off = [(devices, dict(enumerate(steps))) for devices, steps in one_sigma_off(optics)]
        otherwise = [placed(patches, devices["cam1"], devices["projector"], steps) for devices, steps in off]
        black = replace(BLACK, sigma=1e-3)
        z.append(scores(find_vignetting(patches, black=black, otherwise=otherwise), truth)[:2])
        alone.append(scores(find_vignetting(patches, black=black), truth)[:2])
    assert stats.chi2.ppf(0.001, len(z)) / len(z) < np.mean(np.square(z)) < 1 + 4 * np.sqrt(2 / len(z))
    assert np.mean(np.square(alone)) > 10 * np.mean(np.square(z))


@pytest.mark.slow
def test_the_twin_s_light_is_found(rig, rng):
    """A rendered board in six poses, in a room of 40 lux; each estimate within 3.5 sigma."""
    rig, lux = lit_boards.drawn(rig, rng), 40.0
    session = lit_boards.shot(rig, 6, room_lux=lux)
    found = find_vignetting(joined([
        measure_whites(image, session.board, session.camera, session.projector, pose, pose=k)
        for k, (image, pose) in enumerate(zip(session.images, session.poses, strict=True))
    ]), black=Estimate(1.65, 0.3, "dark frames"))  # fmt: skip
    optics = rig.projector.optics
    metre_away = rig.projector.radiant_flux_w * np.prod(optics.focal_px) / np.prod(optics.size)  # W/m^2
    truth = rig.cam1.lens.vignetting, rig.projector.lens.vignetting, lux / 542 / metre_away
    assert np.abs(scores(found, truth)).max() < 3.5
