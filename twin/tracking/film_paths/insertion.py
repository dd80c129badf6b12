"""A needle that is led straight to an aim and back, in the B-scan's plane or across it, its target to the cameras."""

from collections.abc import Sequence
from itertools import product
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from recon.errors import InputError
from recon.geometry import rigid
from recon.model.rig import Finite, NotNegative, Positive, Target, Vector
from twin import conditions
from twin.tracking.film_path import STILL, Aimed, FilmPath, Way
from twin.tracking.views_of_target import covers, in_views

Array = NDArray[np.float64]

STEPS = 96  # of a round, between which it is smooth
# tried one after the other, until all cameras see the target, and it covers no other: in the plane, then across it
HEADINGS_DEG = (0.0, 180.0, *(float(way) for off in range(15, 90, 15) for way in (off, -off, 180 - off, off - 180)), 90.0, -90.0)
ANGLES_DEG = (35.0, 45.0, 55.0, 60.0, 65.0, 70.0, 75.0, 80.0)
ROLLS_DEG = (0.0, *(float(way) for off in range(15, 91, 15) for way in (off, -off)))
MARGIN, MOST_DEG = 0.04, 60.0  # of the image's width, for the hand's turns; of the target's normal to the line of sight
PLACES = 8  # of a round, between which a hand wanders


class Kind(FilmPath):
    """A closed round: the tip goes along its own shaft to the aim, rests there, and comes back."""

    kind: Literal["insertion"] = "insertion"
    seconds: Positive = 10.0  # a round
    rest_s: NotNegative = 2.0  # of it at the aim
    aim_mm: Vector | None = None  # of the tip, in the world; None: under the middle of the array, at depth_mm
    depth_mm: Positive = 22.0  # of the aim, in the B-scan
    entry_mm: Vector | None = None  # from where the tip sets off, in the world; None: by the angles and travel_mm
    angle_deg: Annotated[float, Field(ge=0, le=90)] | None = None  # of the shaft to the array's face; 0 is parallel
    heading_deg: Finite | None = None  # of its way about the depth, from the array's own: 0, 180 stay in the plane, 90 crosses it
    roll_deg: Finite | None = None  # about the shaft, from where the target faces the cameras most; see `in_view` for all three
    travel_mm: NotNegative = 30.0  # to the aim
    beside_mm: Finite | None = (
        None  # shifts all across the plane, the aim so far beside it; None leaves it, an aim by depth in it
    )
    turn_deg: NotNegative = 0.5  # standard deviation of the hand's turns about the tip, about each axis
    unsteady_mm: NotNegative = 0.15  # of the tip about its line

    @model_validator(mode="after")
    def _has_time(self) -> "Kind":
        if self.rest_s >= self.seconds:
            raise ValueError(f"rest_s: expected less than seconds = {self.seconds:g}, found {self.rest_s:g}")
        return self

    def lead(
        self,
        target: Target,
        eyes: Array,
        seed: int,
        errors: conditions.Motion = STILL,
        body: Sequence[int] = (),
        aimed: Aimed | None = None,
    ) -> Way:
        """Lead it along its shaft, turned about that so that its target faces the cameras.

        Raises
        ------
        InputError
            If the body has no tip, or as of `line`.
        """
        if aimed is None or aimed.line_mm is None:
            raise InputError("path.kind: expected insertion for a body with a tip, such as a needle, found one without")
        led = self.in_view(target, eyes, aimed)
        entry, aim, _ = led.line(aimed.world_from_face)
        first = led._held(eyes, aimed.line_mm, aimed.world_from_face)
        rng = np.random.default_rng([seed, 2, *body])
        times = np.linspace(0, self.seconds, STEPS + 1)
        aside, turn = (_wandering(rng, sigma, self.seconds) for sigma in (self.unsteady_mm, np.deg2rad(self.turn_deg)))
        tip = entry + self._share(times)[:, None] * (aim - entry) + aside(times)
        tip[-1] = tip[0]
        return Way(
            CubicSpline(times, tip, bc_type="periodic"), turn, first, aimed.line_mm[1], conditions.trembling(errors, seed, *body)
        )

    def in_view(self, target: Target, eyes: Array, aimed: Aimed) -> "Kind":
        """The path with its angle, heading and roll: as given, or else the first by which all cameras see the target.

        It should be seen with its tip at the entry and at the aim, and cover no other body's target. Ways in the B-scan's plane
        come first, from either side, then those across it; of them flat ones, and of these such as face the cameras. If all cover
        another one, it is led by the first that is seen; if none is, by the first.
        """
        assert aimed.line_mm is not None
        given = (self.heading_deg, self.angle_deg, self.roll_deg)
        tried = [
            usual if value is None else (value,)
            for value, usual in zip(given, (HEADINGS_DEG, ANGLES_DEG, ROLLS_DEG), strict=True)
        ]
        ways = [
            self.model_copy(update={"heading_deg": heading, "angle_deg": angle, "roll_deg": roll})
            for headings in (tried[0][:2], tried[0][2:])
            for angle, roll, heading in product(*tried[1:], headings)
        ]
        seen, others = [], [(pose, other) for other, places in aimed.others for pose in places]
        for way in ways if aimed.cameras else []:
            turn, ends = way._held(eyes, aimed.line_mm, aimed.world_from_face), way.line(aimed.world_from_face)[:2]
            poses = np.stack([rigid.transform(turn, end - turn @ aimed.line_mm[1]) for end in ends])
            if not in_views(poses, target, aimed.cameras, MARGIN, MOST_DEG).all():
                continue
            seen.append(way)
            if not any(covers(own, target, pose, other, aimed.cameras) for own in poses for pose, other in others):
                return way
        return (seen or ways)[0]

    def _held(self, eyes: Array, line_mm: Array, world_from_face: Array) -> Array:
        """Rotation : (3, 3) of the target in the world, its shaft along the line."""
        _, aim, along = self.line(world_from_face)
        roll = Rotation.from_rotvec(np.deg2rad(self.roll_deg or 0.0) * along).as_matrix()
        return roll @ _axes(along, eyes - aim) @ _axes(line_mm[1] - line_mm[0], np.array([0.0, 0.0, 1.0])).T

    def line(self, world_from_face: Array) -> tuple[Array, Array, Array]:
        """Entry and aim of the tip : (3,) mm, and direction : (3,) from one to the other, in the world, of an array at a pose.

        Raises
        ------
        InputError
            If entry and aim are given, and are one.
        """
        into = rigid.invert(world_from_face)
        angle = np.deg2rad(ANGLES_DEG[0] if self.angle_deg is None else self.angle_deg)
        heading = np.deg2rad(HEADINGS_DEG[0] if self.heading_deg is None else self.heading_deg)
        along = np.array([np.cos(heading) * np.cos(angle), np.sin(angle), np.sin(heading) * np.cos(angle)])
        aim = np.array([0.0, self.depth_mm, 0.0]) if self.aim_mm is None else rigid.apply(into, self.aim_mm)
        entry = aim - self.travel_mm * along
        if self.entry_mm is not None:
            entry = rigid.apply(into, self.entry_mm)
            if (length := float(np.linalg.norm(aim - entry))) < 1e-3:
                raise InputError(f"path.entry_mm: expected one apart from the aim, found {list(self.entry_mm)}")
            along = (aim - entry) / length
        shift = [0.0, 0.0, 0.0 if self.beside_mm is None else self.beside_mm - aim[2]]
        first, last = rigid.apply(world_from_face, np.stack([entry, aim]) + shift)
        return first, last, rigid.rotate(world_from_face, along)

    def _share(self, times: Array) -> Array:
        """Of the way to the aim, at times : (n,) s of a round: sets off and arrives gently, there and back."""
        way_s = (self.seconds - self.rest_s) / 2
        share = np.clip((self.seconds / 2 - np.abs(times - self.seconds / 2)) / way_s, 0, 1)
        return share * share * (3 - 2 * share)

    @property
    def room_mm(self) -> Array:
        """Of the places that are given in the world."""
        given = [place for place in (self.entry_mm, self.aim_mm) if place is not None]
        return np.max(given, axis=0) if given else np.zeros(3)


def _axes(along: Array, towards: Array) -> Array:
    """Rotation : (3, 3) whose x axis is along one direction, and whose z axis leans towards another as far as it can."""
    x = along / np.linalg.norm(along)
    z = towards - (towards @ x) * x
    if np.linalg.norm(z) < 1e-6 * np.linalg.norm(towards):  # it points at the other: any turn is as good
        z = np.linalg.svd(x[None])[2][1]
    z = z / np.linalg.norm(z)
    return np.column_stack([x, np.cross(z, x), z])


def _wandering(rng: np.random.Generator, sigma: float, seconds: float) -> CubicSpline:
    """A closed, smooth course : (3,) of a standard deviation at even times."""
    places = sigma * rng.standard_normal((PLACES, 3))
    return CubicSpline(np.linspace(0, seconds, PLACES + 1), np.vstack([places, places[:1]]), bc_type="periodic")
