"""The rows of the optics calibration in reduced form, and the figures that they are made of."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml

from recon.capture.surface_part import read_patterns
from recon.geometry import rigid
from recon.geometry.camera_jacobian import moved
from recon.model.calibration import Calibration
from scenes.board_poses import Config as Poses
from scenes.board_poses import random_poses
from scenes.kinds import board
from tests.twin.experiments.asked import missed, rows
from tests.twin.small_rigs import half
from twin import board_session
from twin.experiments import calibration_accuracy
from twin.experiments.baselines import opencv_peer
from twin.experiments.board_sets import drawn, recalibrated
from twin.experiments.calibration_errors import focal_error, motion_error, point_errors, scale_error, squared_length
from twin.experiments.experiment_setup import Setup
from twin.optics.light_transport import Tracing
from twin.optics.surface_session import calibration_of

ROOT = Path(__file__).resolve().parents[3]
NOISE = (("cam1", 0.005), ("cam2", 0.005), ("projector", 0.003))  # px, as on rendered boards


@pytest.fixture
def setup(rig) -> Setup:
    """The rig and the calibration's patterns."""
    return Setup(
        rig, {name: read_patterns(ROOT / f"conf/patterns/{name}.yaml") for name in ("paper_calibration", "paper_surface")}
    )


def check(function, figures) -> None:
    """Every bar is met."""
    assert not missed(function, figures)


def test_poses_are_those_of_the_paper():
    """The rows rely on the defaults, which are to be those of the paper's file."""
    written = yaml.safe_load((ROOT / "conf" / "poses" / "paper.yaml").read_text(encoding="utf-8"))
    assert Poses.model_validate(written) == Poses()


def test_corrected_centres_of_a_rendered_board(rig, monkeypatch):
    """Discs of 9 mm tilted by 40 deg: 0.077 px of bias without the correction, next to none with it.

    Edges are computed, so that few paths do for all other pixels.
    """
    monkeypatch.setattr(calibration_accuracy, "TRACING", calibration_accuracy.TRACING.model_copy(update={"samples": 4}))
    monkeypatch.setattr(board_session, "SIDE_SAMPLES", 4)
    found = calibration_accuracy.centre_bias(Setup(rig), 9.0, 40.0)
    check(calibration_accuracy.centre_bias, found)
    assert found["uncorrected_px"] == pytest.approx(0.077, abs=0.005)


def test_baselines_need_the_correction(rig):
    """Large discs on tilted boards: left out, the correction costs a hundredth of a millimetre of baseline."""
    found = calibration_accuracy.baseline_bias(Setup(rig), 12.0, 40.0, count=6)
    check(calibration_accuracy.baseline_bias, found)
    assert found["uncorrected_mm"] > 0.005


def test_covariance_is_honest_and_no_worse_than_opencv(rig):
    """Three calibrations of eight poses: chi-square of the parameters; points of camera and projector beat OpenCV's pair.

    With so few calibrations shares of points in their regions and single parameters say little: they are left to the full rows.
    """
    drawings = recalibrated(rig, NOISE, draws=3, count=8)
    honest = rows(calibration_accuracy.honesty, calibration_accuracy.over_predictions(drawings))[:2]
    assert all(row.met for row in honest)
    peer = missed(calibration_accuracy.beside_opencv, opencv_peer.in_many_draws(drawings))
    assert not [row for row in peer if "projector: points" in row.what]


def test_a_covariance_too_small_is_found_out(rig):
    """Half the standard deviation, and chi-square says so."""
    seen, result = recalibrated(rig, NOISE, draws=3, count=8)[0]
    found = result.adjustment.calibration
    boast = replace(found, uncertainty=replace(found.uncertainty, covariance=found.uncertainty.covariance / 4))
    boasted = replace(result, adjustment=replace(result.adjustment, calibration=boast))
    figures = calibration_accuracy.over_predictions([(seen, boasted)])
    assert rows(calibration_accuracy.honesty, figures)[1].met is False


def test_figures_of_a_known_error(rig):
    """A turn, a shift and a longer focal length are read back; points move as the second device does."""
    truth = calibration_of(rig)
    changed = moved(truth.cameras["cam2"], ("fx", "rx", "tx"), np.array([3.318, np.deg2rad(0.01), 0.05]))
    found = Calibration(dict(truth.cameras) | {"cam2": changed})
    assert motion_error(found, truth, "cam2") == pytest.approx((0.01, 0.05), rel=1e-6)
    assert focal_error(found, truth, "cam2") == pytest.approx(0.1, rel=1e-3)
    points = np.array([[0.0, 0.0, 650.0], [30.0, -20.0, 700.0]])
    assert np.abs(point_errors(found, truth, ("cam1", "projector"), points)).max() < 1e-9
    assert np.linalg.norm(point_errors(found, truth, ("cam1", "cam2"), points), axis=1).min() > 0.05


def test_scale_is_told_from_motion(rng):
    """Points turned, shifted and stretched by 0.02 %."""
    true = rng.uniform(-100, 100, (500, 3))
    motion = rigid.from_rotation_vector([0.1, -0.2, 0.3], [5.0, -7.0, 650.0])
    assert scale_error(1.0002 * rigid.apply(motion, true), true) == pytest.approx(0.02, rel=1e-6)


def test_squared_length_of_normal_errors(rng):
    """Mean over many draws is the number of parameters, however different their units."""
    factor = rng.standard_normal((5, 5)) * np.array([[1e3], [1.0], [1e-3], [1e-6], [1e-2]])
    lengths = [squared_length(factor @ rng.standard_normal(5), factor @ factor.T) for _ in range(2000)]
    assert np.mean(lengths) == pytest.approx(5, abs=5 * np.sqrt(10 / 2000))


@pytest.mark.slow
def test_bent_board(rig, rng):
    """A warped, misprinted board, as points: errors as large as predicted, and gone once the shape is released."""
    truth, design = calibration_of(rig), board.design(board.Config())
    poses = random_poses(Poses(count=16), design, list(truth.cameras.values()))
    flat = drawn(truth, design, poses, dict(NOISE), rng)
    bent = drawn(truth, design, poses, dict(NOISE), rng, board.printed_centres(calibration_accuracy.BENT))
    check(calibration_accuracy.bad_board, calibration_accuracy.board_shape(flat, bent))


@pytest.mark.slow
def test_rendered_calibration(setup, rig, monkeypatch):
    """Seven rendered poses: residuals and parameters within the bars, and planes and sphere measured with them.

    The bars are those of the full rows, though a quarter of the rays, and of camera 1's pixels, leaves more noise.
    """
    monkeypatch.setattr(calibration_accuracy, "TRACING", Tracing(samples=4, room_lux=20))
    small = replace(setup, rig=rig.model_copy(update={"cam1": half(rig).cam1}))
    for function in (calibration_accuracy.against_truth, calibration_accuracy.surfaces):
        check(function, function(small, poses=7))
