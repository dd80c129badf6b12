"""A rendered calibration session: the circles are where the truth says, and stopping in between changes nothing."""

import hashlib
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from recon.board_detection.detect import detect
from recon.capture import board_part, manifest
from recon.capture.manifest import SCHEMA, Device, Manifest, SweepPart
from recon.errors import InputError
from recon.files import atomic
from recon.geometry import rigid
from recon.geometry.circle_projection import centre_offsets
from recon.model.patterns import CentreLine, Fringes, Patterns
from scenes import board_poses
from scenes.kinds import board
from tests.twin.small_rigs import shrunk
from twin import board_session
from twin.board_session import Settings
from twin.conditions import BoardPrint, Conditions
from twin.optics.light_transport import Tracing, render
from twin.optics.printed_edges import compute_edges
from twin.optics.ray_world import is_convex
from twin.optics.surface_session import Shooting, calibration_of
from twin.sensor import electrons_per_radiance
from twin.session import TWIN, Session

PATTERNS = Patterns(
    projector_size=(1280, 800),
    unwrap="centre_line",
    parts=tuple(part for axis in ("columns", "rows") for part in (CentreLine(axis=axis), Fringes(axis=axis, pitch=18, steps=3))),
)
DESCRIBED = {"seed": 3}


def traced(*scene):
    """The images of `trace_near`, whole : (n, h, w)."""
    return np.stack([*board_session.trace_near(*scene)])


@pytest.fixture(autouse=True, scope="module")
def few_paths():
    """For pixels at the board's sides, which nothing here looks at closely."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(board_session, "SIDE_SAMPLES", 4)
        yield


@pytest.fixture(scope="module")
def settings(rig) -> Settings:
    """Two poses of a small board before cameras of few pixels."""
    small = rig.model_copy(update={"cam1": shrunk(rig.cam1, 4), "cam2": shrunk(rig.cam2, 4)})
    chosen = board_poses.Config(count=2, margin_px=4, seed=6)
    tracing, shooting = Tracing(samples=4, room_lux=20.0), Shooting()
    return Settings(small, board.Config(rows=7), chosen, PATTERNS, ("cam1", "cam2"), tracing, shooting, seed=3)


def run(out: Path, settings: Settings, stop_after: int | None = None) -> list[int]:
    """Render what is missing; returns the numbers of the poses that were."""
    session = Session(out, "board", DESCRIBED)
    missing = board_session.missing_poses(session, settings)[:stop_after]
    placed = board_session.place_all(settings)
    stage = board_session.set_up(settings)
    exposures = board_session.set_exposures(stage, settings)
    for number in missing:
        images = board_session.shoot_pose(stage, settings, exposures, number, placed[number])
        board_session.write_pose(session, number, *images)
    if stop_after is None:
        board_session.finish(session, settings, exposures, placed)
    return missing


def digest(folder: Path) -> dict[str, str]:
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


@pytest.fixture(scope="module")
def session(settings, tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("board")
    run(out, settings)
    return out


def test_the_circles_are_where_the_truth_says(session, settings):
    """Dark discs, weighed by their darkness, against the outlines of the true ones."""
    truth = np.load(session / "truth" / "board.npz")
    read = board_part.read_board(session / "capture")
    turn = np.linspace(0, 2 * np.pi, 256, endpoint=False)
    rim = settings.board.diameter_mm / 2 * np.column_stack([np.cos(turn), np.sin(turn), 0 * turn])
    cameras = calibration_of(settings.rig).cameras
    for k in range(len(read.poses)):
        rims = rigid.apply(truth["world_from_board"][k], truth["points"][:, None] + rim)
        for j, name in enumerate(("cam1", "cam2")):
            image = read.pose(k).lit[name].astype(float)
            error = []
            for outline, centre in zip(cameras[name].project(rims), truth["pixels"][k, :, j], strict=True):
                moments = cv2.moments(np.float32(outline[:, None]))
                middle = np.array([moments["m10"], moments["m01"]]) / moments["m00"]
                assert np.linalg.norm(middle - centre) < 0.1  # the ellipse's middle is not quite the circle's
                error.append(weighed(image, middle) - middle)
            assert np.abs(np.mean(error, axis=0)).max() < 0.02
            assert np.sqrt(np.mean(np.square(error))) < 0.06


def weighed(image, middle) -> np.ndarray:
    """Centre of the darkness in a window about a disc, against the plane of the white around it."""
    u, v = np.rint(middle).astype(int)
    half = 9
    y, x = np.mgrid[v - half : v + half + 1, u - half : u + half + 1]
    patch, distance = image[y, x], np.hypot(x - middle[0], y - middle[1])
    white = distance > 7.5
    columns = np.column_stack([np.ones(x.size), x.ravel() - u, y.ravel() - v])
    plane = columns @ np.linalg.lstsq(columns[white.ravel()], patch[white], rcond=None)[0]
    darkness = np.where(white, 0, 1 - patch / plane.reshape(x.shape))
    return np.array([(darkness * x).sum(), (darkness * y).sum()]) / darkness.sum()


def test_white_is_bright_and_not_saturated(session):
    """One exposure serves all poses."""
    read = board_part.read_board(session / "capture")
    brightest = [image.max() for k in range(len(read.poses)) for image in read.pose(k).lit.values()]
    assert max(brightest) < 255 and min(brightest) > 140


def test_a_stopped_session_goes_on(session, settings, tmp_path):
    """The poses that were there are kept, and the set is the same bytes as one rendered in one go."""
    run(tmp_path, settings, stop_after=1)
    assert not (tmp_path / "capture").exists()
    assert run(tmp_path, settings) == [1]
    assert digest(tmp_path) == digest(session)


def test_other_settings_start_anew(session, settings, tmp_path):
    """Poses of one session never mix with another's."""
    begun, done = Session(tmp_path, "board", DESCRIBED), board_part.read_board(session / "capture").pose(0)
    assert board_session.missing_poses(begun, settings) == [0, 1]
    board_session.write_pose(begun, 0, done.lit, {"cam1": done.fringes})
    assert board_session.missing_poses(begun, settings) == [1]
    assert board_session.missing_poses(Session(tmp_path, "board", {"seed": 4}), settings) == [0, 1]


def test_changed_settings_of_an_unfinished_run_are_named(settings, tmp_path):
    session = Session(tmp_path, "board", DESCRIBED)
    board_session.missing_poses(session, settings)
    (tmp_path / "unfinished" / "settings.json").write_text("{", encoding="utf-8")
    with pytest.raises(
        InputError, match=r"unfinished/settings\.json: expected nothing or a file as the twin wrote it, found it changed"
    ) as refusal:
        board_session.missing_poses(session, settings)
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize("aperture_mm", [0.0, 60.0])
def test_what_is_far_from_the_board_is_the_room(settings, aperture_mm):
    """The image of a tilted board, sharp or far out of focus, as if every pixel were traced."""
    stage = board_session.set_up(settings)
    board_session.move_things(stage.world, stage.things, board_session.place_all(settings)[0])
    light = board_session.with_fully_on(stage.patterns)
    optics = replace(stage.cameras["cam1"], aperture_mm=aperture_mm, focus_mm=400.0)
    near = traced(stage, optics, light, settings.tracing, 5)
    whole = render(stage.world, optics, stage.projector, light, settings.tracing, 5)
    assert near.shape == whole.shape and (whole[-1] < whole[-1].max() / 50).mean() > 0.3
    apart = ~np.isclose(near, whole, rtol=1e-5, atol=0).all(axis=0)
    assert apart.sum() <= 1  # a path that ends on an edge of the mesh may be taken for one in the neighbour's shadow


def test_a_flat_board_throws_no_shadow(settings):
    """Looking for shadows on a convex board changes no bit of an image; a warped board isn't convex."""
    stage = board_session.set_up(settings)
    assert stage.convex
    assert not is_convex(board.things(board.Config(warp_mm=0.1)))
    board_session.move_things(stage.world, stage.things, board_session.place_all(settings)[0])
    light = board_session.fully_on(stage.patterns)
    images = [
        traced(replace(stage, convex=convex), stage.cameras["cam1"], light, settings.tracing, 5) for convex in (True, False)
    ]
    np.testing.assert_array_equal(*images)


def test_a_board_of_life_is_seen_as_it_is_bent_in_its_pose(settings):
    """Discs far from their design, of another shape in each pose, lie where the truth says, to the noise of small discs."""
    errors = BoardPrint(place_mm=0.2, stretch=0.002, diameter_mm=0.1, bow_mm=1.0, flex_mm=0.5)
    lively = replace(settings, cameras=("cam1",), conditions=Conditions(board=errors))
    stage, placed = board_session.set_up(lively), board_session.place_all(lively)
    exposures, truth = board_session.set_exposures(stage, lively), board_session.board_truth(lively, placed)
    design = board.design(lively.board)
    camera = calibration_of(lively.rig).cameras["cam1"]
    number = 1
    lit, _ = board_session.shoot_pose(stage, lively, exposures, number, placed[number])
    found = detect(lit["cam1"], design, full=255.0).pixels
    offsets = centre_offsets(camera, placed[number], board.printed_centres(lively.bent(number)), 4.5)
    off = found - offsets - truth["pixels"][number, :, 0]
    flat = camera.project(rigid.apply(placed[number], design.points()))
    assert np.nanmedian(np.abs(off)) < 0.02 < 0.1 < np.nanmedian(np.abs(found - offsets - flat))
    assert np.abs(board.printed_centres(lively.bent(0)) - board.printed_centres(lively.bent(1))).max() > 0.1


def test_a_board_out_of_sight_leaves_the_room(settings):
    stage = board_session.set_up(settings)
    board_session.move_things(stage.world, stage.things, rigid.transform(np.eye(3), [5000.0, 0.0, 600.0]))
    optics = stage.cameras["cam1"]
    image = traced(stage, optics, board_session.fully_on(stage.patterns), settings.tracing, 5)[0]
    np.testing.assert_allclose(image, optics.transmission * settings.tracing.room_radiance, rtol=1e-6)


def test_a_board_does_not_take_the_place_of_a_film(settings, tmp_path):
    images = {"cam1": "sweep/cam1", "cam2": "sweep/cam2"}
    devices = {name: Device(size=(64, 48)) for name in images}
    with atomic.new_folder(tmp_path / "capture", TWIN) as folder:
        manifest.write_manifest(folder, Manifest(schema=SCHEMA, devices=devices, sweep=SweepPart(images=images)))
    with pytest.raises(InputError, match="capture: expected nothing or an earlier board, found a sweep of cam1 and cam2"):
        board_session.missing_poses(Session(tmp_path, "board", DESCRIBED), settings)


def test_a_surface_alone_is_no_board(session, tmp_path):
    """Though the settings are the same, of which there are none; another part stands in the folder of the truth."""
    assert board_session.is_finished(Session(session, "board", DESCRIBED))
    devices = {"cam1": Device(size=(64, 48)), "projector": Device(size=PATTERNS.projector_size)}
    with Session(tmp_path, "surface", {}).write({"name": "plane"}) as (capture, _):
        capture.add_surface({"cam1": np.zeros((PATTERNS.count, 48, 64), np.uint8)}, PATTERNS, devices)
    assert not board_session.is_finished(Session(tmp_path, "board", {}))


@pytest.mark.slow
def test_rendering_noise_at_edges_is_that_of_the_sensor(rig, settings):
    """In images of full size, pixels at the circles' edges differ between two seeds by about their shot noise, at the nearest.

    There the lens blurs most, and samples of pixel and lens together stratify least; in focus it is half of that.
    """
    full = replace(settings, rig=rig, cameras=("cam1",))
    stage = board_session.set_up(full)
    pose = board_session.closest_pose(full)
    board_session.move_things(stage.world, stage.things, pose)
    optics, light = stage.cameras["cam1"], board_session.fully_on(stage.patterns)
    images = []
    for seed in (1, 2):
        traced = render(stage.world, optics, stage.projector, light, full.tracing, seed)[0]
        image = traced.copy()
        compute_edges(image, optics, stage.print, pose, seed)
        images.append(image)
    time_s = board_session.set_exposures(stage, full)["cam1"].time_s
    electrons = np.array(images) * electrons_per_radiance(rig.cam1, rig.projector.wavelength_nm) * time_s
    window = np.ones((3, 3), np.uint8)
    edge = cv2.dilate(electrons[0], window) - cv2.erode(electrons[0], window) > electrons[0].max() / 2
    edge &= images[1] != traced  # not the board's sides
    noise = (electrons[0] - electrons[1])[edge].std() / np.sqrt(2)
    assert edge.sum() > 10000
    assert noise < 1.5 * np.sqrt(electrons[0][edge].mean())


@pytest.mark.slow
def test_a_glossy_board_glares(settings, monkeypatch):
    """With a coat some pose throws the projector's light into a camera, and a matt one never."""
    monkeypatch.setattr(board_session, "EDGE_SAMPLES", 8)  # nothing here looks at edges
    settings = replace(settings, cameras=("cam2",), poses=settings.poses.model_copy(update={"count": 8}))
    placed = board_session.place_all(settings)
    brightest = {}
    for roughness in (None, 0.1):
        glossy = replace(settings, board=settings.board.model_copy(update={"roughness": roughness}))
        stage = board_session.set_up(glossy)
        exposures = board_session.set_exposures(stage, glossy)
        shots = [board_session.shoot_pose(stage, glossy, exposures, k, pose)[0] for k, pose in enumerate(placed)]
        brightest[roughness] = max(np.percentile(image, 99) for lit in shots for image in lit.values())
    assert brightest[None] < 240
    assert brightest[0.1] == 255


def test_an_old_session_is_replaced(session, settings, tmp_path):
    """By one of a single pose and camera."""
    shutil.copytree(session, tmp_path / "again")
    run(tmp_path / "again", replace(settings, cameras=("cam1",), poses=settings.poses.model_copy(update={"count": 1}), seed=9))
    assert sorted(path.name for path in (tmp_path / "again").iterdir()) == ["capture", "truth"]
    again, old = digest(tmp_path / "again" / "capture"), digest(session / "capture")
    assert set(again) < set(old) and again != {name: old[name] for name in again}
    assert not [name for name in again if name.endswith(".png") and again[name] == old[name]]
