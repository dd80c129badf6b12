"""Pairs of frames from which the target is measured: both cameras see all circles whole, in poses that differ."""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from recon import arguments
from recon.errors import InputError
from recon.geometry import rigid
from recon.geometry.camera import Camera
from recon.tracking.pose_fit import Sighting
from recon.tracking.tracker import Tracking, is_beside

Array = NDArray[np.float64]

APART_MM, APART_DEG = 2.0, 1.0  # of poses that differ: a rim in the same pixels errs in the same way
LEAST = 8  # pairs
Fault = Literal["without a pose", "with a covered circle", "with a rim that is clipped, smeared or in shadow"]


@dataclass(frozen=True)
class Seen:
    """A pair of frames with all circles in both views."""

    views: tuple[Sighting, Sighting]
    world_from_target: Array  # (4, 4) mm, as the tracker found it
    even: bool = True  # whether the light is even on all rims; else their centres are less certain, as their covariances have it


@dataclass(frozen=True)
class Collected:
    """The pairs of a film that may measure the target, and why the others don't."""

    seen: tuple[Seen, ...] = ()
    faults: Mapping[Fault, int] = field(default_factory=dict)  # numbers of the others
    apart_mm: tuple[float | None, ...] = ()  # of each pair, as of `Tracking`

    @property
    def told(self) -> str:
        """Numbers of pairs by their fault, and a second target, to be added to a message."""
        faults = "".join(f", {count} pairs {fault}" for fault, count in self.faults.items())
        return faults + (", and a second target of this design: cover it" if any(map(is_beside, self.apart_mm)) else "")


def collect(tracked: Iterable[Tracking], cameras: tuple[Camera, Camera]) -> Collected:
    """Pairs of a film, taken one by one, in which all circles are whole, and numbers of the others."""
    seen, faults, apart = list[Seen](), Counter[Fault](), list[float | None]()
    for found in tracked:
        arguments.of_kind("tracked", found, Tracking, way="sonotwin.Tracker.step gives them")
        pair = whole(found, cameras)
        seen.append(pair) if isinstance(pair, Seen) else faults.update([pair])
        apart.append(found.apart_mm)
    return Collected(tuple(seen), faults, tuple(apart))


def whole(found: Tracking, cameras: tuple[Camera, Camera]) -> Seen | Fault:
    """The pair if all rims are whole and sharp; else the fault."""
    if not found.found:
        return "without a pose"
    if not found.pose.used.all():
        return "with a covered circle"
    first, second = (view.outlines.sighting(camera) for view, camera in zip(found.views, cameras, strict=True))
    if any((view.outlines.doubtful & ~view.outlines.uneven).any() for view in found.views):
        return "with a rim that is clipped, smeared or in shadow"
    even = not any(view.outlines.uneven.any() for view in found.views)
    return Seen((first, second), found.pose.world_from_target, even)


def spread(pairs: Sequence[Seen], most: int) -> list[Seen]:
    """Evenly chosen ones, not more than some."""
    chosen = np.unique(np.linspace(0, len(pairs) - 1, min(most, len(pairs))).round().astype(int))
    return [pairs[k] for k in chosen]


def evenly_lit(pairs: Sequence[Seen], least: int = LEAST) -> list[Seen]:
    """Pairs in even light whose poses differ; if these are fewer than `least`, those in uneven light, too."""
    even = distinct([pair for pair in pairs if pair.even])
    return even if len(even) >= least else distinct(pairs)


def distinct(pairs: Sequence[Seen]) -> list[Seen]:
    """Pairs whose poses differ from those of all before."""
    kept: list[Seen] = []
    for pair in pairs:
        if not any(_alike(pair.world_from_target, other.world_from_target) for other in kept):
            kept.append(pair)
    return kept


def _alike(first: Array, second: Array) -> bool:
    step = rigid.difference(first, second)
    return bool(np.linalg.norm(step[3:]) < APART_MM and np.degrees(np.linalg.norm(step[:3])) < APART_DEG)


def tilt_deg(pairs: Sequence[Seen]) -> float:
    """Standard deviation, deg, of the directions in which the target is seen, along the axis in which they differ least."""
    directions = []
    for pair in pairs:
        for view in pair.views:
            away = rigid.apply(rigid.invert(pair.world_from_target), view.camera.centre)
            directions.append(away[:2] / np.linalg.norm(away))
    spread = np.linalg.svd(np.array(directions) - np.mean(directions, axis=0), compute_uv=False)
    return float(np.degrees(np.arcsin(min(spread[1] / np.sqrt(len(directions)), 1.0))))


def range_mm(pairs: Sequence[Seen]) -> float:
    """Distance of the nearest pose to the farthest, along camera 1's axis."""
    depths = [rigid.apply(pair.views[0].camera.camera_from_world, pair.world_from_target[:3, 3])[2] for pair in pairs]
    return float(np.ptp(depths))


def check(pairs: Sequence[Seen], name: str, collected: Collected, least_tilt_deg: float, least_range_mm: float) -> None:
    """Refuse pairs that don't show the target from enough sides.

    Parameters
    ----------
    collected : what the film shows, of which the pairs are those in poses that differ

    Raises
    ------
    InputError
        If pairs, tilts or distances are missing, with what to do.
    """
    if len(pairs) < LEAST:
        expected = f"{LEAST} different poses, by 2 mm or 1 deg, in which both cameras see all circles whole"
        raise InputError(f"{name}: expected {expected}, found {len(pairs)}{collected.told}")
    missing = []
    if (tilt := tilt_deg(pairs)) < least_tilt_deg:
        missing.append(f"tilts that differ by {least_tilt_deg:g} deg (standard deviation; to all sides), found {tilt:.1f}")
    if (reach := range_mm(pairs)) < least_range_mm:
        missing.append(f"distances over {least_range_mm:g} mm, found {reach:.1f}")
    if missing:
        way = "turn the target to all sides, nearer and farther; or set least_tilt_deg, least_range_mm"
        raise InputError(f"{name}: expected {'; and '.join(missing)}: {way}")
