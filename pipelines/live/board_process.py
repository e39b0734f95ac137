"""The process that follows the board sweeps: it finds the corners of each frame, and judges what they determine.

It is started by `pipelines.live.boards_client`, reads plan and frames, writes nothing into the session, and ends with
the capture. It judges after each sweep, and after some frames of a further one; when all boards are done, it solves
the geometry as `faintfield geometry` does.
"""

from collections.abc import Mapping

import cv2
import numpy as np
from msgspec.structs import replace

from faintfield.calib.detection import BoardCorners, detect_boards
from faintfield.calib.errors import CalibrationError
from faintfield.calib.geometry import BoardObservation, GeometrySettings, Node, Target, calibrate_geometry
from faintfield.calib.geometry.calibrate import Adjustment
from faintfield.pipelines.errors import InputError
from faintfield.pipelines.formats.files import write_record
from faintfield.pipelines.formats.results.geometry import camera_poses
from faintfield.pipelines.formats.sets.board_set import BoardView, named_boards
from faintfield.pipelines.live.board_progress import BoardFrame, BoardNews, BoardOrder, BoardProgress, FrameCorners
from faintfield.pipelines.live.board_verdict import SweepPlan, coverage, judge, nominal_poses, sweeps_seen
from faintfield.pipelines.live.side_process import Line, newest_news, serve
from faintfield.rig.errors import RigError
from faintfield.rig.plan import planned_frames
from faintfield.rig.session.session import FRAMES, PLAN, read_plan

# A verdict is due after so many frames of a further sweep.
_FRAMES_PER_VERDICT = 10

# Node, sweep and homing: frames that show the same, and are averaged.
type _View = tuple[Node, int, int]

_FAILURES = (InputError, RigError, CalibrationError)


class BoardWatch:
    """The board sweeps of a session that is being captured; `line` brings news and takes progress."""

    def __init__(self, order: BoardOrder, line: Line) -> None:
        self._order, self._line = order, line
        self._settings = GeometrySettings(depths_mm=order.depths_mm)
        self._wanted_px = order.wanted_px or self._settings.max_transfer_sigma_px
        frozen = read_plan(order.session)
        self._plan, self._mosaic = frozen.plan, frozen.rig.mosaic
        self._boards = named_boards(order.session / PLAN, frozen.rig.board)
        self._planned = {frame.number: frame for frame in planned_frames(frozen.plan) if frame.kind == "charuco"}
        self._wanted: dict[_View, tuple[BoardFrame, ...]] = {}
        self._skipped: frozenset[int] = frozenset()
        self._found: dict[_View, tuple[tuple[BoardFrame, ...], list[BoardCorners]]] = {}
        self._size_px: tuple[int, int] | None = None
        self._adjustment: Adjustment | None = None
        self._judged: frozenset[int] = frozenset()
        self._unjudged = self._solutions = 0
        self._solved: dict[_View, tuple[BoardFrame, ...]] = {}
        self._progress = BoardProgress("waiting", planned=len(self._planned), wanted_px=self._wanted_px)

    def run(self) -> None:
        """Do one thing at a time until the capture ends, which raises EOFError or ConnectionError."""
        self._report()
        busy = False
        while True:
            news: BoardNews | None = newest_news(self._line, wait=not busy)
            if news is not None:
                self._take(news)
            busy = self._advance()
            if not busy:
                self._report(doing="up to date")

    def _take(self, news: BoardNews) -> None:
        wanted: dict[_View, tuple[BoardFrame, ...]] = {}
        for frame in news.frames:
            planned = self._planned[frame.number]
            view = planned.stop.node, planned.sweep, frame.homing
            wanted[view] = (*wanted.get(view, ()), frame)
        self._wanted, self._skipped = wanted, frozenset(news.skipped)
        if self._found.keys() - wanted.keys():  # frames are void, perhaps for their size
            self._found.clear()
            self._size_px = None

    def _advance(self) -> bool:
        """Do what matters most; return whether anything was to be done."""
        new = [
            view for view, frames in self._wanted.items() if view not in self._found or self._found[view][0] != frames
        ]
        complete = self._complete_sweeps()
        if complete and (complete != self._judged or self._unjudged >= _FRAMES_PER_VERDICT):
            self._judge(complete)
        elif new:
            self._detect(max(new, key=lambda view: self._wanted[view][-1].intent))
        elif self._wanted and self._wanted != self._solved and len(complete) == len(self._sweeps()):
            self._solve()
        else:
            return False
        return True

    def _sweeps(self) -> dict[int, set[int]]:
        """Return the numbers of the planned frames of each sweep, without those that are left out."""
        sweeps: dict[int, set[int]] = {}
        for number, frame in self._planned.items():
            if number not in self._skipped:
                sweeps.setdefault(frame.sweep, set()).add(number)
        return sweeps

    def _searched(self) -> set[int]:
        return {frame.number for frames, _ in self._found.values() for frame in frames}

    def _complete_sweeps(self) -> frozenset[int]:
        searched = self._searched()
        return frozenset(sweep for sweep, numbers in self._sweeps().items() if numbers <= searched)

    def _detect(self, view: _View) -> None:
        """Find the boards in the frames of a view."""
        node, sweep, homing = view
        frames = self._wanted[view]
        paths = tuple(self._order.session / FRAMES / frame.file for frame in frames)
        corners: list[BoardCorners] = []
        try:
            image = BoardView(node, sweep, paths, self._mosaic, homing).image(self._size_px)
            self._size_px = image.shape[1], image.shape[0]
            corners = detect_boards(image, list(self._boards.values()))
        except _FAILURES as failure:
            self._report(problem=str(failure))
        self._found[view] = frames, corners
        self._unjudged += 1
        changes: dict[str, object] = {}
        if self._size_px is not None:
            cells = coverage(self._observations(), self._size_px)
            changes = {"cells": cells, "covered": round(float(np.mean(np.array(cells) > 0)), 3)}
            if frames[-1].intent == max(frame.intent for of_view in self._wanted.values() for frame in of_view):
                points = tuple((x, y) for board in corners for x, y in np.round(board.pixels, 2).tolist())
                changes["last"] = FrameCorners(self._planned[frames[-1].number].name, self._size_px, points)
        self._report(
            doing="looking for corners",
            frames=len(self._searched()),
            sweeps=sweeps_seen(self._observations(), self._adjustment, self._boards),
            **changes,
        )

    def _observations(self) -> list[BoardObservation]:
        return [
            BoardObservation(node, Target(seen.board, sweep, homing), seen.corners, seen.pixels, seen.sigma_px)
            for (node, sweep, homing), (_, corners) in self._found.items()
            for seen in corners
            if len(seen.corners)
        ]

    def _judge(self, complete: frozenset[int]) -> None:
        """Solve for what the corners determine so far, and report the verdict."""
        self._judged, self._unjudged = complete, 0
        self._report(doing="judging the boards")
        observations = self._observations()
        plan = SweepPlan(
            nominal_poses(self._plan),
            self._plan.centre.node,
            self._order.depths_mm,
            self._wanted_px,
            self._nodes_to_come(),
            sum(not numbers & self._searched() for numbers in self._sweeps().values()),
        )
        try:
            if self._size_px is None:
                return
            verdict, self._adjustment = judge(self._boards, observations, self._size_px, plan)
        except _FAILURES as failure:
            self._adjustment = None
            self._report(problem=str(failure), verdict=None)
            return
        self._report(
            verdict=verdict,
            after_sweep=len(complete),
            problem="",
            sweeps=sweeps_seen(observations, self._adjustment, self._boards),
        )

    def _nodes_to_come(self) -> Mapping[int, list[Node]]:
        """Return the nodes of each sweep that has begun whose frames are not there yet."""
        searched = self._searched()
        return {
            sweep: [self._planned[number].stop.node for number in sorted(numbers - searched)]
            for sweep, numbers in self._sweeps().items()
            if numbers & searched
        }

    def _solve(self) -> None:
        """Solve the geometry as `faintfield geometry` does, and write lens and poses beside the session's folder."""
        self._solved = dict(self._wanted)
        self._report(doing="solving lens and poses")
        if self._size_px is None:
            self._report(geometry="", refusal="no frame of a board can be decoded here")
            return
        try:
            rig = calibrate_geometry(
                self._boards, self._observations(), self._size_px, self._plan.centre.node, self._settings
            )
        except _FAILURES as failure:
            self._report(geometry="", refusal=str(failure))
            return
        self._solutions += 1
        path = self._order.out / f"geometry_{self._solutions}.json"
        write_record(path, camera_poses(rig))
        self._report(geometry=str(path), refusal="")

    def _report(self, **changes: object) -> None:
        """Change the state, and send it."""
        self._progress = replace(self._progress, **changes)
        self._line.send(self._progress)


def main() -> None:
    """Serve the connection whose number is the argument, until the capture ends."""
    cv2.setNumThreads(1)
    serve(lambda order, line: BoardWatch(order, line).run(), lambda problem: BoardProgress("ended", problem=problem))


if __name__ == "__main__":
    main()
