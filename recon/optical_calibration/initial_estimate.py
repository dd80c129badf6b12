"""First estimates for the adjustment: each device by itself, then where they stand to each other."""

from collections.abc import Sequence

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from recon.estimation.equations import Undetermined
from recon.geometry import rigid
from recon.geometry.camera import Camera
from recon.optical_calibration.bundle import Array, Estimate
from recon.optical_calibration.observations import PROJECTOR, Observations
from recon.optical_calibration.sightings import ENOUGH
from recon.threads import opencv_on_one_thread

HEIGHTS = (0.5, 0.0, 1.0)  # of the principal point, tried in turn: a projector's lies near an edge, and the wrong guess may stay
ENOUGH_STEPS = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 30, 1e-6)  # to a relative change; OpenCV's is rounding's
STRAY_DEG = 3.0  # between a device's place by one pose and by most; noise makes a tenth of it
CONTRADICTING = 1 / 3  # share of such poses from which on the captures contradict each other


def estimate(observations: Observations, light: str = "") -> Estimate:
    """Estimate devices and poses, well enough for `adjustment.adjust` to start from.

    Each device is calibrated alone (`cv2.calibrateCamera`, Zhang's method), and placed in the first one's frame by the median
    over the poses that both see, so that a few poses that contradict the others don't count.

    light : suspicion of the fringes', in words, for messages of the projector

    Raises
    ------
    Undetermined
        If a device sees too little, or stands elsewhere in too many poses.
    """
    cameras: dict[str, Camera] = {}
    places = []  # (d,) of (p, 4, 4) device_from_board, NaN where not seen
    for number, device in enumerate(observations.devices):
        camera, boards = alone(observations, number)
        cameras[device] = camera
        places.append(boards)
    for device, boards in list(zip(observations.devices, places, strict=True))[1:]:
        cameras[device] = _placed(cameras[device], boards, places[0], device, causes(device, light))
    known = np.isfinite(places[0][:, 0, 0])
    poses = places[0].copy()
    for device, boards in list(zip(observations.devices, places, strict=True))[1:]:
        missing = ~known & np.isfinite(boards[:, 0, 0])
        poses[missing] = rigid.invert(cameras[device].camera_from_world) @ boards[missing]
        known |= missing
    if not known.all():
        raise Undetermined(f"pose {observations.poses[int(np.argmin(known))]} is seen by no device")
    return Estimate(cameras, poses, observations.points)


def alone(observations: Observations, number: int) -> tuple[Camera, Array]:
    """One device by itself: its camera, and device_from_board : (p, 4, 4), NaN for poses of which it sees too little."""
    seen = observations.seen[:, :, number]
    enough = np.flatnonzero(seen.sum(axis=1) >= ENOUGH)
    if len(enough) < 3:
        raise Undetermined(f"{observations.devices[number]}: expected 3 poses or more with {ENOUGH} points, found {len(enough)}")
    objects = [np.float32(observations.points[seen[k]]) for k in enough]
    pixels = [np.float32(observations.pixels[k, seen[k], number]) for k in enough]
    size = observations.sizes[number]
    with opencv_on_one_thread():
        trials = [_zhang(objects, pixels, size, height) for height in HEIGHTS]
    _, matrix, distortion, turns, shifts = min(trials, key=lambda trial: trial[0])
    if not (np.isfinite(matrix).all() and np.isfinite(distortion).all() and matrix[0, 0] > 0 and matrix[1, 1] > 0):
        raise Undetermined(
            f"{observations.devices[number]}: expected views of one flat board, found no camera that gives them: "
            "are the boards all parallel, or is the board another one?"
        )
    boards = np.full((len(observations.poses), 4, 4), np.nan)
    for k, turn, shift in zip(enough, turns, shifts, strict=True):
        boards[k] = rigid.from_rotation_vector(np.ravel(turn), shift)
    return Camera(size, matrix, np.ravel(distortion)[:4]), boards


def _zhang(objects: list, pixels: list, size: tuple[int, int], height: float) -> tuple:
    """`cv2.calibrateCamera` with one radial coefficient, from a principal point at a height of the image, 1 being its bottom."""
    rows = max(round(2 * height * size[1]), 1)  # OpenCV starts from the middle of the image that it is told of
    matrix = cv2.initCameraMatrix2D(objects, pixels, (size[0], rows))
    flags = cv2.CALIB_USE_INTRINSIC_GUESS | cv2.CALIB_ZERO_TANGENT_DIST | cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3
    return cv2.calibrateCamera(objects, pixels, size, matrix, np.zeros(5), flags=flags, criteria=ENOUGH_STEPS)


def _placed(camera: Camera, boards: Array, reference: Array, device: str, causes: str) -> Camera:
    """A device in the frame of the first: the median over the poses that both see."""
    both = np.isfinite(boards[:, 0, 0]) & np.isfinite(reference[:, 0, 0])
    if not both.any():
        raise Undetermined(f"{device}: expected poses that it sees together with the first device, found none")
    device_from_world = boards[both] @ np.array([rigid.invert(place) for place in reference[both]])
    found = middle(device_from_world)
    turns = Rotation.from_matrix(device_from_world[:, :3, :3] @ found[:3, :3].T).magnitude()
    strays = int(np.count_nonzero(np.rad2deg(turns) > STRAY_DEG))
    if strays > CONTRADICTING * len(turns):
        raise Undetermined(
            f"{device}: expected it to stand still beside the first device, found it turned in {strays} of {len(turns)} poses: "
            f"{causes}?"
        )
    return Camera(camera.size, camera.matrix, camera.distortion, found)


def causes(device: str, light: str) -> str:
    """Likely causes of poses that contradict each other in a device, the likeliest first; of the projector, the light as well."""
    first = f"{light}, or " if device == PROJECTOR and light else ""
    return f"{first}were images mixed up or mirrored, or did a device move"


def middle(transforms: Sequence[Array] | Array) -> Array:
    """The transform : (4, 4) that most of a set : (m, 4, 4) agree on.

    Of the rotations that with the least sum of distances to the others is taken, and the mean of the half next to it; of the
    translations the median.
    """
    stack = np.asarray(transforms)
    turns = Rotation.from_matrix(stack[:, :3, :3])
    distances = np.array([(turns * turn.inv()).magnitude() for turn in turns])
    order = np.argsort(distances[int(np.argmin(distances.sum(axis=1)))])
    near = turns[order[: max(1, (len(stack) + 1) // 2)]]
    return rigid.transform(near.mean().as_matrix(), np.median(stack[:, :3, 3], axis=0))
