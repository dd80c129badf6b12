"""The command `sonotwin train`: what it writes, what it says, and what it refuses in one line."""
# ruff: noqa: E402 - torch is asked for before what needs it

import json
import os
import shutil
import subprocess
import sys

import pytest

torch = pytest.importorskip("torch")

from recon.files import atomic
from recon.files.occupied import occupied
from sonotwin.cli import main


@pytest.fixture(autouse=True)
def threads_as_before():
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


def train(data, out, *more):
    return main(["train", "network=segmenter", f"data={data}", f"out={out}", "batch=2", "threads=1", *more])


def test_writes_the_network_and_goes_on(data_set, tmp_path, capsys):
    """Without what a run that was killed has left."""
    out = tmp_path / "out"
    files = {"metrics.json", "curves.png", "training.json", "checkpoint.pt", "log.jsonl"}
    files |= {f"segmenter.{suffix}" for suffix in ("onnx", "safetensors", "pt")}
    assert train(data_set, out, "steps=2") == 0
    assert {path.name for path in out.iterdir()} == files | {".sonotwin.json"}
    assert json.loads((out / "metrics.json").read_text())["patches"] == 6
    assert "wrote" in capsys.readouterr().out
    for file in files:
        (out / f".{file.replace('.', '.4194305.new.')}").write_bytes(b"half")
    assert train(data_set, out, "steps=3") == 0
    assert {path.name for path in out.iterdir()} == files | {".sonotwin.json"}
    assert "3 steps of 2" in (said := capsys.readouterr().out) and "from step 2 on" in said
    assert train(data_set, out, "steps=3", "seed=1") == 2
    assert "expected seed=0 as its checkpoint has, or resume=false" in capsys.readouterr().err
    assert train(data_set, out, "steps=1", "seed=1", "resume=false", f"init={out / 'segmenter.pt'}") == 2
    assert "a folder apart from what is read" in capsys.readouterr().err
    assert train(data_set, tmp_path / "other", "steps=1", "seed=1", f"init={out / 'segmenter.pt'}") == 0


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (["steps=1", "colour=red"], "train: colour: unknown key"),
        ([], "train: expected steps or max_minutes, found neither"),
        (["steps=1", "network=unet"], "train: network: expected"),
        (["steps=1", "data=/nowhere"], "/nowhere: expected a folder with shards, shard-00000.tar ..., found no such folder"),
        (["steps=1", "data=[]"], "train: data: expected"),
        (["steps=1", "data=3"], "train: data: expected"),
        (["steps=1", "data="], "train: data: expected a folder, found an empty name"),
        (["steps=1", "validation_data=[/nowhere,'']"], "train: validation_data: expected a folder, found an empty name"),
        (["steps=1", "memory_gb=-1"], "train: memory_gb: expected"),
        (["steps=1", "memory_gb=inf"], "train: memory_gb: expected"),
        (["steps=1", "checkpoint_minutes=inf"], "train: checkpoint_minutes: expected"),
        (["steps=1", "data=[/nowhere,/nowhere]"], "train: data: expected each folder once, found /nowhere twice"),
        (["steps=1", "init=/nowhere.pt"], "/nowhere.pt: expected weights, .safetensors or .pt, found none"),
    ],
)
def test_refuses_in_one_line(data_set, tmp_path, capsys, more, message):
    assert train(data_set, tmp_path / "out", *more) == 2
    said = capsys.readouterr().err
    assert message in said and said.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_a_second_run_into_the_folder_is_refused_at_once(data_set, tmp_path, capsys):
    out = tmp_path / "out"
    with occupied(out):
        assert train(data_set, out, "steps=1") == 2
        said = capsys.readouterr().err
        assert f"{out}: expected a folder that no other run is writing, found process {os.getpid()} on " in said
        assert said.count("\n") == 1 and not out.exists()
    assert train(data_set, out, "steps=1") == 0
    assert {path.name for path in tmp_path.iterdir()} == {"out"}


def test_two_folders_read_from_disk_train_as_one_in_memory(write, data_set, tmp_path, capsys):
    """The same weights to the byte, from a set in one folder and from its ranges in two."""
    parts = [write(tmp_path / name, count, first=first) for name, first, count in (("a", 0, 16), ("b", 16, 8))]
    assert train(data_set, tmp_path / "whole", "steps=3") == 0
    assert "stream" not in capsys.readouterr().out
    assert train(f"[{parts[0]},{parts[1]}]", tmp_path / "parts", "steps=3", "memory_gb=0") == 0
    assert "stream      from the shards: 0.004 GB of images, memory for 0 GB" in capsys.readouterr().out
    for name in ("segmenter.pt", "segmenter.safetensors", "segmenter.onnx"):
        assert (tmp_path / "whole" / name).read_bytes() == (tmp_path / "parts" / name).read_bytes(), name
    one, other = (json.loads((tmp_path / name / "metrics.json").read_text()) for name in ("whole", "parts"))
    assert {**one, "seconds_train": 0} == {**other, "seconds_train": 0}


@pytest.fixture(scope="module")
def trained(data_set, tmp_path_factory):
    """A training of one step."""
    out = tmp_path_factory.mktemp("trained") / "out"
    assert train(data_set, out, "steps=1") == 0
    return out


def test_a_run_of_the_earlier_version_whose_log_was_cut_short_goes_on(data_set, trained, tmp_path):
    """It had one folder by itself, and no memory_gb; half a line of its log is dropped."""
    out = shutil.copytree(trained, tmp_path / "out")
    asked = json.loads((out / "training.json").read_text())
    del asked["memory_gb"]
    (out / "training.json").write_text(json.dumps(asked | {"data": asked["data"][0]}))
    atomic.list_again(out, "training.json", "train")
    with (out / "log.jsonl").open("a") as file:
        file.write('{"step": 1, "lo')
    assert train(data_set, out, "steps=2") == 0
    assert [json.loads(line)["step"] for line in (out / "log.jsonl").read_text().splitlines()] == [1, 2]


@pytest.mark.parametrize(
    ("name", "content"),
    [
        *(
            ("training.json", content)
            for content in (b"", b"[]", b"3", b"\xff", b"[" * 100_000, b'{"seed": ' + b"9" * 10_000 + b"}")
        ),
        *(("log.jsonl", content) for content in (b"[1]\n", b"x}\n", b'{"step": NaN}\n', b'{"step": "1"}\n', b'{"loss": 1}\n')),
        ("log.jsonl", b'{"step": 1, "step": 1}\n'),
        *(("log.jsonl", content) for content in (b"\xff}\n", b'{"step": {"a": 1}}\n', b'{"step": ' + b"9" * 10_000 + b"}\n")),
        *(("checkpoint.pt", content) for content in (b"", b"nothing", b"PK\x03\x04" + b"\0" * 100)),
    ],
)
def test_damage_of_what_a_run_goes_on_from_is_one_line(data_set, trained, tmp_path, capfd, name, content):
    out = shutil.copytree(trained, tmp_path / "out")
    (out / name).write_bytes(content)
    assert train(data_set, out, "steps=2") == 2
    said = capfd.readouterr().err
    assert said.startswith(f"sonotwin: {out / name}: ") and said.count("\n") == 1 and len(said) < 600
    assert (out / name).read_bytes() == content


def test_what_was_asked_before_is_told_shortly(data_set, trained, tmp_path, capsys):
    out = shutil.copytree(trained, tmp_path / "out")
    asked = json.loads((out / "training.json").read_text())
    (out / "training.json").write_text(json.dumps(asked | {"seed": "\n\x1b[2J" * 10_000}))
    atomic.list_again(out, "training.json", "train")
    assert train(data_set, out, "steps=2") == 2
    said = capsys.readouterr().err
    assert "expected seed=" in said and said.count("\n") == 1 and len(said) < 800


def test_without_torch_it_says_what_to_install():
    program = """
import sys
class Refuse:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] == "torch":
            raise ModuleNotFoundError("No module named 'torch'", name="torch")
sys.meta_path.insert(0, Refuse())
from recon.files.occupied import occupied
from sonotwin.cli import main
sys.exit(main(["train", "network=detector", "data=x", "out=y", "steps=1"]))
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert done.returncode == 2 and done.stderr.count("\n") == 1
    assert "the Python package torch is missing; run pip install 'sonotwin[train]'" in done.stderr
