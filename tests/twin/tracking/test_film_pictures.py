"""Frames of films: are the layers where they should be, and are interpolated and evened values those of the light?"""

import numpy as np
import pytest

from twin.shooting import FilmQuality
from twin.tracking.film_pictures import (
    BEYOND,
    Arriving,
    Cells,
    Pixels,
    arriving,
    composed,
    fine_cells,
    near_cells,
    resized,
    sharp_pixels,
    visible_shares,
)
from twin.tracking.moving_transport import NO_CIRCLE, Light
from twin.tracking.target_truth import ViewTruth

SIZE = (320, 256)


def light_of(radiance, held=None, unheld=None):
    """Light of which as much arrives as there is, on held bodies where `held`; `unheld` without these."""
    radiance = np.float32(radiance)
    zero, held = np.zeros_like(radiance), np.zeros_like(radiance) if held is None else np.float32(held)
    unheld = (1 - held) * radiance if unheld is None else np.float32(unheld)
    return Light(radiance, radiance, zero, zero, zero, zero, held, held * radiance, held * radiance, unheld)


def truth_of(rows, blur=0.0):
    rows = np.array(rows, float)
    return ViewTruth(None, rows[:, :2], rows, np.ones(3, bool), np.full(3, blur), np.zeros(3), np.zeros((3, 2), int))


ROWS = [[80.0, 90.0, 20.0, 17.0, 0.4], [150.0, 90.0, 20.0, 18.0, 0.2], [400.0, 90.0, 20.0, 18.0, 0.0]]


NOWHERE = np.zeros((128, 160), bool)


def sharp_of(rig, blur=0.0, outlines=NOWHERE, lines=()) -> Pixels:
    return sharp_pixels(outlines, SIZE, lines, [truth_of(ROWS, blur)], [rig.target], FilmQuality())


@pytest.mark.parametrize("cell", [2, 4, 8])
def test_what_is_linear_is_interpolated_exactly(cell):
    """Lanes are in the middles of their cells."""
    cells = Cells.all_over(SIZE, cell, 1)
    lanes = cells.lanes(0, 0)
    image = resized(cells.spread(3.0 + 0.02 * lanes.u + 0.01 * lanes.v), SIZE)
    v, u = np.mgrid[: SIZE[1], : SIZE[0]]
    assert np.abs(image - (3 + 0.02 * u + 0.01 * v))[4:-4, 4:-4].max() < 1e-3


def test_a_tile_deals_out_each_point_of_its_set_once():
    lanes = Cells.all_over((64, 64), 4, 2).lanes(0, 0)
    assert len(set(lanes.set.tolist())) == 1
    first = lanes.first.reshape(16, 16)[:4, :4]
    assert sorted(first.ravel().tolist()) == list(range(0, 32, 2))


def test_cells_are_finer_about_bodies_and_at_the_borders_of_shadows():
    """A body on the left, a shadow's border at 240 px, whose inside is even; a line elsewhere."""
    cells = Cells.all_over(SIZE, 8, 1)
    u = cells.lanes(0, 0).u
    light = light_of(np.where(u < 240, 1.0, 0.5), held=u < 40, unheld=np.where(u < 40, 0.0, 1.0))
    line = np.array([[150.0, 20.0], [150.0, 60.0]])
    near = near_cells(cells, light, np.ones(SIZE[::-1], np.float32), 1.0, [line], FilmQuality())
    where = near.chosen.any(axis=0).reshape(40, 2).any(axis=1)  # of the columns of 8 px
    assert near.cell == 4 and where[:6].all() and where[29:31].all() and where[17:20].all()
    assert not where[8:16].any() and not where[36:].any()
    fine = fine_cells(near, light_of(*2 * [near.lanes(0, 0).u < 40]), [], FilmQuality())
    assert fine.cell == 2 and fine.chosen[:, :20].all() and not fine.chosen[:, 24:].any()


def test_sharp_pixels_reach_as_far_as_a_fit_looks(rig):
    """Every pixel within BEYOND radii of an ellipse, of outlines and of lines, none twice, each with the nearest circle, if any;
    the third is outside.
    """
    outlines = NOWHERE.copy()
    outlines[100, 20:60] = True
    made = sharp_of(rig, outlines=outlines, lines=[np.array([[290.0, 30.0], [290.0, 200.0]])])
    assert len(np.unique(made.v * SIZE[0] + made.u)) == len(made.u)
    v, u = np.mgrid[: SIZE[1], : SIZE[0]]
    near = (np.hypot(u - 80, v - 90) < 17 * (1 + BEYOND) - 1) | (np.hypot(u - 150, v - 90) < 18 * (1 + BEYOND) - 1)
    held = np.zeros(near.shape, bool)
    held[made.v, made.u] = True
    assert held[near].all() and set(made.circle.tolist()) == {0, 1, NO_CIRCLE}
    assert held[200:202, 40:120].all() and held[40:190, 284:296].all() and not held[30:50, 200:280].any()
    rim = np.abs(np.hypot(made.u - 80.0, made.v - 90.0) - 18.5) < 1
    assert (made.samples[rim] == FilmQuality().rim).all() and (made.samples == FilmQuality().disc).sum() > 500


def test_a_blurred_circle_has_wider_rims(rig):
    still, blurred = (sharp_of(rig, blur).samples for blur in (0.0, 10.0))
    assert np.count_nonzero(blurred == FilmQuality().rim) > 1.5 * np.count_nonzero(still == FilmQuality().rim)


def test_what_arrives_is_averaged_and_sharp_print_is_not(rng):
    """Light of which three quarters arrive, here and there: the mean stays, noise goes, and the print's edge doesn't show."""
    plain = np.where(np.arange(80) < 40, 1.0, 0.05).astype(np.float32)[None].repeat(80, axis=0)
    arrived = (rng.random((80, 80)) < 0.75).astype(np.float32)
    inside = arriving(plain * arrived, plain)[12:-12, 12:-12]
    assert inside.mean() == pytest.approx(0.75, abs=0.03)
    assert inside.std() < 0.25 * arrived.std()
    assert arriving(np.zeros_like(plain), np.zeros_like(plain)).max() == 0


def test_a_repeated_pattern_of_shadow_rays_leaves_no_noise():
    """One in four points is blocked, in each tile the same: everywhere exactly three quarters arrive."""
    arrived = np.tile(np.repeat([[0, 1, 1, 1]], 4, axis=0), (12, 12)).astype(np.float32)
    assert arriving(arrived, np.ones_like(arrived))[4:-4, 4:-4] == pytest.approx(0.75, abs=1e-6)


def test_what_arrives_on_a_body_and_beside_it_is_told_apart():
    """A dark body before a bright scene, half of the light arriving on the one and all on the other, up to the outline."""
    cells = Cells.all_over(SIZE, 4, 1)
    u = cells.lanes(0, 0).u
    held = u < 100
    light = light_of(np.where(held, 0.1, 2.0), held=held)
    share = Arriving.of(cells, light.__class__(**light.__dict__ | {"held_plain": 2 * light.held_radiance}))
    assert share.held[:, :25] == pytest.approx(0.5, abs=1e-6) and share.scene[:, 25:] == pytest.approx(1, abs=1e-6)


def test_a_frame_is_the_body_before_the_shaded_scene(rig):
    """A body of radiance 3 covers the left, and the circles' pixels by a half; half of the light arrives everywhere."""
    fine = Cells.all_over(SIZE, 2, 1)
    covered = fine.lanes(0, 0).u < 20
    sharp = sharp_of(rig)
    half = np.full(SIZE[::-1], 0.5, np.float32)
    some = light_of(np.full(len(sharp.u), 3.0), held=np.full(len(sharp.u), 0.5))
    some = Light(**some.__dict__ | {"held": some.held * sharp.samples})
    image = composed(fine, light_of(3.0 * covered, held=covered), Arriving(half, half), sharp, some, 2 * half)
    assert image[:, :18] == pytest.approx(1.5) and image[:30, 30:] == pytest.approx(0.5)
    assert image[sharp.v, sharp.u] == pytest.approx(0.5 * 1.5 + 0.5 * 0.5)


def test_shares_are_those_of_the_area(rig):
    """Whatever the number of rays: a circle of which the left half is covered."""
    made = sharp_of(rig)
    lanes = Pixels(made.u, made.v, made.samples, made.circle).lanes(0, 0)
    inside = (np.hypot(lanes.u - 80, lanes.v - 90) < 17) | (np.hypot(lanes.u - 150, lanes.v - 90) < 17)
    disc = np.where(inside, lanes.samples, 0).astype(np.float32)
    seen = np.where((lanes.circle == 0) & (lanes.u < 80), 0, disc)
    zero = np.zeros_like(disc)
    shares = visible_shares(lanes, Light(zero, zero, disc, seen, *(6 * [zero])), 3)
    assert shares == pytest.approx([0.5, 1.0, 0.0], abs=0.03)
