"""The process of live planes: receives which frames there are, and sends pictures and its state.

It is started by `pipelines.live.planes_client`, reads frames and calibrations, and ends with the capture. Several
frames that wait are taken newest first; PMLEM runs when none does.
"""

from collections.abc import Sequence
from typing import Literal

import cv2
import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from faintfield.pipelines.errors import InputError
from faintfield.pipelines.formats.frames import read_frame
from faintfield.pipelines.formats.image_files import encoded, grey_levels
from faintfield.pipelines.live.plane_accumulator import MAX_STACK_BYTES, PlaneAccumulator
from faintfield.pipelines.live.planes_client import (
    NO_POSES,
    LiveFrame,
    LiveNews,
    LiveOrder,
    LiveStatus,
    PictureKind,
    PictureStatus,
    PlaneStatus,
)
from faintfield.pipelines.live.planes_scene import LiveScene, dark_frames, live_scene
from faintfield.pipelines.live.side_process import Line, newest_news, serve
from faintfield.pipelines.live.terminal import display_levels
from faintfield.recon.errors import ReconstructionError
from faintfield.recon.names import on_compiling
from faintfield.rig.errors import RigError
from faintfield.rig.session.session import FRAMES, read_plan

# Work on a plane, the most urgent first.
type _Task = Literal["view", "mean", "focus", "pmlem"]
_TASKS: tuple[_Task, ...] = ("view", "mean", "focus", "pmlem")

# Black and white of a picture are these quantiles of its covered samples, from about so many of them.
_QUANTILES = (0.005, 0.998)
_QUANTILE_SAMPLES = 100_000

# Width of the pictures of frames, in pixels.
_FRAME_WIDTH_PX = 640

# Failures of one frame or one calibration, which the page shows.
_FAILURES = (InputError, RigError, ReconstructionError)


class LivePlanes:
    """Planes of a session that is being captured; `line` brings news and takes pictures and states."""

    def __init__(self, order: LiveOrder, line: Line) -> None:
        self._order, self._line = order, line
        self._indices = range(len(order.depths_mm))
        self._planes: PlaneAccumulator | None = None
        self._wanted: dict[int, LiveFrame] = {}
        self._unusable: set[int] = set()
        self._shown = 0
        self._poses = NO_POSES
        self._tasks: set[tuple[int, _Task]] = set()
        self._status = LiveStatus(
            "waiting for frames of the dark scene", planes=tuple(PlaneStatus(depth) for depth in order.depths_mm)
        )

    def run(self) -> None:
        """Do one thing at a time until the capture ends, which raises EOFError or ConnectionError."""
        on_compiling.append(lambda: self._report(doing="compiling; once, for some ten seconds"))
        self._report()
        busy = False
        while True:
            news: LiveNews | None = newest_news(self._line, wait=not busy)
            if news is not None:
                self._wanted = {frame.intent: frame for frame in news.frames}
                self._shown = min(news.depth, self._indices[-1])
                if news.poses.path != self._poses.path:
                    self._begin_again()
                self._poses = news.poses
            busy = self._begin() if self._planes is None else self._advance(self._planes)
            if not busy and self._wanted and self._planes is not None:
                self._report(doing="up to date")

    def _begin(self) -> bool:
        """Find out what is known of the scene, once its first frame is there; return whether planes can begin."""
        if not self._wanted:
            return False
        first = self._wanted[max(self._wanted)]
        folder = self._order.session / FRAMES
        try:
            frozen = read_plan(self._order.session)
            scene = live_scene(self._order, frozen, read_frame(folder / first.file), self._poses)
            self._report(doing="computing where each pixel looks")
            self._planes = PlaneAccumulator(scene, folder, self._order.depths_mm)
        except _FAILURES as failure:
            self._report(doing="waiting", problems=(str(failure),))
            return False
        self._report(
            doing="reading frames",
            poses=scene.poses,
            noise=scene.noise,
            unit="e⁻/px" if scene.knows_noise else "DN/px",
            bins=scene.bins,
            planned_nodes=len({frame.stop.node for frame in dark_frames(frozen.plan)}),
            pmlem=_pmlem_status(scene, self._planes),
            problems=(),
        )
        return True

    def _begin_again(self) -> None:
        """Forget all planes, as poses are others; their pictures stay until there are new ones."""
        self._planes = None
        self._tasks, self._unusable = set(), set()

    def _advance(self, planes: PlaneAccumulator) -> bool:
        """Do what matters most; return whether anything was to be done."""
        void = [frame for intent, frame in planes.frames.items() if intent not in self._wanted]
        new = self._wanted.keys() - planes.frames.keys() - self._unusable
        if void:
            self._remove(planes, [frame for frame in void if frame.node == void[0].node])
        elif new:
            self._add(planes, self._wanted[max(new)])
        elif self._tasks:
            index, task = min(self._tasks, key=self._rank)
            self._work(planes, index, task)
        else:
            return False
        return True

    def _rank(self, task: tuple[int, _Task]) -> tuple[bool, int, int, int]:
        """Return the place in the queue: PMLEM comes last, and planes near to the one that is shown first."""
        index, kind = task
        return kind == "pmlem", abs(index - self._shown), index, _TASKS.index(kind)

    def _add(self, planes: PlaneAccumulator, frame: LiveFrame) -> None:
        """Add a frame, and show it on the plane that is looked at."""
        try:
            electrons = planes.add(frame)
        except _FAILURES as failure:
            self._unusable.add(frame.intent)
            self._report_problem(failure)
            return
        row, column = frame.node
        self._send_picture(f"node_r{row}_c{column}.png", display_levels(electrons, _FRAME_WIDTH_PX))
        self._note_change(planes, with_picture=tuple(dict.fromkeys((*self._status.with_picture, frame.node))))
        self._work(planes, self._shown, "view")
        self._work(planes, self._shown, "mean")

    def _remove(self, planes: PlaneAccumulator, frames: Sequence[LiveFrame]) -> None:
        try:
            planes.remove(frames)
        except _FAILURES as failure:
            self._report_problem(failure)
        self._note_change(planes)

    def _note_change(self, planes: PlaneAccumulator, **changes: object) -> None:
        """Note that the frames are others, so that all is to be done again."""
        self._tasks = {(index, task) for index in self._indices for task in _TASKS}
        self._report(doing="adding frames", frames=len(planes.frames), nodes=len(planes.nodes), **changes)

    def _work(self, planes: PlaneAccumulator, index: int, task: _Task) -> None:
        self._tasks.discard((index, task))
        if task == "focus":
            measure = planes.focus(index)
            self._report_plane(index, focus=measure.detail_e2, focus_sigma=measure.sigma_e2)
        elif task != "pmlem":
            self._draw(planes, index, task)
        elif not planes.is_refined(index):
            self._refine(planes, index)

    def _draw(self, planes: PlaneAccumulator, index: int, kind: PictureKind) -> None:
        """Send a picture, and its scale with the state."""
        picture = planes.picture(index, kind)
        if picture is None:
            return
        black, white = stretch(picture.plane, picture.covered)
        levels = grey_levels(np.where(picture.covered, picture.plane, black), white, black)
        self._send_picture(f"plane_{index:03d}_{kind}.png", levels)
        pictures = self._status.planes[index].pictures
        version = pictures[kind].version + 1 if kind in pictures else 1
        status = PictureStatus(version, picture.nodes, black, white, picture.rounds)
        self._report_plane(index, pictures=pictures | {kind: status})

    def _refine(self, planes: PlaneAccumulator, index: int) -> None:
        """Run PMLEM on a plane until it is done, or there are news; then the rest is to be done later."""
        depths_mm, count = self._order.depths_mm, planes.complete
        rounds = f" in {planes.rounds} rounds" if planes.rounds > 1 else ""
        self._report(doing=f"PMLEM of the plane at {depths_mm[index]:g} mm")
        planes.refine(index, self._line.poll)
        if not planes.is_refined(index):
            self._tasks.add((index, "pmlem"))
        self._draw(planes, index, "pmlem")
        done = sum(map(planes.is_refined, self._indices))
        self._report(pmlem=f"PMLEM of {count} nodes{rounds}: {done} of {len(depths_mm)} planes done")

    def _report_problem(self, failure: Exception) -> None:
        self._report(problems=(*self._status.problems[-2:], str(failure)))

    def _report_plane(self, index: int, **changes: object) -> None:
        planes = list(self._status.planes)
        planes[index] = replace(planes[index], **changes)
        self._report(planes=tuple(planes))

    def _report(self, **changes: object) -> None:
        """Change the state, and send it."""
        self._status = replace(self._status, **changes)
        self._line.send(self._status)

    def _send_picture(self, name: str, levels: NDArray[np.uint8]) -> None:
        self._line.send((name, encoded(levels, ".png")))


def _pmlem_status(scene: LiveScene, planes: PlaneAccumulator) -> str:
    """Return why PMLEM is left out, or that no node is complete yet."""
    if not scene.knows_noise:
        return "PMLEM needs noise.json; run `faintfield noise`, or give --noise"
    if planes.stack_bytes > MAX_STACK_BYTES:
        return (
            f"PMLEM is left out: the images of all nodes take {planes.stack_bytes / 1e9:.1f} GB, at most "
            f"{MAX_STACK_BYTES / 1e9:.0f} GB are kept"
        )
    return "PMLEM begins when a node has all of its frames"


def stretch(plane: NDArray[np.floating], covered: NDArray[np.bool_]) -> tuple[float, float]:
    """Return black and white of a picture: quantiles of its covered samples, a little apart from one another."""
    values = plane[covered & np.isfinite(plane)]
    if not values.size:
        return 0.0, 1.0
    black, white = np.quantile(values[:: 1 + values.size // _QUANTILE_SAMPLES], _QUANTILES).tolist()
    return black, max(white, black + 1e-6)


def main() -> None:
    """Serve the connection whose number is the argument, until the capture ends."""
    cv2.setNumThreads(1)
    serve(lambda order, line: LivePlanes(order, line).run(), lambda problem: LiveStatus("ended", problems=(problem,)))


if __name__ == "__main__":
    main()
