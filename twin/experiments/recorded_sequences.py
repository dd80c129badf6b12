"""Tracked sequences: a recording of the PLUS toolkit against its own reconstruction, and damaged files."""

from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter

import numpy as np

from recon.errors import InputError
from recon.files import volumes
from recon.freehand import plus_config, sequences
from recon.freehand.sequences import Frames
from recon.geometry import rigid
from recon.model import probe
from twin.experiments.experiment_setup import Figures, Setup

SWEEP = "SpinePhantomFreehand.igs.mha"
LEVELS = 2  # grey levels


def real_sweep(setup: Setup) -> Figures:
    """A recorded sweep over a spine phantom, reconstructed as its configuration says."""
    assert setup.real is not None
    folder = setup.real / "tracked_sweep"
    config = plus_config.read_config(folder / "config_NN_MEAN.xml")
    reference = volumes.read_volume(folder / "volume_NN_MEAN.mha")
    plus_config.reconstruct_sequence(folder / SWEEP, config)  # compiles
    start = perf_counter()
    pasted, whole = plus_config.reconstruct_sequence(folder / SWEEP, config)
    seconds = perf_counter() - start
    same = pasted.volume.voxels.shape == reference.voxels.shape
    off = np.abs(pasted.volume.origin - reference.origin).max()
    alike = np.abs(whole.volume.voxels.astype(int) - reference.voxels) <= LEVELS if same else np.zeros(1, bool)
    seen, filled = (alike[pasted.filled], alike[whole.filled & ~pasted.filled]) if same else (alike, alike)
    depth, height, width = pasted.volume.voxels.shape
    figures = {"same_size": same, "off_mm": off, "pasted_alike": seen.mean(), "filled_alike": filled.mean(), "seconds": seconds}
    return figures | {"width": width, "height": height, "depth": depth}


def round_trip(setup: Setup, seed: int = 1) -> Figures:
    """Sequences of random images, poses and times are the same after writing and reading, to the last bit."""
    rng = np.random.default_rng(seed)
    with TemporaryDirectory() as folder:
        same = [_equal(written, sequences.read_sequence(path)) for path, written in _written(Path(folder), rng)]
    return {"sequences": len(same), "same": np.mean(same)}


def damaged(setup: Setup, seed: int = 1) -> Figures:
    """Files cut in half, a bad transform and a NaN are refused in one line that names the file."""
    rng = np.random.default_rng(seed)
    refused = []
    with TemporaryDirectory() as folder:
        for path, _ in _written(Path(folder), rng):
            whole = path.read_bytes()
            number = f"{3.25:g}".encode()
            for content in (whole[: len(whole) // 2], whole.replace(number, b"", 1), whole.replace(number, b"nan", 1)):
                path.write_bytes(content)
                refused.append(_refusal(path))
    return {"sequences": len(refused), "refused": np.mean(refused)}


def real_file(setup: Setup) -> Figures:
    """The recorded sweep is read whole."""
    assert setup.real is not None
    frames = sequences.read_sequence(setup.real / "tracked_sweep" / SWEEP)
    assert frames.images is not None
    placed = np.isfinite(sequences.poses(frames, "Reference", "Probe")).all(axis=(1, 2))
    return {"placed": placed.sum()}


def _written(folder: Path, rng: np.random.Generator) -> Iterator[tuple[Path, Frames]]:
    """Sequences in both formats, with a frame that has no pose; the first number of a pose is 3.25, to be found again."""
    design = probe.ProbeCalibration(rigid.from_rotation_vector([0.1, 0.2, 0.3], [4, 5, 6]), np.array([0.12, 0.13]))
    poses = np.stack([rigid.from_rotation_vector(rng.normal(size=3), rng.normal(scale=99, size=3)) for _ in range(6)])
    poses[0, 0, 3], poses[2, 1, 1] = 3.25, np.nan
    images = rng.integers(0, 256, (6, 20, 30), np.uint8)
    frames = sequences.sequence_of(images, poses, design, np.sort(rng.uniform(0, 1e4, 6)))
    for suffix in (".igs.mha", ".igs.nrrd"):
        sequences.write_sequence(folder / f"s{suffix}", frames)
        yield folder / f"s{suffix}", frames


def _equal(a: Frames, b: Frames) -> bool:
    if a.images is None or b.images is None:
        return False
    tables = [(one.transforms, one.valid) for one in (a, b)]
    return (
        np.array_equal(a.images, b.images)
        and np.array_equal(a.times_s, b.times_s)
        and all(
            first.keys() == second.keys() and all(np.array_equal(first[name], second[name], equal_nan=True) for name in first)
            for first, second in zip(*tables, strict=True)
        )
    )


def _refusal(path: Path) -> bool:
    try:
        sequences.read_sequence(path)
    except InputError as error:
        return str(error).startswith(f"{path}:") and "\n" not in str(error)
    return False
