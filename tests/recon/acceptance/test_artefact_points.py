"""Artefacts found among points of a table, a rod and a background."""

import numpy as np
import pytest

from recon.acceptance import artefact_points
from recon.acceptance.artefact_points import Region
from recon.acceptance.certificates import BarCertificate, Certified
from recon.errors import InputError
from recon.geometry.primitives import fit_plane, fit_sphere
from tests.recon.acceptance import drawn_surfaces

RADIUS, SIGMA = 19.05, 0.02
ENDS = np.array([[-60.0, -30.0, 640.0], [70.0, 30.0, 680.0]])
LENGTH = float(np.linalg.norm(ENDS[1] - ENDS[0]))


def certificate(length=LENGTH):
    ball = Certified(mm=2 * RADIUS, expanded_mm=0.002)
    return BarCertificate(length=Certified(mm=length, expanded_mm=0.002), diameters=(ball, ball), rod_mm=8.0)


def bar(rng):
    """A bar before a wall, its points in any order."""
    balls = [drawn_surfaces.ball(end, RADIUS, rng, SIGMA, 800, cap=0.1) for end in ENDS]
    wall = drawn_surfaces.plate((0, 0, 720), (260, 200), rng, SIGMA, 1500)
    return rng.permutation(np.concatenate([*balls, drawn_surfaces.rod(*ENDS, 4.0, rng), wall]))


def test_a_ball_before_a_wall_is_found(rng):
    """All its points face the camera by the cap's angle, and none is the wall's."""
    ball = drawn_surfaces.ball((10, 5, 650), RADIUS, rng, SIGMA, 800, cap=0.1)
    wall = drawn_surfaces.plate((0, 0, 675), (260, 200), rng, SIGMA, 1500)
    own = artefact_points.ball(np.concatenate([wall, ball]), 2 * RADIUS, "sphere/00")
    fit = fit_sphere(own)
    assert fit.shape.centre == pytest.approx((10, 5, 650), abs=0.02) and np.abs(fit.residuals).max() < 6 * SIGMA
    cap = (1 - np.cos(np.deg2rad(50))) / (1 - 0.1)
    assert len(own) == pytest.approx(cap * len(ball), rel=0.1)
    narrow = artefact_points.ball(np.concatenate([wall, ball]), 2 * RADIUS, "sphere/00", Region(cap_deg=30))
    assert len(narrow) < 0.5 * len(own)


def test_both_balls_of_a_bar_are_found_without_its_rod(rng):
    first, second = artefact_points.bar(bar(rng), certificate(), "bar/00")
    for points, end in ((first, ENDS[0]), (second, ENDS[1])):
        fit = fit_sphere(points)
        assert fit.shape.centre == pytest.approx(end, abs=0.03) and np.abs(fit.residuals).max() < 6 * SIGMA


def test_a_plate_on_a_table_is_found(rng):
    """Of two surfaces the one with the most points, without those within 5 mm of its outline, 11 %."""
    plate = drawn_surfaces.plate((0, 0, 650), (200, 150), rng, SIGMA, 1000)
    table = drawn_surfaces.plate((0, 0, 700), (200, 150), rng, SIGMA, 700)
    found = artefact_points.plate(rng.permutation(np.concatenate([plate, table])), "plane/00", rng)
    assert len(found) == pytest.approx(190 * 140 / (200 * 150) * len(plate), rel=0.04) and fit_plane(found).rms < 1.1 * SIGMA
    assert (np.abs(found[:, :2]).max(axis=0) < (95.5, 70.5)).all()


def test_what_is_not_there_is_refused(rng):
    points = bar(rng)
    with pytest.raises(InputError, match=r"s/00: expected 1 ball of 60 mm, found .*: is it the certified diameter"):
        artefact_points.ball(points, 60.0, "s/00")
    with pytest.raises(InputError, match=r"b/00: expected balls 100 mm apart, found some 14\d\.\d\d mm: another bar\?"):
        artefact_points.bar(points, certificate(100.0), "b/00")
    with pytest.raises(InputError, match=r"b/01: expected 2 balls of 38\.1 mm, found "):
        artefact_points.bar(drawn_surfaces.ball(ENDS[0], RADIUS, rng, SIGMA, 800), certificate(), "b/01")
    with pytest.raises(InputError, match="p/00: expected a plane of 200 points or more, found 3"):
        artefact_points.plate(points[:3], "p/00", rng)
