"""Sums over the pixels of a rim: those of a plain version, and their right sides are slopes of the squares that they add up."""

import numpy as np
import pytest

from recon.geometry.ellipses import signed_distance
from recon.tracking.rim_fit import rim_sums, sectors
from recon.tracking.rim_fit.rim_parameters import Rim
from recon.tracking.rim_fit.sectors import BRIGHT, DARK, EDGE, GROWTH, LEVELS, SECTORS, SUMS, VARIANCE, SideNoise
from tests.recon.tracking.rim_fit import plain_rims

HOLE = 0.4
RIM = Rim(60.3, 58.8, 40.0, 3.0, 36.0, 20.0, 1.0, -2.0, 120.0, 8.0, 5.0, 1.3, 0.0, 0.0)  # no motion
QUIET = SideNoise(1e8, 1e8)  # DN^2, in which no pixel is an outlier
SPREADS = (5, 5, 0.5, 2)


def levels(rng):
    own = np.zeros(SECTORS, LEVELS)
    for name, spread in zip(LEVELS.names, SPREADS, strict=True):
        own[name] = rng.normal(0, spread, SECTORS)
    return own


def changed(table, column, step):
    """A copy with a step added to a column."""
    other = table.copy()
    other[column] += step
    return other


@pytest.fixture
def noise_image(rng):
    return rng.uniform(0, 200, (120, 120)).astype(np.float32)


@pytest.fixture
def sums_of(noise_image):
    """Sums over all sectors of a picture of noise, for their own levels and geometry."""

    def summed(own, geometry):
        sums = np.zeros(SECTORS, SUMS)
        rim_sums.add_up(noise_image, RIM, own, QUIET, geometry, 1, HOLE, sums)
        return {name: sums[name].sum(axis=0) for name in SUMS.names}

    return summed


@pytest.mark.parametrize(("level", "unknown"), [("dark", DARK), ("bright", BRIGHT), ("growth", GROWTH)])
def test_sums_are_slopes_by_own_levels(sums_of, rng, level, unknown):
    geometry = sectors.geometry(RIM, 0.0, HOLE)
    own = levels(rng)
    below, above = (sums_of(changed(own, level, step), geometry)["squares"] for step in (-0.01, 0.01))
    slope = (above - below) / 0.02
    assert -2 * sums_of(own, geometry)["right"][unknown] == pytest.approx(slope, rel=1e-4)


@pytest.mark.parametrize(("column", "unknown", "sign"), [("pull", EDGE, -1), ("wide", VARIANCE, 1)])
def test_sums_are_slopes_by_place_and_variance_of_the_edge(sums_of, column, unknown, sign):
    """A pull inwards by so much is an edge that lies inwards by it. Light that changes across the edge is taken to stay."""
    geometry = sectors.geometry(RIM, 0.0, HOLE)
    own = np.zeros(SECTORS, LEVELS)
    squares = []
    for step in (-1e-3, 1e-3):
        other = changed(geometry, column, step)
        other["blur"] = np.sqrt(other["wide"])
        squares.append(sums_of(own, other)["squares"])
    slope = sign * (squares[1] - squares[0]) / 2e-3
    assert -2 * sums_of(own, geometry)["right"][unknown] == pytest.approx(slope, rel=2e-2)


@pytest.mark.parametrize("motion", [(0.0, 0.0), (2.0, -1.5)])
@pytest.mark.parametrize(("blur", "reach"), [(1.3, 0.0), (6.0, 4.0)])
def test_sums_are_those_of_the_plain_version(noise_image, rng, motion, blur, reach):
    """In little noise, so that many pixels are outliers; a box of 200 parts is as good as the integral to 1e-5."""
    rim = RIM._replace(variance=blur + np.hypot(*motion), variance_cos=motion[0], variance_sin=motion[1])
    own, noise, geometry = levels(rng), SideNoise(20.0, 300.0), sectors.geometry(rim, reach, HOLE)
    found = np.zeros(SECTORS, SUMS)
    rim_sums.add_up(noise_image, rim, own, noise, geometry, 1, HOLE, found)
    expected = plain_rims.add_up(noise_image, rim, own, noise, geometry, HOLE)
    for name in SUMS.names:
        np.testing.assert_allclose(found[name], expected[name], rtol=1e-4, atol=1e-5 * np.abs(expected[name]).max(), err_msg=name)


def test_a_stride_takes_a_quarter_of_the_pixels(noise_image):
    geometry, own = sectors.geometry(RIM, 4.0, HOLE), np.zeros(SECTORS, LEVELS)
    counts = []
    for stride in (1, 2):
        sums = np.zeros(SECTORS, SUMS)
        rim_sums.add_up(noise_image, RIM, own, QUIET, geometry, stride, HOLE, sums)
        counts.append(sums["count"].sum())
    assert counts[1] == pytest.approx(counts[0] / 4, rel=0.03)


def test_distances_are_orthogonal_to_second_order(rng):
    """Within 3 px of an ellipse of 30 and 45 px the third order is below 0.01 px; the first alone is off by more."""
    rim = RIM._replace(a=44.0, b=4.0, c=31.0)
    places = np.array([[np.cos(t), np.sin(t)] for t in rng.uniform(0, 2 * np.pi, 500)]) * rng.uniform(0.92, 1.08, (500, 1))
    points = np.array([rim.x, rim.y]) + places @ plain_rims.shape_of(rim)
    exact = orthogonal(points, rim)
    found, slope, away = plain_rims.distance_of(rim, places)
    near = np.abs(exact) < 3
    assert np.abs(found - exact)[near].max() < 0.01
    assert np.abs((away - 1) / slope - exact)[near].max() > 0.02
    first = signed_distance(points[None], np.array([[rim.x, rim.y]]), plain_rims.shape_of(rim)[None])[0][0]
    assert np.abs(first - exact)[near].max() < 0.2


def orthogonal(points, rim):
    """Signed distances from a densely sampled outline, px."""
    outline = np.stack([np.cos(plain_rims.ANGLES), np.sin(plain_rims.ANGLES)], axis=1) @ plain_rims.shape_of(rim)
    outline += [rim.x, rim.y]
    nearest = np.array([np.linalg.norm(outline - point, axis=1).min() for point in points])
    inside = np.linalg.norm((points - [rim.x, rim.y]) @ np.linalg.inv(plain_rims.shape_of(rim)), axis=1) < 1
    return np.where(inside, -nearest, nearest)


@pytest.fixture
def ring_image(rng):
    """A dark ring on bright ground, with noise, off its rough rim by 2 px, and a finger over part of it."""
    v, u = np.mgrid[:120, :120]
    away = np.linalg.norm(np.stack([u - 62.3, v - 58.8], axis=-1) @ np.linalg.inv(plain_rims.shape_of(RIM)), axis=-1)
    image = np.where((away < 1) & (away > HOLE), 15.0, 110.0) + rng.normal(0, 3, away.shape)
    image[(u > 80) & (v > 70)] = 60
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)


def test_first_levels_are_those_of_the_plain_version(ring_image):
    reach = 4.0
    geometry = sectors.geometry(RIM, reach, HOLE).view(np.recarray)
    pixels, places = plain_rims.pixels_about(RIM, ring_image)
    away = np.linalg.norm(places, axis=1)
    pixels, places = pixels[away >= HOLE], places[away >= HOLE]
    first = (np.linalg.norm(places, axis=1) - 1) / plain_rims.distance_of(RIM, places)[1]
    j, grey = plain_rims.sector_number(places).astype(int), ring_image[pixels[:, 0], pixels[:, 1]].astype(float)
    inside = (first > -geometry.inner[j]) & (first < -0.35 * geometry.inner[j])
    outside = (first > 0.35 * geometry.outer[j]) & (first < geometry.outer[j])
    dark, bright = (np.array([grey[side & (j == k)].mean() for k in range(SECTORS)]) for side in (inside, outside))
    depth = (bright - dark) / (bright + dark)
    ring_like = depth > sectors.STEEP * np.quantile(depth, 0.75)
    assert 30 < ring_like.sum() < SECTORS

    ring, rim, noise = rim_sums.first_levels(ring_image, RIM, reach, HOLE)
    assert ring
    assert rim.dark == pytest.approx(np.median(dark[ring_like])) and rim.bright == pytest.approx(np.median(bright[ring_like]))
    assert (rim.dark_x, rim.dark_y, rim.bright_x, rim.bright_y) == (0, 0, 0, 0)
    assert rim[:5] == RIM[:5] and rim[11:] == RIM[11:]
    assert noise.dark == noise.bright == pytest.approx((0.1 * (rim.bright - rim.dark)) ** 2)
    assert not rim_sums.first_levels(255 - ring_image, RIM, reach, HOLE)[0]


def test_the_middle_is_the_mean_of_its_inner_half(ring_image):
    v, u = np.mgrid[:120, :120]
    away = np.linalg.norm(np.stack([u - RIM.x, v - RIM.y], axis=-1) @ np.linalg.inv(plain_rims.shape_of(RIM)), axis=-1)
    assert rim_sums.middle_level(ring_image, RIM, HOLE) == pytest.approx(ring_image[away <= HOLE / 2].mean())
    assert np.isnan(rim_sums.middle_level(ring_image, RIM._replace(x=500.0), HOLE))
