import time

import numpy as np
import pytest

from recon.devices.igtl_scanner import IgtlScanner
from recon.devices.interfaces import DeviceError, Scanner
from recon.devices.openigtlink import igtl_client
from recon.devices.openigtlink.igtl_image import Image
from recon.devices.openigtlink.igtl_messages import Message, Raw, Text
from recon.devices.openigtlink.igtl_server import Server
from recon.devices.scan_view import ScanView
from tests.patience import PATIENCE_S
from tests.recon.devices.openigtlink.igtl_peers import TIME_NS, plus_frame, plus_image, served

SMALL = Message("Image", Image(np.zeros((4, 5), np.uint8), np.eye(4)))


@pytest.fixture
def server():
    server = Server(port=0)
    yield server
    server.close()


def publish(server: Server, levels: np.ndarray, device: str = "Image", time_ns: int | None = TIME_NS) -> None:
    server.publish(Message(device, Image(levels, np.eye(4)), time_ns))


def frame(scanner: Scanner):
    found = scanner.frame(PATIENCE_S)
    assert found is not None
    return found


def test_a_stream_of_plus_gives_frames(rng):
    """To the byte, with the sender's times; the first image that came while it was opened counts as seen."""
    levels = rng.integers(0, 256, (4, 30, 40), np.uint8)
    other = plus_frame(b"TRANSFORM", b"ProbeToTracker", bytes(48), [])
    data = b"".join(other + plus_image(image) for image in levels)
    with served(data) as (port, _):
        scanner = IgtlScanner("us", port=port)
        frames = [frame(scanner) for _ in range(3)]
        scanner.close()
    assert scanner.size == (40, 30) and scanner.name == "us"
    np.testing.assert_array_equal([one.image for one in frames], levels[1:])
    assert [one.number for one in frames] == [1, 2, 3] and {one.time_ns for one in frames} == {TIME_NS}
    assert abs(time.monotonic_ns() - frames[-1].arrived_ns) < 60e9
    assert not frames[0].image.flags.writeable


def test_the_view_is_applied(server, rng):
    levels = rng.integers(0, 256, (30, 40), np.uint8)
    publish(server, levels)
    scanner = IgtlScanner("us", port=server.port, view=ScanView((5, 6, 20, 10), "UF"))
    publish(server, levels)
    np.testing.assert_array_equal(frame(scanner).image, levels[6:16, 5:25][:, ::-1])
    assert scanner.size == (20, 10)
    scanner.close()


@pytest.mark.parametrize(
    ("levels", "bits", "grey"),
    [
        (np.full((4, 5), 0x0FF0, np.uint16), 12, 0xFF),
        (np.full((4, 5), 0x0FF0, np.int16), 14, 0x3F),
        (np.full((1, 4, 5, 3), (255, 0, 0), np.uint8), 8, 76),  # 0.299 of red
        (np.full((1, 4, 5, 4), (0, 255, 0, 9), np.uint8), 8, 150),  # 0.587 of green
    ],
)
def test_other_levels_become_grey(server, levels, bits, grey):
    publish(server, levels)
    scanner = IgtlScanner("us", port=server.port, bits=bits)
    publish(server, levels)
    assert (frame(scanner).image == grey).all() and scanner.size == (5, 4)
    scanner.close()


def test_frames_without_a_stamp_have_their_arrivals(server):
    publish(server, np.zeros((4, 5), np.uint8), time_ns=None)
    scanner = IgtlScanner("us", port=server.port)
    publish(server, np.zeros((4, 5), np.uint8), time_ns=None)
    found = frame(scanner)
    assert found.time_ns == found.arrived_ns
    scanner.close()


def test_the_first_stream_of_several_is_kept(server):
    publish(server, np.zeros((4, 5), np.uint8), "Image")
    scanner = IgtlScanner("us", port=server.port)
    for k in range(1, 4):
        publish(server, np.full((9, 9), k, np.uint8), "Doppler")
        publish(server, np.full((4, 5), k, np.uint8), "Image")
        assert (frame(scanner).image == k).all()
    scanner.close()


def test_images_of_others_that_came_with_the_first_are_left_out():
    pieces = [(b"Image", 1), (b"Doppler", 2), (b"Image", 3)]
    data = b"".join(plus_image(np.full((3, 4), level, np.uint8), device) for device, level in pieces)
    with served(data) as (port, _):
        scanner = IgtlScanner("us", port=port)
        assert (frame(scanner).image == 3).all()
        scanner.close()


@pytest.mark.parametrize(
    ("content", "fields", "match"),
    [
        (None, {}, "within 0.3 s, found nothing: is the source running"),
        (Message("State", Text("on")), {}, "found STRING of 'State'; let the source send IMAGE"),
        (SMALL, {"device": "Us"}, "'Us': .* IMAGE of 'Image'; give device="),
        (Message("Image", Image(np.zeros((3, 4, 5), np.uint8), np.eye(4))), {}, "images of one plane, found volumes of 3"),
        (Message("Image", Image(np.zeros((4, 5)), np.eye(4))), {}, "float64 of shape .*radio-frequency"),
        (Message("Image", Raw("IMAGE")), {}, "an empty one"),
        (SMALL, {"view": ScanView((9, 9, 9, 9))}, "crop: expected a part"),
        (None, {"bits": 20}, "bits: expected 8 to 16"),
    ],
)
def test_what_gives_no_images_is_named(server, content, fields, match):
    if content:
        server.publish(content)
    with pytest.raises(DeviceError, match=match) as caught:
        IgtlScanner("us", port=server.port, first_s=0.3, **fields)
    assert len(str(caught.value).splitlines()) == 1


def test_senders_without_checksums_are_named_and_read_on_demand():
    data = bytearray(plus_image(np.full((3, 4), 5, np.uint8)))
    data[50:58] = bytes(8)
    with served(bytes(data) * 2) as (port, _):
        with pytest.raises(DeviceError, match=r"a sender without checksums\? give check=False"):
            IgtlScanner("us", port=port, first_s=0.3)
        scanner = IgtlScanner("us", port=port, check=False)
        assert (frame(scanner).image == 5).all()
        scanner.close()


def test_a_lost_scanner_is_named_and_comes_back(server, monkeypatch):
    monkeypatch.setattr(igtl_client, "AGAIN_S", 0.05)
    image = np.zeros((4, 5), np.uint8)
    publish(server, image)
    scanner = IgtlScanner("us", port=server.port)
    assert scanner.frame(0.05) is None  # frozen, but there
    server.close()
    with pytest.raises(DeviceError, match=r"scanner us at OpenIGTLink .*: expected images, found .* as soon as it answers"):
        scanner.frame(0.5)
    again = Server(port=server.port)
    publish(again, image)
    found = frame(scanner)
    assert found.number == 2  # the second, after a gap
    scanner.close()
    again.close()


def test_another_size_is_named(server):
    publish(server, np.zeros((4, 5), np.uint8))
    scanner = IgtlScanner("us", port=server.port)
    publish(server, np.zeros((6, 5), np.uint8))
    with pytest.raises(DeviceError, match="images of 5x4 px, as the first one, found 5x6: another preset"):
        scanner.frame(PATIENCE_S)
    scanner.close()
