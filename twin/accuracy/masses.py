"""How true masses are that are found in tracked B-scans: the breast's tumours against their meshes, under the measured skin."""

from collections.abc import Sequence

import numpy as np
import trimesh

from recon import masses, sequences
from recon.containment import contain
from recon.lag import poses_at
from recon.mass_paths import Sound
from recon.masses import Mass
from recon.surface import mesh as surface_mesh
from scenes.acoustics import TISSUES
from scenes.catalogue import build_scene
from twin.accuracy import surface
from twin.accuracy.rows import Row, Setup
from twin.session import calibration_of
from twin.ultrasound import session
from twin.ultrasound.probe_path import SurfacePath
from twin.ultrasound.solids import body
from twin.ultrasound.sweep import Clocks, PoseNoise, scans
from twin.ultrasound.transducer import Transducer

# as of conf/path/raster.yaml
PATH = SurfacePath(start_mm=(-18.0, -36.0), end_mm=(-18.0, 37.0), strokes=2, stroke_step_mm=46.0, speed_mm_s=21.0)
SOUND = Sound(tissue=TISSUES["silicone"].speed)  # a phantom's is known; that of masses isn't
CENTRE_MM, VOLUME_PERCENT = 0.5, 8.0  # what is asked


def rows(setup: Setup) -> list[Row]:
    """The tumours of 27, 14 and 12 mm: centre and volume, whether all are found and no others, and lie under the skin."""
    found, skin = list(segmented(setup)), measured_skin(setup)
    result = []
    for size, (name, truth) in zip((27, 14, 12), tumours().items(), strict=True):
        mass = min(found, key=lambda one, truth=truth: np.linalg.norm(one.centre - truth.center_mass), default=None)
        centre, volume = errors(mass, truth)
        what = f"{name} of {size} mm"
        result.append(Row("i", f"{what}: centre", centre, CENTRE_MM, None, "mm"))
        result.append(Row("i", f"{what}: volume", volume, VOLUME_PERCENT, None, "%"))
    inside = sum(contain(mass.mesh, skin).inside for mass in found)
    result.append(Row("i", "masses found that are no tumours, or tumours not found", abs(len(found) - 3), 0, 0, "masses"))
    result.append(Row("i", "masses found inside the measured skin", inside, 3, 3, "masses", at_least=True))
    return result


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


def segmented(setup: Setup, seed: int = 1) -> Sequence[Mass]:
    """Sweep over the breast in the twin, as `sonotwin sweep path=raster` does, and segment; poses noisy, the lag known."""
    scene, transducer, clocks = body(build_scene({"kind": "breast"})), Transducer(), Clocks()
    planned = session.plan_sweep(PATH, setup.rig, scene, transducer, clocks, PoseNoise(), seed)
    images = np.stack([one.image for one in scans(scene, transducer, planned, seed)])
    poses = poses_at(planned.track, planned.times, clocks.lag_s)
    world_from_pixel = poses @ sequences.target_from_pixel(session.calibration_of(setup.rig))
    return masses.from_scans(lambda: iter(images), images.shape[1:], world_from_pixel, SOUND)


def measured_skin(setup: Setup) -> trimesh.Trimesh:
    """The breast's surface as the cameras measure it."""
    shot = surface.experiment(setup.rig, build_scene({"kind": "breast"}), setup.sequences["paper_surface"], seed=20)
    return surface_mesh(shot.points, calibration_of(setup.rig).cameras["cam1"])
