"""Trials are done once, in any order, by any engine, and give the same table."""

import importlib.metadata
import json
import math

import pyarrow.parquet as pq
import pytest

from recon.errors import InputError
from recon.files.code_digest import code_digest
from tests.twin.studies import made_up
from twin.engine import Engine
from twin.experiments import experiment_runs
from twin.experiments.experiment_runs import Settings
from twin.studies import factors, study_runs
from twin.studies.study_runs import StudyFolder

HERE = Engine()
DESCRIPTION = {"of": made_up.NAME, "settings": {}}
SPEED, SCALE = "noise.speed_mm_s", "layout.target_scale"


@pytest.fixture(autouse=True)
def experiment(monkeypatch):
    """A made-up one among the others."""
    monkeypatch.setitem(experiment_runs.MODULES, made_up.NAME, made_up.__name__)


@pytest.fixture
def place(tmp_path) -> StudyFolder:
    folder = StudyFolder(tmp_path / "study")
    folder.open(DESCRIPTION)
    return folder


def planned(settings, over, seeds=(0, 1)):
    points = factors.factorial(factors.read(over))
    base = settings.model_dump(mode="json")
    return study_runs.plan(
        made_up.NAME, [(point, Settings.model_validate(factors.applied(base, point))) for point in points], seeds
    )


def measured(place, trials, engine: Engine = HERE):
    return study_runs.in_order(trials, list(study_runs.run(place, made_up.NAME, trials, engine)))


@pytest.fixture
def counted(monkeypatch) -> list:
    """Speeds and seeds of the trials that are measured."""
    taken = []

    def measure(settings, seed):
        taken.append((settings.noise.speed_mm_s, seed))
        return made_up.measure(settings, seed)

    experiment = experiment_runs.Experiment(made_up.EXPERIMENT.reads, measure, made_up.EXPERIMENT.limits)
    monkeypatch.setattr(made_up, "EXPERIMENT", experiment)
    return taken


def test_trials_that_are_kept_are_not_done_again(settings, place, counted):
    """More values and more seeds add theirs alone; figures that are kept are those that were found, NaN too."""
    first = measured(place, planned(settings, {SPEED: [10, 20]}))
    assert counted == [(10, 0), (10, 1), (20, 0), (20, 1)]
    again = measured(place, planned(settings, {SPEED: [20, 10, 30]}, (0, 1, 2)))
    assert sorted(counted[4:]) == [(10, 2), (20, 2), (30, 0), (30, 1), (30, 2)]
    known = {one.trial.key: repr(one.figures) for one in again}
    assert all(known[one.trial.key] == repr(one.figures) for one in first)
    assert math.isnan(first[1].figures["odd"]) and first[0].figures["limit_mm"] == 3.33333  # of ten thirds, six digits


@pytest.mark.parametrize(
    "content",
    [
        "",
        '{"figures": {"sum_m',
        "{}",
        '{"figures": 3}',
        "7",
        "[1, 2]",
        "null",
        '{"figures": {"sum_mm": [1]}}',
        '{"figures": {"sum_mm": "x"}}',
    ],
    ids=["empty", "cut", "other", "no map", "number", "list", "null", "figure a list", "figure a word"],
)
def test_a_damaged_trial_is_done_anew(settings, place, counted, content):
    trials = planned(settings, {SPEED: [10, 20]}, (0,))
    measured(place, trials)
    file = place.folder / study_runs.TRIALS / f"{trials[0].key}.json"
    whole = file.read_text()
    file.write_text(content)
    assert [one.figures["sum_mm"] for one in measured(place, trials)] == [10, 20]
    assert counted == [(10, 0), (20, 0), (10, 0)] and file.read_text() == whole


def test_a_trial_that_measures_nothing_is_a_row_with_its_reason(settings, place, counted):
    """In one line; it isn't kept, so a later run tries it again, and it alone."""
    trials = planned(settings, {SPEED: [10, 200]}, (0,))
    for _ in range(2):
        good, bad = measured(place, trials)
        assert bad.found == "ValueError: speed_mm_s: expected at most 100, found 200" and bad.figures == {}
        rows = study_runs.rows([good, bad])
        assert rows[1]["error"] == bad.found and rows[0]["error"] is None and math.isnan(rows[1]["sum_mm"])
        assert [file.stem for file in place.trials.iterdir()] == [good.trial.key]
    assert counted == [(10, 0), (200, 0), (200, 0)]


def test_other_errors_are_the_callers(settings, place, monkeypatch):
    """A mistake of the software is not a property of the settings."""
    broken = experiment_runs.Experiment(("noise",), lambda settings, seed: {}["figure"], {})
    monkeypatch.setattr(made_up, "EXPERIMENT", broken)
    with pytest.raises(KeyError, match="figure"):
        measured(place, planned(settings, {SPEED: [10]}))


def test_points_that_change_nothing_are_measured_once(settings, place, counted):
    """A field that no figure depends on, and values that are the same: a row each, one trial."""
    trials = planned(settings, {SPEED: [10, 10.0]}, (0,))
    found = measured(place, trials)
    assert counted == [(10, 0)] and len(found) == 2 and [one.trial for one in found] == trials


def test_a_trials_name_is_all_that_its_figures_depend_on(settings, monkeypatch):
    """The experiment, what it reads, the seed and the code; not the settings of other experiments."""
    (key,) = (one.key for one in planned(settings, {SPEED: [10]}, (0,)))
    others = [planned(settings, {SPEED: [11]}, (0,)), planned(settings, {SPEED: [10]}, (1,))]
    elsewhere = settings.model_copy(update={"film": settings.film.model_copy(update={"frames": 77})})
    assert planned(elsewhere, {SPEED: [10]}, (0,))[0].key == key
    assert experiment_runs.digest("chain", settings, 0) != experiment_runs.digest("laboratory", settings, 0)
    monkeypatch.setattr(experiment_runs, "version", lambda *of_its_own: "of other code")
    others.append(planned(settings, {SPEED: [10]}, (0,)))
    assert len({key, *(one.key for (one,) in others)}) == 4


def test_a_version_is_that_of_code_libraries_and_the_ray_tracer(monkeypatch):
    """Each of them changes it; it is found once."""
    version = experiment_runs.version.__wrapped__
    found = [version()]
    for place, name, other in (
        (experiment_runs, "code_digest", lambda *packages: "of other code"),
        (experiment_runs.importlib.metadata, "version", lambda library: "0.1" if library == "scipy" else "1.0"),
        (experiment_runs.importlib.metadata, "version", lambda library: "0.1" if library == "onnxruntime" else "1.0"),
        (experiment_runs, "prepare", lambda: "of a processor that nobody has"),
    ):
        monkeypatch.setattr(place, name, other)
        found.append(version())
    assert len(set(found)) == 5 and version() == found[-1]
    assert experiment_runs.version() is experiment_runs.version() and len(found[0]) == 12


def test_what_one_experiment_alone_depends_on_is_in_its_trials_alone(settings, monkeypatch):
    """Other trainers or another torch void what training gave, and the figures of no other study."""
    training, names = experiment_runs.experiment("training"), ("training", "chain")
    version, installed, code = experiment_runs.version, importlib.metadata.version, experiment_runs.code_digest
    for name in training.libraries:
        pytest.importorskip(name.replace("-", "_"))

    def keys():
        version.cache_clear()
        return [experiment_runs.digest(name, settings, 0) for name in names]

    before = keys()
    for place, name, other in (
        (importlib.metadata, "version", lambda library: "0.1" if library == "torch" else installed(library)),
        (experiment_runs, "code_digest", lambda *packages: code(*packages) + ("1" if "trainers" in packages else "")),
    ):
        with monkeypatch.context() as patched:
            patched.setattr(place, name, other)
            training_key, chain = keys()
            assert training_key != before[0] and chain == before[1]
    assert keys() == before


def test_workers_of_another_version_refuse(settings, place, monkeypatch):
    """Their figures would be kept under the name of this machine's."""
    trials = planned(settings, {SPEED: [10]}, (0,))
    monkeypatch.setattr(experiment_runs, "version", lambda *of_its_own: "of other code")
    with pytest.raises(InputError, match="engine: expected workers with the code and the libraries of this machine, found"):
        measured(place, trials)
    assert not list(place.trials.iterdir())


@pytest.mark.parametrize("engine", [HERE, Engine(workers=2)], ids=["this process", "two processes"])
def test_tables_are_the_same_bytes_whatever_the_engine(settings, place, tmp_path, monkeypatch, engine):
    """And whether a study was stopped in between. Workers find the code as it is now, which may be edited while tests run."""
    for kept in (code_digest, experiment_runs.version):
        kept.cache_clear()
    over = {SPEED: {"from": 10, "to": 90, "count": 5}, SCALE: [1.0, 2.0]}
    expected = StudyFolder(tmp_path / "plain")
    expected.open(DESCRIPTION)
    expected.write_table(measured(expected, planned(settings, over)))
    running = study_runs.run(place, made_up.NAME, planned(settings, over), HERE)
    next(running)
    running.close()
    if engine.workers > 1:
        monkeypatch.setattr(experiment_runs, "run_trial", made_up.run_trial)
    place.write_table(measured(place, planned(settings, over), engine))
    table = (place.folder / study_runs.TABLE).read_bytes()
    assert table == (expected.folder / study_runs.TABLE).read_bytes()
    kept = {file.name: file.read_bytes() for file in (place.folder / "trials").iterdir()}
    assert kept == {file.name: file.read_bytes() for file in (expected.folder / "trials").iterdir()}


def test_a_table_has_a_row_a_trial_and_the_same_columns_in_each(settings, place):
    """Points first, their order that of the plan."""
    trials = planned(settings, {SPEED: [60, 10, 200], SCALE: [2.0, 1.0]}, (5, 6))
    done = measured(place, trials)
    rows = study_runs.rows(done)
    assert {tuple(row) for row in rows} == {(SPEED, SCALE, "seed", "sum_mm", "limit_mm", "odd", "error")}
    assert [(row[SPEED], row[SCALE], row["seed"]) for row in rows[:5]] == [
        (60, 2, 5), (60, 2, 6), (60, 1, 5), (60, 1, 6), (10, 2, 5)
    ]  # fmt: skip
    place.write_table(done)
    table = pq.read_table(place.folder / study_runs.TABLE).to_pylist()
    assert repr(table) == repr(rows) and table[4]["sum_mm"] == 15


def test_a_column_of_mixed_values_holds_words(tmp_path):
    """A file's columns have one kind each; numbers beside nothing stay numbers."""
    points = [{"lens": "wide", "gap_mm": None, "at": [1, 2]}, {"lens": 2, "gap_mm": 5, "at": 3}]
    done = [made_up.done(point, {"sum_mm": 1.0}) for point in points]
    folder = StudyFolder(tmp_path)
    folder.write_table(done)
    table = pq.read_table(tmp_path / study_runs.TABLE).to_pydict()
    assert (table["lens"], table["gap_mm"], table["at"]) == (["wide", "2.0"], [None, 5.0], ["[1, 2]", "3.0"])


def test_what_a_killed_run_left_is_removed(settings, place):
    """Half of a trial, written under a hidden name; whole ones stay."""
    (trial,) = planned(settings, {SPEED: [10]}, (0,))
    measured(place, [trial])
    (place.trials / f".{trial.key}.999999999.new.json").write_text('{"figures": {"su')
    place.open(DESCRIPTION)
    assert [file.name for file in place.trials.iterdir()] == [f"{trial.key}.json"] and place.kept(trial) is not None


def test_numbers_are_told_from_words_and_from_what_is_missing():
    assert study_runs.numeric([1, 2.5]) and not study_runs.numeric([1, "a"]) and not study_runs.numeric([True, False])
    assert study_runs.finite([1, None, math.nan, math.inf, 2.5]).tolist() == [1, 2.5] and study_runs.finite([None]).size == 0


def test_trials_come_in_their_order(settings):
    trials = planned(settings, {SPEED: [10, 10, 20]}, (0, 1))
    done = [study_runs.Done(trial, {}) for trial in trials]
    assert study_runs.in_order(trials, done[::-1]) == done
    assert [id(one.trial) for one in study_runs.in_order(trials, done[3:] + done[:3])] == [id(trial) for trial in trials]


@pytest.mark.parametrize(
    ("value", "expected"),
    [(3, 3.0), (True, True), (None, None), ("lifelike", "lifelike"), ([1, 2], "[1, 2]"), ({"a": 1}, '{"a": 1}')],
)
def test_cells_hold_numbers_and_words(value, expected):
    assert study_runs.cell(value) == expected and type(study_runs.cell(value)) is type(expected)


def test_a_folder_of_other_files_is_left_alone(tmp_path):
    """A study's own is gone on with, and described as it now is."""
    (tmp_path / "thesis.tex").write_text("years of work")
    with pytest.raises(InputError, match="expected a new or empty folder, or one that study wrote, found other files"):
        StudyFolder(tmp_path).open(DESCRIPTION)
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]
    own = StudyFolder(tmp_path / "own")
    own.open(DESCRIPTION | {"seeds": 3})
    own.open(DESCRIPTION | {"seeds": 4})
    assert json.loads((own.folder / "study.json").read_text()) == DESCRIPTION | {"seeds": 4}


@pytest.mark.parametrize(
    "content",
    [b"{", b"", b"[]", b"7", b'{"seeds": 4}', b'{"of": "a survey", "year": 2020}', b"\xff\xfe", b"[" * 100_000],
    ids=["cut", "empty", "list", "number", "other map", "survey", "no text", "deep"],
)
def test_a_file_of_the_same_name_is_left_alone(content, tmp_path):
    """`study.json` is what another program may call its own: only the list of what sonotwin wrote marks a folder as ours."""
    for name, held in (("study.json", content), ("thesis.tex", b"years of work")):
        (tmp_path / name).write_bytes(held)
    with pytest.raises(InputError, match=r"found other files, such as study\.json, and no list of ours"):
        StudyFolder(tmp_path).open(DESCRIPTION)
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == {
        "study.json": content,
        "thesis.tex": b"years of work",
    }


def test_fields_that_an_experiment_does_not_read_are_refused():
    experiment_runs.check_reads("surface", ["shooting.exposure_s", "rig.projector.gamma"])
    with pytest.raises(
        InputError, match=r"over: noise\.board_px: expected a field that of=surface reads, of rig, layout\.projector_mm,"
    ):
        experiment_runs.check_reads("surface", ["shooting.exposure_s", "noise.board_px"])


def test_parts_of_a_field_that_would_change_nothing_are_refused():
    """Of conditions the chain reads some; a whole that holds one of them, and a part of one, are read."""
    experiment_runs.check_reads(
        "chain",
        [
            "rig.probe",
            "rig.cam1.optics.focal_px",
            "conditions",
            "conditions.board",
            "conditions.board.bow_mm",
            "conditions.drift.focal",
        ],
    )
    for inert in (
        "conditions.skin.wet",
        "conditions.board.diameter_mm",
        "conditions.board.bow",
        "conditions.frames",
        "nois",
    ):
        with pytest.raises(InputError, match=rf"over: {inert}: expected a field that of=chain reads, .* would change nothing"):
            experiment_runs.check_reads("chain", ["noise", inert])


@pytest.mark.parametrize("name", experiment_runs.MODULES)
def test_experiments_read_settings_and_have_limits(name, settings):
    """Their dotted names are fields, and the limits have a name."""
    found, base = experiment_runs.experiment(name), settings.model_dump(mode="json")
    for field in found.reads:
        factors.value_at(base, field)
    assert found.limits and found.limit
    assert set(experiment_runs.read_by(name, settings)) == {field.partition(".")[0] for field in found.reads}
