"""The watched folder: which file is the frame that was asked for, and when it is complete."""

import math
import os
import shutil
import time
from collections.abc import Callable
from io import BytesIO
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory
from unittest import mock

import numpy as np
import pytest
import tifffile
from hypothesis import example, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from faintfield.pipelines.live.guided import read_pixels
from faintfield.rig.cameras.folder import FolderCamera
from faintfield.rig.cameras.protocol import Decode, Exposure
from faintfield.rig.cameras.settings import FolderSettings
from faintfield.rig.errors import CameraError, CameraTimeout
from faintfield.rig.simulation.controller.kinematics import SimulatedClock
from faintfield.testing import camera_contract


class Program(SimulatedClock):
    """A camera's program, and the clock by which it writes: files change at given times after a request."""

    def __init__(self, folder: Path) -> None:
        super().__init__()
        self.folder = folder
        self.asked_s = 0.0
        self.due: list[tuple[float, Callable[[], object]]] = []

    def sleep_s(self, duration_s: float) -> None:
        super().sleep_s(duration_s)
        after_s = self.now_s() - self.asked_s
        due = [action for at_s, action in self.due if at_s <= after_s]
        self.due = [(at_s, action) for at_s, action in self.due if at_s > after_s]
        for action in due:
            action()

    def ask(self, camera: FolderCamera) -> "Program":
        """Note that a frame is asked for after a silence; what comes is timed from here."""
        self.due = []
        camera.await_silence(0.0)
        self.asked_s = self.now_s()
        return self

    def at(self, after_s: float, name: str, content: bytes, changed_s: float | None = None) -> None:
        """Let a file have `content` from `after_s` on, changed then, or at `changed_s` after the request."""

        def write() -> None:
            (self.folder / name).write_bytes(content)
            changed = time.time() + (after_s if changed_s is None else changed_s)
            os.utime(self.folder / name, (changed, changed))

        self.due.append((after_s, write))


@pytest.fixture
def program(tmp_path: Path) -> Program:
    return Program(tmp_path)


def watching(program: Program, decode: Decode = lambda path: None, *, file_times: bool = True) -> FolderCamera:
    settings = FolderSettings(str(program.folder), frame_mb=1.0, arrival_s=20.0, quiet_s=5.0, file_times=file_times)
    camera = FolderCamera(settings, program, decode)
    camera.open()
    program.ask(camera)
    return camera


def tiff(pixels: NDArray[np.uint16]) -> bytes:
    """Return the file of a frame without compression, whose pixels come last."""
    buffer = BytesIO()
    tifffile.imwrite(buffer, pixels)
    return buffer.getvalue()


def ramp(rows: int) -> bytes:
    return tiff(np.arange(1, 1 + 16 * rows, dtype=np.uint16).reshape(rows, 16) * 300)


class TriggeredFolder(FolderCamera):
    """A folder whose program saves a file at each exposure."""

    program: Program
    files = 0

    def expose(self, exposure_s: float, number: int) -> Exposure:
        self.files += 1
        self.program.ask(self)
        self.program.at(exposure_s + 1.0, f"IMG_{self.files}.NEF", b"RAW ")
        self.program.at(exposure_s + 2.0, f"IMG_{self.files}.NEF", b"RAW FILE")
        return super().expose(exposure_s, number)


def test_contract(program: Program) -> None:
    camera = TriggeredFolder(FolderSettings(str(program.folder), frame_mb=1.0), program)
    camera.program = program
    camera_contract(camera, 0.1)


def test_file_before_the_exposure_ends_is_refused(program: Program) -> None:
    camera = watching(program)
    program.at(0.3, "early.nef", b"begun before")
    with pytest.raises(CameraError, match=r"early\.nef: came 0\.50 s after .* 2 s, .*; .* take this frame again"):
        camera.expose(2.0, 1)
    program.ask(camera).at(2.5, "right.nef", b"as asked for")
    assert camera.expose(2.0, 2).content == b"as asked for"  # the early file is not taken for it


def test_file_changed_before_the_exposure_ends_is_refused(program: Program) -> None:
    camera = watching(program)
    program.at(6.0, "moved.nef", b"of an hour ago", changed_s=-3600.0)
    with pytest.raises(CameraError, match=r"moved\.nef: was last changed at .* UTC, 3605\.\d s before .* 5 s .*file_t"):
        camera.expose(5.0, 1)
    program.ask(camera)
    program.at(6.0, "coarse.nef", b"on FAT", changed_s=3.5)  # rounded down to 2 s
    assert camera.expose(5.0, 2).content == b"on FAT"
    camera = watching(program, file_times=False)
    program.at(6.0, "camera's time.nef", b"kept", changed_s=-3600.0)
    assert camera.expose(5.0, 3).content == b"kept"


def test_file_times_are_compared_with_the_folder_clock(program: Program) -> None:
    camera = watching(program)
    program.at(6.0, "right.nef", b"of a server whose clock is an hour behind", changed_s=6.0 - 3600.0)
    with mock.patch.object(FolderCamera, "_folder_time_s", return_value=time.time() - 3600.0):
        assert camera.expose(5.0, 1).metadata["camera_file"] == "right.nef"
    assert [path.name for path in program.folder.iterdir()] == ["right.nef"]


def test_probe_for_the_folder_clock_is_removed(program: Program) -> None:
    camera = watching(program)
    assert camera._folder_time_s() is not None  # noqa: SLF001
    assert list(program.folder.iterdir()) == []
    with mock.patch.object(Path, "write_bytes", side_effect=PermissionError):
        assert camera._folder_time_s() is None  # noqa: SLF001


WHOLE, BLACK = ramp(rows=200), tiff(np.zeros((100, 100), np.uint16))
ZEROS_AT_END = WHOLE[: len(WHOLE) // 2] + bytes(len(WHOLE) - len(WHOLE) // 2)


@pytest.mark.parametrize(
    ("writes", "taken_s"),
    [
        ([(1.0, WHOLE)], 1.75),
        ([(1.0, WHOLE[: len(WHOLE) // 2]), (9.0, WHOLE)], 9.75),  # after 8 s of quiet
        ([(1.0, ZEROS_AT_END), (5.0, WHOLE)], 5.75),  # the picture had its size, and so decoded, before its pixels
        ([(1.0, BLACK)], 6.5),  # a picture that ends in black has to be quiet
    ],
    ids=["whole", "half", "zeros at the end", "black"],
)
def test_picture_is_taken_once_it_is_whole(program: Program, writes: list[tuple[float, bytes]], taken_s: float) -> None:
    assert tifffile.imread(BytesIO(ZEROS_AT_END)) is not None
    camera = watching(program, read_pixels)
    for after_s, content in writes:
        program.at(after_s, "picture.tif", content)
    assert camera.expose(0.5, 1).content == writes[-1][1]
    assert taken_s - 0.75 <= program.now_s() - program.asked_s <= taken_s


def test_picture_that_stays_damaged_is_no_frame(program: Program) -> None:
    camera = watching(program, read_pixels)
    program.at(1.0, "picture.tif", ramp(12)[:-100])
    with pytest.raises(CameraTimeout, match=r"picture\.tif is not complete \(.*cannot be decoded.* within 20\.5 s; "):
        camera.expose(0.5, 1)


@pytest.mark.parametrize(
    ("writes", "last"),
    [
        ([(1.0, b"one"), (5.5, b"one two"), (9.0, b"one two three"), (15.0, b"too late")], b"one two three"),
        ([(second, b"%d of 9" % second) for second in range(1, 10)], b"9 of 9"),  # its size stays the same
    ],
)
def test_undecodable_file_is_taken_after_long_quiet(
    program: Program, writes: list[tuple[float, bytes]], last: bytes
) -> None:
    camera = watching(program)
    for after_s, content in writes:
        program.at(after_s, "IMG.NEF", content)
    exposure = camera.expose(0.1, 1)
    assert (exposure.content, exposure.suffix) == (last, ".nef")
    assert exposure.metadata["camera_file"] == "IMG.NEF"


def test_earlier_and_late_files_are_no_frames(program: Program) -> None:
    (program.folder / "old.nef").write_bytes(b"old")
    camera = watching(program)
    with pytest.raises(CameraTimeout, match=r"no file came within 20\.1 s; "):
        camera.expose(0.1, 1)
    (program.folder / "late.nef").write_bytes(b"of the frame before")
    program.ask(camera).at(0.5, "new.nef", b"new")
    program.at(0.5, "notes.txt", b"no frame")
    assert camera.expose(0.1, 2).content == b"new"


@pytest.mark.parametrize("reopened", [False, True])
def test_first_file_after_timeout_may_be_late(program: Program, reopened: bool) -> None:
    camera = watching(program)
    with pytest.raises(CameraTimeout):
        camera.expose(0.1, 1)
    if reopened:  # as a capture does after a failure
        camera.close()
        camera.open()
    program.ask(camera).at(2.0, "late.nef", b"of the frame before")
    with pytest.raises(CameraError, match=r"late\.nef: may be the frame before, .*; take this frame again"):
        camera.expose(0.1, 2)
    program.ask(camera).at(2.0, "right.nef", b"as asked for")
    assert camera.expose(0.1, 3).content == b"as asked for"


def test_late_file_while_closed_is_not_awaited(program: Program) -> None:
    camera = watching(program)
    with pytest.raises(CameraTimeout):
        camera.expose(0.1, 1)
    camera.close()
    (program.folder / "late.nef").write_bytes(b"of the frame before")
    camera.open()
    program.ask(camera).at(2.0, "right.nef", b"as asked for")
    assert camera.expose(0.1, 2).content == b"as asked for"


def test_endless_file_and_two_files_are_refused(program: Program) -> None:
    camera = watching(program)
    for second in range(1, 30):
        program.at(second, "endless.nef", b"more " * second)
    with pytest.raises(CameraTimeout, match=r"endless\.nef never stopped growing"):
        camera.expose(0.1, 1)
    program.ask(camera).at(1.0, "a.nef", b"a")
    program.at(1.0, "b.nef", b"b")
    with pytest.raises(CameraError, match=r"2 files came for one frame \(a.nef, b.nef\); "):
        camera.expose(0.1, 2)


def test_file_renamed_when_whole_is_taken(program: Program) -> None:
    camera = watching(program)
    program.at(1.0, "part.nef", b"whole")
    program.due.append((2.0, lambda: (program.folder / "part.nef").rename(program.folder / "IMG.NEF")))
    assert camera.expose(0.1, 1).metadata["camera_file"] == "IMG.NEF"


def test_vanished_folder_is_named_until_it_returns(tmp_path: Path) -> None:
    folder = tmp_path / "incoming"
    folder.mkdir()
    program = Program(folder)
    camera = watching(program)
    program.due.append((3.0, lambda: shutil.rmtree(folder)))
    with pytest.raises(CameraError, match=r"incoming: the folder is gone; mount it again"):
        camera.expose(0.1, 1)
    assert program.now_s() - program.asked_s < 4.0
    # A capture closes and opens the camera after a failure, and then goes on whether it could
    camera.close()
    with pytest.raises(CameraError, match=r"incoming: is not a folder"):
        camera.open()
    with pytest.raises(CameraError, match=r"incoming: the folder is gone; mount it again"):
        camera.expose(0.1, 2)
    folder.mkdir()
    camera.open()
    program.ask(camera).at(1.0, "new.nef", b"new")
    assert camera.expose(0.1, 3).content == b"new"


def test_folder_of_another_device_is_not_awaited(program: Program) -> None:
    camera = watching(program)
    camera._device += 1  # noqa: SLF001 - a mount needs privileges
    with pytest.raises(CameraError, match=r"the folder is gone; mount it again"):
        camera.expose(0.1, 1)


def test_unreadable_file_is_named(program: Program) -> None:
    camera = watching(program)
    program.at(1.0, "new.nef", b"new")
    with (
        mock.patch.object(Path, "read_bytes", side_effect=OSError(5, "Input/output error")),
        pytest.raises(CameraError, match=r"cannot be read \(Input/output error\); check the disk"),
    ):
        camera.expose(0.1, 1)


@pytest.fixture
def dng() -> bytes:
    """Return a raw file of a real camera."""
    if "FAINTFIELD_DATA" not in os.environ:
        pytest.skip("FAINTFIELD_DATA does not name the folder of real data")
    return (Path(os.environ["FAINTFIELD_DATA"]) / "raw" / "colorchart.dng").read_bytes()


@pytest.mark.parametrize("share", [0.001, 0.9999])
def test_truncated_raw_file_is_damaged(tmp_path: Path, dng: bytes, share: float) -> None:
    path = tmp_path / "cut.dng"
    path.write_bytes(dng[: int(share * len(dng))])
    with pytest.raises(CameraError, match=r"cannot be decoded"):
        read_pixels(path)


def test_raw_file_with_zeros_at_end_is_awaited(program: Program, dng: bytes) -> None:
    camera = watching(program, read_pixels)
    half = len(dng) // 2
    program.at(1.0, "raw.dng", dng[:half] + bytes(len(dng) - half))  # LibRaw decodes it
    program.at(5.0, "raw.dng", dng)
    assert camera.expose(0.5, 1).content == dng


class FreeProgram(SimulatedClock):
    """A program that takes frames by itself, each file named and filled with the time at which its frame began.

    Its files come `delay_s` after the exposures, which begin every `period_s` from `first_s` on.
    """

    def __init__(self, folder: Path, exposure_s: float, period_s: float, delay_s: float, first_s: float) -> None:
        super().__init__()
        self._folder, self._period_s, self._latency_s = folder, period_s, exposure_s + delay_s
        self.next_s = first_s

    def sleep_s(self, duration_s: float) -> None:
        super().sleep_s(duration_s)
        while self.next_s + self._latency_s <= self.now_s():
            (self._folder / f"{self.next_s:012.3f}.nef").write_bytes(f"{self.next_s:.3f}".encode())
            self.next_s += self._period_s


def frames_begun(
    camera: FolderCamera, program: FreeProgram, exposure_s: float, moves_s: list[float]
) -> list[tuple[float, float]]:
    """Return when each frame that the camera took began, in s after its request, and after the stage came to rest."""
    begun_s = []
    for move_s in moves_s:
        program.sleep_s(move_s)
        for _ in range(3):  # a refused frame is asked for again
            rested_s = program.now_s()
            try:
                camera.await_silence(exposure_s)
                asked_s = program.now_s()
                if program.next_s == math.inf:  # it is started when the first frame is asked for
                    program.next_s = asked_s + 0.3
                content = camera.expose(exposure_s, 1).content
            except CameraError:
                camera.close()
                camera.open()
            else:
                assert content is not None
                begun_s.append((float(content) - asked_s, float(content) - rested_s))
                break
    return begun_s


@settings(max_examples=12)
@given(
    exposure_s=st.floats(0.05, 10.0),
    pause_s=st.floats(0.01, 9.5) | st.floats(0.01, 59.5),
    delay_s=st.floats(0.0, 30.0),
    first_s=st.floats(-60.0, 0.0) | st.just(math.inf),
    moves_s=st.lists(st.floats(0.1, 60.0), min_size=4, max_size=4),
    stated=st.booleans(),
)
@example(exposure_s=1.0, pause_s=1.6, delay_s=1.5, first_s=-0.7, moves_s=[0.5] * 9, stated=False)
@example(exposure_s=1.0, pause_s=1.6, delay_s=1.5, first_s=math.inf, moves_s=[0.5] * 9, stated=False)
@example(exposure_s=1.0, pause_s=1.6, delay_s=1.5, first_s=-0.7, moves_s=[0.5] * 9, stated=True)
@example(exposure_s=1.0, pause_s=20.8, delay_s=5.0, first_s=math.inf, moves_s=[20.0] * 9, stated=False)
def test_no_frame_of_free_program_begins_before_request(
    exposure_s: float, pause_s: float, delay_s: float, first_s: float, moves_s: list[float], stated: bool
) -> None:
    with TemporaryDirectory() as folder:
        program = FreeProgram(Path(folder), exposure_s, exposure_s + pause_s, delay_s, first_s)
        settings = FolderSettings(folder, quiet_s=0.5, file_times=False, delay_s=delay_s if stated else None)
        camera = FolderCamera(settings, program)
        camera.open()
        begun_s = frames_begun(camera, program, exposure_s, moves_s)
    assert all(after_rest_s > -0.001 for _, after_rest_s in begun_s)  # names have milliseconds
    if stated:
        assert len(begun_s) == len(moves_s)
    if stated or pause_s < 9.5:  # the silence of `silence_s`, 10 s, is longer
        assert all(after_request_s > -0.001 for after_request_s, _ in begun_s)
    if not stated and pause_s < 9.5:  # it is found out; the frame for which it was started may be taken
        assert len(begun_s) <= (first_s == math.inf)


def test_triggered_program_is_waited_for_once_measured(program: Program) -> None:
    camera = TriggeredFolder(FolderSettings(str(program.folder), frame_mb=1.0, silence_s=3.0), program)
    camera.program = program
    camera.open()
    ended_s = []
    for number in range(3):
        camera.expose(1.0, number)
        ended_s.append(program.now_s())
    assert 61.0 < ended_s[0] < 71.0  # at first the delay may be as long as `arrival_s`
    for before_s, after_s in pairwise(ended_s):
        assert after_s - before_s < 2 * 9.0 + 1.0  # the silence is as long as the file took to be complete


def test_late_file_of_triggered_program_is_no_free_one(program: Program) -> None:
    camera = watching(program)
    with pytest.raises(CameraTimeout):
        camera.expose(0.1, 1)
    program.at(23.0, "late.nef", b"of the frame before")
    camera.await_silence(0.1)
    program.ask(camera).at(2.0, "right.nef", b"as asked for")
    assert camera.expose(0.1, 2).content == b"as asked for"
