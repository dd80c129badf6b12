"""Several calibrations of one probe by `sonotwin calibrate-probe runs=`, from captures, pairs and results of before."""

import contextlib
import csv
import io
import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from recon.capture import manifest, probe_files, sweep_tables
from recon.errors import InputError
from recon.geometry import rigid
from recon.model.probe import NAMES
from recon.probe_calibration import point_calibration, repeatability
from recon.session import probe_runs_step
from recon.session.probe_step import Settings
from sonotwin import choices
from sonotwin.cli import main
from tests.recon import bscans, probe_motions, sweep_sets

POINTS = repeatability.five_points(bscans.SIZE)


def calibrate(*fields: str) -> list[str]:
    """Lines that were said."""
    with contextlib.redirect_stdout(io.StringIO()) as said:
        assert main(["calibrate-probe", *fields]) == 0
    return said.getvalue().splitlines()


def complaint(capsys, *fields: str) -> str:
    assert main(["calibrate-probe", *fields]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    return line.removeprefix("sonotwin: ")


def listed(paths) -> str:
    return f"runs=[{','.join(map(str, paths))}]"


def pairs_of(probe, path: Path, seed: int) -> Path:
    seen = probe_motions.observe(probe, *point_calibration.motion(bscans.SIZE), np.random.default_rng([5, seed]))
    table = np.column_stack([seen.poses[:, :3].reshape(-1, 12), seen.pixels])
    sweep_tables.write_rows(path, sweep_tables.PAIRS, table.tolist())
    return path


@pytest.fixture(scope="module")
def pairs(rig, tmp_path_factory) -> list[Path]:
    """Of five runs, the probe as it is in water."""
    folder, probe = tmp_path_factory.mktemp("pairs"), sweep_sets.probe_in_water(rig)
    return [pairs_of(probe, folder / f"run{seed}.csv", seed) for seed in range(5)]


@pytest.fixture(scope="module")
def singles(pairs) -> list[Path]:
    """The same, calibrated one by one."""
    folders = [path.with_suffix("") for path in pairs]
    for path, folder in zip(pairs, folders, strict=True):
        calibrate(f"pairs={path}", f"out={folder}")
    return folders


def table_of(out: Path) -> list[dict[str, str]]:
    with (out / "runs.csv").open(newline="") as stream:
        return list(csv.DictReader(stream))


def test_five_runs_have_a_repeatability_and_a_mean(pairs, singles, rig, tmp_path):
    """The mean is nearer to the truth than most runs, by as much as it says; figures are those of the single results."""
    out = tmp_path / "out"
    lines = calibrate(listed(pairs), f"out={out}")
    assert sorted(path.name for path in out.iterdir()) == [
        *(".sonotwin.json", "US_params.npz", "frames.csv", "metrics.json", "probe.yaml", "runs.csv")
    ]
    figures, true = json.loads((out / "metrics.json").read_text()), sweep_sets.probe_in_water(rig)
    by_one = [probe_files.read(folder / "probe.yaml") for folder in singles]
    for name, measure in (("cr1", repeatability.cr1), ("cr2", repeatability.cr2)):
        for place, value in repeatability.at_places(measure(by_one, POINTS)).items():
            assert figures[f"{name}_{place}_mm"] == pytest.approx(value, abs=1e-6)
    assert 0.4 < figures["cr1_mean_mm"] / figures["cr1_mean_expected_mm"] < 1.6
    assert figures["chi_square_chance"] > 1e-3 and any(line.startswith("agree ") for line in lines)
    mean = probe_files.read(out / "probe.yaml")
    sigma = np.sqrt(np.trace(point_calibration.point_covariance(mean, POINTS), axis1=1, axis2=2))
    away = np.linalg.norm(mean.to_target(POINTS) - true.to_target(POINTS), axis=1)
    assert (away < 3 * sigma).all() and figures["sigma_centre_mm"] == pytest.approx(sigma[0])
    single = np.sqrt(np.trace(point_calibration.point_covariance(by_one[0], POINTS), axis1=1, axis2=2))
    assert (sigma < 0.9 * single).all()
    rows = table_of(out)
    assert [row["source"] for row in rows] == [str(path) for path in pairs]
    held_out, noise = (np.array([float(row[name]) for row in rows]) for name in ("held_out_mm", "noise_mm"))
    assert (held_out > 0.9 * noise).all() and (held_out < 1.3 * noise).all()
    assert figures["held_out_mm"] == pytest.approx(np.sqrt(np.mean(held_out**2)), abs=1e-3)


def test_results_of_before_serve_as_their_captures_do(pairs, singles, tmp_path):
    """Files or folders, but without frames there is nothing to hold out."""
    calibrate(listed(pairs), f"out={tmp_path / 'pairs'}")
    calibrate(listed([singles[0], *(folder / "probe.yaml" for folder in singles[1:])]), f"out={tmp_path / 'files'}")
    first, second = (probe_files.read(tmp_path / name / "probe.yaml") for name in ("pairs", "files"))
    np.testing.assert_allclose(first.to_target(POINTS), second.to_target(POINTS), atol=1e-6)
    np.testing.assert_allclose(first.uncertainty.covariance, second.uncertainty.covariance, atol=1e-8)
    assert [row["held_out_mm"] for row in table_of(tmp_path / "files")] == [""] * 5
    calibrate(listed([pairs[0], *singles[1:]]), f"out={tmp_path / 'both'}")
    mixed = [row["held_out_mm"] for row in table_of(tmp_path / "both")]
    assert mixed == [table_of(tmp_path / "pairs")[0]["held_out_mm"], *4 * [""]]


def test_the_thermometers_error_does_not_average_out(pairs, tmp_path):
    """2.9 m/s of 1488 are 0.195 % of sy, in five runs as in one."""
    out, colder = tmp_path / "out", tmp_path / "colder"
    calibrate(listed(pairs), f"out={out}", "temperature_c=22")
    calibrate(listed(pairs), f"out={colder}", "temperature_c=22", "temperature_sigma_c=0")
    found, sure = (probe_files.read(folder / "probe.yaml") for folder in (out, colder))
    share = np.sqrt(found.uncertainty.sigma("sy") ** 2 - sure.uncertainty.sigma("sy") ** 2)
    assert share / found.scale[1] == pytest.approx(2.908 / 1488.4, rel=1e-3)
    assert found.speed_m_s == 1540.0
    chances = [json.loads((folder / "metrics.json").read_text())["chi_square_chance"] for folder in (out, colder)]
    assert chances[0] == pytest.approx(chances[1], rel=1e-3), "it moves all runs alike"
    assert [row["held_out_mm"] for row in table_of(out)] == [row["held_out_mm"] for row in table_of(colder)]


def test_a_bracket_that_was_put_on_anew_is_said(rig, pairs, tmp_path):
    """By half a millimetre: the runs scatter more than they claim, and its crossing misses the others' calibration by as much."""
    probe = sweep_sets.probe_in_water(rig)
    moved = replace(probe, target_from_image=rigid.transform(np.eye(3), [0.5, 0, 0]) @ probe.target_from_image)
    off = pairs_of(moved, tmp_path / "off.csv", 9)
    lines = calibrate(listed([*pairs[:4], off]), f"out={tmp_path / 'out'}")
    (said,) = (line for line in lines if line.startswith("warning"))
    assert "scatter more than their covariances predict" in said and "bracket" in said
    rows = table_of(tmp_path / "out")
    assert min(float(row["chance"]) for row in rows[:4]) > float(rows[4]["chance"]) < 1e-3
    assert float(rows[4]["held_out_mm"]) == max(float(row["held_out_mm"]) for row in rows)
    assert float(rows[4]["held_out_mm"]) ** 2 - float(rows[4]["noise_mm"]) ** 2 == pytest.approx(0.25, rel=0.4)
    calibrate(listed(pairs), f"out={tmp_path / 'alike'}")
    wide, narrow = (probe_files.read(tmp_path / name / "probe.yaml").uncertainty.sigma("tx") for name in ("out", "alike"))
    assert wide > 1.5 * narrow


def test_all_sweeps_for_the_probe_of_one_capture_are_runs(rig, tmp_path):
    """Two films of wires in one capture, beside a sweep for something else; B-scans of five pixels' crossing are looked at."""
    capture, names = tmp_path / "capture", ("wires_1", "bottom", "wires_2")
    for seed, name in enumerate(("wires_1", "wires_2")):
        part = sweep_sets.wires(tmp_path / name, rig, np.random.default_rng(seed))
        shutil.copytree(part / "sweep", capture / "sweep" / name)
        content = json.loads((part / "manifest.json").read_text())
    shutil.copytree(capture / "sweep" / "wires_1", capture / "sweep" / "bottom")
    (single,) = [content.pop("sweep")]
    content["sweeps"] = {
        name: {
            **single,
            "purpose": "latency" if name == "bottom" else "probe",
            "images": {"us": f"sweep/{name}/us"},
            "track": f"sweep/{name}/track.csv",
        }
        for name in names
    }
    (capture / "manifest.json").write_text(json.dumps(content))
    manifest.read_manifest(capture)
    calibrate(listed([capture]), f"out={tmp_path / 'out'}")
    rows = table_of(tmp_path / "out")
    assert [row["source"] for row in rows] == [f"{capture} wires_1", f"{capture} wires_2"]
    assert [row["frames"] for row in rows] == ["30", "30"]
    with (tmp_path / "out" / "frames.csv").open(newline="") as stream:
        assert [row["run"] for row in csv.DictReader(stream)] == ["1"] * 30 + ["2"] * 30


def test_plain_matrices_have_a_repeatability_too(singles, tmp_path):
    """Of the rig authors' files, which have no covariance: CR1 and CR2 are the same, the mean's covariance is the scatter's."""
    calibrate(listed(folder / "US_params.npz" for folder in singles), f"out={tmp_path / 'plain'}")
    calibrate(listed(singles), f"out={tmp_path / 'own'}")
    plain, own = (json.loads((tmp_path / name / "metrics.json").read_text()) for name in ("plain", "own"))
    assert plain["cr1_mean_mm"] == pytest.approx(own["cr1_mean_mm"], abs=1e-6)
    assert plain["chi_square"] is None and plain["cr1_mean_expected_mm"] is None
    assert probe_files.read(tmp_path / "plain" / "probe.yaml").uncertainty.sigma("tx") > 0


def test_what_is_wrong_with_runs_is_said_in_one_line(pairs, singles, rig, tmp_path, capsys):
    out = tmp_path / "out"
    fields = [f"out={out}"]
    one = complaint(capsys, listed(pairs[:1]), *fields)
    assert one.startswith("runs: expected two or more of one probe, found 1") and one.endswith("one calibrates by capture=")
    assert complaint(capsys, listed([pairs[0], pairs[0]]), *fields).startswith("runs: expected each once, found ")
    assert "twice: its repeatability would be 0" in complaint(capsys, listed([singles[0], singles[0] / "probe.yaml"]), *fields)
    copied = shutil.copy(pairs[0], tmp_path / "copied.csv")
    found = complaint(capsys, listed([*pairs[:2], copied]), *fields)
    assert found.startswith(f"{copied}: expected another run, found the same as {pairs[0]}")
    assert complaint(capsys, listed(pairs), "sweep=wires", *fields).startswith("calibrate-probe: sweep: expected none with runs")
    assert "one of capture, sequence, pairs and runs, found pairs and runs" in complaint(
        capsys, listed(pairs), f"pairs={pairs[0]}", *fields
    )
    assert complaint(capsys, listed([pairs[0], tmp_path / "none.csv"]), *fields).endswith("expected a file, found none")
    (tmp_path / "loop").symlink_to("loop")
    assert complaint(capsys, listed([pairs[0], tmp_path / "loop"]), *fields).endswith("found too many levels of symbolic links")
    assert "found neither manifest.json nor probe.yaml" in complaint(capsys, listed([pairs[0], tmp_path]), *fields)
    assert "found a sequence: calibrate by each" in complaint(capsys, listed([pairs[0], "a.igs.mha"]), *fields)
    deeper = replace(probe_files.read(singles[0] / "probe.yaml"), scale=np.array([0.1229, 0.15]))
    probe_files.write(tmp_path / "deeper.yaml", deeper)
    found = complaint(capsys, listed([singles[1], tmp_path / "deeper.yaml"]), *fields)
    assert "deeper.yaml: scale: expected some 0.12" in found and "another depth setting or scanner?" in found
    calibrate(f"pairs={pairs[0]}", "temperature_c=22", f"out={tmp_path / 'tissue'}")
    found = complaint(capsys, listed([singles[1], tmp_path / "tissue"]), *fields)
    assert "speed_m_s: expected some 14" in found and "calibrate all with temperature_c, or all without" in found
    known = probe_files.read(singles[0] / "probe.yaml")
    turned = repeatability.after(known, np.pi / 4 * (np.arange(8) == NAMES.index("rx")))
    probe_files.write(tmp_path / "turned.yaml", turned)
    found = complaint(capsys, listed([singles[1], tmp_path / "turned.yaml"]), *fields)
    assert "45 deg and" in found and "another probe, bracket or target?" in found
    assert "apart from what is read" in complaint(capsys, listed(singles), f"out={singles[0]}")
    assert not out.exists()


def test_runs_of_other_image_sizes_are_none_of_one_scanner(rig, pairs, tmp_path, capsys):
    """Captures have their own sizes; a capture of other B-scans is refused beside them."""
    capture = sweep_sets.wires(tmp_path / "capture", rig, np.random.default_rng(1))
    found = complaint(
        capsys, listed([pairs[0], capture]), "rig.probe.image_size=[400,500]", "temperature_c=22", f"out={tmp_path / 'o'}"
    )
    assert found == f"{capture}: expected B-scans of 400x500 px as before, found 321x408"


def test_runs_of_another_phantom_are_compared_by_their_results(tmp_path):
    """Wires in rows show no one point: their captures are refused, their results are not."""
    (tmp_path / "pairs.csv").write_text("x", encoding="utf-8")
    runs = tmp_path / "pairs.csv", tmp_path / "probe.yaml"
    settings = Settings(rig=choices.read_rig(), runs=runs, phantom="n_wires", wires=tmp_path / "w.xml")
    with pytest.raises(InputError, match=r"runs: expected results of before, as n_wires.*pairs\.csv"):
        list(probe_runs_step.read_runs(settings, settings.rig.probe))
