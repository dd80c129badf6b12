"""The same measurement for Mitsuba's own `path` integrator, one render a pattern: the peer of `transport.render`.

Mitsuba's camera and projector are pinholes without distortion, with the principal point in the middle of the projector; so is
the rig that the two can be compared on, see `ideal_rig`.
"""

import mitsuba as mi
import numpy as np

from recon.geometry import rigid
from recon.geometry.camera import Camera
from recon.model.rig import Rig
from scenes.scene_types import Scene
from twin.optics.instruments import ProjectorOptics
from twin.optics.light_transport import Images
from twin.optics.raster import MARGIN, OVERSAMPLING, Light
from twin.optics.ray_world import named_shapes

# Mitsuba's cameras look along +z with x to the left and y up; OpenCV's have x to the right and y down.
OPENCV_FROM_MITSUBA = np.diag([-1.0, -1.0, 1.0, 1.0])


def ideal_rig(rig: Rig, scale: float = 1.0) -> tuple[Camera, ProjectorOptics]:
    """Camera 1 and the projector of a rig as Mitsuba can have them; `scale` shrinks the images of both."""
    camera, projector = rig.cam1.optics.camera(), ProjectorOptics.of(rig.projector)
    lens = projector.camera
    offset = ((np.array(lens.size) - 1) / 2 - lens.matrix[:2, 2]) / lens.matrix[0, 0]
    turn = rigid.from_rotation_vector([offset[1], -offset[0], 0], [0, 0, 0])  # to where the offset lens threw its image
    return (
        _shrunk_pinhole(camera, scale, camera.camera_from_world),
        ProjectorOptics(_shrunk_pinhole(lens, scale, turn @ lens.camera_from_world), 0.0, 1.0, 0.0, projector.plane_irradiance),
    )


def _shrunk_pinhole(camera: Camera, scale: float, camera_from_world: rigid.Array) -> Camera:
    """A pinhole with square pixels and the principal point in the middle of an image shrunk by `scale`."""
    size = (round(camera.size[0] * scale), round(camera.size[1] * scale))
    focal = camera.matrix[0, 0] * scale
    return Camera(
        size, np.array([[focal, 0, (size[0] - 1) / 2], [0, focal, (size[1] - 1) / 2], [0, 0, 1]]), np.zeros(0), camera_from_world
    )


def mitsuba_scene(scene: Scene, camera: Camera, projector: ProjectorOptics, detail: int = 1) -> mi.Scene:
    """A scene with Mitsuba's own camera and projector; the pattern is set later, by `show_pattern`.

    detail : texels a projector px, a divisor of OVERSAMPLING; Mitsuba interpolates linearly between them.
    """
    width, height = projector.camera.size
    blank = np.zeros((height * detail, width * detail, 1), np.float32)
    return mi.load_dict(
        {
            "type": "scene",
            **named_shapes(scene),
            "projector": {
                "type": "projector",
                "to_world": _world_from_mitsuba(projector.camera),
                "fov": _field_of_view(projector.camera),
                "fov_axis": "x",
                "scale": projector.plane_irradiance / np.pi,  # Mitsuba's projector multiplies by pi
                "irradiance": {"type": "bitmap", "bitmap": mi.Bitmap(blank), "raw": True, "wrap_mode": "clamp"},
            },
            "camera": {
                "type": "perspective",
                "to_world": _world_from_mitsuba(camera),
                "fov": _field_of_view(camera),
                "fov_axis": "x",
                "near_clip": 1.0,
                "far_clip": 1e5,
                "film": {
                    "type": "hdrfilm",
                    "width": camera.size[0],
                    "height": camera.size[1],
                    "pixel_format": "luminance",
                    "rfilter": {"type": "box"},
                },
                "sampler": {"type": "independent"},
            },
        }
    )


def render_pattern(world: mi.Scene, light: Light, pattern: int, samples: int, seed: int, bounces: int = 1) -> Images:
    """Radiance : (h, w) W/mm^2/sr under one pattern of vertical fringes, after up to `bounces` reflections."""
    show_pattern(world, light, pattern)
    return render_shown(world, samples, seed, bounces)


def show_pattern(world: mi.Scene, light: Light, pattern: int) -> None:
    """Set the projector's pattern, of vertical fringes; takes as long as a small render."""
    parameters = mi.traverse(world)
    height, width, _ = parameters["projector.irradiance.data"].shape
    fine = light.fine_profiles("columns")[pattern, MARGIN * OVERSAMPLING : -MARGIN * OVERSAMPLING]
    texels = fine.reshape(width, -1).mean(axis=1)
    parameters["projector.irradiance.data"] = mi.TensorXf(np.repeat(texels[None, :, None], height, axis=0))
    parameters.update()


def render_shown(world: mi.Scene, samples: int, seed: int, bounces: int = 1) -> Images:
    """Radiance : (h, w) W/mm^2/sr under the pattern shown, after up to `bounces` reflections."""
    integrator = mi.load_dict({"type": "path", "max_depth": bounces + 1, "rr_depth": 1000})  # its depth counts segments
    return np.asarray(mi.render(world, integrator=integrator, spp=samples, seed=seed))[:, :, 0]


def _field_of_view(camera: Camera) -> float:
    """Horizontal field of view in deg."""
    return float(np.rad2deg(2 * np.arctan(camera.size[0] / 2 / camera.matrix[0, 0])))


def _world_from_mitsuba(camera: Camera) -> mi.ScalarTransform4f:
    """Pose of a camera in Mitsuba's convention."""
    return mi.ScalarTransform4f((rigid.invert(camera.camera_from_world) @ OPENCV_FROM_MITSUBA).tolist())
