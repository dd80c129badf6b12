"""One tracking sample's parameters: cameras, pose and motion, lights, materials, exposure; from (seed, k) alone."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from recon.geometry import rigid
from recon.geometry.camera import Camera
from recon.model import circle_layout
from recon.model.rig import PROBE, CameraDevice, Lens, Rig, Sensor, Target
from recon.tracking.circle_detector import FRAME
from scenes.handheld.mesh_parts import SLOTS
from twin.tracking.sampling_ranges import CameraRanges, DataRanges, LightRanges, PoseRanges, TargetRanges

Array = NDArray[np.float64]

LAMPS = 4  # slots for lamps; unused ones are dark
SCRATCHES, SPOTS = 3, 4  # flaws of a target
MARGIN_PX = 45.0  # about the image, within which a target's middle mostly lies
OUTSIDE_SHARE = 0.08  # of targets drawn without regard to the images' borders
TRIES = 40  # for a pose that both cameras see

# diffuse reflectance, relative texture, its size in mm, gloss and roughness of each kind of surface: (least, most) each
SURFACES = {
    "target": ((0.8, 0.8), (0.0, 0.0), (5, 5), (0.0, 0.5), (0.15, 0.6)),
    "board": ((0.05, 0.85), (0.0, 0.1), (2, 20), (0.0, 0.6), (0.1, 0.6)),
    "probe": ((0.35, 0.9), (0.0, 0.08), (3, 40), (0.1, 1.0), (0.1, 0.5)),
    "bracket": ((0.03, 0.8), (0.0, 0.15), (2, 20), (0.1, 2.0), (0.1, 0.5)),
    "skin": ((0.12, 0.6), (0.05, 0.25), (2, 12), (0.0, 0.5), (0.3, 0.6)),
    "sleeve": ((0.02, 0.85), (0.0, 0.4), (1, 15), (0.0, 0.2), (0.3, 0.8)),
    "cable": ((0.03, 0.8), (0.0, 0.1), (2, 20), (0.0, 0.8), (0.2, 0.6)),
    "marking": ((0.02, 0.95), (0.0, 0.5), (1, 6), (0.0, 0.5), (0.2, 0.6)),
    "table": ((0.02, 0.5), (0.05, 0.7), (2, 40), (0.0, 0.8), (0.15, 0.7)),
    "bench": ((0.05, 0.7), (0.0, 0.5), (2, 80), (0.0, 0.5), (0.2, 0.8)),
    "phantom": ((0.2, 0.8), (0.0, 0.2), (3, 40), (0.0, 0.8), (0.1, 0.5)),
    "thing_a": ((0.03, 0.9), (0.0, 0.6), (1, 30), (0.0, 1.5), (0.05, 0.6)),
    "thing_b": ((0.03, 0.9), (0.0, 0.6), (1, 30), (0.0, 1.5), (0.05, 0.6)),
    "thing_c": ((0.03, 0.9), (0.0, 0.6), (1, 30), (0.0, 1.5), (0.05, 0.6)),
    "poster": ((0.5, 0.95), (0.0, 0.1), (2, 30), (0.0, 0.4), (0.2, 0.6)),
    "metal": ((0.05, 0.5), (0.0, 0.3), (1, 20), (0.5, 6.0), (0.08, 0.4)),
}
GRAINED = 0.5  # share of textures that are drawn out in one direction, as wood and brushed metal are


@dataclass(frozen=True)
class Motion:
    """Where the target is in the middle of the exposure, and how it moves over it, evenly."""

    world_from_target: Array  # (4, 4) mm
    shift_mm: Array  # (3,) over the exposure, of the target's origin, in the world
    turn_rad: Array  # (3,) rotation vector over the exposure, about the origin, in the world

    def later(self, share: float) -> "Motion":
        """The same over an exposure that is later by a share of itself."""
        return Motion(self.at(share), self.shift_mm, self.turn_rad) if share else self

    def carried(self, moved: Array) -> "Motion":
        """The same where all has moved by a rigid transform : (4, 4) mm of the world."""
        turn = moved[:3, :3]
        return Motion(moved @ self.world_from_target, turn @ self.shift_mm, turn @ self.turn_rad)

    def at(self, time: float) -> Array:
        """`world_from_target` at a time from -1/2 to 1/2 of the exposure."""
        return rigid.moved(self.world_from_target, time * np.concatenate([self.turn_rad, self.shift_mm]))


@dataclass(frozen=True)
class Lighting:
    """Lamps, light from all around, and the projector; radiant intensities relative to each other."""

    lamps: Array  # (LAMPS, 5): place in the world mm, radius mm, radiant intensity mm^2
    ambient: float  # radiance
    gradient: Array  # (3,) by which it varies with direction
    projector: Array  # (5,) intensity mm^2, mean, modulation, period px, 0 for columns and 1 for rows


@dataclass(frozen=True)
class Print:
    """The face of the target: its reflectances and its blemishes."""

    ink: float
    paper: float
    unevenness: float  # relative, of the ink and the paper
    softness_mm: float  # of the print's edge
    scratches: Array  # (SCRATCHES, 6): ends x, y, x, y mm, half width mm, reflectance
    spots: Array  # (SPOTS, 4): x, y, radius mm, reflectance


@dataclass(frozen=True)
class Held:
    """A body that carries a target: how it moves, which variant it is, and its print."""

    motion: Motion
    body: int  # number of the variant in the bank
    face: Print
    present: bool = True
    line: Array | None = None  # (n, 3) mm in the target's frame: a thin part, a needle's shaft, of which films render each pixel


@dataclass(frozen=True)
class Take:
    """All that makes one sample: the probe, further bodies if there are any, what surrounds them, light and exposure."""

    k: int
    cameras: tuple[CameraDevice, CameraDevice]
    present: bool
    motion: Motion
    body: int  # number of the held body's variant
    surroundings: int
    scene_from_world: Array  # (4, 4) mm
    lighting: Lighting
    surfaces: Array  # (len(SLOTS), 6): reflectance, texture, size mm, stretch, gloss, roughness
    texture_shift: Array  # (3,) mm, by which textures differ from sample to sample
    face: Print
    white_dn: float  # that the exposure aims at
    gain: float
    noise_seed: int
    late: tuple[float, float] = (0.0, 0.0)  # of each camera's exposure, in exposures
    others: Mapping[str, Held] = field(default_factory=dict)  # bodies besides the probe, by their names in `Rig.bodies`

    @property
    def held(self) -> dict[str, Held]:
        """All bodies by name, the probe first."""
        return {PROBE: Held(self.motion, self.body, self.face, self.present), **self.others}


def draw(ranges: DataRanges, rig: Rig, seed: int, k: int) -> Take:
    """Draw sample k of a data set: its probe, and what surrounds it; `body_samples` adds further bodies."""
    rng = np.random.default_rng([seed, k])
    cameras = _cameras(ranges.cameras, ranges.light, rig, rng)
    present = rng.random() >= ranges.pose.empty_share
    pose = _pose(ranges.pose, rig, cameras, rng)
    motion = draw_motion(ranges.pose, pose, cameras[0].optics.camera(), rng)
    return Take(
        k=k,
        cameras=cameras,
        present=present,
        motion=motion,
        body=int(rng.integers(ranges.variants)),
        surroundings=int(rng.integers(ranges.variants)),
        scene_from_world=scene_behind(pose[:3, 3], rng),
        lighting=_lighting(ranges.light, pose, rng),
        surfaces=_surfaces(rng),
        texture_shift=rng.uniform(-500, 500, 3),
        face=draw_print(ranges.target, rig.target, rng),
        white_dn=_white(ranges.light, rng),
        gain=_log_uniform(ranges.light.gain, rng),
        noise_seed=int(rng.integers(2**31)),
    )


def _log_uniform(ends: tuple[float, float], rng: np.random.Generator) -> float:
    return float(np.exp(rng.uniform(*np.log(ends))))


def _cameras(ranges: CameraRanges, light: LightRanges, rig: Rig, rng: np.random.Generator) -> tuple[CameraDevice, CameraDevice]:
    """The rig's own cameras, or a pair of others that look at one place."""
    own = rng.random() < ranges.own_share
    base, meet = rng.uniform(*ranges.baseline_mm), rng.uniform(*ranges.converge_mm)
    centre = np.array([rng.choice([-1.0, 1.0]) * base, rng.normal(0, 8), rng.normal(0, 8)])
    inward = np.arctan2(centre[0], meet)
    turn = Rotation.from_rotvec([0, -inward, 0]) * Rotation.from_rotvec(np.deg2rad(rng.normal(0, 1.0, 3)))
    cam2_from_world = rigid.invert(rigid.transform(turn.as_matrix(), centre))
    focal = rng.uniform(*ranges.focal_px) * (rig.cam1.optics.size[0] / FRAME[0])  # so that their views are as wide in any image
    lens = _lens(ranges, focal, rig.cam1.sensor.pixel_um, rng)
    dark_noise = rng.uniform(*light.dark_noise_e)
    made = []
    for device, to_world in ((rig.cam1, np.eye(4)), (rig.cam2, cam2_from_world)):
        sensor = device.sensor.model_copy(
            update={"dark_noise_e": dark_noise, "black_level_dn": rng.uniform(0, 4), "prnu": rng.uniform(0.003, 0.015)}
        )
        other = _camera(device, lens, sensor, focal * rng.uniform(0.995, 1.005), to_world, ranges, rng)
        made.append(device if own else other)
    return made[0], made[1]


def _lens(ranges: CameraRanges, focal: float, pixel_um: float, rng: np.random.Generator) -> Lens:
    return Lens(
        focal_length_mm=focal * pixel_um * 1e-3,
        f_number=_log_uniform(ranges.f_number, rng),
        focus_mm=rng.uniform(*ranges.focus_mm),
        blur_px=_log_uniform(ranges.blur_px, rng),
        vignetting=rng.uniform(0, 0.3),
    )


def _camera(
    device: CameraDevice,
    lens: Lens,
    sensor: Sensor,
    focal: float,
    to_world: Array,
    ranges: CameraRanges,
    rng: np.random.Generator,
) -> CameraDevice:
    k1 = rng.normal(0, ranges.distortion)
    distortion = (k1, -2 * k1 * rng.random(), *rng.normal(0, 5e-4, 2), 0.0)
    size = device.optics.size
    middle = (np.array(size) - 1) / 2 + rng.normal(0, ranges.centre_px, 2)
    optics = device.optics.model_copy(
        update={
            "focal_px": (focal, focal * rng.uniform(0.998, 1.004)),
            "centre_px": tuple(middle.tolist()),
            "distortion": tuple(float(value) for value in distortion),
            "device_from_world": _described(to_world, device),
        }
    )
    return device.model_copy(update={"optics": optics, "lens": lens, "sensor": sensor})


def _described(to_world: Array, device: CameraDevice):
    turn = np.rad2deg(Rotation.from_matrix(to_world[:3, :3]).as_rotvec())
    kind = type(device.optics.device_from_world)
    return kind(rotation_deg=tuple(turn.tolist()), translation_mm=tuple(to_world[:3, 3].tolist()))


def _pose(ranges: PoseRanges, rig: Rig, cameras: tuple[CameraDevice, CameraDevice], rng: np.random.Generator) -> Array:
    """A pose whose middle lies in both cameras' views, mostly; the target's face is turned towards them."""
    views = [device.optics.camera() for device in cameras]
    middle_target = circle_layout.middle(rig.target)
    anywhere = rng.random() < OUTSIDE_SHARE
    eyes = (views[0].centre + views[1].centre) / 2
    pose = np.eye(4)
    for _ in range(TRIES):
        distance = rng.uniform(*(ranges.working_mm if rng.random() < ranges.working_share else ranges.distance_mm))
        pixel = rng.uniform([0, 0], np.array(views[0].size) - 1)
        middle = views[0].rays(pixel) * distance
        pose = rigid.transform(facing(eyes - middle, ranges.tilt_deg, rng), np.zeros(3))
        pose[:3, 3] = middle - pose[:3, :3] @ middle_target
        if anywhere or all(within(view, middle) for view in views):
            break
    return pose


def within(view: Camera, point: Array) -> bool:
    """Whether a view shows a point : (3,) mm, not next to its border."""
    pixel = view.project(point)
    return bool(np.all(pixel > MARGIN_PX) and np.all(pixel < np.array(view.size) - 1 - MARGIN_PX))


def facing(towards: Array, most_deg: float, rng: np.random.Generator) -> Array:
    """A rotation whose z axis lies within an angle of a direction, evenly over the solid angle, and any turn about it."""
    z = towards / np.linalg.norm(towards)
    side = np.cross(z, [1.0, 0.0, 0.0] if abs(z[0]) < 0.9 else [0.0, 1.0, 0.0])
    side /= np.linalg.norm(side)
    frame = np.column_stack([side, np.cross(z, side), z])
    tilt = np.arccos(rng.uniform(np.cos(np.deg2rad(most_deg)), 1))
    tilted = Rotation.from_euler("ZYZ", [rng.uniform(0, 2 * np.pi), tilt, rng.uniform(0, 2 * np.pi)])
    return frame @ tilted.as_matrix()


def draw_motion(ranges: PoseRanges, pose: Array, camera: Camera, rng: np.random.Generator) -> Motion:
    """Motion of a body in a hand about a pose, as long in camera 1's image as the ranges have it."""
    still = rng.random() < ranges.still_share
    length_px = rng.uniform(0, ranges.blur_px[0]) if still else _log_uniform(ranges.blur_px, rng)
    path = length_px * pose[2, 3] / camera.matrix[0, 0]
    direction = rng.standard_normal(3) * [1, 1, 0.5]
    direction /= np.linalg.norm(direction[:2])
    axis = rng.standard_normal(3)
    lever_mm = 30.0
    turn = axis / np.linalg.norm(axis) * path * rng.uniform(0, ranges.swing) / lever_mm
    return Motion(pose, direction * path, turn)


def scene_behind(place: Array, rng: np.random.Generator) -> Array:
    """`scene_from_world`, its table's top behind a place : (3,) mm, seen from above or from the side by up to 50 degrees."""
    up = Rotation.from_rotvec([0, 0, rng.uniform(0, 2 * np.pi)])
    lean = Rotation.from_rotvec(np.deg2rad(50) * rng.random() ** 2 * _around(rng))
    world_from_scene = rigid.transform((lean * Rotation.from_rotvec([np.pi, 0, 0]) * up).as_matrix(), np.zeros(3))
    behind = place[2] + rng.uniform(60, 330)
    world_from_scene[:3, 3] = [place[0] + rng.normal(0, 60), place[1] + rng.normal(0, 60), behind]
    return rigid.invert(world_from_scene)


def _around(rng: np.random.Generator) -> Array:
    angle = rng.uniform(0, 2 * np.pi)
    return np.array([np.cos(angle), np.sin(angle), 0])


def _lighting(ranges: LightRanges, pose: Array, rng: np.random.Generator) -> Lighting:
    """Lamps on the cameras' side of the target, so strong that together with the rest they give the target about 1."""
    count = int(rng.integers(ranges.lamps[0], ranges.lamps[1] + 1))
    ambient = rng.uniform(*ranges.ambient)
    strengths = rng.dirichlet(np.ones(count)) * (1 - ambient)
    lamps = np.zeros((LAMPS, 5))
    lamps[:, 3] = 1
    for lamp, strength in zip(lamps, strengths, strict=False):
        way = rng.standard_normal(3)
        way[2] = -abs(way[2]) - 0.15
        distance = _log_uniform(ranges.lamp_mm, rng)
        lamp[:3] = pose[:3, 3] + way / np.linalg.norm(way) * distance
        lamp[3] = _log_uniform(ranges.lamp_radius_mm, rng)
        lamp[4] = strength * distance**2
    gradient = rng.standard_normal(3)
    gradient *= rng.uniform(0, 0.9) / np.linalg.norm(gradient)
    return Lighting(lamps, ambient / np.pi, gradient, _projector(ranges, pose, rng))


def _projector(ranges: LightRanges, pose: Array, rng: np.random.Generator) -> Array:
    if rng.random() >= ranges.projector_share:
        return np.array([0, 1, 0, 12, 0.0])
    strength = _log_uniform(ranges.projector, rng) * pose[2, 3] ** 2
    fringes = rng.random() < 0.7
    return np.array([strength, 0.5, 0.5 * fringes * rng.uniform(0.3, 1), _log_uniform((6, 80), rng), float(rng.random() < 0.5)])


def _surfaces(rng: np.random.Generator) -> Array:
    rows = []
    for slot in SLOTS:
        reflectance, texture, size, gloss, roughness = SURFACES[slot]
        stretch = rng.uniform(0.03, 0.3) if rng.random() < GRAINED else 1.0
        rows.append([
            rng.uniform(*reflectance), rng.uniform(*texture), _log_uniform(size, rng), stretch,
            rng.uniform(*gloss) * (rng.random() < 0.6), rng.uniform(*roughness),
        ])  # fmt: skip
    return np.array(rows)


def draw_print(ranges: TargetRanges, target: Target, rng: np.random.Generator) -> Print:
    """A print of a target, with flaws on some."""
    flawed = rng.random() < ranges.flaw_share
    low, high = np.array([-14.0, -14.0]), circle_layout.extent(target) + 14
    scratches, spots = np.zeros((SCRATCHES, 6)), np.zeros((SPOTS, 4))
    for scratch in scratches[: rng.integers(SCRATCHES + 1) * flawed]:
        start = rng.uniform(low, high)
        end = start + rng.normal(0, 15, 2)
        scratch[:] = [*start, *end, rng.uniform(0.05, 0.4), rng.uniform(0.1, 0.9)]
    for spot in spots[: rng.integers(SPOTS + 1) * flawed]:
        spot[:] = [*rng.uniform(low, high), rng.uniform(0.2, 2.0), rng.uniform(0.05, 0.6)]
    uneven = rng.uniform(0, 0.25) if flawed else rng.uniform(0, 0.03)
    return Print(rng.uniform(*ranges.ink), rng.uniform(*ranges.paper), uneven, rng.uniform(0.0, 0.08), scratches, spots)


def _white(ranges: LightRanges, rng: np.random.Generator) -> float:
    ordinary = rng.random() < ranges.ordinary_share
    return _log_uniform(ranges.ordinary_dn if ordinary else ranges.white_dn, rng)
