"""Besiege a page from a process of its own: many silent or slow connections, and bad requests of every kind."""

import itertools
import resource
import socket
from collections.abc import Iterator
from multiprocessing.connection import Connection
from urllib.parse import urlsplit

_PATIENCE_S = 60.0
_CHUNK = b"x" * (1 << 16)


def besiege(address: str, idle: int, slow: int, body_bytes: int, signal: Connection) -> None:
    """Open `idle` silent and `slow` slow connections, and go round all bad requests until told to stop.

    One message is sent when all connections were opened and each bad request was made once; another message ends it.
    """
    resource.setrlimit(resource.RLIMIT_NOFILE, (idle + slow + 100, resource.getrlimit(resource.RLIMIT_NOFILE)[1]))
    silent = [_connect(address) for _ in range(idle)]
    dripping = [_Dripping(address) for _ in range(slow)]
    bad = list(_bad_requests(address, body_bytes))
    for round_number, request in enumerate(itertools.cycle(bad), 1):
        for one in dripping:
            one.drip()
        _make(address, request)
        if round_number == len(bad):
            signal.send("all")
        if signal.poll():
            break
    for connection in (*silent, *(one.connection for one in dripping)):
        connection.close()


class _Dripping:
    """A connection that sends a request byte by byte, and comes again when it is closed."""

    def __init__(self, address: str) -> None:
        self._address = address
        self._open()

    def drip(self) -> None:
        try:
            self.connection.send(next(self._bytes))
        except BlockingIOError:  # not connected yet
            pass
        except (OSError, StopIteration):
            self.connection.close()
            self._open()

    def _open(self) -> None:
        self.connection = _connect(self._address)
        self._bytes = (bytes([letter]) for letter in b"GET /" + b"x" * 10_000)


def _bad_requests(address: str, body_bytes: int) -> Iterator[tuple[bytes, int]]:
    """Yield the beginning of each bad request, and how many bytes follow it."""
    parts = urlsplit(address)
    host, token = f"Host: {parts.netloc}\r\n".encode(), parts.path.encode()
    length = f"Content-Length: {body_bytes}\r\n\r\n".encode()
    yield b"POST " + token + b"press HTTP/1.1\r\n" + host + length, body_bytes
    yield b"POST " + token + b"press HTTP/1.1\r\n" + host + b"Transfer-Encoding: chunked\r\n\r\nfffffff\r\n", body_bytes
    yield b"POST /press HTTP/1.1\r\n" + host + length, body_bytes
    yield b"GET " + token + b"state HTTP/1.1\r\n" + host + length, body_bytes
    yield b"GET " + token + b"state HTTP/1.1\r\n" + host + b"X: ", body_bytes
    yield b"GET /" + b"a" * 100_000 + b" HTTP/1.1\r\n" + host + b"\r\n", 0
    yield b"GET / HTTP/1.1\r\n" + host + b"".join(b"X-%d: y\r\n" % number for number in range(10_000)) + b"\r\n", 0
    yield b"GET /" + token[:-2] + b"/state HTTP/1.1\r\n" + host + b"\r\n", 0
    yield b"OPTIONS * HTTP/1.1\r\n" + host + b"\r\n", 0
    yield b"GET / HTTP/1.1\r\n" + host + b"Connection: Upgrade\r\nUpgrade: websocket\r\n\r\n", 0
    yield b"POST " + token + b"press HTTP/1.1\r\n" + host + b"Content-Length: -1\r\n\r\n", 0
    yield b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03" + bytes(range(256)), 0
    yield b"\r\n\r\n\r\n\x00\x00", 0
    yield (b"GET " + token + b"frame.png HTTP/1.1\r\n" + host + b"\r\n") * 1000, 0
    yield b"", 0


def _connect(address: str) -> socket.socket:
    """Begin to connect, without waiting for the other side."""
    parts = urlsplit(address)
    connection = socket.socket()
    connection.setblocking(False)
    connection.connect_ex((parts.hostname, parts.port))
    return connection


def _make(address: str, request: tuple[bytes, int]) -> None:
    """Send a request until all is sent or the other side has closed, and go without an answer."""
    beginning, more = request
    parts = urlsplit(address)
    try:
        with socket.create_connection((parts.hostname, parts.port or 0), _PATIENCE_S) as connection:
            connection.sendall(beginning)
            for _ in range(more // len(_CHUNK)):
                connection.sendall(_CHUNK)
    except OSError:
        pass
