"""mrcal's cameramodel: a file a camera, a Python dictionary, in m, of LENSMODEL_PINHOLE and LENSMODEL_OPENCV4, 5, 8 and 12."""

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from recon.capture import camera_dialects, camera_exports
from recon.capture.camera_dialects import MM, NUMBER, Content, Sizes, Stored, pinhole
from recon.errors import InputError, brief
from recon.geometry import rigid
from recon.geometry.camera import Array
from recon.model.calibration import WORLD, Calibration

TOLD_BY = "a file of mrcal"
MRCAL = {"PINHOLE": 0, "OPENCV4": 4, "OPENCV5": 5, "OPENCV8": 8, "OPENCV12": 12}  # coefficients by the model's name
LISTED = re.compile(rf"\[\s*(?:{NUMBER}\s*(?:,\s*{NUMBER}\s*)*,?\s*)?\]")


def recognises(content: Content) -> bool:
    """Whether a file of the folder, or the file itself, names a lens model."""
    return bool(content.of_cameras(_is_model))


def read(content: Content, sizes: Sizes) -> Calibration:
    """All devices, a file each, by their poses."""
    texts = content.of_cameras(_is_model)
    if not content.path.is_dir():
        (text,) = texts.values()
        return camera_dialects.of_metres(content.path, camera_dialects.in_world({WORLD: _mrcal(content.path, text)}))
    names = camera_dialects.devices(content.path, [file.stem for file in texts])
    found = {name: _mrcal(file, text) for name, (file, text) in zip(names, texts.items(), strict=True)}
    return camera_dialects.of_metres(content.path, camera_dialects.in_world(found))


def taken(optics: Calibration) -> Sequence[str]:
    """All devices."""
    return list(optics.cameras)


def _is_model(text: str) -> bool:
    """Whether a text names a lens model as mrcal's files do."""
    return re.search(r"""^[ \t]*(?:\{[ \t]*)?['"]lens_?model['"]\s*:""", text, re.MULTILINE) is not None


def write(folder: Path, optics: Calibration) -> list[str]:
    """Write each device as `NAME.cameramodel`, with camera 1 as the reference; returns the files' names."""
    written = []
    for name, camera in optics.cameras.items():
        k = camera_exports.coefficients(name, camera, (0, 4, 5, 8, 12), "mrcal's LENSMODEL_OPENCV12", "thin_prism")
        model = next(model for model, count in MRCAL.items() if count == k.size)
        pose = camera.camera_from_world
        motion = np.concatenate([Rotation.from_matrix(pose[:3, :3]).as_rotvec(), pose[:3, 3] / MM])
        lines = ["{", f"    'lensmodel': 'LENSMODEL_{model}',", "", "    # fx fy cx cy in px, then OpenCV's coefficients"]
        lines += [
            f"    'intrinsics': {camera_exports.row([*camera_exports.core(name, camera), *k])},",
            "",
            "    # rt_cam_ref: axis times angle in rad, shift in m",
        ]
        lines += [f"    'extrinsics': {camera_exports.row(motion)},", "", f"    'imagersize': {list(camera.size)},", "}"]
        written.append(camera_exports.write(folder / f"{name}.cameramodel", lines))
    return written


def _mrcal(path: Path, text: str) -> Stored:
    """A file's dictionary isn't evaluated: of its values only these are read."""
    plain = re.sub(r"^\s*#.*$", "", text, flags=re.MULTILINE)
    found = re.findall(r"""['"]lens_?model['"]\s*:\s*['"]([^'"]*)['"]""", plain)
    model = found[0].removeprefix("LENSMODEL_") if len(found) == 1 else ""
    if model not in MRCAL:
        expected = ", ".join(f"LENSMODEL_{name}" for name in MRCAL)
        raise InputError(
            f"{path}: lensmodel: expected one of {expected}, found {brief(', '.join(found))}: mrcal-convert-lensmodel makes one"
        )
    fx, fy, cx, cy, *k = _listed(path, plain, "intrinsics", 4 + MRCAL[model])
    width, height = _listed(path, plain, "imagersize", 2)
    motion = _listed(path, plain, "rt_cam_ref|extrinsics", 6)
    pose = rigid.from_rotation_vector(motion[:3], motion[3:] * MM)
    return Stored(
        camera_dialects.image_size(path, "imagersize", [width, height]), pinhole(fx, fy, cx, cy), np.array(k, float), pose
    )


def _listed(path: Path, text: str, key: str, count: int) -> Array:
    """Numbers : (count,) of a list in a Python dictionary."""
    name = key.rpartition("|")[2]
    places = list(re.finditer(rf"""['"](?:{key})['"]\s*:\s*""", text))
    found = LISTED.match(text, places[0].end()) if len(places) == 1 else None
    if found is None:
        raise InputError(f"{path}: {name}: expected a list of numbers once, found {'something else' if places else 'none'}")
    return camera_dialects.numbers(path, name, [float(number) for number in re.findall(NUMBER, found[0])], count)
