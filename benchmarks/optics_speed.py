"""Light transport: a whole pattern stack in one pass, against one Mitsuba render a pattern."""

from time import perf_counter

import drjit as dr
import numpy as np

from recon.model.patterns import CentreLine, Fringes, GrayCode, Patterns, Uniform
from recon.model.rig import Rig
from scenes.catalogue import build_scene
from sonotwin.config import compose
from twin.experiments.table_rows import Measurement, Row
from twin.optics.instruments import CameraOptics, ProjectorOptics
from twin.optics.light_transport import Tracing, render
from twin.optics.mitsuba_reference import ideal_rig, mitsuba_scene, render_pattern
from twin.optics.raster import Light
from twin.optics.ray_world import build_world

SAMPLES = 64
SIZE = (1280, 800)


def measurements() -> list[Measurement]:
    """The rows of the group."""
    return [one_pass_against_many]


def sequence(count: int) -> Patterns:
    """A calibration-like sequence of `count` patterns: fringes, Gray code, and uniform images for the rest."""
    if count == 9:
        return Patterns(projector_size=SIZE, unwrap="centre_line", parts=(CentreLine(), Fringes(pitch=12, steps=8, first=1)))
    parts = (Fringes(pitch=18, steps=18), GrayCode(pitch=18, bits=7, complementary=True))
    return Patterns(projector_size=SIZE, unwrap="gray", parts=(*parts, *(Uniform() for _ in range(count - 26))))


def one_pass_against_many() -> list[Row]:
    """Row b: breast, 1280x1024, 64 samples/px. The peer has no lens and no distortion, ours has both."""
    rig = Rig.model_validate(compose("render", ["out=unused"])["rig"])
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
    name = f"breast, 1280x1024, {SAMPLES} samples/px"
    peer_seconds = {count: many / 27 * count for count in seconds}  # a render a pattern; 27 of them were timed
    faster = f"{name}: 27 patterns in one pass, times faster than 27 Mitsuba renders"
    growth = f"{name}: cost of N = 50 over that of N = 9, less than 50 / 9"
    return [
        Row("b", faster, many / seconds[27], 10, 1, "x", at_least=True),
        Row("b", growth, seconds[50] / seconds[9], 50 / 9, 50 / 9, "x"),
        *(Row("b", f"{name}: N = {count}", seconds[count], peer_seconds[count], peer_seconds[count], "s") for count in seconds),
    ]
