"""A matrix of 4 x 4 numbers from pixels to mm, as text.

Its first two columns are as long as mm/px. Axes that aren't square, by up to some degrees, are taken as such, with a warning.
"""

from pathlib import Path

import numpy as np

from recon.capture.probe_values import of_matrix
from recon.files import opencv_storage
from recon.files.regular import read_bytes
from recon.geometry.rigid import Array
from recon.model.probe import ProbeCalibration

SEPARATORS = bytes.maketrans(b",;[]()", b"      ")


def recognises(path: Path) -> bool:
    """Whether it is a text of 16 numbers."""
    return numbers(read_bytes(path, opencv_storage.MOST_BYTES, "a probe's calibration")) is not None


def read(path: Path, speed_m_s: float | None = None) -> ProbeCalibration:
    """Read it, with the speed of sound for which it holds."""
    matrix = numbers(read_bytes(path))
    assert matrix is not None  # as recognised
    return of_matrix(path, "matrix", matrix, speed_m_s)


def numbers(text: bytes) -> Array | None:
    """The matrix (4, 4) of a text; None of any that isn't 16 numbers."""
    words = text.translate(SEPARATORS).split()
    try:
        return np.array([float(word) for word in words]).reshape(4, 4) if len(words) == 16 else None
    except ValueError:
        return None
