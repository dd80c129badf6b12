import cv2
import numpy as np
import pytest

from recon.board_detection.discs import measure
from recon.board_detection.edges import find_edges
from recon.geometry.ellipses import Ellipses

SIZE, FINE = 48, 20


def disc(centre, radius, blur=0.7, light=None):
    """A dark disc as a camera sees it : (SIZE, SIZE); the light falls where it will, then come the lens and the pixels."""
    at = (np.arange(SIZE * FINE) + 0.5) / FINE - 0.5
    x, y = np.meshgrid(at - centre[0], at - centre[1])
    share = np.clip((np.hypot(x, y) - radius) * FINE + 0.5, 0, 1)
    image = 40 + 140 * share
    if light is not None:
        image = image * light(x, y)
    image = cv2.GaussianBlur(image.astype(np.float32), (0, 0), blur * FINE)
    return image.reshape(SIZE, FINE, SIZE, FINE).mean(axis=(1, 3)).astype(float)


def rough(centre, radius):
    return Ellipses(np.rint([centre]).astype(float), radius * np.eye(2)[None])


def centre_of(image, centre, radius, room=None):
    discs = measure(image, rough(centre, radius), np.array([room or 0.45 * radius]))
    return discs.fit.ellipses.centre[0]


@pytest.mark.parametrize("blur", [0.4, 0.7, 1.5])
@pytest.mark.parametrize("radius", [6.3, 17.0])
def test_where_the_pixels_fall_is_no_matter(rng, radius, blur):
    for centre in 23.5 + rng.uniform(-0.5, 0.5, (3, 2)):
        assert np.abs(centre_of(disc(centre, radius, blur), centre, radius, 4 + blur) - centre).max() < 0.003


def test_a_gradient_of_the_light_is_no_matter():
    """One side of the disc twice as bright as the other. A threshold halfway would be off by about blur^2 / width: 0.02 px."""
    centre = np.array([23.3, 23.6])
    bent = disc(centre, 15, light=lambda x, y: 1 + x / 45 + y / 90)
    assert np.abs(centre_of(bent, centre, 15) - centre).max() < 0.003


def test_blur_and_levels_are_told(rng):
    image = disc((23.2, 23.7), 15.0, blur=1.1) + rng.normal(0, 2, (SIZE, SIZE))
    edges = find_edges(image, rough((23.2, 23.7), 15.0), np.array([8.0]))
    assert edges.blur[0] == pytest.approx(np.hypot(1.1, np.sqrt(1 / 12)), abs=0.1)  # the pixel's width blurs too
    assert edges.inside[0] == pytest.approx(40, abs=1) and edges.outside[0] == pytest.approx(180, abs=1)
    assert edges.noise[0] == pytest.approx(2, rel=0.1)


def test_edge_points_scatter_as_predicted_about_the_circle(rng):
    centre = np.array([23.3, 23.6])
    clean, z = disc(centre, 17.0), []
    for _ in range(20):
        edges = find_edges(clean + rng.normal(0, 3, clean.shape), Ellipses(centre[None], 17.0 * np.eye(2)[None]), np.array([8.0]))
        away = np.hypot(*(edges.points[0] - centre).T) - 17.0
        own = np.sqrt(edges.sigma[0] ** 2 + (edges.shared[0] ** 2).sum(axis=1))
        z.append((away - away.mean()) / own)
    assert np.std(z) == pytest.approx(1, abs=0.1)


@pytest.mark.parametrize("radius", [6.3, 17.0])
def test_centres_scatter_as_predicted_and_near_the_limit(rng, radius):
    """The limit is that of known brightness; judging the brightness from the few pixels at hand costs the rest."""
    noise, blur, count = 3.0, 0.7, 12
    image = np.tile(disc((23.3, 23.6), radius, blur), (count, count))
    centres = np.stack(np.meshgrid(np.arange(count), np.arange(count)), axis=-1).reshape(-1, 2) * SIZE + [23.3, 23.6]
    start = Ellipses(np.rint(centres), np.repeat(radius * np.eye(2)[None], count**2, axis=0))
    found = measure(image + rng.normal(0, noise, image.shape), start, np.full(count**2, 0.45 * radius + 1.5))
    errors = found.fit.ellipses.centre - centres
    z = np.linalg.solve(np.linalg.cholesky(found.covariance), errors[..., None])
    chance = 3 / np.sqrt(2 * errors.size)
    limit = noise / 140 * np.sqrt(2 * np.sqrt(np.pi) * np.hypot(blur, np.sqrt(1 / 12)) / (np.pi * radius))
    assert np.std(errors) < 1.3 * limit * (1 + chance)
    assert np.std(z) == pytest.approx(1, abs=0.05 + chance)


def test_a_spot_of_dirt_on_the_rim_does_little_harm():
    centre = np.array([23.3, 23.6])
    image = disc(centre, 15.0)
    image[22:26, 37:41] = 30
    assert np.abs(centre_of(image, centre, 15.0) - centre).max() < 0.01
