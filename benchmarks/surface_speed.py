"""Fringe analysis: from nine images to points, against plain NumPy with a flood fill."""

from collections.abc import Callable
from time import perf_counter

import numpy as np

from benchmarks import plain_numpy
from recon.capture.surface_part import read_patterns
from recon.model.rig import Rig
from recon.structured_light.decode import decode
from recon.structured_light.surface_mesh import clean
from recon.structured_light.triangulate import Triangulator
from scenes.catalogue import build_scene
from sonotwin.config import compose, folder
from twin.accuracy.surface_accuracy import TRACING
from twin.accuracy.table_rows import Measurement, Row
from twin.optics.surface_session import Shooting, calibration_of, shoot

REPEATS = 15


def measurements() -> list[Measurement]:
    """The rows of the group."""
    return [nine_images]


def nine_images() -> list[Row]:
    """Row h: the paper's sequence of the breast, 1280x1024. Both have the calibrated camera's rays in a table."""
    rig = Rig.model_validate(compose("render", ["out=unused"])["rig"])
    patterns = read_patterns(folder() / "patterns" / "paper_surface.yaml")
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
    name = "breast, 9 images 1280x1024"
    return [
        Row("h", f"{name}: decode and triangulate, median", together, 150, peer, "ms"),
        Row("h", f"{name}: of that, decode with noise and unwrapping", decoding, 110, None, "ms"),
        Row("h", f"{name}: of that, triangulate with both distortions", triangulating, 40, None, "ms"),
        Row("h", f"{name}: clean, after that", cleaning, 60, None, "ms"),
        Row("h", f"{name}: times faster than NumPy and a flood fill", peer / together, 5, 1, "x", at_least=True),
        Row("h", f"{name}: share of pixels where both agree to 0.01 px", agree, 0.99, 1, "", at_least=True),
    ]


def median_ms(work: Callable[[], object], repeats: int = REPEATS) -> float:
    """Median time of some work in ms, after one run that doesn't count."""
    work()
    times = []
    for _ in range(repeats):
        start = perf_counter()
        work()
        times.append(1e3 * (perf_counter() - start))
    return float(np.median(times))
