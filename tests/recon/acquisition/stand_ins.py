"""Cameras, a projector and an operator without any light transport: an image is a reflectance times the pattern."""

from collections import deque
from collections.abc import Sequence

import numpy as np

from recon.acquisition.guidance import Answer, Step
from recon.devices.interfaces import DeviceError, Frame, Trigger

SIZE = (128, 96)
RASTER = (160, 100)


class Bench:
    """Projector and cameras before a plate; the time goes on by 10 ms with each deed."""

    def __init__(self, reflectance: np.ndarray | float = 0.5) -> None:
        self.size = RASTER
        self.reflectance = np.broadcast_to(reflectance, SIZE[::-1]).astype(float)
        self.pattern = np.zeros(RASTER[::-1], np.uint8)
        self.now, self.shows = 0, 0

    def show(self, pattern: np.ndarray) -> int:
        self.pattern, self.shows = pattern, self.shows + 1
        self.now += 10_000_000
        return self.now

    def close(self) -> None:
        pass

    def light(self) -> np.ndarray:
        """Of the pattern, where each camera pixel looks at."""
        v, u = (np.arange(side) for side in SIZE[::-1])
        return self.pattern[v[:, None] + 2, u[None] + 16] / 255

    def seen(self, camera: str) -> np.ndarray:
        """What arrives at a camera's pixels : (h, w), white on white is 1."""
        return self.reflectance * (0.02 + self.light())


class BenchCamera:
    """Sees the bench; 10 ms of white on white are 0.8 of full scale."""

    def __init__(self, name: str, bench: Bench, bits: int = 8) -> None:
        self.name, self.size, self.bits = name, SIZE, bits
        self.exposure_s, self.gain = 0.01, 1.0
        self.number, self.unplugged = 0, False
        self._bench, self._waiting = bench, deque[Frame]()

    def set_exposure(self, exposure_s: float, gain: float) -> None:
        self.exposure_s, self.gain = exposure_s, gain

    def start(self, trigger: Trigger) -> None:
        self.number = 0

    def trigger(self) -> None:
        self.expose()

    def expose(self) -> None:
        full = 2**self.bits - 1
        light = self._bench.seen(self.name) * self.exposure_s * self.gain / 0.01 * 0.8
        image = np.minimum(np.rint(light * full), full).astype(np.uint8 if self.bits == 8 else np.uint16)
        self._waiting.append(Frame(image, self.number, self._bench.now, self._bench.now + 1))
        self.number += 1

    def frame(self, timeout_s: float) -> Frame | None:
        if self.unplugged:
            raise DeviceError(f"{self.name}: unplugged; check cable and power")
        return self._waiting.popleft() if self._waiting else None

    def stop(self) -> None:
        self._waiting.clear()

    def close(self) -> None:
        self.stop()


class Scripted:
    """An operator that answers from a list, and then ends."""

    def __init__(self, answers: Sequence[Answer]) -> None:
        self.asked: list[Step] = []
        self._answers = deque(answers)

    def ask(self, step: Step) -> None:
        self.asked.append(step)

    def answer(self) -> Answer:
        return self._answers.popleft() if self._answers else "end"
