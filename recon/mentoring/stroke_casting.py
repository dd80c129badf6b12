"""Strokes and texts of camera 1's picture, cast along its rays onto the skin as it stood in that picture."""

import numpy as np
import trimesh
from numpy.typing import ArrayLike, NDArray

from recon.errors import InputError
from recon.geometry.camera import Camera
from recon.mentoring.posts import Stroke, Text
from recon.skin_projection import outline_names, skin_curve
from recon.skin_projection.lines_of_sight import NOWHERE, Sight, first_hits
from recon.skin_projection.projector_image import Line
from recon.skin_projection.skin_curve import SkinCurve

Array = NDArray[np.float64]

STEP_MM = 0.5  # between points of a drawing
MOST_POINTS = 20_000  # of all drawings together, 10 m of lines: the projector's picture then takes some 40 ms of a core
DASH_MM = (4.0, 3.0)  # drawn and left out
LETTERS_MM = 0.7  # width of letters' lines
DOT_PX = 0.5  # to each side of a tap, which is a stroke too


def cast(name: str, drawn: Stroke | Text, camera: Camera, skin: trimesh.Trimesh) -> SkinCurve:
    """A drawing on the skin.

    Parameters
    ----------
    camera : camera 1 in the skin's frame, where it stood when the picture was taken

    Raises
    ------
    InputError
        If there is no skin under it, or it is too long.
    """
    pixels = np.reshape(drawn.places if isinstance(drawn, Stroke) else [drawn.at], (-1, 2))
    if isinstance(drawn, Stroke) and len(np.unique(pixels, axis=0)) == 1:
        pixels = pixels[0] + DOT_PX * np.array([[-1.0, 0], [1, 0]])
    if not (np.abs(pixels - (np.array(camera.size) - 1) / 2) <= np.array(camera.size) / 2).all():
        raise InputError(
            f"{drawn.kind}: expected places in the picture of {camera.size[0]}x{camera.size[1]} px, found some beside it"
        )
    sight = _sight(camera, pixels, skin)
    places = _places(camera, pixels, sight)
    if isinstance(drawn, Stroke):
        length_mm = float(np.linalg.norm(np.diff(places, axis=0), axis=1).sum())
        _check_count(length_mm / STEP_MM)
        chain = skin_curve.evenly(places, STEP_MM)
    else:
        chain = _letters(drawn, camera, pixels[0], places[0], sight)
        _check_count(len(chain))
    curve = skin_curve.laid(name, "stroke" if isinstance(drawn, Stroke) else "name", chain, sight, skin)
    if curve.on_skin == 0:
        raise InputError(f"{drawn.kind}: expected skin under it, found none")
    return curve


def look(drawn: Stroke | Text) -> Line:
    """How a drawing is lit."""
    if isinstance(drawn, Text):
        return Line(LETTERS_MM)
    return Line(drawn.width_mm, 1.0, DASH_MM if drawn.dashed else None)


def seen(curve: SkinCurve, camera: Camera) -> list[Array]:
    """Pieces : (n, 2) px of a curve in a camera's image, whether something stands before it or not."""
    pixels = camera.project(curve.points)
    known = np.isfinite(pixels).all(axis=1)
    runs = np.split(np.arange(len(pixels)), np.flatnonzero(np.diff(known)) + 1)
    return [pixels[run] for run in runs if len(run) > 1 and known[run[0]]]


def _sight(camera: Camera, pixels: Array, skin: trimesh.Trimesh) -> Sight:
    """Camera 1's rays, their chart in mm at the skin where the drawing's middle ray meets it."""
    device = Sight.of_device(camera)
    hits = first_hits(device, camera.undistort(pixels), skin)
    if (hits.faces == NOWHERE).all():
        raise InputError("expected the drawing on the skin, found none of it there")
    points = hits.points[hits.faces != NOWHERE]
    towards = points[np.argmin(np.linalg.norm(points - np.median(points, axis=0), axis=1))]
    return Sight.from_eye(camera.centre, towards)


def _places(camera: Camera, pixels: ArrayLike, sight: Sight) -> Array:
    """Places : (n, 2) mm on the chart of camera 1's pixels."""
    return sight.chart(camera.centre + camera.rays(pixels))[..., :2]


def _letters(drawn: Text, camera: Camera, pixel: Array, place: Array, sight: Sight) -> Array:
    """Contours : (n, 2) mm on the chart of a text that begins at a pixel, level as camera 1 sees it, with gaps of NaN."""
    right, down = _places(camera, pixel + np.eye(2), sight) - place
    right, down = right / np.linalg.norm(right), down / np.linalg.norm(down)
    contours = outline_names.letters(drawn.text, drawn.height_mm)
    if not contours:
        raise InputError("text: expected letters, found none that can be drawn")
    left = np.concatenate(contours)[:, 0].min()
    moved = [(contour - [left, 0.0]) @ np.array([right, down]) + place for contour in contours]
    return np.concatenate([part for contour in moved for part in (contour, [[np.nan, np.nan]])])


def _check_count(count: float) -> None:
    if count > MOST_POINTS:
        raise InputError(
            f"expected a drawing of up to {MOST_POINTS * STEP_MM / 1000:g} m of lines, found {count * STEP_MM / 1000:.3g} m"
        )
