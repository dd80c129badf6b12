"""Figures of a tracked film, and the lines that report them."""

import re
from collections import Counter
from collections.abc import Sequence

import numpy as np

from recon.files.metrics import Metrics, shown
from recon.tracking.results import Step

WAYS = ("predicted", "segmented", "detected")
KINDS = 4  # of reasons that are reported one by one


def measure(steps: Sequence[Step]) -> Metrics:
    """Figures of a track, each named with its unit; frames a second are of the tracker alone, in its median frame."""
    found = [step for step in steps if step.found]
    sigma = np.array([step.sigmas for step in found]).reshape(-1, 2)
    typical = np.median(sigma, axis=0) if found else np.full(2, np.nan)
    return {
        "frames": len(steps),
        "frames_found": len(found),
        **{f"frames_{way}": sum(step.how == way for step in found) for way in WAYS},
        "sigma_median_mm": float(typical[0]),
        "sigma_median_deg": float(typical[1]),
        "frames_per_s": 1 / max(float(np.median([step.seconds for step in steps])), 1e-9),
    }


def describe(steps: Sequence[Step], figures: Metrics) -> list[str]:
    """Lines: number of poses and reasons of missing ones, speed with the ways of finding, predicted standard deviations."""
    found, count = figures["frames_found"], figures["frames"]
    missed = ", ".join(f"{kind} ({number})" for kind, number in kinds([step.reason for step in steps]))
    left = f", {count - found} not: {missed}" if found < count else ""
    ways = ", ".join(f"{figures[f'frames_{way}']} {way}" for way in WAYS if figures[f"frames_{way}"])
    return [
        f"found       {found} of {count} frames{left}",
        f"speed       {figures['frames_per_s']:.1f} frames a second, in the median{f'; {ways}' if ways else ''}",
        f"sigma       {shown(figures['sigma_median_mm'], '.3f', ' mm')}, {shown(figures['sigma_median_deg'], '.3f', ' deg')}, "
        "predicted, median",
    ]


def kinds(reasons: Sequence[str | None]) -> list[tuple[str, int]]:
    """Reasons without their details and their numbers, the commonest first; the rarest are put together."""
    counted = Counter(kind(reason) for reason in reasons if reason is not None).most_common()
    rest = sum(number for _, number in counted[KINDS:])
    return counted[:KINDS] + ([("others", rest)] if rest else [])


def kind(reason: str) -> str:
    """A reason without its details."""
    if reason.startswith("camera 1:"):
        return "no camera sees all three circles"
    return re.sub(r"(?<!\w)(?<!camera )\d[\d.]*", "…", re.split(r"[;:]", reason)[0])
