"""Fit the probability that a mass is found to kept trials of `seen`, and test it on others: predicted against found.

Trials of even seeds fit, those of odd seeds test, so that no breast does both. Intervals are of 95 %, exact binomial (Clopper and
Pearson 1934), as if pairs were independent; those of one mass taken in several ways aren't, so they are somewhat too narrow.

python -m twin.experiments.seen_calibration outputs/seen outputs/seen_patients
"""

import argparse
import math
import re
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray
from scipy.stats import binomtest

from recon.errors import InputError
from recon.segmentation import detectability
from recon.segmentation.detectability import ASSUMED, Calibration, Features

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Table = Sequence[Mapping[str, Any]]  # a row a trial

TABLE, SEED, TISSUE = "table.parquet", "seed", "seen.tissue"  # of a study's folder, and its columns
COLUMN = re.compile(r"pair\d+_found")
BINS = tuple((k / 10, (k + 1) / 10) for k in range(10))
BARS = ((0.85, 0.95), (0.4, 0.6))  # places said to be seen, and doubtful ones


@dataclass(frozen=True, eq=False)
class Outcomes:
    """Pairs of trials: n masses, each taken one way."""

    features: Features  # (n,) each
    found: Mask  # (n,)
    seed: NDArray[np.int64]  # (n,)
    tissue: NDArray[np.str_]  # (n,)

    def of(self, chosen: Mask) -> "Outcomes":
        """Some of them."""
        return Outcomes(
            Features(*(one[chosen] for one in self.features)), self.found[chosen], self.seed[chosen], self.tissue[chosen]
        )


def calibrate(tables: Iterable[Table]) -> Calibration:
    """Coefficients by the pairs of even seeds.

    Raises
    ------
    InputError
        As `recon.segmentation.detectability.fit`.
    """
    fitting, _ = halves(outcomes(tables))
    return detectability.fit(fitting.features, fitting.found)


def outcomes(tables: Iterable[Table]) -> Outcomes:
    """Pairs of all trials, in their order; trials without figures have none.

    Raises
    ------
    InputError
        If there is none.
    """
    rows = list[tuple[Any, ...]]()
    for row in (row for table in tables for row in table):
        for name in filter(COLUMN.fullmatch, row):
            pair = [row[name.replace("found", field)] for field in (*Features._fields, "found")]
            if not math.isnan(pair[-1]):
                rows.append((*pair, row[SEED], row.get(TISSUE, "silicone")))
    if not rows:
        raise InputError("trials: expected some with pairs of a mass and a way, found none")
    *features, found, seed, tissue = zip(*rows, strict=True)
    return Outcomes(Features(*map(np.array, features)), np.array(found) > 0, np.array(seed), np.array(tissue))


def halves(pairs: Outcomes) -> tuple[Outcomes, Outcomes]:
    """Pairs of even seeds, and of odd ones."""
    even = pairs.seed % 2 == 0
    return pairs.of(even), pairs.of(~even)


def report(tables: Iterable[Table]) -> Iterator[str]:
    """Lines: the fitted coefficients, and the reliability of both these and the assumed ones by pairs of odd seeds.

    Raises
    ------
    InputError
        As `calibrate`, or if there is no pair of an odd seed.
    """
    kept = list(tables)
    fitting, testing = halves(outcomes(kept))
    if not testing.found.size:
        raise InputError("trials: expected some of odd seeds, to test with, found none")
    fitted = calibrate(kept)
    yield f"fitted      by {fitting.found.size} pairs of even seeds, of which {fitting.found.sum()} were found"
    for name, value in asdict(fitted).items():
        yield f"            {name} {value:.3f}, assumed {getattr(ASSUMED, name):g}"
    tissues = np.unique(testing.tissue).tolist()
    for title, chosen in [("all", testing), *((one, testing.of(testing.tissue == one)) for one in tissues)]:
        yield from _tested(title, chosen, fitted)


def shares(chance: Array, found: Mask, ranges: Iterable[tuple[float, float]]) -> Iterator[str]:
    """A line a range of probability that has pairs: their mean probability, the share that was found, and its interval."""
    for low, high in ranges:
        there = (chance >= low) & ((chance < high) | (high == 1))
        if count := int(there.sum()):
            hit = int(found[there].sum())
            interval = binomtest(hit, count).proportion_ci()
            bounds = f"{interval.low:.2f} to {interval.high:.2f}"
            yield f"{low:.2f}-{high:.2f}   {chance[there].mean():.2f} predicted, {hit / count:.2f} found ({bounds}) of {count}"


def _tested(title: str, pairs: Outcomes, fitted: Calibration) -> Iterator[str]:
    """Lines on pairs that nothing was fitted to."""
    chance, assumed = (detectability.probability(pairs.features, one) for one in (fitted, ASSUMED))
    brier, before = (float(np.mean((one - pairs.found) ** 2)) for one in (chance, assumed))
    yield f"tested      {title}: {pairs.found.size} pairs, Brier score {brier:.3f}, of the assumed coefficients {before:.3f}"
    yield from (f"            {line}" for line in shares(chance, pairs.found, BINS))
    yield from (f"bar         {line}" for line in shares(chance, pairs.found, BARS))


def read(folder: Path) -> Table:
    """The table of a study.

    Raises
    ------
    InputError
        If there is none.
    """
    try:
        return pq.read_table(folder / TABLE).to_pylist()
    except (OSError, pa.ArrowInvalid):
        raise InputError(f"{folder}: expected the folder of a study with {TABLE}, found none") from None


def main() -> int:
    """Print the coefficients and their test."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", type=Path, nargs="+", metavar="FOLDER", help="of a study of=seen")
    try:
        sys.stdout.writelines(f"{line}\n" for line in report(map(read, parser.parse_args().folders)))
    except InputError as error:
        parser.error(str(error))
    return 0


if __name__ == "__main__":
    sys.exit(main())
