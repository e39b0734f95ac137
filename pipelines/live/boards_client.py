"""The capture's side of the board sweeps: their frames go to a process of their own, which sends its progress."""

from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path

from faintfield.pipelines.console import inform
from faintfield.pipelines.live.board_progress import BoardNews, BoardOrder, BoardProgress
from faintfield.pipelines.live.planes_client import NO_POSES, BoardPoses
from faintfield.pipelines.live.side_process import SideProcess, running

_NAME = "verdicts on board sweeps"


class BoardsClient(SideProcess):
    """Progress of the board sweeps as the capture and its page see it; `frames` returns the frames, in another thread.

    `progress` is the latest state of the process; None before the first. The functions `on_poses` are called when
    there are measured poses, or when it is known why there are none.
    """

    def __init__(self, order: BoardOrder, frames: Callable[[], BoardNews]) -> None:
        self.progress: BoardProgress | None = None
        self.on_poses: list[Callable[[], None]] = []
        self._frames = frames
        super().__init__("board_process", _NAME, order)

    def news(self) -> BoardNews:
        """Return the valid frames, and those that are left out."""
        return self._frames()

    def receive(self, message: BoardProgress) -> None:
        """Take a state; say its verdict after each sweep, and whether poses were measured."""
        before, self.progress = self.progress, message
        said = 0 if before is None else before.after_sweep
        if message.verdict is not None and message.after_sweep > said:
            inform(f"board sweep {message.after_sweep}: {message.verdict.words}")
        if message.problem and (before is None or message.problem != before.problem):
            inform(f"board sweeps: {message.problem}")
        if self.poses() not in (NO_POSES, _poses(before)):
            inform(f"poses: {message.poses}")
            for callback in self.on_poses:
                callback()

    def poses(self) -> BoardPoses:
        """Return the measured poses, or why there are none."""
        return _poses(self.progress)


def _poses(progress: BoardProgress | None) -> BoardPoses:
    if progress is None:
        return NO_POSES
    return BoardPoses(Path(progress.geometry) if progress.geometry else None, progress.refusal)


def followed_boards(order: BoardOrder, frames: Callable[[], BoardNews]) -> AbstractContextManager[BoardsClient | None]:
    """Follow the board sweeps while the block runs; None if that fails to begin, which harms nothing else."""
    return running(lambda: BoardsClient(order, frames), _NAME)
