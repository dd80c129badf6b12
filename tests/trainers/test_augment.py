"""Changed pictures must stay pictures of what the labels say."""
# ruff: noqa: E402 - torch is asked for before what needs it

import cv2
import numpy as np
import pytest

torch = pytest.importorskip("torch")

from trainers import augment
from trainers.augment import moved, photograph, turns, warp
from trainers.batches import crops, discs, generator_of
from trainers.shard_reader import in_memory, read_patches, read_views


def test_a_rings_centre_follows_its_label(rng):
    """Centre of darkness of a drawn ring, through 60 maps."""
    n, bits = 60, 4
    centres = torch.from_numpy(rng.uniform([120, 90], [200, 150], (n, 2))).float()
    images = np.full((n, 240, 320), 200, np.uint8)
    for image, centre in zip(images, centres.numpy(), strict=True):
        drawn = np.rint(centre * 2**bits).astype(int).tolist()
        cv2.circle(image, drawn, 14 * 2**bits, 0, -1, cv2.LINE_AA, bits)
        cv2.circle(image, drawn, 6 * 2**bits, 200, -1, cv2.LINE_AA, bits)
    linear = turns(n, (0.5, 1.6), generator_of(0, 0))
    source, goal = torch.full((n, 2), 160.0) - 10, torch.from_numpy(rng.uniform(70, 90, (n, 2))).float()
    changed = 200 - warp(images, linear, source, goal, (160, 160), torch.full((n,), 200.0))[:, 0].numpy()
    rows, columns = np.indices((160, 160))
    expected = moved(centres[:, None], linear, source, goal)[:, 0].numpy()
    near = (np.abs(expected - 80) < 50).all(1)  # a whole ring is in the picture
    assert near.sum() > 20
    for one, place in zip(changed[near], expected[near], strict=True):
        found = np.array([(one * columns).sum(), (one * rows).sum()]) / one.sum()
        assert np.abs(found - place).max() < 0.3


def test_no_map_mirrors():
    assert (torch.linalg.det(turns(500, (0.5, 1.6), generator_of(1, 0))) > 0.2).all()


def test_targets_of_a_batch_have_their_circles_in_the_real_order(data_set):
    """In the image, from c0, c2 lies anticlockwise of c1 for a target that is seen from the front."""
    places = crops(in_memory(read_views([data_set])), 64, 160, generator_of(3, 5)).places
    x, y = places[:, 1] - places[:, 0], places[:, 2] - places[:, 0]
    turn = x[:, 0] * y[:, 1] - x[:, 1] * y[:, 0]
    assert torch.isfinite(turn).sum() > 30
    assert (turn[torch.isfinite(turn)] < 0).all()


@pytest.mark.parametrize("scales", [(0.4, 0.5), (1.0, 1.6)])
def test_targets_of_a_batch_are_as_large_as_asked_for(data_set, scales):
    """Over their own size, but for views that are made narrower by up to 15 %."""
    views = in_memory(read_views([data_set]))
    own = np.linalg.norm(views.centres[:, 1] - views.centres[:, 0], axis=-1) / views.scale[:, 0]
    places = crops(views, 256, 160, generator_of(3, 5), scales).places
    sizes = np.linalg.norm(places[:, 1] - places[:, 0], axis=-1)
    sizes, own = sizes[np.isfinite(sizes)], own[np.isfinite(own)]
    assert 0.84 * scales[0] * own.min() < sizes.min() and sizes.max() < 1.01 * scales[1] * own.max()


def test_dark_rings_are_where_a_batch_says(data_set):
    """Blindly: on a white board a ring's middle is brighter than its rim, at its place and not 4 px beside it."""
    batch = crops(in_memory(read_views([data_set])), 128, 160, generator_of(2, 0))
    images = batch.images[:, 0].numpy()
    peaks = []
    for view, row, column in np.argwhere((batch.labels.pixel < 64).numpy() & (batch.labels.pixel >= 0).numpy()):
        pixel = int(batch.labels.pixel[view, row, column])
        v, u = 8 * row + pixel // 8, 8 * column + pixel % 8
        if 12 <= u < 148 and 12 <= v < 148:
            window = images[view, v - 12 : v + 13, u - 12 : u + 13]
            peaks.append(window / max(window.max(), 1e-3))
    mean = np.mean(peaks, 0)
    assert len(peaks) > 100
    assert mean[12, 12] > mean[[12, 12, 5, 19], [5, 19, 12, 12]].max() + 0.2


def test_a_batch_is_that_of_its_seed_and_step(data_set):
    views, patches = in_memory(read_views([data_set])), in_memory(read_patches([data_set]))
    for make in (lambda g: crops(views, 8, 96, g).images, lambda g: discs(patches, 8, g).images):
        first, again, other = make(generator_of(1, 7)), make(generator_of(1, 7)), make(generator_of(1, 8))
        assert torch.equal(first, again)
        assert not torch.equal(first, other)


def test_masks_are_of_the_discs(data_set):
    """A mask's middle is within the shift of the patch's; patches without a disc have none; its pixels count where known."""
    batch = discs(in_memory(read_patches([data_set])), 96, generator_of(0, 1))
    area = batch.masks.sum((1, 2, 3))
    assert (area == 0).any() and (area > 500).sum() > 40
    columns = (batch.masks * torch.arange(120.0)).sum((1, 2, 3))[area > 500] / area[area > 500]
    assert ((columns - 59.5).abs() < 16).float().mean() > 0.9


def test_pictures_are_8_bit_from_nearly_black_to_saturated():
    images = torch.full((200, 1, 32, 32), 60.0)
    images[:, :, :, 16:] = 120
    changed = photograph(images, torch.full((200,), 120.0), 0.5, generator_of(0, 0))
    assert torch.equal(changed, changed.round()) and changed.min() >= 0 and changed.max() <= 255
    tops = changed.amax((1, 2, 3))
    assert (tops < 25).sum() > 5 and (tops == 255).sum() > 5


def test_compression_loses_what_jpeg_loses(rng):
    """The change that ours makes is about as large as that of OpenCV's JPEG: within a quarter over qualities from 20 to 95."""
    smooth = cv2.GaussianBlur(rng.uniform(0, 255, (64, 64)).astype(np.float32), None, 2)
    image = np.uint8(np.clip(128 + 4 * (smooth - smooth.mean()), 0, 255))
    ours = augment._compressed(torch.from_numpy(np.float32(image)).expand(300, 1, 64, 64), generator_of(0, 0))
    changes = [
        cv2.imdecode(cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, q])[1], 0) - np.float32(image) for q in range(20, 96)
    ]
    assert float((ours - torch.from_numpy(np.float32(image))).square().mean().sqrt()) == pytest.approx(np.std(changes), rel=0.25)


def test_noise_grows_with_light():
    images = torch.cat([torch.full((400, 1, 16, 16), 5.0), torch.full((400, 1, 16, 16), 200.0)], 3)
    noise = augment._noisy(images, generator_of(0, 0)) - images
    assert noise[..., 16:].std() > 1.5 * noise[..., :16].std()
    assert abs(float(noise.mean())) < 0.05
