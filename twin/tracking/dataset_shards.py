"""Data sets on disk: WebDataset tar shards and a Parquet index.

A shard is written to a temporary name and renamed, and sample k depends on the settings and k alone. So a run that was killed
goes on with the shards that are missing, and workers need no coordinator: the bytes are the same, however they were made.

Shard n has the samples from n times its size on, whatever range of them a folder has: folders of one set with ranges apart have
shards of different names, but for one that a range ends in, and no key twice.
"""

import json
import re
from collections.abc import Generator, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from pydantic import BaseModel, ConfigDict, ValidationError

from recon.errors import InputError, brief, one_line
from recon.files import atomic, json_text, tar_members
from recon.geometry.camera import Camera
from recon.model.rig import Rig
from twin.engine import Engine, results
from twin.session import first_difference
from twin.shooting import Quality
from twin.tracking.body_samples import with_bodies
from twin.tracking.mesh_bank import build_bodies
from twin.tracking.rendered_views import Sample, render_full, render_sketches, render_views
from twin.tracking.samples import Held, Take, draw
from twin.tracking.sampling_ranges import DataRanges
from twin.tracking.target_truth import ViewTruth, disc_masks

INDEX, SETTINGS = "index.parquet", "dataset.json"
BY = "dataset"  # who writes
VERSION = 2  # 1 had keys without the seed, and began with sample 0
VERSION_OF_BODIES = 3  # of a rig with further bodies; 2 showed the probe alone
BATCH = 5  # samples traced in one launch; doesn't change them
ROWS = 10_000  # of the index that are written at once
OF_VIEWS = {"white_dn": pa.float64(), "blur_px": pa.float64(), "visible": pa.float64(), "inside": pa.bool_()}  # index columns
LEFTOVER = re.compile(r"\.shard-(\d+)\..*\.(tar|lock)")  # perhaps, as of recon.files.atomic
MADE_ANEW = "delete the file, and the same command makes it anew"
PNG = [cv2.IMWRITE_PNG_COMPRESSION, 4]
RENDER = {"views": render_views, "sketches": render_sketches, "full": render_full}


class Settings(BaseModel):
    """Everything that a data set's bytes depend on, and the range of its samples."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    rig: Rig
    ranges: DataRanges
    quality: Quality
    frames: Literal["views", "sketches", "full"]
    seed: int
    first: int = 0
    samples: int
    shard: int  # samples a shard

    @property
    def version(self) -> int:
        """Version of the data set."""
        return VERSION_OF_BODIES if self.rig.bodies else VERSION

    def shards(self) -> range:
        """Numbers of the shards."""
        return range(self.first // self.shard, (self.first + self.samples - 1) // self.shard + 1)

    def samples_of(self, shard: int) -> range:
        """Samples in a shard."""
        first, end = shard * self.shard, (shard + 1) * self.shard
        return range(max(first, self.first), min(end, self.first + self.samples))

    def key(self, k: int) -> str:
        """A sample's key, unique among data sets of all seeds."""
        return f"{self.seed}-{k:08d}"


@dataclass(frozen=True)
class Place:
    """A data set's folder."""

    folder: Path

    def shard(self, number: int) -> Path:
        """File of a shard."""
        return self.folder / f"shard-{number:05d}.tar"


class Written(BaseModel):
    """What `dataset.json` must have so that its other fields can be compared."""

    model_config = ConfigDict(strict=True)

    version: int
    first: int = 0
    samples: int


def prepare(place: Place, settings: Settings) -> list[int]:
    """Open a folder for a data set, and say which shards are missing.

    Raises
    ------
    InputError
        If the folder holds a data set of other settings or of another version, or something else.
    """
    told = place.folder / SETTINGS
    unused = {} if settings.rig.bodies else {"ranges": {"bodies"}}  # so that sets of one body go on from before there were others
    written = {"version": settings.version, **settings.model_dump(mode="json", exclude=unused)}
    if told.exists():
        _check_same(told, written)
    atomic.check_filled_folder(place.folder, BY)
    if place.folder.is_dir():
        _remove_leftovers(place)
    missing = [number for number in settings.shards() if not _complete(place, settings, number)]
    for name in (SETTINGS, INDEX, *(place.shard(number).name for number in missing)):
        atomic.check_listed(place.folder, name, BY)
    atomic.begin_filled(place.folder, BY)
    with atomic.listed_file(place.folder, SETTINGS, BY) as path:
        path.write_text(json.dumps(written, indent=1), encoding="utf-8")
    return missing


def _check_same(told: Path, written: Mapping[str, Any]) -> None:
    """Refuse a folder whose data set isn't this one, or a longer one."""
    found = json_text.read(told)
    try:
        there = Written.model_validate(found)
    except ValidationError as error:
        raise InputError(f"{told}: {one_line(error)}; expected a data set's settings, or another out") from None
    if there.version != (version := written["version"]):
        older = {1: ", whose keys lack the seed", 2: ", which shows the probe alone"} if there.version < version else {}
        raise InputError(
            f"{told}: version: expected {version}, found {there.version}{older.get(there.version, '')}; "
            "it can be trained with as it is, "
            "but gets no more samples: choose another out, with first=... for those that come after its own"
        )
    if there.samples > written["samples"]:
        expected = f"expected at least the {there.samples} it was begun with"
        raise InputError(f"{told}: samples: {expected}, found {written['samples']}")
    name, wanted, other = first_difference(written, found | {"samples": written["samples"]})
    if name:
        expected = f"expected {brief(wanted)} as in this run, found {brief(other)}, another data set"
        raise InputError(f"{told}: {name}: {expected}; choose another out")


def _remove_leftovers(place: Place) -> None:
    """Remove what a killed run has left of shards; the folder, which may have many thousands, is looked through once."""
    leftovers = [LEFTOVER.fullmatch(path.name) for path in place.folder.iterdir()]
    for number in sorted({int(name[1]) for name in leftovers if name}):
        atomic.remove_leftovers(place.shard(number))


def _complete(place: Place, settings: Settings, number: int) -> bool:
    """Whether a shard is there with all its samples; the last one of a smaller data set of the same settings has to grow."""
    path = place.shard(number)
    if not path.exists():
        return False
    try:
        return [key for key, _ in tar_members.samples(path)] == [settings.key(k) for k in settings.samples_of(number)]
    except InputError as error:
        raise InputError(f"{error}; {MADE_ANEW}") from None


def generate(place: Place, settings: Settings, missing: Sequence[int], engine: Engine) -> Generator[int, None, None]:
    """Make the missing shards; gives the number of samples as each shard is done. However it ends, nothing temporary is left."""
    try:
        yield from results(engine, write_shard, ((place, settings, number) for number in missing))
    finally:
        _remove_leftovers(place)  # of workers that were ended with this process


def write_shard(place: Place, settings: Settings, number: int) -> int:
    """Render a shard's samples and write them; gives their number."""
    import webdataset  # with torch, where it is installed: seconds that a refusal and the help do without

    bank = build_bodies(settings.rig, settings.ranges.variants, settings.seed)
    samples = settings.samples_of(number)
    shard = atomic.listed_file(place.folder, place.shard(number).name, BY)
    with shard as path, webdataset.TarWriter(str(path), encoder=False, mtime=0, mode=0o644) as tar:
        for first in range(samples.start, samples.stop, BATCH):
            drawn = [draw(settings.ranges, settings.rig, settings.seed, k) for k in samples if first <= k < first + BATCH]
            takes = [with_bodies(take, bank, settings.ranges, settings.rig, settings.seed) for take in drawn]
            rendered = RENDER[settings.frames](bank, settings.rig, takes, settings.quality, settings.seed)
            for take, frames in zip(takes, rendered, strict=True):
                tar.write({"__key__": settings.key(take.k), **members(take, frames, settings)})
    return len(samples)


def members(take: Take, frames: Sample, settings: Settings) -> dict[str, bytes]:
    """A sample's files."""
    files = {f"cam{number}.png": _png(view) for number, view in zip((1, 2), frames.views, strict=True)}
    if settings.frames == "views":
        for number, patches in zip((1, 2), frames.patches, strict=True):
            truths = [views[number - 1] for views in frames.bodies.values()]
            masks = np.concatenate([disc_masks(truth.ellipses, truth.patch_origins, patches.shape[-1]) for truth in truths])
            files[f"patches{number}.png"] = _png(np.concatenate(patches))
            files[f"masks{number}.png"] = _png(np.concatenate(masks))
    return {**files, "json": json.dumps(truth_record(take, frames, settings)).encode()}


def _png(image: np.ndarray) -> bytes:
    return cv2.imencode(".png", image, PNG)[1].tobytes()


def truth_record(take: Take, frames: Sample, settings: Settings) -> dict:
    """Ground truth of a sample, as in docs/training.md."""
    probe, *others = take.held
    record = {
        "k": take.k,
        "seed": settings.seed,
        **_held_record(take.held[probe]),
        "surroundings": take.surroundings,
        "exposure": {"white_dn": take.white_dn, "gain": take.gain},
        "light": {
            "lamps": take.lighting.lamps.tolist(),
            "ambient": take.lighting.ambient,
            "projector": take.lighting.projector.tolist(),
        },
        "views": [_camera_record(truth.camera) | _view_record(truth, take.present) for truth in frames.truth],
    }
    bodies = {
        name: {
            "kind": settings.rig.bodies[name].kind,
            **_held_record(take.held[name]),
            "views": [_view_record(truth, take.held[name].present) for truth in frames.others[name]],
        }
        for name in others
    }
    return record | ({"bodies": bodies} if bodies else {})


def _held_record(held: Held) -> dict:
    motion = held.motion
    return {
        "present": held.present,
        "world_from_target": motion.world_from_target.tolist() if held.present else None,
        "shift_mm": motion.shift_mm.tolist() if held.present else None,
        "turn_rad": motion.turn_rad.tolist() if held.present else None,
        "body": held.body,
    }


def _camera_record(camera: Camera) -> dict:
    return {
        "camera": {
            "size": list(camera.size),
            "matrix": camera.matrix.tolist(),
            "distortion": camera.distortion.tolist(),
            "camera_from_world": camera.camera_from_world.tolist(),
        }
    }


def _view_record(truth: ViewTruth, present: bool) -> dict:
    known = {
        "centres": truth.centres.tolist(),
        "ellipses": truth.ellipses.tolist(),
        "blur_px": truth.blur_px.tolist(),
        "white_dn": None if np.isnan(truth.white_dn) else truth.white_dn,
    }
    return {
        **(known if present else dict.fromkeys(known)),
        "visible": truth.visible.tolist(),
        "inside": truth.inside.tolist(),
        "patch_origins": truth.patch_origins.tolist(),
    }


def truths(path: Path) -> Iterator[dict]:
    """Truth records of a shard, in order.

    Raises
    ------
    InputError
        If the shard is damaged.
    """
    for key, files in tar_members.samples(path):
        try:
            _, offset, size = files["json"]
            yield json_text.of_bytes(Path(f"{path}: {key}.json"), tar_members.read(path, offset, size))
        except (KeyError, ValueError, RecursionError):
            raise InputError(f"{path}: {key}: expected its truth, found none or damaged data; {MADE_ANEW}") from None


def write_index(place: Place, settings: Settings) -> None:
    """Index table, a row a sample: its place, and the quantities by which samples are chosen."""
    rows = (_index_row(place.shard(number), record) for number in settings.shards() for record in truths(place.shard(number)))
    columns = _index_columns(settings.rig)
    with atomic.listed_file(place.folder, INDEX, BY) as path, pq.ParquetWriter(path, columns) as table:
        while some := list(islice(rows, ROWS)):  # not all at once: there may be millions
            table.write_table(pa.Table.from_pylist(some, columns))


def _index_columns(rig: Rig) -> pa.Schema:
    """Columns of the sample and the probe, then of further bodies, with their names before them."""
    sample = {"seed": pa.int64(), "k": pa.int64(), "shard": pa.string(), "present": pa.bool_(), "body": pa.int64()}
    sample |= {"surroundings": pa.int64(), "gain": pa.float64()}
    views = {f"{name}_{i}": kind for name, kind in OF_VIEWS.items() for i in (1, 2)}
    others = {f"{body}_{name}": kind for body in rig.bodies for name, kind in ({"present": pa.bool_()} | views).items()}
    return pa.schema({**sample, **views, **others})


def _index_row(shard: Path, record: dict) -> dict:
    try:
        return {
            **{name: record[name] for name in ("seed", "k", "body", "surroundings")},
            "shard": shard.name,
            "gain": record["exposure"]["gain"],
            **_seen(record),
            **{
                f"{body}_{name}": value
                for body, known in record.get("bodies", {}).items()
                for name, value in _seen(known).items()
            },
        }
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise InputError(f"{shard}: expected the truth of samples made here, found other data ({error}); {MADE_ANEW}") from None


def _seen(record: dict) -> dict:
    """Columns of a target by its views."""
    columns = {"present": record["present"]}
    for i, view in enumerate(record["views"], 1):
        columns |= {
            f"white_dn_{i}": view["white_dn"],
            f"blur_px_{i}": max(view["blur_px"] or [0]),
            f"visible_{i}": min(view["visible"]),
            f"inside_{i}": all(view["inside"]),
        }
    return columns
