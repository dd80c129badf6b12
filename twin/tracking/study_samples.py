"""Takes for measurements: the rig's own cameras, a clean target anywhere in the working volume, one lamp and light from around.

Unlike a data set's, these leave nothing to chance but pose, body and surroundings; light and blur are set.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from recon.geometry import rigid
from recon.model.circle_layout import circle_centres
from recon.model.rig import Rig
from twin.tracking.samples import LAMPS, SCRATCHES, SPOTS, Lighting, Motion, Print, Take, draw, facing
from twin.tracking.sampling_ranges import DataRanges
from twin.tracking.target_truth import board_corners
from twin.working_range import working_range

Array = NDArray[np.float64]

HALF_MM = (125.0, 100.0)  # half the breadth and the height of the paper's volume: 253 x 199 x 107 mm at 606 to 713 mm
TILT_DEG = 45.0  # most, of the target's normal from the way to the cameras
MARGIN_PX = 12.0  # of the board from the images' borders
TRIES = 200
GAIN = 1.0
CLEAN = Print(0.04, 0.8, 0.01, 0.03, np.zeros((SCRATCHES, 6)), np.zeros((SPOTS, 4)))  # a print without flaws
TURN_SHARE = 0.3  # of the path in the image, what the target's turn adds on the way


def study_take(rig: Rig, ranges: DataRanges, seed: int, k: int, white_dn: float, blur_px: float) -> Take:
    """Take k of a study: the whole board within both views, its white at `white_dn` of 255, its middle moved by `blur_px`."""
    rng = np.random.default_rng([seed, k])
    drawn = draw(ranges, rig, seed, k)
    pose = _pose(rig, rng)
    path = blur_px * pose[2, 3] / rig.cam1.optics.focal_px[0]
    angle = rng.uniform(0, 2 * np.pi)
    axis = rng.standard_normal(3)
    turn = axis / np.linalg.norm(axis) * TURN_SHARE * path / 30
    motion = Motion(pose, path * np.array([np.cos(angle), np.sin(angle), 0]), turn)
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


def _pose(rig: Rig, rng: np.random.Generator) -> Array:
    """Evenly over the working volume, and over the solid angle of tilts."""
    views = [device.optics.camera() for device in (rig.cam1, rig.cam2)]
    eyes = (views[0].centre + views[1].centre) / 2
    middle_target = circle_centres(rig.target)[1:].sum(axis=0) / 2
    where = working_range(rig)
    half, (near, far) = where.breadth * np.array(HALF_MM), where.depths_mm
    for _ in range(TRIES):
        middle = rng.uniform([*-half, near], [*half, far])
        middle[:2] += [eyes[0] + where.aside_mm[0], where.aside_mm[1]]
        pose = rigid.transform(facing(eyes - middle, TILT_DEG, rng), np.zeros(3))
        pose[:3, 3] = middle - pose[:3, :3] @ middle_target
        corners = [view.project(rigid.apply(pose, board_corners(rig.target))) for view in views]
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
