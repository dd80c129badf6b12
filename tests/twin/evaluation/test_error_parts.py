"""Errors that are made of known parts are taken apart into these."""

from dataclasses import replace

import numpy as np
import pytest

from recon.capture.surface_part import read_surface
from recon.model.calibration import Calibration, Uncertainty
from recon.optical_calibration import uncertainty
from recon.structured_light import triangulate
from recon.structured_light.decode import decode
from twin.evaluation import error_parts, surface_errors

NOISE_MM = 0.04  # along the normals
NAMES = ("cam1.fx", "cam1.cx", "projector.fx", "projector.cx", "projector.ry", "projector.tx")
SIGMAS = np.array([0.05, 0.04, 0.06, 0.04, 4e-6, 4e-3])  # px, rad, mm


@pytest.fixture(scope="module")
def truth(session):
    return surface_errors.read_truth(session.folder / "truth")


@pytest.fixture(scope="module")
def found(session):
    """What was decoded: columns alone."""
    shots = read_surface(session.folder / "capture")
    return decode(shots.images, shots.patterns)


@pytest.fixture(scope="module")
def known(truth):
    """The true calibration, with a covariance of some parameters."""
    covariance = np.diag(SIGMAS) @ (0.5 + 0.5 * np.eye(6)) @ np.diag(SIGMAS)
    return Calibration({"cam1": truth.camera, "projector": truth.projector}, Uncertainty(NAMES, covariance))


def seen_by(estimated, found, truth, rng):
    """Points by an estimated calibration from the true projector coordinates, with noise along the normals."""
    exact = error_parts._true_coordinates(found, truth)
    points = triangulate.triangulate(exact, estimated.cameras["cam1"], estimated.cameras["projector"]).points
    noisy = points + truth.normals * np.float32(rng.normal(0, NOISE_MM, truth.lit.shape))[..., None]
    noisy[~truth.lit] = np.nan
    return surface_errors.compare(noisy, np.full(truth.lit.shape, NOISE_MM, np.float32), truth)


def by_calibration(found, truth, estimated, comparison):
    """The calibration's part, of the points that have a prediction."""
    return error_parts.of_calibration(found, truth, estimated, "cam1", surface_errors.points_with_prediction(comparison))


def test_calibration_and_noise_come_apart(found, truth, known, rng):
    """Noise to 2 %; the rest is the noise's mean over 225 px, a fifteenth of it, which noise lacks in turn."""
    moved = uncertainty.apply(known, 2 * SIGMAS)
    comparison = seen_by(moved, found, truth, rng)
    split = error_parts.split(comparison, by_calibration(found, truth, moved, comparison))
    assert list(split.parts) == ["calibration", "rest", "noise"]
    assert split.parts["noise"].rms_mm == pytest.approx(NOISE_MM, rel=0.02)
    assert split.parts["noise"].predicted_mm == pytest.approx(NOISE_MM, rel=0.03), "by the cosine of the ray"
    assert split.parts["calibration"].rms_mm > NOISE_MM
    assert split.parts["rest"].rms_mm < NOISE_MM / 10


def test_the_parts_add_up(found, truth, known, rng):
    moved = uncertainty.apply(known, 2 * SIGMAS)
    comparison = seen_by(moved, found, truth, rng)
    split = error_parts.split(comparison, by_calibration(found, truth, moved, comparison))
    parts, whole = split.parts.values(), split.whole
    assert sum(part.mean_mm for part in parts) == pytest.approx(whole.mean_mm, abs=1e-6)
    assert sum(part.scatter_mm**2 for part in parts) == pytest.approx(whole.scatter_mm**2, rel=0.05)
    assert whole.rms_mm**2 == pytest.approx(whole.mean_mm**2 + whole.scatter_mm**2)


def test_the_true_calibration_has_no_part(found, truth, known, rng):
    exact = error_parts.of_calibration(found, truth, known, "cam1", truth.lit)
    assert np.nanmax(np.abs(exact.error)) < 3e-4, "float32 at 700 mm, seen obliquely"
    split = error_parts.split(seen_by(known, found, truth, rng), None)
    assert list(split.parts) == ["rest", "noise"]


def test_what_neighbours_share_beside_it_is_the_rest(found, truth, known, rng):
    """A surface that is 0.1 mm too high everywhere, as by no calibration."""
    comparison = seen_by(known, found, truth, rng)
    raised = replace(comparison, error=comparison.error + np.float32(0.1))
    split = error_parts.split(raised, by_calibration(found, truth, known, comparison))
    assert split.parts["rest"].mean_mm == pytest.approx(0.1, abs=0.002)
    assert abs(split.parts["calibration"].mean_mm) < 1e-4


def test_the_calibrations_prediction_is_the_scatter_of_calibrations(found, truth, known, rng):
    """RMS over the surface of 40 calibrations drawn from the covariance, to 4 standard errors of a chi-square of few degrees."""
    draws = rng.multivariate_normal(np.zeros(len(NAMES)), known.uncertainty.covariance, 40)
    squares = []
    for change in draws:
        part = error_parts.of_calibration(found, truth, uncertainty.apply(known, change), "cam1", truth.lit)
        squares.append(np.nanmean(np.float64(part.error) ** 2))
    predicted = error_parts.of_calibration(found, truth, known, "cam1", truth.lit).sigma_mm
    assert np.sqrt(np.mean(squares)) == pytest.approx(predicted, rel=4 / np.sqrt(2 * len(draws)))


def test_the_prediction_is_that_of_the_points_that_count(found, truth, known, rng):
    """The wall and the ball apart: mean squares by their numbers of points give the whole's, to 5 % of 2000 samples' spread."""
    comparison = seen_by(known, found, truth, rng)
    wall = truth.points[..., 2] > 705
    squares, counts = {}, {}
    for name, some in {"whole": truth.lit, "wall": truth.lit & wall, "ball": truth.lit & ~wall}.items():
        chosen = replace(comparison, predicted=np.where(some, comparison.predicted, np.float32(np.nan)))
        split = error_parts.split(chosen, by_calibration(found, truth, known, chosen))
        squares[name], counts[name] = split.parts["calibration"].predicted_mm ** 2, split.known.sum()
    assert counts["wall"] + counts["ball"] == counts["whole"]
    together = sum(counts[name] * squares[name] for name in ("wall", "ball")) / counts["whole"]
    assert together == pytest.approx(squares["whole"], rel=0.05)
    assert abs(squares["wall"] / squares["ball"] - 1) > 0.2, squares
    nothing = replace(comparison, predicted=np.full_like(comparison.predicted, np.nan))
    assert np.isnan(by_calibration(found, truth, known, nothing).sigma_mm)
