"""The tracker on rendered frames, whole function from two images to a pose, beside eager fp32; and the making of training data.

The peer runs the same networks in PyTorch without graph, and does the rest as the tracker does when it knows nothing; without
the train extra its column stays empty.
"""

import resource
from collections.abc import Callable
from dataclasses import replace
from importlib.util import find_spec
from time import perf_counter
from typing import cast

import numpy as np

from recon.model import target_family
from recon.model.rig import PROBE, Rig
from recon.tracking import networks as nets
from recon.tracking.bodies import BodyTracker
from recon.tracking.networks import Networks
from recon.tracking.tracker import Tracker
from scenes.catalogue import build_scene
from sonotwin.config import load
from sonotwin.verbs import sweep
from twin.experiments.bodies_accuracy import SEED, rig_of
from twin.experiments.experiment_setup import Figures, Setup
from twin.experiments.tracking_frames import ranges_of, several, study
from twin.shooting import FilmQuality, Quality
from twin.tracking import film_session, scene_frames
from twin.tracking.mesh_bank import build_bank
from twin.tracking.rendered_views import render_full, render_views
from twin.tracking.samples import draw
from twin.tracking.sampling_ranges import DataRanges
from twin.ultrasound import sweep_session
from twin.ultrasound.echo_solids import at_speeds, body

FRAMES, REPEATS = 4, 12
BATCHES, BATCH = 8, 5


def few(setup: Setup) -> DataRanges:
    """Ranges of few variants: the time of a sample doesn't depend on their number."""
    return ranges_of(setup).model_copy(update={"variants": 4})


def frames_of(setup: Setup) -> list[tuple]:
    """A few stereo frames, still and lit, of a target that nothing covers."""
    return [given.views for _, given in study(replace(setup, frames=few(setup)), 1, FRAMES, 100.0, 0.0, 4)]


def tracked(setup: Setup) -> Figures:
    """With our networks: locked on, and from nothing, beside the same networks in eager fp32 on every frame."""
    rig, images, ours = setup.rig, frames_of(setup), nets.load()
    locked = locked_seconds(rig, images, ours)
    cold = cold_seconds(rig, images, ours)
    theirs = cold_seconds(rig, images, eager("detector", "segmenter")) if find_spec("torch") else float("nan")
    times = {"locked_faster": theirs / locked, "cold_faster": theirs / cold}
    return times | {"locked_hz": 1 / locked, "cold_ms": 1e3 * cold, "eager_ms": 1e3 * theirs}


def bodies(setup: Setup) -> Figures:
    """Three bodies locked on, in turn with one alone in the same frames; and live, with one of them away."""
    rig, known = rig_of(setup), nets.load(by_geometry=True)
    away = target_family.propose(rig.target, 4)[-1]  # that can be told from those in view
    cameras = rig.cam1.optics.camera(), rig.cam2.optics.camera()
    film = several(Setup(rig, frames=few(setup)), SEED, FRAMES, (100.0, 100.0), (0.0, 0.0), FilmQuality())
    seconds: dict[str, list[float]] = {"three": [], "alone": [], "live": []}
    for pair in [frames.views for _, frames in film]:
        designs = {"three": rig.targets, "alone": {PROBE: rig.target}, "live": rig.targets | {"needle": away}}
        trackers = {
            name: BodyTracker({body: Tracker(cameras, target, known) for body, target in own.items()}, 0.2 * (name == "live"))
            for name, own in designs.items()
        }
        for k in range(REPEATS * 2):
            for name, tracker in trackers.items():
                start = perf_counter()
                found = tracker.step(*pair, k / 60)
                if k > 1 and [one.how for one in found.values()].count("predicted") == len(designs[name]) - (name == "live"):
                    seconds[name].append(perf_counter() - start)
    three, alone = np.median(seconds["three"]), np.median(seconds["alone"])
    live = np.quantile(seconds["live"], 0.99)
    return {"three_hz": float(1 / three), "alone_hz": float(1 / alone), "latest_ms": float(1e3 * live)}


def published_shape(setup: Setup) -> Figures:
    """With networks of the published shape, untrained, as their time doesn't depend on weights.

    The peer is their passes alone, two views and six patches in eager fp32, without anything that comes between and after.
    """
    if not find_spec("torch"):
        return {}
    published = median_of(lambda: network_pass(eager("published_detector", "published_segmenter")), 3)
    return {"times_faster": published / locked_seconds(setup.rig, frames_of(setup), nets.load())}


def locked_seconds(rig: Rig, images: list[tuple], networks: Networks) -> float:
    """Seconds of a step while the target is known from the frames before."""
    cameras = rig.cam1.optics.camera(), rig.cam2.optics.camera()
    times = []
    for pair in images:
        tracker = Tracker(cameras, rig.target, networks)
        result = tracker.step(*pair)
        for _ in range(REPEATS):
            start = perf_counter()
            result = tracker.step(*pair)
            times.append(perf_counter() - start)
            if result.how != "predicted":
                times.pop()
    return float(np.median(times)) if times else float("nan")


def cold_seconds(rig: Rig, images: list[tuple], networks: Networks) -> float:
    """Seconds of a step that starts from nothing."""
    cameras = rig.cam1.optics.camera(), rig.cam2.optics.camera()
    return median_of(lambda: [Tracker(cameras, rig.target, networks).step(*pair) for pair in images], 3) / len(images)


def median_of(work: Callable[[], object], repeats: int) -> float:
    """Median seconds, after one run that isn't counted."""
    work()
    times = []
    for _ in range(repeats):
        start = perf_counter()
        work()
        times.append(perf_counter() - start)
    return float(np.median(times))


def network_pass(networks: Networks) -> None:
    """The networks' work for one stereo frame: two views and six patches."""
    networks.detect(np.zeros((2, 240, 320), np.float32))
    networks.segment(np.zeros((6, 120, 120), np.float32))


def eager(detector: str, segmenter: str) -> Networks:
    """Networks in PyTorch without graph, in 32 bits; ours with the shipped weights."""
    import torch

    from trainers.architectures import Name, network
    from trainers.export import load

    modules = []
    for name, kind in ((detector, "detector"), (segmenter, "segmenter")):
        module = network(cast(Name, name), circles=3)
        if not name.startswith("published"):
            load(nets.WEIGHTS / f"{kind}.safetensors", module)
        modules.append(module.eval())

    class Eager:
        @torch.no_grad()
        def detect(self, images):
            places, identities = modules[0](torch.from_numpy(images)[:, None])
            return places.numpy(), identities.numpy()

        @torch.no_grad()
        def segment(self, patches):
            return modules[1](torch.from_numpy(patches)[:, None]).numpy()[:, 0]

    return Eager()


def filmed(setup: Setup) -> Figures:
    """Pairs of whole frames of a sweep over the breast a second, beside frames of which every pixel is rendered."""
    fields = ["scene=breast", "path=raster", "filmed=true", "clocks.camera_hz=8", "name=scan", "out=unused"]
    config = load("sweep", fields, sweep.Config)
    scene = build_scene(config.scene)
    scanned, seed = at_speeds(body(scene), config.conditions.sound, config.seed), config.own_seed
    path, rig, scanner = config.path, config.rig, config.ultrasound
    planned = sweep_session.plan_sweep(path, rig, scanned, scanner, config.clocks, config.pose_noise, seed)
    led = scene_frames.motions(*[planned.target.poses(late) for late in (0.0, -0.005, 0.005)])
    stage = scene_frames.SceneStage(scene, np.eye(4), {PROBE: led}, {})
    bank = scene_frames.make_bank(stage, rig, config.seed)
    made = scene_frames.takes(stage, bank, rig, few(setup), config.frames, seed)
    list(film_session.shoot(bank, rig, made[:BATCH], config.frames.quality, seed))
    start = perf_counter()
    list(film_session.shoot(bank, rig, made, config.frames.quality, seed))
    seconds = (perf_counter() - start) / len(made)
    whole = median_of(lambda: render_full(bank, rig, made[:1], Quality(window=2), seed), 1)
    return {"pairs": len(made), "rate_hz": 1 / seconds, "times_faster": whole / seconds}


def rendered(setup: Setup) -> Figures:
    """Default samples a second, and how much memory grows from one batch to the last."""
    rig, ranges = setup.rig, few(setup)
    bank = build_bank(rig.target, ranges.variants, 2)
    batches = [[draw(ranges, rig, 2, BATCH * b + k) for k in range(BATCH)] for b in range(BATCHES + 1)]
    render_views(bank, rig, batches[0], Quality(), 2)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    start = perf_counter()
    for batch in batches[1:]:
        render_views(bank, rig, batch, Quality(), 2)
    seconds = (perf_counter() - start) / (BATCHES * BATCH)
    grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024
    return {"rate_hz": 1 / seconds, "samples": BATCHES * BATCH, "growth_mb": grown}
