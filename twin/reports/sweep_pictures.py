"""Pictures of B-scans beside ideal ones, with outlines of found and true things."""

from collections.abc import Mapping, Sequence

import cv2
import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.ndimage import binary_fill_holes, map_coordinates

from recon.files.volumes import Volume
from recon.geometry import rigid
from recon.probe_calibration import sound_in_water
from recon.reports import figures
from recon.reports.figures import Colours
from twin.evaluation.sweep_errors import Finding, SweepTruth
from twin.ultrasound import bscan_truth, sweep_session
from twin.ultrasound.echo_solids import label_at

Array = NDArray[np.float64]

FOUND, TRUE = "#4aa3e8", "#f0875f"  # outlines, on grey and on either page
ZOOM = 2  # px of a picture for one of a B-scan
TICK_MM = 10.0  # of depth between the ticks at a B-scan's edge
GAP_PX = 6  # between a B-scan and what it should show
LEVEL_STEP_MM = 0.2  # px of a section through the volume


def beside_truth(
    scan: NDArray[np.uint8], number: int, world_from_pixel: Array, findings: Sequence[Finding], expected: SweepTruth
) -> Colours:
    """B-scan (h, w) of a number and its echo-free image, both with outlines; world_from_pixel : (4, 4) measured, in tissue."""
    ideal = bscan_truth.echo_free(expected.shown(number), expected.body, expected.transducer)
    outlines = cuts(findings, world_from_pixel, true_from_pixel(number, expected))
    tick = TICK_MM / float(np.linalg.norm(world_from_pixel[:3, 1]))
    panels = [outlined(ticked(enlarged(figures.grey(image, 255)), tick), outlines) for image in (scan, ideal)]
    return np.hstack([panels[0], np.zeros((len(panels[0]), GAP_PX, 4), np.uint8), panels[1]])


def true_from_pixel(number: int, expected: SweepTruth) -> Array:
    """Where pixels of a B-scan of a number truly lie in the tissue : (4, 4), to mm in the world."""
    transducer = expected.transducer
    shown = expected.world_from_image[number] @ np.diag([*transducer.scale_mm_per_px, 1.0, 1.0])
    return sound_in_water.in_tissue(shown, transducer.assumed_speed, tissue_speed(expected))


def tissue_speed(expected: SweepTruth) -> float:
    """Speed of sound in the thing that was swept over, m/s; of all that has grown in it, the mean along a way."""
    body = expected.body
    swept = sweep_session.surface_of("", body)
    if body.grown is None:
        return swept.tissue.speed
    inside = np.argwhere(swept.distance < 0)
    places = swept.origin + swept.spacing * inside[:: max(len(inside) // 2000, 1)]
    labels = [label_at(body.packed(), *place) for place in places]
    return float(1 / np.mean(1 / body.column("speed")[labels]))


def level_section(volume: Volume, z: float, findings: Sequence[Finding]) -> Colours:
    """A volume cut at one z of the world, seen along it, with outlines; transparent where nothing was scanned."""
    nz, ny, nx = volume.voxels.shape
    ends = np.stack(np.meshgrid([0, nx - 1], [0, ny - 1], [0, nz - 1]), axis=-1).reshape(-1, 3)
    around = rigid.apply(volume.world_from_voxel, ends)
    low, high = around.min(axis=0), around.max(axis=0)
    world_from_pixel = np.diag([LEVEL_STEP_MM, LEVEL_STEP_MM, 1.0, 1.0])
    world_from_pixel[:3, 3] = low[0], low[1], z
    columns, rows = (int(size / LEVEL_STEP_MM) + 1 for size in (high - low)[:2])
    u, v = np.meshgrid(np.arange(columns), np.arange(rows))
    pixels = np.stack([u, v, np.zeros_like(u)], axis=-1)
    index = np.moveaxis(rigid.apply(np.linalg.inv(volume.world_from_voxel) @ world_from_pixel, pixels), -1, 0)[::-1]
    grey = map_coordinates(np.float32(volume.voxels), index, order=1)
    seen = np.asarray(binary_fill_holes(map_coordinates(np.float32(volume.voxels > 0), index, order=1) > 0.5), bool)
    if not seen.any():
        return np.zeros((8, 8, 4), np.uint8)
    picture = figures.grey(grey, 255)
    picture[~seen, 3] = 0
    picture = outlined(enlarged(picture), cuts(findings, world_from_pixel, world_from_pixel))
    (top, bottom), (left, right) = (np.flatnonzero(seen.any(axis=axis))[[0, -1]] for axis in (1, 0))
    return picture[ZOOM * top : ZOOM * (bottom + 1), ZOOM * left : ZOOM * (right + 1)]


def cuts(findings: Sequence[Finding], measured_from_pixel: Array, true_from_pixel: Array) -> dict[str, Array]:
    """Outlines in an image, by their colour: found things by the measured pose, true ones by the true pose."""
    empty = [np.empty((0, 2, 2))]
    found = [cut(finding.found, measured_from_pixel) for finding in findings if finding.found is not None]
    return {
        TRUE: np.concatenate(empty + [cut(finding.true, true_from_pixel) for finding in findings]),
        FOUND: np.concatenate(empty + found),
    }


def cut(mesh: trimesh.Trimesh, world_from_pixel: Array) -> Array:
    """Where a mesh meets an image's plane: line segments : (k, 2, 2) in px; world_from_pixel : (4, 4)."""
    segments = trimesh.intersections.mesh_plane(mesh, world_from_pixel[:3, 2], world_from_pixel[:3, 3])
    if len(segments) == 0:
        return np.empty((0, 2, 2))
    return rigid.apply(np.linalg.inv(world_from_pixel), segments)[..., :2]


def enlarged(picture: Colours) -> Colours:
    """So that lines are finer than pixels."""
    return cv2.resize(picture, None, fx=ZOOM, fy=ZOOM, interpolation=cv2.INTER_LINEAR)


def ticked(picture: Colours, step_px: float) -> Colours:
    """A picture with ticks at its left edge, every so many px of the B-scan in depth."""
    result = picture.copy()
    for v in np.arange(step_px, len(picture) / ZOOM, step_px):
        row = round((v + 0.5) * ZOOM)
        result[row - 1 : row + 1, : 5 * ZOOM] = 255
    return result


def outlined(picture: Colours, segments: Mapping[str, Array]) -> Colours:
    """An enlarged picture with line segments : (k, 2, 2) px of the B-scan, by their colour."""
    result = np.ascontiguousarray(picture)
    for colour, lines in segments.items():
        rgb = tuple(int(colour[k : k + 2], 16) for k in (1, 3, 5))
        fine = np.int32(np.rint(16 * ((lines + 0.5) * ZOOM - 0.5)))
        cv2.polylines(result, list(fine), False, (*rgb, 255), ZOOM, cv2.LINE_AA, shift=4)
    return result
