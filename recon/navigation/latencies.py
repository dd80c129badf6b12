"""Latencies of what was published, and how often: figures over the last seconds."""

from collections import deque
from dataclasses import dataclass, field
from threading import Lock

import numpy as np


@dataclass(frozen=True)
class Latency:
    """Figures of the last ten seconds."""

    median_ms: float
    high_ms: float  # 99 of 100 are below
    rate_hz: float


@dataclass
class Latencies:
    """Times at which things were exposed and published."""

    _pairs: deque[tuple[int, int]] = field(default_factory=deque)
    _lock: Lock = field(default_factory=Lock)

    def add(self, exposed_ns: int, published_ns: int) -> None:
        """Take in one, by monotonic times."""
        remembered_ns = 10_000_000_000
        with self._lock:
            self._pairs.append((exposed_ns, published_ns))
            while self._pairs[0][1] < published_ns - remembered_ns:
                self._pairs.popleft()

    def figures(self) -> Latency | None:
        """Median, 99 %, and number a second; None of less than two."""
        with self._lock:
            pairs = np.array(self._pairs, np.int64).reshape(-1, 2)
        fewest = 2  # of which figures are made
        if len(pairs) < fewest or pairs[-1, 1] <= pairs[0, 1]:
            return None
        median, high = np.percentile((pairs[:, 1] - pairs[:, 0]) * 1e-6, [50, 99])
        return Latency(float(median), float(high), (len(pairs) - 1) / float(pairs[-1, 1] - pairs[0, 1]) * 1e9)
