"""Short trainings of the detector that is shipped, by which sets of tracking frames are compared. All on one thread.

Sums, and so weights, depend on the number of threads.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

import torch
from torch import nn

from recon.files.metrics import Metrics
from recon.tracking.networks import WEIGHTS
from trainers import architectures, export, fit
from trainers.labels import detector_loss, label_offset, labels, seen_in_view
from trainers.network_metrics import BATCH, measure_detector
from trainers.shard_reader import Views, in_memory, read_views

CIRCLES = 3  # of the target that is shipped for
CROP_PX, CROPS = 128, 16  # of a batch
RATE = 5e-4  # the highest learning rate: a quarter of the usual, to go on from trained weights


def shipped() -> nn.Module:
    """The detector that is shipped."""
    network = architectures.network("detector", CIRCLES)
    export.load(WEIGHTS / "detector.safetensors", network)
    return network


def trained_on(folder: Path, steps: int, seed: int, scales: tuple[float, float]) -> nn.Module:
    """The detector that is shipped, trained further on a data set; scales : least and most, of the views that crops are of."""
    views = in_memory(read_views([folder]))
    plan = fit.Plan("detector", CROPS, CROP_PX, RATE, 0.01, seed, steps, None, scales=scales)
    with _one_thread(), TemporaryDirectory() as unused:
        return fit.fit(shipped(), views, views, plan, Path(unused), lambda *_: None).network


def figures(network: nn.Module, folder: Path) -> Metrics:
    """Figures of a detector on a data set.

    Returns
    -------
    Metrics
        loss: that of training, of whole views as they are; missed: share of circles seen well enough that aren't found within
        4 px of the view by their name; missed_targets: share of targets shown whole of which that holds for any circle;
        centre_px: median error of the others' places, px of the view.
    """
    views = in_memory(read_views([folder]))
    with _one_thread():
        found = measure_detector(network, views)
        return {
            "loss": loss(network, views),
            "missed": 1 - found["recall"],
            "missed_targets": 1 - found["all_three"],
            "centre_px": found["place_median_px"],
        }


@torch.no_grad()
def loss(network: nn.Module, views: Views) -> float:
    """Loss of a detector on whole views, without augmentation."""
    network.eval()
    images = torch.from_numpy(views.images[:]).float()[:, None] / 255
    answers = [network(some) for some in images.split(BATCH)]
    detection, identity = (torch.cat(parts) for parts in zip(*answers, strict=True))
    scale = torch.from_numpy(views.scale).float()
    centres = seen_in_view(torch.from_numpy(views.centres).float(), scale)
    height, width = views.images.shape[1:]
    inside = (centres >= -0.5).all(-1) & (centres < torch.tensor([width, height]) - 0.5).all(-1)
    visible = torch.where(inside, torch.from_numpy(views.visible).float(), torch.zeros(()))
    wanted = labels(centres + label_offset(scale)[:, None], visible, torch.from_numpy(views.identity), (width, height))
    return float(detector_loss(detection, identity, wanted))


@contextmanager
def _one_thread() -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
