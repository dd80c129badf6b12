"""Accuracy of devices' clocks: arrivals drawn with delays of three kinds, clocks that drift, and clocks that are set anew."""

from collections.abc import Callable, Mapping
from logging import LogRecord

import numpy as np
from numpy.typing import NDArray

from recon.devices.device_clocks import LOG, WINDOW, ClockFollower, Jump, fit_clock
from twin.evaluation.surface_errors import rms
from twin.experiments.experiment_setup import Figures, Setup

Times = NDArray[np.int64]
Delays = Callable[[np.random.Generator, int], NDArray[np.float64]]

FRAME_NS = 20_000_000
TRANSFER_NS = 8_000_000  # of the fastest frame
START_NS = 10**18  # of a device's clock that counts from 1970
CRYSTALS = 5e-5  # standard deviation of a device's rate
DRAWS = 200
STEPS = 300  # jumps that are drawn
SHORTEST_S, LONGEST_S = 0.01, 3600.0
LOAD_FRAMES = 90_000  # half an hour, a third of it under load
SEED = 12

DELAYS: Mapping[str, Delays] = {
    "exponential, 0.3 ms": lambda rng, n: rng.exponential(3e5, n),
    "normal, one-sided, 0.3 ms": lambda rng, n: np.abs(rng.normal(0, 3e5, n)),
    "0.1 ms, and 10 ms in a fifth of the frames": lambda rng, n: np.where(
        rng.random(n) < 0.2, rng.exponential(1e7, n), rng.exponential(1e5, n)
    ),
}


def maps(setup: Setup, delays: str, draws: int = DRAWS) -> Figures:
    """Error of a map at the newest of its frames, and of the rate."""
    rng, errors, rates, sigmas = np.random.default_rng(SEED), [], [], []
    for _ in range(draws):
        rate = 1 + CRYSTALS * rng.standard_normal()
        device, true, arrived = drawn(rng, WINDOW, rate, DELAYS[delays])
        clock = fit_clock(device, arrived)
        errors.append((clock.at(int(device[-1])) - int(true[-1]) - TRANSFER_NS) / 1e3)
        sigmas.append(clock.sigma_at(int(device[-1])) / 1e3)
        rates.append(1e6 * (clock.rate - rate))
    inside, newest = np.mean(np.abs(errors) < 3 * np.array(sigmas)), np.quantile(np.abs(errors), 0.95)
    return {"frames": WINDOW, "newest_us": newest, "rate_ppm": rms(np.array(rates)), "inside": inside}


def jumps(setup: Setup, clocks: int = STEPS) -> Figures:
    """Clocks that are set forward or back by 10 ms to an hour, under delays of any kind."""
    rng, found, off = np.random.default_rng(SEED), 0, []
    for draw in range(clocks):
        device, _, arrived = drawn(rng, 700, 1 + CRYSTALS * rng.standard_normal(), list(DELAYS.values())[draw % len(DELAYS)])
        step = rng.choice([-1, 1]) * np.exp(rng.uniform(np.log(SHORTEST_S), np.log(LONGEST_S)))
        at = int(rng.integers(100, 500))
        device[at:] += round(1e9 * step)
        named = followed(device, arrived)
        if len(named) == 1 and named[0].device_ns == device[at]:
            found += 1
            off.append(abs(named[0].step_ns / 1e6 - 1e3 * step))
    return {"clocks": clocks, "named": found / clocks, "step_ms": np.median(off)}


def load(setup: Setup, frames: int = LOAD_FRAMES) -> Figures:
    """Jumps found where a busy computer takes frames over late, by 30 ms on average for a third of the time."""
    rng = np.random.default_rng(SEED)
    device, _, arrived = drawn(rng, frames, 1 + CRYSTALS, DELAYS["0.1 ms, and 10 ms in a fifth of the frames"])
    third = frames // 3
    arrived[third : 2 * third] += np.int64(rng.exponential(3e7, third))
    return {"false": len(followed(device, np.maximum.accumulate(arrived)))}


def drawn(rng: np.random.Generator, n: int, rate: float, delays: Delays) -> tuple[Times, Times, Times]:
    """Times of n frames by the device's clock, the same by this computer's, and arrivals, in ns."""
    device = START_NS + FRAME_NS * np.arange(n)
    true = 5 * 10**12 + np.int64(np.round(rate * FRAME_NS * np.arange(n)))
    return device, true, true + TRANSFER_NS + np.int64(delays(rng, n))


def followed(device_ns: Times, arrived_ns: Times) -> list[Jump]:
    """Jumps found while a clock is followed; their warnings, hundreds, are left out."""
    follower = ClockFollower("cam1")
    LOG.addFilter(_unheard)
    try:
        found = [follower.add(int(device), int(arrived)) for device, arrived in zip(device_ns, arrived_ns, strict=True)]
    finally:
        LOG.removeFilter(_unheard)
    return [jump for jump in found if jump]


def _unheard(record: LogRecord) -> bool:
    return False
