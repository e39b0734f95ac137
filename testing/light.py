"""The contract of a light, which every implementation must meet."""

import pytest

from faintfield.rig.errors import LightError
from faintfield.rig.lights.protocol import Light


def light_contract(light: Light) -> None:
    """Check a closed light, from opening to closing; it is switched some times, and left off.

    Parameters
    ----------
    light : Light
        The light, not yet opened.

    Raises
    ------
    AssertionError
        The light does not meet the contract.
    """
    _check_closed(light)
    light.open()
    _check_switching(light)
    light.open()  # a capture opens the light again after a failure
    _check_switching(light)
    light.close()
    light.close()
    _check_closed(light)
    light.open()
    _check_switching(light)
    light.close()


def _check_closed(light: Light) -> None:
    with pytest.raises(LightError, match="; "):
        light.switch(True)


def _check_switching(light: Light) -> None:
    for on in (True, True, False, True, False, False):
        light.switch(on)
        assert light.is_on() in (on, None)
