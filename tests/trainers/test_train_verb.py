"""The command `sonotwin train`: what it writes, what it says, and what it refuses in one line."""
# ruff: noqa: E402 - torch is asked for before what needs it

import json
import subprocess
import sys

import pytest

torch = pytest.importorskip("torch")

from sonotwin.cli import main


@pytest.fixture(autouse=True)
def threads_as_before():
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


def train(data, out, *more):
    return main(["train", "network=segmenter", f"data={data}", f"out={out}", "batch=2", "threads=1", *more])


def test_writes_the_network_and_goes_on(data_set, tmp_path, capsys):
    out = tmp_path / "out"
    assert train(data_set, out, "steps=2") == 0
    assert {path.name for path in out.iterdir()} == {
        *(f"segmenter.{suffix}" for suffix in ("onnx", "safetensors", "pt")),
        *("metrics.json", "curves.png", "training.json", "checkpoint.pt", "log.jsonl"),
    }
    assert json.loads((out / "metrics.json").read_text())["patches"] == 6
    assert "wrote" in capsys.readouterr().out
    assert train(data_set, out, "steps=3") == 0
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
        (["steps=1", "init=/nowhere.pt"], "/nowhere.pt: expected weights, .safetensors or .pt, found none"),
    ],
)
def test_refuses_in_one_line(data_set, tmp_path, capsys, more, message):
    assert train(data_set, tmp_path / "out", *more) == 2
    said = capsys.readouterr().err
    assert message in said and said.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_without_torch_it_says_what_to_install():
    program = """
import sys
class Refuse:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] == "torch":
            raise ModuleNotFoundError("No module named 'torch'", name="torch")
sys.meta_path.insert(0, Refuse())
from sonotwin.cli import main
sys.exit(main(["train", "network=detector", "data=x", "out=y", "steps=1"]))
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert done.returncode == 2 and done.stderr.count("\n") == 1
    assert "the Python package torch is missing; run pip install '.[train]'" in done.stderr
