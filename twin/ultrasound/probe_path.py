"""Paths of a hand-led probe: along a surface in contact with it, tilted, trembling; at rest on one; up and down over a tank's
bottom; or from rest to rest about wires, or over a wall or a sphere.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy.interpolate import PchipInterpolator
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from recon.errors import InputError
from recon.geometry import rigid
from recon.model.rig import Finite, NotNegative, Part, Positive
from recon.model.tracks import Track
from recon.probe_calibration import point_calibration
from twin import tremor
from twin.tremor import Tremor
from twin.ultrasound.echo_solids import Body, Solid
from twin.ultrasound.transducer import Transducer

Array = NDArray[np.float64]

RATE_HZ = 100.0  # of the poses that make up a path
SEARCH_MM = 0.1  # steps in which a surface is looked for
MOST_S = 3600.0  # of a path
Rest = Annotated[float, Field(ge=0, le=60)]  # s
CALM = tremor.draw(0.0, 0.0, 0)  # a hand without tremor


@dataclass(frozen=True)
class Foot:
    """The probe's foot, rounded across the array and beyond its ends; assumed.

    A path brings its middle into contact with the surface at rest, over the array alone, flat to half a millimetre. Into tissue
    that yields, all of it is pressed.
    """

    across_mm: float = 14.0  # of all of it, across the array
    lens_radius_mm: float = 15.0  # of the rounding across
    flat_mm: float = 8.0  # of its middle, across the array
    ends_mm: float = 4.0  # beyond the array at each end
    end_radius_mm: float = 6.0  # of the rounding there


FOOT = Foot()


class Hand(Part):
    """Unsteadiness of the hand: Gaussian processes of a correlation time, in each of three axes."""

    shift_mm: NotNegative = 0.15  # standard deviation
    turn_deg: NotNegative = 0.6
    correlation_s: Annotated[float, Field(gt=0.01, le=60)] = 0.15  # of the Gaussian that smooths them: drift below 3 Hz


class SurfacePath(Part):
    """Straight strokes over a surface that faces the cameras, seen along the world's z, there and back, side by side."""

    kind: Literal["stroke"] = "stroke"
    surface: str = ""  # name of the solid, where a scene has several
    start_mm: tuple[Finite, Finite] = (4.0, -35.0)  # x, y in the world of the array's middle
    end_mm: tuple[Finite, Finite] = (4.0, 30.0)  # of the first stroke
    strokes: Annotated[int, Field(ge=1, le=100)] = 1
    stroke_step_mm: Finite = 30.0  # from one to the next, along the array
    step_seconds: Annotated[float, Field(ge=0.05, le=60)] = 0.3  # in which the probe slides over to the next
    speed_mm_s: Positive = 10.0
    turn_deg: Finite = 0.0  # of the array about the line of sight, from the world's x
    tilt_deg: tuple[Finite, Finite] = (0.0, 0.0)  # off the surface's normal: in the image plane, and of the plane
    standoff_mm: Finite = 0.0  # between the foot and the nearest point of the surface; negative presses into it
    hand: Hand = Hand()


class Hold(Part):
    """At rest over a surface that faces the cameras, as a probe is held while a needle is led."""

    kind: Literal["hold"] = "hold"
    surface: str = ""  # name of the solid, where a scene has several
    place_mm: tuple[Finite, Finite] = (4.0, -2.0)  # x, y in the world of the array's middle
    seconds: Annotated[float, Field(gt=0, le=MOST_S)] = 10.0
    turn_deg: Finite = 0.0  # of the array about the line of sight, from the world's x
    tilt_deg: tuple[Finite, Finite] = (0.0, 0.0)  # off the surface's normal: in the image plane, and of the plane
    standoff_mm: Finite = 0.0  # between the foot and the nearest point of the surface; negative presses into it
    hand: Hand = Hand()


class Bob(Part):
    """Up and down at an uneven pace, as the lag between scanner and cameras is measured."""

    kind: Literal["bob"] = "bob"
    middle_mm: tuple[Finite, Finite, Finite] = (4.0, -2.0, 672.0)  # of the array's face, in the world
    turn_deg: Finite = 0.0
    height_mm: Positive = 8.0  # amplitude
    seconds: Annotated[float, Field(gt=0, le=MOST_S)] = 12.0
    hand: Hand = Hand()


class WirePath(Part):
    """At rest in poses about two crossed wires, as the probe is calibrated, or moving from pose to pose; turned as in
    `recon.probe_calibration.point_calibration.motion`.
    """

    kind: Literal["wire"] = "wire"
    count: Annotated[int, Field(ge=1, le=1000)] = 30  # poses, one image each
    first: Annotated[int, Field(ge=0, le=10_000)] = 0  # number of poses of the same motion that are left out before
    tilt_deg: Annotated[float, Field(ge=0, le=80)] = 35.0  # to all sides
    roll_deg: Annotated[float, Field(ge=0, le=180)] = 180.0  # about the depth axis, both ways
    miss_mm: NotNegative = 0.2  # standard deviation of the crossing across the image plane: a hand holds it where it shines most
    rest_s: Rest = 0.5  # in each pose, an image in the middle; 0 keeps moving, images at the scanner's rate
    move_s: Annotated[float, Field(ge=0.3, le=60)] = 1.0  # from one pose to the next


class RowPath(Part):
    """At rest in poses over N-wires, as the probe is calibrated by them, or moving from pose to pose: turned to all sides as far
    as all wires stay in view.
    """

    kind: Literal["rows"] = "rows"
    count: Annotated[int, Field(ge=1, le=1000)] = 40  # poses, one image each
    tilt_deg: Annotated[float, Field(ge=0, le=60)] = 20.0  # about the array, to both sides
    roll_deg: Annotated[float, Field(ge=0, le=60)] = 20.0  # about the depth axis, both ways
    rock_deg: Annotated[float, Field(ge=0, le=60)] = 8.0  # in the image's plane
    along_mm: NotNegative = 10.0  # both ways along the wires, from their middle
    rest_s: Rest = 0.5  # in each pose, an image in the middle; 0 keeps moving, images at the scanner's rate
    move_s: Annotated[float, Field(ge=0.3, le=60)] = 1.0  # from one pose to the next


class TiltPath(Part):
    """At rest in poses over a wall or a sphere, as the probe is calibrated by them: tilted to all sides, at various distances."""

    kind: Literal["tilts"] = "tilts"
    count: Annotated[int, Field(ge=1, le=1000)] = 100  # poses, one image each
    tilt_deg: Annotated[float, Field(ge=0, le=60)] = 40.0  # about the array, to both sides
    rock_deg: Annotated[float, Field(ge=0, le=60)] = 25.0  # in the image's plane
    roll_deg: Annotated[float, Field(ge=0, le=180)] = 90.0  # about the depth axis, both ways
    depth_mm: tuple[Positive, Positive] = (13.0, 38.0)  # of the surface before the array's middle, least and most
    aside_mm: NotNegative = 8.0  # of a sphere's middle along the array, or along a wall, both ways
    miss_mm: NotNegative = 8.0  # likewise across the image plane, or the other way along a wall
    rest_s: Rest = 0.5  # in each pose, an image in the middle; 0 keeps moving, images at the scanner's rate
    move_s: Annotated[float, Field(ge=0.3, le=60)] = 1.0  # from one pose to the next


def along_surface(path: SurfacePath, solid: Solid, transducer: Transducer, seed: int, shaken: Tremor = CALM) -> Track:
    """Poses `world_from_image` over time, from 0 ns, of one or more strokes over a solid, by a hand that trembles.

    The face touches the surface where it first meets it, square to the plane fitted to the surface under the foot.

    Raises
    ------
    InputError
        If the foot leaves the solid, or the stroke has no length.
    """
    start, end = np.array(path.start_mm), np.array(path.end_mm)
    duration = float(np.linalg.norm(end - start)) / path.speed_mm_s
    if path.strokes * duration > MOST_S:
        found = f"{path.strokes * duration:.3g} s at {path.speed_mm_s:g} mm/s"
        raise InputError(f"path.speed_mm_s: expected strokes of up to {MOST_S:g} s in all, found {found}")
    if duration < 2 / RATE_HZ:
        raise InputError(f"path.end_mm: expected a stroke of some length, found {np.linalg.norm(end - start):g} mm")
    aside = path.stroke_step_mm * _upright(path.turn_deg)[:2, 0]
    places = []
    for stroke in range(path.strokes):
        one, other = (start, end) if stroke % 2 == 0 else (end, start)
        if stroke:
            places.append(_eased(one + (stroke - 1) * aside, one + stroke * aside, path.step_seconds)[1:-1])
        places.append(_eased(one + stroke * aside, other + stroke * aside, duration))
    faces = np.stack([_place(path, place, solid, transducer) for place in np.concatenate(places)])
    return _led(faces, path.hand, shaken, transducer, seed)


def resting(path: Hold, solid: Solid, transducer: Transducer, seed: int, shaken: Tremor = CALM) -> Track:
    """Poses `world_from_image` over time, from 0 ns, of a probe in contact with a solid at one place, in a hand that trembles.

    Raises
    ------
    InputError
        If the foot is beside the solid.
    """
    face = _place(path, np.array(path.place_mm), solid, transducer)
    return _led(np.tile(face, (int(path.seconds * RATE_HZ) + 1, 1, 1)), path.hand, shaken, transducer, seed)


def _eased(start: Array, end: Array, seconds: float) -> Array:
    """Places : (n, 2) from start to end, that set off and stop gently."""
    share = np.linspace(0, 1, int(seconds * RATE_HZ) + 1)
    return start + (share * share * (3 - 2 * share))[:, None] * (end - start)


def bobbing(bob: Bob, transducer: Transducer, seed: int, shaken: Tremor = CALM) -> Track:
    """Poses `world_from_image` over time, from 0 ns, of a probe that looks along the world's z, in a hand that trembles."""
    times = np.arange(int(bob.seconds * RATE_HZ) + 1) / RATE_HZ
    turned = 2 * np.pi * (0.35 * times + 0.35 * np.sin(0.9 * times))  # uneven: no two strokes last alike
    faces = np.tile(np.eye(4), (len(times), 1, 1))
    faces[:, :3, :3] = _upright(bob.turn_deg)
    faces[:, :3, 3] = bob.middle_mm
    faces[:, 2, 3] += bob.height_mm * np.sin(turned)
    return _led(faces, bob.hand, shaken, transducer, seed)


def crossing(body: Body) -> Array:
    """Where two wires cross : (3,) mm in the world, the midpoint between their axes.

    Raises
    ------
    InputError
        If there are other than two wires, or they don't touch.
    """
    expected = "path: expected a scene of two crossed wires, such as scene=crosswire, found"
    if len(body.wires) != 2:
        raise InputError(f"{expected} {len(body.wires) or 'no'} wires")
    ends = np.stack([wire.ends for wire in body.wires])
    along = ends[:, 1] - ends[:, 0]
    shares = np.linalg.lstsq(np.column_stack([along[0], -along[1]]), ends[1, 0] - ends[0, 0])[0]
    nearest = ends[:, 0] + shares[:, None] * along
    apart = float(np.linalg.norm(nearest[1] - nearest[0]))
    touching_mm = 2.0  # between the axes of two wires that cross
    if apart > touching_mm or (shares < 0).any() or (shares > 1).any():
        raise InputError(f"{expected} two that don't touch")
    return nearest.mean(axis=0)


def about_crossing(path: WirePath, body: Body, transducer: Transducer, seed: int = 0) -> tuple[Track, NDArray[np.int64]]:
    """Poses `world_from_image` over time, from 0 ns, and the middles of the rests : (count,) ns; none of a path without.

    The crossing appears at the pixels of the protocol, the delays of the medium's sound included.

    Raises
    ------
    InputError
        If the scene has no crossing.
    """
    whole = point_calibration.motion(transducer.image_size, path.first + path.count, path.tilt_deg, path.roll_deg)
    turns, pixels = (part[path.first :] for part in whole)
    beside = path.miss_mm * np.random.default_rng(seed).standard_normal(path.count)

    def pose(values: Array) -> Array:
        return held(body, transducer, values[:, :3], values[:, 3:5], values[:, 5])

    return _led_through(np.column_stack([turns, pixels, beside]), pose, path.rest_s, path.move_s)


def _led_through(values: Array, pose: Callable[[Array], Array], rest_s: float, move_s: float) -> tuple[Track, NDArray[np.int64]]:
    """Poses over time of some coordinates : (count, k), of which `pose` makes poses, with the middles of the rests : (count,) ns.

    A probe that rests is tracked at rest only, as over its moves of `move_s` no pose is interpolated. Without rests it is led
    smoothly from pose to pose, and slows down where a coordinate turns back.
    """
    if rest_s == 0:
        times = np.arange(int((len(values) - 1) * move_s * RATE_HZ) + 1) / RATE_HZ
        led = PchipInterpolator(move_s * np.arange(len(values)), values)(times) if len(values) > 1 else values
        return Track(np.rint(times * 1e9).astype(np.int64), pose(led)), np.zeros(0, np.int64)
    steps = np.rint(np.linspace(0, rest_s, int(rest_s * RATE_HZ) + 1) * 1e9).astype(np.int64)
    starts = np.rint(np.arange(len(values)) * (rest_s + move_s) * 1e9).astype(np.int64)
    rests = Track((starts[:, None] + steps).ravel(), np.repeat(pose(values), len(steps), axis=0))
    return rests, starts + steps[-1] // 2


LEVEL = np.cos(np.deg2rad(20))  # of the wires' direction, the part that is level


def over_rows(path: RowPath, body: Body, transducer: Transducer, seed: int = 0) -> tuple[Track, NDArray[np.int64]]:
    """Poses `world_from_image` over time, from 0 ns, and the middles of the rests : (count,) ns; none of a path without.

    The middle of all wires appears near the middle of the image.

    Raises
    ------
    InputError
        If the scene has no three wires.
    """
    if len(body.wires) < 3:
        raise InputError(f"path: expected a scene of N-wires, such as scene=n_wires, found {len(body.wires) or 'no'} wires")
    ends = np.stack([wire.ends for wire in body.wires])
    along = ends[0, 1] - ends[0, 0]
    along /= np.linalg.norm(along)
    rng = np.random.default_rng(seed)
    values = rng.uniform(-1, 1, (4, path.count)).T * [path.tilt_deg, path.roll_deg, path.rock_deg, path.along_mm]
    array = np.array([along[1], -along[0], 0.0])  # across wires that lie level
    if (level := float(np.linalg.norm(array))) < LEVEL:
        found = f"them {np.degrees(np.arccos(level)):.0f} deg from it: z of their definition is up"
        raise InputError(f"path: expected wires that lie level, to be crossed from above, found {found}")
    array /= level
    upright = np.column_stack([array, [0, 0, 1], np.cross(array, [0, 0, 1])])
    true_scale = np.array(transducer.scale_mm_per_px) * [1.0, body.medium.speed / transducer.assumed_speed]
    middle = np.append((np.array(transducer.image_size) - 1) / 2 * true_scale, 0.0)

    def pose(values: Array) -> Array:
        tilt, roll, rock, shift = values.T
        rotations = upright @ Rotation.from_euler("YXZ", np.column_stack([roll, tilt, rock]), degrees=True).as_matrix()
        places = ends.mean(axis=(0, 1)) + shift[:, None] * along
        return np.stack([rigid.transform(turn, place - turn @ middle) for turn, place in zip(rotations, places, strict=True)])

    return _led_through(values, pose, path.rest_s, path.move_s)


def over_surface(path: TiltPath, body: Body, transducer: Transducer, seed: int = 0) -> tuple[Track, NDArray[np.int64]]:
    """Poses `world_from_image` over time, from 0 ns, and the middles of the rests : (count,) ns; none of a path without.

    A wall lies a depth before the array's middle, near the middle of its upper face; a sphere likewise, but for places aside.

    Raises
    ------
    InputError
        If the scene has neither a sphere nor a flat wall.
    """
    middle, radius = _surface(body)
    rng = np.random.default_rng(seed)
    most = [path.tilt_deg, path.rock_deg, path.roll_deg, path.aside_mm, path.miss_mm]
    values = np.column_stack([rng.uniform(-1, 1, (5, path.count)).T * most, rng.uniform(*sorted(path.depth_mm), path.count)])

    def pose(values: Array) -> Array:
        tilt, rock, roll, aside, miss, depth = values.T
        rotations = _upright(0.0) @ Rotation.from_euler("YXZ", np.column_stack([roll, tilt, rock]), degrees=True).as_matrix()
        none = np.zeros(len(values))
        places = np.append(transducer.face_mm, 0.0) + np.column_stack([none, depth + radius, none])
        aims = np.tile(middle, (len(values), 1))
        if radius:
            places += np.column_stack([aside, none, miss])
        else:
            aims += np.column_stack([aside, miss, none])
        turned = np.einsum("nij,nj->ni", rotations, places)
        return np.stack([rigid.transform(turn, place) for turn, place in zip(rotations, aims - turned, strict=True)])

    return _led_through(values, pose, path.rest_s, path.move_s)


def _surface(body: Body) -> tuple[Array, float]:
    """A sphere's centre : (3,) mm and its radius, or the middle of a wall's upper face and 0."""
    named = {solid.name: solid for solid in body.solids}
    if "sphere" in named:
        ball = named["sphere"].mesh
        return ball.bounds.mean(axis=0), float(ball.extents[2]) / 2
    wall = next((named[name] for name in ("plate", "tank") if name in named), None)
    if wall is None or body.wires:
        found = ", ".join([*named, *(wire.name for wire in body.wires)]) or "nothing"
        raise InputError(f"path: expected a scene of a wall or a sphere, such as scene=plane or scene=sphere, found {found}")
    middle = wall.mesh.bounds[:, :2].mean(axis=0)
    return np.append(middle, top(wall, middle[None])), 0.0


def held(body: Body, transducer: Transducer, turns: Array, pixels: Array, beside: Array) -> Array:
    """Poses `world_from_image` : (n, 4, 4) of a probe turned by (n, 3) deg as in
    `recon.probe_calibration.point_calibration.motion`.

    The crossing appears at the pixels : (n, 2), delays included, and lies (n,) mm beside the image plane.
    """
    wire = crossing(body)
    rotations = _upright(0.0) @ Rotation.from_euler("YXZ", turns[:, [1, 0, 2]], degrees=True).as_matrix()
    true_scale = np.array(transducer.scale_mm_per_px) * [1.0, body.medium.speed / transducer.assumed_speed]
    places = np.column_stack([pixels * true_scale, beside])
    return np.stack([rigid.transform(turn, wire - turn @ place) for turn, place in zip(rotations, places, strict=True)])


def _upright(turn_deg: float) -> Array:
    """Axes of an image that looks along z : x along the array, y into the depth."""
    array = Rotation.from_euler("z", turn_deg, degrees=True).apply([1.0, 0.0, 0.0])
    depth = np.array([0.0, 0.0, 1.0])
    return np.column_stack([array, depth, np.cross(array, depth)])


def _place(path: SurfacePath | Hold, place: Array, solid: Solid, transducer: Transducer) -> Array:
    """Pose of the face's middle : (4, 4), in contact at a place (x, y)."""
    axes = _upright(path.turn_deg)
    foot_points = (21, 5)  # of the foot, along and across the array
    along, across = np.meshgrid(
        np.linspace(-0.5, 0.5, foot_points[0]) * transducer.foot_mm, np.linspace(-0.5, 0.5, foot_points[1]) * FOOT.flat_mm
    )
    foot = place + np.outer(along.ravel(), axes[:2, 0]) + np.outer(across.ravel(), axes[:2, 2])
    height = top(solid, foot)
    seen = np.isfinite(height)
    if not np.isfinite(top(solid, place[None])[0]) or seen.sum() < 10:
        raise InputError(
            f"path: expected the probe over {solid.name}, found it beside at x, y = {place[0]:.1f}, {place[1]:.1f} mm"
        )
    design = np.column_stack([foot[seen] - place, np.ones(seen.sum())])
    slope_x, slope_y, level = np.linalg.lstsq(design, height[seen], rcond=None)[0]
    depth = np.array([-slope_x, -slope_y, 1.0]) / np.sqrt(slope_x**2 + slope_y**2 + 1)
    array = axes[:, 0] - depth * (axes[:, 0] @ depth)
    array /= np.linalg.norm(array)
    turn = np.column_stack([array, depth, np.cross(array, depth)])
    turn = turn @ Rotation.from_euler("zx", [path.tilt_deg[0], path.tilt_deg[1]], degrees=True).as_matrix()
    surface = np.column_stack([foot[seen], height[seen]])
    middle = np.array([*place, level])
    under = (np.abs((surface - middle) @ turn[:, [0, 2]]) <= [transducer.foot_mm / 2, FOOT.flat_mm / 2]).all(axis=1)
    gap = ((surface - middle) @ turn[:, 1])[under].min()
    return rigid.transform(turn, middle + (gap - path.standoff_mm) * turn[:, 1])


def top(solid: Solid, places: Array) -> Array:
    """Z of a solid's side that faces the cameras, at x, y : (n, 2) mm; NaN beside it.

    A distance falls by no more than the way, so that lines are searched finely only from where the solid is near.
    """
    low, high = solid.mesh.bounds[:, 2]
    depths = np.arange(low - 1, high, SEARCH_MM)
    coarse, near_mm, window = 10, 2.0, 60  # steps from one look to the next, at which it may be near, and that are searched then
    looks = _along(solid, places, np.broadcast_to(depths[::coarse], (len(places), len(depths[::coarse]))))
    begin = coarse * np.maximum((looks < near_mm).argmax(axis=1) - 1, 0)
    result = _first_below(solid, places, depths[np.minimum(begin[:, None] + np.arange(window), len(depths) - 1)])
    missed = np.isnan(result) & (looks < near_mm).any(axis=1)
    result[missed] = _first_below(solid, places[missed], np.broadcast_to(depths, (missed.sum(), len(depths))))
    return result


def _along(solid: Solid, places: Array, depths: Array) -> Array:
    """Signed distances : (n, m) to a solid at places : (n, 2) and depths : (n, m)."""
    points = np.concatenate([np.repeat(places, depths.shape[1], axis=0), depths.reshape(-1, 1)], axis=1)
    return solid.distances(points).reshape(depths.shape)


def _first_below(solid: Solid, places: Array, depths: Array) -> Array:
    """Z : (n,) at which a line at x, y enters a solid, between the depths : (n, m); NaN where it doesn't."""
    distance, rows = _along(solid, places, depths), np.arange(len(places))
    first = (distance < 0).argmax(axis=1)
    last = np.maximum(first - 1, 0)
    before, after = distance[rows, last], distance[rows, first]
    share = before / np.where(before == after, 1, before - after)
    return np.where(first > 0, depths[rows, last] + share * SEARCH_MM, np.nan)


def _led(faces: Array, hand: Hand, shaken: Tremor, transducer: Transducer, seed: int) -> Track:
    """Poses of the image from those of the face's middle, with the hand's unsteadiness and tremor about it."""
    rng = np.random.default_rng(seed)
    wander = rng.standard_normal((2, len(faces), 3))
    smooth = hand.correlation_s * RATE_HZ
    wander = gaussian_filter1d(wander, smooth, axis=1, mode="wrap") * np.sqrt(2 * np.sqrt(np.pi) * smooth)  # of unit variance
    corner = rigid.transform(np.eye(3), (-transducer.face_mm[0], -transducer.face_mm[1], 0))
    moves = []
    for k, (turn, shift) in enumerate(zip(*wander, strict=True)):
        fast = shaken.at(k / RATE_HZ)
        moves.append(
            rigid.from_rotation_vector(fast[:3], fast[3:])
            @ rigid.from_rotation_vector(np.deg2rad(hand.turn_deg) * turn, hand.shift_mm * shift)
            @ corner
        )
    times = np.rint(np.arange(len(faces)) * 1e9 / RATE_HZ).astype(np.int64)
    return Track(times, faces @ np.stack(moves))
