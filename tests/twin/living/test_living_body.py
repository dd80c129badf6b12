"""A body that lives: its motion in time, and where light and sound show its points."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from pydantic import ValidationError

from recon.errors import InputError
from recon.geometry import rigid
from recon.model.tracks import Track
from recon.optical_calibration.figures_of_merit import triangulated
from scenes.catalogue import build_scene
from scenes.scene_types import Material, Scene, Thing
from scenes.tissue import Tissue
from twin.displacement import displacement, moved_to, rested_at
from twin.filmed_sweep import SweepSettings, plan_sweep
from twin.living import elastic_body
from twin.living import living_body as living_body_module
from twin.living.living_body import Living, LivingBody, LivingSweep, breath, living_body, moved_scene, pulse, scenes_at
from twin.optics.instruments import CameraOptics, ProjectorOptics
from twin.optics.light_transport import Tracing, render_pixels
from twin.optics.raster import Light
from twin.optics.ray_world import build_world, reshape_things
from twin.ultrasound.bscan import scan, scans
from twin.ultrasound.bscan_truth import sections
from twin.ultrasound.echo_solids import body
from twin.ultrasound.probe_path import Hand, Hold, SurfacePath, resting
from twin.ultrasound.sweep_session import surface_of
from twin.ultrasound.transducer import Transducer

QUIET = {"noise_db": -200.0, "face_ring_mm": 0.0, "reverberations": 0, "tgc_db_per_cm_mhz": 0.0}
CALM = Hand(shift_mm=0, turn_deg=0)
HALF = 26  # px, of a window about a mark


@pytest.fixture(scope="module")
def phantom():
    return body(build_scene({"kind": "breast"}))


@pytest.fixture(scope="module")
def array():
    return Transducer(**QUIET)


def over(phantom, array, place_mm=(4.0, -20.0), standoff_mm=0.0):
    held = Hold(place_mm=place_mm, hand=CALM, standoff_mm=standoff_mm)
    return resting(held, surface_of("breast", phantom), array, 1).poses[0]


def test_a_breath_goes_from_expiration_to_inspiration_and_back():
    depth = breath(np.linspace(0, 4, 401), 4.0, 0.0)
    assert (depth[0], depth[200], depth[400]) == pytest.approx((0, 1, 0), abs=1e-9)
    assert (depth[1:101] > depth[:100]).all()
    assert np.mean(depth < 0.5) > 0.6  # it stays longest where it is breathed out
    np.testing.assert_allclose(breath(np.array([5.3]), 4.0, 0.2), breath(np.array([1.3]), 4.0, 0.2), atol=1e-12)


def test_a_beat_is_a_hump_and_a_rest():
    out = pulse(np.linspace(0, 0.9, 901), 0.9, 0.0)
    assert out.max() == pytest.approx(1, abs=1e-3)
    assert np.mean(out == 0) > 0.7


def test_the_chest_rises_by_as_much_as_a_breath_is_deep(phantom):
    patient = LivingBody(Living(breathing_mm=3.0, breathing_s=4.0), phantom, surface_of("breast", phantom), (0.0, 0.0))
    found = patient.world_from_body(np.array([0, 2_000_000_000]))
    np.testing.assert_allclose(found[0], np.eye(4), atol=1e-12)
    np.testing.assert_allclose(found[1][:3, 3], [0, 0, -3.0], atol=1e-9)
    assert patient.world_from_body(np.array([2_000_000_000]), share=0.5)[0, 2, 3] == pytest.approx(-1.5)


def test_a_patient_shifts_once(phantom):
    living = Living(shift_mm=(2.0, 0.0, 1.0), turn_deg=(0.0, 3.0, 0.0), shift_at_s=1.0)
    before, after, later = LivingBody(living, phantom, surface_of("breast", phantom), (0.0, 0.0)).world_from_body(
        np.array([0, 2_100_000_000, 9_000_000_000])
    )
    np.testing.assert_allclose(before, np.eye(4), atol=1e-12)
    np.testing.assert_allclose(after, later, atol=1e-12)
    middle = surface_of("breast", phantom).mesh.bounds.mean(axis=0)
    np.testing.assert_allclose(rigid.apply(after, middle) - middle, [2, 0, 1], atol=1e-9)


def test_a_body_that_only_breathes_looks_alike_to_a_probe_that_goes_along(phantom, array):
    """Where it goes along wholly, its poses in the body are those that it was led by."""
    patient = LivingBody(Living(breathing_mm=5.0, breathing_deg=2.0), phantom, surface_of("breast", phantom), (0.3, 0.0))
    times, poses = np.array([0, 700_000_000]), np.stack([over(phantom, array), over(phantom, array, (10.0, 5.0))])
    world = patient.world_from_body(times) @ poses
    swept = LivingSweep(patient, array, Track(times, world))
    np.testing.assert_allclose(swept.body_from_image(times, world), poses, atol=1e-9)


def test_speckle_moves_with_the_tissue(phantom, array):
    """A body shifted as a whole looks as from the place that is as far the other way."""
    pose, shift = over(phantom, array), np.array([0.7, -1.3, 0.4])
    field = displacement(np.array([-90.0, -80.0, 630.0]), 5.0, np.full((40, 34, 18, 3), shift, np.float32))
    back = pose.copy()
    back[:3, 3] -= shift
    there, expected = (
        one.image.astype(int) for one in (scan(phantom.displaced(field), array, pose, 3), scan(phantom, array, back, 3))
    )
    assert np.mean(np.abs(there - expected) > 2) < 0.002
    assert np.mean(scan(phantom, array, pose, 3).image.astype(int) != expected) > 0.5


def ball_in_a_block(radius=1.5, depth=16.0):
    """A hard ball in a soft block without echoes, which sound crosses as fast as the scanner assumes."""
    clear = Tissue(1.5, 1540.0, 0.0, None, soft=True, modulus_kpa=10.0)
    block = trimesh.creation.box((90.0, 70.0, 40.0))
    block.apply_translation([0, 0, 670.0])
    ball = trimesh.creation.icosphere(4, radius)
    ball.apply_translation([3.0, 0.2, 650.0 + depth])
    hard = replace(clear, impedance=6.0, attenuation=300.0, modulus_kpa=30.0)  # no echo from behind
    things = (
        Thing("breast", block, Material(0.4), tissue=clear),
        Thing("tumour0", ball, Material(0.4), inside=True, tissue=hard),
    )
    return body(Scene("breast", things))


def brightest(envelope, scale):
    """Place of the brightest echo between skin and bottom : (2,) mm, by parabolas about its sample."""
    sx, sy = scale
    rows = envelope.copy()
    rows[: int(6 / sy)] = rows[int(30 / sy) :] = 0
    row, line = np.unravel_index(rows.argmax(), rows.shape)

    def top(before, here, after):
        return (before - after) / (2 * (before - 2 * here + after))

    aside = top(*np.log(rows[row, line - 1 : line + 2].astype(float)))
    deeper = top(*np.log(rows[row - 1 : row + 2, line].astype(float)))
    return np.array([(line + aside) * sx, (row + deeper) * sy])


def test_sound_shows_a_ball_where_the_tissue_has_carried_it(array):
    """By the shift of its echo between rest and pressure, which takes what the pulse adds to a depth out: to 0.05 mm."""
    there = ball_in_a_block()
    soft = elastic_body.elastic_body(there, there.solids[0], None, 4.0)
    down = rigid.transform([[1, 0, 0], [0, 0, -1], [0, 1, 0]], (0.0, 0.0, 650.0))
    pose = down @ rigid.transform(np.eye(3), (-array.face_mm[0], 0.0, 0.0))
    x, y = np.meshgrid(np.linspace(-20, 20, 13), np.linspace(-6, 6, 5), indexing="ij")
    field = elastic_body.press(soft, np.stack([x, y, 652.5 - y**2 / 40], axis=-1).reshape(-1, 3), np.array([0.0, 0.0, 1.0]))
    pose_pressed = pose.copy()
    pose_pressed[2, 3] += 2.5
    seen = [
        rigid.apply(at, [*brightest(scan(one, array, at, 1).envelope, array.scale_mm_per_px), 0.0])
        for one, at in ((there, pose), (there.displaced(field), pose_pressed))
    ]
    ball = there.solids[1].mesh
    tops = [mesh[mesh[:, 2].argmin()] for mesh in (ball.vertices, moved_to(field, np.asarray(ball.vertices)))]
    found, truth = seen[1] - seen[0], tops[1] - tops[0]
    assert np.linalg.norm(truth) > 0.5
    assert np.abs(found[[0, 2]] - truth[[0, 2]]).max() < 0.05


@pytest.mark.slow
def test_light_shows_marks_where_the_skin_has_carried_them(rig):
    """Dark marks on the skin, seen by both cameras at rest and at a moment of breath and beat: shifts to 0.01 mm."""
    scene = build_scene({"kind": "breast"})
    skin = scene.things[0]
    vertices = np.asarray(skin.mesh.vertices)
    marks = [
        int(np.linalg.norm(vertices[:, :2] - place, axis=1).argmin()) for place in ([-30.0, -20.0], [35.0, 15.0], [-20.0, 30.0])
    ]
    off = np.min([np.linalg.norm(vertices - vertices[mark], axis=1) for mark in marks], axis=0)
    albedo = np.float32(0.6 - 0.5 * np.exp(-((off / 2.0) ** 4)))
    scene = replace(scene, things=(replace(skin, albedo=albedo, material=Material(0.5)), *scene.things[1:]))
    living = Living(breathing_mm=4.0, breathing_deg=1.0, heartbeat_mm=1.0, heartbeat_s=0.9)
    patient = LivingBody(living, body(scene), surface_of("breast", body(scene)), (0.2, 0.1))
    time = np.array([50_000_000])
    moment = scenes_at(scene, patient, time)[0]
    assert patient.beaten(50_000_000) is not None
    cameras = [getattr(rig, name) for name in ("cam1", "cam2")]
    width, height = rig.projector.optics.size
    light = Light((width, height), ("columns",), (np.ones(width, np.float32),), 0.0)
    world, optics, found = build_world(scene), [CameraOptics.of(device) for device in cameras], []
    for there in (scene, moment):
        reshape_things(world, there)
        pixels = []
        for its in optics:
            near = np.rint(its.camera.project(there.things[0].mesh.vertices[marks])).astype(int)
            image = np.zeros(its.camera.size[::-1], np.float32)
            windows = np.concatenate([_window(image, place).ravel() for place in near]).astype(np.uint32)
            values = render_pixels(
                world, its, ProjectorOptics.of(rig.projector), light, Tracing(samples=16), 3, np.unique(windows)
            )
            image.ravel()[np.unique(windows)] = values[0]
            pixels.append(np.array([_dark_spot(image, place) for place in near]))
        found.append(triangulated([one.optics.camera() for one in cameras], pixels, np.array([vertices[mark] for mark in marks])))
    truth = moment.things[0].mesh.vertices[marks] - vertices[marks]
    assert np.linalg.norm(truth, axis=1).min() > 1.0
    assert np.linalg.norm(found[1] - found[0] - truth, axis=1).max() < 0.01


def _window(image, near):
    """Numbers of the pixels about a place."""
    rows, columns = np.mgrid[-HALF : HALF + 1, -HALF : HALF + 1]
    return (rows + near[1]) * image.shape[1] + columns + near[0]


def _dark_spot(image, near):
    """Centroid of a dark spot about a pixel, on bright skin whose shading is quadratic."""
    u, v = near
    window = image.ravel()[_window(image, near)].astype(float)
    rows, columns = np.mgrid[-HALF : HALF + 1, -HALF : HALF + 1]
    design = np.stack([np.ones_like(rows), rows, columns, rows**2, columns**2, rows * columns], axis=-1)
    around = np.hypot(rows, columns) > 20
    shading = design @ np.linalg.lstsq(design[around], window[around], rcond=None)[0]
    dark = np.clip(0.9 * shading - window, 0, None)
    return np.array([(dark * columns).sum() / dark.sum() + u, (dark * rows).sum() / dark.sum() + v])


def test_sections_are_those_of_the_displaced_body(phantom, array):
    pose = over(phantom, array, (-10.0, -8.0))
    field = displacement(np.array([-90.0, -80.0, 630.0]), 5.0, np.full((40, 34, 18, 3), [0.0, 0.0, 1.5], np.float32))
    rest, moved = sections(phantom, pose), sections(phantom.displaced(field), pose)
    deeper = [np.concatenate(moved["tumour0"])[:, 1].min() - np.concatenate(rest["tumour0"])[:, 1].min()]
    assert deeper[0] == pytest.approx(1.5 * abs(pose[2, 1]), abs=0.3)


def settings(rig, **changed):
    chosen = {
        "rig": rig,
        "scene": {"kind": "breast"},
        "ultrasound": Transducer(),
        "path": SurfacePath(start_mm=(4.0, -20.0), end_mm=(4.0, -10.0), standoff_mm=-2.0, hand=CALM),
    }
    return SweepSettings(**(chosen | changed))


@pytest.fixture(scope="module")
def pressed_sweep(rig):
    living = Living(yields=True, breathing_mm=3.0, heartbeat_mm=0.3, drag_mm=1.0, breathing_s=2.0, element_mm=5.0)
    return plan_sweep(settings(rig, living=living, clocks={"scanner_hz": 4.0}))


@pytest.mark.slow
def test_truth_says_where_points_rest_and_are(pressed_sweep):
    truth, times = pressed_sweep.truth(), pressed_sweep.plan.truth.times
    count = len(times)
    assert truth["rested_mm"].shape == (count, 51, 41, 3)
    assert truth["centres_mm"].shape == (count, 3, 3)
    field, pose = pressed_sweep.field(1), pressed_sweep.body_from_image[1]
    pixel = rigid.apply(pose, [8 * 0.1229 * 20, 8 * 0.1225 * 25, 0.0])
    np.testing.assert_allclose(truth["rested_mm"][1, 25, 20], rested_at(field, pixel), atol=1e-3)
    assert truth["names"].tolist() == ["tumour0", "tumour1", "tumour2"]
    rest = pressed_sweep.living.patient.body.solids
    inner = next(one.mesh for one in rest if one.name == "tumour0")
    assert truth["resting_centres_mm"][0] == pytest.approx(inner.center_mass)
    carried = rigid.apply(truth["world_from_body"][1], moved_to(field, inner.center_mass))
    assert truth["centres_mm"][1, 0] == pytest.approx(carried, abs=0.05)
    risen = truth["world_from_body"][:, 2, 3]
    assert risen.min() >= -3.0 - 1e-9
    assert np.ptp(risen) > 1.0


@pytest.mark.slow
def test_each_field_is_worked_out_once(rig, monkeypatch):
    """Truth of images that were taken is that of none taken yet."""
    living = Living(yields=True, breathing_mm=3.0, heartbeat_mm=0.3, drag_mm=1.0, element_mm=8.0)
    planned = plan_sweep(settings(rig, living=living, clocks={"scanner_hz": 4.0}))
    expected = planned.truth()
    pressed, press = [], elastic_body.press
    monkeypatch.setattr(elastic_body, "press", lambda *given: pressed.append(1) or press(*given))
    taken = replace(planned, living=replace(planned.living))
    assert len(list(taken.scans())) > 2
    found = taken.truth()
    assert len(pressed) == len(planned.plan.truth.times)
    assert found.keys() == expected.keys()
    assert all((found[name] == expected[name]).all() for name in expected)


@pytest.mark.slow
def test_a_yielding_body_is_never_in_the_probe(pressed_sweep):
    """The face stands 2 mm in the resting skin, and labels begin with the skin or gel, not within."""
    field, pose = pressed_sweep.field(1), pressed_sweep.body_from_image[1]
    face = rigid.apply(pose, np.column_stack([np.linspace(2, 37, 15), np.full(15, 0.3), np.zeros(15)]))
    depths = surface_of("breast", pressed_sweep.scanned).distances(rested_at(field, face))
    assert -0.6 < depths.min() < 0.05
    assert surface_of("breast", pressed_sweep.scanned).distances(face).min() < -1.5


@pytest.mark.slow
def test_scans_of_a_living_body_have_the_same_bytes_again(pressed_sweep):
    first, again = ([one.image for one in pressed_sweep.scans()] for _ in range(2))
    assert all((a == b).all() for a, b in zip(first, again, strict=True))


def test_a_phantom_at_rest_is_scanned_as_ever(rig, phantom, array):
    still = plan_sweep(settings(rig))
    assert still.living is None
    found = next(iter(scans(phantom, array, still.plan.truth.poses[:1], 1)))
    assert (found.image == scan(phantom, array, still.plan.truth.poses[0], 1).image).all()


def test_what_lives_needs_a_path_over_a_surface(rig):
    with pytest.raises(ValidationError, match=r"living: expected a path over a surface, such as stroke, found bob"):
        settings(rig, path={"kind": "bob"}, living=Living(breathing_mm=1.0))


def test_hard_supports_stay(phantom):
    scene = build_scene({"kind": "breast"})
    patient = living_body(Living(breathing_mm=4.0), phantom, "", 3)
    lifted = rigid.transform(np.eye(3), (0.0, 0.0, -4.0))
    moved = moved_scene(scene, patient, lifted, patient.field(0))
    for before, after in zip(scene.things, moved.things, strict=True):
        rise = before.mesh.vertices[0, 2] - after.mesh.vertices[0, 2]
        assert rise == pytest.approx(0 if before.name == "table" else 4)


@pytest.mark.parametrize("y", [-45.0, -35.0, 0.0, 45.0])
def test_a_foot_is_as_deep_in_a_slope_as_it_was_led(phantom, array, y):
    """Down to slopes of 50 degrees, to what is rounded off the foot and lost between elements."""
    patient = LivingBody(Living(yields=True, element_mm=4.0), phantom, surface_of("breast", phantom), (0.0, 0.0))
    face, normal = living_body_module._foot(array, over(phantom, array, (4.0, y), standoff_mm=-2.0))
    depth = elastic_body._under(patient.soft, face, normal).depth
    assert 1.0 < depth.max() < 2.5


def test_a_light_touch_draws_little_skin_along(phantom, array):
    patient = LivingBody(Living(yields=True, element_mm=5.0), phantom, surface_of("breast", phantom), (0.0, 0.0))
    face, normal = living_body_module._foot(array, over(phantom, array, standoff_mm=-0.1))
    across = np.cross(normal, [1.0, 0.0, 0.0])
    drawn = elastic_body.press(patient.soft, face, normal, drag=5.0 * across)
    assert np.linalg.norm(drawn.moved, axis=-1).max() < 0.5


def test_hard_things_do_not_yield():
    hard = body(build_scene({"kind": "sphere"}))
    with pytest.raises(InputError, match=r"living\.yields: expected a surface of soft tissue"):
        living_body(Living(yields=True), hard, "sphere", 1)


def test_a_probe_that_stays_is_not_breathed_into(rig):
    with pytest.raises(InputError, match="expected the probe no more than 5 mm deep in a thing"):
        plan_sweep(settings(rig, living=Living(breathing_mm=40.0, breathing_s=1.0, follows=0.0)))
