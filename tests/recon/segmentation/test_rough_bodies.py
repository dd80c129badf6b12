"""Are bright, faint, small and shadowing bodies found, or named with their reasons, in even and in uneven tissue?"""

from dataclasses import replace
from operator import attrgetter

import numpy as np
import pytest
import trimesh
from scipy import ndimage
from scipy.special import ndtr

from recon.files.volumes import Volume
from recon.segmentation import left_out, masses, rough_bodies
from recon.segmentation.echo_power import EchoPower

SPACING = np.array(masses.SPACING_MM)
SIZE = (np.array([36, 36, 32]) / SPACING).astype(int)  # nx, ny, nz
CENTRE = np.array([3.0, 698.0, 14.0])
ORIGIN = CENTRE - [18.0, 14.0, 16.0]
LOOKS = 24 * SPACING.prod()  # independent cells of speckle in a voxel
REFINEMENTS = sum(masses.REFINEMENTS)
PLACES = ORIGIN + SPACING * np.moveaxis(np.mgrid[: SIZE[2], : SIZE[1], : SIZE[0]][::-1], 0, -1)


def icosphere(radius: float) -> trimesh.Trimesh:
    """A ball."""
    return trimesh.creation.icosphere(4, radius).apply_translation(CENTRE)


def away(radius: float, centre=CENTRE) -> np.ndarray:
    """Distance of all voxels from a ball's surface, mm."""
    return np.linalg.norm(PLACES - centre, axis=-1) - radius


def tissue(radius: float, level: float, centre=CENTRE) -> np.ndarray:
    """Mean power of tissue with a ball of another one, blurred over 0.3 mm."""
    return level + (1 - level) * ndtr(away(radius, centre) / 0.3)


def speckled(mean, rng) -> EchoPower:
    voxels = (mean * rng.gamma(LOOKS, 1 / LOOKS, mean.shape)).astype(np.float32)
    return EchoPower(Volume(voxels, ORIGIN, SPACING), np.full(mean.shape, LOOKS, np.float32))


def lobules(rng) -> np.ndarray:
    """Power of tissue of fat and gland, 8 dB apart, in lobules of some 10 mm."""
    return 10 ** (0.4 * np.sign(ndimage.gaussian_filter(rng.normal(size=PLACES.shape[:3]), 4 / SPACING[::-1])))


def even(first: rough_bodies.Rough) -> bool:
    return first.uneven_db < rough_bodies.FAINT.even_db


def volume_of(radius: float) -> float:
    return 4 / 3 * np.pi * radius**3


@pytest.mark.parametrize("level", [4.0, 0.45])
def test_a_bright_and_a_faint_ball_are_as_large_as_they_are(level, rng):
    """6 dB above and 3.5 dB below the tissue; 0.2 mm of a border in speckle is 12 % of a ball of 5 mm."""
    power = speckled(tissue(5.0, level), rng)
    first = rough_bodies.rough(power)
    assert even(first) and not first.masses
    (found,) = rough_bodies.faint(power, [], first).masses
    assert found.bright == (level > 1)
    (mass,) = masses.refined([found], power, REFINEMENTS)
    assert mass.volume == pytest.approx(volume_of(5.0), rel=0.06 if level > 1 else 0.12)
    assert np.linalg.norm(mass.centre - CENTRE) < (0.1 if level > 1 else 0.3)
    assert masses._stands_out(mass, power)


@pytest.mark.parametrize(("radius", "loss_db_mm", "fades"), [(5.0, 0.2, False), (5.0, 0.4, False), (9.0, 0.6, True)])
def test_a_bright_body_that_fades_into_its_shadow_has_no_back(radius, loss_db_mm, fades, rng):
    """6 dB above the tissue, at the backs of two still 4 and 2 dB; that of the last is 5 dB below it: what is bright ends within,
    with no border there.
    """
    way_mm = SPACING[1] * np.cumsum(away(radius) < 0, axis=1)
    power = speckled(tissue(radius, 4.0) * 10 ** (-loss_db_mm * way_mm / 10), rng)
    first = rough_bodies.rough(power)
    mass = max(
        masses.refined(rough_bodies.faint(power, [], first, signs=(1,)).masses, power, REFINEMENTS),
        key=attrgetter("volume"),
    )
    assert masses._fades(mass, power) == fades
    assert (mass.volume < 0.8 * volume_of(radius)) == fades
    weak = speckled(tissue(radius, 2.0), rng)
    assert not masses._fades(replace(mass, mesh=icosphere(radius)), weak), "3 dB and no loss: nothing falls behind it"
    behind, before = (replace(mass, mesh=mass.mesh.copy().apply_translation([0, mm, 0])) for mm in (6, -6))
    assert masses._behind(behind, mass, power) and not masses._behind(before, mass, power)


def test_even_tissue_alone_holds_nothing(rng):
    power = speckled(np.ones(PLACES.shape[:3]), rng)
    first = rough_bodies.rough(power)
    assert even(first) and not first.masses and not first.left_out
    assert rough_bodies.faint(power, [], first)[:2] == ([], [])


def test_a_body_of_weak_contrast_is_found_in_even_tissue_and_named_in_uneven(rng):
    """7 dB below; what it lies in has lobules as dark."""
    (mass,) = rough_bodies.rough(speckled(tissue(5.0, 0.2), rng)).masses
    assert mass.volume == pytest.approx(volume_of(5.0), rel=0.3)  # roughly
    first = rough_bodies.rough(speckled(np.where(away(5.0) < 0, 0.2, lobules(rng)), rng))
    named = [one for one in first.left_out if one.reason == "weak contrast"]
    assert not even(first) and any(np.linalg.norm(np.array(one.centre_mm) - CENTRE) < 2 for one in named)


def test_small_balls_are_found_or_named_by_their_size(rng):
    """5 mm in diameter, and 2.8 mm."""
    power = speckled(tissue(2.5, 0.05), rng)
    (found,) = rough_bodies.rough(power).masses
    (mass,) = masses.refined([found], power, REFINEMENTS)
    assert mass.volume == pytest.approx(volume_of(2.5), rel=0.15) and np.linalg.norm(mass.centre - CENTRE) < 0.15
    first = rough_bodies.rough(speckled(tissue(1.4, 0.02), rng))
    (one,) = first.left_out
    assert not first.masses and one.reason == "small" and np.linalg.norm(np.array(one.centre_mm) - CENTRE) < 0.5


def test_noise_in_fluid_is_no_rise_behind_it(rng):
    """Power of fluid without echoes is noise, by 10 dB more in its lower half."""
    noise = np.where(PLACES[..., 1] < CENTRE[1], 1e-4, 1e-3)
    mean = noise + (1 - noise) * ndtr(away(6.0) / 0.3)
    power = speckled(mean, rng)
    (mass,) = masses.refined(rough_bodies.rough(power).masses, power, REFINEMENTS)
    assert mass.volume == pytest.approx(volume_of(6.0), rel=0.04)


def test_a_body_whose_shadow_reaches_the_dark_behind_the_tissue_is_named_at_its_place(rng):
    """The dark begins 30 mm deep, and the shadow of a ball half as deep joins it."""
    places = PLACES - CENTRE
    shadow = (np.hypot(places[..., 0], places[..., 2]) < 5) & (places[..., 1] > 0)
    mean = np.where(shadow | (places[..., 1] > 16), 0.02, tissue(5.0, 0.02))
    first = rough_bodies.rough(speckled(mean, rng))
    (one,) = [one for one in first.left_out if one.reason == "its shadow hides its back"]
    assert not first.masses and np.linalg.norm(np.array(one.centre_mm) - CENTRE) < 2.0
    plain = rough_bodies.rough(speckled(np.where(places[..., 1] > 16, 0.02, 1.0), rng))
    assert not any(one.reason == "its shadow hides its back" for one in plain.left_out)


def test_a_body_that_begins_at_the_face_is_named_so_and_gel_isnt(rng):
    """Tissue is on both sides of the one; the other is dark all along the face."""
    top = CENTRE - [0.0, 14.0, 0.0]
    (one,) = rough_bodies.rough(speckled(tissue(4.0, 0.03, top), rng)).left_out
    assert one.reason == "cut by the ringing at the face" and one.text.endswith("scan there through more gel")
    gel = np.where(PLACES[..., 1] < top[1] + 4 + PLACES[..., 0] / 8, 0.01, 1.0)
    bay = top[1] + 5 - np.hypot(PLACES[..., 0] - top[0], PLACES[..., 2] - top[2]) ** 2 / 40  # over a hollow of the skin
    for mean in (gel, np.where(PLACES[..., 1] < bay, 0.01, 1.0)):
        assert not [one for one in rough_bodies.rough(speckled(mean, rng)).left_out if one.reason not in left_out.UNLIKELY]


def test_what_is_bright_with_nothing_behind_it_is_what_the_tissue_lies_on(rng):
    """A table that shines, 6 mm thick in B-scans, in part of the scan."""
    places = PLACES - CENTRE
    table = (places[..., 1] > 8) & (places[..., 1] < 14) & (np.abs(places[..., 0]) < 9) & (np.abs(places[..., 2]) < 9)
    mean = np.where(table, 4.0, np.where(places[..., 1] >= 14, 0.02, 1.0))
    power = speckled(mean, rng)
    found = rough_bodies.faint(power, [], rough_bodies.rough(power))
    assert not found.masses and [one.reason for one in found.left_out] == ["behind the tissue"]


def test_what_was_left_out_is_read_back(rng, tmp_path):
    """And nothing of a folder that has no such file."""
    found = tuple(rough_bodies.rough(speckled(tissue(1.4, 0.02), rng)).left_out)
    left_out.write(tmp_path / left_out.FILE, found)
    assert left_out.read(tmp_path / left_out.FILE) == found and left_out.read(tmp_path / "other.json") == ()


def test_unseen_and_black_depths_leave_even_tissue_even(rng):
    """20 mm of black below 16 mm of tissue, where no level is near."""
    places = PLACES - CENTRE
    assert even(rough_bodies.rough(speckled(np.where(places[..., 1] > 2, 0.0, 1.0), rng)))


def test_a_bright_body_that_the_scan_cuts_is_named_and_a_bright_layer_at_its_end_is_listed(rng):
    """Such a layer is skin, or what the tissue lies on: hardly a mass, and said without a warning."""
    last = int((CENTRE[2] - ORIGIN[2] + 1.0) / SPACING[2])
    layer = np.where(PLACES[..., 1] > PLACES[..., 1].max() - 4, 4.0, 1.0)
    for mean, reason in ((tissue(5.0, 4.0)[:last], "cut by the sweep's end"), (layer, "at the scan's edge")):
        power = speckled(mean, rng)
        found = rough_bodies.faint(power, [], rough_bodies.rough(power))
        assert not found.masses and [one.reason for one in found.left_out] == [reason]


@pytest.mark.parametrize(("radius", "told"), [(2.8, True), (1.5, False)])
def test_a_faint_body_too_small_to_be_measured_is_named(radius, told, rng):
    """4 dB above the tissue, of 92 and 14 mm3, less of which is seen so bright."""
    power = speckled(tissue(radius, 2.5), rng)
    found = rough_bodies.faint(power, [], rough_bodies.rough(power))
    assert not found.masses and [one.reason for one in found.left_out] == told * ["small"]


def begun(gap=None) -> rough_bodies.Rough:
    """A search that found nothing."""
    none = np.zeros(PLACES.shape[:3], bool)
    return rough_bodies.Rough([], [], 4.0, none, none if gap is None else gap)


def looks(*balls) -> EchoPower:
    """Mean probabilities of masses: balls (radius, probability, centre)."""
    chance = np.zeros(PLACES.shape[:3])
    for radius, share, centre in balls:
        chance = np.maximum(chance, share * (away(radius, centre) < 0))
    return EchoPower(Volume(chance.astype(np.float32), ORIGIN, SPACING), np.full(chance.shape, LOOKS, np.float32))


def test_bodies_that_look_like_masses_are_found_with_their_brightness(rng):
    """A smoothing by s moves a ball's border of radius r by s^2 / r inwards, and half of it lies 0.07 s within 0.95's half."""
    for level in (0.2, 4.0):
        (mass,) = rough_bodies.likely(looks((5.0, 0.95, CENTRE)), speckled(tissue(5.0, level), rng), begun()).masses
        assert mass.bright == (level > 1) and np.linalg.norm(mass.centre - CENTRE) < 0.1
        assert mass.volume == pytest.approx(volume_of(5.0 - 0.2 - 0.07), rel=0.04)


def test_bodies_that_may_be_masses_are_named(rng):
    """Unsure ones, small ones, and those that a side, an end, a gap or the images' lower end cuts, each as what it is."""
    power = speckled(np.ones(PLACES.shape[:3]), rng)
    low, high = ORIGIN, ORIGIN + SPACING * SIZE
    cases = {
        "unsure": (5.0, 0.4, CENTRE),
        "small": (2.2, 0.95, CENTRE),
        "cut by the images' side": (4.0, 0.9, [low[0], *CENTRE[1:]]),
        "cut by the sweep's end": (4.0, 0.9, [*CENTRE[:2], high[2]]),
        "cut by the images' lower end": (4.0, 0.9, [CENTRE[0], high[1], CENTRE[2]]),
    }
    for reason, ball in cases.items():
        found = rough_bodies.likely(looks(ball), power, begun())
        assert [one.reason for one in found.left_out] == [reason] and not found.masses
        assert np.linalg.norm(np.array(found.left_out[0].centre_mm) - ball[2]) < 3


def test_a_body_in_a_gap_is_cut_by_it(rng):
    """Seen on both sides of 5 mm that no B-scan shows."""
    chance, power = looks((5.0, 0.9, CENTRE)), speckled(np.ones(PLACES.shape[:3]), rng)
    gap = np.abs(PLACES[..., 2] - CENTRE[2]) < 2.5
    chance.weight[gap], chance.volume.voxels[gap] = 0, 0
    found = rough_bodies.likely(chance, power, begun(gap))
    assert {one.reason for one in found.left_out} == {"cut by a gap in the sweep"} and not found.masses


def test_what_lies_between_two_scans_of_a_stroke_is_no_gap_beside_another_stroke(rng):
    """Sheets between B-scans are unseen but where a stroke beside covers them; a body there is whole."""
    chance, power = looks((5.0, 0.9, CENTRE)), speckled(np.ones(PLACES.shape[:3]), rng)
    between = (np.arange(SIZE[2]) % 2 == 1)[:, None, None] & (np.abs(PLACES[..., 0] - CENTRE[0]) < 12)
    chance.weight[between], chance.volume.voxels[between] = 0, 0
    assert len(rough_bodies.likely(chance, power, begun()).masses) == 1
