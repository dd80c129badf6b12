"""ROS's camera_info: a YAML file a camera; the pose of a pair follows from the rectifications, in m."""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from recon.capture import camera_dialects, camera_exports
from recon.capture.calibration_dialects import kalibr
from recon.capture.camera_dialects import MM, Content, Sizes, Stored
from recon.errors import InputError, brief
from recon.files import yaml_text
from recon.geometry import rigid
from recon.geometry.camera import Array, Camera
from recon.model.calibration import WORLD, Calibration

TOLD_BY = "a file of ROS"
ROS = {"plumb_bob": (4, 5), "rational_polynomial": (8,)}


class _Rectified(NamedTuple):
    """A camera of ROS's: its rectification, too."""

    stored: Stored
    rotation: Array  # (3, 3)
    projection: Array  # (3, 4), px and px m


def recognises(content: Content) -> bool:
    """Whether a file of the folder, or the file itself, has a camera's matrix."""
    return bool(content.of_cameras(_is_camera_info))


def read(content: Content, sizes: Sizes) -> Calibration:
    """A camera, or a pair of them by their rectification."""
    texts = content.of_cameras(_is_camera_info)
    if not content.path.is_dir():
        (text,) = texts.values()
        return camera_dialects.of_metres(content.path, {WORLD: _ros(content.path, text).stored})
    return camera_dialects.of_metres(content.path, _pair(content.path, texts))


def taken(optics: Calibration) -> Sequence[str]:
    """Camera 1 and one other."""
    return pair(optics)


def _is_camera_info(text: str) -> bool:
    """Whether a text has a camera's matrix, and is no camchain."""
    return re.search(r"^camera_matrix\s*:", text, re.MULTILINE) is not None and not kalibr.is_camchain(text)


def write(folder: Path, optics: Calibration) -> list[str]:
    """Write camera 1 and one other device, `NAME.yaml` each, with their rectification as a pair; returns the files' names."""
    names = pair(optics)
    cameras = [optics.cameras[name] for name in names]
    written = []
    for name, camera, (rotation, projection) in zip(names, cameras, _rectified(cameras), strict=True):
        k = camera_exports.coefficients(name, camera, (5, 8), "ROS's rational_polynomial", "rational")
        camera_exports.core(name, camera)
        lines = [f"image_width: {camera.size[0]}", f"image_height: {camera.size[1]}", f"camera_name: {name}"]
        lines += camera_exports.matrix("camera_matrix", camera.matrix)
        lines += [f"distortion_model: {'plumb_bob' if k.size == 5 else 'rational_polynomial'}"]
        lines += camera_exports.matrix("distortion_coefficients", k[None])
        lines += camera_exports.matrix("rectification_matrix", rotation) + camera_exports.matrix("projection_matrix", projection)
        written.append(camera_exports.write(folder / f"{name}.yaml", lines))
    return written


def pair(optics: Calibration) -> list[str]:
    """Camera 1 and one other device: camera 2, or else the projector."""
    return [name for name in optics.cameras if name in (WORLD, "cam2" if "cam2" in optics.cameras else "projector")]


def _rectified(cameras: Sequence[Camera]) -> list[tuple[Array, Array]]:
    """Rectification : (3, 3) and projection : (3, 4) px, px m of one camera, or of both of a pair.

    Both look along the mean of their axes, made square to the line between them, which is the x axis, or the y axis of a pair
    that stands one above the other; the second's shift is along it. The focal length is the smaller one, and the middles of both
    images fall around the middle.
    """
    focal = min(camera.matrix[1, 1] for camera in cameras)
    turns, shift = [np.eye(3)], np.zeros(3)
    if len(cameras) == 2:
        first, second = cameras
        pose = second.camera_from_world @ rigid.invert(first.camera_from_world)
        between = rigid.invert(pose)[:3, 3]  # the second's place in the first's frame
        axis = int(abs(between[1]) > abs(between[0]))
        along = between * np.sign(between[axis]) / np.linalg.norm(between)
        forward = np.array([0, 0, 1]) + pose[2, :3]
        forward -= along * (along @ forward)
        forward /= np.linalg.norm(forward)
        rows = [along, np.cross(forward, along), forward] if axis == 0 else [np.cross(along, forward), along, forward]
        turns = [np.array(rows), np.array(rows) @ pose[:3, :3].T]
        shift[axis] = -(along @ between) / MM
    seen = []  # at the middles of the images, turned; of devices that look aside of the common view, none
    least_forward = 0.1  # cosine
    for turn, camera in zip(turns, cameras, strict=True):
        middle = turn @ np.linalg.solve(camera.matrix, np.append((np.array(camera.size) - 1) / 2, 1))
        seen += [middle[:2] / middle[2]] if middle[2] > least_forward else []
    centre = (np.array(cameras[0].size) - 1) / 2 - focal * np.mean(seen or [np.zeros(2)], axis=0)
    plain = np.column_stack([camera_dialects.pinhole(focal, focal, *centre), np.zeros(3)])
    moved = plain + np.pad(focal * shift[:, None], ((0, 0), (3, 0)))
    return list(zip(turns, (plain, moved), strict=False))


def _pair(folder: Path, texts: Mapping[Path, str]) -> dict[str, Stored]:
    """Devices of a folder's files by the rectification of a pair."""
    names = camera_dialects.devices(folder, [file.stem for file in texts])
    cameras = {name: _ros(file, text) for name, (file, text) in zip(names, texts.items(), strict=True)}
    if len(cameras) > 2:
        raise InputError(
            f"{folder}: expected files of ROS of one pair, found {len(cameras)}: {', '.join(file.name for file in texts)}"
        )
    (first, one), *others = cameras.items()
    found = {first: one.stored}
    for name, other in others:
        focal = np.array([other.projection[0, 0], other.projection[1, 1]])
        if not (focal > 0).all():
            raise InputError(f"{folder}: projection_matrix: expected positive focal lengths of {name}, found {focal.tolist()}")
        shift = (other.projection[:2, 3] - one.projection[:2, 3]) / focal
        if not shift.any():
            raise InputError(
                f"{folder}: projection_matrix: expected those of a pair calibrated together, the second's with a shift in its "
                "last column, found none: which of both is where isn't in these files"
            )
        pose = rigid.transform(other.rotation.T @ one.rotation, other.rotation.T @ np.append(shift, 0) * MM)
        found[name] = other.stored._replace(camera_from_world=pose)
    return camera_dialects.in_world(found)


def _ros(path: Path, text: str) -> _Rectified:
    content = yaml_text.loaded(path, text)
    if not isinstance(content, dict):
        raise InputError(f"{path}: expected a camera's fields, found {brief(content)}")
    model = content.get("distortion_model")
    counts = ROS.get(model) if isinstance(model, str) else None
    if counts is None:
        raise InputError(f"{path}: distortion_model: expected {' or '.join(ROS)}, found {brief(model)}")
    size = camera_dialects.image_size(
        path, "image_width and image_height", [content.get("image_width"), content.get("image_height")]
    )
    k = _entries(path, content, "distortion_coefficients")
    if k.size not in counts:
        raise InputError(f"{path}: distortion_coefficients: expected {counts[-1]} of {model}, found {k.size}")
    matrix = _entries(path, content, "camera_matrix", (3, 3))
    rotation = _entries(path, content, "rectification_matrix", (3, 3)) if "rectification_matrix" in content else np.eye(3)
    if fault := rigid.fault(rigid.transform(rotation, np.zeros(3))):
        raise InputError(f"{path}: rectification_matrix: expected a rotation, found {fault}")
    projection = np.column_stack([matrix, np.zeros(3)])
    if "projection_matrix" in content:
        projection = _entries(path, content, "projection_matrix", (3, 4))
    return _Rectified(Stored(size, matrix, k, np.eye(4)), rotation, projection)


def _entries(path: Path, content: Mapping[str, Any], name: str, shape: tuple[int, ...] | None = None) -> Array:
    """A matrix of ROS's, a map of rows, cols and data."""
    value = content.get(name)
    data = value.get("data") if isinstance(value, dict) else None
    numbers = camera_dialects.numbers(path, name, data, None if shape is None else int(np.prod(shape)))
    return numbers if shape is None else numbers.reshape(shape)
