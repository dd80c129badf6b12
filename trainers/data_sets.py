"""Data sets of all kinds as one: shards of `sonotwin dataset`, and MarkerPose's folders after them."""

from collections.abc import Sequence
from pathlib import Path

from recon.errors import InputError
from trainers import markerpose_layout, shard_reader
from trainers.shard_reader import Patches, Tell, Views, joined


def read_views(folders: Sequence[Path], tell: Tell = lambda count: None, partial: bool = False) -> Views:
    """Views of some folders; see `trainers.shard_reader.read_views`.

    Raises
    ------
    InputError
        Also if MarkerPose's folders, of three circles, stand beside a set of others.
    """
    shards, others = _kinds(folders)
    parts = [shard_reader.read_views(shards, tell, partial)] if shards else []
    return joined([*parts, *(markerpose_layout.read_views(folder) for folder in others)])


def read_patches(folders: Sequence[Path], tell: Tell = lambda count: None, partial: bool = False) -> Patches:
    """Patches of some folders; otherwise as `read_views`."""
    shards, others = _kinds(folders)
    parts = [shard_reader.read_patches(shards, tell, partial)] if shards else []
    return joined([*parts, *(markerpose_layout.read_patches(folder) for folder in others)])


def with_patches(folders: Sequence[Path]) -> list[Path]:
    """Those of some folders that have patches: MarkerPose's, or shards whose first sample has them."""
    shards, others = _kinds(folders)
    have = [*filter(shard_reader.has_patches, shards), *filter(markerpose_layout.has_patches, others)]
    return [folder for folder in folders if folder in have]


def _kinds(folders: Sequence[Path]) -> tuple[list[Path], list[Path]]:
    """Folders with shards, and MarkerPose's."""
    others = [folder for folder in folders if markerpose_layout.recognises(folder)]
    shards = [folder for folder in folders if folder not in others]
    if others and shards and (circles := shard_reader.circles_of(shards)) != 3:
        raise InputError(f"{others[0]}: expected samples of {circles} circles, as in {shards[0]}, found MarkerPose's, of three")
    return shards, others
