"""B-scans of tissue that a face has pressed in, or a breath has raised, as of tissue at rest."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from scipy.ndimage import gaussian_filter, gaussian_filter1d

from recon.freehand import sequences
from recon.freehand.scans import Scans
from recon.geometry import rigid
from recon.model.calibration import Uncertainty
from recon.model.probe import NAMES, ProbeCalibration
from recon.model.rig import Rig
from recon.model.tracks import poses_at
from recon.probe_calibration import sound_in_water
from recon.segmentation import contact, rest, segmented_scans
from recon.segmentation.blur_correction import Blur
from recon.segmentation.rest import LIMITS, Rest
from scenes.kinds import breast
from scenes.solid_meshes import grid
from twin.evaluation import sweep_errors
from twin.experiments import mass_accuracy
from twin.filmed_sweep import SweepSettings, plan_sweep
from twin.living.living_body import Living
from twin.ultrasound import sweep_session
from twin.ultrasound.transducer import Transducer

SIZE, SCALE, COUNT = (320, 400), np.array([0.12, 0.12]), 160
DEPTH_MM = 600.0  # of a flat skin before the camera
TIMES = np.arange(COUNT) / 20


@pytest.fixture(scope="module")
def skin() -> trimesh.Trimesh:
    """A plane of 90 x 90 mm, a vertex each mm."""
    places, faces = grid((90, 90), (90, 90))
    return trimesh.Trimesh(np.column_stack([places, np.full(len(places), DEPTH_MM)]), faces, process=False)


def tissue(rng, gel_mm=0.0) -> np.ndarray:
    """Log-compressed speckle with a bright spot of 0.7 mm, 10 mm below the middle of the face, under gel without echoes."""
    noise = gaussian_filter(rng.standard_normal((2, *SIZE[::-1])), (0, 0.6, 1.5))
    image = np.clip(130 + 20 * np.log(np.hypot(*noise) / noise.std()), 0, 200)
    image[: round(gel_mm / SCALE[1])] = 0
    image[80:87, 157:164] = 255
    return image.astype(np.uint8)


def sweep(off_mm, image) -> Scans:
    """B-scans that look down into the skin, their faces off it by so many mm : (n,), one behind the other; all show one image."""
    probe = ProbeCalibration(np.eye(4), SCALE)
    looking_in = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # the depth axis along the camera's
    places = np.column_stack([np.full(COUNT, -19.0), np.linspace(-20, 20, COUNT), DEPTH_MM - np.broadcast_to(off_mm, COUNT)])
    poses = np.stack([rigid.transform(looking_in, place) for place in places])
    placed = poses @ sequences.target_from_pixel(probe)
    return Scans(SIZE[::-1], placed, lambda: iter([image] * COUNT), 1540, 1540, probe, times_s=TIMES)


def found_in(scans: Scans, skin: trimesh.Trimesh) -> Rest:
    """What moved its tissue."""
    moved = rest.find(scans, skin, contact.measure(scans, skin))
    assert moved is not None
    return moved


def spot(image) -> float:
    """Row of the bright spot's middle."""
    return float(np.nonzero(image == 255)[0].mean())


def hand(rng) -> np.ndarray:
    """Unsteadiness of 0.12 mm."""
    return 0.12 * gaussian_filter1d(rng.standard_normal(COUNT), 3) * np.sqrt(2 * np.sqrt(np.pi) * 3)


def test_what_is_pressed_down_is_put_back_up(skin, rng):
    """10 mm below a face 2 mm within the skin, a spot has gone along by half of it or so, and is shown as much too deep.

    The field that moves the image is the one that the uncertainty is of: `x = X + u(X)`, to the nearest pixel.
    """
    scans = sweep(-2.0, tissue(rng))
    moved = found_in(scans, skin)
    assert moved.pressed_mm == pytest.approx(np.full(COUNT, 2.0), abs=0.02) and not moved.risen_mm.any()
    back = rest.undone(scans, moved)
    images = list(back.stream())
    assert len(images) == COUNT
    rests = spot(images[70])
    places = [
        rigid.apply(one.world_from_pixel[70], [160.0, row, 0.0]) for one, row in ((scans, spot(tissue(rng))), (back, rests))
    ]
    lifted = places[0][2] - places[1][2]
    assert 0.7 < lifted < 1.3
    assert rigid.apply(back.world_from_pixel[70], [160.0, 0, 0])[2] == pytest.approx(DEPTH_MM, abs=0.02)  # from the skin on
    down = moved.pressed_at(np.array([70]), np.array([[160.0, rests]]))[0]
    assert down == pytest.approx([0, 0, lifted], abs=SCALE[1])


def test_breath_is_taken_out_of_the_planes(skin, rng):
    """A chest that rises by 4 mm, with a hand that goes along: faces touch the skin at rest again, to 0.4 mm at 95 %."""
    scans = sweep(4 * np.sin(np.pi * TIMES / 4.2) ** 4 + hand(rng), tissue(rng))
    moved = found_in(scans, skin)
    back = rest.undone(scans, moved)
    assert moved.up == pytest.approx([0, 0, -1]) and not moved.pressed_mm.any()
    assert np.quantile(np.abs(contact.measure(back, skin).distances_mm), 0.95) < 0.4
    assert back.world_from_pixel[:, :2] == pytest.approx(scans.world_from_pixel[:, :2])
    assert any("rose by" in line and "every 4." in line for line in moved.lines)


def test_half_a_breath_is_told_by_tissue_at_the_face(skin, rng):
    """4 mm in 8 s: too slow to come back, but gel so thick would be seen. It is taken out to 0.5 mm at 95 %; 2 mm may be gel."""
    for rise_mm, left_mm in ((4.0, 0.5), (1.5, 1.7)):
        scans = sweep(rise_mm * np.sin(np.pi * TIMES / 16) ** 2 + hand(rng), tissue(rng))
        moved = found_in(scans, skin)
        assert np.quantile(np.abs(contact.measure(rest.undone(scans, moved), skin).distances_mm), 0.95) < left_mm
        assert moved.gel_mm.any() == (rise_mm < LIMITS.risen_mm)


def test_a_face_in_touch_leaves_all_as_it_is(skin, rng):
    """Within the deadband of noise and a little gel, nothing is undone, said or unsure."""
    scans = sweep(hand(rng), tissue(rng))
    moved = found_in(scans, skin)
    assert rest.undone(scans, moved) is scans and not moved.lines and moved.figures == {"undone_mm": 0, "undone_most_mm": 0}
    assert not moved.unknown(np.array([5, 6]), np.array([[100.0, 100], [200, 200]])).any()


def test_gel_that_is_seen_is_no_breath(skin, rng):
    """3 mm off the resting skin: through gel tissue is where it was, and with tissue at once the body has risen to the face."""
    off = 3 + hand(rng)
    through_gel, at_once = (sweep(off, tissue(rng, gel_mm)) for gel_mm in (3.0, 0.0))
    assert rest.undone(through_gel, found_in(through_gel, skin)) is through_gel
    risen = found_in(at_once, skin)
    assert np.median(risen.risen_mm) == pytest.approx(2.5, abs=0.1)  # but for gel of up to 1 mm, of which half counts
    assert found_in(replace(at_once, world_from_pixel=sweep(hand(rng) + 0.9, at_once).world_from_pixel), skin).gel_mm.any()


def test_a_thing_in_the_measured_skin_presses_nothing(skin, rng):
    """A face 10 mm within what light saw in eight B-scans, as of a hand that lay there, and 8 mm in all of them."""
    off = hand(rng)
    off[60:68] -= 10
    assert not found_in(sweep(off, tissue(rng)), skin).moved.any()
    assert not found_in(sweep(hand(rng) - 8, tissue(rng)), skin).moved.any()


def test_more_than_half_a_millimetre_left_is_said():
    """At two standard deviations."""
    assert not rest.warnings_of("mass0", 0.24)
    assert "up to 0.6 mm" in rest.warnings_of("mass0", 0.3)[0]


@pytest.mark.slow
def test_pressed_masses_are_found_as_they_rest(rig: Rig):
    """Silicone over a table, pressed by 2 mm and solved by finite elements; without the nipple, which tears at their limit.

    The two smaller ones, by one stroke: centres come to 0.8 mm of truth, volumes to 8 %, and squared errors are a few variances
    at most: chi-square of 6, 99.9 %.
    """
    smaller = [one.model_dump() for one in breast.Config().tumours[1:]]
    scene = {"kind": "breast", "nipple_height_mm": 1.5, "size_mm": [170.0, 130.0, 49.5], "tumours": smaller}
    one = {"start_mm": (22.0, -31.0), "end_mm": (22.0, 36.0), "strokes": 1}
    path = mass_accuracy.PATH.model_copy(update=one | {"standoff_mm": -2.0})
    planned = plan_sweep(
        SweepSettings(
            rig=rig, scene=scene, ultrasound=Transducer(), path=path, living=Living(yields=True, element_mm=5.0), seed=3
        )
    )
    images = [one.image for one in planned.scans()]
    clocks, plan = planned.settings.clocks, planned.plan
    known = Uncertainty(NAMES, np.diag([1e-4, 1e-4, 1e-3, 1e-3, 1e-3, 0.07, 0.07, 0.07]) ** 2)
    probe = replace(sweep_session.calibration_of(rig, Transducer()), uncertainty=known)
    probe = sound_in_water.for_tissue(probe, mass_accuracy.SOUND.tissue)
    placed = poses_at(plan.track, plan.times, clocks.lag_s) @ sequences.target_from_pixel(probe)
    scans = Scans(images[0].shape, placed, lambda: iter(images), probe.speed_m_s, 1540.0, probe, times_s=plan.times * 1e-9)
    skin = next(thing.mesh for thing in planned.scene.things if thing.name == "breast")
    found = segmented_scans.find_masses(scans, sweep_errors.facing(skin), blur=Blur(), overlays=0)
    pairs = sweep_errors.compare(list(found.meshes.values()), [thing for thing in planned.scene.things if thing.inside])
    assert len(pairs) == len(found.meshes) == 2
    errors = np.array([pair.centre_error_mm for pair in pairs])
    sigmas = np.array([found.figures[f"mass{pair.number}_centre_sigma_mm"] for pair in pairs])
    assert errors.max() < 0.8 and np.sum((errors / sigmas) ** 2) < 22.5 / 3
    assert all(abs(pair.found.volume / pair.true.volume - 1) < 0.08 for pair in pairs if pair.found is not None)
    assert found.figures["pressed_mm"] == pytest.approx(2.0, abs=0.15)
