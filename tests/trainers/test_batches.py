"""Batch k is the same however its images are kept and whoever makes it."""
# ruff: noqa: E402 - torch is asked for before what needs it

import shutil
from itertools import islice

import pytest

torch = pytest.importorskip("torch")

from recon.errors import InputError
from recon.files import tar_members
from trainers.batches import Batches
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
