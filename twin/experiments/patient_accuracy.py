"""A patient who moves between fringes and sweep, tracked by a target of its own: what is left of it between masses and skin.

Devices, targets and circles are drawn as in `drawn_check` and `drawn_session`; poses, their covariances and the patient's frame
are the real software's.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from recon.geometry import rigid
from recon.model import target_family, tracks
from recon.model.calibration import PRINT_SCALE, Calibration
from recon.model.rig import PATIENT, PROBE
from recon.model.tracks import Track
from recon.rig_check import drift
from recon.rig_check.optics_equations import PROJECTOR, points_by_light
from scenes.board_poses import Config as Poses
from twin import conditions
from twin.experiments import drawn_check, drawn_session
from twin.experiments.drawn_session import Eye, Noise, Tracked, pair
from twin.experiments.experiment_setup import Figures, Setup

Array = NDArray[np.float64]

SEED = 3047
COLUMNS = (0,)  # axes of the fringes
SKIN_MM = (4.0, -2.0, 655.0)  # a place of the skin over the mass
DEPTH_MM = 25.0  # of the mass below it
PATIENT_MM, APART_MM = (75.0, 0.0, 680.0), (-25.0, 0.0, 0.0)  # the patient's target, and the scan's place, from the middle
SHIFT_MM, TURN_DEG = 20.0, 5.0  # of the patient, in any direction


class Errors(NamedTuple):
    """Errors : (3,) mm of the mass from the skin."""

    still: Array  # the patient didn't move, and isn't tracked
    moved: Array  # the patient moved, and is tracked
    untracked: Array  # the patient moved, and isn't
    in_world: Array  # of the mass alone, the patient moved and tracked
    covariance: Array  # (3, 3) mm^2 of that, as predicted


def sessions(setup: Setup, sessions: int = 100) -> Figures:
    """Figures over drawn sessions of a rig that was calibrated once, each with devices within that calibration's covariance."""
    optics = drawn_session.calibrated_optics(setup.rig, setup.conditions("lifelike"), Noise(), Poses(), SEED)
    found = [session(setup, optics, k) for k in range(sessions)]
    still, moved, untracked, in_world, covariance = (np.array(each) for each in zip(*found, strict=True))
    whitened = [np.linalg.solve(np.linalg.cholesky(one), error) for one, error in zip(covariance, in_world, strict=True)]
    return {
        "sessions": sessions,
        "still_rms_mm": _rms(still),
        "moved_rms_mm": _rms(moved),
        "moved_over_still": _rms(moved) / _rms(still),
        "untracked_rms_mm": _rms(untracked),
        "over_sigma": float(np.mean(np.square(whitened))),
    }


def session(setup: Setup, optics: Calibration, k: int) -> Errors:
    """Draw devices, prints, skin and scan, with the patient where it was and moved."""
    rng = np.random.default_rng([SEED, k])
    known = drift.calibration_uncertainty(optics, PRINT_SCALE)
    true, noise = drawn_check.drawn_rig(optics.cameras, known, rng), Noise()
    life = setup.conditions("lifelike")
    eyes = {
        name: Eye(
            (true["cam1"], true["cam2"]),
            pair(optics),
            known,
            conditions.printed(target, life.target, int(rng.integers(2**31))),
            target,
            noise.circle_px,
            1.0,
        )
        for name, target in zip((PROBE, PATIENT), target_family.propose(setup.rig.target, 2), strict=True)
    }
    facing = np.diag([1.0, -1.0, -1.0])
    patient = rigid.transform(facing @ _turn(rng, 15.0)[:3, :3], np.array(PATIENT_MM))
    images, _ = drawn_session.led(setup.rig, noise, rng, tuple(np.add(SKIN_MM, APART_MM).tolist()))
    held = np.repeat(setup.rig.probe.target_from_image.matrix()[None], len(images), axis=0)
    scan = images @ np.array([rigid.invert(one) for one in held])
    skin = np.array(SKIN_MM) + APART_MM
    mass = skin + np.array([0.0, 0.0, DEPTH_MM])
    shown = true[PROJECTOR].project(skin[None])[:, list(COLUMNS)]
    measured = points_by_light(true["cam1"].project(skin[None]), shown, COLUMNS, optics.cameras)[0]
    about = rigid.transform(np.eye(3), skin)
    way = rng.standard_normal(3)
    move = about @ _turn(rng, TURN_DEG, exactly=True) @ rigid.invert(about)
    move[:3, 3] += SHIFT_MM * way / np.linalg.norm(way)

    def looked(name: str, poses: Array, key: int) -> Tracked:
        still = np.zeros((len(poses), 3))
        return drawn_session.look(
            eyes[name], poses, np.repeat(np.eye(4)[None], len(poses), axis=0), still[:, :2], still, [SEED, k, key]
        )

    at_fringes = _track(looked(PATIENT, patient[None], 0))
    unmoved = _track(looked(PROBE, scan, 1))
    after, beside = (
        _track(looked(PROBE, move @ scan, 2)),
        _track(looked(PATIENT, np.repeat((move @ patient)[None], len(scan), axis=0), 3)),
    )
    relative = tracks.relative(after, beside, at_fringes)
    local = np.array([rigid.apply(rigid.invert(pose), mass) for pose in scan])  # of the mass, in the target's frame

    def error(track: Track) -> Array:
        places = np.array([rigid.apply(pose, place) for pose, place in zip(track.poses, local, strict=True)])
        return np.nanmean(places, axis=0) - mass

    off = measured - skin
    return Errors(error(unmoved) - off, error(relative) - off, error(after) - off, error(relative), _covariance(relative, local))


def _turn(rng: np.random.Generator, angle_deg: float, exactly: bool = False) -> Array:
    """A turn : (4, 4) about any axis by an angle, or up to it."""
    axis = rng.standard_normal(3)
    share = 1.0 if exactly else rng.uniform()
    return rigid.from_rotation_vector(np.deg2rad(angle_deg) * share * axis / np.linalg.norm(axis), np.zeros(3))


def _rms(errors: Array) -> float:
    """Root mean square length of errors : (n, 3) mm."""
    return float(np.sqrt(np.mean(np.sum(errors**2, axis=1))))


def _track(seen: Tracked) -> Track:
    return Track(np.arange(len(seen.poses)), seen.poses, seen.own, seen.shared)


def _covariance(track: Track, places: Array) -> Array:
    """Covariance : (3, 3) mm^2 of the mean of places : (n, 3) mm in the target's frame, by the errors of n poses."""
    assert track.covariance is not None and track.shared is not None
    seen = track.found
    arms = np.array([rigid.rotate(pose, place) for pose, place in zip(track.poses[seen], places[seen], strict=True)])
    slopes = rigid.slopes(arms)
    own = (slopes @ track.covariance[seen] @ np.swapaxes(slopes, 1, 2)).sum(axis=0) / seen.sum() ** 2
    mean = slopes.mean(axis=0)
    return own + mean @ track.shared[seen].mean(axis=0) @ mean.T
