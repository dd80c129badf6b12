"""Calibrations written for other programs: Kalibr, ROS, mrcal and SLStudio, as `recon.capture.camera_dialects` reads them.

A device that is more than a dialect can say is refused by the first value that has no place.
"""

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from recon.capture.camera_dialects import MM, MRCAL, SLSTUDIO_SIZES, pinhole
from recon.errors import InputError
from recon.files import opencv_storage
from recon.geometry import rigid
from recon.geometry.camera import Array, Camera
from recon.geometry.camera_jacobian import DISTORTION
from recon.model.calibration import WORLD, Calibration

LEAST_FORWARD = 0.1  # cosine


def write_kalibr(folder: Path, optics: Calibration) -> list[str]:
    """Write all devices as `camchain.yaml`, in the order of the calibration; returns the file's name."""
    lines, before = [], np.eye(4)
    for number, (name, camera) in enumerate(optics.cameras.items()):
        k = _coefficients(name, camera, (4,), "Kalibr's radtan", "decentred")
        lines += [f"cam{number}:"]
        if number:
            lines += [
                "  T_cn_cnm1:",
                *(f"  - {_row(row)}" for row in _in_metres(camera.camera_from_world @ rigid.invert(before))),
            ]
        lines += [
            f"  cam_overlaps: {[other for other in range(len(optics.cameras)) if other != number]}",
            "  camera_model: pinhole",
            f"  distortion_coeffs: {_row(k)}",
            "  distortion_model: radtan",
            f"  intrinsics: {_row(_core(name, camera))}",
            f"  resolution: {list(camera.size)}",
            f"  rostopic: /{name}/image_raw",
        ]
        before = camera.camera_from_world
    return [_write(folder / "camchain.yaml", lines)]


def write_ros(folder: Path, optics: Calibration) -> list[str]:
    """Write camera 1 and one other device, `NAME.yaml` each, with their rectification as a pair; returns the files' names."""
    names = pair(optics)
    cameras = [optics.cameras[name] for name in names]
    written = []
    for name, camera, (rotation, projection) in zip(names, cameras, _rectified(cameras), strict=True):
        k = _coefficients(name, camera, (5, 8), "ROS's rational_polynomial", "rational")
        _core(name, camera)
        lines = [f"image_width: {camera.size[0]}", f"image_height: {camera.size[1]}", f"camera_name: {name}"]
        lines += _matrix("camera_matrix", camera.matrix)
        lines += [f"distortion_model: {'plumb_bob' if k.size == 5 else 'rational_polynomial'}"]
        lines += _matrix("distortion_coefficients", k[None])
        lines += _matrix("rectification_matrix", rotation) + _matrix("projection_matrix", projection)
        written.append(_write(folder / f"{name}.yaml", lines))
    return written


def write_mrcal(folder: Path, optics: Calibration) -> list[str]:
    """Write each device as `NAME.cameramodel`, with camera 1 as the reference; returns the files' names."""
    written = []
    for name, camera in optics.cameras.items():
        k = _coefficients(name, camera, (0, 4, 5, 8, 12), "mrcal's LENSMODEL_OPENCV12", "thin_prism")
        model = next(model for model, count in MRCAL.items() if count == k.size)
        pose = camera.camera_from_world
        motion = np.concatenate([Rotation.from_matrix(pose[:3, :3]).as_rotvec(), pose[:3, 3] / MM])
        lines = ["{", f"    'lensmodel': 'LENSMODEL_{model}',", "", "    # fx fy cx cy in px, then OpenCV's coefficients"]
        lines += [
            f"    'intrinsics': {_row([*_core(name, camera), *k])},",
            "",
            "    # rt_cam_ref: axis times angle in rad, shift in m",
        ]
        lines += [f"    'extrinsics': {_row(motion)},", "", f"    'imagersize': {list(camera.size)},", "}"]
        written.append(_write(folder / f"{name}.cameramodel", lines))
    return written


def write_slstudio(folder: Path, optics: Calibration) -> list[str]:
    """Write camera 1 and the projector as `calibration.xml`; returns the file's name."""
    if not {"cam1", "projector"} <= optics.cameras.keys():
        raise InputError(f"layout: expected cam1 and projector for SLStudio, found {', '.join(optics.cameras)}")
    camera, projector = optics.cameras["cam1"], optics.cameras["projector"]
    pose = projector.camera_from_world @ rigid.invert(camera.camera_from_world)
    lenses = {name: _coefficients(name, optics.cameras[name], (5,), "SLStudio", "brown") for name in ("cam1", "projector")}
    storage = cv2.FileStorage(".xml", cv2.FileStorage_WRITE | cv2.FileStorage_MEMORY)
    values = {"Kc": camera.matrix, "kc": lenses["cam1"], "Kp": projector.matrix, "kp": lenses["projector"]}
    for key, value in (values | {"Rp": pose[:3, :3], "Tp": pose[:3, 3]}).items():
        storage.write(key, np.ascontiguousarray(value if value.ndim == 2 else value[:, None]))
    for key in ("cam_error", "proj_error", "stereo_error"):
        storage.write(key, 0.0)  # which nobody knows here
    for device, keys in SLSTUDIO_SIZES.items():
        for key, side in zip(keys, optics.cameras[device].size, strict=True):
            storage.write(key, int(side))
    opencv_storage.save(folder / "calibration.xml", storage)
    return ["calibration.xml"]


WRITERS: dict[str, Callable[[Path, Calibration], list[str]]] = {
    "kalibr": write_kalibr,
    "ros": write_ros,
    "mrcal": write_mrcal,
    "slstudio": write_slstudio,
}


def taken(layout: str, optics: Calibration) -> Sequence[str]:
    """Names of the devices that a layout has a place for."""
    if layout == "slstudio":
        return [name for name in optics.cameras if name in ("cam1", "projector")]
    return pair(optics) if layout == "ros" else list(optics.cameras)


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
    for turn, camera in zip(turns, cameras, strict=True):
        middle = turn @ np.linalg.solve(camera.matrix, np.append((np.array(camera.size) - 1) / 2, 1))
        seen += [middle[:2] / middle[2]] if middle[2] > LEAST_FORWARD else []
    centre = (np.array(cameras[0].size) - 1) / 2 - focal * np.mean(seen or [np.zeros(2)], axis=0)
    plain = np.column_stack([pinhole(focal, focal, *centre), np.zeros(3)])
    moved = plain + np.pad(focal * shift[:, None], ((0, 0), (3, 0)))
    return list(zip(turns, (plain, moved), strict=False))


def _coefficients(name: str, camera: Camera, counts: Sequence[int], model: str, ours: str) -> Array:
    """A device's coefficients, cut or filled up to the least number of those that a dialect has.

    Raises InputError if it has more.
    """
    k = np.trim_zeros(camera.distortion, "b")
    count = next((count for count in counts if count >= k.size), None)
    if count is None:
        beyond = next(index for index in range(counts[-1], k.size) if k[index])
        raise InputError(
            f"calibration: {name}.distortion: expected {' '.join(DISTORTION[: counts[-1]])} alone, all that {model} has, "
            f"found {DISTORTION[beyond]} = {k[beyond]:.4g}: calibrate-optics distortion={ours} does without"
        )
    return np.pad(k, (0, count - k.size))


def _core(name: str, camera: Camera) -> list[float]:
    """Focal lengths and centre; raises InputError if the axes of the image are skew, for which there is no place."""
    if camera.matrix[0, 1]:
        raise InputError(
            f"calibration: {name}.matrix: expected no skew, for which the layout has no place, found {camera.matrix[0, 1]:g}"
        )
    return [camera.matrix[0, 0], camera.matrix[1, 1], camera.matrix[0, 2], camera.matrix[1, 2]]


def _in_metres(pose: Array) -> Array:
    return rigid.transform(pose[:3, :3], pose[:3, 3] / MM)


def _row(numbers: Iterable[float]) -> str:
    """Numbers with all digits, with a point, by which YAML knows `1e-05` for a number."""
    return f"[{', '.join(_digits(float(number)) for number in numbers)}]"


def _digits(number: float) -> str:
    text = repr(number)
    return text if "." in text or "e" not in text else text.replace("e", ".0e")


def _matrix(name: str, values: Array) -> list[str]:
    return [f"{name}:", f"  rows: {values.shape[0]}", f"  cols: {values.shape[1]}", f"  data: {_row(values.ravel())}"]


def _write(path: Path, lines: Sequence[str]) -> str:
    path.write_text("\n".join(["# written by sonotwin", *lines, ""]), encoding="utf-8")
    return path.name
