"""Correction of masses' surfaces for blur: of beam and slice, of the B-scans' spacing, and of the fit itself.

A blur of covariance S moves the border of a body with curvature tensor K inwards by `trace(S K) / 2`, so lobes come out flat. Its
extent at a surface like the one that was found is measured on that one: B-scans of it are made, as blurred as the scanner's and
in the same places, its surface is found in them again, and what that differs by is taken off: one step of Van Cittert's
iteration. A second one moves depths by 0.03 mm, and they scatter more.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import trimesh
from numpy.typing import NDArray

from recon import threads
from recon.compiled import kernel, njit
from recon.freehand.volume_compounding import Grid, grid_of
from recon.geometry.surface_tree import signed_distances
from recon.segmentation import echo_power
from recon.segmentation.echo_power import SLICE_MM, SPREAD_MM, EchoPower, Placed, pixel_mm
from recon.segmentation.mass_surface import Mass, distances

Array = NDArray[np.float64]
Map = NDArray[np.float32]
Fit = Callable[[Sequence[Mass], EchoPower], Sequence[Mass]]  # masses again, their surfaces moved to the borders in the power

EDGE_MM = 0.15  # sigma of the border in the B-scans that are made, or its steps would alias in the voxels
MOST_MM = 1.2  # standard deviation of a beam or a slice; borders that are wider aren't fitted, see `border_fit.BLURS_MM`
OUTSIDE_MM = 4.0  # farther from a border pixels show tissue only, by `MOST_MM` along the array and across
NODES = (-math.sqrt(3), 0.0, math.sqrt(3))  # places, in standard deviations, of a mean over a Gaussian
SHARES = (1 / 6, 2 / 3, 1 / 6)  # their weights; exact for polynomials of the fifth degree


@dataclass(frozen=True)
class Blur:
    """Standard deviations of an echo's power, off the middle of its beam; by default those of the default array."""

    lateral_mm: float = SPREAD_MM[0]  # along the array
    slice_mm: tuple[tuple[float, float], ...] = SLICE_MM  # depth, rising, and across the image plane there; none: a thin slice

    def __str__(self) -> str:
        """In words, for a console."""
        thick = [f"{sigma:g} mm {depth:g} mm deep" for depth, sigma in self.slice_mm[:: max(1, len(self.slice_mm) - 1)]]
        slices = f"across the plane {', '.join(thick)}" if thick else "none across the plane"
        return f"of an echo's power, sigma: {self.lateral_mm:g} mm along the array, {slices}; lobes are corrected for it"

    def across(self, depths: Array) -> Array:
        """Standard deviation across the image plane, mm, at depths, mm."""
        if not self.slice_mm:
            return np.zeros_like(depths)
        return np.interp(depths, *np.transpose(self.slice_mm))


class _Beams(NamedTuple):
    """Beams of a B-scan in a lattice of voxels."""

    voxel_from_pixel: Array  # (4, 4)
    aside: Array  # (3,) voxels, a standard deviation along the array
    across: Array  # (rows, 3) voxels, a standard deviation across the plane


@dataclass(frozen=True)
class Planes:
    """B-scans in space, and how blurred they are."""

    world_from_pixel: Array  # (n, 4, 4), NaN where there is no pose
    rows: range  # that are used
    columns: int
    blur: Blur


def corrected(masses: Sequence[Mass], power: EchoPower, planes: Planes, fit: Fit) -> list[Mass]:
    """Masses without what blur and fit do to their surfaces; `power` is that in which they were found.

    Bright ones are blurred as dark ones are.
    """
    made = echoes(masses, grid_of(power.volume), planes)
    again = fit([replace(mass, bright=False) for mass in masses], EchoPower(made.volume, np.where(made.seen, power.weight, 0)))
    return [_move(*both) for both in zip(masses, again, strict=True)]


def _move(found: Mass, again: Mass) -> Mass:
    """A mass less the difference between what is found of it again and itself."""
    vertices = np.asarray(found.mesh.vertices)
    off = signed_distances(vertices, again.mesh)
    moved = trimesh.Trimesh(vertices + off[:, None] * found.mesh.vertex_normals, found.mesh.faces, process=False)
    return replace(found, mesh=moved)


def echoes(masses: Sequence[Mass], grid: Grid, planes: Planes) -> EchoPower:
    """Mean power on a grid, in B-scans of masses without echoes in tissue of power 1."""
    field, (across, down) = distances(masses, grid), pixel_mm(planes.world_from_pixel)
    slices = planes.blur.across(down * np.arange(planes.rows.stop))
    v, u = np.mgrid[planes.rows.start : planes.rows.stop, : planes.columns].astype(np.float32)
    voxel_from_world, light = np.linalg.inv(field.world_from_voxel), np.ones_like(u)

    def images() -> Iterator[Placed]:
        for matrix in planes.world_from_pixel:
            image = np.ones((planes.rows.stop, planes.columns), np.float32)
            if np.isfinite(matrix).all():
                pixels = voxel_from_world @ matrix
                aside, through = pixels[:3, 0] / across, pixels[:3, 2] / np.linalg.norm(matrix[:3, 2])
                beams = _Beams(pixels, planes.blur.lateral_mm * aside, np.outer(slices, through))
                threads.in_threads(_fill_echoes, len(image), field.voxels, beams, image)
            yield Placed(image[planes.rows.start :], light, u, v)

    return echo_power.accumulated(images(), planes.world_from_pixel, grid)


@kernel
def _fill_echoes(first, end, field, beams, image):
    """Power of each pixel in some rows: the mean of the beam's, of 0 within the masses and of 1 around them."""
    for row in range(first, end):
        for column in range(image.shape[1]):
            x, y, z = _place(beams.voxel_from_pixel, column, row)
            away = _distance(field, x, y, z)
            if away > OUTSIDE_MM:
                continue
            total = 0.0
            for i in range(3):
                for j in range(3):
                    near = _distance(
                        field,
                        x + NODES[i] * beams.aside[0] + NODES[j] * beams.across[row, 0],
                        y + NODES[i] * beams.aside[1] + NODES[j] * beams.across[row, 1],
                        z + NODES[i] * beams.aside[2] + NODES[j] * beams.across[row, 2],
                    )
                    total += SHARES[i] * SHARES[j] * 0.5 * (1 + math.erf(near / (EDGE_MM * math.sqrt(2.0))))
            image[row, column] = total


@njit(inline="always")
def _place(matrix, u, v):
    """A pixel's place, in voxels."""
    x = matrix[0, 0] * u + matrix[0, 1] * v + matrix[0, 3]
    y = matrix[1, 0] * u + matrix[1, 1] * v + matrix[1, 3]
    z = matrix[2, 0] * u + matrix[2, 1] * v + matrix[2, 3]
    return x, y, z


@njit(inline="always")
def _distance(field, x, y, z):
    """Signed distance to the masses, mm, by trilinear interpolation; far outside beyond the lattice."""
    nz, ny, nx = field.shape
    if not (0 <= x < nx - 1 and 0 <= y < ny - 1 and 0 <= z < nz - 1):
        return 2.0 * OUTSIDE_MM
    i, j, k = np.uint64(x), np.uint64(y), np.uint64(z)
    s, t, w = x - i, y - j, z - k
    one = np.uint64(1)
    near = (1 - t) * ((1 - s) * field[k, j, i] + s * field[k, j, i + one])
    near += t * ((1 - s) * field[k, j + one, i] + s * field[k, j + one, i + one])
    far = (1 - t) * ((1 - s) * field[k + one, j, i] + s * field[k + one, j, i + one])
    far += t * ((1 - s) * field[k + one, j + one, i] + s * field[k + one, j + one, i + one])
    return (1 - w) * near + w * far
