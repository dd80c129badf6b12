"""Sweeps become B-scans as the network of masses sees them, with their masses."""

import json

import cv2
import numpy as np
import pytest

from recon.errors import InputError
from recon.model.probe import ProbeCalibration
from recon.model.tracks import Track
from tests.recon.captures import write_sweep
from trainers.scan_reader import read_scans
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
