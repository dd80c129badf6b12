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
from sonotwin.cli import main
from tests.twin.tracking.takes import ranges, rig, rig_of_three
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


@pytest.fixture(scope="module")
def made_of_bodies(tmp_path_factory):
    """A data set of three bodies, in one shard, of which each is absent in a fifth of the samples."""
    place, wanted = Place(tmp_path_factory.mktemp("data") / "bodies"), of_bodies()
    list(generate(place, wanted, prepare(place, wanted), Engine()))
    write_index(place, wanted)
    return place


def of_bodies(samples: int = 5, **changes) -> Settings:
    return settings(samples, rig=rig_of_three(), shard=5, **changes)


@pytest.mark.slow
def test_bodies_are_in_all_that_is_written(made_of_bodies):
    """Images, patches, masks, truth and index agree on which are there, and where."""
    files, index = members(made_of_bodies.shard(0)), pq.read_table(made_of_bodies.folder / dataset_shards.INDEX).to_pylist()
    compared, there = 0, set()
    for row in index:
        truth = json.loads(files[f"5-{row['k']:08d}.json"])
        targets = {"": truth} | {f"{name}_": body for name, body in truth["bodies"].items()}
        assert list(targets) == ["", "needle_", "patient_"] and truth["bodies"]["needle"]["kind"] == "three_circles"
        for camera in (1, 2):
            images = [cv2.imdecode(np.frombuffer(files[f"5-{row['k']:08d}.{kind}{camera}.png"], np.uint8), -1) for kind in KINDS]
            assert all(image.shape == (9 * 120, 120) for image in images)
            for number, (name, target) in enumerate(targets.items()):
                view = target["views"][camera - 1]
                assert row[f"{name}present"] == target["present"] == (view["centres"] is not None)
                assert row[f"{name}visible_{camera}"] == min(view["visible"])
                for circle in range(3):
                    patch, mask = (image.reshape(9, 120, 120)[3 * number + circle] for image in images)
                    assert target["present"] or not mask.any()
                    if not mask.any() or view["visible"][circle] < 0.98:
                        continue
                    u, v, a, _, _ = view["ellipses"][circle]
                    at = np.rint(np.array([v, u]) - view["patch_origins"][circle][::-1]).astype(int)
                    hole = patch[at[0] - 2 : at[0] + 3, at[1] - 2 : at[1] + 3].mean()
                    ring = patch[mask > 0][patch[mask > 0] < np.median(patch[mask > 0])].mean()
                    assert hole > 1.3 * ring and abs(mask[at[0]].astype(bool).sum() - 2 * a) < a
                    compared, there = compared + 1, there | {name}
    assert compared > 12 and there == {"", "needle_", "patient_"}


KINDS = ("patches", "masks")


@pytest.mark.slow
def test_a_sample_of_bodies_does_not_know_its_batch_or_range(made_of_bodies, monkeypatch, tmp_path):
    monkeypatch.setattr(dataset_shards, "BATCH", 1)
    part, wanted = Place(tmp_path / "set"), of_bodies(2, first=2)
    list(generate(part, wanted, prepare(part, wanted), Engine()))
    whole, there = members(made_of_bodies.shard(0)), members(part.shard(0))
    assert {name.split(".")[0] for name in there} == {"5-00000002", "5-00000003"}
    assert all(whole[name] == content for name, content in there.items())


def test_a_set_that_shows_the_probe_alone_gets_no_bodies(tmp_path):
    """As one of a rig with bodies was made once; one of a rig without them goes on, whatever is asked of bodies."""
    place = Place(tmp_path / "set")
    assert prepare(place, of_bodies()) == prepare(place, of_bodies()) == [0]
    kept = place.folder / dataset_shards.SETTINGS
    kept.write_text(json.dumps(json.loads(kept.read_text()) | {"version": 2}))
    with pytest.raises(InputError, match="version: expected 3, found 2, which shows the probe alone; it can be trained with"):
        prepare(place, of_bodies())
    alone = Place(tmp_path / "alone")
    prepare(alone, settings())
    assert "bodies" not in json.loads((alone.folder / dataset_shards.SETTINGS).read_text())["ranges"]


@pytest.mark.slow
def test_networks_train_on_bodies(made_of_bodies, tmp_path):
    pytest.importorskip("torch")
    for network, count in (("detector", 10), ("segmenter", 90)):
        out = tmp_path / network
        assert main(["train", f"network={network}", f"data={made_of_bodies.folder}", f"out={out}", "steps=3", "batch=4"]) == 0
        told = json.loads((out / "metrics.json").read_text())
        assert told["steps"] == 3 and told["views" if network == "detector" else "patches"] == count // 5


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
