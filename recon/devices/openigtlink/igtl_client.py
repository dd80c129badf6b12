"""An OpenIGTLink client: receives from PLUS, scanners and trackers, and connects anew by itself."""

import logging
import socket
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass

from recon.devices.interfaces import DeviceError
from recon.devices.openigtlink import igtl_header, igtl_messages
from recon.devices.openigtlink.igtl_header import MOST_BODY_BYTES, Header
from recon.devices.openigtlink.igtl_messages import Message
from recon.devices.openigtlink.igtl_server import LOOPBACK, PORT
from recon.devices.openigtlink.igtl_stream import Complaints, Pace, Splitter, any_kind, checked_port
from recon.errors import InputError

log = logging.getLogger(__name__)

MOST_WAITING = 64  # messages that nobody has fetched yet; beyond, the oldest are lost
MOST_WAITING_BYTES = 128 << 20
AGAIN_S = 1.0  # after a lost connection


@dataclass(frozen=True)
class Received:
    """A message as it came."""

    message: Message
    number: int  # of all that were wanted since the client began; a gap is what was lost, here or while there was no connection
    arrived_ns: int  # of this computer's monotonic clock


class Client:
    """Receives messages in a thread of its own; `receive` gives them in order, to one thread at a time."""

    def __init__(
        self,
        host: str = LOOPBACK,
        port: int = PORT,
        wanted: Callable[[Header], bool] = any_kind,
        first: Sequence[Message] = (),
        most_bytes: int = MOST_BODY_BYTES,
        check: bool = True,
    ) -> None:
        """Begin to connect; what is there, and why not, is in `state`.

        wanted : which messages are read; of the others not more than the header
        first : messages that are sent at each connection, such as queries for a stream
        most_bytes : of a body; who announces more is given up
        check : whether checksums must be right; some senders write none

        Raises
        ------
        DeviceError
            If the port is none.
        """
        self.name = f"OpenIGTLink {host}:{port}"
        self.state = "not connected yet"
        self.connected = False
        self.fault = ""  # of the last message or connection that was bad
        self.lost = 0  # messages that nobody has fetched in time
        self._seen: dict[str, None] = {}  # names of what came, in order
        self._address = (host, checked_port(port))
        self._splitter = lambda: Splitter(self._wants, most_bytes, check)
        self._wanted, self._first = wanted, first
        self._waiting: deque[tuple[Received, int]] = deque()  # messages and their sizes
        self._size = 0  # of all of them
        self._count = 0
        self._change = threading.Condition()  # of the three above
        self._ends = threading.Event()
        igtl_header.crc64(b"")  # is compiled now, not within the first message
        self._thread = threading.Thread(target=self._run, name=self.name, daemon=True)
        self._thread.start()

    @property
    def seen(self) -> tuple[str, ...]:
        """Names of what the source sends, wanted or not: `IMAGE of 'Image'`."""
        return tuple(self._seen)

    def receive(self, timeout_s: float) -> Received | None:
        """Wait for the next message that was wanted, in order; None if none came in time."""
        with self._change:
            if not self._change.wait_for(lambda: bool(self._waiting), timeout_s):
                return None
            received, size = self._waiting.popleft()
            self._size -= size
            return received

    def close(self) -> None:
        """End the connection; may be called again."""
        self._ends.set()
        self._thread.join()

    def _run(self) -> None:
        complaints = Complaints(log, self.name)
        while not self._ends.is_set():
            try:
                self._listen(complaints)
            except (OSError, UnicodeError, InputError) as error:  # the second of a host's name that is none
                self.state = self.fault = getattr(error, "strerror", None) or str(error)
                complaints.add(f"{self.state}; connecting again")
            if self.connected:
                self.connected = False
                self._count += 1  # what is lost meanwhile is a gap
            self._ends.wait(AGAIN_S)

    def _listen(self, complaints: Complaints) -> None:
        """Connect, and read until the connection ends."""
        connect_s = 5.0
        piece = 1 << 18  # bytes that are read at once
        look_s = 0.2  # between two looks at whether to end
        with socket.create_connection(self._address, connect_s) as connection:
            connection.settimeout(look_s)
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
            for message in self._first:
                connection.sendall(igtl_messages.pack(message, version=1))
            log.info("%s: connected", self.name)
            self.connected, self.state = True, "connected"
            splitter, pace = self._splitter(), Pace()
            while not self._ends.is_set():
                with suppress(TimeoutError):
                    self._read(connection.recv(piece), splitter, pace, complaints)

    def _read(self, data: bytes, splitter: Splitter, pace: Pace, complaints: Complaints) -> None:
        if not data:
            raise DeviceError("the source has ended the connection")
        arrived_ns = time.monotonic_ns()
        for found, size in splitter.feed(data):
            if isinstance(found, InputError):
                self.fault = str(found)
                complaints.add(self.fault)
            else:
                self._put(found, arrived_ns, size)
        if pause := pace.pause(splitter.count, len(data)):
            self._ends.wait(pause)

    def _put(self, message: Message, arrived_ns: int, size: int) -> None:
        with self._change:
            self._waiting.append((Received(message, self._count, arrived_ns), size))
            self._count += 1
            self._size += size
            while len(self._waiting) > MOST_WAITING or self._size > MOST_WAITING_BYTES:
                self._size -= self._waiting.popleft()[1]
                self.lost += 1
            self._change.notify()

    def _wants(self, header: Header) -> bool:
        most_seen = 50  # names that are remembered for messages to people
        if len(self._seen) < most_seen:
            self._seen[header.name] = None
        return self._wanted(header)
