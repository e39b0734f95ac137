"""Frames that are damaged, or of another size or depth than the session's, are refused before they count."""

import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path
from unittest import mock

import numpy as np
import pytest
import tifffile
from msgspec.structs import replace

from faintfield.pipelines.live.guided import read_pixels
from faintfield.rig import devices
from faintfield.rig.cameras.protocol import Exposure, Pixels
from faintfield.rig.errors import CameraError, CaptureStopped
from faintfield.rig.session.journal import Journal
from faintfield.rig.session.session import taken_frames
from faintfield.rig.session.verify import verify
from faintfield.rig.settings import SettleSettings
from faintfield.rig.simulation.lab import SimulatedCamera
from tests.faults.capturing import FRAMES, SMALL_RIG, Operator, assert_complete, capture, events

type Change = Callable[[Exposure], Exposure]


@contextmanager
def changed(changes: dict[int, Change]) -> Iterator[None]:
    """Let the simulated camera give other exposures, by their number in the session."""
    expose = SimulatedCamera.expose

    def expose_changed(camera: SimulatedCamera, exposure_s: float, number: int) -> Exposure:
        exposure = expose(camera, exposure_s, number)
        return changes[number](exposure) if number in changes else exposure

    with mock.patch.object(SimulatedCamera, "expose", expose_changed):
        yield


def pixels_of(exposure: Exposure) -> Pixels:
    assert exposure.pixels is not None
    return exposure.pixels


def cropped(exposure: Exposure) -> Exposure:
    return Exposure(exposure.suffix, pixels=pixels_of(exposure)[:-1])


def coloured(exposure: Exposure) -> Exposure:
    return Exposure(exposure.suffix, pixels=np.dstack([pixels_of(exposure)] * 3))


def shallow(exposure: Exposure) -> Exposure:
    return Exposure(exposure.suffix, pixels=(pixels_of(exposure) >> 8).astype(np.uint8))


def truncated(exposure: Exposure) -> Exposure:
    buffer = BytesIO()
    tifffile.imwrite(buffer, exposure.pixels)
    return Exposure(exposure.suffix, content=buffer.getvalue()[:-100])


def unknown(exposure: Exposure) -> Exposure:
    return Exposure(".nef", content=b"no raw file at all" * 1000)


@pytest.mark.parametrize(
    ("change", "words", "resumed"),
    [
        (cropped, r"has 16 x 11 pixels of uint16, but 00000_bright_0_r0_c0_x1\.tiff has 16 x 12 .* uint16; ", True),
        (coloured, r"has 16 x 12 pixels x 3 colours of uint16, but .* has 16 x 12 pixels of uint16; ", False),
        (shallow, r"has 16 x 12 pixels of uint8, but .* has 16 x 12 pixels of uint16; ", False),
        (truncated, r"_x9\.tiff: cannot be decoded \(.*; take", True),
        (unknown, r"_x9\.nef: cannot be decoded, but .* has 16 x 12 pixels", False),
    ],
)
def test_frame_unlike_the_others_is_taken_again(tmp_path: Path, change: Change, words: str, resumed: bool) -> None:
    folder = tmp_path / "session"
    if resumed:
        assert isinstance(capture(folder, Operator({}, {8: "stop"}), decode=read_pixels), CaptureStopped)
    with changed({9: change}):
        assert capture(folder, decode=read_pixels) is None
    assert_complete(folder)
    for _, _, path in taken_frames(folder):
        pixels = read_pixels(path)
        assert pixels is not None
        assert pixels.shape == (12, 16)
        assert pixels.dtype == np.uint16
    with Journal(folder / "journal.sqlite", read_only=True) as journal:
        (failure,) = journal.details("camera_failed", dict[str, str])
        assert journal.uncommitted() == [(9, 8)]
    assert re.search(words, failure["message"])
    (aside,) = (folder / "set_aside").iterdir()
    assert aside.name.startswith("00008_dark_scene_0_")
    assert not list((folder / "frames").glob("*_x9.*"))


def test_undecodable_frames_are_all_kept(tmp_path: Path) -> None:
    with changed(dict.fromkeys(range(1, FRAMES + 1), unknown)):
        assert capture(tmp_path / "session", decode=read_pixels) is None
    frames = taken_frames(tmp_path / "session")
    assert [committed.intent for _, committed, _ in frames] == list(range(1, FRAMES + 1))
    assert all("cannot be decoded here" in committed.record.warnings[0] for _, committed, _ in frames)


def test_lasting_change_of_size_stops_unattended_capture(tmp_path: Path) -> None:
    with changed(dict.fromkeys(range(5, 100), cropped)):
        assert isinstance(capture(tmp_path / "session", decode=read_pixels), CameraError)
    assert capture(tmp_path / "session", decode=read_pixels) is None
    assert len(list((tmp_path / "session" / "set_aside").iterdir())) == 3


def test_operator_may_skip_a_damaged_frame(tmp_path: Path) -> None:
    with changed({3: truncated}):
        operator = Operator({"camera": ["skip"] * 5, "skipped": ["keep"]})
        assert capture(tmp_path / "session", operator, decode=read_pixels) is None
    verdict = verify(tmp_path / "session")
    assert verdict.problems == ()
    assert verdict.left_out == ("00002_bright_0_r0_c2",)


class WatchedCamera(SimulatedCamera):
    """A camera that somebody else triggers; the frames are those of the simulated one."""

    def await_silence(self, exposure_s: float) -> None:
        self._clock.sleep_s(exposure_s + 5.0)


def test_untriggered_camera_is_silent_once_at_each_node(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(devices, "SimulatedCamera", WatchedCamera)
    operator = Operator()
    settings = replace(SMALL_RIG, settle=SettleSettings(measure=True))
    assert capture(tmp_path / "session", operator, settings) is None
    places = {(frame.step, frame.stop) for frame, _, _ in taken_frames(tmp_path / "session")}
    silences = [status for status in operator.statuses if status.doing.startswith("waiting for silence")]
    assert len(silences) == len(places) < FRAMES
    assert events(tmp_path / "session", "settling") == []  # its frames do not follow the move at once


@pytest.mark.parametrize("odd", [cropped, coloured])
def test_odd_first_frame_is_outvoted_and_taken_again(tmp_path: Path, odd: Change) -> None:
    with changed({1: odd}):
        assert capture(tmp_path / "session", decode=read_pixels) is None
    assert_complete(tmp_path / "session", superseded=1)
    for _, _, path in taken_frames(tmp_path / "session"):
        pixels = read_pixels(path)
        assert pixels is not None
        assert pixels.shape == (12, 16)
    (failure,) = events(tmp_path / "session", "camera_failed")
    assert "or, if that one was odd, just take this frame again" in str(failure.detail["message"])


def test_odd_second_frame_does_not_outvote_the_first(tmp_path: Path) -> None:
    with changed({2: cropped, 3: shallow, 5: cropped, 6: cropped}):
        assert capture(tmp_path / "session", decode=read_pixels) is None
    assert_complete(tmp_path / "session")
    assert len(events(tmp_path / "session", "camera_failed")) == 4
