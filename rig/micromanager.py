"""One Micro-Manager core with all devices of its configuration, which camera and stage may share."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

from faintfield.rig.errors import MissingExtra

type User = Literal["camera", "stage"]


class NotOffered(Exception):
    """The settings name a device, a property or a value that the configuration does not offer."""


def set_properties(core: Any, label: str, properties: Mapping[str, str]) -> None:
    """Set properties of a device; raises `NotOffered`, which lists what there is, before anything is set."""
    known = core.getDevicePropertyNames(label)
    for name, value in properties.items():
        if name not in known:
            raise NotOffered(f"{label} has no property {name!r}; choose from {', '.join(known)}")
        if core.isPropertyReadOnly(label, name):
            raise NotOffered(f"property {name!r} of {label} cannot be set; remove it")
        allowed = core.getAllowedPropertyValues(label, name)
        if allowed and value not in allowed:
            raise NotOffered(f"property {name!r} of {label} cannot be {value!r}; choose from {', '.join(allowed)}")
    for name, value in properties.items():
        core.setProperty(label, name, value)


class SharedCore:
    """A core that is loaded for its first user and unloaded after its last; its methods block, and may hang.

    Devices are loaded once, since most can be opened only once.

    Parameters
    ----------
    configuration : str
        Configuration file; by default that of the demonstration devices.
    adapters : str
        Folder of the device adapters; by default that which pymmcore-plus finds.
    """

    def __init__(self, configuration: str = "", adapters: str = "") -> None:
        self.configuration = configuration
        self.adapters = adapters
        self._core: Any = None
        self._users: set[User] = set()
        self._hanging: set[User] = set()
        self._given_up = 0

    def import_package(self) -> None:
        """Import pymmcore-plus, which takes a while the first time; raises `MissingExtra`."""
        try:
            import pymmcore_plus  # noqa: F401
        except ImportError as failure:
            remedy = "pip install 'faintfield[micromanager]'"
            raise MissingExtra(f"pymmcore-plus for Micro-Manager is not installed; run: {remedy}") from failure

    def acquire(self, user: User) -> Any:
        """Return the core, with its devices loaded.

        Raises RuntimeError or OSError if a device cannot be loaded, a call of the other user still hangs, or this one
        was given up meanwhile.
        """
        if self._hanging and self._users:
            raise RuntimeError(
                f"a call of the {', '.join(self._hanging)} hangs in Micro-Manager, which {', '.join(self._users)} uses "
                "as well; end this program and begin it again"
            )
        if self._core is None:
            given_up = self._given_up
            core = self._load_core()
            if given_up != self._given_up:  # nobody waits for it any more, and another core may be in use
                core.unloadAllDevices()
                raise RuntimeError("the devices were loaded too late; connect again")
            self._core = core
        self._users.add(user)
        return self._core

    def release(self, user: User) -> None:
        """Unload the devices, unless the other user needs them."""
        self._users.discard(user)
        core = self._core
        if core is not None and not self._users and not self._hanging:
            self._core = None
            core.unloadAllDevices()

    def abandon(self, user: User) -> None:
        """Note that a call of `user` hangs; if there is no other user, the next `acquire` loads a new core."""
        self._given_up += 1
        self._users.discard(user)
        if self._users:
            self._hanging.add(user)
        else:
            self._core = None
            self._hanging.clear()

    def _load_core(self) -> Any:
        from pymmcore_plus import CMMCorePlus

        core = CMMCorePlus()
        try:
            if self.adapters:
                core.setDeviceAdapterSearchPaths([self.adapters])
            core.loadSystemConfiguration(*([Path(self.configuration)] if self.configuration else []))
        except BaseException:
            core.unloadAllDevices()
            raise
        return core
