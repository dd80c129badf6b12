"""Results of the open benchmark as others write them, in plain files, against the sealed truth of each session."""

import hashlib
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates
from scipy.stats import rankdata

from recon.capture import calibration_files
from recon.errors import InputError
from recon.files import meshes, volumes
from recon.files.metrics import Metrics
from recon.files.volumes import Volume
from recon.geometry import rigid
from recon.geometry.surface_tree import nearest, signed_distances, surface_tree
from recon.model.calibration import Calibration
from recon.optical_calibration import figures_of_merit, uncertainty
from twin.evaluation import surface_errors, sweep_errors, track_errors
from twin.session import TruthFolder

Array = NDArray[np.float64]

ROUND, FORMAT = "benchmark.json", "sonotwin-benchmark/1"  # a round's description
TASKS = ("optics", "tracking", "surface", "ultrasound")
WANTED = {
    "optics": "calibration.yaml, .yml, .xml or .npz: both cameras",
    "tracking": "poses.csv: time_ns, found, m00 to m23 of world_from_target, mm",
    "surface": "surface.ply, .stl or .glb: triangles in camera 1's frame, mm",
    "ultrasound": "volume.mha or .nrrd in the world, and masses/*.ply or .stl, one closed mesh each; either alone will do",
}
DEPTHS_MM = (610.0, 660.0, 710.0)  # of held-out points
NEAR_MM = 1.0  # of a true place that counts as measured
FALSE_MM = 5.0  # from all that camera 1 sees: a point of something else
STEP = 7  # of the true pixels that are looked for in a surface, each way
MOST = 200_000  # points of a surface that are compared
SHELL_MM = 4.0  # about a mass, of tissue that it is told from
EDGE_MM = 1.0  # on both sides of a mass's border, that count as neither
PASSED_MM = 0.7  # from the plane of a B-scan: places that were imaged
POINTS = 4000  # drawn about each mass


def score(task: str, results: Path, truth: Path) -> Metrics:
    """Figures of a session's results, units in their names; none of what isn't there.

    Raises
    ------
    InputError
        If a file is damaged or of another kind.
    """
    scores: Mapping[str, Callable[[Path, Path], Metrics]] = {
        "optics": _optics,
        "tracking": _tracking,
        "surface": _surface,
        "ultrasound": _ultrasound,
    }
    return scores[task](results, truth) if results.is_dir() else {}


def _given(folder: Path, stem: str, *suffixes: str) -> Path | None:
    """The file of a stem, None if there is none; InputError if there are two."""
    found = [folder / f"{stem}.{suffix}" for suffix in suffixes if (folder / f"{stem}.{suffix}").exists()]
    if len(found) > 1:
        raise InputError(f"{folder}: expected one of {', '.join(path.name for path in found)}, found both")
    return found[0] if found else None


def _optics(results: Path, truth: Path) -> Metrics:
    """Errors of held-out points that both cameras see exactly."""
    path = _given(results, "calibration", "yaml", "yml", "xml", "npz")
    if path is None:
        return {}
    devices = TruthFolder(truth, "board").optics("cam1", "cam2")
    cameras = {name: devices[name] for name in ("cam1", "cam2")}
    found = calibration_files.read(path, {name: camera.size for name, camera in cameras.items()}).cameras
    if not found.keys() >= cameras.keys():
        raise InputError(f"{path}: expected cam1 and cam2, found {', '.join(found) or 'none'}")
    points = uncertainty.working_volume(Calibration(cameras), DEPTHS_MM)
    pixels = [camera.project(points) for camera in cameras.values()]
    met = figures_of_merit.triangulated([found[name] for name in cameras], pixels, points)
    figures = {"points_rms_mm": surface_errors.rms(np.linalg.norm(met - points, axis=1))}
    for name, seen in zip(cameras, pixels, strict=True):
        figures[f"{name}_rms_px"] = surface_errors.rms(np.linalg.norm(found[name].project(points) - seen, axis=1))
    return figures


def _tracking(results: Path, truth: Path) -> Metrics:
    """Errors of poses; part of the frames that show the target whole without a right pose, and of all frames with a wrong one."""
    path = _given(results, "poses", "csv")
    if path is None:
        return {}
    expected = track_errors.read_truth(truth)
    errors = track_errors.compare(track_errors.read_track(path, expected), expected)
    found, whole = track_errors.measure(errors, expected), track_errors.visible_whole(expected)
    right = (errors.shift_mm < track_errors.FALSE_MM) & (errors.turn_deg < track_errors.FALSE_DEG)
    kept = ("shift_median_mm", "shift_p95_mm", "turn_median_deg", "turn_p95_deg")
    shares = {
        "dropped_share": float(1 - right[whole].mean()) if whole.any() else np.nan,
        "false_share": found["track_false"] / found["track_frames"],
    }
    return {name: found[f"track_{name}"] for name in kept} | shares


def _surface(results: Path, truth: Path) -> Metrics:
    """Distances to the truth that camera 1 sees, and from what camera and projector see."""
    path = _given(results, "surface", "ply", "stl", "glb")
    if path is None:
        return {}
    return surface_figures(meshes.read_model(path, "a surface"), surface_errors.read_truth(truth))


def surface_figures(mesh: trimesh.Trimesh, expected: surface_errors.Truth) -> Metrics:
    """Figures of a mesh in the world: distances of its places to the true tangent planes, and completeness.

    Complete is what camera 1 sees and the projector lights and has the mesh within NEAR_MM. For it the mesh's part about the
    truth has places of its own, so that sheets far away take none from it.
    """
    there = np.isfinite(expected.points).all(axis=-1)
    points, normals = np.float64(expected.points[there]), np.float64(expected.normals[there])
    places = np.asarray(trimesh.sample.sample_surface(mesh, MOST, seed=0)[0])
    apart, number = nearest(surface_tree(points), places)
    off = ((places - points[number]) * normals[number]).sum(axis=1)
    of_it = apart < FALSE_MM
    chosen = expected.lit[::STEP, ::STEP]
    lit, outwards = (np.float64(of[::STEP, ::STEP][chosen]) for of in (expected.points, expected.normals))
    low, high = points.min(axis=0) - FALSE_MM, points.max(axis=0) + FALSE_MM
    about = (mesh.triangles.max(axis=1) > low).all(axis=1) & (mesh.triangles.min(axis=1) < high).all(axis=1)
    if about.any() and not about.all():
        places = np.asarray(trimesh.sample.sample_surface(mesh.submesh([np.flatnonzero(about)], append=True), MOST, seed=0)[0])
    back, number = nearest(surface_tree(places), lit)
    met = back < FALSE_MM
    along = np.abs(((places[number] - lit) * outwards).sum(axis=1))[met]  # not by how finely places lie on the surface
    return {
        "to_truth_rms_mm": surface_errors.rms(off[of_it]),
        "to_truth_median_mm": float(np.median(np.abs(off[of_it]))) if of_it.any() else np.nan,
        "from_truth_median_mm": float(np.median(along)) if met.any() else np.nan,
        "complete_share": float((back < NEAR_MM).mean()),
        "false_share": float(1 - of_it.mean()),
    }


def _ultrasound(results: Path, truth: Path) -> Metrics:
    """Masses by their centres and volumes, and a volume by how it tells masses from the tissue about them."""
    path, folder = _given(results, "volume", "mha", "nrrd"), results / "masses"
    if path is None and not folder.is_dir():
        return {}
    expected = sweep_errors.read_truth(truth)
    figures: Metrics = {}
    if folder.is_dir():
        found = [meshes.read_model(one, "a mass") for one in sorted(folder.iterdir())]
        for one, mesh in zip(sorted(folder.iterdir()), found, strict=True):
            if not mesh.is_watertight:
                mesh.merge_vertices()
            if not mesh.is_watertight or mesh.volume <= 0:
                raise InputError(f"{one}: expected a closed mesh with its faces outwards, found an open or inverted one")
        findings = [one for one in sweep_errors.compare(found, expected.hidden) if one.found is not None]
        ratios = [abs(one.found.volume / one.true.volume - 1) for one in findings if one.found is not None]
        figures |= {
            "masses_found_share": len(findings) / len(expected.hidden),
            "masses_false_count": len(found) - len(findings),
            "centre_error_mm": float(np.mean([one.centre_error_mm for one in findings])) if findings else np.nan,
            "volume_error_share": float(np.mean(ratios)) if findings else np.nan,
        }
    if path is not None:
        figures |= volume_figures(volumes.read_volume(path), expected)
    return figures


def volume_figures(volume: Volume, expected: sweep_errors.SweepTruth) -> Metrics:
    """Area under the curve by which levels tell dark masses from tissue, at true places that were imaged; and their share seen.

    1 parts both wholly, 0.5 is chance. Places that the volume doesn't cover count for neither, but lower the share.
    """
    areas, shares = [], []
    for number, thing in enumerate(expected.hidden):
        low, high = thing.mesh.bounds
        drawn = np.random.default_rng(number).uniform(low - SHELL_MM, high + SHELL_MM, (POINTS, 3))
        depth = signed_distances(drawn, thing.mesh)
        others = [signed_distances(drawn, other.mesh) for other in expected.hidden if other is not thing]
        alone = np.min([np.full(POINTS, np.inf), *others], axis=0) > EDGE_MM
        chosen = passed(drawn, expected) & (np.abs(depth) > EDGE_MM) & (depth < SHELL_MM) & alone
        places, inside = drawn[chosen], depth[chosen] < 0
        if not (inside.any() and (~inside).any()):
            continue
        index = rigid.apply(np.linalg.inv(volume.world_from_voxel), places)
        levels = map_coordinates(np.float64(volume.voxels), index.T[::-1], order=1, mode="constant", cval=np.nan)
        seen = np.isfinite(levels)
        shares.append(seen.mean())
        first, second = levels[seen & inside], levels[seen & ~inside]
        if len(first) and len(second):
            ranks = rankdata(np.concatenate([second, first]))[: len(second)].sum()
            areas.append((ranks - len(second) * (len(second) + 1) / 2) / (len(first) * len(second)))
    return {
        "volume_seen_share": float(np.mean(shares)) if shares else np.nan,
        "volume_auc": float(np.mean(areas)) if areas else np.nan,
    }


def passed(places: Array, expected: sweep_errors.SweepTruth) -> NDArray[np.bool_]:
    """Places : (n, 3) mm that a B-scan passed : (n,)."""
    width, height = np.array(expected.transducer.scale_mm_per_px) * (np.array(expected.transducer.image_size) - 1)
    found = np.zeros(len(places), bool)
    for pose in expected.world_from_image:
        x, y, z = rigid.apply(rigid.invert(pose), places).T
        found |= (np.abs(z) < PASSED_MM) & (x >= 0) & (x <= width) & (y >= 0) & (y <= height)
    return found


def files_of(folder: Path) -> Iterator[tuple[str, str]]:
    """Places below a folder, in order, with their files' SHA-256; lists of who wrote a folder are left out."""
    for path in sorted(path for path in folder.rglob("*") if path.is_file() and path.name != ".sonotwin.json"):
        yield path.relative_to(folder).as_posix(), hashlib.sha256(path.read_bytes()).hexdigest()


def digest(folder: Path) -> str:
    """SHA-256 of a folder's list of checksums."""
    return hashlib.sha256("".join(f"{digest}  {place}\n" for place, digest in files_of(folder)).encode()).hexdigest()
