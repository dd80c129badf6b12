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
from twin.experiments.table_rows import Row, Setup

Array = NDArray[np.float64]

DRAWS = range(300, 310)  # seeds of each block's errors, that nothing was tried on
GIVES_MM, GIVES_DEG = 0.5, 0.3  # of a bracket, from the first frame to the last, to any side
LITTLE = 0.17  # mm and deg: 0.1 along each axis, as under conditions of life
SLIPS_MM = 0.8  # of the wires, likewise
WATER_C, TISSUE = 1.0, 0.02  # standard deviations of the water's temperature, and of the tissue's speed over that assumed


def rows(setup: Setup) -> list[Row]:
    """Row s: what moved is found, and the errors are as large as predicted; depths at speeds that are off, likewise."""
    still = list(_calibrations(setup, 0.0, 0.0, 0.0))
    giving = list(_calibrations(setup, GIVES_DEG, GIVES_MM, 0.0))
    slipping = list(_calibrations(setup, 0.0, 0.0, SLIPS_MM))
    little = list(_calibrations(setup, LITTLE, LITTLE, 0.0))
    count = f"{len(still)} calibrations"
    honest = f"{count}, nothing moves: squared error over covariance, of 8"
    gives = f"{count}, a bracket that gives by {GIVES_MM:g} mm and {GIVES_DEG:g} deg"
    hardly = f"{count}, a bracket that gives by {LITTLE:g} mm and {LITTLE:g} deg"
    slips = f"{count}, wires that slip by {SLIPS_MM:g} mm"
    return [
        Row("s", f"{count}, nothing moves: taken for a movement", _named(still, None), 5.0, 0.1, "%"),
        Row("s", f"{honest}, at least", _squared(still), 6.0, 8.0, "", at_least=True),
        Row("s", f"{honest}, at most", _squared(still), 10.0, 8.0, ""),
        Row("s", f"{gives}: found", _named(giving, None), None, None, "%"),
        Row("s", f"{gives}: named so", _named(giving, movement.PROBE), None, None, "%"),
        Row("s", f"{gives}: squared error at its end over covariance, of 8", _squared(giving), 10.0, 8.0, ""),
        Row("s", f"{slips}: found", _named(slipping, None), None, None, "%"),
        Row("s", f"{slips}: named so, else as the bracket's", _named(slipping, movement.WIRES), None, None, "%"),
        Row("s", f"{slips}: squared error over covariance, of 8", _squared(slipping), 10.0, 8.0, ""),
        Row("s", f"{hardly}: squared error at its end over covariance, of 8", _squared(little), 10.0, 8.0, ""),
        _depths(setup),
    ]


def _calibrations(
    setup: Setup, gives_deg: float, gives_mm: float, slips_mm: float
) -> Iterator[tuple[Adjustment, ProbeCalibration]]:
    """Calibrations of all blocks, each beside the probe as it is at the end."""
    frames, truth = probe_accuracy.recorded(setup.rig, setup.scanners["water"]), probe_accuracy.in_water(setup)
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


def _named(results: list[tuple[Adjustment, ProbeCalibration]], what: str | None) -> float:
    """Share in % in which a movement of some kind, or of any, is found."""
    named = [found.moved and found.moved.what for found, _ in results]
    return 100 * float(np.mean([name == what if what else name is not None for name in named]))


def _squared(results: list[tuple[Adjustment, ProbeCalibration]]) -> float:
    return float(np.mean([probe_accuracy.squared_length(found.calibration, truth) for found, truth in results]))


def _depths(setup: Setup) -> Row:
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
    what = f"water off by {WATER_C:g} deg C and tissue by {100 * TISSUE:g} % (1 sigma): depths' error / predicted sigma, RMS"
    return Row("s", what, rms(np.array(errors)), 1.15, 1.0, "")
