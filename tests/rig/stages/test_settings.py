"""Meaning of the settings of a controller, computed by hand from the firmware's documentation."""

import pytest

from faintfield.rig.errors import WrongFirmware
from faintfield.rig.stages import marlin_lines as marlin
from faintfield.rig.stages.grbl_lines import GrblSettings
from faintfield.rig.stages.protocol import Box, Identity, MotionLimits

GRBL = {
    1: "255", 13: "0", 20: "1", 22: "1", 23: "2", 24: "100.0", 25: "1000.0", 27: "3.0",
    100: "80.0", 101: "160.0", 102: "400.0", 110: "6000.0", 111: "3000.0", 112: "600.0",
    120: "500.0", 121: "250.0", 122: "50.0", 130: "400.0", 131: "300.0", 132: "100.0",
}  # fmt: skip
BUILD = {"VER": "1.1h.20190830:", "OPT": "V,15,128"}
MARLIN = [
    "FIRMWARE_NAME:Marlin 2.1.2.4 (Jun  1 2024 12:00:00)",
    "Cap:EMERGENCY_PARSER:1",
    "echo: M92 X80.00 Y160.00 Z400.00",
    "echo: M203 X100.00 Y50.00 Z5.00",
    "echo: M201 X500.00 Y250.00 Z100.00",
    "echo: M204 P400.00 R400.00 T300.00",
    "echo:Soft endstops: On  Min:  X1.00 Y2.00 Z0.00   Max:  X401.00 Y302.00 Z100.00",
]


def grbl(changes: dict[int, str] | None = None, axes: tuple[int, int] = (0, 1), options: str = "V,15,128") -> Identity:
    return GrblSettings(GRBL | (changes or {}), BUILD | {"OPT": options}).identity(axes)


def of_marlin(*changes: tuple[str, str], axes: tuple[str, str] = ("X", "Y"), travel: Box | None = None) -> Identity:
    lines = "\n".join(MARLIN)
    for old, new in changes:
        assert old in lines
        lines = lines.replace(old, new)
    return marlin.marlin_identity(map(marlin.parse, lines.splitlines()), axes, travel)


def test_identity_of_grbl() -> None:
    identity = grbl()
    assert identity.firmware == "Grbl 1.1h.20190830"
    assert identity.travel_mm == Box((-400.0, 0.0), (-300.0, 0.0))
    assert identity.motion == MotionLimits((100.0, 50.0), (500.0, 250.0))
    # Half a step of 1/80 and 1/160 mm, and half a micrometre each for report and command
    assert identity.tolerance_mm == pytest.approx((0.00725, 0.004125), abs=1e-12)
    assert identity.homing_bound_s == 240.0
    assert identity.pull_off_mm == 3.0
    assert identity.homes_together
    assert identity.warnings == ()
    assert identity.settings == {f"${number}": value for number, value in GRBL.items()}


def test_other_axes_of_grbl_have_their_own_settings() -> None:
    identity = grbl(axes=(2, 0))
    assert identity.travel_mm == Box((-100.0, 0.0), (-400.0, 0.0))
    assert identity.motion == MotionLimits((10.0, 100.0), (50.0, 500.0))
    assert identity.tolerance_mm == pytest.approx((0.00225, 0.00725), abs=1e-12)


@pytest.mark.parametrize(
    ("options", "mask", "travel"),
    [
        ("V,15,128", "3", Box((-400.0, 0.0), (-300.0, 0.0))),
        ("VZ,15,128", "0", Box((-400.0, 0.0), (-300.0, 0.0))),
        ("VZ,15,128", "2", Box((-400.0, 0.0), (0.0, 300.0))),
        ("V,Z", "3", Box((-400.0, 0.0), (-300.0, 0.0))),  # only the letters before the comma are options
    ],
)
def test_travel_of_grbl_extends_from_the_switch(options: str, mask: str, travel: Box) -> None:
    assert grbl({23: mask}, options=options).travel_mm == travel


def test_bound_of_homing_is_travel_and_slow_search() -> None:
    # 400 mm at 100 mm/min are 240 s; four pull-offs of 3 mm at 10 mm/min are 72 s; half as much again, and 2 s
    assert grbl({24: "10.0", 25: "100.0"}).homing_bound_s == pytest.approx(1.5 * (240.0 + 72.0) + 2.0)
    # The longer axis counts
    assert grbl({24: "10.0", 25: "100.0"}, axes=(1, 0)).homing_bound_s == pytest.approx(470.0)
    assert grbl({24: "10.0", 25: "100.0"}, axes=(1, 2)).homing_bound_s == pytest.approx(1.5 * (180.0 + 72.0) + 2.0)


@pytest.mark.parametrize(("number", "value"), [(24, "0"), (27, "-1"), (101, "-5"), (110, "0"), (22, "0"), (13, "1")])
def test_impossible_values_of_grbl_are_refused_by_number(number: int, value: str) -> None:
    with pytest.raises(WrongFirmware, match=rf"^\${number}={value}: "):
        grbl({number: value})


@pytest.mark.parametrize("number", [13, 22, 27, 110])
def test_missing_settings_of_grbl_are_refused_by_number(number: int) -> None:
    values = {key: value for key, value in GRBL.items() if key != number}
    with pytest.raises(WrongFirmware, match=rf"^\${number}=not reported: "):
        GrblSettings(values, BUILD).identity((0, 1))


def test_optional_settings_of_grbl() -> None:
    assert grbl({27: "0", 23: "0"}).pull_off_mm == 0.0
    assert not grbl(options="VH,15,128").homes_together
    assert grbl({22: "3"}).homes_together, "bits beyond the first are grblHAL's"


@pytest.mark.parametrize(("version", "accepted"), [("v1.1h", True), ("1.0", False), ("", False)])
def test_only_grbl_1_1_is_driven(version: str, accepted: bool) -> None:
    settings = GrblSettings(GRBL, {"VER": version})
    if accepted:
        assert settings.identity((0, 1)).homes_together
    else:
        with pytest.raises(WrongFirmware, match=version or "of no version"):
            settings.identity((0, 1))


def test_identity_of_marlin() -> None:
    identity = of_marlin()
    assert identity.firmware == "Marlin 2.1.2.4 (Jun  1 2024 12:00:00)"
    assert identity.travel_mm == Box((1.0, 401.0), (2.0, 302.0))
    # Motions between exposures are travel moves: their acceleration is the least of T and the axis's own
    assert identity.motion == MotionLimits((100.0, 50.0), (300.0, 250.0))
    assert identity.tolerance_mm == pytest.approx((0.5 / 80 + 0.0055, 0.5 / 160 + 0.0055), abs=1e-12)
    assert identity.homing_bound_s == 240.0
    assert not identity.homes_together
    assert identity.pull_off_mm == 0.0
    assert identity.warnings == ()
    assert identity.settings["M92"] == "X80 Y160 Z400"
    assert list(identity.settings) == ["M201", "M203", "M204", "M92"]


def test_other_axes_of_marlin_have_own_settings() -> None:
    travel = Box((0.0, 50.0), (0.0, 60.0))
    identity = of_marlin(axes=("Z", "X"), travel=travel)
    assert identity.travel_mm == travel
    assert identity.motion == MotionLimits((5.0, 100.0), (100.0, 300.0))
    with pytest.raises(WrongFirmware, match=r"set stage\.travel_mm"):
        of_marlin(axes=("Z", "X"))


def test_marlin_without_limits_or_parser_gives_warning() -> None:
    travel = Box((0.0, 50.0), (0.0, 60.0))
    without_limits = of_marlin((MARLIN[-1], "ok"), travel=travel)
    assert [warning.split(":")[0] for warning in without_limits.warnings] == ["no limits are reported"]
    without_parser = of_marlin(("PARSER:1", "PARSER:0"))
    assert [warning.split(":")[0] for warning in without_parser.warnings] == ["no emergency parser"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("M203 X100.00 Y50.00", "M203 X100.00 Y0.00"), "M203 Y=0: "),
        (("T300.00", "T-1.00"), "M204 T=-1: "),
        (("Marlin 2.1.2.4", "Repetier 1.0"), "'Repetier 1.0 .*', not Marlin"),
    ],
)
def test_impossible_values_of_marlin_are_refused_by_name(change: tuple[str, str], message: str) -> None:
    with pytest.raises(WrongFirmware, match=message):
        of_marlin(change)


@pytest.mark.parametrize("named", [{"FIRMWARE": "grblHAL"}, {}])
@pytest.mark.parametrize(
    ("options", "homes_low", "hard_limits", "travel_x_mm"),
    [
        ("V", "0", "1", (-397.0, -3.0)),
        ("V", "0", "0", (-400.0, 0.0)),
        ("VZ", "0", "3", (-397.0, 0.0)),
        ("VZ", "1", "1", (0.0, 397.0)),
    ],
)
def test_hard_limits_shorten_the_travel_of_grblhal(
    named: dict[str, str], options: str, homes_low: str, hard_limits: str, travel_x_mm: tuple[float, float]
) -> None:
    # By limits_set_work_envelope() of grblHAL; without its name it is known by a setting that GRBL lacks
    values = {**GRBL, 23: homes_low, 21: hard_limits, 27: "3.000", 130: "400.000", **({} if named else {40: "0"})}
    identity = GrblSettings(values, {**BUILD, **named, "OPT": f"{options},15,128"}).identity((0, 1))
    assert identity.travel_mm.x_mm == travel_x_mm
    assert identity.firmware.startswith("grblHAL ")
