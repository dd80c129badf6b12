"""Training batches: augmented views or patches and their labels. Batch k depends on (seed, k) alone."""

import os
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import count

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Generator, Tensor
from torch.utils.data import DataLoader, Dataset

from recon.errors import InputError
from trainers.augment import WHITE, moved, occlude, photograph, scanned, tilts, turns, uniform, warp
from trainers.labels import Labels, label_offset, labels, seen_in_view
from trainers.scan_reader import Scans
from trainers.shard_reader import PATCH, Data, Patches, Views
from trainers.shard_truth import HIDDEN, SEEN

TARGET_IN_CROP = 0.85  # of crops from views with a target are about it; the others are of anywhere
COVERED = (HIDDEN + SEEN) / 2  # visible fraction of a circle whose centre something was put before: neither answer is wrong
SCALES, DISC_SCALES = (0.5, 1.6), (0.6, 1.5)  # least and most, of views and of patches
COARSEST, COARSEST_DISC = 0.45, 0.22  # a picture 300 px wide may have been made larger, to full resolution
SCAN = (112, 128)  # px, width and height of a B-scan that is trained with
SHOWS_MASS = 0.6  # of B-scans, chosen among those with a mass; the others of all
SHIFT = 12.0  # px, most, of a disc from the middle of its patch: the detector's error, and the rounding

Batch = tuple[Tensor, Tensor, Tensor]


@dataclass(frozen=True)
class Crops:
    """A batch for a detector."""

    images: Tensor  # (n, 1, h, w) grey/255
    labels: Labels
    places: Tensor  # (n, circles, 2) coarse places of the circles, px, not rounded; NaN without a target


@dataclass(frozen=True)
class Discs:
    """A batch for a segmenter: of patches, h = w = 120, or of B-scans."""

    images: Tensor  # (n, 1, h, w) grey/255
    masks: Tensor  # (n, 1, h, w) from 0 to 1
    weights: Tensor  # (n, 1, h, w) 0 where the image shows nothing


@dataclass(frozen=True)
class Batches(Dataset[Batch]):
    """Batches by their steps' numbers: images, and the labels for the losses of `trainers.labels`."""

    data: Data
    size: int
    crop_px: int  # of views
    seed: int
    scales: tuple[float, float] = SCALES  # of views, least and most

    def __getitem__(self, index: int) -> Batch:
        generator = generator_of(self.seed, index)
        if isinstance(self.data, Patches):
            some = discs(self.data, self.size, generator)
            return some.images, some.masks, some.weights
        if isinstance(self.data, Scans):
            some = scans(self.data, self.size, generator)
            return some.images, some.masks, some.weights
        some = crops(self.data, self.size, self.crop_px, generator, self.scales)
        return some.images, some.labels.pixel, some.labels.identity

    def since(self, step: int, loaders: int) -> Iterator[Batch]:
        """Batches from a step on, prepared ahead by worker processes; without workers, one at a time on request.

        Raises
        ------
        InputError
            In one line, also from a worker, where an image that was left in its shard turns out to be damaged.
        """
        for batch in DataLoader(_Told(self), batch_size=None, sampler=count(step), num_workers=loaders, worker_init_fn=_apart):
            if isinstance(batch, InputError):
                raise batch
            yield batch


@dataclass(frozen=True)
class _Told(Dataset["Batch | InputError"]):
    """Batches, or the user's mistakes as what they are: the loader would put a worker's traceback into the message."""

    batches: Batches

    def __getitem__(self, index: int) -> Batch | InputError:
        try:
            return self.batches[index]
        except InputError as error:
            return error


def _apart(_: int) -> None:
    """Signals to stop are for the process that trains; those that make its batches end with it."""
    if hasattr(os, "setpgrp"):  # not on Windows
        os.setpgrp()


def generator_of(seed: int, step: int) -> Generator:
    """The random numbers of one step."""
    state = np.random.SeedSequence([seed, step]).generate_state(1, np.uint64)[0]
    return Generator().manual_seed(int(state >> np.uint64(1)))


def crops(views: Views, size: int, edge: int, generator: Generator, scales: tuple[float, float] = SCALES) -> Crops:
    """Crops of `edge` px of `size` random views, turned, scaled and photographed anew."""
    which = torch.randint(len(views), (size,), generator=generator).numpy()
    images = views.images[which]
    scale = torch.from_numpy(views.scale[which]).float()
    centres = seen_in_view(torch.from_numpy(views.centres[which]).float(), scale)
    visible, white = torch.from_numpy(views.visible[which]).float(), torch.from_numpy(views.white[which]).float()
    height, width = images.shape[1:]
    shown = (centres >= -0.5).all(-1) & (centres < torch.tensor([width, height]) - 0.5).all(-1)
    visible = torch.where(shown, visible, torch.zeros(()))  # beyond the view there is nothing to find
    linear = turns(size, scales, generator)
    anywhere = torch.rand(size, 2, generator=generator) * torch.tensor([width - 1.0, height - 1.0])
    about = (torch.rand(size, generator=generator) < TARGET_IN_CROP) & (visible >= SEEN).any(1)
    middle = _middle(centres, visible, torch.from_numpy(views.body[which]), generator)
    source = torch.where(about[:, None], middle, anywhere)
    goal = edge * uniform(0.15, 0.85, (size, 2), generator)
    images = warp(images, linear, source, goal, (edge, edge), _fill(images, generator))
    places = moved(centres, linear, source, goal)
    images, covered = occlude(images, 2, generator)
    visible = torch.where(_at(covered, places), visible.clamp(max=COVERED), visible)
    places = places + label_offset(scale)[:, None]
    images = photograph(images, white, COARSEST, generator) / WHITE
    names = torch.from_numpy(views.identity[which])
    return Crops(images, labels(places, visible, names, (edge, edge)), places)


def _middle(centres: Tensor, visible: Tensor, body: Tensor, generator: Generator) -> Tensor:
    """Middle (n, 2) of a target in each view: of several, one that is seen. 0 without a target."""
    chosen = torch.zeros(len(centres), dtype=torch.int64)
    if body.max() > 0:
        seen = (visible >= SEEN).float()
        seen[:, 0] += seen.sum(1) == 0
        chosen = body.gather(1, torch.multinomial(seen, 1, generator=generator))[:, 0]
    its = body == chosen[:, None]
    return torch.nan_to_num(torch.where(its[..., None], centres, 0.0).sum(1) / its.sum(1, keepdim=True))


def discs(patches: Patches, size: int, generator: Generator) -> Discs:
    """`size` random patches with their masks, shifted, turned, scaled and photographed anew."""
    which = torch.randint(len(patches), (size,), generator=generator).numpy()
    linear = turns(size, DISC_SCALES, generator)
    drawn = torch.from_numpy(patches.ellipses[which][:, :2]).float()
    middle = torch.full((size, 2), (PATCH - 1) / 2)
    near = ((drawn - middle).abs() < 2 * SHIFT).all(1)  # false without a disc
    source = torch.where(near[:, None], drawn, middle)
    goal = middle + SHIFT * uniform(-1.0, 1.0, (size, 2), generator)
    change = (linear, source, goal, (PATCH, PATCH))
    images = patches.images[which]  # once: they may have to be decoded
    images = warp(images, *change, _fill(images, generator))
    masks = warp(patches.masks[which], *change, torch.zeros(size)) / 255
    known = (warp(np.full((size, PATCH, PATCH), 255, np.uint8), *change, torch.zeros(size)) > 254).float()
    images, _ = occlude(images, 1, generator)
    white = torch.from_numpy(patches.white[which]).float()
    guessed = torch.isfinite(drawn[:, 0]) & (torch.from_numpy(patches.visible[which]) < SEEN)  # no detector leads there
    known = known * ~guessed[:, None, None, None]
    return Discs(photograph(images, white, COARSEST_DISC, generator) / WHITE, masks, known)


def scans(data: Scans, size: int, generator: Generator) -> Discs:
    """`size` random B-scans with their masses, mirrored, tilted, scaled and of another scanner."""
    which = torch.randint(len(data), (size,), generator=generator).numpy()
    if len(data.shows):
        some = torch.randint(len(data.shows), (size,), generator=generator).numpy()
        which = np.where((torch.rand(size, generator=generator) < SHOWS_MASS).numpy(), data.shows[some], which)
    images, masks, (height, width) = data.images[which], data.masks[which], data.size[which].T
    linear = tilts(size, generator)
    source = torch.from_numpy(np.column_stack([(width - 1) / 2, np.zeros(size)])).float()
    goal = torch.tensor([(SCAN[0] - 1) / 2, 0.0]) + uniform(-1.0, 1.0, (size, 2), generator) * torch.tensor([12.0, 8.0])
    change = (linear, source, goal, SCAN)
    v, u = np.ogrid[: images.shape[1], : images.shape[2]]
    own = (v < height[:, None, None]) & (u < width[:, None, None])
    known = (warp(255 * own.astype(np.uint8), *change, torch.zeros(size)) > 254).float()
    masks = warp(masks, *change, torch.zeros(size)) / 255
    return Discs(scanned(warp(images, *change, torch.zeros(size)), generator) / WHITE, masks, known)


def _fill(images: NDArray[np.uint8], generator: Generator) -> Tensor:
    """Fill grey (n,) beyond the borders of images (n, h, w), mostly a dark one."""
    return torch.from_numpy(images.max((1, 2))) * torch.rand(len(images), generator=generator) ** 2


def _at(masks: Tensor, places: Tensor) -> Tensor:
    """Values of masks (n, 1, h, w) at places (n, k, 2), px; false outside."""
    height, width = masks.shape[-2:]
    nearest = torch.nan_to_num(places, nan=-1.0).round().long()
    u, v = nearest[..., 0], nearest[..., 1]
    inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    rows = torch.arange(len(masks))[:, None]
    return masks[rows, 0, v.clamp(0, height - 1), u.clamp(0, width - 1)] & inside
