"""Weights as files: .safetensors, .pt of torch, and ONNX for the tracker, which needs no torch."""

import warnings
from pathlib import Path
from pickle import UnpicklingError

import numpy as np
import onnxruntime
import safetensors.torch
import torch
from safetensors import SafetensorError
from torch import Tensor, nn

from recon.errors import InputError
from recon.files import atomic
from trainers.architectures import Name, is_detector, weights_of
from trainers.shard_reader import PATCH, VIEW

OPSET = 17
AGREEMENT = 1e-4  # of the largest logit, most between torch and ONNX Runtime


def save(path: Path, network: nn.Module) -> None:
    """Write weights as .safetensors or .pt, by the path's suffix."""
    with atomic.new_file(path) as temporary:
        if path.suffix == ".pt":
            torch.save(weights_of(network), temporary)
        else:
            temporary.write_bytes(safetensors.torch.save(dict(weights_of(network))))  # its own writer lets nobody else read


def load(path: Path, network: nn.Module) -> None:
    """Read weights, .safetensors or a state dictionary of torch (.pt, .pth), into a network.

    Raises
    ------
    InputError
        If the file is missing, damaged, or of another network.
    """
    weights = _read(path)
    # torch pads names of modules that ran in parallel
    weights = {name.removeprefix("module."): value for name, value in weights.items()}
    expected = network.state_dict()
    weights |= {name: value for name, value in expected.items() if name.endswith("num_batches_tracked") and name not in weights}
    for name, value in expected.items():
        found = weights.get(name)
        if found is None or found.shape != value.shape:
            shape = "none" if found is None else list(found.shape)
            raise InputError(f"{path}: expected weights {name} of shape {list(value.shape)}, found {shape}")
    unknown = sorted(set(weights) - set(expected))
    if unknown:
        raise InputError(f"{path}: expected weights of a {type(network).__name__}, found {unknown[0]} too")
    network.load_state_dict(weights)


def read_state(path: Path) -> dict:
    """Read a dictionary that torch saved: tensors, numbers and text only, no code.

    Raises
    ------
    InputError
        If the file is damaged or something else.
    """
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
    except (RuntimeError, EOFError, ValueError, KeyError) as error:
        raise InputError(f"{path}: expected a file that torch saved, found a damaged one: {_first(error)}") from None
    except UnpicklingError:
        raise InputError(f"{path}: expected a state dictionary of torch, found something else") from None
    if not isinstance(state, dict):
        raise InputError(f"{path}: expected a state dictionary of torch, found something else")
    return state


def _read(path: Path) -> dict[str, Tensor]:
    if not path.is_file():
        raise InputError(f"{path}: expected weights, .safetensors or .pt, found none")
    if path.suffix == ".safetensors":
        try:
            return safetensors.torch.load_file(path)
        except SafetensorError as error:
            raise InputError(f"{path}: expected weights as safetensors, found a damaged file: {_first(error)}") from None
    weights = read_state(path)
    if not all(isinstance(value, Tensor) for value in weights.values()):
        raise InputError(f"{path}: expected a state dictionary of weights, found something else")
    return weights


def save_onnx(path: Path, network: nn.Module, name: Name) -> None:
    """Write ONNX with free batch, height and width, and make sure that ONNX Runtime gives the same answers.

    Raises
    ------
    RuntimeError
        If it doesn't.
    """
    network = network.eval().to("cpu").float()
    given, answers = ("image", ("detection", "identity")) if is_detector(name) else ("patch", ("mask",))
    axes = {given: {0: "n", 2: "h", 3: "w"}} | {answer: {0: "n", 2: f"h_{answer}", 3: f"w_{answer}"} for answer in answers}
    width, height = VIEW if is_detector(name) else (PATCH, PATCH)
    example = torch.rand(2, 1, height, width, generator=torch.Generator().manual_seed(0))
    with atomic.new_file(path) as temporary:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", category=DeprecationWarning)  # of the exporter that gives free sizes without a fuss
            warnings.filterwarnings("ignore", category=UserWarning)
            torch.onnx.export(
                network,
                (example,),
                str(temporary),
                input_names=[given],
                output_names=list(answers),
                dynamic_axes=axes,
                opset_version=OPSET,
                dynamo=False,
            )
        _check(temporary, network, example)
        _check(temporary, network, example[:1, :, : height // 2 // 8 * 8, : width // 2 // 8 * 8])


@torch.no_grad()
def _check(path: Path, network: nn.Module, example: Tensor) -> None:
    session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    found = session.run(None, {session.get_inputs()[0].name: example.numpy()})
    wanted = network(example)
    for one, other in zip(found, wanted if isinstance(wanted, tuple) else (wanted,), strict=True):
        difference = float(np.abs(one - other.numpy()).max() / max(float(other.abs().max()), 1.0))
        if difference > AGREEMENT:
            raise RuntimeError(f"{path}: ONNX Runtime differs from torch by {difference:.2g}")


def _first(error: Exception) -> str:
    return (str(error).strip().splitlines() or [type(error).__name__])[0]
