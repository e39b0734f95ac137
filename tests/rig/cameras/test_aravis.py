"""GenICam cameras: Aravis' own fake cameras, one in this process and one that speaks GigE Vision over the loopback."""

import fcntl
import shutil
import subprocess
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from tempfile import gettempdir
from typing import Any
from unittest import mock

import msgspec
import numpy as np
import pytest

from faintfield.rig.cameras.aravis import AravisCamera, AravisDevice
from faintfield.rig.cameras.aravis_frames import Moment
from faintfield.rig.cameras.aravis_library import AravisLibrary, Reference
from faintfield.rig.cameras.settings import AravisSettings
from faintfield.rig.errors import CameraError, MissingExtra
from faintfield.testing import camera_contract

pytestmark = pytest.mark.deep

FAKE = AravisSettings("Mono16", camera="Fake_1", region_px=(0, 0, 64, 48))
SERVER = "arv-fake-gv-camera-0.8"


@pytest.fixture
def library() -> AravisLibrary:
    try:
        return AravisLibrary()
    except MissingExtra as failure:
        pytest.skip(f"Aravis' cameras are not tried: {failure}")


@pytest.fixture
def fake(library: AravisLibrary) -> Iterator[AravisCamera]:
    camera = AravisCamera(FAKE)
    camera.open()
    yield camera
    camera.close()


@pytest.fixture
def server(library: AravisLibrary) -> Iterator[list[str]]:
    """Serve a GigE Vision camera on the loopback; the list holds what it is to be started with."""
    program = shutil.which(SERVER)
    if program is None:
        pytest.skip(f"{SERVER} (package aravis-tools) is not installed here: its camera is not tried")
    running: list[subprocess.Popen[bytes]] = []

    class Options(list[str]):
        def append(self, option: str) -> None:
            """Start the server anew with an option more."""
            stop()
            super().append(option)
            running.append(subprocess.Popen([str(program), "-i", "127.0.0.1", *self], stdout=subprocess.DEVNULL))
            time.sleep(0.2)

    def stop() -> None:
        for process in running:
            process.kill()
            process.wait()
        running.clear()

    with (Path(gettempdir()) / "faintfield-gige-vision-port").open("w") as port:
        fcntl.flock(port, fcntl.LOCK_EX)  # GigE Vision has one port, and tests may run in several processes
        options = Options()
        options.append("--serial=GV01")
        yield options
        stop()


def gigabit(**changes: Any) -> AravisSettings:
    """Return settings for the camera of the server; a packet socket does not see the loopback of every computer."""
    served = {"camera": "127.0.0.1", "packet_socket": False, "answer_s": 4.0}
    return msgspec.structs.replace(FAKE, **(served | changes))


def test_contract_over_gigabit_ethernet(server: list[str]) -> None:
    camera_contract(AravisCamera(gigabit()), 0.01)


@pytest.mark.parametrize(("format_name", "bytes_per_px"), [("BayerRG8", 1), ("Mono16", 2), ("Mono8", 1)])
def test_frames_have_the_region_and_format_wanted(library: AravisLibrary, format_name: str, bytes_per_px: int) -> None:
    camera = AravisCamera(AravisSettings(format_name, camera="Fake_1", region_px=(32, 16, 80, 60), gain=0.0))
    camera.open()
    report = camera.report()
    assert report.name == "Aravis Fake 1"
    assert report.settings["PixelFormat"] == format_name
    assert report.settings["Region"] == "80 x 60 at 32, 16"
    assert report.settings["Gain"] == "0"
    exposure = camera.expose(0.01, 1)
    assert exposure.pixels is not None
    assert exposure.pixels.shape == (60, 80)
    assert exposure.pixels.itemsize == bytes_per_px
    assert exposure.metadata["pixel_format"] == format_name
    assert "temperature_c" not in exposure.metadata
    assert camera.temperature_c() is None
    camera.close()
    if format_name == "Mono8":  # a ramp, which rises by 1 from one pixel to the next along rows and columns
        rows, columns = np.indices((60, 80))
        ramp = exposure.pixels.astype(int) - exposure.pixels[0, 0]
        np.testing.assert_array_equal(ramp % 255, (rows + columns) % 255)


def test_acquisition_runs_only_during_an_exposure(fake: AravisCamera) -> None:
    """Anything that ran before could bring a frame of another position."""
    device = fake._device  # noqa: SLF001 - what the driver calls is nowhere else to be seen
    assert device is not None
    acts = {"start_acquisition", "software_trigger", "stream_timeout_pop_buffer", "stop_acquisition", "create_stream"}
    called: list[str] = []
    original = AravisLibrary.call

    def record(self: AravisLibrary, name: str, *arguments: Any) -> Any:
        called.append(name.removeprefix("arv_camera_").removeprefix("arv_"))
        return original(self, name, *arguments)

    order = ["create_stream", "start_acquisition", "software_trigger", "stream_timeout_pop_buffer", "stop_acquisition"]
    with mock.patch.object(AravisLibrary, "call", record):
        for _ in range(2):
            called.clear()
            fake.expose(0.01, 1)
            assert [name for name in called if name in acts] == order
        called.clear()
        with (
            mock.patch.object(AravisDevice, "_values", side_effect=CameraError("broken; mend it")),
            pytest.raises(CameraError, match="broken"),
        ):
            fake.expose(0.01, 1)
        assert [name for name in called if name in acts] == order


@contextmanager
def answering(**answers: Any) -> Iterator[None]:
    """Let functions of the library answer otherwise than Aravis' camera does; the others answer as ever."""
    original = AravisLibrary.call

    def call(self: AravisLibrary, name: str, *arguments: Any) -> Any:
        return answers[name] if name in answers else original(self, name, *arguments)

    with mock.patch.object(AravisLibrary, "call", call):
        yield


@pytest.mark.parametrize(
    ("answers", "words"),
    [
        ({"arv_buffer_get_status": 3}, "the frame is incomplete: .*packets are missing; "),
        ({"arv_buffer_get_status": 99}, "the frame is incomplete: .*state 99; "),
        ({"arv_camera_get_payload": 6143}, r"announces frames of 6143 bytes for the region \[0, 0, 64, 48\]"),
        ({"arv_buffer_get_image_width": 63}, r"63 x 48 pixels in format 0x01100007.* instead of 64 x 48 in Mono16"),
        ({"arv_stream_timeout_pop_buffer": None}, r"no frame came within \d"),
    ],
)
def test_wrong_frame_is_refused(fake: AravisCamera, answers: dict[str, Any], words: str) -> None:
    with answering(**answers), pytest.raises(CameraError, match=words):
        fake.expose(0.01, 1)


SHIFTED = {"OffsetX": "1", "Width": "64", "Height": "48"}


@pytest.mark.parametrize(
    ("changes", "answers", "words"),
    [
        ({}, {"arv_camera_get_pixel_format": 0x01080001}, "keeps pixel format Mono16"),
        ({}, {"arv_camera_get_region": None}, r"reads the region \[0, 0, 0, 0\] instead of"),
        ({"gain": 2.0}, {"arv_camera_get_gain": 1.5}, r"keeps gain 1\.5 instead of camera\.gain = 2; choose 1\.5"),
        ({"camera": "Fake_9"}, {}, "failed at connecting to Fake_9: .*; check its cable"),
        ({"region_px": (2000, 0, 64, 48)}, {}, r"leaves the sensor of 2048 x 2048 pixels"),
        ({"features": {"NoSuchFeature": "1"}}, {}, "NoSuchFeature"),
        (
            {"pixel_format": "BayerRG8", "region_px": None, "features": SHIFTED},
            {},
            r"begins at column 1, row 0, which shifts its mosaic; set camera\.region_px",
        ),
    ],
)
def test_settings_that_are_not_kept_fail_the_opening(
    library: AravisLibrary, changes: dict[str, Any], answers: dict[str, Any], words: str
) -> None:
    camera = AravisCamera(msgspec.structs.replace(FAKE, **changes))
    with answering(**answers), pytest.raises(CameraError, match=words):
        camera.open()
    with pytest.raises(CameraError, match="open it first"):
        camera.expose(0.01, 1)


def test_camera_is_closed_after_the_running_call(library: AravisLibrary) -> None:
    """Ctrl-C leaves an exposure behind in its thread; closing must not free what it uses."""
    camera = AravisCamera(FAKE)
    camera.open()
    device = camera._device  # noqa: SLF001 - the exposure that is left behind
    assert device is not None
    with ThreadPoolExecutor(1) as pool, mock.patch.object(Reference, "release", autospec=True) as release:
        begun, end = threading.Event(), threading.Event()

        def slow(exposure_s: float) -> None:
            begun.set()
            end.wait(10.0)
            released.append(release.called)

        released: list[bool] = []
        with mock.patch.object(AravisDevice, "_take", side_effect=slow):
            pool.submit(device.take, 0.01)
            assert begun.wait(10.0)
            closing = threading.Thread(target=camera.close)
            closing.start()
            closing.join(0.05)
            end.set()
            closing.join(10.0)
        assert released == [False]
        assert release.called
    device.release()


def test_frame_exposed_before_the_request_is_refused(fake: AravisCamera) -> None:
    fake.expose(0.01, 1)
    late = mock.Mock(side_effect=lambda: Moment(time.monotonic_ns() + 10**9, time.time_ns() + 10**9))
    with (
        mock.patch("faintfield.rig.cameras.aravis.Moment.now", late),
        pytest.raises(CameraError, match="began before the request"),
    ):
        fake.expose(0.01, 2)
    assert late.call_count == 2


def test_exposure_time_is_set_anew_after_a_failure(fake: AravisCamera) -> None:
    device = fake._device  # noqa: SLF001 - what the camera keeps is nowhere else to be seen
    assert device is not None
    fake.expose(0.01, 1)
    with answering(arv_camera_get_exposure_time=9800.0), pytest.raises(CameraError, match="choose"):
        fake.expose(0.02, 2)
    fake.expose(0.01, 3)
    kept_us = device._library.call("arv_camera_get_exposure_time", device._camera.pointer)  # noqa: SLF001
    assert kept_us == pytest.approx(10_000.0)


def test_camera_waits_for_its_trigger_without_automatics(library: AravisLibrary) -> None:
    camera = AravisCamera(msgspec.structs.replace(FAKE, features={"GainAuto": "Continuous", "TriggerMode": "Off"}))
    camera.open()
    device = camera._device  # noqa: SLF001 - the camera's features are behind it
    assert device is not None
    expected = {"TriggerMode": "On", "TriggerSource": "Software", "TriggerSelector": "FrameStart", "GainAuto": "Off"}
    pointer = device._camera.pointer  # noqa: SLF001
    assert {name: library.text("arv_camera_get_string", pointer, name.encode()) for name in expected} == expected
    camera.close()


def test_exposure_time_out_of_range_is_refused(fake: AravisCamera) -> None:
    with pytest.raises(CameraError, match=r"is not among the camera's, 1e-05 to 10; choose one"):
        fake.expose(60.0, 1)


def test_lost_packets_make_the_frame_incomplete(server: list[str]) -> None:
    server.append("--gvsp-lost-ratio=300")
    camera = AravisCamera(gigabit(region_px=(0, 0, 512, 512)))
    camera.open()
    for _ in range(2):
        with pytest.raises(CameraError, match=r"the frame is incomplete: .*packets|no frame came within"):
            camera.expose(0.01, 1)
    camera.close()


def test_lost_camera_is_named_and_found_again(server: list[str]) -> None:
    camera = AravisCamera(gigabit(answer_s=3.0))
    camera.open()
    camera.expose(0.01, 1)
    server.append("--serial=GV01")  # the one that runs is killed, and another knows nothing of us
    with pytest.raises(CameraError, match="; "):
        camera.expose(0.01, 2)
    camera.close()
    camera.open()
    camera.expose(0.01, 3)
    camera.close()
