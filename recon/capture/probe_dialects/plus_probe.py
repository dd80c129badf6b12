"""`ImageToProbe` in a configuration of the PLUS toolkit: a matrix from pixels to mm."""

from pathlib import Path

from recon.capture.probe_dialects.plain_matrix import numbers
from recon.capture.probe_values import of_matrix
from recon.errors import InputError, brief
from recon.files import opencv_storage, xml_text
from recon.files.regular import read_bytes
from recon.model.probe import ProbeCalibration

ENDS = ("Image", "Probe")


def recognises(path: Path) -> bool:
    """Whether it is XML, but not OpenCV's."""
    text = read_bytes(path, opencv_storage.MOST_BYTES, "a probe's calibration").lstrip()
    return text.startswith(b"<") and b"opencv_storage" not in text


def read(path: Path, speed_m_s: float | None = None) -> ProbeCalibration:
    """Read it, with the speed of sound for which it holds."""
    name, found = (
        "To".join(ENDS),
        [each for each in xml_text.read(path).iter("Transform") if (each.get("From"), each.get("To")) == ENDS],
    )
    if len(found) != 1:
        expected = f"one Transform from {' to '.join(ENDS)}, the probe's calibration"
        raise InputError(f"{path}: expected {expected}, found {len(found)}")
    text = found[0].get("Matrix") or ""
    if (matrix := numbers(text.encode())) is None:
        raise InputError(f"{path}: {name}: expected 16 numbers, found {brief(text)}")
    return of_matrix(path, name, matrix, speed_m_s)
