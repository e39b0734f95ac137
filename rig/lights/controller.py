"""A light at an output of the stage's controller."""

from faintfield.rig.errors import LightError
from faintfield.rig.stages.gantry import Gantry
from faintfield.rig.stages.protocol import Output


class ControllerLight:
    """A `Light` that the controller of a connected stage switches, while it is at rest."""

    def __init__(self, name: str, stage: Gantry, output: Output) -> None:
        self._name = name
        self._stage = stage
        self._output = output
        self._open = False

    def open(self) -> None:
        """Do nothing but remember: the stage is connected by itself."""
        self._open = True

    def switch(self, on: bool, /) -> None:
        """Switch the output."""
        self._require_open()
        self._stage.switch_output(self._output, on=on)

    def is_on(self) -> bool | None:
        """Return what the controller reports about the output; None if it reports nothing."""
        self._require_open()
        return self._stage.read_output(self._output)

    def unlock(self) -> None:
        """Clear the lock of a controller that was not homed, so that the light can be tried."""
        self._stage.unlock()

    def close(self) -> None:
        """Do nothing but remember."""
        self._open = False

    def _require_open(self) -> None:
        if not self._open:
            raise LightError(f"light {self._name}: is not open; open it first")
