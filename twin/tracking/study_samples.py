"""Takes for measurements: the rig's own cameras, a clean target anywhere in the working volume, one lamp and light from around.

Unlike a data set's, these leave nothing to chance but pose, body and surroundings; light and blur are set.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from recon.errors import InputError
from recon.geometry import rigid
from recon.model.circle_layout import circle_centres
from recon.model.rig import PROBE, Rig, Target
from twin.tracking.mesh_bank import Bank, uncovered_share
from twin.tracking.samples import LAMPS, SCRATCHES, SPOTS, Held, Lighting, Motion, Print, Take, draw, facing, scene_behind
from twin.tracking.sampling_ranges import DataRanges
from twin.tracking.target_truth import board_corners, board_hulls, overlap
from twin.working_range import working_range

Array = NDArray[np.float64]

HALF_MM = (125.0, 100.0)  # half the breadth and the height of the paper's volume: 253 x 199 x 107 mm at 606 to 713 mm
TILT_DEG = 45.0  # most, of the target's normal from the way to the cameras
MARGIN_PX = 12.0  # of the board from the images' borders
TRIES = 200
BODIES_TRIES, PLACE_TRIES = 300, 20  # of poses of several bodies, and of each beside those before
BODIES_STREAM = 1  # of random numbers, apart from those of a single target
WHITE_DN, BLUR_PX = (8.0, 180.0), (0.0, 12.0)  # of several bodies, least and most
GAIN = 1.0
CLEAN = Print(0.04, 0.8, 0.01, 0.03, np.zeros((SCRATCHES, 6)), np.zeros((SPOTS, 4)))  # a print without flaws
TURN_SHARE = 0.3  # of the path in the image, what the target's turn adds on the way


def study_take(rig: Rig, ranges: DataRanges, seed: int, k: int, white_dn: float, blur_px: float) -> Take:
    """Take k of a study: the whole board within both views, its white at `white_dn` of 255, its middle moved by `blur_px`."""
    rng = np.random.default_rng([seed, k])
    drawn = draw(ranges, rig, seed, k)
    pose = _pose(rig, rig.target, rng)
    motion = _moving(rig, pose, blur_px, rng)
    scene = drawn.scene_from_world @ rigid.transform(np.eye(3), drawn.motion.world_from_target[:3, 3] - pose[:3, 3])
    return replace(
        drawn,
        cameras=(rig.cam1, rig.cam2),
        present=True,
        motion=motion,
        scene_from_world=scene,
        lighting=lit_from_the_front(pose, rng),
        face=CLEAN,
        white_dn=white_dn,
        gain=GAIN,
    )


def bodies_take(
    bank: Bank,
    rig: Rig,
    ranges: DataRanges,
    seed: int,
    k: int,
    white_dn: tuple[float, float] = WHITE_DN,
    blur_px: tuple[float, float] = BLUR_PX,
) -> Take:
    """Take k of a study of several bodies: all boards within both views, no circle covered; each body moves by itself.

    bank : of `build_bodies`
    white_dn, blur_px : least and most; the white log-uniform, the blur of each body's middle uniform

    Raises
    ------
    InputError
        If the boards don't find room beside each other.
    """
    rng = np.random.default_rng([seed, k, BODIES_STREAM])
    white = float(np.exp(rng.uniform(*np.log(white_dn))))
    drawn = replace(draw(ranges, rig, seed, k), cameras=(rig.cam1, rig.cam2), present=True, face=CLEAN, white_dn=white, gain=GAIN)
    centres = np.array([device.optics.camera().centre for device in drawn.cameras])
    for _ in range(BODIES_TRIES):
        motions = _apart(rig, blur_px, rng)
        if motions is None:
            continue
        variants = rng.integers(ranges.variants, size=len(motions)) + ranges.variants * np.arange(len(motions))
        held = {name: Held(motion, int(n), CLEAN) for (name, motion), n in zip(motions.items(), variants, strict=True)}
        poses = np.array([one.motion.world_from_target for one in held.values()])
        probe = held.pop(PROBE)
        scene = scene_behind(np.append(poses[:, :2, 3].mean(axis=0), poses[:, 2, 3].max()), rng)
        take = replace(drawn, motion=probe.motion, body=probe.body, others=held, scene_from_world=scene)
        if uncovered_share(bank, take, rig.targets, centres) == 1:
            return replace(take, lighting=lit_from_the_front(poses[0], rng))
    raise InputError(f"rig: expected both views to have room for the boards of {', '.join(rig.targets)}, found none")


def _apart(rig: Rig, blur_px: tuple[float, float], rng: np.random.Generator) -> dict[str, Motion] | None:
    """Motions of all bodies, whose boards keep apart in both views over the exposure; None if one finds no room."""
    motions, taken = dict[str, Motion](), list[tuple[NDArray[np.float32], ...]]()
    views = [device.optics.camera() for device in (rig.cam1, rig.cam2)]
    for name, target in rig.targets.items():
        for _ in range(PLACE_TRIES):
            motion = _moving(rig, _pose(rig, target, rng), rng.uniform(*blur_px), rng)
            hulls = board_hulls(motion, views, target)
            if not any(overlap(hulls, others) for others in taken):
                taken.append(hulls)
                motions[name] = motion
                break
        else:
            return None
    return motions


def _moving(rig: Rig, pose: Array, blur_px: float, rng: np.random.Generator) -> Motion:
    """Over a path in the image, in any direction, with a turn about any axis."""
    path = blur_px * pose[2, 3] / rig.cam1.optics.focal_px[0]
    angle = rng.uniform(0, 2 * np.pi)
    axis = rng.standard_normal(3)
    turn = axis / np.linalg.norm(axis) * TURN_SHARE * path / 30
    return Motion(pose, path * np.array([np.cos(angle), np.sin(angle), 0]), turn)


def _pose(rig: Rig, target: Target, rng: np.random.Generator) -> Array:
    """Of a target, evenly over the working volume, and over the solid angle of tilts."""
    views = [device.optics.camera() for device in (rig.cam1, rig.cam2)]
    eyes = (views[0].centre + views[1].centre) / 2
    middle_target = circle_centres(target)[1:].sum(axis=0) / 2
    where = working_range(rig)
    half, (near, far) = where.breadth * np.array(HALF_MM), where.depths_mm
    for _ in range(TRIES):
        middle = rng.uniform([*-half, near], [*half, far])
        middle[:2] += [eyes[0] + where.aside_mm[0], where.aside_mm[1]]
        pose = rigid.transform(facing(eyes - middle, TILT_DEG, rng), np.zeros(3))
        pose[:3, 3] = middle - pose[:3, :3] @ middle_target
        corners = [view.project(rigid.apply(pose, board_corners(target))) for view in views]
        if all(_within(each, view.size) for each, view in zip(corners, views, strict=True)):
            return pose
    raise ValueError("rig: expected cameras that both see the working volume")


def _within(pixels: Array, size: tuple[int, int]) -> bool:
    return bool((pixels > MARGIN_PX).all() and (pixels < np.array(size) - 1 - MARGIN_PX).all())


def lit_from_the_front(pose: Array, rng: np.random.Generator) -> Lighting:
    """Half the light from a lamp in front, half from around."""
    lamps = np.zeros((LAMPS, 5))
    lamps[:, 3] = 1
    way = np.append(rng.uniform(-0.5, 0.5, 2), -1)
    lamps[0] = [*(pose[:3, 3] + way / np.linalg.norm(way) * 900), 60, 0.5 * 900**2]
    return Lighting(lamps, 0.5 / np.pi, np.zeros(3), np.array([0, 1, 0, 12, 0.0]))
