"""Reads a data set for the tracker's networks: tar shards in WebDataset's layout, decoded once into memory.

Two cores that train can't decode PNGs as well, and a set of 10 000 samples is 1.5 GB of views and 1.7 GB of patches and masks.
"""

import json
import tarfile
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields, replace
from itertools import groupby
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from recon.errors import InputError

VIEW = (320, 240)  # px, width and height of a view as the detector gets it
PATCH = 120  # px, edge of a patch as the segmenter gets it
CIRCLES = 3
VIEWS = ("1", "2")  # of the cameras, as members are named

Grey = NDArray[np.uint8]
Array = NDArray[np.float64]
Tell = Callable[[int], None]  # of how many samples were read


@dataclass(frozen=True)
class Views:
    """Views of n samples, two each, and their ground truth. Without a target centres are NaN and the rest is 0."""

    images: Grey  # (2 n, 240, 320)
    scale: Array  # (2 n, 2) px of full resolution a px of a view, along u and v
    centres: Array  # (2 n, 3, 2) px of full resolution
    visible: Array  # (2 n, 3) fraction of each outer disc that is seen
    inside: NDArray[np.bool_]  # (2 n, 3) whether the whole disc is in the image
    blur: Array  # (2 n, 3) px of full resolution
    white: Array  # (2 n,) digital number of the target's white
    sample: NDArray[np.int64]  # (2 n,) which sample a view is of

    def __len__(self) -> int:
        return len(self.images)

    @property
    def present(self) -> NDArray[np.bool_]:
        """(2 n,) whether there is a target before the camera."""
        return np.isfinite(self.centres).all((1, 2))


@dataclass(frozen=True)
class Patches:
    """Patches of n samples, six each."""

    images: Grey  # (6 n, 120, 120)
    masks: Grey  # (6 n, 120, 120) 255 within the outer disc
    ellipses: Array  # (6 n, 5) u, v in px of the patch, semi-axes in px, angle in rad; NaN without a target
    visible: Array  # (6 n,) fraction of the disc that is seen
    white: Array  # (6 n,) digital number of the target's white
    sample: NDArray[np.int64]  # (6 n,) which sample a patch is of

    def __len__(self) -> int:
        return len(self.images)


Data = Views | Patches


def read_views(folder: Path, tell: Tell = lambda count: None, partial: bool = False) -> Views:
    """Both views of every sample; InputError, in one line, where the set is missing, damaged or, unless `partial`, incomplete."""
    samples = _read(folder, ["json", "cam1.png", "cam2.png"], _views_of, tell, partial)
    return Views(*(np.concatenate(column) for column in zip(*samples, strict=True)))


def read_patches(folder: Path, tell: Tell = lambda count: None, partial: bool = False) -> Patches:
    """All six patches of every sample, with their masks; InputError as `read_views`."""
    members = ["json", *(f"{kind}{camera}.png" for camera in VIEWS for kind in ("patches", "masks"))]
    samples = _read(folder, members, _patches_of, tell, partial)
    return Patches(*(np.concatenate(column) for column in zip(*samples, strict=True)))


def split(data: Data, validation: float) -> tuple[Data, Data]:
    """The first samples to train with and the last ones, a fraction `validation` and at least one, to validate with.

    Raises
    ------
    InputError
        If there is but one sample.
    """
    count = int(data.sample[-1]) + 1
    if count < 2:
        raise InputError("data: expected at least 2 samples, one of them to validate with, found 1")
    last = min(max(round(validation * count), 1), count - 1)
    held = data.sample >= count - last
    return chosen(data, ~held), chosen(data, held)


def chosen(data: Data, which: NDArray) -> Data:
    """The views or patches that a mask or an index selects."""
    return replace(data, **{field.name: getattr(data, field.name)[which] for field in fields(data)})


def _read(folder: Path, members: Sequence[str], decode: Callable, tell: Tell, partial: bool) -> list[tuple]:
    shards = sorted(path for path in folder.glob("*.tar") if not path.name.startswith("."))  # such are being written
    if not shards:
        found = "no such folder" if not folder.exists() else "none" if folder.is_dir() else "a file"
        raise InputError(f"{folder}: expected a folder with shards, shard-00000.tar ..., found {found}")
    results: list[tuple] = []
    with ThreadPoolExecutor(2) as pool:
        for shard in shards:
            for result in pool.map(lambda one: decode(*one), _samples(shard, members)):
                results.append((*result, np.full(len(result[0]), len(results))))
                tell(len(results))
    expected = None if partial else _promised(folder)
    if expected is not None and expected != len(results):
        raise InputError(
            f"{folder}: expected {expected} samples as of dataset.json, found {len(results)} in shards; partial=true takes these"
        )
    return results


def _promised(folder: Path) -> int | None:
    """Number of samples by the data set's own count, or None."""
    path = folder / "dataset.json"
    if not path.is_file():
        return None
    try:
        count = json.loads(path.read_text(encoding="utf-8")).get("samples")
    except (json.JSONDecodeError, UnicodeDecodeError, AttributeError):
        raise InputError(f"{path}: expected a data set's settings as JSON, found other or damaged data") from None
    return count if isinstance(count, int) else None


def _samples(shard: Path, members: Sequence[str]) -> Iterator[tuple[str, dict[str, bytes]]]:
    """Each sample's place, for messages, and its requested members, in the order of the shard."""
    try:
        with tarfile.open(shard, "r:") as archive:
            files = (entry for entry in archive if entry.isfile())
            for key, entries in groupby(files, key=lambda entry: entry.name.partition(".")[0]):
                content = {}
                for entry in entries:
                    name = entry.name.partition(".")[2]
                    file = archive.extractfile(entry) if name in members else None
                    if file is not None:
                        content[name] = file.read()
                for name in members:
                    if name not in content:
                        raise InputError(f"{shard}: {key}: expected the member {key}.{name}, found none")
                yield f"{shard}: {key}", content
    except (tarfile.TarError, EOFError) as error:
        raise InputError(f"{shard}: expected a tar file, found a damaged one: {error}") from None


def _views_of(place: str, content: dict[str, bytes]) -> tuple:
    truth = _truth(place, content["json"])
    images = np.stack([_full_or_view(f"{place}.cam{k}.png", content[f"cam{k}.png"]) for k in VIEWS])
    return images, *_facts(place, truth)


def _facts(place: str, truth: dict) -> tuple[Array, ...]:
    """Scale, centres, visible, inside, blur, white, as of `Views`."""
    rows = []
    try:
        for view in truth["views"]:
            scale = np.divide(view["camera"]["size"], VIEW)
            if view["centres"] is None:
                nothing = np.zeros(CIRCLES)
                rows.append((scale, np.full((CIRCLES, 2), np.nan), nothing, nothing.astype(bool), nothing, 0.0))
            else:
                seen = [
                    np.array(view[name], dtype=kind) for name, kind in (("visible", float), ("inside", bool), ("blur_px", float))
                ]
                rows.append(
                    (scale, np.array(view["centres"], dtype=float).reshape(CIRCLES, 2), *seen, float(view["white_dn"] or 0))
                )
        return tuple(np.stack(column) for column in zip(*rows, strict=True))
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"{place}.json: expected two views with camera, centres, visible ..., found otherwise: {error}"
        ) from None


def _patches_of(place: str, content: dict[str, bytes]) -> tuple:
    truth = _truth(place, content["json"])
    facts = _facts(place, truth)
    visible, white = facts[2].reshape(-1), np.repeat(facts[-1], CIRCLES)
    stacks = [
        np.concatenate([_decoded(f"{place}.{kind}{k}.png", content[f"{kind}{k}.png"], (PATCH, CIRCLES * PATCH)) for k in VIEWS])
        for kind in ("patches", "masks")
    ]
    ellipses = []
    try:
        for view in truth["views"]:
            origins = np.array(view["patch_origins"], dtype=float).reshape(CIRCLES, 2)
            ellipse = np.full((CIRCLES, 5), np.nan) if view["ellipses"] is None else np.array(view["ellipses"], dtype=float)
            ellipses.append(ellipse.reshape(CIRCLES, 5) - np.pad(origins, ((0, 0), (0, 3))))
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{place}.json: expected ellipses and patch_origins of each view, found otherwise: {error}") from None
    images, masks = (stack.reshape(-1, PATCH, PATCH) for stack in stacks)
    return images, masks, np.concatenate(ellipses), visible, white


def _truth(place: str, content: bytes) -> dict:
    try:
        truth = json.loads(content)
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise InputError(f"{place}.json: expected JSON, found damaged data: {error}") from None
    if not isinstance(truth, dict) or len(truth.get("views") or ()) != len(VIEWS):
        raise InputError(f"{place}.json: expected a map with {len(VIEWS)} views, found otherwise")
    return truth


def _full_or_view(place: str, content: bytes) -> Grey:
    """A view of 320x240, or a full frame as the tracker makes it smaller."""
    image = _decoded(place, content, None)
    return image if image.shape[::-1] == VIEW else cv2.resize(image, VIEW)


def _decoded(place: str, content: bytes, size: tuple[int, int] | None) -> Grey:
    image = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED) if content else None
    if image is None:
        raise InputError(f"{place}: expected a PNG, found damaged data")
    if image.dtype != np.uint8 or image.ndim != 2 or (size is not None and image.shape[::-1] != size):
        wanted = "" if size is None else f"{size[0]}x{size[1]} "
        found = f"{image.shape[1]}x{image.shape[0]} {image.dtype}" + (" in colour" if image.ndim > 2 else "")
        raise InputError(f"{place}: expected {wanted}8-bit grey, found {found}")
    return image
