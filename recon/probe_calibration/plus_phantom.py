"""N-wires as a configuration of the PLUS toolkit defines them: `PhantomDefinition`, with the phantom's registration beside it."""

from dataclasses import dataclass
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np
from numpy.typing import NDArray

from recon.errors import InputError
from recon.files import medical_images, xml_text
from recon.files.medical_images import fault
from recon.geometry import rigid
from recon.model.wire_phantom import FCAL_2, WirePhantom

Array = NDArray[np.float64]

N_WIRE = "NWire"
ENDS = ("EndPointFront", "EndPointBack")
PHANTOM = "Phantom"


@dataclass(frozen=True)
class PlusPhantom:
    """A phantom, and what a configuration has on where it is and on the probe."""

    wires: WirePhantom
    reference_from_phantom: Array | None = None  # (4, 4) mm
    target_from_pixel: Array | None = None  # (4, 4) from px to mm, of a calibration that was there before


FCAL = PlusPhantom(WirePhantom(np.array(FCAL_2, float)))  # PLUS's phantom fCal 2


def read(path: Path, reference: str | None = None) -> PlusPhantom:
    """Read the wires, and the transforms from the phantom to a reference frame and from the image to the probe, if it has them.

    Raises
    ------
    InputError
        If the file is missing or broken, or defines no N-wires, or ones that can't be.
    """
    root = xml_text.read(path, "a configuration of the PLUS toolkit")
    patterns = list(root.iterfind(".//PhantomDefinition/Geometry/Pattern"))
    others = [each.get("Type", "none") for each in patterns if each.get("Type") != N_WIRE]
    if not patterns or others:
        found = f"one of type {others[0]}" if others else "none"
        raise fault(path, "PhantomDefinition", f"patterns of type {N_WIRE}", found)
    ends, names = [], []
    for number, pattern in enumerate(patterns, start=1):
        wires = pattern.findall("Wire")
        if len(wires) != 3:
            raise fault(path, f"Pattern {number}", "3 wires: a side, the diagonal, the other side", len(wires))
        ends.append([[_point(path, wire, end) for end in ENDS] for wire in wires])
        names += [wire.get("Name") or f"{number}{'abc'[k]}" for k, wire in enumerate(wires)]
    try:
        phantom = WirePhantom(np.array(ends), tuple(names))
    except ValueError as error:
        raise InputError(f"{path}: {error}") from None
    registered = None if reference is None else _transform(path, root, PHANTOM, reference)
    if registered is not None and (found := rigid.fault(registered)):
        raise fault(path, f"{PHANTOM}To{reference}", rigid.RIGID, found)
    return PlusPhantom(phantom, registered, _transform(path, root, "Image", "Probe"))


def _point(path: Path, wire: Element, name: str) -> Array:
    text = wire.get(name)
    if text is None:
        raise fault(path, f"Wire {wire.get('Name', '')}", f"{name}, three numbers in mm", "none")
    return medical_images.numbers(path, name, text, 3)


def _transform(path: Path, root: Element, source: str, destination: str) -> Array | None:
    """A transform of the configuration, or the inverse of its inverse; None where it has neither."""
    for element in root.iterfind(".//Transform"):
        ends = (element.get("From"), element.get("To"))
        if ends in ((source, destination), (destination, source)):
            name = "To".join(str(end) for end in ends)
            matrix = medical_images.numbers(path, name, element.get("Matrix", ""), 16).reshape(4, 4)
            if abs(np.linalg.det(matrix)) < 1e-12 or np.abs(matrix[3] - [0, 0, 0, 1]).max() > rigid.EXACT:
                raise fault(path, name, "an invertible matrix with the last row 0 0 0 1", element.get("Matrix"))
            return matrix if ends == (source, destination) else np.linalg.inv(matrix)
    return None
