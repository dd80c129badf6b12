"""Poses over time: a tracker's poses of a moving body, and its pose at any moment between."""

from dataclasses import dataclass
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, PlainValidator
from scipy.spatial.transform import Rotation, Slerp

from recon import arguments
from recon.errors import InputError
from recon.geometry import rigid

Array = NDArray[np.float64]
MOST_LAG_S = 1e6
LagSeconds = Annotated[float, Field(ge=-MOST_LAG_S, le=MOST_LAG_S, allow_inf_nan=False)]  # s that stamps of images are late


def _of_setting(value: Any) -> float | Literal["free"]:
    """Seconds, or the word free."""
    if value == "free":
        return "free"
    if isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= MOST_LAG_S:
        return float(value)
    raise ValueError(f"expected free, or a number from -{MOST_LAG_S:g} to {MOST_LAG_S:g}, found {value}")


FreeLagSeconds = Annotated[float | Literal["free"], PlainValidator(_of_setting)]  # the same, or one that is found
MAX_GAP_S = 0.25  # between two poses, over which none is interpolated
SAME_S = 0.5e-3  # a time that is rounded to ms: at it a pose holds, however far away the next is


@dataclass(frozen=True)
class Track:
    """Poses `world_from_target` of n moments, in order of time. Whoever tracks, optically or by other means, hands this on."""

    times: NDArray[np.int64]  # (n,) ns, of the tracker's clock, strictly increasing
    poses: Array  # (n, 4, 4) mm; NaN where the target was not found
    covariance: Array | None = None  # (n, 6, 6) of a turn (rad) after the pose's own, and a shift (mm) in the world
    shared: Array | None = None  # (n, 6, 6) the same by what errs alike in all poses: tolerances of target and cameras

    def __post_init__(self) -> None:
        times = arguments.numbers("times", self.times, ("n",))
        if times.dtype.kind == "f":
            raise InputError(f"times: expected whole ns, found {arguments.described(times)}: seconds?")
        arguments.numbers("poses", self.poses, (len(times), 4, 4), finite=False)
        for name in ("covariance", "shared"):
            if (value := getattr(self, name)) is not None:
                arguments.numbers(name, value, (len(times), 6, 6), finite=False)
        if len(times) > 1 and (late := int(np.argmax(np.diff(times) <= 0))) + 1 and times[late + 1] <= times[late]:
            raise InputError(f"times: expected each later than the one before, found {times[late]}, then {times[late + 1]} ns")
        if self.shared is not None and self.covariance is None:
            raise ValueError("shared: expected with a covariance of each pose alone, found without")

    @property
    def found(self) -> NDArray[np.bool_]:
        """Where there is a pose : (n,)."""
        return np.isfinite(self.poses).all(axis=(1, 2))


def at(track: Track, times: NDArray[np.int64], max_gap_s: float = MAX_GAP_S) -> Array:
    """Poses at other moments : (m,) ns of the track's clock, as (m, 4, 4); NaN outside, and within gaps of the track.

    At the moment of a pose that pose holds, as of stills that are taken one by one. Between two poses the rotation
    turns about one axis at constant speed and the origin moves along a straight line.
    """
    known = track.found
    result = np.full((len(times), 4, 4), np.nan)
    if not known.any():
        return result
    seconds = (track.times[known] - track.times[0]) * 1e-9
    wanted = (np.asarray(times) - track.times[0]) * 1e-9
    poses, after = track.poses[known], np.searchsorted(seconds, wanted)
    for near in (np.clip(after - 1, 0, len(seconds) - 1), np.clip(after, 0, len(seconds) - 1)):
        coinciding = np.abs(seconds[near] - wanted) <= SAME_S
        result[coinciding] = poses[near[coinciding]]
    if len(seconds) < 2:
        return result
    after = np.clip(after, 1, len(seconds) - 1)
    inside = (wanted >= seconds[0]) & (wanted <= seconds[-1]) & (seconds[after] - seconds[after - 1] <= max_gap_s)
    result[inside] = np.eye(4)
    result[inside, :3, :3] = Slerp(seconds, Rotation.from_matrix(poses[:, :3, :3]))(wanted[inside]).as_matrix()
    result[inside, :3, 3] = np.column_stack([np.interp(wanted[inside], seconds, poses[:, axis, 3]) for axis in range(3)])
    return result


def relative(track: Track, reference: Track, at_first: Track) -> Track:
    """A track in the world as it was when a reference body stood at its first pose: how that moved since is undone.

    `world_from_body` becomes `world_from_first_reference @ reference_from_world @ world_from_body`. What errs alike in all poses
    of the reference errs so in a first one of the same cameras and target, too, and mostly cancels; the first one's own noise is
    alike in all that follows.

    Parameters
    ----------
    track, reference : of the same n moments; where the reference wasn't found there is no pose
    at_first : the reference's first pose, the first one of this track that was found; without a shared part, if it is of other
        cameras or another measured target

    Raises
    ------
    InputError
        If the reference has no first pose, or the moments differ.
    """
    if not np.array_equal(track.times, reference.times):
        raise InputError(f"reference: expected poses at the track's {len(track.times)} moments, found those of others")
    if not at_first.found.any():
        raise InputError("at_first: expected a pose of the reference, found none")
    first = int(np.argmax(at_first.found))
    start = at_first.poses[first]
    back = np.array([start @ _inverse(pose) for pose in reference.poses])
    poses = back @ track.poses
    turned = back[:, :3, :3]
    by_body, by_reference, by_first = (np.zeros((len(poses), 6, 6)) for _ in range(3))
    by_body[:, :3, :3] = by_body[:, 3:, 3:] = turned
    by_reference[:, :3, :3] = by_reference[:, 3:, 3:] = -turned
    by_reference[:, 3:, :3] = turned @ rigid.cross(track.poses[:, :3, 3] - reference.poses[:, :3, 3])
    by_first[:, :3, :3] = by_first[:, 3:, 3:] = np.eye(3)
    by_first[:, 3:, :3] = -rigid.cross(poses[:, :3, 3] - start[:3, 3])

    def spread(slopes: Array, covariance: Array) -> Array:
        return slopes @ covariance @ np.swapaxes(slopes, 1, 2)

    own = shared = None
    if track.covariance is not None and reference.covariance is not None:
        own = spread(by_body, track.covariance) + spread(by_reference, reference.covariance)
    if own is not None and track.shared is not None and reference.shared is not None:
        apart = at_first.covariance is not None and at_first.shared is None
        shared = spread(by_body, track.shared) + spread(by_reference if apart else by_reference + by_first, reference.shared)
        if at_first.covariance is not None:
            shared = shared + spread(by_first, at_first.covariance[first])
    return Track(track.times, poses, own, shared)


def from_body(track: Track, body: Track) -> Track:
    """A track in the frame of another body: poses `body_from_target` at the track's moments, of the noise of both.

    Tolerances that both share, as those of the cameras, count twice, so that the shared part is no less than it is.
    """
    if not np.array_equal(track.times, body.times):
        body = Track(track.times, at(body, track.times), covariance_at(body, track.times), shared_at(body, track.times))
    still = Track(np.zeros(1, np.int64), np.eye(4)[None], np.zeros((1, 6, 6)))
    return relative(track, body, still)


def _inverse(pose: Array) -> Array:
    """Inverse of a pose; NaN of one that isn't known."""
    return rigid.invert(pose) if np.isfinite(pose).all() else np.full((4, 4), np.nan)


def neighbours_at(track: Track, times: NDArray[np.int64], lag_s: float) -> tuple[NDArray[np.intp], Array]:
    """Numbers : (n, 2) in the track of the poses of which `poses_at` makes those at n times, and their weights : (n, 2).

    Weights are NaN outside of the track. Of a track of one pose, the second weight is 0.
    """
    found = np.flatnonzero(track.found)
    wanted = np.asarray(times, np.int64) - np.int64(round(lag_s * 1e9))
    if len(found) < 2:
        numbers, shares = np.zeros((len(wanted), 2), np.intp), np.full((len(wanted), 2), np.nan)
        if len(found):
            numbers[:] = found
            shares[np.abs(wanted - track.times[found]) <= SAME_S * 1e9] = 1.0, 0.0
        return numbers, shares
    moments = track.times[found]
    after = np.clip(np.searchsorted(moments, wanted), 1, len(moments) - 1)
    apart = moments[after] - moments[after - 1]
    share, slack = (wanted - moments[after - 1]) / apart, SAME_S * 1e9 / apart
    shares = np.column_stack([1 - share, share])
    shares[(share < -slack) | (share > 1 + slack)] = np.nan
    return found[np.column_stack([after - 1, after])], shares


def shares_at(track: Track, times: NDArray[np.int64], lag_s: float) -> Array:
    """Weights : (n, m) of the m poses that were found, of which `poses_at` makes those at n times; NaN outside of the track."""
    numbers, weights = neighbours_at(track, times, lag_s)
    shares = np.zeros((len(weights), len(track.times)))
    np.add.at(shares, (np.arange(len(weights))[:, None], numbers), weights)
    shares[np.isnan(weights).any(axis=1)] = np.nan
    return shares[:, track.found]


def covariance_at(track: Track, times: NDArray[np.int64], lag_s: float = 0.0) -> Array | None:
    """Covariance : (n, 6, 6) of the poses of `poses_at`; NaN outside of the track. None if the track has none.

    A pose between two others shares the errors of both, taken as independent: halfway its variance is half of theirs.
    """
    return None if track.covariance is None else _blended(track.covariance, *neighbours_at(track, times, lag_s), power=2)


def shared_at(track: Track, times: NDArray[np.int64], lag_s: float = 0.0) -> Array | None:
    """Covariance : (n, 6, 6) of what errs alike in all these poses; NaN outside of the track. None if the track has none."""
    return None if track.shared is None else _blended(track.shared, *neighbours_at(track, times, lag_s), power=1)


def _blended(covariance: Array, numbers: NDArray[np.intp], shares: Array, power: int) -> Array:
    if not len(covariance):
        return np.full((len(numbers), 6, 6), np.nan)
    return np.einsum("nk,nkij->nij", shares**power, covariance[numbers])


def poses_at(track: Track, times: NDArray[np.int64], lag_s: float) -> Array:
    """Poses : (n, 4, 4) at which images of time stamps : (n,) ns were taken; NaN where the track has a gap.

    lag_s : how late the time stamps are; see `recon.probe_calibration.latency.Lag`.
    """
    return at(track, np.asarray(times, np.int64) - np.int64(round(lag_s * 1e9)))


def rates_at(track: Track, times: NDArray[np.int64], lag_s: float, step_s: float = 0.005) -> Array:
    """Change of these poses : (n, 4, 4) per s, by which a longer lag moves them back; zero where there is none.

    step_s : before and after each moment, to the poses that it is measured by
    """
    before, there, after = (poses_at(track, times, lag_s + step) for step in (step_s, 0.0, -step_s))
    rates = np.where(np.isfinite(before), there - before, after - there) / step_s
    both = np.isfinite(before) & np.isfinite(after)
    return np.nan_to_num(np.where(both, (after - before) / (2 * step_s), rates))
