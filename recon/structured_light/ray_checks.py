"""Checks that camera, projector and decoded columns make one scene: images of another rig, mirrored or turned ones don't.

A mirrored sequence decodes perfectly. But what both devices see, both see from its front; its points lie in front of both and in
the projector's image. Where both columns and rows are known, `triangulate` itself refuses rays that don't meet. Images upside
down of columns alone pass all that; a second camera shows them, as it sees other columns where the points would lie.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from recon.errors import Implausible, refuse_or_warn
from recon.geometry import rigid
from recon.geometry.camera import Camera
from recon.structured_light.decode import ProjectorMap
from recon.structured_light.triangulate import PointMap

Array = NDArray[np.float64]


@dataclass(frozen=True)
class RayLimits:
    """Shares of the points beyond which a scene is none. Of right captures all are below 0.01."""

    behind: float = 0.5  # lit from behind; mirrored left to right it is 1
    nowhere: float = 0.1  # rays that don't meet in front of both devices
    beyond: float = 0.1  # of points by columns alone, in rows that the projector doesn't have
    margin: float = 0.05  # of the projector's image, that its model may be off at the borders
    reach: int = 8  # px between the points of a normal, so that noise doesn't turn it
    apart_px: float = 10.0  # projector px, between what two cameras see of a point; a device that moved: some px
    apart: float = 0.3  # share of such points; by what hides points from one of them it is 0.07 of two objects, upside down 0.5
    every: int = 4  # rows and columns, of which one is looked at
    fewest: int = 200  # points that decide


LIMITS = RayLimits()


def check(
    found: ProjectorMap,
    raw: PointMap,
    camera: Camera,
    projector: Camera,
    name: str,
    implausible: Implausible = "refuse",
    limits: RayLimits = LIMITS,
) -> None:
    """Refuse a map whose rays make no scene that camera and projector both see, or warn of it where it is to be taken.

    Parameters
    ----------
    found : ProjectorMap
    raw : PointMap
        Its points, not cleaned.
    name : str
        Of the images, for messages.

    Raises
    ------
    InputError
        If more points than `limits` allow are lit from behind, lie behind a device, or outside of the projector's image.
    """
    if seen := _fault(found, raw, camera, projector, limits):
        refuse_or_warn(name, seen, implausible)


def check_beside(
    found: ProjectorMap,
    raw: PointMap,
    other: ProjectorMap,
    beside: Camera,
    name: str,
    implausible: Implausible = "refuse",
    limits: RayLimits = LIMITS,
) -> float:
    """Refuse a map whose points lie where a second camera sees other columns, or rows, or warn of it where it is to be taken.

    Of points that turn their backs to the second camera it sees what hides them.

    Parameters
    ----------
    found, raw : ProjectorMap, PointMap
        Of the first camera; points not cleaned.
    other : ProjectorMap
        Of the second camera `beside`.
    name : str
        Of the images, for messages.

    Returns
    -------
    Share of the points in which both agree, of those that both see; NaN of few.

    Raises
    ------
    InputError
        If more points than `limits` allow contradict each other.
    """
    first, second = (m.rows if found.columns is None or other.columns is None else m.columns for m in (found, other))
    if first is None or second is None:
        return np.nan
    points, normals = _normals(raw, limits)
    expected = first[:: limits.every, :: limits.every][: points.shape[0], : points.shape[1]]
    facing = (np.sum(normals * (beside.centre - points), axis=-1) > 0) & np.isfinite(expected)
    points, expected = points[facing], expected[facing]
    with np.errstate(all="ignore"):
        pixels = beside.project(points)
    height, width = second.shape
    inside = (pixels > -0.5).all(axis=1) & (pixels < [width - 0.5, height - 0.5]).all(axis=1)
    inside &= rigid.apply(beside.camera_from_world, points)[:, 2] > 0
    u, v = np.rint(pixels[inside]).astype(int).T
    apart = np.abs(second[v, u] - expected[inside])
    apart = apart[np.isfinite(apart)]
    if apart.size < limits.fewest:
        return np.nan
    share = float(np.mean(apart > limits.apart_px))
    if share > limits.apart:
        where = f"where {beside.name or 'the other camera'} sees the projector's image more than {limits.apart_px:g} px off"
        cause = "are the images of either camera upside down, or of another scene, or did one of them move?"
        refuse_or_warn(name, f"{100 * share:.0f} % of the points lie {where}: {cause}", implausible)
    return 1 - share


def _fault(found: ProjectorMap, raw: PointMap, camera: Camera, projector: Camera, limits: RayLimits) -> str | None:
    """The first thing that no scene shows to both devices, with its likely cause; None as a rule, and of few pixels."""
    axes = [axis for axis in (found.columns, found.rows) if axis is not None]
    decoded, solved = np.isfinite(np.stack(axes)).any(axis=0), np.isfinite(raw.points[..., 0])
    if np.count_nonzero(decoded) < limits.fewest * limits.every**2:
        return None
    if (share := _lit_from_behind(raw, camera, projector, limits)) > limits.behind:
        return (
            f"the projector would light the back of what the camera sees in {100 * share:.0f} % of the points: are the "
            "camera's images mirrored or turned by 180 degrees, the patterns projected mirrored, or is it another calibration?"
        )
    lost = 1 - np.count_nonzero(decoded & solved) / np.count_nonzero(decoded)
    if lost > limits.nowhere:
        return (
            f"rays of camera and projector don't meet in front of both in {100 * lost:.0f} % of the decoded pixels: is "
            "the calibration that of this rig, are images and patterns those of this capture, and neither mirrored nor turned?"
        )
    if found.columns is not None and found.rows is not None:  # `triangulate` refuses rays that pass each other
        return None
    thin = np.s_[:: limits.every, :: limits.every]
    seen = projector.project(raw.points[thin][solved[thin]].astype(float))
    other, name_of = (1, "rows") if found.rows is None else (0, "columns")
    length = projector.size[other]
    beyond = np.mean((seen[:, other] < -limits.margin * length) | (seen[:, other] > (1 + limits.margin) * length))
    if beyond > limits.beyond:
        return (
            f"{100 * beyond:.0f} % of the points lie where the projector has no {name_of} to light them: is the "
            "calibration that of this rig, and are images and patterns those of this capture?"
        )
    return None


def _lit_from_behind(raw: PointMap, camera: Camera, projector: Camera, limits: RayLimits) -> float:
    """Share of the points whose surface faces one device and turns its back to the other; 0 of too few."""
    points, normals = _normals(raw, limits)
    facing = [np.sum(normals * (device.centre - points), axis=-1) for device in (camera, projector)]
    known = np.isfinite(facing[0])
    return float(np.mean((facing[0] * facing[1])[known] < 0)) if np.count_nonzero(known) >= limits.fewest else 0.0


def _normals(raw: PointMap, limits: RayLimits) -> tuple[Array, Array]:
    """Every so many points, and normals that face the camera, of any length : (h, w, 3) each; NaN where unknown."""
    points, reach = raw.points, limits.reach
    corner = points[: -reach : limits.every, : -reach : limits.every].astype(float)
    across = points[: -reach : limits.every, reach :: limits.every][: len(corner), : corner.shape[1]] - corner
    down = points[reach :: limits.every, : -reach : limits.every][: len(corner), : corner.shape[1]] - corner
    return corner, np.cross(down, across)
