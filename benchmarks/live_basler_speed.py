"""Two Basler cameras of pylon's emulator: pairs of frames from images on disk to arrays, and to a recording, none lost."""

import hashlib
import os
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import replace
from pathlib import Path
from time import perf_counter
from typing import Literal

import cv2
import numpy as np

from recon.acquisition.frame_checks import Limits
from recon.acquisition.pictures import hidden
from recon.acquisition.recording import open_recording
from recon.acquisition.sweep_recording import SweepPlan, record_sweep
from recon.capture import sweep_tables
from recon.capture.images import read_image
from recon.capture.manifest import CAMERAS, STAMPS, Device, image_name
from recon.devices.basler import BaslerSettings, open_camera
from recon.devices.camera_pairs import CameraPair, Pair
from recon.devices.interfaces import Image
from twin.devices.virtual_session import OneTake
from twin.experiments.experiment_setup import Figures, Setup

PAIRS = 1000
SIZE = (1280, 1024)
SERIALS = ("0815-0000", "0815-0001")  # of the emulator's first cameras
HELD = 256  # frames; where the cores limit the rate, one emulated camera runs ahead of the other by some
RECORDED_HZ = 25.0  # as fast as the tracker follows on two cores
SERVED = (7, 11)  # images that each camera serves in turn: frames of different pairs differ in their hashes


def free_running(setup: Setup) -> Figures:
    """Both cameras at the emulator's rate, beside pylon's bare loop."""
    with served() as (settings, hashes):
        bare = bare_rate(settings)
        rate, lost, wrong = taken(settings, hashes, "free")
    return {"pairs": PAIRS, "lost": lost, "wrong": wrong, "rate_hz": rate, "bare_hz": bare}


def software_trigger(setup: Setup) -> Figures:
    """Both cameras triggered by a call, each time after the pair before."""
    with served() as (settings, hashes):
        rate, lost, wrong = taken(settings, hashes, "software")
    return {"pairs": PAIRS, "lost_or_wrong": lost + wrong, "rate_hz": rate}


class CountedPairs(CameraPair):
    """Pairs until there were enough of them."""

    given = 0

    def pair(self, timeout_s: float) -> Pair | None:
        """Next pair, counted."""
        one = super().pair(timeout_s)
        self.given += one is not None
        return one

    @property
    def over(self) -> bool:
        """Whether there were enough."""
        return self.given >= PAIRS


def recorded(setup: Setup) -> Figures:
    """Both cameras at a rate of their own into a capture, whose images are read again."""
    said, plan = list[str](), SweepPlan("scan", None, ("free", "free"), None, 10.0, Limits())
    with served() as (settings, hashes), tempfile.TemporaryDirectory() as folder:
        cameras = [open_camera(name, SERIALS[k], replace(settings[k], rate_hz=RECORDED_HZ)) for k, name in enumerate(CAMERAS)]
        pairs = CountedPairs((cameras[0], cameras[1]))
        devices = {name: Device(size=SIZE) for name in CAMERAS}
        start = perf_counter()
        with closing(pairs), open_recording(Path(folder) / "capture") as recording:
            counts = record_sweep(recording, pairs, None, devices, OneTake(lambda: pairs.over), plan, {}, said.append, hidden)
        rate = counts[CAMERAS[0]] / (perf_counter() - start)
        lost, wrong = 0, 0
        for name, own in zip(CAMERAS, hashes, strict=True):
            place = Path(folder) / "capture/sweep/scan" / name
            numbers = sweep_tables.read_stamps(place / STAMPS)[0].tolist()
            lost += numbers[-1] + 1 - len(numbers)
            for k in numbers:
                wrong += digest(read_image(place / image_name(k), SIZE, 8)) != own[k % len(own)]
    lost += sum(line.startswith("lost") for line in said)
    return {"pairs": counts[CAMERAS[0]], "asked_hz": RECORDED_HZ, "lost": lost, "wrong": wrong, "rate_hz": rate}


@contextmanager
def served() -> Iterator[tuple[list[BaslerSettings], list[list[str]]]]:
    """Settings of two cameras that serve images of noise from folders, and the images' hashes."""
    os.environ["PYLON_CAMEMU"] = "2"  # before pylon is loaded
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
