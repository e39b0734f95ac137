"""`faintfield import grid`: an elemental set from a folder of pictures taken on a regular grid."""

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

from faintfield.calib.lens import Lens
from faintfield.pipelines.arguments import Count, Fraction, NotNegative, Positive
from faintfield.pipelines.console import inform
from faintfield.pipelines.errors import BadValue, MissingFile
from faintfield.pipelines.formats.exchange.imported_set import PosedImage, read_picture, write_imported_set
from faintfield.pipelines.formats.frames import IMAGE_SUFFIXES
from faintfield.pipelines.formats.sets.elemental_file import Noise
from faintfield.rig.grid import centre_node, grid_nodes, nominal_poses_rt_cam_ref

# Without a pitch the unit of length is free: the plane on which the pictures are aligned is put here.
_FREE_REFERENCE_DEPTH_MM = 1000.0


# Names that lack more than so many pictures for each one there is are not those of a grid.
_MOST_MISSING = 10

# The pictures by node, row by row: every node of the grid has one.
type _Grid = dict[tuple[int, int], Path]


def import_grid(
    src: Path,
    out: Path,
    /,
    *,
    pitch_mm: Positive | None = None,
    fx_px: Positive | None = None,
    disparity_px: NotNegative = 0.0,
    rows: Count | None = None,
    columns: Count | None = None,
    exposure_s: Positive | None = None,
    offset_dn: float | None = None,
    gain_dn_per_e: Positive = 1.0,
    read_noise_e: NotNegative = 0.0,
    dark_current_e_per_s: NotNegative = 0.0,
    quantum_efficiency: Fraction | None = None,
    overwrite: bool = False,
) -> dict[str, Any]:
    """Make an elemental set from pictures taken on a regular grid.

    The node of a picture is read from the last two numbers of its name, row then column, as in view_r3_c12.jpg; names
    without two numbers are taken in order, row by row, with --rows and --columns. Row 0 is the top, column 0 the left.
    Pictures are kept as they are, except that 8-bit ones become 16-bit TIFF with the same values. They are taken to be
    proportional to light: photographs with a gamma curve, as most JPEGs are, give pictures but no photometry.

    Parameters
    ----------
    src
        Folder of pictures: TIFF, PNG, JPEG or raw.
    out
        Folder to write.
    pitch_mm
        Distance of neighbouring nodes. Without it depths are relative: 1000 is the plane of --disparity-px.
    fx_px
        Focal length; the width of a picture by default.
    disparity_px
        For pictures aligned (rectified) on a plane: by how many pixels that plane moved from node to node before it
        was aligned (a positive number), which with the pitch sets its depth to fx · pitch / disparity. 0: not aligned.
    rows
        Of the grid, where names do not tell.
    columns
        Of the grid, where names do not tell.
    exposure_s
        Of each picture; from EXIF by default, 1 s where there is none.
    offset_dn
        Dark level. Raw files bring their own; 0 for others.
    gain_dn_per_e
        DN per electron.
    read_noise_e
        Standard deviation of the read noise.
    dark_current_e_per_s
        Dark electrons per pixel and second.
    quantum_efficiency
        Electrons per photon; without it nothing is said in photons.
    overwrite
        Replace an earlier set in OUT.
    """
    options = {name: value for name, value in locals().items() if name not in ("src", "out", "overwrite")}
    paths = _find_grid(src, rows, columns)
    height, width = read_picture(next(iter(paths.values()))).pixels_dn.shape[:2]
    focal_px = fx_px or float(width)
    if pitch_mm is None:
        pitch_mm = _FREE_REFERENCE_DEPTH_MM * disparity_px / focal_px if disparity_px else 1.0
    lens = Lens((width, height), focal_px, focal_px, (width - 1) / 2, (height - 1) / 2)
    rows, columns = _size(paths)
    write_imported_set(
        out,
        _posed(paths, lens, pitch_mm, disparity_px),
        reference=list(paths).index(centre_node(rows, columns)),
        noise=Noise(gain_dn_per_e, read_noise_e, offset_dn, dark_current_e_per_s, quantum_efficiency),
        exposure_s=exposure_s,
        command="import grid",
        options=options,
        overwrite=overwrite,
    )
    inform(f"{out}: {rows} x {columns} views of {width} x {height} px")
    return {"out": str(out), "rows": rows, "columns": columns, "size_px": lens.size_px}


def _posed(paths: _Grid, lens: Lens, pitch_mm: float, disparity_px: float) -> list[PosedImage]:
    """Return the pictures at nominal poses; aligning them on a plane has moved their principal points."""
    row_0, column_0 = centre_node(*_size(paths))
    poses = nominal_poses_rt_cam_ref(*_size(paths), pitch_mm)
    images = []
    for ((row, column), path), pose in zip(paths.items(), poses, strict=True):
        cx_px = lens.cx_px + disparity_px * (column - column_0)
        cy_px = lens.cy_px + disparity_px * (row - row_0)
        images.append(PosedImage(path, replace(lens, cx_px=cx_px, cy_px=cy_px), pose, (row, column)))
    return images


def _size(paths: _Grid) -> tuple[int, int]:
    """Return how many rows and columns a grid has."""
    last_row, last_column = map(max, zip(*paths, strict=True))
    return last_row + 1, last_column + 1


def _find_grid(src: Path, rows: int | None, columns: int | None) -> _Grid:
    """Return the pictures of a folder by node; every node of the grid must have one."""
    if not src.is_dir():
        raise MissingFile(f"{src}: no such folder; name the folder that holds the pictures")
    paths = sorted(path for path in src.iterdir() if path.suffix.lower() in IMAGE_SUFFIXES and path.is_file())
    if not paths:
        raise MissingFile(f"{src}: holds no pictures; formats read are {', '.join(sorted(IMAGE_SUFFIXES))}")
    if rows is not None or columns is not None:
        return _grid_in_order(src, paths, rows or 1, columns or 1)
    if len(paths) == 1:
        return {(0, 0): paths[0]}
    named: dict[tuple[int, int], Path] = {}
    for path in paths:
        numbers = re.findall(r"\d+", path.stem)
        if len(numbers) < 2:
            raise BadValue(f"{path}: its name has no row and column; give --rows and --columns to take files in order")
        node = int(numbers[-2]), int(numbers[-1])
        if node in named:
            raise BadValue(f"{path}: is at node {node} like {named[node].name}; keep one of the two")
        named[node] = path
    return _complete_grid(src, named)


def _grid_in_order(src: Path, paths: list[Path], rows: int, columns: int) -> _Grid:
    """Return the pictures in the order of their names as a grid of the size given."""
    if len(paths) != rows * columns:
        raise MissingFile(
            f"{src}: holds {len(paths)} pictures, a grid of {rows} x {columns} needs {rows * columns}; "
            "correct --rows and --columns, or add the missing ones"
        )
    return dict(zip(grid_nodes(rows, columns), paths, strict=True))


def _complete_grid(src: Path, named: dict[tuple[int, int], Path]) -> _Grid:
    """Return the pictures with nodes counted from zero, refusing a grid with a gap."""
    row_0, column_0 = (min(node[axis] for node in named) for axis in (0, 1))
    paths = {(row - row_0, column - column_0): path for (row, column), path in sorted(named.items())}
    rows, columns = _size(paths)
    missing = rows * columns - len(paths)
    if missing > _MOST_MISSING * len(paths):
        raise BadValue(
            f"{src}: numbers in names like {next(iter(paths.values())).name} would make a grid of {rows} x {columns} "
            f"of {len(paths)} pictures: they are no row and column; give --rows and --columns to take files in order"
        )
    if missing:
        row, column = next(node for node in grid_nodes(rows, columns) if node not in paths)
        raise MissingFile(
            f"{src}: the view of node {(row + row_0, column + column_0)} is missing, "
            f"{missing} of {rows * columns} in all; add it, or give --rows and --columns for a smaller grid"
        )
    return paths
