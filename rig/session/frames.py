"""The frames of a plan, one by one, in the order in which they are taken."""

from collections import Counter

from msgspec import Struct

from faintfield.rig.plan import CapturePlan, StepKind, Stop


class PlannedFrame(Struct, frozen=True):
    """One frame that the plan asks for.

    Parameters
    ----------
    number : int
        Its place in the plan.
    step : int
        Which of the plan's steps it belongs to.
    kind : str
        The kind of that step.
    sweep : int
        How many steps of the same kind come before: the sweep of a board, the level of a flat.
    stop : Stop
        Node and position.
    exposure_s : float
        Exposure time.
    repeat : int
        Which of the frames of the same exposure at the same stop.
    """

    number: int
    step: int
    kind: StepKind
    sweep: int
    stop: Stop
    exposure_s: float
    repeat: int

    @property
    def name(self) -> str:
        """What it is called in messages, and how its file's name begins."""
        row, column = self.stop.node
        return f"{self.number:05d}_{self.kind}_{self.sweep}_r{row}_c{column}"


def planned_frames(plan: CapturePlan) -> tuple[PlannedFrame, ...]:
    """Return all frames of `plan`, in order."""
    frames: list[PlannedFrame] = []
    seen: Counter[StepKind] = Counter()
    for index, step in enumerate(plan.steps):
        first = len(frames)
        frames.extend(
            PlannedFrame(first + offset, index, step.kind, seen[step.kind], stop, exposure_s, repeat)
            for offset, (stop, exposure_s, repeat) in enumerate(
                (stop, exposure_s, repeat)
                for stop in plan.stops_of(step)
                for exposure_s in step.exposure_s
                for repeat in range(step.frames_per_node)
            )
        )
        seen[step.kind] += 1
    return tuple(frames)
