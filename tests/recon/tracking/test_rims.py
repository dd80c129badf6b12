"""Rims are found to the physical limit, with honest covariance, and what hides or spoils them is noticed."""

import numpy as np
import pytest
from scipy.special import expit

from recon.geometry import rigid
from recon.geometry.circle_projection import centre_offsets
from recon.geometry.ellipses import Ellipses
from recon.model import circle_layout
from recon.tracking import rims
from recon.tracking.rims import measure
from tests.recon.tracking import drawings

FRAMES = 6  # of three rings


@pytest.fixture(scope="module")
def camera(rig):
    return rig.cam1.optics.camera()


def found_and_true(camera, target, rng, white, blur_px=0.0):
    """One frame: the rims from ellipses up to 3 px off, and the truth."""
    place = drawings.facing(rng)
    angle = rng.uniform(0, 2 * np.pi)
    path = blur_px * place[2, 3] / camera.matrix[0, 0] * np.array([np.cos(angle), np.sin(angle), 0])
    poses = [place] if blur_px == 0 else drawings.exposure(place, path)
    image = drawings.frame(camera, poses, target, white, rng)
    true = drawings.shown(camera, place, target)
    rough = Ellipses(true.centre + rng.uniform(-2, 2, (3, 2)), true.shape * 1.02)
    return measure(image, rough, 6.0, target), true


@pytest.mark.parametrize(("white", "blur", "typical"), [(100, 0, 0.012), (20, 0, 0.02), (8, 0, 0.05), (65, 12, 0.03)])
def test_centres_and_their_covariance(camera, rig, rng, white, blur, typical):
    """The median error stays below twice what was measured, and squared normalised errors follow chi-square of 2: 18 rings give a
    mean within 4 standard errors of 2 / sqrt(18)."""
    errors, squared = [], []
    for _ in range(FRAMES):
        found, true = found_and_true(camera, rig.target, rng, white, blur)
        assert found.found.all(), found.reasons
        off = found.ellipses.centre - true.centre
        errors += list(np.hypot(*off.T))
        squared += [e @ np.linalg.solve(c, e) for e, c in zip(off, found.covariance, strict=True)]
        if blur:
            assert np.abs(np.linalg.norm(found.motion, axis=1) - blur).max() < 0.1 * blur
    assert np.median(errors) < typical
    assert 0.5 < np.mean(squared) < 2 + 4 * 2 / np.sqrt(3 * FRAMES)


def test_light_that_falls_off_does_not_move_the_centre(camera, rig, rng):
    """Twice as bright at one side of a ring as at the other."""
    place = drawings.facing(rng, 5.0)
    true = drawings.shown(camera, place, rig.target)
    light = np.exp(np.log(2) * (np.arange(1280) - true.centre[0, 0]) / 90)[None].clip(0.2, 3)
    image = drawings.frame(camera, [place], rig.target, 40.0, rng, light=light)
    found = measure(image, true, 3.0, rig.target)
    assert np.hypot(*(found.ellipses.centre[0] - true.centre[0])) < 0.04


def fringes(true, rng):
    """Sinusoidal fringes of any direction, of nearly full modulation, of a period of one semi-axis to four."""
    v, u = np.mgrid[:1024, :1280]
    angle, period = rng.uniform(0, np.pi), rng.uniform(1.0, 4.0) * true.semi_axes.mean()
    return 0.55 + 0.45 * np.cos(2 * np.pi * (u * np.cos(angle) + v * np.sin(angle)) / period + rng.uniform(0, 2 * np.pi))


def shadow(true, rng):
    """The edge of a shadow across the first circle, in any direction, nearly as sharp as the image or wide."""
    v, u = np.mgrid[:1024, :1280]
    angle = rng.uniform(0, 2 * np.pi)
    across = (u - true.centre[0, 0]) * np.cos(angle) + (v - true.centre[0, 1]) * np.sin(angle)
    return 0.2 + 0.8 * expit(across / rng.uniform(1.0, 4.0))


@pytest.mark.parametrize(("light", "typical"), [(fringes, 0.08), (shadow, 0.022)])
def test_light_of_any_shape_leaves_the_centres_in_place(camera, rig, rng, light, typical):
    """Rims are found, but for those with a middle in the dark; the median error stays below twice what was measured, and squared
    normalised errors are those of chi-square with 2 degrees of freedom, or smaller."""
    errors, squared = [], []
    for _ in range(FRAMES):
        place = drawings.facing(rng)
        true = drawings.shown(camera, place, rig.target)
        image = drawings.frame(camera, [place], rig.target, 120.0, rng, light=light(true, rng))
        found = measure(image, Ellipses(true.centre + rng.uniform(-1.5, 1.5, (3, 2)), true.shape * 1.02), 4.0, rig.target)
        assert set(found.reasons) <= {None, "no white middle"}
        off = (found.ellipses.centre - true.centre)[found.found]
        errors += list(np.hypot(*off.T))
        squared += [e @ np.linalg.solve(c, e) for e, c in zip(off, found.covariance[found.found], strict=True)]
    assert len(errors) >= 0.7 * 3 * FRAMES
    assert np.median(errors) < typical
    assert 0.2 < np.mean(squared) < 2 + 4 * 2 / np.sqrt(len(squared))


def test_a_finger_over_a_quarter_of_the_rim_costs_little(camera, rig, rng):
    place = drawings.facing(rng)
    true = drawings.shown(camera, place, rig.target)
    image = drawings.frame(camera, [place], rig.target, 80.0, rng)
    centre, radius = true.centre[1], true.semi_axes[1].mean()
    v, u = np.mgrid[:1024, :1280]
    finger = (
        (u - centre[0] > 0.1 * radius) & (v - centre[1] > 0.1 * radius) & (np.hypot(u - centre[0], v - centre[1]) < 2 * radius)
    )
    image[finger] = np.clip(45 + 2 * rng.standard_normal(finger.sum()), 0, 255).astype(np.uint8)
    found = measure(image, true, 3.0, rig.target)
    assert found.found[1]
    assert found.doubtful.tolist() == [False, True, False]
    off = found.ellipses.centre[1] - true.centre[1]
    assert np.hypot(*off) < 0.06
    assert np.trace(found.covariance[1]) > np.trace(found.covariance[0])


def test_clipped_white_keeps_the_centre(camera, rig, rng):
    """The edge moves outwards, all around alike."""
    place = drawings.facing(rng)
    true = drawings.shown(camera, place, rig.target)
    found = measure(drawings.frame(camera, [place], rig.target, 500.0, rng), true, 4.0, rig.target)
    assert found.found.all() and found.doubtful.all()
    assert np.hypot(*(found.ellipses.centre - true.centre).T).max() < 0.05


@pytest.mark.parametrize(("blur", "smeared"), [(10.0, False), (24.0, True)])
def test_a_path_longer_than_the_model_allows_is_doubted(camera, rig, rng, blur, smeared):
    """0.4 of a semi-axis of some 45 px is 18 px; a long path at even speed is nothing that the rim itself shows."""
    found, true = found_and_true(camera, rig.target, rng, 65.0, blur)
    assert found.found.all(), found.reasons
    assert (blur > 0.4 * true.semi_axes.mean(axis=1).max()) == smeared
    assert (found.doubtful == smeared).all()


def test_variances_of_what_is_clipped_are_doubled_and_more_if_it_moves(camera, rig, rng, monkeypatch):
    """The same pixels, a grey level below the end of the scale and at it: what differs is that more might have been cut off."""
    place = drawings.facing(rng)
    true = drawings.shown(camera, place, rig.target)
    image = drawings.frame(camera, [place], rig.target, 200.0, rng)
    below = measure(image, true, 4.0, rig.target)
    monkeypatch.setattr(rims, "FULL_DN", below.outside.min())
    clipped = measure(image, true, 4.0, rig.target)
    assert not below.doubtful.any() and clipped.doubtful.all()
    path = np.linalg.norm(below.motion, axis=1)
    skewed = ((rims.SKEWED * path) ** 2)[:, None, None] * np.eye(2)
    np.testing.assert_allclose(clipped.covariance, 2 * below.covariance + skewed)


def test_what_is_no_ring_is_not_found(camera, rig, rng):
    true = drawings.shown(camera, drawings.facing(rng), rig.target)
    noise = rng.integers(0, 256, (1024, 1280)).astype(np.uint8)
    v, u = np.mgrid[:1024, :1280]
    disc = np.where(np.hypot(u - true.centre[0, 0], v - true.centre[0, 1]) < true.semi_axes[0].mean(), 5, 90).astype(np.uint8)
    for image in (np.zeros((1024, 1280), np.uint8), np.full((1024, 1280), 255, np.uint8), noise, disc):
        assert not measure(image, true, 6.0, rig.target).found.any()
    nowhere = Ellipses(np.full((3, 2), np.nan), np.full((3, 2, 2), np.nan))
    assert measure(noise, nowhere, 6.0, rig.target).reasons == ("no rim",) * 3
    outside = Ellipses(true.centre + 5000, true.shape)
    assert not measure(noise, outside, 6.0, rig.target).found.any()


def test_fitted_ellipses_are_those_of_the_plain_fit(camera, rig, rng):
    """Against the projected centres with the offsets that calibration takes."""
    model, radius = circle_layout.circle_centres(rig.target), rig.target.outer_diameter_mm / 2
    for _ in range(5):
        place = drawings.facing(rng)
        expected = camera.project(rigid.apply(place, model)) + centre_offsets(camera, place, model, radius)
        assert np.abs(drawings.shown(camera, place, rig.target).centre - expected).max() < 1e-5
