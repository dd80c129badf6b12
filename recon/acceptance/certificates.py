"""Certificates of the artefacts: calibrated values with their uncertainties, as laboratories state them."""

from typing import Annotated

import numpy as np
from pydantic import Field, model_validator

from recon.model.part import Finite, NotNegative, Part, Positive, Vector

Size = tuple[Positive, Positive, Positive]


class Certified(Part):
    """A calibrated length at 20 deg C."""

    mm: Positive
    """mm, the value"""
    expanded_mm: NotNegative
    """mm, expanded uncertainty U as stated"""
    k: Annotated[float, Field(ge=1, le=4)] = 2.0
    """coverage factor of U"""

    @property
    def standard_mm(self) -> float:
        """Standard uncertainty."""
        return self.expanded_mm / self.k


class Material(Part):
    """A body that grows with warmth, and its paint."""

    expansion_per_k: NotNegative = 11.5e-6
    """1/K, of length: steel 11.5e-6, alumina 7e-6, carbon fibre about 0"""
    expansion_limit_per_k: NotNegative = 1.0e-6
    """1/K, half the width of the interval that holds it"""
    coat_mm: NotNegative = 0.0
    """mm, thickness of paint that was not on it when it was calibrated"""
    coat_limit_mm: NotNegative = 0.0
    """mm, half the width of the interval that holds it"""
    mounting_mm: NotNegative = 0.0
    """mm, standard uncertainty of the test value by how it is held, such as a bar that bends"""


class BallCertificate(Material):
    """The sphere."""

    diameter: Certified
    form_mm: NotNegative
    """mm, certified deviation from a sphere, peak to valley"""


class BarCertificate(Material):
    """The ball bar."""

    length: Certified
    """from centre to centre"""
    diameters: tuple[Certified, Certified]
    """of its balls"""
    rod_mm: Positive
    """mm, diameter of the rod, about which no points are taken"""


class PlateCertificate(Part):
    """The plane."""

    size_mm: tuple[Positive, Positive]
    """mm, length and width"""
    form_mm: NotNegative
    """mm, certified deviation from a plane, peak to valley"""


class DivotCertificate(Material):
    """A plate with divots, in which the tip of a tracked tool stands."""

    places_mm: Annotated[tuple[Vector, ...], Field(min_length=2)]
    """mm, the tip in each divot, in a frame of the plate; divots are numbered from 0"""
    expanded_mm: NotNegative
    """mm, expanded uncertainty U of a distance of two of them"""
    k: Annotated[float, Field(ge=1, le=4)] = 2.0
    """coverage factor of U"""

    def distance(self, first: int, second: int) -> Certified:
        """Distance of two divots."""
        apart = np.linalg.norm(np.subtract(self.places_mm[second], self.places_mm[first]))
        return Certified(mm=float(apart), expanded_mm=self.expanded_mm, k=self.k)


class Screen(Part):
    """How a scanner shows its B-scans."""

    mm_per_px: tuple[Positive, Positive] = (0.1229, 0.1225)
    """mm a pixel, along the array and in depth, by the scanner's own scale"""
    assumed_m_s: Positive = 1540.0
    """m/s, speed of sound by which it shows depths"""
    dynamic_range_db: Positive = 60.0
    """dB from black to white, greys being even in dB"""
    dynamic_range_limit_db: NotNegative = 3.0
    """dB, half the width of the interval that holds it"""


class FilamentCertificate(Part):
    """An ultrasound phantom with parallel filaments, which the image's plane crosses squarely."""

    places_mm: Annotated[tuple[tuple[Finite, Finite], ...], Field(min_length=3)]
    """mm, each filament across all of them: along the phantom's face, and below it; filaments are numbered from 0"""
    expanded_mm: NotNegative
    """mm, expanded uncertainty U of a distance of two of them"""
    k: Annotated[float, Field(ge=1, le=4)] = 2.0
    """coverage factor of U"""
    speed_m_s: Annotated[float, Field(ge=1300, le=1800)] = 1540.0
    """m/s, of sound in the phantom at the room's temperature"""
    speed_limit_m_s: NotNegative = 5.0
    """m/s, half the width of the interval that holds it"""
    screen: Screen = Screen()
    """of the scanner, as it is set"""

    def distance(self, first: int, second: int) -> Certified:
        """Distance of two filaments."""
        apart = np.linalg.norm(np.subtract(self.places_mm[second], self.places_mm[first]))
        return Certified(mm=float(apart), expanded_mm=self.expanded_mm, k=self.k)


class Volume(Part):
    """The measuring volume, a box along the world's axes, that the rig is specified for."""

    centre_mm: Vector = (4.0, -2.0, 659.5)
    """mm in the world"""
    size_mm: Size = (253.0, 199.0, 107.0)
    """mm, width, height, depth"""

    @property
    def diagonal_mm(self) -> float:
        """L0, the length of its space diagonal."""
        return float(sum(side**2 for side in self.size_mm) ** 0.5)


class Artefacts(Part):
    """All artefacts of an acceptance test, and the room."""

    volume: Volume = Volume()
    """that is tested"""
    temperature_c: Finite = 20.0
    """deg C, of the artefacts"""
    temperature_limit_c: NotNegative = 1.0
    """K, half the width of the interval that holds it"""
    sphere: BallCertificate | None = None
    """null: no tests of probing"""
    bar: BarCertificate | None = None
    """null: no tests of lengths"""
    plane: PlateCertificate | None = None
    """null: no test of flatness"""
    divots: DivotCertificate | None = None
    """null: no tests of a tracked tool"""
    filaments: FilamentCertificate | None = None
    """null: no tests of the scanner"""

    @model_validator(mode="after")
    def _can_be(self) -> "Artefacts":
        bar = self.bar
        if bar is not None and bar.length.mm <= (bar.diameters[0].mm + bar.diameters[1].mm) / 2:
            raise ValueError(f"bar.length.mm: expected more than its balls' diameters, found {bar.length.mm:g}")
        if bar is not None and bar.rod_mm >= min(ball.mm for ball in bar.diameters):
            raise ValueError(f"bar.rod_mm: expected less than its balls' diameters, found {bar.rod_mm:g}")
        for name, body in (("divots", self.divots), ("filaments", self.filaments)):
            if body is not None:
                places = np.array(body.places_mm)
                apart = np.linalg.norm(places[:, None] - places[None], axis=-1) + np.diag(np.full(len(places), np.inf))
                if not apart.min() > 0:
                    first, second = np.unravel_index(apart.argmin(), apart.shape)
                    raise ValueError(
                        f"{name}.places_mm: expected places apart from each other, found {first} and {second} in one place"
                    )
        if not any((self.sphere, bar, self.plane, self.divots, self.filaments)):
            raise ValueError("expected sphere, bar, plane, divots or filaments, found none of them")
        return self
