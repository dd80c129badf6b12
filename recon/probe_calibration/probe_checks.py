"""Sanity checks of a probe's calibration: its poses, pixels, motion and outcome; each fault is named."""

from collections.abc import Iterator, Mapping
from itertools import permutations, product
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from recon import arguments
from recon.errors import InputError
from recon.estimation.covariance import root
from recon.geometry import rigid
from recon.model.probe import SPEEDS, ProbeCalibration, place_slopes

Array = NDArray[np.float64]
Size = tuple[int, int]  # width, height, px

MIN_TURN_DEG = 2.0  # rms, about the second axis
MIN_SPREAD = 0.02  # rms, of the crossing in the image, as a fraction of the width or height
MAX_SIGMA_MM = 1.0  # predicted, of any pixel's place in any direction
WATER = (1400.0, 1600.0)  # m/s; pure makes 1402 to 1555, at 0 to 75 deg C, salt and glycerol up to 60 more
SCALES = (0.005, 2.0)  # mm/px, of any scanner
FAR_DEG, FAR_MM = 45.0, 60.0  # from the design of the bracket; beyond, it is another bracket
ALIKE_DEG, ALIKE_MM = 30.0, 30.0  # from the design but for axes or units: another bracket is hardly so by chance
DEPTHS = (10.0, 400.0)  # mm, of ordinary images
UNITS = {"cm": 10.0, "inches": 25.4}  # mm; metres and micrometres leave SCALES
POSE_UNITS = {"m": 1e3, **UNITS}  # mm
_IN_UNIT = "the poses are in {}"
AXES = ("c0-c1", "c0-c2", "normal")  # of the target


How = Literal["contradict", "agree", "moved"]


class Misread(InputError):
    """Frames that another reading of their poses may explain."""

    def __init__(self, fault: str, how: How = "contradict", likely: str = "") -> None:
        """`how`: they contradict each other, agree by an impossible probe, or by a movement; `likely`: the reading, in words."""
        super().__init__(fault + likely)
        self.fault, self.how = fault, how


class _Frames(Protocol):
    @property
    def poses(self) -> Array: ...
    @property
    def pixels(self) -> Array: ...


class _Sightings(_Frames, Protocol):
    @property
    def pose_covariance(self) -> Array | None: ...
    @property
    def pixel_covariance(self) -> Array | None: ...
    @property
    def slice_mm(self) -> Array | None: ...
    @property
    def directions(self) -> Array | None: ...
    @property
    def pose_by_lag(self) -> Array | None: ...


def arrays(sightings: _Sightings) -> dict[str, Array]:
    """The fields that are given, as float arrays; refuses all that are no numbers of n frames, and covariances that are none."""
    count = len(arguments.numbers("sightings: poses", sightings.poses, ("n", 4, 4), finite=False))
    needed, unseen = {"poses": (4, 4), "pixels": (2,)}, {"directions": (2, 2)}  # poses and pixels have checks of their own
    covariances = {"pose_covariance": (6, 6), "pixel_covariance": (2, 2)}
    others = {"slice_mm": (), "pose_by_lag": (4, 4), "pose_rates": (4, 4)}
    found = {}
    for name, shape in (needed | unseen | covariances | others).items():
        value = getattr(sightings, name)
        if name in needed or value is not None:
            finite = name not in needed and name not in unseen
            found[name] = np.asarray(arguments.numbers(f"sightings: {name}", value, (count, *shape), finite), float)
    for name in covariances.keys() & found.keys():
        sigmas = np.sqrt(np.maximum(np.diagonal(found[name], axis1=1, axis2=2), np.finfo(float).tiny))
        least = np.linalg.eigvalsh(found[name] / (sigmas[:, :, None] * sigmas[:, None])).min(axis=1)
        if (least < -1e-6).any():
            k = int(least.argmin())
            raise InputError(f"sightings: {name}: frame {k}: expected a covariance, found a negative variance")
    return found


def poses(world_from_target: Array) -> None:
    """Refuse poses that are no rigid transforms of a right-handed frame."""
    for k, pose in enumerate(world_from_target):
        if found := rigid.fault(pose):
            raise InputError(f"poses: frame {k}: expected {rigid.RIGID}, found {found}")


def pixels(of_crossing: Array, size: Size) -> None:
    """Refuse pixels outside the image: of another scanner, with u and v swapped, or from another origin."""
    limit = np.array(size, float) - 0.5
    outside = ~((of_crossing >= -0.5) & (of_crossing <= limit)).all(axis=1)
    if not outside.any():
        return
    k = int(np.argmax(outside))
    found = f"({of_crossing[k, 0]:g}, {of_crossing[k, 1]:g})"
    expected = f"pixels: frame {k}: expected (u, v) in an image of {size[0]}x{size[1]} px, found {found}"
    if (of_crossing < -0.5).any():
        raise InputError(f"{expected}: are u and v from the centre of the top left pixel, right and down?")
    swapped = ((of_crossing[:, ::-1] >= -0.5) & (of_crossing[:, ::-1] <= limit)).all()
    hint = "are u and v swapped, or is it another scanner" if swapped else "another scanner"
    raise InputError(f"{expected}: {hint}? give rig.probe.image_size=[width,height], and temperature_c, the water's")


def motion(world_from_target: Array, of_crossing: Array, size: Size) -> None:
    """Refuse a motion that leaves unknowns undetermined at any noise, and name the missing rotation, depth or width."""
    axes, rms = turns(world_from_target)
    if rms[0] < MIN_TURN_DEG:
        raise InputError(f"motion: expected turns of the probe about two axes, found none: at most {rms[0]:.1f} deg (rms)")
    if rms[1] < MIN_TURN_DEG:
        raise InputError(f"motion: expected turns of the probe about two axes, found {_one_axis(axes, rms)}")
    places(of_crossing, size)


def places(of_crossing: Array, size: Size) -> None:
    """Refuse places in the image that leave a scale or the image's attitude undetermined, and name the missing depth or width."""
    spread = of_crossing.std(axis=0) / size
    lengths = {"depth": spread[1], "lateral position": spread[0]}
    for name, value in lengths.items():
        if value < MIN_SPREAD:
            found = f"one {name} only: {100 * value:.1f} % of the image (rms)"
            raise InputError(f"motion: expected the crossing at various places of the image, found {found}")
    across = np.linalg.svd((of_crossing - of_crossing.mean(axis=0)) / size, compute_uv=False)[1] / np.sqrt(len(of_crossing))
    if across < MIN_SPREAD:
        found = f"all on one line, where depth goes with lateral position: {100 * across:.1f} % of the image across it (rms)"
        raise InputError(f"motion: expected the crossing at various places of the image, found {found}")


def turns(world_from_target: Array) -> tuple[Array, Array]:
    """Axes about which a probe was turned : (3, 3), rows, in the target's frame, strongest first, and rms angles : (3,) deg."""
    rotations = Rotation.from_matrix(world_from_target[:, :3, :3])
    vectors = (rotations.mean().inv() * rotations).as_rotvec(degrees=True)
    _, lengths, axes = np.linalg.svd(vectors - vectors.mean(axis=0), full_matrices=True)
    return axes, np.pad(lengths, (0, 3 - len(lengths))) / np.sqrt(len(vectors))


def certainty(
    target_from_image: Array,
    scale: Array,
    covariance: Array,
    frames: _Frames,
    size: Size,
    most_mm: float = MAX_SIGMA_MM,
    motions: Mapping[str, float] | None = None,
) -> None:
    """Refuse a motion that leaves some pixel's place uncertain by more than some mm, and name its weakest part.

    Parameters
    ----------
    covariance : (8, 8)
        Of sx, sy, turn and shift.
    most_mm : float
        Standard deviation in any direction.
    motions : description -> size
        Parts of the motion that may be missing, each over the size that would do; None takes those that a point needs.
    """
    right, bottom = size[0] - 1, size[1] - 1
    slopes = place_slopes(target_from_image, scale, [(0, 0), (right, 0), (0, bottom), (right, bottom)])
    left, lengths, _ = np.linalg.svd(slopes @ root(covariance))
    corner = int(lengths[:, 0].argmax())
    worst, open_ = float(lengths[corner, 0]), left[corner, :, 0]
    if worst <= most_mm:
        return
    weak = motions or _motions(frames, size)
    named = min(weak, key=lambda name: weak[name])
    found = f"{worst:.2g} mm along {_axis(open_)}: {named}" if weak[named] < 1 else f"{worst:.2g} mm: too few or too noisy frames"
    expected = f"pixels to be placed to {most_mm:g} mm (1 sigma)"
    raise InputError(f"motion: expected {expected}, found {found}; allow more by max_sigma_mm=")


def _motions(frames: _Frames, size: Size) -> dict[str, float]:
    """Parts of the motion that a point needs, each over the size that would do."""
    axes, rms = turns(frames.poses)
    spread = frames.pixels.std(axis=0) / size
    return {
        f"turns about one axis only, {_axis(axes[0])}, others {rms[1]:.1f} deg (rms)": rms[1] / 10,
        f"nearly one depth only, {100 * spread[1]:.0f} % of the image (rms)": spread[1] / 0.1,
        f"nearly one lateral position only, {100 * spread[0]:.0f} % of the image (rms)": spread[0] / 0.1,
    }


def plausible(scale: Array) -> bool:
    """Whether scales : (2,) mm/px are a scanner's."""
    return bool(((scale >= SCALES[0]) & (scale <= SCALES[1])).all())


def outcome(calibration: ProbeCalibration, size: Size, expected: Array | None) -> None:
    """Refuse scales of other units, and a probe that is as designed but for swapped axes or other units."""
    for name, value in zip(("sx", "sy"), calibration.scale, strict=True):
        if not SCALES[0] <= value <= SCALES[1]:
            found = f"{value:.3g} with {described(calibration)}: are the poses in mm?"
            raise Misread(f"calibration: {name}: expected {SCALES[0]:g} to {SCALES[1]:g} mm/px, found {found}", how="agree")
    if expected is None or near(calibration, size, expected):
        return
    off = _off_if_confused(calibration, size, expected)
    alike = {name: angle for name, (angle, away) in off.items() if angle < ALIKE_DEG and away < ALIKE_MM}
    if alike:
        name = min(alike, key=lambda each: alike[each])
        close = f"found it there to {off[name][0]:.0f} deg and {off[name][1]:.0f} mm, but as if {name}"
        fault = f"calibration: expected target_from_image near its design, {close}"
        way = f"if it is right, give {described(calibration)}"
        for unit, length in UNITS.items():
            if name == _IN_UNIT.format(unit):
                raise InputError(f"{fault}: multiply their translations by {length:g}; {way}")
        raise Misread(f"{fault}; {way}", how="agree")


def scanner_scale(implied: float, calibration: ProbeCalibration) -> None:
    """Refuse a calibration of which no scale of the scanner implies the speed of sound, m/s, where nothing else has it."""
    if np.isnan(implied):
        expected = "expected the water's temperature, or the scanner's mm/px, as rig.probe.scale_mm_per_px is of other images"
        way = "are lengths of poses right? then give temperature_c=..., or rig.probe.scale_mm_per_px=[sx,sy] by the scanner"
        raise InputError(f"calibration: sy: {expected}, found neither: {way} ({_in_the_tank(calibration)})")


def speed(implied: float, calibration: ProbeCalibration, limits: tuple[float, float] = SPEEDS) -> None:
    """Refuse a calibration whose sy, beside the scanner's, implies a speed of sound, m/s, out of limits; NaN is unknown."""
    low, high = limits
    if implied < low or implied > high:
        raise InputError(
            f"calibration: sy: expected to imply a speed of sound of {low:g} to {high:g} m/s, found {implied:.0f}: is "
            "rig.probe.scale_mm_per_px this scanner's, are the poses in mm, is the tank of water? give that scale, or "
            f"temperature_c=..., or tank_speed=... ({_in_the_tank(calibration)})"
        )


def doubts(calibration: ProbeCalibration, size: Size, expected: Array) -> Iterator[str]:
    """Unusual traits of a calibration that can be right: another bracket than designed, a target below the face, a tiny image."""
    deep = (size[1] - 1) * calibration.scale[1]
    if not DEPTHS[0] <= deep <= DEPTHS[1]:
        yield f"the image is {deep:.3g} mm deep: are the poses in mm?"
    if near(calibration, size, expected):
        return
    angle, away = off_design(calibration, size, expected)
    yield (
        f"the probe is {angle:.0f} deg and {away:.0f} mm from its design: another bracket? Then nothing excludes swapped axes of "
        "the image, which fit as well; a pose that is right can be given as its design"
    )
    depth = rigid.invert(calibration.target_from_image)[1, 3]
    if depth > 0:
        yield (
            f"the target lies {depth:.0f} mm below the probe's face: unless the bracket holds it there, the image is upside down "
            "or u and v are swapped, and depths are converted about the wrong end"
        )


def described(calibration: ProbeCalibration) -> str:
    """The pose found, as the rig's fields."""
    turn = np.degrees(Rotation.from_matrix(calibration.target_from_image[:3, :3]).as_rotvec())
    values = {"rotation_deg": turn, "translation_mm": calibration.target_from_image[:3, 3]}
    return " ".join(
        f"rig.probe.target_from_image.{name}=[{','.join(f'{value:.1f}' for value in vector)}]" for name, vector in values.items()
    )


def _in_the_tank(calibration: ProbeCalibration) -> str:
    sx, sy = calibration.scale
    return f"found in the tank: {sx:.4g} and {sy:.4g} mm/px, {described(calibration)}"


def readings(world_from_target: Array) -> dict[str, Array]:
    """Common other meanings of 4x4 poses, each with the poses in ours."""
    inverse = np.linalg.inv(world_from_target)
    transposed = world_from_target.copy()
    transposed[:, :3, :3] = np.swapaxes(world_from_target[:, :3, :3], 1, 2)
    result = {"target_from_world, the inverse": inverse, "transposed rotations": transposed}
    turns = Rotation.from_matrix(world_from_target[:, :3, :3]).as_quat()  # x, y, z, w
    for order, name in (((1, 2, 3, 0), "that begins with w, read as one that ends with it"),
                        ((3, 0, 1, 2), "that ends with w, read as one that begins with it")):  # fmt: skip
        turned = world_from_target.copy()
        turned[:, :3, :3] = Rotation.from_quat(turns[:, order]).as_matrix()
        result[f"a quaternion {name}"] = turned
    for order, name in (((1, 0, 2), "x and y"), ((0, 2, 1), "y and z"), ((2, 1, 0), "x and z")):
        swapped = world_from_target.copy()
        swapped[:, :3, 3] = swapped[:, order, 3]
        result[f"axes {name} swapped in the translations"] = swapped
    for axis, name in enumerate("xyz"):
        mirrored = world_from_target.copy()
        mirrored[:, axis, 3] *= -1
        result[f"translations of the wrong handedness, {name} mirrored"] = mirrored
    return result


def _one_axis(axes: Array, rms: Array) -> str:
    return f"planar motion, about {_axis(axes[0])} only: {rms[0]:.1f} deg, others {rms[1]:.1f} deg (rms)"


def _axis(direction: Array) -> str:
    """A direction in the target's frame, in words where it is near an axis."""
    k = int(np.argmax(np.abs(direction)))
    direction = direction * np.sign(direction[k])
    text = f"({', '.join(f'{value:.2f}' for value in direction)})"
    return f"the target's {'xyz'[k]} ({AXES[k]})" if direction[k] > np.cos(np.radians(20)) else f"{text} in the target's frame"


def _angle(rotation: Array) -> float:
    return float(np.degrees(Rotation.from_matrix(rotation).magnitude()))


def _centre(calibration: ProbeCalibration, size: Size) -> Array:
    """Place : (3,) mm of the image's centre in the target's frame."""
    return calibration.to_target((np.array(size) - 1) / 2)


def off_design(calibration: ProbeCalibration, size: Size, expected: Array) -> tuple[float, float]:
    """Angle, deg, and distance of the image's centre, mm, from the design : (4, 4), with the scales as found."""
    away = _centre(calibration, size) - _centre(ProbeCalibration(expected, calibration.scale), size)
    return _angle(expected[:3, :3].T @ calibration.target_from_image[:3, :3]), float(np.linalg.norm(away))


def near(calibration: ProbeCalibration, size: Size, expected: Array) -> bool:
    """Whether a probe is as designed, but for what brackets differ by."""
    angle, away = off_design(calibration, size, expected)
    return angle < FAR_DEG and away < FAR_MM


def _off_if_confused(calibration: ProbeCalibration, size: Size, expected: Array) -> dict[str, tuple[float, float]]:
    """Angle, deg, and distance, mm, from the design, by what may be confused: the image's axes, the target's, units."""
    turn, (_, away) = calibration.target_from_image[:3, :3], off_design(calibration, size, expected)
    off = {name: (_angle((expected[:3, :3] @ axes).T @ turn), away) for name, axes in IMAGE_AXES.items()}
    for signed in _TURNED:
        axes = ", ".join(" -"[int(row.sum() < 0)].strip() + "xyz"[int(np.argmax(np.abs(row)))] for row in signed)
        off[f"the target's axes are swapped: ({axes}) of the design"] = off_design(
            calibration, size, rigid.transform(signed, np.zeros(3)) @ expected
        )
    for unit, length in UNITS.items():
        pose = rigid.transform(turn, calibration.target_from_image[:3, 3] * length)
        off[_IN_UNIT.format(unit)] = off_design(ProbeCalibration(pose, calibration.scale * length), size, expected)
    return off


def _signed_permutations() -> list[Array]:
    """The 23 turns that take axes to axes, but for none."""
    all_ = [
        np.eye(3)[list(order)] * np.array(signs)[:, None]
        for order in permutations(range(3))
        for signs in product((1, -1), repeat=3)
    ]
    return [matrix for matrix in all_ if np.linalg.det(matrix) > 0 and np.trace(matrix) < 3]


_TURNED = _signed_permutations()
IMAGE_AXES = {  # found = expected @ this
    "the image is mirrored left to right": np.diag([-1.0, 1, -1]),
    "the image is upside down": np.diag([1.0, -1, -1]),
    "the image is upside down and mirrored": np.diag([-1.0, -1, 1]),
    "u and v are swapped": np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]]),
    "the image is turned by 90 degrees": np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]),
    "the image is turned by -90 degrees": np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]]),
}
