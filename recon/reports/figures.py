"""Figures of a measurement: arrays in; pictures and drawings out, for a page or a file of their own.

Pictures carry no lettering and drawings take the colour of the text around them, so that both suit a light and a dark page.
"""

import base64
import io
from collections.abc import Mapping
from dataclasses import dataclass, replace

import cv2
import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import PathPatch
from matplotlib.path import Path
from numpy.typing import NDArray

Map = NDArray[np.float32]  # (h, w)
Mask = NDArray[np.bool_]  # (h, w)
Colours = NDArray[np.uint8]  # (h, w, 4) red, green, blue, opacity

DIVERGING, CYCLIC, SEQUENTIAL = "RdBu_r", "twilight", "viridis"
QUALITY = 88  # of WebP: no visible loss in sensor noise
BARS, LINE = "#5b8db8", "#c8553d"  # what is measured, and what it is held against: both stand out from light and from dark
TEXT = "#0a0b0c"  # stands for the page's text colour until the drawing is in the page


@dataclass(frozen=True)
class Scale:
    """A colour map over a range of values."""

    colours: str  # matplotlib's name
    low: float
    high: float

    def __call__(self, values: Map) -> Colours:
        """Colour values : (h, w); NaN becomes transparent."""
        lookup = np.uint8(np.rint(255 * matplotlib.colormaps[self.colours](np.linspace(0, 1, 256))))
        scaled = (np.nan_to_num(values, nan=self.low) - self.low) / (self.high - self.low)
        coloured = lookup[np.uint8(np.clip(np.rint(255 * scaled), 0, 255))]
        coloured[np.isnan(values), 3] = 0
        return coloured

    def gradient(self, stops: int = 13) -> list[str]:
        """Colours at equal distances from low to high, as `rgb(...)`."""
        rgb = np.rint(255 * matplotlib.colormaps[self.colours](np.linspace(0, 1, stops))[:, :3]).astype(int)
        return [f"rgb({r},{g},{b})" for r, g, b in rgb]


@dataclass(frozen=True)
class Curve:
    """A probability density along x."""

    x: NDArray[np.float64]
    density: NDArray[np.float64]
    label: str


def grey(image: NDArray, full: float, gamma: float = 1.0) -> Colours:
    """An image : (h, w) as grey, black at 0 and white at `full`; gamma above 1 lifts the shadows."""
    levels = np.uint8(np.rint(255 * np.clip(np.asarray(image, np.float32) / full, 0, 1) ** (1 / gamma)))
    return np.dstack([levels, levels, levels, np.full_like(levels, 255)])


def webp(picture: Colours) -> str:
    """A picture as the data URI of a WebP image."""
    _, data = cv2.imencode(".webp", cv2.cvtColor(picture, cv2.COLOR_RGBA2BGRA), [cv2.IMWRITE_WEBP_QUALITY, QUALITY])
    return "data:image/webp;base64," + base64.b64encode(data.tobytes()).decode("ascii")


def error_map_png(error: Map, interior: Mask, half_range: float) -> bytes:
    """Map of signed errors : (h, w) mm with its colour bar, as a PNG file for itself; edges are left out."""
    figure = Figure(figsize=(8, 5.4), dpi=160, layout="constrained")
    axes = figure.add_subplot()
    masked = np.where(interior, error, np.nan)
    drawn = axes.imshow(masked, cmap=DIVERGING, vmin=-half_range, vmax=half_range, interpolation="nearest")
    axes.set(facecolor="0.85", xlabel="camera column, px", ylabel="camera row, px")
    figure.colorbar(drawn, label="error, mm, positive outwards", extend="both")
    file = io.BytesIO()
    figure.savefig(file, format="png")
    return file.getvalue()


def histogram(values: NDArray, expected: Curve, unit: str, half_range: float) -> str:
    """Histogram of values as an SVG drawing, with the density that theory expects as a line."""
    bins = np.linspace(-half_range, half_range, 101)
    density = np.histogram(values, bins)[0] / (len(values) * np.diff(bins))
    highest = max(density.max(), expected.density.max())
    figure, axes = blank(5.2, 3.1)
    axes.stairs(density, bins, fill=True, color=BARS, alpha=0.55, label="measured")
    axes.plot(expected.x, expected.density, color=LINE, linewidth=1.6, label=expected.label)
    axes.set(xlabel=unit, xlim=(-half_range, half_range), ylim=(0, 1.15 * highest), yticks=[])
    axes.locator_params(axis="x", nbins=6)
    axes.legend(frameon=False, labelcolor=TEXT, fontsize=9)
    axes.spines[["left", "top", "right"]].set_visible(False)
    return inline_svg(figure)


def arrows(starts: NDArray, vectors: NDArray, size: tuple[int, int], magnification: float, colour: str = LINE) -> str:
    """Vectors over an image plane of a size (width, height) px, as an SVG drawing.

    Parameters
    ----------
    starts, vectors : (n, 2), px
        Where each stands, marked by a dot, and where it points, drawn so many times longer.
    """
    figure, axes = _image_plane(size)
    ends = starts + magnification * vectors
    _strokes(axes, np.stack([starts, ends], axis=1), color=colour, linewidth=0.8)
    _strokes(axes, _dotted(starts), color=TEXT, linewidth=1.3)
    return inline_svg(figure)


def magnification(size: tuple[int, int], length: float) -> float:
    """A round factor for `arrows` by which a vector of a length, px, becomes as long as suits an image of a size."""
    arrow = 0.04  # of an image's width: length of an arrow to be seen well
    wanted = arrow * size[0] / max(length, 1e-9)
    step = 10 ** np.floor(np.log10(wanted))
    return float(step * max(k for k in (1, 2, 5) if k * step <= wanted))


def dots(places: NDArray, values: NDArray, scale: Scale, size: tuple[int, int]) -> str:
    """Dots at places : (n, 2) px of an image plane of a size (width, height), coloured by values : (n,), as an SVG drawing."""
    figure, axes = _image_plane(size)
    steps = 12  # colours that can be told apart; a path for each keeps the drawing small
    level = np.clip((values - scale.low) / (scale.high - scale.low) * steps, 0, steps - 1).astype(int)
    for k in range(steps):
        chosen = places[level == k]
        colour = matplotlib.colormaps[scale.colours]((k + 0.5) / steps)
        _strokes(axes, _dotted(chosen), color=colour, linewidth=2.2)
    return inline_svg(figure)


def slope(x: NDArray, y: NDArray, steepness: float, labels: tuple[str, str], names: tuple[str, str]) -> str:
    """Measured points : (n,), (n,) and the line through the origin that they are held against, as an SVG drawing.

    Parameters
    ----------
    labels : of the two axes, with units.
    names : of points and line, for the legend.
    """
    figure, axes = blank(3.8, 3.6)
    across = 1.08 * float(np.abs(x).max())
    ends = np.array([-across, across])
    axes.plot(ends, steepness * ends, color=LINE, linewidth=1.6, label=names[1])
    axes.plot(x, y, "o", color=BARS, markersize=3.2, label=names[0])
    axes.set(xlabel=labels[0], ylabel=labels[1], xlim=(-across, across))
    axes.locator_params(nbins=7)
    axes.legend(frameon=False, labelcolor=TEXT, fontsize=9)
    axes.spines[["top", "right"]].set_visible(False)
    return inline_svg(figure)


def course(values: NDArray, bounds: NDArray, labels: tuple[str, str], names: tuple[str, str]) -> str:
    """Values : (n,) in their order and the bounds : (n,) they are held against; shaded where NaN. Labels and names as `slope`."""
    figure, axes = blank(5.2, 3.1)
    axes.plot(bounds, color=LINE, linewidth=1.3, drawstyle="steps-mid", label=names[1])
    axes.plot(values, "o", color=BARS, markersize=3.6, label=names[0])
    for k in np.flatnonzero(np.isnan(values)):
        axes.axvspan(k - 0.5, k + 0.5, color=BARS, alpha=0.18, linewidth=0)
    axes.set(xlabel=labels[0], ylabel=labels[1], xlim=(-0.5, len(values) - 0.5), ylim=(0, 1.2 * axes.get_ylim()[1]))
    axes.legend(frameon=False, labelcolor=TEXT, fontsize=9)
    axes.spines[["top", "right"]].set_visible(False)
    return inline_svg(figure)


def outlines(shapes: NDArray, marks: Mapping[str, NDArray], labels: tuple[str, str]) -> str:
    """Outlines : (p, c, 2) mm and named marks : (2,) mm in one plane with equal scales, y down, as an SVG drawing."""
    everything = np.concatenate([np.reshape(shapes, (-1, 2)), *(np.reshape(mark, (1, 2)) for mark in marks.values())])
    low, high = everything.min(axis=0) - 40, everything.max(axis=0) + 40
    figure, axes = blank(5.2, float(np.clip(5.2 * (high[1] - low[1]) / (high[0] - low[0]), 2.5, 9)))
    closed = np.concatenate([shapes, shapes[:, :1]], axis=1)
    _strokes(axes, closed, color=BARS, linewidth=0.8)
    for name, place in marks.items():
        axes.plot(*place, "o", color=LINE, markersize=4)
        axes.annotate(name, place, (7, 0), textcoords="offset points", va="center", color=TEXT, fontsize=9)
    axes.set(xlabel=labels[0], ylabel=labels[1], xlim=(low[0], high[0]), ylim=(high[1], low[1]), aspect="equal")
    axes.spines[["top", "right"]].set_visible(False)
    return inline_svg(figure)


def standard_normal(half_range: float) -> Curve:
    """The standard normal distribution."""
    return replace(normal(1.0, half_range), label="standard normal")


def normal(sigma: float, half_range: float) -> Curve:
    """The normal distribution of a standard deviation about zero."""
    x = np.linspace(-half_range, half_range, 301)
    return Curve(x, np.exp(-((x / sigma) ** 2) / 2) / (sigma * np.sqrt(2 * np.pi)), "normal distribution")


def noise_mixture(sigma: NDArray, half_range: float, label: str) -> Curve:
    """Mixture of normal distributions of predicted sigma : (n,), normalised."""
    x = np.linspace(-half_range, half_range, 301)
    levels = np.quantile(sigma, (np.arange(200) + 0.5) / 200).astype(float)
    return Curve(x, (np.exp(-((x / levels[:, None]) ** 2) / 2) / (levels[:, None] * np.sqrt(2 * np.pi))).mean(axis=0), label)


def blank(width: float, height: float) -> tuple[Figure, Axes]:
    """Empty axes whose lines and letters take the colour of the text around them; width and height in inches."""
    figure = Figure(figsize=(width, height), layout="constrained")
    axes = figure.add_subplot()
    for spine in axes.spines.values():
        spine.set_color(TEXT)
    axes.tick_params(colors=TEXT)
    axes.xaxis.label.set_color(TEXT)
    axes.yaxis.label.set_color(TEXT)
    return figure, axes


def _image_plane(size: tuple[int, int]) -> tuple[Figure, Axes]:
    """Axes over an image of a size (width, height) px, v down."""
    width, height = size
    figure, axes = blank(5.2, 5.2 * height / width)
    axes.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5), aspect="equal")
    axes.set(xticks=[0, width // 2, width - 1], yticks=[0, height // 2, height - 1])
    return figure, axes


def _dotted(places: NDArray) -> NDArray:
    """Lines : (n, 2, 2) that are dots in effect; without any length they would be left out."""
    return np.stack([places, places + np.array([0.01, 0.0])], axis=1)


def _strokes(axes: Axes, lines: NDArray, **style: object) -> None:
    """Draw lines : (n, k, 2), all as one path."""
    codes = np.full(lines.shape[:2], Path.LINETO, np.uint8)
    codes[:, 0] = Path.MOVETO
    path = Path(lines.reshape(-1, 2), codes.ravel())
    path.should_simplify = False
    axes.add_patch(PathPatch(path, fill=False, capstyle="round", joinstyle="round", **style))


def inline_svg(figure: Figure) -> str:
    """A figure as an SVG drawing for a page."""
    file = io.StringIO()
    with matplotlib.rc_context({"svg.fonttype": "none", "svg.hashsalt": "sonotwin", "font.size": 10}):
        figure.savefig(file, format="svg", transparent=True, metadata={"Date": None})
    text = file.getvalue()
    return text[text.index("<svg") :].replace(TEXT, "currentColor")
