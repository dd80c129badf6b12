"""The PLUS toolkit's configuration files: the calibration of the probe, and the settings of a sequence's reconstruction."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np
from numpy.typing import NDArray

from recon.errors import InputError
from recon.files import medical_images, xml_text
from recon.files.medical_images import fault
from recon.freehand import scans as freehand_scans
from recon.freehand import sequences
from recon.freehand.plus_arithmetic import Arithmetic
from recon.freehand.scans import VolumeSettings
from recon.freehand.sequences import FrameNames
from recon.freehand.volume_compounding import Clip, Compounding, Interpolation, Reconstruction
from recon.model.fan import Fan

Array = NDArray[np.float64]

COMPOUNDING: dict[str, Compounding] = {"MEAN": "mean", "MAXIMUM": "maximum", "LATEST": "latest", "IMPORTANCE_MASK": "weighted"}
INTERPOLATION: dict[str, Interpolation] = {"NEAREST_NEIGHBOR": "nearest", "LINEAR": "linear"}
ARITHMETIC: dict[str, Arithmetic] = {"FULL": "plus_full", "PARTIAL": "plus_partial", "NONE": "plus_none"}
EARLIER = {"WEIGHTED_AVERAGE": "MEAN", "MAXIMUM": "MAXIMUM"}
SWITCH = {"ON": True, "TRUE": True, "OFF": False, "FALSE": False}


@dataclass(frozen=True)
class PlusConfig:
    """The parts of a configuration on coordinates and on the reconstruction."""

    path: Path
    transforms: dict[str, Array]  # "ImageToProbe": (4, 4), mm and px
    names: FrameNames = field(default_factory=FrameNames)  # those of image and reference that the reconstruction names
    volume: VolumeSettings | None = None  # along the reference frame's axes; None where there is no reconstruction


def read_config(path: Path) -> PlusConfig:
    """Read the elements CoordinateDefinitions and VolumeReconstruction of a PLUS configuration; others are left alone.

    Raises
    ------
    InputError
        If the file is missing or has neither, or has settings unknown here: another way of compounding or of filling holes.
    """
    path = Path(path)
    root = xml_text.read(path)
    transforms = _transforms(path, root)
    element = root if root.tag == "VolumeReconstruction" else root.find(".//VolumeReconstruction")
    if element is None and not transforms:
        raise fault(path, root.tag, "an element VolumeReconstruction or CoordinateDefinitions with a Transform", "neither")
    if element is None:
        return PlusConfig(path, transforms)
    usual = FrameNames()
    image, reference = (element.get(f"{name}CoordinateFrame", name) for name in (usual.image, usual.reference))
    names = FrameNames(image, usual.target, reference)
    return PlusConfig(path, transforms, names, replace(_volume(path, element), fan=_fan(path, element)))


def reconstruct_sequence(path: Path, config: PlusConfig) -> tuple[Reconstruction, Reconstruction]:
    """Reconstruct a sequence file by its configuration, reading the images one by one; as usual here where it has no settings.

    Returns
    -------
    Reconstruction, Reconstruction
        Before its holes are filled, and after; the same without filling.
    """
    scans = freehand_scans.of_sequence(path, config.names, fixed=config.transforms)
    try:
        return freehand_scans.volume(scans, config.volume or VolumeSettings())
    except InputError as error:
        raise error if str(error).startswith(str(path)) else InputError(f"{path}: {error}") from None


def _transforms(path: Path, root: Element) -> dict[str, Array]:
    transforms = {}
    for element in root.iterfind(".//CoordinateDefinitions/Transform"):
        name = f"{_text(path, element, 'From')}To{_text(path, element, 'To')}"
        matrix = medical_images.numbers(path, name, _text(path, element, "Matrix"), 16).reshape(4, 4)
        if not sequences.is_usable(matrix):
            raise fault(
                path, name, "an invertible matrix with the last row 0 0 0 1", repr(" ".join(element.get("Matrix", "").split()))
            )
        transforms[name] = matrix
    return transforms


def _fan(path: Path, element: Element) -> Fan | None:
    """The fan-shaped clip; None where both angles are 0. PLUS may look for narrower ones in each image."""
    left, right = sorted(_numbers(path, element, ("FanAnglesDeg", "FanAngles"), [0, 0]))
    if left == right == 0:
        return None
    u, v = _numbers(path, element, ("FanOriginPixel", "FanOrigin"), [0, 0])
    (first,) = _numbers(path, element, ("FanRadiusStartPixel",), [0])
    fan_radius_stop = 500.0  # px, as PLUS has it where none is given
    (last,) = _numbers(path, element, ("FanRadiusStopPixel", "FanDepth"), [fan_radius_stop])
    try:
        return Fan(u, v, first, last, left, right)
    except ValueError as error:
        raise InputError(f"{path}: Fan: {error}") from None


def _numbers(path: Path, element: Element, names: Sequence[str], usual: list[float]) -> list[float]:
    """Numbers of an attribute, by its name or an earlier one; the usual ones where there is none."""
    name = next((name for name in names if element.get(name)), None)
    return usual if name is None else medical_images.numbers(path, name, _text(path, element, name), len(usual)).tolist()


def _volume(path: Path, element: Element) -> VolumeSettings:
    spacing = medical_images.numbers(path, "OutputSpacing", _text(path, element, "OutputSpacing"), 3)
    if spacing.min() <= 0:
        raise fault(path, "OutputSpacing", "3 lengths above 0", repr(element.get("OutputSpacing")))
    interpolation = INTERPOLATION[_choice(path, element, "Interpolation", "NEAREST_NEIGHBOR", INTERPOLATION)]
    compounding = COMPOUNDING[_choice(path, element, "CompoundingMode", _earlier_compounding(path, element), COMPOUNDING)]
    arithmetic = ARITHMETIC[_choice(path, element, "Optimization", "FULL", ARITHMETIC)]
    x, y, z = spacing.tolist()
    holes, clip = _sticks(path, element), _clip(path, element)
    weights = path.parent / _text(path, element, "ImportanceMaskFilename") if compounding == "weighted" else None
    return VolumeSettings((x, y, z), "aligned", compounding, interpolation, clip, *holes, None, arithmetic, weights)


def _earlier_compounding(path: Path, element: Element) -> str:
    """The compounding as configurations of before 2014 have it, by two attributes."""
    if _choice(path, element, "Calculation", "WEIGHTED_AVERAGE", EARLIER) == "MAXIMUM":
        return "MAXIMUM"
    return "MEAN" if SWITCH[_choice(path, element, "Compounding", "ON", SWITCH)] else "LATEST"


def _clip(path: Path, element: Element) -> Clip | None:
    if not element.get("ClipRectangleSize"):
        return None
    width, height = medical_images.whole_numbers(path, "ClipRectangleSize", _text(path, element, "ClipRectangleSize"), pieces=2)
    u, v = medical_images.whole_numbers(path, "ClipRectangleOrigin", element.get("ClipRectangleOrigin", "0 0"), pieces=2)
    return Clip(u, v, width + 1, height + 1) if width and height else None  # PLUS takes the pixels on both borders


def _sticks(path: Path, element: Element) -> tuple[int, int]:
    """Longest stick across a hole, 0 where holes stay open, and number of sticks."""
    if not SWITCH[_choice(path, element, "FillHoles", "OFF", SWITCH)]:
        return 0, 1
    rules = element.findall("HoleFilling/HoleFillingElement")
    if len(rules) != 1 or rules[0].get("Type") != "STICK":
        raise fault(
            path, "HoleFilling", "one element of type STICK", ", ".join(rule.get("Type", "?") for rule in rules) or "none"
        )
    (most,) = medical_images.whole_numbers(path, "StickLengthLimit", _text(path, rules[0], "StickLengthLimit"), 1, 1)
    (sticks,) = medical_images.whole_numbers(path, "NumberOfSticksToUse", rules[0].get("NumberOfSticksToUse", "1"), 1, 1)
    return most, sticks


def _choice(path: Path, element: Element, name: str, usual: str, known: dict) -> str:
    word = element.get(name, usual).upper()
    if word not in known:
        raise fault(path, name, f"one of {', '.join(known)}", word)
    return word


def _text(path: Path, element: Element, name: str) -> str:
    text = element.get(name)
    if text is None:
        raise fault(path, f"{element.tag}.{name}", "a value", "none")
    return text
