"""Speckle: its statistics, and that it belongs to the tissue and not to the image."""

import numba
import numpy as np
import pytest

from recon.geometry import rigid
from recon.geometry.primitives import Cylinder
from scenes import solid_meshes as shapes
from scenes.acoustics import Tissue
from scenes.scene_types import Material, Thing
from tests.twin.ultrasound import plain_sound
from tests.twin.ultrasound.phantoms import down
from twin.ultrasound import bmode_image
from twin.ultrasound.beam import beam
from twin.ultrasound.bscan import scan
from twin.ultrasound.echo_solids import Body, solid
from twin.ultrasound.medium import scatter
from twin.ultrasound.sound_paths import follow

FACE = (3.0, -2.0, 650.0)


def echoes(body, transducer, pose, seed=1):
    spread = beam(transducer)
    return bmode_image.focused(scatter(body, transducer, spread, follow(body, transducer, pose), pose, seed), spread)


def correlation(a, b):
    """Complex correlation of two fields."""
    return np.vdot(a, b) / np.sqrt(np.vdot(a, a).real * np.vdot(b, b).real)


def test_speckle_is_fully_developed(speckle, clean):
    """Rayleigh: mean over standard deviation of the envelope is sqrt(pi / (4 - pi)) = 1.91, and the intensity's is 1."""
    envelope = scan(speckle, clean, down(clean, FACE), 1).envelope[80:]
    assert envelope.mean() / envelope.std() == pytest.approx(1.91, abs=0.1)
    intensity = envelope**2
    assert intensity.mean() / intensity.std() == pytest.approx(1, abs=0.08)


def test_reference_tissue_has_its_power_at_every_depth(speckle, clean):
    """Mean intensity is 1 after the gain. A band of 3 mm holds about 1000 cells, so 5 sigma are 0.7 dB."""
    frames = np.stack([scan(speckle, clean, down(clean, FACE), seed).envelope for seed in (1, 2)])
    bands = (frames[:, 40:400] ** 2).reshape(2, 15, 24, -1).mean(axis=(0, 2, 3))
    assert np.abs(10 * np.log10(bands)).max() < 1.0


def test_speckle_stays_with_the_tissue(speckle, small):
    """Moved along the array by ten lines, the image shows the same speckle ten lines beside; elsewhere it shows another."""
    first, second = (echoes(speckle, small, down(small, (x, -2.0, 650.0))) for x in (3.0, 3.0 + 10 * small.scale_mm_per_px[0]))
    here, there = first[40:, 24:-14], second[40:, 14:-24]
    assert abs(correlation(here, there)) > 0.99
    assert abs(correlation(first[40:], echoes(speckle, small, down(small, FACE), seed=2)[40:])) < 0.1


@pytest.mark.parametrize("moved", [0.25, 0.5, 0.8])
def test_decorrelation_across_the_plane_follows_diffraction(speckle, clean, moved):
    """At the lens's focus the beam both ways is the transform of the aperture with itself, a triangle. Moved by d, it has moved
    by 2 d against itself and its waves are turned; of a pair of images, the error is 0.03."""
    rows = np.abs(clean.rows_mm - clean.elevation_focus_mm) < 3
    first, second = (echoes(speckle, clean, down(clean, (3.0, y, 650.0)))[rows] for y in (-2.0, -2.0 + moved))
    height, u = clean.elevation_mm, np.linspace(-8, 8, 20001)
    here, there = (np.maximum(1 - np.abs(u + shift) / height, 0) for shift in (0, 2 * moved))
    turn = np.exp(1j * clean.wavenumber * u * moved / clean.elevation_focus_mm)
    expected = abs((here * there * turn).sum()) / (here**2).sum()
    assert abs(correlation(first, second)) == pytest.approx(expected, abs=0.08)


@pytest.mark.parametrize("turn", [(0, 0, 0), (0.4, 0.3, -0.2)])
def test_scatterers_are_found_as_by_the_slow_way(clean, turn):
    """A dark rod and a void one in reference tissue, straight and turned: the same echoes but for the table of phases."""
    array = clean.model_copy(update={"image_size": (24, 408), "scatterers_per_mm3": 8.0})
    made = Body(Tissue(1.6, 1540.0, 0.5, 0.0), (rod(12.0, -6.0), rod(24.0, None)), ())
    pose = down(array, (0.0, 0.0, 0.0)) @ rigid.from_rotation_vector(turn, [0, 0, 0])
    spread, paths = beam(array), follow(made, array, pose)
    quick, slow = (way(made, array, spread, paths, pose, 3) for way in (scatter, plain_sound.scatter))
    assert np.abs(quick - slow)[:, :800].max() < 0.01 * np.abs(slow).max()


def test_the_same_bytes_on_any_number_of_threads(small):
    """Echoes are summed in parts that don't depend on the threads."""
    made, pose, threads = (
        Body(Tissue(1.6, 1540.0, 0.5, 0.0), (rod(20.0, -6.0),), ()),
        down(small, (0, 0, 0)),
        numba.get_num_threads(),
    )
    images = []
    for number in (1, threads):
        numba.set_num_threads(number)
        images.append(scan(made, small, pose, 1).envelope)
    assert (images[0] == images[1]).all()


def rod(depth, echogenicity):
    """Across the image plane, 3 mm in radius."""
    pose = rigid.transform([[0, -1, 0], [1, 0, 0], [0, 0, 1]], (0, 0, depth))
    thing = Thing("rod", shapes.moved(shapes.rod(3.0, 30.0), pose), Material(0.5))
    return solid(
        thing, Tissue(1.6, 1560.0, 0.5, echogenicity), Cylinder("rod", np.array([0, 0, depth]), np.array([0.0, 1, 0]), 3.0)
    )
