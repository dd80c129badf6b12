"""Two Basler cameras of pylon's emulator: pairs of frames from images on disk to arrays with number and time, none lost."""

import hashlib
import os
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from time import perf_counter
from typing import Literal

import cv2
import numpy as np

from recon.devices.basler import BaslerSettings, open_camera
from recon.devices.camera_pairs import CameraPair
from recon.devices.interfaces import Image
from twin.accuracy.table_rows import Measurement, Row

PAIRS = 1000
SIZE = (1280, 1024)
SERIALS = ("0815-0000", "0815-0001")  # of the emulator's first cameras
HELD = 256  # frames; where the cores limit the rate, one emulated camera runs ahead of the other by some
SERVED = (7, 11)  # images that each camera serves in turn: frames of different pairs differ in their hashes
WHAT = f"{PAIRS} pairs 1280x1024 of two emulated Basler cameras"


def measurements() -> list[Measurement]:
    """The rows of the group."""
    os.environ["PYLON_CAMEMU"] = "2"  # before pylon is loaded
    return [free_running, software_trigger]


def free_running() -> list[Row]:
    """Row a: both cameras at the emulator's rate, beside pylon's bare loop."""
    with served() as (settings, hashes):
        bare = bare_rate(settings)
        rate, lost, wrong = taken(settings, hashes, "free")
    return [
        Row("a", f"{WHAT}, free-running: frames lost", lost, 0, None, ""),
        Row("a", f"{WHAT}, free-running: frames with another hash than that served", wrong, 0, None, ""),
        Row("a", f"{WHAT}, free-running (peer: pylon's own loop, hashes too)", rate, 0.7 * bare, bare, "pairs/s", True),
    ]


def software_trigger() -> list[Row]:
    """Row a: both cameras triggered by a call, each time after the pair before."""
    with served() as (settings, hashes):
        rate, lost, wrong = taken(settings, hashes, "software")
    return [
        Row("a", f"{WHAT}, software trigger: frames lost, or with another hash", lost + wrong, 0, None, ""),
        Row("a", f"{WHAT}, software trigger, 10 ms exposure", rate, None, None, "pairs/s"),
    ]


@contextmanager
def served() -> Iterator[tuple[list[BaslerSettings], list[list[str]]]]:
    """Settings of two cameras that serve images of noise from folders, and the images' hashes."""
    rng = np.random.default_rng(1)
    with tempfile.TemporaryDirectory() as folder:
        settings, hashes = [], []
        for camera, n in enumerate(SERVED):
            place = Path(folder) / str(camera)
            place.mkdir()
            images = [rng.integers(0, 256, SIZE[::-1], np.uint8) for _ in range(n)]
            for k, image in enumerate(images):
                cv2.imwrite(str(place / f"{k:04}.bmp"), image)
            features = {"TestImageSelector": "Off", "ImageFilename": str(place), "ImageFileMode": "On"}
            settings.append(BaslerSettings(SIZE, held=HELD, features=features))
            hashes.append([digest(image) for image in images])
        yield settings, hashes


def taken(
    settings: Sequence[BaslerSettings], hashes: Sequence[Sequence[str]], trigger: Literal["free", "software"]
) -> tuple[float, int, int]:
    """Pairs a second, frames lost, and frames with another hash than that of the image served."""
    first, second = (open_camera(f"cam{k + 1}", SERIALS[k], settings[k]) for k in range(2))
    pair, lost, wrong = CameraPair((first, second)), 0, 0
    pair.start(trigger)
    start = perf_counter()
    for _ in range(PAIRS):
        if trigger == "software":
            pair.trigger()
        one = pair.pair(10.0)
        if one is None:
            raise RuntimeError("emulator: expected a pair of frames in 10 s, found none")
        lost += sum(each.last - each.first + 1 for each in one.lost)
        wrong += sum(digest(frame.image) != own[frame.number % len(own)] for frame, own in zip(one.frames, hashes, strict=True))
    rate = PAIRS / (perf_counter() - start)
    pair.close()
    return rate, lost, wrong


def bare_rate(settings: Sequence[BaslerSettings]) -> float:
    """Pairs a second of pylon alone: no thread, no numbers, no times; images are hashed, too."""
    from pypylon import pylon

    factory = pylon.TlFactory.GetInstance()
    present = {info.GetSerialNumber(): info for info in factory.EnumerateDevices()}
    cameras = [pylon.InstantCamera(factory.CreateDevice(present[serial])) for serial in SERIALS]
    for camera, one in zip(cameras, settings, strict=True):
        camera.Open()
        for name, value in {"Width": SIZE[0], "Height": SIZE[1], "AcquisitionFrameRateEnable": False, **one.features}.items():
            camera.GetNodeMap().GetNode(name).SetValue(value)
        camera.StartGrabbing(pylon.GrabStrategy_OneByOne)
    start = perf_counter()
    for _ in range(PAIRS):
        for camera in cameras:
            with camera.RetrieveResult(10_000) as result:
                digest(result.Array)
    rate = PAIRS / (perf_counter() - start)
    for camera in cameras:
        camera.Close()
    return rate


def digest(image: Image) -> str:
    """Hash of an image's pixels."""
    return hashlib.sha256(image.tobytes()).hexdigest()
