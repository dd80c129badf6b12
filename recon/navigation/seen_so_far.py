"""What was seen so far, as B-scans come in: the places that are still to be scanned, and the share that isn't.

B-scans are added as they come, some ms each, by a thread of its own, and twice a second the map is made of their sums. So neither
tracking nor publishers wait for it; of B-scans that navigation itself passes over nothing is counted.
"""

import logging
from dataclasses import dataclass, field
from threading import Thread
from time import monotonic

import cv2
import numpy as np
import trimesh
from numpy.typing import NDArray

from recon.errors import InputError
from recon.freehand import volume_compounding
from recon.geometry import rigid
from recon.navigation.newest import Every
from recon.navigation.placed_scans import PlacedScan
from recon.segmentation import containment, detectability, echo_power, insonation, rough_bodies, seen_map
from recon.segmentation.detectability import Sought
from recon.segmentation.insonation import Planned, Spread, Tally

log = logging.getLogger(__name__)
Array = NDArray[np.float64]
Map = NDArray[np.float32]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class LiveLimits:
    """How fine the live map is, and how often it is made."""

    step_mm: float = 3.0  # of its grid: a browser shows as many points
    every_s: float = 0.5
    wait_s: float = 0.2  # for a B-scan, before looking whether to end
    pixel_mm: float = 0.5  # in which the tissue's unevenness is measured
    speckle_db: float = 0.55  # in single B-scans, that several average away: silicone has 0.91 dB instead of 0.72


LIVE = LiveLimits()
ROOM = (20, 4, 20)  # voxels around the first B-scan, without a skin, and more where others leave the grid


@dataclass(frozen=True, eq=False)
class SeenSoFar:
    """What was seen until a moment."""

    share: float  # of the planned volume, that was seen well enough
    planned_mm3: float
    points: Map  # (n, 3) mm in the world, middles of voxels that weren't
    seen: Map  # (n,) probability that a mass with its middle there is found, over what B-scans side by side give
    uneven_db: float = np.nan  # standard deviation of the tissue's power; NaN where it couldn't be measured
    source: str = detectability.source(detectability.EVEN.trials)  # of the coefficients


@dataclass
class RunningMap:
    """The map of B-scans so far, from the first one on that shows tissue.

    Planned is all that lies under the skin down to the images' depth; without a skin the same around what was touched so far.
    B-scans in the air add nothing. One of another size, in colour or too far away for the grid is left out, which is logged once.
    """

    skin: trimesh.Trimesh | None = None
    sought: Sought = field(default_factory=Sought)
    spread: Spread = field(default_factory=Spread)
    face_row: float = 0.0
    tally: Tally | None = field(default=None, init=False)
    left_out: int = field(default=0, init=False)
    _planned: Planned | None = field(default=None, init=False)
    _uneven_db: list[float] = field(default_factory=list, init=False)  # of each B-scan
    _logged: set[str] = field(default_factory=set, init=False)  # reasons of what was left out

    def add(self, scan: PlacedScan) -> None:
        """Take in a B-scan."""
        try:
            self._add(scan)
        except InputError as error:
            self.left_out += 1
            if (reason := str(error).partition(":")[0]) not in self._logged:
                self._logged.add(reason)
                log.warning("a B-scan is left out of what was seen, as will be others like it: %s", error)

    def seen(self) -> SeenSoFar | None:
        """The map so far; None before the first B-scan, or where nothing is planned."""
        if self.tally is None:
            return None
        where = insonation.insonation(self.tally, planned=self._planned)
        planned = seen_map.planned(where, self.sought.size_mm)
        if not planned.any():
            return None
        uneven_db = float(np.median(self._uneven_db)) if self._uneven_db else np.nan
        calibration = detectability.calibration_for(uneven_db)
        _, seen = seen_map.probability(where, self.sought, uneven_db, calibration)
        left = planned & (seen < seen_map.WELL)
        points, share = insonation.centres(where.grid)[left].astype(np.float32), float(1 - left.sum() / planned.sum())
        planned_mm3 = float(planned.sum()) * where.voxel_mm3
        return SeenSoFar(share, planned_mm3, points, seen[left], uneven_db, detectability.source(calibration.trials))

    def _add(self, scan: PlacedScan) -> None:
        """Take in a B-scan; InputError if it has another size than the first or isn't grey, or the grid would be too large."""
        insonation.check(scan.image, scan.image.shape if self.tally is None else self.tally.shape)
        across, down = np.linalg.norm(scan.world_from_pixel[:3, :2], axis=0).tolist()
        pixels = insonation.tissue(scan.image, (across, down), self.face_row)
        if not pixels.any():
            return
        if self.tally is None:
            self.tally = self._begun(scan)
        elif self.skin is None:
            self.tally = _holding(self.tally, scan.corners)
        insonation.add(self.tally, scan.world_from_pixel, scan.image)
        if (uneven_db := unevenness(scan.image, (across, down), pixels)) is not None:
            self._uneven_db.append(uneven_db)

    def _begun(self, scan: PlacedScan) -> Tally:
        """A tally on a grid over all that is planned, or with room around a B-scan."""
        height, step = scan.image.shape[0], np.full(3, LIVE.step_mm)
        array, down = scan.world_from_pixel[:3, :2].T
        down_mm = float(np.linalg.norm(down))
        first_mm, last_mm = ((row - self.face_row) * down_mm for row in (insonation.top_row(self.face_row, down_mm), height - 1))
        if self.skin is None:
            around = volume_compounding.grid_over(scan.corners, _directions(array, down), step)
            return insonation.begin(insonation.widened(around, ROOM), scan.image.shape, self.spread, self.face_row)
        inwards, surface = _inwards(self.skin), np.asarray(self.skin.vertices, float)
        points = np.concatenate([surface, surface + last_mm * inwards])
        directions = _directions(array, inwards)
        grid = volume_compounding.grid_over(points, directions, step, insonation.LIMITS.around_mm)
        tally = insonation.begin(grid, scan.image.shape, self.spread, self.face_row)
        places = insonation.centres(grid)
        depths = containment.below(places.reshape(-1, 3), self.skin)[0].reshape(places.shape[:3])
        under = np.where((depths >= 0) & (depths <= last_mm), depths, np.nan).astype(np.float32)
        ends = np.minimum(under - first_mm, last_mm - under) - LIVE.step_mm / 2  # wherever in its voxel a middle lies
        self._planned = Planned(under, ends.astype(np.float32))
        return tally


def unevenness(image: NDArray[np.uint8], pixel_mm: tuple[float, float], pixels: Mask) -> float | None:
    """Standard deviation, dB, of the tissue's power in a B-scan (h, w); None where it shows too little.

    As `recon.segmentation.rough_bodies.rough` has it of many B-scans: of power smoothed over speckle, over that of the tissue
    around, without dark bodies and robust against others.

    pixels : (h, w) bool, that show tissue
    """
    limits, least = rough_bodies.LIMITS, 0.3  # share of the image
    if pixels.mean() < least:
        return None
    power = cv2.LUT(image, echo_power.powers(float(np.median(image[::4, ::4][pixels[::4, ::4]])))) * pixels
    size = tuple(max(1, round(n * mm / LIVE.pixel_mm)) for n, mm in zip(image.shape[::-1], pixel_mm, strict=True))
    power, tissue = (cv2.resize(one, size, interpolation=cv2.INTER_AREA) for one in (power, pixels.astype(np.float32)))

    def mean(weight: Map, values: Map, sigma_mm: float) -> Map:
        sums, shares = (cv2.GaussianBlur(one, (0, 0), sigma_mm / LIVE.pixel_mm) for one in (values * weight, weight))
        return sums / np.maximum(shares, np.float32(1e-6))

    local = power / np.maximum(tissue, np.float32(1e-6))
    fine, kept, level = mean(tissue, local, limits.smooth_mm), tissue, np.float32(0)
    for _ in range(2):
        level = mean(kept, np.minimum(local, 2), limits.around_mm)
        kept = tissue * (fine > limits.dark * level)
    known = (kept > 0) & (level > 0)
    if not known.any():
        return None
    spread = 1.4826 * float(np.median(np.abs(10 * np.log10(fine[known] / level[known]))))
    return float(np.sqrt(max(spread**2 - LIVE.speckle_db**2, 0)))


def _inwards(skin: trimesh.Trimesh) -> Array:
    """Mean direction : (3,) into the body of a skin, whichever way its triangles are wound: away from camera 1."""
    normals, places = np.asarray(skin.face_normals), np.asarray(skin.triangles_center)
    away = np.sign((normals * places).sum(axis=1)) * skin.area_faces
    total = away @ normals
    return total / np.linalg.norm(total)


def _directions(array: Array, beam: Array) -> Array:
    """A grid's directions : (3, 3), columns, y along the beam and x along the array as far as that is square to it."""
    y = beam / np.linalg.norm(beam)
    x = array / np.linalg.norm(array)
    least = 0.1  # of it across the beam
    x = x - y * (x @ y) if np.linalg.norm(x - y * (x @ y)) > least else np.linalg.svd(y[None])[2][1]
    x = x / np.linalg.norm(x)
    return np.column_stack([x, y, np.cross(x, y)])


def _holding(tally: Tally, corners: Array) -> Tally:
    """A tally on a grid that holds a B-scan's corners : (4, 3) mm, and what lies beside; InputError if that is too large."""
    beside = np.array([1, 0, 1]) * insonation.LIMITS.around_mm / LIVE.step_mm + 1
    index = rigid.apply(np.linalg.inv(insonation.world_from_voxel(tally.grid)), corners)
    out = np.maximum(beside - index.min(axis=0), index.max(axis=0) - (np.array(tally.grid.size) - 1 - beside))
    more = np.ceil(np.maximum(out, 0) / ROOM).astype(int) * ROOM
    return insonation.grown(tally, tuple(more.tolist())) if more.any() else tally


@dataclass
class Mapper:
    """A thread that adds B-scans to a running map; `newest` is what was seen so far, None once it has ended by a fault."""

    running: RunningMap
    newest: SeenSoFar | None = field(default=None, init=False)
    _scans: Every[PlacedScan] = field(default_factory=Every, init=False)
    _ended: bool = field(default=False, init=False)
    _thread: Thread | None = field(default=None, init=False)

    def add(self, scan: PlacedScan) -> None:
        """Leave a B-scan to be added; none once the thread has ended."""
        if self._thread is None or self._thread.is_alive():
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
        made, changed, whole = -np.inf, False, False
        try:
            while not whole:
                scan = self._scans.take(LIVE.wait_s)
                if scan is not None:
                    self.running.add(scan)
                    changed = True
                if changed and (scan is None or monotonic() - made > LIVE.every_s):
                    self.newest, made, changed = self.running.seen(), monotonic(), False
                whole = scan is None and self._ended
        finally:
            if not whole:  # a fault, which Python tells; navigation goes on without
                self.newest, self._scans = None, Every()
                log.error("what was seen isn't mapped any more")
