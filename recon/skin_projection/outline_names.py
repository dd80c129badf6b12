"""Names of masses on the skin, each beside its outline: letters as curves, so that whoever looks sees them as they lie there.

They stand upright for whoever stands as camera 1 does. A name keeps off all curves, and is left out where there is no room for
it on the skin, or where the light would not reach all of it: half a name is another one.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
import trimesh
from matplotlib.font_manager import FontProperties
from matplotlib.path import Path
from matplotlib.textpath import text_to_path
from numpy.typing import ArrayLike, NDArray

from recon.skin_projection import mass_outline, skin_curve
from recon.skin_projection.lines_of_sight import Sight
from recon.skin_projection.skin_curve import SkinCurve

Array = NDArray[np.float64]

FONT = FontProperties("DejaVu Sans")  # which comes with matplotlib, so that a name looks alike everywhere
GAP = 0.5  # between a name and any curve, of the capitals' height
FARTHER = (1.0, 2.5, 4.0)  # gaps from the outline that are tried, as multiples of that
ROUND = np.array([[0, -1], [0, 1], [1, 0], [-1, 0], [1, -1], [-1, -1], [1, 1], [-1, 1]])  # sides, over the outline first


class _Table(NamedTuple):
    """Places about a mass, to the right and down as camera 1 sees them, in mm on the skin."""

    chart_from_table: Array  # (3, 3), of (right, down, 1) to places on the chart

    def chart(self, places: Array) -> Array:
        """Places : (..., 2) on the chart."""
        return places @ self.chart_from_table[:2, :2].T + self.chart_from_table[:2, 2]

    def table(self, charted: Array) -> Array:
        """Places : (n, 2) of those on the chart."""
        return (charted - self.chart_from_table[:2, 2]) @ np.linalg.inv(self.chart_from_table[:2, :2]).T


def beside(
    curves: Sequence[SkinCurve],
    masses: Mapping[str, trimesh.Trimesh],
    skin: trimesh.Trimesh,
    eye_mm: ArrayLike | None,
    height_mm: float,
    reached: Callable[[SkinCurve], bool],
) -> list[SkinCurve]:
    """Names of the masses that have an outline among the curves.

    Parameters
    ----------
    eye_mm : (3,) mm of the surgeon's eye, or None, as for the outlines
    height_mm : of capitals
    reached : whether all of a name is lit
    """
    names: list[SkinCurve] = []
    for curve in curves:
        if curve.kind == "mass":
            sight = mass_outline.sight_of(masses[curve.name].vertices, skin, eye_mm)
            tried = _tried(curve, [*curves, *names], sight, skin, height_mm)
            names += [name for name in [next(filter(reached, tried), None)] if name is not None]
    return names


def title(mass: str) -> str:
    """What the curve of a mass's name is called."""
    return f"name of {mass}"


def letters(name: str, height_mm: float) -> list[Array]:
    """Closed contours : (n, 2) mm, to the right and down, of a name about its middle, with capitals of a height."""
    capital = 0.729  # height of the font's capitals, of its size
    scale = height_mm / capital / text_to_path.FONT_SCALE
    path = Path(*text_to_path.get_text_path(FONT, name))
    contours = [scale * polygon * [1, -1] for polygon in path.to_polygons()]
    if not contours:
        return []
    together = np.concatenate(contours)
    middle = (together.min(axis=0) + together.max(axis=0)) / 2
    return [skin_curve.evenly(contour - middle) for contour in contours]


def _tried(
    curve: SkinCurve, others: Sequence[SkinCurve], sight: Sight, skin: trimesh.Trimesh, height_mm: float
) -> Iterator[SkinCurve]:
    """A name in each place about its outline that is free of curves and wholly on the skin, the best place first."""
    contours = letters(curve.name, height_mm)
    if not contours:
        return
    table, half, gap = _table(curve, sight), np.concatenate(contours).max(axis=0), GAP * height_mm
    outline = table.table(sight.chart(_known(curve))[:, :2])
    low, high = outline.min(axis=0), outline.max(axis=0)
    drawn = table.table(sight.chart(np.concatenate([_known(other) for other in others]))[:, :2])
    for farther in FARTHER:
        for side in ROUND:
            place = (low + high) / 2 + side * ((high - low) / 2 + half + farther * gap)
            if (np.abs(drawn - place) > half + 0.9 * gap).any(axis=1).all():
                chain = np.concatenate([part for contour in contours for part in (contour + place, [[np.nan, np.nan]])])
                laid = skin_curve.laid(title(curve.name), "name", table.chart(chain), sight, skin)
                if np.array_equal(np.isfinite(laid.points[:, 0]), np.isfinite(chain[:, 0])):
                    yield laid


def _known(curve: SkinCurve) -> Array:
    return curve.points[np.isfinite(curve.points).all(axis=1)]


def _table(curve: SkinCurve, sight: Sight) -> _Table:
    """The table about a curve's middle, upright as the world is: x to the right, y down."""
    middle = _known(curve).mean(axis=0)
    start = sight.chart(middle)
    step = np.linalg.norm(sight.world(start + np.eye(3)[:2]) - middle, axis=1).mean()  # mm of a step on the chart
    across, down = (sight.chart(middle + axis)[:2] - start[:2] for axis in np.eye(3)[:2])
    right = across / np.linalg.norm(across)
    turned = np.array([-right[1], right[0]])
    upright = turned if turned @ down > 0 else -turned
    return _Table(np.column_stack([np.append(right, 0) / step, np.append(upright, 0) / step, np.append(start[:2], 1)]))
