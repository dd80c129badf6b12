"""Accuracy of light on the skin: outlines of masses as camera 1 sees them drawn, against the true ones on the true skin.

The true outline is that of the true mass, along the same lines of sight, on the true skin.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np
import trimesh
from numpy.typing import NDArray

from recon.fusion import skin as skin_parts
from recon.model.rig import Rig
from recon.skin_projection import mass_outline, projector_image, skin_registration
from recon.skin_projection.lines_of_sight import Sight
from recon.structured_light.surface_mesh import mesh as surface_mesh
from scenes.catalogue import build_scene
from scenes.scene_types import Scene
from twin.evaluation import light_errors
from twin.evaluation.light_errors import LightErrors
from twin.experiments import mass_accuracy, surface_accuracy
from twin.experiments.experiment_setup import Figures, Setup
from twin.optics.instruments import CameraOptics, ProjectorOptics
from twin.optics.light_transport import Tracing, render
from twin.optics.projected_image import ImageLight
from twin.optics.ray_world import build_world
from twin.optics.surface_session import calibration_of
from twin.optics.surface_truth import surface_truth
from twin.sensor import Exposure, auto_exposure, expose

Meshes = Mapping[str, trimesh.Trimesh]
Spec = Mapping[str, object]  # of a scene, as for `build_scene`

BREAST = {"kind": "breast"}
MOVED = BREAST | {"middle_mm": [7.0, -4.0], "turn_deg": 2.0}  # by (3, -2) mm and 2 deg
EYE_MM = (120.0, 150.0, 150.0)  # of a surgeon beside the cameras
TRACING = Tracing(samples=16, room_lux=20)
RIDGE_PX = 1.7  # smoothing, for lines of 1 mm, 5 px
SEED = 40


def along_the_normal(setup: Setup) -> Figures:
    """True masses along the skin's normal, on the measured skin."""
    return outlines(drawn(setup, BREAST, measured(setup, BREAST), mass_accuracy.tumours(), None, "normal"))


def as_the_eye_sees(setup: Setup) -> Figures:
    """The same as a surgeon's eye sees them."""
    return outlines(drawn(setup, BREAST, measured(setup, BREAST), mass_accuracy.tumours(), EYE_MM, "eye"))


def after_a_shift(setup: Setup) -> Figures:
    """Masses that were found before the phantom moved, moved along by the skin that is measured again."""
    new = measured(setup, MOVED)
    shift = skin_registration.register(measured(setup, BREAST), new)
    masses = {name: mass.copy().apply_transform(shift.new_from_old) for name, mass in mass_accuracy.tumours().items()}
    pairs = zip(masses.values(), tumours(MOVED).values(), strict=True)
    off = max(np.linalg.norm(mass.center_mass - true.center_mass) for mass, true in pairs)
    sigma = max(shift.sigma_mm(mass.center_mass) for mass in mass_accuracy.tumours().values())
    return outlines(drawn(setup, MOVED, new, masses, None, "moved")) | {"centres_mm": off, "centres_sigma_mm": sigma}


def found(setup: Setup) -> Figures:
    """The whole chain, masses as ultrasound finds them."""
    true = mass_accuracy.tumours()
    segmented = mass_accuracy.segmented(setup, mass_accuracy.SEEDS[0])
    nearest = {name: mass_accuracy.nearest(segmented, mesh) for name, mesh in true.items()}
    masses = {name: mass.mesh for name, mass in nearest.items() if mass is not None}
    return outlines(drawn(setup, BREAST, measured(setup, BREAST), masses, None, "found"))


def outlines(errors: LightErrors) -> Figures:
    """Distances of a picture's light from the true outlines."""
    return dict(zip(("median_mm", "most_mm"), np.percentile(errors.all, [50, 95]).tolist(), strict=True))


def measured(setup: Setup, scene: Spec) -> trimesh.Trimesh:
    """The skin of a scene as the cameras measure it, without the table."""
    shot = surface_accuracy.experiment(setup.rig, build_scene(scene), setup.sequences["paper_surface"], seed=SEED)
    skin = skin_parts.by_plane(surface_mesh(shot.points, calibration_of(setup.rig).cameras["cam1"])).skin
    assert skin is not None
    return skin


def tumours(scene: Spec) -> Meshes:
    """The true masses of a scene, by name."""
    return {thing.name: thing.mesh for thing in build_scene(scene).things if thing.inside}


@dataclass(frozen=True, eq=False)
class Picture:
    """A projector's image of masses, and the lines of sight along which each was drawn."""

    image: NDArray[np.uint8]  # (h, w)
    sights: Mapping[str, Sight]


def drawn(
    setup: Setup, scene: Spec, skin: trimesh.Trimesh, masses: Meshes, eye_mm: tuple[float, float, float] | None, name: str
) -> LightErrors:
    """Draw masses on a measured skin by the projector, look at them by camera 1, and compare with the scene's own."""
    return compared(setup, scene, picture_of(setup.rig, skin, masses, eye_mm), name)


def picture_of(rig: Rig, skin: trimesh.Trimesh, masses: Meshes, eye_mm: tuple[float, float, float] | None) -> Picture:
    """The projector's image of masses on a measured skin."""
    sights = {name: mass_outline.sight_of(mass.vertices, skin, eye_mm) for name, mass in masses.items()}
    curves = [mass_outline.on_skin(name, mass, skin, sights[name]) for name, mass in masses.items()]
    drawing = projector_image.draw(curves, skin, rig.projector.optics.camera(), rig.projector.gamma)
    return Picture(drawing.image, sights)


def compared(setup: Setup, scene: Spec, picture: Picture, name: str) -> LightErrors:
    """Look at a picture on a scene by camera 1, and compare with the true outlines of the scene's masses on its true skin."""
    built, rig = build_scene(scene), setup.rig
    seen = photographed(rig, built, picture.image)
    if setup.out is not None:
        cv2.imwrite(str(setup.out / f"live_skin_{name}.png"), seen)
    truth = surface_truth(build_world(built), rig.cam1.optics.camera(), rig.projector.optics.camera())
    light = light_errors.in_space(light_errors.ridges(seen, RIDGE_PX), truth.points)
    skin, true = next(thing.mesh for thing in built.things if not thing.inside), tumours(scene)
    return light_errors.compare(light, [mass_outline.on_skin(key, true[key], skin, picture.sights[key]).points for key in true])


def photographed(rig: Rig, scene: Scene, picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """An image of camera 1 while the projector shows a picture : (h, w) on a scene."""
    light, wavelength = ImageLight.of(picture, rig.projector), rig.projector.wavelength_nm
    projector = ProjectorOptics.of(rig.projector)
    radiance = render(build_world(scene), CameraOptics.of(rig.cam1), projector, light, TRACING, SEED)
    exposure = Exposure(auto_exposure(radiance, rig.cam1, wavelength))
    return np.uint8(expose(radiance, rig.cam1, wavelength, exposure, SEED)[0])
