"""A drawn session without errors is the truth; its errors are of the sizes that detectors claim."""

from types import SimpleNamespace

import numpy as np
import pytest

from recon.errors import InputError
from recon.geometry import rigid
from recon.model import circle_layout
from recon.probe_calibration.sound_in_water import speed_of_sound
from twin.conditions import IDEAL, Conditions, Motion
from twin.experiments import drawn_session
from twin.experiments.drawn_session import WATER_C, Drawn, Eye, Noise
from twin.optics.surface_session import calibration_of

OFF = Drawn(**dict.fromkeys(Drawn.model_fields, 0.0))
QUIET = Noise(drawn=OFF)


def eye(rig, times: float = 1.0, sigma_px: float = 0.008) -> Eye:
    """Both cameras, known exactly, and a target as designed."""
    cameras = drawn_session.pair(calibration_of(rig))
    return Eye(cameras, cameras, None, rig.target, rig.target, sigma_px, times)


def scan(rig, count: int = 40):
    """Poses of the image over a mass, the bracket and velocities of a steady hand."""
    images, velocity = drawn_session.led(rig, Noise(scans=count), np.random.default_rng(1))
    return images, drawn_session.bracket(rig, IDEAL, 1.0, count, 0), velocity


def differences(found, truth) -> np.ndarray:
    """Steps : (n, 6) from poses to others, rad and mm."""
    return np.stack([rigid.difference(first, second) for first, second in zip(found, truth, strict=True)])


def true_targets(images, held) -> np.ndarray:
    return np.stack([image @ rigid.invert(at) for image, at in zip(images, held, strict=True)])


def test_a_scan_goes_there_and_back(rig):
    """20 mm at 10 mm/s; the array's face passes the middle, its image points down, and the mean velocity is none."""
    noise = Noise(scans=40)
    poses, velocity = drawn_session.led(rig, noise, np.random.default_rng(3))
    foot = [rig.probe.image_size[0] * rig.probe.scale_mm_per_px[0] / 2, 0, 0]
    faces = np.stack([rigid.apply(pose, foot) for pose in poses])
    assert np.ptp(faces, axis=0) == pytest.approx([0, noise.span_mm, 0], abs=1e-9)
    assert faces.mean(axis=0) == pytest.approx(drawn_session.MIDDLE_MM) and faces[:20] == pytest.approx(faces[:19:-1])
    assert np.linalg.norm(velocity, axis=1) == pytest.approx(noise.speed_mm_s) and velocity.sum(axis=0) == pytest.approx(0)
    assert (np.sign(np.diff(faces[:20, 1])) == np.sign(velocity[:19, 1])).all()
    assert poses[:, 2, 1].min() > 0.85 and all(rigid.fault(pose) is None for pose in poses)


def test_poses_without_noise_are_the_true_ones(rig):
    """To the hundredth of the noise that stays: 0.08 thousandths of a pixel."""
    images, held, velocity = scan(rig)
    found = drawn_session.look(eye(rig, 0.0), images, held, np.zeros((40, 2)), velocity, [1])
    off = differences(found.poses, true_targets(images, held))
    assert np.abs(off[:, :3]).max() < 2e-5 and np.abs(off[:, 3:]).max() < 5e-4


@pytest.mark.slow
def test_poses_err_as_their_covariance_says(rig):
    """Squares of 80 poses' errors by their covariances: 6 in the mean, to 4 standard deviations; half the noise, a quarter.

    Standard deviations that are too small or too large by a sixth are found out.
    """
    images, held, velocity = (np.concatenate([each] * 2) for each in scan(rig))
    mean = []
    for drawn in (1.0, 0.5):
        found = drawn_session.look(eye(rig, drawn), images, held, np.zeros((80, 2)), velocity, [7])
        off = differences(found.poses, true_targets(images, held))
        mean.append(np.einsum("ni,nij,nj->n", off, np.linalg.inv(found.own), off).mean())
    assert mean == pytest.approx([6, 1.5], rel=4 * np.sqrt(2 / 6 / 80))


def test_cameras_that_are_late_see_the_target_farther_on(rig):
    """Both 2 ms late at 10 mm/s: 0.02 mm along its way."""
    images, held, velocity = scan(rig, 8)
    found = drawn_session.look(eye(rig, 0.0), images, held, np.full((8, 2), 2e-3), velocity, [1])
    off = differences(found.poses, true_targets(images, held))
    assert off[:, 3:] == pytest.approx(-2e-3 * velocity, abs=1e-3)  # steps lead from what is found


def test_a_bracket_gives_from_the_first_to_the_last(rig):
    """It is as designed in the middle, and always where conditions are ideal."""
    design = rig.probe.target_from_image.matrix()
    life = Conditions(motion=Motion(bracket_mm=0.5))
    assert (drawn_session.bracket(rig, IDEAL, 1.0, 4, 0) == design).all()
    assert (drawn_session.bracket(rig, life, 0.0, 4, 0) == design).all()
    given = np.stack([differences(drawn_session.bracket(rig, life, 1.0, 5, seed), [design] * 5) for seed in range(600)])
    assert np.abs(given[:, 2]).max() < 1e-9 and np.abs(given[..., :3]).max() < 1e-9
    way = given[:, -1, 3:] - given[:, 0, 3:]
    assert way.std(axis=0) == pytest.approx(0.5, rel=0.12)
    more = differences(drawn_session.bracket(rig, life, 3.0, 5, 7), [design] * 5)
    assert more == pytest.approx(3 * given[7], abs=1e-6)


def test_circles_outside_an_image_are_not_seen(rig):
    """A target that is led 200 mm to the left is found as long as one camera sees all its circles, the other two."""
    images, held, velocity = scan(rig)
    images = np.repeat(images[:1], 40, axis=0)
    images[:, 0, 3] -= np.linspace(0, 200, 40)
    found = drawn_session.look(eye(rig), images, held, np.zeros((40, 2)), velocity, [1])
    within = np.zeros((2, 40, 3), bool)
    for k, camera in enumerate(drawn_session.pair(calibration_of(rig))):
        seen = np.stack([
            camera.project(rigid.apply(target, circle_layout.circle_centres(rig.target))) for target in true_targets(images, held)
        ])  # fmt: skip
        within[k] = ((seen > 0) & (seen < np.array(camera.size) - 1)).all(axis=2)
    enough = within.all(axis=2).any(axis=0) & (within.all(axis=0).sum(axis=1) >= 2)
    assert enough[0] and not enough[-1] and np.array_equal(np.isfinite(found.poses).all(axis=(1, 2)), enough)


@pytest.mark.parametrize("warmer", [0.0, 3.0])
def test_a_probe_without_noise_is_the_true_one_but_for_the_waters_warmth(rig, scanners, warmer):
    """Depths are measured in water of another speed than is taken for it: the scale along depth errs by their ratio."""
    water = float(speed_of_sound(WATER_C + warmer) / speed_of_sound(WATER_C))
    found = drawn_session.calibrated_probe(rig, eye(rig, 0.0), IDEAL, QUIET, water, scanners["water"], 1)
    assert found.scale == pytest.approx(np.array(rig.probe.scale_mm_per_px) * [1, water], rel=1e-4)
    off = rigid.difference(found.target_from_image, rig.probe.target_from_image.matrix())
    assert np.abs(off[3:]).max() < 2e-3 and np.rad2deg(np.abs(off[:3]).max()) < 2e-3


def test_crossings_are_found_with_noise_of_the_size_that_is_drawn(rig, scanners, monkeypatch):
    """Of 300 B-scans; the same ones without it lie in their places, and what is claimed stays. The target is seen exactly."""
    seen = []

    def calibrate(sightings, size):
        seen.append(sightings)
        return SimpleNamespace(calibration=None)

    def look(eye, images, held, *others):
        return drawn_session.Tracked(true_targets(images, held), *np.zeros((2, len(images), 6, 6)))

    monkeypatch.setattr(drawn_session.point_calibration, "calibrate", calibrate)
    monkeypatch.setattr(drawn_session, "look", look)
    for size in (0.0, 1.0, 2.0):
        noise = Noise(wires=300, crossing_px=0.4, drawn=OFF.model_copy(update={"crossing": size}))
        drawn_session.calibrated_probe(rig, eye(rig, 0.0), IDEAL, noise, 1.0, scanners["water"], 2)
    for size in (1, 2):
        assert (seen[size].pixels - seen[0].pixels).std(axis=0) == pytest.approx(0.4 * size, rel=0.15)
        assert np.array_equal(seen[0].pixel_covariance, seen[size].pixel_covariance)
    assert seen[0].pixel_covariance[0, 0, 0] == pytest.approx(0.4**2)


@pytest.fixture(scope="module")
def session(settings):
    """One without any errors."""
    return draw(settings, QUIET, 3)


def draw(settings, noise, seed, life=IDEAL):
    return drawn_session.draw(settings.rig, life, noise, settings.ultrasound, settings.poses, seed)


def test_a_session_without_errors_is_the_truth(settings, session):
    """Devices see the working volume where they truly do, to a thousandth of a pixel; probe and poses are in their places."""
    truth, grid = calibration_of(settings.rig), np.array([[x, y, z] for x in (-50, 50) for y in (-40, 40) for z in (620, 700)])
    for name, camera in truth.cameras.items():
        assert session.optics.cameras[name].project(grid) == pytest.approx(camera.project(grid), abs=3e-3)
        assert session.used.cameras[name].project(grid) == pytest.approx(camera.project(grid), abs=1e-9)
    assert session.latency_s == 0 and session.true_probe.scale == pytest.approx(settings.rig.probe.scale_mm_per_px)
    held = settings.rig.probe.target_from_image.matrix()
    off = differences(session.tracked.poses, session.true_poses @ rigid.invert(held))
    assert np.abs(off[:, 3:]).max() < 0.005


@pytest.mark.parametrize("source", ["bracket", "circle"])
@pytest.mark.parametrize("where", ["at_wires", "in_scan"])
def test_sources_over_the_wires_and_in_the_scan_are_apart(settings, session, monkeypatch, source, where):
    """One that is on over the wires moves the probe's calibration, and no pose of the scan; and the other way round."""
    monkeypatch.setattr(drawn_session, "calibrated_optics", lambda *_: session.optics)
    noise = QUIET.model_copy(update={"drawn": OFF.model_copy(update={f"{source}_{where}": 1.0})})
    found = draw(settings, noise, 3, Conditions(motion=Motion(bracket_mm=0.5)))
    probe = np.abs(rigid.difference(found.probe.target_from_image, session.probe.target_from_image)).max()
    poses = np.abs(differences(found.tracked.poses, session.tracked.poses)).max()
    moved, still = (probe, poses) if where == "at_wires" else (poses, probe)
    assert moved > 1e-3 and still < 1e-6


@pytest.mark.slow
def test_a_session_is_that_of_its_seed(settings, session):
    again, other = draw(settings, QUIET, 3), draw(settings, Noise(), 4)
    assert again.tracked.poses == pytest.approx(session.tracked.poses, rel=1e-6, abs=1e-6)
    assert again.probe.target_from_image == pytest.approx(session.probe.target_from_image, rel=1e-6, abs=1e-6)
    assert not np.array_equal(other.true_poses, session.true_poses) and other.latency_s != 0


def test_a_target_that_is_lost_over_the_scan_is_refused(settings):
    """So fast that both views' rays miss each other by centimetres."""
    life, fast = Conditions(motion=Motion(trigger_s=1e-3)), QUIET.model_copy(update={"speed_mm_s": 2e4})
    with pytest.raises(InputError, match="target: expected to be seen in all 40 poses of the scan, found it lost in some"):
        draw(settings, fast, 3, life)


@pytest.mark.parametrize("field", ["board_px", "circle_px", "latency_s"])
def test_noise_is_claimed_to_be_some(field):
    """A detector that claims none would weigh without end; what is drawn may be zero, and not less."""
    with pytest.raises(ValueError, match=field):
        Noise(**{field: 0.0})
    with pytest.raises(ValueError, match="board"):
        Drawn(board=-1.0)


@pytest.mark.parametrize("scans", [6, 9, 41])
def test_a_scan_goes_there_and_back_alike(scans):
    """Half of its B-scans each way, and enough of them."""
    with pytest.raises(ValueError, match="scans"):
        Noise(scans=scans)
    assert Noise(scans=8).scans == 8
