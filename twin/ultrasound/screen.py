"""A scanner's screen around the B-scan, as frame grabbers and clips bring it: settings, ruler, greys, focus and clock."""

import cv2
import numpy as np
from numpy.typing import NDArray

from twin.ultrasound.transducer import Transducer

Grey = NDArray[np.uint8]

TEXT, FAINT = 200, 110  # greys of letters and marks
WEDGE_PX = 14  # width of the strip of all greys, at the screen's left


def part_of(transducer: Transducer) -> tuple[int, int, int, int]:
    """The B-scan's part of what the scanner sends: u and v of its upper left pixel, width, height, px."""
    width, height = transducer.image_size
    if transducer.screen is None:
        return 0, 0, width, height
    wide, high = transducer.screen
    return (wide - width) // 2, (high - height) * 2 // 3, width, height


def sent_size(transducer: Transducer) -> tuple[int, int]:
    """Width and height, px, of what the scanner sends."""
    return transducer.screen or transducer.image_size


def on_screen(image: Grey, transducer: Transducer, time_ns: int) -> Grey:
    """The image (h, w) as the scanner sends it at a moment, which its clock shows."""
    if transducer.screen is None:
        return image
    u, v, width, height = part_of(transducer)
    screen = np.zeros(transducer.screen[::-1], np.uint8)
    screen[v : v + height, u : u + width] = image
    seconds = time_ns // 1_000_000_000
    _write(screen, "SONOTWIN", 8, 18)
    _write(screen, f"{seconds // 3600 % 24:02d}:{seconds // 60 % 60:02d}:{seconds % 60:02d}", transducer.screen[0] - 80, 18)
    figures = f"{transducer.frequency_mhz:g} MHz", f"D {transducer.depth_mm / 10:.1f} cm", f"DR {transducer.dynamic_range_db:.0f}"
    for k, figure in enumerate(figures):
        _write(screen, figure, 8 + 110 * k, 36)
    wedge = np.linspace(255, 0, height // 2).astype(np.uint8)
    screen[v : v + len(wedge), 12 : 12 + WEDGE_PX] = wedge[:, None]
    cv2.circle(screen, (u + 4, v - 10), 4, TEXT, 1, cv2.LINE_AA)  # the side of the probe's mark
    row_mm, right = transducer.scale_mm_per_px[1], u + width + 8
    for depth in range(0, int(transducer.depth_mm) + 1, 5):
        row = v + round((depth + transducer.face_mm[1]) / row_mm)
        cv2.line(screen, (right, row), (right + (8 if depth % 10 == 0 else 4), row), FAINT)
        if depth % 10 == 0 and depth:
            _write(screen, str(depth // 10), right + 12, row + 4)
    for focus in (transducer.transmit_focus_mm, *transducer.focal_zones_mm):
        row = v + round((focus + transducer.face_mm[1]) / row_mm)
        if row < v + height:
            cv2.drawMarker(screen, (right + 30, row), TEXT, cv2.MARKER_TRIANGLE_UP, 8)
    return screen


def _write(screen: Grey, text: str, u: int, v: int) -> None:
    cv2.putText(screen, text, (u, v), cv2.FONT_HERSHEY_SIMPLEX, 0.42, TEXT, 1, cv2.LINE_AA)
