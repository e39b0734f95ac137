"""An elemental set from pictures taken on a regular grid, in a folder or in one file: `faintfield import grid`.

Views that lie in one file, a stack or a mosaic of views, or hold floats are unpacked beforehand.
"""

import math
import shutil
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from tempfile import mkdtemp
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from faintfield.calib.arrangement.views import Orientation
from faintfield.pipelines.console import inform
from faintfield.pipelines.errors import BadValue, WrongBitDepth, WrongUsage
from faintfield.pipelines.formats.exchange.arranged_grid import arrange_grid
from faintfield.pipelines.formats.exchange.hci import described_grid, write_true_depth
from faintfield.pipelines.formats.exchange.image_grid import ImageGrid, find_grid
from faintfield.pipelines.formats.exchange.imported_set import (
    check_set_free,
    read_picture,
    require_room_for_copies,
    stated_lens,
    write_imported_set,
)
from faintfield.pipelines.formats.exchange.options import GridOptions
from faintfield.pipelines.formats.files import require_room
from faintfield.pipelines.formats.frames import IMAGE_SUFFIXES, RAW_SUFFIXES, pages_in, picture_kind, read_frame
from faintfield.pipelines.formats.image_files import write_frame
from faintfield.pipelines.formats.reading import is_file
from faintfield.pipelines.formats.sets.elemental_file import Arrangement
from faintfield.pipelines.formats.units import Units
from faintfield.rig.plan import grid_nodes

# DN of the largest value of float pictures: below the end of 16 bits, so that no pixel counts as saturated.
_LARGEST_DN = 65534.0

# Without a pitch the unit of length is free: the plane on which the pictures are aligned gets this depth.
_FREE_REFERENCE_DEPTH_MM = 1000.0

# Disparity of infinitely far points beyond the largest one found: a share of the range, and a part of a pixel.
_BEYOND_SHARE, _BEYOND_PX = 0.25, 0.1

type _Views = Callable[[], Iterable[tuple[Path, NDArray[Any]]]]


class ImportedGrid(msgspec.Struct, frozen=True):
    """The result of `faintfield import grid`; `arrangement` is what the pictures say."""

    out: str
    rows: int
    columns: int
    size_px: tuple[int, int]
    views: int
    arrangement: Arrangement


def import_pictures(src: Path, out: Path, options: GridOptions) -> ImportedGrid:
    """Make an elemental set of the pictures in a folder or a file, put in order by what they show."""
    check_set_free(out, options, src)
    prescribed = Orientation(options.transpose, options.flip_rows, options.flip_columns)
    if options.keep_order and prescribed != Orientation():
        flags = ("transpose", "flip_rows", "flip_columns")
        option = next(f"--{flag.replace('_', '-')}" for flag in flags if getattr(options, flag))
        raise WrongUsage(f"--keep-order contradicts {option}; leave one out")
    if options.distortion and None in (options.pitch_mm, options.fx_px):
        lacking = "--pitch-mm" if options.pitch_mm is None else "--fx-px"
        raise WrongUsage(f"--distortion is that of a lens whose scale is known; give {lacking}, too")
    if options.distortion and options.disparity_px:
        raise WrongUsage("--distortion is that of pictures as they were taken, not of aligned ones; leave one out")
    recorded = {name: value for name, value in asdict(options).items() if name not in ("no_align", "overwrite")}
    pitch_mm, fx_px, disparity_px = options.pitch_mm, options.fx_px, options.disparity_px
    described = described_grid(src)
    own_scale = pitch_mm is None and fx_px is None and disparity_px is None
    if described is not None:
        pitch_mm, fx_px, disparity_px = described.scale(pitch_mm, fx_px, disparity_px)
    with _unpacked(src, options, described.size if described else None) as views:
        for remark in views.remarks:
            inform(remark)
        first = read_picture(next(iter(views.paths.values())))
        require_room_for_copies(out, first, len(views.paths))
        height, width = first.pixels_dn.shape[:2]
        lens = stated_lens((width, height), fx_px or width, fx_px or width, options)
        white = float(first.saturation_dn or np.iinfo(first.pixels_dn.dtype).max)
        grid, arrangement = arrange_grid(
            views,
            prescribed if options.keep_order or prescribed != Orientation() else None,
            white=white if views.dn_per_value is None else np.inf,  # floats state no white
            aligned=bool(disparity_px),
            lens=lens,
        )
        stated = disparity_px is not None
        if options.distortion and arrangement.aligned and not stated:
            raise BadValue(
                f"{src}: the pictures are aligned on a plane in the scene, and --distortion is that of pictures as "
                "they were taken; leave it out, give those, or state by --disparity-px 0 that they are not aligned"
            )
        pitch_mm, fx_px, at_infinity_px, in_mm = _scale(arrangement, float(width), pitch_mm, fx_px, disparity_px)
        if in_mm and arrangement.aligned is None and arrangement.disparity_range_px is not None and not stated:
            inform(
                "warning: the pictures do not tell whether they are aligned on a plane in the scene; depths in mm hold "
                "only if they are not: give --disparity-px, 0 if they are not aligned"
            )
        lens = replace(lens, fx_px=fx_px, fy_px=fx_px)
        write_imported_set(
            out,
            options,
            grid.posed(lens, pitch_mm, at_infinity_px, arrangement.pitch_ratio),
            reference=grid.centre,
            command="import grid",
            recorded=recorded | {"dn_per_value": grid.dn_per_value},
            models=[described.file] if described else [],
            sources=grid.sources,
            units=Units(depth="mm" if in_mm else "disparity_px" if len(grid.paths) > 1 else "relative"),
            arrangement=arrangement,
            also=partial(write_true_depth, described, grid) if described is not None and own_scale else None,
        )
    inform(f"{out}: {grid.size[0]} x {grid.size[1]} views of {width} x {height} px")
    return ImportedGrid(str(out), *grid.size, lens.size_px, len(grid.paths), arrangement)


def _scale(
    arrangement: Arrangement, width_px: float, pitch_mm: float | None, fx_px: float | None, disparity_px: float | None
) -> tuple[float, float, float, bool]:
    """Return pitch in mm, focal length in px, disparity in px of infinitely far points, and whether depths are in mm.

    Without a scale a nominal one is made in which all that was found is in front of the cameras.
    """
    focal_px = fx_px or width_px
    aligned = bool(arrangement.aligned) and disparity_px is None
    if (pitch_mm is None) != (fx_px is None) or (pitch_mm is not None and aligned):
        inform(
            "depths are stated as disparities in px: mm need --pitch-mm and --fx-px"
            + (", and --disparity-px as the pictures are aligned on a plane" if aligned else "")
        )
    if pitch_mm is not None and fx_px is not None and not aligned:
        return pitch_mm, focal_px, disparity_px or 0.0, True
    if disparity_px:
        # The plane on which the pictures are aligned gets a depth of its own
        return pitch_mm or _FREE_REFERENCE_DEPTH_MM * disparity_px / focal_px, focal_px, disparity_px, False
    at_infinity_px = 0.0
    if arrangement.disparity_range_px is not None:
        least, largest = arrangement.disparity_range_px
        # Ranges are those along columns of nodes, the scale is that along rows
        at_infinity_px = max(largest + _BEYOND_SHARE * (largest - least) + _BEYOND_PX, 0.0) / arrangement.pitch_ratio
        if at_infinity_px > 0:
            inform(
                f"infinitely far points are taken to have a disparity of {at_infinity_px:.2f} px, beyond all that were "
                "found, and the 2 % of a confidence are those of the difference from it; state it by --disparity-px"
            )
    return pitch_mm or 1.0, focal_px, at_infinity_px, False


@contextmanager
def _unpacked(src: Path, options: GridOptions, running: tuple[int, int] | None) -> Iterator[ImageGrid]:
    """Yield the views of a folder, see `find_grid`, or of one file; those that were unpacked are gone afterwards.

    A file is a TIFF with a picture for each view, row by row, or one picture of all views in equal tiles.
    """
    folder = Path(mkdtemp(prefix="faintfield-views-"))
    try:
        if is_file(src):
            yield _write_views(*_divide_file(src, folder, options.rows, options.columns), folder)
            return
        grid = find_grid(src, options.rows, options.columns, options.pattern, running=running)
        if read_frame(grid.sources[0]).pixels_dn.dtype.kind == "f":
            grid = _write_views(grid, lambda: ((path, read_frame(path).pixels_dn) for path in grid.sources), folder)
        yield grid
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _divide_file(src: Path, folder: Path, rows: int | None, columns: int | None) -> tuple[ImageGrid, _Views]:
    """Return the grid of the views in one file, as files of their own that are not written yet, and these views."""
    readable = IMAGE_SUFFIXES - RAW_SUFFIXES
    if picture_kind(src) not in readable:
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
    grid = ImageGrid(paths, remarks=remarks, guessed=guessed, sources=[src])
    if count > 1:
        return grid, lambda: ((path, read_frame(src, page=page).pixels_dn) for page, path in enumerate(paths.values()))
    picture = read_frame(src).pixels_dn
    height, width = picture.shape[:2]
    if height % rows or width % columns:
        raise BadValue(
            f"{src}: is {width} x {height} px, which {columns} columns and {rows} rows do not divide; correct --rows "
            "and --columns, or crop the margins away"
        )
    tiles = [tile for line in np.split(picture, rows) for tile in np.split(line, columns, axis=1)]
    return grid, lambda: zip(paths.values(), tiles, strict=True)


def _write_views(grid: ImageGrid, views: _Views, folder: Path) -> ImageGrid:
    """Write views as files of their own; floats become 16-bit numbers, linear, all by one factor."""
    _, first = next(iter(views()))
    require_room(folder, len(grid.paths) * 2 * first.size)
    factor = _dn_per_value(views) if first.dtype.kind == "f" else None
    paths = {}
    for node, (path, pixels) in zip(grid.paths, views(), strict=True):
        paths[node] = folder / f"{path.stem}.tiff"
        whole = pixels if factor is None else np.rint(np.maximum(pixels, 0) * factor).astype(np.uint16)
        write_frame(paths[node], whole)
    remarks = [] if factor is None else [f"float values became 16-bit numbers, linear, {factor:.6g} DN for 1"]
    return replace(grid, paths=paths, remarks=grid.remarks + remarks, dn_per_value=factor)


def _dn_per_value(views: _Views) -> float:
    """Return the factor by which float pictures, whose values are finite and not negative, become 16-bit ones."""
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
