"""OpenIGTLink: agreement with pyigtl both ways, and times on loopback."""

import signal
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager
from time import perf_counter
from typing import Any

import numpy as np

from benchmarks import live_igtl_soak
from recon.devices.openigtlink import igtl_messages
from recon.devices.openigtlink.igtl_client import Client
from recon.devices.openigtlink.igtl_image import Image
from recon.devices.openigtlink.igtl_messages import Message, Transform
from recon.devices.openigtlink.igtl_server import LOOPBACK, Server
from twin.experiments.experiment_setup import Figures, Setup

DRAWS = 50  # transforms and images each way
WAIT_S = 10.0
SOAK_S, RATE_HZ = 60.0, 20.0
SHAPE = (480, 640)  # of a B-scan


def drawn(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, int]:
    """A rigid pose (4, 4) up to 1 m away, a B-scan and a time in ns since 1970."""
    pose = np.eye(4)
    pose[:3, :3] = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    pose[:3, 3] = rng.uniform(-1000, 1000, 3)
    return pose, rng.integers(0, 256, SHAPE, np.uint8), int(rng.integers(10**18, 2 * 10**18))


def off(found: np.ndarray, pose: np.ndarray) -> float:
    """Largest error of a pose's numbers, by their own size above 1."""
    return float((np.abs(found - pose) / np.maximum(np.abs(pose), 1)).max())


def to_pyigtl(setup: Setup) -> Figures:
    """Our server to pyigtl's client, headers of both versions in turn."""
    import pyigtl

    rng, errors, wrong, late = np.random.default_rng(1), list[float](), 0, list[float]()
    for version in (1, 2):
        server = Server(port=0, version=version)
        client = pyigtl.OpenIGTLinkClient(LOOPBACK, server.port)
        for k in range(DRAWS // 2):
            pose, levels, time_ns = drawn(rng)
            server.publish(Message(f"Probe{k}ToWorld", Transform(pose), time_ns))
            server.publish(Message(f"Image{k}", Image(levels, np.eye(4)), time_ns))
            transform, image = (wait(client, name) for name in (f"Probe{k}ToWorld", f"Image{k}"))
            errors.append(off(transform.matrix, pose))
            late += [abs(one.timestamp - time_ns / 1e9) for one in (transform, image)]
            wrong += not np.array_equal(image.image[0], levels)
        client.stop()
        server.close()
    return agreement(errors, wrong, late)


def wait(client: Any, name: str) -> Any:
    """The next message of a name."""
    return client.wait_for_message(name, WAIT_S)


def from_pyigtl(setup: Setup) -> Figures:
    """pyigtl's server to our client."""
    import pyigtl

    rng, errors, wrong, late = np.random.default_rng(2), list[float](), 0, list[float]()
    with pyigtl_server() as server:
        client = Client(port=server.server_address[1])
        for k in range(DRAWS):
            pose, levels, time_ns = drawn(rng)
            for message in (pyigtl.TransformMessage(pose, device_name=f"Probe{k}ToWorld", timestamp=time_ns / 1e9),
                            pyigtl.ImageMessage(levels[None], device_name=f"Image{k}", timestamp=time_ns / 1e9)):  # fmt: skip
                server.send_message(message, wait=False)
            for _ in range(2):
                received = client.receive(WAIT_S)
                assert received is not None and received.message.time_ns is not None
                late.append(abs(received.message.time_ns - time_ns) / 1e9)
                content = received.message.content
                if isinstance(content, Transform):
                    errors.append(off(content.matrix, pose))
                else:
                    wrong += not (isinstance(content, Image) and np.array_equal(content.levels, levels))
        client.close()
    return agreement(errors, wrong, late)


@contextmanager
def pyigtl_server() -> Iterator[Any]:
    """A server of pyigtl, which takes signals for itself; they are given back."""
    import pyigtl

    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    server = pyigtl.OpenIGTLinkServer(port=0, local_server=True)
    yield server
    server.stop()
    for number, handler in handlers.items():
        signal.signal(number, handler)


def agreement(errors: list[float], wrong: int, late: list[float]) -> Figures:
    """Figures of one way; times are doubles of seconds since 1970."""
    return {"transform": max(errors), "images": len(errors), "wrong": wrong, "late_us": 1e6 * max(late)}


def times(setup: Setup) -> Figures:
    """Publishing beside a client that takes nothing, and the time to a client that does."""
    server = Server(port=0)
    stalled = socket.create_connection((LOOPBACK, server.port))
    client = Client(port=server.port)
    took, late = list[float](), list[float]()
    levels = np.random.default_rng(3).integers(0, 256, SHAPE, np.uint8)
    server.publish(Message("Image", Image(levels, np.eye(4))))
    assert client.receive(WAIT_S)
    for _ in range(200):
        start = perf_counter()
        server.publish(Message("Image", Image(levels, np.eye(4))))
        took.append(1e3 * (perf_counter() - start))
        received = client.receive(WAIT_S)
        assert received is not None
        late.append(1e3 * (perf_counter() - start))
        time.sleep(0.01)
    stalled.close()
    client.close()
    server.close()
    figures = {"width": SHAPE[1], "height": SHAPE[0], "write_ms": written_ms(levels), "publish_ms": np.median(took)}
    return figures | {"late_ms": np.median(late), "latest_ms": np.quantile(late, 0.99)}


def written_ms(levels: np.ndarray) -> float:
    """Median time to write an image's message."""
    took = list[float]()
    for _ in range(50):
        start = perf_counter()
        igtl_messages.pack(Message("Image", Image(levels, np.eye(4))))
        took.append(perf_counter() - start)
    return 1e3 * float(np.median(took))


def soak(setup: Setup) -> Figures:
    """A minute; half an hour is `python -m benchmarks.live_igtl_soak`."""
    found = live_igtl_soak.run(SOAK_S, RATE_HZ)
    threads = {"threads": found.tenth(9)[2], "most_threads": found.tenth(1)[2] + live_igtl_soak.MOST_MORE}
    return threads | {"growth_mb": found.growth_mb, "most_mb": live_igtl_soak.MOST_MB, "soak_s": SOAK_S, "soak_hz": RATE_HZ}
