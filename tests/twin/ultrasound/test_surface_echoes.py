"""Echoes of walls: what apertures see of a curved one, how it repeats, and what roughness scatters."""

from dataclasses import replace

import numpy as np
import pytest

from recon.geometry import rigid
from recon.geometry.primitives import Cylinder
from scenes import solid_meshes as shapes
from scenes.acoustics import TISSUES
from scenes.catalogue import build_scene
from scenes.scene_types import Material, Thing
from scenes.tissue import Tissue
from tests.twin.ultrasound import plain_sound
from tests.twin.ultrasound.phantoms import down, filament
from twin.ultrasound.beam import beam
from twin.ultrasound.bscan import scan
from twin.ultrasound.echo_field import scanner_at
from twin.ultrasound.echo_solids import Body, Wire, body, solid
from twin.ultrasound.sound_paths import follow
from twin.ultrasound.surface_echoes import surface_echoes, wire_echoes

WATER = TISSUES["water"]
DEPTH_MM, RADIUS_MM = 25.0, 8.0


def rod(tissue: Tissue, depth: float = DEPTH_MM, radius: float = RADIUS_MM) -> Body:
    """A rod across the image plane in water, its front 17 mm deep."""
    pose = rigid.transform([[0, -1, 0], [1, 0, 0], [0, 0, 1]], (0, 0, depth))
    thing = Thing("rod", shapes.moved(shapes.rod(radius, 30.0), pose), Material(0.5))
    shape = Cylinder("rod", np.array([0.0, 0.0, depth]), np.array([0.0, 1.0, 0.0]), radius)
    return Body(WATER, (solid(thing, tissue, shape),), ())


def on_wall(envelope, array, angle_deg):
    """Brightest echo within 0.6 mm of the rod's wall, at an angle from its crest on the image's right."""
    angle = np.deg2rad(angle_deg)
    beside, depth = RADIUS_MM * np.sin(angle), (DEPTH_MM - RADIUS_MM * np.cos(angle)) * array.assumed_speed / WATER.speed
    u = round((beside + array.width_mm / 2) / array.scale_mm_per_px[0])
    v = round(depth / array.scale_mm_per_px[1])
    return envelope[v - 5 : v + 6, u - 5 : u + 6].max()


def test_a_smooth_rod_is_seen_where_it_is_square_to_the_beam(clean):
    """Both apertures together accept slopes up to the mean of their half angles, 12 degrees; beyond are Hann's side lobes."""
    smooth = replace(TISSUES["polymer"], roughness=0.0)
    envelope = scan(rod(smooth), clean, down(clean, (0, 0, 0)), 1).envelope
    crest = on_wall(envelope, clean, 0)
    assert 20 * np.log10(on_wall(envelope, clean, 5) / crest) > -6
    assert 20 * np.log10(on_wall(envelope, clean, 20) / crest) < -25
    assert all(20 * np.log10(on_wall(envelope, clean, angle) / crest) < -60 for angle in (40, 50, 60, 70, 80))


def test_roughness_fades_along_the_flank(clean):
    """Small roughness scatters as cos³ of the tilt a projected area, and no more beyond the critical angle of 33 degrees.

    Means over 48 echoes, some 20 of them independent: 1 dB each.
    """
    rough = replace(TISSUES["polymer"], roughness=0.003)
    envelopes = [scan(rod(rough), clean, down(clean, (0, 0.7 * k, 0)), k).envelope for k in range(6)]

    def power(low, high):
        angles = [side * angle for angle in range(low, high, 3) for side in (1, -1)]
        return np.mean([on_wall(one, clean, angle) ** 2 for one in envelopes for angle in angles])

    expected = 30 * np.log10(np.cos(np.deg2rad(61.5)) / np.cos(np.deg2rad(31.5)))
    assert 10 * np.log10(power(57, 67) / power(27, 37)) == pytest.approx(expected, abs=3.0)


def test_a_repeat_of_a_curved_wall_fades_twice_as_fast(small):
    """The second echo sees twice the slope, so it is narrower than the first, and there is nothing else below it."""
    smooth = replace(TISSUES["polymer"], roughness=0.0, attenuation=40.0)  # nothing from the back
    repeating = small.model_copy(update={"reverberations": 2})
    envelope = scan(rod(smooth), repeating, down(small, (0, 0, 0)), 1).envelope
    first = round((DEPTH_MM - RADIUS_MM) * small.assumed_speed / WATER.speed / small.scale_mm_per_px[1])
    crest = envelope[first - 4 : first + 5].max(axis=0)
    repeat = envelope[2 * first - 4 : 2 * first + 5].max(axis=0)
    widths = [np.count_nonzero(one > one.max() / 4) * small.scale_mm_per_px[0] for one in (crest, repeat)]
    assert widths[1] < widths[0]
    assert -45 < 20 * np.log10(repeat.max() / crest.max()) < -10
    assert 20 * np.log10(envelope[2 * first + 10 :].max() / repeat.max()) < -20


def test_a_plate_repeats_by_its_reflection_and_the_face(small):
    """At 2 y the echo is `R face` of the first, less the beam's spreading, which the two-way focus turns into a few dB."""
    tank = body(build_scene({"kind": "tank"}))
    bounce = (TISSUES["polymer"].impedance - WATER.impedance) / (TISSUES["polymer"].impedance + WATER.impedance)
    levels = []
    for face in (0.1, 0.3):
        array = small.model_copy(update={"reverberations": 1, "face_reflection": face})
        envelope = scan(tank, array, down(small, (4.0, -2.0, 682.0)), 1).envelope
        row = round(18 * array.assumed_speed / WATER.speed / array.scale_mm_per_px[1])
        levels.append(envelope[2 * row - 4 : 2 * row + 5].max() / envelope[row - 4 : row + 5].max())
    assert levels[1] / levels[0] == pytest.approx(3.0, rel=0.02)
    assert 20 * np.log10(levels[1] / (0.3 * bounce)) == pytest.approx(0, abs=6)


def test_a_wire_rings_but_does_not_come_again(small):
    """Echoes from its back follow within a diameter or two; at twice its depth there is nothing."""
    repeating = small.model_copy(update={"reverberations": 2})
    envelope = scan(filament(15.0), repeating, down(small, (0, 0, 0)), 1).envelope
    assert envelope[200:].max() < 1e-3 * envelope.max()


@pytest.mark.parametrize(("roughness", "most"), [(0.0, 0.03), (0.01, 0.15)])
def test_borders_echo_as_by_the_slow_way(small, roughness, most):
    """A rod within a larger one, turned a little: borders sought in small steps and by bisection send the same echoes.

    The quick march finds borders by a secant, a little off: that turns phases, and puts some facets of rough walls on the next
    patch, whose phase is another.
    """
    array = small.model_copy(update={"image_size": (24, 408), "reverberations": 2})
    outer, inner = (replace(TISSUES[name], roughness=roughness) for name in ("gelatin", "polymer"))
    parts = [rod(tissue).solids[0] for tissue in (outer, inner)]
    made = Body(WATER, (parts[0], replace(parts[1], distance=parts[1].distance + np.float32(3))), ())
    pose = down(array, (0.8, 0, 0)) @ rigid.from_rotation_vector([0.03, 0.05, -0.04], [0, 0, 0])
    spread, paths = beam(array), follow(made, array, pose)
    quick, slow = (way(made, array, spread, paths, pose, 5) for way in (surface_echoes, plain_sound.border_echoes))
    assert np.count_nonzero(slow) > 1000
    assert np.linalg.norm(quick - slow) < most * np.linalg.norm(slow)


@pytest.mark.parametrize("aside", np.arange(1.12, 1.36, 0.0615))
def test_borders_of_bodies_one_behind_the_other_echo_as_by_the_slow_way(small, aside):
    """Rays 1.2 mm beside the axes of two thin rods never get far from a border: where one's grid ends, the other's goes on."""
    array = small.model_copy(update={"image_size": (4, 408), "reverberations": 0})
    rough = replace(TISSUES["gelatin"], roughness=0.01)
    made = Body(WATER, tuple(rod(rough, depth, 2.0).solids[0] for depth in (12.0, 17.0)), ())
    pose, spread = down(array, (aside, 0, 0)), beam(array)
    paths = follow(made, array, pose)
    quick, slow = (way(made, array, spread, paths, pose, 5) for way in (surface_echoes, plain_sound.border_echoes))
    middle = slice(len(quick) // 2 - 2, len(quick) // 2 + 2)
    assert np.linalg.norm(quick[middle] - slow[middle]) <= 0.2 * np.linalg.norm(slow[middle])


def test_a_border_at_the_end_of_the_rays_is_no_trap(small):
    """A floor within a micrometre of the depth to which rays go, before it and behind."""
    array = small.model_copy(update={"image_size": (8, 408)})
    pose, spread = down(array, (0, 0, 0)), beam(array)
    deepest = scanner_at(array, spread, follow(Body(WATER, (), ()), array, pose), pose, 1).deepest_mm
    for off in np.linspace(-1e-6, 2e-6, 13):
        plate = shapes.moved(shapes.plate((60.0, 60.0), 20.0), rigid.transform(np.eye(3), (0, 0, deepest + off)))
        floor = Body(WATER, (solid(Thing("floor", plate, Material(0.5)), TISSUES["polymer"], None),), ())
        assert np.isfinite(surface_echoes(floor, array, spread, follow(floor, array, pose), pose, 1)).all()


@pytest.mark.parametrize("tilt", [0.0, 0.02])
def test_wires_echo_as_by_the_slow_way(small, tilt):
    """A rough wire, oblique in the slice, in water."""
    array = small.model_copy(update={"image_size": (24, 408)})
    ends = np.array([[1.0, -10.0, 20.0 - 10 * tilt], [-0.5, 10.0, 20.0 + 10 * tilt]])
    wire = Wire("wire", replace(TISSUES["steel"], roughness=0.01), ends, 0.1)
    pose = down(array, (0, 0, 0))
    spread, paths = beam(array), follow(Body(WATER, (), (wire,)), array, pose)
    quick = wire_echoes(Body(WATER, (), (wire,)), array, spread, paths, pose, 5)
    slow = plain_sound.wire_echoes(wire, WATER, array, spread, paths, pose, 5)
    assert np.count_nonzero(slow) > 10
    assert np.abs(quick - slow).max() < 1e-4 * np.abs(slow).max()
