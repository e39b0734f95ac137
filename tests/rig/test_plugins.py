"""Drivers of other packages are found by their names, checked as they are made, and fail by name."""

import sys
from pathlib import Path
from typing import Any
from unittest import mock

import msgspec
import pytest

from faintfield.pipelines.formats.toml_files import read_rig
from faintfield.rig import plugins
from faintfield.rig.cameras.folder import FolderCamera
from faintfield.rig.cameras.protocol import UntriggeredCamera
from faintfield.rig.cameras.settings import (
    BUILT_IN_BACKENDS,
    AravisSettings,
    CameraSettings,
    FolderSettings,
    PluginSettings,
)
from faintfield.rig.devices import open_rig, open_stage
from faintfield.rig.errors import PlanRefused, PluginFailed, UnknownPlugin
from faintfield.rig.settings import RigSettings
from faintfield.rig.stages.protocol import StageSettings

MODULE = """
from msgspec import Struct
from faintfield.rig.cameras.folder import FolderCamera
from faintfield.rig.cameras.settings import FolderSettings
from faintfield.rig.plugins import CameraPlugin, StagePlugin

class Sky(Struct, frozen=True, forbid_unknown_fields=True):
    folder: str
    wait_s: float = 60.0

class Lax(Struct):
    folder: str = ""

def fail(settings, clock):
    raise KeyError("no driver")

def make(settings, clock):
    return FolderCamera(FolderSettings(settings.folder, arrival_s=settings.wait_s), clock)

SKY = CameraPlugin(Sky, make)
LAX = CameraPlugin(Lax, lambda settings, clock: None)
FAILING = CameraPlugin(Sky, fail)
STAGE = StagePlugin(Sky, lambda options, settings, clock: (options, settings, clock))
"""
POINTS = {
    "cameras": {
        "sky": "sky_drivers:SKY",
        "lax": "sky_drivers:LAX",
        "failing": "sky_drivers:FAILING",
        "broken": "broken_drivers:SKY",
        "gphoto2": "sky_drivers:SKY",
    },
    "stages": {"moon": "sky_drivers:STAGE"},
}
RIG = """
[stage]
protocol = "simulated"
[camera]
backend = "sky"
folder = "frames"
mosaic = ["RG", "GB"]
[grid]
rows = 2
columns = 2
pitch_mm = 50.0
origin_mm = [-350.0, -350.0]
[[step]]
kind = "bright"
exposure_s = 0.1
"""


def install(folder: Path, package: str, points: dict[str, dict[str, str]]) -> None:
    """Write what pip would write of a package with these entry points."""
    info = folder / f"{package}-1.2.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 1.2\n")
    groups = (
        [f"[faintfield.{group}]", *(f"{name} = {value}" for name, value in names.items())]
        for group, names in points.items()
    )
    (info / "entry_points.txt").write_text("\n".join(line for group in groups for line in group) + "\n")


@pytest.fixture
def packages(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Install packages with drivers, good and bad ones, for the time of a test."""
    folder = tmp_path / "packages"
    folder.mkdir()
    install(folder, "sky-drivers", POINTS)
    (folder / "sky_drivers.py").write_text(MODULE)
    (folder / "broken_drivers.py").write_text("raise OSError('libsky.so: no such\\nfile')\n")
    monkeypatch.syspath_prepend(folder)
    for name in ("sky_drivers", "broken_drivers"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    return folder


SKY_TABLE = 'backend = "sky"\nfolder = "frames"\nmosaic = ["RG", "GB"]'
ARAVIS = 'backend = "aravis"\npixel_format = "BayerRG12p"\nregion_px = [0, 2, 64, 48]'


def rig_file(tmp_path: Path, old: str = "", new: str = "", camera: str = SKY_TABLE) -> Path:
    assert old in RIG
    path = tmp_path / "rig.toml"
    path.write_text((RIG.replace(old, new) if old else RIG).replace(SKY_TABLE, camera))
    return path


def test_built_in_backends_are_those_with_settings() -> None:
    tags = {settings.__struct_config__.tag for settings in CameraSettings.__value__.__args__}
    assert tags == {*BUILT_IN_BACKENDS, "plugin"}


def test_camera_of_another_package(packages: Path, tmp_path: Path) -> None:
    settings = read_rig(rig_file(tmp_path))
    assert settings.camera == PluginSettings("sky", {"folder": "frames"}, mosaic=("RG", "GB"))
    assert settings.mosaic == ("RG", "GB")
    guarded = open_rig(settings).camera
    assert isinstance(guarded, plugins.PluginCamera)
    camera = guarded._device  # noqa: SLF001 - what the plug-in made
    assert isinstance(camera, FolderCamera)
    assert camera._settings == FolderSettings("frames", arrival_s=60.0)  # noqa: SLF001 - what the plug-in got
    assert isinstance(guarded, UntriggeredCamera), "a watched folder has to be silent before each frame"
    with mock.patch.object(camera, "await_silence") as silence:
        guarded.await_silence(0.5)
    silence.assert_called_once_with(0.5)


def test_keys_of_built_in_drivers_are_read(tmp_path: Path) -> None:
    stage = 'protocol = "micromanager"\nconfiguration = "rig.cfg"\napproach_mm = 0.2'
    settings = read_rig(rig_file(tmp_path, 'protocol = "simulated"', stage, camera=ARAVIS))
    assert settings.stage == StageSettings("micromanager", approach_mm=0.2, options={"configuration": "rig.cfg"})
    assert settings.camera == AravisSettings("BayerRG12p", region_px=(0, 2, 64, 48))
    assert settings.mosaic == ("RG", "GB")


def test_stored_settings_are_read_without_the_package(packages: Path, tmp_path: Path) -> None:
    settings = read_rig(rig_file(tmp_path))
    stored = msgspec.json.encode(settings)
    sys.path.remove(str(packages))
    assert msgspec.json.decode(stored, type=RigSettings) == settings
    with pytest.raises(UnknownPlugin, match=r"camera\.backend = 'sky'; choose from 'gphoto2'.*no plug-in is installed"):
        open_rig(settings)


def test_stage_of_another_package(packages: Path, tmp_path: Path) -> None:
    stage = 'protocol = "moon"\nfolder = "orbit"\napproach_mm = 1.0'
    settings = read_rig(rig_file(tmp_path, 'protocol = "simulated"', stage)).stage
    assert settings == StageSettings("moon", approach_mm=1.0, options={"folder": "orbit"})
    arguments: Any = open_stage(settings)._controller  # noqa: SLF001 - the plug-in's own
    options, stage_settings, clock = arguments
    assert options.folder == "orbit"
    assert stage_settings == settings
    assert clock.now_s() <= clock.now_s()


@pytest.mark.parametrize(
    ("backend", "failure", "words"),
    [
        ("skye", UnknownPlugin, r"choose from 'gphoto2', .* or of the plug-ins 'broken', .*; did you mean 'sky'\?"),
        ("lax", PluginFailed, "of sky-drivers 1.2 is no CameraPlugin whose settings forbid unknown fields"),
        ("broken", PluginFailed, "of sky-drivers 1.2 cannot be imported: OSError: libsky.so: no such file; install"),
        ("failing", PluginFailed, "'failing' failed: KeyError: 'no driver'; correct"),
        ('sky"\nfoldr = "x', PlanRefused, r"backend = 'sky': .*unknown field `foldr`"),
    ],
)
def test_unusable_plugin_is_refused(
    packages: Path, tmp_path: Path, backend: str, failure: type[Exception], words: str
) -> None:
    with pytest.raises(failure, match=words) as caught:
        open_rig(read_rig(rig_file(tmp_path, "sky", backend)))
    assert "\n" not in str(caught.value)
    assert caught.value.__cause__ is not None or "imported" not in words


def test_two_packages_with_one_name_are_named(packages: Path, tmp_path: Path) -> None:
    install(packages, "other-sky", {"cameras": {"sky": "sky_drivers:SKY"}})
    with pytest.raises(UnknownPlugin, match=r"'sky' is offered by other-sky 1\.2 and sky-drivers 1\.2; uninstall"):
        open_rig(read_rig(rig_file(tmp_path)))


def test_plugin_cannot_replace_a_built_in_driver(packages: Path, tmp_path: Path) -> None:
    settings = read_rig(rig_file(tmp_path, 'backend = "sky"\nfolder = "frames"\nmosaic', 'backend = "gphoto2"\n#'))
    assert type(open_rig(settings).camera).__name__ == "GPhoto2Camera"
