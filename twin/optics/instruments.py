"""The twin's camera and projector: thin lenses with OpenCV distortion, in the ray tracer's arrays."""

from dataclasses import dataclass
from functools import cached_property

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray
from scipy.stats import norm

from recon.geometry import rigid
from recon.geometry.camera import Camera, distorted
from recon.model.rig import CameraDevice, Lens, ProjectorDevice

Images = NDArray[np.float32]

FOOTPRINT = 1 << 13  # entries of the table of a pixel's footprint; even, so that both halves mirror each other


@dataclass(frozen=True)
class CameraOptics:
    """A thin-lens camera: rays for points of the image, and the light that its lens loses towards the corners.

    The distortion is inverted in float64 at each pixel centre, together with its derivative, which carries a sample anywhere
    within the pixel to 1e-6 px; the ray tracer's float32 leaves some 1e-3 px.
    """

    camera: Camera
    aperture_mm: float  # diameter of the entrance pupil; 0 is a pinhole
    focus_mm: float
    blur_px: float  # standard deviation of the point spread in focus
    transmission: Images  # (h, w), cos^4 law and vignetting

    @classmethod
    def of(cls, device: CameraDevice) -> "CameraOptics":
        """The optics of a rig's camera."""
        camera = device.optics.camera()
        lens = device.lens
        return cls(camera, lens.aperture_mm, lens.focus_mm, lens.blur_px, transmission(camera, lens))

    @classmethod
    def pinhole(cls, camera: Camera) -> "CameraOptics":
        """A camera with a sharp image at any depth and no loss of light."""
        return cls(camera, 0.0, 1.0, 0.0, np.ones(camera.size[::-1], np.float32))

    @cached_property
    def tables(self) -> tuple[mi.Point2f, mi.Vector2f, mi.Vector2f]:
        """Ideal coordinates x/z, y/z at each pixel's centre, and their change for one px in u and one px in v."""
        grid = self.camera.pixel_grid()
        half_u, half_v = np.array([0.5, 0.0]), np.array([0.0, 0.5])
        centre = self.camera.undistort(grid)
        across = self.camera.undistort(grid + half_u) - self.camera.undistort(grid - half_u)
        down = self.camera.undistort(grid + half_v) - self.camera.undistort(grid - half_v)
        return tuple(
            kind(*np.float32(table.reshape(-1, 2).T))
            for kind, table in ((mi.Point2f, centre), (mi.Vector2f, across), (mi.Vector2f, down))
        )

    @cached_property
    def footprint(self) -> mi.Float:
        """Where, in px from a pixel's centre, lie evenly spaced fractions of the light that it gathers along one axis.

        The inverse of the distribution of a uniform number plus a normal one; points of the unit square go through it to those of
        pixel and blur together, and keep their even spacing.
        """
        sigma = self.blur_px
        offset = np.linspace(-0.5 - 6 * sigma, 0.5 + 6 * sigma, 1 << 16)
        right, left = (offset + 0.5) / sigma, (offset - 0.5) / sigma
        below = sigma * (right * norm.cdf(right) + norm.pdf(right) - left * norm.cdf(left) - norm.pdf(left))
        fractions = np.linspace(0, 1, FOOTPRINT)[FOOTPRINT // 2 :]
        fractions[-1] -= 0.3 / FOOTPRINT  # not the end of the tail: the last cell's light is interpolated evenly up to there
        half = np.interp(fractions, below, offset)
        return mi.Float(np.float32(np.concatenate([-half[::-1], half])))

    def reach_px(self, depths: NDArray[np.float64]) -> float:
        """Largest distance of a point's light from its sharp place, px, at any of the depths : (n,) mm from the lens."""
        focal = max(self.camera.matrix[0, 0], self.camera.matrix[1, 1])
        defocus = focal * self.aperture_mm / 2 * np.abs(1 / depths - 1 / self.focus_mm).max()
        return float(0.5 + 6 * self.blur_px + 1.2 * defocus + 1)  # 1.2: what distortion stretches; 1: the place's own pixel

    def spread(self, square: mi.Point2f) -> mi.Point2f:
        """Points of the square [-1/2, 1/2]^2 spread over a pixel's footprint, px; opposite ones stay opposite."""
        position = (square + 0.5) * (FOOTPRINT - 1)
        below = dr.clip(dr.floor(position), 0, FOOTPRINT - 2)
        first, fraction = mi.Point2u(below), position - below
        low = mi.Point2f(*(dr.gather(mi.Float, self.footprint, index) for index in first))
        high = mi.Point2f(*(dr.gather(mi.Float, self.footprint, index + 1) for index in first))
        return dr.lerp(low, high, fraction)


def sample_rays(optics: CameraOptics, tables: tuple, offset: mi.Point2f, lens: mi.Point2f) -> mi.Ray3f:
    """Rays in the world, one a pixel, for offsets from the pixel's centre in px and points of the unit disc on the lens."""
    centre, across, down = tables
    ideal = centre + across * offset.x + down * offset.y
    origin = mi.Point3f(lens.x, lens.y, 0) * (optics.aperture_mm / 2)
    in_focus = mi.Point3f(ideal.x, ideal.y, 1) * optics.focus_mm
    world_from_camera = _to_mitsuba(rigid.invert(optics.camera.camera_from_world))
    return mi.Ray3f(world_from_camera @ origin, dr.normalize(world_from_camera @ mi.Vector3f(in_focus - origin)))


@dataclass(frozen=True)
class ProjectorOptics:
    """A thin-lens projector: which of its pixels lights a point through a given point of its lens, and how strongly."""

    camera: Camera
    aperture_mm: float  # diameter of the exit pupil; 0 is a pinhole
    focus_mm: float
    vignetting: float
    plane_irradiance: float  # W per unit area of the plane z = 1 (an area without unit), all pixels on

    @classmethod
    def of(cls, device: ProjectorDevice) -> "ProjectorOptics":
        """The optics of a rig's projector; its flux is spread evenly over the image."""
        camera = device.optics.camera()
        (width, height), (fx, fy) = device.optics.size, device.optics.focal_px
        lens = device.lens
        return cls(camera, lens.aperture_mm, lens.focus_mm, lens.vignetting, device.radiant_flux_w * fx * fy / (width * height))


def light_point(projector: ProjectorOptics, point: mi.Point3f, lens: mi.Point2f) -> tuple:
    """Illumination of points of the world by the projector, through points of the unit disc on its lens.

    Returns
    -------
    source : Point3f
        The lens point in the world, mm.
    pixel : Point2f
        Projector coordinates of the light that goes from there to the point, px, with distortion and defocus.
    irradiance : Float
        On a surface that faces the lens point, W/mm^2, all pixels on; zero behind the projector.
    """
    matrix = projector.camera.camera_from_world
    source = mi.Point3f(lens.x, lens.y, 0) * (projector.aperture_mm / 2)
    local = _to_mitsuba(matrix) @ point
    toward = local - source
    in_focus = source + toward * (projector.focus_mm / toward.z)
    pixel, radius2 = _project(projector.camera, in_focus)
    distance2 = dr.squared_norm(toward)
    inverse_cosine = dr.sqrt(distance2) / toward.z
    irradiance = projector.plane_irradiance * inverse_cosine**3 / distance2 * (1 - projector.vignetting * radius2)
    return _to_mitsuba(rigid.invert(matrix)) @ source, pixel, dr.select(local.z > 0, irradiance, 0)


def pixels_per_mm(projector: ProjectorOptics, point: mi.Point3f, normal: mi.Normal3f) -> mi.Vector2f:
    """Change of the projector's column and of its row along a surface, each where it is steepest, without distortion : px/mm."""
    matrix = _to_mitsuba(projector.camera.camera_from_world)
    local, across = matrix @ point, matrix @ mi.Vector3f(normal)
    focal = projector.camera.matrix[0, 0], projector.camera.matrix[1, 1]
    slopes = mi.Vector3f(1, 0, -local.x / local.z), mi.Vector3f(0, 1, -local.y / local.z)
    along = (dr.safe_sqrt(dr.squared_norm(slope) - dr.square(dr.dot(slope, across))) for slope in slopes)
    return mi.Vector2f(*(float(f) * steepest / local.z for f, steepest in zip(focal, along, strict=True)))


def _project(camera: Camera, local: mi.Point3f) -> tuple[mi.Point2f, mi.Float]:
    """Project points of the device's frame to pixels; also their squared distance from the image's middle, 1 at a corner."""
    x, y = distorted(local.x / local.z, local.y / local.z, camera.coefficients.tolist())
    (fx, skew, cx), (_, fy, cy) = camera.matrix[0], camera.matrix[1]
    pixel = mi.Point2f(float(fx) * x + float(skew) * y + float(cx), float(fy) * y + float(cy))
    middle, corner2 = _middle_and_corner2(camera)
    return pixel, dr.squared_norm(pixel - mi.Point2f(middle.tolist())) / corner2


def transmission(camera: Camera, lens: Lens) -> Images:
    """Light that reaches each pixel relative to the axis : (h, w); the cos^4 law times the lens's vignetting."""
    x, y = np.moveaxis(camera.undistort(camera.pixel_grid()), -1, 0)
    cosine2 = 1 / (1 + x * x + y * y)
    middle, corner2 = _middle_and_corner2(camera)
    radius2 = ((camera.pixel_grid() - middle) ** 2).sum(axis=-1) / corner2
    return np.float32(cosine2**2 * (1 - lens.vignetting * radius2))


def _to_mitsuba(matrix: rigid.Array) -> mi.Transform4f:
    """A 4x4 transform for the ray tracer."""
    return mi.Transform4f(matrix.tolist())


def _middle_and_corner2(camera: Camera) -> tuple[NDArray[np.float64], float]:
    middle = (np.array(camera.size, float) - 1) / 2
    return middle, float(middle @ middle)
