"""A target that stays in one place, as a board on a post does beside what lies still."""

from collections.abc import Sequence
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from recon.model import circle_layout
from recon.model.rig import Finite, Target, Vector
from twin import conditions
from twin.tracking.film_path import STILL, Aimed, FilmPath, Way, facing

Array = NDArray[np.float64]


class Kind(FilmPath):
    """One place, in which a hand alone trembles."""

    kind: Literal["still"] = "still"
    place_mm: Vector  # of the circles' middle, in the world
    roll_deg: Finite = 0.0  # of the target's x axis in the image

    def lead(
        self,
        target: Target,
        eyes: Array,
        seed: int,
        errors: conditions.Motion = STILL,
        body: Sequence[int] = (),
        aimed: Aimed | None = None,
    ) -> Way:
        """Keep it there."""
        place, never = np.array(self.place_mm), CubicSpline([0.0, 1.0], np.zeros((2, 3)), bc_type="periodic")
        middle = CubicSpline([0.0, 1.0], np.tile(place, (2, 1)), bc_type="periodic")
        first = facing(eyes - place, self.roll_deg)
        return Way(middle, never, first, circle_layout.middle(target), conditions.trembling(errors, seed, *body))

    @property
    def room_mm(self) -> Array:
        """The place."""
        return np.array(self.place_mm)
