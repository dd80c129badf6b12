"""What was seen so far, as B-scans come in: the places that are still to be scanned, and the share that isn't.

B-scans are added as they come, some ms each, by a thread of its own, and twice a second the map is made of their sums. So neither
tracking nor publishers wait for it; of B-scans that navigation itself passes over nothing is counted.
"""

import logging
from dataclasses import dataclass, field
from threading import Thread
from time import monotonic

import numpy as np
import trimesh
from numpy.typing import NDArray

from recon.errors import InputError
from recon.freehand import volume_compounding
from recon.geometry import rigid
from recon.navigation.newest import Every
from recon.navigation.placed_scans import PlacedScan
from recon.segmentation import containment, detectability, insonation, seen_map
from recon.segmentation.detectability import Sought
from recon.segmentation.insonation import Spread, Tally

log = logging.getLogger(__name__)
Array = NDArray[np.float64]
Map = NDArray[np.float32]


@dataclass(frozen=True)
class LiveLimits:
    """How fine the live map is, and how often it is made."""

    step_mm: float = 3.0  # of its grid: a browser shows as many points
    every_s: float = 0.5
    wait_s: float = 0.2  # for a B-scan, before looking whether to end


LIVE = LiveLimits()
ROOM = (20, 4, 20)  # voxels around the first B-scan, without a skin, and more where others leave the grid


@dataclass(frozen=True, eq=False)
class SeenSoFar:
    """What was seen until a moment."""

    share: float  # of the planned volume, that was seen well enough
    planned_mm3: float
    points: Map  # (n, 3) mm in the world, middles of voxels that weren't
    probability: Map  # (n,) that a mass with its middle there would have been found


@dataclass
class RunningMap:
    """The map of B-scans so far, on a grid along the first one.

    Planned is all that lies under the skin down to the images' depth; without a skin the same around what was touched so far.
    """

    skin: trimesh.Trimesh | None = None
    sought: Sought = field(default_factory=Sought)
    spread: Spread = field(default_factory=Spread)
    face_row: float = 0.0
    tally: Tally | None = field(default=None, init=False)
    _depth_mm: float = field(default=0.0, init=False)  # of the images
    _planned: Map | None = field(default=None, init=False)  # (nz, ny, nx) mm below the skin; NaN elsewhere

    def add(self, scan: PlacedScan) -> None:
        """Take in a B-scan; one of another size than the first is left out.

        Raises
        ------
        InputError
            If the grid would be too large.
        """
        if self.tally is None:
            self._begin(scan)
        assert self.tally is not None
        if scan.image.shape != self.tally.shape:
            return
        if self.skin is None:
            self.tally = _holding(self.tally, scan.corners)
        insonation.add(self.tally, scan.world_from_pixel, scan.image)

    def seen(self) -> SeenSoFar | None:
        """The map so far; None before the first B-scan, or where nothing is planned."""
        if self.tally is None:
            return None
        where = insonation.insonation(self.tally, planned=self._planned)
        margin_mm = (LIVE.step_mm + self.sought.size_mm) / 2  # a ball lies between ringing and lower end, wherever in its voxel
        least_mm, most_mm = insonation.LIMITS.ringing_mm + margin_mm, self._depth_mm - margin_mm
        planned = where.around & (where.under_mm >= least_mm) & (where.under_mm <= most_mm)
        if not planned.any():
            return None
        found = seen_map.probability(where, self.sought, detectability.OBSERVER.even_db)
        left = planned & (found < seen_map.WELL)
        points = insonation.centres(where.grid)[left].astype(np.float32)
        return SeenSoFar(float(1 - left.sum() / planned.sum()), float(planned.sum()) * where.voxel_mm3, points, found[left])

    def _begin(self, scan: PlacedScan) -> None:
        """Begin the tally, on a grid along a B-scan: over all that is planned, or with room around the B-scan."""
        x, y = (scan.world_from_pixel[:3, axis] / np.linalg.norm(scan.world_from_pixel[:3, axis]) for axis in (0, 1))
        directions, step = np.column_stack([x, y, np.cross(x, y)]), np.full(3, LIVE.step_mm)
        height = scan.image.shape[0]
        self._depth_mm = float((height - 1 - self.face_row) * np.linalg.norm(scan.world_from_pixel[:3, 1]))
        if self.skin is None:
            grid = insonation.widened(volume_compounding.grid_over(scan.corners, directions, step), ROOM)
        else:
            surface = np.asarray(self.skin.vertices, float)
            grid = volume_compounding.grid_over(np.concatenate([surface, surface + self._depth_mm * y]), directions, step)
        self.tally = insonation.begin(grid, scan.image.shape, self.spread, self.face_row)
        if self.skin is not None:
            places = insonation.centres(grid)
            depths = containment.below(places.reshape(-1, 3), self.skin)[0].reshape(places.shape[:3])
            self._planned = np.where((depths >= 0) & (depths <= self._depth_mm), depths, np.nan).astype(np.float32)


def _holding(tally: Tally, corners: Array) -> Tally:
    """A tally on a grid that holds a B-scan's corners : (4, 3) mm, and what lies beside."""
    beside = np.array([1, 0, 1]) * insonation.LIMITS.around_mm / LIVE.step_mm + 1
    while True:
        index = rigid.apply(np.linalg.inv(insonation.world_from_voxel(tally.grid)), corners)
        out = (index.min(axis=0) < beside) | (index.max(axis=0) > np.array(tally.grid.size) - 1 - beside)
        if not out.any():
            return tally
        tally = insonation.grown(tally, tuple(np.where(out, ROOM, 0).tolist()))


@dataclass
class Mapper:
    """A thread that adds B-scans to a running map; `newest` is what was seen so far."""

    running: RunningMap
    newest: SeenSoFar | None = field(default=None, init=False)
    _scans: Every[PlacedScan] = field(default_factory=Every, init=False)
    _ended: bool = field(default=False, init=False)
    _thread: Thread | None = field(default=None, init=False)

    def add(self, scan: PlacedScan) -> None:
        """Leave a B-scan to be added."""
        self._scans.put(scan)

    def start(self) -> None:
        """Begin."""
        self._thread = Thread(target=self._run, name="mapping what was seen", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """End, once all that was left is added."""
        self._ended = True
        self._scans.close()
        if self._thread is not None:
            self._thread.join()

    def _run(self) -> None:
        made, changed = -np.inf, False
        try:
            while True:
                scan = self._scans.take(LIVE.wait_s)
                if scan is not None:
                    self.running.add(scan)
                    changed = True
                if changed and (scan is None or monotonic() - made > LIVE.every_s):
                    self.newest, made, changed = self.running.seen(), monotonic(), False
                if scan is None and self._ended:
                    return
        except InputError as error:  # navigation goes on without
            self.newest = None
            log.warning("what was seen isn't mapped any more: %s", error)
