"""Lines of controllers are parsed strictly: no input crashes, and no damaged line is taken for an answer."""

from functools import reduce
from operator import xor

import pytest
from hypothesis import given
from hypothesis import strategies as st

from faintfield.rig.stages import grbl_lines as grbl
from faintfield.rig.stages import marlin_lines as marlin
from faintfield.rig.stages.transport import Ok, Unknown

GRBL_LINES = [
    "ok",
    "error:15",
    "ALARM:1",
    "<Idle|MPos:-1.000,-2.000,0.000|FS:0,0|WCO:0.000,0.000,0.000>",
    "<Hold:0|WPos:1.000,2.000,0.000|Bf:15,128|Pn:XY>",
    "$130=400.000",
    "[MSG:Reset to continue]",
    "[VER:1.1h.20190830:]",
    "Grbl 1.1h ['$' for help]",
]
MARLIN_LINES = [
    "ok",
    "ok N12 P15 B3",
    "ok X:0.00 Y:0.00 Z:0.00 E:0.00 Count: A:0 B:0 C:0",
    "X:10.00 Y:20.50 Z:0.00 E:0.00 Count X:800 Y:1640 Z:0",
    "Resend: 7",
    "Error:checksum mismatch, Last Line: 6",
    "Error:Printer halted. kill() called!",
    "echo:busy: processing",
    "start",
    "Cap:EMERGENCY_PARSER:1",
    "echo: M92 X80.00 Y80.00 Z400.00",
    "echo:Soft endstops: On  Min:  X0.00 Y0.00 Z0.00   Max:  X400.00 Y400.00 Z100.00",
    "area:{full:{min:{x:0,y:0,z:0},max:{x:400,y:400,z:100}},work:{min:{x:1,y:2,z:0},max:{x:399,y:398,z:100}}}",
    "x_min: TRIGGERED",
    "FIRMWARE_NAME:Marlin 2.1.2.4 (Jun  1 2024 12:00:00) SOURCE_CODE_URL:github.com/MarlinFirmware/Marlin",
]


def test_grbl_lines_are_read() -> None:
    kinds = [type(grbl.parse(line)).__name__ for line in GRBL_LINES]
    assert kinds == ["Ok", "ErrorCode", "Alarm", "Report", "Report", "GrblSetting", "Feedback", "Feedback", "Banner"]
    assert grbl.parse(GRBL_LINES[4]) == grbl.Report("Hold", 0, (1.0, 2.0, 0.0), False, None, "XY", is_brief=True)
    assert grbl.parse(GRBL_LINES[3]) == grbl.Report(
        "Idle", None, (-1.0, -2.0, 0.0), True, offset=(0.0, 0.0, 0.0), pins=""
    )


@pytest.mark.parametrize(
    ("fields", "outputs", "is_brief"),
    [
        ("FS:0,0", None, True),
        ("FS:0,0|WCO:0.000,0.000,0.000", None, False),  # GRBL puts the outputs off to the next report
        ("FS:0,0|Ov:100,100,100", "", False),
        ("FS:0,0|Ov:100,100,100|A:SFM", "SFM", False),
        ("Bf:15,128|FS:0,0|Pn:P|A:", "", False),  # grblHAL: the last one was switched off
        ("FS:0,0|v:100,100,100|:F", None, False),  # damaged
    ],
)
def test_outputs_in_reports_are_read(fields: str, outputs: str | None, is_brief: bool) -> None:
    report = grbl.parse(f"<Idle|MPos:-1.000,-2.000,0.000|{fields}>")
    assert isinstance(report, grbl.Report)
    assert report.outputs == (None if outputs is None else frozenset(outputs))
    assert report.is_brief == is_brief


def test_marlin_lines_are_read() -> None:
    assert [type(marlin.parse(line)).__name__ for line in MARLIN_LINES] == [
        "Ok", "Ok", "PositionReport", "PositionReport", "Resend", "ErrorText", "ErrorText", "Busy", "Start",
        "Capability", "MarlinSetting", "Limits", "Limits", "Switch", "Firmware",
    ]  # fmt: skip
    assert marlin.parse(MARLIN_LINES[3]) == marlin.PositionReport({"X": 10.0, "Y": 20.5, "Z": 0.0}, is_ok=False)
    assert marlin.parse(MARLIN_LINES[12]) == marlin.Limits((1.0, 399.0), (2.0, 398.0))
    assert marlin.parse(MARLIN_LINES[14]) == marlin.Firmware("Marlin 2.1.2.4 (Jun  1 2024 12:00:00)")
    assert marlin.parse("Error:checksum mismatch, Last Line: 6") == marlin.ErrorText(
        "checksum mismatch, Last Line: 6", in_transmission=True
    )


@given(st.integers(0, 10**6), st.text(st.characters(min_codepoint=32, max_codepoint=126), max_size=60))
def test_numbered_line_carries_xor_of_its_bytes(number: int, command: str) -> None:
    line, _, checksum = marlin.number_line(number, command).rstrip(b"\n").rpartition(b"*")
    assert line == f"N{number} {command}".encode()
    assert int(checksum) == reduce(xor, line)


@pytest.mark.parametrize("line", ["o", "OK", " ok", "ok ok", "ok\x00", ">G54:ok", "error:"])
def test_damaged_and_similar_lines_are_no_answers(line: str) -> None:
    assert isinstance(grbl.parse(line), Unknown)
    assert isinstance(marlin.parse(line), Unknown)


@given(st.data())
def test_one_damaged_character_never_makes_another_answer(data: st.DataObject) -> None:
    line = data.draw(st.sampled_from([line for line in GRBL_LINES + MARLIN_LINES if not line.startswith("ok")]))
    place = data.draw(st.integers(0, len(line) - 1))
    new = data.draw(st.characters(max_codepoint=255))
    for damaged in (line[:place] + new + line[place + 1 :], line[:place] + line[place + 1 :], line[:place] + line):
        assert not isinstance(grbl.parse(damaged), Ok)
        assert not isinstance(marlin.parse(damaged), Ok)
