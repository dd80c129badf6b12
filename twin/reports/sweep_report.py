"""Ultrasound's sections of the report: masses inside the measured surface, the probe's calibration and its sweep."""

import csv
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from recon.capture import lag_files, probe_files, sweep_part
from recon.capture.sweep_part import SweepCapture
from recon.files import volumes
from recon.files.metrics import FILE, Metrics, shown
from recon.files.metrics import read as read_figures
from recon.files.regular import read_text
from recon.files.volumes import Volume
from recon.freehand import sequences
from recon.geometry import rigid
from recon.model import tracks
from recon.model.probe import ProbeCalibration
from recon.probe_calibration import sound_in_water
from recon.probe_calibration.repeatability import five_points
from recon.reports import figures, page, space_views
from recon.reports.figures import SEQUENTIAL, Colours, Scale
from recon.reports.page import Section
from recon.reports.space_views import Lines, Shape, Sheet
from recon.segmentation import masses
from twin.evaluation import sweep_errors
from twin.evaluation.sweep_errors import Finding, SweepTruth
from twin.reports import sweep_pictures
from twin.reports.sweep_pictures import FOUND, TICK_MM, TRUE

Array = NDArray[np.float64]

SKIN = "#d9b8a4"
FRAMES = "#8f969c"
PATH = "#7d8b6a"
DEEP_MM = 20.0  # at which a speed of sound other than assumed is stated
MASS_MM = 10.0  # of a tumour, of which it is stated too
CELLS = (17, 21)  # of the maps over a B-scan, across and down
PLANES_SHOWN = 12  # B-scans whose outlines are drawn in space
PAPER = {  # Meza et al. 2021, Optical Engineering 60(5) 054106: CR2, and the RMS of the equations
    "equations": "0.423 mm",
    "centre": "0.274 mm",
    "corner": "0.345 mm",
    "mean": "0.368 mm",
}


@dataclass(frozen=True, eq=False)
class Inside:
    """A sweep, its results, and its truth."""

    sweep: SweepCapture
    world_from_pixel: Array  # (n, 4, 4), as measured, with depths as of speed_m_s
    volume: Volume
    findings: Sequence[Finding]
    truth: SweepTruth
    probe: ProbeCalibration
    bob: SweepCapture  # over a flat bottom
    depth_residuals: Array  # (k, 2) for each of its B-scans: depth in px and residual in px; NaN where none
    lag_s: float
    speed_m_s: float  # of sound in the tissue, as given to the reconstruction


def read(result: Path, scan: str, bottom: str, findings: Sequence[Finding], expected: SweepTruth) -> Inside:
    """Read the results of `sonotwin reconstruct`.

    Parameters
    ----------
    scan, bottom : names of the sweep over the scene, and of that over a flat bottom

    Raises
    ------
    InputError
        If one of them is missing or damaged.
    """
    sweep = sweep_part.read_sweep(result / "poses" / scan, scan)
    probe = probe_files.read(result / "probe" / "probe.yaml")
    lag_s = lag_files.read(result / "latency" / lag_files.FILE).lag_s
    rows = _rows(result / "latency" / "depths.csv")
    given = float(read_figures(result / "volume" / scan / FILE)["speed_m_per_s"])
    return Inside(
        sweep,
        sweep.poses(lag_s) @ sequences.target_from_pixel(sound_in_water.for_tissue(probe, given)),
        volumes.read_volume(result / "volume" / scan / "volume.nrrd"),
        findings,
        expected,
        probe,
        sweep_part.read_sweep(result / "poses" / bottom, bottom),
        np.array([[float(row[name] or "nan") for name in ("depth_px", "residual_px")] for row in rows]),
        lag_s,
        given,
    )


def result(metrics: Metrics) -> str:
    """The masses found inside, in one sentence; nothing without a sweep."""
    if "tumours_true" not in metrics:
        return ""
    found, count = metrics["tumours_found"], metrics["tumours_true"]
    errors = sweep_errors.of_each(metrics, "centre_error_mm")
    span = " to ".join(dict.fromkeys(f"{value:.2f}" for value in (min(errors), max(errors)))) if errors else ""
    off = f", {'their centres' if len(errors) > 1 else 'its centre'} off by {span} mm" if errors else ""
    false = f"; {metrics['tumours_false']} more are none" if metrics["tumours_false"] else ""
    return f" Ultrasound found {found} of {count} tumours inside it{off}{false}."


def inside(story: Inside, points: NDArray[np.float32], skin: NDArray[np.bool_], metrics: Metrics) -> Section:
    """The masses found: in space, in the B-scans and in numbers.

    Parameters
    ----------
    points : (h, w, 3), mm
        The measured surface, organised by the camera's pixels.
    skin : (h, w)
        Which of them to show.
    """
    text = (
        "The B-scans lie in the frame of the cameras, because the cameras track the probe: nothing is registered. "
        "Tumours are found without any knowledge of the truth, and meet the measured "
        "surface in one coordinate system."
    )
    caption = (
        "Drag to turn, scroll to come nearer, click in the legend to show or hide. The B-scan is the one that passes nearest to "
        "the centre of the largest tumour that was scanned; equal scales on all axes."
    )
    pairs = [page.picture(*picture) for picture in pictures(story)]
    width, height = np.array(story.sweep.size) * masses.pixel_mm(story.world_from_pixel)
    beside = (
        f"Each B-scan ({width:.0f} mm wide, {height:.0f} mm deep, ticks every {TICK_MM:.0f} mm) beside what it should show: "
        "each tissue’s mean grey, without speckle, surfaces, loss, blur or noise. True outlines are cut from the rendered thing "
        "at the true pose, found ones from the found thing at the tracked pose, so their distance holds every error there is. "
        f"{too_deep(story.truth, story.speed_m_s)}"
    )
    return Section(
        "Inside",
        [
            page.paragraph(text),
            page.view("inside", view(story, points, skin), caption),
            tumours(story, metrics),
            page.paragraph(beside),
            page.key({"found": FOUND, "true": TRUE}),
            page.grid(pairs, "two"),
        ],
    )


def too_deep(expected: SweepTruth, given: float) -> str:
    """Effect of the tissue's speed of sound on depths, and its correction."""
    speed, assumed = sweep_pictures.tissue_speed(expected), expected.transducer.assumed_speed
    off = float(sound_in_water.shown_too_deep(DEEP_MM, speed, assumed))
    lies = f"lies {abs(off):.1f} mm {'less' if off > 0 else 'more'} deep" if off else "lies there"
    names = {thing.name for thing in expected.hidden}
    of_mass = float(np.mean([solid.tissue.speed for solid in expected.body.solids if solid.name in names]))
    shorter = MASS_MM * (1 - speed / of_mass)
    far = (
        f" The speed in a tumour ({of_mass:.0f} m/s) isn’t given: {MASS_MM:.0f} mm of it look {abs(shorter):.1f} mm "
        f"{'shorter' if shorter > 0 else 'longer'}, so its far side is shown {'above' if shorter > 0 else 'below'} its outline."
    )
    return (
        f"The speed of sound is {speed:.0f} m/s in this tissue, and the scanner assumes {assumed:.0f}: an echo shown "
        f"{DEEP_MM:.0f} mm deep {lies}. Found outlines, ticks and volume are for {given:.0f} m/s, as given to the "
        f"reconstruction, true outlines for {speed:.0f}."
        f"{far if round(abs(shorter), 1) else ''}"
    )


def view(story: Inside, points: NDArray[np.float32], skin: NDArray[np.bool_]) -> str:
    """The surface, the masses found under it, and the sweep, in space."""
    shapes = [space_views.surface_shape(points, skin, "measured surface", SKIN, 0.35)]
    for finding in story.findings:
        if finding.found is not None:
            shapes.append(Shape("tumours, found", finding.found.vertices, finding.found.faces, FOUND))
        shapes.append(Shape("tumours, true", finding.true.vertices, finding.true.faces, TRUE, opacity=0.5, shown=False))
    placed = np.flatnonzero(np.isfinite(story.world_from_pixel).all(axis=(1, 2)))
    right, bottom = np.array(story.sweep.size) - 1
    frame = np.array([[0, 0, 0], [right, 0, 0], [right, bottom, 0], [0, bottom, 0], [0, 0, 0]], float)
    some = placed[np.linspace(0, len(placed) - 1, min(PLANES_SHOWN, len(placed))).astype(int)]
    rectangles = np.stack([rigid.apply(story.world_from_pixel[k], frame) for k in some])
    middles = np.stack([rigid.apply(story.world_from_pixel[k], [right / 2, 0, 0]) for k in placed])
    lines = [Lines("some of the B-scans", rectangles, FRAMES), Lines("path of the probe’s face", middles[None], PATH)]
    shown_at = [sweep_errors.nearest_frame(one, story.world_from_pixel, story.sweep.size) for one in centres(story)]
    sheets = [
        Sheet("a B-scan", story.sweep.image(number), story.world_from_pixel[number]) for number in shown_at if number is not None
    ]
    return space_views.inside_view(shapes, lines, sheets[:1])


def centres(story: Inside) -> list[Array]:
    """True centres of volume : (3,) mm of the tumours, of the largest first."""
    ordered = sorted(story.findings, key=lambda finding: -finding.true.volume)
    return [np.asarray(finding.true.center_mass) for finding in ordered]


def tumours(story: Inside, metrics: Metrics) -> str:
    """The table of the masses found."""
    rows = []
    for finding in story.findings:
        figure = {
            key.removeprefix(f"{finding.name}_"): value for key, value in metrics.items() if key.startswith(f"{finding.name}_")
        }
        if finding.found is None:
            inside_it = "not found"
        else:
            inside_it = "unknown" if np.isnan(figure["inside"]) else "yes" if figure["inside"] else "no"
        rows.append(
            (
                _titled(finding.name),
                _beside(figure["extent_mm"], figure["true_extent_mm"], ".1f"),
                _beside(figure["volume_mm3"] / 1e3, figure["true_volume_mm3"] / 1e3, ".2f"),
                shown(figure["centre_error_mm"], ".2f"),
                shown(figure["outline_rms_mm"], ".2f"),
                shown(figure["dice"], ".3f"),
                _beside(figure["under_skin_mm"], figure["true_under_skin_mm"], ".1f"),
                inside_it,
            )
        )
    head = ("", "extent, mm", "volume, cm³", "centre off by, mm", "outline, RMS, mm", "Dice", "under the skin, mm", "inside")
    false = metrics["tumours_false"]
    besides = f"{false} {'things were' if false > 1 else 'thing was'}" if false else "Nothing was"
    caption = (
        "Two figures are found / true. Extent: the greatest, in any direction. Outline: distance of the found surface from the "
        "true one. Under the skin: least tissue between them, found from the measured surface, true from the rendered one. "
        f"{besides} found where there is no tumour. The paper shows its tumours of 27, 14 and 12 mm inside the surface, without "
        "figures."
    )
    return page.table(head, rows, caption)


def pictures(story: Inside) -> Iterator[tuple[Colours, str, str]]:
    """Each tumour's B-scan beside an ideal one, and a level section through the volume, each with caption and detail."""
    for finding in story.findings:
        centre = finding.true.center_mass
        number = sweep_errors.nearest_frame(centre, story.world_from_pixel, story.sweep.size)
        if number is None:
            continue
        yield (
            sweep_pictures.beside_truth(
                story.sweep.image(number), number, story.world_from_pixel[number], story.findings, story.truth
            ),
            _titled(finding.name),
            f"B-scan {number}, with the outline found and the true one; what it should show.",
        )
    level = float(np.median([finding.true.center_mass[2] for finding in story.findings]))
    yield (
        sweep_pictures.level_section(story.volume, level, story.findings),
        "Across all B-scans",
        f"The volume made of the sweep, cut level with the table at z = {level:.0f} mm, as seen from the cameras.",
    )


def probe_and_clock(story: Inside, metrics: Metrics) -> Section:
    """The probe's calibration, the lag of its images, and the error that both leave in a pixel's place."""
    text = (
        "Where a B-scan’s pixels lie in the frame of the probe’s target was found from the crossing of two wires in water, seen "
        "from all sides; the lag of the scanner’s images behind the cameras, from strokes up and down over a flat bottom."
    )
    names = ("speed of the probe, mm/s", "bottom late by, mm"), ("B-scans", f"{metrics['lag_ms']:.1f} ms")
    drawings = [
        *(page.picture(*picture) for picture in uncertainty(story, metrics)),
        page.drawing(
            figures.slope(*against_speed(story, metrics["probe_sy_measured_mm_per_px"]), 1e-3 * metrics["lag_ms"], *names),
            "Lag",
            "How far the bottom is from where the pose at the image’s time stamp lets expect it: the slope is the lag.",
        ),
    ]
    return Section("The probe", [page.paragraph(text), page.grid(drawings), probe_table(metrics, story)])


def uncertainty(story: Inside, metrics: Metrics) -> Iterator[tuple[Colours, str, str, Scale, str]]:
    """Predicted standard deviation and true error of where the calibration puts each pixel, on one scale."""
    width, height = story.sweep.size
    u, v = np.meshgrid(np.linspace(0, width - 1, CELLS[0]), np.linspace(0, height - 1, CELLS[1]))
    error, sigma = sweep_errors.probe_errors(story.probe, story.truth, np.column_stack([u.ravel(), v.ravel()]))
    both = np.array([error, sigma])
    scale = Scale(SEQUENTIAL, 0.0, float(np.ceil(20 * np.nanmax(both)) / 20))
    maps = [scale(cv2.resize(np.float32(part.reshape(u.shape)), (width, height))) for part in (sigma, error)]
    used, rejected = metrics["probe_frames_used"], metrics["probe_frames_rejected"]
    yield (
        maps[0],
        "Predicted",
        f"Standard deviation of where the calibration puts a pixel, over the B-scan; from {used} B-scans with a clear crossing "
        f"({rejected} had none).",
        scale,
        "mm",
    )
    yield maps[1], "True error", "How far it puts the pixel from where it is.", scale, "mm"


def against_speed(story: Inside, sy: float) -> tuple[Array, Array]:
    """Speed : (k,) mm/s of the probe in its main direction; lag of the bottom's depth behind its pose : (k,) mm."""
    times, track = story.bob.times, story.bob.track
    depth, residual = story.depth_residuals.T * sy
    late, now = (tracks.poses_at(track, times, lag_s)[:, :3, 3] for lag_s in (story.lag_s, 0.0))
    known = np.isfinite(depth) & np.isfinite(residual) & np.isfinite(late).all(axis=1) & np.isfinite(now).all(axis=1)
    places = late[known] - late[known].mean(axis=0)
    direction = np.linalg.svd(places, full_matrices=False)[2][0]
    direction *= -np.sign((places @ direction) @ (depth[known] - depth[known].mean()))  # towards the bottom
    moved = (now - late)[known] @ direction
    return moved / story.lag_s, moved + residual[known]


def probe_table(metrics: Metrics, story: Inside) -> str:
    """The paper's figures, the calibration's own predictions, and its true errors."""
    error, sigma = sweep_errors.probe_errors(story.probe, story.truth, five_points(story.sweep.size))
    rows = [("Equations of the crossings, RMS", PAPER["equations"], "", f"{metrics['probe_rms_mm']:.3f} mm")]
    places = (
        ("centre", "Image centre, off by", slice(0, 1)),
        ("corner", "Corners, off by, mean", slice(1, 5)),
        ("mean", "Mean of these five", slice(0, 5)),
    )
    for name, what, which in places:
        rows.append((what, PAPER[name], shown(float(np.mean(sigma[which])), ".3f", " mm"), f"{np.mean(error[which]):.3f} mm"))
    speed, known = metrics["probe_implied_speed_m_per_s"], metrics["probe_water_speed_m_per_s"]
    interval = f"{metrics['lag_low_ms']:.1f} to {metrics['lag_high_ms']:.1f} ms (95 %)"
    rows += [
        (
            "Speed of sound that the scale in depth implies",
            "not measured",
            f"± {metrics['probe_implied_speed_sigma_m_per_s']:.1f} m/s",
            f"{speed:.1f} m/s; of water as warm as given {known:.1f}",
        ),
        (
            "Lag of the scanner’s images",
            "not measured",
            interval,
            f"{metrics['lag_ms']:.1f} ms; true {1e3 * story.truth.lag_s:.1f}",
        ),
        ("A pixel of the sweep in space, RMS", "not measured", "", f"{metrics['placement_rms_mm']:.3f} mm"),
    ]
    caption = (
        "Paper: Meza et al. 2021; its CR2, the mean distance of five calibrations from their mean, stands beside the error "
        "against the truth here, which holds what calibrations have in common too. Predicted: one standard deviation of the "
        "place in space. The last row has all errors: of the tracked poses, the lag and the calibration, over centre and corners "
        "of all B-scans, at the speed of sound that the scanner assumes."
    )
    return page.table(("", "paper", "predicted", "here"), rows, caption)


def _rows(path: Path) -> list[dict[str, str]]:
    return list(csv.DictReader(read_text(path).splitlines()))


def _beside(found: float, true: float, form: str) -> str:
    return f"{shown(found, form)} / {shown(true, form)}"


def _titled(name: str) -> str:
    """A thing's name for people: `tumour0` is `Tumour 1`."""
    word = name.rstrip("0123456789")
    return f"{word.capitalize()} {int(name[len(word) :]) + 1}" if word != name else word.capitalize()
