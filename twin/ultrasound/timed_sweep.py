"""A freehand sweep: the scanner's images and the cameras' poses, each by its own clock, and their truth."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from recon.errors import InputError
from recon.geometry import rigid
from recon.model import tracks
from recon.model.rig import NotNegative, Part, Positive, Probe
from recon.model.tracks import LagSeconds, Track
from twin import conditions
from twin.ultrasound.bscan import scans
from twin.ultrasound.bscan_truth import labels
from twin.ultrasound.echo_solids import Body
from twin.ultrasound.transducer import Transducer

Array = NDArray[np.float64]

STILL = conditions.Motion()
Jitter = Annotated[float, Field(ge=0, le=1)]  # s


class Clocks(Part):
    """Rates of scanner and cameras, and errors of their time stamps. Truth is the cameras' clock."""

    scanner_hz: Positive = 20.0
    """images/s; usual at 5 cm with compounding; of wires, rows and tilts one image a rest instead, unless the path's `rest_s`
    is 0"""
    camera_hz: Positive = 40.0
    """pairs of frames/s, or poses/s; assumed, a fifth of what the cameras could"""
    lag_s: LagSeconds = 0.05
    """s, delay of the scanner's time stamps: stamped t, an image shows the probe as it stood at t - lag; assumed, a frame
    grabber's"""
    scanner_jitter_s: Jitter = 0.002
    """s, standard deviation of a stamp; assumed, a computer that isn't a real-time one"""
    camera_jitter_s: Jitter = 0.0
    """s; the cameras are triggered"""


class PoseNoise(Part):
    """Errors of the tracked poses, independent from frame to frame; standard deviations in each axis."""

    turn_deg: NotNegative = 0.05  # about the target's own axes
    shift_mm: NotNegative = 0.03  # in the world


@dataclass(frozen=True, eq=False)
class TargetMotion:
    """The target's true motion at the cameras' m moments."""

    path: Track  # world_from_image
    times: NDArray[np.int64]  # (m,) ns
    target_from_image: Array  # (m, 4, 4); a bracket may give

    def poses(self, later_s: float = 0.0) -> Array:
        """Poses `world_from_target` : (m, 4, 4) somewhat later than the moments; at them where the path has none any more."""
        at_once, shifted = (tracks.at(self.path, self.times + round(step * 1e9)) for step in (0.0, later_s))
        led = np.where(np.isfinite(shifted), shifted, at_once)
        return np.stack([pose @ rigid.invert(held) for pose, held in zip(led, self.target_from_image, strict=True)])


@dataclass(frozen=True, eq=False)
class Plan:
    """Plan of a sweep: true times and poses of its n images, and both clocks' stamps and the tracked poses."""

    times: NDArray[np.int64]  # (n,) ns, the scanner's stamps
    track: Track  # world_from_target by the cameras
    truth: Track  # world_from_image at the moments when the images are taken
    target: TargetMotion


@dataclass(frozen=True, eq=False)
class Sweep:
    """The recording of a sweep, and its truth."""

    images: NDArray[np.uint8]  # (n, h, w)
    times: NDArray[np.int64]  # (n,) ns, the scanner's stamps
    track: Track  # world_from_target by the cameras
    truth: Track  # world_from_image at the moments when the images were taken
    labels: NDArray[np.uint8]  # (n, h, w) as of `truth.labels`


def sweep(
    body: Body, transducer: Transducer, probe: Probe, path: Track, clocks: Clocks, pose_noise: PoseNoise, seed: int
) -> Sweep:
    """Record a sweep at the scanner's rate, whole in memory; `plan` and `bscan.scans` give the same one by one.

    Parameters
    ----------
    probe : of the rig, which says how the image stands in the target's frame.
    path : Track of `world_from_image`, as of `twin.ultrasound.probe_path`.

    Raises
    ------
    InputError
        If the path is shorter than two images.
    """
    planned = plan(probe, path, moments(path, clocks.scanner_hz), clocks, pose_noise, seed)
    taken = list(scans(body, transducer, planned.truth.poses, seed))
    images, shown = np.stack([one.image for one in taken]), np.stack([labels(one.paths, transducer) for one in taken])
    return Sweep(images, planned.times, planned.track, planned.truth, shown)


def moments(path: Track, rate_hz: float) -> NDArray[np.int64]:
    """Moments : (n,) ns on a path, at an even rate from its start."""
    length = (path.times[-1] - path.times[0]) * 1e-9
    most_moments = 1_000_000  # of a sweep
    if length * rate_hz > most_moments:
        found = f"{length * rate_hz:.3g} at {rate_hz:g} Hz over {length:g} s"
        raise InputError(f"clocks: expected up to {most_moments} images, found {found}")
    return path.times[0] + np.rint(np.arange(int(length * rate_hz) + 1) * 1e9 / rate_hz).astype(np.int64)


def plan(
    probe: Probe,
    path: Track,
    taken: NDArray[np.int64],
    clocks: Clocks,
    pose_noise: PoseNoise,
    seed: int,
    errors: conditions.Motion = STILL,
) -> Plan:
    """Plan a sweep whose images are taken at moments : (n,) ns on the path; the cameras see the probe where the path has poses.

    errors : of which the bracket's is added: the target moves against the image.

    Raises
    ------
    InputError
        If there are fewer than two images.
    """
    rng = np.random.default_rng(seed)
    if len(taken) < 2:
        length = (path.times[-1] - path.times[0]) * 1e-9
        raise InputError(f"path: expected one that lasts two images, found {length:.3f} s")
    stamps = _stamped(taken, clocks.lag_s, clocks.scanner_jitter_s, rng)
    tracked = moments(path, clocks.camera_hz)
    tracked = tracked[np.isfinite(tracks.at(path, tracked)).all(axis=(1, 2))]
    design, given = probe.target_from_image.matrix(), conditions.given(errors, tracked, seed)
    target = TargetMotion(path, tracked, np.stack([rigid.moved(design, step) for step in given]))
    seen = noisy(target.poses(), pose_noise, rng)
    track = Track(_stamped(tracked, 0.0, clocks.camera_jitter_s, rng), seen)
    return Plan(stamps, track, Track(taken, tracks.at(path, taken)), target)


def _stamped(moments: NDArray[np.int64], lag_s: float, jitter_s: float, rng: np.random.Generator) -> NDArray[np.int64]:
    """Stamps in order: a jitter beyond the frame's period can't turn two around."""
    stamps = moments + np.rint(1e9 * (lag_s + jitter_s * rng.standard_normal(len(moments)))).astype(np.int64)
    return np.maximum.accumulate(stamps) + np.arange(len(stamps))


def noisy(poses: Array, noise: PoseNoise, rng: np.random.Generator) -> Array:
    """Poses : (n, 4, 4) as cameras find them."""
    turns = np.deg2rad(noise.turn_deg) * rng.standard_normal((len(poses), 3))
    result = np.stack([pose @ rigid.from_rotation_vector(turn, np.zeros(3)) for pose, turn in zip(poses, turns, strict=True)])
    result[:, :3, 3] += noise.shift_mm * rng.standard_normal((len(poses), 3))
    return result
