"""Captures of sweeps: crossed wires, a tank's bottom, and a bright ball, as a rig with a perfect scanner would record them."""

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from recon.capture import sweep_part
from recon.freehand import sequences
from recon.geometry import rigid
from recon.model import tracks
from recon.model.probe import ProbeCalibration
from recon.model.tracks import Track
from recon.probe_calibration import sound_in_water
from tests.recon import bscans, captures, probe_motions

START_NS = 10**18  # of the clocks: seconds since 1970
WATER_C = 22.0
BORDER = (40, 60)  # px, of a screen to the left of the B-scan and above it; as much again to the right and below
BLANK, UNTRACKED = 4, 12  # frames of the wires' sweep
BALL = np.array([12.0, -8.0, 710.0])  # mm, in the world
BALL_MM = 6.0  # its radius


def nanoseconds(seconds):
    return START_NS + np.round(np.asarray(seconds, float) * 1e9).astype(np.int64)


def probe_in_water(rig) -> ProbeCalibration:
    """The rig's probe, where the scanner assumes 1540 m/s and the wires are in water."""
    probe = probe_motions.true_probe(rig)
    return sound_in_water.in_medium(probe, sound_in_water.SCANNER_SPEED, float(sound_in_water.speed_of_sound(WATER_C)))


def wires(folder: Path, rig, rng, lag_s: float = 0.0) -> Path:
    """The crossing of two wires, the probe at rest for 0.1 s at each of 30 frames; one shows none, one isn't tracked."""
    turns, pixels = probe_motions.motion(rig)
    seen = probe_motions.observe(probe_in_water(rig), turns, pixels, rng)
    poses = seen.poses.copy()
    poses[UNTRACKED] = np.nan
    moments = np.arange(len(poses), dtype=float)

    def images():
        for k, pixel in enumerate(seen.pixels):
            wire = 0 if k == BLANK else bscans.spot(pixel)
            yield bscans.image(wire + bscans.face(), rng)

    track = Track(nanoseconds((moments[:, None] + [-0.05, 0.05]).ravel()), np.repeat(poses, 2, axis=0))
    captures.write_sweep(folder, images(), nanoseconds(moments + lag_s), track, bscans.SIZE, name="wires")
    return folder


def height(t):
    """Of the probe, mm: up and down by some 10 mm at an uneven pace."""
    return 9 * np.sin(2 * np.pi * (0.6 * t + 0.25 * np.sin(0.9 * t))) + 3 * np.sin(2.4 * t + 1)


def bottom(folder: Path, rng, lag_s: float, slips_mm: float = 0.0) -> Path:
    """Six seconds over a flat bottom at 15 frames/s, tracked at 40 poses/s; the target may slip along the probe meanwhile."""
    shown, tracked = np.arange(0.3, 6, 1 / 15), np.arange(0, 6.3, 1 / 40)
    poses = np.array(
        [rigid.transform(np.eye(3), [5, -3, 700 - h - slips_mm * t / 6]) for t, h in zip(tracked, height(tracked), strict=True)]
    )
    poses[50:53] = np.nan
    images = (bscans.image(bscans.bottom((32 + h) / bscans.MM_PER_PX) + bscans.face(), rng) for h in height(shown))
    times = nanoseconds(shown + lag_s)
    captures.write_sweep(folder, images, times, Track(nanoseconds(tracked), poses), bscans.SIZE, name="bottom")
    return folder


def ball(folder: Path, rig, lag_s: float = 0.0, count: int = 41, with_probe: bool = True) -> Path:
    """A sweep across a bright ball, at 10 mm/s and tilted by 20 degrees; small B-scans, a quarter of the rig's each way."""
    design = rig.probe
    size = (80, 100)
    probe = ProbeCalibration(design.target_from_image.matrix(), 4 * np.array(design.scale_mm_per_px))
    turn = Rotation.from_euler("YX", [20, 0], degrees=True).as_matrix() @ probe_motions.LOOKING_AWAY
    moments = np.linspace(-1, 1, count)
    middle = probe.scale * (np.array(size) - 1) / 2

    def world_from_image(t):
        centre = BALL + turn[:, 2] * 10 * t
        return rigid.transform(turn, centre - turn[:, :2] @ middle)

    u, v = np.meshgrid(np.arange(size[0]), np.arange(size[1]))
    plane = np.stack([u * probe.scale[0], v * probe.scale[1], np.zeros(u.shape)], axis=-1)
    images = (
        np.where(np.linalg.norm(rigid.apply(world_from_image(t), plane) - BALL, axis=-1) < BALL_MM, 200, 20).astype(np.uint8)
        for t in moments
    )
    tracked = np.arange(-1.1, 1.1, 0.03)
    poses = np.array([world_from_image(t) @ rigid.invert(probe.target_from_image) for t in tracked])
    times, track = nanoseconds(moments + lag_s), Track(nanoseconds(tracked), poses)
    captures.write_sweep(folder, images, times, track, size, probe if with_probe else None, "ball")
    return folder


def on_screen(image):
    """A B-scan in a frame grabber's picture of the whole screen: bright, with a line of text as high as a wire's echo."""
    across, above = BORDER
    screen = np.pad(image, ((above, above), (across, across)), constant_values=120)
    screen[above // 2 - 4 : above // 2 + 4, ::3] = 255
    return screen


def recorded(path: Path, capture: Path, probe: ProbeCalibration | None = None, screen: bool = False) -> Path:
    """The sweep of a capture as PLUS records it: a pose a B-scan, at its time stamp, in the tracker's frame."""
    sweep = sweep_part.read_sweep(capture)
    poses = tracks.at(sweep.track, sweep.times)
    found = np.isfinite(poses).all(axis=(1, 2))
    transforms = {"ProbeToTracker": np.where(found[:, None, None], poses, np.eye(4))}
    valid = {"ProbeToTracker": found, "Image": np.ones(len(poses), bool)}
    if probe is not None:
        transforms["ImageToProbe"] = np.tile(sequences.target_from_pixel(probe), (len(poses), 1, 1))
        valid["ImageToProbe"] = np.ones(len(poses), bool)
    images = np.stack([on_screen(image) if screen else image for image in sweep.images()])
    times_s = (sweep.times - START_NS) * 1e-9
    sequences.write_sequence(path, sequences.Frames(times_s, transforms, valid, images))
    return path
