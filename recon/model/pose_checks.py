"""Plausibility of a sweep's poses: lost ones written as the identity, a tracker that froze, jumps that no hand makes, units.

What fits no motion is left out by name and number, and a sweep of which too much would be left out is refused. Poses that are the
same to the last digit are suspicious only while the images change: a probe on a motor may rest.
"""

import logging
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from recon.errors import WAY, Implausible, InputError, refuse_or_warn

log = logging.getLogger(__name__)

Array = NDArray[np.float64]
Rows = NDArray[np.int64]
Cause = Literal["identity", "frozen", "jump"]
Images = Callable[[], tuple[Array, NDArray[np.float32]]]  # moments : (m,) of images, and these as of `small_images` : (m, h, w)

BLOCK_PX, MOST_BLOCKS = 8, 4096  # that images are averaged in before they are compared
LOST = -3.697314e28  # of a coordinate, which NDI's trackers write where a tool isn't seen
WORDS: dict[Cause, str] = {
    "identity": "the identity, as of a tool that is not seen",
    "frozen": "the same to the last digit as the one before while the images change, as of a tracker that stopped",
    "jump": "farther off its neighbours than a hand moves",
}


@dataclass(frozen=True)
class MotionLimits:
    """Limits of a plausible motion. Hands scan at 5 to 100 mm/s, and swing from place to place at up to some 1000."""

    speed_mm_s: float = 3000.0
    turn_rad_s: float = 20.0  # of a tool that is flicked about; one that is seen from its other side turns by pi in a frame
    least_mm: float = 20.0  # of a jump, by which stamps that come in bursts make no speed
    least_rad: float = 0.35
    acceleration_mm_s2: float = 30e3  # three times that of gravity; of a single pose between two that fit
    spike_mm: float = 2.0  # off the way between its neighbours, at least
    usual: float = 12.0  # times the median over the sweep, which tells a noisy tracker from a jump
    near: float = 5.0  # times the median step, within which a pose that is the identity lies on the way
    away_mm: float = 1000.0  # from the sweep's middle
    burst_s: float = 5e-3  # between stamps, below which they may come in bursts
    together: int = 12  # such steps that are timed together: bursts may have 14, and one step in 15 may be a gap
    gap: float = 5.0  # times the period, over which a motion isn't followed
    untimed_mm: float = 100.0  # of a step, where no times tell its speed
    alone: int = 10  # poses that make a sweep of their own there
    repeats: int = 4  # poses in a row that are the same, at least, before images are compared
    changed: float = 0.7  # times the usual change between images, as far apart, of a moving probe
    changed_before_jump: float = 0.3  # the same, where the pose jumps when it goes on
    grows: float = 1.2  # times the mean square between neighbours, by which images farther apart tell motion from noise
    small_mm: tuple[float, float] = (1.0, 20.0)  # a sweep's extent that might be in centimetres or inches, as few in mm are
    near_mm: float = 150.0  # the same of its farthest place from the origin
    slow_mm_s: float = 6.0  # and of its median speed
    swing: float = 2.5  # way of the places over that of the inverses'; of right sweeps 1.03 at most, of far trackers 0.15
    no_order: float = 0.7  # median step over that in random order; 1 of a shuffled table, far less of a motion
    least_covered: float = 0.8  # share of the images with a pose, below which it is said
    most_share: float = 1 / 3  # of poses that may be left out
    most_jumps_in_no_order: float = 0.1  # of jumps, where the others are in no order either


LIMITS = MotionLimits()


@dataclass(frozen=True)
class Findings:
    """Poses that are implausible, by their cause; rows count from 0."""

    count: int = 0  # of the poses that there were
    rows: dict[Cause, Rows] = field(default_factory=dict)

    @property
    def rows_left_out(self) -> Rows:
        """All rows : (m,), increasing."""
        return np.unique(np.concatenate([np.empty(0, np.int64), *self.rows.values()]))

    def lines(self, what: str = "pose") -> list[str]:
        """A sentence for each cause: the number of poses, and the first of them."""
        return [
            f"{len(rows)} of {self.count} poses, from {what} {rows[0]} on: {WORDS[cause]}" for cause, rows in self.rows.items()
        ]


def coverage(found: NDArray[np.bool_]) -> str | None:
    """Say where images : (n,), in order, have no pose, if that are many."""
    if not found.any() or found.mean() >= LIMITS.least_covered:
        return None
    first, last = np.flatnonzero(found)[[0, -1]]
    between = int((~found[first:last]).sum())
    where = f"{first} before the first pose, {len(found) - 1 - last} after the last, {between} in gaps"
    return f"{(~found).sum()} of {len(found)} B-scans have no pose: {where}"


def is_lost(values: Array) -> bool:
    """Whether numbers of a pose hold the mark of a tool that is not seen."""
    return bool(np.isclose(values, LOST, rtol=1e-3, atol=0).any())


def without_implausible(
    place: str,
    times_s: Array,
    poses: Array,
    implausible: Implausible = "refuse",
    images: Images | None = None,
    clock: Array | None = None,
    what: str = "pose",
    unit: str = "",
) -> tuple[Array, Findings]:
    """The poses of a sweep without those that are implausible, and these; all of them where they are to be taken.

    Parameters
    ----------
    place : of the poses, for messages
    what : word for one of them
    times_s, poses, images, clock : as of `find`
    unit : field that says in which unit they are, if there is one

    Raises
    ------
    InputError
        If more would be left out than may be.
    """
    found = find(times_s, poses, images, clock)
    if implausible == "take":
        for line in found.lines(what):
            log.warning("%s: taken all the same: %s", place, line)
        return poses, Findings(found.count)
    shuffled = len(found.rows.get("jump", ())) > LIMITS.most_jumps_in_no_order * found.count and in_no_order(poses)
    if shuffled or len(found.rows_left_out) > LIMITS.most_share * found.count:
        if "jump" in found.rows and (fault := unit_fault(poses, unit)):
            raise InputError(f"{place}: poses: expected a sweep in mm, found {fault}; {WAY}")
        share = LIMITS.most_jumps_in_no_order if shuffled else LIMITS.most_share
        expected = f"a motion that a hand makes, but for {100 * share:.0f} % at most"
        order = ", and each as far from the next as from any: rows out of order?" if shuffled else ""
        raise InputError(f"{place}: poses: expected {expected}, found {'; '.join(found.lines(what))}{order}; {WAY}")
    for line in found.lines(what):
        log.warning("%s: left out %s", place, line)
    return without(poses, found.rows_left_out), found


def check_motion(place: str, times_s: Array, poses: Array, implausible: Implausible = "refuse", unit: str = "") -> None:
    """Refuse a sweep : (n, 4, 4), NaN where there is no pose, of more than a few that are all the same or of another unit.

    Where they are to be taken it is said only, as it is of a sweep that may be of another unit; `unit` as above.
    """
    known = poses[np.isfinite(poses).all(axis=(1, 2))]
    if len(known) > LIMITS.repeats and (known == known[0]).all():
        found = f"all {len(known)} the same to the last digit: no tracking, or a probe at rest?"
        refuse_or_warn(place, f"poses: expected those of a probe that moves, found {found}", implausible)
    if fault := unit_fault(poses, unit):
        refuse_or_warn(place, f"poses: expected a sweep in mm, found {fault}", implausible)
    elif implausible == "refuse" and (told := unit_doubt(times_s, poses, unit)):
        log.warning("%s: %s", place, told)
    if told := direction_doubt(poses):
        log.warning("%s: %s", place, told)


def find(times_s: Array, poses: Array, images: Images | None = None, clock: Array | None = None) -> Findings:
    """Implausible poses of a sweep.

    Parameters
    ----------
    times_s : (n,) s, NaN where a pose has none; any order
    poses : (n, 4, 4) mm, rigid or nearly so, or times a scale; NaN where there is none
    images : looked at only where poses repeat
    clock : (n,) of the poses, by which the images' moments count; the times without it
    """
    clock = times_s if clock is None else clock
    there = np.flatnonzero(np.isfinite(poses).all(axis=(1, 2)))
    rows: dict[Cause, Rows] = {}
    lost = _lost(poses[there])
    left = there[~lost]
    if lost.any():
        rows["identity"] = there[lost]
    frozen = _frozen(clock[left], poses[left], images)
    if len(frozen):
        rows["frozen"], left = left[frozen], np.delete(left, frozen)
    jumped = _jumps(times_s[left], poses[left])
    if len(jumped):
        rows["jump"] = left[jumped]
    return Findings(len(there), rows)


def in_no_order(poses: Array) -> bool:
    """Whether places : (n, 4, 4), NaN where there is none, lie as far from the next as from any, as in a table that was shuffled.

    Poses at rest, each at another place, do so by right; places that are all the same are in any order.
    """
    places = poses[np.isfinite(poses).all(axis=(1, 2)), :3, 3]
    if len(places) < LIMITS.alone:
        return False
    orders = np.arange(len(places)), np.random.default_rng(0).permutation(len(places))
    step, apart = (float(np.median(np.linalg.norm(np.diff(places[order], axis=0), axis=1))) for order in orders)
    return apart > LIMITS.spike_mm and step > LIMITS.no_order * apart


def unit_fault(poses: Array, unit: str = "") -> str | None:
    """The fault of poses : (n, 4, 4) whose shifts seem to be in another unit than mm, with the likely one; None as a rule."""
    places = poses[np.isfinite(poses).all(axis=(1, 2)), :3, 3]
    if len(places) < 3:
        return None
    span, farthest = float(np.linalg.norm(np.ptp(places, axis=0))), float(np.abs(places).max())
    if 1e-6 < span < 1 and farthest < 5:
        way = f"give {unit}" if unit else "multiply the translations by 1000"
        return f"all within {span:.3g} mm, and {farthest:.3g} mm from the origin: metres? {way}"
    if (most := float(np.linalg.norm(np.subtract(*np.percentile(places, [90, 10], axis=0))))) > 5000:  # a few may be wrong
        way = f"give {unit}" if unit else "divide the translations by 1000"
        return f"a sweep over {most:.4g} mm: micrometres? {way}"
    return None


def unit_doubt(times_s: Array, poses: Array, unit: str = "") -> str | None:
    """Say that a sweep may be in another unit: one that is small, near and slow, as those in centimetres or inches are."""
    found = np.isfinite(poses).all(axis=(1, 2))
    places, times = poses[found, :3, 3], times_s[found]
    if len(places) <= LIMITS.repeats:
        return None
    span, farthest = float(np.linalg.norm(np.ptp(places, axis=0))), float(np.linalg.norm(places, axis=1).max())
    if not LIMITS.small_mm[0] < span < LIMITS.small_mm[1] or farthest > LIMITS.near_mm:
        return None
    told = f"all poses lie within {span:.3g} mm, and up to {farthest:.3g} mm from the origin"
    if (seconds := _seconds(times)) is not None:
        steps = np.linalg.norm(np.diff(places, axis=0), axis=1) / np.maximum(np.diff(seconds), _shortest(seconds))
        if (speed := float(np.median(steps))) > LIMITS.slow_mm_s:
            return None
        told += f", at {speed:.2g} mm/s"
    return f"{told}: is it in mm, not in centimetres or inches?" + (f" Else give {unit}" if unit else "")


def direction_doubt(poses: Array) -> str | None:
    """Say that poses : (n, 4, 4) may be the other way round.

    A probe that is far from the world's origin turns about itself: its place hardly moves by that. The origin's place in the
    probe's frame swings, as far as it is away.
    """
    known = poses[np.isfinite(poses).all(axis=(1, 2))]
    if len(known) <= LIMITS.repeats:
        return None
    given, other = (np.linalg.norm(np.diff(each[:, :3, 3], axis=0), axis=1).sum() for each in (known, np.linalg.inv(known)))
    if given < LIMITS.swing * other or other < LIMITS.small_mm[0]:
        return None
    return f"poses whose places go {given:.3g} mm, and those of their inverses {other:.3g} mm: the other way round?"


def small_images(images: Iterable[NDArray]) -> NDArray[np.float32]:
    """Mean grey levels : (n, h, w) of the images' blocks, in which noise counts little beside what is seen."""
    found = []
    for image in images:
        block = max(BLOCK_PX, int(np.ceil(np.sqrt(image.size / MOST_BLOCKS))))
        size = [max(1, pixels // block) for pixels in image.shape[::-1]]
        found.append(cv2.resize(image.astype(np.float32), size, interpolation=cv2.INTER_AREA))
    return np.array(found)


def _lost(poses: Array) -> NDArray[np.bool_]:
    """Where a pose is the identity and doesn't lie on the way; a sweep may begin there, as of poses relative to the first one."""
    same = np.abs(poses - np.eye(4)).max(axis=(1, 2), initial=0) < 1e-9
    others = np.flatnonzero(~same)
    if not same.any() or len(others) < 2:
        return np.zeros(len(poses), bool)
    places, turns = poses[others, :3, 3], poses[others, :3, :3]
    usual_mm = LIMITS.near * np.median(np.linalg.norm(np.diff(places, axis=0), axis=1)) + 1e-6
    usual_rad = LIMITS.near * np.median(_turns(turns[:-1], turns[1:])) + 1e-6
    for row in np.flatnonzero(same):
        after = np.searchsorted(others, row)
        beside = np.unique(np.clip([after - 1, after], 0, len(others) - 1))
        fits = np.linalg.norm(places[beside], axis=1) <= usual_mm
        same[row] = not (fits & (_turns(np.eye(3)[None], turns[beside]) <= usual_rad)).any()
    return same


def _frozen(times_s: Array, poses: Array, images: Images | None) -> Rows:
    """Rows of poses that repeat the one before to the last digit, long, while the images change as they do elsewhere.

    Images some way apart are compared: those of a probe at rest differ by noise alone, however slow its motion was.
    """
    same = (poses[1:] == poses[:-1]).all(axis=(1, 2))
    starts = np.concatenate([[0], np.flatnonzero(~same) + 1])
    lengths = np.diff([*starts, len(poses)])
    usual_length = np.sort(lengths)[(len(lengths) - 1) // 2]  # of a tracker that is slower than the images
    long = (lengths > LIMITS.repeats) & (lengths > 3 * usual_length)
    if not long.any() or images is None:
        return np.empty(0, np.int64)
    steps = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)[~same]
    moments, small = images()
    later = np.arange(len(moments)) > 0
    within = [
        later & (moments > times_s[start]) & (moments <= times_s[start + length - 1])
        for start, length in zip(starts[long], lengths[long], strict=True)
    ]
    moving = later & ~np.any(within, axis=0)
    frozen = []
    for start, length, own in zip(starts[long], lengths[long], within, strict=True):
        apart = (min(_longest(own), _longest(moving)) + 1) // 2
        if own.sum() < 3 or apart == 0:
            continue
        end = start + length
        jump = np.linalg.norm(poses[end, :3, 3] - poses[start, :3, 3]) > 3 * np.median(steps) if end < len(poses) else False
        least = LIMITS.changed_before_jump if jump else LIMITS.changed
        (far, near), (usual, usual_near) = ([_change(small, among, k) for k in (apart, 1)] for among in (own, moving))
        if usual > LIMITS.grows * usual_near:  # else neighbours differ as others do, far more than by noise
            changed = far > LIMITS.changed_before_jump**2 * usual
            changed &= (far - near) * usual_near > least**2 * (usual - usual_near) * near
        else:
            changed = far > least**2 * usual
        if changed:
            frozen.append(np.arange(start + 1, end))
    return np.concatenate([np.empty(0, np.int64), *frozen])


def _longest(marked: NDArray[np.bool_]) -> int:
    """Length of the longest run of marked ones."""
    bounds = np.flatnonzero(np.diff([False, *marked, False]))
    return int(np.diff(bounds)[::2].max(initial=0))


def _change(images: NDArray[np.float32], marked: NDArray[np.bool_], apart: int) -> float:
    """Median mean square of the difference of images : (n, h, w) some way apart, all on the way but the first one marked."""
    ends = np.flatnonzero(np.convolve(marked, np.ones(apart), "valid") == apart) + apart - 1
    return float(np.median([np.square(images[k] - images[k - apart]).mean() for k in ends]))


def _jumps(times_s: Array, poses: Array) -> Rows:
    """Rows of poses that no motion of a hand leads to."""
    if len(poses) < 3:
        return np.empty(0, np.int64)
    places = poses[:, :3, 3]
    away = np.linalg.norm(places - np.median(places, axis=0), axis=1)
    kept = np.flatnonzero(away <= max(LIMITS.away_mm, 8 * np.percentile(away, 75)))
    kept = kept[_joined(times_s[kept], poses[kept])]
    kept = kept[~_spikes(times_s[kept], places[kept])]
    return np.setdiff1d(np.arange(len(poses)), kept)


def _seconds(times_s: Array) -> Array | None:
    """Times that rise; None where they tell nothing of speeds."""
    steps = np.diff(times_s)
    return times_s if len(steps) and np.isfinite(steps).all() and steps.min() >= 0 and _shortest(times_s) > 0 else None


def _shortest(seconds: Array) -> float:
    """The least time between two poses that is believed: their period, and half more of stamps that may come in bursts."""
    if (period := float(np.percentile(np.diff(seconds), 40))) > LIMITS.burst_s:
        return period
    steps = min(LIMITS.together, len(seconds) - 1)
    return 1.5 * float(np.percentile(seconds[steps:] - seconds[:-steps], 20)) / steps


def _joined(times_s: Array, poses: Array) -> Rows:
    """Rows of the longest piece of the motion, and of those that can be reached from it.

    Where no times tell how long a hand had, a long piece from which the motion doesn't come back is another sweep.
    """
    seconds, places = _seconds(times_s), poses[:, :3, 3]
    steps = np.linalg.norm(np.diff(places, axis=0), axis=1)
    turns = _turns(poses[:-1, :3, :3], poses[1:, :3, :3])
    shortest = 0.0 if seconds is None else _shortest(seconds)
    most_mm = max(LIMITS.untimed_mm, 20 * float(np.median(steps, axis=0)))
    most_rad = max(1.0, 20 * float(np.median(turns)))

    def fits(step_mm: Array, turn_rad: Array, a: Rows, b: Rows) -> NDArray[np.bool_]:
        if seconds is None:
            return (step_mm <= most_mm) & (turn_rad <= most_rad)
        duration = np.maximum(np.abs(seconds[b] - seconds[a]), shortest)
        near = (step_mm <= LIMITS.least_mm) | (step_mm <= LIMITS.speed_mm_s * duration)
        return near & ((turn_rad <= LIMITS.least_rad) | (turn_rad <= LIMITS.turn_rad_s * duration))

    rows = np.arange(len(poses))
    apart = ~fits(steps, turns, rows[:-1], rows[1:])
    if seconds is not None:
        apart |= np.diff(seconds) > LIMITS.gap * shortest
    ends = np.flatnonzero(apart)
    pieces = np.split(rows, ends + 1)
    longest = max(range(len(pieces)), key=lambda k: len(pieces[k]))

    kept = []
    for others, last, first in ((pieces[longest + 1 :], -1, 0), (pieces[:longest][::-1], 0, -1)):

        def reached(before: Rows, after: Rows, last: int = last, first: int = first) -> bool:
            a, b = before[[last]], after[[first]]
            step = np.linalg.norm(places[b] - places[a], axis=1)
            return bool(fits(step, _turns(poses[a, :3, :3], poses[b, :3, :3]), a, b)[0])

        way = [pieces[longest]]
        for number, piece in enumerate(others):
            here = reached(way[-1], piece)
            if not here and len(way) > 1 and len(way[-1]) < len(piece) and reached(way[-2], piece):
                way, here = way[:-1], True  # what was reached over a gap was wrong
            if not here and seconds is None and len(piece) >= LIMITS.alone:
                here = not any(reached(way[-1], later) for later in others[number + 1 :])
            if here:
                way.append(piece)
        kept += way
    return np.unique(np.concatenate(kept))


def _spikes(times_s: Array, places: Array) -> NDArray[np.bool_]:
    """Where a single place : (n, 3) mm lies off the way between its two neighbours, by more than any hand could."""
    result, seconds = np.zeros(len(places), bool), _seconds(times_s)
    if len(places) < 5:
        return result
    if seconds is None:
        early = late = np.ones(len(places) - 2)
    else:
        shortest = _shortest(seconds)
        early, late = (np.maximum(part, shortest) for part in (np.diff(seconds)[:-1], np.diff(seconds)[1:]))
    share = (early / (early + late))[:, None]
    off = np.linalg.norm(places[1:-1] - (1 - share) * places[:-2] - share * places[2:], axis=1)
    across = np.linalg.norm(places[2:] - places[:-2], axis=1)
    least = LIMITS.untimed_mm if seconds is None else np.maximum(LIMITS.spike_mm, LIMITS.acceleration_mm_s2 * early * late / 2)
    result[1:-1] = (off > least) & (off > LIMITS.usual * np.median(off)) & (off > across)
    return result


def _turns(before: Array, after: Array) -> Array:
    """Angles : (n,) rad between rotations : (n, 3, 3), each perhaps times a scale of its axes."""
    before, after = (each / np.linalg.norm(each, axis=1, keepdims=True) for each in (before, after))
    return np.arccos(np.clip((np.einsum("nij,nij->n", before, after) - 1) / 2, -1, 1))


def without(poses: Array, rows: Rows) -> Array:
    """The poses, NaN in some rows."""
    result = np.array(poses)
    result[rows] = np.nan
    return result
