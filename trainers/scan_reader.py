"""Reads B-scans with their masses, as the network that finds these sees them: rendered sweeps, or images with outlines.

Outlines of others, such as of public breast images, come as a folder with `outlines.csv`: a row an image with the columns
`image` and `mask`, files in the folder, of one size, the mask 255 within lesions and 0 elsewhere; and `mm_per_px`, the size of a
pixel.
"""

import csv
import functools
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict

from recon.capture.image_formats import decode_image, size_of
from recon.capture.images import read_image
from recon.capture.manifest import MANIFEST, image_name
from recon.capture.sweep_part import SweepCapture, read_sweep
from recon.errors import InputError, short, validated
from recon.files import json_text
from recon.files.regular import MOST_TABLE, opened, read_bytes
from recon.segmentation import mass_network

Grey = NDArray[np.uint8]
Pairs = Iterator[tuple[Grey, Grey]]

CAPTURE, SCENE, LABELS = "capture", Path("truth", "scene.json"), Path("truth", "sweep", "labels")
MASS = re.compile(r"(mass|solid|tumour)\d+")  # labels of masses, and of a complex cyst's solid part, which is one's, too
OUTLINES, COLUMNS = "outlines.csv", ("image", "mask", "mm_per_px")


@dataclass(frozen=True)
class Scans:
    """B-scans of some sweeps, of `mass_network.PIXEL_MM`, and where they show masses."""

    images: Grey  # (n, h, w)
    masks: Grey  # (n, h, w) 255 within a mass
    size: NDArray[np.int64]  # (n, 2) height and width of a B-scan; to the right and below it is black
    sample: NDArray[np.int64]  # (n,) which sweep a B-scan is of

    def __len__(self) -> int:
        return len(self.images)

    @functools.cached_property
    def shows(self) -> NDArray[np.int64]:
        """Numbers of the B-scans with a mass."""
        return np.flatnonzero([mask.any() for mask in self.masks])


class _Scene(BaseModel):
    """What counts here of a scene's truth."""

    model_config = ConfigDict(extra="ignore")
    labels: list[str]


@dataclass(frozen=True)
class _Sample:
    """B-scans of one sweep, or an image with its outline, not read yet."""

    count: int
    shape: tuple[int, int]  # of its images: h, w
    pixel_mm: tuple[float, float]  # width and height of a pixel
    pairs: Callable[[], Pairs]  # reads images and masks


def read_scans(folders: Sequence[Path], tell: Callable[[int], None] = lambda count: None, partial: bool = False) -> Scans:
    """All B-scans of some folders: each is that of one sweep, of many, or of images with outlines, each a sample of its own.

    partial : leaves out sweeps that aren't finished

    Raises
    ------
    InputError
        If a folder has neither sweeps nor outlines, or one that is damaged, unfinished, or has no truth.
    """
    samples = [sample for folder in folders for sample in _samples(folder, partial)]
    counts = [sample.count for sample in samples]
    if not sum(counts):
        raise InputError("data: expected B-scans, found none")
    own = np.array([mass_network.reduced_size(sample.shape, sample.pixel_mm) for sample in samples])
    height, width = (-(-own.max(axis=0) // mass_network.MULTIPLE) * mass_network.MULTIPLE).tolist()
    images, masks = np.zeros((2, sum(counts), height, width), np.uint8)
    k = 0
    for sample in samples:
        for pair in sample.pairs():
            for wide, one in zip((images, masks), pair, strict=True):
                small = mass_network.reduced(one, sample.pixel_mm)
                wide[k, : small.shape[0], : small.shape[1]] = small
            k += 1
        tell(k)
    return Scans(images, masks, np.repeat(own, counts, axis=0), np.repeat(np.arange(len(samples)), counts))


def _samples(folder: Path, partial: bool) -> list[_Sample]:
    """Each sweep, or each image with an outline, in a folder."""
    if (folder / OUTLINES).is_file():
        return list(_outlined(folder))
    if (folder / CAPTURE).is_dir():
        return [_sweep(folder)]
    begun = sorted({path.parent for name in (CAPTURE, f".{CAPTURE}.*") for path in folder.glob(f"*/{name}")})
    found = [sweep for sweep in begun if (sweep / CAPTURE / MANIFEST).is_file()]
    if len(found) < len(begun) and not partial:
        sweep = next(sweep for sweep in begun if sweep not in found)
        raise InputError(f"{sweep / CAPTURE / MANIFEST}: expected a finished sweep, found none; partial=true leaves it out")
    if not found:
        raise InputError(f"{folder}: expected sweeps, as of `sonotwin sweep count=100`, or {OUTLINES}, found none")
    return [_sweep(sweep) for sweep in found]


def _outlined(folder: Path) -> Iterator[_Sample]:
    """Images and masks of a table."""
    path = folder / OUTLINES
    try:
        lines = read_bytes(path, MOST_TABLE).decode("utf-8-sig").splitlines()
        rows = list(csv.DictReader(lines))
    except (csv.Error, UnicodeDecodeError):
        raise InputError(f"{path}: expected a table as CSV text, found other or damaged data") from None
    if not rows:
        raise InputError(f"{path}: expected a row for each image, found none")
    for number, row in enumerate(rows, start=2):
        place = f"{path}: line {number}"
        if missing := [name for name in COLUMNS if not row.get(name)]:
            raise InputError(f"{place}: expected {', '.join(COLUMNS)}, found no {missing[0]}")
        files = folder / row["image"], folder / row["mask"]
        (width, height), other = map(_size, files)
        if (width, height) != other:
            found = f"{width}x{height} and {other[0]}x{other[1]}"
            raise InputError(f"{place}: expected image and mask of one size, found {found}")
        try:
            mm = float(row["mm_per_px"])
        except ValueError:
            mm = np.nan
        if not 0.01 <= mm <= 1:
            raise InputError(f"{place}: mm_per_px: expected 0.01 to 1, found {short(row['mm_per_px'])}")
        yield _Sample(1, (height, width), (mm, mm), functools.partial(_outline, *files))


def _size(path: Path) -> tuple[int, int]:
    """Width and height of an image file."""
    with opened(path, expected="an image") as stream:
        return size_of(path, stream)


def _outline(image: Path, mask: Path) -> Pairs:
    """The pair of an image and a mask."""
    inside = _grey(mask)
    if other := set(np.unique(inside).tolist()) - {0, 255}:
        raise InputError(f"{mask}: expected a mask of 0 and 255, found {min(other)}")
    yield _grey(image), inside


def _grey(path: Path) -> Grey:
    """An image file of 8 bits as grey."""
    pixels = decode_image(path, read_bytes(path))
    if pixels.dtype != np.uint8:
        raise InputError(f"{path}: expected 8 bits, found 16")
    return cv2.cvtColor(pixels, cv2.COLOR_BGR2GRAY) if pixels.ndim == 3 else pixels


def _sweep(folder: Path) -> _Sample:
    """A sweep with its truth."""
    sweep = read_sweep(folder / CAPTURE)
    if sweep.probe is None:
        raise InputError(f"{folder / CAPTURE}: expected the probe's calibration, for the size of pixels, found none")
    names = validated(_Scene, json_text.read(folder / SCENE), folder / SCENE).labels
    inside = np.zeros(256, np.uint8)
    inside[[k for k, name in enumerate(names[:256]) if MASS.fullmatch(name)]] = 255
    (width, height), scale = sweep.size, sweep.probe.scale
    pairs = functools.partial(_labelled, folder / LABELS, sweep, inside)
    return _Sample(len(sweep.frames), (height, width), (scale[0], scale[1]), pairs)


def _labelled(folder: Path, sweep: SweepCapture, inside: Grey) -> Pairs:
    """B-scans of a sweep and their masks; inside : (256,) 255 of the labels of masses."""
    for number, frame in enumerate(sweep.frames):
        yield sweep.image(number), inside[read_image(folder / image_name(int(frame)), sweep.size, bits=8)]
