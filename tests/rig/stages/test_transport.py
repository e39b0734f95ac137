"""Lines over pyserial: bounded waits, every byte in the log, and named failures for lost connections."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from faintfield.rig.devices import open_stage
from faintfield.rig.errors import StageLost, StageTimeout
from faintfield.rig.simulation.controller.bench import Bench, Link, PtyLink
from faintfield.rig.simulation.controller.grbl import SimulatedGrbl
from faintfield.rig.simulation.controller.kinematics import SimulatedClock
from faintfield.rig.stages.protocol import StageSettings
from faintfield.rig.stages.transport import LineTransport, SerialPort
from tests.rig.stages.benches import Traffic, homed
from tests.rig.stages.socket_link import SocketLink


@pytest.fixture
def pty() -> Iterator[PtyLink]:
    link = PtyLink()
    yield link
    link.close()


def open_line() -> tuple[Link, LineTransport]:
    link = Link()
    line = LineTransport(link.open, SimulatedClock())
    line.open()
    return link, line


@pytest.mark.parametrize("url", ["/dev/no-such-port", "socket://127.0.0.1:1", "nonsense://x"])
def test_port_that_cannot_be_opened_is_named(url: str) -> None:
    with pytest.raises(StageLost, match=r"cannot be opened .*; serial ports here: .*; check the cable") as caught:
        SerialPort(url, 115200)
    assert "\n" not in str(caught.value)


def test_port_is_opened_exclusively(pty: PtyLink) -> None:
    first = pty.open()
    with pytest.raises(StageLost, match="no other program"):
        pty.open()
    first.close()
    pty.open().close()


def test_bytes_pass_and_an_unplugged_port_is_lost(pty: PtyLink) -> None:
    port = pty.open()
    port.write(b"?")
    assert pty.receive(1) == b"?"
    pty.send(b"ok\r\n")
    data = b""
    while len(data) < 4:
        data += port.read(1.0)
    assert data == b"ok\r\n"
    assert port.read(0.0) == b""
    pty.unplug()
    for use in (lambda: port.read(1.0), lambda: port.write(b"?")):
        with pytest.raises(StageLost, match="connection is lost"):
            use()
    port.close()


def test_lines_of_any_bytes_are_decoded() -> None:
    link, line = open_line()
    link.send(b"\r\nok\r\n\n  <Idle|\xff\x00>  \nhalf")
    assert line.next_line(0.0) == "ok"
    assert line.next_line(0.0) == "<Idle|\ufffd\x00>"
    assert line.next_line(0.0) is None
    link.send(b" a line\n")
    assert line.next_line(0.0) == "half a line"


def test_endless_noise_is_bounded() -> None:
    link, line = open_line()
    for _ in range(100):
        link.send(b"x" * 1000)
        assert line.next_line(0.0) is None
    link.send(b"\nok\n")
    first = line.next_line(0.0)
    assert first is not None
    assert len(first) <= 2024
    assert line.next_line(0.0) == "ok"


def test_closed_line_forgets_what_it_held() -> None:
    link, line = open_line()
    link.send(b"half")
    assert line.next_line(0.0) is None
    link.unplug()
    with pytest.raises(StageLost):
        line.next_line(0.0)
    with pytest.raises(StageLost, match="not connected"):
        line.send(b"?")
    link.plug()
    line.open()
    link.send(b"ok\n")
    assert line.next_line(0.0) == "ok"


def test_every_byte_and_time_is_logged(pty: PtyLink) -> None:
    bench = Bench(SimulatedGrbl, pty)
    traffic = Traffic()
    sent, received = bytearray(), bytearray()
    bench.wire.filters_to_controller.append(lambda data: sent.extend(data) or data)  # type: ignore[func-returns-value]
    bench.wire.filters_to_host.append(lambda data: received.extend(data) or data)  # type: ignore[func-returns-value]
    stage = homed(bench, traffic)
    stage.move_to(-100.0, -100.0)
    assert traffic.all("sent") == sent
    assert traffic.all("received") == received
    times = [at_s for at_s, _, _ in traffic.entries]
    assert times == sorted(times)
    assert times[-1] == bench.clock.now_s()


@pytest.mark.parametrize("link", [PtyLink, SocketLink])
def test_unplugged_stage_returns_by_the_same_name(link: type[PtyLink] | type[SocketLink]) -> None:
    connection = link()
    bench = Bench(SimulatedGrbl, connection)
    stage = homed(bench)
    bench.unplug()
    with pytest.raises(StageLost):
        stage.move_to(-100.0, -100.0)
    with pytest.raises(StageLost):
        stage.recover()
    bench.plug()
    stage.recover()
    assert not stage.trusted
    stage.home()
    assert stage.move_to(-100.0, -100.0).trusted
    stage.close()
    connection.close()


def test_mute_controller_does_not_hang_the_connection(bench: Bench) -> None:
    bench.wire.filters_to_host.append(lambda data: b"")
    with pytest.raises(StageTimeout, match="no answer"):
        bench.stage().connect()
    assert bench.clock.now_s() < 10.0


def test_settings_are_checked() -> None:
    for settings, words in (({}, r"stage\.port is missing"), ({"port": "x", "axes": ("X", "X")}, r"stage\.axes")):
        with pytest.raises(ValueError, match=words):
            StageSettings(protocol="grbl", **settings)  # type: ignore[arg-type]
    StageSettings(protocol="grbl", port="x", axes=("Z", "X"), approach_mm=0.0, feed_mm_per_min=0.1)
    assert open_stage(StageSettings(protocol="simulated")).settings.protocol == "grbl"


@pytest.mark.parametrize("scheme", ["spy", "file"])
def test_url_that_writes_files_is_refused(scheme: str, tmp_path: Path) -> None:
    written = tmp_path / "written"
    with pytest.raises(ValueError, match=r"stage.port = .*; give a serial device, or a URL that begins with socket://"):
        StageSettings("grbl", port=f"{scheme}:///dev/null?file={written}")
    assert not written.exists()
