"""Devices of a rig as they were calibrated: pinholes, lenses' distortion, and places."""

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation

from recon.estimation.covariance import root
from recon.geometry import rigid
from recon.geometry.camera import Camera
from recon.geometry.camera_jacobian import DISTORTION, MATRIX, MOTION
from recon.identification.estimates import Estimate, Findings
from recon.model.calibration import WORLD, Calibration, linearise, moved, with_scale
from recon.model.rig import DEVICES, Optics, OpticsCovariance, Pose, Rig
from recon.optical_calibration.joint_calibration import Result

Array = NDArray[np.float64]

SOURCE = "calibration by a board"


def with_devices(rig: Rig, calibration: Calibration) -> Rig:
    """The rig with its devices' optics as calibrated; cameras' nominal focal lengths follow by their pixels' size.

    What was measured of these optics before doesn't count any more; other devices keep their covariance, as if independent.
    """
    changed = {}
    for name, camera in calibration.cameras.items():
        if name not in DEVICES:
            continue
        device = getattr(rig, name)
        update: dict[str, object] = {"optics": optics_of(camera)}
        if name != "projector":
            length = float(camera.matrix[0, 0]) * device.sensor.pixel_um * 1e-3
            update["lens"] = device.lens.model_copy(update={"focal_length_mm": length})
        changed[name] = device.model_copy(update=update)
    known = {"optics_covariance": _covariance(calibration, rig)}
    return rig.unmeasured(*(f"{name}.optics" for name in changed)).model_copy(update=changed | known)


def _covariance(calibration: Calibration, rig: Rig) -> OpticsCovariance | None:
    """Covariance as the rig's description has it, the scale's error included, and that of devices which weren't calibrated."""
    before, blocks, names = rig.calibration().uncertainty, list[NDArray[np.float64]](), list[str]()
    known = None if calibration.uncertainty is None else with_scale(calibration.uncertainty, calibration.cameras, None)
    for part, devices in ((known, set(calibration.cameras)), (before, set(DEVICES) - set(calibration.cameras))):
        if part is not None:
            places = [k for k, name in enumerate(part.names) if name.partition(".")[0] in devices & set(DEVICES)]
            blocks.append(part.covariance[np.ix_(places, places)])
            names += [part.names[k] for k in places]
    if not names:
        return None
    rows = block_diag(*blocks).tolist()
    return OpticsCovariance(names=tuple(names), rows=tuple(tuple(row[: k + 1]) for k, row in enumerate(rows)))


def optics_of(camera: Camera) -> Optics:
    """A calibrated camera as the rig's description has it."""
    vector = np.rad2deg(Rotation.from_matrix(camera.camera_from_world[:3, :3]).as_rotvec())
    return Optics(
        size=camera.size,
        focal_px=(float(camera.matrix[0, 0]), float(camera.matrix[1, 1])),
        centre_px=(float(camera.matrix[0, 2]), float(camera.matrix[1, 2])),
        distortion=tuple(camera.distortion.tolist()),
        device_from_world=Pose(
            rotation_deg=tuple(vector.tolist()), translation_mm=tuple(camera.camera_from_world[:3, 3].tolist())
        ),
    )


def one_sigma_off(optics: Result) -> list[tuple[dict[str, Camera], Array]]:
    """Devices, and poses of the board : (p, 4, 4), that are one standard deviation off, along each axis of the covariance.

    The poses follow the devices, so that discs stay where they were seen, as well as that goes. None without a covariance.
    """
    adjusted, known = optics.adjustment, optics.adjustment.calibration.uncertainty
    if known is None:
        return []
    cameras, seen = adjusted.calibration.cameras, np.isfinite(adjusted.residuals).all(axis=-1)
    answers = list[Array]()  # (6, g) of each pose
    for pose, shown in zip(adjusted.poses, seen, strict=True):
        by_pose, by_device = list[Array](), list[Array]()
        for k, device in enumerate(optics.observations.devices):
            points = adjusted.points[shown[:, k]]
            slopes = linearise(cameras, device, rigid.apply(pose, points), known.names)
            by_pose.append((slopes.by_point @ rigid.slopes(rigid.rotate(pose, points))).reshape(-1, 6))
            by_device.append(slopes.by_parameter.reshape(-1, len(known.names)))
        answers.append(-np.linalg.lstsq(np.concatenate(by_pose), np.concatenate(by_device))[0])
    steps = root(known.covariance).T
    return [(moved(cameras, known.names, step), rigid.moved(adjusted.poses, np.stack(answers) @ step)) for step in steps]


def findings(calibration: Calibration) -> Findings:
    """Numbers of all devices with the standard deviations of the calibration; none if it has no covariance.

    A turn's standard deviation is that of its rotation vector, to first order in the turn.
    """
    known, found = calibration.uncertainty, dict[str, Estimate]()
    if known is None:
        return Findings(unknown={f"{name}.optics": "the calibration has no covariance" for name in calibration.cameras})
    for name, camera in calibration.cameras.items():
        optics = optics_of(camera)
        numbers: dict[str, tuple[tuple[str, ...], tuple[float, ...]]]
        numbers = {"focal_px": (MATRIX[:2], optics.focal_px), "centre_px": (MATRIX[2:], optics.centre_px)}
        numbers["distortion"] = (DISTORTION, optics.distortion)
        if name != WORLD:
            pose = optics.device_from_world
            numbers["device_from_world.translation_mm"] = (MOTION[3:], pose.translation_mm)
            numbers["device_from_world.rotation_deg"] = (MOTION[:3], pose.rotation_deg)
        for field, (parameters, values) in numbers.items():
            unit = np.rad2deg(1.0) if "rotation" in field else 1.0
            for k, (parameter, value) in enumerate(zip(parameters, values, strict=False)):
                if f"{name}.{parameter}" in known.names:
                    sigma = unit * known.sigma(f"{name}.{parameter}")
                    found[f"{name}.optics.{field}.{k}"] = Estimate(value, sigma, SOURCE)
    return Findings(found)
