"""Coefficients are fitted to breasts of each density and tested on others, by made-up pairs of known chances."""

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from recon.errors import InputError
from recon.segmentation import detectability
from recon.segmentation.detectability import EVEN, Calibration, Features, Threshold
from twin.experiments import patient_trial, seen_calibration

TRUE = Calibration(3.5, 0.5, Threshold(1.2, 3.0), Threshold(1.0, 4.0), Threshold(0.05, -60.0))


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
    return [values[n : n + 8] for n in range(0, len(values), 8)]


def test_coefficients_are_those_by_which_masses_were_found(rng):
    """Those that are printed are of all pairs, and say what found them."""
    rows = table(rng)
    pairs = seen_calibration.outcomes([rows])
    (found,) = printed(seen_calibration.report([rows]))
    fitted = detectability.fit(pairs.features, pairs.found)
    assert found == pytest.approx(list(fitted.coefficients.values()), abs=6e-4)
    assert np.abs(detectability.probability(pairs.features, fitted) - detectability.probability(pairs.features, TRUE)).max() < 0.1


def test_a_breast_is_tested_by_what_others_say(rng):
    """No part tests itself, though masses of one are found by other rules."""
    pairs = seen_calibration.outcomes(
        [table(rng, odd=Calibration(2.0, 0.5, Threshold(1.2, -3.0), Threshold(1.0, -4.0), Threshold(0.0, 20.0)))]
    )
    part, chance = seen_calibration.part_of(pairs.seed), seen_calibration.tested(pairs)
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
    looks = Calibration(0.5, 0.5, Threshold(2.0, 3.0), Threshold(1.4, 4.0), Threshold(0.05, -60.0))
    rows = table(rng, looks, looks, "patients", uneven_db=3.4)
    lines = list(seen_calibration.report([table(rng, uneven_db=float("nan")), rows]))
    for found, true in zip(printed(lines), (TRUE, looks), strict=True):
        assert found[2] == pytest.approx(true.detectability.middle, abs=0.25)
        assert found[4] == pytest.approx(true.resolved.middle, abs=0.25) and found[6] == pytest.approx(
            true.unseen.middle, abs=0.02
        )
    *_, few = seen_calibration.report([[rows[0]]])
    assert few.startswith("not tested  in grown tissue: trials: expected more than 8")


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
    assert lines[1].endswith(f"in use {EVEN.dark:g}")
    with pytest.raises(InputError, match=r"expected the folder of a study with table\.parquet"):
        seen_calibration.read(tmp_path)
