"""Images that stay in their shards: each is read by its place and decoded when it is asked for, in any order."""

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

    A PNG has one image, or several of them one below the other, its pieces: image i of all is piece i % pieces of the PNG
    i // pieces.
    """

    shards: tuple[Path, ...]
    places: NDArray[np.int64]  # (m, 3) of PNGs: number of the shard, offset and size in it, bytes
    decode: Decode
    size: tuple[int, int]  # px, width and height of an image
    pieces: int
    index: NDArray[np.int64]  # (n,) which of all images

    @property
    def shape(self) -> tuple[int, int, int]:
        """(n, h, w)."""
        return len(self.index), self.size[1], self.size[0]

    def __len__(self) -> int:
        return len(self.index)

    def chosen(self, which: NDArray) -> "StoredImages":
        """Those that a mask or an index selects, left where they are."""
        return replace(self, index=self.index[which])

    def __getitem__(self, which: NDArray | slice) -> Grey:
        """Decoded images : (k, h, w); InputError in one line where a PNG is damaged, or of another size."""
        index = self.index[which]
        images = np.empty((len(index), *self.shape[1:]), np.uint8)
        order = np.argsort(index, kind="stable")  # along the disk, and each PNG once
        borders = np.flatnonzero(np.diff(index[order] // self.pieces)) + 1

        def fill(rows: NDArray[np.int64]) -> None:
            if len(rows):
                images[rows] = self._decoded(index[rows[0]] // self.pieces)[index[rows] % self.pieces]

        with ThreadPoolExecutor(THREADS) as pool:
            list(pool.map(fill, np.split(order, borders)))
        return images

    def _decoded(self, png: int) -> Grey:
        shard, offset, size = self.places[png].tolist()
        path = self.shards[shard]
        content = tar_members.read(path, offset, size)
        try:
            return self.decode("", content)
        except InputError:
            return self.decode(
                f"{path}: {tar_members.name_at(path, offset)}", content
            )  # again, with its name, found for the line
