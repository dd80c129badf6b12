"""The tracker: pairs of frames in, poses of the target out.

While it knows where the target is, the rims are fitted where the last poses say they will be, without a network. If that
fails the segmenter looks at those places, and then the detector at the whole frames. Each answer passes the same checks, of rims,
of sizes against distances, and of both views against each other; so what is wrong is not found rather than found wrongly.
"""

from collections.abc import Generator, Sequence
from dataclasses import dataclass, field, replace
from time import perf_counter
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from recon.capture.manifest import CAMERAS
from recon.errors import InputError
from recon.geometry import pose_hypotheses, rigid
from recon.geometry.camera import Camera
from recon.geometry.circle_outline import ellipses_of
from recon.geometry.ellipses import Ellipses, joined
from recon.model import circle_layout
from recon.model.calibration import DRIFT_PX, Uncertainty, in_use
from recon.model.rig import Target
from recon.tracking import circle_detector, circle_segmenter, covered_circle, identity, views
from recon.tracking.circle_detector import AT_ONCE, Candidates, Detections, Window
from recon.tracking.frames import grey
from recon.tracking.identity import Naming
from recon.tracking.networks import Networks
from recon.tracking.pose import DISTINCT, UNTOLD, estimate, exchanged, same
from recon.tracking.pose_fit import Sighting, TargetPose, lost
from recon.tracking.rims import Outlines, Sought, measure, measure_all, reach_px
from recon.tracking.views import View

Array = NDArray[np.float64]
Frames = tuple[NDArray, NDArray]
Views = tuple[View, View]

FOLLOWED = 0.18  # of a disc's mean semi-axis, by which a prediction may be off with a known velocity
BLIND = 0.31  # and without
FORGOTTEN_S = 0.25  # after which the target may be anywhere
FORGOTTEN_FRAMES = 4.0  # the same without times
EXCHANGED = "cameras exchanged: as camera 2's and camera 1's these views show the target"
GONE_S, GONE_FRAMES = 0.5, 15.0  # for which the last poses tell where it has gone
LOOK_S, LOOK_FRAMES = 1.0, 30.0  # after which a second target is looked for again, while one is followed
OTHERS = 4  # namings that are looked at then
APART_DISCS = 1.0  # least distance of two targets, in circles' diameters
NO_NETWORKS = "no networks to find it by"
SPARSE = 16  # rows, of which one is compared to know two cameras' images for the same one
TRIALS = 10  # namings of both views that are looked at
ALL_LEVELS = 16  # frames without the target, after which it is looked for at any size again


@dataclass(frozen=True)
class Tracking:
    """The result of a pair of frames."""

    pose: TargetPose
    views: Views
    how: str | None = None  # "predicted", "segmented" or "detected"; None if it isn't found
    seconds: dict[str, float] = field(default_factory=dict)  # a stage: frames, predict, segment, detect, look
    others: tuple[Array, ...] | None = None  # poses of further targets of the design; None of a pair not searched for them

    @property
    def found(self) -> bool:
        """Whether there is a pose."""
        return self.pose.found

    @property
    def apart_mm(self) -> float | None:
        """Distance of the nearest further target; infinite without one, None of a pair that wasn't searched for them."""
        if self.others is None:
            return None
        own = self.pose.world_from_target[:3, 3]
        return min((float(np.linalg.norm(other[:3, 3] - own)) for other in self.others), default=np.inf)


class Moment(NamedTuple):
    """When a pair was taken, and for how long what is known holds: in s, or in frames of pairs that come without times."""

    now: float
    forgotten: float = FORGOTTEN_S
    gone: float = GONE_S
    look: float = LOOK_S


def paired(cameras: tuple[Camera, Camera], images: tuple[NDArray, NDArray], bits: int | None) -> Frames:
    """A pair of frames, camera 1's and camera 2's, grey from 0 to 255.

    Raises
    ------
    InputError
        If one is no image, or of another size than its camera's, or both are the same.
    """
    frames = []
    for number, (camera, image) in enumerate(zip(cameras, images, strict=True), start=1):
        try:
            frame = grey(image, bits)
        except InputError as error:
            raise InputError(f"camera {number}: {error}") from None
        if frame.shape != camera.size[::-1]:
            found = f"{frame.shape[1]}x{frame.shape[0]}"
            raise InputError(f"camera {number}: expected an image of {camera.size[0]}x{camera.size[1]}, found {found}")
        frames.append(frame)
    if np.array_equal(frames[0][::SPARSE], frames[1][::SPARSE]) and frames[0].std() > 0:
        raise InputError("both cameras show the same image to the last digit: is one camera's folder given for both?")
    return frames[0], frames[1]


def is_beside(apart_mm: float | None) -> bool:
    """Whether there is a further target, by `Tracking.apart_mm`."""
    return apart_mm is not None and bool(np.isfinite(apart_mm))


@dataclass
class Tracker:
    """Follows a target through pairs of frames. Its state is the last poses; `forget` clears it.

    Cameras count as used some time after their calibration, by `drift_px` and `board_scale`: without that allowance sharp rims
    would refuse the target to cameras that have warmed by a kelvin.
    """

    cameras: tuple[Camera, Camera]
    target: Target
    networks: Networks | None = None  # without them it only follows from a pose that it is given by `remember`
    bits: int | None = None  # of frames deeper than 8 bits, see `frames.grey`
    optics: Uncertainty | None = None  # of the cameras' calibration, as its file has it; None where it isn't known, or exact
    drift_px: float = DRIFT_PX  # standard deviation of principal points since the calibration; 0 of exact cameras
    board_scale: float | None = None  # relative, of the board of their calibration; None: as `optics` has it, or of paper
    _past: list[tuple[float, Array]] = field(default_factory=list, init=False)  # times and poses, the last one last, two at most
    disc_px: float | None = field(default=None, init=False)  # diameter when it was seen last; None before
    _last: Array | None = field(default=None, init=False)  # the last pose, however old
    _looked: float | None = field(default=None, init=False)  # when a second target was looked for
    _missed: int = field(default=0, init=False)  # frames since then
    _clock: float = field(default=0.0, init=False)  # counts frames that come without a time
    _used: tuple[tuple, Uncertainty | None] | None = field(
        default=None, init=False, repr=False
    )  # settings, and what follows of them

    @property
    def optics_in_use(self) -> Uncertainty | None:
        """Uncertainty of the cameras as they are now: of their calibration, and by drift and the board's scale since."""
        given = self.optics, self.cameras, self.board_scale, self.drift_px
        if not self._used or any(one is not other for one, other in zip(given, self._used[0], strict=True)):
            self._used = (
                given,
                in_use(self.optics, dict(zip(CAMERAS, self.cameras, strict=True)), self.board_scale, self.drift_px),
            )
        return self._used[1]

    @property
    def count(self) -> int:
        """Number of the target's circles."""
        return circle_layout.count(self.target)

    def step(self, left: NDArray, right: NDArray, time_s: float | None = None) -> Tracking:
        """Track one pair of frames, camera 1's and camera 2's. Never raises on what they show.

        Times must be given always or never; without them frames are evenly spaced.
        """
        watch, moment = _Watch(), self.begin(time_s)
        try:
            frames = paired(self.cameras, (left, right), self.bits)
        except InputError as error:
            return replace(self.unseen(str(error)), seconds=watch.seconds)
        watch.stop("frames")
        sought = self.ahead(moment)
        result = None if sought is None else self.follow(frames, sought, measure_all(*frames, [sought])[0], watch)
        if self.networks is not None:
            detections = Detections(frames, self.networks)
            if result is None or not result.found:
                result = self.find(detections)
                watch.stop("detect")
            if result.found and self._is_due(result, moment):
                result, self._looked = self.nearest(result, self._beside(detections, result)), moment.now
                watch.stop("look")
        return replace(self.keep(result or self.unseen(NO_NETWORKS), moment), seconds=watch.seconds)

    def begin(self, time_s: float | None) -> Moment:
        """Begin a pair of a time in s, or the next of those that come without times."""
        self._clock += 1
        return Moment(self._clock, FORGOTTEN_FRAMES, GONE_FRAMES, LOOK_FRAMES) if time_s is None else Moment(time_s)

    def ahead(self, moment: Moment) -> Sought | None:
        """The rims where the last poses say that the target is; None if they don't say."""
        if not (self._past and 0 < moment.now - self._past[-1][0] <= moment.forgotten):
            return None
        rough = self._rough(self._predicted(moment.now))
        if not np.isfinite(rough.centre).all():
            return None
        return self._sought(rough, FOLLOWED if len(self._past) > 1 else BLIND)

    def follow(self, frames: Frames, sought: Sought, outlines: Outlines, watch: "_Watch | None" = None) -> Tracking:
        """The target by rims that are measured where it was sought `ahead`; if these fail, by the segmenter there."""
        watch = watch or _Watch()
        result = self._fitted(frames, outlines, "predicted")
        watch.stop("predict")
        if not result.found and self.networks is not None:
            result = self._segmented(frames, self.networks, sought.rough, result)
            watch.stop("segment")
        return result

    def keep(self, result: Tracking, moment: Moment) -> Tracking:
        """Take the result of a pair as known; of one without a pose, with the reason that the last poses give."""
        if result.found:
            pose = result.pose.world_from_target
            self._keep(pose, moment)
            self._last = pose
            self.disc_px = min(views.diameter(view.outlines.ellipses) for view in result.views)
        else:
            result = self._explained(result, moment)
        self._missed = 0 if result.found else self._missed + 1
        return result

    def unseen(self, reason: str) -> Tracking:
        """The result of a pair that isn't looked at, for a reason."""
        nothing = views.nothing(reason, self.count)
        return Tracking(lost(views.unseen((nothing, nothing)) if reason == NO_NETWORKS else reason), (nothing, nothing))

    def _explained(self, result: Tracking, moment: Moment) -> Tracking:
        """A result without a pose, with the reasons that the last poses know: circles that have left a view, or got too small."""
        gone = self._past and 0 < moment.now - self._past[-1][0] <= moment.gone
        if not gone or result.pose.reason != views.unseen(result.views):
            return result
        pose = self._predicted(moment.now)
        seen = [views.gone(view, self._expected(k, pose), self.cameras[k].size) for k, view in enumerate(result.views)]
        changed = seen[0], seen[1]
        if all(new is old for new, old in zip(changed, result.views, strict=True)):
            return result
        return replace(result, pose=replace(result.pose, reason=views.unseen(changed)), views=changed)

    def remember(self, world_from_target: Array, time_s: float | None = None) -> None:
        """Take a pose as known, of a time in s, or of the last frame where frames come without times."""
        self._keep(world_from_target, Moment(self._clock, FORGOTTEN_FRAMES) if time_s is None else Moment(time_s))

    def _keep(self, world_from_target: Array, moment: Moment) -> None:
        steady = self._past and 0 < moment.now - self._past[-1][0] <= moment.forgotten
        self._past = [*(self._past[-1:] if steady else []), (moment.now, world_from_target)]

    def forget(self) -> None:
        """Clear the last poses."""
        self._past, self.disc_px, self._missed, self._last, self._looked = [], None, 0, None, None

    def _is_due(self, result: Tracking, moment: Moment) -> bool:
        """Whether a second target is to be looked for: in the pair after the first that shows one, then now and then, and where a
        target that was lost is found again.
        """
        if result.how == "detected":
            return self._last is not None
        return self._looked is None or not 0 <= moment.now - self._looked < moment.look

    def _beside(self, detections: Detections, result: Tracking) -> list[Tracking]:
        """Further targets beside the one that is found, all of them by both views."""
        frames, networks = detections.frames, detections.networks
        known = [view.outlines.ellipses for view in result.views]
        wide = min(map(views.diameter, known))
        windows = [
            each[circle_detector.usual_level(each, wide)] for each in map(circle_detector.levels, (c.size for c in self.cameras))
        ]
        places = [(k, window) for k, each in enumerate(windows) for window in each]
        seen = detections.candidates(places, self.count)
        choices = [
            (k, naming)
            for (k, window), candidates in zip(places, seen, strict=True)
            for naming in identity.namings(candidates.apart_from(known[k].centre, wide / 2), self.target, window.width)
            if np.isfinite(naming.points).all()
        ]
        found: list[Tracking] = []
        for k, naming in sorted(choices, key=lambda choice: -choice[1].score)[:OTHERS]:
            view = self._seen_at(frames, networks, k, naming)
            again = self._confirmed(frames, k, view) if view.found else None
            if again is not None and all(self.differ(again, other) for other in (result, *found)):
                found.append(again)
        return found

    def differ(self, one: Tracking, other: Tracking) -> bool:
        """Whether two results are of two targets."""
        way = one.pose.world_from_target[:3, 3] - other.pose.world_from_target[:3, 3]
        return bool(np.linalg.norm(way) > APART_DISCS * self.target.outer_diameter_mm)

    def nearest(self, result: Tracking, others: Sequence[Tracking]) -> Tracking:
        """Of several targets the one nearest to the last pose, else the first; the others beside it."""
        all_of_them = [result, *others]
        if self._last is not None:
            last = self._last[:3, 3]
            all_of_them.sort(key=lambda one: float(np.linalg.norm(one.pose.world_from_target[:3, 3] - last)))
        return replace(all_of_them[0], others=tuple(one.pose.world_from_target for one in all_of_them[1:]))

    def _confirmed(self, frames: Frames, k: int, view: View) -> Tracking | None:
        """The pose by camera k's view and the other's at the circles that it predicts; None if these show none."""
        results = [
            self.posed((view, other) if k == 0 else (other, view), "detected") for other in self._opposite_views(frames, k, view)
        ]
        return min((one for one in results if one.found), key=rank, default=None)

    def _predicted(self, now: float) -> Array:
        """Pose at a moment, by constant velocity : (4, 4) mm."""
        last, pose = self._past[-1]
        if len(self._past) < 2:
            return pose
        before, earlier = self._past[-2]
        ahead = (now - last) / (last - before)
        if ahead > FORGOTTEN_FRAMES:  # stamps that come in bursts tell no velocity
            return pose
        return rigid.moved(pose, ahead * rigid.difference(earlier, pose))

    def _rough(self, world_from_target: Array) -> Ellipses:
        """Ellipses of a pose, camera 1's and then camera 2's."""
        return joined([self._expected(k, world_from_target) for k in (0, 1)])

    def _expected(self, k: int, world_from_target: Array) -> Ellipses:
        """Ellipses that camera k should show of a pose."""
        return Ellipses(*ellipses_of(self.cameras[k], world_from_target, *circle_layout.circles(self.target)))

    def _sought(self, rough: Ellipses, reach: float) -> Sought:
        """Rims of both views, from rough ellipses that are off by a share of a disc at most."""
        return Sought(rough, np.arange(2 * self.count) >= self.count, reach_px(rough, reach), self.target)

    def _fitted(self, frames: Frames, outlines: Outlines, how: str) -> Tracking:
        """From the rims of both views to the pose."""
        halves = [
            covered_circle.completed(*each, self.target)
            for each in zip(frames, (outlines[: self.count], outlines[self.count :]), strict=True)
        ]
        seen = (self.judged(0, halves[0]), self.judged(1, halves[1]))
        return self._settled(frames, seen, how)

    def _settled(self, frames: Frames, seen: Views, how: str) -> Tracking:
        """From two views to the pose; where they give none, by a second look for circles that something covers."""
        result = self.posed(seen, how)
        if result.found:
            return result
        rims = [view.outlines for view in seen]
        for choices in covered_circle.sought_again(frames, rims, self.cameras, self.target, self.optics_in_use):
            judged = [(self.judged(0, one), self.judged(1, other)) for one, other in choices]
            found = [each for each in (self.posed((one, other), how) for one, other in judged) if each.found]
            if found:
                best = min(found, key=rank)
                return best if all(same(best.pose, each.pose) for each in found) else result
        return result

    def posed(self, seen: Views, how: str) -> Tracking:
        """From two views to the pose."""
        if not (all(view.useful for view in seen) and any(view.found for view in seen)):
            each = self._unconfirmed(seen)
            return Tracking(lost(views.unseen(each)), each)
        found = estimate(*self._sightings(seen), self.target, self.optics_in_use)
        if not found.found:
            if not all(view.found for view in seen):
                return Tracking(found, self._unconfirmed(seen))
            if exchanged(*self._sightings(seen), self.target, self.optics_in_use):
                found = lost(EXCHANGED)
            return Tracking(found, views.doubted(seen, found.reason))
        if not found.used.all():
            one, other = self._expected(0, found.world_from_target), self._expected(1, found.world_from_target)
            seen = views.with_predicted(seen[0], one, found.used[0]), views.with_predicted(seen[1], other, found.used[1])
        return Tracking(found, seen, how)

    def _sightings(self, seen: Views) -> tuple[Sighting, Sighting]:
        return seen[0].outlines.sighting(self.cameras[0]), seen[1].outlines.sighting(self.cameras[1])

    def _unconfirmed(self, seen: Views) -> Views:
        """Two views that don't confirm each other."""
        return views.unconfirmed(seen[0], self.cameras[0], self.target), views.unconfirmed(seen[1], self.cameras[1], self.target)

    def _segmented(self, frames: Frames, networks: Networks, rough: Ellipses, before: Tracking) -> Tracking:
        """From rough ellipses of both views to the pose, by the segmenter."""
        cuts = [
            circle_segmenter.patches(frame, at, circle_segmenter.step_for(at, self.target))
            for frame, at in zip(frames, (rough.centre[: self.count], rough.centre[self.count :]), strict=True)
        ]
        masks = networks.segment(np.concatenate([cut.images for cut in cuts]))
        halves = [
            circle_segmenter.read(half, cut) for half, cut in zip((masks[: self.count], masks[self.count :]), cuts, strict=True)
        ]
        if min(np.isfinite(half.centre[:, 0]).sum() for half in halves) < 2:
            return before
        (outlines,) = measure_all(*frames, [self._sought(joined(halves), circle_segmenter.OFF)])
        return self._fitted(frames, outlines, "segmented")

    def find(self, detections: Detections) -> Tracking:
        """Search both frames, level by level of what the detector sees of them."""
        parts = self.find_in_parts(detections)
        while True:
            try:
                next(parts)
            except StopIteration as end:
                return end.value

    def find_in_parts(self, detections: Detections) -> Generator[None, None, Tracking]:
        """The same in parts of a few windows or a naming each, between which something else may be done."""
        levels = [circle_detector.levels(camera.size) for camera in self.cameras]
        usual = [circle_detector.usual_level(each, self.disc_px) for each in levels]
        result, shown = None, list[tuple[bool, int]]()
        for number in range(max(map(len, levels))):
            windows = [each[number] if number < len(each) else () for each in levels]
            if number and not self._at_any_size() and number not in usual:
                continue
            seen = yield from self._detected_in(detections, windows)
            if isinstance(seen, Tracking):
                return seen
            most = sorted(map(_shown, seen), reverse=True)
            if result is None or most > shown:
                result, shown = self._settled(detections.frames, seen, "detected"), most
            if any(view.found for view in result.views) or all(view.found for view in seen):
                return result  # its size is known, so finer levels show nothing else
        assert result is not None  # there is a level of the whole frame
        return result

    def _at_any_size(self) -> bool:
        """Whether the target may be of any size: now and then, as a search for small circles takes its time."""
        return self._missed % ALL_LEVELS == (0 if self.disc_px is None else ALL_LEVELS - 1)

    def _detected_in(
        self, detections: Detections, windows: Sequence[Sequence[Window]]
    ) -> Generator[None, None, Tracking | Views]:
        """Search windows of both frames; verify each pose hypothesis (P3P) of one view in the other.

        Without a pose the views that show most of the target.
        """
        frames, networks = detections.frames, detections.networks
        places = [(k, window) for k, each in enumerate(windows) for window in each]
        seen: list[Candidates] = []
        for first in range(0, len(places), AT_ONCE):
            seen += detections.candidates(places[first : first + AT_ONCE], self.count)
            yield
        choices = [
            (k, naming)
            for (k, window), candidates in zip(places, seen, strict=True)
            for naming in identity.namings(candidates, self.target, window.width)
        ]
        counts = [sum(len(each.points) for (k, _), each in zip(places, seen, strict=True) if k == view) for view in (0, 1)]
        likeliest: dict[int, View] = {}
        settled: dict[int, Naming] = {}
        for k, naming in sorted(choices, key=lambda choice: -choice[1].score)[:TRIALS]:
            if k in settled and naming.within(settled[k]):
                continue
            view = self._seen_at(frames, networks, k, naming)
            if k not in likeliest or _shown(view) > _shown(likeliest[k]):
                likeliest[k] = view
            if view.found:
                settled[k] = naming
                others = self._opposite_views(frames, k, view)
                results = [self.posed((view, other) if k == 0 else (other, view), "detected") for other in others]
                if any(result.found for result in results):
                    return _likeliest(results)
                likeliest.update((1 - k, other) for other in others if other.found)
            yield
        first, second = (likeliest.get(k, views.absent(count, self.count)) for k, count in enumerate(counts))
        return views.in_light(first, frames[0]), views.in_light(second, frames[1])

    def _opposite_views(self, frames: Frames, k: int, view: View) -> list[View]:
        """Views of the other camera at the circles that each pose hypothesis of camera k's view predicts."""
        poses = pose_hypotheses.poses(self.cameras[k], view.outlines.rings.centre, circle_layout.circle_centres(self.target))
        expected = [self._expected(1 - k, pose) for pose in poses]
        return [self.judged(1 - k, self._view(frames, 1 - k, rough, FOLLOWED)) for rough in expected]

    def _seen_at(self, frames: Frames, networks: Networks, k: int, naming: Naming) -> View:
        """View of one camera at predicted places of its circles."""
        rough = circle_segmenter.rough_ellipses(frames[k], naming.points, networks, self.target)
        rims = measure(frames[k], rough, reach_px(rough, circle_segmenter.OFF), self.target)
        rims = covered_circle.named_and_completed(frames[k], rims, self.target)
        view, wide = self.judged(k, views.renamed(rims, self.target, self.cameras[k])), views.diameter(rough)
        return replace(view, reason=views.too_small(wide)) if not view.found and wide < circle_detector.LEAST_PX else view

    def judged(self, k: int, outlines: Outlines) -> View:
        """Camera k's view of some rims."""
        return views.judged(outlines, self.target, self.cameras[k])

    def _view(self, frames: Frames, k: int, rough: Ellipses, reach: float) -> Outlines:
        """Camera k's rims, from rough ellipses."""
        return covered_circle.completed(frames[k], measure(frames[k], rough, reach_px(rough, reach), self.target), self.target)


@dataclass
class _Watch:
    """Seconds of each stage."""

    seconds: dict[str, float] = field(default_factory=dict)
    since: float = field(default_factory=perf_counter)

    def stop(self, stage: str) -> None:
        now = perf_counter()
        self.seconds[stage], self.since = now - self.since, now


def rank(result: Tracking) -> tuple[int, float]:
    """To find the right tilt first: a wrong one misses circles, or else fits worse."""
    return -result.pose.freedom, result.pose.misfit


def _likeliest(results: Sequence[Tracking]) -> Tracking:
    """Of results by several hypotheses the one found that ranks first; none if another pose fits as many circles as well."""
    best, *others = sorted((one for one in results if one.found), key=rank)
    rivals = [
        one.pose for one in others if one.pose.freedom == best.pose.freedom and one.pose.misfit < best.pose.misfit + DISTINCT
    ]
    if all(same(best.pose, rival) for rival in rivals):
        return best
    pose = lost(UNTOLD)
    return Tracking(pose, views.doubted(best.views, pose.reason))


def _shown(view: View) -> tuple[bool, int]:
    """To prefer the view that shows most of the target."""
    return view.found, int(view.outlines.found.sum())
