"""Coefficients are fitted to breasts of each density and tested on others, by made-up pairs of known chances."""

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from recon.errors import InputError
from recon.segmentation import detectability
from recon.segmentation.detectability import EVEN, Calibration, Features
from twin.experiments import patient_trial, seen_calibration

TRUE = Calibration(-7.0, 2.5, 1.2, -30.0, -1.5)


def table(rng, usual=TRUE, odd=TRUE, tissue="silicone", trials=160, pairs=24, uneven_db=0.8):
    """Trials of masses that differ in all features, found by the chances of one calibration, in the second part of another."""
    rows = []
    for seed in range(trials):
        unseen = np.maximum(rng.normal(0, 0.08, pairs), 0)
        given = Features(rng.normal(2, 1, pairs), rng.normal(1.5, 0.5, pairs), unseen, (rng.random(pairs) < 0.3).astype(float))
        found = rng.random(pairs) < detectability.probability(
            given, odd if seen_calibration.part_of(np.int64(seed)) == 1 else usual
        )
        columns = given._asdict() | {"found": found, "uneven_db": np.full(pairs, uneven_db)}
        row = {f"pair{n:02d}_{name}": float(values[n]) for n in range(pairs) for name, values in columns.items()}
        rows.append({"seen.tissue": tissue, "seed": seed, "pairs": float(pairs), **row, "error": None})
    return rows


def printed(lines):
    """Fitted coefficients, in order, a list a tissue."""
    values = [float(line.split()[1].rstrip(",")) for line in lines if ", in use " in line]
    return [values[n : n + 5] for n in range(0, len(values), 5)]


def test_coefficients_are_those_by_which_masses_were_found(rng):
    """Each within four of its standard errors, by the information of the pairs."""
    rows = table(rng)
    features = seen_calibration.outcomes([rows]).features
    share = detectability.probability(features, TRUE)
    design = np.column_stack([np.ones(len(share)), *features])
    sigma = np.sqrt(np.diag(np.linalg.inv((design * (share * (1 - share))[:, None]).T @ design)))
    (found,) = printed(seen_calibration.report([rows]))
    assert (np.abs(np.subtract(found, TRUE.coefficients)) < 4 * sigma).all()


def test_a_breast_is_tested_by_what_others_say(rng):
    """Where masses of one part are found the less often the more they are said to be, it is told; no part tests itself."""
    pairs = seen_calibration.outcomes([table(rng, odd=Calibration(7.0, -2.5, -1.2, 30.0, 1.5))])
    part, chance = seen_calibration.part_of(pairs.seed), seen_calibration.tested(pairs)
    assert np.corrcoef(chance[part == 1], pairs.found[part == 1])[0, 1] < -0.3
    usual = pairs.of(part != 1)
    assert chance[part == 1] == pytest.approx(
        detectability.probability(pairs.of(part == 1).features, detectability.fit(usual.features, usual.found))
    )


def test_every_part_has_breasts_of_every_density():
    """A patient's density goes by its seed."""
    seed, count = np.arange(32), len(patient_trial.DENSITIES)
    for part in range(seen_calibration.PARTS):
        assert set(seed[seen_calibration.part_of(seed) == part] % count) == set(range(count))


def test_grown_tissue_has_coefficients_of_its_own(rng):
    """There masses are told by their looks; tissue of unknown unevenness counts as even."""
    looks = Calibration(-2.0, 0.5, 1.5, -10.0, 0.0)
    rows = table(rng, looks, looks, "patients", uneven_db=3.4)
    lines = list(seen_calibration.report([table(rng, uneven_db=float("nan")), rows]))
    even, grown = printed(lines)
    assert np.abs(np.subtract(even, TRUE.coefficients))[1:3].max() < 0.6 and np.abs(even[3] - TRUE.unseen) < 6
    assert np.abs(np.subtract(grown, looks.coefficients))[1:3].max() < 0.6 and np.abs(grown[3] - looks.unseen) < 6
    (few,) = seen_calibration.report([[rows[0]]])
    assert few.startswith("not fitted  to grown tissue: trials: expected more than 4")


def test_pairs_that_a_trial_does_not_have_count_as_none(rng):
    """A table has the columns of the trial with most pairs; others have NaN there, and those that failed everywhere."""
    rows = table(rng, trials=4, pairs=3)
    rows[1] |= {name: float("nan") for name in rows[1] if name.startswith("pair02")}
    rows[2] |= {name: float("nan") for name in rows[2] if name.startswith("pair")}
    found = seen_calibration.outcomes([rows, table(rng, tissue="patients", trials=1, pairs=2)])
    assert found.seed.tolist() == [0, 0, 0, 1, 1, 3, 3, 3, 0, 0]
    assert found.tissue.tolist() == ["silicone"] * 8 + ["patients"] * 2
    assert found.features.resolved[4] == rows[1]["pair01_resolved"] and found.found[4] == rows[1]["pair01_found"]
    with pytest.raises(InputError, match="pairs of a mass and a way, found none"):
        seen_calibration.outcomes([[rows[2]]])


def test_shares_have_the_interval_of_clopper_and_pearson():
    """9 of 10 found: 0.555 to 0.997, as tabulated; a chance of 1 lies in the last range, and empty ranges have no line."""
    chance, found = np.array([0.92] * 9 + [1.0, 0.2]), np.array([True] * 9 + [False, False])
    lines = list(seen_calibration.shares(chance, found, seen_calibration.BINS))
    assert lines == [
        "0.20-0.30   0.20 predicted, 0.00 found (0.00 to 0.97) of 1",
        "0.90-1.00   0.93 predicted, 0.90 found (0.55 to 1.00) of 10",
    ]


def test_the_report_tests_each_tissue(rng, tmp_path):
    """As read from studies' folders; fitted coefficients are better than assumed ones where these are wrong."""
    for tissue, trials in (("silicone", 80), ("patients", 40)):
        (tmp_path / tissue).mkdir()
        rows = table(rng, tissue=tissue, trials=trials)
        pq.write_table(pa.Table.from_pylist(rows), tmp_path / tissue / seen_calibration.TABLE)
    tables = [seen_calibration.read(tmp_path / name) for name in ("silicone", "patients")]
    lines = list(seen_calibration.report(tables))
    tested = [line for line in lines if line.startswith("tested")]
    assert [line.split()[1:3] for line in tested] == [["all:", "2880"], ["patients:", "960"], ["silicone:", "1920"]]
    assert all(float(line.split()[-1]) > float(line.split("score ")[1].split(",")[0]) for line in tested)
    assert sum(line.startswith("bar  ") for line in lines) == 6
    assert f"in use {EVEN.unseen:g}" in lines[4]
    with pytest.raises(InputError, match=r"expected the folder of a study with table\.parquet"):
        seen_calibration.read(tmp_path)
