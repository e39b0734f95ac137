"""What `[camera]` and a report refuse before anything moves; plug-ins that fail; real cameras in rehearsals."""

from typing import Any
from unittest import mock

import numpy as np
import pytest

from faintfield.rig.cameras.aravis import AravisCamera
from faintfield.rig.cameras.protocol import CameraReport, Exposure
from faintfield.rig.cameras.settings import (
    AravisSettings,
    CoolingSettings,
    FolderSettings,
    MicroManagerSettings,
    PluginSettings,
    SimulatedSettings,
)
from faintfield.rig.errors import CameraError, CameraTimeout, MissingExtra
from faintfield.rig.plugins import PluginCamera


@pytest.mark.parametrize("mosaic", [(), ("RGB", "GB"), ("RX", "GB")])
def test_a_mosaic_is_rows_of_one_length(mosaic: tuple[str, ...]) -> None:
    for make in (
        lambda: SimulatedSettings(mosaic=mosaic),
        lambda: FolderSettings("inbox", mosaic=mosaic),
        lambda: MicroManagerSettings(mosaic=mosaic),
        lambda: PluginSettings("sky", mosaic=mosaic),
    ):
        with pytest.raises(ValueError, match="rows of one length of the letters R, G and B"):
            make()


def test_limits_of_a_wait_need_the_temperature() -> None:
    with pytest.raises(ValueError, match="give it, or remove them"):
        CoolingSettings(settle_tolerance_c=1.0)
    CoolingSettings(settle_temperature_c=-10.0, settle_tolerance_c=1.0)


@pytest.mark.parametrize(
    ("keys", "reason"),
    [
        ({"features": {"PixelFormat": "Mono16"}}, "features has PixelFormat"),
        ({"packet_bytes": 65536}, "give 576 to 65535"),
        ({"region_px": (-1, 0, 4, 4)}, "give left column"),
        ({"answer_s": 1e9}, "at most 3600 s"),
    ],
)
def test_values_of_a_genicam_camera_that_cannot_be(keys: dict[str, Any], reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        AravisSettings("Mono8", **keys)
    AravisSettings("Mono8", packet_bytes=576, features={"BlackLevel": "64"})


def test_region_of_mosaic_begins_at_even_pixels() -> None:
    with pytest.raises(ValueError, match="even for a mosaic"):
        AravisSettings("BayerRG8", region_px=(1, 0, 4, 4))
    assert AravisSettings("BayerGB12Packed", region_px=(2, 0, 4, 4)).mosaic == ("GB", "RG")


def test_a_missing_library_says_what_to_install() -> None:
    with (
        mock.patch("faintfield.rig.cameras.aravis_library.LIBRARY", "libaravis-0.0.so"),
        pytest.raises(MissingExtra, match=r"needs libaravis-0\.0\.so, .*; run: apt-get install libaravis-0\.8-0"),
    ):
        AravisCamera(AravisSettings("Mono16")).open()


@pytest.mark.parametrize(("exposure_s", "offered"), [(1e-6, False), (1e-5, True), (10.0, True), (12.0, False)])
def test_a_report_with_a_range_offers_what_lies_in_it(exposure_s: float, offered: bool) -> None:
    assert CameraReport("camera", 1, exposure_range_s=(1e-5, 10.0)).offers(exposure_s) is offered


class Broken:
    """A camera of a plug-in that fails in its own words."""

    def open(self) -> None:
        raise ValueError("no port")

    def report(self) -> CameraReport:
        return CameraReport("broken", 1)

    def expose(self, exposure_s: float, number: int) -> Exposure:
        if number == 1:
            raise CameraTimeout("no frame")
        if number == 2:
            raise ZeroDivisionError
        return Exposure(".tiff", pixels=np.zeros((2, 2), np.uint8))

    def close(self) -> None:
        """Do nothing."""


def test_what_a_plug_in_raises_is_a_camera_error_that_names_it() -> None:
    camera = PluginCamera("sky", Broken())
    with pytest.raises(CameraError, match="the plug-in 'sky' failed with ValueError: no port"):
        camera.open()
    with pytest.raises(CameraTimeout, match="no frame"):
        camera.expose(1.0, 1)
    with pytest.raises(CameraError, match="'sky' failed with ZeroDivisionError"):
        camera.expose(1.0, 2)
    assert camera.expose(1.0, 3).pixels is not None
    assert camera.report().name == "broken"
    assert camera.temperature_c() is None
