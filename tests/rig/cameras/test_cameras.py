"""Cameras meet the contract, real ones by virtual cameras of their libraries; limits of settings and reports."""

import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest import mock

import numpy as np
import pytest

from faintfield.rig.cameras.aravis import AravisCamera
from faintfield.rig.cameras.gphoto2 import GPhoto2Camera, parse_shutter_s
from faintfield.rig.cameras.micromanager import MicroManagerCamera
from faintfield.rig.cameras.protocol import CameraReport, Exposure, Thermometer, call_within
from faintfield.rig.cameras.settings import (
    AravisSettings,
    CoolingSettings,
    FolderSettings,
    GPhoto2Settings,
    MicroManagerSettings,
    PluginSettings,
    SimulatedSettings,
)
from faintfield.rig.errors import CameraError, CameraTimeout, MissingExtra
from faintfield.rig.plugins import PluginCamera
from faintfield.rig.simulation.controller.kinematics import SimulatedClock
from faintfield.rig.simulation.lab import TRUE_POSE, SimulatedCamera, SimulatedLab
from faintfield.rig.stages.protocol import Point
from faintfield.testing import camera_contract

SEED = b"\xff\xd8 a picture, for all that the camera knows \xff\xd9"


def test_simulated_camera() -> None:
    clock = SimulatedClock()
    settings = SimulatedSettings(size_px=(8, 8))
    lab = SimulatedLab(Point(0.0, 0.0), lambda: Point(10.0, 0.0), lambda: 60.0, (), settings)
    camera = SimulatedCamera(settings, clock, lab)
    camera_contract(camera, 0.1)
    assert clock.now_s() >= 6 * 0.1
    camera.open()
    assert camera.expose(0.1, 1).metadata[TRUE_POSE] == pytest.approx([0, 0, 0, -10, 0, 0], abs=1e-9)


@pytest.mark.parametrize(
    ("words", "seconds"),
    [("1/250", 1 / 250), ("0.0100s", 0.01), ("30", 30.0), ("bulb", None), ("1/0", None), ("0", None)],
)  # fmt: skip
def test_exposure_times_in_words_of_cameras(words: str, seconds: float | None) -> None:
    assert parse_shutter_s(words) == (None if seconds is None else pytest.approx(seconds))


def test_exposure_is_either_file_or_array() -> None:
    for both in ({}, {"content": b"x", "pixels": np.zeros((2, 2))}):
        with pytest.raises(ValueError, match="either"):
            Exposure(".nef", **both)  # type: ignore[arg-type]


def test_hanging_call_is_left_behind() -> None:
    never = threading.Event()
    with pytest.raises(CameraTimeout, match=r"did not finish an exposure in 0\.01 s; "):
        call_within(0.01, never.wait, "an exposure")
    never.set()
    assert call_within(60.0, lambda: 7, "counting") == 7
    with pytest.raises(ZeroDivisionError):
        call_within(60.0, lambda: 1 // 0, "dividing")


@pytest.mark.parametrize(
    ("camera", "package", "extra"),
    [
        (GPhoto2Camera(GPhoto2Settings()), "gphoto2", "gphoto2"),
        (MicroManagerCamera(MicroManagerSettings()), "pymmcore_plus", "micromanager"),
    ],
)
def test_missing_extra_names_its_installation(
    camera: Any, package: str, extra: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(MissingExtra, match=rf"pip install 'faintfield\[{extra}\]'"):
        camera.open()


@pytest.fixture(scope="module")
def card(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The only file on the card of gphoto2's virtual camera, which reads its card once per process."""
    gphoto2 = pytest.importorskip("gphoto2", reason="python-gphoto2 is not installed here: its camera is not tried")
    library = Path(gphoto2.__file__).parent / "libgphoto2"
    if not (library / "vusb").is_dir():
        pytest.skip("this build of libgphoto2 has no virtual camera")
    root = tmp_path_factory.mktemp("card")
    picture = root / "DCIM" / "100NIKON" / "seed.jpg"
    picture.parent.mkdir(parents=True)
    picture.write_bytes(SEED)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("IOLIBS", str(library / "vusb"))
        patch.setenv("VCAMERADIR", str(root))
        yield picture


@pytest.mark.deep
def test_gphoto2_keeps_the_file_byte_for_byte(card: Path) -> None:
    camera_contract(GPhoto2Camera(GPhoto2Settings(frame_mb=1.0)), 0.01)
    camera = GPhoto2Camera(GPhoto2Settings(settings={"f-number": "f/8"}))
    camera.open()
    report = camera.report()
    assert report.settings["f-number"] == "f/8"
    assert report.exposures_s is not None
    assert {0.01, 0.1, 1.0} <= set(report.exposures_s)
    exposure = camera.expose(0.1, 1)
    assert (exposure.content, exposure.suffix) == (SEED, ".jpg")
    with pytest.raises(CameraError, match=r"exposure_s = 0\.3 is not among the camera's"):
        camera.expose(0.3, 2)
    for setting, words in (("warp", "the camera has no setting warp"), ("f-number", "is not offered .* offers: .*f/8")):
        with pytest.raises(CameraError, match=rf"settings\.{setting} = 'f/0'.*{words}"):
            GPhoto2Camera(GPhoto2Settings(settings={setting: "f/0"})).open()
    camera.close()


@pytest.mark.deep
def test_gphoto2_faults(card: Path) -> None:
    with pytest.raises(CameraError, match="failed at connecting"):
        GPhoto2Camera(GPhoto2Settings(port="usb:999,999")).open()
    with pytest.raises(CameraTimeout, match=r"finish connecting in 1e-06 s; "):
        GPhoto2Camera(GPhoto2Settings(answer_s=1e-6)).open()
    camera = GPhoto2Camera(GPhoto2Settings())
    camera.open()
    away = card.rename(card.with_suffix(".away"))  # without its file the virtual camera cannot expose
    with pytest.raises(CameraError, match="failed at an exposure"):
        camera.expose(0.1, 1)
    away.rename(card)
    camera.close()


@pytest.fixture
def demo() -> MicroManagerCamera:
    """Return Micro-Manager's demonstration camera."""
    why = "pymmcore-plus and mm-test-adapters are not installed here: their camera is not tried"
    pytest.importorskip("pymmcore_plus", reason=why)
    adapters = pytest.importorskip("mm_test_adapters", reason=why)
    return MicroManagerCamera(MicroManagerSettings(adapters=adapters.device_adapter_path()))


@pytest.mark.deep
def test_micromanager_frames_are_arrays(demo: MicroManagerCamera) -> None:
    camera_contract(demo, 0.01)
    demo.open()
    exposure = demo.expose(0.01, 1)
    assert exposure.pixels is not None
    assert exposure.pixels.dtype == np.uint16
    assert exposure.pixels.shape == (512, 512)
    assert exposure.pixels.std() > 0
    assert demo.report().settings["PixelType"] == "16bit"
    demo.close()


@pytest.mark.deep
def test_micromanager_faults(demo: MicroManagerCamera, tmp_path: Path) -> None:
    broken = tmp_path / "broken.cfg"
    broken.write_text("Device,Camera,NoSuchAdapter,DCam\n")
    with pytest.raises(CameraError, match=r"failed at loading .*NoSuchAdapter"):
        MicroManagerCamera(MicroManagerSettings(configuration=str(broken))).open()
    with pytest.raises(CameraError, match=r"'Binning' of Camera cannot be 'seventeen'; choose from 1, 2, 4, 8$"):
        MicroManagerCamera(MicroManagerSettings(properties={"Binning": "seventeen"})).open()
    with pytest.raises(CameraTimeout, match=r"did not finish .* in 1e-06 s; "):
        MicroManagerCamera(MicroManagerSettings(answer_s=1e-6)).open()
    demo.open()
    core = demo._core  # noqa: SLF001 - there is no other way to pull the virtual cable
    core.unloadDevice("Camera")
    with pytest.raises(CameraError, match=r"failed at an exposure .*; check its cable"):
        demo.expose(0.01, 1)
    demo.close()


@pytest.mark.parametrize(
    ("properties", "temperature_c"),
    [
        ({"Temperature": "7", "Gain": "1"}, 7.0),
        ({"Temperature": "30", "CCDTemperature": "-20"}, -20.0),
        ({"Temperature": "nan"}, None),
        ({"Gain": "1"}, None),
    ],
)
def test_temperature_that_micromanager_reports(properties: dict[str, str], temperature_c: float | None) -> None:
    camera = MicroManagerCamera(MicroManagerSettings())
    camera._core = SimpleNamespace(  # noqa: SLF001 - the real core reads no temperature without a camera
        getCameraDevice=lambda: "Camera",
        getDevicePropertyNames=lambda label: tuple(properties),
        getProperty=lambda label, name: properties[name],
        setExposure=lambda exposure_ms: None,
        snap=lambda: np.zeros((2, 3), np.uint16),
    )
    assert isinstance(camera, Thermometer)
    assert camera.temperature_c() == temperature_c
    assert camera.expose(0.1, 1).metadata["temperature_c"] == temperature_c


@pytest.mark.parametrize("mosaic", [(), ("RGB", "GB"), ("RX", "GB")])
def test_mosaic_must_be_rows_of_one_length(mosaic: tuple[str, ...]) -> None:
    for make in (
        lambda: SimulatedSettings(mosaic=mosaic),
        lambda: FolderSettings("inbox", mosaic=mosaic),
        lambda: MicroManagerSettings(mosaic=mosaic),
        lambda: PluginSettings("sky", mosaic=mosaic),
    ):
        with pytest.raises(ValueError, match="rows of one length of the letters R, G and B"):
            make()


def test_limits_of_a_wait_need_the_temperature() -> None:
    CoolingSettings(settle_temperature_c=-10.0, settle_tolerance_c=1.0)
    with pytest.raises(ValueError, match="give it, or remove them"):
        CoolingSettings(settle_tolerance_c=1.0)


@pytest.mark.parametrize(
    ("keys", "reason"),
    [
        ({"features": {"PixelFormat": "Mono16"}}, "features has PixelFormat"),
        ({"packet_bytes": 65536}, "give 576 to 65535"),
        ({"region_px": (-1, 0, 4, 4)}, "give left column"),
        ({"answer_s": 1e9}, "at most 3600 s"),
    ],
)
def test_impossible_values_of_genicam_cameras_are_refused(keys: dict[str, Any], reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        AravisSettings("Mono8", **keys)
    AravisSettings("Mono8", packet_bytes=576, features={"BlackLevel": "64"})


def test_region_of_mosaic_begins_at_even_pixels() -> None:
    with pytest.raises(ValueError, match="even for a mosaic"):
        AravisSettings("BayerRG8", region_px=(1, 0, 4, 4))
    assert AravisSettings("BayerGB12Packed", region_px=(2, 0, 4, 4)).mosaic == ("GB", "RG")


def test_missing_aravis_names_its_package() -> None:
    with (
        mock.patch("faintfield.rig.cameras.aravis_library.LIBRARY", "libaravis-0.0.so"),
        pytest.raises(MissingExtra, match=r"needs libaravis-0\.0\.so; run: apt-get install libaravis-0\.8-0"),
    ):
        AravisCamera(AravisSettings("Mono16")).open()


@pytest.mark.parametrize(("exposure_s", "offered"), [(1e-6, False), (1e-5, True), (10.0, True), (12.0, False)])
def test_report_offers_exposures_within_its_range(exposure_s: float, offered: bool) -> None:
    assert CameraReport("camera", 1, exposure_range_s=(1e-5, 10.0)).offers(exposure_s) is offered


def test_failure_of_a_plugin_names_it() -> None:
    frame = Exposure(".tiff", pixels=np.zeros((2, 2), np.uint8))
    broken = mock.Mock(spec=["open", "report", "expose", "close"])
    broken.open.side_effect = ValueError("no port")
    broken.expose.side_effect = [CameraTimeout("no frame"), ZeroDivisionError, frame]
    camera = PluginCamera("sky", broken)
    with pytest.raises(CameraError, match="the plug-in 'sky' failed: ValueError: no port"):
        camera.open()
    with pytest.raises(CameraTimeout, match="no frame"):
        camera.expose(1.0, 1)
    with pytest.raises(CameraError, match="'sky' failed: ZeroDivisionError"):
        camera.expose(1.0, 2)
    assert camera.expose(1.0, 3) is frame
    assert camera.report() is broken.report.return_value
    assert camera.temperature_c() is None
