"""Recording: a surface from virtual devices beside one that is rendered into a folder, and sweeps whose recorder is killed."""

import signal
import subprocess
import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from recon.acquisition.exposure_setting import Exposing
from recon.acquisition.frame_checks import Limits
from recon.acquisition.pictures import hidden
from recon.acquisition.recording import open_recording
from recon.acquisition.surface_recording import SurfacePlan, record_surface
from recon.artwork.projected_images import images
from recon.capture import sweep_tables
from recon.capture.images import read_image, read_images
from recon.capture.manifest import STAMPS, image_name, read_manifest
from recon.devices.pattern_player import Stage, Triggered
from recon.structured_light.decode import decode
from recon.structured_light.surface_mesh import clean
from recon.structured_light.triangulate import triangulate
from scenes.catalogue import build_scene
from twin.devices.virtual_session import StillSettings, before_scene
from twin.evaluation import surface_errors
from twin.experiments.experiment_setup import Figures, Setup
from twin.experiments.surface_accuracy import TRACING, experiment
from twin.optics.surface_session import calibration_of

KILLS, SEED = 20, 5
SIZE = (320, 240)
RECORDER = """
import sys, numpy as np
from pathlib import Path
from recon.acquisition.recording import open_recording
from recon.capture.manifest import Device
rng, devices = np.random.default_rng(0), {"cam1": Device(size=(320, 240)), "cam2": Device(size=(320, 240))}
with open_recording(Path(sys.argv[1])) as capture, capture.sweep(sys.argv[2], None, devices) as sweep:
    for k in range(100_000):
        for device in devices:
            sweep.add(device, k, k, rng.integers(0, 256, (240, 320), np.uint8))
            print(device, k, flush=True)
"""


def recorded_surface(setup: Setup) -> Figures:
    """RMS error of a recorded surface beside that of a rendered one, of the same scene, rig and exposure."""
    patterns, scene = setup.sequences["paper_surface"], {"kind": "breast"}
    made = experiment(setup.rig, build_scene(scene), patterns)
    shown = list(images(patterns))
    devices = before_scene(StillSettings(setup.rig, TRACING, ["cam1"], seed=SEED), scene, shown)
    plan = SurfacePlan(patterns, shown, Exposing(exposure_s=made.view.exposure.time_s), Limits())
    with TemporaryDirectory() as folder:
        with open_recording(Path(folder) / "capture") as recording:
            stage = Stage(devices.projector, devices.cameras, Triggered())
            record_surface(recording, stage, devices.operator, plan, lambda text: None, hidden)
        surface = read_manifest(Path(folder) / "capture").surface
        assert surface is not None
        taken = read_images([Path(folder) / "capture" / path for path in surface.images["cam1"]], devices.cameras["cam1"].size, 8)
    cameras, found = calibration_of(setup.rig).cameras, decode(taken, patterns)
    points = clean(triangulate(found, cameras["cam1"], cameras["projector"]), cameras["cam1"], found.modulation)
    compared = surface_errors.compare(points.points, points.sigma, made.truth)
    recorded = surface_errors.measure(points.points, compared, made.truth)["surface_rms_mm"]
    return {"difference": abs(recorded / made.metrics["surface_rms_mm"] - 1)}


def killed(setup: Setup) -> Figures:
    """Frames lost or unread after `kill -9` at random moments, and those recorded."""
    rng, lost, kept = np.random.default_rng(SEED), 0, 0
    with TemporaryDirectory() as folder:
        capture = Path(folder) / "capture"
        for number in range(KILLS):
            line = [sys.executable, "-c", RECORDER, str(capture), f"s{number}"]
            process = subprocess.Popen(line, stdout=subprocess.PIPE, text=True)
            assert process.stdout is not None
            said = [process.stdout.readline()]
            time.sleep(rng.uniform(0.0, 0.5))
            process.send_signal(signal.SIGKILL)
            said += process.communicate()[0].splitlines(keepends=True)
            whole = {name for name in said if name.endswith("\n")}
            there = _readable(capture, f"s{number}")
            lost, kept = lost + len(whole - there), kept + len(there)
    return {"recorders": KILLS, "lost": lost, "read": kept}


def _readable(capture: Path, name: str) -> set[str]:
    """Frames that the ordinary readers read, each as the recorder names it."""
    found = set()
    for device, place in read_manifest(capture).sweeps[name].images.items():
        frames, _ = sweep_tables.read_stamps(capture / place / STAMPS)
        for frame in frames.tolist():
            read_image(capture / place / image_name(frame), SIZE, 8)
            found.add(f"{device} {frame}\n")
    return found
