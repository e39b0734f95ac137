"""Guide the operator through a capture: what to do before each step, questions, answers, warnings, remaining time."""

from collections import Counter, defaultdict
from collections.abc import Sequence
from statistics import median
from typing import TYPE_CHECKING, Literal, NoReturn, Protocol

from msgspec import Struct

from faintfield.rig.cameras.protocol import Pixels
from faintfield.rig.capture.checks import Findings
from faintfield.rig.capture.rounds import NoisePredictor, Progress, Rounds
from faintfield.rig.clock import Clock
from faintfield.rig.errors import CaptureStopped
from faintfield.rig.plan import CapturePlan, CaptureStep, PlannedFrame, StepKind
from faintfield.rig.session.journal import RoundsEnded
from faintfield.rig.session.session import Session
from faintfield.rig.stages.gantry import Gantry
from faintfield.rig.stages.motion import one_sided_duration_s
from faintfield.rig.stages.protocol import Point, StageSettings

if TYPE_CHECKING:  # views of a capture need no drivers
    from faintfield.rig.devices import Rig

type Answer = Literal["go", "test", "again", "keep", "retake", "skip", "finish", "stop"]
type OperatorRequest = Literal["pause", "skip", "retake", "stop"]

_TO_DO: dict[StepKind, tuple[str, ...]] = {
    "charuco": (
        "Put the boards in place, in view from every node, at least in part, and do not touch them until this sweep is "
        "done.",
        "Turn the lights on.",
    ),
    "bright": (
        "Take the boards away and put the objects in place.",
        "Turn the lights on. From here on, move nothing until the dark-scene set is done.",
    ),
    "dark_scene": (
        "Lights out. Cover every lamp, every indicator and all screens but this one, which you dim and turn away from "
        "the scene. The objects stay where they are.",
        "Set the faint light for the scene, wait until your eyes are dark-adapted, and look for stray light.",
    ),
    "noise_reference": (
        "Look at the planes first: once the objects are moved, no frame of the dark scene can be taken again.",
        "Take the objects out without touching the camera or the stage.",
        "Turn the faint light off: absolute dark.",
    ),
    "dark": ("Cover the lens. Cover the viewfinder too, if the camera has one.",),
    "flat": ("Uncover the lens and put an evenly lit diffuser right before it.",),
}
_TO_DO_AGAIN: dict[StepKind, tuple[str, ...]] = {
    "charuco": (
        "Move and turn the boards: nearer or farther, tilted another way, still in view from every node, at least in "
        "part.",
        "Then do not touch them until this sweep is done.",
    ),
    "flat": ("Change the light on the diffuser, so that the frames become clearly brighter or darker.",),
}
# The same where the rig switches the lights: what is left to be done by hand.
_TO_DO_BUT_LIGHTS: dict[StepKind, tuple[str, ...]] = {
    "charuco": _TO_DO["charuco"][:1],
    "flat": ("Put a diffuser right before the lens.",),
}
_OBJECTS = "Take boards and diffuser away, and put the objects in place. From here on, move nothing."
_CHECK: dict[StepKind, str] = {
    "charuco": "Check that many corners are found and that no frame is saturated.",
    "bright": "Check focus and that no frame is saturated.",
    "dark_scene": "Check the SNR of each frame, and that stray light stays near 0 DN. Black and white are fixed: the "
    "scene hardly shows before it is reconstructed.",
    "noise_reference": "Check that frames are even: a bright corner is stray light.",
    "dark": "Check that frames are even: a bright corner means that the cover leaks.",
    "flat": "Check that frames are even, bright, and not saturated.",
}
_TEST: dict[StepKind, str] = {
    "charuco": "A test frame shows whether the boards are sharp and well lit.",
    "bright": "A test frame shows whether the objects are sharp and well lit.",
    "dark_scene": "A test frame measures the light: set the lamp, and take another until it is as planned.",
    "noise_reference": "A test frame is to be even, and shows no more than noise.",
    "dark": "A test frame is to be even, and shows no more than noise.",
    "flat": "A test frame is to be even and bright, and nowhere saturated.",
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
    """A question to the operator, whose usual answer comes first; a capture without a person gives `unattended`.

    The journal knows it by its key: `home`, `step`, `paused`, `stage`, `camera`, `light`, `drift` or `skipped`.
    """

    key: str
    title: str
    lines: tuple[str, ...]
    answers: tuple[Answer, ...]
    unattended: Answer


class Status(Struct, frozen=True):
    """State of the capture, whose present step is the one of number `step`, from 1.

    `done` of `total` frames are taken; the rest takes `to_go_s` without prompts. `node` is where the stage is or goes,
    and `grid` has the share of the frames of this step and round that is done, per row and column; −1 where there are
    none. `stage` and `camera` are their states in words. Each step has `step_frames`, of which the missing ones take
    `step_to_go_s`. `round` is the number of the present round, and `rounds` says how far a step in rounds is, else it
    is empty; rounds that are not expected do not count.
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
    stage: str = ""
    camera: str = ""
    step_to_go_s: tuple[float, ...] = ()
    step_frames: tuple[int, ...] = ()
    rounds: str = ""
    round: int = 1


class ShownFrame(Struct, frozen=True, eq=False):
    """A frame just taken, what was found in it, and the temperature of the sensor if the camera reports it.

    Unless `recorded` it is a test frame, taken as `frame` will be. `scale_dn` is black and white of its picture if they
    stay the same in its step, else None. Each is equal to itself alone.
    """

    frame: PlannedFrame
    pixels: Pixels
    findings: Findings
    temperature_c: float | None = None
    recorded: bool = True
    scale_dn: tuple[float, float] | None = None


class OperatorInterface(Protocol):
    """Connects a capture to the person at the rig: by terminal, by page, or by answers given in advance."""

    def ask(self, prompt: Prompt) -> Answer:
        """Return the answer to a prompt, waiting for it."""

    def take_request(self) -> OperatorRequest | None:
        """Return the latest request since the last call, without waiting."""

    def show_status(self, status: Status) -> None:
        """Show the state of the capture."""

    def show_frame(self, shown: ShownFrame) -> None:
        """Show the frame just taken."""


# Steps with something before the lens that a person puts in place, and takes away.
BY_HAND: frozenset[StepKind] = frozenset({"charuco", "flat"})


def needs_hand(step: CaptureStep, before: StepKind | None) -> bool:
    """Return whether something has to be done by hand before a step, with the kind of the frames taken `before` it.

    A person sees to the lights unless the rig does, puts boards and diffusers in place, and takes them away.
    """
    return step.lights is None or step.kind in BY_HAND or before in BY_HAND


def step_prompt(
    steps: Sequence[CaptureStep], frame: PlannedFrame, frames: tuple[int, int], duration_s: float
) -> Prompt:
    """Return the prompt before a step that begins with `frame`.

    `frames` are those that are expected, and take `duration_s`, and how many there are at most.
    """
    test = f"{_TEST[frame.kind]} It is taken where the step begins, and not recorded."
    until, (expected, most) = steps[frame.step].until, frames
    sequence = f"Then {expected} frames follow, {format_duration(duration_s)}."
    if until is not None:
        sequence = f"Then rounds over the grid follow until the noise of the planes is {until.sigma_e:g} e⁻: "
        sequence += f"probably {expected} frames, at most {most}, {format_duration(duration_s)}."
    motion = f"{sequence} The stage moves by itself: keep clear of it."
    return Prompt(
        key="step",
        title=_step_title(frame, len(steps)),
        lines=(*_to_do(steps[frame.step], frame), test, motion, _CHECK[frame.kind]),
        answers=("go", "test", "skip", "stop"),
        unattended="go",
    )


def preparations(steps: Sequence[CaptureStep], frame: PlannedFrame) -> tuple[str, ...]:
    """Return what to do by hand before the step of a frame; of lights only where the rig does not switch them."""
    before = steps[frame.step - 1].kind if frame.step else None
    return _to_do(steps[frame.step], frame) if needs_hand(steps[frame.step], before) else ()


def _to_do(step: CaptureStep, frame: PlannedFrame) -> tuple[str, ...]:
    if step.lights is not None and not (frame.sweep and frame.kind == "charuco"):
        return _TO_DO_BUT_LIGHTS.get(frame.kind, (_OBJECTS,))
    return _TO_DO_AGAIN.get(frame.kind, _TO_DO[frame.kind]) if frame.sweep else _TO_DO[frame.kind]


def step_name(frame: PlannedFrame) -> str:
    """Return the name of the step of a frame, such as `Board sweep 2`."""
    return TITLES[frame.kind] + (f" {frame.sweep + 1}" if frame.kind in ("charuco", "flat") else "")


def _step_title(frame: PlannedFrame, steps: int) -> str:
    return f"Step {frame.step + 1} of {steps}: {step_name(frame)}"


def format_duration(duration_s: float) -> str:
    """Return a duration rounded to s, min, or h and min, such as `about 2 h 05 min`."""
    if duration_s < 90:
        return f"about {max(1, round(duration_s))} s"
    minutes = round(duration_s / 60)
    return f"about {minutes} min" if minutes < 90 else f"about {minutes // 60} h {minutes % 60:02d} min"


def describe_progress(progress: Progress, to_go_s: float, ended: RoundsEnded | None = None) -> str:
    """Return how far a step in rounds is, such as `σ now 0.21 e⁻, wanted 0.1: 3 more rounds, about 41 min`."""
    until, more = progress.until, progress.wanted - progress.whole - progress.begun
    wanted = f"wanted {until.sigma_e:g}"
    if ended is not None:
        rounds = _count_rounds(ended.rounds)
        return rounds if ended.sigma_e is None else f"σ {ended.sigma_e:.3g} e⁻ after {rounds}, {wanted}"
    if progress.final_e is None:
        return f"σ is not known until a frame shows the light, {wanted} e⁻; at most {_count_rounds(progress.most)}"
    parts = [] if progress.sigma_e is None else [f"now {progress.sigma_e:.3g} e⁻"]
    if progress.final_e > until.sigma_e:
        parts.append(f"{progress.final_e:.3g} e⁻ at the end")
    parts.append(wanted + ", reached" * progress.reached)
    rest = [f"the rest of round {progress.whole + 1}"] if progress.begun else []
    rest += [f"{more} more {'round' if more == 1 else 'rounds'}"] if more > 0 else []
    time = f", {format_duration(to_go_s)}" if rest else ""
    return f"σ {', '.join(parts)}: {' and '.join(rest) or 'no more rounds'}{time}"


def _count_rounds(rounds: int) -> str:
    return "1 round" if rounds == 1 else f"{rounds} rounds"


def describe_rounds(ended: RoundsEnded) -> str:
    """Return how a step in rounds ended, such as `step 4 ended after 3 rounds, at a predicted σ of 0.098 e⁻`."""
    rounds = _count_rounds(ended.rounds)
    noise = "" if ended.sigma_e is None else f", at a predicted σ of {ended.sigma_e:.3g} e⁻"
    return f"step {ended.step + 1} ended after {rounds}{noise}{', by the operator' * ended.by_operator}"


def describe_frame_count(plan: CapturePlan) -> str:
    """Return the number of frames of a plan, such as `570 frames`; of one in rounds `at most 570 frames`."""
    most = "at most " if any(step.until is not None for step in plan.steps) else ""
    return f"{most}{plan.frame_count()} frames"


def format_capture_duration(duration_s: float, stage: StageSettings) -> str:
    """Return the duration of a capture without prompts, and by which clock if the stage is simulated."""
    clock = " by the simulated stage's clock, far less by yours" if stage.simulated else ""
    return f"{format_duration(duration_s)} without prompts{clock}"


# Time in s of a stop besides motion and rest, and of a frame besides exposure and readout, until one has been measured:
# two status reports, and writing a file.
_STOP_S, _FRAME_S = 0.15, 0.2


class Pace:
    """Tracks where the stage is (`here`), and learns how long a stop, a frame and a drift check (`check_s`) take.

    The rest at a stop, `rest_s` by the kind of step, is at first the planned one. So is the time of a frame besides its
    exposure.
    """

    def __init__(self, stage: Gantry, clock: Clock, rest_s: float, readout_s: float) -> None:
        self._stage = stage
        self._clock = clock
        self._stop_s: list[float] = []
        self._frame_s: dict[bool, list[float]] = {False: [], True: []}
        self._guess_s = _FRAME_S + readout_s
        self.rest_s = dict.fromkeys(TITLES, rest_s)
        self._departed_s = 0.0
        self._start: Point | None = None
        self.here: Point | None = None
        self.check_s = 0.0

    def depart(self) -> None:
        """Note that the stage leaves its position."""
        self._departed_s, self._start = self._clock.now_s(), self.here
        self.here = None

    def arrive(self, target: Point, kind: StepKind, *, timed: bool) -> None:
        """Note that the stage is at rest at `target`; learn from the time it took if `timed`."""
        if timed and self._start is not None:
            known_s = self._motion_s(self._start, target) + self.rest_s[kind]
            self._stop_s.append(self._clock.now_s() - self._departed_s - known_s)
        self.here = target

    def finish_frame(self, begun_s: float, exposure_s: float, *, repeated: bool) -> None:
        """Note that a frame that was begun at `begun_s` is committed.

        The first frame at a stop is told from the next ones, which are faster: a controller that was just asked for its
        position is not asked again at once.
        """
        self._frame_s[repeated].append(self._clock.now_s() - begun_s - exposure_s)

    def remaining_s(self, frames: list[PlannedFrame], drift_checks: int) -> float:
        """Return how long `frames`, in this order, and a number of drift checks will take, without prompts."""
        return sum(self.step_durations_s(frames).values()) + drift_checks * self.check_s

    def step_durations_s(self, frames: list[PlannedFrame]) -> dict[int, float]:
        """Return how long `frames`, in this order, will take in each step, without prompts and drift checks."""
        stop_s = median(self._stop_s or [_STOP_S])
        first_s = median(self._frame_s[False] or [self._guess_s])
        again_s = median(self._frame_s[True] or [first_s])
        steps_s: defaultdict[int, float] = defaultdict(float)
        here, last_step = self.here, None
        for frame in frames:
            target = frame.stop.target
            arrives = target != here or frame.step != last_step
            if arrives:
                steps_s[frame.step] += stop_s + self.rest_s[frame.kind]
                steps_s[frame.step] += self._motion_s(here, target) if here is not None else 0.0
            steps_s[frame.step] += frame.exposure_s + (first_s if arrives else again_s)
            here, last_step = target, frame.step
        return steps_s

    def _motion_s(self, start: Point, target: Point) -> float:
        stage = self._stage
        return one_sided_duration_s(
            start, target, stage.settings.approach_mm, stage.identify().motion, stage.feed_mm_per_s()
        )


# Without an operator, a capture stops after this many failures in a row at one frame, or failed drift checks in all.
MAX_UNATTENDED_TRIES = 3


class Dialogue:
    """The capture's side of the conversation with the operator, which the journal of the session keeps.

    `pace` estimates the remaining time, and `rounds` how many rounds are needed. Shown with the status are the latest
    `warnings`, and the states of `stage` and `camera` in words.
    """

    def __init__(
        self, session: Session, rig: "Rig", operator: OperatorInterface, noise: NoisePredictor | None = None
    ) -> None:
        self.session = session
        self.rounds = Rounds(session, noise)
        self.rig = rig
        self.pace = Pace(rig.stage, rig.clock, session.plan.settle_s, session.plan.readout_s)
        self.operator = operator
        self.warnings: tuple[str, ...] = ()
        self.stage = self.camera = "not connected"

    def ask(self, prompt: Prompt) -> Answer:
        """Ask the operator, and record question and answer."""
        answer = self.operator.ask(prompt)
        self.session.journal.event("prompt", key=prompt.key, title=prompt.title, lines=prompt.lines, answer=answer)
        return answer

    def ask_or_stop(self, prompt: Prompt) -> Answer:
        """Ask the operator as `ask` does; raise `CaptureStopped` if the answer is to stop."""
        answer = self.ask(prompt)
        if answer == "stop":
            self.stop()
        return answer

    def warn(self, text: str) -> None:
        """Record a warning, and show it from now on."""
        self.session.journal.event("warning", message=text)
        self.warnings = (text,)

    def stop(self) -> NoReturn:
        """Raise `CaptureStopped` on behalf of the operator."""
        self.session.journal.event("stopped")
        done, total = len(self.session.valid()), len(self.session.wanted())
        raise CaptureStopped(f"stopped with {done} of {total} frames taken; run the same command to go on")

    def show_status(self, frame: PlannedFrame, doing: str, recording: PlannedFrame | None = None) -> None:
        """Show the state of the capture, which is `doing` something for `frame`, while another one is recorded."""
        session = self.session
        expected = self.rounds.expected(session.wanted())
        open_numbers = {left.number for left in session.missing() if left != recording}
        missing = [left for left in expected if left.number in open_numbers]
        frames_of_step = Counter(each.step for each in expected)
        steps, progress = session.plan.steps, self.rounds.progress(frame.step)
        steps_s = self.pace.step_durations_s(missing)
        if session.frozen.rig.drift.check:
            for step, _ in {(left.step, left.round) for left in missing if steps[left.step].at == "grid"}:
                steps_s[step] += self.pace.check_s
        status = Status(
            doing=doing,
            step=frame.step + 1,
            steps=len(steps),
            title=_step_title(frame, len(steps)),
            done=len(session.valid()),
            total=len(expected),
            to_go_s=sum(steps_s.values()),
            node=frame.stop.node,
            grid=self._shares_done(frame),
            warnings=self.warnings,
            stage=self.stage,
            camera=self.camera,
            step_to_go_s=tuple(steps_s.get(step, 0.0) for step in range(len(steps))),
            step_frames=tuple(frames_of_step[step] for step in range(len(steps))),
            round=frame.round + 1,
            rounds=""
            if progress is None
            else describe_progress(progress, steps_s.get(frame.step, 0.0), session.rounds_ended.get(frame.step)),
        )
        self.operator.show_status(status)

    def _shares_done(self, now: PlannedFrame) -> tuple[tuple[float, ...], ...]:
        """Return the share of the frames of a step and round that is done, per row and column; −1 where it has none."""
        grid, valid = self.session.frozen.rig.grid, self.session.valid()
        done: defaultdict[tuple[int, int], list[bool]] = defaultdict(list)
        for frame in self.session.frames:
            if (frame.step, frame.round) == (now.step, now.round):
                done[frame.stop.node].append(frame.number in valid)
        nodes = [[done.get((row, column)) for column in range(grid.columns)] for row in range(grid.rows)]
        return tuple(tuple(sum(frames) / len(frames) if frames else -1.0 for frames in row) for row in nodes)
