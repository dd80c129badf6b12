"""Accuracy of masses segmented in tracked B-scans: the breast's tumours against their meshes, under the measured skin."""

from collections.abc import Sequence

import numpy as np
import trimesh

from recon.freehand import sequences
from recon.model.tracks import poses_at
from recon.probe_calibration import sound_in_water
from recon.segmentation import masses
from recon.segmentation.blur_correction import Blur
from recon.segmentation.containment import contain
from recon.segmentation.masses import Mass
from recon.segmentation.refraction import Sound
from recon.structured_light.surface_mesh import mesh as surface_mesh
from scenes.acoustics import TISSUES
from scenes.catalogue import build_scene
from twin.experiments import surface_accuracy
from twin.experiments.experiment_setup import Figures, Setup
from twin.optics.surface_session import calibration_of
from twin.ultrasound import sweep_session
from twin.ultrasound.bscan import scans
from twin.ultrasound.echo_solids import body
from twin.ultrasound.probe_path import SurfacePath
from twin.ultrasound.timed_sweep import Clocks, PoseNoise
from twin.ultrasound.transducer import Transducer

# as of conf/path/raster.yaml
PATH = SurfacePath(start_mm=(-22.0, -31.0), end_mm=(-22.0, 36.0), strokes=2, stroke_step_mm=44.0, speed_mm_s=21.0)
SOUND = Sound(tissue=TISSUES["silicone"].speed)  # a phantom's is known; that of masses isn't
SEEDS = (11, 12)  # of the sweeps


def tumours_found(setup: Setup, seeds: Sequence[int] = SEEDS) -> Figures:
    """The tumours of 27, 14 and 12 mm in some sweeps: whether all are found and no others, centre, volume, and under the skin."""
    sweeps, skin = [segmented(setup, seed) for seed in seeds], measured_skin(setup)
    inside = min(sum(one.inside is True for one in contain([mass.mesh for mass in found], skin)) for found in sweeps)
    figures: Figures = {"sweeps": len(sweeps), "wrong": max(abs(len(found) - 3) for found in sweeps), "inside": inside}
    for name, truth in tumours().items():
        centre, volume = np.max([errors(nearest(found, truth), truth) for found in sweeps], axis=0)
        figures |= {f"{name}_centre_mm": centre, f"{name}_volume_percent": volume}
    return figures


def nearest(found: Sequence[Mass], truth: trimesh.Trimesh) -> Mass | None:
    """The mass whose centre is nearest to the true one's."""
    return min(found, key=lambda one: np.linalg.norm(one.centre - truth.center_mass), default=None)


def errors(mass: Mass | None, truth: trimesh.Trimesh) -> tuple[float, float]:
    """Distance of the centres, mm, and error of the volume, % : without signs; not numbers if there is no mass."""
    if mass is None:
        return float("nan"), float("nan")
    volume = 100 * abs(mass.volume / truth.volume - 1)
    return float(np.linalg.norm(mass.centre - truth.center_mass)), float(volume)


def tumours() -> dict[str, trimesh.Trimesh]:
    """The breast's tumours by name, largest first."""
    things = build_scene({"kind": "breast"}).things
    return {thing.name: thing.mesh for thing in things if thing.name.startswith("tumour")}


def segmented(setup: Setup, seed: int) -> Sequence[Mass]:
    """Sweep over the breast in the twin, as `sonotwin sweep path=raster` does, and segment; poses noisy, the lag known."""
    scene, transducer, clocks = body(build_scene({"kind": "breast"})), Transducer(), Clocks()
    planned = sweep_session.plan_sweep(PATH, setup.rig, scene, transducer, clocks, PoseNoise(), seed)
    images = np.stack([one.image for one in scans(scene, transducer, planned.truth.poses, seed)])
    poses = poses_at(planned.track, planned.times, clocks.lag_s)
    calibration = sound_in_water.for_tissue(sweep_session.calibration_of(setup.rig, transducer), SOUND.tissue)
    world_from_pixel = poses @ sequences.target_from_pixel(calibration)
    return masses.from_scans(lambda: iter(images), images.shape[1:], world_from_pixel, SOUND, blur=Blur()).masses


def measured_skin(setup: Setup) -> trimesh.Trimesh:
    """The breast's surface as the cameras measure it."""
    shot = surface_accuracy.experiment(setup.rig, build_scene({"kind": "breast"}), setup.sequences["paper_surface"], seed=20)
    return surface_mesh(shot.points, calibration_of(setup.rig).cameras["cam1"])
