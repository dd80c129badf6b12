"""A probe that keeps moving over a phantom: its track and the phantom's echoes, by clocks that jitter, drop frames and differ."""

import numpy as np
from scipy.interpolate import PchipInterpolator
from scipy.spatial.transform import Rotation

from recon.capture.sweep_part import SweepCapture
from recon.geometry import rigid
from recon.model.tracks import Track
from recon.probe_calibration import plus_phantom, point_calibration
from recon.probe_calibration.cross_wire import Crossing
from recon.probe_calibration.phantom_frames import PhantomFrames
from recon.probe_calibration.wire_dots import Dots
from tests.recon import bscans, probe_motions, wire_rows
from tests.recon.sweep_sets import nanoseconds

SCANNER_HZ, CAMERA_HZ = 5.0, 40.0
JITTER_S, DROPPED = 0.002, 0.1  # of the B-scans' time stamps; share of the B-scans
CROSSING_PX = 0.15  # 1 sigma


def led(values, seconds):
    """Values : (n, k) through which a hand leads smoothly within some seconds, as a function of moments : (m,) s."""
    return PchipInterpolator(np.linspace(0, seconds, len(values)), values)


def _clocks(seconds, lag_s, rng):
    """Moments (n,) s of the B-scans, at an uneven pace, their stamps (n,) ns, and moments (m,) s of the poses."""
    taken = np.arange(0.7, seconds - 0.7, 1 / SCANNER_HZ)
    taken += rng.uniform(-0.3, 0.3, len(taken)) / SCANNER_HZ
    taken = taken[rng.random(len(taken)) > DROPPED]
    return taken, nanoseconds(taken + lag_s + JITTER_S * rng.standard_normal(len(taken))), np.arange(0, seconds, 1 / CAMERA_HZ)


def _sweep(stamps, moments, poses, rng):
    """Tracked with noise in each pose."""
    seen = rigid.moved(poses, rng.standard_normal((len(poses), 6)) * np.repeat([np.radians(0.08), 0.05], 3))
    return SweepCapture("drawn", bscans.SIZE, (), np.arange(len(stamps)), stamps, Track(nanoseconds(moments), seen))


def over_crossing(rig, lag_s, rng, seconds=40.0, rest=False):
    """A sweep without images over crossed wires, and its frames, not yet at poses; at rest the crossing and the probe stay."""
    probe = probe_motions.true_probe(rig)
    turns, pixels = point_calibration.motion(rig.probe.image_size, int(seconds / 2) + 1, roll_deg=60.0)
    turn_at, pixel_at = led(turns, seconds), led(pixels, seconds)
    taken, stamps, moments = _clocks(seconds, lag_s, rng)
    if rest:  # in each pose for two seconds
        turn_at, pixel_at = (lambda t, each=each: each[np.rint(np.asarray(t) / 2).astype(int)] for each in (turns, pixels))
        taken = np.rint(taken / 2) * 2 + 0.1 * (taken - np.rint(taken / 2) * 2)
        stamps = nanoseconds(taken + lag_s)
    poses = probe_motions.poses_of(probe, turn_at(moments), pixel_at(moments))
    seen = pixel_at(taken) + CROSSING_PX * rng.standard_normal((len(taken), 2))
    crossings = tuple(Crossing(pixel, CROSSING_PX**2 * np.eye(2), 20.0) for pixel in seen)
    frames = PhantomFrames(
        "drawn", bscans.SIZE, None, np.arange(len(taken)), crossings, poses=np.full((len(taken), 4, 4), np.nan)
    )
    return _sweep(stamps, moments, poses, rng), frames


def over_rows(rig, lag_s, rng, seconds=40.0):
    """The same over the N-wires of fCal 2, which lie up to some 0.1 mm beside their places."""
    probe, phantom = probe_motions.true_probe(rig), wire_rows.FCAL
    count = int(seconds / 1.5) + 1
    way = led(rng.uniform(-1, 1, (count, 6)) * [15, 15, 6, 10, 2, 2], seconds)  # deg about three axes, mm along, mm in the image
    upright = np.column_stack([phantom.across[0], -phantom.across[1], phantom.along])
    upright[:, 2] *= np.linalg.det(upright)
    middle = phantom.ends.mean(axis=(0, 1, 2))

    def poses_at(moments):
        result = []
        for each in way(moments):
            turn = upright @ Rotation.from_euler("YXZ", each[:3], degrees=True).as_matrix()
            centre = np.append((np.array(bscans.SIZE) - 1) / 2 * probe.scale + each[4:], 0.0)
            held = rigid.transform(turn, middle + each[3] * phantom.along - turn @ centre)
            result.append(wire_rows.WORLD_FROM_PHANTOM @ held @ rigid.invert(probe.target_from_image))
        return np.array(result)

    taken, stamps, moments = _clocks(seconds, lag_s, rng)
    seen = wire_rows.dots_of(probe, phantom, poses_at(taken), 0.1 * rng.standard_normal((phantom.count, 3)))
    seen += wire_rows.PIXEL_PX * rng.standard_normal(seen.shape)
    own = np.tile(wire_rows.PIXEL_PX**2 * np.eye(2), (1, phantom.count, 1, 1))
    dots = tuple(Dots(pixels[None], own, 20.0) for pixels in seen)
    numbers, none = np.arange(len(taken)), np.full((len(taken), 4, 4), np.nan)
    frames = PhantomFrames("drawn", bscans.SIZE, None, numbers, dots, phantom="n_wires", known=plus_phantom.FCAL, poses=none)
    return _sweep(stamps, moments, poses_at(moments), rng), frames
