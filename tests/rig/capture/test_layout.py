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

from faintfield.pipelines.live.guided import read_pixels
from faintfield.rig.cameras.protocol import Decode, Exposure
from faintfield.rig.capture.guide import Answer, OperatorRequest, Prompt
from faintfield.rig.capture.loop import Capture
from faintfield.rig.capture.survey import survey
from faintfield.rig.devices import open_rig
from faintfield.rig.errors import CameraError, CaptureStopped, RigError
from faintfield.rig.session.journal import Journal
from faintfield.rig.session.resume import open_session
from faintfield.rig.session.session import FrozenPlan, taken_frames
from faintfield.rig.session.verify import verify
from faintfield.rig.simulation.lab import SimulatedCamera
from tests.faults.capturing import FRAMES, SMALL_RIG, Unattended

type Change = Callable[[Exposure], Exposure]


class Stopping(Unattended):
    """A person who stops after some frames."""

    def __init__(self, frames: int) -> None:
        self.left = frames

    def take_request(self) -> OperatorRequest | None:
        self.left -= 1
        return "stop" if self.left < 0 else None


def capture(folder: Path, person: Unattended | None = None, decode: Decode = read_pixels) -> RigError | None:
    plan = FrozenPlan(survey(open_rig(SMALL_RIG), SMALL_RIG).plan, SMALL_RIG)
    try:
        with open_session(folder, plan) as session:
            Capture(session, open_rig(SMALL_RIG, session.journal), person or Unattended(), decode).run()
    except RigError as failure:
        return failure
    return None


@contextmanager
def changed(changes: dict[int, Change]) -> Iterator[None]:
    """Let the simulated camera give other exposures, by their number in the session."""
    expose = SimulatedCamera.expose

    def other(camera: SimulatedCamera, exposure_s: float, number: int) -> Exposure:
        exposure = expose(camera, exposure_s, number)
        return changes[number](exposure) if number in changes else exposure

    with mock.patch.object(SimulatedCamera, "expose", other):
        yield


def cropped(exposure: Exposure) -> Exposure:
    assert exposure.pixels is not None
    return Exposure(exposure.suffix, pixels=exposure.pixels[:-1], metadata=exposure.metadata)


def coloured(exposure: Exposure) -> Exposure:
    assert exposure.pixels is not None
    return Exposure(exposure.suffix, pixels=np.dstack([exposure.pixels] * 3), metadata=exposure.metadata)


def shallow(exposure: Exposure) -> Exposure:
    assert exposure.pixels is not None
    return Exposure(exposure.suffix, pixels=(exposure.pixels >> 8).astype(np.uint8), metadata=exposure.metadata)


def as_file(exposure: Exposure) -> Exposure:
    buffer = BytesIO()
    tifffile.imwrite(buffer, exposure.pixels)
    return Exposure(exposure.suffix, content=buffer.getvalue(), metadata=exposure.metadata)


def truncated(exposure: Exposure) -> Exposure:
    content = as_file(exposure).content
    assert content is not None
    return Exposure(exposure.suffix, content=content[:-100], metadata=exposure.metadata)


def unknown(exposure: Exposure) -> Exposure:
    return Exposure(".nef", content=b"no raw file at all" * 1000, metadata=exposure.metadata)


CHANGES: dict[Change, str] = {
    cropped: r"has 16 x 11 pixels of uint16, but 00000_bright_0_r0_c0_x1\.tiff has 16 x 12 pixels of uint16; ",
    coloured: r"has 16 x 12 pixels x 3 colours of uint16, but .* has 16 x 12 pixels of uint16; ",
    shallow: r"has 16 x 12 pixels of uint8, but .* has 16 x 12 pixels of uint16; ",
    truncated: r"_x9\.tiff: cannot be decoded \(.*; take",
    unknown: r"_x9\.nef: cannot be decoded, but .* has 16 x 12 pixels",
}


@pytest.mark.parametrize(
    ("change", "resumed"), [(cropped, True), (coloured, False), (shallow, False), (truncated, True), (unknown, False)]
)
def test_a_frame_unlike_the_others_is_set_aside_and_taken_again(tmp_path: Path, change: Change, resumed: bool) -> None:
    folder = tmp_path / "session"
    if resumed:
        assert isinstance(capture(folder, Stopping(8)), CaptureStopped)
    with changed({9: change}):
        assert capture(folder) is None
    verdict = verify(folder)
    assert verdict.problems == ()
    assert (verdict.present, verdict.sealed, verdict.superseded) == (FRAMES, True, 0)
    for _, _, path in taken_frames(folder):
        pixels = read_pixels(path)
        assert pixels is not None
        assert pixels.shape == (12, 16)
        assert pixels.dtype == np.uint16
    with Journal(folder / "journal.sqlite", read_only=True) as journal:
        (failure,) = journal.details("camera_failed", dict[str, str])
        assert journal.uncommitted() == [(9, 8)]
    assert re.search(CHANGES[change], failure["message"])
    (aside,) = (folder / "set_aside").iterdir()
    assert aside.name.startswith("00008_dark_scene_0_")
    assert not list((folder / "frames").glob("*_x9.*"))


def test_frames_of_a_kind_that_is_not_decoded_here_are_all_kept(tmp_path: Path) -> None:
    with changed(dict.fromkeys(range(1, FRAMES + 1), unknown)):
        assert capture(tmp_path / "session") is None
    taken = taken_frames(tmp_path / "session")
    assert [it.intent for _, it, _ in taken] == list(range(1, FRAMES + 1))
    assert all("cannot be decoded here" in it.record.warnings[0] for _, it, _ in taken)


def test_a_camera_that_goes_on_with_another_size_stops_a_capture_without_a_person(tmp_path: Path) -> None:
    with changed(dict.fromkeys(range(5, 100), cropped)):
        failure = capture(tmp_path / "session")
    assert isinstance(failure, CameraError)
    assert capture(tmp_path / "session") is None
    assert len(list((tmp_path / "session" / "set_aside").iterdir())) == 3


def test_a_person_may_skip_a_frame_that_cannot_be_right(tmp_path: Path) -> None:
    class Skipping(Unattended):
        def ask(self, prompt: Prompt) -> Answer:
            return {"camera": "skip", "skipped": "keep"}.get(prompt.key, prompt.unattended)  # type: ignore[return-value]

    with changed({3: truncated}):
        assert capture(tmp_path / "session", Skipping()) is None
    verdict = verify(tmp_path / "session")
    assert verdict.problems == ()
    assert verdict.left_out == ("00002_bright_0_r0_c2",)
