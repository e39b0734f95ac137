"""Settings that a session keeps, settings that may change before it is resumed, and their records."""

from pathlib import Path
from unittest import mock

import msgspec
import pytest

from faintfield.rig.cameras.settings import FolderSettings, GPhoto2Settings, SimulatedSettings
from faintfield.rig.errors import PlanRefused
from faintfield.rig.lights.settings import CommandSettings
from faintfield.rig.plan import CapturePlan
from faintfield.rig.session.resume import adopt_settings, check_same_rig, find_changes, open_session, present_settings
from faintfield.rig.session.session import FrozenPlan, taken_frames
from faintfield.rig.session.verify import verify
from faintfield.rig.settings import CheckSettings, RigSettings
from faintfield.rig.stages.protocol import StageSettings
from tests.faults.capturing import SMALL_RIG, Operator, capture, events

replace = msgspec.structs.replace


def frozen(rig: RigSettings = SMALL_RIG) -> FrozenPlan:
    return FrozenPlan(CapturePlan.of(rig.grid, rig.steps(), approach_mm=1.0, frame_bytes=1), rig)


def with_checks(**values: float) -> RigSettings:
    return replace(SMALL_RIG, checks=CheckSettings(**values))  # type: ignore[arg-type]


@pytest.fixture
def session(tmp_path: Path) -> Path:
    """A session of which four frames are taken."""
    capture(tmp_path / "session", Operator({}, {4: "stop"}))
    return tmp_path / "session"


@pytest.mark.parametrize(
    ("now", "words"),
    [
        (
            replace(SMALL_RIG, grid=replace(SMALL_RIG.grid, pitch_mm=49.0), step=SMALL_RIG.step[:2]),
            ["grid.pitch_mm was 50.0 and is 49.0", 'step[2].kind was "dark" and is not set', "step[2].exposure_s was"],
        ),
        (
            replace(SMALL_RIG, stage=replace(SMALL_RIG.stage, approach_mm=1.0), checks=CheckSettings(leak_dn=9.0)),
            ["stage.approach_mm was 2.0 and is 1.0"],
        ),
        (
            replace(SMALL_RIG, camera=FolderSettings("incoming")),
            ['camera.backend was "simulated" and is "folder"', 'camera.folder was not set and is "incoming"'],
        ),
    ],
)  # fmt: skip
def test_refused_change_names_both_values(now: RigSettings, words: list[str]) -> None:
    with pytest.raises(PlanRefused, match=r"; set it back, or begin a new session") as refused:
        check_same_rig(frozen(), now)
    assert all(text in str(refused.value) for text in words)
    assert "checks" not in str(refused.value)


@pytest.mark.parametrize(
    ("then", "now", "keys"),
    [
        (SMALL_RIG, with_checks(leak_dn=9.0, saturation_dn=4000.0), ["checks.saturation_dn", "checks.leak_dn"]),
        (
            SMALL_RIG,
            replace(SMALL_RIG, stage=replace(SMALL_RIG.stage, port="simulated:grbl", baud=9600)),
            ["stage.port", "stage.baud"],
        ),
        (
            replace(SMALL_RIG, camera=GPhoto2Settings(port="usb:001,004")),
            replace(SMALL_RIG, camera=GPhoto2Settings(port="usb:001,009", answer_s=60.0)),
            ["camera.port", "camera.answer_s"],
        ),
        (
            replace(SMALL_RIG, camera=FolderSettings("in")),
            replace(SMALL_RIG, camera=FolderSettings("in", arrival_s=90.0, quiet_s=9.0, file_times=False)),
            ["camera.arrival_s", "camera.quiet_s", "camera.file_times"],
        ),
        (SMALL_RIG, SMALL_RIG, []),
    ],
)
def test_settings_that_no_frame_needs_may_change(then: RigSettings, now: RigSettings, keys: list[str]) -> None:
    check_same_rig(frozen(then), now)
    changes = find_changes(then, now)
    assert [change.key for change in changes] == keys
    assert not any(change.frozen for change in changes)


@pytest.mark.parametrize(("then", "now"), [("/dev/ttyUSB0", "simulated:grbl"), ("simulated:grbl", "/dev/ttyUSB0")])
def test_port_keeps_a_stage_real_or_simulated(then: str, now: str) -> None:
    before, after = (replace(SMALL_RIG, stage=StageSettings("grbl", port)) for port in (then, now))
    with pytest.raises(PlanRefused, match=r"stage\.port \(simulated\) was \w+ and is \w+; set it back"):
        check_same_rig(frozen(before), after)
    check_same_rig(frozen(before), replace(before, stage=replace(before.stage, port=f"{then}2")))


def test_command_of_a_light_may_change(tmp_path: Path) -> None:
    lamps = [CommandSettings(name=name, on=("usbrelay", "A=1"), off=("usbrelay", "A=0")) for name in ("room", "lamp")]
    before = replace(SMALL_RIG, light=tuple(lamps))
    now = replace(SMALL_RIG, light=(lamps[0], replace(lamps[1], on=("usbrelay", "B=1"), limit_s=20.0)))
    capture(tmp_path / "session", Operator({}, {1: "stop"}), before)
    with open_session(tmp_path / "session", None) as opened:
        assert [change.key for change in adopt_settings(opened, now)] == ["light[1].on", "light[1].limit_s"]
        with pytest.raises(PlanRefused, match=r'light\[0\]\.name was "room" and is "hall"'):
            adopt_settings(opened, replace(now, light=(replace(lamps[0], name="hall"), now.light[1])))
    assert present_settings(tmp_path / "session") == now


def test_changes_are_recorded_all_or_none(session: Path) -> None:
    times = ["2030-01-01T00:00:00.000+00:00", KeyboardInterrupt]  # killed at the second change
    with open_session(session, None) as opened:
        with mock.patch("faintfield.rig.session.journal._now", side_effect=times), pytest.raises(KeyboardInterrupt):
            adopt_settings(opened, with_checks(leak_dn=9.0, saturation_dn=4000.0))
    assert present_settings(session) == SMALL_RIG
    with open_session(session, None) as opened:
        with pytest.raises(PlanRefused):
            adopt_settings(
                opened, replace(with_checks(leak_dn=9.0), camera=SimulatedSettings(size_px=(16, 12), seed=2))
            )
        assert opened.rig == SMALL_RIG
        assert opened.journal.events("setting_changed") == []
        adopt_settings(opened, with_checks(leak_dn=9.0, saturation_dn=4000.0))
    assert present_settings(session) == with_checks(leak_dn=9.0, saturation_dn=4000.0)


def test_changes_are_recorded_and_apply(session: Path) -> None:
    assert isinstance(SMALL_RIG.camera, SimulatedSettings)
    # Every pixel is above this: the offset is 100 DN
    strict = with_checks(saturation_dn=1.0)
    with open_session(session, None) as opened:
        assert opened.rig == SMALL_RIG
        adopt_settings(opened, strict)
        assert opened.rig == strict
    capture(session, Operator({}, {2: "stop"}))
    assert present_settings(session) == strict
    changes = [event.detail for event in events(session, "setting_changed")]
    assert changes == [{"key": "checks.saturation_dn", "old": None, "new": 1.0}]
    records = [committed.record for _, committed, _ in taken_frames(session)]
    assert [record.checks["saturated_share"] for record in records] == [0.0] * 4 + [1.0] * 2
    assert all(record.warnings for record in records[4:])
    assert verify(session).problems == ()


def test_change_back_is_recorded_but_no_repetition(session: Path) -> None:
    for now in (with_checks(leak_dn=9.0), with_checks(leak_dn=9.0), SMALL_RIG):
        with open_session(session, None) as opened:
            adopt_settings(opened, now)
    changes = [(event.detail["old"], event.detail["new"]) for event in events(session, "setting_changed")]
    assert changes == [(8.0, 9.0), (9.0, 8.0)]
    assert present_settings(session) == SMALL_RIG
