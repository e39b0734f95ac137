"""State that terminal and page share: one prompt, one status, one queue of pressed buttons; and the frames so far.

Both show the same state, and the first answer from either counts. The capture runs in the main thread and reads the
queue; keys, clicks and Ctrl-C all write to it.
"""

import itertools
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import suppress
from queue import Empty, SimpleQueue
from typing import Any, get_args

import numpy as np
from msgspec import Struct
from msgspec.structs import replace
from numpy.typing import NDArray

from faintfield.pipelines.live.board_progress import BoardFrame, BoardNews
from faintfield.pipelines.live.planes_client import LiveFrame
from faintfield.rig.cameras.protocol import Pixels
from faintfield.rig.capture.checks import LIT_KINDS
from faintfield.rig.capture.guide import Answer, OperatorRequest, Prompt, ShownFrame, Status, preparations
from faintfield.rig.plan import CaptureStep, PlannedFrame
from faintfield.rig.session.homings import Homed
from faintfield.rig.session.journal import CommittedFrame, RoundsEnded
from faintfield.rig.session.session import Session

REQUESTS: tuple[OperatorRequest, ...] = get_args(OperatorRequest.__value__)


class OpenPrompt(Struct, frozen=True):
    """A prompt that waits for its answer; `number` distinguishes it from earlier ones."""

    number: int
    prompt: Prompt


# Black and white of frames without light: so many standard deviations of a pixel below and above the median.
_BELOW, _ABOVE = 3.0, 6.0
# About so many pixels are enough for statistics of a frame.
_SAMPLES = 1_000_000


def sampled(pixels: Pixels) -> NDArray[np.float64]:
    """Return about a million pixels of a frame, one of an odd number each, which meets all colours of a mosaic."""
    return np.asarray(pixels.ravel()[:: max(1, pixels.size // _SAMPLES) | 1], float)


def _dark_scale_dn(pixels: Pixels) -> tuple[float, float]:
    """Return black and white for the frames of a step without light, of which this is the first."""
    samples = sampled(pixels)
    middle = float(np.median(samples))
    # The median deviation of a normal law is 0.6745 standard deviations; whole numbers may make it 0
    sigma = max(float(np.median(np.abs(samples - middle))) / 0.6745, 1.0)
    return middle - _BELOW * sigma, middle + _ABOVE * sigma


class CapturePanel:
    """The `OperatorInterface` of a capture; views show its state and press its buttons.

    If it is `unattended`, it gives every prompt its unattended answer; requests are still accepted. Prompt, status and
    frame to show are each replaced as a whole, so any thread may read them; then the functions `on_change` are called
    in the thread of the capture. The `outcome` is how the capture ended, and what comes next; None until then.
    """

    def __init__(self, *, unattended: bool) -> None:
        self.asked: OpenPrompt | None = None
        self.status: Status | None = None
        self.shown: ShownFrame | None = None
        self.outcome: str | None = None
        self._scale = -1, (0.0, 0.0)  # of which step, and its black and white
        self.on_change: list[Callable[[], None]] = []
        self.unattended = unattended
        # The word of each button or key, and the number of the prompt that it answers, if any
        self._pressed: SimpleQueue[tuple[str, int | None]] = SimpleQueue()
        self._numbers = itertools.count(1)

    def press(self, word: str, prompt: int | None = None) -> None:
        """Press a button, from any thread or a signal handler."""
        self._pressed.put((word, prompt))

    def ask(self, prompt: Prompt) -> Answer:
        """Show `prompt` and return the first answer to it."""
        if self.unattended:
            return prompt.unattended
        if any(word == "stop" for word, _ in self._waiting_presses()):
            return "stop"  # of the rest none was meant for this prompt
        self.asked = OpenPrompt(next(self._numbers), prompt)
        self._changed()
        while True:
            word, number = self._pressed.get()
            if word in prompt.answers and number in (None, self.asked.number):
                self.asked = None
                self._changed()
                return word

    def take_request(self) -> OperatorRequest | None:
        """Return the latest request since the last call, None if there is none."""
        latest: OperatorRequest | None = None
        for word, number in self._waiting_presses():
            if word in REQUESTS and number is None:
                latest = word
        return latest

    def _waiting_presses(self) -> Iterator[tuple[str, int | None]]:
        with suppress(Empty):
            while True:
                yield self._pressed.get_nowait()

    def show_status(self, status: Status) -> None:
        """Show the state of the capture."""
        self.status = status
        self._changed()

    def show_frame(self, shown: ShownFrame) -> None:
        """Show the frame just taken."""
        step, scale_dn = shown.frame.step, None
        if shown.frame.kind == "flat":  # a scale of its own would show unevenness as strong as that of a scene
            scale_dn = 0.0, max(float(sampled(shown.pixels).max()), 1.0)
        elif shown.frame.kind not in LIT_KINDS:
            scale_dn = self._scale[1] if self._scale[0] == step else _dark_scale_dn(shown.pixels)
            if shown.recorded:
                self._scale = step, scale_dn
        self.shown = replace(shown, scale_dn=scale_dn)
        self._changed()

    def end(self, outcome: str) -> None:
        """Show how the capture ended."""
        self.outcome = outcome
        self._changed()

    def _changed(self) -> None:
        for callback in self.on_change:
            callback()


class StepProgress(Struct, frozen=True):
    """A step of the plan, by its first frame: the numbers of its frames that are done, left out, and all.

    `rounds` is their number if the step ended before its last round, else None.
    """

    index: int
    first: PlannedFrame
    frames: str
    done: int
    skipped: int
    total: int
    rounds: int | None
    preparations: tuple[str, ...]


class SessionFrames:
    """The frames of an open session, whose capture goes on in another thread."""

    def __init__(self, session: Session) -> None:
        self._session = session
        self._homings: list[Homed] = []
        self._count = -1
        self._first = {frame.step: frame for frame in reversed(session.frames)}

    def steps(self) -> list[StepProgress]:
        """Return the steps of the plan."""
        frames, plan = self._session.frames, self._session.plan
        done = Counter(frames[number].step for number in list(self._session.valid()))
        total = Counter(frame.step for frame in self._session.wanted())
        skipped = Counter(frame.step for frame in self._session.skipped())
        return [
            StepProgress(
                index=index,
                first=self._first[index],
                frames=_describe_frames(step, len(plan.stops_of(step)), self._session.rounds_ended.get(index)),
                done=done[index],
                skipped=skipped[index],
                total=total[index],
                rounds=None if (ended := self._session.rounds_ended.get(index)) is None else ended.rounds,
                preparations=preparations(plan.steps, self._first[index]),
            )
            for index, step in enumerate(plan.steps)
        ]

    def values(self, step: int, name: str) -> list[float]:
        """Return a checked value of the valid frames of a step, in the order in which they were taken."""
        frames = sorted(self._session.valid().values(), key=lambda frame: frame.intent)
        return [
            frame.record.checks[name]
            for frame in frames
            if self._session.frames[frame.frame].step == step and name in frame.record.checks
        ]

    def at(self, step: int, node: tuple[int, int]) -> list[dict[str, Any]]:
        """Return the frames of a step at a node, in the order of the plan, as JSON objects."""
        return [
            {
                "name": planned.name,
                "position_mm": list(frame.record.position_mm),
                "exposure_s": frame.record.exposure_s,
                "written_s": self._written_s(frame),
            }
            for frame, planned in self._valid()
            if planned.step == step and planned.stop.node == node
        ]

    def of_boards(self) -> BoardNews:
        """Return the frames of the board sweeps in the order of the plan, and those that are left out."""
        homings = self._homings
        frames = tuple(
            BoardFrame(
                frame.frame,
                frame.intent,
                frame.file,
                max((homed.group for homed in homings if homed.first_intent <= frame.intent), default=0),
            )
            for frame, planned in self._valid()
            if planned.kind == "charuco"
        )
        return BoardNews(frames, tuple(frame.number for frame in self._session.skipped() if frame.kind == "charuco"))

    def note_homings(self) -> None:
        """Read from the journal which frames share a homing; called in the thread of the capture, whose journal it is.

        Nothing is read unless frames have come.
        """
        count = len(self._session.valid())
        if count != self._count:
            self._count, self._homings = count, self._session.journal.details("homed", Homed)

    def of_dark_scene(self) -> tuple[LiveFrame, ...]:
        """Return the frames of the dark scene, in the order of the plan."""
        return tuple(
            LiveFrame(frame.intent, frame.file, planned.stop.node, planned.exposure_s, planned.round)
            for frame, planned in self._valid()
            if planned.kind == "dark_scene"
        )

    def _valid(self) -> list[tuple[CommittedFrame, PlannedFrame]]:
        """Return the valid frames in the order of the plan."""
        # Sorting copies them in one step: the capture changes them meanwhile
        frames = sorted(self._session.valid().values(), key=lambda frame: frame.frame)
        return [(frame, self._session.frames[frame.frame]) for frame in frames]

    def _written_s(self, frame: CommittedFrame) -> float | None:
        """Return when the file of a frame was written, in s since 1970."""
        with suppress(OSError):
            return self._session.path_of(frame).stat().st_mtime
        return None


def _describe_frames(step: CaptureStep, stops: int, ended: RoundsEnded | None) -> str:
    """Return the frames of a step, such as `49 nodes, 10 x 0.1 s`."""
    place = "centre node" if step.at == "centre" else f"{stops} nodes" if stops > 1 else "1 node"
    repeats = f"{step.frames_per_node} x " if step.frames_per_node > 1 else ""
    until = step.until
    rounds = "" if until is None else f", at most {until.at_most_rounds} rounds, until σ is {until.sigma_e:g} e⁻"
    if ended is not None:
        sigma = "" if ended.sigma_e is None else f", σ is {ended.sigma_e:.3g} e⁻"
        rounds = f", rounds: {ended.rounds}{sigma}"
    return f"{place}, {repeats}{', '.join(f'{exposure_s:g}' for exposure_s in step.exposure_s)} s{rounds}"
