"""A checkpoint brings a training back, or says in one line why it can't."""
# ruff: noqa: E402 - torch is asked for before what needs it

import pytest

torch = pytest.importorskip("torch")

from recon.errors import InputError
from trainers import checkpoints, export
from trainers.architectures import Segmenter
from trainers.export import read_state

SAMPLES = (20, 4)


def training(seed: int = 0, steps: int = 2):
    """Networks and an optimizer after some steps."""
    torch.manual_seed(seed)
    networks = {name: Segmenter((4, 4, 4)) for name in ("network", "average")}
    optimizer = torch.optim.AdamW(networks["network"].parameters(), lr=0.01)
    for _ in range(steps):
        networks["network"](torch.rand(2, 1, 64, 64)).square().mean().backward()
        optimizer.step()
    return networks, optimizer


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    """Bytes of a checkpoint of step 2."""
    path = tmp_path_factory.mktemp("saved") / "checkpoint.pt"
    checkpoints.write(path, *training(), SAMPLES, 2, 1.5)
    return path.read_bytes()


@pytest.fixture
def written(saved, tmp_path):
    """A checkpoint of step 2, to be changed."""
    (tmp_path / "checkpoint.pt").write_bytes(saved)
    return tmp_path / "checkpoint.pt"


def test_all_comes_back(written):
    networks, optimizer = training(1, 0)
    assert checkpoints.resume(written, networks, optimizer, SAMPLES) == (2, 1.5)
    wanted, other = training()
    for name, network in networks.items():
        for one, two in zip(network.state_dict().values(), wanted[name].state_dict().values(), strict=True):
            assert torch.equal(one, two)
    for one, two in zip(optimizer.state_dict()["state"].values(), other.state_dict()["state"].values(), strict=True):
        assert all(torch.equal(one[name], two[name]) for name in two)


def test_the_same_state_is_the_same_bytes(written, tmp_path):
    """Whatever the file is called, and whoever writes it."""
    checkpoints.write(tmp_path / "other.pt", *training(), SAMPLES, 2, 1.5)
    assert written.read_bytes() == (tmp_path / "other.pt").read_bytes()


def test_without_one_it_begins(tmp_path):
    assert checkpoints.resume(tmp_path / "checkpoint.pt", *training(), SAMPLES) == (0, 0.0)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda state: state.update(samples=(19, 4)), "expected a checkpoint of 20 and 4 samples, .* found one of 19 and 4"),
        (lambda state: state.update(samples=7), "samples: expected two whole numbers"),
        (lambda state: state.update(samples=("20", "4")), "samples: expected two whole numbers"),
        (lambda state: state.update(samples=torch.tensor([20, 4])), "samples: expected two whole numbers"),
        (lambda state: state.update(step="2"), "step: expected a whole number"),
        (lambda state: state.update(step=-1), "step: expected a whole number"),
        (lambda state: state.update(step=2.5), "step: expected a whole number"),
        (lambda state: state.pop("step"), "step: expected a whole number"),
        (lambda state: state.update(seconds=float("nan")), "seconds: expected a number from 0"),
        (lambda state: state.update(seconds=[1]), "seconds: expected a number from 0"),
        (lambda state: state.update(network=[1]), "expected network, a dictionary of tensors, found .1."),
        (lambda state: state.update(network={1: 2}), "expected network level1"),
        (lambda state: state.pop("average"), "expected average, a dictionary of tensors, found None"),
        (lambda state: state.update(optimizer=3), "optimizer: expected the state of one"),
        (lambda state: state["optimizer"].update(state={"a": 1}), "expected optimizer.0, a dictionary of tensors, found None"),
        (lambda state: state["optimizer"]["state"][0].pop("exp_avg"), "expected optimizer.0 exp_avg of shape .*, found none"),
        (lambda state: state["optimizer"]["state"][1].update(step=2), r"expected optimizer.1 step of shape \[\], found 2"),
        (
            lambda state: state["optimizer"]["state"][1].update(exp_avg_sq=torch.zeros(7)),
            "expected optimizer.1 exp_avg_sq of shape",
        ),
    ],
)
def test_what_is_no_state_is_named_and_changes_nothing(written, change, message):
    state = read_state(written)
    change(state)
    torch.save(state, written)
    networks, optimizer = training(1, 0)
    before = {name: value.clone() for name, value in networks["network"].state_dict().items()}
    with pytest.raises(InputError, match=f"^{written}: {message}") as caught:
        checkpoints.resume(written, networks, optimizer, SAMPLES)
    assert str(caught.value).isprintable() and len(str(caught.value)) < 400
    assert all(torch.equal(value, before[name]) for name, value in networks["network"].state_dict().items())


def test_rates_are_those_that_were_asked_for(written):
    """Not those of a file that was changed."""
    state = read_state(written)
    for group in state["optimizer"]["param_groups"]:
        group |= {"lr": "fast", "betas": (2, 2)}
    torch.save(state, written)
    networks, optimizer = training(1, 0)
    checkpoints.resume(written, networks, optimizer, SAMPLES)
    assert all((group["lr"], group["betas"]) == (0.01, (0.9, 0.999)) for group in optimizer.param_groups)


def test_an_archive_with_a_damaged_or_bloated_table_of_parts_is_refused_unread(written, monkeypatch):
    """Torch takes as much memory for a part as the archive says: of 1.7 kB, 6.6 GB were seen."""
    intact = written.read_bytes()
    monkeypatch.setattr(torch, "load", lambda *_, **__: pytest.fail("read"))
    written.write_bytes(intact[:-22] + bytes(22))  # all but the end of the table
    with pytest.raises(InputError, match=f"^{written}: expected a file that torch saved, found a damaged one"):
        read_state(written)
    written.write_bytes(intact)
    monkeypatch.setattr(export, "MOST_BYTES", 100)
    with pytest.raises(InputError, match="expected at most 0 MiB of weights, found"):
        read_state(written)
