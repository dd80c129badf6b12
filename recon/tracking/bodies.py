"""All bodies of a rig in pairs of frames: each is followed by a tracker of its own, and what is lost is searched for in common.

The networks look at a pair once, whatever the number of bodies. Rings that belong to no body that is followed are fitted, and
where their rays meet, distances tell the bodies (`recon.tracking.constellations`). A body of which something covers circles is
then left to its own tracker's search, among the circles that are left.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from time import perf_counter
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from recon.errors import InputError
from recon.geometry.pose_hypotheses import POINTS
from recon.tracking import circle_detector, constellations, covered_circle
from recon.tracking.circle_detector import Detections
from recon.tracking.constellations import Points
from recon.tracking.pose import DISTINCT, UNTOLD, same
from recon.tracking.pose_fit import lost
from recon.tracking.rims import Outlines, hole_of, measure_again, measure_all
from recon.tracking.tracker import NO_NETWORKS, Frames, Moment, Tracker, Tracking, paired, rank
from recon.tracking.views import diameter, doubted

CIRCLES = 40  # candidates of a window, of all bodies and of what else is round


WAITING = "lost, and not searched for in this pair"


class _Claim(NamedTuple):
    """A body at some rings."""

    name: str
    result: Tracking
    rings: frozenset[tuple[int, int]]  # view and number


@dataclass
class _Search:
    """A search for what is lost, in a pair."""

    moment: Moment  # of that pair
    parts: Iterator[None]
    settled: dict[str, Tracking]  # by the parts that were done, and not taken yet
    ended: bool = False

    def advance(self, whole: bool = False) -> dict[str, Tracking]:
        """Results that the next part settles, or all parts that are left."""
        for _ in self.parts:
            if not whole:
                break
        else:
            self.ended = True
        settled = dict(self.settled)
        self.settled.clear()
        return settled


@dataclass
class BodyTracker:
    """Follows several bodies through pairs of frames; see `Tracker`, of which each body has one."""

    trackers: Mapping[str, Tracker]  # by the body's name, all of the same cameras and networks
    search_s: float = 0.0  # live: least time from one search to the next, of which a pair takes a part, while a body is followed
    further: bool = True  # whether further bodies of the designs are looked for, now and then, while all bodies are followed
    _search: _Search | None = field(default=None, init=False)  # that goes on
    _searched: float | None = field(default=None, init=False)  # when the last one began
    _looked: float | None = field(default=None, init=False)  # when further bodies of the designs were looked for

    def step(self, left: NDArray, right: NDArray, time_s: float | None = None) -> dict[str, Tracking]:
        """Track one pair of frames, camera 1's and camera 2's, as `Tracker.step`; the result of each body by its name.

        A search for what is lost is of this pair, and whole. With `search_s`, while another body is followed, its first part
        alone is, which finds bodies that both views show whole; each of the next pairs does another part of it. What these find
        is looked for there in the pair that follows.
        """
        start = perf_counter()
        first = next(iter(self.trackers.values()))
        (moment, *_) = [tracker.begin(time_s) for tracker in self.trackers.values()]
        try:
            frames = paired(first.cameras, (left, right), first.bits)
        except InputError as error:
            return {name: tracker.unseen(str(error)) for name, tracker in self.trackers.items()}
        results = self._followed(frames, moment)
        found = {name: result for name, result in results.items() if result.found}
        there: dict[str, tuple[Tracking, Moment]] = {}  # found in an earlier pair
        if first.networks is not None:
            in_parts = bool(found) and time_s is not None and self.search_s > 0
            if self._search_is_due(found, moment, in_parts):
                settled: dict[str, Tracking] = {}
                detections = Detections(frames, first.networks, CIRCLES, named=False)
                search = _Search(moment, self._parts(detections, found, settled), settled)
                results |= search.advance(whole=not in_parts)
                if not in_parts or self._search is None:
                    self._search = search
            elif self._search is not None:
                earlier = self._search.advance()
                began = self._search.moment
                there = {name: (one, began) for name, one in earlier.items() if one.found and name not in found}
                results |= {name: one for name, one in earlier.items() if not one.found} | _beside(found, earlier)
            if self._search is not None and self._search.ended:
                self._search = None
        reason = NO_NETWORKS if first.networks is None else WAITING
        kept = {
            name: tracker.keep(results.get(name) or tracker.unseen(reason), moment) for name, tracker in self.trackers.items()
        }
        for name, (one, began) in there.items():
            self.trackers[name].keep(one, began)
        seconds = {"bodies": (perf_counter() - start) / len(kept)}
        return {name: replace(result, seconds=seconds) for name, result in kept.items()}

    def forget(self) -> None:
        """Clear the last poses."""
        self._search = self._searched = self._looked = None
        for tracker in self.trackers.values():
            tracker.forget()

    def _followed(self, frames: Frames, moment: Moment) -> dict[str, Tracking]:
        """Results of the bodies whose last poses say where they are; all their rims are measured at once."""
        known = {name: tracker.ahead(moment) for name, tracker in self.trackers.items()}
        sought = {name: each for name, each in known.items() if each is not None}
        if not sought:
            return {}
        rims = measure_all(*frames, list(sought.values()))
        return {
            name: self.trackers[name].follow(frames, each, own) for (name, each), own in zip(sought.items(), rims, strict=True)
        }

    def _search_is_due(self, found: Mapping[str, Tracking], moment: Moment, in_parts: bool) -> bool:
        """Whether to begin a search: for what is lost, or now and then for further bodies of the designs."""
        look = self.further and (self._looked is None or not 0 <= moment.now - self._looked < moment.look)
        waiting = in_parts and self._searched is not None and 0 <= moment.now - self._searched < self.search_s
        if not look and (waiting or len(found) == len(self.trackers)):
            return False
        self._searched, self._looked = moment.now, moment.now if look else self._looked
        return True

    def _parts(self, detections: Detections, found: Mapping[str, Tracking], told: dict[str, Tracking]) -> Iterator[None]:
        """Parts of a search; each adds what it settles to `told`: results of the bodies that aren't found yet, and those of the
        others with further bodies of their design.

        Bodies that both views show whole come first; then those of which both show two circles, and the others are sought about
        them; then each lost one's own tracker searches among what is left. At each stage, where two bodies fit, neither is told.
        """
        for result in found.values():
            _take(detections, result)
        first, both = next(iter(self.trackers.values())), list[Outlines]()
        for frame, places in zip(detections.frames, self._places(detections), strict=True):
            both.append(constellations.rings_of(frame, places, detections.networks, first.target))
        rings = both[0], both[1]
        points = constellations.points_of(rings, first.cameras)
        results, others = dict(found), {name: list[Tracking]() for name in self.trackers}
        for least in (POINTS, POINTS - 1):
            claims = self._claims(detections.frames, rings, points, least)
            settled = _settled([claim for claim in claims if claim.name not in results])
            settled += _free([claim for claim in claims if claim.name in results], settled)
            points = points.without(set().union(*(claim.rings for claim in settled)))
            for name, result, _ in settled:
                if name in results:
                    others[name].append(result)
                else:
                    results[name] = told[name] = result
                    _take(detections, result)
            if least == POINTS:
                yield
        for name, further in others.items():
            if name in results and results[name].found:
                told[name] = self.trackers[name].nearest(results[name], [one for one in further if one.found])
        missing = {}
        for name, tracker in self.trackers.items():
            if name not in results:
                yield
                missing[name] = yield from tracker.find_in_parts(detections)
        told |= _told(missing)

    def _places(self, detections: Detections) -> list[NDArray]:
        """Places : (n, 2) px of each view that may be circles' middles, in windows in which circles are as large as usual."""
        first = next(iter(self.trackers.values()))
        known = [tracker.disc_px for tracker in self.trackers.values() if tracker.disc_px is not None]
        places = []
        for k, camera in enumerate(first.cameras):
            windows = circle_detector.levels(camera.size)
            level = windows[circle_detector.usual_level(windows, min(known, default=None))]
            seen = detections.candidates([(k, window) for window in level], first.count)
            places.append(np.concatenate([each.points for each in seen]))
        return places

    def _claims(
        self, frames: tuple[NDArray, NDArray], rings: tuple[Outlines, Outlines], points: Points, least: int
    ) -> list[_Claim]:
        """Each body at all rings that a pose of it fits, of which both views show a number at least; others are sought again."""
        claims, first = [], next(iter(self.trackers.values())).target
        for name, tracker in self.trackers.items():
            for choice in constellations.choices(points, tracker.target, least):
                rims = constellations.chosen_rims(rings, points, choice)
                if hole_of(tracker.target) != hole_of(first):
                    rims = [measure_again(frame, each, tracker.target) for frame, each in zip(frames, rims, strict=True)]
                if (choice < 0).any():
                    rims = [
                        covered_circle.completed(frame, each, tracker.target) for frame, each in zip(frames, rims, strict=True)
                    ]
                result = tracker.posed((tracker.judged(0, rims[0]), tracker.judged(1, rims[1])), "detected")
                if result.found:
                    taken = frozenset((k, ring) for k in (0, 1) for ring in points.rings[choice[choice >= 0], k].tolist())
                    claims.append(_Claim(name, result, taken))
        return claims


def _beside(found: Mapping[str, Tracking], earlier: Mapping[str, Tracking]) -> dict[str, Tracking]:
    """Results of bodies that are followed, with the further bodies of their design that an earlier pair showed."""
    return {name: replace(one, others=earlier[name].others) for name, one in found.items() if name in earlier}


def _settled(claims: Sequence[_Claim]) -> list[_Claim]:
    """Claims that share no rings, the surest first; where two bodies, or two poses of one, fit the same rings, none is told."""
    settled: list[_Claim] = []
    for claim in sorted(claims, key=lambda claim: rank(claim.result)):
        rivals = [one for one in settled if one.rings & claim.rings]
        if not rivals:
            settled.append(claim)
        elif _as_well(claim.result, rivals[0].result):
            if rivals[0].name != claim.name:
                told = _untold(claim.result, f"circles of the {rivals[0].name}, or of the {claim.name}: no distance tells which")
                settled.append(claim._replace(result=told))
            elif not same(rivals[0].result.pose, claim.result.pose):
                told = _untold(claim.result, UNTOLD)
            else:
                continue
            settled = [one._replace(result=told) if one is rivals[0] else one for one in settled]
    return settled


def _told(results: Mapping[str, Tracking]) -> dict[str, Tracking]:
    """Results of lost bodies by their own searches: of two at the same circles that which fits better, neither if both do."""
    told: dict[str, Tracking] = {}
    for name, result in sorted(results.items(), key=lambda item: rank(item[1]) if item[1].found else (1, np.inf)):
        rival = next((one for one in told if result.found and _overlap(results[one], result)), None)
        if rival is None:
            told[name] = result
            continue
        told[name] = _untold(result, f"circles seen in part, of the {rival} or of the {name}")
        if _as_well(result, results[rival]):
            told[rival] = _untold(results[rival], f"circles seen in part, of the {rival} or of the {name}")
    return told


def _untold(result: Tracking, reason: str) -> Tracking:
    """The result without its pose, for a reason."""
    return Tracking(lost(reason), doubted(result.views, reason))


def _overlap(one: Tracking, other: Tracking) -> bool:
    """Whether two results are at the same circle in a view."""
    for here, there in zip(one.views, other.views, strict=True):
        away = np.linalg.norm(here.outlines.ellipses.centre[:, None] - there.outlines.ellipses.centre, axis=-1)
        if one.found and other.found and np.nanmin(away, initial=np.inf) < diameter(here.outlines.ellipses) / 2:
            return True
    return False


def _free(claims: Sequence[_Claim], settled: Sequence[_Claim]) -> list[_Claim]:
    """Claims that share no rings with each other or with those that are settled, the surest first."""
    free: list[_Claim] = []
    for claim in sorted(claims, key=lambda claim: rank(claim.result)):
        if not any(one.rings & claim.rings for one in (*settled, *free)):
            free.append(claim)
    return free


def _as_well(one: Tracking, other: Tracking) -> bool:
    """Whether a pose fits as many circles about as well as another."""
    return other.found and one.pose.freedom >= other.pose.freedom and one.pose.misfit < other.pose.misfit + DISTINCT


def _take(detections: Detections, result: Tracking) -> None:
    """Leave the circles of a body that is found out of the detections."""
    if result.found:
        for k, view in enumerate(result.views):
            detections.take(k, view.outlines.ellipses)
