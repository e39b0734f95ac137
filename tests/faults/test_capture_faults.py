"""A lost cable or camera, a full disk, a read-only folder: a named failure or a recovery; the session stays whole."""

import ctypes
import resource
import signal
from collections.abc import Callable, Container
from pathlib import Path
from unittest import mock

import msgspec
import numpy as np
import pytest

from faintfield.rig.cameras.protocol import CameraReport, Exposure
from faintfield.rig.capture.guide import Answer, OperatorInterface, Prompt, Status
from faintfield.rig.capture.loop import Capture
from faintfield.rig.capture.survey import survey
from faintfield.rig.capture.take import DriftChecks
from faintfield.rig.devices import Rig
from faintfield.rig.errors import CameraError, CaptureStopped, RigError, SessionUnwritable, StageLost
from faintfield.rig.session.disk import encode_exposure
from faintfield.rig.session.homings import DriftCheck, homing_groups, read_homing_groups
from faintfield.rig.session.journal import Journal
from faintfield.rig.session.resume import open_session
from faintfield.rig.session.session import FrozenPlan, is_sealed, read_plan, taken_frames
from faintfield.rig.session.verify import verify
from faintfield.rig.settings import DriftSettings, RigSettings, StepSettings
from faintfield.rig.simulation.controller.bench import Bench
from faintfield.rig.simulation.controller.grbl import SimulatedGrbl
from faintfield.rig.simulation.controller.grblhal import SimulatedGrblHal
from faintfield.rig.simulation.controller.marlin import SimulatedMarlin
from faintfield.rig.stages.protocol import Point
from tests.faults.capturing import FRAMES, SMALL_RIG, Unattended, capture_small, in_process
from tests.faults.stage_faults import Fault, faults_of
from tests.patience import HANG_S
from tests.rig.stages.benches import Controller

CONTROLLERS: dict[str, Controller] = {"grbl": SimulatedGrbl, "grblhal": SimulatedGrblHal, "marlin": SimulatedMarlin}
ORIGIN = {"grbl": Point(-350.0, -350.0), "grblhal": Point(-350.0, -350.0), "marlin": Point(50.0, 50.0)}
# Tolerance: half a step of 1/80 mm, and the rounding of reports
ON_TARGET_UM = 12


class TruthfulCamera:
    """A camera whose frames hold the true position of the stage in µm, and which fails on demand."""

    def __init__(self, bench: Bench) -> None:
        self.bench = bench
        self.exposures = 0
        self.on_exposure: dict[int, Callable[[], None]] = {}

    def open(self) -> None:
        pass

    def report(self) -> CameraReport:
        return CameraReport("truthful", 1000)

    def expose(self, exposure_s: float, number: int) -> Exposure:
        self.exposures += 1
        self.on_exposure.pop(self.exposures, lambda: None)()
        x_mm, y_mm = self.bench.true_position()
        self.bench.clock.sleep_s(exposure_s)
        micrometres = np.rint(1000.0 * np.array([[x_mm, y_mm]])).astype(np.int32)
        return Exposure(".tiff", content=micrometres.tobytes())

    def close(self) -> None:
        pass


class Lab:
    """A bench and the session captured on it; a new bench for each run, as after switching everything off and on."""

    def __init__(self, folder: Path, protocol: str, settings: RigSettings = SMALL_RIG) -> None:
        self.folder = folder
        self.protocol = protocol
        self.settings = msgspec.structs.replace(
            settings, grid=msgspec.structs.replace(settings.grid, origin_mm=ORIGIN[protocol])
        )

    def run(
        self,
        prepare: Callable[[Bench, TruthfulCamera], None] = lambda bench, camera: None,
        operator: OperatorInterface | None = None,
    ) -> RigError | None:
        """Capture; return how it failed, None when it did not."""
        frozen = read_plan(self.folder) if (self.folder / "plan.json").exists() else self.plan()
        try:
            with open_session(self.folder, frozen) as session:
                bench = Bench(CONTROLLERS[self.protocol])
                camera = TruthfulCamera(bench)
                rig = Rig(bench.stage(traffic=session.journal), camera, bench.clock, lambda kind, sweep: None)
                prepare(bench, camera)
                Capture(session, rig, operator or Unattended(), lambda path: None).run()
        except RigError as failure:
            return failure
        return None

    def plan(self) -> FrozenPlan:
        bench = Bench(CONTROLLERS[self.protocol])
        rig = Rig(bench.stage(), TruthfulCamera(bench), bench.clock, lambda kind, sweep: None)
        return FrozenPlan(survey(rig, self.settings).plan, self.settings)

    def assert_true_positions(self) -> None:
        """Assert that the session is whole and that every frame was taken where the plan says."""
        verdict = verify(self.folder)
        assert verdict.problems == ()
        assert (verdict.present, verdict.sealed) == (FRAMES, True)
        for frame, _, path in taken_frames(self.folder):
            there_um = np.frombuffer(path.read_bytes(), np.int32)
            np.testing.assert_allclose(there_um, 1000.0 * np.array(frame.stop.target), atol=ON_TARGET_UM)


@pytest.mark.parametrize(
    ("protocol", "fault"),
    [(name, fault) for name, kind in CONTROLLERS.items() for fault in faults_of(kind) if fault.nature != "mechanics"],
    ids=str,
)
def test_stage_faults_in_mid_capture(tmp_path: Path, protocol: str, fault: Fault) -> None:
    lab = Lab(tmp_path / "session", protocol)

    def prepare(bench: Bench, camera: TruthfulCamera) -> None:
        camera.on_exposure = {3: lambda: fault.strike(bench), 9: lambda: fault.strike(bench)}

    failure = lab.run(prepare)
    if failure is not None:
        assert "; " in str(failure)
        assert not is_sealed(lab.folder)
        assert lab.run() is None
    lab.assert_true_positions()


@pytest.mark.parametrize("feed_mm_per_min", [300, 6000], ids=["it still moves afterwards", "it stands elsewhere"])
def test_a_stage_that_somebody_jogs_during_an_exposure_has_the_frame_taken_again(
    tmp_path: Path, feed_mm_per_min: int
) -> None:
    lab = Lab(tmp_path / "session", "grbl")

    def prepare(bench: Bench, camera: TruthfulCamera) -> None:
        camera.on_exposure = {3: lambda: bench.firmware.receive(b"$J=G91 G21 X-0.5 F%d\n" % feed_mm_per_min)}

    assert lab.run(prepare) is None
    lab.assert_true_positions()
    with Journal(lab.folder / "journal.sqlite", read_only=True) as journal:
        assert [frame for _, frame in journal.uncommitted()] == [2]
        assert len(journal.events("stage_failed")) == 1


DRIFTING = msgspec.structs.replace(SMALL_RIG, drift=DriftSettings())


@pytest.mark.parametrize("protocol", CONTROLLERS)
@pytest.mark.parametrize("drift", [DriftSettings(check=False), DriftSettings(every_nodes=2)])
@pytest.mark.parametrize(("moment_s", "gone_s"), [(0.0, 3.0), (0.4, 3.0), (4.0, 3.0), (0.4, 30.0)])
def test_a_port_that_disappears_for_a_while_ends_no_capture(
    tmp_path: Path, protocol: str, drift: DriftSettings, moment_s: float, gone_s: float
) -> None:
    lab = Lab(tmp_path / "session", protocol, msgspec.structs.replace(SMALL_RIG, drift=drift))

    def vanish(bench: Bench) -> None:
        bench.unplug()
        bench.clock.after(gone_s, bench.plug)

    def prepare(bench: Bench, camera: TruthfulCamera) -> None:
        camera.on_exposure = {3: lambda: fault_later(bench, moment_s, vanish)}

    assert lab.run(prepare) is None
    lab.assert_true_positions()


def test_the_cause_of_a_failed_recovery_is_told(tmp_path: Path) -> None:
    lab = Lab(tmp_path / "session", "grbl")
    told: list[str] = []

    class Watching(Unattended):
        def show_status(self, status: Status) -> None:
            told.extend(status.warnings)

    def prepare(bench: Bench, camera: TruthfulCamera) -> None:
        def vanish() -> None:
            bench.unplug()
            bench.clock.after(90.0, bench.plug)

        camera.on_exposure = {3: vanish}

    assert lab.run(prepare, Watching()) is None
    lab.assert_true_positions()
    with Journal(lab.folder / "journal.sqlite", read_only=True) as journal:
        (failed,) = journal.events("recovery_failed")
    assert failed.frame == 2
    assert failed.detail["device"] == "stage"
    assert failed.detail["error"] == "StageLost"
    assert "unplugged" in str(failed.detail["message"])
    assert any("the stage was not recovered: " in warning and "unplugged" in warning for warning in told)


def test_a_port_that_stays_away_is_given_up(tmp_path: Path) -> None:
    lab = Lab(tmp_path / "session", "grbl")
    ended_s: list[float] = []

    def prepare(bench: Bench, camera: TruthfulCamera) -> None:
        camera.on_exposure = {3: bench.unplug}
        camera.close = lambda: ended_s.append(bench.clock.now_s())  # type: ignore[method-assign]

    assert isinstance(lab.run(prepare), StageLost)
    assert 120.0 < ended_s[-1] < 240.0
    assert lab.run() is None
    lab.assert_true_positions()


def busy_at_homing(bench: Bench, numbers: Container[int]) -> None:
    """Let the computer be busy while some homings end."""
    homings: list[bool] = []

    def count(data: bytes) -> bytes:
        if b"$H" in data or b"G28" in data:
            homings.append(True)
            if len(homings) in numbers:
                bench.clock.after(0.3, lambda: setattr(bench, "host_busy_until_s", bench.clock.now_s() + 2.0))
        return data

    bench.wire.filters_to_controller.append(count)


@pytest.mark.parametrize("protocol", CONTROLLERS)
def test_a_busy_computer_ends_no_capture(tmp_path: Path, protocol: str) -> None:
    lab = Lab(tmp_path / "session", protocol, DRIFTING)

    def prepare(bench: Bench, camera: TruthfulCamera) -> None:
        camera.on_exposure = {2: lambda: busy_at_homing(bench, (1, 3))}

    assert lab.run(prepare) is None
    lab.assert_true_positions()
    with Journal(lab.folder / "journal.sqlite", read_only=True) as journal:
        assert len(journal.events("suspect")) == 2
        assert all("answers were delayed" in str(event.detail["message"]) for event in journal.events("suspect"))


@pytest.mark.parametrize("protocol", CONTROLLERS)
def test_a_capture_may_begin_on_a_busy_computer(tmp_path: Path, protocol: str) -> None:
    lab = Lab(tmp_path / "session", protocol, DRIFTING)
    assert lab.run(lambda bench, camera: busy_at_homing(bench, (2, 6, 7))) is None
    lab.assert_true_positions()


@pytest.mark.parametrize("protocol", CONTROLLERS)
def test_a_computer_that_is_always_busy_ends_a_capture_that_can_be_resumed(tmp_path: Path, protocol: str) -> None:
    lab = Lab(tmp_path / "session", protocol, DRIFTING)

    def prepare(bench: Bench, camera: TruthfulCamera) -> None:
        camera.on_exposure = {2: lambda: busy_at_homing(bench, range(1, 1000))}

    assert isinstance(lab.run(prepare), CaptureStopped)
    assert lab.run() is None
    # What was taken before the last check is kept, and stays marked
    assert verify(lab.folder).problems == ()
    assert len(verify(lab.folder).suspect) == 6


def test_frames_before_and_after_a_homing_are_told_apart(tmp_path: Path) -> None:
    lab = Lab(tmp_path / "session", "grbl")

    def alarm(bench: Bench) -> None:
        assert isinstance(bench.firmware, SimulatedGrbl)
        bench.firmware.alarm(3)

    assert lab.run(lambda bench, camera: camera.on_exposure.update({5: lambda: alarm(bench)})) is None
    groups = read_homing_groups(lab.folder)
    # The fifth exposure failed; the stage was homed before the sixth
    assert groups.groups == {intent: 1 if intent < 5 else 2 for intent in range(1, FRAMES + 2) if intent != 5}
    assert groups.spread_mm is None
    by_frame = [groups.groups[committed.intent] for _, committed, _ in taken_frames(lab.folder)]
    assert by_frame == [1] * 4 + [2] * (FRAMES - 4)


def test_a_resumed_session_goes_on_with_another_homing_group(tmp_path: Path) -> None:
    lab = Lab(tmp_path / "session", "grbl")

    def fail() -> None:
        raise CameraError("the camera failed at an exposure: I/O problem; check its cable")

    assert lab.run(lambda bench, camera: camera.on_exposure.update(dict.fromkeys((4, 5, 6), fail))) is not None
    assert lab.run() is None
    assert set(read_homing_groups(lab.folder).groups.values()) == {1, 2}


def test_the_spread_of_the_switches_is_that_of_the_checks(tmp_path: Path) -> None:
    lab = Lab(tmp_path / "session", "marlin", DRIFTING)

    def prepare(bench: Bench, camera: TruthfulCamera) -> None:
        def shift() -> None:
            bench.firmware.mechanics.axes[0].slip_mm -= 0.2

        camera.on_exposure = {2: shift}

    assert lab.run(prepare) is None
    with Journal(lab.folder / "journal.sqlite", read_only=True) as journal:
        away_mm = np.array([check.away_mm for check in journal.details("drift_check", DriftCheck)])
        groups = homing_groups(journal)
    assert away_mm.shape == (2, 2)
    assert groups.spread_mm is not None
    assert groups.spread_mm == pytest.approx(np.std(away_mm, axis=0, ddof=1))
    assert groups.spread_mm[0] == pytest.approx(0.2 / 2**0.5, rel=0.01)
    # Each check homes, so that each step of the plan is a group of its own
    assert [groups.groups[it.intent] for _, it, _ in taken_frames(lab.folder)] == [1] * 6 + [2] * 6 + [3] * 4


def test_frames_that_no_check_confirms_are_marked(tmp_path: Path) -> None:
    lab = Lab(tmp_path / "session", "grbl", DRIFTING)

    def slip_and_stop(bench: Bench) -> None:
        bench.firmware.mechanics.axes[0].slip_mm -= 3.0
        fault_later(bench, 5.0, lambda bench: bench.firmware.restart())

    assert lab.run(lambda bench, camera: camera.on_exposure.update({8: lambda: slip_and_stop(bench)})) is None
    verdict = verify(lab.folder)
    # The check after the first step confirms its frames; the next homing was not preceded by a check
    kept = [(committed.file, path) for _, committed, path in taken_frames(lab.folder)[6:12]]
    there_um = {file: np.frombuffer(path.read_bytes(), np.int32) for file, path in kept}
    nodes_um = {it.file: 1000.0 * np.array(frame.stop.target) for frame, it, _ in taken_frames(lab.folder)}
    wrong = {file for file, at_um in there_um.items() if np.abs(at_um - nodes_um[file]).max() > ON_TARGET_UM}
    assert wrong
    assert wrong <= set(verdict.suspect) < set(there_um)


def test_frames_whose_last_check_was_cut_off_are_marked_when_nothing_is_left_to_take(tmp_path: Path) -> None:
    one_step = msgspec.structs.replace(DRIFTING, step=(StepSettings("dark_scene", 0.1),))
    lab = Lab(tmp_path / "session", "grbl", one_step)
    cut_off = mock.patch.object(DriftChecks, "check_after", side_effect=[*(None,) * 6, KeyboardInterrupt])
    with cut_off, pytest.raises(KeyboardInterrupt):
        lab.run()
    assert not is_sealed(lab.folder)
    assert lab.run() is None
    verdict = verify(lab.folder)
    assert (verdict.problems, verdict.sealed, verdict.present) == ((), True, 6)
    assert len(verdict.suspect) == 6


def test_a_check_waits_for_the_last_frame_of_a_node(tmp_path: Path) -> None:
    """It homes, so that the frames of a node would be of two groups."""
    every_two = msgspec.structs.replace(
        DRIFTING, step=(StepSettings("dark_scene", 0.1, 3),), drift=DriftSettings(every_nodes=2)
    )
    lab = Lab(tmp_path / "session", "grbl", every_two)
    assert lab.run() is None
    groups = read_homing_groups(lab.folder).groups
    assert [groups[it.intent] for _, it, _ in taken_frames(lab.folder)] == [1] * 6 + [2] * 6 + [3] * 6
    assert verify(lab.folder).suspect == ()


def test_a_session_that_records_no_homing_has_no_groups(tmp_path: Path) -> None:
    lab = Lab(tmp_path / "session", "grbl")
    with mock.patch("faintfield.rig.capture.loop.begin_group"):
        assert lab.run() is None
    assert set(read_homing_groups(lab.folder).groups.values()) == {None}


def fault_later(bench: Bench, delay_s: float, strike: Callable[[Bench], None]) -> None:
    """Let a fault strike some time from now."""
    bench.clock.after(delay_s, lambda: strike(bench))


def make_slip(bench: Bench, camera: TruthfulCamera) -> None:
    """Let an axis lose steps in the second step of the plan."""

    def slip() -> None:
        bench.firmware.mechanics.axes[0].slip_mm -= 3.0

    camera.on_exposure = {9: slip}


def test_lost_steps_are_found_and_their_frames_taken_again(tmp_path: Path) -> None:
    lab = Lab(tmp_path / "session", "grbl", msgspec.structs.replace(SMALL_RIG, drift=DriftSettings()))
    assert lab.run(make_slip) is None
    lab.assert_true_positions()
    with Journal(lab.folder / "journal.sqlite", read_only=True) as journal:
        suspects = journal.events("suspect")
        assert len(suspects) == 1
        assert "lost its scale" in str(suspects[0].detail["message"])
        # Everything since the last good check, which was at the end of the first step
        assert [it.frame for it in journal.committed() if it.void is not None] == list(range(6, 12))
    assert verify(lab.folder).superseded == 6


def test_a_stage_that_loses_steps_again_and_again_is_given_up(tmp_path: Path) -> None:
    lab = Lab(tmp_path / "session", "grbl", msgspec.structs.replace(SMALL_RIG, drift=DriftSettings()))

    def prepare(bench: Bench, camera: TruthfulCamera) -> None:
        def slip() -> None:
            bench.firmware.mechanics.axes[0].slip_mm -= 3.0

        camera.on_exposure = dict.fromkeys(range(2, 100, 6), slip)

    assert isinstance(lab.run(prepare), CaptureStopped)
    with Journal(lab.folder / "journal.sqlite", read_only=True) as journal:
        assert len(journal.events("suspect")) == 3
    assert lab.run() is None
    # The frames in doubt when the capture was given up are present and stay marked
    assert verify(lab.folder).problems == ()


class Keeping(Unattended):
    """A person who wants to keep suspect frames."""

    def ask(self, prompt: Prompt) -> Answer:
        return "keep" if prompt.key == "drift" else prompt.unattended


def test_frames_kept_in_spite_of_lost_steps_stay_marked(tmp_path: Path) -> None:
    lab = Lab(tmp_path / "session", "grbl", msgspec.structs.replace(SMALL_RIG, drift=DriftSettings()))
    assert lab.run(make_slip, Keeping()) is None
    verdict = verify(lab.folder)
    assert verdict.problems == ()
    assert verdict.suspect == tuple(committed.file for _, committed, _ in taken_frames(lab.folder)[6:12])


@pytest.mark.parametrize("failures", [1, 2, 3])
def test_a_camera_that_fails(tmp_path: Path, failures: int) -> None:
    lab = Lab(tmp_path / "session", "grbl")

    def fail() -> None:
        raise CameraError("the camera failed at an exposure: I/O problem; check its cable")

    failure = lab.run(lambda bench, camera: camera.on_exposure.update(dict.fromkeys(range(4, 4 + failures), fail)))
    if failures < 3:
        assert failure is None
    else:
        assert isinstance(failure, CameraError)
        assert lab.run() is None
    lab.assert_true_positions()
    with Journal(lab.folder / "journal.sqlite", read_only=True) as journal:
        assert len(journal.events("camera_failed")) == failures
        assert len(journal.uncommitted()) == failures


def limited_capture(folder: Path, room_bytes: int) -> None:
    """Capture while no file may grow beyond a size, as on a disk without room; SQLite's files are smaller."""
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (room_bytes, resource.getrlimit(resource.RLIMIT_FSIZE)[1]))
    with pytest.raises(SessionUnwritable, match=r"; "):
        capture_small(folder)


@pytest.mark.parametrize("room_bytes", [100, 600, 40_000, 80_000, 120_000])
def test_a_full_disk(tmp_path: Path, room_bytes: int) -> None:
    folder = tmp_path / "session"
    process = in_process(limited_capture, folder, room_bytes)
    process.join(HANG_S)
    assert process.exitcode == 0
    assert not list(folder.glob("frames/*.part"))
    capture_small(folder)
    verdict = verify(folder)
    assert verdict.problems == ()
    assert (verdict.present, verdict.sealed) == (FRAMES, True)


def drop_rights() -> None:
    """Give up all privileges, so that permissions hold for the superuser too (capset, Linux)."""
    header = (ctypes.c_uint32 * 2)(0x20080522, 0)
    if ctypes.CDLL(None, use_errno=True).capset(header, (ctypes.c_uint32 * 6)()) != 0:
        raise OSError(ctypes.get_errno(), "capset")


def capture_read_only(folder: Path, place: str) -> None:
    """Capture; a folder becomes read-only after some frames."""
    drop_rights()
    taken = iter(range(FRAMES))

    class Interfering(Unattended):
        def show_status(self, status: object) -> None:
            if next(taken) == 6:
                (folder / place).chmod(0o500)

    from faintfield.rig.devices import open_rig

    plan = FrozenPlan(survey(open_rig(SMALL_RIG), SMALL_RIG).plan, SMALL_RIG)
    with open_session(folder, plan) as session, pytest.raises(SessionUnwritable, match=r"make the folder writable"):
        Capture(session, open_rig(SMALL_RIG, session.journal), Interfering(), lambda path: None).run()


def test_a_folder_made_read_only(tmp_path: Path) -> None:
    folder = tmp_path / "session"
    process = in_process(capture_read_only, folder, "frames")
    process.join(HANG_S)
    assert process.exitcode == 0
    (folder / "frames").chmod(0o700)
    assert 0 < len(list((folder / "frames").iterdir())) < FRAMES
    capture_small(folder)
    assert verify(folder).problems == ()


def test_frames_are_kept_as_the_camera_made_them() -> None:
    assert encode_exposure(Exposure(".nef", content=b"raw")) == b"raw"
