"""Places of the artefacts in the measuring volume, as an acceptance test asks for, and whether a test keeps to them.

VDI/VDE 2634-2 asks for a sphere in ten places, a ball bar in seven and a plane in six, spread over the volume. The guideline
isn't public, and shows arrangements as examples; these are ours: the sphere in the middle of all octants and of front and back,
the bar along the four space diagonals and along width, height and the front's diagonal, the plane near, in the middle and far,
upright and tilted about both axes.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from recon.acceptance.certificates import Artefacts, Volume

Array = NDArray[np.float64]

LEAST = {"sphere": 10, "bar": 7, "plane": 6}  # places
SPHERE, BAR, BALLS, PLATE = (0.02, 0.2), 0.3, (0.02, 0.2), 0.5  # of L0: diameters; the bar's and the plate's least length
PLATE_WIDTH_MM = 50.0
TILT_DEG = 15.0  # of the plane
SPREAD = 0.5  # of the volume's depth, over which places of an artefact are spread at least


class Demand(NamedTuple):
    """One demand on the arrangement."""

    words: str
    found: str
    met: bool


def spheres(volume: Volume, diameter_mm: float) -> Array:
    """Centres : (10, 3) mm of the sphere."""
    signs = np.array([(x, y, z) for z in (-1, 1) for y in (-1, 1) for x in (-1, 1)]) / 2
    places = np.concatenate([signs, [[0, 0, -1], [0, 0, 1]]])
    return np.array(volume.centre_mm) + places * (np.array(volume.size_mm) - diameter_mm) / 2


def bars(volume: Volume, length_mm: float, ball_mm: float) -> tuple[Array, Array]:
    """Middles : (7, 3) mm of the bar, and its directions : (7, 3), as far as balls stay in the volume's depth."""
    width, height, depth = volume.size_mm
    rise = min(depth, max(depth - ball_mm, 0.0) * volume.diagonal_mm / length_mm)  # of a diagonal that is as steep as fits
    corners = [(width, side * height, slope * rise) for side in (1, -1) for slope in (1, -1)]
    along = np.array([*corners, (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (width, height, 0.0)])
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    room = np.maximum(np.array(volume.size_mm) - np.abs(along) * length_mm - ball_mm, 0) / 2
    aside = np.array([(0, 0, 0)] * 4 + [(0, -0.8, 0.9), (0.6, 0, 0.9), (0, 0, -0.9)])
    return np.array(volume.centre_mm) + aside * room, along


def planes(volume: Volume) -> tuple[Array, Array]:
    """Middles : (6, 3) mm of the plane, and its tilts : (6, 2) deg about x, then y."""
    depth = np.array([-0.4, 0.0, 0.4, 0.0, 0.0, 0.0])[:, None] * [0, 0, volume.size_mm[2]]
    tilts = TILT_DEG * np.array([(0, 0), (0, 0), (0, 0), (1, 0), (0, 1), (-0.7, -0.7)])
    return np.array(volume.centre_mm) + depth, tilts


def demands(artefacts: Artefacts, places: dict[str, Array]) -> list[Demand]:
    """Demands on the artefacts and their places, and what was found.

    places : of each kind of artefact, middles : (n, 3) mm as measured
    """
    volume, found = artefacts.volume, list[Demand]()
    whole = volume.diagonal_mm
    if artefacts.sphere is not None:
        size = artefacts.sphere.diameter.mm / whole
        found.append(Demand("sphere: diameter of 0.02 to 0.2 L0", f"{size:.3f} L0", SPHERE[0] <= size <= SPHERE[1]))
    if artefacts.bar is not None:
        length, balls = artefacts.bar.length.mm / whole, [ball.mm / whole for ball in artefacts.bar.diameters]
        found.append(Demand("bar: length of 0.3 L0 or more", f"{length:.2f} L0", length >= BAR))
        inside = all(BALLS[0] <= ball <= BALLS[1] for ball in balls)
        found.append(Demand("bar: balls of 0.02 to 0.2 L0", " and ".join(f"{ball:.3f} L0" for ball in balls), inside))
    if artefacts.plane is not None:
        length, width = max(artefacts.plane.size_mm), min(artefacts.plane.size_mm)
        met = length >= PLATE * whole and width >= PLATE_WIDTH_MM
        found.append(Demand("plane: 0.5 L0 long, 50 mm wide", f"{length / whole:.2f} L0, {width:.0f} mm", met))
    for kind, middles in places.items():
        away = np.abs(middles - volume.centre_mm) <= np.array(volume.size_mm) / 2
        found.append(Demand(f"{kind}: {LEAST[kind]} places", str(len(middles)), len(middles) >= LEAST[kind]))
        inside = int(away.all(axis=1).sum())
        found.append(Demand(f"{kind}: in the volume", f"{inside} of {len(middles)}", inside == len(middles)))
        spread = float(np.ptp(middles[:, 2])) / volume.size_mm[2]
        least = SPREAD if kind != "bar" else 0.0  # a bar's balls lie at its ends
        if least:
            words = f"{kind}: over {100 * least:.0f} % of the depth"
            found.append(Demand(words, f"{100 * spread:.0f} %", bool(spread >= least)))
    if (spheres_at := places.get("sphere")) is not None:
        octants = len({tuple(row) for row in (spheres_at > volume.centre_mm)})
        found.append(Demand("sphere: in all eight octants", str(octants), octants == 8))
    return found
