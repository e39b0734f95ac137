"""The board set: a folder of images of ChArUco boards with `charuco.toml`."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import msgspec
import numpy as np
import tomli_w
from numpy.typing import NDArray

from calib.board import Board
from calib.geometry import Node
from pipelines.errors import BadValue, MissingFile, WrongSize
from pipelines.files import sha256, write_whole
from pipelines.frames import read_frame
from pipelines.toml_files import inside, read_toml

FILE_NAME = "charuco.toml"


class BoardEntry(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One `[[board]]`."""

    name: str
    columns: int
    rows: int
    square_mm: float
    marker_mm: float
    dictionary: str
    first_marker_id: int = 0

    def board(self) -> Board:
        """Return the board described (ValueError where it cannot be)."""
        return Board(**msgspec.structs.asdict(self))


class ImageEntry(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One `[[image]]`; several of the same node and sweep are repeated frames and are averaged."""

    file: str
    node: tuple[int, int]
    sweep: int = 0


class BoardSetFile(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """The whole of `charuco.toml`; `pitch_mm`, what the stage was told, is needed for its scale only."""

    format: Literal[1]
    board: list[BoardEntry]
    image: list[ImageEntry]
    pitch_mm: float | None = None


@dataclass(frozen=True)
class BoardView:
    """What was seen at a node in a sweep: the files of its repeated frames."""

    node: Node
    sweep: int
    paths: tuple[Path, ...]

    def image(self) -> NDArray[np.float32]:
        """Return the mean of the frames (row, column), the colours of RGB frames averaged.

        Raises
        ------
        WrongSize
            The frames are not of one size.
        """
        total: NDArray[Any] | None = None
        for path in self.paths:
            pixels = read_frame(path).pixels_dn.astype(np.float32)
            grey = pixels.mean(axis=2) if pixels.ndim == 3 else pixels
            if total is not None and grey.shape != total.shape:
                raise WrongSize(f"{path}: is {grey.shape[::-1]} px, its repeats {total.shape[::-1]}; take it again")
            total = grey if total is None else total + grey
        assert total is not None
        return np.asarray(total / len(self.paths), np.float32)


@dataclass(frozen=True)
class BoardSet:
    """A board set that has been checked, without its pixels.

    Attributes
    ----------
    source : Path
        The file that describes it.
    boards : dict of name to Board
        All boards.
    views : list of BoardView
        In the order in which they were taken.
    pitch_mm : float, optional
        Distance of neighbouring nodes as the stage was told.
    """

    source: Path
    boards: dict[str, Board]
    views: list[BoardView]
    pitch_mm: float | None

    @property
    def reference(self) -> Node:
        """The centre node of the grid that the views span."""
        rows, columns = (1 + max(view.node[axis] for view in self.views) for axis in (0, 1))
        return rows // 2, columns // 2

    def input_hashes(self) -> Iterator[tuple[str, str]]:
        """Yield name and SHA-256 of every file that was read."""
        folder = self.source.parent
        for path in (self.source, *(path for view in self.views for path in view.paths)):
            yield str(path.relative_to(folder)), sha256(path)


def load_board_set(folder: Path) -> BoardSet:
    """Read and check `charuco.toml` and that the files it names exist.

    Raises
    ------
    InputError
        A file is missing, a key unknown, or a value cannot be; the message names it.
    """
    path = folder / FILE_NAME if folder.is_dir() or not folder.exists() else folder
    settings = read_toml(path, BoardSetFile)
    boards = _boards(path, settings)
    if not settings.image:
        raise BadValue(f"{path}: names no [[image]]; give each its file, node and sweep")
    files: dict[tuple[Node, int], list[Path]] = {}
    for index, entry in enumerate(settings.image):
        file = inside(path.parent, entry.file, f"{path}: image[{index}].file")
        if not file.is_file():
            raise MissingFile(f"{path}: {entry.file} is named but missing; put it there or remove its entry")
        if min(entry.node) < 0:
            raise BadValue(f"{path}: image[{index}].node = {list(entry.node)}; rows and columns count from 0")
        files.setdefault((entry.node, entry.sweep), []).append(file)
    if settings.pitch_mm is not None and not settings.pitch_mm > 0:
        raise BadValue(f"{path}: pitch_mm = {settings.pitch_mm}; it must be positive")
    views = [BoardView(node, sweep, tuple(paths)) for (node, sweep), paths in files.items()]
    return BoardSet(path, boards, views, settings.pitch_mm)


def write_board_set(folder: Path, settings: BoardSetFile) -> None:
    """Write `charuco.toml`; the images come first, so that a folder with this file is whole."""
    content = {name: value for name, value in msgspec.to_builtins(settings).items() if value is not None}
    write_whole(folder / FILE_NAME, tomli_w.dumps(content))


def _boards(path: Path, settings: BoardSetFile) -> dict[str, Board]:
    """Return the boards by name; two that share a name or a marker are refused."""
    if not settings.board:
        raise BadValue(f"{path}: names no [[board]]; give what `faintfield board` printed beneath the board")
    boards: dict[str, Board] = {}
    for entry in settings.board:
        try:
            board = entry.board()
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
