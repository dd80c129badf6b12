"""The tracker's noise and the hand's motion from filmed sweeps of a capture: part of the step that identifies a rig."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from recon.capture import probe_files, stereo_frames
from recon.capture.manifest import MANIFEST, SCANNER, read_manifest
from recon.capture.stereo_frames import Film
from recon.errors import InputError
from recon.geometry import rigid
from recon.identification import hand_motion, tracker_noise
from recon.identification.estimates import Findings
from recon.identification.tracker_noise import Recording
from recon.model import circle_layout
from recon.model.rig import Rig
from recon.probe_calibration import repeatability
from recon.session import poses_step
from recon.session.tracker_settings import make_tracker
from recon.session.watch import SILENT, Watch
from recon.tracking import track_figures
from recon.tracking.tracker import Tracker, Tracking

Array = NDArray[np.float64]

SCALES = 2  # of a calibration's parameters, before its pose
OUT_OF_VIEW = track_figures.CAUSES["^out of view"]
NOT_SEEN = {  # reasons of what no film of a capture shows
    **{f"tracker.{name}": "no film of a target in a stand: give still=[NAME]" for name in tracker_noise.STILL},
    **{f"tracker.{name}": "no film: give still=[NAME] or hand=[NAME]" for name in ("dropped", "rays_over_predicted")},
    **dict.fromkeys((hand_motion.TREMOR, hand_motion.TURN), "no film of a target in a hand: give hand=[NAME]"),
    hand_motion.TRIGGER: "no film of a moving target: give hand=[NAME]",
    **dict.fromkeys(
        (hand_motion.GIVE, hand_motion.GIVE_TURN), "no calibrations of the probe before and after: give probes=[A,B]"
    ),
}


def identify(
    capture: Path,
    rig: Rig,
    calibration: Path | None,
    still: Sequence[str],
    hand: Sequence[str],
    watch: Watch = SILENT,
) -> Findings:
    """What films show of the tracker and of the hand.

    Parameters
    ----------
    calibration : used instead of the capture's own
    still, hand : names of sweeps of the capture with frames of both cameras: of a target in a stand, and in a hand

    Raises
    ------
    InputError
        If there is no such sweep, or its frames are incomplete or damaged.
    """
    found = Findings(unknown=NOT_SEEN)
    names = list(dict.fromkeys([*still, *hand]))
    if both := set(still) & set(hand):
        raise InputError(f"still, hand: expected each sweep in one of them, found {', '.join(sorted(both))} in both")
    if not names:
        return found
    films = {name: stereo_frames.read_film(capture, calibration, name) for name in names}
    tracked = dict[str, Recording]()
    for name, film in films.items():
        settings = poses_step.Settings(capture=capture, rig=rig, calibration=calibration, sweep=name)
        tracker = make_tracker(settings, rig.target, film.cameras, film.optics, film.bits)
        tracked[name] = track(film, tracker, watch)
        watch.say(f"tracked     {name or 'the sweep'}: {tracked[name].found.sum()} of {len(film.times)} pairs of frames")
    gaps = {name: tracker_noise.gaps_of(tracked[name], films[name].cameras) for name in names}
    if still:
        own = hand_motion.find_trigger([gaps[name] for name in still], _listed(still))
        rays = own.estimates.get("tracker.rays_over_predicted")
        found |= tracker_noise.still_noise([tracked[name] for name in still], rays, _listed(still))
    found |= tracker_noise.drop_outs(list(tracked.values()), _listed(names))
    found |= tracker_noise.noise_table([(tracked[name], gaps[name]) for name in names], _listed(names))
    moving = hand or still
    found |= hand_motion.find_trigger([gaps[name] for name in moving], _listed(moving))
    if hand:
        points = [shaken_point(capture, name, rig) for name in hand]
        found |= hand_motion.find_tremor([tracked[name].tracked for name in hand], points, _listed(hand))
    return found


def compare_probes(files: Sequence[Path]) -> Findings:
    """The bracket's giving, from results of calibrate-probe: before and after a session, and so on for further ones.

    Raises
    ------
    InputError
        If their number is odd, or one is missing, damaged or without a covariance.
    """
    if not files:
        return Findings()
    if len(files) % 2:
        raise InputError(f"probes: expected two of each session, before and after it, found {len(files)}")
    calibrations = [probe_files.read(file) for file in files]
    own = repeatability.own_covariances(calibrations)
    if own is None:
        raise InputError(f"probes: expected results with a covariance, found one without in {', '.join(map(str, files))}")
    pairs = list(zip(calibrations[::2], calibrations[1::2], strict=True))
    steps = np.array([repeatability.step_between(*pair)[SCALES:] for pair in pairs])
    covariances = (own[::2] + own[1::2])[:, SCALES:, SCALES:]
    return hand_motion.bracket_give(steps, covariances, f"calibrations before and after {len(pairs)} sessions")


def _listed(names: Sequence[str]) -> str:
    return ", ".join(name or "the sweep" for name in names)


def shaken_point(capture: Path, sweep: str, rig: Rig) -> Array:
    """Point : (3,) mm in the target's frame whose shift is measured: the middle of the array in a sweep with B-scans, else of the
    circles.
    """
    contents = read_manifest(capture)
    _, part = contents.sweep_of(capture / MANIFEST, "frames", sweep)
    if SCANNER not in part.images:
        return circle_layout.middle(rig.target)
    if contents.probe is not None:
        return probe_files.read(capture / contents.probe).to_target([(rig.probe.image_size[0] - 1) / 2, 0.0])
    width_mm = rig.probe.scale_mm_per_px[0] * (rig.probe.image_size[0] - 1)
    return rigid.apply(rig.probe.target_from_image.matrix(), [width_mm / 2, 0.0, 0.0])


def track(film: Film, tracker: Tracker, watch: Watch = SILENT) -> Recording:
    """Track a film, and keep what tells the noise."""
    pairs = watch.follow(film.pairs(), len(film.times), "tracking")
    found = [one for _, one in poses_step.follow(tracker, film.times, pairs)]
    rims = [[view.outlines for view in one.views] for one in found]
    seen = np.array([[one.found & each.found for each in pair] for one, pair in zip(found, rims, strict=True)])
    centres = np.array([[each.rings.centre for each in pair] for pair in rims])
    return Recording(
        film.times * 1e-9,
        np.array([one.pose.world_from_target for one in found]),
        np.array([one.pose.covariance for one in found]),
        np.where(seen[..., None], centres, np.nan),
        np.array([[each.covariance for each in pair] for pair in rims]),
        np.where(seen, [[each.contrast for each in pair] for pair in rims], np.nan),
        np.where(seen, [[np.linalg.norm(each.motion, axis=1) for each in pair] for pair in rims], np.nan),
        np.array([is_in_view(one) for one in found]),
    )


def is_in_view(found: Tracking) -> bool:
    """Whether a pair without a pose has no camera whose view the target has left."""
    reason = found.pose.reason
    return reason is None or OUT_OF_VIEW not in track_figures.views_of(reason).values()
