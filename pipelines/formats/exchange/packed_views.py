"""Views for `import grid` that lie in one file, a stack or a mosaic of views, or hold floats: unpacked beforehand."""

import math
import shutil
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import mkdtemp
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintfield.pipelines.errors import BadValue, WrongBitDepth
from faintfield.pipelines.formats.exchange.image_grid import ImageGrid, find_grid
from faintfield.pipelines.formats.files import require_room
from faintfield.pipelines.formats.frames import IMAGE_SUFFIXES, RAW_SUFFIXES, pages_in, read_frame
from faintfield.pipelines.formats.image_files import write_frame
from faintfield.pipelines.formats.reading import is_file
from faintfield.rig.plan import grid_nodes

# DN of the largest value of float pictures: below the end of 16 bits, so that no pixel counts as saturated.
_LARGEST_DN = 65534.0

type _Views = Callable[[], Iterable[tuple[Path, NDArray[Any]]]]


@dataclass(frozen=True)
class UnpackedViews:
    """Views of a folder or a file.

    Attributes
    ----------
    grid : ImageGrid
        The pictures by node; those that were unpacked are gone after the import.
    sources : list of Path
        The files of the user that hold them.
    dn_per_value : float, optional
        Factor by which float values became whole numbers; None for other pictures.
    """

    grid: ImageGrid
    sources: list[Path]
    dn_per_value: float | None = None


@contextmanager
def unpack_views(
    src: Path,
    rows: int | None = None,
    columns: int | None = None,
    pattern: str | None = None,
    running: tuple[int, int] | None = None,
) -> Iterator[UnpackedViews]:
    """Find the views of a folder, see `find_grid`, or of one file; unpack what is no 8- or 16-bit picture by itself.

    Parameters
    ----------
    src : Path
        A folder of pictures; a TIFF with a picture for each view, row by row; or one picture of all views, laid out in
        rows and columns of equal tiles.
    rows, columns, pattern, running
        As in `find_grid`; a mosaic of views needs rows and columns.

    Raises
    ------
    MissingFile, BadValue, UnreadableImage
        As in `find_grid`; or the file cannot be divided into views.
    WrongBitDepth
        Some pictures hold floats, and others do not.
    """
    folder = Path(mkdtemp(prefix="faintfield-views-"))
    try:
        if is_file(src):
            grid, views = _divide_file(src, folder, rows, columns)
            yield _unpack(UnpackedViews(grid, [src]), views, folder)
            return
        grid = find_grid(src, rows, columns, pattern, running=running)
        packed = UnpackedViews(grid, list(grid.paths.values()))
        if read_frame(packed.sources[0]).pixels_dn.dtype.kind == "f":
            yield _unpack(packed, lambda: ((path, read_frame(path).pixels_dn) for path in packed.sources), folder)
        else:
            yield packed
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _divide_file(src: Path, folder: Path, rows: int | None, columns: int | None) -> tuple[ImageGrid, _Views]:
    """Return the grid of the views in one file, as files of their own that are not written yet, and these views."""
    readable = IMAGE_SUFFIXES - RAW_SUFFIXES
    if src.suffix.lower() not in readable:
        raise BadValue(
            f"{src}: is no file that views are unpacked from (these are {', '.join(sorted(readable))}); name a folder "
            "of pictures, a TIFF with a picture for each view, or a picture that holds them in rows and columns"
        )
    count, remarks = pages_in(src), []
    side = math.isqrt(count)
    guessed = count > 1 and rows is None and columns is None and side**2 == count
    if guessed:
        rows, columns = side, side
        remarks.append(f"{src.name} holds {count} pictures; they are taken as {side} x {side}, row by row")
    if rows is None and columns is None:
        holds = f"holds {count} pictures, which are no square grid" if count > 1 else "holds one picture"
        raise BadValue(f"{src}: {holds}; give --rows and --columns of the views in it")
    rows, columns = rows or 1, columns or 1
    if count > 1 and count != rows * columns:
        raise BadValue(
            f"{src}: holds {count} pictures, a grid of {rows} x {columns} needs {rows * columns}; correct --rows and "
            "--columns"
        )
    paths = {node: folder / f"{src.stem}_r{node[0]}_c{node[1]}.tiff" for node in grid_nodes(rows, columns)}
    grid = ImageGrid(paths, remarks=remarks, guessed=guessed)
    if count > 1:
        return grid, lambda: ((path, read_frame(src, page=page).pixels_dn) for page, path in enumerate(paths.values()))
    return grid, lambda: zip(paths.values(), _tiles(src, rows, columns), strict=True)


def _tiles(src: Path, rows: int, columns: int) -> list[NDArray[Any]]:
    """Return the equal tiles of a picture, row by row."""
    picture = read_frame(src).pixels_dn
    height, width = picture.shape[:2]
    if height % rows or width % columns:
        raise BadValue(
            f"{src}: is {width} x {height} px, which {columns} columns and {rows} rows do not divide; correct --rows "
            "and --columns, or crop the margins away"
        )
    return [tile for line in np.split(picture, rows) for tile in np.split(line, columns, axis=1)]


def _unpack(packed: UnpackedViews, views: _Views, folder: Path) -> UnpackedViews:
    """Write views as files of their own; floats become 16-bit numbers, linear, all by one factor."""
    grid = packed.grid
    _, first = next(iter(views()))
    require_room(folder, len(grid.paths) * 2 * first.size)
    factor = _dn_per_value(views) if first.dtype.kind == "f" else None
    paths = []
    for path, pixels in views():
        paths.append(folder / f"{path.stem}.tiff")
        whole = pixels if factor is None else np.rint(np.maximum(pixels, 0) * factor).astype(np.uint16)
        write_frame(paths[-1], whole)
    remarks = grid.remarks.copy()
    if factor is not None:
        remarks.append(f"float values became 16-bit numbers, linear, {factor:.6g} DN for 1")
    grid = replace(grid, paths=dict(zip(grid.paths, paths, strict=True)), remarks=remarks)
    return UnpackedViews(grid, packed.sources, factor)


def _dn_per_value(views: _Views) -> float:
    """Return the factor by which float pictures become 16-bit ones.

    Raises
    ------
    BadValue
        A value is not finite, or below zero by more than rounding hides.
    WrongBitDepth
        A picture does not hold floats.
    """
    least, largest, darkest = 0.0, 0.0, Path()
    for path, pixels in views():
        if pixels.dtype.kind != "f":
            raise WrongBitDepth(
                f"{path}: holds {pixels.dtype} pixels, the first picture floats; export all of them alike"
            )
        if not np.isfinite(pixels).all():
            raise BadValue(f"{path}: holds values that are not finite; replace them, or leave the picture out")
        largest = max(largest, float(pixels.max()))
        if pixels.min() < least:
            least, darkest = float(pixels.min()), path
    factor = _LARGEST_DN / largest if largest > 0 else 1.0
    if least * factor < -0.5:
        raise BadValue(
            f"{darkest}: holds {least:g}, and the largest value of all pictures is {largest:g}; light is not negative: "
            "add one number to all pictures, and state it by --offset-dn, in DN as the import scales them"
        )
    return factor
