"""What terminal and page have in common: one prompt, one status, one queue of pressed buttons.

Whoever presses first answers; both show the same. The capture runs in the main thread and only looks at the queue, so
a key, a click and Ctrl-C take the same way.
"""

import itertools
from collections.abc import Callable, Mapping
from queue import Empty, SimpleQueue
from typing import NamedTuple, get_args

from msgspec import Struct

from faintfield.rig.cameras.protocol import Pixels
from faintfield.rig.capture.guide import Answer, Prompt, Status, OperatorRequest
from faintfield.rig.session.frames import PlannedFrame

REQUESTS: tuple[OperatorRequest, ...] = get_args(OperatorRequest.__value__)


class ButtonPress(NamedTuple):
    """A button or key: the word on it, and the number of the prompt that it was meant for, if for one."""

    word: str
    prompt: int | None


class OpenPrompt(Struct, frozen=True):
    """A prompt that waits for its answer; `number` tells it from earlier ones."""

    number: int
    prompt: Prompt


class ShownFrame(Struct, frozen=True):
    """A frame as it is looked at."""

    frame: PlannedFrame
    pixels: Pixels
    values: Mapping[str, float]


class CapturePanel:
    """An `OperatorInterface` that others look at and press buttons of.

    Parameters
    ----------
    unattended : bool
        Prompts answer themselves; wishes are still heard.

    Attributes
    ----------
    asked, status, shown
        What is to be seen now. Each is replaced as a whole, so any thread may look.
    on_change : list of callable
        Told in the capture's thread that something is new.
    """

    def __init__(self, *, unattended: bool) -> None:
        self.asked: OpenPrompt | None = None
        self.status: Status | None = None
        self.shown: ShownFrame | None = None
        self.on_change: list[Callable[[], None]] = []
        self.unattended = unattended
        self._pressed: SimpleQueue[ButtonPress] = SimpleQueue()
        self._numbers = itertools.count(1)

    def press(self, word: str, prompt: int | None = None) -> None:
        """Press a button, from any thread or a signal handler."""
        self._pressed.put(ButtonPress(word, prompt))

    def ask(self, prompt: Prompt) -> Answer:
        """Wait for an answer to `prompt` from wherever it comes."""
        if self.unattended:
            return prompt.unattended
        self.asked = OpenPrompt(next(self._numbers), prompt)
        self._changed()
        while True:
            pressed = self._pressed.get()
            if pressed.word in prompt.answers and pressed.prompt in (None, self.asked.number):
                self.asked = None
                self._changed()
                return pressed.word

    def wish(self) -> OperatorRequest | None:
        """Return the latest of what was wished for since the last call."""
        latest: OperatorRequest | None = None
        while True:
            try:
                pressed = self._pressed.get_nowait()
            except Empty:
                return latest
            if pressed.word in REQUESTS and pressed.prompt is None:
                latest = pressed.word

    def show_status(self, status: Status) -> None:
        """Show where the capture stands."""
        self.status = status
        self._changed()

    def show_frame(self, frame: PlannedFrame, pixels: Pixels, values: Mapping[str, float]) -> None:
        """Show the frame just taken."""
        self.shown = ShownFrame(frame, pixels, values)
        self._changed()

    def _changed(self) -> None:
        """Tell those who look."""
        for tell in self.on_change:
            tell()
