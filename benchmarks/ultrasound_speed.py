"""B-scans of the breast on the path of a hand, everything on, against PyMUST's time for one frame; and crossed wires.

The peer is measured apart, by `benchmarks/pymust_peer.py`, on one core: a plane wave on as many scatterers as the slice has.
"""

import subprocess
import sys
from collections import deque
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter, process_time

import numba
import numpy as np
import yaml

from scenes.catalogue import build_scene
from sonotwin.config import folder
from twin.experiments.bmode_accuracy import peer
from twin.experiments.table_rows import Measurement, Row
from twin.ultrasound.beam import beam
from twin.ultrasound.bscan import scan, scans
from twin.ultrasound.echo_solids import body
from twin.ultrasound.probe_path import Hand, SurfacePath, along_surface
from twin.ultrasound.transducer import Transducer

FRAMES = 40


def measurements() -> list[Measurement]:
    """The rows of the group."""
    return [frames, wires]


def frames() -> list[Row]:
    """Row b: frames a second on all cores, and the work of one frame on one."""
    array = Transducer.model_validate(yaml.safe_load((folder() / "ultrasound" / "linear.yaml").read_text(encoding="utf-8")))
    made = body(build_scene({"kind": "breast"}))
    skin = next(one for one in made.solids if one.name == "breast")
    path = along_surface(SurfacePath(start_mm=(-10, -20), end_mm=(-10, 10), speed_mm_s=30, hand=Hand()), skin, array, 1)
    poses = path.poses[np.linspace(0, len(path.poses) - 1, FRAMES).astype(int)]

    scan(made, array, poses[0], 1)
    start = perf_counter()
    deque(scans(made, array, poses, 1), maxlen=0)
    seconds, threads = (perf_counter() - start) / FRAMES, numba.get_num_threads()
    numba.set_num_threads(1)
    alone = []
    for frame, pose in enumerate(poses):
        start = process_time()
        scan(made, array, pose, 1, frame)
        alone.append(process_time() - start)
    numba.set_num_threads(threads)
    count = scatterers(array)
    theirs = peer()["plane_wave"]["seconds"] * count / peer()["plane_wave"]["scatterers"]
    what = f"breast, {array.image_size[0]}x{array.image_size[1]}, some {count / 1e3:.0f} 000 scatterers"
    return [
        Row("b", f"{what}: frames a second, {threads} cores", 1 / seconds, 20, 1 / theirs, "1/s", at_least=True),
        Row("b", f"{what}: one frame, seconds of one core", float(np.median(alone)), 0.2, theirs, "s"),
    ]


def wires() -> list[Row]:
    """Row w: the whole command that renders what a probe is calibrated from, with code that is compiled."""
    with TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "sonotwin", "sweep", "scene=crosswire", "ultrasound=water", "path=wire"]
        for name in ("compiled", "timed"):
            start = perf_counter()
            subprocess.run([*command, f"out={Path(folder) / name}"], check=True, stdout=subprocess.DEVNULL)
            seconds = perf_counter() - start
    return [Row("w", "30 B-scans of crossed wires, rendered and written, the whole command", seconds, 8, None, "s")]


def scatterers(array: Transducer) -> float:
    """Number in the slice that an image of tissue all over takes account of."""
    spread = beam(array)
    depths = spread.depth_step_mm * np.arange(len(spread.core_mm))
    area = 2 * spread.core_mm[depths < array.depth_mm].sum() * spread.depth_step_mm
    return float(area * array.width_mm * array.scatterers_per_mm3)
