"""Data sets are the same bytes however they are made, and damaged or foreign folders are refused."""

import io
import json
import shutil
import tarfile
import time

import cv2
import numpy as np
import pyarrow.parquet as pq
import pytest
import webdataset

from recon.errors import InputError
from tests.twin.tracking.takes import ranges, rig
from twin.engine import Engine
from twin.shooting import Quality
from twin.tracking import dataset_shards
from twin.tracking.dataset_shards import Place, Settings, generate, prepare, write_index

QUALITY = Quality(view=1, patch=2, window=2)


def settings(samples: int = 4, **changes) -> Settings:
    fields = {"rig": rig(), "ranges": ranges(), "quality": QUALITY, "frames": "views", "seed": 5, "shard": 2}
    return Settings(samples=samples, **{**fields, **changes})


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A data set of two shards."""
    place = Place(tmp_path_factory.mktemp("data") / "set")
    list(generate(place, settings(), prepare(place, settings()), Engine()))
    write_index(place, settings())
    return place


def members(path) -> dict[str, bytes]:
    with tarfile.open(path) as archive:
        return {entry.name: archive.extractfile(entry).read() for entry in archive}


def test_a_killed_run_goes_on_to_the_same_bytes(made, tmp_path, monkeypatch):
    place, wanted = Place(tmp_path / "set"), settings()
    written = []

    def dies(tar, sample):
        written.append(sample["__key__"])
        if len(written) == 2:
            raise KeyboardInterrupt
        return write(tar, sample)

    write = webdataset.TarWriter.write
    monkeypatch.setattr(webdataset.TarWriter, "write", dies)
    with pytest.raises(KeyboardInterrupt):
        list(generate(place, wanted, prepare(place, wanted), Engine()))
    assert not list(place.folder.glob("*.tar"))
    monkeypatch.undo()
    missing = prepare(place, wanted)
    assert missing == [0, 1]
    list(generate(place, wanted, missing[1:], Engine()))
    assert prepare(place, wanted) == [0]
    list(generate(place, wanted, [0], Engine()))
    for number in (0, 1):
        assert place.shard(number).read_bytes() == made.shard(number).read_bytes()


def test_what_workers_were_at_when_they_were_ended_is_removed(tmp_path, monkeypatch):
    """Ctrl-C ends them amid a shard: its half and the locks that they held go; hidden files of others stay."""
    place, wanted = Place(tmp_path / "set"), settings()
    missing = prepare(place, wanted)

    def interrupted(*_):
        for name in (".shard-00000.4194305.new.tar", ".shard-00000.tar.lock", ".shard-00001.tar.lock", ".shard-notes.tar"):
            (place.folder / name).write_bytes(b"half")
        yield 1
        raise KeyboardInterrupt

    monkeypatch.setattr(dataset_shards, "results", interrupted)
    with pytest.raises(KeyboardInterrupt):
        list(generate(place, wanted, missing, Engine()))
    assert {path.name for path in place.folder.iterdir()} == {".shard-notes.tar", ".sonotwin.json", "dataset.json"}


def test_a_sample_does_not_know_its_batch(made, monkeypatch, tmp_path):
    monkeypatch.setattr(dataset_shards, "BATCH", 1)
    place = Place(tmp_path / "set")
    place.folder.mkdir()
    dataset_shards.write_shard(place, settings(), 1)
    assert place.shard(1).read_bytes() == made.shard(1).read_bytes()


@pytest.mark.slow
def test_two_workers_write_the_same_bytes(made, tmp_path):
    """By whichever engine: all of them do tasks alike."""
    place = Place(tmp_path / "set")
    list(generate(place, settings(), prepare(place, settings()), Engine(workers=2)))
    for number in (0, 1):
        assert place.shard(number).read_bytes() == made.shard(number).read_bytes()


def test_what_is_in_a_shard(made):
    files = members(made.shard(0))
    keys = {name.split(".")[0] for name in files}
    assert keys == {"5-00000000", "5-00000001"}
    for key in keys:
        truth = json.loads(files[f"{key}.json"])
        for number, view in enumerate(truth["views"], 1):
            image = cv2.imdecode(np.frombuffer(files[f"{key}.cam{number}.png"], np.uint8), cv2.IMREAD_UNCHANGED)
            assert image.shape == (240, 320)
            patches = cv2.imdecode(np.frombuffer(files[f"{key}.patches{number}.png"], np.uint8), cv2.IMREAD_UNCHANGED)
            masks = cv2.imdecode(np.frombuffer(files[f"{key}.masks{number}.png"], np.uint8), cv2.IMREAD_UNCHANGED)
            assert patches.shape == masks.shape == (360, 120)
            if not truth["present"]:
                assert not masks.any()
                continue
            for circle in range(3):  # the mask's middle is the ellipse's, where the patch holds it all
                piece = masks[120 * circle : 120 * circle + 120]
                if piece[0].any() or piece[-1].any() or piece[:, 0].any() or piece[:, -1].any() or not piece.any():
                    continue
                v, u = np.nonzero(piece)
                middle = np.array([u.mean(), v.mean()]) + view["patch_origins"][circle]
                assert np.abs(middle - np.array(view["ellipses"][circle])[:2]).max() < 0.1


def test_the_index_has_a_row_a_sample(made):
    table = pq.read_table(io.BytesIO((made.folder / dataset_shards.INDEX).read_bytes())).to_pylist()
    assert [(row["seed"], row["k"]) for row in table] == [(5, 0), (5, 1), (5, 2), (5, 3)]
    assert [row["shard"] for row in table] == ["shard-00000.tar"] * 2 + ["shard-00001.tar"] * 2


def test_a_data_set_of_other_settings_is_not_mixed_with(made):
    with pytest.raises(InputError, match="seed: expected 6 as in this run, found 5"):
        prepare(made, settings(seed=6))


@pytest.mark.parametrize(("name", "there"), [("window", 64), ("old", 2)])
def test_what_differs_is_named_however_deep(tmp_path, name, there):
    """Also what an earlier version knew and this one doesn't."""
    place = Place(tmp_path / "set")
    prepare(place, settings())
    kept = place.folder / dataset_shards.SETTINGS
    told = json.loads(kept.read_text())
    expected = told["quality"].get(name)
    told["quality"][name] = there
    kept.write_text(json.dumps(told))
    with pytest.raises(InputError, match=f"dataset.json: quality.{name}: expected {expected} as in this run, found {there}"):
        prepare(place, settings())


def test_a_folder_of_other_things_is_left_alone(tmp_path):
    (tmp_path / "letter.txt").write_text("keep me")
    with pytest.raises(InputError, match="expected a new or empty folder, or one that dataset wrote"):
        prepare(Place(tmp_path), settings())


def test_more_samples_may_be_asked_for_later(made, tmp_path):
    grown = Place(tmp_path / "set")
    shutil.copytree(made.folder, grown.folder)
    assert prepare(grown, settings(8)) == [2, 3]
    assert prepare(grown, settings(9)) == [2, 3, 4]
    with pytest.raises(InputError, match="samples: expected at least the 9"):
        prepare(grown, settings(4))


def test_a_range_is_a_part_of_the_whole(made, tmp_path):
    """Samples 1 and 2 of another machine are those of the whole set, to the byte, and have its keys."""
    part = Place(tmp_path / "set")
    wanted = settings(2, first=1)
    list(generate(part, wanted, prepare(part, wanted), Engine()))
    write_index(part, wanted)
    whole = {**members(made.shard(0)), **members(made.shard(1))}
    there = {**members(part.shard(0)), **members(part.shard(1))}
    assert {name.split(".")[0] for name in there} == {"5-00000001", "5-00000002"}
    assert all(whole[name] == content for name, content in there.items())
    assert pq.read_table(part.folder / dataset_shards.INDEX)["k"].to_pylist() == [1, 2]
    assert prepare(part, wanted) == []
    assert prepare(part, settings(3, first=1)) == [1]  # it has to grow
    with pytest.raises(InputError, match="first: expected 0 as in this run, found 1"):
        prepare(part, settings(3))


def test_ranges_meet_without_gap_or_overlap():
    """Whatever the shards' size, three ranges have each sample once, and but the shards between two are in two of them."""
    parts = [settings(samples, first=first, shard=7) for first, samples in ((0, 10), (10, 18), (28, 2))]
    samples = [k for part in parts for number in part.shards() for k in part.samples_of(number)]
    assert samples == list(range(30))
    numbers = [number for part in parts for number in part.shards()]
    assert numbers == [0, 1, 1, 2, 3, 4]


def test_a_folder_of_the_earlier_version_is_left_alone(tmp_path):
    place = Place(tmp_path / "set")
    prepare(place, settings())
    kept = place.folder / dataset_shards.SETTINGS
    told = json.loads(kept.read_text()) | {"version": 1}
    del told["first"]
    kept.write_text(json.dumps(told))
    with pytest.raises(InputError, match="version: expected 2, found 1, whose keys lack the seed; it can be trained with"):
        prepare(place, settings())


@pytest.mark.parametrize(
    "content",
    [
        *(b"", b"[]", b"\xff\xfe", b"[" * 100_000, b'{"version": 2, "samples": "4"}', b'{"version": 2, "samples": NaN}'),
        *(b'{"version": 2, "samples": 4, "rig": ' + b"9" * 10_000 + b"}", b'{"version": 2, "samples": 4, "rig": "a\\u0000\\nb"}'),
    ],
)
def test_damaged_settings_are_refused_in_one_line(tmp_path, content):
    place = Place(tmp_path / "set")
    place.folder.mkdir()
    kept = place.folder / dataset_shards.SETTINGS
    kept.write_bytes(content)
    with pytest.raises(InputError) as caught:
        prepare(place, settings())
    line = str(caught.value)
    assert line.startswith(f"{kept}: ") and line.isprintable() and len(line) < 600
    assert kept.read_bytes() == content


@pytest.mark.parametrize("content", [b"", b"nothing", b"[]"])
def test_a_damaged_shard_is_named_with_the_way_on(made, tmp_path, content):
    """Also one that is whole but has another's truth."""
    place = Place(tmp_path / "set")
    shutil.copytree(made.folder, place.folder)
    path = place.shard(1)
    if content == b"[]":
        with tarfile.open(path, "w") as archive:
            for k in (2, 3):
                entry = tarfile.TarInfo(f"5-{k:08d}.json")
                entry.size = len(content)
                archive.addfile(entry, io.BytesIO(content))
    else:
        path.write_bytes(content)
    with pytest.raises(InputError) as caught:
        prepare(place, settings())
    assert str(path) in str(caught.value) and "move it away" in str(caught.value) and "\n" not in str(caught.value)


def test_many_shards_cost_no_more_each(tmp_path):
    """A folder of a million samples is opened in a moment: what is asked of each shard doesn't depend on the others' number."""
    place = Place(tmp_path / "set")
    wanted = settings(200_000)
    before = time.process_time()
    assert len(prepare(place, wanted)) == len(wanted.shards()) == 100_000
    assert time.process_time() - before < 10


def test_the_index_is_written_piece_by_piece(made, monkeypatch, tmp_path):
    place = Place(tmp_path / "set")
    shutil.copytree(made.folder, place.folder)
    monkeypatch.setattr(dataset_shards, "ROWS", 3)
    write_index(place, settings())
    written, whole = (pq.ParquetFile(one.folder / dataset_shards.INDEX) for one in (place, made))
    assert written.num_row_groups == 2 and written.read().equals(whole.read())
