"""Cameras, stages and lights from other packages, found by their entry points (docs/tutorials/camera_driver.md)."""

import difflib
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from importlib.metadata import EntryPoint, entry_points
from typing import Any

import msgspec
from msgspec import Struct

from faintfield.rig.cameras.protocol import Camera, CameraReport, Exposure, Thermometer, UntriggeredCamera
from faintfield.rig.cameras.settings import BUILT_IN_BACKENDS, MosaicSettings, PluginSettings
from faintfield.rig.clock import Clock
from faintfield.rig.errors import (
    CameraError,
    LightError,
    PlanRefused,
    PluginFailed,
    RigError,
    UnknownPlugin,
    in_one_line,
)
from faintfield.rig.lights import settings as lights
from faintfield.rig.lights.protocol import Light
from faintfield.rig.stages.protocol import BUILT_IN_PROTOCOLS, WITHOUT_OPTIONS, Controller, StageSettings

CAMERAS = "faintfield.cameras"
STAGES = "faintfield.stages"
LIGHTS = "faintfield.lights"
# Key in rig.toml, and built-in drivers, of each group.
_BUILT_IN = {
    CAMERAS: ("camera.backend", BUILT_IN_BACKENDS),
    STAGES: ("stage.protocol", BUILT_IN_PROTOCOLS),
    LIGHTS: ("light.driver", lights.BUILT_IN_DRIVERS),
}


@dataclass(frozen=True)
class CameraPlugin[T: Struct]:
    """Factory named by an entry point of the group `faintfield.cameras`.

    Parameters
    ----------
    settings : type
        Struct of the keys of `[camera]`, besides `backend`, `mosaic` and those that begin with `settle_`; it forbids
        unknown fields.
    make : callable
        Makes the camera, closed, from its settings and the clock of its waits.
    """

    settings: type[T]
    make: Callable[[T, Clock], Camera]


@dataclass(frozen=True)
class StagePlugin[T: Struct]:
    """Factory named by an entry point of the group `faintfield.stages`.

    Parameters
    ----------
    settings : type
        Struct of the keys of `[stage]` that `StageSettings` does not have; it forbids unknown fields.
    make : callable
        Makes the controller, unconnected, from these, the whole `[stage]` table, and the clock of its waits.
    """

    settings: type[T]
    make: Callable[[T, StageSettings, Clock], Controller]


@dataclass(frozen=True)
class LightPlugin[T: Struct]:
    """Factory named by an entry point of the group `faintfield.lights`.

    Parameters
    ----------
    settings : type
        Struct of the keys of a `[[light]]` table, besides `name`, `driver` and `steady_s`; it forbids unknown fields.
    make : callable
        Makes the light, closed, from its settings and the clock of its waits.
    """

    settings: type[T]
    make: Callable[[T, Clock], Light]


def fold_plugins(content: Any) -> Any:
    """Return the content of a rig.toml as `RigSettings` takes it: with what no built-in driver reads as `options`.

    Raises `UnknownPlugin` if a driver is neither built in nor installed.
    """
    if not isinstance(content, dict):
        return content
    camera, stage = content.get("camera"), content.get("stage")
    if isinstance(camera, dict) and isinstance(name := camera.get("backend"), str) and name not in BUILT_IN_BACKENDS:
        _entry_points(CAMERAS, name)
        own = _with_options({key: camera[key] for key in camera if key != "backend"}, MosaicSettings)
        content = content | {"camera": {"backend": "plugin", "name": name, **own}}
    if isinstance(stage, dict) and isinstance(name := stage.get("protocol"), str) and name not in WITHOUT_OPTIONS:
        if name not in BUILT_IN_PROTOCOLS:
            _entry_points(STAGES, name)
        content = content | {"stage": _with_options(stage, StageSettings)}
    if isinstance(tables := content.get("light"), list):
        content = content | {"light": [_fold_light(table) for table in tables]}
    return content


def _fold_light(table: Any) -> Any:
    name = table.get("driver") if isinstance(table, dict) else None
    if not isinstance(name, str) or name in lights.BUILT_IN_DRIVERS:
        return table
    _entry_points(LIGHTS, name)
    own = {key: table[key] for key in ("name", "steady_s") if key in table}
    options = {key: value for key, value in table.items() if key not in ("driver", *own)}
    return {"driver": "plugin", "plugin": name, **own, "options": options}


def _with_options(table: dict[str, Any], kind: type[Struct]) -> dict[str, Any]:
    """Move the keys of `table` that `kind` does not have to a table `options`."""
    known = set(kind.__struct_fields__) - {"options"}
    options = {key: value for key, value in table.items() if key not in known}
    return {key: value for key, value in table.items() if key in known} | {"options": options}


def plugin_camera(settings: PluginSettings, clock: Clock) -> Camera:
    """Return the camera that a plug-in makes; raises `PlanRefused` if its settings are wrong or it cannot be used."""
    name = settings.name
    plugin = _load(CAMERAS, name, CameraPlugin)
    options = convert_options(settings.options, plugin.settings, f"[camera] with backend = {name!r}")
    with _making(name):
        camera = plugin.make(options, clock)
    return (
        UntriggeredPluginCamera(name, camera) if isinstance(camera, UntriggeredCamera) else PluginCamera(name, camera)
    )


class _PluginDevice[Device: Camera | Light]:
    """A device of another package, the plug-in `name`, whose failures all become `error`."""

    error: type[RigError]

    def __init__(self, name: str, device: Device) -> None:
        self._name = name
        self._device = device

    def open(self) -> None:
        """Connect to the device."""
        with self._guarded():
            self._device.open()

    def close(self) -> None:
        """Disconnect."""
        with self._guarded():
            self._device.close()

    def _guarded(self) -> AbstractContextManager[None]:
        return _raise_as(self.error, f"the plug-in {self._name!r} failed", "tell its authors", passing=RigError)


class PluginCamera(_PluginDevice[Camera]):
    """A camera of another package."""

    error = CameraError

    def report(self) -> CameraReport:
        """Return the camera's name, limits and settings."""
        with self._guarded():
            return self._device.report()

    def expose(self, exposure_s: float, number: int) -> Exposure:
        """Take one frame."""
        with self._guarded():
            return self._device.expose(exposure_s, number)

    def temperature_c(self) -> float | None:
        """Return the temperature of the sensor in °C, None if the camera reports none."""
        with self._guarded():
            return self._device.temperature_c() if isinstance(self._device, Thermometer) else None


class UntriggeredPluginCamera(PluginCamera):
    """A camera of another package that a person or a program triggers."""

    def await_silence(self, exposure_s: float) -> None:
        """Wait until no exposure is under way that could be taken for the next frame."""
        with self._guarded():
            assert isinstance(self._device, UntriggeredCamera)
            self._device.await_silence(exposure_s)


def plugin_light(settings: lights.PluginSettings, clock: Clock) -> Light:
    """Return the light that a plug-in makes; raises as `plugin_camera` does."""
    name = settings.plugin
    plugin = _load(LIGHTS, name, LightPlugin)
    options = convert_options(settings.options, plugin.settings, f"[[light]] {settings.name} with driver = {name!r}")
    with _making(name):
        return PluginLight(name, plugin.make(options, clock))


class PluginLight(_PluginDevice[Light]):
    """A light of another package."""

    error = LightError

    def switch(self, on: bool, /) -> None:
        """Switch the light."""
        with self._guarded():
            self._device.switch(on)

    def is_on(self) -> bool | None:
        """Return whether the light is on, None if it is not read back."""
        with self._guarded():
            return self._device.is_on()


def plugin_controller(settings: StageSettings, clock: Clock) -> Controller:
    """Return the controller that a plug-in makes; raises as `plugin_camera` does."""
    name = settings.protocol
    plugin = _load(STAGES, name, StagePlugin)
    options = convert_options(settings.options, plugin.settings, f"[stage] with protocol = {name!r}")
    with _making(name):
        return plugin.make(options, settings, clock)


def _making(name: str) -> AbstractContextManager[None]:
    return _raise_as(PluginFailed, f"the plug-in {name!r} failed", "correct its settings, or tell its authors")


def convert_options[T](options: Mapping[str, Any], kind: type[T], place: str) -> T:
    """Return `options` as the Struct `kind`; raises `PlanRefused` for keys and values that it does not take."""
    try:
        return msgspec.convert(dict(options), kind)
    except msgspec.ValidationError as failure:
        raise PlanRefused(f"{place}: {failure}; correct it in rig.toml") from None


def _entry_points(group: str, name: str) -> list[EntryPoint]:
    installed = entry_points(group=group)
    entries = [plugin for plugin in installed if plugin.name == name]
    if not entries:
        key, built_in = _BUILT_IN[group]
        names = sorted({plugin.name for plugin in installed})
        near = difflib.get_close_matches(name, [*built_in, *names], n=1, cutoff=0.5)
        plugin_names = f"or of the plug-ins {', '.join(map(repr, names))}" if names else "no plug-in is installed"
        raise UnknownPlugin(
            f"{key} = {name!r}; choose from {', '.join(map(repr, built_in))}, {plugin_names}"
            + (f"; did you mean {near[0]!r}?" if near else "")
        )
    return entries


def _load[T](group: str, name: str, kind: type[T]) -> T:
    entries, key = _entry_points(group, name), _BUILT_IN[group][0]
    packages = sorted({f"{entry.dist.name} {entry.dist.version}" if entry.dist else entry.value for entry in entries})
    if len(packages) > 1:
        raise UnknownPlugin(f"{key} = {name!r} is offered by {' and '.join(packages)}; uninstall all but one")
    what = f"the plug-in {name!r} of {packages[0]}"
    with _raise_as(PluginFailed, f"{what} cannot be imported", "install what it needs, or another version of it"):
        plugin = entries[0].load()
    settings = getattr(plugin, "settings", None)
    strict = (
        isinstance(settings, type) and issubclass(settings, Struct) and settings.__struct_config__.forbid_unknown_fields
    )
    if not isinstance(plugin, kind) or not strict:
        state = f"is no {kind.__name__} whose settings forbid unknown fields"
        raise PluginFailed(f"{what} {state}; install a version of it that fits this version of faintfield")
    return plugin


@contextmanager
def _raise_as(
    kind: type[RigError], what: str, remedy: str, passing: type[Exception] | tuple[()] = ()
) -> Iterator[None]:
    """Raise a failure inside, of whatever type, as one of `kind`; those of type `passing` pass as they are."""
    try:
        yield
    except passing:
        raise
    except Exception as failure:  # a plug-in may raise anything
        raise kind(f"{what}: {type(failure).__name__}: {in_one_line(failure)}; {remedy}") from failure
