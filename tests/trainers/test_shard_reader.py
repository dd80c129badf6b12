"""A data set is read as it was written, or refused in one line that says where."""
# ruff: noqa: E402 - torch is asked for before what needs it

import io
import json
import shutil
import tarfile
from dataclasses import fields

import numpy as np
import pytest

torch = pytest.importorskip("torch")  # the folder's other tests need it, and so does what reads shards

from recon.errors import InputError
from trainers.shard_reader import Patches, as_fits, bytes_decoded, chosen, in_memory, read_patches, read_views, split
from trainers.shard_truth import UNNAMED


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
    views = in_memory(read_views([data_set]))
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


def test_circles_of_further_bodies_stand_beside_the_probes(data_set, set_of_bodies):
    """Their names are the probe's where the target is of its kind; a set without them has none of them."""
    views = in_memory(read_views([set_of_bodies, data_set]))
    assert views.centres.shape == (40 + 48, 10, 2)
    assert (views.identity[:40] == [0, 1, 2, 0, 1, 2, *[UNNAMED] * 4]).all()
    assert (views.body[:40] == [0, 0, 0, 1, 1, 1, 2, 2, 2, 2]).all()
    alone = in_memory(read_views([data_set]))
    for name in ("centres", "visible", "inside", "blur", "identity", "body"):
        np.testing.assert_array_equal(getattr(views, name)[40:, :3], getattr(alone, name))
    assert np.isnan(views.centres[40:, 3:]).all() and not views.visible[40:, 3:].any() and (views.body[40:, 3:] == -1).all()
    assert (np.isfinite(views.centres[:40, 3:]).all((1, 2)) == (views.sample[:40] % 5 != 4)).all()
    assert (views.present[:40] == ((views.sample[:40] % 5 != 4) | (views.sample[:40] % 6 != 5))).all()
    for image, centres, scale in zip(views.images[:40], views.centres[:40, 3:], views.scale[:40], strict=True):
        for u, v in np.rint(centres / scale)[np.isfinite(centres).all(1)].astype(int):
            hole, ring = image[v, u], image[max(v - 5, 0), u]
            assert int(hole) > int(ring) + 60  # px of the view: holes have a radius of 3, discs of 7 or more


def test_patches_of_further_bodies_have_their_masks(data_set, set_of_bodies):
    patches = in_memory(read_patches([data_set, set_of_bodies]))
    assert len(patches) == 144 + 20 * 2 * 10 and (patches.sample[144:] == 24 + np.repeat(np.arange(20), 20)).all()
    rows, columns = np.indices((120, 120))
    near = np.abs(patches.ellipses[:, :2] - 59.5).max(1) < 1
    near[:144] = False
    assert near.sum() > 250
    for mask, ellipse in zip(patches.masks[near], patches.ellipses[near], strict=True):
        inside = mask > 0
        assert np.abs([columns[inside].mean() - ellipse[0], rows[inside].mean() - ellipse[1]]).max() < 0.3
    assert not patches.masks[np.isnan(patches.ellipses[:, 0])].any()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda truth: truth.pop("bodies"),
            "bodies: expected the same in all samples, found none, and needle of 3 circles, tray",
        ),
        (
            lambda truth: truth["bodies"].update(tray=truth["bodies"]["needle"]),
            "found needle of 3 circles, tray of 3 circles, and",
        ),
        (lambda truth: truth["bodies"]["tray"]["views"][0].update(patch_origins=[[0, 0]] * 3), "patch"),
        (lambda truth: truth["bodies"]["tray"].pop("kind"), r"bodies\.tray\.kind: expected a value"),
        (lambda truth: truth.update(bodies=[1]), "bodies: expected"),
        (lambda truth: truth["bodies"]["needle"]["views"].pop(), r"bodies\.needle\.views"),
        (lambda truth: truth["bodies"]["needle"]["views"][1].update(visible=[2.0] * 3), r"bodies\.needle\.views\.1\.visible\.0"),
    ],
)
def test_damaged_truth_of_bodies_is_named(set_of_bodies, tmp_path, change, message):
    def changed(name, content):
        if not name.endswith("-00000003.json"):
            return content
        truth = json.loads(content)
        change(truth)
        return json.dumps(truth).encode()

    folder = shutil.copytree(set_of_bodies, tmp_path / "set")
    rewritten(folder, changed)
    for read in (read_views, read_patches):
        with pytest.raises(InputError, match=rf"shard-00000\.tar: 0-00000003\.json: .*{message}") as caught:
            read([folder])
        assert str(caught.value).isprintable() and len(str(caught.value)) < 600


def test_masks_lie_where_their_ellipses_are(data_set):
    patches = in_memory(read_patches([data_set]))
    assert patches.images.shape == patches.masks.shape == (144, 120, 120)
    rows, columns = np.indices((120, 120))
    near = np.abs(patches.ellipses[:, :2] - 59.5).max(1) < 1  # the others were cut at the image's border
    assert near.sum() > 60
    for mask, ellipse in zip(patches.masks[near], patches.ellipses[near], strict=True):
        inside = mask > 0
        assert np.abs([columns[inside].mean() - ellipse[0], rows[inside].mean() - ellipse[1]]).max() < 0.3
    assert not patches.masks[np.isnan(patches.ellipses[:, 0])].any()


def test_no_sample_is_on_both_sides(data_set):
    train, held = split(in_memory(read_views([data_set])), 0.1)
    assert not set(train.sample) & set(held.sample)
    assert len(train) + len(held) == 48 and len(held) == 2 * 2


def test_a_missing_folder_is_said_in_one_line(tmp_path):
    for folder, found in ((tmp_path / "nowhere", "no such folder"), (tmp_path, "none")):
        with pytest.raises(InputError, match=rf"^{folder}: expected a folder with shards.*{found}$"):
            read_views([folder])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda name, content: None if name == "0-00000003.cam2.png" else content,
            "expected the member 0-00000003.cam2.png, found none",
        ),
        (lambda name, content: content[:200] if name.endswith("3.cam1.png") else content, "0-00000003.cam1.png: expected .*PNG"),
        (lambda name, content: b"{" if name.endswith("3.json") else content, "0-00000003.json: expected JSON"),
        (
            lambda name, content: b'{"views": [{}, {}]}' if name.endswith("3.json") else content,
            "0-00000003.json: views.0.camera: expected a value",
        ),
    ],
)
def test_damage_is_said_with_the_place(write, tmp_path, change, message):
    folder = write(tmp_path / "set", 6)
    rewritten(folder, change)
    with pytest.raises(InputError, match=message) as caught:
        in_memory(read_views([folder]))
    assert "shard-00000.tar: 0-00000003" in str(caught.value).replace(".json", "").replace(".cam1.png", "") and "\n" not in str(
        caught.value
    )


def _truth(change):
    """A change of the first sample's truth."""

    def changed(name, content):
        if not name.endswith("-00000000.json"):
            return content
        truth = json.loads(content)
        change(truth)
        return json.dumps(truth).replace('"BIG"', "9" * 10_000).encode()

    return changed


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda truth: truth.update(views={"1": {}, "2": {}}), "views: expected a list"),
        (lambda truth: truth["views"].append(truth["views"][0]), "views: expected"),
        (
            lambda truth: truth["views"][0].update(centres=[["1", "2"]] * 3),
            r"views\.0\.centres\.0\.0: expected number, found '1'",
        ),
        (lambda truth: truth["views"][0].update(centres=[[1e308, 0]] * 3), r"views\.0\.centres\.0\.0: expected less than"),
        (lambda truth: truth["views"][1].update(visible=[float("nan")] * 3), "expected finite numbers, found NaN"),
        (
            lambda truth: truth["views"][1].update(visible=[1.0, 1.0]),
            r"views\.1\.visible: expected 3 values, as there are centres, found 2",
        ),
        (lambda truth: truth["views"][1].update(visible=None), r"views\.1\.visible: expected 3 values, as there are centres"),
        (lambda truth: truth["views"][1].update(white_dn="BIG"), "expected JSON, found it damaged: a number of 10000 digits"),
        (lambda truth: truth["views"][1]["camera"].update(size=[0, 1024]), r"views\.1\.camera\.size\.0: expected greater than"),
        (lambda truth: truth["views"][1].update(ellipses=[[1, 2, -3, 4, 5]] * 3), r"views\.1\.ellipses\.0\.2: expected greater"),
        (lambda truth: truth["views"][1].update(patch_origins=None), r"views\.1\.patch_origins: expected a list, found None"),
        (lambda truth: truth.update(k="0"), "k: expected integer, found '0'"),
    ],
)
def test_truth_of_another_type_is_named_by_its_field(data_set, tmp_path, change, message):
    folder = shutil.copytree(data_set, tmp_path / "set")
    rewritten(folder, _truth(change))
    with pytest.raises(InputError, match=rf"shard-00000\.tar: 0-00000000\.json: {message}") as caught:
        read_patches([folder])
    assert str(caught.value).isprintable() and len(str(caught.value)) < 400


@pytest.mark.parametrize("content", [b"", b"\0", b"[" * 100_000, b'{"views": ' * 5000 + b"}" * 5000, b"\xff\xfe", b"null"])
def test_json_that_is_none_is_said(data_set, tmp_path, content):
    folder = shutil.copytree(data_set, tmp_path / "set")
    rewritten(folder, lambda name, old: content if name.endswith("-00000000.json") else old)
    with pytest.raises(InputError, match=r"shard-00000\.tar: 0-00000000\.json: expected") as caught:
        read_views([folder])
    assert str(caught.value).isprintable()


def test_a_key_that_stands_twice_is_refused(data_set, tmp_path):
    """As in all other JSON: which of two values was meant?"""
    folder = shutil.copytree(data_set, tmp_path / "set")
    rewritten(folder, lambda name, old: old.replace(b'"k":', b'"k": 7, "k":') if name.endswith("3.json") else old)
    with pytest.raises(InputError, match=r"0-00000003\.json: expected JSON, found it damaged: the key 'k' twice in one object$"):
        read_views([folder])


@pytest.mark.parametrize(
    "content",
    [
        *(b"", b"[]", b"[" * 100_000, b"\xff"),
        *(b'{"samples": "24"}', b'{"samples": -1}', b'{"samples": NaN}', b'{"samples": 24, "samples": 6}'),
    ],
)
def test_a_damaged_promise_is_said(data_set, tmp_path, content):
    folder = shutil.copytree(data_set, tmp_path / "set")
    (folder / "dataset.json").write_bytes(content)
    with pytest.raises(InputError, match=rf"^{folder}/dataset\.json: .*expected") as caught:
        read_views([folder])
    assert str(caught.value).isprintable()


@pytest.mark.parametrize("place", ["dataset.json", "nowhere"])
def test_a_promise_behind_a_link_that_leads_nowhere_is_said(data_set, tmp_path, place):
    """A data set without the file is read, as its shards are enough."""
    folder = shutil.copytree(data_set, tmp_path / "set")
    (folder / "dataset.json").unlink(missing_ok=True)
    read_views([folder])
    (folder / "dataset.json").symlink_to(folder / place)
    with pytest.raises(InputError, match=rf"^{folder}/dataset\.json: expected a file"):
        read_views([folder])


def test_a_shard_of_zeros_is_refused(data_set, tmp_path):
    folder = shutil.copytree(data_set, tmp_path / "set")
    last = max(folder.glob("*.tar"))
    last.write_bytes(bytes(last.stat().st_size))
    with pytest.raises(InputError, match=rf"^{last}: expected samples, found none in it"):
        read_views([folder])


def test_ranges_of_a_set_are_the_set(write, data_set, tmp_path):
    """Two machines' folders, one after the other, are the folder of one."""
    parts = [write(tmp_path / "a", 16), write(tmp_path / "b", 8, first=16)]
    whole, joined = in_memory(read_views([data_set])), in_memory(read_views(parts))
    for field in fields(whole):
        np.testing.assert_array_equal(getattr(whole, field.name), getattr(joined, field.name))


def test_parts_that_share_samples_are_refused(write, data_set, tmp_path):
    """They would be trained with and validated with; other seeds have the same numbers, but other samples."""
    part = write(tmp_path / "a", 4, first=22)
    with pytest.raises(
        InputError, match=r"a/shard-00001\.tar: expected samples that are in no other part, found 2 in two"
    ) as caught:
        read_patches([data_set, part])
    assert str(data_set / "shard-00001.tar") in str(caught.value) and "\n" not in str(caught.value)
    assert len(read_views([data_set, write(tmp_path / "b", 4, seed=1)])) == 2 * 28


def test_sets_of_the_earlier_version_are_read(write, tmp_path):
    """Their keys had no seed."""
    folder = write(tmp_path / "set", 6)
    now = in_memory(read_views([folder]))
    path = folder / "shard-00000.tar"
    with tarfile.open(path) as archive:
        files = [(entry.name.removeprefix("0-"), archive.extractfile(entry).read()) for entry in archive]
    with tarfile.open(path, "w") as archive:
        for name, content in files:
            entry = tarfile.TarInfo(name)
            entry.size = len(content)
            archive.addfile(entry, io.BytesIO(content))
    (folder / "dataset.json").write_text(json.dumps({"version": 1, "samples": 6, "seed": 0}))
    before = in_memory(read_views([folder]))
    assert (before.images == now.images).all() and (before.sample == now.sample).all()
    with pytest.raises(InputError, match="found 6 in two"):  # of one seed, whatever their keys
        read_views([folder, write(tmp_path / "other", 6)])


def test_images_are_the_same_from_memory_and_from_shards(data_set):
    """In any order, also those that are asked for twice, and those chosen of the chosen."""
    for stored in (read_views([data_set]), read_patches([data_set])):
        held = in_memory(stored)
        assert isinstance(held.images, np.ndarray) and not isinstance(stored.images, np.ndarray)
        which = np.random.default_rng(0).integers(len(stored), size=40)
        for some in (which, slice(3, 9), slice(0, 0), held.sample == 5):
            np.testing.assert_array_equal(stored.images[some], held.images[some])
        twice = chosen(chosen(stored, which), held.sample[which] % 2 == 0)
        np.testing.assert_array_equal(twice.images[::-1], held.images[which][held.sample[which] % 2 == 0][::-1])
        if isinstance(stored, Patches):
            np.testing.assert_array_equal(stored.masks[which], held.masks[which])


def test_what_fits_goes_into_memory_the_smaller_first(data_set):
    train, held_out = split(read_views([data_set]), 0.25)
    room = bytes_decoded(held_out) + bytes_decoded(train)
    assert bytes_decoded(held_out) == 12 * 320 * 240
    for most, expected in ((room, (True, True)), (room - 1, (False, True)), (0, (False, False))):
        assert tuple(isinstance(some.images, np.ndarray) for some in as_fits((train, held_out), most)) == expected


def test_a_shard_cut_short_is_refused(write, tmp_path):
    folder = write(tmp_path / "set", 6)
    path = folder / "shard-00000.tar"
    path.write_bytes(path.read_bytes()[:200_000])
    with pytest.raises(
        InputError,
        match=r"shard-00000\.tar: expected a tar file, found a damaged one|expected the member|found the tar file cut short",
    ):
        in_memory(read_views([folder]))
    path.write_bytes(b"no tar at all" * 100)
    with pytest.raises(InputError, match="found a damaged one"):
        in_memory(read_views([folder]))


def test_a_shard_that_is_missing_is_noticed(write, tmp_path):
    folder = write(tmp_path / "set", 6, shard=2)
    (folder / "shard-00001.tar").unlink()
    with pytest.raises(InputError, match=r"expected 6 samples as of dataset\.json, found 4"):
        in_memory(read_views([folder]))


def test_patches_of_another_size_are_refused(write, tmp_path):
    folder = write(tmp_path / "set", 2)
    with tarfile.open(folder / "shard-00000.tar") as archive:
        view = archive.extractfile("0-00000000.cam1.png").read()
    rewritten(folder, lambda name, content: view if name == "0-00000001.masks1.png" else content)
    with pytest.raises(InputError, match=r"masks1.png: expected 120x360 8-bit grey, found 320x240"):
        in_memory(read_patches([folder]))
    assert json.loads((folder / "dataset.json").read_text())["samples"] == 2
