"""The `[[light]]` tables of rig.toml, one type for each driver."""

import math
from typing import Any

from msgspec import Struct

from faintfield.rig.stages.protocol import Output, OutputKind

# Values of `driver` that are built in.
BUILT_IN_DRIVERS = ("controller", "command", "simulated")
# Longest time limit of a command, and longest time until a lamp is steady, in s.
_MAX_LIMIT_S, _MAX_STEADY_S = 600.0, 3600.0
# Largest number of a pin, and largest value of an output.
_MAX_NUMBER, _MAX_LEVEL = 999, 100_000.0


class _LightSettings(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Keys of every `[[light]]` table.

    Parameters
    ----------
    name : str
        Name by which steps list the light.
    steady_s : float
        Time after switching until the light is steady, or until a shutter is open or closed.
    """

    name: str
    steady_s: float = 0.0

    def __post_init__(self) -> None:
        if not self.name.strip():
            raise ValueError("a light has an empty name; give one")
        if not 0.0 <= self.steady_s <= _MAX_STEADY_S:
            raise ValueError(f"light {self.name}: steady_s = {self.steady_s:g}; give 0 to {_MAX_STEADY_S:g} s")


class ControllerSettings(_LightSettings, frozen=True, forbid_unknown_fields=True, tag_field="driver", tag="controller"):
    """A lamp at an output of the stage's controller.

    Parameters
    ----------
    output, number : str, int
        `flood`, `mist` or `spindle` with GRBL and grblHAL, `pin` or `fan` with Marlin; number of the pin or fan.
    level : float, optional
        Value (S) that switches the light on; by default 1000 for the spindle, and 255 for pins and fans.
    """

    output: OutputKind
    number: int = 0
    level: float | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0 <= self.number <= _MAX_NUMBER:
            raise ValueError(f"light {self.name}: number = {self.number}; give 0 to {_MAX_NUMBER}")
        if self.level is not None and not 0.0 < self.level <= _MAX_LEVEL:
            raise ValueError(f"light {self.name}: level = {self.level:g}; give more than 0 and at most {_MAX_LEVEL:g}")

    def in_controller(self) -> Output:
        """Return the output."""
        return Output(self.output, self.number, self.level)


class CommandSettings(_LightSettings, frozen=True, forbid_unknown_fields=True, tag_field="driver", tag="command"):
    """A lamp that a program switches.

    Parameters
    ----------
    on, off : tuple of str
        Program and arguments that switch the light on; program and arguments that switch the light off, without a
        shell.
    state : tuple of str
        Program and arguments that print `on` or `off`, or 1 or 0; by default the light is not read back.
    limit_s : float
        Time limit of each of these programs.
    """

    on: tuple[str, ...]
    off: tuple[str, ...]
    state: tuple[str, ...] = ()
    limit_s: float = 10.0

    def __post_init__(self) -> None:
        super().__post_init__()
        for command in (self.on, self.off, self.state or ("none",)):
            if not command or not command[0] or any("\0" in word for word in command):
                raise ValueError(f"light {self.name}: {list(command)} is no command; give a program and its arguments")
        if not 0.0 < self.limit_s <= _MAX_LIMIT_S or math.isnan(self.limit_s):
            raise ValueError(
                f"light {self.name}: limit_s = {self.limit_s:g}; give more than 0, at most {_MAX_LIMIT_S:g} s"
            )


class SimulatedSettings(_LightSettings, frozen=True, forbid_unknown_fields=True, tag_field="driver", tag="simulated"):
    """A lamp of the simulated lab, which has `room`, `board`, `scene` and `shutter`."""


class PluginSettings(_LightSettings, frozen=True, forbid_unknown_fields=True, tag_field="driver", tag="plugin"):
    """A light that another package drives; docs/tutorials/camera_driver.md.

    Parameters
    ----------
    plugin, options : str, dict
        Name of the entry point in the group `faintfield.lights`, which is `driver` in rig.toml; the other keys of the
        table, which the plug-in's own settings type checks.
    """

    plugin: str
    options: dict[str, Any] = {}


type LightSettings = ControllerSettings | CommandSettings | SimulatedSettings | PluginSettings
