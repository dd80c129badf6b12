"""A session without images: what detectors would find is drawn, with noise of a known size, and the pipeline does the rest.

So each source of errors can be turned on and off in seconds, where rendering a session takes minutes. All that follows the
detectors is the real software: the calibration of the optics, poses from six circles, the calibration of the probe.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Annotated, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from recon.errors import InputError
from recon.geometry import rigid
from recon.geometry.camera import Camera
from recon.geometry.circle_outline import ellipses_of
from recon.model import circle_layout, tracks
from recon.model.calibration import DRIFT_PX, PRINT_SCALE, Calibration, Uncertainty, in_use
from recon.model.probe import ProbeCalibration
from recon.model.rig import NotNegative, Part, Positive, Rig, Target
from recon.optical_calibration.joint_calibration import Result, calibrate
from recon.probe_calibration import point_calibration
from recon.probe_calibration.point_calibration import Sightings
from recon.probe_calibration.sound_in_water import speed_of_sound
from recon.tracking import pose
from recon.tracking.pose_fit import Sighting
from scenes.board_poses import Config as Poses
from scenes.board_poses import random_poses
from scenes.kinds import board, crosswire
from twin import conditions
from twin.conditions import BoardPrint, Conditions
from twin.experiments.board_sets import drawn
from twin.optics.surface_session import calibration_of
from twin.ultrasound.echo_solids import body
from twin.ultrasound.probe_path import WirePath, about_crossing, crossing
from twin.ultrasound.transducer import Transducer
from twin.working_range import PAPER, WorkingRange

Array = NDArray[np.float64]

CAMERAS = ("cam1", "cam2")
WATER_C = 22.0  # nominal, of the tank
ROLL_DEG = 90.0  # of the probe over the wires, both ways: as far as the cameras see the target
MIDDLE_MM = (4.0, -2.0, 620.0)  # of the array's face, in the middle of the scan
TILT_DEG = 8.0  # standard deviation of the hand's tilts over the scan
SOME = 1e-2  # least drawn noise over the claimed: adjustments would scale their covariances to zero
SCAN_STREAM = 1000  # added to the seed of what the scan draws again: bracket and triggers


Size = Annotated[float, Field(gt=0)]


class Noise(Part):
    """Standard deviations of what detectors find, as they claim them, and the motion of the scan."""

    board_px: Size = 0.004  # of a disc's centre in a camera, three quarters in the projector; of rendered boards
    circle_px: Size = 0.008  # of a circle of the target, along each axis; of rendered films
    crossing_px: Size = 0.3  # of the wires' crossing in a B-scan, along each axis
    click_px: Size = 4.3  # of the crossing as a person finds it, along each axis: it makes the paper's RMS of the equation
    beside_mm: Size = 0.2  # of the crossing from the image plane, as a hand holds it
    latency_s: Size = 0.001  # of the scanner's latency, as measured over a flat bottom
    column_px: Size = 0.02  # of the projector's column that a pixel sees
    wires: Annotated[int, Field(ge=6, le=1000)] = 40  # B-scans of the wires
    scans: Annotated[int, Field(ge=8, le=1000, multiple_of=2)] = 40  # B-scans over the mass, half of them there and half back
    span_mm: Positive = 20.0  # way of the probe over the mass
    speed_mm_s: Positive = 10.0
    of_paper: bool = True  # whether board_px, circle_px and column_px are those of the paper's rig, and others for another one
    drawn: "Drawn" = Field(default_factory=lambda: Drawn())

    def at(self, where: WorkingRange) -> "Noise":
        """The noise in a rig."""
        if not self.of_paper:
            return self
        board, circle = where.rims
        sizes = {
            "board_px": board * self.board_px,
            "circle_px": circle * self.circle_px,
            "column_px": where.noise * self.column_px,
        }
        return self.model_copy(update=sizes | {"of_paper": False})


class Drawn(Part):
    """Sizes of drawn errors over those that detectors claim, and of a bracket's giving over that of the conditions; 0 is none."""

    board: NotNegative = 1.0
    circle_at_wires: NotNegative = 1.0  # while the probe is calibrated
    circle_in_scan: NotNegative = 1.0
    crossing: NotNegative = 1.0
    beside: NotNegative = 1.0
    latency: NotNegative = 1.0
    column: NotNegative = 1.0
    bracket_at_wires: NotNegative = 1.0
    bracket_in_scan: NotNegative = 1.0


class Eye(NamedTuple):
    """Both cameras, as they are and as they are known, and the target likewise."""

    true: tuple[Camera, Camera]
    known: tuple[Camera, Camera]
    optics: Uncertainty | None
    printed: Target
    design: Target
    sigma_px: float  # of a circle along each axis, as the detector claims
    times: float  # drawn errors over that


class Tracked(NamedTuple):
    """Poses of n pairs of frames."""

    poses: Array  # (n, 4, 4) world_from_target, as found; NaN where none was
    own: Array  # (n, 6, 6) covariance by their own noise
    shared: Array  # (n, 6, 6) by what errs alike in all


@dataclass(frozen=True)
class Session:
    """Estimates of a drawn session, and its truth."""

    used: Calibration  # the devices as they are while they are used
    optics: Calibration  # as calibrated
    probe: ProbeCalibration  # as calibrated, converted to the speed of sound that is taken for the tissue's
    true_probe: ProbeCalibration  # in the tissue
    true_poses: Array  # (n, 4, 4) world_from_image of the scan
    velocity: Array  # (n, 3) mm/s
    tracked: Tracked
    latency_s: float  # error of the measured latency
    where: WorkingRange = PAPER

    @property
    def face_mm(self) -> tuple[float, float, float]:
        """Place of the array's face in the middle of the scan."""
        return self.where.place(*MIDDLE_MM)


def draw(
    rig: Rig, life: Conditions, noise: Noise, transducer: Transducer, poses: Poses, seed: int, where: WorkingRange = PAPER
) -> Session:
    """Draw a session, the same for the same seed.

    where : in which range board, wires and scan lie

    Raises
    ------
    InputError
        If a calibration is refused, or the target is lost over the scan.
    """
    optics = calibrated_optics(rig, life, noise, poses, seed, where)
    used = calibration_of(conditions.drifted(rig, life.drift, seed))
    printed = conditions.printed(rig.target, life.target, seed)
    known = in_use(optics.uncertainty, optics.cameras, PRINT_SCALE, DRIFT_PX)
    eye = Eye(pair(used), pair(optics), known, printed, rig.target, noise.circle_px, noise.drawn.circle_in_scan)
    faster, warmer = conditions.speeds(life.sound, seed)
    water = float(speed_of_sound(WATER_C + warmer) / speed_of_sound(WATER_C))
    at_wires = eye._replace(times=noise.drawn.circle_at_wires)
    probe = calibrated_probe(rig, at_wires, life, noise, water, transducer, seed, where)
    true_poses, velocity = led(rig, noise, np.random.default_rng([seed, 22]), where.place(*MIDDLE_MM))
    later = conditions.triggered(life.motion, len(true_poses), seed + SCAN_STREAM)
    tracked = look(
        eye,
        true_poses,
        bracket(rig, life, noise.drawn.bracket_in_scan, len(true_poses), seed + SCAN_STREAM),
        later,
        velocity,
        [seed, 23],
    )
    if not np.isfinite(tracked.poses).all():
        raise InputError(f"target: expected to be seen in all {len(true_poses)} poses of the scan, found it lost in some")
    true_probe = ProbeCalibration(rig.probe.target_from_image.matrix(), np.array(rig.probe.scale_mm_per_px) * [1.0, faster])
    latency = noise.drawn.latency * noise.latency_s * float(np.random.default_rng([seed, 24]).standard_normal())
    return Session(used, optics, probe, true_probe, true_poses, velocity, tracked, latency, where)


def calibrated_optics(
    rig: Rig, life: Conditions, noise: Noise, chosen: Poses, seed: int, where: WorkingRange = PAPER
) -> Calibration:
    """Calibrate from a board whose discs are found with noise."""
    return calibrated_board(rig, life, noise, chosen, seed, where).adjustment.calibration


def calibrated_board(rig: Rig, life: Conditions, noise: Noise, chosen: Poses, seed: int, where: WorkingRange = PAPER) -> Result:
    """The same, with the board's observations."""
    return _calibrated(rig, life.board, noise.board_px, max(noise.drawn.board, SOME), chosen, seed, where)


@lru_cache(maxsize=8)  # trials of a seed differ in much that a board doesn't see
def _calibrated(
    rig: Rig, errors: BoardPrint, board_px: float, times: float, chosen: Poses, seed: int, where: WorkingRange
) -> Result:
    truth, config = calibration_of(rig), where.board(board.Config())
    design = board.design(config)
    poses = random_poses(
        where.poses(chosen).model_copy(update={"seed": chosen.seed + seed}), design, list(truth.cameras.values())
    )
    printed = conditions.printed_board(config, errors, seed)
    points = np.stack([board.printed_centres(conditions.flexed(printed, errors, seed, k)) for k in range(chosen.count)])
    claimed = {name: board_px * (0.75 if name == "projector" else 1) for name in truth.cameras}
    seen = drawn(truth, design, poses, claimed, np.random.default_rng([seed, 20]), points, times)
    return calibrate(seen.sightings, design, seen.sizes)


def calibrated_probe(
    rig: Rig,
    eye: Eye,
    life: Conditions,
    noise: Noise,
    water: float,
    transducer: Transducer,
    seed: int,
    where: WorkingRange = PAPER,
) -> ProbeCalibration:
    """Calibrate from the crossing of two wires in water of a speed of sound, relative to that which is taken for it."""
    wires = crosswire.Config()
    wires = wires.model_copy(update={"cross_mm": where.place(*wires.cross_mm)})
    rng, wired, drawn_too = np.random.default_rng([seed, 21]), body(crosswire.build(wires)), noise.drawn
    path = WirePath(count=noise.wires, roll_deg=ROLL_DEG, miss_mm=drawn_too.beside * noise.beside_mm)
    rests, moments = about_crossing(path, wired, transducer, seed)
    images = tracks.at(rests, moments)
    local = np.stack([rigid.apply(rigid.invert(image), crossing(wired)) for image in images])
    pixels = local[:, :2] / (np.array(rig.probe.scale_mm_per_px) * [1.0, water])
    pixels = pixels + max(drawn_too.crossing, SOME) * noise.crossing_px * rng.standard_normal(pixels.shape)
    at_rest = np.zeros((len(images), 3))
    tracked = look(
        eye, images, bracket(rig, life, drawn_too.bracket_at_wires, len(images), seed), at_rest[:, :2], at_rest, [seed, 25]
    )
    found = np.isfinite(tracked.poses).all(axis=(1, 2))
    covariance = np.broadcast_to(noise.crossing_px**2 * np.eye(2), (found.sum(), 2, 2))
    beside = np.full(found.sum(), noise.beside_mm)
    seen = Sightings(tracked.poses[found], pixels[found], tracked.own[found], covariance, beside)
    return point_calibration.calibrate(seen, rig.probe.image_size).calibration


def led(
    rig: Rig, noise: Noise, rng: np.random.Generator, middle_mm: tuple[float, float, float] = MIDDLE_MM
) -> tuple[Array, Array]:
    """Poses `world_from_image` : (n, 4, 4) over a mass, there and back, and their velocities : (n, 3) mm/s."""
    half = noise.scans // 2
    there = np.linspace(-0.5, 0.5, half) * noise.span_mm
    along = np.concatenate([there, there[::-1]])
    upright = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    foot = np.array([rig.probe.image_size[0] * rig.probe.scale_mm_per_px[0] / 2, 0.0, 0.0])
    tilts = np.deg2rad(TILT_DEG) * rng.standard_normal(3) + np.deg2rad(1.0) * rng.standard_normal((len(along), 3))
    turns = [rigid.from_rotation_vector(tilt, np.zeros(3))[:3, :3] @ upright for tilt in tilts]
    faces = np.array(middle_mm) + along[:, None] * [0.0, 1.0, 0.0]
    poses = np.stack([rigid.transform(turn, face - turn @ foot) for turn, face in zip(turns, faces, strict=True)])
    velocity = np.zeros((len(along), 3))
    velocity[:, 1] = np.repeat([noise.speed_mm_s, -noise.speed_mm_s], half)
    return poses, velocity


def bracket(rig: Rig, life: Conditions, times: float, count: int, seed: int) -> Array:
    """Poses `target_from_image` : (n, 4, 4) of a bracket that gives from the first to the last."""
    design, steps = rig.probe.target_from_image.matrix(), times * conditions.given(life.motion, np.arange(count) * 10**9, seed)
    return np.stack([rigid.moved(design, step) for step in steps])


def look(eye: Eye, images: Array, held: Array, later_s: Array, velocity: Array, key: list[int]) -> Tracked:
    """Track the target, whose circles are found with noise, in n pairs of frames.

    images, held : (n, 4, 4) world_from_image and target_from_image
    later_s : (n, 2) by which each camera exposes later
    velocity : (n, 3) mm/s
    """
    rng, found = np.random.default_rng(key), []
    for image, at, late, moving in zip(images, held, later_s, velocity, strict=True):
        target = image @ rigid.invert(at)
        first, second = (
            _sighting(eye, k, rigid.transform(target[:3, :3], target[:3, 3] + late[k] * moving), rng) for k in (0, 1)
        )
        found.append(pose.estimate(first, second, eye.design, eye.optics))
    return Tracked(*(np.stack([getattr(one, name) for one in found]) for name in ("world_from_target", "covariance", "shared")))


def _sighting(eye: Eye, k: int, world_from_target: Array, rng: np.random.Generator) -> Sighting:
    """What a camera finds of the target."""
    centres, shapes = ellipses_of(eye.true[k], world_from_target, *circle_layout.circles(eye.printed))
    seen = centres + max(eye.times, SOME) * eye.sigma_px * rng.standard_normal(centres.shape)
    outside = ((centres < 0) | (centres > np.array(eye.true[k].size) - 1)).any(axis=1)
    seen[outside] = np.nan
    return Sighting(eye.known[k], seen, np.broadcast_to(eye.sigma_px**2 * np.eye(2), (3, 2, 2)), shapes)


def pair(calibration: Calibration) -> tuple[Camera, Camera]:
    """Both cameras."""
    first, second = (calibration.cameras[name] for name in CAMERAS)
    return first, second
