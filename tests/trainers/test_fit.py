"""Training goes on where it was, to the bit, and learns."""
# ruff: noqa: E402 - torch is asked for before what needs it

import os
import signal
import subprocess
import sys
from dataclasses import replace
from multiprocessing import active_children

import pytest

torch = pytest.importorskip("torch")

from recon.errors import InputError
from tests.patience import PATIENCE_S
from trainers import fit
from trainers.architectures import Detector, Segmenter, begin_with_nothing
from trainers.fit import Plan, progress, rate, read_log
from trainers.shard_reader import in_memory, read_patches, read_views, split


def plan(name, steps, **changes):
    return Plan(
        **{"name": name, "batch": 4, "crop_px": 64, "learning_rate": 2e-3, "weight_decay": 0.01, "seed": 3} | changes,
        steps=steps,
        max_minutes=None,
    )


def small(name):
    torch.manual_seed(0)
    return Detector(3, 8) if name == "detector" else Segmenter((4, 4, 4))


@pytest.fixture(autouse=True)
def one_thread():
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


class Interrupted(Exception):
    """As if the machine had been switched off."""


@pytest.mark.parametrize("name", ["detector", "segmenter"])
def test_an_interrupted_training_ends_with_the_same_weights(name, data_set, tmp_path):
    """Switched off at step 7, after the checkpoint of step 5; log rows of steps that come again are there once.

    The last part's batches are made by two other processes. The whole one's images are in memory, the parts' are not.
    """
    data = split((read_views if name == "detector" else read_patches)([data_set]), 0.1)
    paths = [tmp_path / "whole", tmp_path / "parts"]
    for path in paths:
        path.mkdir()
    asked = plan(name, 10, log_steps=2)
    whole = fit.fit(small(name), *map(in_memory, data), asked, paths[0], lambda step, done, loss: None)

    def stop(step, done, loss):
        if step == 5:
            os.kill(os.getpid(), signal.SIGTERM)

    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    with pytest.raises(KeyboardInterrupt):
        fit.fit(small(name), *data, asked, paths[1], stop)
    signal.signal(signal.SIGTERM, before)

    def fail(step, done, loss):
        if step == 7:
            raise Interrupted

    with pytest.raises(Interrupted):
        fit.fit(small(name), *data, asked, paths[1], fail)
    helpers = []
    asked_with_helpers = replace(asked, loaders=2)
    parts = fit.fit(small(name), *data, asked_with_helpers, paths[1], lambda *_: helpers.append(len(active_children())))
    assert helpers == [2] * 5
    assert (whole.resumed_at, parts.resumed_at, parts.steps) == (0, 5, 10)
    for one, other in zip(whole.network.state_dict().values(), parts.network.state_dict().values(), strict=True):
        assert torch.equal(one, other)
    assert [row["step"] for row in read_log(paths[1])] == [2, 4, 6, 8, 10]


TRAINING = """
import sys
from pathlib import Path
import torch
from trainers import fit
from trainers.architectures import Segmenter
from trainers.shard_reader import read_patches, split
torch.set_num_threads(1)
plan = fit.Plan("segmenter", 4, 64, 1e-3, 0.01, 3, 100000, None, loaders=2)
data = split(read_patches([Path(sys.argv[1])]), 0.1)
fit.fit(Segmenter((4, 4, 4)), *data, plan, Path(sys.argv[2]), lambda step, *_: print(step, flush=True))
"""


def test_a_key_press_that_reaches_all_processes_leaves_a_checkpoint(data_set, tmp_path):
    """Ctrl+C in a terminal goes to those that make batches, too; the training must not fail for want of them."""
    running = subprocess.Popen(
        [sys.executable, "-c", TRAINING, str(data_set), str(tmp_path)],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True,
    )  # fmt: skip
    try:
        assert running.stdout.readline() == "1\n"
        os.killpg(running.pid, signal.SIGINT)
        _, told = running.communicate(timeout=PATIENCE_S)
    finally:
        if running.poll() is None:
            os.killpg(running.pid, signal.SIGKILL)
    assert "KeyboardInterrupt" in told and (tmp_path / fit.CHECKPOINT).is_file(), told


def test_weights_that_are_not_finite_are_not_saved(data_set, tmp_path):
    """Of gradients that overflow in the last step, whose loss was finite; and a loss that was none before is the data's."""
    data = split(read_patches([data_set]), 0.1)
    network = small("segmenter")
    next(network.parameters()).register_hook(lambda gradient: gradient * torch.inf)
    with pytest.raises(InputError, match=r"learning_rate: .* weights that aren't finite after step 1"):
        fit.fit(network, *data, plan("segmenter", 1), tmp_path, lambda *_: None)
    assert not (tmp_path / fit.CHECKPOINT).exists()
    network = small("segmenter")
    next(network.parameters()).data[:] = torch.nan
    with pytest.raises(InputError, match="data: expected samples with a finite loss"):
        fit.fit(network, *data, plan("segmenter", 1), tmp_path, lambda *_: None)


def test_the_learning_rate_rises_falls_and_ends(data_set):
    rates = [rate(k / 1000) for k in range(1001)]
    assert max(rates) == pytest.approx(1) and rates.index(max(rates)) == 50
    assert 0 < rates[0] < 0.05 and rates[-1] == pytest.approx(0.01)


def test_the_end_comes_with_steps_or_minutes():
    both = Plan("detector", 4, 64, 1e-3, 0, 0, 100, 2.0)
    assert progress(both, 50, 0) == 0.5 and progress(both, 50, 90) == 0.75 and progress(both, 0, 500) == 1


def test_a_tiny_segmenter_learns_the_drawn_discs(data_set, tmp_path):
    """In 50 steps from nothing to an outline that is right for most of a disc, and to none where there is none."""
    train, held = split(in_memory(read_patches([data_set])), 0.2)
    torch.manual_seed(0)
    fitted = fit.fit(
        Segmenter((4, 8, 16)), train, held, plan("segmenter", 50, batch=8, learning_rate=1e-2), tmp_path, lambda *_: None
    )
    figures = fit.measure(fitted.network, held)
    assert figures["iou"] > 0.8
    assert figures["centre_median_px"] < 4


@pytest.mark.slow
def test_a_small_detector_learns_the_drawn_targets(write, tmp_path):
    """Half a minute of training finds circles where they are, and the one that stands alone by its name.

    The target is far away, all of it within a few cells. c0 and c1 have alike surroundings: to tell them apart by where c2 lies
    takes thousands of steps more. That no augmentation mirrors them, and that labels bear their names, is tested by itself.
    """
    train, held = split(in_memory(read_views([write(tmp_path / "set", 75, sizes=(1.5, 2.2))])), 0.3)
    torch.manual_seed(0)
    asked = plan("detector", 400, batch=16, crop_px=64, learning_rate=8e-3)
    small = Detector(3, 24)
    begin_with_nothing(small.get_parameter("detection.3.bias"))
    figures = fit.measure(fit.fit(small, train, held, asked, tmp_path, lambda *_: None).network, held)
    assert figures["recall_c2"] > 0.8 and figures["identity_accuracy_c2"] > 0.8
    assert figures["place_median_full_px"] < 5 and figures["false_per_empty_view"] == 0
