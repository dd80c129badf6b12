"""Reads rendered sweeps, as of `sonotwin sweep`, for the network that finds masses: B-scans as it sees them, and their masses."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict

from recon.capture.images import read_image
from recon.capture.manifest import MANIFEST, image_name
from recon.capture.sweep_part import read_sweep
from recon.errors import InputError, validated
from recon.files import json_text
from recon.segmentation import mass_network

Grey = NDArray[np.uint8]

CAPTURE, SCENE, LABELS = "capture", Path("truth", "scene.json"), Path("truth", "sweep", "labels")
MASS = "mass"  # how labels of masses begin; a complex cyst's solid part is one's, too
SOLID = "solid"


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
    """All B-scans of sweeps: each folder is that of one sweep, or of many.

    Raises
    ------
    InputError
        If a folder has no sweep, or one that is damaged, or has no truth.
    """
    images, masks, sample = list[Grey](), list[Grey](), list[int]()
    for number, sweep in enumerate(sweep for folder in folders for sweep in _sweeps(folder)):
        for image, mask in _read(sweep):
            images.append(image)
            masks.append(mask)
            sample.append(number)
        tell(len(images))
    height, width = np.max([image.shape for image in images], axis=0)
    wide, inside = (np.stack([_padded(image, height, width) for image in some]) for some in (images, masks))
    return Scans(wide, inside, np.array(sample))


def _sweeps(folder: Path) -> list[Path]:
    """Folders of the sweeps in a folder."""
    if (folder / CAPTURE).is_dir():
        return [folder]
    found = sorted(path.parent for path in folder.glob(f"*/{CAPTURE}") if (path / MANIFEST).is_file())
    if not found:
        raise InputError(f"{folder}: expected sweeps, as of `sonotwin sweep count=100`, found none")
    return found


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
