"""`calibration.html`: the report of a calibration, for the decision whether to measure with it."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial import ConvexHull

from recon.files import atomic
from recon.files.metrics import Metrics, shown
from recon.geometry.camera import Array
from recon.geometry.camera_jacobian import DISTORTION, MATRIX, MOTION
from recon.model.calibration import Calibration
from recon.optical_calibration import figures_of_merit, uncertainty
from recon.optical_calibration.figures_of_merit import CELLS, Parameter
from recon.optical_calibration.joint_calibration import Result
from recon.reports import figures, page
from recon.reports.figures import SEQUENTIAL, Scale
from recon.reports.page import Opening, Section

FEWEST = 10  # points in a cell whose mean residual is shown
MAP_ZOOM = 6  # px of the picture for one of an uncertainty map
NAMES = {"cam1": "camera 1", "cam2": "camera 2", "projector": "projector"}
BEHIND_MM = 30.0  # distance of two devices in a side view that lets their names collide
LABELS = {
    "rx": "turn about x",
    "ry": "turn about y",
    "rz": "turn about z",
    "tx": "shift along x",
    "ty": "shift along y",
    "tz": "shift along z",
    "distance": "distance of the pinholes",
}
MEASURED = (("point_sigma_mm", ".3f", "mm"), ("shape_sigma_mm", ".4f", "mm"), ("scale_sigma_ppm", ".0f", "ppm"))
SUSPICIOUS = 3.0  # standard deviations
FOOTER = (
    "World is the frame of camera 1: x right, y down, z away from it. The projector is a camera run backwards. This file is "
    "complete: it fetches nothing."
)


def write(
    path: Path,
    result: Result,
    metrics: Metrics,
    outputs: Sequence[tuple[str, str]],
    commands: Sequence[str],
    truth: Calibration | None = None,
) -> None:
    """Write the page, one HTML file that needs no other.

    Parameters
    ----------
    metrics : dict
        Those of `figures_of_merit.measure`.
    outputs : (file, what is in it)
        For the list at the end.
    commands : sequence of str
        That make the same again.
    truth : Calibration, optional
        The true one, of a render.
    """
    depths, volume = figures_of_merit.working_depths(result), figures_of_merit.working_volume(result)
    sections = [
        *warnings(result),
        residuals(result, metrics),
        coverage(result, metrics),
        poses(result),
        uncertainty_maps(result, metrics, depths, volume),
        parameters(result, metrics, truth),
        consistency(result),
        models(result),
        reading(),
        Section("Files, and how to make them again", [page.table(("file", "what is in it"), outputs), page.commands(commands)]),
    ]
    text = page.render(opening(result, metrics), sections, FOOTER)
    with atomic.new_file(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def opening(result: Result, metrics: Metrics) -> Opening:
    """The title, the result in one sentence, and the figures that matter."""
    devices = [NAMES[device] for device in result.observations.devices]
    together = f"{', '.join(devices[:-1])} and {devices[-1]}" if len(devices) > 1 else devices[0]
    text = (
        f"{together[0].upper()}{together[1:]}, calibrated in one adjustment from {metrics['poses']:g} poses of "
        f"{len(result.observations.points)} points"
    )
    measured = [row for row in MEASURED if row[0] in metrics]  # by two devices or more
    if measured:
        point, shape = shown(metrics["point_sigma_mm"], ".3f", " mm"), shown(metrics["shape_sigma_mm"], ".4f", " mm")
        text += f". By the calibration alone, a point in the working volume is uncertain by {point}, within a shape by {shape}"
    if "shape_error_rms_mm" in metrics:
        here = shown(metrics["point_error_rms_mm"], ".3f", " mm")
        shape = shown(metrics["shape_error_rms_mm"], ".4f", " mm")
        text += f"; against the true rig it is off by {here} and {shape}"
    text += f". The board {figures_of_merit.describe_board(result, metrics)}"
    if result.warnings:
        text += ". Mind the warnings below"
    numbers = [
        (f"{NAMES[device]}, RMS", shown(metrics[f"reprojection_rms_{device}_px"], ".4f"), "px")
        for device in result.observations.devices
    ]
    numbers += [(f"{name.split('_')[0]}, 1 σ", shown(metrics[name], form), unit) for name, form, unit in measured]
    return Opening("optics calibration", "The calibrated cameras and projector", text + ".", numbers)


def warnings(result: Result) -> list[Section]:
    """Warnings before the calibration is used; none if there are none."""
    return [Section("Warnings", [page.notices(result.warnings)])] if result.warnings else []


def residuals(result: Result, metrics: Metrics) -> Section:
    """Residuals of the observations over each image."""
    blocks = [
        page.paragraph(
            "An arrow is where a point was seen less where the calibration predicts it, magnified, from all poses together. "
            "Arrows in random directions are noise; neighbouring arrows in one direction are an error of the model. Noise "
            "cancels in the means of the image’s cells, so that a pattern stands out there."
        )
    ]
    histograms, published = [], figures_of_merit.published_rms(result.adjustment.calibration)
    for device in result.observations.devices:
        pixels, left, _ = figures_of_merit.sightings(result, device)
        middles, means, number = figures_of_merit.cell_means(result, device)
        enough = number >= min(FEWEST, number.max())
        size = result.adjustment.calibration.cameras[device].size
        rms = metrics[f"reprojection_rms_{device}_px"]
        compared = f"; the paper’s rig {published[device]:.3f} px" if device in published else ""
        sigma = rms / np.sqrt(2)
        magnified = figures.magnification(size, 2.5 * sigma)
        magnified_means = figures.magnification(size, 2 * float(np.sqrt(np.mean(means[enough] ** 2))))
        drawings = [
            page.drawing(
                figures.arrows(pixels, left, size, magnified),
                f"Residuals, {NAMES[device]}",
                f"{page.count(len(left))} points, magnified {magnified:g} times. RMS {rms:.4f} px{compared}.",
            ),
            page.drawing(
                figures.arrows(middles[enough], means[enough], size, magnified_means),
                "Means over cells",
                f"{CELLS[0]} × {CELLS[1]} cells, magnified {magnified_means:g} times; none for less than {FEWEST} points. They "
                f"are {metrics[f'pattern_ratio_{device}']:.2f} times what random residuals leave; 1 means no pattern.",
            ),
        ]
        blocks.append(page.grid(drawings, "two"))
        histograms.append(
            page.drawing(
                figures.histogram(left.ravel(), figures.normal(sigma, 4 * sigma), "residual in u and v, px", 4 * sigma),
                f"Distribution, {NAMES[device]}",
                f"The noise is {metrics[f'noise_ratio_{device}']:.2f} times what the detection predicted for its points.",
            )
        )
    blocks.append(page.grid(histograms))
    return Section("Residuals", blocks)


def coverage(result: Result, metrics: Metrics) -> Section:
    """Where in the images and in depth the board was."""
    depth = figures_of_merit.board_points(result)[..., 2]
    low, high = np.floor(depth.min()), np.ceil(depth.max())
    scale = Scale(SEQUENTIAL, float(low), float(high))
    drawings = []
    for number, device in enumerate(result.observations.devices):
        used = result.observations.seen[:, :, number] & ~result.adjustment.outliers[:, :, number]
        camera = result.adjustment.calibration.cameras[device]
        svg = figures.dots(result.observations.pixels[:, :, number][used], depth[used], scale, camera.size)
        detail = f"Coloured by depth. Points surround {100 * metrics[f'coverage_{device}']:.0f} % of the image."
        drawings.append(page.drawing(svg + page.colour_bar(scale, "mm depth"), f"Points, {NAMES[device]}", detail))
    board = result.adjustment.points
    corners = board[ConvexHull(board[:, :2]).vertices]
    placed = np.einsum("pij,cj->pci", result.adjustment.poses[:, :3, :3], corners) + result.adjustment.poses[:, None, :3, 3]
    centres = {NAMES[name]: camera.centre for name, camera in result.adjustment.calibration.cameras.items()}
    views = (
        ([2, 0], ("z, mm", "x, mm"), "The board’s poses from above"),
        ([2, 1], ("z, mm", "y, mm"), "The same from the side"),
    )
    sides = [
        page.drawing(figures.outlines(placed[..., axes], _marks(centres, axes), labels), caption, "Equal scales.")
        for axes, labels, caption in views
    ]
    text = (
        "A calibration holds where the board was: distortion is not known beyond the outermost points, and focal lengths come "
        "from depth and tilt."
    )
    return Section("Coverage", [page.paragraph(text), page.grid(drawings), page.grid(sides, "two")])


def poses(result: Result) -> Section:
    """One row a pose."""
    devices = result.observations.devices
    head = ("pose", "points", "tilt, deg", "depth, mm", *(f"{NAMES[device]}, px" for device in devices), "outliers")
    tilt, depth = np.rad2deg(figures_of_merit.tilts(result)), figures_of_merit.board_centres(result)[:, 2]
    remaining = figures_of_merit.pose_rms(result)
    rows = []
    for k, name in enumerate(result.observations.poses):
        points = "\u202f/\u202f".join(str(number) for number in result.observations.seen[k].sum(axis=0))
        rms = [shown(value, ".4f") if np.isfinite(value) else "" for value in remaining[k]]
        outliers = int(result.adjustment.outliers[k].sum())
        rows.append((name, points, f"{tilt[k]:.1f}", f"{depth[k]:.0f}", *rms, str(outliers) if outliers else ""))
    seen_by = " / ".join(NAMES[device] for device in devices)
    caption = f"Points seen by {seen_by}. Tilt is between the board’s normal and camera 1’s axis. RMS of what are no outliers."
    blocks = [page.table(head, rows, caption)]
    if result.dropped:
        blocks.insert(0, page.table(("left out", "reason"), result.dropped.items()))
    return Section("Poses", blocks)


def uncertainty_maps(result: Result, metrics: Metrics, depths: Sequence[float], volume: Array) -> Section:
    """Maps of the parameters' covariance, carried to px and mm."""
    found = result.adjustment.calibration
    middle = depths[len(depths) // 2]
    pixels = {device: uncertainty.projection_map(found, device, middle, volume) for device in result.observations.devices}
    scale = _shared_scale(pixels.values())
    maps = [
        page.picture(
            _enlarged(scale(values)),
            f"Projection, {NAMES[device]}",
            f"Where a point at {middle:g} mm falls; RMS {metrics[f'projection_sigma_{device}_px']:.4f} px in the working volume.",
            scale,
            "px",
        )
        for device, values in pixels.items()
    ]
    blocks = [
        page.paragraph(
            "One standard deviation, as it follows from the noise of the observations through the adjustment. Residuals say how "
            "well the calibration explains what it has seen; these say how well it is determined, and grow where the board was "
            "not. In the projections a common motion of all devices is taken out: it changes no measurement."
        ),
        page.grid(maps),
    ]
    if len(found.cameras) > 1:
        blocks += _millimetre_maps(found, metrics, depths, volume)
    return Section("Uncertainty", blocks)


def _millimetre_maps(found: Calibration, metrics: Metrics, depths: Sequence[float], volume: Array) -> list[str]:
    """Maps of the uncertainty of points, which two devices measure."""
    blocks, pair = [], figures_of_merit.devices_that_measure(found)
    millimetres = {depth: uncertainty.point_maps(found, *pair, depth, volume) for depth in depths}
    for k, caption, detail in (
        (0, "Position", "Of a point in the frame of camera 1, the motion of that frame included."),
        (1, "Within a shape", "The same, less what a rigid motion of the working volume explains: what distances suffer from."),
    ):
        shared = _shared_scale(values[k] for values in millimetres.values())
        blocks.append(
            page.grid(
                page.picture(_enlarged(shared(values[k])), f"{caption}, {depth:g} mm deep", detail, shared, "mm")
                for depth, values in millimetres.items()
            )
        )
    first, second = (NAMES[device] for device in pair)
    blocks.append(
        page.paragraph(
            f"Over the image of {first}, for points measured with {first} and {second}, without the noise of that measurement. "
            f"Lengths share an uncertainty of scale of {shown(metrics['scale_sigma_ppm'], '.0f')} ppm, that of the board’s print "
            "(board_scale) included: a board printed 0.1 % too large makes everything 0.1 % too small. Known lengths make it "
            "less: a caliper over the board (board_length_mm), a ball bar, a target under a microscope, a board on glass."
        )
    )
    return blocks


def parameters(result: Result, metrics: Metrics, truth: Calibration | None) -> Section:
    """The values with their standard deviations and, if known, the true ones."""
    rows = figures_of_merit.parameters(result.adjustment.calibration, truth)
    if truth is None:
        table = page.table(("parameter", "unit", "value", "±"), [(*_named(row), *_value(row)) for row in rows])
        return Section("Parameters", [table])
    head = ("parameter", "unit", "value", "±", "true", "error", "error / σ")
    normalised = metrics["parameters_error_sigma"]
    text = (
        f"Beside the true values of the render. All errors together, correlations taken into account, are {normalised:.2f} times "
        "what their covariance lets expect; 1 if it is right."
    )
    return Section(
        "Parameters", [page.paragraph(text), page.table(head, [(*_named(row), *_value(row), *_error(row)) for row in rows])]
    )


def consistency(result: Result) -> Section:
    """Differences of two calibrations from half of the poses each."""
    if not np.isfinite(result.halves).all():
        return Section("Two halves", [page.paragraph("Too few poses to calibrate from two halves and compare.")])
    known = result.adjustment.calibration.uncertainty
    assert known is not None
    differences = dict(zip(known.names, result.halves, strict=True))
    devices = result.observations.devices
    rows = []
    for name in MATRIX + DISTORTION + MOTION:
        cells = [differences.get(f"{device}.{name}") for device in devices]
        if any(cell is not None for cell in cells):
            rows.append(
                (
                    LABELS.get(name, name),
                    *("" if cell is None else f"{_signed(np.round(cell, 1) + 0.0, '+.1f')} σ" for cell in cells),
                )
            )
    rms, worst = np.sqrt(np.mean(result.halves**2)), np.abs(result.halves).max()
    text = (
        "Calibrated twice, from one half of the poses and from the other: the difference in units of its predicted standard "
        f"deviation. RMS {rms:.2f}, largest {worst:.1f}. They should scatter about zero by 1, and exceed {SUSPICIOUS:g} next to "
        "never; where they do, something that the prediction leaves out moves the result: a board that bends, a lens that the "
        "model doesn’t describe. What both halves share, such as an error of the board’s scale, doesn’t show."
    )
    return Section("Two halves", [page.paragraph(text), page.table(("", *(NAMES[device] for device in devices)), rows)])


def models(result: Result) -> Section:
    """Which distortion model each device got, and why."""
    names = list(dict.fromkeys(name for scores in result.scores.values() for name in scores))
    if not names:
        given = ", ".join(f"{NAMES[device]}: {model}" for device, model in result.model.items())
        why = "Given, or too few poses to choose by the data"
        return Section("Distortion models", [page.paragraph(f"{why}. {given}.")])
    rows = []
    for device in result.observations.devices:
        scores = result.scores.get(device, {})
        cells = [shown(scores[name], ".4f", " px") if name in scores else "" for name in names]
        rows.append((NAMES[device], *cells, result.model[device]))
    text = (
        "RMS of points of poses that were left out of the calibration, for each distortion model. More coefficients always fit "
        "better what they were fitted to; here they must fit what they have not seen. Where models differ by less than chance, "
        "the one with fewer coefficients is taken."
    )
    return Section("Distortion models", [page.paragraph(text), page.table(("device", *names, "taken"), rows)])


def reading() -> Section:
    """Guide to judging a calibration by this page."""
    rows = [
        (
            "A pattern in the residuals",
            "The lens model is too simple, the board isn’t as designed, or the fringes are disturbed.",
        ),
        (
            "One pose far above the others",
            "It moved between the images, or was blurred or half hidden: leave it out or repeat it.",
        ),
        ("Noise far above 1 times the predicted", "Something besides noise is in the residuals: see their pattern."),
        ("Uncertainty grows towards a corner", "Take poses there."),
        ("Shape uncertain, residuals small", "Poses are too alike: tilt the board by 20° to 40° and move it through the depth."),
        ("Halves differ by many σ", "Don’t trust the ± of the parameters: an error is there that is no noise."),
    ]
    return Section("How to read it", [page.table(("what you see", "what it means"), rows)])


def _marks(centres: Mapping[str, Array], axes: Sequence[int]) -> dict[str, Array]:
    """Where devices stand in a plane of two of the world's axes; those that stand behind each other share a name."""
    marks: dict[str, Array] = {}
    for name, centre in centres.items():
        place = centre[list(axes)]
        near = next((other for other, at in marks.items() if np.linalg.norm(at - place) < BEHIND_MM), None)
        marks[name if near is None else f"{near}, {name}"] = place if near is None else marks.pop(near)
    return marks


def _shared_scale(maps: Iterable[Array]) -> Scale:
    """One scale from zero for several maps, to be compared; their most uncertain twentieth may be beyond it."""
    values = np.concatenate([values[np.isfinite(values)] for values in maps])
    highest = float(np.quantile(values, 0.95)) if values.size else 1.0
    step = 10 ** np.floor(np.log10(highest)) / 5 if highest > 0 else 1.0
    return Scale(SEQUENTIAL, 0.0, float(np.ceil(highest / step) * step))


def _enlarged(colours: figures.Colours) -> figures.Colours:
    height, width = colours.shape[:2]
    return cv2.resize(colours, (width * MAP_ZOOM, height * MAP_ZOOM), interpolation=cv2.INTER_NEAREST)


def _named(row: Parameter) -> tuple[str, str]:
    return f"{NAMES[row.device]}, {LABELS.get(row.label, row.label)}", row.unit


def _value(row: Parameter) -> tuple[str, str]:
    form = _form(row)
    return _signed(row.value, form), f"{row.sigma:{form}}" if row.sigma else "fixed"


def _error(row: Parameter) -> tuple[str, str, str]:
    form = _form(row)
    ratio = _signed(row.error / row.sigma, "+.1f") if row.sigma else ""
    return _signed(row.true, form), _signed(row.error, f"+{form}"), ratio


def _form(row: Parameter) -> str:
    """As many decimals as leave two digits of the standard deviation."""
    if row.sigma <= 0:
        return ".4f"
    return f".{int(np.clip(1 - np.floor(np.log10(row.sigma)), 0, 7))}f"


def _signed(value: float, form: str) -> str:
    """A number with the typographer's minus."""
    return f"{value:{form}}".replace("-", "−") if np.isfinite(value) else "unknown"
