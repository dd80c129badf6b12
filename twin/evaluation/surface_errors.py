"""Errors of a reconstructed surface against the rendered one, pixel by pixel, and the limit that the sensor's noise sets.

The error of a point is its signed distance to the plane that touches the true surface where the pixel's ray meets it, positive
outwards.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from recon.errors import InputError
from recon.files import npz
from recon.files.metrics import Metrics
from recon.files.npz import Form
from recon.geometry import primitives
from recon.geometry.camera import Array, Camera
from recon.geometry.order_statistics import NORMAL_MAD
from recon.geometry.primitives import Cylinder, Plane, Shape, Sphere
from twin.session import SCENE, TruthFolder

Map = NDArray[np.float32]  # (h, w)
Mask = NDArray[np.bool_]  # (h, w)

GROSS_MM = 1.0  # along the ray: a wrong fringe order moves a point by tens of mm, noise by hundredths
EDGE_PX = 3  # width of the band along discontinuities that the interior leaves out
EDGE_MM = 0.5  # a neighbour farther than this from the tangent plane lies beyond an edge
DIFFERENCE_MM = 0.5  # half of the central difference along the ray
ON_SHAPE_MM = 0.1  # truth nearer than this to a shape is of that shape; meshes of it are finer
LEAST_FITTED = 100  # points; fewer say nothing about a shape
MOST_FITTED = 100_000  # points, evenly chosen; more would change a radius by less than 1e-4 mm and take long
FITTED = {  # figures of a fit
    "plane": ("rms_mm", "angle_error_deg"),
    "sphere": ("rms_mm", "radius_error_mm", "centre_error_mm"),
    "cylinder": ("rms_mm", "radius_error_mm", "angle_error_deg"),
}
TRUTH = {
    "points": Form("f", (None, None, 3)),
    "normals": Form("f", (None, None, 3)),
    "objects": Form("u", (None, None)),
    "lit": Form("b", (None, None)),
    "limit_px": Form("f", (None, None, 2)),
}


@dataclass(frozen=True, eq=False)
class Truth:
    """Ground truth of one camera, without noise and blur. Maps are (h, w), lengths mm in the world."""

    points: Map  # (h, w, 3); NaN where the ray meets nothing
    normals: Map  # (h, w, 3) unit, outwards
    objects: NDArray[np.uint8]  # number of the thing; none of `things` where the ray meets nothing
    lit: Mask  # the projector sees the point too
    limit_px: Map  # (h, w, 2) standard deviation of the projector's column and row that the sensor's noise alone allows;
    # inf where an axis carried no fringes
    camera: Camera
    projector: Camera
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
    gross: Mask  # a point, lit or not, that is far from all truth around its pixel


def read_truth(folder: Path, camera: str = "cam1") -> Truth:
    """Read one camera's ground truth from the `truth/` folder of a rendered session.

    Raises
    ------
    InputError
        If a file is missing or damaged, or the parts don't fit together.
    """
    kept = TruthFolder(Path(folder), "surface")
    described = kept.scene()
    name = f"surface/{camera}.npz"
    maps = kept.arrays(name, TRUTH)
    optics = kept.optics(camera, "projector")
    size = optics[camera].size
    for field, array in maps.items():
        if array.shape[:2] != size[::-1]:
            raise InputError(
                f"{kept.folder / name}: {field}: expected {size[0]}x{size[1]}, found {array.shape[1]}x{array.shape[0]}"
            )
    try:
        scene, things = str(described["name"]), tuple(str(thing) for thing in described["things"])
        shapes = tuple(_shape(entry) for entry in described["shapes"])
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{kept.described / SCENE}: expected name, things and shapes, found them damaged at {error}") from None
    return Truth(
        **maps,
        camera=optics[camera],
        projector=optics["projector"],
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
    maps = npz.read(path, {"points": Form("f", (None, None, 3)), "sigma": Form("f", (None, None))})
    points, sigma = maps["points"], maps["sigma"]
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
        `|cos| / sqrt((du/dt / limit_u)^2 + (dv/dt / limit_v)^2)`, as triangulation weights the axes, with the slopes of the
        projector's column u and row v along the ray by central differences. A point is gross if its distance along the ray
        differs by more than 1 mm from those of all true points in the 3x3 pixels around its own.

    Raises
    ------
    InputError
        If the map has another size than the truth, or has no point where the truth is lit.
    """
    if points.shape != truth.points.shape or sigma.shape != truth.lit.shape:
        (height, width), (wanted_height, wanted_width) = points.shape[:2], truth.lit.shape
        raise InputError(f"points: expected {wanted_width}x{wanted_height} as the truth has, found {width}x{height}")
    there = np.isfinite(points).all(axis=-1)
    compared = there & truth.lit
    if not compared.any():
        raise InputError(f"points: expected some of {np.count_nonzero(truth.lit)} px that camera and projector see, found none")
    rays = truth.camera.rays(truth.camera.pixel_grid())
    cosine = np.abs((truth.normals * rays).sum(axis=-1))
    offset = np.where(compared[..., None], points - truth.points, np.nan)
    with np.errstate(divide="ignore", invalid="ignore"):
        limit = cosine / np.linalg.norm(_projector_slopes(rays, truth) / truth.limit_px, axis=-1)
    return Comparison(
        error=np.float32((offset * truth.normals).sum(axis=-1)),
        along_ray=np.float32((offset * rays).sum(axis=-1)),
        predicted=np.where(compared, np.float32(sigma * cosine), np.float32(np.nan)),
        limit=np.where(truth.lit, np.float32(limit), np.float32(np.nan)),
        compared=compared,
        interior=compared & away_from_edges(truth),
        gross=there & ~_near_truth(points, truth),
    )


def measure(points: Map, comparison: Comparison, truth: Truth) -> Metrics:
    """Put a comparison into numbers, with their units in their names; NaN is a figure that nothing could be said of.

    Root mean squares are over all compared points unless the name says otherwise. `without_gross`, the bias, the z statistics
    and the fits leave out points that are off by more than 1 mm along their own ray. `gross_error_fraction` is of all points,
    lit or not. `interior` is more than 3 px from any edge of the truth, and `false` points are as far from all that is lit.
    """
    there, compared, error = np.isfinite(points).all(axis=-1), comparison.compared, comparison.error
    fine, known = fine_points(comparison), points_with_prediction(comparison)
    z = error[known] / comparison.predicted[known]
    limit = comparison.limit[compared]
    metrics: Metrics = {
        "surface_rms_mm": rms(error[compared]),
        "surface_rms_without_gross_mm": rms(error[fine]),
        "surface_interior_rms_mm": rms(error[comparison.interior]),
        "surface_bias_mm": _mean(error[fine]),
        "surface_median_abs_mm": _median(np.abs(error[compared])),
        "coverage": float(compared.sum() / truth.lit.sum()),
        "gross_error_fraction": float(comparison.gross.sum() / there.sum()),
        "predicted_rms_mm": rms(comparison.predicted[known]),
        "limit_rms_mm": rms(limit[np.isfinite(limit)]),
        "z_std": float(np.std(z)) if z.size else np.nan,
        "z_robust_std": NORMAL_MAD * _median(np.abs(z - _median(z))),
        "points": int(there.sum()),
        "false_points": int((there & (_distance_px(truth.lit) > EDGE_PX)).sum()),
    }
    for number, name in enumerate(truth.things):
        metrics[f"thing_{name}_rms_mm"] = rms(error[compared & (truth.objects == number)])
    for shape in truth.shapes:
        on_shape = fine & (np.abs(shape.distance(truth.points)) < ON_SHAPE_MM)
        chosen = np.float64(points[on_shape])
        metrics |= fit(shape, chosen[:: max(1, -(-len(chosen) // MOST_FITTED))])
        metrics[f"{shape_key(shape)}_limit_rms_mm"] = rms(comparison.limit[on_shape])
    return metrics


def fine_points(comparison: Comparison) -> Mask:
    """Compared points that are not off by more than 1 mm along their own ray : (h, w)."""
    return comparison.compared & (np.abs(comparison.along_ray) <= GROSS_MM)


def points_with_prediction(comparison: Comparison) -> Mask:
    """Fine points that have a predicted standard deviation : (h, w)."""
    return fine_points(comparison) & (comparison.predicted > 0) & np.isfinite(comparison.predicted)


def shape_key(shape: Shape) -> str:
    """Prefix of the names of a shape's figures, such as `sphere_ball`."""
    return f"{type(shape).__name__.lower()}_{shape.name}"


def things(metrics: Metrics) -> dict[str, float]:
    """RMS error of each thing in mm, by its name, from the figures of `measure`."""
    return {key[len("thing_") : -len("_rms_mm")]: value for key, value in metrics.items() if key.startswith("thing_")}


def fit(shape: Shape, points: Array) -> Metrics:
    """Fit a shape's kind to measured points : (n, 3) mm, and compare with the shape, as one does without ground truth.

    NaN if there are too few points, or they don't determine the shape: a piece of a sphere too small to be told from a plane.
    """
    names = FITTED[type(shape).__name__.lower()]
    try:
        values = _fitted(shape, points) if len(points) >= LEAST_FITTED else len(names) * (np.nan,)
    except ValueError:
        values = len(names) * (np.nan,)
    return {f"{shape_key(shape)}_{name}": value for name, value in zip(names, values, strict=True)}


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
    return _distance_px(smooth == 0) > EDGE_PX


def rms(values: NDArray) -> float:
    """Root mean square; NaN of nothing."""
    return float(np.sqrt(np.mean(np.square(values, dtype=np.float64)))) if values.size else np.nan


def _projector_slopes(rays: Array, truth: Truth) -> Array:
    """Change of the projector's column and row along the camera's ray at the true points : (h, w, 2) px/mm."""
    half = DIFFERENCE_MM * rays
    return (truth.projector.project(truth.points + half) - truth.projector.project(truth.points - half)) / (2 * DIFFERENCE_MM)


def _near_truth(points: Map, truth: Truth) -> Mask:
    """Points no farther than 1 mm, along the ray, from a true point in the 3x3 pixels around : (h, w)."""
    height, width = truth.lit.shape
    distance, true = (np.linalg.norm(p - truth.camera.centre, axis=-1) for p in (points, truth.points))
    around = np.pad(true, 1, constant_values=np.nan)
    near = np.zeros((height, width), bool)
    for j, i in np.ndindex(3, 3):
        near |= np.abs(distance - around[j : j + height, i : i + width]) <= GROSS_MM
    return near


def _distance_px(mask: Mask) -> Map:
    """Distance of each pixel to the nearest of a mask : (h, w) px."""
    return cv2.distanceTransform(np.uint8(~mask), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)


def _fitted(shape: Shape, points: Array) -> tuple[float, ...]:
    """The figures of `FITTED` for a shape's kind."""
    match shape:
        case Plane():
            plane = primitives.fit_plane(points)
            return plane.rms, _angle_deg(plane.shape.normal, shape.normal)
        case Sphere():
            sphere = primitives.fit_sphere(points)
            off_centre = float(np.linalg.norm(sphere.shape.centre - shape.centre))
            return sphere.rms, sphere.shape.radius - shape.radius, off_centre
        case Cylinder():
            cylinder = primitives.fit_cylinder(points)
            return cylinder.rms, cylinder.shape.radius - shape.radius, _angle_deg(cylinder.shape.axis, shape.axis)


def _angle_deg(first: Array, second: Array) -> float:
    """Angle between two unit vectors of either sign."""
    return float(np.rad2deg(np.arccos(min(abs(float(first @ second)), 1.0))))


FARTHEST_MM = 1e7  # of a shape in a scene


def _shape(entry: Mapping) -> Shape:
    """A shape as `scene.json` has it; KeyError, TypeError or ValueError if it is none."""

    def vector(field: str) -> Array:
        value = np.asarray(entry[field], float)
        if value.shape != (3,) or not (np.abs(value) <= FARTHEST_MM).all():
            raise ValueError(f"{field} {entry[field]}")
        return value

    name = str(entry["name"])
    match entry["kind"]:
        case "plane":
            return Plane(name, vector("point"), vector("normal"))
        case "sphere":
            return Sphere(name, vector("centre"), float(entry["radius"]))
        case "cylinder":
            return Cylinder(name, vector("point"), vector("axis"), float(entry["radius"]))
    raise ValueError(f"kind {entry['kind']}")


def _mean(values: NDArray) -> float:
    return float(np.mean(values, dtype=np.float64)) if values.size else np.nan


def _median(values: NDArray) -> float:
    return float(np.median(values)) if values.size else np.nan
