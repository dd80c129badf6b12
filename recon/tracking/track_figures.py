"""Figures of a tracked film, and the lines that report them."""

import re
from collections import Counter
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from recon.files.metrics import Metrics, shown
from recon.geometry.order_statistics import NORMAL_MAD
from recon.model import circle_layout
from recon.model.rig import Target
from recon.tracking.results import Step
from recon.tracking.tracker import EXCHANGED, is_beside

Array = NDArray[np.float64]

WAYS = ("predicted", "segmented", "detected")
KINDS = 4  # of reasons that are reported one by one
FEW = 5  # pairs, of which nothing is said in common
GAP_MM = 0.06  # of the rays: 0.3 px of the rig, twice what a calibration with residuals of 0.15 px leaves
OFF_MM = 0.02  # of a length
ALIKE = 2.0  # times the spread from pair to pair
BEYOND = 3.0  # times the tolerance
CAUSES = {  # of views without the target, by a part of their reason, the first that fits
    "^too dark": "too dark, or even",
    "^too small": "circles of less than 16 px",
    "^out of view": "circles out of view",
    "blurred by": "blurred by motion or out of focus",
    "a contrast of|an uncertainty of": "too little contrast",
    "of its rim seen|no white middle": "circles covered, or cut off",
    "no rim": "no rims where circles are expected",
    r"\d of \d circles|places like circles": "no circles like the target's, of 16 px and more",
}
MEASURE = "measure it with calibrate-target"
MOVED = "a camera was moved after its calibration, or that is of others; calibrate-optics anew"


def measure(steps: Sequence[Step], target: Target) -> Metrics:
    """Figures of a track, each named with its unit; frames a second are of the tracker alone, in its median frame."""
    found = [step for step in steps if step.found]
    sigma = np.array([step.sigmas for step in found]).reshape(-1, 2)
    typical = np.median(sigma, axis=0) if found else np.full(2, np.nan)
    return {
        "frames": len(steps),
        "frames_found": len(found),
        "frames_with_a_second_target": sum(is_beside(step.apart_mm) for step in steps),
        **{f"frames_{way}": sum(step.how == way for step in found) for way in WAYS},
        "sigma_median_mm": float(typical[0]),
        "sigma_median_deg": float(typical[1]),
        "shared_median_mm": float(np.median([step.shared_sigmas[0] for step in found])) if found else np.nan,
        **_triangulated(steps, target),
        "frames_per_s": 1 / max(float(np.median([step.seconds for step in steps])), 1e-9),
    }


def describe(steps: Sequence[Step], figures: Metrics) -> list[str]:
    """Lines: number of poses and reasons of missing ones, speed with the ways of finding, predicted standard deviations."""
    found, count = figures["frames_found"], figures["frames"]
    lost = [f"lost        {line}" for line in _lost(steps)]
    missed = ", ".join(f"{kind} ({number})" for kind, number in kinds([step.reason for step in steps]))
    left = f", {count - found} not: {missed}" if found < count else ""
    ways = ", ".join(f"{figures[f'frames_{way}']} {way}" for way in WAYS if figures[f"frames_{way}"])
    return [
        f"found       {found} of {count} frames{left}",
        *lost,
        f"speed       {figures['frames_per_s']:.1f} frames a second, in the median{f'; {ways}' if ways else ''}",
        f"sigma       {shown(figures['sigma_median_mm'], '.3f', ' mm')}, {shown(figures['sigma_median_deg'], '.3f', ' deg')}, "
        f"predicted, median; {shown(figures['shared_median_mm'], '.3f', ' mm')} by tolerances, alike in all pairs",
    ]


def _lost(steps: Sequence[Step]) -> Iterator[str]:
    """Lines: causes of the views that don't show the target, with their numbers, a line a camera."""
    seen = [views_of(step.reason) for step in steps if step.reason is not None]
    for name in ("camera 1", "camera 2"):
        counted = Counter(views[name] for views in seen if name in views).most_common(KINDS)
        if counted:
            yield f"{name}: {', '.join(f'{why} ({number})' for why, number in counted)}"


def _triangulated(steps: Sequence[Step], target: Target) -> Metrics:
    """Medians of the target's lengths and of the rays' gap, as both cameras triangulate them."""
    known = [step.triangle for step in steps if step.triangle is not None]
    lengths = np.median([one.lengths_mm for one in known], axis=0) if known else np.full(len(target.LENGTHS), np.nan)
    gap = float(np.median([one.gaps_mm.mean() for one in known])) if known else np.nan
    named = {f"triangulated_{name}": float(value) for name, value in zip(target.LENGTHS, lengths, strict=True)}
    return named | {"ray_gap_mm": gap}


def causes(steps: Sequence[Step], target: Target) -> Iterator[str]:
    """Lines: errors alike in all pairs, found or not, with the likely cause."""
    crossed = sum(step.reason == EXCHANGED for step in steps)
    if crossed > sum(step.found for step in steps):
        yield (
            f"warning     cameras exchanged? In {crossed} of {len(steps)} pairs the views show the target as each other's: "
            "exchange the frames of cam1 and cam2, or their names in the calibration"
        )
    yield from second_target([step.apart_mm for step in steps])
    known = [step.triangle for step in steps if step.triangle is not None]
    if len(known) < FEW:
        return
    of = f"alike in {len(known)} pairs"
    gap, spread = _middle(np.array([one.gaps_mm.mean() for one in known]))
    if abs(gap) > max(GAP_MM, ALIKE * spread):
        yield f"warning     both cameras' rays miss each other by {abs(gap):.2f} mm, {of}: {MOVED}"
    off, spread = _middle(np.array([one.lengths_mm for one in known]) - circle_layout.lengths(target))
    alike = np.abs(off) > np.maximum(OFF_MM, ALIKE * spread)
    if not alike.any():
        return
    names = (name.removesuffix("_mm").replace("_", " ") for name in target.LENGTHS)
    found = ", ".join(f"{name} by {value:+.2f} mm" for name, value, one in zip(names, off, alike, strict=True) if one)
    tolerance = np.sqrt(np.diag(circle_layout.length_covariance(target)))
    if (np.abs(off) > BEYOND * tolerance).any() and target.covariance_mm2 is not None:
        yield f"warning     the target isn't the one that was measured, off {found}, {of}: another print? Measure this one, too"
    elif (np.abs(off) > BEYOND * tolerance).any():
        yield f"warning     the target's circles aren't where rig.target has them, off {found}, {of}: {MEASURE}"
    else:
        yield f"target      off its design within the tolerance, {found}: {MEASURE}, and poses get more exact"


def second_target(apart_mm: Sequence[float | None]) -> Iterator[str]:
    """A line on further targets of the design, if there are any, by the distance of each pair's as of `Tracking.apart_mm`."""
    searched = sum(one is not None for one in apart_mm)
    two = [k for k, one in enumerate(apart_mm) if is_beside(one)]
    if two:
        yield (
            f"warning     a second target of this design in {len(two)} of {searched} pairs searched for one, first in pair "
            f"{two[0]}, {apart_mm[two[0]]:.0f} mm from the one that is followed: the surer one at first, after a loss "
            "the nearer to the last pose; cover the other one"
        )


def _middle(values: Array) -> tuple[Array, Array]:
    """Medians over the first axis, and standard deviations by the median deviation."""
    middle = np.median(values, axis=0)
    return middle, NORMAL_MAD * np.median(np.abs(values - middle), axis=0)


def kinds(reasons: Sequence[str | None]) -> list[tuple[str, int]]:
    """Reasons without their details and their numbers, the commonest first; the rarest are put together."""
    counted = Counter(kind(reason) for reason in reasons if reason is not None).most_common()
    rest = sum(number for _, number in counted[KINDS:])
    return counted[:KINDS] + ([("others", rest)] if rest else [])


def kind(reason: str) -> str:
    """A reason without its details."""
    if reason.startswith("camera ") and "expected an image" not in reason:
        return "no camera sees enough circles"
    return re.sub(r"^camera \d: ", "", re.split(r"[;:] (?!expected an image)", reason)[0])


def views_of(reason: str) -> dict[str, str]:
    """Of a pair that views give no pose of: the cause in each camera's view that doesn't show the target, by camera."""
    parts = re.split(r"(?:^|; )(camera [12]): ", reason)
    return {name: cause(why) for name, why in zip(parts[1::2], parts[2::2], strict=True)}


def cause(reason: str) -> str:
    """The cause, in a few words, that a view doesn't show the circles."""
    told = next((words for part, words in CAUSES.items() if re.search(part, reason)), None)
    return told or re.split(r"[;:]", reason)[0]
