"""The board set: a folder of images of ChArUco boards with `charuco.toml`, or the charuco frames of a session."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from faintfield.calib.board import Board
from faintfield.calib.geometry import Node
from faintfield.pipelines.errors import BadValue, MissingFile
from faintfield.pipelines.formats.files import sha256
from faintfield.pipelines.formats.frames import at_phase, mosaic_period, read_frame
from faintfield.pipelines.formats.reading import is_file
from faintfield.pipelines.formats.toml_files import inside, read_toml
from faintfield.pipelines.formats.units import MAX_NODE
from faintfield.rig.plan import centre_node
from faintfield.rig.session.homings import read_homing_groups
from faintfield.rig.session.session import PLAN, has_session, read_plan, taken_frames
from faintfield.rig.settings import BoardSettings

FILE_NAME = "charuco.toml"

# Pixels of a frame from which its black and white are taken; of larger ones, some in even distances.
_QUANTILE_PX = 4_000_000

type _Index = Annotated[int, Meta(ge=0, le=MAX_NODE)]


class BoardEntry(BoardSettings, frozen=True, kw_only=True):
    """One `[[board]]`. Its dictionary must be the printed one: markers of another are not found."""

    dictionary: str


class ImageEntry(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One `[[image]]`; images of the same node and sweep are repeated frames, which are averaged.

    Parameters
    ----------
    file : str
        Name of the image.
    node : (int, int)
        Row and column in the grid.
    sweep : int
        Number of the sweep, during which no board moves.
    homing : int
        Number of homings of the stage before the image; a homing may shift all later images.
    """

    file: str
    node: tuple[_Index, _Index]
    sweep: int = 0
    homing: int = 0


class BoardSetFile(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """`charuco.toml`.

    Parameters
    ----------
    format : 1
        Version of the format.
    board : list of BoardEntry
        Printed boards.
    image : list of ImageEntry
        Images of the boards.
    pitch_mm : float, optional
        Commanded distance of nodes, for the scale of the stage only.
    """

    format: Literal[1]
    board: list[BoardEntry]
    image: Annotated[list[ImageEntry], Meta(min_length=1)]
    pitch_mm: Annotated[float, Meta(gt=0)] | None = None


@dataclass(frozen=True)
class BoardView:
    """The view of a node in a sweep after a homing: the files of its repeated frames, and their colour filters."""

    node: Node
    sweep: int
    paths: tuple[Path, ...]
    mosaic: tuple[str, ...] | None = None
    homing: int = 0

    def image(self, expected_px: tuple[int, int] | None = None) -> NDArray[np.float32]:
        """Return the mean of the frames (row, column), the colours of RGB frames averaged."""
        total: NDArray[Any] | None = None
        for path in self.paths:
            frame = read_frame(path, expected_px, of="the first image")
            pixels = frame.pixels_dn.astype(np.float32)
            grey = pixels.mean(axis=2) if pixels.ndim == 3 else _without_filters(pixels, self.mosaic or frame.mosaic)
            total = grey if total is None else total + grey
            expected_px = grey.shape[::-1]
        assert total is not None
        return np.asarray(total / len(self.paths), np.float32)


@dataclass(frozen=True)
class BoardSet:
    """All boards, and their views in the order in which they were taken.

    `reference` is the node whose camera is the reference, the centre of the grid. `pitch_mm` is the commanded distance
    of neighbouring nodes. With `one_sided` the stage approached every node from the same side, in whatever order;
    `switches_repeat` if homings are known to lead to the same place.
    """

    source: Path
    boards: dict[str, Board]
    views: list[BoardView]
    reference: Node
    pitch_mm: float | None
    one_sided: bool = False
    switches_repeat: bool = False

    def input_hashes(self) -> Iterator[tuple[str, str]]:
        """Yield name and SHA-256 of every file that was read."""
        folder = self.source.parent
        for path in (self.source, *(path for view in self.views for path in view.paths)):
            yield path.relative_to(folder).as_posix(), sha256(path)


def load_board_set(folder: Path) -> BoardSet:
    """Read and check `charuco.toml`, or the charuco frames of a session, and that the files named exist."""
    if has_session(folder) and not is_file(folder / FILE_NAME):
        return _of_session(folder)
    path = folder if is_file(folder) else folder / FILE_NAME
    page = "docs/how-to/measure_geometry.md"
    remedy = f"name a session with charuco frames, or a folder of board images and {FILE_NAME} ({page})"
    settings = read_toml(path, BoardSetFile, remedy=remedy)
    boards = named_boards(path, settings.board)
    files: dict[tuple[Node, int, int], list[Path]] = {}
    for index, entry in enumerate(settings.image):
        file = inside(path.parent, entry.file, f"{path}: image[{index}].file")
        if not is_file(file):
            raise MissingFile(f"{path}: {entry.file} is named but missing; put it there or remove its entry")
        files.setdefault((entry.node, entry.sweep, entry.homing), []).append(file)
    rows, columns = (1 + max(node[axis] for node, *_ in files) for axis in (0, 1))
    return BoardSet(path, boards, _views(files), centre_node(rows, columns), settings.pitch_mm)


def _of_session(folder: Path) -> BoardSet:
    frozen = read_plan(folder)
    files: dict[tuple[Node, int, int], list[Path]] = {}
    homings = read_homing_groups(folder)
    for planned, taken, path in taken_frames(folder):
        if planned.kind == "charuco":
            if not is_file(path):
                raise MissingFile(f"{path}: is in the journal but missing; restore it from a copy")
            files.setdefault((planned.stop.node, planned.sweep, homings.groups.get(taken.intent) or 0), []).append(path)
    if not files:
        raise BadValue(f"{folder}: the session has no charuco frame yet; capture its charuco steps first")
    boards = named_boards(folder / PLAN, frozen.rig.board)
    rig, plan = frozen.rig, frozen.plan
    placed = (plan.centre.node, rig.grid.pitch_mm, plan.approach_mm > 0, homings.repeat())
    return BoardSet(folder / PLAN, boards, _views(files, rig.mosaic), *placed)


def _views(files: dict[tuple[Node, int, int], list[Path]], mosaic: tuple[str, ...] | None = None) -> list[BoardView]:
    return [BoardView(*key[:2], tuple(paths), mosaic, key[2]) for key, paths in files.items()]


def _without_filters(pixels: NDArray[np.float32], mosaic: tuple[str, ...] | None) -> NDArray[np.float32]:
    """Return a frame without the effect of its filters: each phase is scaled to the black and white of the whole frame.

    A board is grey, so that its light differs between phases by a factor only, whatever the black level.
    """
    if mosaic is None:
        return pixels
    period, ends = mosaic_period(mosaic), (0.05, 0.95)
    step = max(int(np.sqrt(pixels.size / _QUANTILE_PX)), 1)
    phases = {phase: at_phase(pixels, phase, period)[::step, ::step].ravel() for phase in np.ndindex(period)}
    black, white = np.quantile(np.concatenate(list(phases.values())), ends)
    grey = np.empty_like(pixels)
    for phase, sample in phases.items():
        low, high = np.quantile(sample, ends)
        scaled = at_phase(pixels, phase, period) - low
        scaled *= (white - black) / max(high - low, 1.0)
        scaled += black
        at_phase(grey, phase, period)[...] = scaled
    return grey


def named_boards(path: Path, entries: Sequence[BoardSettings]) -> dict[str, Board]:
    """Return the boards by name; two that share a name or a marker are refused."""
    if not entries:
        raise BadValue(f"{path}: names no [[board]]; give what `faintfield board` printed beneath the board")
    boards: dict[str, Board] = {}
    for entry in entries:
        try:
            board = Board(**msgspec.structs.asdict(entry))
        except ValueError as failure:
            raise BadValue(f"{path}: {failure}") from failure
        for other in boards.values():
            if board.name == other.name:
                raise BadValue(f"{path}: two boards are named '{board.name}'; give each its own name")
            shared = set(board.marker_ids) & set(other.marker_ids)
            if board.dictionary == other.dictionary and shared:
                raise BadValue(
                    f"{path}: boards '{other.name}' and '{board.name}' share markers {min(shared)} to {max(shared)}; "
                    "give each its own first_marker_id, as printed"
                )
        boards[board.name] = board
    sizes = {board.square_mm for board in boards.values()}
    if len(sizes) > 1:
        raise BadValue(f"{path}: square_mm differs between boards ({sorted(sizes)}); print all in one size")
    return boards
