"""`sonotwin study`: studies of conf/study can be planned, a sweep runs from end to end, mistakes are refused beforehand."""

import inspect
import json
import os
import re
import shlex
import signal
import subprocess
import sys
from html import unescape
from time import sleep
from types import SimpleNamespace

import numba
import pyarrow.parquet as pq
import pytest

from recon.errors import InputError
from sonotwin import choices, study_plan, study_steps
from sonotwin.cli import main
from sonotwin.config import folder, load
from sonotwin.verbs.study import Config
from tests.patience import PATIENCE_S
from tests.twin.studies.made_up import done
from twin.conditions import Conditions
from twin.experiments import experiment_runs, surface_trial
from twin.experiments.drawn_session import Drawn
from twin.studies import beside_paper, error_budget, factors, rig_search

STUDIES = sorted(path.stem for path in (folder() / "study").glob("*.yaml"))
SMALL = ["of=chain", "poses=demo", "poses.count=8", "noise.wires=12", "noise.scans=8"]


def loaded(tmp_path, *fields: str) -> Config:
    return load("study", [f"out={tmp_path / 'out'}", *fields], Config)


def planned(config: Config) -> list[factors.Point]:
    """Points of a study, as far as they are known beforehand."""
    read = factors.read(config.over)
    if config.budget is not None:
        return list(error_budget.points(config.budget, config.settings.model_dump(mode="json")).values())
    points = factors.factorial(read)
    if config.search is None:
        return points
    ends = [points[0], points[-1], config.search.start]
    return [point | some for point in ends for some in rig_search.conditions(config.search)]


@pytest.mark.parametrize("name", STUDIES)
def test_each_study_can_be_planned(name, tmp_path):
    """All fields are the experiment's, all values pass its settings; each figure that is shown has a name."""
    config = loaded(tmp_path, f"name={name}")
    points = planned(config)
    trials = study_plan.trials(config.of, config.settings, points, study_steps.seeds(config))
    assert len(trials) == len(points) * config.seeds and len({trial.key for trial in trials}) == len(trials)
    if config.search is not None:
        rig_search.check(config.search.model_copy(update={"by": "tpe"}), factors.read(config.over))
    assert config.title and not (tmp_path / "out").exists()


@pytest.mark.parametrize("name", STUDIES)
def test_each_study_says_what_it_is_for(name):
    text = (folder() / "study" / f"{name}.yaml").read_text(encoding="utf-8")
    assert text.startswith(f"# conf/study/{name}.yaml: ")


def test_the_budget_names_its_sources_alike(tmp_path):
    """Each source is some under the study's conditions, and is in one place; none of the chain's drawn errors is forgotten."""
    config = loaded(tmp_path, "name=budget")
    sources = config.budget.sources
    listed = [field for fields in sources.values() for field in fields]
    assert len(listed) == len(set(listed)) and {f"noise.drawn.{name}" for name in Drawn.model_fields} <= set(listed)
    settings = config.settings.model_dump(mode="json")
    assert all(factors.value_at(settings, field) > 0 for fields in sources.values() for field in fields)
    assert set(config.budget.figures) == set(experiment_runs.experiment(config.of).limits)


def test_what_is_given_goes_before_what_the_study_says(tmp_path):
    """Seeds, and fields that the study sets."""
    config = loaded(tmp_path, "name=budget", "seeds=2", "conditions=ideal", "noise.scans=12", "title=Mine")
    assert (config.seeds, config.title, config.of) == (2, "Mine", "chain")
    assert config.settings.conditions == type(config.settings.conditions)() and config.settings.noise.scans == 12
    assert loaded(tmp_path, "name=budget").title == "Error budget"
    assert loaded(tmp_path, "name=budget").settings.conditions.board.bow_mm > 0
    assert loaded(tmp_path, "name=better_rig").settings.shooting.exposure_s == 0.004
    assert loaded(tmp_path, "name=better_rig", "shooting.exposure_s=0.008").settings.shooting.exposure_s == 0.008


@pytest.mark.parametrize(
    ("name", "count"), [("planes", 1), ("sphere", 2), ("optics", 3), ("probe", 7), ("cylinders", 3), ("breast", 3)]
)
def test_the_papers_figures_come_with_their_study(name, count, tmp_path):
    """Unless others are given, or none."""
    config = load("study", [f"name={name}", "out=x"], Config)
    assert len(config.beside) == count and all(figure.paper and figure.ours for figure in config.beside)
    assert load("study", [f"name={name}", "out=x", "beside=[]"], Config).beside == ()
    assert load("study", ["name=phase_steps", "out=x"], Config).beside == ()


def test_the_papers_document_has_the_tables_of_its_studies():
    """Columns, figures and what the paper reports: the numbers of trials are of the last measurement."""
    text = (folder().parent / "docs" / "paper.md").read_text(encoding="utf-8")
    for name in ("planes", "sphere", "optics", "probe", "cylinders", "breast", "ultrasound_causes"):
        config = load("study", [f"name={name}", "out=x"], Config)
        lost = [done({"conditions": point}, "not measured") for point in config.over["conditions"]]
        rows = re.search(rf"<!-- {name} -->.*?\n(\|.*?)\n\n<!-- /{name} -->", text, flags=re.DOTALL)[1].splitlines()
        planned = beside_paper.markdown(beside_paper.compare(config.beside, lost)).splitlines()
        assert rows[:2] == planned[:2]
        assert [row.split("|")[1:4] for row in rows] == [row.split("|")[1:4] for row in planned]


def test_the_columns_of_surfaces_are_explained():
    """All figures of a trial, by their names in its source; those of sessions are compared where one is run."""
    glossary = (folder().parent / "docs" / "studies.md").read_text(encoding="utf-8")
    figures = re.findall(r'^ +"(\w+)": ', inspect.getsource(surface_trial.measure), flags=re.MULTILINE)
    assert len(figures) > 10 and not [name for name in figures if f"`{name}`" not in glossary]


def test_a_studys_name_may_be_a_number(tmp_path, monkeypatch):
    (tmp_path / "study").mkdir()
    (tmp_path / "study" / "7.yaml").write_text("title: Seventh\nof: surface\nover: {}\n")
    monkeypatch.setattr(choices, "config", SimpleNamespace(folder=lambda: tmp_path))
    config = load("study", ["name=7", "out=x"], Config)
    assert (config.name, config.title) == ("7", "Seventh")


def test_a_study_of_ones_own_is_a_file(tmp_path):
    own = tmp_path / "own.yaml"
    own.write_text("title: Own\nof: surface\nover: {patterns.parts.fringes.steps: [4, 8]}\nfields: [patterns=gray_surface]\n")
    config = loaded(tmp_path, f"name={own}")
    assert config.settings.patterns.unwrap == "gray" and len(planned(config)) == 2


OURS = ["name=sweep", *SMALL]
SURFACE = ["name=sweep", "of=surface"]
SWEEP = "over={noise.speed_mm_s: [5, 10]}"


@pytest.mark.parametrize(
    ("fields", "complaint"),
    [
        (
            [*SURFACE, "over={shooting.gain: [1, 2]}", "patterns=gray_alone"],
            "settings.patterns: expected fringes along columns, which closed forms are of, found none",
        ),
        (["name=exposur"], "name: expected one of acceptance, better_rig, "),
        (["name=7"], "name: expected one of acceptance, better_rig, "),
        (["name=sweep", SWEEP], "of: needs a value with name=sweep; give of=..."),
        (["name=sweep", "of=chain"], "over: needs a value with name=sweep; give over=..."),
        (["name=sweep", "of=chains", SWEEP], "of: expected one of surface, calibration, tracking, laboratory, chain,"),
        (["of=chain", SWEEP], "name: needs a value; give name=..."),
        ([*OURS, "over={noise.sped_mm_s: [5]}"], "over: noise.sped_mm_s: unknown key sped_mm_s; expected one of board_px, "),
        ([*OURS, "over={shooting.gain: [1]}"], "over: shooting.gain: expected a field that of=chain reads,"),
        ([*OURS, "over={noise.speed_mm_s: [5, -1]}"], "over: noise.speed_mm_s=-1: noise.speed_mm_s: expected"),
        ([*OURS, "over={noise.speed_mm_s: 5}"], "over: noise.speed_mm_s: expected a list, {from, to,"),
        ([*OURS, "over={noise.speed_mm_s: {normal: [5, 1]}}"], "over: noise.speed_mm_s: a distribution needs points=N"),
        ([*OURS, "over={}"], "over: expected a field with its values, as in over='{shooting.exposure_s: [0.004, 0.008]}', found"),
        ([*OURS, "over={}", "points=8"], "over: expected a field with its values, as in"),
        (["name=better_rig", "over={}"], "over: expected a field with its values, as in"),
        ([*OURS, "over={conditions.skin.wet: [0, 1]}"], "over: conditions.skin.wet: expected a field that of=chain reads,"),
        ([*OURS, SWEEP, "document=nowhere.md"], "nowhere.md: expected a Markdown file, found none"),
        ([*OURS, "over=5"], "over: expected dictionary, found 5"),
        ([*OURS, "over={conditions: [lifelik]}"], "over: conditions: expected one of ideal, lifelike, or a YAML file, found"),
        ([*OURS, SWEEP, "seeds=0"], "seeds: expected greater than or equal to 1, found 0"),
        ([*OURS, SWEEP, "fill=halton"], "fill: expected 'sobol' or 'latin', found 'halton'"),
        ([*OURS, SWEEP, "sead=3"], "; did you mean seeds?"),
        (
            [*OURS, SWEEP, "rig.cam1.sensor.dark=3"],
            "rig.cam1.sensor.dark: unknown key; expected one of pixel_um, quantum_efficiency, saturation_e, dark_noise_e,",
        ),
        ([*OURS, SWEEP, "rig.cam1.sensor.dark=3"], "; did you mean rig.cam1.sensor.dark_noise_e?"),
        ([*OURS, "over={noise.speed_mm_s: [5}"], "over: expected balanced brackets and quotes, found {noise.speed_mm_s: [5}"),
        ([*OURS, SWEEP, "rig=/home/me/mine.yaml"], "three_bodies, or a YAML file, found none at /home/me/mine.yaml; begin"),
        ([*OURS, SWEEP, "poses.count=0"], "poses.count: expected greater than or equal to 1, found 0"),
        ([*OURS, SWEEP, "search={runs: 3}"], "search.least: needs a value"),
        (
            [*OURS, SWEEP, "search={least: pixel_rms_mm, by: tpe, start: {noise.speed_mm_s: 7}}"],
            "search: start.noise.speed_mm_s: expected one of [5, 10], found 7",
        ),
        (
            [*OURS, "over={}", "budget={figures: {pixel_rms_mm: x}, sources: {a: [noise.drawn.colum]}}"],
            "bracket_at_wires, bracket_in_scan; did you mean column?",
        ),
        (
            [*OURS, "over={}", "noise.drawn.column=0", "budget={figures: {pixel_rms_mm: x}, sources: {a: [noise.drawn.column]}}"],
            "budget: sources: noise.drawn.column: expected the size of an error, above zero, found 0",
        ),
        (
            [*OURS, SWEEP, "search={least: pixel_rms_mm, by: tpe, bounds: {price: {most: 3}}}"],
            "search: price: expected prices with it, found none",
        ),
    ],
)  # fmt: skip
def test_nonsense_is_refused_by_name(fields, complaint, tmp_path, capsys):
    """One line, exit status 2, nothing written."""
    assert main(["study", f"out={tmp_path / 'out'}", *fields]) == 2
    message = capsys.readouterr().err
    assert complaint in message and message.count("\n") == 1 and message.startswith("sonotwin: ")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("content", "complaint"),
    [
        ("over: [1", "own.yaml: expected YAML, found"),
        ("title: Own\nof: surface\nover: {}\nseedz: 4\n", "own.yaml: seedz: expected no such field, found 4"),
        ("of: surface\nover: {}\n", "own.yaml: title: expected a value, found none"),
    ],
)
def test_a_wrong_file_is_refused_with_its_name(content, complaint, tmp_path, capsys):
    (tmp_path / "own.yaml").write_text(content)
    assert main(["study", f"name={tmp_path / 'own.yaml'}", f"out={tmp_path / 'out'}"]) == 2
    message = capsys.readouterr().err
    assert complaint in message and message.count("\n") == 1 and not (tmp_path / "out").exists()


def test_a_place_that_is_taken_is_refused_before_any_trial(tmp_path, capsys):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "thesis.tex").write_text("years of work")
    assert main(["study", "name=sweep", f"out={tmp_path / 'out'}", *SMALL, SWEEP]) == 2
    assert "expected a new or empty folder, or one that study wrote" in capsys.readouterr().err
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["thesis.tex"]
    (tmp_path / "out" / "study.json").write_text("{")
    assert main(["study", "name=sweep", f"out={tmp_path / 'out'}", *SMALL, SWEEP]) == 2
    message = capsys.readouterr().err
    assert "found other files, such as study.json" in message and message.count("\n") == 1
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["study.json", "thesis.tex"]
    assert (tmp_path / "out" / "study.json").read_text() == "{"


def test_a_choice_of_a_group_is_a_value(tmp_path):
    """Conditions, patterns and rigs by their names; fields beside them vary too, where they come later."""
    config = loaded(tmp_path, "name=sweep", *SMALL, "over={conditions: [ideal, lifelike], poses: [demo, paper]}")
    trials = study_plan.trials("chain", config.settings, planned(config), [0])
    bow, count = (
        [each(trial.settings) for trial in trials] for each in (lambda s: s.conditions.board.bow_mm, lambda s: s.poses.count)
    )
    assert bow == [0, 0, 0.1, 0.1] and count == [10, 34, 10, 34]
    shown = loaded(tmp_path, "name=sweep", "of=surface", "over={patterns: [gray_surface, paper_surface]}")
    first, second = study_plan.trials("surface", shown.settings, planned(shown), [0])
    assert (first.settings.patterns.unwrap, second.settings.patterns.unwrap) == ("gray", "centre_line")


@pytest.mark.parametrize(
    "fields",
    [
        [*SURFACE, "over={shooting.exposure_s: [0.004, 0.0105]}", "seeds=7"],
        [*SURFACE, "over={patterns.parts.fringes.pitch: [6, 9], layout.projector_mm: [null, 100]}"],
        [*SURFACE, "over={shooting.exposure_s: {from: 0.001, to: 1.6e-2, count: 5, log: true}}", "points=64", "fill=latin"],
        [*SURFACE, "over={rig.cam1.sensor.prnu+rig.cam2.sensor.prnu: [0.0, 0.01]}"],
        [*SURFACE, "over={conditions: [ideal, lifelike]}", "title='Light & \\'lamp\\''"],
        ["name=sweep", "of=chain", "over={noise.drawn: [{board: 0.0}, {column: 2.0}]}", "conditions=lifelike", "noise.scans=8"],
        [
            *SURFACE,
            "over={shooting.bits: [8, 10]}",
            "patterns=gray_surface",
            "shooting.gain=2",
            "first_seed=3",
            "engine=dask",
            "trials=my kept trials",
        ],
        ["name=budget", "budget={step: 3.0}", "poses.count=8"],
        ["name=better_rig", "search={by: tpe, runs: 7}", "~plane"],
    ],
    ids=["numbers", "null", "range", "joined", "words", "maps", "settings", "budget", "search"],
)
def test_the_command_on_the_page_is_the_same_study(fields, tmp_path):
    """All that is given, as a shell splits it and Hydra reads it."""
    config = load("study", [f"out={tmp_path / 'my out'}", *fields], Config)
    program, verb, *again = shlex.split(study_steps.command(config))
    assert (program, verb, again) == ("sonotwin", "study", [f"out={tmp_path / 'my out'}", *fields])
    assert load("study", again, Config) == config and config.out == tmp_path / "my out"


def test_a_sweep_from_end_to_end(tmp_path, capsys):
    """Two conditions, two seeds, the second added later: a table, a page and figures; again, nothing is measured anew."""
    out = tmp_path / "my out"
    figure = "beside=[{what: pixels, reported: [0.1, 0.2], ours: pixel_rms_mm, unit: mm}]"
    (tmp_path / "paper.md").write_text("Ours:\n\n<!-- sweep -->\n<!-- /sweep -->\n")
    fields = ["study", "name=sweep", f"out={out}", *SMALL, "over={conditions: [ideal, lifelike]}", "title=Two conditions", figure]
    assert main([*fields, "seeds=1", "noise.scans=8"]) == 0
    assert "study       chain over conditions: 2 trials, 0 of them there already" in capsys.readouterr().out
    assert main([*fields, "seeds=2", f"document={tmp_path / 'paper.md'}"]) == 0
    said = capsys.readouterr().out
    assert "lifelike    pixels: reported 0.1 to 0.2, its method , ours" in said
    assert "| lifelike | pixels | 0.1 to 0.2 |" in (tmp_path / "paper.md").read_text(encoding="utf-8")
    assert re.search(r"figure      mass_to_skin_mm [\d.]+ to [\d.]+\n", said)
    assert re.search(r"figure      pixel_rms_mm .* to .*, predicted by the software's covariances .* to .*\n", said)
    assert "study       chain over conditions: 4 trials, 2 of them there already" in said and "wrong" not in said
    rows = pq.read_table(out / "table.parquet").to_pylist()
    assert [(row["conditions"], row["seed"]) for row in rows] == [("ideal", 0), ("ideal", 1), ("lifelike", 0), ("lifelike", 1)]
    assert max(row["pixel_rms_mm"] for row in rows[:2]) < min(row["pixel_rms_mm"] for row in rows[2:])
    glossary = (folder().parent / "docs" / "studies.md").read_text(encoding="utf-8")
    assert not [name for name in rows[0] if f"`{name}`" not in glossary and name not in ("conditions", "seed", "error")]
    predicted = loaded(tmp_path, "name=budget").budget.predicted
    assert {name for known in predicted.values() for name in known.values()} <= set(rows[0])
    description = json.loads((out / "study.json").read_text())
    assert (description["of"], description["settings"]["poses"]["count"]) == ("chain", 8)
    page = (out / "report.html").read_text(encoding="utf-8")
    assert "<h1>Two conditions</h1>" in page and "Beside the paper" in page and "4 of 4 trials gave figures." in page
    (commands,) = re.findall("<pre>(.*?)</pre>", page, flags=re.S)
    assert f"'out={out}'" in unescape(commands) and shlex.split(unescape(commands).splitlines()[0])[1:] == [
        *fields,
        "seeds=2",
        f"document={tmp_path / 'paper.md'}",
    ]
    assert (out / "figures" / "surface_rms_mm_over_conditions.png").is_file()
    table = (out / "table.parquet").read_bytes()
    assert main([*fields, "seeds=2"]) == 0
    assert "4 trials, 4 of them there already" in capsys.readouterr().out and (out / "table.parquet").read_bytes() == table


COMMAND = [sys.executable, "-m", "sonotwin", "study"]


@pytest.mark.slow
def test_tables_are_the_same_bytes_from_any_number_of_threads(tmp_path):
    """Of drawn sessions, whose calibrations make much of a last bit: in this process by one thread, in another one by several."""
    fields = ["name=sweep", *SMALL, "over={noise.speed_mm_s: [10]}", "seeds=1"]
    several = dict.fromkeys(("NUMBA_NUM_THREADS", "SONOTWIN_THREADS", "OMP_NUM_THREADS"), "3")
    kept = {name: value for name, value in os.environ.items() if name != "OPENBLAS_NUM_THREADS"}  # left to the command
    subprocess.run([*COMMAND, *fields, f"out={tmp_path / 'several'}"], env=kept | several, check=True, capture_output=True)
    before = numba.get_num_threads()
    numba.set_num_threads(1)
    try:
        assert main(["study", *fields, f"out={tmp_path / 'one'}"]) == 0
    finally:
        numba.set_num_threads(before)
    one, other = ((tmp_path / name / "table.parquet").read_bytes() for name in ("one", "several"))
    assert one == other


@pytest.mark.slow
def test_a_virtual_trial_goes_on(tmp_path, capsys):
    """A patient in one arm, then one in another."""
    fields = ["study", "name=trial", "noise.wires=20", "noise.scans=12", "seeds=1", f"out={tmp_path / 'trial'}"]
    assert main([*fields, "over={biopsy.training: [novice]}"]) == 0
    assert "share       all: within 1 mm " in capsys.readouterr().out
    assert (tmp_path / "trial/figures/shares.png").exists()
    assert main([*fields, "over={biopsy.training: [novice, trained]}"]) == 0
    assert "2 trials, 1 of them there already" in capsys.readouterr().out


@pytest.mark.slow
def test_a_key_press_that_reaches_dasks_workers_is_told_in_one_line(tmp_path):
    """Ctrl-C in a terminal goes to all processes of the group."""
    pytest.importorskip("distributed")
    fields = ["name=sweep", *SMALL, "over={noise.board_px: [0.004, 0.008]}", "seeds=50", "engine=dask", "engine.workers=2"]
    with subprocess.Popen(
        [*COMMAND, *fields, f"out={tmp_path / 'out'}"],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True,
    ) as running:  # fmt: skip
        try:
            while not list((tmp_path / "out").glob("**/trials/*.json")) and running.poll() is None:
                sleep(0.2)
            os.killpg(running.pid, signal.SIGINT)
            _, said = running.communicate(timeout=PATIENCE_S)
        finally:
            if running.poll() is None:
                os.killpg(running.pid, signal.SIGKILL)
    assert (running.returncode, said) == (130, "sonotwin: interrupted\n")


@pytest.mark.slow
def test_a_study_without_any_figures_fails(tmp_path, capsys):
    """Exit status 1, and the reason: a scan so fast that no pair of frames shows one target."""
    fields = ["over={noise.speed_mm_s: [20000]}", "seeds=1", "conditions.motion.trigger_s=0.01"]
    assert main(["study", "name=sweep", f"out={tmp_path / 'out'}", *SMALL, *fields]) == 1
    assert "no figures  noise.speed_mm_s=20000, seed=0: target: expected to be seen in all 8 poses" in capsys.readouterr().out
    assert "0 of 1 trials gave figures." in (tmp_path / "out" / "report.html").read_text(encoding="utf-8")


@pytest.mark.slow
def test_a_budget_and_a_search_from_end_to_end(tmp_path, capsys):
    """Of one source and of four speeds: each says its result; the page has its section."""
    sources = "{scanner: [noise.drawn.latency], circles: [noise.drawn.circle_in_scan]}"
    budget = f"budget={{sources: {sources}, figures: {{pixel_rms_mm: pixels}}}}"
    assert main(["study", "name=sweep", f"out={tmp_path / 'a'}", *SMALL, "over={}", "seeds=1", budget]) == 0
    said = capsys.readouterr().out
    assert "chain: 5 trials" in said and "budget      pixels: " in said and "mend first  circles makes" in said
    assert (tmp_path / "a" / "figures" / "budget_pixel_rms_mm.png").is_file()
    search = "search={least: pixel_rms_mm, runs: 4, batch: 2, by: tpe, start: {noise.speed_mm_s: 80}}"
    over = "over={noise.speed_mm_s: [10, 20, 40, 80]}"
    assert main(["study", "name=sweep", f"out={tmp_path / 'b'}", *SMALL, over, "seeds=1", search]) == 0
    said = capsys.readouterr().out
    assert "start       pixel_rms_mm" in said and "best        pixel_rms_mm" in said
    assert pq.read_table(tmp_path / "b" / "table.parquet").num_rows == 4
    assert [path.name for path in (tmp_path / "b" / "figures").iterdir()] == ["search.png"]  # too few for single factors


@pytest.mark.slow
def test_a_search_from_a_start_without_figures_says_why(tmp_path, capsys):
    """A scan so fast that no pair of frames shows one target; the best is found, and no improvement stated."""
    fields = ["over={noise.speed_mm_s: [20000, 10]}", "seeds=1", "conditions.motion.trigger_s=0.01"]
    search = "search={least: pixel_rms_mm, runs: 3, batch: 1, by: tpe, start: {noise.speed_mm_s: 20000}}"
    main(["study", "name=sweep", f"out={tmp_path / 'out'}", *SMALL, *fields, search])
    said = capsys.readouterr().out
    assert "start       pixel_rms_mm unknown: noise.speed_mm_s=20000" in said
    assert "no start    The start gives no figures, so no improvement on it can be stated: target: expected to be seen" in said


@pytest.mark.slow
def test_a_budgets_lost_trials_are_named_by_their_source(tmp_path, capsys):
    """Not by all the fields that are zero."""
    lost = [*SMALL, "over={}", "seeds=1", "conditions.motion.trigger_s=0.005", "noise.speed_mm_s=20000"]
    sources = "{scanner: [noise.drawn.latency], triggers: [conditions.motion.trigger_s]}"
    budget = f"budget={{sources: {sources}, figures: {{pixel_rms_mm: pixels}}}}"
    assert main(["study", "name=sweep", f"out={tmp_path / 'out'}", *lost, budget]) == 1
    said = capsys.readouterr().out
    lines = [line for line in said.splitlines() if line.startswith("no figures")]
    assert lines and all(
        re.match(r"no figures  (all sources|(scanner|triggers) alone.*), seed=0: target: ", line) for line in lines
    )
    assert all(len(line) < 250 for line in lines)


def test_wrong_choices_of_a_group_name_the_right_ones():
    with pytest.raises(InputError, match=r"over: board_patterns: expected one of .*gray_surface, .*, found lines"):
        study_plan.choice("board_patterns", "lines")
    with pytest.raises(
        InputError, match=r"over: conditions: expected lifelike, or a part of it, .*sound.*, found lifelike.sounds"
    ):
        study_plan.choice("conditions", "lifelike.sounds")


def test_a_part_of_a_choice_is_a_value(tmp_path):
    """All else is then as it is without any choice."""
    config = loaded(tmp_path, "name=sweep", *SMALL, "over={conditions: [lifelike, lifelike.sound]}")
    whole, sound = (trial.settings.conditions for trial in study_plan.trials("chain", config.settings, planned(config), [0]))
    assert sound == Conditions(sound=whole.sound) and whole.sound.tissue > 0
