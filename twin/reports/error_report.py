"""The report's section on the surface's errors: their parts by calibration, noise and the rest, in numbers and maps."""

import numpy as np
from numpy.typing import NDArray

from recon.files.metrics import shown
from recon.reports import figures, page
from recon.reports.figures import DIVERGING, SEQUENTIAL, Scale
from recon.reports.page import Section
from twin.evaluation import surface_errors
from twin.evaluation.error_parts import AVERAGED_PX, ErrorParts, Part, local_mean
from twin.evaluation.surface_errors import GROSS_MM, Comparison

ERROR_MM = 0.1  # colours of errors span plus and minus this, or twice their RMS if that is more
SYSTEMATIC_MM = 0.02  # colours of averaged errors span plus and minus this
PARTS = {"calibration": "calibration of cameras and projector", "rest": "rest, the same in neighbouring points", "noise": "noise"}


def errors(comparison: Comparison, parts: ErrorParts) -> Section:
    """Error map, the parts of the errors, and what the calibration leaves of them over the points' own sigma."""
    compared = page.paragraph(f"No point is both within {GROSS_MM:g} mm of the truth and has a prediction to compare with.")
    if parts.known.any():
        compared = page.grid(histograms(comparison, parts), "two")
    text = (
        "The error of a point is its distance from the plane that touches the true surface where the pixel’s ray meets it. "
        f"{by_calibration(parts)}Noise differs from point to point, and is predicted for each; the rest is alike in neighbouring "
        "points and no part of the calibration’s: light from one surface to another, blur at edges, lenses that the model "
        "doesn’t describe."
    )
    return Section(
        "Errors", [page.paragraph(text), parts_table(parts), page.grid(error_maps(comparison, parts), "two"), compared]
    )


def by_calibration(parts: ErrorParts) -> str:
    """A sentence on the calibration's part; nothing where the capture came with the true calibration."""
    if "calibration" not in parts.parts:
        return "The capture came with the true calibration, so that none of it is the calibration’s. "
    mean = _signed(parts.parts["calibration"].mean_mm)
    return (
        "The calibration moves the surface as a whole and bends it a little: that part is known from the true places and the "
        f"estimated cameras alone, and is {mean} mm in the mean. "
    )


def parts_table(parts: ErrorParts) -> str:
    """The parts of the errors, and their sum."""
    rows = [(PARTS[name], *_figures(part)) for name, part in parts.parts.items()]
    apart = np.sqrt(sum(part.scatter_mm**2 for part in parts.parts.values()))
    rows.append(("all together", *_figures(parts.whole)))
    caption = (
        "In mm, over all points with a prediction. Means add up. So do the squares of scatters, to "
        f"{shown(float(apart), '.4f')} mm, as far as the parts are independent. RMS² = mean² + scatter². Predicted: one standard "
        "deviation; of the calibration, over calibrations like this one, by its covariance; of the noise by the images’ own."
    )
    return page.table(("part of the error", "mean", "scatter about it", "predicted", "RMS"), rows, caption)


def error_maps(comparison: Comparison, parts: ErrorParts) -> list[str]:
    """Pictures of the errors, their systematic part and what is predicted."""
    mean, inside = local_mean(comparison.error, comparison.interior, AVERAGED_PX), comparison.interior
    error = Scale(DIVERGING, *_both(half_range(comparison.error, ERROR_MM)))
    left = np.where(inside & parts.known, parts.smooth, np.float32(np.nan))
    rest = Scale(DIVERGING, *_both(half_range(left, SYSTEMATIC_MM)))
    sigma = comparison.predicted[parts.known]
    noise = Scale(SEQUENTIAL, 0, round_up(float(np.quantile(sigma, 0.99))) if sigma.size else ERROR_MM)
    over = f"Mean over {AVERAGED_PX} × {AVERAGED_PX} px, by which noise falls fifteenfold"
    band = f"A band of {surface_errors.EDGE_PX} px along edges is left out"
    pictures = [
        page.picture(
            error(np.where(inside, comparison.error, np.float32(np.nan))),
            "Error",
            f"Distance from the true surface, positive outwards. {band}.",
            error,
            "mm",
        ),
        page.picture(error(mean), "Calibration and rest", f"{over}. On the same scale.", error, "mm"),
    ]
    if "calibration" in parts.parts:
        pictures.append(page.picture(rest(left), "The rest", f"The same less the calibration’s part. {band}.", rest, "mm"))
    predicted = "Standard deviation expected from the images’ own noise."
    return [*pictures, page.picture(noise(comparison.predicted), "Predicted noise", predicted, noise, "mm")]


def histograms(comparison: Comparison, parts: ErrorParts) -> list[str]:
    """Drawings of the errors, and of what the calibration leaves of them over their predicted standard deviations."""
    error, left = comparison.error[parts.known], parts.left[parts.known]
    predicted, whole = comparison.predicted[parts.known], parts.whole
    half = round_up(max(float(np.quantile(np.abs(error), 0.999)), 3.5 * surface_errors.rms(predicted)))
    ratio = left / predicted
    less = ", less the calibration’s part" if "calibration" in parts.parts else ""
    return [
        page.drawing(
            figures.histogram(error, figures.noise_mixture(predicted, half, "predicted noise alone"), "error, mm", half),
            "Errors in mm",
            f"RMS {shown(whole.rms_mm, '.4f')} mm, mean {_signed(whole.mean_mm)} mm; noise alone is predicted to leave "
            f"{shown(surface_errors.rms(predicted), '.4f')} mm.",
        ),
        page.drawing(
            figures.histogram(ratio, figures.standard_normal(5), "error / predicted standard deviation", 5),
            f"Errors in units of the noise predicted for them{less}",
            f"Standard deviation {np.std(ratio):.3f}; 1 if the prediction is right, less if it is cautious.",
        ),
    ]


def _figures(part: Part) -> tuple[str, str, str, str]:
    """Cells of a part of the errors: mean, scatter, prediction and RMS."""
    predicted = f"{part.predicted_mm:.4f}" if np.isfinite(part.predicted_mm) else "–"
    return _signed(part.mean_mm), shown(part.scatter_mm, ".4f"), predicted, shown(part.rms_mm, ".4f")


def _signed(value: float) -> str:
    """A length in mm with its sign; a zero has none."""
    if not np.isfinite(value):
        return "unknown"
    return f"{value:+.4f}".replace("-", "−") if round(value, 4) else "0.0000"


def _both(half: float) -> tuple[float, float]:
    return -half, half


def half_range(error: NDArray[np.float32], least: float) -> float:
    """The end of a scale for errors : (h, w) mm, NaN where there are none."""
    known = error[np.isfinite(error)]
    return max(least, round_up(2 * surface_errors.rms(known))) if known.any() else least


def round_up(value: float) -> float:
    """The next number with one or two significant digits, for the end of an axis."""
    step = 10 ** np.floor(np.log10(value)) / 2
    return float(np.ceil(value / step) * step)
