"""A film's motion is that of its path, its light is one light, and what is written is what was made."""

import itertools
import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from recon.capture import stereo_frames
from recon.capture.manifest import CAMERAS
from recon.geometry import rigid
from recon.tracking.tracker import Tracker
from sonotwin.cli import main
from sonotwin.config import load
from sonotwin.verbs.film import Config, ranges
from tests.twin.tracking import takes
from twin.conditions import Motion
from twin.evaluation import track_errors
from twin.session import Session
from twin.tracking import film_session
from twin.tracking.mesh_bank import uncovered, uncovered_share
from twin.tracking.rendered_views import Frames, white_radiance
from twin.tracking.target_truth import view_truth


@pytest.fixture(scope="module")
def config() -> Config:
    return load("film", ["out=unused", "frames=24"], Config)


@pytest.fixture(scope="module")
def bank(config):
    return film_session.make_bank(config.rig, ranges(), config, config.seed)


@pytest.fixture(scope="module")
def made(config, bank):
    return film_session.takes(bank, config.rig, ranges(), config, config.seed)


@pytest.fixture(scope="module")
def way(config):
    return config.path.lead(config.rig.target, np.array([80.0, 0.0, 0.0]), 5)


@pytest.mark.parametrize("seconds", [0.0, 0.31, 0.77])
def test_the_velocity_is_the_paths_derivative(way, seconds):
    """Of the origin and of the rotation, by central differences, to their own error of 1e-4 of it."""
    step = 1e-3
    before, after = way.pose(seconds - step), way.pose(seconds + step)
    speed, spin = way.velocity(seconds)
    assert speed == pytest.approx((after - before)[:3, 3] / (2 * step), rel=1e-3, abs=0.05)
    assert spin == pytest.approx(Rotation.from_matrix(after[:3, :3] @ before[:3, :3].T).as_rotvec() / (2 * step), abs=2e-3)


def test_a_round_is_closed_and_smooth(way, config):
    assert way.pose(0.0) == pytest.approx(way.pose(config.path.seconds), abs=1e-9)
    for early, late in zip(way.velocity(0.0), way.velocity(config.path.seconds), strict=True):
        assert early == pytest.approx(late, abs=1e-9)


def test_over_an_exposure_the_target_moves_as_the_path(way):
    """Evenly, so it differs from the path by the third derivative alone: a hundredth of a mm at 10 ms."""
    motion = way.motion(0.5, 0.01)
    for part in (-0.5, 0.5):
        apart = motion.at(part)[:3, 3] - way.pose(0.5 + 0.01 * part)[:3, 3]
        assert np.linalg.norm(apart) < 0.03 and np.linalg.norm(motion.shift_mm) > 1


def test_a_trembling_hand_moves_as_fast_as_it_says(config):
    """The path's own speed and turn, and the tremor's, are the slopes of its poses."""
    eyes, shaky = np.array([50.0, 0, 0]), Motion(tremor_mm=0.2, tremor_deg=0.3)
    calm, trembling = (config.path.lead(config.rig.target, eyes, 3, errors) for errors in (Motion(), shaky))
    step = 1e-5
    for time in (0.1, 0.5, 0.93):
        before, after = trembling.pose(time - step), trembling.pose(time + step)
        slope = rigid.difference(before, after) / (2 * step)
        speed, spin = trembling.velocity(time)
        np.testing.assert_allclose(slope, [*spin, *speed], rtol=1e-3, atol=1e-3)
    apart = [rigid.difference(calm.pose(t), trembling.pose(t)) for t in np.linspace(0, 1, 200)]
    assert np.rad2deg(np.std(apart, axis=0)[:3]) == pytest.approx(np.full(3, 0.3), rel=0.4)


def test_frames_lie_on_the_path(made, config):
    """From one frame's motion to the next frame's pose: what is left over is the acceleration's."""
    poses = np.array([take.motion.world_from_target for take in made])
    speed = np.array([take.motion.shift_mm for take in made]) / config.exposure_s
    expected = (speed[1:] + speed[:-1]) / 2 / config.camera_hz
    assert np.abs(np.diff(poses[:, :3, 3], axis=0) - expected).max() < 0.15
    assert [take.k for take in made] == list(range(24)) and len({take.noise_seed for take in made}) == 24


def test_the_default_film_has_what_a_tracker_fails_at(made, config):
    """Slow and fast stretches, and one where camera 1 misses a circle that camera 2 sees whole."""
    views = [[view_truth(take, device, 0.0, config.rig.target) for device in take.cameras] for take in made]
    blur = np.array([[view.blur_px.max() for view in both] for both in views]).max(axis=1)
    inside = np.array([[view.inside.all() for view in both] for both in views])
    assert blur[0] < 4 and 9 < blur.max() < 14
    assert (inside[:, 1] & ~inside[:, 0]).sum() >= 4 and inside.all(axis=1).sum() >= 12


def test_there_is_one_light_and_one_exposure(made, config):
    """What a radiance of one comes to is the same in all frames; the target's white is as dark as asked for."""
    gains = [take.white_dn / white_radiance(take, config.rig) for take in made]
    assert gains == pytest.approx([gains[0]] * 24)
    whites = np.array([take.white_dn for take in made])
    assert whites.mean() == pytest.approx(65) and whites.std() > 0.5
    assert all(take.lighting is made[0].lighting and take.body == made[0].body for take in made)
    assert (made[0].scene_from_world == made[5].scene_from_world).all()


def test_fingers_leave_the_circles_free(bank, made, config):
    """Eyes in front see the body that was chosen best; eyes behind the board see nothing through it."""
    target = config.rig.target
    front, behind = np.array([[0, 0, 600.0], [150, 0, 600]]), np.array([[10.0, 15, -600]])
    seen = [uncovered(bank, body, target, front) for body in range(film_session.BODIES)]
    assert seen[made[0].body] == max(seen) == 1.0
    assert uncovered(bank, 0, target, behind) == 0


def blanks(made, size=(1280, 1024)):
    """Frames of a film that nobody rendered, one by one."""
    for take in made:
        first, second = (view_truth(take, device, 0.0, takes.rig().target) for device in take.cameras)
        image = np.full(size[::-1], take.k, np.uint8)
        yield Frames((image, image), (first, second))


def test_what_is_written_is_what_was_made(config, made, tmp_path):
    few = config.model_copy(update={"frames": 3})
    session = Session(tmp_path, "sweep", {"seed": 0}, devices=CAMERAS)
    film_session.write_session(session, config.rig, config.rig, few, made[:3], blanks(made[:3]))
    read = stereo_frames.read_film(tmp_path / "capture")
    assert read.times.tolist() == [0, 33_333_333, 66_666_667]
    assert [int(left[0, 0]) for left, _ in read.pairs()] == [0, 1, 2]
    truth = track_errors.read_truth(tmp_path / "truth")
    assert (truth.poses == [take.motion.world_from_target for take in made[:3]]).all()
    assert truth.times.tolist() == read.times.tolist() and truth.inside.shape == (3, 2, 3)
    assert json.loads((tmp_path / "truth" / "settings.json").read_text()) == {"seed": 0}


def test_frames_are_rendered_as_they_are_asked_for(made, bank, config, monkeypatch):
    asked = []
    monkeypatch.setattr(film_session, "render_film", lambda bank, rig, batch, *_: asked.append(len(batch)) or list(blanks(batch)))
    frames = film_session.shoot(bank, config.rig, made, config.quality, 0)
    assert not asked
    next(frames)
    assert asked == [film_session.BATCH]
    assert sum(1 for _ in frames) == 23 and sum(asked) == 24


def test_what_is_wrong_is_said_in_one_line(tmp_path, capsys):
    def complaint(*fields: str) -> str:
        assert main(["film", f"out={tmp_path / 'film'}", *fields]) == 2
        (line,) = capsys.readouterr().err.splitlines()
        return line.removeprefix("sonotwin: ")

    assert complaint("exposure_s=0.05").startswith("film: exposure_s: expected at most 1 / camera_hz = 0.03333, found 0.05")
    assert complaint("frames=0").startswith("film: frames: expected")
    assert complaint("path.places_mm=[[0,0,650]]").startswith("film: path.places_mm: expected")
    (tmp_path / "film" / "capture").mkdir(parents=True)
    (tmp_path / "film" / "capture" / "thesis.tex").write_text("")
    assert "found other files" in complaint()


@pytest.mark.slow
def test_a_rendered_film_is_tracked(tmp_path, config):
    """Three slow frames, by a tracker as `track` makes it, started beside the first: off by less than 4 sigma, and 0.2 mm."""
    assert main(["film", f"out={tmp_path / 'film'}", "frames=3"]) == 0
    read = stereo_frames.read_film(tmp_path / "film" / "capture")
    truth = track_errors.read_truth(tmp_path / "film" / "truth")
    assert track_errors.visible_whole(truth).all()
    tracker = Tracker(read.cameras, config.rig.target, optics=read.optics)
    tracker.remember(rigid.transform(truth.poses[0][:3, :3], truth.poses[0][:3, 3] + [0.3, 0, 0]), -0.03)
    for (left, right), time, true in itertools.islice(zip(read.pairs(), read.times, truth.poses, strict=True), 3):
        found = tracker.step(left, right, time * 1e-9)
        assert found.found, found.pose.reason
        error = np.linalg.norm(found.pose.world_from_target[:3, 3] - true[:3, 3])
        assert error < min(4 * np.sqrt(np.trace(found.pose.covariance[3:, 3:])), 0.2)


@pytest.fixture(scope="module")
def three():
    """Config, bank and takes of a film of a rig with a needle and a patient."""
    config = load("film", ["rig=three_bodies", "out=unused", "frames=24"], Config)
    bank = film_session.make_bank(config.rig, ranges(), config, config.seed)
    return config, bank, film_session.takes(bank, config.rig, ranges(), config, config.seed)


def test_three_bodies_stand_side_by_side(three):
    """Most pairs show all circles of all bodies, none behind another body, hand or cable; only the probe leaves the view."""
    config, bank, made = three
    eyes = np.array([device.optics.camera().centre for device in made[0].cameras])
    free = [uncovered_share(bank, take, config.rig.targets, eyes) for take in made]
    inside = np.array([
        [view_truth(held, device, 0.0, config.rig.targets[name]).inside.all() for device in take.cameras]
        for take in made for name, held in take.held.items()
    ]).reshape(len(made), 3, 2)  # fmt: skip
    assert np.mean(np.array(free) > 0.999) > 0.8 and inside[:, 1:].all() and inside.all(axis=(1, 2)).mean() > 0.5


def test_the_patient_breathes_and_the_needle_is_held(three):
    """By millimetres on a post, by a hand's own sway and turns in a hand."""
    _, _, made = three
    moves = {}
    for name in ("needle", "patient"):
        poses = np.array([take.others[name].motion.world_from_target for take in made])
        moves[name] = np.ptp(poses[:, :3, 3], axis=0).max()
        turns = [rigid.difference(poses[0], pose)[:3] for pose in poses]
        assert (np.abs(turns).max() > 0.01) == (name == "needle")
    assert 0.2 < moves["patient"] < 2 < 6 < moves["needle"]


def test_the_probe_is_the_one_of_a_film_without_others(three, made):
    """Its path and its print are the same; light may come from farther off."""
    for take, alone in zip(three[2], made, strict=True):
        assert (take.motion.world_from_target == alone.motion.world_from_target).all()
        assert take.face.paper == alone.face.paper


def test_truth_of_further_bodies_is_read_by_name(three, tmp_path):
    config, _, made = three
    few = config.model_copy(update={"frames": 2})
    session = Session(tmp_path, "sweep", {"seed": 0}, devices=CAMERAS)

    def blank(take):
        views = {
            name: tuple(view_truth(held, device, 0.0, config.rig.targets[name]) for device in take.cameras)
            for name, held in take.held.items()
        }
        image = np.zeros((1024, 1280), np.uint8)
        return Frames((image, image), views.pop("probe"), others=views)

    film_session.write_session(session, config.rig, config.rig, few, made[:2], map(blank, made[:2]))
    for name in config.rig.targets:
        truth = track_errors.read_truth(tmp_path / "truth", body=name)
        assert (truth.poses == [take.held[name].motion.world_from_target for take in made[:2]]).all()
    with np.load(tmp_path / "truth/sweep/bodies/needle.npz") as needle:
        assert needle["tip_mm"] == pytest.approx(config.look("needle").tip_mm(config.rig.bodies["needle"]))


def test_two_bodies_of_one_design_make_a_film():
    """As a rig has them that says so: a second target like the probe's, a board on a post."""
    rig = takes.rig().model_dump()
    rig["bodies"] = {"double": rig["target"] | {"unusual": True}}
    config = load("film", ["out=unused", "frames=2"], Config)
    config = Config.model_validate(config.model_dump() | {"rig": rig})
    bank = film_session.make_bank(config.rig, ranges(), config, 1)
    made = film_session.takes(bank, config.rig, ranges(), config, 1)
    assert list(made[0].held) == ["probe", "double"] and config.look("double").kind == "board"


def test_what_is_wrong_with_bodies_is_said_in_one_line(tmp_path, capsys):
    def complaint(*fields: str) -> str:
        assert main(["film", f"out={tmp_path / 'film'}", *fields]) == 2
        (line,) = capsys.readouterr().err.splitlines()
        return line.removeprefix("sonotwin: ")

    told = complaint("bodies.needle={look: {kind: needle}}")
    assert "bodies: expected names of the rig's further bodies (none, such as rig=three_bodies has), found needle" in told
    told = complaint("rig=three_bodies", "bodies.needle.look={kind: needle, gauge: 24}")
    assert "bodies.needle.look" in told and "gauge" in told and "expected one of 14" in told
    near = "bodies.patient={path: {places_mm: [[0,0,50],[1,0,50],[0,1,50]]}}"
    assert complaint("rig=three_bodies", near).startswith("bodies.patient.path: expected places at least 100 mm")
    assert not (tmp_path / "film").exists()
