"""The outline of a mass on the skin: where the lines of sight that touch the mass come through the skin.

The lines are parallel, along the skin's normal over the mass, or those of the surgeon's eye. Where they meet the mass is sampled
on a fine grid of the chart, and the border of that region, smoothed by a cell or two, is the outline: so masses of any shape
have one, lobes and hollows included.
"""

from collections.abc import Mapping

import numpy as np
import trimesh
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import gaussian_filter
from skimage.measure import find_contours

from recon.errors import InputError
from recon.skin_projection import skin_curve
from recon.skin_projection.lines_of_sight import Sight, covered
from recon.skin_projection.skin_curve import SkinCurve

Array = NDArray[np.float64]


def outlines(
    masses: Mapping[str, trimesh.Trimesh], skin: trimesh.Trimesh, eye_mm: ArrayLike | None = None
) -> dict[str, SkinCurve]:
    """Outlines of masses by name, as seen from the surgeon's eye : (3,) mm, or each along the skin's normal over it without.

    Raises
    ------
    InputError
        If no line of sight of a mass meets the skin.
    """
    return {name: on_skin(name, mass, skin, sight_of(mass.vertices, skin, eye_mm)) for name, mass in masses.items()}


def on_skin(name: str, mass: trimesh.Trimesh, skin: trimesh.Trimesh, sight: Sight) -> SkinCurve:
    """The outline of a mass on the skin, closed, broken where the skin has holes; raises InputError as `outlines`."""
    curve = skin_curve.laid(name, "mass", outline(mass, sight), sight, skin)
    if curve.on_skin == 0:
        raise InputError(f"{name}: expected skin over it, found none on any line of sight: is it of another session?")
    return curve


def sight_of(points: ArrayLike, skin: trimesh.Trimesh, eye_mm: ArrayLike | None = None) -> Sight:
    """Lines of sight to points : (n, 3) mm under the skin: from an eye : (3,) mm, or along the skin's normal over them.

    Raises
    ------
    InputError
        If the eye is on the other side of the skin.
    """
    points = np.asarray(points, float)
    middle, normal = (points.min(axis=0) + points.max(axis=0)) / 2, normal_over(points, skin)
    if eye_mm is None:
        return Sight.along(-normal, middle)
    eye = np.asarray(eye_mm, float)
    if (eye - middle) @ normal <= 0:
        raise InputError(f"eye_mm: expected a place before the skin, found {eye.tolist()} behind it; z grows away from camera 1")
    return Sight.from_eye(eye, middle)


def normal_over(points: ArrayLike, skin: trimesh.Trimesh) -> Array:
    """The skin's normal over points : (n, 3) mm, towards camera 1 : (3,), the mean of a patch as broad as they are.

    Of a patch rather than of a place, so that a nipple or the skin's relief doesn't turn it. The patch lies about the line from
    the points' middle along the normal, which is sought from the skin's nearest place on.
    """
    points = np.asarray(points, float)
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    away = np.asarray(skin.vertices) - middle
    distance = np.sqrt(np.einsum("ij,ij->i", away, away))
    nearest = float(distance.min())
    reach = max(float(np.linalg.norm(points - middle, axis=1).max()), nearest / 2)
    around = np.flatnonzero(distance <= nearest + 2 * reach)
    away, normals = away[around], np.asarray(skin.vertex_normals)[around]
    behind = np.einsum("ij,ij->i", away + middle, normals) > 0  # as the winding of another program may have them
    normals = np.where(behind[:, None], -normals, normals)
    normal = normals[distance[around].argmin()]
    patches = 4  # of skin, each about the normal of the one before
    for _ in range(patches):
        height = away @ normal
        patch = (height > -reach) & (np.linalg.norm(away - height[:, None] * normal, axis=1) <= reach)
        if not patch.any():  # no skin over them: what is nearest will do
            break
        total = normals[patch].sum(axis=0)
        normal = total / np.linalg.norm(total)
    return normal


def outline(mass: trimesh.Trimesh, sight: Sight) -> Array:
    """The outer border of a mass on the chart : (n, 2) mm, closed, its last place the first, at even distances.

    Raises
    ------
    InputError
        If the mass is too thin to be seen.
    """
    places = sight.chart(mass.vertices)[:, :2]
    low, high = places.min(axis=0), places.max(axis=0)
    finest_mm = 0.05  # of the grid
    most_cells = 600  # of it along an axis, for large masses
    pitch = max(finest_mm, float((high - low).max()) / most_cells)
    margin = 8  # cells around
    columns, rows = (np.ceil((high - low) / pitch).astype(int) + 1 + 2 * margin).tolist()
    first = low - margin * pitch
    grid = first + pitch * np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=-1).reshape(-1, 2)
    region = covered(sight, grid, mass).reshape(rows, columns)
    smoothing = 1.5  # cells; moves a border of radius r inwards by (1.5 * 0.05 mm)^2 / 2r, 0.001 mm at 3 mm
    borders = find_contours(gaussian_filter(region.astype(np.float32), smoothing), 0.5)
    if not borders:
        raise InputError(f"masses: expected closed bodies, found one of {(high - low).max():.2g} mm that no line of sight meets")
    outer = max(borders, key=lambda border: abs(_area(border)))
    return skin_curve.evenly(first + pitch * outer[:, ::-1])


def _area(border: Array) -> float:
    """Area within a closed border : (n, 2), its sign that of its sense."""
    y, x = border.T
    return float((x[:-1] * y[1:] - x[1:] * y[:-1]).sum() / 2)
