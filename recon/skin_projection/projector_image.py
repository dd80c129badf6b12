"""The projector's image that draws curves on the skin: lines of a width in mm there, hidden where the projector can't reach.

The projector is a camera run backwards, so a strip on the skin is projected into its image, lens distortion included, and filled.
Coverage is light, so the image's values are its root by the projector's gamma.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated

import cv2
import numpy as np
import trimesh
from numpy.typing import NDArray
from pydantic import Field

from recon.files import meshes
from recon.geometry.camera import Camera
from recon.skin_projection import skin_curve
from recon.skin_projection.lines_of_sight import Sight, first_hits
from recon.skin_projection.skin_curve import SkinCurve

Array = NDArray[np.float64]
Image = NDArray[np.uint8]
Length = Annotated[float, Field(ge=0.5, le=100)]
FINE = 8  # parts of a pixel along each axis, by which its coverage is counted
Lit = Mapping[str, NDArray[np.bool_]]  # whether light reaches a curve's points : (n,), by its name
MARGIN_MM = 3.0  # around the body: more than it moves by hand between two images of a projector


@dataclass(frozen=True)
class Line:
    """The look of a kind of curve on the skin."""

    width_mm: Annotated[float, Field(ge=0.1, le=20)]
    light: Annotated[float, Field(gt=0, le=1)] = 1.0  # of the projector's full light
    dash_mm: tuple[Length, Length] | None = None  # drawn and left out, in turn; None is a whole line


@dataclass(frozen=True)
class Lines:
    """The look of each kind of curve."""

    mass: Line = Line(1.0)
    cut: Line = Line(1.0, 1.0, (4.0, 2.0))
    scan: Line = Line(0.7, 0.7)
    name: Line = Line(0.5)

    def of(self, curve: SkinCurve) -> Line:
        """That of a curve."""
        return {"mass": self.mass, "cut": self.cut, "scan": self.scan, "name": self.name}[curve.kind]


USUAL = Lines()


@dataclass(frozen=True, eq=False)
class Drawing:
    """An image for a projector, and what of each curve it lights, dashes and gaps alike."""

    image: Image  # (h, w)
    lit: Lit


def draw(
    curves: Sequence[SkinCurve],
    skin: trimesh.Trimesh,
    projector: Camera,
    gamma: float = 1.0,
    lines: Lines = USUAL,
    dark: NDArray[np.bool_] | None = None,
) -> Drawing:
    """Draw curves on the skin.

    Parameters
    ----------
    gamma : float
        Of the projector: light = value ** gamma.
    dark : (h, w)
        Pixels that are to stay dark, as of `probe_shadow.shadow`.
    """
    lit = in_sight(curves, skin, projector, dark)
    light = _strips_of_light(curves, lit, projector, lines)
    if dark is not None:
        light[dark] = 0
    return Drawing(np.uint8(np.rint(255 * light ** (1 / gamma))), lit)


def in_sight(
    curves: Sequence[SkinCurve], skin: trimesh.Trimesh, device: Camera, dark: NDArray[np.bool_] | None = None
) -> dict[str, NDArray[np.bool_]]:
    """Whether a device sees each point of a curve, by the curve's name; points at dark pixels count as unseen."""
    together = np.concatenate([np.zeros((0, 3)), *(curve.points for curve in curves)])  # so that the skin is looked at once
    lit = visible(together, skin, device)
    if dark is not None:
        u, v = np.rint(device.project(together[lit])).astype(int).T
        lit[lit] = ~dark[v, u]
    parts = np.split(lit, np.cumsum([len(curve.points) for curve in curves]))  # an empty one is left
    return {curve.name: part for curve, part in zip(curves, parts, strict=False)}


def _strips_of_light(curves: Sequence[SkinCurve], lit: Lit, device: Camera, lines: Lines) -> NDArray[np.float32]:
    """Light of a device's pixels : (h, w) by what is lit of curves, of the projector's full light."""
    light = np.zeros(device.size[::-1], np.float32)
    for curve in curves:
        line, points = lines.of(curve), lit[curve.name]
        pieces = skin_curve.dashed(curve, line.dash_mm) & points[:-1] & points[1:]
        corners = quadrilaterals(curve, line.width_mm, device)
        whole = pieces & np.isfinite(corners).all(axis=(1, 2))
        np.maximum(light, line.light * coverage(corners[whole], device.size), out=light)
    return light


def lit_share(curve: SkinCurve, lit: Lit) -> float:
    """Share of a curve's points on the skin that are lit."""
    on_skin = np.isfinite(curve.points).all(axis=1)
    return float(lit[curve.name].sum() / max(on_skin.sum(), 1))


def visible(points: Array, skin: trimesh.Trimesh, device: Camera) -> NDArray[np.bool_]:
    """Whether a device's light reaches points : (n, 3) mm of the skin : (n,), within its image and past the skin itself."""
    pixels, (width, height) = device.project(points), device.size
    with np.errstate(invalid="ignore"):
        within = (pixels > -0.5).all(axis=1) & (pixels[:, 0] < width - 0.5) & (pixels[:, 1] < height - 0.5)
    sight = Sight.of_device(device)
    hits = first_hits(sight, np.where(within[:, None], sight.chart(points)[:, :2], np.nan), skin).points
    before = np.linalg.norm(points - device.centre, axis=1) - np.linalg.norm(hits - device.centre, axis=1)
    hidden_mm = 0.5  # that something stands before a point of the skin, to hide it: far above the noise of a surface
    return within & ~(before > hidden_mm)


def quadrilaterals(curve: SkinCurve, width_mm: float, device: Camera) -> Array:
    """Each piece of a curve between two points as wide as a line, in a device's image : (n - 1, 4, 2) px, NaN where broken."""
    left, right = (device.project(edge) for edge in skin_curve.edges(curve, width_mm))
    return np.stack([left[:-1], left[1:], right[1:], right[:-1]], axis=1)


def coverage(corners: Array, size: tuple[int, int]) -> NDArray[np.float32]:
    """Share of each pixel of an image of a size (width, height) that convex quadrilaterals : (n, 4, 2) px cover : (h, w)."""
    width, height = size
    result = np.zeros((height, width), np.float32)
    if not len(corners):
        return result
    low = np.clip(np.floor(corners.min(axis=(0, 1))).astype(int), 0, [width - 1, height - 1])
    high = np.clip(np.ceil(corners.max(axis=(0, 1))).astype(int), low, [width - 1, height - 1])
    columns, rows = (high - low + 1).tolist()
    fine = np.zeros((rows * FINE, columns * FINE), np.uint8)
    inner = (corners - low + 0.5) * FINE - 0.5
    shift = 4  # binary digits behind the point, of corners for OpenCV
    for corner in np.rint(inner * 2**shift).astype(np.int32):
        cv2.fillConvexPoly(fine, corner, 255, shift=shift)
    share = cv2.resize(fine, (columns, rows), interpolation=cv2.INTER_AREA)
    result[low[1] : high[1] + 1, low[0] : high[0] + 1] = share.astype(np.float32) / 255
    return result


def expected_view(curves: Sequence[SkinCurve], lit: Lit, skin: trimesh.Trimesh, camera: Camera, lines: Lines) -> Image:
    """Grey view : (h, w) of the skin's vertices, in their own grey where they carry one, and of what is lit of the curves."""
    width, height = camera.size
    view = np.zeros((height, width), np.uint8)
    pixels = np.rint(camera.project(np.asarray(skin.vertices)))
    within = ((pixels >= 0) & (pixels < [width, height])).all(axis=1)
    u, v = pixels[within].astype(int).T
    greys = meshes.greys_of(skin)
    dimmed = 0.5  # of the skin's grey, so that lines stand out
    plain = 128  # grey of a skin that carries none
    view[v, u] = dimmed * (plain if greys is None else greys[within])
    filled = np.where(view == 0, cv2.dilate(view, np.ones((3, 3), np.uint8)), view)  # between vertices that are farther apart
    seen = in_sight(curves, skin, camera)
    both = {name: points & seen[name] for name, points in lit.items()}
    drawn = _strips_of_light(curves, both, camera, lines)
    return np.maximum(filled, np.uint8(np.rint(255 * drawn)))


def probe_shadow(body: trimesh.Trimesh, projector: Camera, margin_mm: float = MARGIN_MM) -> NDArray[np.bool_]:
    """Whether pixels : (h, w) of a projector see a body, such as `recon.fusion.probe_shape.of` moved by its pose, or its margin.

    Left dark, no line climbs over the probe, where it would mislead, and none crosses the target's circles, which the cameras
    track. A body that is partly behind the projector hides what its triangles before it hide.
    """
    width, height = projector.size
    covered, vertices = np.zeros((height, width), np.uint8), np.asarray(body.vertices)
    corners = projector.project(vertices)[body.faces]
    near = np.abs(corners).max(axis=(1, 2)) < 8 * max(width, height)  # farther ones would overflow, and false if not finite
    for corner in np.rint(corners[near]).astype(np.int32):
        cv2.fillConvexPoly(covered, corner, 1)
    distance = float(np.median(np.linalg.norm(vertices - projector.centre, axis=1)))
    reach = int(np.ceil(margin_mm * projector.matrix[0, 0] / distance))
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1))
    return cv2.dilate(covered, disc).astype(bool)
