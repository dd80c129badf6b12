"""Recordings of a tracked target, made of a led path, a drawn tremor, noise, and jitter of triggers."""

from typing import NamedTuple

import numpy as np

from recon.geometry import rigid
from recon.identification.tracker_noise import Recording
from recon.model import circle_layout
from twin import tremor

START = rigid.from_rotation_vector([np.pi, 0.0, 0.0], [0.0, 20.0, 660.0])


class Hand(NamedTuple):
    """What a recording is made with."""

    tremor_mm: float = 0.0
    tremor_deg: float = 0.0
    trigger_s: float = 0.0
    led_mm: float = 0.0  # amplitude of the path along each axis
    noise: float = 1.0  # of poses and centres, over the predicted one
    hz: float = 30.0
    count: int = 90


def record(rig, hand: Hand, seed: int, contrast: float = 80.0, centre_px: float = 0.01) -> Recording:
    """A recording; the tremor is about the circles' middle, and poses' noise is drawn apart from the centres'."""
    rng, about = np.random.default_rng([seed, 81]), circle_layout.middle(rig.target)
    shaken = tremor.draw(hand.tremor_deg, hand.tremor_mm, seed, 82)
    hz, phases = rng.uniform(0.1, 0.8, 6), rng.uniform(0, 2 * np.pi, 6)
    size = hand.led_mm * np.array([0.004, 0.004, 0.004, 1, 1, 1])
    middle = rigid.apply(START, about)

    def true_pose(seconds: float):
        fast, led = shaken.at(seconds), size * np.sin(2 * np.pi * hz * seconds + phases)
        turned = rigid.from_rotation_vector(fast[:3], np.zeros(3)) @ rigid.from_rotation_vector(led[:3], np.zeros(3)) @ START
        return rigid.transform(turned[:3, :3], middle + led[3:] + fast[3:] - turned[:3, :3] @ about)

    times = np.arange(hand.count) / hand.hz
    spread = np.array([3e-4, 3e-4, 1e-4, 0.004, 0.004, 0.02]) * rng.uniform(0.5, 2)
    poses = np.array([rigid.moved(true_pose(t), hand.noise * spread * rng.standard_normal(6)) for t in times])
    covariance = np.tile(np.diag(spread**2), (hand.count, 1, 1))
    late = hand.trigger_s * rng.standard_normal((hand.count, 2))
    points = circle_layout.circle_centres(rig.target)
    cameras = [device.optics.camera() for device in (rig.cam1, rig.cam2)]
    centres = np.array([
        [camera.project(rigid.apply(true_pose(t + own), points)) for camera, own in zip(cameras, both, strict=True)]
        for t, both in zip(times.tolist(), late.tolist(), strict=True)
    ])  # fmt: skip
    centres += hand.noise * centre_px * rng.standard_normal(centres.shape)
    shape = centres.shape[:3]
    return Recording(
        times, poses, covariance, centres, np.broadcast_to(centre_px**2 * np.eye(2), (*shape, 2, 2)),
        np.full(shape, contrast), np.zeros(shape), np.ones(hand.count, bool),
    )  # fmt: skip


def cameras(rig):
    return rig.cam1.optics.camera(), rig.cam2.optics.camera()
