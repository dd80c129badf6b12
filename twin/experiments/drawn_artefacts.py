"""Artefacts drawn within their certificates: sizes as they are in a room of a temperature within its limits."""

from typing import NamedTuple

import numpy as np

from recon.acceptance.certificates import Artefacts, Certified, Material
from recon.acceptance.optical_acceptance import REFERENCE_C


class Actual(NamedTuple):
    """Sizes as they are; 0 of artefacts that there aren't."""

    radius_mm: float = 0.0
    length_mm: float = 0.0
    ball_radius_mm: float = 0.0  # of both balls, whose certified diameters are their mean's


def draw(artefacts: Artefacts, rng: np.random.Generator) -> Actual:
    """Draw sizes."""
    warmer = artefacts.temperature_c - REFERENCE_C + artefacts.temperature_limit_c * rng.uniform(-1, 1)

    def grown(one: Certified, expansion: float) -> float:
        return float((one.mm + one.standard_mm * rng.standard_normal()) * (1 + expansion * warmer))

    def expansion(body: Material) -> float:
        return body.expansion_per_k + body.expansion_limit_per_k * rng.uniform(-1, 1)

    actual = Actual()
    if artefacts.sphere is not None:
        actual = actual._replace(radius_mm=grown(artefacts.sphere.diameter, expansion(artefacts.sphere)) / 2)
    if artefacts.bar is not None:
        own = expansion(artefacts.bar)
        diameters = [grown(one, own) for one in artefacts.bar.diameters]
        actual = actual._replace(length_mm=grown(artefacts.bar.length, own), ball_radius_mm=sum(diameters) / 4)
    return actual
