"""A stand-in for pylon's camera object, for what pylon's emulator lacks: wires, time stamps, chunks, counters that wrap.

It behaves as the manuals say: frames carry their number and the time of the exposure's start, and a frame that found no room on
the bus is missing in the numbers. Its sensor's readout takes no time.
"""

import time
from collections import deque
from dataclasses import dataclass, field

import numpy as np
from pypylon import genicam

SELECTORS = ("FrameBurstStart", "FrameStart")


@dataclass
class Node:
    """A feature with its range or choices."""

    value: object
    choices: tuple[str, ...] = ()
    low: float | None = None
    high: float | None = None
    usable: bool = True
    done: object = None  # called by Execute

    def IsReadable(self):
        return self.usable

    IsWritable = IsReadable

    def GetValue(self):
        return self.value

    def SetValue(self, value):
        if (self.choices and value not in self.choices) or (self.low is not None and not self.low <= value <= self.high):
            raise genicam.OutOfRangeException(f"{value} is refused. : OutOfRangeException thrown", "Stand.h", 1)
        self.value = value

    def GetSettableValues(self):
        return self.choices

    def GetMin(self):
        return self.low

    def GetMax(self):
        return self.high

    def GetUnit(self):
        return ""

    def Execute(self):
        self.done()


class PerSelector(Node):
    """A feature that has a value of its own for each choice of another."""

    def __init__(self, selector, value, choices):
        super().__init__(value, choices)
        self.selector, self.values = selector, {}

    def SetValue(self, value):
        super().SetValue(value)
        self.values[self.selector.value] = value

    def GetValue(self):
        return self.values.get(self.selector.value, self.value)


@dataclass
class Result:
    """A grab result."""

    BlockID: int
    TimeStamp: int
    Array: np.ndarray
    ChunkExposureTime: Node
    chunks: tuple[str, ...]
    whole: bool = True
    ErrorDescription: str = ""

    @property
    def Width(self):
        return self.Array.shape[1]

    @property
    def Height(self):
        return self.Array.shape[0]

    def __enter__(self):
        return self

    def __exit__(self, *ended):
        pass

    def IsValid(self):
        return True

    def GrabSucceeded(self):
        return True

    def IsChunkDataAvailable(self):
        return bool(self.chunks)

    def HasCRC(self):
        return "PayloadCRC16" in self.chunks

    def CheckCRC(self):
        return self.whole


class Nothing:
    def IsValid(self):
        return False


@dataclass
class PylonStandIn:
    """An open camera; `pulse` is an edge at its Line1, `offset_ns` its clock before this computer's."""

    size: tuple[int, int] = (64, 48)
    offset_ns: int = 7 * 10**15
    gige: bool = False
    nodes: dict = field(default_factory=dict)
    results: deque = field(default_factory=deque)
    removed: bool = False
    closed: int = 0

    def __post_init__(self):
        on_off = ("On", "Off")
        trigger, line = Node("FrameStart", SELECTORS), Node("Line1", ("Line1", "Line2", "Line3"))
        self.block = 1 if self.gige else 0
        self.latched = Node(0)
        chunks = Node("Timestamp", ("Timestamp", "ExposureTime", "PayloadCRC16"))
        self.nodes = {
            "PixelFormat": Node("Mono8", ("Mono8", "Mono10", "Mono12")),
            "OffsetX": Node(8, low=0, high=1000),
            "OffsetY": Node(8, low=0, high=1000),
            "Width": Node(1280, low=1, high=1280),
            "Height": Node(1024, low=1, high=1024),
            "Gain": Node(0.0, low=0.0, high=12.0),
            "ExposureTimeAbs" if self.gige else "ExposureTime": Node(5000.0, low=10.0, high=1e6),
            "TriggerSelector": trigger,
            "TriggerMode": PerSelector(trigger, "On", on_off),  # of another program that has left all of them on
            "TriggerSource": PerSelector(trigger, "Software", ("Software", "Line1", "Line3")),
            "TriggerActivation": PerSelector(trigger, "RisingEdge", ("RisingEdge", "FallingEdge")),
            "AcquisitionFrameRateEnable": Node(True),
            "LineSelector": line,
            "LineMode": PerSelector(line, "Input", ("Input", "Output")),
            "LineSource": PerSelector(line, "Off", ("Off", "ExposureActive")),
            "ChunkModeActive": Node(False),
            "ChunkSelector": chunks,
            "ChunkEnable": PerSelector(chunks, False, ()),
            "GevTimestampControlLatch" if self.gige else "TimestampLatch": Node(None, done=self._latch),
            "GevTimestampValue" if self.gige else "TimestampLatchValue": self.latched,
        }
        if self.gige:
            self.nodes["GevTimestampTickFrequency"] = Node(125_000_000)
        self.MaxNumBuffer = Node(10)

    def GetNodeMap(self):
        return self

    def GetNode(self, name):
        return self.nodes.get(name, Node(None, usable=False))

    def IsGigE(self):
        return self.gige

    def Open(self):
        pass

    def Close(self):
        self.closed += 1

    def DestroyDevice(self):
        pass

    def StartGrabbing(self, strategy):
        pass

    def StopGrabbing(self):
        pass

    def IsCameraDeviceRemoved(self):
        return self.removed

    def CanWaitForFrameTriggerReady(self):
        return True

    def WaitForFrameTriggerReady(self, timeout_ms, handling):
        return True

    def ExecuteSoftwareTrigger(self):
        self._expose(time.monotonic_ns())

    def RetrieveResult(self, timeout_ms, handling):
        until = time.monotonic() + timeout_ms / 1000
        while not self.results and time.monotonic() < until:
            time.sleep(0.0005)
        return self.results.popleft() if self.results else Nothing()

    def pulse(self, at_ns=None, lost=False, whole=True):
        """An edge at Line1 at a time of this computer's clock; the frame may be lost on the bus, or come damaged."""
        at_ns = time.monotonic_ns() if at_ns is None else at_ns
        self.nodes["TriggerSelector"].value = "FrameStart"
        waits = self.nodes["TriggerMode"].GetValue() == "On" and self.nodes["TriggerSource"].GetValue() == "Line1"
        if waits:
            self._expose(at_ns, lost, whole)

    def _expose(self, at_ns, lost=False, whole=True):
        block = self.block
        self.block = block % 65535 + 1 if self.gige else block + 1
        if lost:
            return
        image = np.full(self.size[::-1], block % 256, np.uint8)
        sent = tuple(name for name, on in self.nodes["ChunkEnable"].values.items() if on and self.nodes["ChunkModeActive"].value)
        exposure = self.nodes["ExposureTimeAbs" if self.gige else "ExposureTime"].value
        own = Node(exposure, usable="ExposureTime" in sent)
        self.results.append(Result(block, self._ticks(at_ns), image, own, sent, whole))

    def _ticks(self, at_ns):
        return (at_ns + self.offset_ns) // (8 if self.gige else 1)

    def _latch(self):
        self.latched.value = self._ticks(time.monotonic_ns())
