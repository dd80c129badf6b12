"""Sweeps become B-scans as the network of masses sees them, with their masses; batches and figures of these."""
# ruff: noqa: E402 - torch is asked for before what needs it

import json

import cv2
import numpy as np
import pytest

torch = pytest.importorskip("torch")

from recon.errors import InputError
from recon.model.probe import ProbeCalibration
from recon.model.tracks import Track
from tests.recon.captures import write_sweep
from trainers.batches import SCAN, Batches, generator_of, scans
from trainers.network_metrics import measure_masses
from trainers.scan_reader import Scans, read_scans
from trainers.shard_reader import chosen, split

NAMES = ["surroundings", "breast", "mass0", "solid0", "massive"]


def draw(folder, seed, frames=3, size=(80, 120)):
    """A sweep of B-scans with noise in them, and labels with a disc of 10 mm in a ring of 16 mm; 0.2 mm a pixel."""
    rng = np.random.default_rng(seed)
    width, height = size
    images = rng.integers(1, 255, (frames, height, width)).astype(np.uint8)
    times = np.arange(1, frames + 1) * 50_000_000
    poses = np.tile(np.eye(4), (frames, 1, 1))
    write_sweep(folder / "capture", images, times, Track(times, poses), size, ProbeCalibration(np.eye(4), np.array([0.2, 0.2])))
    labels = folder / "truth" / "sweep" / "labels"
    labels.mkdir(parents=True)
    for number in range(frames):
        shown = np.ones((height, width), np.uint8)
        if number:
            cv2.circle(shown, (40, 60), 30, 2, -1)
            cv2.circle(shown, (40, 60), 15, 3, -1)
        cv2.imwrite(str(labels / f"{number:04d}.png"), shown)
    (folder / "truth" / "scene.json").write_text(json.dumps({"name": "patient", "labels": NAMES}))


@pytest.fixture
def sweeps(tmp_path):
    """Two folders: one of two sweeps, and a single one of a larger image."""
    for number in range(2):
        draw(tmp_path / "many" / f"{number:06d}", number)
    draw(tmp_path / "single", 7, size=(120, 120))
    return tmp_path / "many", tmp_path / "single"


def test_b_scans_have_the_networks_pixels_and_their_masses(sweeps):
    """A disc of 12 mm, whose solid part is of it, is pi 15^2 px of 0.4 mm; smaller images have black beside them."""
    scans = read_scans(sweeps)
    assert scans.images.shape == scans.masks.shape == (9, 64, 64) and scans.sample.tolist() == [0] * 3 + [1] * 3 + [2] * 3
    shows = scans.sample < 2
    areas = (scans.masks[shows] > 127).sum(axis=(1, 2))
    assert areas[[0, 3]].max() == 0
    np.testing.assert_allclose(areas[[1, 2, 4, 5]], np.pi * 15.25**2, rtol=0.03)
    assert (scans.images[shows][:, :, 48:] == 0).all() and (scans.images[~shows][:, :60, :60] > 0).all()


def test_the_last_sweeps_validate(sweeps):
    """Whole ones: B-scans of one patient are never in both."""
    train, validation = split(read_scans(sweeps), 0.3)
    assert set(train.sample) == {0, 1} and set(validation.sample) == {2}
    assert len(chosen(train, np.array([0, 5]))) == 2


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda one: (one / "truth" / "scene.json").unlink(), r"scene.json: "),
        (lambda one: (one / "truth" / "scene.json").write_text("{}"), r"scene.json: labels: "),
        (
            lambda one: (one / "truth" / "sweep" / "labels" / "0001.png").write_bytes(b""),
            r"labels/0001.png: expected .* an empty file",
        ),
    ],
)
def test_damage_is_one_line(sweeps, damage, message):
    damage(sweeps[1])
    with pytest.raises(InputError, match=message):
        read_scans(sweeps)


def test_a_folder_without_sweeps_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"expected sweeps, as of `sonotwin sweep count=100`, or outlines.csv, found none$"):
        read_scans([tmp_path])


def outline(folder, mm="0.2", size=(80, 60)):
    """An image of noise, in colour, with a square of 6 mm, and its table."""
    folder.mkdir()
    mask = np.zeros(size[::-1], np.uint8)
    mask[10:40, 20:50] = 255
    cv2.imwrite(str(folder / "a.png"), np.random.default_rng(0).integers(1, 255, (60, 80, 3)).astype(np.uint8))
    cv2.imwrite(str(folder / "a_mask.png"), mask)
    (folder / "outlines.csv").write_text(f"image,mask,mm_per_px,kind\na.png,a_mask.png,{mm},benign\n", encoding="utf-8")
    return folder


def test_outlines_of_others_are_samples(sweeps, tmp_path):
    """Each image one; after sweeps."""
    scans = read_scans([sweeps[0], outline(tmp_path / "theirs")])
    assert scans.sample.tolist() == [0] * 3 + [1] * 3 + [2]
    assert (scans.masks[-1] > 127).sum() == 15**2 and scans.images.shape[1:] == (64, 48)


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ({"mm": "4"}, r"outlines.csv: line 2: mm_per_px: expected 0.01 to 1, found 4$"),
        ({"mm": ""}, r"outlines.csv: line 2: expected image, mask, mm_per_px, found no mm_per_px$"),
        ({"size": (81, 60)}, r"outlines.csv: line 2: expected image and mask of one size, found 80x60 and 81x60$"),
    ],
)
def test_a_wrong_table_is_one_line(tmp_path, more, message):
    with pytest.raises(InputError, match=message):
        read_scans([outline(tmp_path / "theirs", **more)])


def drawn(count=12):
    """B-scans of grey 60, some with a white mass of 12 px radius in them."""
    images, masks = np.full((count, 128, 112), 60, np.uint8), np.zeros((count, 128, 112), np.uint8)
    for k in range(0, count, 3):
        cv2.circle(masks[k], (40 + 3 * k, 50 + 2 * k), 12, 255, -1)
        images[k][masks[k] > 0] = 180
    return Scans(images, masks, np.arange(count))


def test_masks_of_a_batch_are_where_its_masses_are():
    """Mirrored, turned, scaled and shifted alike; more than half of the B-scans show one; black beside the image isn't known."""
    batch = scans(drawn(), 64, generator_of(0, 5))
    assert batch.images.shape == (64, 1, SCAN[1], SCAN[0]) and batch.images.max() <= 1
    shows = batch.masks.amax((1, 2, 3)) > 0.9
    assert 0.5 < shows.float().mean() < 0.95
    for image, mask, known in zip(batch.images[shows], batch.masks[shows], batch.weights[shows], strict=True):
        ground = (mask < 0.01) & (known > 0)
        assert image[mask > 0.99].median() > image[ground].median()  # also where a grey map makes both alike
    assert (batch.images[(batch.weights == 0) & (batch.masks == 0)] < 0.3).float().mean() > 0.95


def test_a_batch_is_that_of_its_seed_and_step():
    first, again, other = (Batches(drawn(), 4, 160, 0)[k] for k in (3, 3, 4))
    assert all(torch.equal(one, two) for one, two in zip(first, again, strict=True))
    assert not torch.equal(first[0], other[0])


class Knowing(torch.nn.Module):
    """Answers that were given to it, one a B-scan."""

    def __init__(self, masks):
        super().__init__()
        self.answers, self.at = torch.from_numpy(masks)[:, None].float() - 127, 0

    def forward(self, images):
        self.at += len(images)
        return self.answers[self.at - len(images) : self.at]


def test_figures_of_masses():
    """A perfect answer is perfect; one that misses one of four masses, and sees one in one of eight empty scans, says so."""
    some = drawn()
    perfect = measure_masses(Knowing(some.masks), some)
    assert (perfect["iou"], perfect["missed"], perfect["empty_right"], perfect["false_px"]) == (1, 0, 1, 0)
    wrong = some.masks.copy()
    wrong[0], wrong[1] = 0, some.masks[0]
    figures = measure_masses(Knowing(wrong), some)
    assert (figures["iou"], figures["missed"], figures["empty_right"]) == (0.75, 0.25, 0.875)
    assert figures["false_px"] == pytest.approx((some.masks[0] > 0).sum() / 8)
    assert figures["iou_pixels"] == pytest.approx(3 / 4, abs=0.001)


def test_the_verb_trains_on_sweeps(sweeps, tmp_path, capsys):
    """A few steps, and on; the network is one that `segment` takes."""
    from recon.segmentation import mass_network
    from sonotwin.cli import main

    many, single = sweeps
    command = ["train", "network=masses", f"data=[{many}]", f"validation_data={single}", f"out={tmp_path / 'out'}", "threads=1"]
    assert main([*command, "batch=2", "steps=2"]) == 0
    said = capsys.readouterr().out
    assert "6 B-scans to train with, 3 to validate with" in said and "of B-scans with a mass missed" in said
    assert main([*command, "batch=2", "steps=3"]) == 0 and "from step 2 on" in capsys.readouterr().out
    answers = mass_network.probabilities(
        [np.full((60, 80), 90, np.uint8)], (0.4, 0.4), mass_network.opened(tmp_path / "out" / "masses.onnx")
    )
    assert next(answers).shape == (60, 80)
