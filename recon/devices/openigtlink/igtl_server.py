"""An OpenIGTLink server: publishes transforms, images, models and texts to 3D Slicer and others.

A client gets the newest message of each name. One that reads slowly misses some and holds up neither the publisher nor the other
clients; one that connects late gets the newest of each name first, so a model is published once. Nothing that a client sends is
kept; queries for single messages (GET_) and for streams (STT_, STP_) are answered.

The server listens on this computer alone unless it is given another address; the protocol has neither password nor encryption.
"""

import errno
import logging
import socket
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack, suppress

from recon.devices.interfaces import DeviceError
from recon.devices.openigtlink import igtl_header, igtl_messages
from recon.devices.openigtlink.igtl_header import Header
from recon.devices.openigtlink.igtl_messages import Message, Raw, Status
from recon.devices.openigtlink.igtl_stream import Complaints, Pace, Splitter, checked_port
from recon.errors import InputError, reason

log = logging.getLogger(__name__)

LOOPBACK = "127.0.0.1"
PORT = 18944  # registered for OpenIGTLink
MOST_CLIENTS = 16
MOST_NAMES = 256  # pairs of kind and device, of each of which a message is held
STALLED_S = 30.0  # for one message, after which a client that takes nothing is dropped
LOOK_S = 0.5  # between two looks at whether to end

Key = tuple[str, str]  # kind and device
Answer = Callable[[Message], Mapping[Key, bytes]]


class Server:
    """Publishes messages, from any thread. Each client has threads of its own."""

    def __init__(self, host: str = LOOPBACK, port: int = PORT, version: int = 1) -> None:
        """Listen.

        port : 0 for any that is free; the attribute `port` has it
        version : of the headers: 1, which any client reads, or 2, with metadata and numbers of messages

        Raises
        ------
        DeviceError
            If the address isn't one of this computer's, or the port is in use.
        """
        self._version = version
        self._newest: dict[Key, bytes] = {}
        self._clients: list[_Client] = []
        self._lock = threading.Lock()  # over the two above
        self._ends = threading.Event()
        igtl_header.crc64(b"")  # is compiled now, not within the first message
        with ExitStack() as stack:
            self._listener = stack.enter_context(_listener(host, port))
            self.port: int = self._listener.getsockname()[1]
            self._complaints = Complaints(log, f"OpenIGTLink server {host}:{self.port}")
            self._thread = threading.Thread(target=self._accept_all, name="OpenIGTLink server", daemon=True)
            self._thread.start()
            stack.pop_all()  # the thread closes it

    @property
    def clients(self) -> int:
        """Number of clients that are connected."""
        with self._lock:
            return len(self._connected())

    def publish(self, message: Message) -> None:
        """Send a message to all clients, in place of an older one of its name that they haven't got yet; returns at once.

        Raises
        ------
        InputError
            If it can't be written, or there are too many names.
        """
        key, data = (message.kind, message.device), igtl_messages.pack(message, self._version)
        with self._lock:
            if key not in self._newest and len(self._newest) >= MOST_NAMES:
                raise InputError(f"{message.name}: expected at most {MOST_NAMES} names, found one more")
            self._newest[key] = data
            for client in self._connected():
                client.put({key: data})

    def close(self) -> None:
        """Drop all clients and listen no more."""
        self._ends.set()
        self._thread.join()
        with self._lock:
            clients, self._clients = self._clients, []
        for client in clients:
            client.close()

    def _connected(self) -> "list[_Client]":
        """Clients that aren't gone; of the others nothing is kept. To be called with the lock."""
        self._clients = [client for client in self._clients if client.connected]
        return self._clients

    def _accept_all(self) -> None:
        """The loop of the server's thread."""
        with self._listener as listener:
            while not self._ends.is_set():
                try:
                    self._accept(*listener.accept())
                except TimeoutError:
                    continue
                except OSError as error:  # gone again, or this process has no more files
                    self._complaints.add(f"a client couldn't connect: {error.strerror}")
                    self._ends.wait(LOOK_S)

    def _accept(self, connection: socket.socket, address: tuple) -> None:
        name = f"client {address[0]}:{address[1]}"
        if self.clients >= MOST_CLIENTS:
            self._complaints.add(f"{name} is refused: {MOST_CLIENTS} others are connected")
            connection.close()
            return
        with self._lock:
            self._clients.append(_Client(connection, name, self._newest, self._answer, self._complaints))

    def _answer(self, query: Message) -> Mapping[Key, bytes]:
        """Answer GET_ by the newest message, and STT_ and STP_ by whether there are messages of that kind: they come anyway."""
        verb, asked = query.kind[:4], query.kind[4:]
        with self._lock:
            named = {
                key: data
                for key, data in self._newest.items()
                if key[0].startswith(asked) and query.device in ("", key[1])  # TRANSFORM is asked for as TRANS
            }
        if verb == "GET_" and named:
            return named
        if query.kind == "GET_STATUS":
            content = Status(text="sonotwin")
        else:
            whole = next((kind for kind in igtl_messages.READERS if kind.startswith(asked)), asked)
            content = Raw(whole) if verb == "GET_" else Raw(f"RTS_{asked}"[:12], b"\0" if named else b"\1")
        answer = Message(query.device, content, time.time_ns())
        return {(answer.kind, answer.device): igtl_messages.pack(answer, self._version)}


class _Client:
    """A connection: a thread that sends what waits, and one that reads queries."""

    def __init__(
        self, connection: socket.socket, name: str, first: Mapping[Key, bytes], answer: Answer, complaints: Complaints
    ) -> None:
        connection.settimeout(STALLED_S)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        unsent_bytes = 1 << 18  # in the system's memory: what lies there is no longer the newest
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, unsent_bytes)
        self._connection, self._name, self._answer, self._complaints = connection, name, answer, complaints
        self._waiting = dict(first)
        self._change = threading.Condition()  # of the two beside it
        self.connected = True
        log.info("OpenIGTLink %s: connected", name)
        for loop in (self._send_all, self._read_all):
            threading.Thread(target=loop, name=name, daemon=True).start()

    def put(self, messages: Mapping[Key, bytes]) -> None:
        """Let messages wait, each in the place of an older one of its name."""
        with self._change:
            self._waiting.update(messages)
            self._change.notify()

    def close(self, fault: str = "") -> None:
        """End the connection, and say why if the client is at fault."""
        with self._change:
            if not self.connected:
                return
            self.connected = False
            self._change.notify()
        if fault:
            self._complaints.add(f"{self._name} is dropped: {fault}")
        with suppress(OSError):
            self._connection.shutdown(socket.SHUT_RDWR)  # wakes the other thread
        self._connection.close()

    def _send_all(self) -> None:
        try:
            while (data := self._next()) is not None:
                self._connection.sendall(data)
        except TimeoutError:
            self.close(f"it took no whole message in {STALLED_S:.0f} s")
        except OSError:  # gone, or closed by the other thread
            self.close()

    def _next(self) -> bytes | None:
        """Wait for a message; None at the end."""
        with self._change:
            self._change.wait_for(lambda: self._waiting or not self.connected)
            return self._waiting.pop(next(iter(self._waiting))) if self.connected else None

    def _read_all(self) -> None:
        splitter, pace = Splitter(_is_query), Pace()
        try:
            while self.connected:
                self._read(splitter, pace)
        except InputError as error:
            self.close(str(error))
        except OSError:
            self.close()

    def _read(self, splitter: Splitter, pace: Pace) -> None:
        """Read once and answer what is asked."""
        piece = 1 << 16  # bytes that are read at once
        try:
            data = self._connection.recv(piece)
        except TimeoutError:  # a client need not say anything
            return
        if not data:
            self.close()
            return
        for query, _ in splitter.feed(data):
            if isinstance(query, InputError):
                self._complaints.add(f"{self._name}: {query}")
            else:
                self.put(self._answer(query))
        if len(self._waiting) > 2 * MOST_NAMES:
            raise InputError(f"expected a client that takes its answers, found {len(self._waiting)} that wait")
        time.sleep(pace.pause(splitter.count, len(data)))


def _is_query(header: Header) -> bool:
    most_query_bytes = 1 << 16
    queries = ("GET_", "STT_", "STP_")
    return header.kind.startswith(queries) and header.size <= most_query_bytes


def _listener(host: str, port: int) -> socket.socket:
    """A socket that listens."""
    try:
        host.encode("idna")  # of a name that is none, `create_server` would leave its socket open
        listener = socket.create_server((host, checked_port(port, least=0)))
    except (OSError, UnicodeError) as error:  # the second of a host's name that is none
        used = isinstance(error, OSError) and error.errno == errno.EADDRINUSE
        found = "one that another server uses, such as PlusServer" if used else reason(error)
        raise DeviceError(f"OpenIGTLink server {host}:{port}: expected a free port of this computer, found {found}") from None
    listener.settimeout(LOOK_S)
    if not listener.getsockname()[0].startswith("127."):
        log.warning("OpenIGTLink server %s:%d: anybody who reaches this computer can read what is published", host, port)
    return listener
