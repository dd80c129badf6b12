"""Reach of the tracker: drawn rigs of 0.3 to 12 MP, their targets at any distance at which circles are 16 px and more.

What a rig of other cameras shows differs from ours in its pixels alone: resolution, angle of view, and how large a circle is.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from recon.geometry import rigid
from recon.geometry.camera import Camera
from recon.model.circle_layout import circle_centres
from recon.model.rig import CameraDevice, Lens, Optics, Pose, Rig, Target
from recon.tracking import networks as nets
from recon.tracking.networks import Networks
from recon.tracking.tracker import Tracker
from twin.experiments import tracking_frames
from twin.experiments.experiment_setup import Figures, Setup
from twin.experiments.pose_accuracy import cameras_of, pose_errors
from twin.experiments.tracking_frames import exactly_printed
from twin.shooting import FilmQuality
from twin.tracking.mesh_bank import build_bank
from twin.tracking.rendered_views import Frames, render_film
from twin.tracking.samples import Motion, Take, draw, facing
from twin.tracking.study_samples import CLEAN, lit_from_the_front
from twin.tracking.target_truth import board_corners

Array = NDArray[np.float64]

SEED, COUNT, VARIANTS = 2003, 200, 8
SIZES = ((640, 480), (752, 480), (800, 600), (1280, 720), (1280, 1024), (1920, 1200), (2448, 2048), (3840, 2160), (4000, 3000))
FOCAL_WIDTHS = (0.8, 3.5)  # focal length over the image's width: angles of view of 64 to 16 degrees
LEAST_PX, MOST_PX = 16.0, 600.0  # of a circle's diameter at right angles; more doesn't fit into any of these images
MOST_OF_HEIGHT = 0.24  # of a circle's diameter: the target is 3.6 of them high
NEAREST_MM = 110.0
BASELINE = (0.15, 0.35)  # of the distance
TILT_DEG = 45.0
WHITE_DN = (60.0, 150.0)
BLUR_PX = 0.5  # of the lens in focus
MARGIN_PX = 4.0  # of the board from the images' borders
TRIES = 1000
WRONG_SHARE = 0.01  # error of a place over its distance beyond which a pose is wrong, whatever is predicted
WHOLLY = 0.98  # of each disc that is seen


@dataclass(frozen=True)
class Reached:
    """One pair of frames of a drawn rig."""

    k: int
    size: tuple[int, int]  # px
    disc_px: float  # diameter of a circle at right angles, the least of both views
    distance_mm: float
    how: str | None
    reason: str | None
    wrong: bool


def drawn_rigs(setup: Setup, count: int = COUNT, most_px: float = np.inf) -> Figures:
    """Shares found, and wrong ones; of rigs of `most_px` pixels at most."""
    reached = list(tracked(exactly_printed(setup), nets.load(kind=setup.rig.target.kind), SEED, count, most_px))
    found, wrong = 100 * np.mean([one.how is not None for one in reached]), sum(one.wrong for one in reached)
    return {"pairs": len(reached), "found_percent": found, "wrong": wrong}


def tracked(setup: Setup, networks: Networks, seed: int, count: int, most_px: float = np.inf) -> Iterator[Reached]:
    """Track each pair as if nothing were known before."""
    for take, given in drawn(setup, seed, count, most_px):
        cameras = cameras_of(take)
        result = Tracker(cameras, setup.rig.target, networks).step(*given.views)
        distance = float(np.linalg.norm(take.motion.world_from_target[:3, 3]))
        errors = pose_errors(take, result.pose.world_from_target) if result.found else None
        wrong = errors is not None and errors[0] > WRONG_SHARE * distance
        disc = min(disc_px(camera, take.motion.world_from_target, setup.rig.target) for camera in cameras)
        yield Reached(take.k, cameras[0].size, disc, distance, result.how, result.pose.reason, wrong)


def drawn(setup: Setup, seed: int, count: int, most_px: float = np.inf) -> Iterator[tuple[Take, Frames]]:
    """Pairs of frames of drawn rigs, their target uncovered."""
    bank = build_bank(setup.rig.target, VARIANTS, seed)
    k = given = 0
    while given < count:
        take = reach_take(setup, seed, k)
        k += 1
        if np.prod(take.cameras[0].optics.size) > most_px:
            continue
        shown = render_film(bank, setup.rig, [take], FilmQuality(), seed)[0]
        if min(view.visible.min() for view in shown.truth) > WHOLLY:
            given += 1
            yield take, shown


def reach_take(setup: Setup, seed: int, k: int) -> Take:
    """Take k: cameras of a resolution, an angle of view, a distance, and a pose in which both see the board."""
    rng = np.random.default_rng([seed, k])
    take = draw(tracking_frames.ranges_of(setup).model_copy(update={"variants": VARIANTS}), setup.rig, seed, k)
    size = SIZES[int(rng.integers(len(SIZES)))]
    for _ in range(TRIES):
        focal = float(size[0] * np.exp(rng.uniform(*np.log(FOCAL_WIDTHS))))
        disc = float(np.exp(rng.uniform(*np.log([LEAST_PX, min(MOST_PX, MOST_OF_HEIGHT * size[1])]))))
        distance = focal * setup.rig.target.outer_diameter_mm / disc
        devices = cameras_at(setup.rig, size, focal, distance, rng)
        pose = _pose(devices, setup.rig.target, distance, rng)
        if distance > NEAREST_MM and pose is not None:
            break
    else:
        raise ValueError("expected cameras that both see the target")
    scene = take.scene_from_world @ rigid.transform(np.eye(3), take.motion.world_from_target[:3, 3] - pose[:3, 3])
    return replace(
        take,
        cameras=devices,
        present=True,
        motion=Motion(pose, np.zeros(3), np.zeros(3)),
        scene_from_world=scene,
        lighting=lit_from_the_front(pose, rng),
        face=CLEAN,
        white_dn=float(rng.uniform(*WHITE_DN)),
        gain=1.0,
    )


def cameras_at(
    rig: Rig, size: tuple[int, int], focal_px: float, distance_mm: float, rng: np.random.Generator
) -> tuple[CameraDevice, CameraDevice]:
    """Two cameras whose axes meet at a distance, in focus there."""
    base = distance_mm * rng.uniform(*BASELINE)
    centre = np.array([rng.choice([-1.0, 1.0]) * base, *rng.normal(0, 0.02 * base, 2)])
    turn = Rotation.from_rotvec([0, -np.arctan2(centre[0], distance_mm), 0]).as_matrix()
    to_world = rigid.invert(rigid.transform(turn, centre))
    focal_mm = focal_px * rig.cam1.sensor.pixel_um * 1e-3
    lens = Lens(focal_length_mm=focal_mm, f_number=11.0, focus_mm=max(distance_mm, 2 * focal_mm), blur_px=BLUR_PX)
    middle = tuple(((np.array(size) - 1) / 2 + rng.normal(0, 0.01 * size[0], 2)).tolist())
    k1 = float(rng.normal(0, 0.05))
    made = []
    for device, pose in ((rig.cam1, np.eye(4)), (rig.cam2, to_world)):
        rotation = np.rad2deg(Rotation.from_matrix(pose[:3, :3]).as_rotvec())
        stands = Pose(rotation_deg=tuple(rotation.tolist()), translation_mm=tuple(pose[:3, 3].tolist()))
        optics = Optics(
            size=size, focal_px=(focal_px, focal_px * 1.002), centre_px=middle, distortion=(k1, 0.0, 0.0, 0.0),
            device_from_world=stands,
        )  # fmt: skip
        made.append(device.model_copy(update={"optics": optics, "lens": lens}))
    return made[0], made[1]


def _pose(devices: Sequence[CameraDevice], target: Target, distance: float, rng: np.random.Generator) -> Array | None:
    """Of a target anywhere in both views, at a distance; None if its board doesn't lie within them."""
    views = [device.optics.camera() for device in devices]
    eyes = (views[0].centre + views[1].centre) / 2
    middle_target = circle_centres(target)[1:].sum(axis=0) / 2
    size = np.array(views[0].size)
    ray = views[0].rays(rng.uniform(0.1 * size, 0.9 * size))
    middle = views[0].centre + ray / ray[2] * distance
    pose = rigid.transform(facing(eyes - middle, TILT_DEG, rng), np.zeros(3))
    pose[:3, 3] = middle - pose[:3, :3] @ middle_target
    for view in views:
        corners = view.project(rigid.apply(pose, board_corners(target)))
        if not (np.isfinite(corners).all() and (corners > MARGIN_PX).all() and (corners < size - 1 - MARGIN_PX).all()):
            return None
    return pose if min(disc_px(view, pose, target) for view in views) >= LEAST_PX else None


def disc_px(camera: Camera, pose: Array, target: Target) -> float:
    """Diameter of a circle at right angles at the distance of the farthest one, px."""
    depths = rigid.apply(camera.camera_from_world @ pose, circle_centres(target))[:, 2]
    return float(camera.matrix[0, 0] * target.outer_diameter_mm / depths.max())
