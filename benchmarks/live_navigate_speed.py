"""Live navigation of a recorded sweep, played back in real time: from the exposure to the published pose, with B-scans in place.

A program that takes all that the page is sent stands in for the browser, which draws on a graphics card elsewhere.
"""

import subprocess
import sys
import tempfile
from pathlib import Path
from time import process_time, sleep

import trimesh

from recon.devices import playback
from recon.navigation import mass_distances, still_scene
from recon.navigation.browser_view import BrowserView
from recon.navigation.navigator import Navigator, warm_up
from recon.navigation.slicer_publisher import SlicerPublisher
from sonotwin.config import load
from sonotwin.verbs import navigate, sweep
from twin.experiments.experiment_setup import Figures, Setup

LAG_S, RATE_HZ = 0.05, 25  # of the sweep as it is rendered; of cameras and scanner
FIRST_S, COUNTED_S = 12.0, 12.0  # of which the first are left out: the images are read, and latencies go ten seconds back
PORT = 18088
MASSES = {"mass0": (-9.3, -6.9, 680.6), "mass1": (28.9, -18.0, 676.7), "mass2": (26.2, 19.2, 681.6)}  # mm, centres
READER = """
import sys, viser
from websockets.sync.client import connect
with connect(sys.argv[1], subprotocols=["viser-v" + viser.__version__], max_size=None) as page:
    for message in page:
        pass
"""


class Sink:
    """An OpenIGTLink server without clients."""

    def transform(self, name, ras_from_frame, time_ns): ...

    def image(self, name, levels, ras_from_index, time_ns): ...

    def model(self, name, points, triangles): ...

    def text(self, name, text, time_ns): ...

    def close(self): ...


def navigated(setup: Setup) -> Figures:
    """A stroke over the breast, round and round, with skin and three masses."""
    with tempfile.TemporaryDirectory() as folder:
        capture = recorded(Path(folder))
        config = load("navigate", [f"capture={capture}", f"lag_s={LAG_S}"], navigate.Config)
        sources = navigate.sources_of(config)
        tracker = navigate.tracker_of(config, sources.sizes, sources.bits)
        probe = navigate.probe_of(config)
        scene = still_scene.read_scene(None, None, config.rig.target, probe, sources.width)
        masses = {name: trimesh.creation.icosphere(4, 8.0).apply_translation(centre) for name, centre in MASSES.items()}
        view = BrowserView(scene, PORT)
        warm_up(tracker)
        publishers, bodies = [SlicerPublisher(scene, Sink()), view], mass_distances.bodies_of(masses)
        navigator = Navigator((sources.cam1, sources.cam2), sources.scanner, tracker, probe, LAG_S, bodies, publishers)
        reader = subprocess.Popen([sys.executable, "-c", READER, view.address.replace("http", "ws")])
        navigator.start()
        try:
            sleep(FIRST_S)
            before = process_time()
            sleep(COUNTED_S)
            used = (process_time() - before) / COUNTED_S
        finally:
            navigator.stop()
            reader.terminate()
            reader.wait()
    late, scans = (each.figures() for each in (navigator.outlets[1].latencies, navigator.outlets[1].scans))
    if late is None or scans is None:
        raise RuntimeError("expected moments with B-scans in place, found none")
    latency = {"late_ms": late.median_ms, "latest_ms": late.high_ms, "delivery_ms": playback.DELIVERY_NS * 1e-6}
    return latency | {"scans_hz": scans.rate_hz, "cores": used}


def recorded(folder: Path) -> Path:
    """A filmed stroke of three seconds; returns the capture."""
    rates = [f"clocks.camera_hz={RATE_HZ}", f"clocks.scanner_hz={RATE_HZ}"]
    fields = ["scene=breast", "path=raster", "path.strokes=1", "filmed=true", *rates, f"out={folder}"]
    sweep.run(load("sweep", fields, sweep.Config))
    return folder / "capture"
