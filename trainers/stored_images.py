"""Images that stay in their files: each is read by its place and decoded when it is asked for, in any order."""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from recon.errors import InputError
from recon.files import tar_members

THREADS = min(os.cpu_count() or 1, 8)  # that decode; the decoders release the interpreter's lock

Grey = NDArray[np.uint8]
Decode = Callable[[str, bytes], Grey]  # from a place for messages and a PNG to its images (pieces, h, w)


@dataclass(frozen=True)
class StoredImages:
    """Images (n, h, w) uint8, by `[which]` the same as those of an array that holds them.

    A file lies by itself, or is a member of a shard. It has one image, or several of them one below the other, its pieces.
    """

    shards: tuple[Path, ...]  # or files
    places: NDArray[np.int64]  # (m, 3) of files: number of the shard, offset and size in it, bytes
    decode: tuple[Decode, ...]  # of the files in each shard
    size: tuple[int, int]  # px, width and height of an image
    index: NDArray[np.int64]  # (n, 2) file of each image, and the piece of it

    @property
    def shape(self) -> tuple[int, int, int]:
        """(n, h, w)."""
        return len(self.index), self.size[1], self.size[0]

    def __len__(self) -> int:
        return len(self.index)

    def followed_by(self, other: "StoredImages") -> "StoredImages":
        """These images and another's, of the same size."""
        return StoredImages(
            self.shards + other.shards,
            np.concatenate([self.places, other.places + np.array([len(self.shards), 0, 0])]),
            self.decode + other.decode,
            self.size,
            np.concatenate([self.index, other.index + np.array([len(self.places), 0])]),
        )

    def chosen(self, which: NDArray) -> "StoredImages":
        """Those that a mask or an index selects, left where they are."""
        return replace(self, index=self.index[which])

    def __getitem__(self, which: NDArray | slice) -> Grey:
        """Decoded images : (k, h, w); InputError in one line where a PNG is damaged, or of another size."""
        index = self.index[which]
        images = np.empty((len(index), *self.shape[1:]), np.uint8)
        order = np.lexsort(index.T[::-1])  # along the disk, and each file once
        borders = np.flatnonzero(np.diff(index[order, 0])) + 1

        def fill(rows: NDArray[np.int64]) -> None:
            if len(rows):
                images[rows] = self._decoded(index[rows[0], 0])[index[rows, 1]]

        with ThreadPoolExecutor(THREADS) as pool:
            list(pool.map(fill, np.split(order, borders)))
        return images

    def _decoded(self, file: int) -> Grey:
        shard, offset, size = self.places[file].tolist()
        path = self.shards[shard]
        content = tar_members.read(path, offset, size)
        try:
            return self.decode[shard]("", content)
        except InputError:  # again, with its name, found for the line; no member begins at 0
            return self.decode[shard](f"{path}: {tar_members.name_at(path, offset)}" if offset else str(path), content)
