"""Views for `import grid` that lie in one file, a stack or a mosaic of views, or hold floats: unpacked beforehand."""

import math
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
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

type _Views = Callable[[], Iterator[tuple[Path, NDArray[Any]]]]


@dataclass(frozen=True)
class FoundViews:
    """The views of a folder or a file.

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
    said: list[str] = field(default_factory=list)


@contextmanager
def found_views(
    src: Path,
    rows: int | None = None,
    columns: int | None = None,
    pattern: str | None = None,
    running: tuple[int, int] | None = None,
) -> Iterator[FoundViews]:
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
            yield _of_one_file(src, folder, rows, columns)
            return
        grid = find_grid(src, rows, columns, pattern, running=running)
        paths = list(grid.paths.values())
        found = FoundViews(grid, paths, said=grid.said)
        if read_frame(paths[0]).pixels_dn.dtype.kind == "f":
            written, factor = _whole_numbers(lambda: ((path, read_frame(path).pixels_dn) for path in paths), folder)
            found = replace(
                found,
                grid=replace(grid, paths=dict(zip(grid.paths, written, strict=True))),
                dn_per_value=factor,
                said=[*grid.said, _scaled(factor)],
            )
        yield found
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _of_one_file(src: Path, folder: Path, rows: int | None, columns: int | None) -> FoundViews:
    """Return the views in one file, unpacked into a folder."""
    suffix = src.suffix.lower()
    if suffix not in IMAGE_SUFFIXES:
        raise BadValue(
            f"{src}: files of {suffix or 'no kind'} are not read (read are {', '.join(sorted(IMAGE_SUFFIXES))}); "
            "convert it to PNG or TIFF, a picture for each view"
        )
    if suffix in RAW_SUFFIXES:
        raise BadValue(
            f"{src}: is no file that views are unpacked from; name a folder of pictures, a TIFF with a picture for "
            "each view, or a picture that holds them in rows and columns"
        )
    count, said = pages_in(src), []
    side = math.isqrt(count)
    guessed = count > 1 and rows is None and columns is None and side**2 == count
    if guessed:
        rows, columns = side, side
        said.append(f"{src.name} holds {count} pictures; they are taken as {side} x {side}, row by row")
    if rows is None and columns is None:
        holds = f"holds {count} pictures, which are no square grid" if count > 1 else "holds one picture"
        raise BadValue(f"{src}: {holds}; give --rows and --columns of the views in it")
    rows, columns = rows or 1, columns or 1
    if count > 1 and count != rows * columns:
        raise BadValue(
            f"{src}: holds {count} pictures, a grid of {rows} x {columns} needs {rows * columns}; correct --rows and "
            "--columns"
        )
    names = [folder / f"{src.stem}_r{row}_c{column}.tiff" for row, column in grid_nodes(rows, columns)]

    def pages() -> Iterator[tuple[Path, NDArray[Any]]]:
        return ((name, read_frame(src, page=index).pixels_dn) for index, name in enumerate(names))

    def tiles() -> Iterator[tuple[Path, NDArray[Any]]]:
        return zip(names, _tiles(src, rows, columns), strict=True)

    paths, factor = _unpacked(pages if count > 1 else tiles, rows * columns, folder)
    said += [_scaled(factor)] if factor is not None else []
    grid = ImageGrid(dict(zip(grid_nodes(rows, columns), paths, strict=True)), guessed=guessed)
    return FoundViews(grid, [src], factor, said)


def _tiles(src: Path, rows: int, columns: int) -> list[NDArray[Any]]:
    """Return the equal tiles of a picture, row by row."""
    picture = read_frame(src).pixels_dn
    height, width = picture.shape[:2]
    if height % rows or width % columns:
        raise BadValue(
            f"{src}: is {width} x {height} px, which {columns} columns and {rows} rows do not divide; correct --rows "
            "and --columns, or crop the margins away"
        )
    tall, wide = height // rows, width // columns
    return [picture[r * tall : (r + 1) * tall, c * wide : (c + 1) * wide] for r, c in grid_nodes(rows, columns)]


def _unpacked(views: _Views, count: int, folder: Path) -> tuple[list[Path], float | None]:
    """Write views as files of their own; return these, and the factor of float ones."""
    _, first = next(views())
    require_room(folder, count * 2 * first.size)
    if first.dtype.kind == "f":
        return _whole_numbers(views, folder)
    paths = []
    for path, pixels in views():
        write_frame(path, pixels)
        paths.append(path)
    return paths, None


def _whole_numbers(views: _Views, folder: Path) -> tuple[list[Path], float]:
    """Write float pictures as 16-bit ones, linear, all by one factor; return the files and the factor.

    Raises
    ------
    BadValue
        A value is not finite, or below zero by more than rounding hides.
    WrongBitDepth
        A picture does not hold floats.
    """
    least, largest, darkest = 0.0, 0.0, folder
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
    paths = []
    for path, pixels in views():
        paths.append(folder / f"{path.stem}.tiff")
        write_frame(paths[-1], np.rint(np.maximum(pixels, 0) * factor).astype(np.uint16))
    return paths, factor


def _scaled(factor: float) -> str:
    return f"float values became 16-bit numbers, linear, {factor:.6g} DN for 1"
