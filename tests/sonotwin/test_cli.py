"""What a person sees of the command line: help, and one line for each mistake."""

import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from recon import user_cache
from recon.errors import InputError
from sonotwin import cli, console_watch, verb_help
from tests.patience import PATIENCE_S

VERBS = sorted(path.stem.replace("_", "-") for path in Path(cli.__file__).with_name("verbs").glob("[a-z]*.py"))


def complaint(capsys, *arguments: str) -> str:
    """Run the command line on a mistake; returns the one line on stderr without its prefix."""
    assert cli.main(arguments) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    (line,) = captured.err.splitlines()
    assert line.startswith("sonotwin: ")
    return line.removeprefix("sonotwin: ")


@pytest.fixture
def failing(monkeypatch):
    """Make the verb `doctor` raise an exception."""

    def make(error: BaseException) -> None:
        def run(config):
            raise error

        monkeypatch.setattr("sonotwin.verbs.doctor.run", run)

    return make


def test_linear_algebra_has_one_thread_in_a_process_that_gave_it_more(monkeypatch):
    """A notebook has loaded NumPy before it runs a verb: what the environment says is read no more."""
    counts = set[int]()

    def run(config):
        counts.update(library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas")

    monkeypatch.setattr("sonotwin.verbs.doctor.run", run)
    assert np.linalg.det(np.eye(2)) == 1
    with threadpool_limits(2, "blas"):
        assert cli.main(["doctor"]) == 0
    assert counts == {1}


def test_verbs_are_in_the_table():
    assert set(VERBS) <= {verb.name for verb in cli.VERBS}


def test_help_lists_verbs_in_order(capsys):
    assert cli.main(["--help"]) == 0
    lines = [line.split() for line in capsys.readouterr().out.splitlines() if line.startswith("  ")]
    assert [line[0] for line in lines if line[0] != "or"][-len(cli.VERBS) :] == [verb.name for verb in cli.VERBS]


@pytest.fixture
def no_texts(tmp_path, monkeypatch):
    """A folder without any text of help."""
    monkeypatch.setattr(user_cache, "help_texts", lambda: tmp_path / "help")
    return tmp_path / "help"


@pytest.mark.parametrize("verb", VERBS)
def test_help_of_a_verb(verb, no_texts, monkeypatch, capsys):
    """It shows an example that can be typed, and each field with its default; the second time, without the verb."""
    assert cli.main([verb, "--help"]) == 0
    text = capsys.readouterr().out
    assert text.startswith(f"usage: sonotwin {verb}")
    assert f"    sonotwin {verb}" in text
    monkeypatch.setattr(verb_help, "make", None)
    assert cli.main([verb, "--help"]) == 0
    assert capsys.readouterr().out == text


def test_help_of_a_study_is_its_own(tmp_path, capsys):
    """Its title, its purpose without the file's name, and its fields with their comments; of a file without a purpose, too."""
    assert cli.main(["study", "name=exposure", "--help"]) == 0
    usage, title, purpose, _, fields, _ = capsys.readouterr().out.strip().split("\n\n")
    assert usage.startswith("usage: sonotwin study name=exposure ") and title == "Exposure"
    assert purpose == "light against noise, until images saturate"
    assert "\n  of: surface\n  over:\n    shooting.exposure_s: {from: " in fields
    (tmp_path / "our own.yaml").write_text("title: Ours\nof: chain\nover: {}\n", encoding="utf-8")
    assert cli.main(["study", "name=exposure", f"name={tmp_path / 'our own.yaml'}", "-h"]) == 0
    usage, title, _, fields, _ = capsys.readouterr().out.strip().split("\n\n")
    assert f"name='{tmp_path / 'our own.yaml'}'" in usage and title == "Ours" and "of: chain" in fields
    assert cli.main(["study", "name=exposur", "--help"]) == 2 and "did you mean exposure" in capsys.readouterr().err


def test_help_has_fields_that_settings_inherit(no_texts, capsys):
    assert cli.main(["export", "--help"]) == 0
    assert "  screen_px: " in capsys.readouterr().out


def test_help_is_made_anew_after_a_change_and_where_nothing_can_be_kept(no_texts, monkeypatch):
    """One file a verb is kept, whatever became of the last one."""
    made = iter(("first", "second", "third", "fourth"))
    monkeypatch.setattr(verb_help, "make", lambda verb, module: next(made))
    monkeypatch.setattr(verb_help, "_state", lambda: "one state")
    assert [verb_help.text("check", "") for _ in range(2)] == ["first", "first"]
    monkeypatch.setattr(verb_help, "_state", lambda: "another")
    assert [verb_help.text("check", "") for _ in range(2)] == ["second", "second"]
    (kept,) = no_texts.iterdir()
    kept.write_bytes(b"\xff")
    assert verb_help.text("check", "") == "third" and [*no_texts.iterdir()] == [kept]
    kept.unlink()
    no_texts.rmdir()
    no_texts.write_text("a file in its place")
    assert verb_help.text("check", "") == "fourth"


def test_the_state_is_that_of_all_sources(tmp_path, monkeypatch):
    """Of a wheel, too, which has conf inside the package."""
    for name in ("sonotwin/cli.py", "sonotwin/conf/rig/one.yaml", "recon/a.py"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("a")
    monkeypatch.setattr(verb_help, "__file__", str(tmp_path / "sonotwin" / "verb_help.py"))
    states = [verb_help._state()]
    for name in ("recon/a.py", "sonotwin/conf/rig/one.yaml", "twin/new.py"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text("longer")
        states.append(verb_help._state())
    (tmp_path / "recon" / "__pycache__").mkdir()
    (tmp_path / "recon" / "__pycache__" / "a.py").write_text("")
    (tmp_path / "sonotwin" / "conf" / "rig" / "gone.yaml").symlink_to(tmp_path / "nowhere.yaml")
    assert len(set(states)) == 4 and verb_help._state() == states[-1]
    monkeypatch.setattr(verb_help, "version", lambda name: "another")
    assert verb_help._state() not in states


def test_two_clones_keep_a_text_each(no_texts, tmp_path, monkeypatch):
    monkeypatch.setattr(verb_help, "make", lambda verb, module: verb_help.__file__)
    here, made = verb_help.__file__, []
    for place in (here, str(tmp_path / "clone" / "sonotwin" / "verb_help.py"), here):
        monkeypatch.setattr(verb_help, "__file__", place)
        made.append(verb_help.text("check", ""))
    assert made[0] == made[2] != made[1] and len(list(no_texts.iterdir())) == 2


def test_help_waits_for_no_library():
    """It is there at once because nothing heavy is imported for it; a verb's likewise, once it is kept."""
    heavy = {"numpy", "scipy", "cv2", "numba", "hydra", "drjit", "mitsuba", "torch", "onnxruntime", "matplotlib", "trimesh"}
    assert cli.main(["check", "--help"]) == 0
    asked = "main(['--help']); main(['check', '--help'])"
    code = f"import sys; from sonotwin.cli import main; {asked}; print(*sys.modules, file=sys.stderr)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.count("usage: sonotwin") == 2
    assert not heavy & set(done.stderr.split())


def test_version(capsys):
    assert cli.main(["--version"]) == 0
    assert re.fullmatch(r"sonotwin \d+\.\d+\.\d+\n", capsys.readouterr().out)


def test_unknown_verb(capsys):
    assert complaint(capsys, "docter") == "docter: unknown verb; did you mean doctor?"
    assert complaint(capsys, "xyzzy").startswith("xyzzy: unknown verb; expected one of doctor, demo")


def test_unknown_option(capsys):
    assert complaint(capsys, "doctor", "--fast") == "doctor: --fast: unknown option; fields are given as field=value"


def test_unknown_key(capsys):
    assert complaint(capsys, "doctor", "pitchh=3") == "doctor: pitchh: unknown key; expected none"


def test_a_reader_that_has_seen_enough():
    """`sonotwin --help | head -1` ends without a traceback."""
    done = subprocess.run(
        f"{sys.executable} -m sonotwin surface --help | head -1", shell=True, capture_output=True, text=True, check=True
    )
    assert done.stdout.count("\n") == 1 and done.stderr == ""


def test_a_mistake_in_a_process_of_its_own():
    """No traceback, status 2, one line."""
    done = subprocess.run([sys.executable, "-m", "sonotwin", "doctr"], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (2, "", 1)
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize(
    ("error", "line"),
    [
        (InputError("a.png: expected 8-bit grey,\nfound RGB"), "a.png: expected 8-bit grey, found RGB"),
        (
            ModuleNotFoundError("...", name="mitsuba.python"),
            "the Python package mitsuba is missing; run pip install 'sonotwin[twin]'",
        ),
        (
            ModuleNotFoundError("...", name="drjit"),
            "the Python package drjit is missing; run pip install 'sonotwin[twin]'",
        ),
        (ModuleNotFoundError("...", name="cv2"), "the Python package cv2 is missing; run pip install 'sonotwin'"),
        (PermissionError(13, "Permission denied", "out/surface.ply"), "out/surface.ply: Permission denied"),
        (OSError(28, "No space left on device"), "output: No space left on device"),
    ],
)
def test_mistakes_become_one_line(error, line, failing, capsys):
    failing(error)
    assert complaint(capsys, "doctor") == line


@pytest.mark.parametrize("error", [ModuleNotFoundError("...", name="recon.nothing"), OSError("no file name"), KeyError("x")])
def test_our_own_mistakes_keep_their_traceback(error, failing):
    failing(error)
    with pytest.raises(type(error)):
        cli.main(["doctor"])


def test_interrupt(failing, capsys):
    failing(KeyboardInterrupt())
    assert cli.main(["doctor"]) == 130
    assert capsys.readouterr().err == "sonotwin: interrupted\n"


@pytest.mark.parametrize(("number", "status"), [(signal.SIGTERM, 143), (signal.SIGHUP, 129), (signal.SIGINT, 130)])
def test_a_command_that_is_told_to_end_cleans_up(tmp_path, number, status):
    """One line, the status of the signal, and nothing half written; a second signal doesn't disturb the cleaning."""
    program = """
import os, signal, sys
from pathlib import Path
from recon.files import atomic
from sonotwin import cli, verb_help

def work(arguments):
    with atomic.new_folder(Path("out"), "mark"):
        try:
            print("ready", flush=True)
            signal.pause()
        finally:
            if sys.argv[1] != "2":
                os.kill(os.getpid(), signal.SIGTERM)

cli._run = work
sys.exit(cli.main([]))
"""
    env = os.environ | {"PYTHONPATH": str(Path(cli.__file__).parents[1])}
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    running = subprocess.Popen([sys.executable, "-c", program, str(int(number))], cwd=tmp_path, env=env, text=True, **pipes)
    assert running.stdout.readline() == "ready\n"
    running.send_signal(number)
    said = running.communicate(timeout=PATIENCE_S)[1]
    assert running.returncode == status
    assert len(said.splitlines()) == 1 and list(tmp_path.iterdir()) == []


def test_a_reader_that_goes_away_ends_no_step(tmp_path):
    """As in `sonotwin surface ... | head -1`: the result is written, and the status is that of a broken pipe."""
    program = """
import sys
from pathlib import Path
from sonotwin import cli
from sonotwin.console_watch import ConsoleWatch

def work(arguments):
    for line in ("read", "decode", "wrote"):
        ConsoleWatch().say(line)
    Path("result").touch()

cli._run = work
sys.exit(cli.main([]))
"""
    env = {name: value for name, value in os.environ.items() if name != "PYTHONUNBUFFERED"}
    env["PYTHONPATH"] = str(Path(cli.__file__).parents[1])
    reading, writing = os.pipe()
    os.close(reading)
    done = subprocess.run(
        [sys.executable, "-c", program], cwd=tmp_path, env=env, stdout=writing, stderr=subprocess.PIPE, check=False
    )
    os.close(writing)
    assert (done.returncode, done.stderr) == (128 + cli.BROKEN_PIPE, b"")
    assert (tmp_path / "result").exists()


def test_lines_are_printed_as_they_are(capsys):
    """Names of folders that are long, in brackets or between colons, too."""
    line = f"wrote       {'long/' * 60}[bold]/:x:/12.5"
    console_watch.ConsoleWatch().say(line)
    assert capsys.readouterr().out == f"{line}\n"
