"""Names and places of unknowns that are packed into one array, block by block."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Blocks:
    """Blocks of unknowns, one behind the other."""

    sizes: Mapping[str, int]  # block: number of its unknowns

    def __len__(self) -> int:
        return sum(self.sizes.values())

    def __getitem__(self, block: str) -> slice:
        """Places of a block's unknowns."""
        names = list(self.sizes)
        first = sum(self.sizes[name] for name in names[: names.index(block)])
        return slice(first, first + self.sizes[block])

    def split(self, packed: Array) -> list[Array]:
        """The blocks' own values, in their order."""
        return [packed[self[block]] for block in self.sizes]


def of_block(names: Sequence[str], block: str) -> tuple[NDArray[np.intp], tuple[str, ...]]:
    """Places of the parameters of a block among names `BLOCK.PARAMETER`, and their names without it."""
    places = [k for k, name in enumerate(names) if name.partition(".")[0] == block]
    return np.array(places, np.intp), tuple(names[k].partition(".")[2] for k in places)
