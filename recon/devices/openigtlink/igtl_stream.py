"""A stream of OpenIGTLink's bytes, parted into messages, with bounds on what a peer can make this computer hold or do."""

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from logging import Logger
from typing import NamedTuple

from recon.devices.interfaces import DeviceError
from recon.devices.openigtlink import igtl_header, igtl_messages
from recon.devices.openigtlink.igtl_header import HEADER, MOST_BODY_BYTES, Header
from recon.devices.openigtlink.igtl_messages import Message
from recon.errors import InputError

MOST_MESSAGES_S = 2000  # of a peer: twenty times what a rig sends
MOST_BYTES_S = 512 << 20  # of a peer
SILENT_S = 30.0  # in which nothing is said twice
MOST_LINES = 10  # in that time


def any_kind(header: Header) -> bool:
    """Whether a message is wanted: each one is."""
    return True


def checked_port(port: int, least: int = 1) -> int:
    """A port's number, if it is one; DeviceError if not."""
    most_port = 65535
    if not least <= port <= most_port:
        raise DeviceError(f"OpenIGTLink: port: expected {least} to {most_port}, found {port}")
    return port


class Arrival(NamedTuple):
    """A message that is whole, or what is wrong with it."""

    found: Message | InputError
    size: int  # of the body, bytes


class Splitter:
    """Takes bytes as they come, gives messages; holds a message at a time, and of it only what has come."""

    def __init__(
        self, wanted: Callable[[Header], bool] = any_kind, most_bytes: int = MOST_BODY_BYTES, check: bool = True
    ) -> None:
        self.count = 0  # of all messages, wanted or not
        self._wanted, self._most_bytes, self._check = wanted, most_bytes, check
        self._held = bytearray()
        self._header: Header | None = None
        self._skipped = 0  # bytes of an unwanted body that are still to come
        self._bad = 0

    def feed(self, data: bytes | memoryview) -> Iterator[Arrival]:
        """The messages that are whole with these bytes, and what is wrong with damaged ones.

        A damaged body is left out, and the next header follows it. Of a damaged header there is no such way on.

        Raises
        ------
        InputError
            If there is no header where one is due, if it announces too large a body, or if too many bodies in a row are damaged.
        """
        self._held += data
        while self._advance():
            if self._header is None:
                self._begin(igtl_header.read_header(self._take(HEADER.size), self._most_bytes))
            else:
                header, self._header = self._header, None
                yield Arrival(self._message(header, self._take(header.size)), header.size)

    def _advance(self) -> bool:
        """Drop what is to be skipped; whether the next part is whole."""
        if self._skipped:
            gone = min(self._skipped, len(self._held))
            del self._held[:gone]
            self._skipped -= gone
        due = HEADER.size if self._header is None else self._header.size
        return not self._skipped and len(self._held) >= due

    def _take(self, size: int) -> bytes:
        taken = bytes(memoryview(self._held)[:size])
        del self._held[:size]
        return taken

    def _begin(self, header: Header) -> None:
        self.count += 1
        if self._wanted(header):
            self._header = header
        else:
            self._skipped = header.size

    def _message(self, header: Header, body: bytes) -> Message | InputError:
        most_bad = 10  # damaged messages one after the other, after which the peer is given up
        try:
            found = igtl_messages.unpack(header, igtl_header.checked(header, body) if self._check else body)
        except InputError as error:
            self._bad += 1
            if self._bad > most_bad:
                raise InputError(f"{self._bad} damaged messages one after the other, the last: {error}") from None
            return error
        self._bad = 0
        return found


@dataclass
class Pace:
    """Bounds what a peer may send in a second; the rest waits in its own memory."""

    begun: float = 0.0  # of the running second, monotonic s
    size: int = 0  # bytes since then
    count: int = 0  # of the messages before it

    def pause(self, count: int, size: int) -> float:
        """Seconds until more may be read, after `size` more bytes, and `count` messages in all."""
        now = time.monotonic()
        self.size += size
        if now - self.begun >= 1:
            self.begun, self.size, self.count = now, 0, count
        return self.begun + 1 - now if count - self.count > MOST_MESSAGES_S or self.size > MOST_BYTES_S else 0.0


class Complaints:
    """Lines about peers, so few that they fill no disk: in half a minute each text once, and ten at most."""

    def __init__(self, log: Logger, name: str) -> None:
        self._log, self._name = log, name
        self._begun, self._said, self._left_out = -SILENT_S, set[str](), 0

    def add(self, text: str) -> None:
        """Log a line, unless there were enough just before."""
        if time.monotonic() - self._begun >= SILENT_S:
            self._begun, self._said = time.monotonic(), set()
        if text in self._said or len(self._said) >= MOST_LINES:
            self._left_out += 1
            return
        more = f" ({self._left_out} more such lines)" if self._left_out else ""
        self._log.warning("%s: %s%s", self._name, text, more)
        self._said.add(text)
        self._left_out = 0
