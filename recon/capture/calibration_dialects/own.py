"""sonotwin's own `optics.yaml`: OpenCV FileStorage YAML.

For every device a map of `size`, `matrix`, `distortion` and `camera_from_world`; and, if known, `parameters`, their names,
`covariance`, and `has_scale`, whether the error of the board's scale is in it: 0 or 1.
"""

from collections.abc import Mapping
from pathlib import Path

from recon.capture import camera_dialects
from recon.capture.camera_dialects import Content, Sizes
from recon.errors import InputError, short
from recon.files import opencv_storage
from recon.files.opencv_storage import Values
from recon.geometry.camera import Camera
from recon.geometry.camera_jacobian import DISTORTION, MATRIX, MOTION
from recon.model.calibration import WORLD, Calibration, Uncertainty
from recon.model.lengths import UNIT_KEY

TOLD_BY = "schema"
HAS_SCALE = "has_scale"
SCHEMA = "sonotwin-optics/1"


def recognises(content: Content) -> bool:
    """Whether the content names its schema."""
    return "schema" in content.values


def read(content: Content, sizes: Sizes) -> Calibration:
    """All devices, with their covariance."""
    return camera_dialects.of_mm(content, _calibration(content.path, content.values))


def _calibration(path: Path, values: Values) -> Calibration:
    if values["schema"] != SCHEMA:
        found = short(values["schema"]) if isinstance(values["schema"], str) else "a value that is no text"
        raise InputError(f"{path}: schema: expected {SCHEMA}, found {found}")
    cameras = {}
    own_keys = ("schema", "parameters", "covariance", HAS_SCALE, UNIT_KEY)  # any other is a device
    for name in [name for name in values if name not in own_keys]:
        device = values[name]
        if not isinstance(device, dict):
            raise InputError(f"{path}: {name}: expected size, matrix, distortion and camera_from_world, found something else")
        matrix, distortion, pose = (
            opencv_storage.matrix(path, f"{name}.{key}", device.get(key)) for key in ("matrix", "distortion", "camera_from_world")
        )
        size = device.get("size")
        if not isinstance(size, list) or len(size) != 2 or not all(isinstance(side, int) and side > 0 for side in size):
            raise InputError(f"{path}: {name}.size: expected width and height in px, found something else")
        cameras[name] = camera_dialects.camera(path, name, (size[0], size[1]), matrix, distortion, pose)
    if not cameras:
        raise InputError(f"{path}: expected at least one device, found none")
    return Calibration(cameras, _uncertainty(path, values, cameras))


def _uncertainty(path: Path, values: Values, cameras: Mapping[str, Camera]) -> Uncertainty | None:
    names = opencv_storage.names(values)
    if names is None:
        return None
    if not names:
        raise InputError(f"{path}: parameters: expected names of the covariance's parameters, found something else")
    known = {f"{device}.{name}" for device in cameras for name in MATRIX + DISTORTION + (MOTION if device != WORLD else ())}
    wrong = next((name for k, name in enumerate(names) if name not in known or name in names[:k]), None)
    if wrong is not None:
        raise InputError(f"{path}: parameters: expected a device's parameter like projector.fx, each once, found {short(wrong)}")
    has_scale = values.get(HAS_SCALE, 0)
    if not isinstance(has_scale, int) or has_scale not in (0, 1):
        raise InputError(f"{path}: {HAS_SCALE}: expected 0 or 1, found {short(str(has_scale))}")
    return Uncertainty(names, opencv_storage.covariance(path, values, len(names)), bool(has_scale))
