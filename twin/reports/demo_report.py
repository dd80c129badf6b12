"""The report of a measured surface: images, phase, points, and their errors."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from recon.capture import surface_part
from recon.capture.manifest import Manifest, read_manifest
from recon.capture.surface_part import SurfaceCapture
from recon.files import atomic
from recon.files.metrics import Metrics, shown
from recon.fusion import scene_page
from recon.fusion.fused_scene import FusedScene
from recon.model.calibration import Calibration
from recon.model.patterns import CentreLine, Fringes, GrayCode, Uniform
from recon.reports import figures, page, space_views
from recon.reports.figures import CYCLIC, SEQUENTIAL, Scale
from recon.reports.page import Opening, Section
from recon.structured_light import decode
from recon.structured_light.decode import ProjectorMap, Status
from twin.evaluation import error_parts, surface_errors
from twin.evaluation.error_parts import ErrorParts
from twin.evaluation.surface_errors import GROSS_MM, Comparison, Truth
from twin.reports import chain_report, error_report, sweep_report, track_report
from twin.reports.sweep_report import Inside
from twin.reports.track_report import Tracked
from twin.ultrasound.sweep_session import SUPPORTS

FRINGES_SHOWN = 4
TITLES = {"breast": "breast phantom"}  # where a scene's name alone is too short
PAPER = {  # Meza et al. 2021, Optical Engineering 60(5) 054106, section 3
    "plane_rms": "0.101 to 0.131 mm",
    "sphere_radius_error": "0.045 mm",
    "sphere_rms": "0.040 mm",
    "cylinder_radius_error": "0.10 mm",
}


@dataclass(frozen=True, eq=False)
class Measurement:
    """A capture, its results, and the truth."""

    manifest: Manifest
    shots: SurfaceCapture
    camera: str
    found: ProjectorMap
    points: NDArray[np.float32]  # (h, w, 3), mm
    truth: Truth
    comparison: Comparison
    parts: ErrorParts


def read(captured: Path, truth: Path, points: Path, camera: str = "cam1", calibration: Calibration | None = None) -> Measurement:
    """Read a capture folder, the truth folder beside it and the `points.npz` reconstructed from the capture.

    calibration : Calibration, optional
        By which the points were reconstructed; the true one if it isn't given.

    Raises
    ------
    InputError
        If one of them is missing or damaged, or they don't fit together.
    """
    shots = surface_part.read_surface(captured, camera)
    expected = surface_errors.read_truth(truth, camera)
    measured, sigma = surface_errors.read_points(points)
    comparison = surface_errors.compare(measured, sigma, expected)
    found = decode.decode(shots.images, shots.patterns, bits=shots.bits, name=shots.name)
    by_calibration = None
    if calibration is not None:
        known = surface_errors.points_with_prediction(comparison)
        by_calibration = error_parts.of_calibration(found, expected, calibration, camera, known)
    parts = error_parts.split(comparison, by_calibration)
    return Measurement(read_manifest(captured), shots, camera, found, measured, expected, comparison, parts)


def write(
    path: Path,
    measurement: Measurement,
    metrics: Metrics,
    outputs: Sequence[tuple[str, str]],
    commands: Sequence[str],
    inside: Inside | None = None,
    tracked: Tracked | None = None,
    fused: FusedScene | None = None,
) -> None:
    """Write the report, one HTML file of about 8 MB that needs no other.

    Parameters
    ----------
    metrics : dict
        Those of `evaluate.measure`; more are welcome.
    outputs : (file, what is in it)
        For the list at the end.
    commands : sequence of str
        That make the same again.
    inside : Inside, optional
        What ultrasound adds.
    tracked : Tracked, optional
        What tracking adds.
    fused : FusedScene, optional
        All of it in one frame.
    """
    scanned, probe = [], []
    if inside is not None:
        scanned = [sweep_report.inside(inside, measurement.points, without_supports(measurement), metrics)]
        probe = [sweep_report.probe_and_clock(inside, metrics)]
    whole = [] if fused is None else [scene_page.in_space(fused), *chain_report.sections(metrics)]
    sections = [
        *whole,
        surface(measurement),
        *scanned,
        error_report.errors(measurement.comparison, measurement.parts),
        images(measurement),
        decoding(measurement),
        *probe,
        *([track_report.section(tracked, metrics, inside is not None)] if tracked is not None else []),
        beside_the_paper(metrics),
        settings(measurement, metrics),
        Section("Files, and how to make them again", [page.table(("file", "what is in it"), outputs), page.commands(commands)]),
    ]
    text = page.render(opening(measurement, metrics), sections, FOOTER)
    with atomic.new_file(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


FOOTER = (
    "Made by sonotwin, a rendered twin of the rig of Meza et al. 2021. World is the frame of camera 1: x right, y down, z away "
    "from it. The 3-D view needs WebGL; everything else is plain HTML. This file is complete: it fetches nothing."
)


def opening(measurement: Measurement, metrics: Metrics) -> Opening:
    """The title, the result in one sentence, and the figures that matter."""
    scene = TITLES.get(measurement.truth.scene, measurement.truth.scene).replace("_", " ")
    here, limit = metrics["surface_rms_mm"], metrics["limit_rms_mm"]
    things = ", ".join(f"{name} {shown(value, '.3f')}" for name, value in surface_errors.things(metrics).items())
    result = (
        f"From {measurement.shots.patterns.count} images, {page.count(metrics['points'])} points of the surface were measured to "
        f"{here:.3f} mm RMS of the true one ({things}){_mostly(measurement.parts, limit)}.{sweep_report.result(metrics)}"
        f"{track_report.result(metrics)}"
    )
    both = "tumours_true" in metrics
    by_part = [
        (f"by {name}, RMS", shown(part.rms_mm, ".3f"), "mm") for name, part in measurement.parts.parts.items() if name != "rest"
    ]
    return Opening(
        f"fringe projection{' and freehand ultrasound' if both else ''}, digital twin",
        f"The {scene}, {'outside and inside' if both else 'measured by fringe projection'}",
        result,
        (
            ("error, RMS", f"{here:.3f}", "mm"),
            *by_part,
            ("limit by noise, RMS", shown(limit, ".3f"), "mm"),
            ("coverage", f"{100 * metrics['coverage']:.1f}", "%"),
            (f"errors above {GROSS_MM:g} mm", f"{100 * metrics['gross_error_fraction']:.3f}", "%"),
        ),
    )


def _mostly(parts: ErrorParts, limit: float) -> str:
    """The errors' two main parts in words, beside the limit of noise."""
    noise, alone = parts.parts["noise"].rms_mm, shown(limit, ".3f")
    if not (np.isfinite(noise) and np.isfinite(limit)):
        return ""
    if "calibration" not in parts.parts:
        return f"; their noise is {noise:.3f} mm, where the camera’s alone would leave {alone}"
    moved = parts.parts["calibration"]
    by = f"; the calibration alone moves it by {moved.rms_mm:.3f} mm, {moved.mean_mm:+.3f} mm in the mean".replace("-", "−")
    return f"{by}, noise by {noise:.3f} mm, where the camera’s alone would leave {alone}"


def surface(measurement: Measurement) -> Section:
    """The surface in 3-D."""
    drawn = space_views.surface_view(
        measurement.points,
        measurement.comparison.error,
        error_report.half_range(measurement.comparison.error, error_report.ERROR_MM),
    )
    caption = "Drag to turn, scroll to come nearer. Red lies outside the true surface, blue inside; equal scales on all axes."
    return Section("The surface", [page.switch("surface"), page.view("surface", drawn, caption)])


def without_supports(measurement: Measurement) -> NDArray[np.bool_]:
    """Pixels : (h, w) of things other than their support."""
    supports = [number for number, name in enumerate(measurement.truth.things) if name in SUPPORTS]
    return ~np.isin(measurement.truth.objects, supports)


def images(measurement: Measurement) -> Section:
    """The camera's images: the scene, and some of each part of the sequence."""
    stack, full = measurement.shots.images, 2.0**measurement.shots.bits - 1
    parts = measurement.shots.patterns.slices()
    fringes = next(place for part, place in parts if isinstance(part, Fringes))
    mean = stack[fringes].mean(axis=0)
    scene = figures.grey(mean, float(np.quantile(mean, 0.999)), gamma=2.2)
    pictures = [page.picture(scene, "The scene", f"Mean of {fringes.stop - fringes.start} fringe images; shadows lifted.")]
    for part, place in parts:
        match part:
            case Fringes():
                for k in np.linspace(0, part.steps, FRINGES_SHOWN, endpoint=False).astype(int):
                    shift = np.rad2deg(part.shifts[k])
                    detail = f"Shift {shift:.0f}°, {part.pitch:g} projector px a period."
                    picture = figures.grey(stack[place.start + k], full)
                    pictures.append(page.picture(picture, f"Fringes {k + 1} of {part.steps}", detail))
            case CentreLine():
                detail = f"{part.width:g} px wide; numbers the fringes."
                pictures.append(page.picture(figures.grey(stack[place.start], full), "Centre line", detail))
            case GrayCode():
                detail = f"Coarsest of {part.bits} bits; numbers the fringes."
                pictures.append(page.picture(figures.grey(stack[place.start], full), "Gray code", detail))
            case Uniform():
                detail = f"Level {part.level:g}."
                pictures.append(page.picture(figures.grey(stack[place.start], full), "Uniform light", detail))
    return Section("What the camera saw", [page.grid(pictures)])


def decoding(measurement: Measurement) -> Section:
    """From the images to projector coordinates."""
    found, patterns = measurement.found, measurement.shots.patterns
    axis = patterns.axes[0]
    fringes = min(
        (part for part in patterns.parts if isinstance(part, Fringes) and part.axis == axis), key=lambda part: part.pitch
    )
    coordinate = found.columns if axis == "columns" else found.rows
    assert coordinate is not None
    usable = np.isfinite(coordinate)
    cycle = Scale(CYCLIC, -np.pi, np.pi)
    order = np.rint((coordinate - fringes.zero(patterns.length(axis))) / fringes.pitch - found.phase / (2 * np.pi))
    orders, columns = _span(order, usable), _span(coordinate, usable)
    strength = Scale("gray", 0, error_report.round_up(float(np.quantile(found.modulation, 0.995))))
    seen = found.status != Status.DARK
    stages = [
        page.picture(
            cycle(np.where(seen, found.phase, np.float32(np.nan))), "Wrapped phase", "Least squares over the steps.", cycle, "rad"
        ),
        page.picture(orders(order), "Fringe order", "Which period a pixel sees.", orders, ""),
        page.picture(columns(coordinate), f"Projector {axis.removesuffix('s')}", "Phase and order together.", columns, "px"),
        page.picture(
            strength(found.modulation), "Modulation", "Amplitude of the fringes: the signal against the noise.", strength, "DN"
        ),
    ]
    return Section("From fringes to coordinates", [page.grid(stages, "two")])


def beside_the_paper(metrics: Metrics) -> Section:
    """The paper's figures, the limit and ours: of the shapes that the scene has."""
    limit, interior = (shown(metrics[name], ".4f", " mm") for name in ("limit_rms_mm", "surface_interior_rms_mm"))
    rows = [
        ("Surface against its true shape, RMS", "not measured: shown only", limit, f"{metrics['surface_rms_mm']:.4f} mm"),
        ("the same, away from edges", "not measured", limit, interior),
        *_fitted(metrics, "Plane, RMS of the fit", "plane", "rms"),
        *_fitted(metrics, "Sphere, error of the radius", "sphere", "radius_error"),
        *_fitted(metrics, "Sphere, RMS of the fit", "sphere", "rms"),
        *_fitted(metrics, "Cylinder, error of the radius", "cylinder", "radius_error"),
    ]
    caption = (
        "Paper: J. Meza et al., Three-dimensional multimodal medical imaging system based on free-hand ultrasound and structured "
        "light, Optical Engineering 60(5) 054106, 2021, which measured a plane, a sphere and a cylinder: scenes of these have "
        "their figures here. Limit: the noise of photons, sensor and digits alone, through the rig’s "
        "true geometry. The paper’s rig was calibrated with its own images; here "
        + ("so was the rig, with a rendered board." if "poses" in metrics else "the capture came with the true calibration.")
    )
    return Section("Paper, limit, here", [page.table(("", "paper", "limit", "here"), rows, caption)])


def settings(measurement: Measurement, metrics: Metrics) -> Section:
    """Exposure of the images and their noise."""
    shots, found = measurement.shots, measurement.found
    device = measurement.manifest.devices_of("surface")[measurement.camera]
    parts = ", ".join(f"{part.count} × {part.kind.replace('_', ' ')} ({part.axis})" for part in shots.patterns.parts)
    seen = measurement.comparison.compared
    rows = [
        ("camera", f"{measurement.camera}, {device.size[0]} × {device.size[1]} px, {device.bits} bits"),
        ("exposure", "unknown" if device.exposure_s is None else f"{1e3 * device.exposure_s:.2f} ms"),
        ("gain", "unknown" if device.gain is None else f"{device.gain:g}"),
        ("patterns", f"{parts}; unwrapped by {shots.patterns.unwrap.replace('_', ' ')}"),
        (
            "modulation",
            f"median {np.median(found.modulation[seen]):.1f} DN, weakest 1 % {np.quantile(found.modulation[seen], 0.01):.1f} DN",
        ),
        ("saturated", f"{100 * np.mean(found.status == Status.SATURATED):.2f} % of the image"),
        ("noise, measured", f"variance {found.noise.read_variance:.3f} DN² + {found.noise.gain:.4f} DN × intensity"),
        (
            "points",
            f"{page.count(metrics['points'])}, of them {page.count(metrics['false_points'])} where the projector doesn’t shine",
        ),
    ]
    spent = [f"{key.removeprefix('seconds_')} {value:.2f}" for key, value in metrics.items() if key.startswith("seconds_")]
    if spent:
        rows.append(("seconds", ", ".join(spent)))
    return Section("The capture", [page.table(("", "value"), rows)])


def _fitted(metrics: Metrics, what: str, kind: str, figure: str) -> list[tuple[str, str, str, str]]:
    """A row of the table: the paper's figure, and limit and ours for all shapes of the kind; none if the scene has none."""
    names = [
        key.removeprefix(f"{kind}_").removesuffix("_limit_rms_mm")
        for key in metrics
        if re.fullmatch(f"{kind}_.*_limit_rms_mm", key)
    ]
    here = ", ".join(shown(abs(metrics[f"{kind}_{name}_{figure}_mm"]), ".4f", " mm") for name in names)
    limit = ", ".join(shown(metrics[f"{kind}_{name}_limit_rms_mm"], ".4f", " mm") for name in names) if figure == "rms" else ""
    return [(what, PAPER[f"{kind}_{figure}"], limit, here)] if names else []


def _span(values: NDArray, usable: NDArray[np.bool_]) -> Scale:
    low, high = np.quantile(values[usable], (0.001, 0.999)) if usable.any() else (0, 1)
    return Scale(SEQUENTIAL, float(np.floor(low)), float(np.ceil(high)))
