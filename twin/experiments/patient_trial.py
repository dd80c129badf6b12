"""Masses of a patient drawn by a seed, who breathes and yields to the probe, as the software finds them today.

Poses have the noise of `PoseNoise`; probe, lag and the mean speed of sound are known. The skin is that of her rest.
"""

from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import trimesh

from recon.files.metrics import Metrics
from recon.segmentation import contact
from recon.session import masses_step
from scenes.catalogue import parse_scene
from scenes.kinds.patient import draw_masses, skin_of
from twin.evaluation import sweep_errors
from twin.experiments.experiment_runs import Experiment, Settings
from twin.filmed_sweep import SweepSettings, plan_sweep
from twin.living.living_body import Living
from twin.session import CAPTURE, Session
from twin.ultrasound import sweep_session
from twin.ultrasound.probe_path import SurfacePath
from twin.ultrasound.timed_sweep import Clocks

PATH = SurfacePath(
    start_mm=(-22.0, -31.0), end_mm=(-22.0, 36.0), strokes=2, stroke_step_mm=44.0, speed_mm_s=15.0, standoff_mm=-2.0
)
LIVING = Living(yields=True, breathing_mm=2.0, breathing_deg=0.3, heartbeat_mm=0.2, drag_mm=1.0, element_mm=5.0)
CLOCKS = Clocks(scanner_hz=15.0)  # a B-scan a millimetre
TISSUE_M_S = 1500.0  # mean of fat and gland
SEED = 500  # of the first patient
DENSITIES = ("fatty", "scattered", "heterogeneous", "dense")


def patient(seed: int) -> dict:
    """A patient with two or three masses of 8 to 20 mm, none within another.

    Raises
    ------
    InputError
        If no place is found for them.
    """
    scene = {"kind": "patient", "seed": SEED + seed, "edge_mm": 1.5, "anatomy": {"density": DENSITIES[seed % len(DENSITIES)]}}
    config = parse_scene(scene)[1]
    masses = draw_masses(config, skin_of(config), np.random.default_rng([seed, 48]))
    return scene | {"masses": [one.model_dump(mode="json") for one in masses]}


def measure(settings: Settings, seed: int) -> Metrics:
    """Figures of one patient; NaN of what wasn't found."""
    chosen = SweepSettings(
        rig=settings.rig,
        scene=patient(seed),
        ultrasound=settings.ultrasound,
        path=PATH,
        living=LIVING,
        clocks=CLOCKS,
        seed=seed,
    )
    planned = plan_sweep(chosen)
    skin = next(thing.mesh for thing in planned.scene.things if thing.name == "breast")
    hidden = [thing for thing in planned.scene.things if thing.inside]
    with TemporaryDirectory() as folder:
        session = Session(Path(folder), "sweep", chosen.model_dump(mode="json"))
        probe = sweep_session.calibration_of(chosen.rig, chosen.ultrasound)
        taken = (planned.scene, planned.scanned, chosen.ultrasound, planned.plan, planned.scans(), probe)
        sweep_session.write_session(session, *taken)
        fields = {"capture": Path(folder) / CAPTURE, "lag_s": CLOCKS.lag_s, "tissue_m_s": TISSUE_M_S}
        scans = masses_step.read(masses_step.Settings(**fields))
        found = list(masses_step.find(scans, masses_step.Method(overlays=0), sweep_errors.facing(skin)).meshes.values())
        touch = contact.measure(scans, sweep_errors.facing(skin))
    pairs = sweep_errors.compare(found, hidden)
    here = [pair for pair in pairs if pair.found is not None]
    volumes = [abs(pair.found.volume / pair.true.volume - 1) for pair in here if isinstance(pair.found, trimesh.Trimesh)]
    return {
        "masses_true": len(hidden),
        "masses_found": len(here),
        "masses_false": len(found) - len(here),
        "centre_error_mm": float(np.mean([pair.centre_error_mm for pair in here])) if here else np.nan,
        "volume_error_percent": 100 * float(np.mean(volumes)) if here else np.nan,
        "contact_mm": touch.median_mm,
    }


EXPERIMENT = Experiment(
    ("rig.probe", "ultrasound"), measure, {"masses_found": "", "masses_false": "", "centre_error_mm": "", "contact_mm": ""}
)
