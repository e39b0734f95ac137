"""List the frames of a plan in the order in which they are taken."""

from collections import Counter

from msgspec import Struct

from faintfield.rig.plan import CapturePlan, StepKind, Stop


class PlannedFrame(Struct, frozen=True):
    """One frame that the plan asks for.

    Parameters
    ----------
    number : int
        Index in the plan.
    step : int
        Index of its step in the plan.
    kind : str
        Kind of that step.
    sweep : int
        Number of earlier steps of the same kind: the sweep of a board, the light level of a flat.
    stop : Stop
        Node and position of the stage.
    exposure_s : float
        Exposure time in s.
    repeat : int
        Index among the frames of the same exposure time at the same stop.
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
        """Name of the frame in messages, and the beginning of its file name."""
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
