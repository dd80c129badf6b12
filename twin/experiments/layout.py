"""A rig's layout by a few lengths: what a designer turns, instead of the poses and sizes that follow from it."""

import numpy as np
from scipy.spatial.transform import Rotation

from recon.geometry import rigid
from recon.geometry.camera import Array
from recon.model.rig import Optics, Part, Pose, Positive, Rig
from twin.working_range import working_range

AIM_MM = 660.0  # z of what a device keeps looking at: the middle of the working range of Meza et al. 2021, and likewise of others


class Layout(Part):
    """Changes of a rig's layout; as the rig describes it where nothing is given."""

    projector_mm: Positive | None = None  # distance of the projector's pinhole from camera 1's, along the line it stands on
    camera_mm: Positive | None = None  # the same of camera 2
    target_scale: Positive = 1.0  # of all lengths of the target: circles, their distances and the board


def laid_out(rig: Rig, layout: Layout) -> Rig:
    """The rig in another layout: devices that move keep looking at the same place."""
    changed, aim_mm = {}, working_range(rig).depth(AIM_MM)
    for name, distance in (("projector", layout.projector_mm), ("cam2", layout.camera_mm)):
        if distance is not None:
            device = getattr(rig, name)
            changed[name] = device.model_copy(update={"optics": moved(device.optics, distance, aim_mm)})
    if layout.target_scale != 1:
        changed["target"] = _scaled(rig, layout.target_scale)
    return rig.unmeasured(*(f"{name}.optics" for name in changed)).model_copy(update=changed)


def moved(optics: Optics, distance_mm: float, aim_mm: float = AIM_MM) -> Optics:
    """A device farther from or nearer to the world's origin, turned so that its image's middle shows the same place."""
    camera = optics.camera()
    ray = camera.rays((np.array(camera.size) - 1) / 2)
    aim = camera.centre + ray * (aim_mm - camera.centre[2]) / ray[2]
    centre = camera.centre * distance_mm / np.linalg.norm(camera.centre)
    turn = least_turn(aim - camera.centre, aim - centre)
    rotation = camera.camera_from_world[:3, :3] @ turn.T
    pose = rigid.transform(rotation, -rotation @ centre)
    vector = np.rad2deg(Rotation.from_matrix(pose[:3, :3]).as_rotvec())
    return optics.model_copy(
        update={"device_from_world": Pose(rotation_deg=tuple(vector.tolist()), translation_mm=tuple(pose[:3, 3].tolist()))}
    )


def least_turn(before: Array, after: Array) -> Array:
    """The smallest rotation : (3, 3) that brings one direction : (3,) to another."""
    first, second = before / np.linalg.norm(before), after / np.linalg.norm(after)
    axis = np.cross(first, second)
    sine = np.linalg.norm(axis)
    if sine == 0:
        return np.eye(3)
    return Rotation.from_rotvec(axis / sine * np.arctan2(sine, first @ second)).as_matrix()


def _scaled(rig: Rig, scale: float):
    target = rig.target
    lengths = (*target.LENGTHS, "outer_diameter_mm", "inner_diameter_mm")
    width, height = target.board_mm
    return target.model_copy(
        update={name: scale * getattr(target, name) for name in lengths} | {"board_mm": (scale * width, scale * height)}
    )
