"""The simulated controllers answer as the real ones do."""

from contextlib import closing
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from faintfield.rig.simulation.controller.bench import Server
from faintfield.rig.simulation.controller.firmware import Wire
from faintfield.rig.simulation.controller.grbl import SimulatedGrbl
from faintfield.rig.simulation.controller.kinematics import SimulatedClock
from faintfield.rig.simulation.controller.marlin import SimulatedMarlin
from faintfield.rig.stages.transport import SerialPort
from tests.rig.stages.benches import CONTROLLERS, Controller


class ControllerTerminal:
    """Types lines to a simulated controller and returns its answers."""

    def __init__(self, firmware: Controller, **options: Any) -> None:
        self.clock = SimulatedClock()
        self.wire = Wire(self.clock)
        self.firmware = firmware(self.clock, self.wire, **options)
        self.greeting = self.wait(2.0)

    def wait(self, duration_s: float) -> list[str]:
        self.clock.sleep_s(duration_s)
        return self.wire.take().decode().split("\n")[:-1]

    def type(self, data: bytes, wait_s: float = 0.1) -> list[str]:
        self.firmware.receive(data)
        return [line.strip() for line in self.wait(wait_s)]


GREETING = "Grbl 1.1h ['$' for help]"
LOCKED = "[MSG:'$H'|'$X' to unlock]"


def test_grbl_starts_locked() -> None:
    terminal = ControllerTerminal(SimulatedGrbl)
    assert [line.strip() for line in terminal.greeting] == [GREETING, LOCKED]
    assert terminal.type(b"$J=G91X1F100\n") == ["error:9"]
    assert terminal.type(b"?")[0].startswith("<Alarm|MPos:0.000,0.000,0.000")
    assert terminal.type(b"$X\n") == ["[MSG:Caution: Unlocked]", "ok"]


def test_homed_grbl_answers_as_the_firmware_does() -> None:
    terminal = ControllerTerminal(SimulatedGrbl)
    assert terminal.type(b"$H\n", 120.0) == ["ok"]
    for line, answer in (
        (b"$J=X1F100\n", "error:15"),
        (b"$J=F100\n", "error:16"),
        (b"x" * 81 + b"\n", "error:11"),
        (b"\n", "ok"),
        (b"\x18", GREETING),  # a reset at rest is no alarm
        (b"$J=G90X-100F6000\n", "ok"),  # parsed, not moved
    ):
        assert terminal.type(line) == [answer], line
    assert terminal.type(b"?")[0].startswith("<Jog|MPos:")
    terminal.wait(3.0)
    assert terminal.type(b"?")[0].startswith("<Idle|MPos:-100.000,-1.000,0.000")
    terminal.type(b"$J=G90X-300F6000\n", 0.5)
    assert terminal.type(b"\x18")[0] == "ALARM:3"


def test_grbl_needs_a_reset_after_critical_alarm() -> None:
    terminal = ControllerTerminal(SimulatedGrbl)
    assert terminal.type(b"$H\n", 120.0) == ["ok"]
    terminal.firmware.receive(b"G53G0X10\n")
    terminal.firmware.receive(b"\x18")  # too early
    assert [line.strip() for line in terminal.wait(1.0)][:2] == ["ALARM:2", "ok"]
    assert terminal.type(b"?") == terminal.type(b"$$\n") == []
    assert terminal.type(b"\x18") == [GREETING, LOCKED]


def test_marlin_asks_again_for_damaged_lines() -> None:
    terminal = ControllerTerminal(SimulatedMarlin)
    assert terminal.greeting[0] == "start"
    assert terminal.type(b"N0 M110 N0*125\n") == ["ok"]
    assert terminal.type(b"N1 G21*26\n") == ["Error:checksum mismatch, Last Line: 0", "Resend: 1", "ok"]
    assert terminal.type(b"N1 G21*27\n") == ["ok"]
    assert terminal.type(b"N1 G21*27\n")[0] == "Error:Line Number is not Last Line Number+1, Last Line: 1"
    assert terminal.type(b"N2 G21\n")[1] == "Resend: 2"


@settings(max_examples=20)
@given(st.lists(st.binary(max_size=40), max_size=8))
@pytest.mark.parametrize("firmware", CONTROLLERS)
def test_no_bytes_crash_a_controller(firmware: Controller, typed: list[bytes]) -> None:
    terminal = ControllerTerminal(firmware)
    for data in typed:
        terminal.type(data)
    # Ends an unfinished line and, on GRBL, any state
    terminal.type(b"\n\x18\n", 2000.0)
    answer = terminal.type(b"?" if firmware.protocol == "grbl" else b"M115\n")
    assert any("<" in line or "FIRMWARE_NAME" in line for line in answer)


@pytest.mark.parametrize("firmware", CONTROLLERS)
def test_served_controller_answers_at_its_port(firmware: Controller) -> None:
    with closing(Server(firmware)) as server:
        port = SerialPort(server.port, 115200)
        heard = b""
        for turn in range(10_000):
            if turn == 200:
                port.write(b"?\nM115\n")
            server.turn(0.01 * turn)
            heard += port.read(0.0)
            if b"FIRMWARE_NAME" in heard or b"<Alarm" in heard:
                break
        port.close()
    assert (b"<Alarm" if firmware.protocol == "grbl" else b"FIRMWARE_NAME") in heard
