"""Decisions whether a test value keeps to its limit, by ISO 14253-1: the uncertainty counts against whoever has to prove."""

from collections.abc import Iterable
from typing import Literal

from recon.model.part import Part, Positive

Decision = Literal["accepted", "rejected", "neither"]


class Limits(Part):
    """Maximum permissible errors (MPE) of a rig; a test whose limit is null is reported without a decision."""

    pf_mm: Positive | None = 0.3
    """PF, probing error of form: width of the shell around all points of a sphere, less the worst 3 in 1000"""
    pf95_mm: Positive | None = 0.2
    """P[Form.Sph.D95%], the same around 95 % of the points"""
    ps_mm: Positive | None = 0.1
    """PS, P[Size.Sph.All], probing error of size: fitted less certified diameter"""
    sd_mm: Positive | None = 0.15
    """SD, sphere-spacing error: distance of the balls' centres less the certified one"""
    e_mm: Positive | None = 0.2
    """E, length measurement error: length over both balls, from end to end, less the certified one"""
    f_mm: Positive | None = 0.4
    """F, flatness measurement error: distance of two planes around all points of a plane, less the worst 3 in 1000"""
    f95_mm: Positive | None = 0.25
    """the same around 95 % of the points"""
    tp_mm: Positive | None = None
    """TP, repeatability of a tracked tool's tip in a divot: distance from its mean, RMS"""
    td_mm: Positive | None = None
    """TD, error of the distance of two divots by a tracked tool"""
    ud_mm: Positive | None = None
    """UD, calliper error: distance of two filaments in a B-scan less the certified one"""
    ul_mm: Positive | None = None
    """UL, lateral resolution: width of a filament's echo along the array at -6 dB"""
    ua_mm: Positive | None = None
    """UA, axial resolution: the same in depth"""


def decide(value_mm: float, expanded_mm: float, limit_mm: float) -> Decision:
    """Decision on an error: accepted where it is within the limit by the expanded uncertainty, rejected where beyond by it.

    The guard band is the expanded uncertainty for 95 %, to both sides of the limit, so that what is accepted and what is rejected
    is proven; between them nothing is.
    """
    size = abs(value_mm)
    if size + expanded_mm <= limit_mm:
        return "accepted"
    return "rejected" if size - expanded_mm > limit_mm else "neither"


def together(decisions: Iterable[Decision]) -> Decision:
    """Decision on a rig: accepted where all are, rejected where one is."""
    found = set(decisions)
    return "rejected" if "rejected" in found else "accepted" if found == {"accepted"} else "neither"
