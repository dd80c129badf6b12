"""A sample of the campaign; all of it takes hours and is run by `make campaign`."""

import shutil
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from campaign import (
    bad_inputs,
    foreign,
    forked,
    full_disk,
    fuzzing,
    kills,
    mistake_figures,
    mistaken_tasks,
    mistakes,
    soak,
    sources,
    two_writers,
)
from campaign.commands import Outcome
from campaign.sources import COMMANDS
from tests.twin.small_rigs import half_as_fields

NAMES = {"ball", "scan", "skin", "volume"}
COUNT = 28  # two of each verb


@pytest.fixture(scope="module")
def copies() -> Iterator[forked.Copies]:
    """Commands without the seconds that their imports take."""
    with forked.copies() as commands:
        yield commands


@pytest.fixture(scope="module")
def place(tmp_path_factory, copies, rig) -> Path:
    """Sources, those that are rendered by cameras of half the size."""

    def run(line: Sequence[str], folder: Path, longest_s: float) -> Outcome:
        return copies.run((*line, *half_as_fields(rig)) if line[0] == "render" else line, folder, longest_s)

    folder = tmp_path_factory.mktemp("campaign") / "sources"
    sources.make(folder, NAMES, run)
    return folder


@pytest.mark.slow
def test_bad_inputs_are_refused(place, copies, rig):
    """Some of every verb's whose sources are quickly made; how long they take isn't tested: machines are noisy."""
    few = [command for command in COMMANDS if set(command.folders) <= NAMES and not command.minutes]
    small = {"compare-twin": half_as_fields(rig)}  # else it is refused for the images' size
    few = [replace(command, fields=(*command.fields, *small.get(command.verb, ()))) for command in few]
    chosen = bad_inputs.chosen(bad_inputs.cases(place, few), COUNT, seed=21)
    found = bad_inputs.run(chosen, place, workers=1, command=copies.run)
    wrong = {f"{one.case.command.verb} {one.case.fault}": (one.fault, one.outcome.said) for one in found if one.fault}
    assert not {name: fault for name, fault in wrong.items() if fault[0] != "slow"}


@pytest.mark.slow
def test_files_of_others_stay(place):
    """Those of the Python interface's writer, which takes no process of its own."""
    found = foreign.run(place, 1, only=[foreign.INTERFACE])
    assert not [one for one in found if one.lost or one.status < 0 or (one.status == 2) != one.said.startswith("sonotwin: ")]
    statuses = {one.content: one.status for one in found}
    assert len(found) >= 13 and all(statuses[content] == 0 for content in list(foreign.IN_A_RESULT)[:6])
    assert all(statuses[content] == 2 for content in ("one of ours, changed by hand", *foreign.INSTEAD))


@pytest.mark.slow
def test_mistakes_are_made_and_judged(place, tmp_path):
    """A few with one sweep; a run that was ended goes on, and the right commands have no distance from themselves."""
    shutil.copytree(place / "scan", place / "raster")  # a short one in its place
    tasks, kept = [mistaken_tasks.FREEHAND], tmp_path / "mistakes.csv"
    first = mistakes.run(place, 4, workers=1, kept=kept, tasks=tasks)
    assert [one.row for one in mistakes.run(place, 4, workers=1, kept=kept, tasks=tasks)] == [one.row for one in first]
    assert all(one.outcome != "traceback" for one in first), first
    one, other = (mistakes._commands(place, mistaken_tasks.FREEHAND, None, np.random.default_rng(0)).figures for _ in range(2))
    assert mistake_figures.distance(one, other) == 0
    assert mistakes.table(first)[2].startswith("| freehand | 4 |")


@pytest.mark.slow
def test_killed_commands_lose_nothing(place, copies, monkeypatch):
    """One that replaces a folder, by both signals; `reconstruct`, which goes on with its own, and recordings have theirs."""
    brief = ("sweep", "scene=tank", "ultrasound=water", "path=bob", "path.seconds=0.3")
    lines = ((*brief, f"seed={seed}", "out=new") for seed in (1, 2))
    monkeypatch.setattr(kills, "KILLED", (kills.Killed("sweep", *lines),))
    tallies = kills.run(place, moments=1, seed=3, workers=1, command=copies.run, kill=copies.kill)
    assert len(tallies) == 2 and all(tally.good for tally in tallies), tallies


@pytest.mark.slow
@pytest.mark.skipif(not full_disk.can_mount(), reason="a small disk can't be mounted")
def test_full_disks_are_named_and_old_results_kept(place, copies):
    found = full_disk.run(place, ["freehand"], copies.run)
    assert len(found) == 3 and all(one.good and one.outcome.status == 2 for one in found), full_disk.table(found)


@pytest.mark.slow
@pytest.mark.skipif(not two_writers.can_part(), reason="no process namespaces")
def test_two_writers_dont_mix(place, copies):
    """With settings of their own, so that a mixture shows."""
    (surface,) = (killed for killed in kills.KILLED if killed.verb == "surface")
    pairs = two_writers.both(place, surface, surface.first, 1, copies.run)
    assert pairs and all(pair.good for pair in pairs), pairs


@pytest.mark.slow
def test_readers_survive_some_fuzzing(place):
    pytest.importorskip("atheris")
    found = fuzzing.run(place, 600, only=["manifest"], workers=1, inputs=1000)
    assert all(one.inputs >= 1000 and not one.faults for one in found), found


@pytest.mark.slow
def test_memory_stays_as_it_is(place):
    """A B-scan that is kept makes 0.1 MB of 400, so 30 MB."""
    found = soak.run(place, "freehand", 400)
    assert found.growth_mb < 20
