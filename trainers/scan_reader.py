"""Reads B-scans with their masses, as the network that finds these sees them: rendered sweeps, or images with outlines.

Outlines of others, such as of public breast images, come as a folder with `outlines.csv`: a row an image with the columns
`image` and `mask`, files in the folder, of one size, the mask white within lesions; and `mm_per_px`, the size of a pixel.
"""

import csv
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict

from recon.capture.image_formats import decode_image
from recon.capture.images import read_image
from recon.capture.manifest import MANIFEST, image_name
from recon.capture.sweep_part import read_sweep
from recon.errors import InputError, reason, short, validated
from recon.files import json_text
from recon.files.regular import read_bytes
from recon.segmentation import mass_network

Grey = NDArray[np.uint8]

CAPTURE, SCENE, LABELS = "capture", Path("truth", "scene.json"), Path("truth", "sweep", "labels")
MASS = "mass"  # how labels of masses begin; a complex cyst's solid part is one's, too
SOLID = "solid"
OUTLINES, COLUMNS = "outlines.csv", ("image", "mask", "mm_per_px")


@dataclass(frozen=True)
class Scans:
    """B-scans of some sweeps, of `mass_network.PIXEL_MM`, and where they show masses."""

    images: Grey  # (n, h, w)
    masks: Grey  # (n, h, w) 255 within a mass
    sample: NDArray[np.int64]  # (n,) which sweep a B-scan is of

    def __len__(self) -> int:
        return len(self.images)


class _Scene(BaseModel):
    """What counts here of a scene's truth."""

    model_config = ConfigDict(extra="ignore")
    labels: list[str]


def read_scans(folders: Sequence[Path], tell: Callable[[int], None] = lambda count: None) -> Scans:
    """All B-scans of some folders: each is that of one sweep, of many, or of images with outlines, each a sample of its own.

    Raises
    ------
    InputError
        If a folder has neither sweeps nor outlines, or one that is damaged, or has no truth.
    """
    images, masks, sample = list[Grey](), list[Grey](), list[int]()
    for number, pairs in enumerate(pairs for folder in folders for pairs in _samples(folder)):
        for image, mask in pairs:
            images.append(image)
            masks.append(mask)
            sample.append(number)
        tell(len(images))
    height, width = np.max([image.shape for image in images], axis=0)
    wide, inside = (np.stack([_padded(image, height, width) for image in some]) for some in (images, masks))
    return Scans(wide, inside, np.array(sample))


def _samples(folder: Path) -> Iterator[Iterable[tuple[Grey, Grey]]]:
    """B-scans and masks of each sweep, or of each image with an outline, in a folder."""
    if (folder / OUTLINES).is_file():
        return ([pair] for pair in _outlined(folder))
    if (folder / CAPTURE).is_dir():
        return iter([_read(folder)])
    found = sorted(path.parent for path in folder.glob(f"*/{CAPTURE}") if (path / MANIFEST).is_file())
    if not found:
        raise InputError(f"{folder}: expected sweeps, as of `sonotwin sweep count=100`, or {OUTLINES}, found none")
    return (_read(sweep) for sweep in found)


def _outlined(folder: Path) -> Iterator[tuple[Grey, Grey]]:
    """Images and masks of a table."""
    path = folder / OUTLINES
    with path.open(encoding="utf-8-sig", newline="") as file:
        try:
            rows = list(csv.DictReader(file))
        except (csv.Error, UnicodeDecodeError) as error:
            raise InputError(f"{path}: expected a table, found {reason(error)}") from None
    if not rows:
        raise InputError(f"{path}: expected a row for each image, found none")
    for number, row in enumerate(rows, start=2):
        place = f"{path}: line {number}"
        if missing := [name for name in COLUMNS if not row.get(name)]:
            raise InputError(f"{place}: expected {', '.join(COLUMNS)}, found no {missing[0]}")
        image, mask = (_grey(folder / row[name]) for name in COLUMNS[:2])
        if image.shape != mask.shape:
            sizes = " and ".join(f"{one.shape[1]}x{one.shape[0]}" for one in (image, mask))
            raise InputError(f"{place}: expected image and mask of one size, found {sizes}")
        try:
            mm = float(row["mm_per_px"])
        except ValueError:
            mm = np.nan
        if not 0.01 <= mm <= 1:
            raise InputError(f"{place}: mm_per_px: expected 0.01 to 1, found {short(row['mm_per_px'])}")
        inside = np.where(mask > 127, 255, 0).astype(np.uint8)
        yield mass_network.reduced(image, (mm, mm)), mass_network.reduced(inside, (mm, mm))


def _grey(path: Path) -> Grey:
    """An image file of 8 bits as grey."""
    pixels = decode_image(path, read_bytes(path))
    if pixels.dtype != np.uint8:
        raise InputError(f"{path}: expected 8 bits, found 16")
    return cv2.cvtColor(pixels, cv2.COLOR_BGR2GRAY) if pixels.ndim == 3 else pixels


def _read(folder: Path) -> Iterator[tuple[Grey, Grey]]:
    """B-scans of a sweep and their masks."""
    sweep = read_sweep(folder / CAPTURE)
    if sweep.probe is None:
        raise InputError(f"{folder / CAPTURE}: expected the probe's calibration, for the size of pixels, found none")
    names = validated(_Scene, json_text.read(folder / SCENE), folder / SCENE).labels
    inside = np.array([255 if name.startswith((MASS, SOLID)) else 0 for name in names] + [0] * (256 - len(names)), np.uint8)
    pixel_mm = sweep.probe.scale[0], sweep.probe.scale[1]
    for number, frame in enumerate(sweep.frames):
        labels = read_image(folder / LABELS / image_name(int(frame)), sweep.size, bits=8)
        yield tuple(mass_network.reduced(one, pixel_mm) for one in (sweep.image(number), inside[labels]))


def _padded(image: Grey, height: int, width: int) -> Grey:
    return np.pad(image, ((0, height - image.shape[0]), (0, width - image.shape[1])))
