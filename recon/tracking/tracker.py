"""The tracker: pairs of frames in, poses of the target out.

While it knows where the target is, the rims are fitted where the last poses say they will be, without a network. If that
fails the segmenter looks at those places, and then the detector at the whole frames. Each answer passes the same checks, of rims,
of sizes against distances, and of both views against each other; so what is wrong is not found rather than found wrongly.
"""

from dataclasses import dataclass, field, replace
from time import perf_counter

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from recon import rigid
from recon.camera import Camera
from recon.ellipses import Ellipses, joined
from recon.errors import InputError
from recon.rig import Target
from recon.tracking import covered, detection, identity, segmentation, views
from recon.tracking.frames import grey
from recon.tracking.identity import Triple
from recon.tracking.networks import Networks
from recon.tracking.outline_model import ellipses_of
from recon.tracking.outlines import Outlines, measure_both
from recon.tracking.pose import GROSS_MM, Sighting, TargetPose, circle_centres, estimate, lost, meet
from recon.tracking.views import View

Array = NDArray[np.float64]
Frames = tuple[NDArray, NDArray]

REACH_PX = 8.0  # by which a prediction may be off with a known velocity
BLIND_PX = 14.0  # and without
ROUGH_PX = 5.0  # by which the segmenter's ellipses may be off
FORGOTTEN_S = 0.25  # after which the target may be anywhere
FORGOTTEN_FRAMES = 4.0  # the same without times
COARSE_MM = 8.0  # by which the detector's places may be off, in distances and as rays that miss each other
TRIALS = 3  # pairs of triples that the segmenter looks at
SIZES = 0.12  # of a disc's size, by which rims may differ from the pose's


@dataclass(frozen=True)
class Tracking:
    """What a pair of frames shows."""

    pose: TargetPose
    views: tuple[View, View]
    how: str | None = None  # "predicted", "segmented" or "detected"; None if it isn't found
    seconds: dict[str, float] = field(default_factory=dict)  # a stage: frames, predict, segment, detect

    @property
    def found(self) -> bool:
        """Whether there is a pose."""
        return self.pose.found


@dataclass
class Tracker:
    """Follows a target through pairs of frames. Its state is what it remembers of the last poses; `forget` clears it."""

    cameras: tuple[Camera, Camera]
    target: Target
    networks: Networks | None = None  # without them it only follows from a pose that it is given by `remember`
    bits: int | None = None  # of frames deeper than 8 bits, see `frames.grey`
    _past: list[tuple[float, Array]] = field(default_factory=list, init=False)  # times and poses, the last one last, two at most
    _clock: float = field(default=0.0, init=False)  # counts frames that come without a time

    def step(self, left: NDArray, right: NDArray, time_s: float | None = None) -> Tracking:
        """Track one pair of frames, camera 1's and camera 2's. Never raises on what they show.

        Times must be given always or never; without them frames are evenly spaced.
        """
        self._clock += 1
        now, limit = (self._clock, FORGOTTEN_FRAMES) if time_s is None else (time_s, FORGOTTEN_S)
        watch = _Watch()
        try:
            frames = self._frames(left, right)
        except InputError as error:
            return Tracking(lost(str(error)), (views.nothing(str(error)), views.nothing(str(error))), seconds=watch.seconds)
        watch.stop("frames")
        result = None
        if self._past and 0 < now - self._past[-1][0] <= limit:
            rough = self._rough(self._predicted(now))
            if np.isfinite(rough.centre).all():
                result = self._fitted(frames, rough, REACH_PX if len(self._past) > 1 else BLIND_PX, "predicted")
                watch.stop("predict")
                if not result.found and self.networks is not None:
                    result = self._segmented(frames, self.networks, (rough.centre[:3], rough.centre[3:]), "segmented", result)
                    watch.stop("segment")
        if (result is None or not result.found) and self.networks is not None:
            result = self._detected(frames, self.networks)
            watch.stop("detect")
        if result is None:
            result = _nowhere("no networks to find it by", "no networks to find it by")
        if result.found:
            self.remember(result.pose.world_from_target, now)
        return replace(result, seconds=watch.seconds)

    def remember(self, world_from_target: Array, time_s: float) -> None:
        """Take a pose as known, of a time in s, or of the frame counted so."""
        steady = self._past and 0 < time_s - self._past[-1][0] <= (FORGOTTEN_S if time_s != self._clock else FORGOTTEN_FRAMES)
        self._past = [*(self._past[-1:] if steady else []), (time_s, world_from_target)]

    def forget(self) -> None:
        """Know nothing."""
        self._past = []

    def _frames(self, left: NDArray, right: NDArray) -> Frames:
        frames = []
        for number, (camera, image) in enumerate(zip(self.cameras, (left, right), strict=True), start=1):
            try:
                frame = grey(image, self.bits)
            except InputError as error:
                raise InputError(f"camera {number}: {error}") from None
            if frame.shape != camera.size[::-1]:
                found = f"{frame.shape[1]}x{frame.shape[0]}"
                raise InputError(f"camera {number}: expected an image of {camera.size[0]}x{camera.size[1]}, found {found}")
            frames.append(frame)
        return frames[0], frames[1]

    def _predicted(self, now: float) -> Array:
        """Pose at a moment, by constant velocity : (4, 4) mm."""
        last, pose = self._past[-1]
        if len(self._past) < 2:
            return pose
        before, earlier = self._past[-2]
        ahead = (now - last) / (last - before)
        if ahead > FORGOTTEN_FRAMES:  # stamps that come in bursts tell no velocity
            return pose
        turn = Rotation.from_matrix(pose[:3, :3] @ earlier[:3, :3].T).as_rotvec()
        moved = Rotation.from_rotvec(ahead * turn).as_matrix() @ pose[:3, :3]
        return rigid.transform(moved, pose[:3, 3] + ahead * (pose[:3, 3] - earlier[:3, 3]))

    def _rough(self, world_from_target: Array) -> Ellipses:
        """Six ellipses, three a view, of a pose."""
        centres, radius = circle_centres(self.target), self.target.outer_diameter_mm / 2
        both = [ellipses_of(camera, world_from_target, centres, radius) for camera in self.cameras]
        return Ellipses(np.concatenate([each[0] for each in both]), np.concatenate([each[1] for each in both]))

    def _fitted(self, frames: Frames, rough: Ellipses, reach: float, how: str, rename: bool = False) -> Tracking:
        """From six rough ellipses to the pose."""
        outlines = measure_both(*frames, rough, np.arange(6) >= 3, reach, self.target)
        halves = [self._completed(frames, half, k) for k, half in enumerate((outlines[:3], outlines[3:]))]
        if rename:
            halves = [views.renamed(half, self.target) for half in halves]
        seen = (views.judged(halves[0], self.target), views.judged(halves[1], self.target))
        if not (seen[0].found and seen[1].found):
            return Tracking(lost(_unseen(seen)), seen)
        found = estimate(seen[0].sighting(self.cameras[0]), seen[1].sighting(self.cameras[1]), self.target)
        if found.found:
            expected = self._rough(found.world_from_target).shape
            shown = np.concatenate([view.outlines.ellipses.shape for view in seen])
            off = np.abs(shown - expected).max() / (np.trace(expected, axis1=1, axis2=2).mean() / 2)
            if off > SIZES:
                found = lost(f"circles whose sizes are {100 * off:.0f} % from what their distance asks for")
        return Tracking(found, seen, how if found.found else None)

    def _completed(self, frames: Frames, outlines: Outlines, view: int) -> Outlines:
        """Three rims, of which one that something covers is looked for where the other two ask for it."""
        which = covered.missing(outlines.found)
        if which is None:
            return outlines
        rough = covered.third(outlines.ellipses, which, self.target)
        again = measure_both(*frames, rough, np.array([view == 1]), covered.REACH_PX, self.target, middles=False)
        return outlines.replaced(which, again) if covered.alike(again, outlines, which) else outlines

    def _segmented(
        self, frames: Frames, networks: Networks, places: tuple[Array, Array], how: str, before: Tracking | None = None
    ) -> Tracking:
        """From six places, three a frame : (3, 2) px, to the pose, by the segmenter."""
        cuts = [
            segmentation.patches(frame, at, segmentation.step_for(at, self.target))
            for frame, at in zip(frames, places, strict=True)
        ]
        masks = networks.segment(np.concatenate([cut.images for cut in cuts]))
        halves = [segmentation.read(half, cut) for half, cut in zip((masks[:3], masks[3:]), cuts, strict=True)]
        rough = joined(halves)
        if before is not None and min(np.isfinite(half.centre[:, 0]).sum() for half in halves) < 2:
            return before
        return self._fitted(frames, rough, ROUGH_PX, how, rename=how == "detected")

    def _detected(self, frames: Frames, networks: Networks) -> Tracking:
        """From nothing to the pose."""
        candidates = detection.detect(list(frames), networks)
        choices = [identity.triples(each, self.target, frame.shape[1]) for each, frame in zip(candidates, frames, strict=True)]
        reasons = [_absent(each) for each in candidates]
        if not choices[0] and not choices[1]:
            return _nowhere(*reasons)
        if not (choices[0] and choices[1]):
            return self._one_sided(frames, networks, choices, reasons)
        tried = []
        for pair in self._pairs(choices[0], choices[1]):
            result = self._segmented(frames, networks, (pair[0].points, pair[1].points), "detected")
            if result.found:
                return result
            tried.append(result)
        return tried[0]  # the likeliest one's reason

    def _one_sided(self, frames: Frames, networks: Networks, choices: list[list[Triple]], reasons: list[str]) -> Tracking:
        """The circles of the one view that has any."""
        k = 0 if choices[0] else 1
        rough = segmentation.rough_ellipses(frames[k], choices[k][0].points, networks, self.target)
        outlines = self._completed(frames, measure_both(*frames, rough, np.full(3, k == 1), ROUGH_PX, self.target), k)
        view, other = views.judged(views.renamed(outlines, self.target), self.target), views.nothing(reasons[1 - k])
        seen = (view, other) if k == 0 else (other, view)
        return Tracking(lost(_unseen(seen)), seen)

    def _pairs(self, first: list[Triple], second: list[Triple]) -> list[tuple[Triple, Triple]]:
        """Pairs of triples that may be one target, the likeliest first; if there are none, the likeliest in each view."""
        expected = np.linalg.norm(_sides(circle_centres(self.target)), axis=1)
        loose = np.tile(np.eye(2), (3, 1, 1))
        ordered = sorted(((a, b) for a in first for b in second), key=lambda pair: -pair[0].score - pair[1].score)
        good = []
        for pair in ordered:
            sightings = [Sighting(camera, each.points, loose) for camera, each in zip(self.cameras, pair, strict=True)]
            points, apart = meet(*sightings)
            distances = np.linalg.norm(_sides(points), axis=1)
            if np.isfinite(points).all() and apart.max() < COARSE_MM and np.abs(distances - expected).max() < 2 * GROSS_MM:
                good.append(pair)
            if len(good) == TRIALS:
                break
        return good or ordered[:1]


@dataclass
class _Watch:
    """Seconds of each stage."""

    seconds: dict[str, float] = field(default_factory=dict)
    since: float = field(default_factory=perf_counter)

    def stop(self, stage: str) -> None:
        now = perf_counter()
        self.seconds[stage], self.since = now - self.since, now


def _sides(points: Array) -> Array:
    return points[[1, 2, 2]] - points[[0, 0, 1]]


def _absent(candidates: detection.Candidates) -> str:
    count = len(candidates.points)
    return f"{count} of 3 circles" if count < 3 else f"{count} places like circles, no three that lie like the target's"


def _unseen(seen: tuple[View, View]) -> str:
    """Why two views, not both with the target, give no pose."""
    for k in (0, 1):
        if seen[k].found:
            return f"only camera {k + 1} sees the target; camera {2 - k}: {seen[1 - k].reason}"
    return f"camera 1: {seen[0].reason}; camera 2: {seen[1].reason}"


def _nowhere(first: str, second: str) -> Tracking:
    seen = (views.nothing(first), views.nothing(second))
    return Tracking(lost(_unseen(seen)), seen)
