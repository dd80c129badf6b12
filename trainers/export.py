"""Weights as files: .safetensors, .pt of torch, and ONNX for the tracker, which needs no torch."""

import io
import struct
import warnings
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from pickle import UnpicklingError
from typing import Any, Literal

import numpy as np
import onnxruntime
import safetensors.torch
import torch
from safetensors import SafetensorError
from torch import Tensor, nn

from recon.errors import InputError, brief, reason
from recon.files import atomic
from recon.tracking.networks import TRAINED_FOR, WEIGHTS
from trainers import architectures
from trainers.architectures import Name, weights_of
from trainers.batches import SCAN
from trainers.shard_reader import PATCH, VIEW

SHIPPED = Path("shipped")  # in the place of folders: the published networks that come with sonotwin
OPSET = 17
DAMAGE = (  # what reading damaged files of weights ends in
    *(RuntimeError, EOFError, ValueError, TypeError, LookupError, AttributeError, AssertionError, ArithmeticError),
    *(OSError, MemoryError, NameError, struct.error, zipfile.BadZipFile),
)
MOST_BYTES = 1 << 29  # of a checkpoint's parts, once they are unpacked
INTERFACES = {  # names of input and outputs, and a size
    "detector": ("image", ("detection", "identity"), VIEW),
    "segmenter": ("patch", ("mask",), (PATCH, PATCH)),
    "masses": ("scan", ("mask",), SCAN),
}
AGREEMENT = 1e-4  # of the largest logit, most between torch and ONNX Runtime


def save(path: Path, network: nn.Module) -> None:
    """Write weights as .safetensors or .pt, by the path's suffix; the same weights give the same bytes."""
    if path.suffix == ".pt":
        write_state(path, weights_of(network))
        return
    with atomic.new_file(path) as temporary:
        temporary.write_bytes(safetensors.torch.save(dict(weights_of(network))))  # its own writer lets nobody else read


def write_state(path: Path, state: Mapping) -> None:
    """Write a dictionary as torch does, but for the name of a file to write to, which torch would write into it."""
    content = io.BytesIO()
    torch.save(dict(state), content)
    with atomic.new_file(path) as temporary:
        temporary.write_bytes(content.getbuffer())


def load(path: Path, network: nn.Module) -> None:
    """Read weights, .safetensors or a state dictionary of torch (.pt, .pth), into a network.

    Raises
    ------
    InputError
        If the file is missing, damaged, or of another network.
    """
    weights = _read(path)
    # torch pads names of modules that ran in parallel
    weights = {name.removeprefix("module.") if isinstance(name, str) else name: value for name, value in weights.items()}
    expected = network.state_dict()
    weights |= {name: value for name, value in expected.items() if name.endswith("num_batches_tracked") and name not in weights}
    unknown = next((name for name in weights if name not in expected), None)
    check_tensors(path, "weights", weights, expected)
    if unknown is not None:
        raise InputError(f"{path}: expected weights of a {type(network).__name__}, found {brief(unknown)} too")
    network.load_state_dict(weights)


def copy_published(
    sources: Sequence[Path], folder: Path, names: Mapping[Literal["published_detector", "published_segmenter"], str]
) -> str:
    """Write published networks, of three circles, under the names that other programs load; returns a line about them.

    Parameters
    ----------
    sources : folders, in one of which detector.pt lies, and in one segmenter.pt; or SHIPPED alone
    names : network -> file

    Raises
    ------
    InputError
        If a file is in none of the folders or in several, damaged, or of another network, with the way to such a one.
    """
    for network, name in names.items():
        path, module = _published(network, sources), architectures.network(network, circles=3)
        try:
            load(path, module)
        except InputError as error:
            raise InputError(f"{error}; sonotwin train network={network} makes the published shape") from None
        save(folder / name, module)
    return f"networks    {', '.join(names.values())}"


def _published(network: str, sources: Sequence[Path]) -> Path:
    if list(sources) == [SHIPPED]:
        return WEIGHTS / f"{network}.safetensors"
    file = f"{network.removeprefix('published_')}.pt"
    there = [path for source in sources if (path := source / file).exists()]
    if len(there) != 1:
        places = ", ".join(map(str, sources))
        raise InputError(f"networks: expected {file} in one folder of {places}, found it in {len(there)}; or give {SHIPPED}")
    return there[0]


def check_tensors(path: Path, kind: str, found: object, expected: Mapping[Any, Tensor]) -> None:
    """Refuse, in one line, a dictionary that hasn't all expected tensors: of their shapes, in memory, of finite numbers."""
    if not isinstance(found, Mapping):
        raise InputError(f"{path}: expected {kind}, a dictionary of tensors, found {brief(found)}")
    for name, value in expected.items():
        there, wanted = found.get(name), f"{path}: expected {kind} {name} of shape {list(value.shape)}"
        if there is None:
            raise InputError(f"{wanted}, found none")
        if not isinstance(there, Tensor):
            raise InputError(f"{wanted}, found {brief(there)}")
        if there.shape != value.shape:
            raise InputError(f"{wanted}, found {list(there.shape)}")
        plain = there.layout == torch.strided and there.device.type == "cpu" and not (there.is_quantized or there.is_nested)
        if not plain or there.is_floating_point() != value.is_floating_point() or there.is_complex():
            raise InputError(f"{wanted}, found {there.dtype} of another kind of tensor")
        if not bool(torch.isfinite(there.float()).all()):
            raise InputError(f"{wanted}, found numbers in it that aren't finite")


def read_state(path: Path) -> dict:
    """Read a dictionary that torch saved: tensors, numbers and text only, no code.

    Raises
    ------
    InputError
        If the file is damaged or something else.
    """
    _check_parts(path)
    try:
        with warnings.catch_warnings(action="ignore"):  # torch's on how such files were written: what counts is checked
            state = torch.load(path, map_location="cpu", weights_only=True)
    except UnpicklingError:
        raise InputError(f"{path}: expected a state dictionary of torch, found something else") from None
    except DAMAGE as error:
        raise InputError(f"{path}: expected a file that torch saved, found a damaged one: {reason(error)}") from None
    if not isinstance(state, dict):
        raise InputError(f"{path}: expected a state dictionary of torch, found something else")
    return state


def _check_parts(path: Path) -> None:
    """Refuse an archive with a damaged or a bloated table of its parts, for which torch would take as much memory as it says."""
    try:
        with path.open("rb") as stream:
            if stream.read(2) != b"PK":  # written by torch before 1.6
                return
            with zipfile.ZipFile(stream) as archive:
                size = sum(part.file_size for part in archive.infolist())
    except DAMAGE as error:
        raise InputError(f"{path}: expected a file that torch saved, found a damaged one: {reason(error)}") from None
    if size > MOST_BYTES:
        raise InputError(f"{path}: expected at most {MOST_BYTES >> 20} MiB of weights, found {size >> 20} MiB")


def _read(path: Path) -> dict[Any, Any]:
    if not path.is_file():
        raise InputError(f"{path}: expected weights, .safetensors or .pt, found none")
    if path.suffix != ".safetensors":
        return read_state(path)
    try:
        return safetensors.torch.load_file(path)
    except (SafetensorError, *DAMAGE) as error:
        raise InputError(f"{path}: expected weights as safetensors, found a damaged file: {reason(error)}") from None


def save_onnx(path: Path, network: nn.Module, name: Name, kind: str = "") -> None:
    """Write ONNX with free batch, height and width, for a kind of target if any, and make sure of its answers.

    Raises
    ------
    RuntimeError
        If it doesn't.
    """
    network = network.eval().to("cpu").float()
    given, answers, (width, height) = INTERFACES[name.removeprefix("published_")]
    axes = {given: {0: "n", 2: "h", 3: "w"}} | {answer: {0: "n", 2: f"h_{answer}", 3: f"w_{answer}"} for answer in answers}
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
        with temporary.open("ab") as file:
            file.write(_metadata(TRAINED_FOR, kind) if kind else b"")
        _check(temporary, network, example)
        _check(temporary, network, example[:1, :, : height // 2 // 16 * 16, : width // 2 // 16 * 16])


def _metadata(key: str, value: str) -> bytes:
    """An entry of `metadata_props`, field 14 of ONNX's ModelProto, which may stand at a file's end; of short texts."""
    entry = b"".join(bytes([field << 3 | 2, len(text)]) + text.encode("ascii") for field, text in ((1, key), (2, value)))
    return bytes([14 << 3 | 2, len(entry)]) + entry


@torch.no_grad()
def _check(path: Path, network: nn.Module, example: Tensor) -> None:
    session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    found = session.run(None, {session.get_inputs()[0].name: example.numpy()})
    wanted = network(example)
    for one, other in zip(found, wanted if isinstance(wanted, tuple) else (wanted,), strict=True):
        difference = float(np.abs(one - other.numpy()).max() / max(float(other.abs().max()), 1.0))
        if difference > AGREEMENT:
            raise RuntimeError(f"{path}: ONNX Runtime differs from torch by {difference:.2g}")
