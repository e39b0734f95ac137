"""The link between driver and simulated controller: within the program, or a pseudo-terminal.

The latter passes every byte through pyserial and the operating system, as with real hardware.
"""

import os
import tempfile
import tty
from pathlib import Path
from typing import Protocol

from faintfield.rig.errors import StageLost
from faintfield.rig.stages.transport import Port, SerialPort


class Link(Protocol):
    """A cable from the host's port to the controller's."""

    @property
    def url(self) -> str:
        """URL that the driver opens."""
        ...

    def open(self) -> Port:
        """Open the host's end."""
        ...

    def receive(self, count: int) -> bytes:
        """Return `count` bytes that the host has written."""
        ...

    def send(self, data: bytes) -> None:
        """Write bytes for the host to read."""
        ...

    def plug(self) -> None:
        """Plug the cable in."""
        ...

    def unplug(self) -> None:
        """Pull the cable out."""
        ...


class DirectLink:
    """A link within the program."""

    url = "simulated:"

    def __init__(self) -> None:
        self._plugged = True
        self._written, self._readable = bytearray(), bytearray()

    def open(self) -> Port:
        """Return the host's end, emptied."""
        self._require_plug()
        self._written.clear()
        self._readable.clear()
        return self

    def write(self, data: bytes) -> None:
        """Send `data` to the controller."""
        self._require_plug()
        self._written += data

    def read(self, timeout_s: float) -> bytes:
        """Return what the controller has sent."""
        self._require_plug()
        data = bytes(self._readable)
        self._readable.clear()
        return data

    def close(self) -> None:
        """Do nothing: the link needs no closing."""

    def receive(self, count: int) -> bytes:
        """Return `count` bytes that the host has written."""
        data = bytes(self._written[:count])
        del self._written[:count]
        return data

    def send(self, data: bytes) -> None:
        """Write bytes for the host to read."""
        self._readable += data

    def plug(self) -> None:
        """Plug the cable in."""
        self._plugged = True

    def unplug(self) -> None:
        """Pull the cable out."""
        self._plugged = False

    def _require_plug(self) -> None:
        """Raise `StageLost` as a port does when its cable is unplugged."""
        if not self._plugged:
            raise StageLost("simulated: the connection is lost (unplugged); check cable and power")


class PtyLink:
    """A pseudo-terminal, which is a serial port to the driver.

    Its name is a symbolic link, so that it stays the same when the cable is plugged in again.
    """

    def __init__(self) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix="faintfield-stage-")
        self.url = str(Path(self._folder.name) / "tty")
        self._far = -1
        self.plug()

    def open(self) -> Port:
        """Open the host's end with pyserial."""
        return SerialPort(self.url, 115200)

    def receive(self, count: int) -> bytes:
        """Return `count` bytes that the host has written."""
        data = b""
        while len(data) < count:
            data += os.read(self._far, count - len(data))
        return data

    def send(self, data: bytes) -> None:
        """Write bytes for the host to read."""
        os.write(self._far, data)

    def plug(self) -> None:
        """Plug the cable in."""
        if self._far >= 0:
            return
        self._far, near = os.openpty()
        tty.setraw(near)
        Path(self.url).unlink(missing_ok=True)
        Path(self.url).symlink_to(os.ttyname(near))
        os.close(near)

    def unplug(self) -> None:
        """Pull the cable out."""
        if self._far >= 0:
            os.close(self._far)
            self._far = -1
            Path(self.url).unlink(missing_ok=True)

    def close(self) -> None:
        """Remove the port."""
        self.unplug()
        self._folder.cleanup()
