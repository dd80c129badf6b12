"""Accuracy of the probe's calibration with brackets that give, wires that slip, and speeds of sound that nobody stated."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from recon.geometry import rigid
from recon.model.probe import ProbeCalibration
from recon.probe_calibration import movement, point_calibration, sound_in_water, wires
from recon.probe_calibration.point_calibration import Adjustment, Noise, Sightings
from scenes.acoustics import TISSUES
from twin.evaluation.surface_errors import rms
from twin.experiments import probe_accuracy
from twin.experiments.experiment_setup import Figures, Setup

Array = NDArray[np.float64]

DRAWS = range(300, 310)  # unseen seeds of each block's errors
KINDS = {"nothing": None, "probe_percent": movement.PROBE, "wires_percent": movement.WIRES}
WATER_C, TISSUE = 1.0, 0.02  # standard deviations of the water's temperature, and of the tissue's speed over that assumed


def movements(setup: Setup, gives_mm: float = 0.0, gives_deg: float = 0.0, slips_mm: float = 0.0) -> Figures:
    """What moved is found, of a bracket that gives or wires that slip to any side; the errors are as large as predicted.

    The squared error is over the covariance, of eight parameters, of the probe as it is at the end.
    """
    results = list(_calibrations(setup, gives_deg, gives_mm, slips_mm))
    names = [found.moved.what if found.moved else None for found, _ in results]
    share = {name: 100 * np.mean([each == what for each in names]) for name, what in KINDS.items()}
    squared = [probe_accuracy.squared_length(found.calibration, truth) for found, truth in results]
    return share | {"calibrations": len(results), "found_percent": 100 - share.pop("nothing"), "squared": np.mean(squared)}


def _calibrations(
    setup: Setup, gives_deg: float, gives_mm: float, slips_mm: float
) -> Iterator[tuple[Adjustment, ProbeCalibration]]:
    """Calibrations of all blocks, each beside the probe as it is at the end."""
    frames, truth = probe_accuracy.taken(setup), probe_accuracy.in_water(setup)
    for seed in DRAWS:
        for number, block in enumerate(probe_accuracy.blocks(frames)):
            rng = np.random.default_rng([seed, number])
            turn, shift, slip = (_sideways(rng, length) for length in (np.radians(gives_deg), gives_mm, slips_mm))
            growth = np.concatenate([turn, shift]) / 2
            found = _calibrated(setup, frames.found.of(block), rng, growth, slip / 2)
            yield found, replace(truth, target_from_image=rigid.moved(truth.target_from_image, growth))


def _calibrated(setup: Setup, seen: Sightings, rng: np.random.Generator, by_probe: Array, by_wires: Array) -> Adjustment:
    """Calibrate from sightings with the image's poses, tracked with errors, while the bracket gives and the wires slip."""
    design = setup.rig.probe.target_from_image.matrix()
    poses = probe_accuracy.tracked(setup.rig, seen.poses, rng)
    for time, pose in zip(np.linspace(-1, 1, len(poses)), poses, strict=True):
        pose[:] = pose @ design @ rigid.invert(rigid.moved(design, time * by_probe))
        pose[:3, 3] += time * by_wires
    noise = Noise(probe_accuracy.TURN_DEG, probe_accuracy.SHIFT_MM)
    speed = float(sound_in_water.speed_of_sound(probe_accuracy.TEMPERATURE_C))
    ahead = wires.echo_ahead(probe_accuracy.WIRE_MM, TISSUES["nylon"].speed, speed)
    size = setup.rig.probe.image_size
    return point_calibration.calibrate(replace(seen, poses=poses), size, noise, design, ahead_mm=ahead)


def _sideways(rng: np.random.Generator, length: float) -> Array:
    way = rng.standard_normal(3)
    return length * way / np.linalg.norm(way)


def depths(setup: Setup) -> Figures:
    """Depths in a tissue of a speed that is off, by a calibration in water of a temperature that is off."""
    rng, errors = np.random.default_rng(DRAWS[0]), []
    exact, stated, wanted = probe_accuracy.in_water(setup), probe_accuracy.TEMPERATURE_C, sound_in_water.SCANNER_SPEED
    water = float(sound_in_water.speed_of_sound(stated))
    sigma = float(sound_in_water.speed_sigma(stated, WATER_C))
    known = sound_in_water.for_tissue(exact, None, 1e-9)  # with a covariance
    told = sound_in_water.in_medium(known, water, wanted, ratio_sigma=wanted / water**2 * sigma)
    told = sound_in_water.for_tissue(told, wanted, TISSUE * wanted)
    assert told.uncertainty is not None
    for warmer, faster in rng.standard_normal((500, 2)):
        true = wanted * (1 + TISSUE * faster) / float(sound_in_water.speed_of_sound(stated + WATER_C * warmer))
        errors.append((told.scale[1] - exact.scale[1] * true) / told.uncertainty.sigma("sy"))
    return {"ratio": rms(np.array(errors))}
