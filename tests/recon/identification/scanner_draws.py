"""Scanners drawn at random, and what the twin's scanner shows of even tissue and of air."""

import numpy as np
from numpy.typing import NDArray

from recon.identification.estimates import Estimate, Findings
from recon.identification.scanner import Recordings, Sheet
from scenes.tissue import Tissue
from tests.twin.ultrasound.phantoms import down
from twin.experiments.drawn_rig import draw_scanner
from twin.ultrasound.bscan import scan
from twin.ultrasound.echo_solids import Body
from twin.ultrasound.transducer import Transducer

Images = NDArray[np.uint8]

STEP_MM = 0.22  # between B-scans side by side
LABEL, SHEET = 0.05, (0.05, 0.5)  # relative error of the frequency and of the attenuation, and dB of the tissue's echo
EMPTY = Tissue(1.5, 1540.0, 0.0, None)


def drawn(seed: int) -> tuple[Transducer, float, np.random.Generator]:
    """A scanner, and the attenuation of its phantom."""
    rng = np.random.default_rng([seed, 77])
    return draw_scanner(rng), rng.uniform(0.4, 0.6), rng


def recorded(array: Transducer, attenuation: float, seed: int, places: int = 8, steps: int = 14) -> Recordings:
    """B-scans of even tissue at several places and side by side, and of air."""
    tissue = Body(Tissue(1.6, 1540.0, attenuation, 0.0), (), ())

    def images(body: Body, poses: list, first: int) -> Images:
        return np.stack([scan(body, array, pose, seed, first + k).image for k, pose in enumerate(poses)])

    beside = [down(array, (0, -500 + STEP_MM * k, 0)) for k in range(steps)]
    return Recordings(
        images(tissue, [down(array, (0, 30.0 * k, 0)) for k in range(places)], 0),
        images(Body(EMPTY, (), ()), [down(array, (0, 0, 0))] * 3, 100),
        images(tissue, beside, 200) if steps else None,
        np.stack(beside) if steps else None,
    )


def sheet_of(array: Transducer, attenuation: float, rng: np.random.Generator) -> Sheet:
    """What labels say, with their errors."""
    f = array.frequency_mhz * (1 + LABEL * rng.standard_normal())
    a = attenuation * (1 + SHEET[0] * rng.standard_normal())
    return Sheet(
        array.scale_mm_per_px,
        Estimate(f, LABEL * f, "label"),
        Estimate(a, SHEET[0] * a, "sheet"),
        Estimate(SHEET[1] * rng.standard_normal(), SHEET[1], "sheet"),
    )


def deviations(found: Findings, array: Transducer) -> dict[str, float]:
    """Errors over their standard deviations, by the field."""
    truth = array.model_dump() | {f"bandwidth.{n}": value for n, value in enumerate(array.bandwidth)}
    fields = {name.removeprefix("ultrasound."): each for name, each in found.estimates.items()}
    return {name: (each.value - truth[name]) / each.sigma for name, each in fields.items()}
