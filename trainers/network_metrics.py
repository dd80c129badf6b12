"""Figures of merit of a network on whole validation views and patches, decoded as in the tracker.

A detector's answer becomes circles as published: softmax over a cell's classes, scores of all pixels, of those within 4 px of
each other the best, above 0.015 the best, as many as the targets have, each with the identity that its cell says.
"""

import math
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn.functional import max_pool2d, pixel_shuffle

from trainers.architectures import NO_PIXEL
from trainers.scan_reader import Scans
from trainers.shard_reader import Patches, Views
from trainers.shard_truth import HIDDEN, SEEN, UNNAMED

Array = NDArray[np.float64]
Metrics = dict[str, float | int]

RADIUS = 4  # px, within which the best score alone stays
SCORE = 0.015  # least of a circle
FOUND = 4.0  # px of the view, most between a found circle and the true one
BRIGHT = {"dark": (0.0, 8.0), "dim": (8.0, 15.0), "bright": (15.0, math.inf)}  # digital number of the white
BLUR = {
    "sharp": (0.0, 4.0),
    "blurred": (4.0, 12.0),
    "smeared": (12.0, math.inf),
}  # px of full resolution, the most blurred circle
BATCH = 16


@dataclass(frozen=True)
class Peaks:
    """Circles found in one view, the best first."""

    places: NDArray[np.int64]  # (m, 2) px of the view
    identities: NDArray[np.int64]  # (m,) 0, 1 and on, or the number of identities for none
    scores: Array  # (m,)


def scores_of(detection: Tensor) -> Tensor:
    """Logits (n, 65, h/8, w/8) to the probability (n, h, w) that a circle's centre is at a pixel."""
    return pixel_shuffle(torch.softmax(detection, 1)[:, :NO_PIXEL], 8)[:, 0]


def decode(detection: Tensor, identity: Tensor, most: int) -> list[Peaks]:
    """Circles of n views, at most so many in each."""
    scores = scores_of(detection)
    kinds = identity.argmax(1).repeat_interleave(8, 1).repeat_interleave(8, 2)
    best = max_pool2d(scores[:, None], 2 * RADIUS + 1, 1, RADIUS)[:, 0]
    result = []
    for view, kind, peak in zip(scores, kinds, (scores == best) & (scores > SCORE), strict=True):
        v, u = torch.nonzero(peak, as_tuple=True)
        order = torch.argsort(view[v, u], descending=True, stable=True)[:most]
        v, u = v[order], u[order]
        result.append(Peaks(torch.stack([u, v], 1).numpy(), kind[v, u].numpy(), view[v, u].numpy()))
    return result


@torch.no_grad()
def measure_detector(network: nn.Module, views: Views) -> Metrics:
    """Figures of a detector.

    `recall`: of circles seen well enough, those found within 4 px with the right identity, and for each identity; `all_three`: of
    targets that a view shows whole, those with all circles right, and by the white's digital number and by blur; errors of place
    against the exact coarse place, in px of the view and of full resolution (along u); `wrong`: of found circles in views
    of a target, those that are none of it or have another's identity; `false_per_empty_view`: circles found where there is none.
    Of targets whose identities aren't learnt, any will do.
    """
    network.eval()
    most = views.centres.shape[1]
    answers = (network(_grey(views.images[k : k + BATCH])) for k in range(0, len(views), BATCH))
    peaks = [found for detection, identity in answers for found in decode(detection, identity, most)]
    errors = np.stack(
        [
            _errors(found, centres / scale, names)
            for found, centres, scale, names in zip(peaks, views.centres, views.scale, views.identity, strict=True)
        ]
    )
    named, anyhow = errors[:, 0], errors[:, 1]  # (n, circles) px, to the circle found by that name, and by any
    places = (views.centres + 0.5) / views.scale[:, None] - 0.5
    with np.errstate(invalid="ignore"):
        held = ((places >= -0.5) & (places < np.array(views.images.shape[:0:-1]) - 0.5)).all(-1)
    counts = (views.visible >= SEEN) & held  # beyond the view there is nothing to find
    right, located = named <= FOUND, anyhow <= FOUND
    targets = [views.body == number for number in range(int(views.body.max()) + 1)]
    whole = np.stack([(its & counts & views.inside).sum(1) == np.maximum(its.sum(1), 1) for its in targets], 1)
    all_three = np.stack([(right | ~its).all(1) for its in targets], 1)
    hits = named[counts & right]
    full = hits * views.scale[0, 0]
    found = np.array([len(one.places) for one in peaks])
    empty = (views.visible <= HIDDEN).all(1)
    by_name = {k: counts & (views.identity == k) for k in range(int(views.identity.max()) + 1)}
    figures: Metrics = {
        "views": len(views),
        "recall": _share(right[counts]),
        "identity_accuracy": _share(right[counts & located]),
        **{f"recall_c{k}": _share(right[its]) for k, its in by_name.items()},
        **{f"identity_accuracy_c{k}": _share(right[its & located]) for k, its in by_name.items()},
        "place_median_px": float(np.median(hits)) if len(hits) else math.nan,
        "place_median_full_px": float(np.median(full)) if len(full) else math.nan,
        "place_95_full_px": float(np.percentile(full, 95)) if len(full) else math.nan,
        "all_three": _share(all_three[whole]),
        "all_three_views": int(whole.sum()),
        "wrong": 1 - _share_of(right.sum(), found[views.present].sum()),
        "false_per_empty_view": _share_of(found[empty].sum(), empty.sum()),
        "empty_views": int(empty.sum()),
    }
    blur = np.stack([np.where(its, views.blur, 0.0).max(1) for its in targets], 1)
    white = np.repeat(views.white[:, None], len(targets), axis=1)
    for values, classes in ((white, BRIGHT), (blur, BLUR)):
        for name, (least, end) in classes.items():
            figures[f"all_three_{name}"] = _share(all_three[whole & (values >= least) & (values < end)])
    return figures


@torch.no_grad()
def measure_segmenter(network: nn.Module, patches: Patches) -> Metrics:
    """Figures of a segmenter.

    `iou`: intersection over union, mean over patches with a disc seen well enough, and by the white's digital number; errors of
    the mask's centre of area against the true mask's, px; `missed`: of those patches, the ones without an answer; `empty_right`:
    of patches without a disc, those whose answer is less than 50 px.
    """
    network.eval()
    parts = [_areas(network, patches.images[k : k + BATCH], patches.masks[k : k + BATCH]) for k in range(0, len(patches), BATCH)]
    found, true, both, either, errors = (np.concatenate(column) for column in zip(*parts, strict=True))
    empty = true == 0
    counts = (patches.visible >= SEEN) & ~empty
    iou = np.where(either > 0, both / np.maximum(either, 1), 1.0)
    answered = counts & (found >= LEAST_PX)
    errors = errors[answered]
    figures: Metrics = {
        "patches": len(patches),
        "iou": float(iou[counts].mean()) if counts.any() else math.nan,
        "centre_median_px": float(np.median(errors)) if len(errors) else math.nan,
        "centre_95_px": float(np.percentile(errors, 95)) if len(errors) else math.nan,
        "missed": 1 - _share_of(answered.sum(), counts.sum()),
        "empty_right": _share(found[empty] < LEAST_PX),
        "empty_patches": int(empty.sum()),
    }
    for name, (least, most) in BRIGHT.items():
        some = counts & (patches.white >= least) & (patches.white < most)
        figures[f"iou_{name}"] = float(iou[some].mean()) if some.any() else math.nan
    return figures


@torch.no_grad()
def measure_masses(network: nn.Module, scans: Scans) -> Metrics:
    """Figures of the network of masses.

    `iou`: intersection over union of B-scans with a mass, mean, and over all their pixels together `iou_pixels`; `missed`: of
    them, those where less than a tenth of the masses is found; `empty_right`: of B-scans without a mass, those whose answer is
    less than 50 px; `false_px`: pixels of answers in these, mean.
    """
    network.eval()
    parts = [_areas(network, scans.images[k : k + BATCH], scans.masks[k : k + BATCH]) for k in range(0, len(scans), BATCH)]
    found, true, both, either, _ = (np.concatenate(column) for column in zip(*parts, strict=True))
    counts, empty = true >= LEAST_PX, true == 0
    return {
        "scans": len(scans),
        "iou": float((both[counts] / either[counts]).mean()) if counts.any() else math.nan,
        "iou_pixels": _share_of(both[counts].sum(), either[counts].sum()),
        "missed": _share(both[counts] < 0.1 * true[counts]),
        "empty_right": _share(found[empty] < LEAST_PX),
        "false_px": float(found[empty].mean()) if empty.any() else math.nan,
        "empty_scans": int(empty.sum()),
    }


LEAST_PX = 50  # of a mask that is one


def _areas(network: nn.Module, images: NDArray[np.uint8], masks: NDArray[np.uint8]) -> tuple[NDArray, ...]:
    """Areas (n,) px of answers, of true masks, of both and of either, and the distance of their centres of area, px."""
    found, true = network(_grey(images)).numpy()[:, 0] > 0, masks > 127
    areas = (some.sum((1, 2)) for some in (found, true, found & true, found | true))
    return *areas, np.linalg.norm(_middles(found) - _middles(true), axis=1)


def _grey(images: NDArray[np.uint8]) -> Tensor:
    return torch.from_numpy(images).float()[:, None] / 255


def _errors(found: Peaks, places: Array, names: NDArray[np.int64]) -> Array:
    """Distances (2, circles) of true coarse places to the nearest circle found with the right identity, and to that with any."""
    result = np.full((2, len(places)), np.inf)
    for k, (place, name) in enumerate(zip(places, names, strict=True)):
        distances = np.linalg.norm(found.places - place, axis=1)
        result[0, k] = min(distances[(found.identities == name) | (name == UNNAMED)], default=np.inf)
        result[1, k] = min(distances, default=np.inf)
    return np.nan_to_num(result, nan=np.inf)


def _middles(masks: NDArray[np.bool_]) -> Array:
    """Centres of area (n, 2), px."""
    rows, columns = np.indices(masks.shape[1:])
    area = np.maximum(masks.sum((1, 2)), 1)
    return np.stack([(masks * columns).sum((1, 2)) / area, (masks * rows).sum((1, 2)) / area], 1)


def _share(right: NDArray) -> float:
    return _share_of(right.sum(), right.size)


def _share_of(part: float, whole: float) -> float:
    return float(part / whole) if whole else math.nan
