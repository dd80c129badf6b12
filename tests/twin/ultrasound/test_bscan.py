"""Images: point spread, contrast, shadow, speed of sound, surfaces."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
import yaml
from scipy.optimize import brentq

from recon.geometry import rigid
from recon.geometry.primitives import Cylinder
from scenes import solid_meshes as shapes
from scenes.acoustics import TISSUES
from scenes.catalogue import build_scene
from scenes.scene_types import Material, Thing
from scenes.tissue import Tissue
from tests.twin.ultrasound.phantoms import down, filament, peak, width_at_half
from twin.ultrasound.bscan import scan
from twin.ultrasound.echo_solids import Body, body, solid
from twin.ultrasound.transducer import Transducer

MATT = Material(0.5)


def disc(tissue: Tissue, depth: float, diameter: float) -> Body:
    """A rod across the image plane in the reference tissue."""
    pose = rigid.transform([[0, -1, 0], [1, 0, 0], [0, 0, 1]], (0, 0, depth))
    thing = Thing("disc", shapes.moved(shapes.rod(diameter / 2, 30.0), pose), MATT)
    shape = Cylinder("disc", np.array([0.0, 0.0, depth]), np.array([0.0, 1.0, 0.0]), diameter / 2)
    return Body(Tissue(1.6, 1540.0, 0.0, 0.0), (solid(thing, tissue, shape),), ())


def hann_beam(x, aperture, depth, wavelength):
    """Far field of a Hann-weighted aperture at its focus [Harris 1978]."""
    u = x * aperture / (wavelength * depth)
    return np.sinc(u) / (1 - u**2)


def test_width_along_the_array_is_that_of_diffraction(small):
    """A filament at the transmit focus: the product of two Hann beams."""
    depth, wavelength = small.transmit_focus_mm, small.wavelength_mm
    sent, received = depth / small.transmit_f_number, min(depth / small.receive_f_number, small.aperture_mm)

    def excess(x):
        return hann_beam(x, sent, depth, wavelength) * hann_beam(x, received, depth, wavelength) - 0.5

    envelope = scan(filament(depth), small, down(small, (0, 0, 0)), 1).envelope
    row = int(envelope.max(axis=1).argmax())
    found = width_at_half(envelope[row], small.scale_mm_per_px[0])
    assert found == pytest.approx(2 * brentq(excess, 0.05, 0.9), rel=0.05)


def test_each_focal_zone_has_the_beam_of_its_focus(small):
    """A filament in each zone is as wide as under an array with that focus alone, and beside it wider than there."""
    zoned = small.model_copy(update={"transmit_focus_mm": 10.0, "focal_zones_mm": (22.0,)})

    def width(array, depth):
        envelope = scan(filament(depth), array, down(array, (0, 0, 0)), 1).envelope
        return width_at_half(envelope[int(envelope.max(axis=1).argmax())], array.scale_mm_per_px[0])

    single = {focus: small.model_copy(update={"transmit_focus_mm": focus}) for focus in (10.0, 22.0)}
    for focus, other in ((10.0, 22.0), (22.0, 10.0)):
        assert width(zoned, focus) == width(single[focus], focus) < width(single[other], focus)


@pytest.mark.parametrize("band", [0.4, 0.65])
def test_width_in_depth_is_that_of_the_pulse(small, band):
    """The envelope of a Gaussian band B f0 wide at half amplitude lasts (4 ln 2 / pi) / (B f0) at half amplitude."""
    fine = small.model_copy(update={"scale_mm_per_px": (0.1229, 0.03), "bandwidth": (band, band)})
    envelope = scan(filament(10.0), fine, down(small, (0, 0, 0)), 1).envelope
    found = width_at_half(envelope[:, small.image_size[0] // 2], 0.03)
    expected = 4 * np.log(2) / np.pi / (band * fine.frequency_mhz) * fine.assumed_speed / 2e3
    assert found == pytest.approx(expected, rel=0.05)


def test_the_slice_is_thinnest_at_the_lens_focus(small):
    """A bead is moved across the plane; at the focus its echo has the width of sinc², elsewhere it is wider."""
    offsets = np.arange(-3, 3.01, 0.15)

    def profile(depth):
        peaks = [scan(filament(depth, 0.0, 0.1, z), small, down(small, (0, 0, 0)), 1).envelope.max() for z in offsets]
        return np.array(peaks)

    focus = small.elevation_focus_mm
    expected = 0.886 * small.wavelength_mm * focus / small.elevation_mm
    assert width_at_half(profile(focus), 0.15) == pytest.approx(expected, rel=0.1)
    for depth in (6.0, 48.0):
        peaks = profile(depth)
        assert 0.15 * np.ptp(np.flatnonzero(peaks > peaks.max() / 2)) > 1.5 * expected


def test_contrast_of_a_lesion_is_its_echogenicity(clean):
    """-6 dB in, -6 dB out; 5 sigma of the two means, of some 300 and 1000 cells, are 1.5 dB."""
    made = disc(Tissue(1.6, 1540.0, 0.0, -6.0), 25.0, 14.0)
    intensity = scan(made, clean, down(clean, (0, 0, 0)), 1).envelope ** 2
    v, u = np.meshgrid(clean.rows_mm - 25.0, np.arange(321) * clean.scale_mm_per_px[0] - clean.width_mm / 2, indexing="ij")
    radius = np.hypot(u, v)
    found = 10 * np.log10(intensity[radius < 5].mean() / intensity[(radius > 9) & (np.abs(v) < 7)].mean())
    assert found == pytest.approx(-6, abs=1.2)


def test_sound_is_weaker_behind_what_absorbs_it(clean):
    """A rod of 10 mm that takes 0.8 dB/cm/MHz more casts a shadow of 12 dB behind its middle; one that takes less enhances."""
    made = disc(Tissue(1.6, 1540.0, 0.8, 0.0), 20.0, 10.0)
    intensity = scan(made, clean, down(clean, (0, 0, 0)), 1).envelope[260:380] ** 2
    behind, beside = intensity[:, 154:167].mean(), intensity[:, :80].mean()
    assert 10 * np.log10(behind / beside) == pytest.approx(-0.8 * 7.5 * 2, abs=2.0)


@pytest.fixture(scope="module")
def tank():
    return body(build_scene({"kind": "tank"}))


def test_water_shows_the_bottom_too_deep(tank, small):
    """By the scanner's speed over the water's: 30 mm appear as 31.04."""
    envelope = scan(tank, small, down(small, (4.0, -2.0, 670.0)), 1).envelope
    rows = envelope.argmax(axis=0) * small.scale_mm_per_px[1]
    assert np.median(rows) == pytest.approx(30 * 1540 / TISSUES["water"].speed, abs=small.scale_mm_per_px[1])


def test_a_tilted_bottom_sends_its_echo_past_the_aperture(tank, small):
    """At 25 degrees, beyond the receive aperture's half angle of 14, nothing but roughness is left."""
    straight, tilted = (scan(tank, small, down(small, (4.0, -2.0, 670.0), tilt), 1).envelope.max() for tilt in (0, 25))
    assert 20 * np.log10(tilted / straight) < -20


def test_a_bottom_repeats_at_twice_its_depth(tank, small):
    """The echo that comes back to the face goes down again, unless reverberation is off."""
    repeating = small.model_copy(update={"reverberations": 2})
    images = [scan(tank, one, down(small, (4.0, -2.0, 682.0)), 1).envelope for one in (small, repeating)]
    row = round(2 * 18 * 1540 / TISSUES["water"].speed / small.scale_mm_per_px[1])
    without, with_them = (one[row - 3 : row + 4].max() for one in images)
    assert with_them > 20 * without


def test_noise_and_quantisation(speckle, small):
    """Four bits leave sixteen greys; noise differs from image to image, where tissue does not."""
    noisy = small.model_copy(update={"noise_db": -20.0, "bits": 4})
    first, second = (scan(speckle, noisy, down(small, (0, 0, 650.0)), 1, frame) for frame in (0, 1))
    assert len(np.unique(first.image)) <= 16
    assert (first.image != second.image).any()
    quiet = [scan(speckle, small, down(small, (0, 0, 650.0)), 1, frame).image for frame in (0, 1)]
    assert (quiet[0] == quiet[1]).all()


def test_refraction_bends_what_lies_behind_a_fast_wedge(small):
    """Through a border tilted by t, a line turns by (c2/c1 - 1) tan t: a filament 20 mm behind is seen beside its place.

    The border rises towards +x: 10 - x tan(t) deep. By Snell's law, sound that is faster behind it turns away from the border's
    normal (sin t, cos t), so a line that comes straight down turns towards -x. It is the line at 20 (c2/c1 - 1) tan(t) on the
    array's +x side that meets the filament, and there the filament is shown.
    """
    slant = trimesh.creation.box((120.0, 60.0, 60.0))
    tilt = np.deg2rad(15.0)
    slant.apply_transform(rigid.from_rotation_vector([0, tilt, 0], [0, 0, 0]) @ rigid.transform(np.eye(3), (0, 0, 30.0)))
    slant.apply_translation([0, 0, 10.0])
    wedge = solid(Thing("wedge", slant, MATT), Tissue(1.5, 1617.0, 0.0, None), None)
    made = replace(filament(30.0), solids=(wedge,))
    images = [scan(made, small.model_copy(update={"refraction": on}), down(small, (0, 0, 0)), 1).envelope for on in (False, True)]
    straight, bent = (peak(one[200:].max(axis=0)) for one in images)
    assert (bent - straight) * small.scale_mm_per_px[0] == pytest.approx(0.05 * np.tan(tilt) * 20, abs=0.04)


def test_configurations_are_read_and_the_default_is_the_linear_array():
    folder = Path(__file__).parents[3] / "conf" / "ultrasound"
    read = {path.stem: Transducer(**yaml.safe_load(path.read_text(encoding="utf-8"))) for path in folder.glob("*.yaml")}
    assert read["linear"] == Transducer()
    assert read["water"].tgc_db_per_cm_mhz == TISSUES["water"].attenuation
