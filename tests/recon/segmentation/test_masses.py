"""Are dark bodies found, and as large as they are, in averaged power with walls and shadows?"""

import re
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from scipy import ndimage
from scipy.special import ndtr

from recon.errors import InputError
from recon.files.volumes import Volume
from recon.segmentation import masses, rough_bodies
from recon.segmentation.echo_power import EchoPower
from recon.segmentation.left_out import UNLIKELY
from recon.segmentation.mass_network import Looks
from recon.segmentation.mass_surface import Mass
from recon.segmentation.masses import refined
from recon.segmentation.rough_bodies import rough, say

SPACING = np.array(masses.SPACING_MM)
SIZE = (np.array([36, 36, 32]) / SPACING).astype(int)  # nx, ny, nz
CENTRE, RADIUS = np.array([3.0, 698.0, 14.0]), 5.0
ORIGIN = CENTRE - [18.0, 14.0, 16.0]
DARK = 0.05  # of tissue's power
LOOKS = 24 * SPACING.prod()  # independent cells of speckle in a voxel
PULSE_MM = 0.063  # sigma of an echo's power along the beam


def grid():
    """Places of the voxels : (nz, ny, nx, 3) mm."""
    k, j, i = np.mgrid[: SIZE[2], : SIZE[1], : SIZE[0]]
    return ORIGIN + SPACING * np.stack([i, j, k], axis=-1)


def speckled(mean, rng, looks=LOOKS):
    voxels = (mean * rng.gamma(looks, 1 / looks, mean.shape)).astype(np.float32)
    return EchoPower(Volume(voxels, ORIGIN, SPACING), np.full(mean.shape, looks, np.float32))


def ball():
    """Mean power of a dark ball, blurred over 0.3 mm, and the distance to its border."""
    distance = np.linalg.norm(grid() - CENTRE, axis=-1) - RADIUS
    return DARK + (1 - DARK) * ndtr(distance / 0.3), distance


def find(power):
    first = rough(power)
    say(first.left_out)
    return refined(first.masses, power, masses.REFINEMENTS[-1])


VOLUME = 4 / 3 * np.pi * RADIUS**3


def test_a_ball_is_as_large_as_it_is(rng):
    """A border of 314 mm2 in speckle of 82 % a voxel is known to some 0.02 mm, 1.2 % of the volume; 4 % is over 3 sigma."""
    (mass,) = find(speckled(ball()[0], rng))
    assert mass.mesh.is_watertight
    assert mass.volume == pytest.approx(VOLUME, rel=0.04)
    assert np.linalg.norm(mass.centre - CENTRE) < 0.12


def test_a_body_larger_than_its_surroundings_count_is_no_hollow_one(rng):
    """48 mm wide: from its middle no tissue is within reach."""
    step, radius = 1.5, 24.0
    distance = step * np.linalg.norm(np.mgrid[-22:23, -22:23, -22:23], axis=0)
    mean = np.where(distance < radius, DARK, 1.0)
    voxels = (mean * rng.gamma(40, 1 / 40, mean.shape)).astype(np.float32)
    (mass,) = rough(EchoPower(Volume(voxels, np.zeros(3), np.full(3, step)), np.full(mean.shape, 40, np.float32))).masses
    assert mass.volume == pytest.approx(4 / 3 * np.pi * radius**3, rel=0.05) and mass.mesh.body_count == 1


def test_a_bright_wall_does_not_change_it(rng):
    """The front reflects, 6 times as bright as tissue at most. At half level the border would lie 0.4 mm inside of it there."""
    mean, distance = ball()
    places = grid() - CENTRE
    square = np.clip(-places[..., 1] / np.maximum(np.linalg.norm(places, axis=-1), 0.1), 0, 1)
    (mass,) = find(speckled(mean + 5 * square**8 * np.exp(-((distance / 0.3) ** 2) / 2), rng))
    assert mass.volume == pytest.approx(VOLUME, rel=0.05)
    assert np.linalg.norm(mass.centre - CENTRE) < 0.2


def test_a_line_as_thin_as_the_pulse_moves_the_front_little(rng):
    """Thrice as bright as tissue it passes for a step nearby: 0.12 mm too deep, in voxels of 0.5 mm along the beam 0.20 mm."""
    _, distance = ball()
    places = grid() - CENTRE
    outwards = places / np.maximum(np.linalg.norm(places, axis=-1, keepdims=True), 0.1)
    width = np.sqrt(PULSE_MM**2 + outwards**2 @ SPACING**2 / 6)  # shared out to voxels
    line = 3 * np.clip(-outwards[..., 1], 0, 1) ** 8 * PULSE_MM / width * np.exp(-((distance / width) ** 2) / 2)
    border = DARK + (1 - DARK) * ndtr(distance / np.hypot(0.15, SPACING[0] / np.sqrt(6)))
    (mass,) = find(speckled(border + line, rng, looks=1.7 * LOOKS))
    out = np.asarray(mass.mesh.vertices) - CENTRE
    radii = np.linalg.norm(out, axis=1)
    assert radii[-out[:, 1] > 0.9 * radii].mean() == pytest.approx(RADIUS, abs=0.16)


def test_what_reaches_the_images_end_is_no_mass(rng):
    """A shadow to the bottom, gel above the tissue, and tissue alone."""
    places = grid() - CENTRE
    shadow = np.where((np.hypot(places[..., 0], places[..., 2]) < 4) & (places[..., 1] > 0), DARK, 1.0)
    gel = np.where(places[..., 1] < -10, 0.01, 1.0)
    assert find(speckled(shadow, rng)) == []
    assert find(speckled(gel, rng)) == []
    assert find(speckled(np.ones(shadow.shape), rng)) == []


def test_a_mass_that_the_scans_end_cuts_is_told(rng, caplog):
    """Nine tenths of it are in the scan. What is dark all along an end, as behind a phantom, isn't told."""
    mean, _ = ball()
    last = int((CENTRE[2] - ORIGIN[2] + 0.8 * RADIUS) / SPACING[2])
    seen = speckled(mean[:last], rng)
    assert not find(seen)
    (told,) = caplog.messages
    found = re.fullmatch(
        r"a dark body is cut by the sweep's end, .*: (\d+) mm3 of it at 3, 698, 1[34] mm, 10 x .*; scan on there", told
    )
    assert 0.6 * VOLUME < float(found[1]) < VOLUME
    caplog.clear()
    mean[:, -20:] = DARK
    assert len(find(speckled(mean, rng))) == 1 and not caplog.messages


@pytest.mark.parametrize(("axis", "border"), [(0, "the sweep's end"), (2, "the images' side")])
@pytest.mark.parametrize("share", [0.25, 0.65])
def test_a_body_of_which_any_part_is_seen_is_named_with_what_cuts_it(axis, border, share, rng, caplog):
    """A quarter of its width, 13 % of its volume, and more; it shadows what lies behind, most just behind its edges."""
    mean, distance = ball()
    places = grid() - CENTRE
    beside = np.hypot(places[..., 0], places[..., 2]) - RADIUS
    behind = (places[..., 1] > 0) & (distance > 0)
    edges = behind * np.exp(-((beside / 0.9) ** 2) / 2 - np.maximum(places[..., 1], 0) / 14)
    mean = mean * np.where(behind & (beside < -0.9), 0.3, 1) * (1 - 0.9 * edges)
    last = int(((CENTRE - ORIGIN)[::-1][axis] + (2 * share - 1) * RADIUS) / SPACING[::-1][axis])
    part = tuple(slice(last) if one == axis else slice(None) for one in range(3))
    assert not find(speckled(mean[part], rng))
    (told,) = caplog.messages
    volume, *extents = (float(word) for word in re.findall(r"([\d.]+) (?:mm3|x|mm;)", told))
    assert f"cut by {border}" in told and (distance[part] < 0).sum() * SPACING.prod() == pytest.approx(volume, rel=0.4)
    assert extents[2 - axis] == pytest.approx(2 * share * RADIUS, abs=1) and min(extents[1], extents[axis]) > 6


def with_gap(power, first, width_mm, axis=0):
    """The same without what lies in a slab across the sweep, or along it between two strokes."""
    lost = [slice(None)] * 3
    lost[axis] = slice(first, first + round(width_mm / SPACING[::-1][axis]))
    power.volume.voxels[tuple(lost)], power.weight[tuple(lost)] = 0, 0
    return power


@pytest.mark.parametrize(("axis", "where"), [(0, "in the sweep"), (2, "between strokes")])
@pytest.mark.parametrize("width_mm", [4.0, 7.0])
def test_a_body_that_a_gap_cuts_is_named_and_so_is_the_gap(axis, where, width_mm, rng, caplog):
    """The ball of 10 mm is lost in part, and is no mass."""
    middle = int((CENTRE - ORIGIN)[::-1][axis] / SPACING[::-1][axis])
    assert not find(with_gap(speckled(ball()[0], rng), middle - round(width_mm), width_mm, axis))
    gap, *bodies = caplog.messages
    found = re.fullmatch(rf"a gap of (\S+) mm {where}, (\d+) mm3 about \d, 70\d, 1\d mm, wasn't scanned: .*", gap)
    across = 36 * (36 if axis == 0 else 32)
    assert float(found[1]) == width_mm and float(found[2]) == pytest.approx(across * width_mm, rel=0.1)
    cut = "a gap in the sweep" if axis == 0 else "the images' side"
    assert bodies and all(f"is cut by {cut}" in one for one in bodies)


def test_a_gap_that_hides_no_mass_of_some_size_is_bridged_or_a_line_of_its_own(rng, caplog):
    """A mass is found over 2 and 3 mm, and beside 5 mm."""
    middle = int((CENTRE[2] - ORIGIN[2]) / SPACING[2])
    for width_mm in (2.0, 3.0):
        (mass,) = find(with_gap(speckled(ball()[0], rng), middle - round(width_mm), width_mm))
        assert mass.volume == pytest.approx(VOLUME, rel=0.06) and not caplog.messages
    assert len(find(with_gap(speckled(ball()[0], rng), 3, 5.0))) == 1
    (told,) = caplog.messages
    assert told.startswith("a gap of 5.0 mm in the sweep")


def test_a_hand_that_goes_up_and_down_leaves_no_gap(rng, caplog):
    """By 2 mm, as in breathing: images end now higher, now deeper."""
    power = speckled(ball()[0], rng)
    for k, mm in enumerate(2 - 2 * np.cos(4 * np.pi * np.arange(SIZE[2]) / SIZE[2])):
        rows = round(mm / SPACING[1])
        power.weight[k, -1 - rows :], power.weight[k, : round((4 - mm) / SPACING[1])] = 0, 0
    assert len(find(power)) == 1 and not caplog.messages


def test_b_scans_far_apart_pass_by_a_mass_and_shadows_hide_it(rng):
    """A quarter of its slices is scanned; in the shadow of others a fifth of these stay."""
    power = speckled(ball()[0], rng)
    (mass,) = find(power)
    slices = np.arange(SIZE[2])
    power.weight[slices % 4 > 0] = 0
    kept, left_out = masses._without_shadows([mass], power, power)
    assert kept == [mass] and not left_out
    shaded = EchoPower(power.volume, np.where((slices % 20 == 0)[:, None, None], power.weight, 0))
    kept, left_out = masses._without_shadows([mass], shaded, power)
    assert not kept and [one.reason for one in left_out] == ["in the shadow of a mass"]


@pytest.mark.parametrize("share", [0.35, 0.8])
def test_a_body_that_the_images_lower_end_cuts_asks_for_depth(share, rng, caplog):
    last = int(((CENTRE - ORIGIN)[1] + (2 * share - 1) * RADIUS) / SPACING[1])
    assert not find(speckled(ball()[0][:, :last], rng))
    (told,) = caplog.messages
    assert "is cut by the images' lower end, and is left out" in told and told.endswith("mm; set a greater depth")


@pytest.mark.parametrize("dark", ["from the face on", "along the lower end", "at the side, all the way down"])
def test_what_is_dark_without_tissue_before_it_is_no_body(dark, rng, caplog):
    """Where the array's end is lifted off, behind a phantom, and in the shadow of something beside the images."""
    places, size = grid() - CENTRE, grid()[-1, -1, -1] - CENTRE
    lifted, lower = (places[..., 0] > size[0] - 5) & (places[..., 1] < 0), places[..., 1] > size[1] - 6
    shadow = places[..., 0] > size[0] - 3
    where = {"from the face on": lifted, "along the lower end": lower, "at the side, all the way down": shadow}[dark]
    assert not find(speckled(np.where(where, DARK, 1.0), rng)) and not caplog.messages


def test_the_dark_behind_a_phantom_is_no_cut_body_and_hides_none(rng, caplog):
    """Turned planes see it end at many depths, partly in noise that the scanner's gain lifts; the mass before it is whole."""
    mean, _ = ball()
    places = grid() - CENTRE
    floor, deep = places[..., 1] - 8, 1.0 + np.abs(places[..., 2]) / 8
    mean = np.where(floor > 0, np.where(floor > 7, 0.2, DARK), mean)
    power = speckled(mean, rng)
    power.weight[places[..., 1] > 20 - 3 * deep] = 0
    power.weight[np.abs(places[..., 0]) > 16 - deep] = 0
    (mass,) = find(power)
    assert mass.volume == pytest.approx(VOLUME, rel=0.05) and not caplog.messages


def test_a_streak_down_the_beam_is_no_mass(rng, caplog):
    """The shadow of a border beside the scan: 6 mm thick, 20 mm down the beam, with tissue on all sides."""
    places = grid() - CENTRE
    streak = (np.abs(places[..., 0]) < 3) & (np.abs(places[..., 1] - 1) < 10) & (np.abs(places[..., 2]) < 4)
    assert not find(speckled(np.where(streak, DARK, 1.0), rng))
    (told,) = caplog.messages
    assert re.match(
        r"a streak from 3, 69[12], 14 mm on, (19|20) mm down the beam and [56] mm thick, is left out: a shadow ", told
    )
    assert told.endswith("of a border, or a body longer down the beam than 2.5 times its thickness")


def test_the_level_of_tissue_is_that_of_images_with_a_pose():
    """Three of five images are of air, before the target was seen; and gel all over is no tissue."""
    images, matrices = np.zeros((5, 200, 40), np.uint8), np.tile(np.diag([0.2, 0.2, 0.2, 1.0]), (5, 1, 1))
    images[3:] = 136
    matrices[:3] = np.nan
    assert masses.tissue_grey(iter(images), (200, 40), matrices) == 136
    with pytest.raises(InputError, match=r"images: expected tissue in the upper half .* found 4 \(median\): gel"):
        masses.tissue_grey(iter(np.full((5, 200, 40), 4, np.uint8)), (200, 40), matrices)
    with pytest.raises(InputError, match="images: expected more than 6 mm of depth, found 20 rows, of which 15 are ringing"):
        masses.tissue_grey(iter(images[:, :20]), (20, 40), matrices)


def test_a_shape_that_is_not_the_images_is_refused():
    """Height comes first; taken for width and height, a transposed part of the scan would be searched."""
    matrices = np.tile(np.diag([0.2, 0.2, 0.2, 1.0]), (3, 1, 1))
    with pytest.raises(InputError, match=r"shape: expected that of the images, height and width, .* \(40, 200\).*200, 40"):
        masses.from_scans(lambda: iter(np.full((3, 200, 40), 100, np.uint8)), (40, 200), matrices)
    with pytest.raises(InputError, match="shape: expected height and width in px"):
        masses.from_scans(lambda: iter(()), 200, matrices)


@pytest.mark.parametrize("shape", [(9, 30, 21), (1, 12, 40), (40, 5, 3)])
def test_a_blur_is_a_gaussian_filter(rng, shape):
    """Another width along each axis, axes shorter than the kernel too."""
    field, sigma = rng.normal(size=shape).astype(np.float32), np.array([0.8, 2.3, 5.1])
    np.testing.assert_allclose(rough_bodies._blurred(field, sigma), ndimage.gaussian_filter(field, sigma), atol=1e-6)
    wide = np.array([6.0, 30.0, 11.0])
    exact = ndimage.gaussian_filter(field.astype(float), wide, truncate=8)
    np.testing.assert_allclose(rough_bodies._widely_blurred(field, wide), exact, atol=1e-6)


@pytest.mark.parametrize("spacing", [(0.5, 0.5, 0.5), (0.9, 0.4, 0.25), (4.0, 0.3, 0.5)])
def test_an_opening_is_one_by_distances(rng, spacing):
    """Bodies of all sizes, some at the faces of the volume; the same as by exact distances from and to all voxels."""
    mask = ndimage.gaussian_filter(rng.normal(size=(16, 40, 48)), 3 / np.array(spacing) / 2) > 0
    core = ndimage.distance_transform_edt(mask, spacing) > 1.5
    assert 0 < core.sum() < mask.sum() < mask.size
    opened = mask & (ndimage.distance_transform_edt(~core, spacing) <= 1.75)
    np.testing.assert_array_equal(rough_bodies._opened(mask, 1.5, np.array(spacing)), opened)


NEAR, FAR = (13.0, 15.0, 16.0), (28.0, 24.0, 16.0)  # middles of a very dark and a dark ball, mm
BLACK = SimpleNamespace(run=lambda _, given: [40 * (0.2 - ndimage.gaussian_filter(given["scan"], (0, 0, 1.5, 1.5)))])
"""stands in for the network: a mass is what is nearly black"""


PIXEL_MM, APART_MM = 0.25, 0.8  # of 41 B-scans (160, 160)


def scan_places():
    """Places of the pixels of B-scans side by side : (3, 41, 160, 160) mm."""
    k, v, u = np.mgrid[:41, :160, :160].astype(np.float32)
    return np.stack([u * PIXEL_MM, v * PIXEL_MM, k * APART_MM])


def speckled_scans(level, rng):
    """B-scans of tissue of a level : (41, 160, 160) dB, and their poses."""
    speckle = 10 * np.log10(rng.exponential(1.0, level.shape))
    poses = np.tile(np.diag([PIXEL_MM, PIXEL_MM, 1.0, 1.0]), (len(level), 1, 1))
    poses[:, 2, 3] = APART_MM * np.arange(len(level))
    return np.clip(140 + 255 / 60 * (level + speckle), 0, 255).astype(np.uint8), poses


def grown_scans(rng, shadow=False):
    """B-scans (160, 160) 0.8 mm apart of lobules 8 dB apart, with both balls in them, and their poses."""
    places = scan_places()
    level = 4 * np.sign(ndimage.gaussian_filter(rng.standard_normal(places.shape[1:]), (2, 7, 7)))
    for centre, radius, depth in ((NEAR, 5.0, -30.0), (FAR, 4.0, -14.0)):
        away = np.linalg.norm(places - np.reshape(centre, (3, 1, 1, 1)), axis=0) - radius
        level = np.where(away < 0, depth, level)
    if shadow:
        beside = np.hypot(places[0] - NEAR[0], places[2] - NEAR[2])
        level = np.where((beside < 5) & (places[1] > NEAR[1]), -30.0, level)
    return speckled_scans(level, rng)


def test_in_grown_tissue_looks_tell_masses(rng, caplog):
    """One ball is found and measured, by its border's fit; the other looks like tissue to the network, and is listed so, once.

    By power alone both are masses. What is said is listed. Lobules that touch the border, half as dark, move it by up to 0.3 mm.
    """
    images, poses = grown_scans(rng)
    found = masses.from_scans(lambda: iter(images), (160, 160), poses, looks=Looks(network=BLACK))
    (mass,) = found.masses
    assert found.uneven_db > 2.8 and np.linalg.norm(mass.centre - NEAR) < 0.3
    assert mass.volume == pytest.approx(VOLUME, rel=0.2)
    (denied,) = (one for one in found.left_out if np.linalg.norm(np.array(one.centre_mm) - FAR) < 3)
    assert denied.reason == "looks like tissue"
    assert {one.text for one in found.left_out} >= set(caplog.messages)
    without = masses.from_scans(lambda: iter(images), (160, 160), poses, looks=Looks("never"))
    assert len(without.masses) == 2


def test_a_mass_by_looks_whose_back_is_hidden_is_no_mass(rng):
    images, poses = grown_scans(rng, shadow=True)
    found = masses.from_scans(lambda: iter(images), (160, 160), poses, looks=Looks(network=BLACK))
    near = [one.reason for one in found.left_out if np.linalg.norm(np.array(one.centre_mm)[::2] - [NEAR[0], NEAR[2]]) < 3]
    assert not found.masses and near


def ball_scans(rng, first, first_db, loss_db_mm, second, second_db):
    """B-scans (160, 160) 0.8 mm apart of even tissue with two balls : x, y, z, radius, of which the first absorbs; poses."""
    places = scan_places()
    within, behind = (
        np.linalg.norm(places - np.reshape(centre, (3, 1, 1, 1)), axis=0) < radius for *centre, radius in (first, second)
    )
    level = first_db * within + second_db * behind - loss_db_mm * PIXEL_MM * np.cumsum(within, axis=1)
    return speckled_scans(level, rng)


def reasons_near(left_out, centre):
    """Of what is left out within 4 mm of a place."""
    return [one.reason for one in left_out if np.linalg.norm(np.subtract(one.centre_mm, centre)) < 4]


def test_a_bright_mass_that_fades_is_named_and_so_is_what_lies_behind_it(rng):
    """6 dB above even tissue, and 5 dB below it at its back by its own loss; with a ball in its shadow, 8 dB darker."""
    images, poses = ball_scans(rng, (20, 15, 16, 9.0), 6.0, 0.6, (20, 31, 16, 3.0), -8.0)
    found = masses.from_scans(lambda: iter(images), (160, 160), poses)
    assert not found.masses
    for centre, reason in (((20, 15, 16), "its shadow hides its back"), ((20, 31, 16), "cut by the images' lower end")):
        assert reason in reasons_near(found.left_out, centre) and reason not in UNLIKELY


@pytest.mark.parametrize(("loss_db_mm", "found_behind"), [(0.0, True), (0.5, True), (0.8, False)])
def test_a_mass_in_the_shadow_of_another_is_found_or_named(loss_db_mm, found_behind, rng):
    """Both 14 dB below even tissue. A third of the power comes through the first; a sixth, in which one of 6 mm is small."""
    first, second = (20.0, 12.0, 16.0), (20.0, 26.0, 16.0)
    images, poses = ball_scans(rng, (*first, 5.0), -14.0, loss_db_mm, (*second, 3.0), -14.0)
    found = masses.from_scans(lambda: iter(images), (160, 160), poses)
    places = [mass.centre for mass in found.masses]
    assert len(places) == 1 + found_behind and np.linalg.norm(places[0] - first) < 0.3
    assert (reasons_near(found.left_out, second) == ["small"]) != found_behind


def test_a_mass_that_lets_nothing_through_is_named(rng):
    """Its shadow is as dark as itself to the images' end."""
    place = (20.0, 12.0, 16.0)
    images, poses = ball_scans(rng, (*place, 5.0), -14.0, 1.6, (20, 20, 16, 0.0), 0.0)
    found = masses.from_scans(lambda: iter(images), (160, 160), poses)
    (told,) = found.left_out
    assert not found.masses and told.reason == "its shadow hides its back" and "the images' lower end" in told.text
    assert np.linalg.norm(np.subtract(told.centre_mm, place)) < 1 and told.extents_mm == pytest.approx((10, 10, 10), abs=1.5)


def test_a_body_that_is_brighter_towards_its_back_has_its_shadow_on_it(monkeypatch):
    """Of the ball come 5 % of tissue's power, of its shadow 20 %. What comes through must exceed 1.5 of its own, and more."""
    mean, distance = ball()
    places = grid() - CENTRE
    shadow = (np.hypot(places[..., 0], places[..., 2]) < RADIUS) & (places[..., 1] > 0) & (distance > 0)
    power = EchoPower(Volume(np.where(shadow, 0.2, mean).astype(np.float32), ORIGIN, SPACING), np.ones(mean.shape, np.float32))
    whole = trimesh.creation.icosphere(4, RADIUS)
    with_shadow = whole.copy()
    with_shadow.vertices[with_shadow.vertices[:, 1] > 0] *= [1, 2, 1]

    def why(mesh, through):
        monkeypatch.setattr(masses, "passed", lambda *_: through)
        return masses._no_back(None, None, [Mass(mesh.copy().apply_translation(CENTRE))], 0, None, power)

    assert why(whole, 0.2) == ""
    assert why(whole, 0.15).startswith("it is dark behind it")
    assert why(with_shadow, 0.5).startswith("it grows brighter towards its back")


def test_a_body_taller_than_wide_with_a_shadow_may_have_it_on_it(monkeypatch):
    """If half of tissue's power comes through at most. Without tissue behind, no back is known."""
    mean, _ = ball()
    power = EchoPower(Volume(np.full_like(mean, 0.1), ORIGIN, SPACING), np.ones(mean.shape, np.float32))

    def why(stretch, through, radius=RADIUS):
        mesh = trimesh.creation.icosphere(4, radius)
        mesh.vertices *= [1, stretch, 1]
        monkeypatch.setattr(masses, "passed", lambda *_: through)
        return masses._no_back(None, None, [Mass(mesh.apply_translation(CENTRE))], 0, None, power)

    deep, wide = 1.35 * 2 * RADIUS, 2 * RADIUS
    assert why(1.35, 0.4) == f"it is {deep:.0f} mm deep, {wide:.0f} mm wide at most, and has a shadow, which may hang on to it"
    assert why(1.25, 0.4) == why(1.35, 0.6) == why(1.35, 0.4, 4.0) == ""
    assert why(1.0, np.inf) == "no tissue is seen behind it, so its back isn't told from its shadow's end"


def test_behind_a_mass_lies_what_is_deeper_and_no_farther_aside_than_it_is_wide():
    mean, _ = ball()
    power = EchoPower(Volume(mean, ORIGIN, SPACING), np.ones(mean.shape, np.float32))
    first = Mass(trimesh.creation.icosphere(2, 4.0).apply_translation(CENTRE))

    def behind(shift, beside_mm=0.0):
        return masses._behind(Mass(trimesh.creation.icosphere(2, 1.0).apply_translation(CENTRE + shift)), first, power, beside_mm)

    assert behind([3.0, 15.0, 0.0]) and not behind([3.0, -15.0, 0.0]) and not behind([6.0, 15.0, 0.0])
    assert behind([6.0, 15.0, 6.0], 3.0) and not behind([6.0, 15.0, 8.0], 3.0)


def test_what_gel_adds_makes_no_body_and_hides_none(rng):
    """Gel over the array's end adds 0.7 dB/mm to what lies behind it, to the images' end, where a bright mass touches that."""
    place = (26.0, 20.0, 16.0)
    images, poses = ball_scans(rng, (*place, 6.0), 6.0, 0.0, (20, 20, 16, 0.0), 0.0)
    u_mm, v_mm = 0.25 * np.arange(160), 0.25 * np.arange(160)[:, None]
    gel_mm = np.clip((u_mm - 20) * 0.5, 0, 8)
    images = np.clip(images + 255 / 60 * 0.7 * gel_mm, 0, 255)
    images = np.where(v_mm < gel_mm, 0, images).astype(np.uint8)
    found = masses.from_scans(lambda: iter(images), (160, 160), poses)
    (mass,) = found.masses
    assert np.linalg.norm(mass.centre - place) < 0.3 and mass.volume == pytest.approx(4 / 3 * np.pi * 6**3, rel=0.08)
