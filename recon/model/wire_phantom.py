"""A phantom of N-wires: rows of two parallel wires with a third across from one to the other, all rows parallel.

An image plane meets the wires of a row in three dots on one line. The place of the middle one between the others is that of its
wire's crossing between the sides, whatever the image's scale: so each row gives a point of the phantom by one B-scan.

Source: Comeau et al. 1998; Chen et al. 2009, Ultrasound in Medicine and Biology 35(12) 2079.
"""

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from recon import arguments

Array = NDArray[np.float64]

LIKE_DEG = 3.0  # between wires, or rows, that count as parallel: holes of printed phantoms lie to 0.2 mm
DIAGONAL_DEG = 5.0  # least angle of a diagonal with its sides
ROW_MM = 1.0  # most distance of a diagonal's ends from the plane of its sides
MOST_ROWS = 8
LENGTHS = (5.0, 500.0)  # mm, of a wire, and of a row's width
FCAL_2 = (  # mm, front and back of each wire: the fCal 2.x phantom of PLUS with three N-wires
    (((30, 0, 20), (30, 40, 20)), ((55, 0, 20), (35, 40, 20)), ((60, 0, 20), (60, 40, 20))),
    (((30, 0, 10), (30, 40, 10)), ((35, 0, 10), (55, 40, 10)), ((60, 0, 10), (60, 40, 10))),
    (((35, 0, 0), (35, 40, 0)), ((55, 0, 0), (40, 40, 0)), ((60, 0, 0), (60, 40, 0))),
)


@dataclass(frozen=True)
class WirePhantom:
    """The wires of p rows in the phantom's frame."""

    ends: Array  # (p, 3, 2, 3) mm: a side, the diagonal, the other side; front and back
    names: tuple[str, ...] = ()  # (3 p,)
    along: Array = field(init=False)  # (3,) of the sides, front to back
    across: Array = field(init=False)  # (2, 3) orthonormal: of the rows, and between them

    def __post_init__(self) -> None:
        ends = np.asarray(arguments.numbers("wires", self.ends, ("p", 3, 2, 3)), float)
        count = len(ends)
        if not 1 <= count <= MOST_ROWS:
            raise ValueError(f"expected 1 to {MOST_ROWS} N-wires, found {count}")
        names = self.names or tuple(f"{row + 1}{side}" for row in range(count) for side in ("a", "b", "c"))
        object.__setattr__(self, "ends", ends)
        object.__setattr__(self, "names", names)
        lines = ends[:, :, 1] - ends[:, :, 0]
        lengths = np.linalg.norm(lines, axis=-1)
        self._refuse(lengths, f"a wire of {LENGTHS[0]:g} to {LENGTHS[1]:g} mm", "{:.4g} mm: another unit?", *LENGTHS)
        units = lines / lengths[..., None]
        along = units[0, 0]
        sine = np.linalg.norm(np.cross(units, along), axis=-1)
        angles = np.degrees(np.arctan2(sine, units @ along))
        self._refuse(angles[:, ::2], "both sides of all N-wires parallel, front to back", "{:.3g} deg between them", 0, LIKE_DEG)
        tilts = np.degrees(np.arcsin(np.minimum(sine, 1)))
        self._refuse(tilts[:, 1:2], "the diagonal second of three wires", "one along the sides", DIAGONAL_DEG, 90)
        widths = ends[:, 2, 0] - ends[:, 0, 0]
        widths -= (widths @ along)[:, None] * along
        self._refuse(np.linalg.norm(widths, axis=1), f"rows {LENGTHS[0]:g} mm wide or more", "{:.3g} mm", *LENGTHS)
        row = widths[0] / np.linalg.norm(widths[0])
        turned = np.degrees(np.arccos(np.clip(np.abs(widths @ row) / np.linalg.norm(widths, axis=1), 0, 1)))
        self._refuse(turned, "all rows parallel", "{:.3g} deg between them", 0, LIKE_DEG)
        object.__setattr__(self, "along", along)
        object.__setattr__(self, "across", np.stack([row, np.cross(along, row)]))
        off = np.abs((ends[:, 1] - ends[:, :1, 0]) @ self.across[1])
        self._refuse(off, "the diagonal in the plane of its sides", "{:.3g} mm beside it", 0, ROW_MM)
        _refuse_one_depth(self.sections[:, 0, 1])

    def _refuse(self, values: Array, expected: str, found: str, least: float, most: float) -> None:
        """Refuse values : (p, ...) out of limits, naming the first row with one."""
        wrong = ~((values >= least) & (values <= most)).reshape(len(values), -1)
        if wrong.any():
            row = int(wrong.any(axis=1).argmax())
            value = values.reshape(len(values), -1)[row][wrong[row]][0]
            raise ValueError(
                f"N-wire {row + 1} ({', '.join(self.row_names(row))}): expected {expected}, found {found.format(value)}"
            )

    def row_names(self, row: int) -> tuple[str, ...]:
        """Names of a row's three wires."""
        return self.names[3 * row : 3 * row + 3]

    @property
    def count(self) -> int:
        """Number of wires."""
        return 3 * len(self.ends)

    @property
    def points(self) -> Array:
        """A point : (3 p, 3) mm of each wire, its front."""
        return self.ends[:, :, 0].reshape(-1, 3)

    @property
    def directions(self) -> Array:
        """Unit vectors : (3 p, 3) along the wires."""
        lines = (self.ends[:, :, 1] - self.ends[:, :, 0]).reshape(-1, 3)
        return lines / np.linalg.norm(lines, axis=1, keepdims=True)

    @cached_property
    def normals(self) -> Array:
        """Orthonormal vectors : (3 p, 2, 3) across each wire."""
        least = np.eye(3)[np.abs(self.directions).argmin(axis=1)]
        first = np.cross(self.directions, least)
        first /= np.linalg.norm(first, axis=1, keepdims=True)
        return np.stack([first, np.cross(self.directions, first)], axis=1)

    @property
    def sections(self) -> Array:
        """Places : (p, 2, 2) mm of the sides, in a plane across them: along the row, and between rows."""
        return self.ends[:, ::2].mean(axis=2) @ self.across.T

    def on_diagonals(self, shares: Array) -> Array:
        """Points : (..., p, 3) mm of the diagonals that lie at shares : (..., p) of the way from the first side to the other."""
        begin, end = self.ends[:, 1, 0], self.ends[:, 1, 1]
        at_front, at_back = self.shares_of_ends().T
        return begin + ((shares - at_front) / (at_back - at_front))[..., None] * (end - begin)

    def restrung(self, rows: list[int]) -> "WirePhantom":
        """The same with the diagonals of some rows the other way: front and back exchange their places in the row."""
        ends = self.ends.copy()
        shift = ((ends[rows, 1, 1] - ends[rows, 1, 0]) @ self.along)[:, None] * self.along
        ends[rows, 1] = np.stack([ends[rows, 1, 1] - shift, ends[rows, 1, 0] + shift], axis=1)
        return replace(self, ends=ends)

    def shares_of_ends(self) -> Array:
        """Shares : (p, 2) of the way between the sides, at which the diagonals have their ends."""
        first = self.ends[:, :1, 0]
        reach = (self.ends[:, 2, 0] - self.ends[:, 0, 0]) @ self.across[0]
        return (self.ends[:, 1] - first) @ self.across[0] / reach[:, None]


def _refuse_one_depth(depths: Array) -> None:
    apart = np.abs(depths[:, None] - depths)[np.triu_indices(len(depths), 1)]
    if (apart < 1).any():
        raise ValueError("expected N-wires one above the other, found two at one depth")
