"""A simulated controller with its mechanics, wire and clock, for the driver in this program or for other programs."""

import os
import select
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from faintfield.rig.errors import PlanRefused, StageLost
from faintfield.rig.simulation.controller.firmware import SimulatedFirmware, Wire
from faintfield.rig.simulation.controller.kinematics import SimulatedClock
from faintfield.rig.stages.gantry import Gantry, serial_stage
from faintfield.rig.stages.protocol import Point, StageSettings
from faintfield.rig.stages.transport import Port, SerialPort, TrafficLog

with suppress(ModuleNotFoundError):  # on Windows
    import tty

# Longest wait in s between two looks at a served port.
_MAX_WAIT_S = 0.05

type MakeFirmware = Callable[[SimulatedClock, Wire], SimulatedFirmware]
"""Makes a controller: `SimulatedGrbl` or `SimulatedMarlin`, possibly with options."""


class Link:
    """A cable from the host's port to the controller's, within the program; it is the host's end as well."""

    url = "simulated:"

    def __init__(self) -> None:
        self._plugged = True
        self._written, self._readable = bytearray(), bytearray()

    def open(self) -> Port:
        """Return the host's end, emptied."""
        self.read(0.0)
        self._written.clear()
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
        if not self._plugged:
            raise StageLost("simulated: the connection is lost (unplugged); check cable and power")


class PtyLink(Link):
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
        self._far, near, name = _open_pty()
        Path(self.url).unlink(missing_ok=True)
        Path(self.url).symlink_to(name)
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


class Bench:
    """A simulated stage, on which motions take no real time.

    Driver and controller take turns on one clock: when the driver waits for bytes, simulated time advances until some
    arrive or the wait is over. The bytes pass through `link`. Unless told otherwise, opening the port restarts the
    controller, as on most boards. Until `host_busy_until_s`, which faults raise, the driver does not come to read what
    has arrived, as on a computer that is busy.
    """

    def __init__(self, firmware: MakeFirmware, link: Link | None = None, *, resets_on_open: bool = True) -> None:
        self.clock = SimulatedClock()
        self.wire = Wire(self.clock)
        self.firmware = firmware(self.clock, self.wire)
        self.link = link or Link()
        self.resets_on_open = resets_on_open
        self.host_busy_until_s = 0.0

    def open_port(self) -> Port:
        """Open the host's end of the link."""
        port = self.link.open()
        if self.resets_on_open:
            self.firmware.restart()
        self.wire.clear()
        return _SteppedPort(port, self)

    def stage(self, settings: StageSettings | None = None, traffic: TrafficLog | None = None) -> Gantry:
        """Return the driver for this controller, not yet connected; by default with the firmware's protocol."""
        settings = settings or StageSettings(protocol=self.firmware.protocol, port=self.link.url)
        return serial_stage(settings, self.clock, traffic, self.open_port)

    def true_position(self) -> Point:
        """Return the true position of the carriages, whatever the controller reports."""
        return Point(*self.firmware.mechanics.true_mm())

    def still_s(self) -> float:
        """Return the time since the last motion ended."""
        return self.clock.now_s() - self.firmware.mechanics.still_since_s

    def plug(self) -> None:
        """Plug the cable in, which powers and starts the controller."""
        self.link.plug()
        self.wire.connected = True
        self.firmware.restart()

    def unplug(self) -> None:
        """Pull the cable out."""
        self.link.unplug()
        self.wire.connected = False
        self.wire.clear()


class _SteppedPort:
    """A port on which simulated time passes only while the driver waits for bytes."""

    def __init__(self, port: Port, bench: Bench) -> None:
        self._port = port
        self._bench = bench

    def write(self, data: bytes) -> None:
        self._port.write(data)
        arrived = self._bench.link.receive(len(data))
        self._bench.firmware.receive(self._bench.wire.to_controller(arrived))

    def read(self, timeout_s: float) -> bytes:
        """Advance simulated time until bytes arrive or `timeout_s` is over, and return them."""
        bench = self._bench
        deadline_s = bench.clock.now_s() + timeout_s
        while not bench.wire.arrived():
            if not bench.wire.connected:
                return self._port.read(0.0)
            if not bench.clock.step(deadline_s):
                break
        bench.clock.sleep_s(max(0.0, bench.host_busy_until_s - bench.clock.now_s()))
        if not bench.wire.arrived():
            return b""
        data = bench.wire.take()
        bench.link.send(data)
        received = b""
        while len(received) < len(data):
            received += self._port.read(1.0)
        return received

    def close(self) -> None:
        self._port.close()


class Server:
    """A simulated controller behind a pseudo-terminal, whose device `port` other programs open."""

    def __init__(self, make_firmware: MakeFirmware) -> None:
        self._clock = SimulatedClock()
        self._wire = Wire(self._clock)
        self._firmware = make_firmware(self._clock, self._wire)
        # The near end stays open, so that programs can connect again
        self._far, self._near, self.port = _open_pty()

    def run(self, speed: float = 1.0) -> None:
        """Serve until interrupted, `speed` simulated seconds per real second."""
        begun_s = time.monotonic()
        while True:
            self.turn(speed * (time.monotonic() - begun_s))
            next_s = self._clock.next_event_s()
            wait_s = _MAX_WAIT_S if next_s is None else (next_s - self._clock.now_s()) / speed
            select.select([self._far], [], [], min(_MAX_WAIT_S, max(0.0, wait_s)))

    def turn(self, now_s: float) -> None:
        """Advance simulated time to `now_s`, and pass on the bytes in both directions."""
        self._clock.sleep_s(max(0.0, now_s - self._clock.now_s()))
        if self._wire.arrived():
            os.write(self._far, self._wire.take())
        if select.select([self._far], [], [], 0.0)[0]:
            self._firmware.receive(self._wire.to_controller(os.read(self._far, 4096)))

    def close(self) -> None:
        """Remove the port."""
        os.close(self._far)
        os.close(self._near)


def _open_pty() -> tuple[int, int, str]:
    """Open a pseudo-terminal that changes no bytes; return its far and near end, and the name of the near one."""
    if sys.platform == "win32":
        raise PlanRefused("Windows has no pseudo-terminals; name a simulated stage without :pty")
    far, near = os.openpty()
    tty.setraw(near)
    return far, near, os.ttyname(near)
