import cv2
import numpy as np
import pytest

from recon.probe_calibration import echo_curve
from tests.recon import bscans

MIDDLE = (bscans.SIZE[0] - 1) / 2
NOTHING = np.zeros((bscans.SIZE[1], bscans.SIZE[0]))


def speckled(rows, rng, peak_db=-6.0, thick_px=4.0):
    """Amplitude of a rough surface at rows : (w,), NaN where there is none: speckle that is Gaussian in depth."""
    v = np.arange(bscans.SIZE[1])[:, None]
    beam = np.exp(-np.nan_to_num((v - rows) ** 2, nan=np.inf) / (2 * thick_px**2))
    real, other = rng.standard_normal((2, *NOTHING.shape))
    speckle = np.hypot(*(cv2.GaussianBlur(part * beam, (0, 0), sigmaX=2.5, sigmaY=1.5) for part in (real, other)))
    return 10 ** (peak_db / 20) * speckle / max(float(speckle.max()), 1e-9)


def arc(centre, radius):
    """Rows : (w,) of a circle's upper half."""
    u = np.arange(bscans.SIZE[0])
    return centre[1] - np.sqrt(np.where(np.abs(u - centre[0]) < radius, radius**2 - (u - centre[0]) ** 2, np.nan))


def drawn(*amplitudes, rng):
    return bscans.image(sum(amplitudes) + bscans.face(), rng)


def test_lines_of_a_rough_wall_are_found_with_honest_covariance(rng):
    """Beside reverberation at twice the depth, and with a third of the wall missing."""
    u, normalised = np.arange(bscans.SIZE[0]), []
    for _ in range(30):
        depth, slope, gap = rng.uniform(70, 180), rng.uniform(-0.35, 0.35), rng.uniform(0, 220)
        rows = depth + slope * (u - MIDDLE)
        broken = np.where((u > gap) & (u < gap + 100), np.nan, rows)
        image = drawn(speckled(broken, rng), speckled(2 * rows, rng, peak_db=-12), rng=rng)
        found = echo_curve.find_line(image)
        assert found.found, found.reason
        away = found.nodes[:, 1] - depth - slope * (found.nodes[:, 0] - MIDDLE)
        normalised.append(np.linalg.solve(np.linalg.cholesky(found.covariance), away))
        assert np.abs(away).max() < 1.5
    assert 0.6 < np.sqrt(np.mean(np.square(normalised))) < 1.6  # 60 numbers: 1 ± 0.1, and how long speckle lasts is an estimate


def test_arcs_of_a_rough_sphere_are_found_with_honest_covariance(rng):
    """Anywhere in the image, cut by its border, before a flat bottom below it."""
    normalised = []
    for _ in range(30):
        centre, radius = np.array([rng.uniform(60, 260), rng.uniform(230, 380)]), rng.uniform(90, 160)
        rows = arc(centre, radius)
        image = drawn(speckled(rows, rng), speckled(np.full(bscans.SIZE[0], 395.0), rng, peak_db=-3), rng=rng)
        found = echo_curve.find_arc(image)
        assert found.found, found.reason
        true = centre[1] - np.sqrt(radius**2 - (found.nodes[:, 0] - centre[0]) ** 2)
        away = found.nodes[:, 1] - true
        normalised.append(np.linalg.solve(np.linalg.cholesky(found.covariance), away))
        assert np.abs(away).max() < 2
    assert 0.6 < np.sqrt(np.mean(np.square(normalised))) < 1.6


def test_the_middle_of_an_echo_stays_where_it_is_brighter_than_white(rng):
    """An echo of 25 dB more is clipped over three times the rows, evenly to both sides."""
    rows = 150 + 0.1 * (np.arange(bscans.SIZE[0]) - MIDDLE)
    v = np.arange(bscans.SIZE[1])[:, None]
    even = np.exp(-((v - rows) ** 2) / (2 * 3.0**2))
    for peak_db in (-10, 0, 15):
        found = echo_curve.find_line(drawn(10 ** (peak_db / 20) * even, rng=rng))
        assert found.nodes[:, 1] == pytest.approx(150 + 0.1 * (found.nodes[:, 0] - MIDDLE), abs=0.15)


def flat(depth, slope=0.0):
    return depth + slope * (np.arange(bscans.SIZE[0]) - MIDDLE)


@pytest.mark.parametrize(("find", "curves", "reason"), [
    ("line", [], echo_curve.NO_ECHO),
    ("line", [np.where(np.abs(flat(0, 1)) < 45, flat(200), np.nan)], echo_curve.SHORT),
    ("line", [arc((160, 620), 450)], echo_curve.CURVED),
    ("line", [flat(200, 0.5), flat(200, -0.5)], echo_curve.SEVERAL),
    ("arc", [], echo_curve.NO_ECHO),
    ("arc", [flat(200, 0.2)], echo_curve.STRAIGHT),
    ("arc", [300 - arc((160, 300), 150)], echo_curve.HOLLOW),
    ("arc", [arc((85, 300), 75), arc((240, 310), 75)], echo_curve.SEVERAL),
])  # fmt: skip
def test_what_is_no_surface_is_named(find, curves, reason, rng):
    image = drawn(NOTHING, *(speckled(rows, rng) for rows in curves), rng=rng)
    found = {"line": echo_curve.find_line, "arc": echo_curve.find_arc}[find](image)
    assert not found.found and (found.reason or "").startswith(reason)
    assert np.isnan(found.nodes).all()


def test_wires_are_no_surface(rng):
    """A crossing's spot and the rows of N-wires are too short for a wall, and not curved as a sphere is."""
    dots = [bscans.spot((u, v)) for v in (90, 170, 250) for u in (40, 150, 280)]
    for image in (drawn(bscans.spot((150, 200)), rng=rng), drawn(*dots, rng=rng)):
        assert not echo_curve.find_line(image).found
        assert not echo_curve.find_arc(image).found


def test_a_part_of_an_image_keeps_its_place(rng):
    image = drawn(speckled(flat(180, 0.1), rng), rng=rng)
    whole, part = echo_curve.find_line(image), echo_curve.find_line(image[30:, 40:280]).shifted((40, 30))
    assert part.nodes[:, 1] == pytest.approx(flat(180, 0.1)[np.round(part.nodes[:, 0]).astype(int)], abs=1)
    assert whole.found and part.found
