"""Batch k is the same however its images are kept and whoever makes it."""
# ruff: noqa: E402 - torch is asked for before what needs it

import shutil
from itertools import islice
from unittest.mock import Mock

import pytest

torch = pytest.importorskip("torch")

from recon.errors import InputError
from recon.files import tar_members
from trainers.architectures import network
from trainers.batches import Batches, crops, generator_of
from trainers.fit import Plan, fit, measure, read_log
from trainers.shard_reader import in_memory, read_patches, read_views


@pytest.mark.parametrize("read", [read_views, read_patches])
def test_batches_from_shards_are_those_from_memory(data_set, read):
    stored = read([data_set])
    for k in (0, 7, 7_000_000):
        one, two = (Batches(data, 4, 64, 3)[k] for data in (stored, in_memory(stored)))
        assert all(torch.equal(a, b) for a, b in zip(one, two, strict=True))


@pytest.mark.parametrize("loaders", [0, 1])
def test_damage_that_is_met_later_is_one_line(data_set, tmp_path, loaders):
    """From a process that makes batches, too, whose traceback nobody wants to read."""
    folder = shutil.copytree(data_set, tmp_path / "set")
    stored = read_patches([folder])
    for shard in folder.glob("*.tar"):
        content = bytearray(shard.read_bytes())
        for member in tar_members.members(shard):
            if "masks" in member.name:
                content[member.offset + 60] ^= 255
        shard.write_bytes(content)
    with pytest.raises(InputError, match=rf"^{folder}/shard-0000\d\.tar: 0-\d+\.masks\d\.png: expected") as caught:
        list(islice(Batches(stored, 4, 64, 3).since(0, loaders), 3))
    assert "\n" not in str(caught.value)


def test_crops_are_about_each_target_in_turn(set_of_bodies):
    """Of three targets in view each is whole in its share of crops; no middle of all of them is taken, where there is nothing."""
    views = read_views([set_of_bodies])
    some = crops(views, 400, 96, generator_of(1, 0))
    inside = ((some.places >= 0) & (some.places < 96)).all(-1)
    held = torch.stack([inside[:, :3].all(1), inside[:, 3:6].all(1), inside[:, 6:].all(1)], 1).float().mean(0)
    assert (held > 0.08).all(), held  # each in a third of those that are about a target, less what turns and scales push out
    assert inside.any(1).float().mean() > 0.7
    assert set(some.labels.identity.unique().tolist()) == {-100, 0, 1, 2, 3}


@pytest.mark.slow
def test_a_detector_trains_on_several_bodies(set_of_bodies, tmp_path):
    """Its loss falls in a few steps, and all that is measured of it is there."""
    data = read_views([set_of_bodies])
    torch.manual_seed(0)
    fitted = fit(
        network("detector", 3), data, data, Plan("detector", 8, 96, 0.002, 0.01, 0, 30, None, log_steps=10), tmp_path, Mock()
    )
    losses = [row["loss"] for row in read_log(tmp_path)]
    assert fitted.steps == 30 and losses[-1] < 0.8 * losses[0]
    figures = measure(fitted.network, data)
    assert {"recall_c0", "recall_c2", "all_three"} <= set(figures) and "recall_c3" not in figures
    assert figures["all_three_views"] > 60  # targets: up to three a view
