"""What planes and a sphere come to under one cause at a time, with the true calibration, decoded by our method and as published.

As published: the least-squares phase of the images as they are, without corrections of the frames.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from scenes.catalogue import build_scene
from scenes.kinds import plane
from scenes.scene_types import Scene
from twin.conditions import Conditions, Drift, Frames, Skin, drifted
from twin.experiments import surface_accuracy
from twin.experiments.experiment_setup import Figures, Setup
from twin.experiments.plane_and_sphere import Measured, as_published, measured
from twin.experiments.surface_accuracy import Experiment
from twin.optics.surface_session import Shooting, calibration_of

SEEDS = range(320, 323)


class Cause(NamedTuple):
    """One cause of errors."""

    conditions: Conditions = Conditions()
    light: float = 1.0  # of that which fills the range of the images


def one_cause(setup: Setup, cause: str) -> Figures:
    """RMS of planes, RMS and radius error of the sphere, as published and by our decoding."""
    by_us, published = zip(*(compared(setup, causes(setup.conditions("lifelike"))[cause], seed) for seed in SEEDS), strict=True)
    return {
        f"{name} {decoding}": np.mean([abs(getattr(one, name)) for one in results])
        for decoding, results in (("as published", published), ("by us", by_us))
        for name in ("plane_rms_mm", "sphere_rms_mm", "radius_error_mm")
    }


def causes(life: Conditions) -> Mapping[str, Cause]:
    """The causes by name; some of the size of conditions of life, some larger."""
    return {
        "no cause but noise": Cause(),
        "lamp and light of life": Cause(Conditions(frames=life.frames)),
        "flicker of 3 %, offsets of 1 DN": Cause(Conditions(frames=Frames(flicker=0.03, stray_dn=1.0))),
        "a quarter of the light": Cause(light=1 / 4),
        "a sixteenth of the light": Cause(light=1 / 16),
        f"light that spreads by {life.skin.spread_mm:g} mm": Cause(Conditions(skin=Skin(spread_mm=life.skin.spread_mm))),
        "light that spreads by 1 mm": Cause(Conditions(skin=Skin(spread_mm=1.0))),
        "devices that drifted as in life": Cause(Conditions(drift=life.drift)),
        "devices that drifted ten times as far": Cause(
            Conditions(drift=Drift(centre_px=10 * life.drift.centre_px, focal=10 * life.drift.focal))
        ),
    }


def compared(setup: Setup, cause: Cause, seed: int) -> tuple[Measured, Measured]:
    """A plane and the sphere under one cause, by our decoding and by the published one."""
    patterns, true = setup.sequences["paper_surface"], calibration_of(setup.rig)
    flat = translucent(plane.build(plane.PAPER_POSES[seed % len(plane.PAPER_POSES)]))
    first, second = (shoot(setup, scene, cause, seed) for scene in (flat, translucent(build_scene({"kind": "sphere"}))))
    plain = as_published(first, patterns), as_published(second, patterns)
    return measured((first, second), true), measured(plain, true)


def shoot(setup: Setup, scene: Scene, cause: Cause, seed: int) -> Experiment:
    """Render and decode a scene."""
    patterns, rig = setup.sequences["paper_surface"], drifted(setup.rig, cause.conditions.drift, seed)
    bright = surface_accuracy.experiment(rig, scene, patterns, seed, conditions=cause.conditions)
    if cause.light == 1:
        return bright
    shooting = Shooting(exposure_s=cause.light * bright.view.exposure.time_s)
    return surface_accuracy.experiment(rig, scene, patterns, seed, shooting=shooting, conditions=cause.conditions)


def translucent(scene: Scene) -> Scene:
    """The same scene of a material that light may spread in."""
    things = (replace(thing, material=replace(thing.material, translucent=True)) for thing in scene.things)
    return replace(scene, things=tuple(things))
