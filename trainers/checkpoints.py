"""The state of a training on disk: written so that it goes on to the bit, and checked field by field when it is read."""

import math
from collections.abc import Mapping
from pathlib import Path

import torch
from torch import Tensor, nn

from recon.errors import InputError
from recon.files import atomic
from trainers.export import check_tensors, read_state, write_state

TRAIN = "train"  # who writes
COUNTER = "step"  # of AdamW, one for each parameter
MOMENTS = ("exp_avg", "exp_avg_sq")


def write(
    path: Path,
    networks: Mapping[str, nn.Module],
    optimizer: torch.optim.Optimizer,
    samples: tuple[int, int],
    step: int,
    seconds: float,
) -> None:
    """Write networks by their names, the optimizer's moments, the numbers of samples, the step and the time that it took."""
    states = {name: network.state_dict() for name, network in networks.items()}
    with atomic.listed_file(path.parent, path.name, TRAIN) as temporary:
        state = {"optimizer": optimizer.state_dict(), "samples": samples, "step": step, "seconds": seconds}
        write_state(temporary, {**states, **state})


def resume(
    path: Path, networks: Mapping[str, nn.Module], optimizer: torch.optim.Optimizer, samples: tuple[int, int]
) -> tuple[int, float]:
    """Step and seconds of a checkpoint, whose state is put in place; 0 without one.

    Raises
    ------
    InputError
        If it is damaged, of another network, or of another number of samples to train and to validate with: a data set that has
        grown gives other batches, and validates with what was trained with.
    """
    if not path.is_file():
        return 0, 0.0
    state = read_state(path)
    there = state.get("samples", samples)  # older ones have none
    if not (isinstance(there, list | tuple) and len(there) == 2 and all(type(count) is int for count in there)):
        raise InputError(f"{path}: samples: expected two whole numbers, found something else; resume=false starts anew")
    if tuple(there) != samples:
        one, other = (f"{train} and {held} samples" for train, held in (samples, there))
        raise InputError(f"{path}: expected a checkpoint of {one}, to train and to validate, found one of {other}; resume=false")
    step, seconds = state.get("step"), state.get("seconds")
    if type(step) is not int or not 0 <= step < 1 << 62:
        raise InputError(f"{path}: step: expected a whole number from 0, found something else; resume=false starts anew")
    if not isinstance(seconds, int | float) or not 0 <= seconds < math.inf:
        raise InputError(f"{path}: seconds: expected a number from 0, found something else; resume=false starts anew")
    for name, network in networks.items():
        check_tensors(path, name, state.get(name), network.state_dict())
    moments = _moments(path, state.get("optimizer"), optimizer, step)
    for name, network in networks.items():
        network.load_state_dict({key: state[name][key] for key in network.state_dict()})
    optimizer.load_state_dict({"state": moments, "param_groups": optimizer.state_dict()["param_groups"]})
    return step, float(seconds)


def _moments(path: Path, found: object, optimizer: torch.optim.Optimizer, step: int) -> dict[int, dict[str, Tensor]]:
    """The optimizer's state, by its parameters' numbers; rates and decays are those that were asked for, not the file's."""
    states = found.get("state") if isinstance(found, Mapping) else None
    if not isinstance(states, Mapping):
        raise InputError(f"{path}: optimizer: expected the state of one, found something else; resume=false starts anew")
    if step == 0:
        return {}
    parameters = [parameter for group in optimizer.param_groups for parameter in group["params"]]
    result = {}
    for number, parameter in enumerate(parameters):
        expected = {COUNTER: torch.zeros(()), **dict.fromkeys(MOMENTS, parameter)}
        check_tensors(path, f"optimizer.{number}", states.get(number), expected)
        result[number] = {name: states[number][name] for name in expected}
    return result
