"""The target on a tool whose tip rests in a dimple, tilted to all sides and turned: what a tip is calibrated from."""

from collections.abc import Mapping, Sequence
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from recon.model import circle_layout
from recon.model.rig import Finite, Positive, Target, Vector
from twin import conditions
from twin.tracking.film_path import STILL, Aimed, FilmPath, Way, facing

Array = NDArray[np.float64]

STEPS = 96  # of a round, between which it is smooth
TIP_MM = (0.0, -120.0, -30.0)  # in the target's frame: below the circles, as of a pointer that is held like a pen
ROUNDS = (2, 3, 1)  # of both tilts and of the turn, in one round of the path: tilts of all sizes, upright among them


class Kind(FilmPath):
    """A closed round about the tip, which stays where it is: a trembling hand turns the tool about it."""

    kind: Literal["pivot"] = "pivot"
    seconds: Positive = 10.0  # a round
    tip_mm: Vector | None = None  # in the target's frame; None: the body's own, or TIP_MM where it has none
    middle_mm: Vector  # of the circles' middle in the world, of the tool upright, its face to the cameras
    roll_deg: Finite = 0.0  # of the target's x axis in the image then, from left to right
    tilt_deg: Annotated[float, Field(ge=0, le=60)] = 25.0  # at most, about each of two axes across the shaft
    turn_deg: Annotated[float, Field(ge=0, le=60)] = 20.0  # at most, about the shaft, both ways

    def lead(
        self,
        target: Target,
        eyes: Array,
        seed: int,
        errors: conditions.Motion = STILL,
        body: Sequence[int] = (),
        aimed: Aimed | None = None,
    ) -> Way:
        """Lead it about the tip; the seed tells where it begins."""
        middle, tip = circle_layout.middle(target), self._tip(aimed)
        first = facing(eyes - np.array(self.middle_mm, float), self.roll_deg)
        shaft = first @ (middle - tip) / np.linalg.norm(middle - tip)
        across = np.linalg.svd(shaft[None])[2][1:]
        phases = np.random.default_rng([seed, 2, *body]).uniform(0, 2 * np.pi, 3)
        parts = np.sin(2 * np.pi * np.linspace(0, 1, STEPS + 1)[:, None] * ROUNDS + phases)
        tilts = Rotation.from_rotvec(np.deg2rad(self.tilt_deg) * parts[:, :2] @ across)
        turned = (tilts * Rotation.from_rotvec(np.deg2rad(self.turn_deg) * parts[:, 2:] * shaft)).as_rotvec()
        turned[-1] = turned[0]
        times = np.linspace(0, self.seconds, STEPS + 1)
        dimple = np.tile(self.dimple_mm(target, eyes, aimed), (STEPS + 1, 1))
        rest = CubicSpline(times, dimple, bc_type="periodic")
        still = errors.model_copy(update={"tremor_mm": 0.0})
        return Way(rest, CubicSpline(times, turned, bc_type="periodic"), first, tip, conditions.trembling(still, seed, *body))

    def dimple_mm(self, target: Target, eyes: Array, aimed: Aimed | None = None) -> Array:
        """Place of the tip in the world : (3,) mm."""
        first = facing(eyes - np.array(self.middle_mm, float), self.roll_deg)
        return np.array(self.middle_mm) + first @ (self._tip(aimed) - circle_layout.middle(target))

    @property
    def room_mm(self) -> Array:
        """Behind the tool, however it is tilted."""
        return np.add(self.middle_mm, [0.0, 0.0, np.linalg.norm(self._tip()) * np.sin(np.deg2rad(self.tilt_deg))])

    def truth(self, target: Target) -> Mapping[str, Array]:
        """The tip, in the target's frame."""
        return {"tip_mm": self._tip()}

    def _tip(self, aimed: Aimed | None = None) -> Array:
        """As given, or else the body's own : (3,) mm in the target's frame."""
        if self.tip_mm is None and aimed is not None and aimed.line_mm is not None:
            return aimed.line_mm[-1]
        return np.array(TIP_MM if self.tip_mm is None else self.tip_mm, float)
