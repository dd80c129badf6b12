"""Are lines of light found to a fraction of a pixel, and what is missing or too much counted?"""

from itertools import pairwise

import numpy as np
from scipy.ndimage import gaussian_filter

from twin.evaluation import light_errors

V, U = np.mgrid[:120, :160].astype(float)


def circle(middle, radius, width, rng):
    """A ring of light as wide as `width` px, blurred by the lens, with noise of a hundredth."""
    across = np.abs(np.hypot(U - middle[0], V - middle[1]) - radius)
    ring = np.clip(width / 2 - across + 0.5, 0, 1)
    return gaussian_filter(ring, 0.7) + 0.01 * rng.standard_normal(ring.shape)


def test_a_line_is_found_to_a_tenth_of_a_pixel(rng):
    middle, radius = np.array([80.3, 60.7]), 40.2
    found = light_errors.ridges(circle(middle, radius, 4.0, rng), 1.6)
    off = np.linalg.norm(found - middle, axis=1) - radius
    assert abs(np.mean(off)) < 0.05 and np.std(off) < 0.1
    angles = np.sort(np.arctan2(*(found - middle).T))
    assert np.diff(angles).max() < np.deg2rad(5), "all round"


def test_noise_alone_gives_no_line_beside_one(rng):
    image = np.clip(2.0 - np.abs(V - 60.2), 0, 1) + 0.02 * rng.standard_normal(V.shape)
    found = light_errors.ridges(image, 1.6)
    assert np.abs(found[:, 1] - 60.2).max() < 0.3


def test_what_is_missing_and_what_is_too_much_count():
    """A true square, drawn 0.5 mm aside along x, without one of its sides."""
    square = np.array([[0, 0, 700], [20, 0, 700], [20, 20, 700], [0, 20, 700], [0, 0, 700.0]])
    drawn = np.add(np.concatenate([np.linspace(a, b, 200) for a, b in pairwise(square[:4])]), [0.5, 0, 0])
    errors = light_errors.compare(drawn, [square])
    assert np.quantile(errors.from_true, 0.99) > 8, "the side that is missing, at its middle, is 10 mm from the others"
    assert 0.4 < np.quantile(errors.from_light, 0.9) <= 0.51


def test_pixels_become_places_of_the_surface():
    points = np.float32(np.stack([0.2 * U, 0.3 * V, 700 + 0.1 * U], axis=-1))
    assert np.allclose(light_errors.in_space(np.array([[10.5, 20.25]]), points), [[2.1, 6.075, 701.05]], atol=1e-4)
    assert np.isnan(light_errors.in_space(np.array([[-5.0, 20.0]]), points)).all()
