"""A data set is read as it was written, or refused in one line that says where."""
# ruff: noqa: E402 - torch is asked for before what needs it

import io
import json
import tarfile

import numpy as np
import pytest

torch = pytest.importorskip("torch")  # the folder's other tests need it, and so does what reads shards

from recon.errors import InputError
from trainers.shard_reader import read_patches, read_views, split


def rewritten(folder, change):
    """Write the first shard again with members changed by `change(name, content)`: None leaves one out."""
    path = folder / "shard-00000.tar"
    with tarfile.open(path) as archive:
        files = [(entry.name, archive.extractfile(entry).read()) for entry in archive]
    with tarfile.open(path, "w") as archive:
        for name, content in files:
            content = change(name, content)
            if content is not None:
                entry = tarfile.TarInfo(name)
                entry.size = len(content)
                archive.addfile(entry, io.BytesIO(content))


def test_views_and_their_truth_are_read_in_order(data_set):
    views = read_views(data_set)
    assert views.images.shape == (48, 240, 320) and views.images.dtype == np.uint8
    assert (views.sample == np.repeat(np.arange(24), 2)).all()
    assert (views.present == (views.sample % 6 != 5)).all()
    dark, bright = [], []
    for image, centres, scale in zip(views.images, views.centres, views.scale, strict=True):
        u, v = np.rint(centres[0] / scale)
        if 8 < u < 312 and 8 < v < 232:
            bright.append(image[int(v), int(u)])  # the white hole of c0
            dark.append(image[int(v), int(u) + 7])  # its black
    assert len(dark) > 30 and np.mean(bright) > np.mean(dark) + 80


def test_masks_lie_where_their_ellipses_are(data_set):
    patches = read_patches(data_set)
    assert patches.images.shape == patches.masks.shape == (144, 120, 120)
    rows, columns = np.indices((120, 120))
    near = np.abs(patches.ellipses[:, :2] - 59.5).max(1) < 1  # the others were cut at the image's border
    assert near.sum() > 60
    for mask, ellipse in zip(patches.masks[near], patches.ellipses[near], strict=True):
        inside = mask > 0
        assert np.abs([columns[inside].mean() - ellipse[0], rows[inside].mean() - ellipse[1]]).max() < 0.3
    assert not patches.masks[np.isnan(patches.ellipses[:, 0])].any()


def test_no_sample_is_on_both_sides(data_set):
    train, held = split(read_views(data_set), 0.1)
    assert not set(train.sample) & set(held.sample)
    assert len(train) + len(held) == 48 and len(held) == 2 * 2


def test_a_missing_folder_is_said_in_one_line(tmp_path):
    for folder, found in ((tmp_path / "nowhere", "no such folder"), (tmp_path, "none")):
        with pytest.raises(InputError, match=rf"^{folder}: expected a folder with shards.*{found}$"):
            read_views(folder)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda name, content: None if name == "00000003.cam2.png" else content,
            "expected the member 00000003.cam2.png, found none",
        ),
        (lambda name, content: content[:200] if name.endswith("3.cam1.png") else content, "00000003.cam1.png: expected .*PNG"),
        (lambda name, content: b"{" if name.endswith("3.json") else content, "00000003.json: expected JSON"),
        (
            lambda name, content: b'{"views": [{}, {}]}' if name.endswith("3.json") else content,
            "00000003.json: expected two views",
        ),
    ],
)
def test_damage_is_said_with_the_place(write, tmp_path, change, message):
    folder = write(tmp_path / "set", 6)
    rewritten(folder, change)
    with pytest.raises(InputError, match=message) as caught:
        read_views(folder)
    assert "shard-00000.tar: 00000003" in str(caught.value).replace(".json", "").replace(".cam1.png", "") and "\n" not in str(
        caught.value
    )


def test_a_shard_cut_short_is_refused(write, tmp_path):
    folder = write(tmp_path / "set", 6)
    path = folder / "shard-00000.tar"
    path.write_bytes(path.read_bytes()[:200_000])
    with pytest.raises(InputError, match=r"shard-00000\.tar: expected a tar file, found a damaged one|expected the member"):
        read_views(folder)
    path.write_bytes(b"no tar at all" * 100)
    with pytest.raises(InputError, match="found a damaged one"):
        read_views(folder)


def test_a_shard_that_is_missing_is_noticed(write, tmp_path):
    folder = write(tmp_path / "set", 6, shard=2)
    (folder / "shard-00001.tar").unlink()
    with pytest.raises(InputError, match=r"expected 6 samples as of dataset\.json, found 4"):
        read_views(folder)


def test_patches_of_another_size_are_refused(write, tmp_path):
    folder = write(tmp_path / "set", 2)
    with tarfile.open(folder / "shard-00000.tar") as archive:
        view = archive.extractfile("00000000.cam1.png").read()
    rewritten(folder, lambda name, content: view if name == "00000001.masks1.png" else content)
    with pytest.raises(InputError, match=r"masks1.png: expected 120x360 8-bit grey, found 320x240"):
        read_patches(folder)
    assert json.loads((folder / "dataset.json").read_text())["samples"] == 2
