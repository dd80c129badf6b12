"""The target led by a hand through places, as when a probe is brought from one to the next."""

from collections.abc import Sequence
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy.interpolate import CubicSpline

from recon.model import circle_layout
from recon.model.rig import Finite, NotNegative, Positive, Target, Vector
from twin import conditions
from twin.tracking.film_path import STILL, Aimed, FilmPath, Way, facing

Array = NDArray[np.float64]


class Kind(FilmPath):
    """A closed round: the target's middle passes at even times through places, and turns about them as a hand does."""

    kind: Literal["hand"] = "hand"
    seconds: Positive = 1.6  # a round
    places_mm: Annotated[tuple[Vector, ...], Field(min_length=3)]  # in the world
    roll_deg: Finite = 180.0  # of the target's x axis in the image, from left to right, on the whole
    turn_deg: NotNegative = 6.0  # standard deviation about each axis, from place to place
    unsteady_mm: NotNegative = 1.0  # of the places

    def lead(
        self,
        target: Target,
        eyes: Array,
        seed: int,
        errors: conditions.Motion = STILL,
        body: Sequence[int] = (),
        aimed: Aimed | None = None,
    ) -> Way:
        """Lead it as steadily as the path demands."""
        rng = np.random.default_rng([seed, 2, *body])
        places = np.array(self.places_mm, float)
        places = places + self.unsteady_mm * rng.standard_normal(places.shape)
        turns = np.deg2rad(self.turn_deg) * rng.standard_normal(places.shape)
        times = np.linspace(0, self.seconds, len(places) + 1)
        middle, turn = (CubicSpline(times, np.vstack([rows, rows[:1]]), bc_type="periodic") for rows in (places, turns))
        first = facing(eyes - places.mean(axis=0), self.roll_deg)
        return Way(middle, turn, first, circle_layout.middle(target), conditions.trembling(errors, seed, *body))

    @property
    def room_mm(self) -> Array:
        """Behind the farthest place."""
        places = np.array(self.places_mm, float)
        return np.append(places[:, :2].mean(axis=0), places[:, 2].max())
