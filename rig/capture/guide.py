"""The experiment as a person is led through it: what to do before each step, and what can be answered."""

from collections.abc import Mapping
from typing import Literal, Protocol

from msgspec import Struct

from faintfield.rig.cameras.protocol import Pixels
from faintfield.rig.plan import StepKind
from faintfield.rig.session.frames import PlannedFrame

type Answer = Literal["go", "again", "keep", "retake", "skip", "stop"]
type Wish = Literal["pause", "skip", "retake", "stop"]

_TO_DO: dict[StepKind, tuple[str, ...]] = {
    "charuco": (
        "Put the boards in place, in view from every node, and let them stand still until this sweep is done.",
        "Turn the lights on.",
    ),
    "bright": (
        "Take the boards away and put the objects in place.",
        "Turn the lights on. Nothing may be moved from here until the dark-scene set is done.",
    ),
    "dark_scene": (
        "Lights out. Cover every lamp, screen and indicator; the objects stay where they are.",
        "Set the faint light for the scene, wait until your eyes are dark-adapted, and look for stray light.",
    ),
    "noise_reference": (
        "Take the objects out without touching the camera or the stage.",
        "Turn the faint light off: absolute dark.",
    ),
    "dark": ("Cover the lens. Cover the viewfinder too, if the camera has one.",),
    "flat": ("Uncover the lens and put an evenly lit diffuser right before it.",),
}
_TO_DO_AGAIN: dict[StepKind, tuple[str, ...]] = {
    "charuco": (
        "Move and turn the boards: nearer or farther, tilted another way, still in view from every node.",
        "Then let them stand still until this sweep is done.",
    ),
    "flat": ("Change the light on the diffuser, so that the frames become clearly brighter or darker.",),
}
_CHECK: dict[StepKind, str] = {
    "charuco": "Check that the corners found are many and that no frame is saturated.",
    "bright": "Check focus and that no frame is saturated.",
    "dark_scene": "Check that frames look empty: the scene shows only in the reconstruction.",
    "noise_reference": "Check that frames are even: a bright corner is stray light.",
    "dark": "Check that frames are even: a bright corner means that the cover leaks.",
    "flat": "Check that frames are even, bright, and not saturated.",
}
TITLES: dict[StepKind, str] = {
    "charuco": "Board sweep",
    "bright": "Bright set",
    "dark_scene": "Dark-scene set",
    "noise_reference": "Noise reference",
    "dark": "Dark frames",
    "flat": "Flat frames",
}


class Prompt(Struct, frozen=True):
    """A question to the operator.

    Parameters
    ----------
    key : str
        What it is about, for the journal: `home`, `step`, `paused`, `stage`, `camera`, `drift`, `skipped`.
    title : str
        A few words.
    lines : tuple of str
        What to do, what will happen, how long it takes, what to check.
    answers : tuple of str
        What can be answered; the first is the usual one.
    unattended : str
        The answer of a capture without a person (`--yes`).
    """

    key: str
    title: str
    lines: tuple[str, ...]
    answers: tuple[Answer, ...]
    unattended: Answer


class Status(Struct, frozen=True):
    """Where the capture stands.

    Parameters
    ----------
    doing : str
        What happens now, in a few words.
    step, steps : int
        The present step, from 1, and how many there are.
    title : str
        Of the present step.
    done, total : int
        Frames.
    to_go_s : float
        Time to go, prompts aside.
    node : (int, int), optional
        Where the stage is or goes.
    grid : tuple of tuple of float
        Per row and column, which share of this step's frames is done; −1 where it has none.
    warnings : tuple of str
        The latest.
    """

    doing: str
    step: int
    steps: int
    title: str
    done: int
    total: int
    to_go_s: float
    node: tuple[int, int] | None
    grid: tuple[tuple[float, ...], ...]
    warnings: tuple[str, ...]


class Operator(Protocol):
    """The person at the rig, by way of a terminal, a page, or answers given in advance."""

    def ask(self, prompt: Prompt) -> Answer:
        """Wait for an answer."""
        ...

    def wish(self) -> Wish | None:
        """Return what was asked for since the last call, without waiting."""
        ...

    def show_status(self, status: Status) -> None:
        """Show where the capture stands."""
        ...

    def show_frame(self, frame: PlannedFrame, pixels: Pixels, values: Mapping[str, float]) -> None:
        """Show the frame just taken."""
        ...


class Unattended:
    """Nobody: every prompt gets the answer that it has for this case."""

    def ask(self, prompt: Prompt) -> Answer:
        """Answer at once."""
        return prompt.unattended

    def wish(self) -> Wish | None:
        """Wish for nothing."""
        return None

    def show_status(self, status: Status) -> None:
        """Show nothing."""

    def show_frame(self, frame: PlannedFrame, pixels: Pixels, values: Mapping[str, float]) -> None:
        """Show nothing."""


def step_prompt(frame: PlannedFrame, step: int, steps: int, frames: int, duration_s: float) -> Prompt:
    """Return the question before a step.

    Parameters
    ----------
    frame : PlannedFrame
        Its first frame.
    step, steps : int
        Which step of how many, from 1.
    frames, duration_s : int, float
        How many frames are to be taken, and how long that takes.
    """
    title = TITLES[frame.kind] + (f" {frame.sweep + 1}" if frame.kind in ("charuco", "flat") else "")
    to_do = _TO_DO_AGAIN.get(frame.kind, _TO_DO[frame.kind]) if frame.sweep else _TO_DO[frame.kind]
    will = f"Then {frames} frames follow, {spoken_duration(duration_s)}. The stage moves by itself: keep clear of it."
    return Prompt(
        key="step",
        title=f"Step {step} of {steps}: {title}",
        lines=(*to_do, will, _CHECK[frame.kind]),
        answers=("go", "skip", "stop"),
        unattended="go",
    )


def spoken_duration(duration_s: float) -> str:
    """Return a duration as one says it."""
    if duration_s < 90:
        return f"about {max(1, round(duration_s))} s"
    minutes = round(duration_s / 60)
    return f"about {minutes} min" if minutes < 90 else f"about {minutes // 60} h {minutes % 60:02d} min"
