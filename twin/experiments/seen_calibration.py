"""Fit the probability that a mass is found to kept trials of `seen`, and test it on others: predicted against found.

All breasts fit; each is tested by coefficients that were fitted to those of other parts (cross-validation), four seeds in a row
being in one part, one of each density. Pairs in even and in grown tissue are fitted apart, as masses are found there by their
contrast and by their looks. Intervals are of 95 %, exact binomial (Clopper and Pearson 1934), as if pairs were independent; those
of one mass taken in several ways aren't, so they are somewhat too narrow.

python -m twin.experiments.seen_calibration outputs/seen outputs/seen_patients
"""

import argparse
import math
import re
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray
from scipy.stats import binomtest

from recon.errors import InputError
from recon.segmentation import detectability
from recon.segmentation.detectability import EVEN, GROWN, Features
from twin.experiments import patient_trial, seen_trial

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Table = Sequence[Mapping[str, Any]]  # a row a trial

TABLE, SEED, TISSUE = "table.parquet", "seed", "seen.tissue"  # of a study's folder, and its columns
COLUMN = re.compile(r"pair\d+_found")
PARTS = 4  # of the breasts, each tested by the others
BINS = tuple((k / 10, (k + 1) / 10) for k in range(10))
BARS = ((0.4, 0.6), (0.7, 1.0))  # doubtful places, and the best


@dataclass(frozen=True, eq=False)
class Outcomes:
    """Pairs of trials: n masses, each taken one way."""

    features: Features  # (n,) each
    found: Mask  # (n,)
    seed: NDArray[np.int64]  # (n,)
    tissue: NDArray[np.str_]  # (n,)
    uneven_db: Array  # (n,) of the tissue

    def of(self, chosen: Mask) -> "Outcomes":
        """Some of them."""
        rest = (getattr(self, one.name)[chosen] for one in fields(self)[1:])
        return Outcomes(Features(*(one[chosen] for one in self.features)), *rest)


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
                uneven_db = row[name.replace("found", "uneven_db")]
                rows.append((*pair, row[SEED], row.get(TISSUE, "silicone"), uneven_db))
    if not rows:
        raise InputError("trials: expected some with pairs of a mass and a way, found none")
    *features, found, seed, tissue, uneven_db = (np.array(column) for column in zip(*rows, strict=True))
    return Outcomes(Features(*features), found > 0, seed, tissue, uneven_db)


def part_of(seed: NDArray[np.int64]) -> NDArray[np.int64]:
    """Parts of breasts by their seeds, with breasts of every density in each."""
    return seed // len(patient_trial.DENSITIES) % PARTS


def tested(pairs: Outcomes) -> Array:
    """Probability of each pair : (n,), by coefficients fitted to the breasts of other parts.

    Raises
    ------
    InputError
        If these are too few.
    """
    part, chance = part_of(pairs.seed), np.empty(len(pairs.found))
    for one in np.unique(part):
        other = pairs.of(part != one)
        fitted = detectability.fit(other.features, other.found)
        chance[part == one] = detectability.probability(pairs.of(part == one).features, fitted)
    return chance


def report(tables: Iterable[Table]) -> Iterator[str]:
    """Lines: coefficients fitted to even and to grown tissue, and how reliable such are on breasts that they weren't fitted to.

    Raises
    ------
    InputError
        If there is no pair.
    """
    pairs = outcomes(tables)
    grown = np.array([seen_trial.LOOKS.sees(one) for one in pairs.uneven_db])
    for name, used, chosen in (("even", EVEN, ~grown), ("grown", GROWN, grown)):
        if not chosen.any():
            continue
        part = pairs.of(chosen)
        try:
            fitted = detectability.fit(part.features, part.found)
        except InputError as error:
            yield f"not fitted  to {name} tissue: {error}"
            continue
        yield f"fitted      to {part.found.size} pairs in {name} tissue, of which {part.found.sum()} were found"
        for field, value in fitted.coefficients.items():
            yield f"            {field} {value:.3f}, in use {used.coefficients[field]:g}"
        try:
            chance, earlier = tested(part), detectability.probability(part.features, used)
        except InputError as error:
            yield f"not tested  in {name} tissue: {error}"
            continue
        for title in ("all", *np.unique(part.tissue).tolist()):
            here = (part.tissue == title) | (title == "all")
            yield from _tested(title, chance[here], earlier[here], part.found[here])


def shares(chance: Array, found: Mask, ranges: Iterable[tuple[float, float]]) -> Iterator[str]:
    """A line a range of probability that has pairs: their mean probability, the share that was found, and its interval."""
    for low, high in ranges:
        there = (chance >= low) & ((chance < high) | (high == 1))
        if count := int(there.sum()):
            hit = int(found[there].sum())
            interval = binomtest(hit, count).proportion_ci()
            bounds = f"{interval.low:.2f} to {interval.high:.2f}"
            yield f"{low:.2f}-{high:.2f}   {chance[there].mean():.2f} predicted, {hit / count:.2f} found ({bounds}) of {count}"


def _tested(title: str, chance: Array, earlier: Array, found: Mask) -> Iterator[str]:
    """Lines on pairs, by chances that weren't fitted to them and by those of the coefficients in use."""
    brier, before = (float(np.mean((one - found) ** 2)) for one in (chance, earlier))
    yield f"tested      {title}: {found.size} pairs, Brier score {brier:.3f}, of the coefficients in use {before:.3f}"
    yield from (f"            {line}" for line in shares(chance, found, BINS))
    yield from (f"bar         {line}" for line in shares(chance, found, BARS))


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
