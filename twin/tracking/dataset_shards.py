"""Data sets on disk: WebDataset tar shards and a Parquet index.

A shard is written to a temporary name and renamed, and sample k depends on the settings and k alone. So a run that was killed
goes on with the shards that are missing, and workers need no coordinator: the bytes are the same, however they were made.
"""

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import webdataset as wds
from pydantic import BaseModel, ConfigDict

from recon.errors import InputError
from recon.files import atomic
from recon.model.rig import Rig
from twin.engine import Engine, results
from twin.session import first_difference
from twin.shooting import Quality
from twin.tracking.mesh_bank import build_bank
from twin.tracking.rendered_views import Sample, render_full, render_sketches, render_views
from twin.tracking.samples import Take, draw
from twin.tracking.sampling_ranges import DataRanges
from twin.tracking.target_truth import ViewTruth, disc_masks

INDEX, SETTINGS = "index.parquet", "dataset.json"
VERSION = 1
BATCH = 5  # samples traced in one launch; doesn't change them
PNG = [cv2.IMWRITE_PNG_COMPRESSION, 4]
RENDER = {"views": render_views, "sketches": render_sketches, "full": render_full}


class Settings(BaseModel):
    """Everything that a data set's bytes depend on, and the number of its samples."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    rig: Rig
    ranges: DataRanges
    quality: Quality
    frames: Literal["views", "sketches", "full"]
    seed: int
    samples: int
    shard: int  # samples a shard

    def shards(self) -> list[range]:
        """Samples of each shard."""
        return [range(first, min(first + self.shard, self.samples)) for first in range(0, self.samples, self.shard)]


@dataclass(frozen=True)
class Place:
    """A data set's folder."""

    folder: Path

    def shard(self, number: int) -> Path:
        """File of a shard."""
        return self.folder / f"shard-{number:05d}.tar"


def prepare(place: Place, settings: Settings) -> list[int]:
    """Open a folder for a data set, and say which shards are missing.

    Raises
    ------
    InputError
        If the folder holds a data set of other settings, or something else.
    """
    told = place.folder / SETTINGS
    written = {"version": VERSION, **settings.model_dump(mode="json")}
    if told.exists():
        try:
            found = json.loads(told.read_text())
        except json.JSONDecodeError as error:
            raise InputError(f"{told}: expected JSON, found {error}") from None
        if not isinstance(found, dict) or not isinstance(found.get("samples"), int):
            raise InputError(f"{told}: expected a data set's settings, found something else")
        if found["samples"] > settings.samples:
            expected = f"expected at least the {found['samples']} it was begun with"
            raise InputError(f"{told}: samples: {expected}, found {settings.samples}")
        name, wanted, there = first_difference(written, found | {"samples": settings.samples})
        if name:
            expected = f"expected {wanted} as in this run, found {there}, another data set"
            raise InputError(f"{told}: {name}: {expected}; choose another out")
    elif place.folder.exists() and any(place.folder.iterdir()):
        raise InputError(f"{place.folder}: expected an empty folder or a data set, found other files")
    place.folder.mkdir(parents=True, exist_ok=True)
    for number, _ in enumerate(settings.shards()):
        atomic.remove_leftovers(place.shard(number))
    with atomic.new_file(told) as path:
        path.write_text(json.dumps(written, indent=1))
    return [number for number, _ in enumerate(settings.shards()) if not _complete(place, settings, number)]


def _complete(place: Place, settings: Settings, number: int) -> bool:
    """Whether a shard is there in full; the last one of a smaller data set of the same settings may have to grow."""
    path = place.shard(number)
    if not path.exists():
        return False
    return len(settings.shards()[number]) == settings.shard or _samples_in(path) == len(settings.shards()[number])


def _samples_in(path: Path) -> int:
    return sum(1 for _ in truths(path))


def generate(place: Place, settings: Settings, missing: Sequence[int], engine: Engine) -> Iterator[int]:
    """Make the missing shards; gives the number of samples as each shard is done."""
    return results(engine, write_shard, ((place, settings, number) for number in missing))


def write_shard(place: Place, settings: Settings, number: int) -> int:
    """Render a shard's samples and write them; gives their number."""
    bank = build_bank(settings.rig.target, settings.ranges.variants, settings.seed)
    samples = settings.shards()[number]
    with atomic.new_file(place.shard(number)) as path, wds.TarWriter(str(path), encoder=False, mtime=0, mode=0o644) as tar:
        for first in range(samples.start, samples.stop, BATCH):
            takes = [draw(settings.ranges, settings.rig, settings.seed, k) for k in samples if first <= k < first + BATCH]
            rendered = RENDER[settings.frames](bank, settings.rig, takes, settings.quality, settings.seed)
            for take, frames in zip(takes, rendered, strict=True):
                tar.write({"__key__": f"{take.k:08d}", **members(take, frames, settings)})
    return len(samples)


def members(take: Take, frames: Sample, settings: Settings) -> dict[str, bytes]:
    """A sample's files."""
    files = {f"cam{number}.png": _png(view) for number, view in zip((1, 2), frames.views, strict=True)}
    if settings.frames == "views":
        for number, patches, truth in zip((1, 2), frames.patches, frames.truth, strict=True):
            masks = np.zeros_like(patches)
            if take.present:
                masks = disc_masks(truth.ellipses, truth.patch_origins, patches.shape[-1])
            files[f"patches{number}.png"] = _png(np.concatenate(patches))
            files[f"masks{number}.png"] = _png(np.concatenate(masks))
    return {**files, "json": json.dumps(truth_record(take, frames, settings.seed)).encode()}


def _png(image: np.ndarray) -> bytes:
    return cv2.imencode(".png", image, PNG)[1].tobytes()


def truth_record(take: Take, frames: Sample, seed: int) -> dict:
    """Ground truth of a sample, as in docs/training.md."""
    motion = take.motion
    return {
        "k": take.k,
        "seed": seed,
        "present": take.present,
        "world_from_target": motion.world_from_target.tolist() if take.present else None,
        "shift_mm": motion.shift_mm.tolist() if take.present else None,
        "turn_rad": motion.turn_rad.tolist() if take.present else None,
        "body": take.body,
        "surroundings": take.surroundings,
        "exposure": {"white_dn": take.white_dn, "gain": take.gain},
        "light": {
            "lamps": take.lighting.lamps.tolist(),
            "ambient": take.lighting.ambient,
            "projector": take.lighting.projector.tolist(),
        },
        "views": [_view_record(truth, take.present) for truth in frames.truth],
    }


def _view_record(truth: ViewTruth, present: bool) -> dict:
    camera = truth.camera
    known = {
        "centres": truth.centres.tolist(),
        "ellipses": truth.ellipses.tolist(),
        "blur_px": truth.blur_px.tolist(),
        "white_dn": None if np.isnan(truth.white_dn) else truth.white_dn,
    }
    return {
        "camera": {
            "size": list(camera.size),
            "matrix": camera.matrix.tolist(),
            "distortion": camera.distortion.tolist(),
            "camera_from_world": camera.camera_from_world.tolist(),
        },
        **(known if present else dict.fromkeys(known)),
        "visible": truth.visible.tolist(),
        "inside": truth.inside.tolist(),
        "patch_origins": truth.patch_origins.tolist(),
    }


def truths(path: Path) -> Iterator[dict]:
    """Truth records of a shard, in order."""
    for sample in wds.WebDataset(str(path), shardshuffle=False, select_files=lambda name: name.endswith(".json")):
        yield json.loads(sample["json"])


def write_index(place: Place, settings: Settings) -> None:
    """Index table, a row a sample: its place, and the quantities by which samples are chosen."""
    rows = []
    for number, _ in enumerate(settings.shards()):
        for record in truths(place.shard(number)):
            rows.append({
                "k": record["k"],
                "shard": place.shard(number).name,
                "present": record["present"],
                "body": record["body"],
                "surroundings": record["surroundings"],
                "gain": record["exposure"]["gain"],
                **{f"white_dn_{i}": view["white_dn"] for i, view in enumerate(record["views"], 1)},
                **{f"blur_px_{i}": max(view["blur_px"] or [0]) for i, view in enumerate(record["views"], 1)},
                **{f"visible_{i}": min(view["visible"]) for i, view in enumerate(record["views"], 1)},
                **{f"inside_{i}": all(view["inside"]) for i, view in enumerate(record["views"], 1)},
            })  # fmt: skip
    with atomic.new_file(place.folder / INDEX) as path:
        pq.write_table(pa.Table.from_pylist(rows), path)
