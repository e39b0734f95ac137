"""A light that a program switches."""

import os
import signal
import subprocess
import sys
from tempfile import TemporaryFile

from faintfield.rig.errors import LightError
from faintfield.rig.lights.settings import CommandSettings

_STATES = {"on": True, "1": True, "off": False, "0": False}
# Bytes of a program's output that are read, and characters that are shown.
_MAX_OUTPUT_BYTES, _SHOWN = 4096, 80


class CommandLight:
    """A `Light` that runs a program for each request, without a shell and within a time limit."""

    def __init__(self, settings: CommandSettings) -> None:
        self._settings = settings
        self._open = False

    def open(self) -> None:
        """Do nothing but remember: the programs are run when they are needed."""
        self._open = True

    def switch(self, on: bool, /) -> None:
        """Run the program for this state."""
        self._run(self._settings.on if on else self._settings.off)

    def is_on(self) -> bool | None:
        """Return what the program for the state prints; None if there is none."""
        if not self._settings.state:
            return None
        output = self._run(self._settings.state)
        if output.lower() not in _STATES:
            raise self._failure(f"{self._settings.state[0]} printed {output[:_SHOWN]!r}; let it print 'on' or 'off'")
        return _STATES[output.lower()]

    def close(self) -> None:
        """Do nothing but remember."""
        self._open = False

    def _run(self, command: tuple[str, ...]) -> str:
        if not self._open:
            raise self._failure("is not open; open it first")
        program, limit_s = command[0], self._settings.limit_s
        with TemporaryFile() as output:
            try:
                # A session of its own: Ctrl-C ends the capture, which then still has to switch the light off
                process = subprocess.Popen(
                    command, stdin=subprocess.DEVNULL, stdout=output, stderr=output, start_new_session=True
                )
            except (OSError, ValueError) as failure:
                raise self._failure(f"{program} cannot be run ({failure}); correct the command") from failure
            try:
                code = process.wait(limit_s)
            except BaseException as failure:
                if sys.platform == "win32":
                    process.kill()
                else:
                    os.killpg(process.pid, signal.SIGKILL)
                process.wait()
                if isinstance(failure, subprocess.TimeoutExpired):
                    raise self._failure(f"{program} did not end within {limit_s:g} s; raise limit_s") from failure
                raise
            output.seek(0)
            text = " ".join(output.read(_MAX_OUTPUT_BYTES).decode(errors="replace").split())
        if code != 0:
            said = f", saying {text[:_SHOWN]!r}" if text else ""
            raise self._failure(f"{program} ended with exit code {code}{said}; run it by hand to see why")
        return text

    def _failure(self, problem: str) -> LightError:
        return LightError(f"light {self._settings.name}: {problem}")
