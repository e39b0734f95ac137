"""Every camera meets the contract; gphoto2 and Micro-Manager with the real libraries and their virtual cameras."""

import importlib
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from faintfield.rig.cameras.bounded import call_within
from faintfield.rig.cameras.gphoto2 import GPhoto2Camera, shutter_s
from faintfield.rig.cameras.micromanager import MicroManagerCamera
from faintfield.rig.cameras.protocol import Exposure
from faintfield.rig.cameras.settings import GPhoto2Settings, MicroManagerSettings, SimulatedSettings
from faintfield.rig.errors import CameraError, CameraTimeout, MissingExtra
from faintfield.rig.simulation.controller.wire import SimulatedClock
from faintfield.rig.simulation.lab import TRUE_POSE, SimulatedCamera, SimulatedLab
from faintfield.rig.stages.protocol import Point
from faintfield.testing import camera_contract

SEED = b"\xff\xd8 a picture, for all that the camera knows \xff\xd9"


def test_the_simulated_camera() -> None:
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
def test_exposure_times_in_a_camera_s_words(words: str, seconds: float | None) -> None:
    assert shutter_s(words) == (None if seconds is None else pytest.approx(seconds))


def test_an_exposure_is_a_file_or_an_array() -> None:
    for both in ({}, {"content": b"x", "pixels": np.zeros((2, 2))}):
        with pytest.raises(ValueError, match="either"):
            Exposure(".nef", **both)  # type: ignore[arg-type]


def test_a_call_that_hangs_is_left_behind() -> None:
    never = threading.Event()
    with pytest.raises(CameraTimeout, match=r"did not finish an exposure within 0\.01 s; "):
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
def test_a_missing_extra_says_what_to_install(
    camera: Any, package: str, extra: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(importlib.import_module("sys").modules, package, None)
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
def test_gphoto2_virtual_camera(card: Path) -> None:
    camera_contract(GPhoto2Camera(GPhoto2Settings(frame_mb=1.0)), 0.01)


@pytest.mark.deep
def test_gphoto2_keeps_the_file_byte_for_byte(card: Path) -> None:
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
    with pytest.raises(CameraError, match=r"settings\.warp = '9': the camera has no setting warp, it has: .*f-number"):
        GPhoto2Camera(GPhoto2Settings(settings={"warp": "9"})).open()
    with pytest.raises(CameraError, match=r"settings\.f-number = 'f/0' is not offered .* offers: .*f/8.*; choose one"):
        GPhoto2Camera(GPhoto2Settings(settings={"f-number": "f/0"})).open()
    camera.close()


@pytest.mark.deep
def test_gphoto2_faults(card: Path) -> None:
    with pytest.raises(CameraError, match="failed at connecting"):
        GPhoto2Camera(GPhoto2Settings(port="usb:999,999")).open()
    with pytest.raises(CameraTimeout, match=r"connecting within 1e-06 s; "):
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
def test_micromanager_demo_camera(demo: MicroManagerCamera) -> None:
    camera_contract(demo, 0.01)


@pytest.mark.deep
def test_micromanager_frames_are_arrays(demo: MicroManagerCamera) -> None:
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
    demo.open()
    core = demo._core  # noqa: SLF001 - there is no other way to pull the virtual cable
    core.unloadDevice("Camera")
    with pytest.raises(CameraError, match=r"failed at an exposure .*; check its cable"):
        demo.expose(0.01, 1)
    demo.close()


@pytest.mark.deep
def test_micromanager_time_out() -> None:
    pytest.importorskip("pymmcore_plus", reason="pymmcore-plus is not installed here: its time-out is not tried")
    with pytest.raises(CameraTimeout, match=r"within 1e-06 s; "):
        MicroManagerCamera(MicroManagerSettings(answer_s=1e-6)).open()
