"""A link of the simulated controllers over TCP, for tests of network connections."""

import socket

from faintfield.rig.simulation.controller.bench import Link
from faintfield.rig.stages.transport import Port, SerialPort
from tests.patience import HANG_S


class SocketLink(Link):
    """A TCP connection on this computer, as to a serial device server; pyserial opens it by `socket://`."""

    def __init__(self) -> None:
        self._listener: socket.socket | None = None
        self._far: socket.socket | None = None
        self._address = ("127.0.0.1", 0)
        self.plug()

    def open(self) -> Port:
        """Open the host's end with pyserial."""
        port = SerialPort(self.url, 115200)
        if self._listener is not None:
            self._hang_up()
            self._far, _ = self._listener.accept()
            self._far.settimeout(HANG_S)
            self._far.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        return port

    def receive(self, count: int) -> bytes:
        """Return `count` bytes that the host has written."""
        data = b""
        while self._far is not None and len(data) < count:
            data += self._far.recv(count - len(data))
        return data

    def send(self, data: bytes) -> None:
        """Write bytes for the host to read."""
        if self._far is not None:
            self._far.sendall(data)

    def plug(self) -> None:
        """Plug the cable in."""
        if self._listener is None:
            self._listener = socket.create_server(self._address, reuse_port=True)
            self._listener.settimeout(HANG_S)
            self._address = self._listener.getsockname()[:2]
            self.url = "socket://{}:{}".format(*self._address)

    def unplug(self) -> None:
        """Pull the cable out."""
        self._hang_up()
        if self._listener is not None:
            self._listener.close()
            self._listener = None

    def close(self) -> None:
        """Stop listening."""
        self.unplug()

    def _hang_up(self) -> None:
        """Close the connection, if there is one."""
        if self._far is not None:
            self._far.close()
            self._far = None
