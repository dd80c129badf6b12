"""`python -m benchmarks.live_igtl_soak [seconds=1800] [rate_hz=20]`: OpenIGTLink for long, with good, slow and bad clients.

At the rate a pose, a B-scan and a status are published, and each second a model. Our scanner and a client of transforms read
along; one client takes nothing; and each second one comes that sends garbage, one that announces 4 GB, and one that leaves at
once. Printed are memory, threads and open files in the second tenth and the last one, and the share of messages that a newer one
replaced before it was sent, which happens where this computer does other things for longer than a frame. The status is 1 if
memory grew by more than 20 MB, or threads or open files did.
"""

import logging
import os
import socket
import sys
import threading
import time
from array import array
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from campaign import commands
from recon.devices.igtl_scanner import IgtlScanner
from recon.devices.openigtlink.igtl_client import Client
from recon.devices.openigtlink.igtl_header import HEADER
from recon.devices.openigtlink.igtl_image import Image
from recon.devices.openigtlink.igtl_messages import Message, Status, Transform
from recon.devices.openigtlink.igtl_model import Model
from recon.devices.openigtlink.igtl_server import LOOPBACK, Server

MOST_MB = 20.0
MOST_MORE = 5  # threads or files: a bad client's may be there as they are counted
SIZE = (480, 640)  # of a B-scan
TRIANGLES = 5000
BAD = (b"GET / HTTP/1.1\r\n\r\n" * 10, HEADER.pack(1, b"IMAGE", b"Image", 0, 4 << 30, 0), b"")


@dataclass(frozen=True)
class Soak:
    """What came of a run; columns of `held` are seconds, memory in MB, threads and open files."""

    held: np.ndarray  # (n, 4)
    published: int
    images: int  # received by the scanner
    poses: int  # received by the client
    late_s: np.ndarray  # (images,) from publishing to the frame

    def tenth(self, which: int) -> np.ndarray:
        """Medians over a tenth of the run."""
        begin, end = which * len(self.held) // 10, (which + 1) * len(self.held) // 10
        return np.median(self.held[begin : max(end, begin + 1)], axis=0)

    @property
    def growth_mb(self) -> float:
        """Memory of the last tenth over that of the second one."""
        return float(self.tenth(9)[1] - self.tenth(1)[1])

    @property
    def lost(self) -> float:
        """Share of images and poses that the readers didn't get; the first image has opened the scanner."""
        return 1 - (1 + self.images + self.poses) / (2 * self.published)

    @property
    def flat(self) -> bool:
        """Whether as much is held at the end as after a while."""
        return self.growth_mb <= MOST_MB and bool((self.tenth(9)[2:] - self.tenth(1)[2:] < MOST_MORE).all())


def run(seconds: float, rate_hz: float) -> Soak:
    """Publish for some seconds to readers in threads of this process."""
    rng = np.random.default_rng(0)
    server = Server(port=0)
    images = rng.integers(0, 256, (10, *SIZE), np.uint8)
    model = Model(rng.normal(size=(TRIANGLES // 2, 3)), rng.integers(0, TRIANGLES // 2, (TRIANGLES, 3)))
    _publish(server, images[0], 0)
    scanner = IgtlScanner("us", port=server.port)
    poses = Client(port=server.port, wanted=lambda header: header.kind == "TRANSFORM")
    stalled = socket.create_connection((LOOPBACK, server.port))
    assert poses.receive(10.0) is not None
    late, counted, ends = array("d"), [0], threading.Event()
    readers = [threading.Thread(target=_read_images, args=(scanner, late, ends)),
               threading.Thread(target=_read_poses, args=(poses, counted, ends))]  # fmt: skip
    for reader in readers:
        reader.start()
    held, begun, count = [_held(0.0)], time.monotonic(), 1
    while time.monotonic() < begun + seconds:
        time.sleep(1 / rate_hz - (time.monotonic() - begun) % (1 / rate_hz))  # no burst makes up for a late one
        _publish(server, images[count % len(images)], count)
        count += 1
        if time.monotonic() - begun > len(held):  # each second
            server.publish(Message("Skin", model))
            _come_badly(server.port)
            held.append(_held(time.monotonic() - begun))
    time.sleep(1)
    ends.set()
    for reader in readers:
        reader.join()
    stalled.close()
    scanner.close()
    poses.close()
    server.close()
    return Soak(np.array(held), count, len(late), counted[0], np.array(late))


def _publish(server: Server, image: np.ndarray, k: int) -> None:
    pose = np.eye(4)
    pose[0, 3] = k
    now = time.time_ns()
    server.publish(Message("ProbeToWorld", Transform(pose), now))
    server.publish(Message("Image", Image(image, pose), now))
    server.publish(Message("State", Status(text=f"frame {k}"), now))


def _read_images(scanner: IgtlScanner, late: array, ends: threading.Event) -> None:
    while not ends.is_set():
        if frame := scanner.frame(0.2):
            late.append((time.time_ns() - frame.time_ns) / 1e9)


def _read_poses(client: Client, counted: list[int], ends: threading.Event) -> None:
    counted[0] = 1  # the one that was waited for
    while not ends.is_set():
        counted[0] += client.receive(0.2) is not None


def _come_badly(port: int) -> None:
    for garbage in BAD:
        with suppress(OSError), socket.create_connection((LOOPBACK, port), 1.0) as connection:
            connection.sendall(garbage)


def _held(seconds: float) -> tuple[float, float, float, float]:
    files = len(os.listdir("/proc/self/fd"))
    return seconds, commands.memory_mb(os.getpid(), "VmRSS"), float(threading.active_count()), float(files)


def lines(soak: Soak) -> list[str]:
    """What is printed."""
    _, memory, threads, files = soak.tenth(9)
    before = soak.tenth(1)
    return [
        f"published {soak.published} poses and images in {soak.held[-1, 0]:.0f} s, lost {100 * soak.lost:.2f} %",
        f"memory    {memory:.1f} MB, {soak.growth_mb:+.1f} MB since the second tenth",
        f"threads   {threads:.0f}, before {before[2]:.0f}; open files {files:.0f}, before {before[3]:.0f}",
        f"late      {1e3 * np.median(soak.late_s):.1f} ms median, {1e3 * np.quantile(soak.late_s, 0.99):.1f} ms at 99 %",
    ]


def main(arguments: list[str]) -> int:
    """Run, print; 1 if what is held has grown."""
    fields = {"seconds": 1800.0, "rate_hz": 20.0} | {
        name: float(value) for name, _, value in (a.partition("=") for a in arguments)
    }
    logging.getLogger("recon.devices").setLevel(logging.ERROR)  # thousands of bad clients are meant
    soak = run(fields["seconds"], fields["rate_hz"])
    print(*lines(soak), sep="\n")
    return 0 if soak.flat else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
