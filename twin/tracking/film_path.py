"""How a hand leads the target before the cameras in a film: at any time a pose, a speed and a turn.

A kind of path is a module of `twin.tracking.film_paths`, found by its name, with a subclass `Kind` of `FilmPath`.
"""

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from recon.geometry import rigid
from recon.geometry.camera import Camera
from recon.model.part import Kinds
from recon.model.rig import Target
from twin import conditions
from twin.tracking.samples import Motion
from twin.tremor import Tremor

Array = NDArray[np.float64]

STILL = conditions.Motion()


@dataclass(frozen=True)
class Way:
    """A path at any time; both splines are closed."""

    middle: CubicSpline  # (3,) mm in the world over s, of the point about which it turns
    turn: CubicSpline  # (3,) rotation vector in the world over s, from `facing`
    facing: Array  # (3, 3)
    middle_target: Array  # (3,) mm, that point in the target's frame
    tremor: Tremor  # of the hand, about that point

    def pose(self, seconds: float) -> Array:
        """`world_from_target` : (4, 4) mm."""
        shaken = self.tremor.at(seconds)
        turned = Rotation.from_rotvec(shaken[:3]).as_matrix() @ Rotation.from_rotvec(self.turn(seconds)).as_matrix() @ self.facing
        return rigid.transform(turned, self.middle(seconds) + shaken[3:] - turned @ self.middle_target)

    def velocity(self, seconds: float) -> tuple[Array, Array]:
        """Of the target's origin : (3,) mm/s, and its turn : (3,) rad/s, in the world."""
        shaken, rate = self.tremor.at(seconds), self.tremor.rate(seconds)
        led = _left_jacobian(self.turn(seconds)) @ self.turn(seconds, 1)
        spin = _left_jacobian(shaken[:3]) @ rate[:3] + Rotation.from_rotvec(shaken[:3]).as_matrix() @ led
        lever = self.pose(seconds)[:3, :3] @ self.middle_target
        return self.middle(seconds, 1) + rate[3:] - np.cross(spin, lever), spin

    def motion(self, seconds: float, exposure_s: float) -> Motion:
        """Over an exposure with its middle at a time."""
        speed, spin = self.velocity(seconds)
        return Motion(self.pose(seconds), speed * exposure_s, spin * exposure_s)


class Aimed(NamedTuple):
    """What a tool is led by besides its target."""

    line_mm: Array | None  # (2, 3) from the shaft's rear end to the tip, in the target's frame; None of a body without a tip
    world_from_face: Array  # (4, 4) mm: the middle of the array's face, x along it, y into the depth
    cameras: Sequence[Camera] = ()  # that are to see the target
    others: Sequence[tuple[Target, Array]] = ()  # targets that it should not cover, with their poses : (k, 4, 4)


class FilmPath(Kinds):
    """A closed round of the target."""

    PACKAGE = "twin.tracking.film_paths"
    USUAL = "hand"

    @abstractmethod
    def lead(
        self,
        target: Target,
        eyes: Array,
        seed: int,
        errors: conditions.Motion = STILL,
        body: Sequence[int] = (),
        aimed: Aimed | None = None,
    ) -> Way:
        """Lead the target along the path, its face to the point between the cameras : (3,) mm.

        errors : of which the tremor is added.
        body : its number, of one besides the probe
        aimed : of one besides the probe
        """

    @property
    @abstractmethod
    def room_mm(self) -> Array:
        """Where surroundings are set up : (3,) mm, so that the whole path lies in front of them."""

    def truth(self, target: Target) -> Mapping[str, Array]:
        """More truth of the path, by name."""
        return {}


def facing(towards: Array, roll_deg: float) -> Array:
    """Rotation with z along a direction, and x turned by an angle from the image's, clockwise for those who look at the face."""
    z = towards / np.linalg.norm(towards)
    roll = np.deg2rad(roll_deg)
    x = np.array([np.cos(roll), np.sin(roll), 0.0])
    x = x - (x @ z) * z
    x = x / np.linalg.norm(x)
    return np.column_stack([x, np.cross(z, x), z])


def _left_jacobian(vector: Array) -> Array:
    """From the rate of a rotation vector to the angular velocity in the fixed frame : (3, 3)."""
    angle = float(np.linalg.norm(vector))
    k = rigid.cross(vector)
    if angle < 1e-4:
        return np.eye(3) + k / 2 + k @ k / 6
    return np.eye(3) + (1 - np.cos(angle)) / angle**2 * k + (angle - np.sin(angle)) / angle**3 * k @ k
