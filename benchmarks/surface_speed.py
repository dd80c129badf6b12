"""Fringe analysis: from nine images to points, against plain NumPy with a flood fill."""

from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter

import numpy as np

from benchmarks import plain_numpy
from recon.capture.images import read_images, write_images
from recon.structured_light.decode import decode
from recon.structured_light.surface_mesh import clean
from recon.structured_light.triangulate import PointMap, Triangulator
from scenes.catalogue import build_scene
from twin.experiments.experiment_setup import Figures, Setup
from twin.experiments.surface_accuracy import TRACING
from twin.optics.surface_session import Shooting, calibration_of, shoot

REPEATS = 15


def nine_images(setup: Setup) -> Figures:
    """The paper's sequence of the breast, 1280x1024. Both have the calibrated camera's rays in a table."""
    rig, patterns = setup.rig, setup.sequences["paper_surface"]
    images = shoot(rig, build_scene({"kind": "breast"}), patterns, "cam1", TRACING, Shooting(), seed=1).images
    cameras = calibration_of(rig).cameras
    camera, projector = cameras["cam1"], cameras["projector"]
    triangulate = Triangulator(camera, projector)
    found = decode(images, patterns)
    points = triangulate(found)
    rays = camera.rays(camera.pixel_grid())
    columns, _ = plain_numpy.reconstruct(images, patterns, rays, camera.centre, projector)
    assert found.columns is not None
    both = np.isfinite(columns) & np.isfinite(found.columns)
    agree = float(np.mean(np.abs(columns[both] - found.columns[both]) < 0.01))

    decoding = median_ms(lambda: decode(images, patterns))
    triangulating = median_ms(lambda: triangulate(found))
    cleaning = median_ms(lambda: clean(points, camera, found.modulation))
    peer = median_ms(lambda: plain_numpy.reconstruct(images, patterns, rays, camera.centre, projector), repeats=3)
    together = decoding + triangulating
    parts = {"decoding_ms": decoding, "triangulating_ms": triangulating, "cleaning_ms": cleaning, "agree": agree}
    return parts | {"together_ms": together, "peer_ms": peer, "times_faster": peer / together}


def from_files(setup: Setup) -> Figures:
    """The same as a user with one capture waits for it: images read, rays and all; the peer is the authors' way."""
    rig, patterns = setup.rig, setup.sequences["paper_surface"]
    shot = shoot(rig, build_scene({"kind": "breast"}), patterns, "cam1", TRACING, Shooting(), seed=1)
    cameras = calibration_of(rig).cameras
    camera, projector = cameras["cam1"], cameras["projector"]
    with TemporaryDirectory() as place:
        paths = [Path(place) / f"{number}.png" for number in range(len(shot.images))]
        write_images(paths, shot.images)

        def ours() -> PointMap:
            return Triangulator(camera, projector)(decode(read_images(paths, camera.size, 8), patterns))

        points = ours().points
        mask = np.isfinite(points[..., 0])
        theirs = plain_numpy.from_files(paths, patterns, mask, camera, projector)
        apart = float(np.median(np.linalg.norm(points[mask] - theirs, axis=-1)))
        whole = median_ms(ours)
        peer = median_ms(lambda: plain_numpy.from_files(paths, patterns, mask, camera, projector), repeats=5)
    return {"whole_ms": whole, "peer_ms": peer, "times_faster": peer / whole, "apart_mm": apart}


def median_ms(work: Callable[[], object], repeats: int = REPEATS) -> float:
    """Median time of some work in ms, after one run that doesn't count."""
    work()
    times = []
    for _ in range(repeats):
        start = perf_counter()
        work()
        times.append(1e3 * (perf_counter() - start))
    return float(np.median(times))
