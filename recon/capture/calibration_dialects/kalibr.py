"""Kalibr's camchain: `cam0`, `cam1`, ... of one YAML file, in m, with `pinhole` and `radtan` or `none`."""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from recon.capture import camera_dialects, camera_exports
from recon.capture.camera_dialects import MM, Content, Sizes, Stored, pinhole
from recon.errors import InputError, brief
from recon.files import yaml_text
from recon.geometry import rigid
from recon.model.calibration import Calibration

TOLD_BY = "a file of Kalibr"


def recognises(content: Content) -> bool:
    """Whether a camera begins the text."""
    return not content.path.is_dir() and any(map(is_camchain, content.texts().values()))


def is_camchain(text: str) -> bool:
    """Whether cameras are numbered in a text as Kalibr does."""
    return re.search(r"^cam\d+\s*:", text, re.MULTILINE) is not None


def read(content: Content, sizes: Sizes) -> Calibration:
    """All cameras of the chain."""
    (text,) = content.texts().values()
    return camera_dialects.of_metres(content.path, _stored(content.path, yaml_text.loaded(content.path, text)))


def taken(optics: Calibration) -> Sequence[str]:
    """All devices."""
    return list(optics.cameras)


def write(folder: Path, optics: Calibration) -> list[str]:
    """Write all devices as `camchain.yaml`, in the order of the calibration; returns the file's name."""
    lines, before = [], np.eye(4)
    for number, (name, camera) in enumerate(optics.cameras.items()):
        k = camera_exports.coefficients(name, camera, (4,), "Kalibr's radtan", "decentred")
        lines += [f"cam{number}:"]
        if number:
            lines += [
                "  T_cn_cnm1:",
                *(
                    f"  - {camera_exports.row(row)}"
                    for row in camera_exports.in_metres(camera.camera_from_world @ rigid.invert(before))
                ),
            ]
        lines += [
            f"  cam_overlaps: {[other for other in range(len(optics.cameras)) if other != number]}",
            "  camera_model: pinhole",
            f"  distortion_coeffs: {camera_exports.row(k)}",
            "  distortion_model: radtan",
            f"  intrinsics: {camera_exports.row(camera_exports.core(name, camera))}",
            f"  resolution: {list(camera.size)}",
            f"  rostopic: /{name}/image_raw",
        ]
        before = camera.camera_from_world
    return [camera_exports.write(folder / "camchain.yaml", lines)]


def _stored(path: Path, content: Any) -> dict[str, Stored]:
    entries = {
        key: value for key, value in (content if isinstance(content, dict) else {}).items() if re.fullmatch(r"cam\d+", str(key))
    }
    ordered = sorted(entries, key=lambda key: int(key[3:]))
    if ordered != [f"cam{k}" for k in range(len(ordered))] or not ordered:
        raise InputError(f"{path}: expected cam0, cam1 and so on, found {', '.join(ordered) or 'none'}")
    topics, stored, pose = [], [], np.eye(4)
    for number, key in enumerate(ordered):
        entry = entries[key]
        if not isinstance(entry, dict):
            raise InputError(f"{path}: {key}: expected a camera's fields, found {brief(entry)}")
        model, lens = entry.get("camera_model"), entry.get("distortion_model")
        if model != "pinhole" or lens not in ("radtan", "none"):
            raise InputError(
                f"{path}: {key}: expected camera_model: pinhole with distortion_model: radtan or none, found {brief(model)} with "
                f"{brief(lens)}: calibrate with --models pinhole-radtan"
            )
        fx, fy, cx, cy = camera_dialects.numbers(path, f"{key}.intrinsics", entry.get("intrinsics"), 4)
        k = camera_dialects.numbers(
            path, f"{key}.distortion_coeffs", entry.get("distortion_coeffs"), 4 if lens == "radtan" else None
        )
        if number:
            rows = entry.get("T_cn_cnm1")
            motion = [camera_dialects.numbers(path, f"{key}.T_cn_cnm1", row, 4) for row in rows] if isinstance(rows, list) else []
            if len(motion) != 4:
                raise InputError(f"{path}: {key}.T_cn_cnm1: expected 4 rows of 4 numbers, found {brief(rows)}")
            pose = np.array(motion) * np.array([[1, 1, 1, MM]] * 3 + [[1, 1, 1, 1]]) @ pose
        size = camera_dialects.image_size(path, f"{key}.resolution", entry.get("resolution"))
        topics.append(str(entry.get("rostopic") or ""))
        stored.append(Stored(size, pinhole(fx, fy, cx, cy), k if lens == "radtan" else np.zeros(0), pose))
    return camera_dialects.in_world(dict(zip(camera_dialects.devices(path, topics), stored, strict=True)))
