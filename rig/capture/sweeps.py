"""Check by whole sweeps whether the boards are in view: single views that miss a board do no harm."""

from collections.abc import Mapping, Sequence

from faintfield.rig.session.frames import PlannedFrame

# If this many frames at the beginning of a sweep see no board, that is not due to the corner where the grid begins.
_FIRST_FRAMES = 3
# Largest tolerated share of a sweep's frames that see too little.
_MAX_POOR_SHARE = 0.5
# Number of nodes named in a warning.
_MAX_NAMED = 6


def board_warnings(
    last: PlannedFrame, frames: Sequence[PlannedFrame], corners: Mapping[int, int], limit: int
) -> tuple[str, ...]:
    """Return the warnings about boards that are due right after a frame was taken.

    There is a warning when all of the first frames of a sweep show too little, when more than half of a sweep did, and
    when after all sweeps no board was seen from some node, so that its pose cannot be found.

    Parameters
    ----------
    last : PlannedFrame
        The frame just taken.
    frames : sequence of PlannedFrame
        All frames of the plan.
    corners : mapping of int to int
        Number of board corners found, by the number of each frame taken.
    limit : int
        Smallest number of corners that suffices.
    """
    boards = [frame for frame in frames if frame.kind == "charuco"]
    sweep = [frame for frame in boards if frame.step == last.step]
    seen = [corners[frame.number] for frame in sweep if frame.number in corners]
    poor = sum(found < limit for found in seen)
    warnings = []
    sweep_name = f"board sweep {last.sweep + 1}"
    if len(seen) == poor == min(_FIRST_FRAMES, len(sweep)):
        warnings.append(
            f"{sweep_name}: none of its first {poor} frames shows {limit} board corners, the most is {max(seen)}; "
            "move the board into view, or correct [[board]]"
        )
    elif len(seen) == len(sweep) and poor > _MAX_POOR_SHARE * len(seen):
        warnings.append(
            f"{sweep_name}: {poor} of {len(seen)} frames show fewer than {limit} board corners, limit half of them; "
            "stand the board nearer to the middle and take the sweep again, or add one"
        )
    if all(frame.number in corners for frame in boards):
        warnings.extend(_blind_node_warnings(boards, corners, limit))
    return tuple(warnings)


def _blind_node_warnings(boards: Sequence[PlannedFrame], corners: Mapping[int, int], limit: int) -> list[str]:
    """Return a warning about the nodes from which no sweep shows enough of a board."""
    best: dict[tuple[int, int], int] = {}
    for frame in boards:
        best[frame.stop.node] = max(best.get(frame.stop.node, 0), corners[frame.number])
    blind = [list(node) for node, found in best.items() if found < limit]
    if not blind:
        return []
    named = ", ".join(map(str, blind[:_MAX_NAMED])) + (" …" if len(blind) > _MAX_NAMED else "")
    return [
        f"{len(blind)} of {len(best)} nodes see {limit} board corners in no sweep ({named}), so that their poses "
        "cannot be found; add a sweep with a board in their view"
    ]
