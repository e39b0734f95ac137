"""The protocol of a light, which capture and drivers share."""

from typing import Protocol


class Light(Protocol):
    """A lamp, or a shutter, which lets light in when it is on.

    Every method is bounded in time. It raises `LightError`, or the `StageError` of the controller that switches it.
    """

    def open(self) -> None:
        """Connect to the light, without switching it."""

    def switch(self, on: bool, /) -> None:
        """Switch the light on or off; switching it twice does no harm."""

    def is_on(self) -> bool | None:
        """Return whether the light is on, as it reports by itself; None if it does not."""

    def close(self) -> None:
        """Disconnect, without switching; closing twice does no harm."""
