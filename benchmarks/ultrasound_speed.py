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

from scenes.catalogue import build_scene
from twin.experiments.bmode_accuracy import peer
from twin.experiments.experiment_setup import Figures, Setup
from twin.ultrasound.beam import beam
from twin.ultrasound.bscan import scan, scans
from twin.ultrasound.echo_solids import body
from twin.ultrasound.probe_path import Hand, SurfacePath, along_surface
from twin.ultrasound.transducer import Transducer

FRAMES = 40


def frames(setup: Setup) -> Figures:
    """Frames a second on all cores, and the work of one frame on one."""
    array = setup.scanners["linear"]
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
    figures = {"width": array.image_size[0], "height": array.image_size[1], "thousands": count / 1e3, "cores": threads}
    return figures | {"rate_hz": 1 / seconds, "peer_hz": 1 / theirs, "frame_s": np.median(alone), "peer_s": theirs}


def wires(setup: Setup) -> Figures:
    """The whole command that renders what a probe is calibrated from, with code that is compiled."""
    with TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "sonotwin", "sweep", "scene=crosswire", "ultrasound=water", "path=wire"]
        for name in ("compiled", "timed"):
            start = perf_counter()
            subprocess.run([*command, f"out={Path(folder) / name}"], check=True, stdout=subprocess.DEVNULL)
            seconds = perf_counter() - start
    return {"seconds": seconds}


def scatterers(array: Transducer) -> float:
    """Number in the slice that an image of tissue all over takes account of."""
    spread = beam(array)
    depths = spread.depth_step_mm * np.arange(len(spread.core_mm))
    area = 2 * spread.core_mm[depths < array.depth_mm].sum() * spread.depth_step_mm
    return float(area * array.width_mm * array.scatterers_per_mm3)
