"""Accuracy of the probe's calibration, from the twin's own B-scans of crossed wires."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from recon.errors import InputError
from recon.geometry import rigid
from recon.model.probe import ProbeCalibration
from recon.model.rig import Rig
from recon.probe_calibration import (
    phantom_frames,
    point_calibration,
    repeatability,
    sound_in_water,
    tank_calibration,
    wires,
)
from recon.probe_calibration.point_calibration import Adjustment, Noise, Sightings
from scenes.acoustics import TISSUES
from scenes.kinds import crosswire
from twin.experiments.experiment_setup import Figures, Setup
from twin.ultrasound.bscan import scans
from twin.ultrasound.echo_solids import Body, body
from twin.ultrasound.probe_path import WirePath, about_crossing, held
from twin.ultrasound.sweep_session import calibration_of
from twin.ultrasound.transducer import Transducer

Array = NDArray[np.float64]

CALIBRATIONS, IMAGES = 5, 30  # as in Meza et al. 2021
ROLL_DEG = 90.0  # as far as a wrist goes
TURN_DEG, SHIFT_MM = 0.08, 0.05  # standard deviations of the tracked pose, in each axis
REPEATS = 4  # of the five calibrations, with other errors of the poses
WRONG = 0.3  # share of outliers
REGION = 0.95
TEMPERATURE_C = 22.0  # of the scene's water
DEPTH_MM = 50.0  # shown, at which depths are compared
ERROR_MM = 0.3  # of a calibration, at most
WIRE_MM = 0.1  # radius of the scene's wires
FEW = 20  # frames of a motion that is to be refused
ALMOST_MM = 1e-3  # noise of a crossing that is known
PLACES = ("centre", "corners", "mean")
REPEATED = [f"{name}_{place}" for name in ("cr1", "cr2") for place in PLACES]
LEFT_HANDED, X_AND_Y = np.diag([1.0, 1, -1, 1]), np.eye(4)[[1, 0, 2, 3]]


@dataclass(frozen=True, eq=False)
class Frames:
    """B-scans of crossed wires, in n poses: where the crossing was found, and where it is."""

    world_from_image: Array  # (n, 4, 4) mm, true
    found: Sightings  # of the m frames in which a crossing was found, with true poses of the image instead of the target's
    numbers: NDArray[np.int64]  # (m,) of these frames
    pixels: Array  # (n, 2) px, true: the crossing, projected into the image plane
    beside: Array  # (n,) mm, true: of the crossing from the image plane


@cache
def recorded(rig: Rig, transducer: Transducer, count: int = CALIBRATIONS * IMAGES) -> Frames:
    """Take B-scans along the path of the protocol, and find the crossing in them."""
    wired = body(crosswire.build(crosswire.Config(diameter_mm=2 * WIRE_MM)))
    track, _ = about_crossing(WirePath(count=count, roll_deg=ROLL_DEG), wired, transducer)
    return looked_at(wired, transducer, track.poses[:: len(track.poses) // count])


def looked_at(wired: Body, transducer: Transducer, world_from_image: Array) -> Frames:
    """Take a B-scan in each of n poses : (n, 4, 4), and find the crossing."""
    images = (taken.image for taken in scans(wired, transducer, world_from_image, 0))
    found, crossings = point_calibration.from_images(images, world_from_image)
    middle = np.mean([wire.ends.mean(axis=0) for wire in wired.wires], axis=0)
    local = np.stack([rigid.apply(rigid.invert(pose), middle) for pose in world_from_image])
    scale = np.array(transducer.scale_mm_per_px) * [1, wired.medium.speed / transducer.assumed_speed]
    numbers = np.flatnonzero([crossing.found for crossing in crossings])
    return Frames(world_from_image, found, numbers, local[:, :2] / scale, local[:, 2])


def tracked(rig: Rig, world_from_image: Array, rng: np.random.Generator) -> Array:
    """Poses `world_from_target` : (n, 4, 4) as a tracker reports them, with independent errors."""
    poses = world_from_image @ rigid.invert(rig.probe.target_from_image.matrix())
    turns, shifts = np.radians(TURN_DEG) * rng.standard_normal((len(poses), 3)), SHIFT_MM * rng.standard_normal((len(poses), 3))
    noisy = np.stack([pose @ rigid.from_rotation_vector(turn, np.zeros(3)) for pose, turn in zip(poses, turns, strict=True)])
    noisy[:, :3, 3] += shifts
    return noisy


def blocks(frames: Frames) -> list[NDArray[np.int64]]:
    """Numbers of the sightings of each calibration's 30 images; those without a crossing aren't replaced."""
    calibrations = len(frames.world_from_image) // IMAGES
    return [np.flatnonzero(frames.numbers // IMAGES == k) for k in range(calibrations)]


def calibrated(rig: Rig, sightings: Sightings, rng: np.random.Generator) -> Adjustment:
    """Calibrate from sightings with the image's poses, tracked with errors."""
    noise = Noise(TURN_DEG, SHIFT_MM)
    ahead = wires.echo_ahead(WIRE_MM, TISSUES["nylon"].speed, float(sound_in_water.speed_of_sound(TEMPERATURE_C)))
    seen = replace(sightings, poses=tracked(rig, sightings.poses, rng))
    return point_calibration.calibrate(seen, rig.probe.image_size, noise, rig.probe.target_from_image.matrix(), ahead_mm=ahead)


def calibrated_exactly(rig: Rig, frames: Frames, block: NDArray[np.int64], rng: np.random.Generator) -> ProbeCalibration:
    """Calibrate from the same poses, brought to have the crossing in the image plane, and the true pixels."""
    chosen = frames.numbers[block]
    moved = frames.world_from_image[chosen].copy()
    moved[:, :3, 3] += moved[:, :3, 2] * frames.beside[chosen, None]
    noise = Noise(TURN_DEG, SHIFT_MM, ALMOST_MM, ALMOST_MM)
    seen = Sightings(tracked(rig, moved, rng), frames.pixels[chosen])
    return point_calibration.calibrate(seen, rig.probe.image_size, noise).calibration


def in_water(setup: Setup) -> ProbeCalibration:
    """The true calibration for images of the scene's water."""
    truth = calibration_of(setup.rig, setup.scanners["water"])
    return sound_in_water.in_medium(truth, truth.speed_m_s, float(sound_in_water.speed_of_sound(TEMPERATURE_C)))


def errors(found: Sequence[ProbeCalibration], truth: ProbeCalibration, rig: Rig) -> Array:
    """Distances : (n, 5) mm of five points from where they are, by each of n calibrations."""
    points = repeatability.five_points(rig.probe.image_size)
    return np.stack([np.linalg.norm(each.to_target(points) - truth.to_target(points), axis=1) for each in found])


def repeatabilities(found: Sequence[ProbeCalibration], rig: Rig) -> Array:
    """REPEATED : (6,) mm."""
    points = repeatability.five_points(rig.probe.image_size)
    both = [repeatability.at_places(values) for values in (repeatability.cr1(found, points), repeatability.cr2(found, points))]
    return np.array([values[place] for values in both for place in PLACES])


def squared_length(found: ProbeCalibration, truth: ProbeCalibration) -> float:
    """Squared error of the eight parameters in units of their covariance; 8 are expected."""
    assert found.uncertainty is not None
    error = np.concatenate([truth.scale - found.scale, rigid.difference(found.target_from_image, truth.target_from_image)])
    return float(error @ np.linalg.solve(found.uncertainty.covariance, error))


@cache
def sets(rig: Rig, frames: Frames, repeats: int) -> tuple[list[list[Adjustment]], list[list[ProbeCalibration]]]:
    """Calibrations of all blocks, by found crossings and by true ones, each set with other errors of the poses."""
    by_images, exact = [], []
    for repeat in range(repeats):
        rng = np.random.default_rng([1, repeat])
        by_images.append([calibrated(rig, frames.found.of(block), rng) for block in blocks(frames)])
        rng = np.random.default_rng([1, repeat])
        exact.append([calibrated_exactly(rig, frames, block, rng) for block in blocks(frames)])
    return by_images, exact


def taken(setup: Setup) -> Frames:
    """B-scans of the protocol."""
    return recorded(setup.rig, setup.scanners["water"])


def repeats(setup: Setup, frames: Frames | None = None) -> Figures:
    """Five calibrations agree, and are right; the limit is that of the poses' errors alone."""
    frames = frames or taken(setup)
    rig, truth = setup.rig, in_water(setup)
    by_images, exact = sets(rig, frames, REPEATS)
    found = [[each.calibration for each in one] for one in by_images]
    figures: Figures = {"set": len(found[0]), "used": np.mean([(~each.outliers).sum() for one in by_images for each in one])}
    for ending, many in (("mm", found), ("limit_mm", exact)):
        values = np.mean([repeatabilities(one, rig) for one in many], axis=0)
        worst = errors([each for one in many for each in one], truth, rig).max(axis=1)
        figures |= {f"{name}_{ending}": value for name, value in zip(REPEATED, values, strict=True)}
        figures |= {f"error_{ending}": np.median(worst), f"worst_{ending}": worst.max(), "calibrations": len(worst)}
    squared = sum(squared_length(each, truth) for one in found for each in one) / (8 * figures["calibrations"])
    freedom = 8 * len(found[0])  # repeats share their images, so only sets of these count as independent
    low, high = chi2.ppf([(1 - REGION) / 2, (1 + REGION) / 2], freedom) / freedom
    return figures | {"squared_error": squared, "low": low, "high": high}


def with_outliers(sightings: Sightings, size: tuple[int, int], rng: np.random.Generator) -> Sightings:
    """Sightings, some with the crossing anywhere in the image."""
    pixels = sightings.pixels.copy()
    wrong = rng.choice(len(pixels), round(WRONG * len(pixels)), replace=False)
    pixels[wrong] = rng.uniform([0, 0], np.array(size) - 1, (len(wrong), 2))
    return replace(sightings, pixels=pixels)


def outliers(setup: Setup, frames: Frames | None = None) -> Figures:
    """The same with 30 % of the crossings anywhere, over those without; the limit is that of so many fewer frames."""
    frames = frames or taken(setup)
    rig, truth = setup.rig, in_water(setup)
    clean = [[each.calibration for each in one] for one in sets(rig, frames, REPEATS)[0]]
    spoilt = []
    for repeat in range(REPEATS):
        rng, draw = np.random.default_rng([1, repeat]), np.random.default_rng([2, repeat])
        ones = [with_outliers(frames.found.of(block), rig.probe.image_size, draw) for block in blocks(frames)]
        spoilt.append([calibrated(rig, one, rng).calibration for one in ones])
    ratio = np.mean([repeatabilities(one, rig) for one in spoilt], 0) / np.mean([repeatabilities(one, rig) for one in clean], 0)
    after, before = (errors([each for one in many for each in one], truth, rig).max(axis=1) for many in (spoilt, clean))
    figures = dict(zip(REPEATED, ratio, strict=True)) | {"limit": (1 - WRONG) ** -0.5}
    return figures | {"error": np.median(after) / np.median(before), "worst": after.max() / before.max()}


def refusals(setup: Setup, frames: Frames | None = None) -> Figures:
    """Motions and axes from which nothing can follow are refused, by their names: 1 for each that is."""
    frames = frames or taken(setup)
    rig, rng = setup.rig, np.random.default_rng(3)
    upper = frames.found.pixels[:, 1] < rig.probe.image_size[1] / 2
    block = frames.found.of(blocks(frames)[0])

    def turned(matrix: Array) -> Callable[[], object]:
        poses = tracked(rig, block.poses, rng) @ matrix
        expected = rig.probe.target_from_image.matrix()
        return lambda: point_calibration.calibrate(replace(block, poses=poses), rig.probe.image_size, None, expected)

    def shifted() -> object:
        poses = tracked(rig, block.poses, rng)
        poses[:, :3, 3] *= [1, 1, -1]
        pairs = phantom_frames.of_pairs("crossings", rig.probe.image_size, poses, block.pixels)
        return tank_calibration.calibrate(pairs, rig.probe, tank_calibration.Settings(temperature_c=TEMPERATURE_C))

    cases: dict[str, tuple[Callable[[], object], str]] = {
        "planar": (lambda: calibrated(rig, planar(setup), rng), "planar motion"),
        "depth": (lambda: calibrated(rig, frames.found.of(upper), rng), "one depth only"),
        "swapped": (turned(X_AND_Y @ LEFT_HANDED), "axes are swapped"),
        "mirrored": (shifted, "wrong handedness"),
        "left_handed": (turned(LEFT_HANDED), "left-handed"),
    }
    return {name: refused(make, named) for name, (make, named) in cases.items()}


def planar(setup: Setup) -> Sightings:
    """Crossings in B-scans of a probe that is tilted forward and backward only."""
    transducer = setup.scanners["water"]
    wired = body(crosswire.build(crosswire.Config(diameter_mm=2 * WIRE_MM)))
    _, pixels = point_calibration.motion(transducer.image_size, FEW)
    tilts = np.linspace(20, 35, FEW) * np.where(np.arange(FEW) % 2, 1, -1)
    turns = np.outer(tilts, [1.0, 0, 0])
    return looked_at(wired, transducer, held(wired, transducer, turns, pixels, np.zeros(FEW))).found


def refused(make: Callable[[], object], named: str) -> float:
    """1 if making a calibration is refused by a message that has the name of the fault, else 0."""
    try:
        make()
    except InputError as error:
        return float(named in str(error))
    return 0.0


def sound(setup: Setup, frames: Frames | None = None) -> Figures:
    """The error of depths in water of 22 degrees, as predicted, and after its correction by the temperature."""
    frames = frames or taken(setup)
    rig, truth = setup.rig, calibration_of(setup.rig, setup.scanners["water"])
    speed = float(sound_in_water.speed_of_sound(TEMPERATURE_C))
    found = [each.calibration for each in sets(rig, frames, REPEATS)[0][0]]
    seen, sigma = sound_in_water.implied_speed(repeatability.average(found), truth.scale[1])
    predicted = float(sound_in_water.shown_too_deep(DEPTH_MM, speed))
    deep = float(sound_in_water.shown_too_deep(DEPTH_MM, seen))
    undone = [sound_in_water.in_medium(each, speed, sound_in_water.SCANNER_SPEED) for each in found]
    before, after = errors(found, truth, rig).max(axis=1), errors(undone, truth, rig).max(axis=1)
    figures = {"calibrations": len(found), "predicted_mm": predicted, "found_mm": deep, "difference_mm": abs(deep - predicted)}
    figures |= {"limit_mm": DEPTH_MM * sigma / sound_in_water.SCANNER_SPEED, "before_mm": before.min()}
    return figures | {"least_before_mm": predicted - ERROR_MM, "after_mm": np.median(after), "worst_after_mm": after.max()}
