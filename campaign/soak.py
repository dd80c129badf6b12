"""Long runs, item by item: memory stays as it is, and the last tenth is as fast as the first."""

import os
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import cycle, islice
from pathlib import Path
from queue import Queue
from tempfile import TemporaryDirectory
from threading import Thread

import numpy as np
from rich.progress import track

from campaign import commands

COUNTS = {"dataset": 10_000, "track": 5_000, "freehand": 2_000, "sweep": 2_000}
SHARD = 50  # samples
LOOK_S = 0.5  # between two looks at the memory


@dataclass(frozen=True)
class Soak:
    """Times and memory of a run."""

    verb: str
    used_s: np.ndarray  # (n,) of processors, at the end of each item: what else the machine does counts less
    memory_mb: np.ndarray  # (n,) resident
    size: int = 1  # samples an item

    @property
    def growth_mb(self) -> float:
        """Memory of the last tenth over that of the second tenth, medians."""
        tenth = max(len(self.memory_mb) // 10, 1)
        return float(np.median(self.memory_mb[-tenth:]) - np.median(self.memory_mb[tenth : 2 * tenth]))

    @property
    def slowing(self) -> float:
        """Processor's time of the last tenth over that of the second tenth, less 1; whole tenths, as items may come in bursts."""
        tenth = max(len(self.used_s) // 10, 1)
        return float((self.used_s[-1] - self.used_s[-1 - tenth]) / (self.used_s[2 * tenth] - self.used_s[tenth]) - 1)

    @property
    def sample_s(self) -> float:
        """Processor's time of a sample, over all."""
        return float(self.used_s[-1] - self.used_s[0]) / (self.size * (len(self.used_s) - 1))


def run(place: Path, verb: str, count: int) -> Soak:
    """Let one verb's work go on over many items."""
    with TemporaryDirectory(dir=place.parent, ignore_cleanup_errors=True) as name:
        items, size = WORK[verb](place, count, Path(name))
        used, memory, looked, held = list[float](), list[float](), 0.0, 0.0
        for _ in track(items, verb, count // size):
            used.append(time.process_time())
            if (now := time.perf_counter()) - looked > LOOK_S:
                looked, held = now, commands.memory_mb(os.getpid(), "VmRSS")
            memory.append(held)
    return Soak(verb, np.array(used), np.array(memory), size)


def _dataset(place: Path, count: int, folder: Path) -> tuple[Iterator[object], int]:
    from sonotwin import config
    from sonotwin.verbs import dataset
    from twin.tracking import dataset_shards

    fields = [f"out={folder / 'data'}", f"samples={count}", f"shard={SHARD}", "engine.workers=1"]
    settings = config.load("dataset", fields, dataset.Config)
    target = dataset_shards.Place(settings.out)
    missing = dataset_shards.prepare(target, settings.settings())
    return dataset_shards.generate(target, settings.settings(), missing, settings.engine), SHARD


def _track(place: Path, count: int, folder: Path) -> tuple[Iterator[object], int]:
    from recon.capture import stereo_frames
    from recon.model.rig import Rig
    from recon.tracking import networks
    from recon.tracking.tracker import Tracker
    from sonotwin import config
    from sonotwin.verbs import track as verb

    film = stereo_frames.read_film(place / "film" / "capture")
    rig: Rig = config.load("track", ["capture=none", "out=none"], verb.Config).rig
    tracker = Tracker(film.cameras, rig.target, networks.load(), film.bits, film.optics)
    pairs = (pair for _ in cycle([None]) for pair in film.pairs())
    return (tracker.step(*pair, k / 30) for k, pair in enumerate(islice(pairs, count))), 1


def _freehand(place: Path, count: int, folder: Path) -> tuple[Iterator[object], int]:
    from recon.capture.sweep_part import read_sweep
    from recon.freehand import scans

    sweep = read_sweep(place / "scan" / "capture")
    few = scans.of_sweep(sweep, scans.probe_of(sweep, place, None), 0.0, None)
    times = -(-count // len(few.world_from_pixel))
    poses = np.tile(few.world_from_pixel, (times, 1, 1))[:count]
    taken: Queue[object] = Queue()

    def stream() -> Iterator[np.ndarray]:
        for image in islice(cycle_of(few.stream), count):
            taken.put(image is not None)
            yield image
        taken.put(None)

    many = replace(few, world_from_pixel=poses, stream=stream)
    Thread(target=scans.volume, args=(many, scans.VolumeSettings(hole_voxels=0)), daemon=True).start()
    return iter(taken.get, None), 1


def cycle_of(stream: Callable[[], Iterator[np.ndarray]]) -> Iterator[np.ndarray]:
    """A stream from the beginning again and again, read anew each time."""
    while True:
        yield from stream()


def _sweep(place: Path, count: int, folder: Path) -> tuple[Iterator[object], int]:
    from sonotwin import config
    from sonotwin.verbs import sweep
    from twin.filmed_sweep import plan_sweep

    speed = 1.0 * 20.0 / count  # mm/s, over 1 mm at 20 images/s: all of them show nearly the same, and so take the same time
    fields = ["path.start_mm=[-18,-2]", "path.end_mm=[-18,-1]", f"path.speed_mm_s={speed}", f"out={folder / 'new'}"]
    planned = plan_sweep(config.load("sweep", fields, sweep.Config))
    return islice(planned.scans(), count), 1


WORK = {"dataset": _dataset, "track": _track, "freehand": _freehand, "sweep": _sweep}


def table(found: Sequence[Soak]) -> list[str]:
    """Lines of Markdown: a row a verb."""
    lines = ["| verb | items | processor's time of one, ms | memory, MB | growth, MB | slower in the end |", "|---" * 6 + "|"]
    for one in found:
        figures = [
            f"{1e3 * one.sample_s:.1f}",
            f"{one.memory_mb[-1]:.0f}",
            f"{one.growth_mb:+.0f}",
            f"{100 * one.slowing:+.1f} %",
        ]
        lines.append(f"| {one.verb} | {one.size * len(one.used_s)} | {' | '.join(figures)} |")
    return lines
