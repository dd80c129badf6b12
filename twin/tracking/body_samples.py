"""Further bodies of a data set's samples, beside the probe's target: which are there, where, and how they move.

A body in a hand is anywhere in view, as the probe is. One that stands, such as a patient's board on its post, stands on the table
behind the probe. Boards keep apart in both views; hands, posts and cables cover what they may.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from recon.geometry import rigid
from recon.geometry.camera import Camera
from recon.model import circle_layout
from recon.model.rig import Rig, Target
from scenes.handheld.body_look import Stand, look_of
from twin.tracking.mesh_bank import Bank
from twin.tracking.samples import OUTSIDE_SHARE, TRIES, Held, Motion, Take, draw_motion, draw_print, facing, within
from twin.tracking.sampling_ranges import DataRanges
from twin.tracking.target_truth import board_hulls, overlap

Array = NDArray[np.float64]

ABOVE_MM = 40.0  # the table, least, of a board in a hand


def with_bodies(take: Take, bank: Bank, ranges: DataRanges, rig: Rig, seed: int) -> Take:
    """The sample with all bodies of the rig, each of them there or absent; a sample that is empty stays so.

    Each body has random numbers of its own, by (seed, k) and its number, so that what surrounds them, and the probe's pose, are
    those of a rig without others. One that finds no room is absent.

    bank : of `mesh_bank.build_bodies`
    """
    if not rig.bodies:
        return take
    cameras = [device.optics.camera() for device in take.cameras]
    first, *streams = [np.random.default_rng([seed, take.k, number]) for number in range(1, 2 + len(rig.bodies))]
    present = take.present and first.random() >= ranges.bodies.absent_share
    taken = [board_hulls(take.motion, cameras, rig.target)] if present else []
    others = {}
    for number, (rng, (name, target)) in enumerate(zip(streams, rig.bodies.items(), strict=True), 1):
        wanted = take.present and rng.random() >= ranges.bodies.absent_share
        variant, face = int(rng.integers(ranges.variants)), draw_print(ranges.target, target, rng)
        stand = None if look_of(name).IN_A_HAND else bank.stands[name][variant]
        motion = None
        for _ in range(TRIES if wanted else 0):
            drawn = _motion(target, stand, take, cameras, ranges, rng)
            hulls = board_hulls(drawn, cameras, target) if drawn else ()
            if drawn and not any(overlap(hulls, those) for those in taken):
                taken.append(hulls)
                motion = drawn
                break
        others[name] = Held(motion or take.motion, ranges.variants * number + variant, face, motion is not None)
    return replace(take, present=present, others=others)


def _motion(
    target: Target, stand: Stand | None, take: Take, cameras: Sequence[Camera], ranges: DataRanges, rng: np.random.Generator
) -> Motion | None:
    """Motion of a body in a hand, or of one on its stand, which hardly moves; None if it would be out of view, or lie badly."""
    way = cameras[0].rays(rng.uniform([0, 0], np.array(cameras[0].size) - 1))
    eyes = np.mean([camera.centre for camera in cameras], axis=0)
    anywhere = rng.random() < OUTSIDE_SHARE
    if stand is None:
        depth = take.motion.world_from_target[2, 3] + rng.uniform(-1, 1) * ranges.bodies.apart_mm
        middle = way / way[2] * np.clip(depth, *ranges.pose.distance_mm)
        turn, moves = facing(eyes - middle, ranges.pose.tilt_deg, rng), ranges.pose
        fits = rigid.apply(take.scene_from_world, middle)[2] > ABOVE_MM
    else:
        up, height = take.scene_from_world[2, :3], take.scene_from_world[2, 3]
        middle = way * (stand.height_mm - height) / (up @ way)
        upright, _ = Rotation.align_vectors(up, stand.up)
        turn = (Rotation.from_rotvec(rng.uniform(0, 2 * np.pi) * up) * upright).as_matrix()
        moves = ranges.pose.model_copy(update={"still_share": 1.0})
        towards = (eyes - middle) / np.linalg.norm(eyes - middle)
        nearest, farthest = ranges.pose.distance_mm
        fits = nearest < middle[2] < farthest and turn[:, 2] @ towards > np.cos(np.deg2rad(ranges.pose.tilt_deg))
    if not fits or not (anywhere or all(within(camera, middle) for camera in cameras)):
        return None
    return draw_motion(moves, rigid.transform(turn, middle - turn @ circle_layout.middle(target)), cameras[0], rng)
