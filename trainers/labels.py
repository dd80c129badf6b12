"""Labels of detector and segmenter from circles' centres and masks, and the losses against them.

A circle's coarse place is its centre in full resolution over the scale, rounded to a pixel of the view: the tracker multiplies
back. A pixel p of the view is not at scale * p of the full image, since `cv2.resize` aligns the images' outer edges: it shows
the full image around scale * (p + 1/2) - 1/2. So the place by which a circle is known lies `label_offset` from where it is seen.
"""

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits, cross_entropy

from trainers.architectures import CELL, NO_PIXEL
from trainers.shard_truth import HIDDEN, SEEN, UNNAMED

NEAR = 1.5  # px, within which a cell beyond the border knows a circle's identity too: the peak may fall there
IGNORED = -100  # a class that doesn't count
NONE_WEIGHT = 0.02  # of a cell without a circle, of which there are hundreds, in the loss of identity


@dataclass(frozen=True)
class Labels:
    """Classes of the cells of n views."""

    pixel: Tensor  # (n, h/8, w/8) int64: 8 row + column, 64 for none, IGNORED
    identity: Tensor  # (n, h/8, w/8) int64: 0, 1 and on, the number of identities for none, IGNORED


def label_offset(scale: Tensor) -> Tensor:
    """Offset of a circle's coarse place from its place in the view, px of the view; scale : (..., 2) as of `Views`."""
    return 0.5 - 0.5 / scale


def seen_in_view(centres: Tensor, scale: Tensor) -> Tensor:
    """Where a view shows centres (n, circles, 2) of full resolution, px of the view; scale : (n, 2)."""
    return (centres + 0.5) / scale[:, None] - 0.5


def labels(places: Tensor, visible: Tensor, names: Tensor, size: tuple[int, int]) -> Labels:
    """Classes of cells.

    Parameters
    ----------
    places : (n, circles, 2) float, px
        Coarse places, not yet rounded, NaN where there is no target.
    visible : (n, circles) float
        Fraction of each disc that is seen.
    names : (n, circles) int64
        Each circle's identity, UNNAMED of those that count for their place alone.
    size : (width, height) of the views, px, multiples of 8
    """
    width, height = size
    n = len(places)
    pixel = torch.full((n, height // CELL, width // CELL), NO_PIXEL)
    identity = torch.full_like(pixel, int(names.max()) + 1)
    names = torch.where(names == UNNAMED, IGNORED, names)
    known = torch.isfinite(places).all(-1)
    nearest = torch.where(known[..., None], places, torch.full_like(places, -1e6)).round().long()
    inside = known & (nearest >= 0).all(-1) & (nearest[..., 0] < width) & (nearest[..., 1] < height)
    for shown in (False, True):  # those that count are written over those that don't
        chosen = inside & ((visible >= SEEN) if shown else (visible > HIDDEN) & (visible < SEEN))
        view, circle = torch.nonzero(chosen, as_tuple=True)
        u, v = nearest[view, circle].unbind(-1)
        if shown:
            exact = places[view, circle]
            for right in (-NEAR, NEAR):
                for down in (-NEAR, NEAR):
                    column = ((exact[:, 0] + right) / CELL).long().clamp(0, width // CELL - 1)
                    row = ((exact[:, 1] + down) / CELL).long().clamp(0, height // CELL - 1)
                    identity[view, row, column] = names[view, circle]
        identity[view, v // CELL, u // CELL] = names[view, circle] if shown else IGNORED
        pixel[view, v // CELL, u // CELL] = CELL * (v % CELL) + u % CELL if shown else IGNORED
    return Labels(pixel, identity)


def detector_loss(detection: Tensor, identity: Tensor, wanted: Labels) -> Tensor:
    """Cross-entropies of place and identity, each about that of one circle.

    The place's is summed over cells with and without circle alike, so that scores are probabilities, which the tracker's
    threshold is compared with.
    """
    place = cross_entropy(detection, wanted.pixel, ignore_index=IGNORED, reduction="sum")
    circles = ((wanted.pixel != NO_PIXEL) & (wanted.pixel != IGNORED)).sum()
    weight = identity.new_ones(identity.shape[1])
    weight[-1] = NONE_WEIGHT
    kind = cross_entropy(identity, wanted.identity, weight, ignore_index=IGNORED)
    return place / (circles + len(detection)) + kind


def segmenter_loss(logits: Tensor, mask: Tensor, weight: Tensor) -> Tensor:
    """Binary cross-entropy and the soft Dice loss over all pixels that count.

    logits, mask, weight : (n, 1, h, w); the mask from 0 to 1, the weight 0 where nothing is known.
    """
    entropy = (binary_cross_entropy_with_logits(logits, mask, reduction="none") * weight).sum() / weight.sum().clamp(min=1)
    shown = torch.sigmoid(logits) * weight
    both, either = (shown * mask).sum((1, 2, 3)), (shown + mask * weight).sum((1, 2, 3))
    smooth = 50.0  # px, by which an empty mask is compared without division by 0
    return entropy + (1 - (2 * both + smooth) / (either + smooth)).mean()
