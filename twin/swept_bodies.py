"""Bodies besides the probe in a sweep: led over the sweep's time, and tracked by the cameras as the probe is."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from recon.geometry import rigid
from recon.model.rig import Rig, Target
from recon.model.tracks import Track
from scenes.handheld.body_look import Look
from scenes.handheld.shaft import Shaft
from twin import conditions
from twin.tracking.film_path import STILL, Way
from twin.tracking.film_paths import insertion
from twin.tracking.led_bodies import LedBodies
from twin.tracking.views_of_target import cameras_of, covers, in_views
from twin.ultrasound import scan_lines
from twin.ultrasound.timed_sweep import Plan, PoseNoise, noisy
from twin.ultrasound.transducer import Transducer

Array = NDArray[np.float64]

SLICE_MM = 1.5  # of the B-scan to each side, in which a tip is seen; assumed, about a linear array's at its focus
POSES_LOOKED_AT = 5  # of the other bodies, evenly over the sweep, of which an insertion covers none
STREAM = 16  # of random numbers, apart from those of the probe's poses


@dataclass(frozen=True, eq=False)
class SweptBody:
    """A body besides the probe over a sweep of n images and m pairs of frames, or poses."""

    look: Look
    target: Target
    way: Way  # at any time of the path, s
    track: Track  # world_from_target by the cameras: (m,), stamped as the probe's poses; not found where a view lacks a circle
    truth: Track  # the same at the cameras' moments
    scanned: Track  # reference_from_target at the moments when the n images are taken; the patient may have moved since

    @property
    def shaft(self) -> Shaft | None:
        """The shaft that sound meets, in the target's frame; None of a body that stays outside."""
        return self.look.shaft(self.target)

    def in_view(self, rig: Rig) -> NDArray[np.bool_]:
        """Whether both cameras have its target in view : (m,), as of `in_views`."""
        return in_views(self.truth.poses, self.target, cameras_of(rig))

    def covers(self, target: Target, poses: Array, rig: Rig) -> NDArray[np.bool_]:
        """Whether its target and another one at poses : (m, 4, 4) lie before each other for a camera : (m,), as of `covers`."""
        pairs, cameras = zip(self.truth.poses, poses, strict=True), cameras_of(rig)
        return np.array([covers(own, self.target, other, target, cameras) for own, other in pairs])

    def in_slice(self, world_from_image: Array, rig: Rig) -> NDArray[np.bool_] | None:
        """Whether its tip lies in the B-scans : (n,) of poses (n, 4, 4), within their slice; None of a body without a tip."""
        tip = self.look.tip_mm(self.target)
        if tip is None:
            return None
        tips = [rigid.apply(rigid.invert(one) @ own, tip) for one, own in zip(world_from_image, self.scanned.poses, strict=True)]
        shown, beside = np.split(np.array(tips), [2], axis=1)
        size_mm = np.array(rig.probe.scale_mm_per_px) * (np.array(rig.probe.image_size) - 1)
        return ((shown >= 0) & (shown <= size_mm)).all(axis=1) & (np.abs(beside[:, 0]) <= SLICE_MM)


def lead(
    led: LedBodies,
    rig: Rig,
    transducer: Transducer,
    plan: Plan,
    noise: PoseNoise,
    seed: int,
    errors: conditions.Motion = STILL,
    filmed: bool = False,
) -> Mapping[str, SweptBody]:
    """Lead the rig's further bodies beside the probe, each by its name; if no path is given, needles to the B-scan, while what
    stands stays where it is.

    filmed : whether cameras film them, so that none should hide another one's target

    Raises
    ------
    InputError
        If a body finds no path, or an insertion is led by a body without a tip.
    """
    standing = led.standing(rig)
    face, bodies = mean_pose(scan_lines.world_from_face(transducer, plan.truth.poses) @ scan_lines.middle_of_face(transducer)), {}
    some = np.unique(np.linspace(0, len(plan.target.times) - 1, POSES_LOOKED_AT).astype(int))
    others = [(rig.target, plan.target.poses()[some])]
    numbered = sorted(enumerate(rig.bodies, 1), key=lambda each: led.look(each[1]).IN_A_HAND)  # what stands comes first
    for number, name in numbered:
        look, given, target = led.look(name), led.bodies.get(name), rig.bodies[name]
        to_image = look.line_mm(target) is not None and (given is None or given.path is None)
        path = insertion.Kind() if to_image else standing.get(name) or led.path_of(name, number - 1)
        way = led.lead(name, path, rig, face, seed, errors, others if filmed else ())
        truth, scanned = (_along(way, moments) for moments in (plan.target.times, plan.truth.times))
        seen = noisy(truth.poses, noise, np.random.default_rng([seed, STREAM, number]))
        seen[~in_views(truth.poses, target, cameras_of(rig))] = np.nan
        bodies[name] = SweptBody(look, target, way, Track(plan.track.times, seen), truth, scanned)
        others.append((target, truth.poses[some]))
    return {name: bodies[name] for name in rig.bodies}


def mean_pose(poses: Array) -> Array:
    """Mean (4, 4) of poses (n, 4, 4)."""
    return rigid.transform(Rotation.from_matrix(poses[:, :3, :3]).mean().as_matrix(), poses[:, :3, 3].mean(axis=0))


def _along(way: Way, moments: NDArray[np.int64]) -> Track:
    return Track(moments, np.stack([way.pose(time * 1e-9) for time in moments.tolist()]))
