"""Where a rig works, from the rig itself: where the views of all its devices overlap and its lenses are sharp.

Places and sizes of what studies measure are those of the rig of Meza et al. 2021, 606 to 713 mm from camera 1; in another rig
they lie and are as large as in that one, by its depth, the middle of its views, and their breadth.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from recon.errors import InputError
from recon.model.rig import CameraDevice, ProjectorDevice, Rig
from scenes import board_poses
from scenes.kinds import board
from scenes.kinds.plane import Config as Plate
from twin.sensor import Exposure, noise_dn, number_per_electron

Array = NDArray[np.float64]

DEPTH_MM, MIDDLE_MM, BREADTH_MM = 659.5, (2.8, -2.3), 226.7  # of conf/rig/meza2021.yaml, as `_measured` finds them
NOISE, FOCAL_PX = 0.01743, 3324.5  # of its cameras: `relative_noise`, and the mean focal length
GRID = (33, 27)  # places over camera 1's image, across and down
NEAREST, FARTHEST, STEPS = 0.1, 10.0, 462  # depths that are looked at, of camera 1's focus, each 1 % behind the one before
SHARP_PX = 1.0, 1.0, 5.0  # disc of a point out of focus that halves a depth's weight, of cameras and projector
POWER = 4  # of a depth's weight: the best ones count
LEVEL = 0.45  # of a camera's range: the brightness at which its noise is compared


@dataclass(frozen=True)
class WorkingRange:
    """A rig's working range over that of Meza et al. 2021; `PAPER` for that one."""

    scale: float  # of depths
    breadth: float  # of the common view at the middle depth
    aside_mm: tuple[float, float]  # of the middle of the common view
    noise: float  # of the cameras' images, relative to their brightness
    magnification: float  # of the cameras at the middle depth, px/mm

    @property
    def depths_mm(self) -> tuple[float, float]:
        """Nearest and farthest."""
        return self.depth(board_poses.DEPTHS_MM[0]), self.depth(board_poses.DEPTHS_MM[1])

    def depth(self, z_mm: float) -> float:
        """A depth of the paper's rig in this one."""
        return self.scale * z_mm

    def place(self, x_mm: float, y_mm: float, z_mm: float) -> tuple[float, float, float]:
        """A place of the paper's rig in this one."""
        return self.scale * x_mm + self.aside_mm[0], self.scale * y_mm + self.aside_mm[1], self.scale * z_mm

    def plate(self, pose: Plate) -> Plate:
        """A plate of the paper's rig in this one."""
        size = (self.breadth * pose.size_mm[0], self.breadth * pose.size_mm[1])
        return pose.model_copy(update={"centre_mm": self.place(*pose.centre_mm), "size_mm": size})

    def board(self, design: board.Config) -> board.Config:
        """A board of the paper's rig in this one, of which the lengths that were given stay."""
        lengths = ("spacing_mm", "diameter_mm", "margin_mm")
        if self.breadth == 1 or design.model_fields_set & set(lengths):
            return design
        return design.model_copy(update={name: round(self.breadth * getattr(design, name), 1) for name in lengths})

    def poses(self, limits: board_poses.Config) -> board_poses.Config:
        """Limits of a board's poses, with this rig's depths where none are given."""
        return limits if limits.depth_mm is not None else limits.model_copy(update={"depth_mm": self.depths_mm})

    @property
    def rims(self) -> tuple[float, float]:
        """Noise of a disc's centre, px, on a board that fills the view likewise, and on the same target.

        By the images' noise, averaged over pixels along a rim.
        """
        return self.noise / (self.breadth * self.magnification) ** 0.5, self.noise / self.magnification**0.5

    def in_words(self) -> str:
        """The range on one line."""
        near, far = self.depths_mm
        return (
            f"works at {near:.0f} to {far:.0f} mm, where the views overlap and are sharp; boards and plates x {self.breadth:g}, "
            f"noise of discs x {self.rims[0]:.2f}, circles x {self.rims[1]:.2f}, fringes x {self.noise:g} of the paper's rig"
        )


PAPER = WorkingRange(1.0, 1.0, (0.0, 0.0), 1.0, 1.0)


@lru_cache(maxsize=64)
def working_range(rig: Rig) -> WorkingRange:
    """Where a rig works.

    Raises
    ------
    InputError
        If the views of its devices have no place in common.
    """
    depth, middle, breadth = _measured(rig)
    scale = round(depth / DEPTH_MM, 3)
    aside = [round(own - scale * paper) + 0.0 for own, paper in zip(middle, MIDDLE_MM, strict=True)]
    cameras = rig.cam1, rig.cam2
    noise = np.mean([relative_noise(camera) for camera in cameras]) / NOISE
    magnification = np.mean([camera.optics.focal_px for camera in cameras]) / FOCAL_PX / scale
    ratios = (round(float(ratio), 2) for ratio in (noise, magnification))
    return WorkingRange(scale, round(breadth / BREADTH_MM, 2), (aside[0], aside[1]), *ratios)


def _measured(rig: Rig) -> tuple[float, tuple[float, float], float]:
    """Middle depth, mm, and of the view that all devices share there the middle : (x, y) mm and the root of its area, mm.

    A depth weighs by the share of camera 1's view that the others see, halved by each lens whose disc of confusion is as large as
    is still sharp.
    """
    parts: tuple[CameraDevice | ProjectorDevice, ...] = (rig.cam1, rig.cam2, rig.projector)
    cameras = [part.optics.camera() for part in parts]
    across, down = (np.linspace(0, length - 1, steps) for length, steps in zip(cameras[0].size, GRID, strict=True))
    rays = cameras[0].rays(np.stack(np.meshgrid(across, down), axis=-1).reshape(-1, 2))
    rays = rays / rays[:, 2:]
    depths = rig.cam1.lens.focus_mm * np.geomspace(NEAREST, FARTHEST, STEPS)
    seen = np.ones((STEPS, len(rays)), bool)
    for camera in cameras[1:]:
        pixels = camera.project(depths[:, None, None] * rays)
        with np.errstate(invalid="ignore"):
            seen &= ((pixels > -0.5) & (pixels < np.array(camera.size) - 0.5)).all(axis=-1)
    if not seen.any():
        raise InputError("rig: expected views of cam1, cam2 and projector that overlap, found none that do")
    weights = seen.mean(axis=1)
    for part, sharp in zip(parts, SHARP_PX, strict=True):
        discs = part.lens.aperture_mm * part.optics.focal_px[0] * np.abs(1 / depths - 1 / part.lens.focus_mm)
        weights = weights / (1 + (discs / sharp) ** 2)
    weights = (weights / weights.max()) ** POWER
    depth = float(np.exp(weights @ np.log(depths) / weights.sum()))
    own = seen[np.abs(np.log(depths / depth)).argmin()]
    if not own.any():
        own = seen[weights.argmax()]
    x, y = depth * rays[own, 0].mean(), depth * rays[own, 1].mean()
    view = np.ptp(rays[:, :2], axis=0).prod() * depth**2 * own.mean()
    return depth, (float(x), float(y)), float(np.sqrt(view))


def relative_noise(camera: CameraDevice) -> float:
    """Noise of a camera's image over its brightness, at a part of its range, by its sensor alone."""
    exposure = Exposure(1.0)
    electrons = np.float32(LEVEL * 255 / number_per_electron(camera.sensor, exposure))
    return float(noise_dn(electrons, camera.sensor, exposure) / (LEVEL * 255))
