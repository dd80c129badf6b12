"""A ball bar under fringes: found in a map of the projector, measured to its noise, and the scale that it gives."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from recon.errors import InputError
from recon.model.calibration import DRIFT_PX, moved
from recon.optical_calibration import uncertainty
from recon.rig_check import ball_bar, drift
from recon.rig_check.ball_bar import SHARED, BallBar, Bars
from recon.rig_check.optics_equations import CAMERAS
from recon.structured_light.decode import ProjectorMap
from recon.structured_light.phase import Noise
from recon.tracking.pose_fit import meet
from twin.experiments import drawn_check
from twin.optics.surface_session import calibration_of

CENTRES = np.array([[-66.0, -28.0, 650.0], [75.0, 23.0, 650.0]])  # mm
LENGTH, BALL, SIGMA_PX = float(np.linalg.norm(CENTRES[1] - CENTRES[0])), 25.4, 0.02
NAMES = ("projector.cx", "projector.fx", "projector.tx", "projector.rz", "cam1.cy")


@pytest.fixture(scope="module")
def calibration(rig):
    return calibration_of(rig)


def depths(camera, pixels):
    """Points : (n, 3) mm of balls, and of the ground at 710 mm behind them, that a camera's pixels : (n, 2) see."""
    rays = camera.rays(pixels)
    far = (710 - camera.centre[2]) / rays[:, 2]
    for centre in CENTRES:
        along = rays @ (centre - camera.centre)
        off = np.sum((centre - camera.centre) ** 2) - along**2
        with np.errstate(invalid="ignore"):
            far = np.fmin(far, along - np.sqrt((BALL / 2) ** 2 - off))
    return camera.centre + far[:, None] * rays


def drawn_map(cameras, rng):
    """The projector's columns in camera 1 as noise leaves them."""
    width, height = cameras["cam1"].size
    pixels = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).reshape(-1, 2).astype(float)
    columns = cameras["projector"].project(depths(cameras["cam1"], pixels))[:, 0].reshape(height, width)
    noisy = np.float32(columns + SIGMA_PX * rng.standard_normal(columns.shape))
    bright = np.full(noisy.shape, 100, np.float32)
    lit, none = np.ones(noisy.shape, bool), np.zeros(noisy.shape, np.uint8)
    return ProjectorMap(
        noisy,
        None,
        SIGMA_PX * np.ones_like(noisy),
        None,
        bright,
        bright,
        0 * bright,
        none,
        lit,
        Noise(1.0, 0.0),
        {},
        camera="cam1",
    )


def drawn_bar(cameras, rng, moved_mm=(0.0, 0.0, 0.0), patches=None):
    """Points of both balls, as camera 1 and the projector see them; some patches of each alone, to be quick."""
    pixels, shown, axes = drawn_check.drawn_bar(cameras, CENTRES + moved_mm, BALL, SIGMA_PX, rng)
    some = slice(patches and SHARED * patches)
    return BallBar((pixels[0][some], pixels[1][some]), (shown[0][some], shown[1][some]), axes)


def test_two_balls_are_found_and_measured_to_their_noise(calibration, rng):
    """To 0.005 mm, where phases don't err alike, for which 0.01 mm are allowed."""
    bar = ball_bar.find(drawn_map(calibration.cameras, rng), calibration.cameras, BALL, "bar")
    found = ball_bar.measure(bar, calibration.cameras, ())
    assert min(map(len, bar.pixels)) > 5000
    assert abs(found.length_mm - LENGTH) < 0.005 and found.sigma_mm == pytest.approx(0.01, abs=0.002)
    assert found.balls_mm == pytest.approx((BALL, BALL), abs=0.02)


def test_balls_of_another_size_are_refused(calibration, rng):
    drawn = drawn_map(calibration.cameras, rng)
    with pytest.raises(InputError, match=r"bar: expected two balls of 30 mm before cam1 and projector, found .*is ball_mm"):
        ball_bar.find(drawn, calibration.cameras, 30.0, "bar")


def test_nothing_in_the_images_is_no_bar(calibration, rng):
    dark = replace(drawn_map(calibration.cameras, rng), columns=np.full((1024, 1280), np.nan, np.float32))
    with pytest.raises(InputError, match=r"expected two balls of 25\.4 mm before cam1 and projector, found none"):
        ball_bar.find(dark, calibration.cameras, BALL, "bar")


def test_a_bar_of_another_length_departs(calibration, rng):
    """By 0.5 mm of 150, where a print to 3e-4 and usual drift leave 0.06: beyond 5 sigma; as certified within 3."""
    bar = drawn_bar(calibration.cameras, rng)
    known = drift.expected(calibration, 3e-4, DRIFT_PX)
    found = ball_bar.measure(bar, calibration.cameras, known.names)
    right, wrong = (abs(ball_bar.departure(found, (LENGTH + off, 0.002), known)) for off in (0.0, 0.5))
    assert right < 0.5 and 5 < wrong < 20


def test_the_slopes_are_those_of_the_length(calibration, rng):
    """By finite differences, to 2 % of the largest."""
    bar = drawn_bar(calibration.cameras, rng)
    found, steps = ball_bar.measure(bar, calibration.cameras, NAMES), np.diag([0.1, 0.1, 0.01, 1e-5, 0.1])
    slopes = [
        np.subtract(*(ball_bar.measure(bar, moved(calibration.cameras, NAMES, s * step), ()).length_mm for s in (1, -1))) / 2
        for step in steps
    ]
    expected = found.by_optics * np.diag(steps)
    assert np.abs(slopes - expected).max() < 0.02 * np.abs(expected).max()


@pytest.mark.slow
def test_a_bar_tells_the_scale_as_well_as_it_says(rig, calibration):
    """Of 16 drifted rigs, whose boards were printed to 3e-4: below 8e-5, and squares of the error over sigma as chi-square's."""
    normal = []
    for seed in range(16):
        rng = np.random.default_rng([13, seed])
        wrong = drawn_check.drawn_rig(calibration.cameras, drift.calibration_uncertainty(calibration, 3e-4), rng)
        true = drawn_check.drawn_rig(wrong, drift.usual_drift(calibration.cameras, DRIFT_PX), rng)
        matches = drawn_check.drawn_matches(true, calibration.cameras, (0,), SIGMA_PX, rng).some(slice(0, 300))
        seen = tuple(drawn_bar(true, rng, (0.0, 0.0, z), patches=80) for z in (-35.0, 30.0))
        bars = Bars(seen, LENGTH + 0.002 * rng.standard_normal(), 0.002)
        found = drift.estimate(calibration, None, matches, rig.target, 3e-4, DRIFT_PX, bars).after
        volume = uncertainty.working_volume(found, [620.0, 680.0])
        sigma = uncertainty.scale(found, "cam1", "cam2", volume)
        assert sigma < 8e-5
        places = meet([found.cameras[name] for name in CAMERAS], [true[name].project(volume) for name in CAMERAS])[0]
        modes = uncertainty.similarity_modes(volume)
        normal.append(np.linalg.lstsq(modes.reshape(-1, 7), (places - volume).ravel(), rcond=None)[0][-1] / sigma)
    assert 1e-3 < stats.chi2.sf(np.sum(np.square(normal)), len(normal)) < 1 - 1e-3
