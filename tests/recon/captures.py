"""Captures of one part, written in one call."""

from recon.board_detection.kinds.asymmetric_circles import AsymmetricCircles
from recon.capture.manifest import CAMERAS, SCANNER, Device
from recon.capture.writer import new_capture
from recon.model.patterns import Fringes, GrayCode, Patterns

PROJECTOR = (128, 80)
BOARD = AsymmetricCircles(columns=4, rows=11, spacing_mm=15.0, diameter_mm=9.0)
PATTERNS = Patterns(
    projector_size=PROJECTOR,
    unwrap="gray",
    parts=tuple(
        part
        for axis in ("columns", "rows")
        for part in (Fringes(axis=axis, pitch=18, steps=3), GrayCode(axis=axis, pitch=18, bits=3))
    ),
)


def write_sweep(folder, images, times, track, size, probe=None, name=""):
    """B-scans : n of (h, w), taken one by one, and the poses of the target."""
    with new_capture(folder, name) as capture:
        capture.add_sweep({SCANNER: times}, ((SCANNER, image) for image in images), {SCANNER: Device(size=size)}, track)
        if probe is not None:
            capture.add_probe(probe)


def write_film(folder, pairs, times, optics, devices, name=""):
    """Frames of both cameras, taken pair by pair."""
    frames = (frame for pair in pairs for frame in zip(CAMERAS, pair, strict=True))
    with new_capture(folder, name) as capture:
        capture.add_calibration(optics)
        capture.add_sweep(dict.fromkeys(CAMERAS, times), frames, devices)
