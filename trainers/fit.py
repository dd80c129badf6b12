"""Training loop, resumable at any step: a step's batch depends on the seed and the step's number alone."""

import json
import logging
import math
from collections.abc import Callable, Mapping
from copy import deepcopy
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import Annotated, Literal

import numpy as np
import torch
from pydantic import ConfigDict, Field, RootModel
from torch import Tensor, nn

from recon import interrupts
from recon.errors import InputError, validated
from recon.files import atomic, json_text
from recon.files.regular import read_bytes
from trainers import checkpoints
from trainers.architectures import Name, is_detector
from trainers.batches import SCALES, Batches
from trainers.checkpoints import TRAIN
from trainers.labels import Labels, detector_loss, segmenter_loss
from trainers.network_metrics import measure_detector, measure_masses, measure_segmenter
from trainers.scan_reader import Scans
from trainers.shard_reader import Data, Patches, Views, chosen

CHECKPOINT, LOG = "checkpoint.pt", "log.jsonl"
WARM_UP = 0.05  # of the training, over which the learning rate rises
LAST_RATE = 0.01  # of the highest learning rate, at the end
CLIP = 5.0  # most of the gradient's norm
NO_LOSS = "data: expected samples with a finite loss, found one without before the first weight changed"
AVERAGE = 0.998  # of the averaged weights that stays in a step, once there were enough steps

Precision = Literal["auto", "32-true", "bf16-mixed"]
Row = dict[str, Annotated[int | float, Field(allow_inf_nan=False)] | None]


class _Row(RootModel[Row]):
    model_config = ConfigDict(strict=True)


@dataclass(frozen=True)
class Plan:
    """Settings of a training. The end comes with `steps` or `max_minutes`, whichever is first."""

    name: Name
    batch: int
    crop_px: int  # of a detector's crops
    learning_rate: float  # the highest
    weight_decay: float
    seed: int
    steps: int | None
    max_minutes: float | None
    checkpoint_minutes: float = 5.0
    log_steps: int = 50
    validate_at_most: int = 200  # views or patches at each checkpoint; at the end it is all
    precision: Precision = "auto"
    loaders: int = 0  # processes that make batches ahead
    scales: tuple[float, float] = SCALES  # least and most, of the views that a detector's crops are of


@dataclass(frozen=True)
class Fitted:
    """A trained network: its averaged weights, which are better than the last ones."""

    network: nn.Module
    steps: int
    seconds: float
    resumed_at: int


Tell = Callable[[int, float, float], None]  # step, share of the training that is done, loss


def fit(start: nn.Module, train: Data, validation: Data, plan: Plan, folder: Path, tell: Tell) -> Fitted:
    """Train, or go on where `folder` has a checkpoint.

    Raises
    ------
    KeyboardInterrupt
        On Ctrl-C, or whatever the handlers of SIGTERM and SIGHUP raise, once the checkpoint is written.
    """
    from lightning_fabric import Fabric  # takes seconds to import

    for name in ("lightning_utilities.core.rank_zero", "lightning_fabric.utilities.rank_zero"):
        logging.getLogger(name).setLevel(logging.WARNING)  # it would say which precision it takes
    fabric = Fabric(accelerator="auto", devices=1, precision=precision_of(plan.precision))
    plain = start.to(memory_format=torch.channels_last)  # pyrefly: ignore[no-matching-overload]
    optimizer = torch.optim.AdamW(_groups(plain, plan.weight_decay), lr=plan.learning_rate)
    average = deepcopy(plain).requires_grad_(False)
    module, optimizer = fabric.setup(plain, optimizer)
    average = average.to(fabric.device)
    networks, samples = {"network": plain, "average": average}, (len(train), len(validation))
    step, before = checkpoints.resume(folder / CHECKPOINT, networks, optimizer, samples)
    resumed_at = step
    _forget_later(folder, step)
    began = written = perf_counter()
    losses: list[float] = []
    survivable = f"learning_rate: expected one that training survives, found {plan.learning_rate:g}"
    shown = chosen(validation, np.unique(np.linspace(0, len(validation) - 1, plan.validate_at_most).round().astype(int)))

    def save() -> None:
        if not all(weights.isfinite().all() for network in networks.values() for weights in network.parameters()):
            raise InputError(f"{survivable}: weights that aren't finite after step {step}; the last checkpoint stays")
        checkpoints.write(folder / CHECKPOINT, networks, optimizer, samples, step, seconds)
        if (folder / LOG).is_file():
            atomic.list_again(folder, LOG, TRAIN)

    batches = Batches(train, plan.batch, plan.crop_px, plan.seed, plan.scales).since(step, plan.loaders)
    with interrupts.held_back() as came:
        seconds = before
        while (done := progress(plan, step, seconds)) < 1:
            for group in optimizer.param_groups:
                group["lr"] = plan.learning_rate * rate(done)
            module.train()
            loss = _loss(module, plan.name, fabric.to_device(next(batches)))
            optimizer.zero_grad(set_to_none=True)
            fabric.backward(loss)
            fabric.clip_gradients(module, optimizer, max_norm=CLIP, error_if_nonfinite=False)
            optimizer.step()
            _blend(average, plain, min(AVERAGE, (1 + step) / (10 + step)))
            step += 1
            seconds = before + perf_counter() - began
            losses.append(float(loss.detach()))
            if not math.isfinite(losses[-1]):
                raise InputError(f"{survivable}: step {step}" if step > 1 else NO_LOSS)
            tell(step, progress(plan, step, seconds), losses[-1])
            if step % plan.log_steps == 0 or progress(plan, step, seconds) >= 1:
                row = {"step": step, "seconds": round(seconds, 2), "loss": float(np.mean(losses)), "rate": rate(done)}
                _append(folder / LOG, row)
                losses.clear()
            if came:
                save()
                raise KeyboardInterrupt
            if perf_counter() - written > 60 * plan.checkpoint_minutes:
                save()
                looked = perf_counter()
                _append(folder / LOG, {"step": step, "seconds": round(seconds, 2)} | measure(average, shown))
                written = perf_counter()
                began += written - looked  # looking is no training
    save()
    return Fitted(average.cpu(), step, seconds, resumed_at)


def measure(module: nn.Module, data: Data) -> dict[str, float | int]:
    """Figures of a network, as of `trainers.network_metrics`, in 32 bits."""
    looked_at = deepcopy(module).cpu().float()
    match data:
        case Views():
            return measure_detector(looked_at, data)
        case Patches():
            return measure_segmenter(looked_at, data)
        case Scans():
            return measure_masses(looked_at, data)


def progress(plan: Plan, step: int, seconds: float) -> float:
    """Share of the training that is done, 0 to 1."""
    by_steps = step / plan.steps if plan.steps else 0.0
    return min(max(by_steps, seconds / (60 * plan.max_minutes) if plan.max_minutes else 0.0), 1.0)


def rate(done: float) -> float:
    """Learning rate relative to the highest: up evenly, then down along a cosine."""
    if done < WARM_UP:
        return (done + 0.02 * WARM_UP) / (1.02 * WARM_UP)
    return LAST_RATE + (1 - LAST_RATE) * 0.5 * (1 + math.cos(math.pi * (done - WARM_UP) / (1 - WARM_UP)))


def precision_of(wanted: Precision) -> Literal["32-true", "bf16-mixed"]:
    """16 bits where the machine reckons with them, else 32: without the instructions they are slower."""
    if wanted != "auto":
        return wanted
    if torch.cuda.is_available():
        return "bf16-mixed" if torch.cuda.is_bf16_supported(including_emulation=False) else "32-true"
    path = Path("/proc/cpuinfo")
    flags = path.read_text(encoding="utf-8") if path.is_file() else ""
    return "bf16-mixed" if "avx512_bf16" in flags or "amx_bf16" in flags else "32-true"


def read_log(folder: Path) -> list[Row]:
    """Rows of the log so far.

    Raises
    ------
    InputError
        If a line isn't a row: a map of numbers, or null, with its step.
    """
    path = folder / LOG
    *whole, _ = read_bytes(path).split(b"\n") if path.is_file() else [b""]  # the last one may be cut short
    return [_row(f"{path}: line {number}", line) for number, line in enumerate(whole, 1)]


def _row(place: str, line: bytes) -> Row:
    try:
        row = validated(_Row, json_text.of_bytes(Path(place), line), place).root
    except InputError as error:
        raise InputError(f"{error}; resume=false starts anew") from None
    if not isinstance(row.get("step"), int):
        raise InputError(f"{place}: expected a row with its step, a whole number, found none; resume=false starts anew")
    return row


def _loss(module: nn.Module, name: Name, batch: tuple[Tensor, Tensor, Tensor]) -> Tensor:
    images, *wanted = batch
    answer = module(images.contiguous(memory_format=torch.channels_last))
    if is_detector(name):
        detection, identity = answer
        return detector_loss(detection.float(), identity.float(), Labels(*wanted))
    return segmenter_loss(answer.float(), *wanted)


def _groups(module: nn.Module, decay: float) -> list[dict]:
    """Parameters with and without decay: biases and norms have none."""
    matrices = [value for value in module.parameters() if value.ndim > 1]
    others = [value for value in module.parameters() if value.ndim <= 1]
    return [{"params": matrices, "weight_decay": decay}, {"params": others, "weight_decay": 0.0}]


@torch.no_grad()
def _blend(average: nn.Module, module: nn.Module, stays: float) -> None:
    for old, new in zip(average.state_dict().values(), module.state_dict().values(), strict=True):
        if old.is_floating_point():
            old.lerp_(new, 1 - stays)
        else:
            old.copy_(new)


def _append(path: Path, row: Mapping[str, float | int]) -> None:
    finite = {name: value if math.isfinite(value) else None for name, value in row.items()}
    if not path.exists():
        with atomic.listed_file(path.parent, path.name, TRAIN, grows=True) as temporary:
            temporary.touch()
    with atomic.named_in_errors(path), path.open("a", encoding="utf-8") as file:
        file.write(json.dumps(finite) + "\n")


def _forget_later(folder: Path, step: int) -> None:
    """Drop rows of steps after the checkpoint: they come again."""
    if (folder / LOG).is_file():
        kept = [row for row in read_log(folder) if (row["step"] or 0) <= step]
        with atomic.listed_file(folder, LOG, TRAIN, grows=True) as temporary:
            temporary.write_text("".join(f"{json.dumps(row)}\n" for row in kept), encoding="utf-8")
