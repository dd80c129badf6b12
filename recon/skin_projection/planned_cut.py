"""A planned cut, drawn by a surgeon as a curve in 3D Slicer, on the skin.

The curve is laid on the skin as masses are: along the skin's normal over it, or along the surgeon's view.
"""

from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import trimesh
from numpy.typing import ArrayLike, NDArray
from pydantic import BaseModel, Field
from scipy.interpolate import CubicSpline

from recon.errors import InputError, validated
from recon.files import json_text
from recon.skin_projection import skin_curve
from recon.skin_projection.mass_outline import sight_of
from recon.skin_projection.skin_curve import SkinCurve

Array = NDArray[np.float64]

LPS_FROM = {"LPS": np.ones(3), "RAS": np.array([-1.0, -1.0, 1.0])}
Coordinate = Annotated[float, Field(ge=-1e4, le=1e4)]  # mm: nothing of the rig is farther away than ten metres


class ControlPoint(BaseModel):
    """A control point of 3D Slicer's markups; other keys don't matter here."""

    position: tuple[Coordinate, Coordinate, Coordinate]
    positionStatus: str = "defined"


class Markup(BaseModel):
    """A curve or line of 3D Slicer's markups."""

    type: Literal["Line", "Curve", "ClosedCurve"]
    coordinateSystem: Literal["LPS", "RAS"] = "LPS"
    coordinateUnits: Literal["mm"] = "mm"
    controlPoints: list[ControlPoint] = Field(min_length=2, max_length=10_000)


class _Markups(BaseModel):
    """A file of 3D Slicer's markups."""

    markups: list[Markup] = Field(min_length=1, max_length=100)


def read(path: Path) -> list[Array]:
    """Curves of a file of 3D Slicer's markups, `.mrk.json`, as chains of points : (n, 3) mm in the world.

    The world is what 3D Slicer has as LPS, as in all files that this software writes for it. Curves are splines through their
    control points, lines are straight.

    Raises
    ------
    InputError
        If the file is missing, damaged or of something else, or a curve has two points in the same place.
    """
    content = validated(_Markups, json_text.read(path, "a curve of 3D Slicer, .mrk.json"), path)
    chains = []
    least_mm = 1e-3  # between two control points; nearer ones are one
    for number, markup in enumerate(content.markups):
        defined = [point.position for point in markup.controlPoints if point.positionStatus == "defined"]
        points = LPS_FROM[markup.coordinateSystem] * np.reshape(defined, (-1, 3))
        if markup.type == "ClosedCurve":
            points = np.concatenate([points, points[:1]])
        if len(points) < 2 or not np.linalg.norm(np.diff(points, axis=0), axis=1).min() > least_mm:
            raise InputError(f"{path}: markups.{number}: expected control points in two places or more, found some in one place")
        chains.append(points if markup.type == "Line" else _spline(points, markup.type == "ClosedCurve"))
    return chains


def on_skin(name: str, chain: ArrayLike, skin: trimesh.Trimesh, eye_mm: ArrayLike | None = None) -> SkinCurve:
    """A cut's chain of points : (n, 3) mm, on the skin or near it, laid on the skin.

    Raises
    ------
    InputError
        If there is no skin under it.
    """
    chain = skin_curve.evenly(chain)
    sight = sight_of(chain, skin, eye_mm)
    curve = skin_curve.laid(name, "cut", sight.chart(chain)[:, :2], sight, skin)
    if curve.on_skin == 0:
        raise InputError(f"{name}: expected skin under it, found none: was it drawn in another session, or in RAS?")
    return curve


def _spline(points: Array, closed: bool) -> Array:
    """A cubic spline over the chords' lengths through points : (n, 3)."""
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    spline = CubicSpline(along, points, bc_type="periodic" if closed else "natural")
    fine = 20  # points of a spline from one control point to the next
    return spline(np.interp(np.arange((len(points) - 1) * fine + 1) / fine, np.arange(len(points)), along))
