"""What is written is the network: other software gets the same answers from the files."""
# ruff: noqa: E402 - torch is asked for before what needs it

from copy import deepcopy
from functools import cache

import pytest

torch = pytest.importorskip("torch")
import onnx
import onnxruntime

from recon.errors import InputError
from trainers.architectures import network
from trainers.export import load, save, save_onnx


def trained(name, seed=0):
    """A network whose norms have statistics, as after some steps."""
    return deepcopy(_trained(name, seed))


@cache
def _trained(name, seed):
    torch.manual_seed(seed)
    module = network(name, 3).train()
    with torch.no_grad():
        for _ in range(3):
            module(torch.rand(2, 1, 32, 32))
    return module.eval()


@pytest.mark.parametrize("name", ["detector", "segmenter", "published_segmenter", "masses"])
def test_onnx_runtime_agrees_at_any_size(name, tmp_path):
    module = trained(name)
    save_onnx(tmp_path / "network.onnx", module, name, "three_circles")
    session = onnxruntime.InferenceSession(str(tmp_path / "network.onnx"), providers=["CPUExecutionProvider"])
    assert onnx.load(tmp_path / "network.onnx").opset_import[0].version >= 17
    outputs = [value.name for value in session.get_outputs()]
    assert outputs == (["detection", "identity"] if name == "detector" else ["mask"])
    for n, height, width in ((1, 112, 160), (3, 96, 64)):
        picture = torch.rand(n, 1, height, width)
        with torch.no_grad():
            wanted = module(picture)
        found = session.run(outputs, {{"detector": "image", "masses": "scan"}.get(name, "patch"): picture.numpy()})
        for one, other in zip(found, wanted if isinstance(wanted, tuple) else (wanted,), strict=True):
            assert abs(one - other.numpy()).max() < 1e-4


@pytest.mark.parametrize("suffix", [".safetensors", ".pt"])
def test_weights_come_back_to_the_bit(suffix, tmp_path):
    module, other = trained("published_segmenter"), trained("published_segmenter", 1)
    save(tmp_path / f"weights{suffix}", module)
    load(tmp_path / f"weights{suffix}", other)
    assert all(torch.equal(one, two) for one, two in zip(module.state_dict().values(), other.state_dict().values(), strict=True))
    (tmp_path / "other").touch()
    assert (tmp_path / f"weights{suffix}").stat().st_mode == (tmp_path / "other").stat().st_mode  # whoever may read files here


def test_published_files_of_older_torch_are_read(tmp_path):
    """Their state dictionaries may lack the norms' counters and have the prefix of a parallel module."""
    module = trained("published_segmenter")
    old = {f"module.{name}": value for name, value in module.state_dict().items() if "num_batches" not in name}
    torch.save(old, tmp_path / "old.pt")
    other = network("published_segmenter", 3)
    load(tmp_path / "old.pt", other)
    assert torch.equal(other.up1.double_conv[0].weight, module.up1.double_conv[0].weight)


def test_other_files_are_refused_in_one_line(tmp_path):
    save(tmp_path / "segmenter.safetensors", trained("segmenter"))
    (tmp_path / "damaged.pt").write_bytes(b"nothing")
    (tmp_path / "damaged.safetensors").write_bytes(b"nothing")
    torch.save([1, 2], tmp_path / "list.pt")
    for name, message in (
        ("segmenter.safetensors", "expected weights inc.double_conv.0.weight of shape .16, 1, 3, 3., found none"),
        ("damaged.pt", "expected a"),
        ("damaged.safetensors", "expected weights as safetensors, found a damaged file"),
        ("list.pt", "expected a state dictionary"),
        ("none.pt", "expected weights, .safetensors or .pt, found none"),
    ):
        with pytest.raises(InputError, match=message) as caught:
            load(tmp_path / name, network("published_segmenter", 3))
        assert str(caught.value).startswith(str(tmp_path / name)) and "\n" not in str(caught.value)


@pytest.mark.parametrize("suffix", [".safetensors", ".pt"])
def test_the_same_weights_are_the_same_bytes(suffix, tmp_path):
    """Under any name; torch would write that of the file, which while it is written has the process's number in it."""
    paths = [tmp_path / f"{name}{suffix}" for name in ("one", "other")]
    for path in paths:
        save(path, trained("segmenter"))
    assert paths[0].read_bytes() == paths[1].read_bytes()


def _weights(**changes):
    return {**trained("segmenter").state_dict(), **changes}


FIRST = "level1.double_conv.0.weight"  # 8 x 1 x 3 x 3


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({1: torch.zeros(3)}, "expected weights level1.* found none"),
        (_weights() | {1: torch.zeros(3)}, "expected weights of a Segmenter, found 1 too"),
        (_weights(**{"a\nb": torch.zeros(3)}), r"expected weights of a Segmenter, found 'a\\nb' too"),
        (_weights(**{"x" * 10_000: 1}), "expected weights of a Segmenter, found 'xxx"),
        (_weights(**{FIRST: 1.0}), f"expected weights {FIRST} of shape .*, found 1.0"),
        (_weights(**{FIRST: "9" * 10_000}), f"expected weights {FIRST} of shape .*, found '999"),
        (_weights(**{FIRST: torch.full((8, 1, 3, 3), torch.nan)}), f"weights {FIRST} .* numbers in it that aren't finite"),
        (_weights(**{FIRST: torch.zeros(8, 1, 3, 3, dtype=torch.complex64)}), f"weights {FIRST} .* another kind of tensor"),
        (_weights(**{FIRST: torch.zeros(8, 1, 3, 3).to_sparse()}), f"weights {FIRST} .* another kind of tensor"),
        (_weights(**{FIRST: torch.zeros(8, 1, 3, 3, device="meta")}), f"weights {FIRST} .* another kind of tensor"),
        (_weights(**{FIRST: torch.zeros(8, 1, 3, 3, dtype=torch.int64)}), f"weights {FIRST} .* another kind of tensor"),
    ],
)
def test_what_is_no_state_of_the_network_is_named(tmp_path, content, message, recwarn):
    torch.save(content, tmp_path / "weights.pt")
    with pytest.raises(InputError, match=message) as caught:
        load(tmp_path / "weights.pt", network("segmenter", 3))
    assert str(caught.value).isprintable() and len(str(caught.value)) < 400
    assert not recwarn.list


@pytest.mark.parametrize("suffix", [".safetensors", ".pt"])
def test_damage_at_random_ends_in_a_line(tmp_path, rng, suffix, recwarn):
    path = tmp_path / f"weights{suffix}"
    save(path, network("segmenter", 3))
    whole = path.read_bytes()
    for _ in range(60):
        content = bytearray(whole)
        for place in rng.integers(0, 6000, 3):
            content[place] = rng.integers(256)
        path.write_bytes(content[: rng.integers(len(content))] if rng.random() < 0.2 else content)
        try:
            load(path, network("segmenter", 3))
        except InputError as error:
            assert str(error).isprintable() and len(str(error)) < 400
    assert not recwarn.list
