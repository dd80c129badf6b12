"""How far a reconstructed surface is from the rendered one, pixel by pixel, and what the sensor's noise alone would allow.

The error of a point is its signed distance to the plane that touches the true surface where the pixel's ray meets it, positive
outwards. Ground truth is read here and in the report, nowhere else.
"""

import json
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from recon import calibration, primitives
from recon.camera import Array, Camera
from recon.errors import InputError, one_line
from recon.patterns import Axis, Patterns
from scenes.things import Cylinder, Plane, Shape, Sphere

Map = NDArray[np.float32]  # (h, w)
Mask = NDArray[np.bool_]  # (h, w)
Metrics = dict[str, float | int]

GROSS_MM = 1.0  # along the ray: a wrong fringe order moves a point by tens of mm, noise by hundredths
EDGE_PX = 3  # width of the band along discontinuities that the interior leaves out
EDGE_MM = 0.5  # a neighbour farther than this from the tangent plane lies beyond an edge
DIFFERENCE_MM = 0.5  # half of the central difference along the ray
ON_SHAPE_MM = 0.1  # truth nearer than this to a shape is of that shape; meshes of it are finer
LEAST_FITTED = 100  # points; fewer say nothing about a shape
MOST_FITTED = 100_000  # points, evenly chosen; more would change a radius by less than 1e-4 mm and take long
NORMAL_MAD = 1.4826  # standard deviation of a normal distribution over its median absolute deviation
SHAPES = {"plane": Plane, "sphere": Sphere, "cylinder": Cylinder}


@dataclass(frozen=True, eq=False)
class Truth:
    """What one camera of the twin would have seen without noise and blur. Maps are (h, w), lengths mm in the world."""

    points: Map  # (h, w, 3); NaN where the ray meets nothing
    normals: Map  # (h, w, 3) unit, outwards
    objects: NDArray[np.uint8]  # number of the thing; none of `things` where the ray meets nothing
    lit: Mask  # the projector sees the point too
    limit_px: Map  # standard deviation of the projector coordinate that the sensor's noise alone allows
    camera: Camera
    projector: Camera
    axes: tuple[Axis, ...]  # that carried fringes
    scene: str
    things: tuple[str, ...]
    shapes: tuple[Shape, ...]  # to be fitted


@dataclass(frozen=True, eq=False)
class Comparison:
    """A point map against the truth. Maps are (h, w) float32 mm, NaN where not compared."""

    error: Map  # signed distance to the true surface's tangent plane, positive outwards
    along_ray: Map  # signed distance along the pixel's ray, positive away from the camera
    predicted: Map  # standard deviation of `error` that the points themselves predict
    limit: Map  # standard deviation of `error` that the sensor's noise alone allows; wherever the truth is lit
    compared: Mask  # a point, where the truth is lit
    interior: Mask  # compared, and away from discontinuities of the truth


def read_truth(folder: Path, camera: str = "cam1") -> Truth:
    """Read one camera's ground truth from the `truth/` folder of a rendered session.

    Raises
    ------
    InputError
        If a file is missing or damaged, or the parts don't fit together.
    """
    folder = Path(folder)
    described = _read_json(folder / "scene.json")
    settings = _read_json(folder / "settings.json")
    path = folder / "surface" / f"{camera}.npz"
    arrays = read_arrays(path, {"points": 3, "normals": 3, "objects": 2, "lit": 2, "limit_px": 2})
    optics = calibration.read(folder / "calibration" / "optics.yaml").cameras
    for name in (camera, "projector"):
        if name not in optics:
            raise InputError(f"{folder / 'calibration' / 'optics.yaml'}: expected {name}, found {', '.join(optics) or 'none'}")
    size = optics[camera].size
    for name, array in arrays.items():
        if array.shape[:2] != size[::-1]:
            raise InputError(f"{path}: {name}: expected {size[0]}x{size[1]}, found {array.shape[1]}x{array.shape[0]}")
    try:
        patterns = Patterns.model_validate(settings.get("patterns"))
    except ValidationError as error:
        raise InputError(f"{folder / 'settings.json'}: patterns.{one_line(error)}") from None
    try:
        scene, things = str(described["name"]), tuple(described["things"])
        shapes = tuple(_shape(entry) for entry in described["shapes"])
    except (KeyError, TypeError) as error:
        raise InputError(f"{folder / 'scene.json'}: expected name, things and shapes, found them damaged at {error}") from None
    return Truth(
        **arrays,
        camera=optics[camera],
        projector=optics["projector"],
        axes=patterns.axes,
        scene=scene,
        things=things,
        shapes=shapes,
    )


def read_points(path: Path) -> tuple[Map, Map]:
    """Read points (h, w, 3) mm and their predicted sigma (h, w) mm along the ray from a `points.npz`.

    Raises
    ------
    InputError
        If the file is missing or damaged, or the two have different sizes.
    """
    arrays = read_arrays(path, {"points": 3, "sigma": 2})
    points, sigma = arrays["points"], arrays["sigma"]
    if points.shape != (*sigma.shape, 3):
        raise InputError(f"{path}: expected points of shape {(*sigma.shape, 3)} to fit sigma, found {points.shape}")
    return points, sigma


def compare(points: Map, sigma: Map, truth: Truth) -> Comparison:
    """Compare an organised point map with the truth, pixel by pixel.

    Parameters
    ----------
    points : (h, w, 3), mm
        In the world, NaN where none.
    sigma : (h, w), mm
        Their predicted standard deviation along the ray.

    Returns
    -------
    Comparison
        Distances along the ray become distances from the surface by the cosine between ray and normal. The limit is
        `limit_px |cos| / |du/dt|`, with the slope of the projector coordinate u along the ray by central differences.

    Raises
    ------
    InputError
        If the map has another size than the truth, or has no point where the truth is lit.
    """
    if points.shape != truth.points.shape or sigma.shape != truth.lit.shape:
        (height, width), (wanted_height, wanted_width) = points.shape[:2], truth.lit.shape
        raise InputError(f"points: expected {wanted_width}x{wanted_height} as the truth has, found {width}x{height}")
    compared = np.isfinite(points).all(axis=-1) & truth.lit
    if not compared.any():
        raise InputError(f"points: expected some of {np.count_nonzero(truth.lit)} px that camera and projector see, found none")
    rays = truth.camera.rays(truth.camera.pixel_grid())
    cosine = np.abs((truth.normals * rays).sum(axis=-1))
    offset = np.where(compared[..., None], points - truth.points, np.nan)
    slope = _projector_slope(truth.points, rays, truth)
    with np.errstate(divide="ignore", invalid="ignore"):
        limit = np.where(truth.lit, truth.limit_px * cosine / slope, np.nan)
    return Comparison(
        error=np.float32((offset * truth.normals).sum(axis=-1)),
        along_ray=np.float32((offset * rays).sum(axis=-1)),
        predicted=np.where(compared, np.float32(sigma * cosine), np.float32(np.nan)),
        limit=np.float32(limit),
        compared=compared,
        interior=compared & away_from_edges(truth),
    )


def measure(points: Map, comparison: Comparison, truth: Truth) -> Metrics:
    """Put a comparison into numbers, with their units in their names.

    Root mean squares are over all compared points unless the name says otherwise. `gross` points are off by more than 1 mm
    along the ray; the z statistics and the fits leave them out. `interior` is more than 3 px from any edge of the truth.
    """
    there, compared, error = np.isfinite(points).all(axis=-1), comparison.compared, comparison.error
    gross = compared & (np.abs(comparison.along_ray) > GROSS_MM)
    fine = compared & ~gross
    known = fine & (comparison.predicted > 0) & np.isfinite(comparison.predicted)
    z = error[known] / comparison.predicted[known]
    limit = comparison.limit[compared]
    metrics: Metrics = {
        "surface_rms_mm": rms(error[compared]),
        "surface_rms_without_gross_mm": rms(error[fine]),
        "surface_interior_rms_mm": rms(error[comparison.interior]),
        "surface_bias_mm": _mean(error[fine]),
        "surface_median_abs_mm": _median(np.abs(error[compared])),
        "coverage": float(compared.sum() / truth.lit.sum()),
        "gross_error_fraction": float(gross.sum() / compared.sum()),
        "predicted_rms_mm": rms(comparison.predicted[known]),
        "limit_rms_mm": rms(limit[np.isfinite(limit)]),
        "z_std": float(np.std(z)) if z.size else np.nan,
        "z_robust_std": NORMAL_MAD * _median(np.abs(z - _median(z))),
        "points": int(there.sum()),
        "false_points": int((there & ~truth.lit).sum()),
    }
    for number, name in enumerate(truth.things):
        metrics[f"thing_{name}_rms_mm"] = rms(error[compared & (truth.objects == number)])
    for shape in truth.shapes:
        on_shape = fine & (np.abs(_distance(shape, truth.points)) < ON_SHAPE_MM)
        chosen = np.float64(points[on_shape])
        if len(chosen) >= LEAST_FITTED:
            metrics |= fit(shape, chosen[:: -(-len(chosen) // MOST_FITTED)])
            metrics[f"{type(shape).__name__.lower()}_{shape.name}_limit_rms_mm"] = rms(comparison.limit[on_shape])
    return {key: value for key, value in metrics.items() if np.isfinite(value)}


def fit(shape: Shape, points: Array) -> Metrics:
    """Fit a shape's kind to measured points : (n, 3) mm, and compare with the shape, as one does without ground truth."""
    match shape:
        case Plane(name=name):
            plane = primitives.fit_plane(points)
            cosine = min(abs(float(plane.shape.normal @ shape.normal)), 1.0)
            return {f"plane_{name}_rms_mm": plane.rms, f"plane_{name}_angle_error_deg": float(np.rad2deg(np.arccos(cosine)))}
        case Sphere(name=name):
            sphere = primitives.fit_sphere(points)
            return {
                f"sphere_{name}_rms_mm": sphere.rms,
                f"sphere_{name}_radius_error_mm": sphere.shape.radius - shape.radius,
                f"sphere_{name}_centre_error_mm": float(np.linalg.norm(sphere.shape.centre - shape.centre)),
            }
        case Cylinder(name=name):
            cylinder = primitives.fit_cylinder(points)
            cosine = min(abs(float(cylinder.shape.axis @ shape.axis)), 1.0)
            return {
                f"cylinder_{name}_rms_mm": cylinder.rms,
                f"cylinder_{name}_radius_error_mm": cylinder.shape.radius - shape.radius,
                f"cylinder_{name}_angle_error_deg": float(np.rad2deg(np.arccos(cosine))),
            }


def away_from_edges(truth: Truth) -> Mask:
    """Pixels more than `EDGE_PX` from any edge: where the thing, the light or the surface itself breaks off : (h, w)."""
    smooth = np.ones(truth.lit.shape, np.uint8)
    for axis in (0, 1):
        here = tuple(slice(None, -1) if i == axis else slice(None) for i in (0, 1))
        there = tuple(slice(1, None) if i == axis else slice(None) for i in (0, 1))
        step = truth.points[there] - truth.points[here]
        with np.errstate(invalid="ignore"):
            off = np.maximum(*(np.abs((step * truth.normals[side]).sum(axis=-1)) for side in (here, there)))
            edge = ~(off < EDGE_MM)
        edge |= (truth.objects[here] != truth.objects[there]) | (truth.lit[here] != truth.lit[there])
        smooth[here][edge] = 0
        smooth[there][edge] = 0
    return cv2.distanceTransform(smooth, cv2.DIST_L2, cv2.DIST_MASK_PRECISE) > EDGE_PX


def rms(values: NDArray) -> float:
    """Root mean square; NaN of nothing."""
    return float(np.sqrt(np.mean(np.square(values, dtype=np.float64)))) if values.size else np.nan


def read_arrays(path: Path, dimensions: Mapping[str, int]) -> dict[str, NDArray]:
    """Read named arrays with the numbers of dimensions given from an npz file; InputError if that can't be done."""
    try:
        with np.load(path, allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in dimensions if name in archive}
    except FileNotFoundError:
        raise InputError(f"{path}: expected a file, found none") from None
    except (ValueError, EOFError, zipfile.BadZipFile, OSError):
        raise InputError(f"{path}: expected an npz file of plain arrays, found other or damaged data") from None
    for name, count in dimensions.items():
        if name not in arrays:
            raise InputError(f"{path}: {name}: expected an array, found none")
        if arrays[name].ndim != count:
            raise InputError(f"{path}: {name}: expected {count} dimensions, found {arrays[name].ndim}")
    return arrays


def _projector_slope(points: Map, rays: Array, truth: Truth) -> Array:
    """Change of the projector coordinates that carried fringes, along the camera's ray : (h, w) px/mm."""
    half = DIFFERENCE_MM * rays
    change = (truth.projector.project(points + half) - truth.projector.project(points - half)) / (2 * DIFFERENCE_MM)
    return np.linalg.norm(change[..., [("columns", "rows").index(axis) for axis in truth.axes]], axis=-1)


def _distance(shape: Shape, points: Map) -> Array:
    """Signed distance of points : (h, w, 3) to a shape's surface : (h, w)."""
    match shape:
        case Plane():
            return (points - shape.point) @ shape.normal
        case Sphere():
            return np.linalg.norm(points - shape.centre, axis=-1) - shape.radius
        case Cylinder():
            return np.linalg.norm(np.cross(points - shape.point, shape.axis), axis=-1) - shape.radius


def _shape(entry: Mapping) -> Shape:
    values = {key: np.asarray(value) if isinstance(value, list) else value for key, value in entry.items() if key != "kind"}
    return SHAPES[entry["kind"]](**values)


def _mean(values: NDArray) -> float:
    return float(np.mean(values, dtype=np.float64)) if values.size else np.nan


def _median(values: NDArray) -> float:
    return float(np.median(values)) if values.size else np.nan


def _read_json(path: Path) -> dict:
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise InputError(f"{path}: expected a file of the twin's ground truth, found none") from None
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: expected JSON, found {error}") from None
    if not isinstance(content, dict):
        raise InputError(f"{path}: expected an object, found {type(content).__name__}")
    return content
