"""`faintfield import grid`: an elemental set from a folder of pictures taken on a regular grid."""

import re
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from pipelines.arguments import Count, Fraction, NotNegative, Positive
from pipelines.console import progress, say
from pipelines.elemental_set import Camera, ElementalSet, Noise, View, write_set
from pipelines.errors import BadValue, MissingFile, WrongSize
from pipelines.files import building_folder, sha256, write_json
from pipelines.frames import IMAGE_SUFFIXES, RAW_SUFFIXES, Frame, read_frame
from pipelines.image_files import write_frame
from pipelines.provenance import provenance
from rig.grid import centre_node, nominal_poses_rt_cam_ref

# Without a pitch the unit of length is free: the plane on which the pictures are aligned is put here.
_FREE_REFERENCE_DEPTH_MM = 1000.0


@dataclass(frozen=True)
class _Grid:
    """The pictures by node."""

    paths: dict[tuple[int, int], Path]
    rows: int
    columns: int


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
    grid = _find_grid(src, rows, columns)
    first = _read_picture(next(iter(grid.paths.values())))
    noise = Noise(
        gain_dn_per_e=gain_dn_per_e,
        read_noise_e=read_noise_e,
        offset_dn=offset_dn if offset_dn is not None or first.black_dn is not None else 0.0,
        dark_current_e_per_s=dark_current_e_per_s,
        quantum_efficiency=quantum_efficiency,
        saturation_dn=_saturation_dn(first),
    )
    exposure_s = exposure_s or first.exposure_s
    if exposure_s is None:
        say("the pictures do not state their exposure; 1 s is assumed, which matters for dark current only")
        exposure_s = 1.0
    with building_folder(out, replace_if="elemental.toml" if overwrite else None, reads=src) as folder:
        camera, views = _copy_views(grid, folder, first, pitch_mm, fx_px, disparity_px)
        row, column = centre_node(grid.rows, grid.columns)
        write_set(folder, ElementalSet(1, exposure_s, row * grid.columns + column, camera, noise, views))
        inputs = {path.name: sha256(path) for path in grid.paths.values()}
        write_json(folder / "provenance.json", provenance("import grid", options, inputs))
    say(f"{out}: {grid.rows} x {grid.columns} views of {camera.size_px[0]} x {camera.size_px[1]} px")
    return {"out": str(out), "rows": grid.rows, "columns": grid.columns, "size_px": camera.size_px}


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
        return _Grid({(0, 0): paths[0]}, 1, 1)
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
    nodes = [(row, column) for row in range(rows) for column in range(columns)]
    return _Grid(dict(zip(nodes, paths, strict=True)), rows, columns)


def _complete_grid(src: Path, named: dict[tuple[int, int], Path]) -> _Grid:
    """Return the pictures with nodes counted from zero, refusing a grid with a gap."""
    row_0, column_0 = (min(node[axis] for node in named) for axis in (0, 1))
    paths = {(row - row_0, column - column_0): path for (row, column), path in sorted(named.items())}
    rows, columns = (max(node[axis] for node in paths) + 1 for axis in (0, 1))
    missing = [node for node in np.ndindex(rows, columns) if node not in paths]
    if missing:
        raise MissingFile(
            f"{src}: the view of node {(missing[0][0] + row_0, missing[0][1] + column_0)} is missing, "
            f"{len(missing)} of {rows * columns} in all; add it, or give --rows and --columns for a smaller grid"
        )
    return _Grid(paths, rows, columns)


def _read_picture(path: Path) -> Frame:
    """Read a picture whose pixels are what a camera's are."""
    frame = read_frame(path)
    if frame.pixels_dn.dtype not in (np.uint8, np.uint16):
        raise BadValue(
            f"{path}: holds {frame.pixels_dn.dtype} pixels; 8- or 16-bit whole numbers are wanted; convert it"
        )
    return frame


def _saturation_dn(frame: Frame) -> float:
    """Return the value at which a picture's pixels are full."""
    return frame.saturation_dn or float(np.iinfo(frame.pixels_dn.dtype).max)


def _copy_views(
    grid: _Grid, folder: Path, first: Frame, pitch_mm: float | None, fx_px: float | None, disparity_px: float
) -> tuple[Camera, list[View]]:
    """Copy every picture into the set, and return the camera and the views at nominal poses."""
    height, width = first.pixels_dn.shape[:2]
    focal_px = fx_px or float(width)
    if pitch_mm is None:
        pitch_mm = _FREE_REFERENCE_DEPTH_MM * disparity_px / focal_px if disparity_px else 1.0
    camera = Camera((width, height), focal_px, focal_px, (width - 1) / 2, (height - 1) / 2)
    poses = nominal_poses_rt_cam_ref(grid.rows, grid.columns, pitch_mm)
    row_0, column_0 = centre_node(grid.rows, grid.columns)
    views = []
    for index, (node, path) in enumerate(progress(grid.paths.items(), "copying pictures", len(grid.paths))):
        view = View(_copy_picture(path, folder, first), tuple(poses[index].tolist()), node)
        if disparity_px != 0:
            cx_px = camera.cx_px + disparity_px * (node[1] - column_0)
            cy_px = camera.cy_px + disparity_px * (node[0] - row_0)
            view = msgspec.structs.replace(view, cx_px=cx_px, cy_px=cy_px)
        views.append(view)
    return camera, views


def _copy_picture(path: Path, folder: Path, first: Frame) -> str:
    """Copy a picture as it is, or as 16-bit TIFF when it has 8 bits; return its name in the set."""
    frame = _read_picture(path)
    if frame.pixels_dn.shape != first.pixels_dn.shape:
        raise WrongSize(
            f"{path}: is {frame.pixels_dn.shape}, the first picture {first.pixels_dn.shape} (rows, columns, colours); "
            "all must be alike; take it again or leave it out"
        )
    as_it_is = path.suffix.lower() in RAW_SUFFIXES or frame.pixels_dn.dtype == np.uint16
    name = path.name if as_it_is else f"{path.stem}.tiff"
    if (folder / name).exists():
        raise BadValue(f"{path}: would become {name} like another picture; give it another name")
    if as_it_is:
        shutil.copyfile(path, folder / name)
    else:
        write_frame(folder / name, frame.pixels_dn.astype(np.uint16))
    return name
