"""The page of a real capture beside the twin's rendering of it: pictures, figures, and in words what the twin doesn't explain."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray
from scipy.special import ndtr

from recon.files import atomic
from recon.files.metrics import Metrics, shown
from recon.model.patterns import Fringes
from recon.reports import figures, page
from recon.reports.figures import BARS, DIVERGING, LINE, SEQUENTIAL, TEXT, Scale
from recon.reports.page import Opening, Section
from twin.evaluation import likeness, local_residuals
from twin.evaluation.likeness import Likeness, Profile, Statistic, Taken, passed_by, width_of

Array = NDArray[np.float64]

NAMES = {
    "noise_variance": "variance of noise, in the grey level that is farthest off",
    "temporal_spectrum": "temporal power of noise and flicker",
    "spatial_spectrum": "spatial spectrum of noise, in the band that is farthest off",
    "modulation_correlation": "correlation of the maps of modulation",
    "modulation_repeated": "that of two captures alike, by halves of their steps",
    "modulation_ratio": "modulation of the fringes over the light",
    "harmonics": "harmonics of the fringes, the farthest off, of the modulation",
    "edge_width": "width of edges of light, 25 to 75 %",
    "halo": "light in dark places beyond edges, of the bright ones' light",
    "twin_sigma_over_residual": "sigma that the twin predicts, over the local residual",
    "own_sigma_over_residual": "sigma by the real images, over the local residual",
    "twin_sigma_over_twin_residual": "the same of the twin's own images",
    "histogram_distance": "distance of the grey histograms (Kolmogorov)",
}
AMPLITUDES = "Amplitudes, of the modulation; the twin’s as behind the real one’s blur, by edges of light."
AROUND_PX = 24  # of the compared pixels, that pictures show
QUARTILE = 0.4040  # of a disc's radius from its middle, on either side of which half of its light lies
DISC = 2 * QUARTILE  # radii between a quarter and three quarters of an edge behind a disc
NORMAL = 1.349  # standard deviations between them behind a Gaussian
MOSTLY = 0.5  # of a change of the fringes' modulation, that edges may leave open
DARKER = 2.0  # times as far off in the dark as in the bright, from which on noise is dark noise
RESIDUAL = 4.0  # ends of the residuals' colours, standard deviations


def write(path: Path, real: Taken, twin: Taken, found: Likeness, name: str, source: str, commands: Sequence[str]) -> None:
    """Write the page, one HTML file that needs no other.

    Parameters
    ----------
    source : a paragraph on the data that the rig is from
    commands : that make the same again
    """
    told = list(unexplained(real, found))
    sections = [
        Section("What the twin does not explain", [page.paragraph(line) for line in told]),
        Section("Statistics", [_table(found)]),
        pictures(real, twin, found),
        grey_levels(real, twin, found),
        noise(real, found),
        modulation(found),
        edges(found),
        residuals(real, twin, found),
        Section("Data, and how to make this again", [page.paragraph(source), page.paragraph(LIMITS), page.commands(commands)]),
    ]
    text = page.render(opening(found, name, told[0]), sections, FOOTER)
    with atomic.new_file(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


FOOTER = "Made by sonotwin without any ground truth. This file is complete: it fetches nothing."
LIMITS = (
    "The surface’s shape, its reflectance, pixel by pixel from the light under bright and dark stripes, and the room’s light are "
    "taken from this capture, so grey levels there agree by themselves. Fringes, edges, noise and what follows from them are "
    "the rig’s. Frames’ errors are drawn anew. Light from one place of the surface to another goes as many ways as "
    "tracing.bounces says; what stands around it isn’t rendered."
)


def opening(found: Likeness, name: str, first: str) -> Opening:
    """Title, the result, and the statistics that have bars."""
    chosen = ("noise_variance", "temporal_spectrum", "modulation_correlation", "edge_width", "twin_sigma_over_residual")
    labels = ("noise", "noise and flicker", "correlation of modulation", "width of edges", "twin’s sigma / residual")
    numbers = [(label, shown(found[name].value, ".3f"), "") for label, name in zip(labels, chosen, strict=True)]
    return Opening("real capture, digital twin", f"{name}: real and rendered again", first, numbers)


def metrics_of(found: Likeness) -> Metrics:
    """All statistics by name, and the figures that they are of."""
    figures_of: Metrics = {one.name: one.value for one in found.statistics}
    figures_of |= {"compared_px": int(np.count_nonzero(found.compared)), "beyond_bars": len(found.off)}
    if found.edges is not None:
        for side, light in (("real", found.edges.real), ("twin", found.edges.twin)):
            figures_of[f"edge_width_{side}_px"] = width_of(found.edges.place, light)
    if found.noise is not None:
        ratio = found.noise.real / found.noise.twin
        figures_of |= {"noise_variance_darkest": float(ratio[0]), "noise_variance_brightest": float(ratio[-1])}
    if found.harmonics is not None:
        for side, lines in zip(("real", "twin"), found.harmonics, strict=True):
            figures_of |= {f"harmonic_{k}_{side}": float(np.abs(one)) for k, one in enumerate(lines, 2)}
    if found.frames is not None:
        for side, one in (("real", found.frames.real), ("rig", found.frames.expected)):
            figures_of |= {f"{field}_{side}": getattr(one, field) for field in ("flicker", "stray_dn", "shift")}
    return figures_of


def unexplained(real: Taken, found: Likeness) -> Iterator[str]:
    """Sentences on the statistics beyond their bars, the farthest first; one if there are none."""
    missing = [NAMES[one.name] for one in found.statistics if np.isnan(one.value) and np.isfinite(one.bar)]
    counted = sum(np.isfinite(one.bar) and np.isfinite(one.value) for one in found.statistics)
    if not found.off:
        yield f"Nothing: all {counted} statistics that have a bar are within it."
    for one in found.off:
        yield SENTENCES[one.name](one, real, found)
    if missing:
        yield f"Not told by this capture: {'; '.join(missing)}."


def _noise_off(one: Statistic, real: Taken, found: Likeness) -> str:
    assert found.noise is not None
    ratio = found.noise.real / found.noise.twin
    dark, bright = ratio[0] - 1, ratio[-1] - 1
    cause = "the electrons a digital number (saturation_e, or the camera’s gain)"
    if abs(dark) > DARKER * abs(bright):
        cause = "dark noise or the black level"
    ends = f"{_percent(dark)} in the darkest and {_percent(bright)} in the brightest levels ({found.noise.level[0]:.0f} and "
    return f"Noise: its variance is off by {ends}{found.noise.level[-1]:.0f} DN), as by {cause} of the camera."


def _spectrum_off(one: Statistic, real: Taken, found: Likeness) -> str:
    assert found.frames is not None and found.noise is not None
    own, rig = found.frames.real, found.frames.expected
    full = 2.0**real.bits - 1
    by_frames = likeness.power_of(own, found.frames, full) - likeness.power_of(rig, found.frames, full)
    if abs(by_frames) < abs(float(found.noise.real.mean() - found.noise.twin.mean())):
        return f"Temporal power: noise and flicker together have {one.value:.2f} times the twin’s power, by the noise above."
    return (
        f"Flicker: noise and errors of frames have {one.value:.2f} times the power that the rig’s conditions have. Gains of "
        f"{found.frames.steps} frames scatter by {_percent(own.flicker, 2)} (conditions: {_percent(rig.flicker, 2)}), stray "
        f"light by {own.stray_dn:.2f} DN ({rig.stray_dn:.2f}), shifts by {own.shift:.3f} steps ({rig.shift:.3f})."
    )


def _rings_off(one: Statistic, real: Taken, found: Likeness) -> str:
    assert found.spatial is not None
    ratio = found.spatial.real / found.spatial.twin
    k = int(np.argmax(np.abs(ratio - 1)))
    return (
        f"Grain: the noise isn’t white over the image as the twin’s is: it has {one.value:.2f} times the twin’s share at periods "
        f"of some {1 / found.spatial.frequency[k]:.1f} px, as by processing in the camera or harmonics of the fringes."
    )


def _correlation_off(one: Statistic, real: Taken, found: Likeness) -> str:
    alike = found["modulation_repeated"].value
    but = f"; two captures alike would have {alike:.3f}" if np.isfinite(alike) else ""
    return f"Modulation: its map and the twin’s have a correlation of {one.value:.3f}: it differs from place to place{but}."


def _modulation_off(one: Statistic, real: Taken, found: Likeness) -> str:
    text = f"fringes have {one.value:.3f} times the twin’s modulation over the light."
    by_edges = modulation_by_edges(real, found)
    if abs(by_edges - one.value) < MOSTLY * abs(one.value - 1):
        return f"Blur: {text} It is that of edges of light, as wide as they are: {by_edges:.3f} times would be left."
    if found.harmonics is not None and np.abs(np.subtract(*found.harmonics))[0] > likeness.BARS.harmonic:
        return f"Modulation: {text} It goes with the second harmonic: a gamma changes both."
    return f"Modulation: {text} Edges as wide as they are would leave {by_edges:.3f} times: contrast, or light between places."


def _harmonics_off(one: Statistic, real: Taken, found: Likeness) -> str:
    assert found.harmonics is not None
    k = int(np.argmax(np.abs(found.harmonics[0] - found.harmonics[1])))
    ours, theirs = (_percent(float(np.abs(lines[k])), 2) for lines in found.harmonics)
    cause = "the projector’s gamma" if k == 0 else "grey levels that the projector doesn’t show, or errors in step with fringes"
    return f"Harmonics: number {k + 2} of the fringes is {ours} of the modulation and {theirs} in the twin, as by {cause}."


def _width_off(one: Statistic, real: Taken, found: Likeness) -> str:
    assert found.edges is not None
    place, ours, theirs = found.edges
    width, usual = width_of(place, ours), width_of(place, theirs)
    text = f"Blur: edges of light rise over {width:.2f} projector px, and over {usual:.2f} px in the twin (25 to 75 %)"
    disc, gaussian = shapes_of_edge(found.edges)
    if min(disc, gaussian) > 0.5 * max(disc, gaussian):
        return f"{text}: blur or focus of projector or camera."
    if disc < gaussian:
        return (
            f"{text}. Their form is that of a disc of {2 * width / DISC:.1f} px (RMS off by {_percent(disc, 1)}; a Gaussian’s by "
            f"{_percent(gaussian, 1)}): the projector is out of focus, which the rig has otherwise."
        )
    return f"{text}. Their form is that of a Gaussian of {width / NORMAL:.2f} px: a lens’s blur, more than a disc out of focus."


def _halo_off(one: Statistic, real: Taken, found: Likeness) -> str:
    return (
        f"Halo: beyond the width of edges dark places have {_percent(one.value, 1)} more of the bright ones’ light than in the "
        "twin, and bright ones lack it: veiling glare, or light between places of the surface."
    )


def _sigma_off(one: Statistic, real: Taken, found: Likeness) -> str:
    own = found["own_sigma_over_residual"].value
    follows = "it follows from the modulation and noise above" if abs(own - 1) <= one.bar else "so there is more than noise"
    return (
        f"Residual: the sigma that the twin predicts is {one.value:.2f} of what neighbouring points scatter by. "
        f"That by the real images’ own noise and modulation is {own:.2f} of it: {follows}."
    )


SENTENCES = {
    "noise_variance": _noise_off,
    "temporal_spectrum": _spectrum_off,
    "spatial_spectrum": _rings_off,
    "modulation_correlation": _correlation_off,
    "modulation_ratio": _modulation_off,
    "harmonics": _harmonics_off,
    "edge_width": _width_off,
    "halo": _halo_off,
    "twin_sigma_over_residual": _sigma_off,
}


def modulation_by_edges(real: Taken, found: Likeness) -> float:
    """Ratio of the modulation, real over twin's, that a blur leaves by which edges are as wide as they are; NaN without any."""
    pitches = [part.pitch for part in real.patterns.parts if isinstance(part, Fringes)]
    if found.edges is None or not pitches:
        return np.nan
    ours, theirs = (passed_by(found.edges.place, light, min(pitches)) for light in found.edges[1:])
    return ours / theirs


def shapes_of_edge(profile: Profile) -> tuple[float, float]:
    """RMS by which the real edge differs from that behind a disc and behind a Gaussian of its width, over two widths around."""
    width = width_of(profile.place, profile.real)
    near = np.abs(profile.place) < 2 * width
    place, light = profile.place[near], profile.real[near]
    middle = np.interp(0.5, np.maximum.accumulate(profile.real), profile.place)
    x = np.clip((place - middle) * DISC / width, -1, 1)
    disc = 0.5 + (x * np.sqrt(1 - x * x) + np.arcsin(x)) / np.pi
    gaussian = ndtr((place - middle) * NORMAL / width)
    off = [float(np.sqrt(np.trapezoid((light - one) ** 2, place) / np.ptp(place))) for one in (disc, gaussian)]
    return off[0], off[1]


def _table(found: Likeness) -> str:
    rows = []
    for one in sorted(found.statistics, key=lambda one: (-one.off, np.isnan(one.bar))):
        bar, verdict = "–", ""
        if np.isfinite(one.bar):
            low, high = one.expected - one.bar, one.expected + one.bar
            bar = f"{low:.2f} to {high:.2f}" if one.name != "modulation_correlation" else f"{low:.2f} or more"
            verdict = "not told" if np.isnan(one.value) else "explained" if one.explained else f"{one.off:.1f} bars off"
        chance = f" ± {one.sigma:.3f}" if one.sigma else ""
        rows.append((NAMES[one.name], bar, verdict, f"{shown(one.value, '.3f')}{chance}"))
    caption = (
        "Real over twin’s, or real less twin’s. ± is one standard deviation, by noise and by the number of frames: a value "
        "counts as explained within its bar and three of these."
    )
    return page.table(("statistic", "bar", "", "value"), rows, caption)


def pictures(real: Taken, twin: Taken, found: Likeness) -> Section:
    """Even light and one fringe image of both, alike in grey."""
    rows, columns = _around(found)
    place = next((place for part, place in real.patterns.slices() if isinstance(part, Fringes)), slice(0, 1))
    weights = real.patterns.even_light
    blocks = []
    even = [np.tensordot(weights, side.images, 1)[rows, columns] for side in (real, twin)]
    full = float(np.quantile(even[0], 0.999))
    blocks += [
        page.picture(figures.grey(image, full, 2.2), f"Even light, {name}", "Mean of fringes; shadows lifted.")
        for name, image in zip(("real", "twin"), even, strict=True)
    ]
    fringe = [side.images[place.start][rows, columns] for side in (real, twin)]
    full = float(np.quantile(fringe, 0.999))
    blocks += [
        page.picture(figures.grey(image, full), f"Fringe image 1, {name}", "Alike in grey.")
        for name, image in zip(("real", "twin"), fringe, strict=True)
    ]
    if found.edges is not None:
        number = next(one.number for one in likeness.stripes(real.patterns) if np.isfinite(one.inside_px).all())
        stripe = [side.images[number][rows, columns] for side in (real, twin)]
        full = float(np.quantile(stripe, 0.999))
        blocks += [
            page.picture(figures.grey(image, full, 2.2), f"Stripes, {name}", "Shadows lifted.")
            for name, image in zip(("real", "twin"), stripe, strict=True)
        ]
    text = "The surface as reconstructed, with its reflectance, before black; what stood around it isn’t known to the twin."
    return Section("Pictures", [page.paragraph(text), page.grid(blocks, "two")])


def grey_levels(real: Taken, twin: Taken, found: Likeness) -> Section:
    """Histograms of all images."""
    shares = {name: likeness.histogram(side, found.compared) for name, side in (("real", real), ("twin", twin))}
    step = 2 ** (real.bits - 8)
    binned = {name: share.reshape(-1, step).sum(axis=1) for name, share in shares.items()}
    distance = found["histogram_distance"].value
    drawn = page.drawing(
        _lines(np.arange(256) * step, binned, ("grey level, DN", "share of pixels")),
        "Grey levels of all images",
        f"Compared pixels alone. The shares up to a level differ by {distance:.3f} at most.",
    )
    return Section("Grey levels", [drawn])


def noise(real: Taken, found: Likeness) -> Section:
    """Noise over grey level, over the sequence and over the image."""
    blocks = []
    if found.noise is not None:
        drawn = _lines(
            found.noise.level, {"real": found.noise.real, "twin": found.noise.twin}, ("grey level, DN", "variance, DN²"), 0
        )
        text = f"Farthest off: {found['noise_variance'].value:.3f} of the twin’s."
        blocks.append(page.drawing(drawn, "Noise over grey level", text))
    if found.temporal is not None:
        drawn = _lines(
            found.temporal.frequency,
            {"real": found.temporal.real, "twin": found.temporal.twin},
            ("harmonic of the sequence", "power, DN²"),
            log=True,
        )
        text = "Fringes are the first; a gamma adds the second; noise and errors of frames are alike in all."
        blocks.append(page.drawing(drawn, "Temporal spectrum", text))
    if found.spatial is not None:
        drawn = _lines(
            found.spatial.frequency,
            {"real": found.spatial.real, "twin": found.spatial.twin},
            ("cycles a pixel", "power over its mean"),
            0,
        )
        blocks.append(page.drawing(drawn, "Spatial spectrum of temporal noise", "White noise is 1."))
    if found.frames is not None:
        own, rig = found.frames.real, found.frames.expected
        chance = f"{100 / np.sqrt(2 * (found.frames.steps - 1)):.0f} %"
        rows = [
            ("flicker of the light", _percent(rig.flicker, 2), _percent(own.flicker, 2)),
            ("stray light, 8-bit DN", f"{rig.stray_dn:.2f}", f"{own.stray_dn:.2f}"),
            ("shifts, steps", f"{rig.shift:.4f}", f"{own.shift:.4f}"),
        ]
        caption = f"Standard deviations. {found.frames.steps} frames show one to {chance}."
        blocks.append(page.table(("errors of frames", "conditions", "real"), rows, caption))
    return Section("Noise", [page.grid(blocks, "two") if blocks else page.paragraph("Fringes of eight steps or more show it.")])


def modulation(found: Likeness) -> Section:
    """Maps of the fringes' modulation over the light, their ratio, and the harmonics."""
    rows, columns = _around(found)
    ours, theirs = (one[rows, columns] for one in found.contrast)
    top = float(np.nanquantile(np.stack([ours, theirs]), 0.99))
    scale = Scale(SEQUENTIAL, 0, top)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = ours / theirs - 1
    half = max(0.05, float(np.nanquantile(np.abs(ratio), 0.9)))
    change = Scale(DIVERGING, -half, half)
    ratios = [found[name].value for name in ("modulation_ratio", "modulation_correlation")]
    text = "Modulation of the fringes over the light between dark and bright; 0.5 of sharp, linear fringes."
    blocks = [
        page.picture(scale(ours), "Modulation, real", text, scale),
        page.picture(scale(theirs), "Modulation, twin", "On the same scale.", scale),
        page.picture(
            change(ratio),
            "Real over twin, less 1",
            f"Median ratio {ratios[0]:.3f}; correlation of the modulations {ratios[1]:.3f}.",
            change,
        ),
    ]
    parts = [page.grid(blocks, "two")]
    if found.harmonics is not None:
        lines = [
            (f"{k}", *(_percent(float(np.abs(one)), 2) for one in pair))
            for k, pair in enumerate(zip(*found.harmonics, strict=True), 2)
        ]
        parts.append(page.table(("harmonic in step with the fringes", "real", "twin"), lines, AMPLITUDES))
    return Section("Modulation and harmonics", parts)


def edges(found: Likeness) -> Section:
    """Profiles across edges of stripes, once whole and once their dark side enlarged."""
    if found.edges is None:
        return Section("Edges of light", [page.paragraph("Stripes of Gray code show them; this sequence has none wide enough.")])
    place, real, twin = found.edges
    widths = [width_of(place, one) for one in (real, twin)]
    near = np.abs(place) < max(8.0, 2.5 * np.nanmax(widths))
    across = ("projector px from the edge", "share of the light")
    blocks = [
        page.drawing(
            _lines(place[near], {"real": real[near], "twin": twin[near]}, across),
            "Edges of stripes",
            f"A quarter to three quarters within {widths[0]:.2f} px, in the twin {widths[1]:.2f} px.",
        ),
        page.drawing(
            _lines(place, {"real": np.maximum(real, 1e-4), "twin": np.maximum(twin, 1e-4)}, across, log=True),
            "The same with its dark side enlarged",
            "Light that spreads farther than blur does lies above the twin’s.",
        ),
    ]
    return Section("Edges of light", [page.grid(blocks, "two")])


def residuals(real: Taken, twin: Taken, found: Likeness) -> Section:
    """Local residuals over the sigma that the twin predicts."""
    rows, columns = _around(found)
    scale, blocks = Scale(DIVERGING, -RESIDUAL, RESIDUAL), []
    for name, side in (("real", real), ("twin", twin)):
        left = np.where(found.compared, local_residuals.residuals(side.distance) / twin.points.sigma, np.float32(np.nan))
        spread = np.nanstd(np.clip(left, -20, 20))
        window = local_residuals.WINDOW
        text = f"Distance less a quadratic in {window} × {window} px; standard deviation {spread:.2f}."
        blocks.append(page.picture(scale(left[rows, columns]), f"Local residual over the twin’s sigma, {name}", text, scale, "σ"))
    names = ("twin_sigma_over_residual", "own_sigma_over_residual", "twin_sigma_over_twin_residual")
    by_twin, by_images, rendered = (shown(found[one].value, ".3f") for one in names)
    text = (
        f"Over smooth patches sigma is {by_twin} of the real residual as the twin predicts it, {by_images} as the real images "
        f"do, and {rendered} of the rendered one: below 1 by as much as rays are few."
    )
    return Section("Residuals of the surface", [page.paragraph(text), page.grid(blocks, "two")])


def _around(found: Likeness) -> tuple[slice, slice]:
    """Rows and columns of the compared pixels and some around them."""
    rows, columns = (slice(max(int(k.min()) - AROUND_PX, 0), int(k.max()) + AROUND_PX) for k in np.nonzero(found.compared))
    return rows, columns


def _lines(
    x: NDArray, y: Mapping[str, NDArray], labels: tuple[str, str], bottom: float | None = None, *, log: bool = False
) -> str:
    """The real course and the twin's over x, as an SVG drawing; from `bottom` on."""
    drawn, axes = figures.blank(5.2, 3.1)
    for (name, values), colour in zip(y.items(), (BARS, LINE), strict=True):
        marker = "o" if len(x) < 20 else ""
        axes.plot(x, values, marker=marker, color=colour, linewidth=1.4, markersize=3.6, label=name)
    axes.set(xlabel=labels[0], ylabel=labels[1], yscale="log" if log else "linear")
    axes.xaxis.set_major_locator(MaxNLocator(7, integer=bool(np.all(np.mod(x, 1) == 0))))
    if bottom is not None:
        axes.set_ylim(bottom=bottom)
    axes.tick_params(which="both", colors=TEXT)
    axes.legend(frameon=False, labelcolor=TEXT, fontsize=9)
    axes.spines[["top", "right"]].set_visible(False)
    return figures.inline_svg(drawn)


def _percent(share: float, digits: int = 0) -> str:
    return f"{100 * share:.{digits}f} %".replace("-", "−")
