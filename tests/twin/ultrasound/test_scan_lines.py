"""Curved arrays: places on their lines and in the image, turns about their centre, and what linear ones see too."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from recon.clips import fan_region
from recon.geometry import rigid
from recon.geometry.primitives import Cylinder
from recon.model.fan import Fan
from scenes import solid_meshes as shapes
from scenes.acoustics import TISSUES
from scenes.scene_types import Material, Thing
from scenes.tissue import Tissue
from tests.twin.ultrasound.conftest import QUIET
from tests.twin.ultrasound.phantoms import down, filament, width_at_half
from tests.twin.ultrasound.test_medium import correlation, echoes
from twin.ultrasound import bscan_truth, scan_lines
from twin.ultrasound.bscan import scan
from twin.ultrasound.echo_solids import Body, solid
from twin.ultrasound.faces import curved
from twin.ultrasound.sound_paths import follow
from twin.ultrasound.transducer import Transducer

FIGURES = QUIET | {"frequency_mhz": 5.0, "transmit_focus_mm": 35.0, "elevation_focus_mm": 35.0, "scatterers_per_mm3": 20.0}
CURVED = Transducer(
    **FIGURES,
    image_size=(440, 360),
    scale_mm_per_px=(0.2, 0.2),
    curved=curved.Face(radius_mm=40.0, sector_deg=60.0, lines=257),
)
LINES = scan_lines.lines_of(CURVED)
LINEAR = Transducer(**FIGURES, image_size=(LINES.count, 334), scale_mm_per_px=(LINES.pitch_mm, 0.2))
PLATE = replace(TISSUES["polymer"], roughness=0.0, attenuation=40.0)  # nothing from its back


def turned(pose: np.ndarray, lines: float) -> np.ndarray:
    """The pose turned about the centre of the face's arc, so that the middle line comes where one so many lines beside was."""
    centre = rigid.transform(np.eye(3), (CURVED.face_mm[0], CURVED.face_mm[1] - 40.0, 0.0))
    turn = rigid.from_rotation_vector([0, 0, -lines * LINES.pitch_mm * LINES.bend], [0, 0, 0])
    return pose @ centre @ turn @ rigid.invert(centre)


def plate(depth: float) -> Body:
    """A thick, smooth plate in water, square to what looks along z."""
    thing = Thing("plate", shapes.moved(shapes.plate((80, 60), 8.0), rigid.transform(np.eye(3), (0, 0, depth))), Material(0.5))
    return Body(TISSUES["water"], (solid(thing, PLATE, None),), ())


@settings(deadline=None)
@given(st.floats(0, 60), st.floats(0, 80))
def test_a_place_on_a_line_is_found_there(along, depth):
    """And its line leaves the arc at a right angle, towards its depth."""
    pose = scan_lines.world_from_lines(LINES, np.eye(4), np.array([along]))[0]
    place = rigid.apply(pose, np.array([0.0, depth, 0.0]))
    assert scan_lines.on_lines(place[0], place[1], LINES.bend, LINES.middle_mm) == pytest.approx((along, depth), abs=1e-9)
    assert np.hypot(place[0], place[1] + 40) == pytest.approx(40 + depth)
    assert np.allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3))


@pytest.mark.parametrize(("beside", "depth"), [(0.0, 20.0), (0.0, 50.0), (-14.0, 25.0), (22.0, 45.0), (-30.0, 40.0)])
def test_a_wire_is_seen_in_its_pixel(beside, depth):
    """The middle of its echo, of all pixels up to 12 dB under the brightest, whichever line it lies on; a pixel is 0.2 mm."""
    image = scan(filament(depth, beside), CURVED, down(CURVED, (0, 0, 0)), 1).image.astype(float)
    v, u = np.nonzero(image > image.max() - 255 * 12 / CURVED.dynamic_range_db)
    found = np.array([u.mean(), v.mean()]) * 0.2 - CURVED.face_mm
    assert found == pytest.approx((beside, depth), abs=0.15)


def test_focus_along_the_array_is_that_of_a_linear_one():
    """In mm: the delays that focus take out the arc, too. A hundred lines beside the middle it is as sharp as there."""
    width = {}
    for name, array, beside in (("linear", LINEAR, 0.0), ("middle", CURVED, 0.0), ("aside", CURVED, 100.0)):
        angle = beside * LINES.pitch_mm * LINES.bend
        depth = 75 * np.cos(angle) - 40 if array is CURVED else 35.0
        envelope = scan(filament(depth, 75 * np.sin(angle)), array, down(array, (0, 0, 0)), 1).envelope
        step = LINES.pitch_mm * (scan_lines.widening(35.0, LINES.bend) if array is CURVED else 1)
        width[name] = width_at_half(envelope[int(envelope.max(axis=1).argmax())], step)
    assert width["middle"] == pytest.approx(width["linear"], rel=0.03)
    assert width["aside"] == pytest.approx(width["middle"], rel=0.03)


def test_a_mirror_square_to_the_middle_line_is_as_bright_as_for_a_linear_array():
    """For that line nothing else is different; the sum over facets on lines that diverge must come to the same, in focus and
    out of it, where phases count. Only there is it seen: 15 degrees beside, more than the apertures' 12, echoes pass by."""
    middle, aside = LINES.count // 2, LINES.count // 2 + round(np.deg2rad(15) / (LINES.pitch_mm * LINES.bend))
    ratios = []
    for depth in (20.0, 35.0, 55.0):
        row = round(depth * 1540 / TISSUES["water"].speed / 0.2)
        linear, curved = (scan(plate(depth), array, down(array, (0, 0, 0)), 1).envelope for array in (LINEAR, CURVED))
        ratios.append(20 * np.log10(curved[row - 4 : row + 5, middle].max() / linear[row - 4 : row + 5, middle].max()))
        assert curved[:, aside].max() < 0.05 * curved[:, middle].max()
    assert ratios == pytest.approx([0, 0, 0], abs=0.25) and np.ptp(ratios) < 0.08


@pytest.mark.parametrize("array", [LINEAR, CURVED])
def test_a_wire_under_a_fast_rod_is_seen_beside(array):
    """By as many mm as its line is bent, at a depth where lines of a curved array are twice as far apart as on the face."""
    pose = rigid.transform([[0, -1, 0], [1, 0, 0], [0, 0, 1]], (5.0, 0, 20.0))
    rod = Thing("rod", shapes.moved(shapes.rod(8.0, 60.0), pose), Material(0.5))
    shape = Cylinder("rod", np.array([5.0, 0.0, 20.0]), np.array([0.0, 1.0, 0.0]), 8.0)
    fast = solid(rod, Tissue(1.5, 1650.0, 0.0, None), shape)
    wired = filament(42.0)
    medium = replace(wired.medium, echogenicity=None)
    shift = follow(Body(medium, (fast,), ()), array, down(array, (0, 0, 0))).shift_mm[LINES.count // 2, round(42 / 0.2)]
    envelope = scan(Body(medium, (fast,), wired.wires), array, down(array, (0, 0, 0)), 1).envelope
    rows = slice(round(38 / 0.2), round(48 / 0.2))
    profile = (envelope[rows] ** 4).max(axis=0)
    step = LINES.pitch_mm * scan_lines.widening(42.0, scan_lines.lines_of(array).bend)
    found = ((np.arange(LINES.count) - LINES.count // 2) * profile).sum() / profile.sum() * step
    assert abs(shift) > 0.3
    assert found == pytest.approx(-shift, abs=0.1)


def test_turned_about_its_centre_it_shows_the_same_on_other_lines(speckle):
    """Ten lines beside: speckle, whose lattice lies anyhow to both, and a wire that runs obliquely through the plane."""
    pose = down(CURVED, (3.0, -2.0, 650.0))
    ends = np.array([[-4.0, -14.0, 683.0], [10.0, 10.0, 691.0]])
    wired = Body(TISSUES["water"], (), (replace(filament(0).wires[0], ends=ends),))
    one, other = (scan(wired, CURVED, turned(pose, lines), 1).envelope for lines in (0, 10))
    assert one.max() > 0 and np.abs(one[:, 54:-44] - other[:, 44:-54]).max() < 0.02 * one.max()
    first, second = (echoes(speckle, CURVED, turned(pose, lines)) for lines in (0, 10))
    assert abs(correlation(first[40:, 54:-44], second[40:, 44:-54])) > 0.99
    assert abs(correlation(first[40:, 54:-44], second[40:, 54:-44])) < 0.2


def test_reference_tissue_has_its_power_at_every_depth_and_on_every_line(speckle):
    """Mean intensity is 1 after the gain, where lines are near and where they are far from each other. Means are of some 500
    cells of speckle and more: five sigma are 1 dB."""
    frames = np.stack([scan(speckle, CURVED, down(CURVED, (3.0, -2.0, 650.0)), seed).envelope for seed in (1, 2, 3)]) ** 2
    usable = frames[:, 30:330]
    assert np.abs(10 * np.log10(usable.reshape(3, 10, 30, -1).mean(axis=(0, 2, 3)))).max() < 1.0
    assert np.abs(10 * np.log10(usable[..., :256].reshape(3, 300, 8, 32).mean(axis=(0, 1, 3)))).max() < 1.0
    assert frames[:, 100:].mean() ** 2 / (frames[:, 100:] ** 2).mean() == pytest.approx(0.5, abs=0.05)  # Rayleigh


def test_labels_are_the_sections():
    """Of a rod of tissue as fast as assumed, beside the middle."""
    pose = rigid.transform([[0, -1, 0], [1, 0, 0], [0, 0, 1]], (-12.0, 0, 40.0))
    tissue = Tissue(1.6, 1540.0, 0.0, -6.0)
    thing = Thing("rod", shapes.moved(shapes.rod(6.0, 30.0), pose), Material(0.5))
    rod = solid(thing, tissue, Cylinder("rod", np.array([-12.0, 0.0, 40.0]), np.array([0.0, 1.0, 0.0]), 6.0))
    made = Body(Tissue(1.6, 1540.0, 0.0, 0.0), (rod,), ())
    looking = down(CURVED, (0, 0, 0))
    shown = bscan_truth.labels(follow(made, CURVED, looking), CURVED)
    assert shown.shape == (360, 440)
    v, u = np.nonzero(shown == 1)
    assert len(u) * 0.04 == pytest.approx(np.pi * 36, rel=0.02)
    assert (u.mean() * 0.2 - CURVED.face_mm[0], v.mean() * 0.2 - CURVED.face_mm[1]) == pytest.approx((-12, 40), abs=0.1)
    (outline,) = bscan_truth.sections(made, looking)["rod"]
    assert outline.mean(axis=0) == pytest.approx((CURVED.face_mm[0] - 12, CURVED.face_mm[1] + 40), abs=0.1)


def test_the_image_is_a_fan_that_the_pipeline_finds(speckle):
    """Black beside it; its numbers are those of the array."""
    noisy = CURVED.model_copy(update={"noise_db": -20.0})
    images = [scan(speckle, noisy, down(CURVED, (3.0, 2.0 * k, 650.0)), 1, k).image for k in range(6)]
    apex = CURVED.face_mm[1] - 40
    truth = Fan(CURVED.face_mm[0] / 0.2, apex / 0.2, 200.0, (40 + CURVED.rows_mm[-1]) / 0.2, -30.0, 30.0)
    inside = truth.mask((360, 440))
    assert (np.max(images, axis=0)[inside] > 0).mean() > 0.99
    grown = Fan(truth.u, truth.v - 4, truth.first_px - 2, truth.last_px + 6, truth.left_deg, truth.right_deg).mask((360, 440))
    assert (np.max(images, axis=0)[~grown] == 0).all()
    found = fan_region.find(images, "sweep").mask((360, 440))
    assert (found & inside).sum() / (found | inside).sum() > 0.95


def test_what_no_image_can_hold_is_refused():
    with pytest.raises(ValueError, match="image_size: expected an image deeper than the face's arc"):
        Transducer(
            image_size=(440, 60), scale_mm_per_px=(0.1, 0.1), curved=curved.Face(radius_mm=60.0, sector_deg=90.0, lines=64)
        )
