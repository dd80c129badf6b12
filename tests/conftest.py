"""Fixtures that tests of all packages share."""

import gc
import logging
import os
import signal
import zlib
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # of NumPy's; two workers share two cores. Before NumPy is loaded
os.environ.setdefault("OMP_NUM_THREADS", "1")  # of torch

import numpy as np
import pytest
import yaml

from recon.model.rig import Rig
from twin.ultrasound.transducer import Transducer

ROOT = Path(__file__).resolve().parent.parent

for number in (signal.SIGINT, signal.SIGHUP):  # ignored in jobs of the background and under nohup, and so in all that they start
    if signal.getsignal(number) == signal.SIG_IGN:
        signal.signal(number, lambda *_: None)  # a handler isn't inherited: what tests start has the default again

logging.getLogger("recon.compiled").setLevel(logging.WARNING)  # verbs announce nothing: a test may count their lines


gc.disable()  # until all tests are collected: of these 8 000 and of modules nothing is garbage


@pytest.hookimpl(trylast=True)  # of those that are selected
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin each worker's half with its slow tests: at the end one takes quick ones from the other, and neither waits long."""
    slow, quick = ([item for item in items if (item.get_closest_marker("slow") is None) == fast] for fast in (False, True))
    first = len(slow) // 2
    rest = max(len(items) // 2 - first, 0)
    items[:] = [*slow[:first], *quick[:rest], *slow[first:], *quick[rest:]]


def pytest_collection_finish() -> None:
    """Collect garbage from now on, but look through none of what stays to the end."""
    gc.freeze()
    gc.enable()


@pytest.fixture
def rng(request: pytest.FixtureRequest) -> np.random.Generator:
    """A generator seeded by the test's name: the same in each run, another one for each test and parameter."""
    return np.random.default_rng(zlib.crc32(request.node.name.encode()))


@pytest.fixture(scope="session")
def rig() -> Rig:
    """The rig of Meza et al. 2021."""
    return Rig.model_validate(yaml.safe_load((ROOT / "conf/rig/meza2021.yaml").read_text(encoding="utf-8")))


@pytest.fixture(scope="session")
def scanners() -> dict[str, Transducer]:
    """The arrays and scanners of `conf/ultrasound`, by name."""
    files = (ROOT / "conf/ultrasound").glob("*.yaml")
    return {file.stem: Transducer.model_validate(yaml.safe_load(file.read_text(encoding="utf-8"))) for file in files}


@pytest.fixture(scope="session")
def real() -> Path:
    """The folder of real recordings: `SONOTWIN_REAL`, else `shared/real` beside the clone; skips the test without it."""
    folder = Path(os.environ.get("SONOTWIN_REAL") or ROOT.parent / "shared" / "real")
    if not folder.is_dir():
        pytest.skip(f"no real recordings in {folder}; SONOTWIN_REAL names another folder")
    return folder
