"""Frames of films: are the layers where they should be, and are interpolated and evened values those of the light?"""

import numpy as np
import pytest

from twin.shooting import FilmQuality
from twin.tracking.film_pictures import (
    BEYOND,
    Cells,
    FilmPicture,
    Pixels,
    arriving,
    sharp_pixels,
    visible_shares,
)
from twin.tracking.moving_transport import NO_CIRCLE, Light
from twin.tracking.target_truth import ViewTruth

SIZE = (320, 256)


def light_of(radiance, plain=None):
    zero = np.zeros(len(radiance), np.float32)
    radiance = np.float32(radiance)
    return Light(radiance, radiance if plain is None else np.float32(plain), zero, zero, zero, zero)


def truth_of(rows, blur=0.0):
    rows = np.array(rows, float)
    return ViewTruth(None, rows[:, :2], rows, np.ones(3, bool), np.full(3, blur), np.zeros(3), np.zeros((3, 2), int))


CORNERS = np.array([[20.0, 20], [300, 20], [300, 240], [20, 240]])
ROWS = [[80.0, 90.0, 20.0, 17.0, 0.4], [150.0, 90.0, 20.0, 18.0, 0.2], [400.0, 90.0, 20.0, 18.0, 0.0]]


def test_what_is_linear_is_interpolated_exactly():
    """Lanes are in the middles of their cells; a window may begin anywhere."""
    whole, near = Cells((0, 0), SIZE, 4, 1), Cells((33, 21), (61, 50), 2, 1)
    picture = FilmPicture(SIZE, [whole, near])
    lanes = picture.lanes(0, 0)
    image = picture.radiance(light_of(3.0 + 0.02 * lanes.u + 0.01 * lanes.v))
    v, u = np.mgrid[: SIZE[1], : SIZE[0]]
    error = np.abs(image - (3 + 0.02 * u + 0.01 * v))
    assert error[4:-4, 4:-4].max() < 0.03, "beside the window's border by half a cell's slope"
    assert error[30:60, 45:85].max() < 1e-3


def test_a_tile_deals_out_each_point_of_its_set_once():
    lanes = Cells((0, 0), (64, 64), 4, 2).lanes(0, 0)
    assert len(set(lanes.set.tolist())) == 1
    first = lanes.first.reshape(16, 16)[:4, :4]
    assert sorted(first.ravel().tolist()) == list(range(0, 32, 2))
    finer = Cells((8, 8), (32, 32), 2, 2).lanes(0, 0)
    assert set(finer.set.tolist()) == set(lanes.set.tolist()), (
        "another set would be off by another error, in a step at the border"
    )


def test_sharp_pixels_reach_as_far_as_a_fit_looks(rig):
    """Every pixel within BEYOND radii of an ellipse and beside an edge, none twice, each with the nearest circle, if any; the
    third is outside.
    """
    made = sharp_pixels(truth_of(ROWS), CORNERS, SIZE, rig.target, FilmQuality())
    assert len(np.unique(made.v * SIZE[0] + made.u)) == len(made.u)
    v, u = np.mgrid[: SIZE[1], : SIZE[0]]
    near = (np.hypot(u - 80, v - 90) < 17 * (1 + BEYOND) - 1) | (np.hypot(u - 150, v - 90) < 18 * (1 + BEYOND) - 1)
    held = np.zeros(near.shape, bool)
    held[made.v, made.u] = True
    assert held[near].all() and set(made.circle.tolist()) == {0, 1, NO_CIRCLE}
    assert held[17:24, 20:300].all() and held[20:240, 297:304].all() and not held[30:50, 200:290].any()
    rim = np.abs(np.hypot(made.u - 80.0, made.v - 90.0) - 18.5) < 1
    assert (made.samples[rim] == FilmQuality().rim).all() and (made.samples == FilmQuality().disc).sum() > 500


def test_a_blurred_circle_has_wider_rims(rig):
    still, blurred = (
        sharp_pixels(truth_of(ROWS, blur), CORNERS, SIZE, rig.target, FilmQuality()).samples for blur in (0.0, 10.0)
    )
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


def test_pixels_take_the_light_of_the_cells_beneath(rig, rng):
    """Half of the light arrives by the cells, whatever the pixels' own shadow rays say: no circle stands in a paler disc."""
    sharp = sharp_pixels(truth_of(ROWS), CORNERS, SIZE, rig.target, FilmQuality())
    picture = FilmPicture(SIZE, [Cells((0, 0), SIZE, 4, 1), sharp])
    cells = SIZE[0] * SIZE[1] // 16
    radiance = np.r_[np.full(cells, 0.5), rng.random(len(sharp.u))]
    assert picture.radiance(light_of(radiance, np.ones_like(radiance))) == pytest.approx(0.5, abs=1e-6)


def test_shares_are_those_of_the_area(rig):
    """Whatever the number of rays: a circle of which the left half is covered."""
    made = sharp_pixels(truth_of(ROWS), CORNERS, SIZE, rig.target, FilmQuality())
    lanes = Pixels(made.u, made.v, made.samples, made.circle).lanes(0, 0)
    inside = (np.hypot(lanes.u - 80, lanes.v - 90) < 17) | (np.hypot(lanes.u - 150, lanes.v - 90) < 17)
    disc = np.where(inside, lanes.samples, 0).astype(np.float32)
    seen = np.where((lanes.circle == 0) & (lanes.u < 80), 0, disc)
    zero = np.zeros_like(disc)
    shares = visible_shares(lanes, Light(zero, zero, disc, seen, zero, zero), 3)
    assert shares == pytest.approx([0.5, 1.0, 0.0], abs=0.03)
