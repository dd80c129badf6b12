"""Boards of discs in images."""

import numpy as np
from numpy.typing import NDArray

from recon.board_detection import discs, lattice
from recon.board_detection.findings import BoardNotFound, Detection, first_faults, refuse_bad, spread
from recon.board_detection.reduced_images import reduced
from recon.geometry.ellipses import Ellipses
from recon.model.boards import Discs

Array = NDArray[np.float64]

MOST_PLACES = 20  # times the board's discs that are tried for another design
ROOM = 0.45  # of the gap between neighbours, and of a disc's radius, is looked at
MOST_BLUR = 0.25  # of the disc's shorter radius
LEAST_CONTRAST = 0.03  # of the full scale
LEAST_SIGNAL = 4.0  # contrast over noise
MOST_CLIPPED = 0.02  # of the pixels about a rim
MOST_SIGMA = 0.2  # px, of a centre
MOST_RESIDUAL = (0.03, 0.3)  # of the radius and px, RMS of the edge points about the ellipse
LEAST_RATIO = 0.3  # of the semi-axes


def find_circles(image: Array, board: Discs, full: float) -> Detection:
    """Find the discs of a board and measure their ellipses; see `recon.board_detection.detect.detect`."""
    image = full - image if board.white else image
    looked = reduced(image)
    rough = looked.full_ellipses(discs.candidates(looked.image, full))
    cells, steps = _grid(board)
    try:
        assignment = lattice.assign(rough.centre, cells, steps)
    except BoardNotFound as reason:
        raise BoardNotFound(f"{reason}{_likely(rough.centre, board)}") from None
    present = np.flatnonzero(assignment >= 0)
    chosen = rough[assignment[present]]
    measured = discs.measure(image, chosen, _room(chosen, board), full)
    good = refuse_bad(_faults(measured, full, board.white), len(cells), "circles")
    at, ellipses = present[good], measured.fit.ellipses[good]
    return Detection(
        spread(ellipses.centre, at, len(cells)),
        spread(measured.covariance[good], at, len(cells)),
        spread(ellipses.semi_axes, at, len(cells)),
    )


def _likely(centres: Array, board: Discs) -> str:
    """The design that centres : (k, 2) px fit better, in words: rows and columns exchanged; nothing if they don't."""
    exchanged = board.model_copy(update={"columns": board.rows, "rows": board.columns})
    if board.columns == board.rows or board.pitch_mm == board.spacing_mm or len(centres) > MOST_PLACES * len(board.points()):
        return ""
    try:
        lattice.assign(centres, *_grid(exchanged))
    except BoardNotFound:
        return ""
    return f"; rows and columns exchanged? They fit columns: {exchanged.columns}, rows: {exchanged.rows}"


def _grid(board: Discs) -> tuple[lattice.Integers, lattice.Integers]:
    """Cells of the discs, and two steps between neighbours."""
    cells = np.rint(board.points()[:, :2] / board.spacing_mm).astype(np.int64)
    return cells, np.array(board.NEIGHBOURS, dtype=np.int64)


def _room(rough: Ellipses, board: Discs) -> Array:
    """Width of the clear band about each rim : (n,) px, from the design and the disc's own size."""
    gap = 2 * max(board.pitch_mm / board.diameter_mm - 1, 0.1)  # in radii
    return np.maximum(ROOM * min(gap, 1) * rough.semi_axes[:, 1], 2.0)


def _faults(measured: discs.Discs, full: float, white: bool) -> list[str | None]:
    """Reasons to refuse each disc, None for good ones."""
    edges, fit = measured.edges, measured.fit
    longer, shorter = fit.ellipses.semi_axes.T
    contrast = edges.outside - edges.inside
    sigma = np.sqrt(np.trace(measured.covariance, axis1=1, axis2=2) / 2)
    scatter = np.sqrt(np.nansum(fit.residuals**2, axis=1) / np.maximum(np.isfinite(fit.residuals).sum(axis=1), 1))
    least = np.maximum(LEAST_CONTRAST * full, LEAST_SIGNAL * edges.noise)
    other = f"{'dark' if white else 'white'} discs, by {{:.1f}} %: give the board white: {str(not white).lower()}"
    tests = [
        (-contrast >= least, -100 * contrast / full, other),
        (contrast < least, 100 * contrast / full, "contrast of {:.1f} %"),
        (edges.clipped > MOST_CLIPPED, 100 * edges.clipped, "rim saturated, {:.0f} % of it"),
        (edges.blur > MOST_BLUR * shorter, edges.blur, "too blurred, {:.1f} px"),
        (shorter < LEAST_RATIO * longer, shorter / longer, "too oblique, semi-axes 1:{:.2f}"),
        (scatter > np.maximum(MOST_RESIDUAL[0] * shorter, MOST_RESIDUAL[1]), scatter, "rim {:.2f} px off an ellipse"),
        (~(sigma < MOST_SIGMA), sigma, "centre uncertain by {:.2f} px"),
    ]
    return first_faults(tests, len(longer))
