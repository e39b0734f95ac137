"""Are the boards in view? Judged by whole sweeps: one view that sees little of one board does no harm."""

from collections.abc import Mapping, Sequence

from faintfield.rig.session.frames import PlannedFrame

# So many frames without a board are no accident of where the grid begins.
_FIRST_FRAMES = 3
_POOR_SHARE = 0.5
_MOST_NAMED = 6


def board_doubts(
    last: PlannedFrame, frames: Sequence[PlannedFrame], corners: Mapping[int, int], limit: int
) -> tuple[str, ...]:
    """Return what is wrong with the boards as far as they were seen, right after a frame was taken.

    Something is said when the first frames of a sweep all show too little, when half of a sweep did, and when after all
    sweeps there is a node that no board was seen from, whose pose therefore cannot be found.

    Parameters
    ----------
    last : PlannedFrame
        The frame just taken.
    frames : sequence of PlannedFrame
        All of the plan.
    corners : mapping of int to int
        Board corners found, by the numbers of the frames taken.
    limit : int
        Fewest that are enough.
    """
    boards = [frame for frame in frames if frame.kind == "charuco"]
    sweep = [frame for frame in boards if frame.step == last.step]
    seen = [corners[frame.number] for frame in sweep if frame.number in corners]
    poor = sum(found < limit for found in seen)
    doubts = []
    if len(seen) == poor == min(_FIRST_FRAMES, len(sweep)):
        doubts.append(
            f"{_called(last)}: none of its first {poor} frames shows {limit} board corners, the most is {max(seen)}; "
            "move the board into view, or correct [[board]]"
        )
    elif len(seen) == len(sweep) and poor > _POOR_SHARE * len(seen):
        doubts.append(
            f"{_called(last)}: {poor} of {len(seen)} frames show fewer than {limit} board corners, limit half of them; "
            "stand the board nearer to the middle and take the sweep again, or add one"
        )
    if all(frame.number in corners for frame in boards):
        doubts.extend(_nodes_without_a_board(boards, corners, limit))
    return tuple(doubts)


def _nodes_without_a_board(boards: Sequence[PlannedFrame], corners: Mapping[int, int], limit: int) -> list[str]:
    """Return a warning where no sweep shows enough of a board from a node."""
    best: dict[tuple[int, int], int] = {}
    for frame in boards:
        best[frame.stop.node] = max(best.get(frame.stop.node, 0), corners[frame.number])
    blind = [list(node) for node, found in best.items() if found < limit]
    if not blind:
        return []
    named = ", ".join(map(str, blind[:_MOST_NAMED])) + (" …" if len(blind) > _MOST_NAMED else "")
    return [
        f"{len(blind)} of {len(best)} nodes see {limit} board corners in no sweep ({named}), so that their poses "
        "cannot be found; add a sweep with a board in their view"
    ]


def _called(frame: PlannedFrame) -> str:
    """Return the name of a sweep as the prompts have it."""
    return f"board sweep {frame.sweep + 1}"
