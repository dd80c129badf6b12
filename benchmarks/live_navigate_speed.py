"""Live navigation of recorded sweeps, played back in real time: from the exposure to the published pose, with B-scans in place;
and beside a needle and a patient, with the needle's distances from masses.

A program that takes all that the page is sent stands in for the browser, which draws on a graphics card elsewhere.
"""

import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from time import process_time, sleep

import numpy as np
import trimesh
from numpy.typing import NDArray

from recon.capture import sweep_tables, tip_files
from recon.devices import playback
from recon.geometry import rigid
from recon.model.rig import PATIENT
from recon.model.tip import Tip
from recon.model.tracks import Track
from recon.navigation import mass_distances, still_scene, tool_distances, tool_figures
from recon.navigation.browser_view import BrowserView
from recon.navigation.moving_bodies import MovingBodies
from recon.navigation.navigator import Navigator, warm_up
from recon.navigation.publishing import Moment
from recon.navigation.slicer_publisher import SlicerPublisher
from scenes.handheld.body_look import look_of
from sonotwin.config import load
from sonotwin.verbs import navigate, sweep
from twin.evaluation import track_errors
from twin.experiments.experiment_setup import Figures, Setup

LAG_S, RATE_HZ = 0.05, 25  # of the sweep as it is rendered; of cameras and scanner
FIRST_S, COUNTED_S = 12.0, 12.0  # of which the first are left out: the images are read, and latencies go ten seconds back
PORT = 18088
MASSES = {"mass0": (-9.3, -6.9, 680.6), "mass1": (28.9, -18.0, 676.7), "mass2": (26.2, 19.2, 681.6)}  # mm, centres
MASS_MM = 8.0  # their radius
NEEDLE, TIP_SIGMA_MM = "needle", 0.1
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


class Kept:
    """A publisher that keeps all moments."""

    name = "kept"

    def __init__(self, moments: list[Moment]) -> None:
        self._moments = moments

    def publish(self, moment: Moment) -> None:
        self._moments.append(moment)

    def close(self) -> None: ...


def navigated(setup: Setup) -> Figures:
    """A stroke over the breast, round and round, with skin and three masses."""
    with tempfile.TemporaryDirectory() as folder:
        fields = ["scene=breast", "path=raster", "path.strokes=1"]
        capture = recorded(Path(folder), fields)
        return watched(load("navigate", [f"capture={capture}", f"lag_s={LAG_S}"], navigate.Config))


def navigated_with_tools(setup: Setup) -> Figures:
    """A probe held over the breast while a needle is led to the B-scan, round and round, beside the patient's target."""
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        capture = recorded(folder, ["rig=three_bodies", "scene=breast", "path=hold", "path.seconds=6"])
        truth = {body: track_errors.read_truth(folder / "truth", body=body) for body in (NEEDLE, PATIENT)}
        tip_mm = look_of(NEEDLE).tip_mm(load("navigate", ["capture=x", "rig=three_bodies"], navigate.Config).rig.bodies[NEEDLE])
        tip_files.write(folder / "tip.yaml", Tip(tip_mm, TIP_SIGMA_MM**2 * np.eye(3), body=NEEDLE))
        true = {body: Track(each.times, each.poses) for body, each in truth.items()}
        sweep_tables.write_track(folder / "reference.csv", Track(true[PATIENT].times[:1], true[PATIENT].poses[:1]))
        given = [f"tips.{NEEDLE}={folder / 'tip.yaml'}", f"reference={folder / 'reference.csv'}"]
        config = load("navigate", [f"capture={capture}", f"lag_s={LAG_S}", "rig=three_bodies", *given], navigate.Config)
        kept: list[Moment] = []
        figures = watched(config, kept)
        timeline = playback.timeline_of(playback.read_recording(capture))
        off = [each for moment in kept for each in _off(moment, timeline, true[NEEDLE], tip_mm)]
    return figures | {
        "off_95_mm": float(np.quantile(off, 0.95)),
        "told_percent": 100 * len(off) / max(len(kept), 1) / len(MASSES),
    }


def watched(config: navigate.Config, kept: list[Moment] | None = None) -> Figures:
    """Navigate for some seconds with a page that somebody looks at, and keep the moments of those that count."""
    sources = navigate.sources_of(config)
    tracker = navigate.tracker_of(config, sources.sizes, sources.bits)
    probe, tools, reference = navigate.probe_of(config), navigate.tools_of(config), navigate.reference_of(config)
    scene = still_scene.read_scene(None, None, config.rig.target, probe, sources.width, tools=tools)
    masses = {name: trimesh.creation.icosphere(4, MASS_MM).apply_translation(centre) for name, centre in MASSES.items()}
    surfaces = {name: tool_distances.surface_of(mass.vertices, mass.faces) for name, mass in masses.items()} if tools else {}
    view = BrowserView(scene, PORT)
    warm_up(tracker)
    publishers = [SlicerPublisher(scene, Sink()), view, *([] if kept is None else [Kept(kept)])]
    navigator = Navigator(
        (sources.cam1, sources.cam2), sources.scanner, tracker, probe, config.lag_s, mass_distances.bodies_of(masses), publishers,
        moving=MovingBodies(tools, surfaces, None, reference),
    )  # fmt: skip
    reader = subprocess.Popen([sys.executable, "-c", READER, view.address.replace("http", "ws")])
    navigator.start()
    try:
        sleep(FIRST_S)
        if kept is not None:
            kept.clear()
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
    return latency | {"poses_hz": late.rate_hz, "scans_hz": scans.rate_hz, "cores": used}


def recorded(folder: Path, fields: list[str]) -> Path:
    """A filmed sweep; returns the capture."""
    rates = [f"clocks.camera_hz={RATE_HZ}", f"clocks.scanner_hz={RATE_HZ}"]
    sweep.run(load("sweep", [*fields, "filmed=true", *rates, f"out={folder}"], sweep.Config))
    return folder / "capture"


def _off(moment: Moment, timeline: playback.Timeline, true: Track, tip: NDArray[np.float64]) -> Iterator[float]:
    """Errors, mm, of the needle's distances from the masses at a moment; none where the needle or the patient isn't seen."""
    figures = tool_figures.body_of(moment, NEEDLE).figures
    if figures is None or moment.frame_ns is None:
        return
    recorded = timeline.first + (moment.frame_ns - timeline.first) % timeline.length
    place = rigid.apply(true.poses[int(np.abs(true.times - recorded).argmin())], tip)
    for name, centre in MASSES.items():
        yield abs(figures.masses[name].mm - (np.linalg.norm(place - centre) - MASS_MM))
