"""A laboratory that films its sweeps: optics calibrated, target tracked and probe calibrated by our method and by the paper's.

B-scans and frames are rendered; the board of the cameras' calibration is drawn, with the noise of rendered ones. Both methods get
the same images, and the same latency, measured as exactly as over a flat bottom.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import trimesh

from recon.model.calibration import Calibration
from recon.model.rig import Rig
from recon.probe_calibration.phantom_frames import PhantomFrames
from recon.probe_calibration.tank_calibration import Result
from recon.probe_calibration.tank_calibration import Settings as Tank
from recon.session import probe_step, skin_step
from recon.structured_light.triangulate import triangulate
from recon.tracking import networks
from recon.tracking.networks import Networks
from scenes.catalogue import build_scene
from twin.conditions import drifted
from twin.experiments import drawn_session, probe_accuracy, surface_accuracy, tracked_sweep
from twin.experiments.baselines import opencv_peer, published_probe
from twin.experiments.baselines.published_probe import Solved
from twin.experiments.drawn_session import WATER_C
from twin.experiments.experiment_runs import Settings
from twin.experiments.layout import laid_out
from twin.experiments.surface_accuracy import Experiment as Shot
from twin.experiments.tracked_sweep import Optics, TrackedSweep
from twin.experiments.tube_accuracy import WATER
from twin.filmed_sweep import SweepSettings, plan_sweep
from twin.shooting import FrameShooting
from twin.ultrasound.sweep_session import AnyPath
from twin.ultrasound.timed_sweep import Clocks
from twin.ultrasound.transducer import Transducer

AT_REST_HZ = 5.0  # pairs of frames: two or three in each rest, less apart than poses are interpolated over
NOT_KEPT = "not among those that are kept"
READS = (  # of a study's settings
    *("rig", "layout", "patterns", "poses", "conditions", "tracing", "shooting", "film.white_dn", "wire_path", "ranges"),
    *("noise.board_px", "noise.click_px", "noise.latency_s", "noise.drawn.board", "noise.drawn.latency"),
)


@dataclass(frozen=True)
class FilmedLaboratory:
    """What all sweeps of a laboratory share."""

    settings: Settings
    seed: int
    rig: Rig
    optics: Optics
    latency_s: float  # as measured
    networks: Networks
    folder: Path  # for B-scans


@contextmanager
def opened(settings: Settings, seed: int) -> Iterator[FilmedLaboratory]:
    """A laboratory with calibrated optics, and a folder as long as it is open."""
    rig = laid_out(settings.rig, settings.layout)
    board = drawn_session.calibrated_board(rig, settings.conditions, settings.noise, settings.poses, seed)
    as_seen = np.zeros_like(board.observations.pixels)  # ellipses' middles, uncorrected
    cameras, light = (opencv_peer.stereo(board.observations, name, as_seen) for name in ("cam2", "projector"))
    optics = Optics(board.adjustment.calibration, cameras, light)
    level = settings.noise.drawn.latency * settings.noise.latency_s
    latency = Clocks().lag_s + level * float(np.random.default_rng([seed, 31]).standard_normal())
    with TemporaryDirectory() as folder:
        yield FilmedLaboratory(settings, seed, rig, optics, latency, networks.load(kind=rig.target.kind), Path(folder))


def swept(lab: FilmedLaboratory, name: str, scene: dict, path: AnyPath, clocks: Clocks, transducer: Transducer) -> TrackedSweep:
    """Lead the probe, render and track."""
    settings = SweepSettings(
        rig=lab.rig,
        scene=scene,
        ultrasound=transducer,
        path=path,
        conditions=lab.settings.conditions,
        clocks=clocks,
        name=name,
        filmed=True,
        frames=FrameShooting(white_dn=lab.settings.film.white_dn),
        seed=lab.seed,
    )
    return tracked_sweep.track(plan_sweep(settings), lab.optics, lab.networks, lab.settings.ranges, lab.folder)


def wires(lab: FilmedLaboratory, number: int) -> TrackedSweep:
    """The probe at rest in poses about crossed wires, others in each calibration."""
    settings = lab.settings
    path = settings.wire_path.model_copy(update={"first": settings.wire_path.first + number * settings.wire_path.count})
    return swept(lab, f"wires{number}", {"kind": "crosswire"}, path, Clocks(camera_hz=AT_REST_HZ), WATER)


def crossings(lab: FilmedLaboratory, sweep: TrackedSweep) -> PhantomFrames:
    """The first 30 B-scans in which the crossing is seen while both methods have a pose."""
    own, seen = sweep.ours, np.isfinite(sweep.published_at(lab.latency_s)).all(axis=(1, 2))
    found = probe_step.look(own, lag_s=lab.latency_s)
    kept = found.usable[seen[found.usable]][: probe_accuracy.IMAGES]
    some = tuple(replace(one, reason=one.reason or (None if k in kept else NOT_KEPT)) for k, one in enumerate(found.seen))
    return replace(found, sightings=found.sightings.of(np.isin(found.usable, kept)), seen=some)


def calibrated(lab: FilmedLaboratory, found: PhantomFrames) -> Result:
    """Our calibration."""
    return probe_step.calibrate(found, lab.rig.probe, Tank(temperature_c=WATER_C, wire_radius_sigma_mm=0.0)).result


def published(lab: FilmedLaboratory, found: PhantomFrames, sweep: TrackedSweep, rng: np.random.Generator) -> Solved:
    """The published calibration, of the same crossings, clicked by hand."""
    clicks = published_probe.clicked(found.sightings.pixels, lab.settings.noise.click_px, rng)
    return published_probe.calibrate(sweep.published_at(lab.latency_s)[found.usable], clicks)


def by_light(lab: FilmedLaboratory, scene: dict) -> Shot:
    """A scene under fringes, by devices that have drifted since they were calibrated."""
    chosen = lab.settings
    rig = drifted(lab.rig, chosen.conditions.drift, lab.seed)
    made = build_scene(scene)
    return surface_accuracy.experiment(rig, made, chosen.patterns, lab.seed, chosen.tracing, chosen.shooting, chosen.conditions)


def meshed(shot: Shot, calibration: Calibration) -> trimesh.Trimesh:
    """The surface of a decoded shot by a calibration."""
    camera, projector = calibration.cameras["cam1"], calibration.cameras["projector"]
    return skin_step.surface_of(shot.found, triangulate(shot.found, camera, projector), camera).mesh
