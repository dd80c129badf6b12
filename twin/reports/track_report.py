"""Tracking's section of the report: pictures of frames, errors against predicted ones, and reasons for frames without a pose."""

import csv
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path

import cv2
import numpy as np

from recon.errors import InputError
from recon.files.metrics import Metrics, shown
from recon.files.regular import read_text
from recon.reports import figures, page
from recon.reports.figures import Colours
from recon.reports.page import Section
from recon.tracking import results
from twin.evaluation import track_errors
from twin.evaluation.track_errors import LEVEL, Errors, FilmTruth

FAILURES_SHOWN = 10
NAMES = ("error", f"predicted: {100 * LEVEL:.0f} % lie below")


@dataclass(frozen=True, eq=False)
class Tracked:
    """A film of n frames, its poses, and its truth."""

    folder: Path  # of the poses
    errors: Errors
    truth: FilmTruth
    hows: tuple[str, ...]  # (n,) "" where the target was not found
    reasons: tuple[str, ...]  # (n,) "" where it was
    overlays: tuple[Path, ...]  # (n,)


def read(truth: Path, track: Path, name: str = "") -> Tracked:
    """Read the truth of filmed frames, of one of several sweeps by its name, and what `sonotwin track` found in them.

    Raises
    ------
    InputError
        If something is missing or damaged, or they don't fit together.
    """
    expected = track_errors.read_truth(truth, name)
    errors = track_errors.compare(track_errors.read_track(track / results.POSES, expected), expected)
    rows = list(csv.DictReader(read_text(track / results.FRAMES).splitlines()))
    if len(rows) != len(expected.times):
        raise InputError(f"{track / results.FRAMES}: expected {len(expected.times)} frames, found {len(rows)}")
    pictures = tuple(track / results.OVERLAYS / results.overlay_name(int(row["frame_cam1"])) for row in rows)
    return Tracked(track, errors, expected, tuple(row["how"] for row in rows), tuple(row["reason"] for row in rows), pictures)


def result(metrics: Metrics) -> str:
    """Summary of the tracking in one sentence; nothing if there was none."""
    if "track_found" not in metrics:
        return ""
    seen = f"{metrics['track_visible_found']} of the {metrics['track_visible']} frames that show it whole to both cameras"
    off = f"{shown(metrics['track_shift_median_mm'], '.3f', ' mm')} and {shown(metrics['track_turn_median_deg'], '.3f', '°')}"
    return f" The probe’s target was found in {seen}, off by {off} in the median."


def section(story: Tracked, metrics: Metrics, swept: bool) -> Section:
    """The tracker's frames, its errors, and the frames without a pose; of a sweep with B-scans, or of a film."""
    text = (
        "While the scanner records, both cameras see the board on the probe, held by a hand over the very phantom, in light as "
        f"dark as the real rig’s; its circles move by up to {metrics['track_blur_most_px']:.1f} px in an exposure. Networks find "
        "them; from then on their rims are fitted where the last poses let expect them. What the two views together don’t show "
        "to be the target is not found, rather than found wrongly. A B-scan’s pose is taken between those of two frames."
        if swept
        else "A hand leads the target past the cameras, in light as dark as the real rig’s: slowly, then so fast that rims are "
        f"blurred by up to {metrics['track_blur_most_px']:.1f} px, then partly out of one camera’s view. Networks find its "
        "circles; from then on their rims are fitted where the last poses let expect them. What the two views "
        "together don’t show to be the target is not found, rather than found wrongly."
    )
    detail = "With the bound that the tracker’s own covariance sets; shaded: not found."
    drawings = [
        page.drawing(figures.course(values, bounds, ("frame", f"{what}, {unit}"), NAMES), f"Error of the {what}", detail)
        for what, unit, values, bounds in (
            ("position", "mm", story.errors.shift_mm, story.errors.shift_bound_mm),
            ("orientation", "°", story.errors.turn_deg, story.errors.turn_bound_deg),
        )
    ]
    blocks = [
        page.paragraph(text),
        page.grid([page.picture(*picture) for picture in pictures(story)], "two"),
        page.grid(drawings, "two"),
        errors_table(metrics, "by the board" if swept and "point_sigma_mm" in metrics else "the true one here"),
        *failures(story),
    ]
    return Section("The tracker", blocks)


def pictures(story: Tracked) -> Iterator[tuple[Colours, str, str]]:
    """Both views of some frames, each with caption and detail."""
    blur = story.truth.blur_px.max(axis=(1, 2))
    for number, title in chosen(story.errors, blur).items():
        if (image := cv2.imread(str(story.overlays[number]))) is None:
            continue  # tracked without pictures
        how = f"{story.hows[number]}, off by {story.errors.shift_mm[number]:.3f} mm" if story.hows[number] else "not found"
        detail = f"Frame {number}, both cameras, brightened; {how}; blurred by {blur[number]:.1f} px."
        yield cv2.cvtColor(image, cv2.COLOR_BGR2RGBA), title, detail


def chosen(errors: Errors, blur: np.ndarray) -> dict[int, str]:
    """Frames to show, with a title each: the first found, the fastest found, one not found, the last found."""
    found, missed = np.flatnonzero(errors.found), np.flatnonzero(~errors.found)
    frames: dict[int, str] = {}
    if found.size:
        frames[int(found[0])] = "The first"
        frames.setdefault(int(found[blur[found].argmax()]), "The fastest")
    if missed.size:
        frames[int(missed[len(missed) // 2])] = "One not found"
    if found.size:
        frames.setdefault(int(found[-1]), "The last")
    return frames


def errors_table(metrics: Metrics, calibrated: str) -> str:
    """Detection rates and errors; calibrated : of the cameras, for the caption."""
    rows = []
    for what, kind, unit in (("Position of the target’s origin", "shift", "mm"), ("Orientation", "turn", "deg")):
        sign = "°" if unit == "deg" else " mm"
        values = (f"track_sigma_median_{unit}", f"track_{kind}_median_{unit}", f"track_{kind}_p95_{unit}")
        rows.append((what, *(shown(metrics[name], ".3f", sign) for name in values)))
    caption = (
        f"Found: {metrics['track_found']} of {metrics['track_frames']} frames, and {metrics['track_visible_found']} of the "
        f"{metrics['track_visible']} that show all circles to both cameras; {metrics['track_false']} of them wrongly. "
        f"{100 * metrics['track_within_bound']:.0f} % of the errors lie below their {100 * LEVEL:.0f} % bounds. Predicted: one "
        f"standard deviation over all directions, the print known to its tolerance. The cameras’ calibration is {calibrated}."
    )
    return page.table(("", "predicted, median", "off by, median", "off by, 95th percentile"), rows, caption)


def failures(story: Tracked) -> list[str]:
    """Why frames were not found, neighbours of one reason together; nothing if all were."""
    if story.errors.found.all():
        return []
    missed = np.flatnonzero(~story.errors.found).tolist()
    runs = [list(run) for _, run in groupby(enumerate(missed), lambda pair: (pair[1] - pair[0], story.reasons[pair[1]]))]
    rows = [(_span([frame for _, frame in run]), story.reasons[run[0][1]]) for run in runs]
    more = [("", f"{len(rows) - FAILURES_SHOWN} more")] if len(rows) > FAILURES_SHOWN else []
    return [page.table(("not found: frames", "why"), [*rows[:FAILURES_SHOWN], *more])]


def _span(frames: Sequence[int]) -> str:
    return f"{frames[0]}" if len(frames) == 1 else f"{frames[0]} to {frames[-1]}"
