"""Errors of points, B-scans and masses that a rig will find in a session, by sessions drawn from what detectors find.

All that follows the detectors is the real software: see `drawn_session`.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from twin.experiments import chain_trial
from twin.experiments.experiment_runs import Settings

FIGURES = {
    "surface_rms_mm": "points of the surface along z",
    "pixel_rms_mm": "pixels of B-scans",
    "mass_error_mm": "the centre of a mass",
    "mass_to_skin_mm": "the centre of a mass against the skin over it",
}


class SessionError(NamedTuple):
    """One figure of sessions, mm."""

    rms: float
    sigma: float  # of that, as so few sessions were drawn
    worst: float


def predict(settings: Settings, seeds: Sequence[int]) -> dict[str, SessionError]:
    """Predict the errors of `FIGURES`, in camera 1's frame, by two sessions or more.

    Raises
    ------
    InputError, ValueError
        If nothing can be measured with these settings.
    """
    drawn = [chain_trial.measure(settings, seed) for seed in seeds]
    found = {}
    for name in FIGURES:
        squares = np.array([one[name] for one in drawn], float) ** 2
        rms = float(np.sqrt(squares.mean()))
        sigma = float(squares.std(ddof=1) / np.sqrt(len(squares)) / (2 * rms))
        found[name] = SessionError(rms, sigma, float(np.sqrt(squares.max())))
    return found
