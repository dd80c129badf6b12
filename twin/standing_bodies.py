"""Bodies of a rig that stand beside a scene, such as the patient's board, under the fringes that fall on both."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from recon.geometry import rigid
from recon.model.rig import Rig
from scenes.handheld.standing_things import stand_at, things
from scenes.scene_types import Scene
from twin.tracking.film_path import STILL
from twin.tracking.led_bodies import LedBodies
from twin.tracking.study_samples import CLEAN

Array = NDArray[np.float64]


def with_standing(scene: Scene, rig: Rig, designed: Rig, led: LedBodies, seed: int) -> tuple[Scene, dict[str, Array]]:
    """The scene with all bodies that stand beside it, as they look in a sweep of the same seed, and their poses by name.

    Parameters
    ----------
    rig, designed : as cameras and prints are, and as they were designed, by which bodies are led as in a sweep

    Returns
    -------
    the scene, and `world_from_target` : (4, 4) mm of each body where its path begins

    Raises
    ------
    InputError
        If a body finds no place.
    """
    poses, made = dict[str, Array](), list(scene.things)
    centres = np.array([device.optics.camera().centre for device in (rig.cam1, rig.cam2)])
    meshes = [thing.mesh for thing in scene.things if not thing.inside]
    about = meshes[0].bounds.mean(axis=0)  # of what is scanned
    for name, path in led.standing(designed).items():
        target, number = rig.bodies[name], list(rig.bodies).index(name) + 1
        pose = led.lead(name, path, designed, np.eye(4), seed, STILL).pose(0.0)
        eyes = rigid.apply(rigid.invert(pose), centres)
        stand = stand_at(pose, target, meshes, eyes, about, np.eye(4))
        parts = led.look(name).parts(np.random.default_rng([seed, 4, number]), target, stand)
        made += things(name, target, parts, pose, CLEAN.ink, CLEAN.paper)
        poses[name] = pose
    return replace(scene, things=tuple(made)), poses
