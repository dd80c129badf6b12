"""Light transport: a whole pattern stack in one pass, against one Mitsuba render a pattern."""

from time import perf_counter

import drjit as dr
import numpy as np

from recon.model.patterns import CentreLine, Fringes, GrayCode, Patterns, Uniform
from scenes.catalogue import build_scene
from twin.experiments.experiment_setup import Figures, Setup
from twin.optics.instruments import CameraOptics, ProjectorOptics
from twin.optics.light_transport import Tracing, render
from twin.optics.mitsuba_reference import ideal_rig, mitsuba_scene, render_pattern
from twin.optics.raster import Light
from twin.optics.ray_world import build_world

SAMPLES = 64
SIZE = (1280, 800)


def sequence(count: int) -> Patterns:
    """A calibration-like sequence of `count` patterns: fringes, Gray code, and uniform images for the rest."""
    if count == 9:
        return Patterns(projector_size=SIZE, unwrap="centre_line", parts=(CentreLine(), Fringes(pitch=12, steps=8, first=1)))
    parts = (Fringes(pitch=18, steps=18), GrayCode(pitch=18, bits=7, complementary=True))
    return Patterns(projector_size=SIZE, unwrap="gray", parts=(*parts, *(Uniform() for _ in range(count - 26))))


def one_pass_against_many(setup: Setup) -> Figures:
    """Breast, 1280x1024, 64 samples/px. The peer has no lens and no distortion, ours has both."""
    rig = setup.rig
    scene = build_scene({"kind": "breast"})
    world = build_world(scene)

    def ours(count: int) -> float:
        light = Light.of(sequence(count), rig.projector)
        optics = CameraOptics.of(rig.cam1), ProjectorOptics.of(rig.projector)
        render(world, *optics, light, Tracing(samples=SAMPLES), seed=0)  # compiles
        times = []
        for seed in range(3):
            start = perf_counter()
            render(world, *optics, light, Tracing(samples=SAMPLES), seed=seed)
            times.append(perf_counter() - start)
        return float(np.median(times))

    seconds = {count: ours(count) for count in (9, 27, 50)}
    camera, projector = ideal_rig(rig)
    peer = mitsuba_scene(scene, camera, projector)
    light = Light.of(sequence(27), rig.projector)
    render_pattern(peer, light, 0, 2, seed=0)  # compiles
    dr.sync_thread()
    start = perf_counter()
    for pattern in range(27):
        render_pattern(peer, light, pattern, SAMPLES, seed=pattern)
    many = perf_counter() - start
    figures = {"samples": SAMPLES, "times_faster": many / seconds[27], "growth": seconds[50] / seconds[9], "most_growth": 50 / 9}
    for count in seconds:
        figures |= {f"seconds_{count}": seconds[count], f"peer_{count}": many / 27 * count}  # 27 of its renders were timed
    return figures
