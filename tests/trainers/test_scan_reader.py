"""Sweeps become B-scans as the network of masses sees them, with their masses; batches and figures of these."""
# ruff: noqa: E402 - torch is asked for before what needs it

import json
import tracemalloc

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


def draw(folder, seed, frames=3, size=(80, 120), names=NAMES):
    """A sweep of B-scans with noise in them, and labels with a disc of 10 mm in a ring of 16 mm; 0.2 mm a pixel."""
    rng = np.random.default_rng(seed)
    width, height = size
    images = rng.integers(1, 255, (frames, height, width)).astype(np.uint8)
    times = np.arange(1, frames + 1) * 50_000_000
    poses = np.tile(np.eye(4), (frames, 1, 1))
    poses[:, 2, 3] = np.arange(frames)  # mm
    write_sweep(folder / "capture", images, times, Track(times, poses), size, ProbeCalibration(np.eye(4), np.array([0.2, 0.2])))
    labels = folder / "truth" / "sweep" / "labels"
    labels.mkdir(parents=True)
    for number in range(frames):
        shown = np.ones((height, width), np.uint8)
        if number:
            cv2.circle(shown, (40, 60), 30, 2, -1)
            cv2.circle(shown, (40, 60), 15, 3, -1)
        cv2.imwrite(str(labels / f"{number:04d}.png"), shown)
    (folder / "truth" / "scene.json").write_text(json.dumps({"name": "patient", "labels": names}))


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
    assert scans.size[shows].tolist() == [[60, 40]] * 6 and scans.size[~shows].tolist() == [[60, 60]] * 3
    assert scans.shows.tolist() == [1, 2, 4, 5, 7, 8] and scans.shows is scans.shows  # found once
    assert (scans.images[shows][:, :, 48:] == 0).all() and (scans.images[~shows][:, :60, :60] > 0).all()


@pytest.mark.parametrize(
    ("names", "diameter"), [(["tumour0", "lobe0"], 30), (["massive", "tumour12"], 15), (["massive", "solid"], 0)]
)
def test_masses_are_known_by_their_whole_names(tmp_path, names, diameter):
    """A phantom's tumours, too; none is all that begins as a mass does."""
    draw(tmp_path, 0, names=["surroundings", "breast", *names])
    expected = np.pi * {30: 15**2 - 7.5**2, 15: 7.5**2, 0: 0}[diameter]
    assert (read_scans([tmp_path]).masks[1] > 127).sum() == pytest.approx(expected, rel=0.08)


def test_b_scans_are_in_memory_once(tmp_path):
    draw(tmp_path, 0, frames=40, size=(400, 400))
    read_scans([tmp_path])  # whatever is kept of a first call
    tracemalloc.start()
    try:
        scans = read_scans([tmp_path])
        assert tracemalloc.get_traced_memory()[1] < 1.4 * (scans.images.nbytes + scans.masks.nbytes)
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("begun", ["capture", ".capture.4194305.new"])
def test_unfinished_sweeps_are_refused_or_left_out(sweeps, begun):
    """Of a run that goes on, or was ended."""
    many = sweeps[0]
    (many / "000007" / begun / "sweep").mkdir(parents=True)
    expected = rf"^{many}/000007/capture/manifest.json: expected a finished sweep, found none; partial=true leaves it out$"
    with pytest.raises(InputError, match=expected):
        read_scans([many])
    assert len(read_scans([many], partial=True)) == 6


def test_nothing_is_refused():
    with pytest.raises(InputError, match=r"^data: expected B-scans, found none$"):
        read_scans([])


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


def outline(folder, mm="0.2", size=(80, 60), white=255):
    """An image of noise, in colour, with a square of 6 mm, and its table."""
    folder.mkdir()
    mask = np.zeros(size[::-1], np.uint8)
    mask[10:40, 20:50] = white
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
        ({"white": 1}, r"a_mask.png: expected a mask of 0 and 255, found 1$"),
    ],
)
def test_a_wrong_table_is_one_line(tmp_path, more, message):
    with pytest.raises(InputError, match=message):
        read_scans([outline(tmp_path / "theirs", **more)])


@pytest.mark.parametrize("content", [b"image,mask\xff\n", b"image,mask,mm_per_px\n", b"image,mask,mm_per_px\n" + b"1" * 200_000])
def test_what_is_no_table_is_one_line(tmp_path, content):
    folder = outline(tmp_path / "theirs")
    (folder / "outlines.csv").write_bytes(content)
    with pytest.raises(InputError, match=r"outlines.csv: (line 2: )?expected .*, found ") as caught:
        read_scans([folder])
    assert "\n" not in str(caught.value)


def drawn(count=12):
    """B-scans of grey 60, some with a white mass of 12 px radius in them."""
    images, masks = np.full((count, 128, 112), 60, np.uint8), np.zeros((count, 128, 112), np.uint8)
    for k in range(0, count, 3):
        cv2.circle(masks[k], (40 + 3 * k, 50 + 2 * k), 12, 255, -1)
        images[k][masks[k] > 0] = 180
    return Scans(images, masks, np.tile([128, 112], (count, 1)), np.arange(count))


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


def test_what_is_beside_a_small_image_isnt_known():
    """Black on to the largest of the set; the image itself is in the middle of what is trained with, wherever the set ends."""
    some = drawn()
    small = Scans(*(np.pad(one, ((0, 0), (0, 0), (0, 400))) for one in (some.images, some.masks)), some.size, some.sample)
    one, other = (scans(data, 32, generator_of(0, 5)) for data in (some, small))
    assert torch.equal(one.weights, other.weights) and torch.equal(one.images, other.images)
    assert one.weights.mean() > 0.5


@pytest.mark.parametrize("loaders", [0, 1])
def test_batches_of_b_scans_are_made_ahead(loaders):
    batches = Batches(drawn(), 4, 160, 0)
    assert all(torch.equal(*pair) for pair in zip(next(batches.since(3, loaders)), batches[3], strict=True))


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


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ("crop_px=96", "train: crop_px: expected none for network=masses, which trains with whole B-scans, found 96"),
        ("scales=[0.4,1.0]", "train: scales: expected none for network=masses"),
        ("memory_gb=8", "train: memory_gb: expected none for network=masses"),
        (
            "data={nothing}",
            "data: expected masses to train with, as of labels mass0, solid0, tumour0 ..., or masks, found none",
        ),
    ],
)
def test_what_changes_nothing_and_data_without_a_mass_are_refused(sweeps, tmp_path, capsys, more, message):
    from sonotwin.cli import main

    draw(tmp_path / "nothing", 0, names=["surroundings", "breast", "massive"])
    many, single = sweeps
    line = ["train", "network=masses", f"data={many}", f"validation_data={single}", f"out={tmp_path / 'out'}", "steps=1"]
    assert main([*line, more.format(nothing=tmp_path / "nothing")]) == 2
    said = capsys.readouterr().err
    assert message in said and said.count("\n") == 1 and not (tmp_path / "out").exists()


def test_the_verb_leaves_out_unfinished_sweeps_if_it_may(sweeps, tmp_path, capsys):
    from sonotwin.cli import main

    many, single = sweeps
    (many / "000007" / "capture").mkdir(parents=True)
    line = ["train", "network=masses", f"data={many}", f"validation_data={single}", f"out={tmp_path / 'out'}", "threads=1"]
    assert main([*line, "batch=2", "steps=1"]) == 2 and "partial=true" in capsys.readouterr().err
    assert main([*line, "batch=2", "steps=1", "partial=true"]) == 0 and "6 B-scans to train with" in capsys.readouterr().out
