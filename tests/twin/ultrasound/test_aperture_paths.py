"""Paths over the aperture: none differ in an even medium; delays, shifts and shadows are those of geometry."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from scenes import solid_meshes
from scenes.scene_types import Material, Thing
from scenes.tissue import Tissue
from tests.twin.ultrasound.phantoms import down
from twin.ultrasound.aperture_paths import _edges, _evened, over_aperture
from twin.ultrasound.beam import beam, receive_aperture, sent_aperture
from twin.ultrasound.echo_solids import Body, solid
from twin.ultrasound.sound_paths import follow
from twin.ultrasound.transducer import Transducer

WATER = Tissue(1.5, 1540.0, 0.0, None)
ARRAY = Transducer(aperture_rays=15, receive_f_number=2.0)
MIDDLE = 160
ACROSS = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 612.0], [0, 0, 0, 1]])  # a rod 12 mm deep, across the image
POSE = down(ARRAY, (0.0, 0.0, 600.0))


def paths(*things: tuple[Thing, Tissue], medium: Tissue = WATER, array: Transducer = ARRAY):
    body = Body(medium, tuple(solid(thing, tissue, None) for thing, tissue in things), ())
    return over_aperture(follow(body, array, POSE), body, array, POSE)


def slab(top: float, thickness: float, tilt_deg: float = 0.0, size: tuple[float, float] = (200.0, 60.0)) -> Thing:
    """A plate whose upper face is met at a depth under the array's middle, tilted along the array."""
    mesh = solid_meshes.plate(size, thickness)
    mesh.apply_transform(
        [[np.cos(t := np.deg2rad(tilt_deg)), 0, np.sin(t), 0], [0, 1, 0, 0], [-np.sin(t), 0, np.cos(t), 0], [0, 0, 0, 1]]
    )
    mesh.apply_translation([0, 0, 600 + top])
    return Thing("plate", mesh, Material(0.3))


def test_one_ray_leaves_the_paths_as_they_are():
    body = Body(WATER, (), ())
    single = ARRAY.model_copy(update={"aperture_rays": 1})
    found = follow(body, single, POSE)
    assert over_aperture(found, body, single, POSE) is found


def test_an_even_medium_changes_nothing_but_the_arrays_ends():
    """There, half of the aperture is missing: half of the amplitude both ways, in a beam twice as wide.

    The ray in the middle still is.
    """
    found = paths()
    depths = found.step_mm * np.arange(found.labels.shape[1])
    np.testing.assert_allclose(found.shown_mm[MIDDLE], depths, atol=1e-3)
    np.testing.assert_allclose(found.amplitude[MIDDLE, 1:240], 1, atol=1e-5)
    np.testing.assert_allclose(found.focus[:, 1:], 1, atol=1e-4)
    assert np.abs(found.shift_mm).max() < 1e-3
    assert 0.5**1.5 < found.amplitude[0, 200] < 0.55


def test_a_loss_is_that_of_the_way_of_the_aperture():
    """Rays aside have a longer way: between that of the middle ray and that of the outermost."""
    lossy = replace(WATER, attenuation=0.7)
    found = paths(medium=lossy)
    straight = 10 ** (-2 * 0.7 * 7.5 * 0.1 * 0.1225 * 200 / 20)
    longest = straight ** np.sqrt(1 + 0.25**2)
    assert longest < found.amplitude[MIDDLE, 200] < straight


def test_a_slower_layer_delays_and_spoils_no_focus_if_thin():
    fat = Tissue(1.5, 1450.0, 0.0, None)
    found, bare = paths((slab(5.0, 4.0), fat)), paths()
    late = (found.shown_mm - bare.shown_mm)[MIDDLE, 200]
    assert late == pytest.approx(4 * (1540 / 1450 - 1), rel=0.03)
    assert found.focus[MIDDLE, 200] > 0.97


def test_an_inclined_border_shifts_the_beam_as_refraction_does():
    """Against Snell's law of the middle ray, in the limit of small angles: (1 - c2 / c1) tan(tilt) from the border on."""
    fat, tilt = Tissue(1.5, 1480.0, 0.0, None), 8.0
    found = paths((slab(10.0, 80.0, tilt), fat))
    level = 280
    below = found.step_mm * level - 10.0
    expected = (1480 / 1540 - 1) * np.tan(np.deg2rad(tilt)) * below
    assert abs(found.shift_mm[MIDDLE, level]) == pytest.approx(abs(expected), rel=0.12)
    straight = follow(Body(WATER, (solid(slab(10.0, 80.0, tilt), fat, None),), ()), ARRAY, POSE)
    assert np.sign(found.shift_mm[MIDDLE, level]) == np.sign(straight.shift_mm[MIDDLE, level])


def test_a_shadow_widens_and_fills_with_depth():
    """Past a bar of 4 mm that lets nothing through, the receiving aperture looks from 20 mm on, the sending one from 27."""
    bar = slab(10.0, 1.0, size=(4.0, 60.0))
    found = paths((bar, Tissue(1.5, 1540.0, 200.0, None)))
    levels = [round(depth / found.step_mm) for depth in (12.0, 22.0, 40.0)]
    near, middle, far = (found.amplitude[MIDDLE, level] for level in levels)
    assert near < 1e-3 and near <= middle < far and far > 0.01
    edges = [np.flatnonzero(found.amplitude[40:280, level] < 0.95) for level in levels]
    widths = [0.1229 * np.ptp(edge) for edge in edges]
    assert widths[0] < 6 < widths[1] < widths[2]


def test_the_sending_aperture_is_whole_at_its_focus_and_one_zone_beside_it():
    """Fresnel's zones: half as deep as the focus F, the path at half the width s is longer by s²/2 (2/F - 1/F)."""
    focus, width = ARRAY.transmit_focus_mm, ARRAY.transmit_focus_mm / ARRAY.transmit_f_number
    whole, half = sent_aperture(ARRAY, np.array([focus, focus / 2]))
    assert whole == width
    longer = (half / 4) ** 2 / 2 / focus
    assert half == width or longer == pytest.approx(ARRAY.wavelength_mm / 4)
    assert (sent_aperture(ARRAY, np.array([2.0])) < receive_aperture(ARRAY, np.array([20.0]))).all()


def test_a_constant_shift_stays_to_both_ends():
    """By the same amplitude: lines neither crowd nor part."""
    found = paths()
    for shift in (1.0, -1.0):
        moved = _evened(
            found._replace(shift_mm=np.full_like(found.shift_mm, shift)), np.full(found.labels.shape[1], 0.74), 0.1229
        )
        np.testing.assert_allclose(moved.shift_mm, shift, atol=1e-5)
        np.testing.assert_allclose(moved.amplitude, found.amplitude, rtol=1e-5)


def test_edges_of_a_shadow_are_kept_where_the_beam_blurs_them():
    """The beam's mean power across a step is nearer to the step with the factor; even tissue, weak or not, has none."""
    spread = beam(ARRAY)
    step = np.where(np.arange(321)[:, None] < 160, 1.0, 0.01) * np.ones((1, 408), np.float32)
    factor = _edges(step.astype(np.float32), 0.1225, spread, 0.1225)[:, 300]
    share = np.abs(spread.lateral[300]) ** 2 / (np.abs(spread.lateral[300]) ** 2).sum()
    blurred = np.sqrt(np.convolve(np.pad(step[:, 300] ** 2, 32, mode="edge"), share, mode="valid"))
    off = [np.abs(kept - step[:, 300])[140:180].sum() for kept in (blurred, blurred * factor)]
    assert off[0] > 1.3 * off[1]
    for level in (1.0, 1e-4):
        np.testing.assert_allclose(_edges(np.full((321, 408), level, np.float32), 0.1225, spread, 0.1225), 1, atol=1e-4)


def test_a_ragged_layer_spoils_the_focus():
    """Bars of another speed, side by side: neighbouring parts of the aperture come early and late."""
    bars = [(slab(4.0, 6.0, size=(1.5, 60.0)), x) for x in np.arange(-21, 22, 3.0)]
    things = []
    for k, (thing, x) in enumerate(bars):
        thing.mesh.apply_translation([x, 0, 0])
        things.append((replace(thing, name=f"plate{k}"), Tissue(1.5, 1450.0, 0.0, None)))
    found = paths(*things)
    assert found.focus[MIDDLE - 20 : MIDDLE + 20, 200].mean() < 0.5


def test_without_refraction_nothing_is_shifted():
    still = ARRAY.model_copy(update={"refraction": False})
    found = paths((slab(10.0, 80.0, 8.0), Tissue(1.5, 1480.0, 0.0, None)), array=still)
    assert np.abs(found.shift_mm).max() == 0


def test_bent_beams_carry_no_more_power_than_straight_ones():
    """Behind a slow rod, which draws lines together and apart: power a line, of even scatterers, stays within 1.2 dB."""
    rod = Thing("rod", solid_meshes.moved(trimesh.creation.cylinder(6.0, 60.0, sections=96), ACROSS), Material(0.3))
    found = paths((rod, replace(WATER, speed=1440.0, impedance=1.5)))
    level, pitch = 340, ARRAY.scale_mm_per_px[0]
    places = pitch * np.arange(len(found.labels))
    power = found.amplitude[:, level].astype(float) ** 2 / paths().amplitude[:, level].astype(float) ** 2
    shifts = found.shift_mm[:, level].astype(float)
    shown, bins = places - shifts, np.arange(8.0, 32.0, 2.0)
    share = np.histogram(shown, bins, weights=power)[0] * pitch / 2.0
    crowded = np.histogram(shown, bins)[0] * pitch / 2.0
    assert np.ptp(shifts) > 0.5 and np.abs(10 * np.log10(share)).max() < 1.2
    assert np.abs(10 * np.log10(crowded)).max() > 1.5  # without it
