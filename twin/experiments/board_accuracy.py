"""Accuracy with boards that bow and are printed imprecisely, against the best fixed choice, which is told their tolerances."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from recon.model.calibration import Calibration
from recon.model.rig import Rig
from recon.optical_calibration import uncertainty
from recon.optical_calibration.joint_calibration import Settings, Shape, calibrate, deviation
from scenes.board_poses import Config as Poses
from scenes.board_poses import random_poses
from scenes.kinds import board
from twin.evaluation.surface_errors import rms
from twin.experiments.board_sets import drawn
from twin.experiments.calibration_errors import DEPTHS, PAIRS, inside_region, point_errors, squared_length, squared_point_errors
from twin.experiments.experiment_setup import Figures, Setup
from twin.optics.surface_session import calibration_of

Array = NDArray[np.float64]

SEEDS = range(700, 740)  # unseen seeds of boards
BOWS_MM = (0.0, 0.02, 0.1, 0.5)  # largest distance from the plane
PRINTS_MM = (0.0, 0.02, 0.1)  # standard deviation of each dot along x and y
POSES = (12, 20, 34)
NOISE_PX = {"cam1": 0.004, "cam2": 0.004, "projector": 0.003}  # a fourth more than of rendered boards
SMALL_MM = 0.001  # forms of less are as good: it is that of measured planes with the true calibration


@dataclass(frozen=True)
class Calibrated:
    """A calibration with one board."""

    form_mm: float  # of planes seen by camera 1 and projector without noise
    parameters: float  # squared error over its expectation, a parameter
    points: float  # the same of points, a coordinate
    inside: float  # share of points in their 95 % region


def bowed_boards(setup: Setup) -> Figures:
    """Form of planes and honesty with default settings, and forms by fixed choices."""
    found = [each(setup.rig, seed) for seed in SEEDS]
    forms = {name: np.array([choices[name].form_mm for choices in found]) for name in found[0]}
    default, bows = [choices["default"] for choices in found], np.array([_bow(seed) for seed in SEEDS])
    figures: Figures = {"boards": len(found), "form_mm": forms["default"].max()}
    figures |= {f"{name}: form_mm": rms(form) for name, form in forms.items()}
    for bow in BOWS_MM:
        alike = {name: max(rms(form[bows == bow]), SMALL_MM) for name, form in forms.items()}
        figures[f"ratio_at_{bow:g}"] = alike.pop("default") / min(alike.values())
    return figures | {name: np.mean([getattr(one, name) for one in default]) for name in ("parameters", "points", "inside")}


def each(rig: Rig, seed: int, names: Collection[str] | None = None) -> Mapping[str, Calibrated]:
    """One board, its poses and their noise, calibrated by default and by fixed choices of shape and lens.

    names : of choices; all if not given
    """
    rng, truth, design = np.random.default_rng([seed, 5]), calibration_of(rig), board.design(board.Config())
    bow, off = _bow(seed), PRINTS_MM[seed % len(PRINTS_MM)]
    points = misshapen(design.points(), bow, off, rng)
    poses = random_poses(Poses(count=POSES[seed % 7 % len(POSES)], seed=seed), design, list(truth.cameras.values()))
    seen = drawn(truth, design, poses, NOISE_PX, rng, points)
    flatness = float(np.std(points[:, 2]))
    told = Shape(in_plane_mm=max(off, 1e-4), out_of_plane_mm=max(flatness, 1e-4))
    choices = {
        "default": Settings(),
        "the true lens, taken as designed": Settings(distortion="decentred", shape=Shape(released=False)),
        "the true lens, tolerances told": Settings(distortion="decentred", shape=told),
        "five coefficients, tolerances told": Settings(distortion="brown", shape=told),
        "one coefficient, taken as designed": Settings(distortion="radial1", shape=Shape(released=False)),
    }
    return {
        name: judged(calibrate(seen.sightings, design, seen.sizes, settings).adjustment.calibration, truth)
        for name, settings in choices.items()
        if names is None or name in names
    }


def misshapen(points: Array, bow_mm: float, print_mm: float, rng: np.random.Generator) -> Array:
    """A board's points : (n, 3) mm, bowed by random shares of an arch either way and a twist, each printed off its place."""
    x, y = ((points - points.mean(axis=0)) / (np.ptp(points, axis=0) / 2 + 1e-9)).T[:2]
    z = rng.standard_normal(3) @ np.array([x**2, x * y, y**2])
    z -= z.mean()
    return points + np.column_stack([print_mm * rng.standard_normal((len(points), 2)), bow_mm * z / np.abs(z).max()])


def judged(found: Calibration, truth: Calibration) -> Calibrated:
    """Compare a calibration with the true one."""
    assert found.uncertainty is not None
    error, volume = deviation(found, truth), uncertainty.working_volume(truth, DEPTHS)
    parameters = squared_length(error, found.uncertainty.covariance) / len(error)
    points = float(squared_point_errors(found, truth, PAIRS[1], volume).mean()) / 3
    return Calibrated(form(found, truth), parameters, points, inside_region(found, truth, PAIRS[1], volume))


def form(found: Calibration, truth: Calibration, depths: Sequence[float] = DEPTHS) -> float:
    """Form error of planes at three depths, seen by camera 1 and projector without noise, RMS, mm."""
    return rms(np.array([_flatness(found, truth, depth) for depth in depths]))


def _bow(seed: int) -> float:
    return BOWS_MM[seed % len(BOWS_MM)]


def _flatness(found: Calibration, truth: Calibration, depth: float) -> float:
    """RMS distance of a plane's points from the plane that fits them best, mm."""
    plane = uncertainty.working_volume(truth, [depth])
    points = plane + point_errors(found, truth, PAIRS[1], plane)
    points = points - points.mean(axis=0)
    return rms(points @ np.linalg.svd(points)[2][-1])
