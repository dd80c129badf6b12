"""Reflection at borders, and what a line meets."""

import numpy as np
import pytest
import trimesh

from recon.geometry import rigid
from scenes.catalogue import build_scene
from scenes.scene_types import Material, Scene, Thing
from tests.twin.ultrasound import plain_sound
from tests.twin.ultrasound.phantoms import down
from twin.ultrasound.aperture_paths import over_aperture
from twin.ultrasound.echo_solids import body
from twin.ultrasound.sound_paths import LOWEST, follow, low_frequencies, reflection


def test_reflection_at_normal_incidence():
    """The impedances alone count: water to steel gives 0.937."""
    assert reflection(1.49, 46.0, 1488.0, 5900.0, 1.0) == pytest.approx((46 - 1.49) / (46 + 1.49))
    assert reflection(1.6, 1.6, 1540.0, 1540.0, 0.3) == pytest.approx(0)


def test_reflection_is_total_beyond_the_critical_angle():
    """Water to acrylic: the critical angle is asin(1488/2700) = 33.4 degrees."""
    below, beyond = (reflection(1.49, 3.2, 1488.0, 2700.0, np.cos(np.deg2rad(angle))) for angle in (30, 35))
    assert 0 < below < 1
    assert beyond == 1


def test_two_fluids_swap_with_the_opposite_sign():
    """Stokes: back through the border, along the refracted ray, the reflection changes its sign."""
    cosine = 0.9
    onwards = np.sqrt(1 - (1450 / 1540) ** 2 * (1 - cosine**2))
    assert reflection(1.6, 1.4, 1540.0, 1450.0, cosine) == pytest.approx(-reflection(1.4, 1.6, 1450.0, 1540.0, onwards))


@pytest.mark.parametrize("kind", ["inner_cylinder", "breast"])
def test_lines_are_followed_as_by_the_slow_way(small, kind):
    """Step by step, tissues by SciPy: the same delays, losses and bends, in float32."""
    array = small.model_copy(update={"image_size": (12, 408), "scale_mm_per_px": (1.2, 0.1225)})
    made = body(build_scene({"kind": kind}))
    pose = down(array, (4.0, -2.0, 650.0)) @ rigid.from_rotation_vector([0.05, 0.1, -0.05], [0, 0, 0])
    quick = follow(made, array, pose)
    slow = plain_sound.follow(made, array, pose, quick.labels.shape[1])
    assert len(np.unique(slow.labels)) > 1
    assert np.abs(slow.shift_mm).max() > 0.1
    assert (quick.labels == slow.labels).all()
    assert quick.shown_mm == pytest.approx(slow.shown_mm, abs=1e-4)
    assert quick.amplitude == pytest.approx(slow.amplitude, abs=1e-4)
    assert quick.shift_mm == pytest.approx(slow.shift_mm, abs=1e-3)


def test_lines_beyond_the_gel_have_air_before_them(clean):
    """A block under half of the array, 0.5 mm below it: the other half gets no echo, nor gives an aperture any."""
    block = trimesh.creation.box((20.0, 40.0, 30.0))
    block.apply_translation((-10.0, 0.0, 615.5))
    there = body(Scene("breast", (Thing("breast", block, Material(0.4)),)))
    pose, half = down(clean, (0.0, 0.0, 600.0)), clean.image_size[0] // 2
    wet, dry = (follow(there, clean.model_copy(update={"gel_mm": gel}), pose) for gel in (None, 1.0))
    assert (wet.amplitude[half + 5 :, 50] > 0).all()
    assert (dry.amplitude[half + 5 :, 50] == 0).all()
    np.testing.assert_array_equal(dry.amplitude[: half - 5], wet.amplitude[: half - 5])
    several = clean.model_copy(update={"aperture_rays": 7, "refraction": False, "gel_mm": 1.0})
    cut = over_aperture(follow(there, several, pose), there, several, pose).amplitude[:, 200]
    assert cut[half + 100] < 1e-12
    assert 0.5**1.5 < cut[half - 2] / cut[half - 100] < 0.6  # half of the aperture is left, and the ray in its middle


@pytest.mark.parametrize("absorbed", [0.5, 4.0, 12.0])
def test_low_frequencies_last_longer_as_a_gaussian_spectrum_says(absorbed):
    """The spectrum times its loss at each frequency, as long as its middle sinks by less than a half; then held there."""
    spread = 0.06
    sunk = min(spread * absorbed, LOWEST)
    gained = low_frequencies(absorbed, spread)
    assert gained == pytest.approx(sunk * absorbed - sunk**2 / (2 * spread))
    if sunk < LOWEST:
        share = np.linspace(-3, 3, 20001)  # of the frequency, beside the middle
        whole = np.trapezoid(np.exp(-(share**2) / (2 * spread) - absorbed * (1 + share)), share)
        assert np.log(whole / np.trapezoid(np.exp(-(share**2) / (2 * spread)), share)) + absorbed == pytest.approx(
            gained, rel=1e-3
        )
    assert low_frequencies(absorbed, 0.0) == 0
