"""Reads data sets for the tracker's networks, tar shards in WebDataset's layout: the truth at once, the images as memory allows.

Images in memory cost no decoding during the training. What is larger than memory stays in the shards, and is read image by image
by its place: the same images either way, whatever the order.
"""

import functools
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import NamedTuple, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from recon import registry
from recon.capture.image_formats import decode_image
from recon.errors import InputError, short, validated
from recon.files import json_text, tar_members
from recon.model import circle_layout
from recon.model.rig import Target
from trainers.scan_reader import Scans
from trainers.shard_truth import (
    UNNAMED,
    Array,
    Count,
    Facts,
    Known,
    PatchedTruth,
    SampleTruth,
    ellipses_in_patches,
    facts,
    identity,
    parse,
)
from trainers.stored_images import Decode, Grey, StoredImages

VIEW = (320, 240)  # px, width and height of a view as the detector gets it
PATCH = 120  # px, edge of a patch as the segmenter gets it
VIEWS = ("1", "2")  # of the cameras, as members are named
AT_ONCE = 1024  # images that are decoded between two calls of `tell`

Images = Grey | StoredImages
Tell = Callable[[int], None]  # of how many samples were read, or images decoded


@dataclass(frozen=True)
class Views:
    """Views of n samples, two each, and their ground truth. Of a target that isn't there centres are NaN and the rest is 0.

    The circles are those of the probe's target, then those of further bodies' targets.
    """

    images: Images  # (2 n, 240, 320)
    scale: Array  # (2 n, 2) px of full resolution a px of a view, along u and v
    centres: Array  # (2 n, circles, 2) px of full resolution
    visible: Array  # (2 n, circles) fraction of each outer disc that is seen
    inside: NDArray[np.bool_]  # (2 n, circles) whether the whole disc is in the image
    blur: Array  # (2 n, circles) px of full resolution
    identity: NDArray[np.int64]  # (2 n, circles) 0 of c0 and on; UNNAMED of targets of another kind than the probe's
    body: NDArray[np.int64]  # (2 n, circles) whose a circle is: 0 of the probe's target, then of further ones; -1 of none
    white: Array  # (2 n,) digital number of the targets' white, the brightest's
    sample: NDArray[np.int64]  # (2 n,) which sample a view is of

    def __len__(self) -> int:
        return len(self.images)

    @property
    def present(self) -> NDArray[np.bool_]:
        """(2 n,) whether there is a target before the camera."""
        return np.isfinite(self.centres).all(2).any(1)


@dataclass(frozen=True)
class Patches:
    """Patches of n samples, one a circle and view: m."""

    images: Images  # (m, 120, 120)
    masks: Images  # (m, 120, 120) 255 within the outer disc
    ellipses: Array  # (m, 5) u, v in px of the patch, semi-axes in px, angle in rad; NaN without a target
    visible: Array  # (m,) fraction of the disc that is seen
    white: Array  # (m,) digital number of the target's white
    sample: NDArray[np.int64]  # (m,) which sample a patch is of

    def __len__(self) -> int:
        return len(self.images)


Data = Views | Patches | Scans
Some = TypeVar("Some", bound=Data)


def read_views(folders: Sequence[Path], tell: Tell = lambda count: None, partial: bool = False) -> Views:
    """Both views of every sample of some data sets, one after the other, with the images left in the shards.

    Raises
    ------
    InputError
        In one line, where a set is missing, damaged or, unless `partial`, incomplete, or a sample is in two of them. Damage of
        images shows when they are decoded.
    """
    kind, circles = kind_of(folders), circles_of(folders)

    def convert(samples: Sequence[SampleTruth]) -> tuple[Array, ...]:
        return np.array([view.camera.size for sample in samples for view in sample.views], float), *facts(samples, circles)

    parts = []
    for index in _read(folders, [f"cam{k}.png" for k in VIEWS], SampleTruth, convert, circles, tell, partial):
        size, known = index.columns[0], Facts(*index.columns[1:])
        n = len(size)
        targets = [(kind, circles), *index.others.values()]
        identity = [np.arange(count) if one == targets[0] else np.full(count, UNNAMED) for one in targets for count in one[1:]]
        body = np.repeat(np.arange(len(targets)), [count for _, count in targets])
        parts.append(
            Views(
                index.images(slice(None), _view, VIEW, 1),
                size / VIEW,
                known.centres,
                known.visible,
                known.inside,
                known.blur,
                np.tile(np.concatenate(identity), (n, 1)),
                np.tile(body, (n, 1)),
                known.white.max(axis=1),
                np.arange(n) // len(VIEWS),
            )
        )
    return joined(parts)


def read_patches(folders: Sequence[Path], tell: Tell = lambda count: None, partial: bool = False) -> Patches:
    """All patches of every sample, with their masks; otherwise as `read_views`."""
    circles = circles_of(folders)

    def convert(samples: Sequence[PatchedTruth]) -> tuple[Array, ...]:
        return *facts(samples, circles), ellipses_in_patches(samples, circles)

    ends = [f"{kind}{k}.png" for kind in ("patches", "masks") for k in VIEWS]
    parts = []
    for index in _read(folders, ends, PatchedTruth, convert, circles, tell, partial):
        *known, ellipses = index.columns
        visible, white = Facts(*known).visible, Facts(*known).white
        count = visible.shape[1]
        images, masks = (
            index.images(which, functools.partial(_patches, circles=count), (PATCH, PATCH), count)
            for which in (slice(len(VIEWS)), slice(len(VIEWS), None))
        )
        sample = np.arange(white.size) // (count * len(VIEWS))
        parts.append(Patches(images, masks, ellipses.reshape(-1, 5), visible.ravel(), white.ravel(), sample))
    return joined(parts)


def joined(parts: Sequence[Some]) -> Some:
    """Samples of all parts, one after the other; their images may lie in files of any kind."""
    circles = max(part.centres.shape[1] if isinstance(part, Views) else 0 for part in parts)
    first, *others = (_with_circles(part, circles) for part in parts)
    for part in others:
        columns = {field.name: _stacked(getattr(first, field.name), getattr(part, field.name)) for field in fields(first)}
        first = replace(first, **columns | {"sample": np.append(first.sample, part.sample + first.sample[-1] + 1)})
    return first


def _with_circles(data: Some, circles: int) -> Some:
    """The same; views with columns of that many circles, the further ones those of targets that aren't there."""
    if not isinstance(data, Views):
        return data
    nothing = {"centres": np.nan, "visible": 0.0, "inside": False, "blur": 0.0, "identity": UNNAMED, "body": -1}
    columns = {}
    for name, value in nothing.items():
        some = getattr(data, name)
        more = np.full_like(some, value, shape=(len(some), circles - some.shape[1], *some.shape[2:]))
        columns[name] = np.concatenate([some, more], axis=1)
    return replace(data, **columns)


def _stacked(one: StoredImages | np.ndarray, other: StoredImages | np.ndarray) -> StoredImages | np.ndarray:
    if isinstance(one, StoredImages) and isinstance(other, StoredImages):
        return one.followed_by(other)
    return np.concatenate([one, other])


def has_patches(folder: Path) -> bool:
    """Whether the first sample of a data set has patches."""
    samples = (sample for path in sorted(folder.glob("*.tar")) for _, sample in tar_members.samples(path))
    return "patches1.png" in next(samples, {})


def split(data: Some, validation: float) -> tuple[Some, Some]:
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
    held_out = data.sample >= count - last
    return chosen(data, ~held_out), chosen(data, held_out)


def chosen(data: Some, which: NDArray) -> Some:
    """The views, patches or B-scans that a mask or an index selects."""
    columns = {field.name: getattr(data, field.name) for field in fields(data)}
    return replace(
        data, **{name: some.chosen(which) if isinstance(some, StoredImages) else some[which] for name, some in columns.items()}
    )


def bytes_decoded(data: Data) -> int:
    """Memory that the images of a data set take."""
    images = (data.images, data.masks) if not isinstance(data, Views) else (data.images,)
    return sum(int(np.prod(some.shape)) for some in images)


def in_memory(data: Some, tell: Tell = lambda count: None) -> Some:
    """The same with its images decoded; InputError in one line where one is damaged, or of another size."""
    stored = {field.name: getattr(data, field.name) for field in fields(data)}
    decoded = {name: _decoded(some, tell) for name, some in stored.items() if isinstance(some, StoredImages)}
    return replace(data, **decoded)


def as_fits(sets: Sequence[Data], most_bytes: float, tell: Tell = lambda count: None) -> list[Data]:
    """Data sets, the smaller ones first in memory as long as they fit; the others stay in their shards."""
    result = list(sets)
    for place in sorted(range(len(sets)), key=lambda place: bytes_decoded(sets[place])):
        most_bytes -= bytes_decoded(sets[place])
        if most_bytes >= 0:
            result[place] = in_memory(sets[place], tell)
    return result


def _decoded(images: StoredImages, tell: Tell) -> Grey:
    result = np.empty(images.shape, np.uint8)
    for first in range(0, len(images), AT_ONCE):
        result[first : first + AT_ONCE] = images[first : first + AT_ONCE]
        tell(min(first + AT_ONCE, len(images)))
    return result


class _Index(NamedTuple):
    """What is known of all samples of a folder without their images."""

    shards: tuple[Path, ...]
    places: NDArray[np.int64]  # (samples, members, 3) as of `StoredImages`
    columns: list[Array]
    others: Mapping[str, tuple[str, int]]  # kind and number of circles of further bodies' targets

    def images(self, which: slice, decode: Decode, size: tuple[int, int], pieces: int) -> StoredImages:
        """Images in some of the members."""
        places = self.places[:, which].reshape(-1, 3)
        index = np.column_stack([np.repeat(np.arange(len(places)), pieces), np.tile(np.arange(pieces), len(places))])
        return StoredImages(self.shards, places, (decode,) * len(self.shards), size, index)


class _Shard(NamedTuple):
    path: Path
    places: NDArray[np.int64]  # (samples, members, 3)
    identities: NDArray[np.uint64]  # (samples,)
    columns: Sequence[Array]
    others: Mapping[str, tuple[str, int]]


def _read(
    folders: Sequence[Path],
    ends: Sequence[str],
    model: type[SampleTruth],
    convert: Callable,
    circles: int,
    tell: Tell,
    partial: bool,
) -> list[_Index]:
    """Read the truth of all samples, folder by folder, and find the members with these ends of their names."""
    shards: list[_Shard] = []
    indices: list[_Index] = []
    count = 0
    for folder in folders:
        before, own = count, list[_Shard]()
        for path in _shards_of(folder):
            own.append(_scan(path, len(own), ends, model, convert, circles))
            if own[-1].others != own[0].others:
                raise InputError(f"{path}: {_other_bodies(own[0].others, own[-1].others)} in {own[0].path}")
            count += len(own[-1].identities)
            tell(count)
        expected = None if partial else _settings(folder).samples
        if expected is not None and expected != count - before:
            found = f"found {count - before} in shards; partial=true takes these"
            raise InputError(f"{folder}: expected {expected} samples as of dataset.json, {found}")
        columns = [np.concatenate(column) for column in zip(*(shard.columns for shard in own), strict=True)]
        places = np.concatenate([shard.places for shard in own])
        indices.append(_Index(tuple(shard.path for shard in own), places, columns, own[0].others))
        shards += own
    _check_apart(shards)
    return indices


def _other_bodies(expected: Mapping[str, tuple[str, int]], found: Mapping[str, tuple[str, int]]) -> str:
    one, other = (
        ", ".join(f"{short(name)} of {count} circles" for name, (_, count) in some.items()) or "none"
        for some in (expected, found)
    )
    return f"bodies: expected the same in all samples, found {other}, and {one}"


def _shards_of(folder: Path) -> list[Path]:
    shards = sorted(path for path in folder.glob("*.tar") if not path.name.startswith("."))  # such are being written
    if not shards:
        found = "no such folder" if not folder.exists() else "none" if folder.is_dir() else "a file"
        raise InputError(f"{folder}: expected a folder with shards, shard-00000.tar ..., found {found}")
    return shards


def _scan(path: Path, number: int, ends: Sequence[str], model: type[SampleTruth], convert: Callable, circles: int) -> _Shard:
    truths: list[SampleTruth] = []
    places: list[list[tuple[int, int, int]]] = []
    identities: list[int] = []
    for key, members in tar_members.samples(path):
        for end in ("json", *ends):
            if end not in members:
                raise InputError(f"{path}: {key}: expected the member {key}.{end}, found none")
        _, offset, size = members["json"]
        content = tar_members.read(path, offset, size)
        truth = parse(f"{path}: {key}.json", content, model)
        for view in truth.views:
            if view.circles not in (None, circles):
                found = f"{view.circles}; dataset.json beside it names the target, rig.target.kind"
                raise InputError(f"{path}: {key}.json: expected {circles} circles a view, found {found}")
        truths.append(truth)
        if truth.others != truths[0].others:
            raise InputError(f"{path}: {key}.json: {_other_bodies(truths[0].others, truth.others)} before it")
        places.append([(number, members[end].offset, members[end].size) for end in ends])
        identities.append(identity(truth, content))
    if not places:
        raise InputError(f"{path}: expected samples, found none in it; was it cut short? Remove it, and make its samples again")
    return _Shard(path, np.array(places, np.int64), np.array(identities, np.uint64), convert(truths), truths[0].others)


def _check_apart(shards: Sequence[_Shard]) -> None:
    """Refuse samples that are there twice: some would be trained with and validated with."""
    identities = np.concatenate([shard.identities for shard in shards])
    of_shard = np.repeat(np.arange(len(shards)), [len(shard.identities) for shard in shards])
    order = np.argsort(identities, kind="stable")
    same = np.flatnonzero((np.diff(identities[order]) == 0) & (identities[order][1:] > 0))
    if len(same):
        one, other = (shards[of_shard[order[place]]].path for place in (same[0], same[0] + 1))
        raise InputError(
            f"{other}: expected samples that are in no other part, found {len(same)} in two, here and in {one} the first; "
            "parts of one set need ranges apart (first, samples), or seeds of their own"
        )


class _Kind(Known):
    kind: str = Target.USUAL


class _Rig(Known):
    target: _Kind = _Kind()


class _Settings(Known):
    """What counts here of a data set's settings."""

    samples: Count | None = None
    rig: _Rig = _Rig()


def _settings(folder: Path) -> _Settings:
    """Settings of a data set; the usual ones where its folder has none."""
    path = folder / "dataset.json"
    if not os.path.lexists(path):
        return _Settings()
    try:
        return validated(_Settings, json_text.read(path), path)
    except InputError as error:
        raise InputError(f"{error}; expected a data set's settings") from None


def kind_of(folders: Sequence[Path]) -> str:
    """The kind of target that data sets show, a module of `recon.model.targets`.

    Raises
    ------
    InputError
        If two show different ones, or one that isn't known.
    """
    kinds = {folder: _settings(folder).rig.target.kind for folder in folders}
    first, there = folders[0], registry.names(Target.PACKAGE)
    for folder, kind in kinds.items():
        if kind not in there:
            raise InputError(f"{folder}: rig.target.kind: expected one of {', '.join(there)}, found {short(kind)}")
        if kind != kinds[first]:
            raise InputError(
                f"{folder}: expected samples of {kinds[first]} as in {first}, found those of {kind}: train one for each"
            )
    return kinds[first]


def circles_of(folders: Sequence[Path]) -> int:
    """Number of the circles of the target that data sets show."""
    return circle_layout.count(Target.named(kind_of(folders)))


def _view(place: str, content: bytes) -> Grey:
    """A view of 320x240, or a full frame as the tracker makes it smaller : (1, 240, 320)."""
    image = _grey_image(place, content, None)
    return (image if image.shape[::-1] == VIEW else cv2.resize(image, VIEW))[None]


def _patches(place: str, content: bytes, circles: int) -> Grey:
    """Patches or masks of one view : (circles, 120, 120)."""
    return _grey_image(place, content, (PATCH, circles * PATCH)).reshape(circles, PATCH, PATCH)


def _grey_image(place: str, content: bytes, size: tuple[int, int] | None) -> Grey:
    image = decode_image(Path(place), content)
    if image.dtype != np.uint8 or image.ndim != 2 or (size is not None and image.shape[::-1] != size):
        wanted = "" if size is None else f"{size[0]}x{size[1]} "
        found = f"{image.shape[1]}x{image.shape[0]} {image.dtype}" + (" in colour" if image.ndim > 2 else "")
        raise InputError(f"{place}: expected {wanted}8-bit grey, found {found}")
    return image
