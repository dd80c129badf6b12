"""MarkerPose's training data: what goes out trains with the same labels as the shards it is from; bad folders are one line."""
# ruff: noqa: E402 - torch is asked for before what needs it

import csv
import shutil

import cv2
import numpy as np
import pytest

torch = pytest.importorskip("torch")

from recon.errors import InputError
from trainers import data_sets, markerpose_layout
from trainers.labels import label_offset, labels, seen_in_view
from trainers.shard_reader import Views, chosen, in_memory, read_patches, read_views, split
from trainers.shard_truth import SEEN


@pytest.fixture(scope="module")
def exported(data_set, tmp_path_factory):
    """Views and patches of the drawn data set, in their layout."""
    folder = tmp_path_factory.mktemp("theirs")
    markerpose_layout.write_views(folder, read_views([data_set]))
    markerpose_layout.write_patches(folder, read_patches([data_set]))
    return folder


@pytest.fixture
def theirs(exported, tmp_path):
    return shutil.copytree(exported, tmp_path / "theirs")


def labels_of(views: Views) -> tuple:
    scale = torch.from_numpy(views.scale)
    places = seen_in_view(torch.from_numpy(views.centres), scale) + label_offset(scale)[:, None]
    found = labels(places, torch.from_numpy(views.visible), torch.from_numpy(views.identity), (320, 240))
    return found.pixel, found.identity


def whole(views: Views) -> np.ndarray:
    places = (views.centres + 0.5) / views.scale[:, None] - 0.5
    with np.errstate(invalid="ignore"):
        return ((places >= 0) & (places <= [319, 239])).all((1, 2)) & (views.visible >= SEEN).all(1)


def test_views_come_back_with_the_same_labels(data_set, exported):
    """Those that show all three circles, image by image."""
    before, after = in_memory(read_views([data_set])), in_memory(markerpose_layout.read_views(exported))
    kept = whole(before)
    assert 20 < kept.sum() < len(before) and len(after) == kept.sum()
    assert np.array_equal(after.images, before.images[kept]) and after.centres == pytest.approx(before.centres[kept])
    for one, other in zip(labels_of(after), labels_of(before), strict=True):
        assert torch.equal(one, other[torch.from_numpy(kept)])


def test_places_are_those_of_the_images(exported):
    """Each lies in the white hole of its circle, as flips of their script ask for, and rounds to a pixel of the image."""
    with (exported / "data_centers.csv").open(encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    assert list(rows[0]) == ["FileName", "c0x", "c0y", "cXx", "cXy", "cYx", "cYy"]
    off = []
    for row in rows:
        image = cv2.imread(str(exported / "images" / row["FileName"]), cv2.IMREAD_GRAYSCALE)
        assert image.shape == (240, 320)
        place = np.array([float(row["c0x"]), float(row["c0y"])])
        rows_, columns = np.indices(image.shape)
        near = np.hypot(columns - place[0], rows_ - place[1]) < 6
        dark = near & (image < (int(image[near].max()) + int(image[near].min())) / 2)
        off.append([columns[dark].mean() - place[0], rows_[dark].mean() - place[1]])
    assert np.abs(np.median(off, axis=0)).max() < 0.1, "px, of the ring's middle: a shift by half a pixel is seen"


def test_patches_come_back_with_their_discs(data_set, exported):
    before, after = in_memory(read_patches([data_set])), in_memory(markerpose_layout.read_patches(exported))
    near = np.abs(before.ellipses[:, :2] - 59.5) <= 20
    kept = near.all(1) & (before.visible >= SEEN)
    assert 60 < kept.sum() < len(before)
    assert np.array_equal(after.images, before.images[kept]) and np.array_equal(after.masks, before.masks[kept])
    assert np.abs(after.ellipses[:, :2] - before.ellipses[kept, :2]).max() < 0.3, "px: OpenCV's rounding of the mask"
    assert after.ellipses[:, 2] == pytest.approx(before.ellipses[kept, 2], abs=1.0)


def test_both_kinds_train_together(data_set, exported):
    """Theirs after the shards; no sample of either is in two parts."""
    for reader, alone in ((data_sets.read_views, read_views), (data_sets.read_patches, read_patches)):
        both, shards = reader([exported, data_set]), alone([data_set])
        theirs = reader([exported])
        assert len(both) == len(shards) + len(theirs)
        assert np.array_equal(
            both.images[np.array([len(shards) - 1, len(shards)])], np.stack([shards.images[-1:][0], theirs.images[:1][0]])
        )
        assert len(np.unique(both.sample)) == len(np.unique(shards.sample)) + len(theirs)
        train, held = split(both, 0.05)
        assert not set(train.sample) & set(held.sample) and len(in_memory(held).images)


def change_table(how):
    def spoil(folder):
        path = folder / "data_centers.csv"
        lines = path.read_text(encoding="utf-8").splitlines()
        path.write_text("\n".join(how(lines)) + "\n", encoding="utf-8")

    return spoil


def cell(line: str, column: int, word: str) -> str:
    words = line.split(",")
    return ",".join([*words[:column], word, *words[column + 1 :]])


@pytest.mark.parametrize(("spoil", "complaint"), [
    (change_table(lambda lines: lines[:1]), "expected one row or more below the header"),
    (change_table(lambda lines: [lines[0].replace("cXx", "c1x"), *lines[1:]]), "line 1: expected columns cXx, found"),
    (change_table(lambda lines: [*lines[:2], cell(lines[2], 3, "320.5")]), "line 3: cXx: expected px of an image of 320x240"),
    (change_table(lambda lines: [*lines[:2], cell(lines[2], 6, "nan")]), "line 3: cYy: expected px"),
    (change_table(lambda lines: [*lines[:2], cell(lines[2], 0, "../im1.png")]), "line 3: FileName: expected an image within"),
    (change_table(lambda lines: [*lines[:2], lines[2] + ",1"]), "line 3: expected 7 columns, found 8"),
    (lambda folder: (folder / "data_centers.csv").write_bytes(b"\xff\xfe\x00"), "expected a table as CSV text"),
    (lambda folder: (folder / "images" / "im1.png").unlink(), "im1.png: expected a file, found none"),
    (lambda folder: cv2.imwrite(str(folder / "images" / "im1.png"), np.zeros((1024, 1280), np.uint8)),
     "im1.png: expected 320x240 px, found 1280x1024"),
])  # fmt: skip
def test_bad_tables_and_images_are_one_line(theirs, spoil, complaint):
    spoil(theirs)
    with pytest.raises(InputError) as error:
        data_sets.read_views([theirs])
    assert complaint in str(error.value) and "\n" not in str(error.value)


@pytest.mark.parametrize(("spoil", "complaint"), [
    (lambda folder: (folder / "mask120" / "000003.png").unlink(), "expected as many images in patch120/ as in mask120/"),
    (lambda folder: shutil.rmtree(folder / "patch120"), "found 0 and"),
    (lambda folder: [(folder / "mask120" / "000003.png").unlink(), (folder / "patch120" / "000005.png").unlink()],
     "mask120: expected the frame of patch120/000003.png next, found 000004.png: is one lost in between?"),
    (lambda folder: cv2.imwrite(str(folder / "mask120" / "000003.png"), np.zeros((60, 120), np.uint8)),
     "000003.png: expected 120x120 8-bit, found 120x60"),
    (lambda folder: cv2.imwrite(str(folder / "patch120" / "000003.png"), np.zeros((60, 120), np.uint8)),
     "000003.png: expected 120x120 px, found 120x60"),
])  # fmt: skip
def test_bad_patches_are_one_line(theirs, spoil, complaint):
    spoil(theirs)
    with pytest.raises(InputError) as error:
        data_sets.read_patches([theirs])
    assert complaint in str(error.value) and "\n" not in str(error.value)


def test_a_damaged_image_is_named_when_it_is_decoded(theirs):
    path = theirs / "images" / "im2.png"
    path.write_bytes(path.read_bytes()[:-40])
    with pytest.raises(InputError, match=r"im2\.png: expected"):
        in_memory(data_sets.read_views([theirs]))


def test_a_set_without_circles_is_refused(data_set, tmp_path):
    views = read_views([data_set])
    with pytest.raises(InputError, match="expected views that show all three circles, found none in 8"):
        markerpose_layout.write_views(tmp_path, chosen(views, ~views.present))
