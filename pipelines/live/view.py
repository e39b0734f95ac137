"""Content of the views of a capture, terminal and page: everything that they show is declared here once."""

import itertools
from collections.abc import Callable, Sequence
from typing import Literal

import numpy as np
from msgspec import Struct

from faintfield.pipelines.live.board_progress import BoardProgress
from faintfield.pipelines.live.boards_client import BoardsClient
from faintfield.pipelines.live.light_meter import LightMeter, LightReading
from faintfield.pipelines.live.panel import REQUESTS, CapturePanel, SessionFrames, sampled
from faintfield.pipelines.live.planes_client import LiveStatus, PlanesClient
from faintfield.pipelines.planning.known import Sensor
from faintfield.rig.capture.checks import LIT_KINDS, MAIN_QUANTITIES, QUANTITIES, Limit, Quantity
from faintfield.rig.capture.guide import Answer, OperatorRequest, Prompt, ShownFrame, Status, format_duration, step_name

_LABELS: dict[Answer | OperatorRequest, str] = {
    "go": "go on",
    "test": "test frame",
    "again": "try again",
    "keep": "keep as it is",
    "retake": "take last again",
    "skip": "skip frame",
    "finish": "finish after this round",
    "stop": "stop",
    "pause": "pause",
}
# The same in prompts of a key.
_LABELS_IN_PROMPTS: dict[tuple[str, str | None], str] = {("skip", "step"): "skip step", ("go", "home"): "home"}
KEYS: dict[Answer | OperatorRequest, str] = {
    "go": "g",
    "test": "t",
    "again": "a",
    "keep": "k",
    "retake": "r",
    "skip": "s",
    "finish": "f",
    "stop": "q",
    "pause": "p",
}


def button_label(word: Answer | OperatorRequest, prompt: Prompt | None) -> str:
    """Return the label of a button: an answer to a prompt, or a request without one."""
    key = None if prompt is None else prompt.key
    return _LABELS_IN_PROMPTS.get((word, key), _LABELS[word])


_HISTOGRAM_BINS = 64
# Range of the histogram of a frame without light, beyond its black and white, in parts of their distance.
_BEYOND = 0.25
# A course over a step has at most so many points, each the mean of as many frames.
_MAX_POINTS = 240


class CheckRow(Struct, frozen=True):
    """A check of a frame in words; `low` is a value that is no fault of a single frame."""

    label: str
    value: str
    limit: str
    verdict: Literal["pass", "fail", "low", ""]


class Mark(Struct, frozen=True):
    """A range of pixel values that is marked in a histogram; both ends are the same for a single value."""

    label: str
    low_dn: float
    high_dn: float


class Histogram(Struct, frozen=True):
    """Logarithmic heights of equal bins over a range of pixel values; the outer bins have all pixels beyond it."""

    low_dn: float
    high_dn: float
    heights: tuple[float, ...]
    marks: tuple[Mark, ...]


class FrameView(Struct, frozen=True):
    """The last frame, without its picture; each has another `version`.

    `size_px` is its width and height, `scale` black and white in words.
    """

    version: int
    name: str
    title: str
    step: int
    recorded: bool
    size_px: tuple[int, int]
    checks: tuple[CheckRow, ...]
    histogram: Histogram
    temperature: str
    scale: str


class Course(Struct, frozen=True):
    """A quantity over the frames of a step, so many per point, the last one in words, and its limit."""

    label: str
    values: tuple[float, ...]
    last: str
    frames_per_point: int
    limit: float | None


class StepRow(Struct, frozen=True):
    """A step of the plan: what is taken, how much of it is done, how long the rest takes, and what to prepare."""

    number: int
    title: str
    state: Literal["done", "now", "next", "to do", "left out"]
    frames: str
    done: int
    total: int
    to_go: str
    prepare: tuple[str, ...]


class Button(Struct, frozen=True):
    """A button with its word for `CapturePanel.press`, its label and its key."""

    word: Answer | OperatorRequest
    label: str
    key: str


class PlanesView(Struct, frozen=True):
    """Live planes: how their process ended, if it did, the frames that it was told of, its silence in s, its state."""

    ended: str | None
    offered: int
    silence_s: int
    status: LiveStatus | None


class BoardsView(Struct, frozen=True):
    """Board sweeps: how the process that follows them ended, if it did, the poses in words, and the progress."""

    ended: str | None
    poses: str
    progress: BoardProgress | None


class PageState(Struct, frozen=True):
    """Everything that the page shows, except pictures; `prompt` is the number of the open prompt."""

    title: str
    mode: Literal["waiting", "failed", "running", "ended"]
    prompt: int | None
    lines: tuple[str, ...]
    buttons: tuple[Button, ...]
    plan: tuple[StepRow, ...]
    status: Status | None
    to_go: str
    frame: FrameView | None
    courses: tuple[Course, ...]
    light: LightReading | None
    boards: BoardsView | None
    planes: PlanesView | None
    outcome: str | None


class CaptureView:
    """The state of a capture for its page: of the panel, session, live planes, board sweeps and light meter.

    What takes longer is computed again only when frame or status have changed.
    """

    def __init__(
        self,
        panel: CapturePanel,
        session: SessionFrames | None = None,
        planes: PlanesClient | None = None,
        boards: BoardsClient | None = None,
        meter: LightMeter | None = None,
    ) -> None:
        self.panel, self.session, self.planes, self._boards, self._meter = panel, session, planes, boards, meter
        self._versions = itertools.count(1)
        self._frame = _Memory[FrameView]()
        self._plan = _Memory[tuple[StepRow, ...]]()
        self._courses = _Memory[tuple[Course, ...]]()

    def state(self) -> PageState:
        """Return the content of the page now."""
        panel, session = self.panel, self.session
        asked, status, shown, outcome = panel.asked, panel.status, panel.shown, panel.outcome
        prompt = None if asked is None else asked.prompt
        words: Sequence[Answer | OperatorRequest] = REQUESTS if prompt is None else prompt.answers
        sensor = None if self._meter is None else self._meter.sensor
        frame: FrameView | None = None
        courses: tuple[Course, ...] = ()
        if shown is not None:
            frame = self._frame.get((shown, sensor), lambda: frame_view(shown, sensor, next(self._versions)))
            if session is not None:
                courses = self._courses.get((shown, status), lambda: _courses(session, shown))
        homing = prompt is not None and prompt.key == "home"
        return PageState(
            title=outcome or (prompt.title if prompt else status.title if status else "Connecting to stage and camera"),
            mode=_mode(outcome, prompt),
            prompt=None if asked is None else asked.number,
            lines=() if prompt is None else prompt.lines,
            buttons=() if outcome else tuple(Button(word, button_label(word, prompt), KEYS[word]) for word in words),
            plan=() if session is None else self._plan.get((status, asked), lambda: step_rows(session, status, homing)),
            status=status,
            to_go="" if status is None else format_duration(status.to_go_s),
            frame=frame,
            courses=courses,
            light=None if shown is None or self._meter is None else self._meter.read(shown),
            boards=None if self._boards is None else _boards(self._boards),
            planes=None if self.planes is None else _planes(self.planes),
            outcome=outcome,
        )


def _mode(outcome: str | None, prompt: Prompt | None) -> Literal["waiting", "failed", "running", "ended"]:
    if outcome is not None:
        return "ended"
    if prompt is None:
        return "running"
    return "failed" if prompt.key in ("stage", "camera", "light", "drift") else "waiting"


class _Memory[T]:
    """The last result of a computation, kept while its inputs are the same objects."""

    def __init__(self) -> None:
        self._last: tuple[tuple[object, ...], T] | None = None

    def get(self, inputs: tuple[object, ...], compute: Callable[[], T]) -> T:
        if self._last is None or any(old is not new for old, new in zip(self._last[0], inputs, strict=True)):
            self._last = inputs, compute()
        return self._last[1]


def _planes(planes: PlanesClient) -> PlanesView:
    return PlanesView(planes.failure(), planes.frame_count(), round(planes.silence_s()), planes.status)


def _boards(boards: BoardsClient) -> BoardsView:
    progress = boards.progress
    return BoardsView(boards.failure(), "" if progress is None else progress.poses, progress)


def step_rows(session: SessionFrames, status: Status | None, homing: bool = False) -> tuple[StepRow, ...]:
    """Return the steps of the plan; none is under way while the stage is homed before the first."""
    present = None if status is None or homing else status.step - 1
    rows: list[StepRow] = []
    has_next = False
    for step in session.steps():
        done, total = (
            step.done,
            step.total if status is None or not status.step_frames else status.step_frames[step.index],
        )
        state: Literal["done", "now", "next", "to do", "left out"] = "to do"
        if done == total:
            state = "done"
        elif step.index == present:
            state = "now"
        elif done + step.skipped >= total:  # of rounds that are not expected, too
            state = "left out"
        elif not has_next:
            state, has_next = "next", True
        to_go_s = status.step_to_go_s[step.index] if status is not None and status.step_to_go_s else 0.0
        to_go = format_duration(to_go_s) if to_go_s and state not in ("done", "left out") else ""
        title = step_name(step.first) + ("" if step.rounds is None else f", rounds: {step.rounds}")
        rows.append(StepRow(step.index + 1, title, state, step.frames, done, total, to_go, step.preparations))
    return tuple(rows)


def check_rows(shown: ShownFrame) -> tuple[CheckRow, ...]:
    """Return the checks of a frame in words, in the order of `QUANTITIES`; unknown ones by their names, at the end."""
    findings = shown.findings
    names = [name for name in QUANTITIES if name in findings.values]
    names += [name for name in findings.values if name not in QUANTITIES]
    return tuple(_check_row(name, findings.values[name], findings.limits.get(name)) for name in names)


def _check_row(name: str, value: float, limit: Limit | None) -> CheckRow:
    quantity = QUANTITIES.get(name, Quantity(name, "", "g"))
    if limit is None:
        return CheckRow(quantity.label, quantity.text(value), "", "")
    words = f"at {'least' if limit.is_least else 'most'} {quantity.text(limit.value)}"
    verdict: Literal["pass", "fail", "low"] = "fail" if quantity.warning else "low"
    return CheckRow(quantity.label, quantity.text(value), words, "pass" if limit.holds(value) else verdict)


def frame_view(shown: ShownFrame, sensor: Sensor | None, version: int) -> FrameView:
    """Return name, checks and histogram of a frame."""
    frame = shown.frame
    height, width = shown.pixels.shape[:2]
    return FrameView(
        version=version,
        name=frame.name if shown.recorded else "test frame, not recorded",
        title=f"Step {frame.step + 1}: {step_name(frame)}, {frame.exposure_s:g} s",
        step=frame.step + 1,
        recorded=shown.recorded,
        size_px=(width, height),
        checks=check_rows(shown),
        histogram=_histogram(shown, sensor),
        temperature="" if shown.temperature_c is None else f"{shown.temperature_c:.1f} °C",
        scale=describe_scale(shown),
    )


def describe_scale(shown: ShownFrame) -> str:
    """Return black and white of the picture of a frame in words."""
    if shown.scale_dn is None:
        return "shown from its darkest to its brightest values"
    return "black {:.0f} DN, white {:.0f} DN in this step".format(*shown.scale_dn)


def _histogram(shown: ShownFrame, sensor: Sensor | None) -> Histogram:
    """Return the histogram of a frame: up to saturation, or of dark frames about their black and white."""
    samples = sampled(shown.pixels)
    findings, marks = shown.findings, []
    if shown.frame.kind in LIT_KINDS:
        low, high = min(0.0, float(samples.min())), findings.saturation_dn or max(float(samples.max()), 1.0)
        if findings.saturation_dn is not None:
            marks.append(Mark(f"saturation {findings.saturation_dn:.0f} DN", high, high))
    else:
        black, white = shown.scale_dn or (float(samples.min()), float(samples.max()) + 1.0)
        low, high = black - _BEYOND * (white - black), white + _BEYOND * (white - black)
        if (offset := _offset_dn(sensor)) is not None:
            level, noise = offset
            marks.append(Mark(f"offset {level:.0f} ± read noise {noise:.1f} DN", level - noise, level + noise))
            low, high = min(low, level - 2 * noise), max(high, level + 2 * noise)
    median = findings.values.get("median_dn")
    if median is not None:
        marks.append(Mark(f"median {median:.0f} DN", median, median))
    if "median_dn" in findings.limits:
        least = findings.limits["median_dn"].value
        marks.append(Mark(f"least median {least:.0f} DN", least, least))
    counts, _ = np.histogram(np.clip(samples, low, high), bins=_HISTOGRAM_BINS, range=(low, high))
    heights = np.log1p(counts) / max(float(np.log1p(counts).max()), 1.0)
    return Histogram(low, high, tuple(heights.round(3).tolist()), tuple(marks))


def _offset_dn(sensor: Sensor | None) -> tuple[float, float] | None:
    """Return the offset and the read noise of a sensor in DN, None if they are not known."""
    if sensor is None:
        return None
    offset, read_noise_e, gain = sensor.offset_dn(), sensor.read_noise_e.value, sensor.gain_dn_per_e.value
    return None if offset is None or read_noise_e is None or gain is None else (offset, read_noise_e * gain)


def _courses(session: SessionFrames, shown: ShownFrame) -> tuple[Course, ...]:
    """Return the course of the main quantities over the step of a frame."""
    courses = []
    for name in MAIN_QUANTITIES[shown.frame.kind]:
        quantity, limit = QUANTITIES[name], shown.findings.limits.get(name)
        values = session.values(shown.frame.step, name)
        count = -(-len(values) // _MAX_POINTS) or 1
        points = [quantity.factor * float(np.mean(values[i : i + count])) for i in range(0, len(values), count)]
        limit_value = None if limit is None else quantity.factor * limit.value
        last = quantity.text(values[-1]) if values else ""
        courses.append(Course(quantity.label, tuple(points), last, count, limit_value))
    return tuple(courses)
