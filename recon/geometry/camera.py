"""Pinhole cameras with OpenCV lens distortion, and projectors as the same model run backwards.

Pixel centres lie at integer coordinates, `u` to the right and `v` down. The distortion is OpenCV's full model, in its order
`k1 k2 p1 p2 k3 k4 k5 k6 s1 s2 s3 s4 tau_x tau_y`; shorter sets leave the rest at zero.
"""

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from recon import arguments
from recon.compiled import kernel, njit
from recon.geometry import rigid
from recon.threads import in_threads

Array = NDArray[np.float64]

DISTORTION_LENGTHS = (0, 4, 5, 8, 12, 14)
ROTATION = 2e-6  # of a rotation's products: stricter than a pose's, as all points depend on it; six decimals leave 1.8e-6
NEWTON_STEPS = 20
NEWTON_TOLERANCE = 1e-13  # normalised image coordinates: far below a thousandth of a pixel at any focal length
ACCEPTED = 1e-10  # the same, of a root that rounding keeps from the tolerance
FEW = 16  # points: threads take longer to wake than one core takes to undistort these
FEW_PROJECTED = 1000  # the same to distort them, array by array
SLOPE_STEP = 1e-6  # normalised image coordinates: to each side, of the Jacobian by central differences
FARTHEST = 21  # place of the square of a lens's largest radius among its coefficients
STEEPEST, ANGLES = 89.5, 400  # deg from the axis up to which a lens is followed, and steps to there


@dataclass(frozen=True, eq=False)
class Camera:
    """A calibrated pinhole camera with OpenCV distortion; the projector is one too, run backwards.

    Its arrays are copies, and can't be written to.

    Raises
    ------
    ValueError
        If a shape is wrong, a value is not finite, a focal length is not positive, or a matrix is not of its form, as when it is
        transposed.
    """

    size: tuple[int, int]  # width, height, px
    matrix: Array  # (3, 3), px
    distortion: Array  # (0 | 4 | 5 | 8 | 12 | 14,), OpenCV order
    camera_from_world: Array = field(default_factory=lambda: np.eye(4))  # (4, 4), mm
    name: str = ""  # of the device, as its calibration has it

    def __post_init__(self) -> None:
        object.__setattr__(self, "size", arguments.image_size("size", self.size))
        for name, shape in (("matrix", (3, 3)), ("camera_from_world", (4, 4))):
            value = np.array(arguments.numbers(name, getattr(self, name), shape, finite=False), float)
            if not np.isfinite(value).all():
                raise ValueError(f"{name}: expected a finite {shape[0]}x{shape[1]} matrix, found {value.tolist()}")
            object.__setattr__(self, name, _fixed(value))
        distortion = np.array(arguments.numbers("distortion", self.distortion, finite=False), float).ravel()
        if distortion.size not in DISTORTION_LENGTHS or not np.isfinite(distortion).all():
            raise ValueError(f"distortion: expected 0, 4, 5, 8, 12 or 14 finite coefficients, found {distortion.tolist()}")
        object.__setattr__(self, "distortion", _fixed(distortion))
        if self.matrix[0, 0] <= 0 or self.matrix[1, 1] <= 0:
            raise ValueError(f"matrix: expected positive focal lengths, found {self.matrix[0, 0]:g}, {self.matrix[1, 1]:g}")
        if np.abs(self.matrix[[1, 2, 2, 2], [0, 0, 1, 2]] - [0, 0, 0, 1]).max() > rigid.EXACT:
            raise ValueError(f"matrix: expected the form [[fx, s, cx], [0, fy, cy], [0, 0, 1]], found {self.matrix.tolist()}")
        if found := rigid.fault(self.camera_from_world, ROTATION):
            raise ValueError(f"camera_from_world: expected {rigid.RIGID}, found {found}")

    @cached_property
    def centre(self) -> Array:
        """The pinhole in the world : (3,) mm."""
        return _fixed(rigid.invert(self.camera_from_world)[:3, 3])

    @cached_property
    def coefficients(self) -> Array:
        """The distortion in a fixed layout for compiled code : (22,), 12 coefficients, the 3x3 tilt matrix, row by row, and the
        square of the radius up to which the lens is one: see `largest_radius`.
        """
        padded = np.zeros(14)
        padded[: self.distortion.size] = self.distortion
        tilt = tilt_matrix(padded[12], padded[13]) if padded[12:].any() else np.eye(3)
        return _fixed(np.concatenate([padded[:12], tilt.ravel(), [largest_radius(padded) ** 2]]))

    def project(self, points: ArrayLike) -> Array:
        """Project points : (..., 3) mm in the world, to pixels : (..., 2).

        Points behind the camera give NaN, and those so far aside that the lens model has turned back: see `largest_radius`.
        """
        local = rigid.apply(self.camera_from_world, points)
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            normalised = np.where(local[..., 2:] > 0, local[..., :2] / local[..., 2:], np.nan)
            if normalised.size <= 2 * FEW_PROJECTED:
                x, y = normalised[..., 0], normalised[..., 1]
                bent = np.stack(distorted(x, y, self.coefficients), axis=-1)
                if (farthest := self.coefficients[FARTHEST]) < np.inf:
                    bent[x * x + y * y > farthest] = np.nan
            else:
                flat, bent, k = np.ascontiguousarray(normalised.reshape(-1, 2)), np.empty(normalised.shape), self.coefficients
                in_threads(_distort_all, len(flat), flat, k, bent.reshape(-1, 2))
            return self.to_pixels(bent)

    def undistort(self, pixels: ArrayLike) -> Array:
        """Undo lens and matrix: pixels : (..., 2), to normalised coordinates x/z, y/z : (..., 2) of the ideal pinhole.

        The forward model is inverted by Newton's method, to 1e-13 in normalised coordinates. A pixel that no ray reaches
        (outside the range where the polynomial can be inverted, or by rays past its turn alone) gives NaN.
        """
        pixels = np.asarray(pixels, float)
        flat = pixels.reshape(-1, 2)
        y = (flat[:, 1] - self.matrix[1, 2]) / self.matrix[1, 1]
        x = (flat[:, 0] - self.matrix[0, 2] - self.matrix[0, 1] * y) / self.matrix[0, 0]
        if 0 < len(flat) <= FEW:
            return np.reshape([_undistort(*point, self.coefficients) for point in zip(x, y, strict=True)], pixels.shape)
        bent, found, k = np.stack([x, y], axis=-1), np.empty((len(flat), 2)), self.coefficients
        in_threads(_undistort_all, len(flat), bent, k, found)
        return found.reshape(pixels.shape)

    def rays(self, pixels: ArrayLike) -> Array:
        """Directions of the rays through pixels : (..., 2), as unit vectors : (..., 3) in the world."""
        normalised = self.undistort(pixels)
        local = np.concatenate([normalised, np.ones_like(normalised[..., :1])], axis=-1)
        local /= np.linalg.norm(local, axis=-1, keepdims=True)
        return local @ self.camera_from_world[:3, :3]

    def pixel_rays(self) -> Array:
        """Directions of the rays through all pixel centres : (h, w, 3), as of `rays`; each row begins at those before."""
        (width, height), rotation = self.size, np.ascontiguousarray(self.camera_from_world[:3, :3])
        found = np.empty((height, width, 3))
        in_threads(_pixel_rays, height, self.matrix, self.coefficients, rotation, found)
        return found

    def pixel_grid(self) -> Array:
        """All pixel centres : (h, w, 2), as (u, v)."""
        width, height = self.size
        return np.stack(np.meshgrid(np.arange(width, dtype=float), np.arange(height, dtype=float)), axis=-1)

    def to_pixels(self, distorted: Array) -> Array:
        """Distorted normalised coordinates : (..., 2), to pixels : (..., 2)."""
        return distorted @ self.matrix[:2, :2].T + self.matrix[:2, 2]


def _fixed(values: Array) -> Array:
    """The array itself, which can't be written to any more."""
    values.setflags(write=False)
    return values


def largest_radius(k: Array) -> float:
    """The radius, in normalised image coordinates, up to which a lens of coefficients k : (12 or more,) is one.

    Beyond it distorted rays turn back towards the image's middle (a fold) or come from infinity (a pole): the polynomial says
    nothing of a lens there. Decentring and prism make that radius depend on the direction: it is that of the last to turn.
    Infinite where none does.
    """

    def bent(r: Array) -> Array:
        r2 = r * r
        radial = (1 + r2 * (k[0] + r2 * (k[1] + r2 * k[4]))) / (1 + r2 * (k[5] + r2 * (k[6] + r2 * k[7])))
        return r * radial + r2 * (np.hypot(3 * k[3] + k[8], 3 * k[2] + k[10]) + r2 * np.hypot(k[9], k[11]))

    radii = np.tan(np.radians(np.linspace(0, STEEPEST, ANGLES + 1)))
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        for _ in range(3):  # the last step, again in fine ones
            back = ~(np.diff(bent(radii)) > 0)
            if not back.any():
                return np.inf
            turn = int(back.argmax())
            radii = np.linspace(radii[max(turn - 1, 0)], radii[turn + 1], ANGLES + 1)
    return float(radii[turn])


def tilt_matrix(tau_x: float, tau_y: float) -> Array:
    """Homography : (3, 3) of a sensor tilted by tau_x, tau_y in rad (Scheimpflug), as in OpenCV's camera model."""
    cx, sx, cy, sy = np.cos(tau_x), np.sin(tau_x), np.cos(tau_y), np.sin(tau_y)
    about_x = np.array([[1, 0, 0], [0, cx, sx], [0, -sx, cx]])
    about_y = np.array([[cy, 0, -sy], [0, 1, 0], [sy, 0, cy]])
    rotation = about_y @ about_x
    onto_sensor = np.array([[rotation[2, 2], 0, -rotation[0, 2]], [0, rotation[2, 2], -rotation[1, 2]], [0, 0, 1]])
    return onto_sensor @ rotation


def distorted(x, y, k):
    """Distort a normalised point by the coefficients k : (22,) of `Camera.coefficients`; anything with arithmetic will do."""
    r2 = x * x + y * y
    radial = (1 + r2 * (k[0] + r2 * (k[1] + r2 * k[4]))) / (1 + r2 * (k[5] + r2 * (k[6] + r2 * k[7])))
    xd = x * radial + 2 * k[2] * x * y + k[3] * (r2 + 2 * x * x) + r2 * (k[8] + r2 * k[9])
    yd = y * radial + k[2] * (r2 + 2 * y * y) + 2 * k[3] * x * y + r2 * (k[10] + r2 * k[11])
    w = k[18] * xd + k[19] * yd + k[20]
    return (k[12] * xd + k[13] * yd + k[14]) / w, (k[15] * xd + k[16] * yd + k[17]) / w


distort = njit(forceinline=True, error_model="numpy")(distorted)  # inlined by LLVM, which compiles in a sixth of the time
distort_side_by_side = njit(inline="always")(distorted)  # by Numba: its points share vector instructions, in a loop over arrays


@kernel
def _distort_all(first, end, points, k, found):
    for i in range(first, end):
        x, y = points[i, 0], points[i, 1]
        xd, yd = distort(x, y, k)
        inside = x * x + y * y <= k[FARTHEST]
        found[i, 0], found[i, 1] = xd if inside else np.nan, yd if inside else np.nan


@njit(forceinline=True, error_model="numpy")
def distortion_slopes(x, y, k):
    """Jacobian of the distortion at (x, y): dxd/dx, dxd/dy, dyd/dx, dyd/dy."""
    right, left = distort(x + SLOPE_STEP, y, k), distort(x - SLOPE_STEP, y, k)
    below, above = distort(x, y + SLOPE_STEP, k), distort(x, y - SLOPE_STEP, k)
    scale = 1 / (2 * SLOPE_STEP)
    return (
        (right[0] - left[0]) * scale,
        (below[0] - above[0]) * scale,
        (right[1] - left[1]) * scale,
        (below[1] - above[1]) * scale,
    )


@njit(forceinline=True, error_model="numpy")
def _undistort_from(x, y, u, v, k):
    """Normalised point near (x, y) whose distortion is (u, v), by Newton's method; NaN where there is none."""
    error = determinant = np.inf
    for _ in range(NEWTON_STEPS):
        xd, yd = distort(x, y, k)
        ex, ey = u - xd, v - yd
        error = max(abs(ex), abs(ey))
        if not error > NEWTON_TOLERANCE:
            break
        a, b, c, d = distortion_slopes(x, y, k)
        determinant = a * d - b * c
        x += (d * ex - b * ey) / determinant
        y += (a * ey - c * ex) / determinant
    if determinant == np.inf:  # the start was the solution
        a, b, c, d = distortion_slopes(x, y, k)
        determinant = a * d - b * c
    # past the fold of a polynomial a root is not a ray: the distortion mirrors there, or throws to the other side
    if error < ACCEPTED and x * u + y * v >= 0 and determinant > 0 and x * x + y * y <= k[FARTHEST]:
        return x, y
    return np.nan, np.nan


@njit(forceinline=True, error_model="numpy")
def _undistort(u, v, k):
    """Normalised point whose distortion is (u, v); NaN where there is none."""
    return _undistort_from(u, v, u, v, k)


@kernel
def _undistort_all(first, end, points, k, found):
    for i in range(first, end):
        found[i, 0], found[i, 1] = _undistort(points[i, 0], points[i, 1], k)


@njit(nogil=True, noalias=True, error_model="numpy")
def _pixel_rays(first, end, matrix, k, rotation, found):
    """Rows `first` to `end`, not included. All but the first three begin where those before lead to; see `_continued`."""
    width = found.shape[1]
    rows, doubtful = np.empty((3, 2, width)), np.empty(width, np.bool_)  # normalised points of the latest three
    for j in range(first, end):
        v = (j - matrix[1, 2]) / matrix[1, 1]
        before, last, row = rows[(j + 1) % 3], rows[(j + 2) % 3], rows[j % 3]
        if j < first + 3:
            for i in range(width):
                row[0, i], row[1, i] = _undistort((i - matrix[0, 2] - matrix[0, 1] * v) / matrix[0, 0], v, k)
        else:
            _continued(row, before, last, v, matrix, k, doubtful)
        for i in range(width):
            x, y = row[0, i], row[1, i]
            shorter = 1 / np.sqrt(x * x + y * y + 1)
            for n in range(3):
                found[j, i, n] = shorter * (rotation[0, n] * x + rotation[1, n] * y + rotation[2, n])


@njit(inline="always", error_model="numpy")
def _continued(row, before, last, v, matrix, k, doubtful):
    """Undistort an image row from three before, of which it replaces the first: extrapolated, and one step with their slopes.

    Without branches, so that pixels share vector instructions; Newton's method does where that falls short of its tolerance.
    """
    width = row.shape[1]
    doubtful[0] = doubtful[width - 1] = True
    for i in range(1, width - 1):
        u = (i - matrix[0, 2] - matrix[0, 1] * v) / matrix[0, 0]
        x, y = 3 * (last[0, i] - before[0, i]) + row[0, i], 3 * (last[1, i] - before[1, i]) + row[1, i]
        xd, yd = distort_side_by_side(x, y, k)
        right, down = matrix[0, 0] * (u - xd) + matrix[0, 1] * (v - yd), matrix[1, 1] * (v - yd)  # px left to go
        a, b = (last[0, i + 1] - last[0, i - 1]) / 2, last[0, i] - before[0, i]
        c, d = (last[1, i + 1] - last[1, i - 1]) / 2, last[1, i] - before[1, i]
        x, y = x + a * right + b * down, y + c * right + d * down
        xd, yd = distort_side_by_side(x, y, k)
        near = (abs(u - xd) <= NEWTON_TOLERANCE) & (abs(v - yd) <= NEWTON_TOLERANCE)
        doubtful[i] = not (near & (x * u + y * v >= 0) & (a * d > b * c) & (x * x + y * y <= k[FARTHEST]))
        row[0, i], row[1, i] = x, y
    for i in range(width):
        if doubtful[i]:
            u = (i - matrix[0, 2] - matrix[0, 1] * v) / matrix[0, 0]
            x, y = _undistort_from(row[0, i], row[1, i], u, v, k)
            row[0, i], row[1, i] = (x, y) if x == x else _undistort(u, v, k)
