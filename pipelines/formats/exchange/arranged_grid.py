"""Views of a grid put in order by what their pictures show, or refused by name; and a table of what was found."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rich.table import Table

from faintfield.calib.arrangement.axes import SURE
from faintfield.calib.arrangement.look import Look
from faintfield.calib.arrangement.orientation import Orientation
from faintfield.pipelines.console import console, inform, visible
from faintfield.pipelines.errors import AmbiguousOrder, CameraTurned, CopiedPicture, NotOneScene
from faintfield.pipelines.formats.exchange.grid_orders import Grey, look_at_grid
from faintfield.pipelines.formats.exchange.grid_places import Node
from faintfield.pipelines.formats.exchange.image_grid import ImageGrid
from faintfield.pipelines.formats.exchange.imported_set import read_picture
from faintfield.pipelines.formats.sets.elemental_file import Arrangement

# Contrast over white above which pictures in which nothing is seen are not dark, but show no scene in common.
_BRIGHT = 0.02

# Share of views that may be odd; of missing ones, `find_grid` decides.
_MAX_ODD_SHARE = 0.25

# Rotation in degrees and magnification against the other views that are worth a word, and that planes cannot use.
_SAID_DEG, _SAID_SCALE, _MAX_DEG, _MAX_SCALE = 0.3, 0.005, 5.0, 0.1

# Displacement in px beyond what disparities explain that is worth a word.
_SAID_PX = 1.0

# Spread of light between views that is worth a word.
_SAID_LIGHT = 0.1


@dataclass(frozen=True)
class ArrangedGrid:
    """Views by row and column, x to the right and y down, and what was found."""

    grid: ImageGrid
    found: Look
    arrangement: Arrangement


def grey_picture(path: Path, size_px: tuple[int, int] | None = None) -> NDArray[np.float32]:
    """Return a picture (row, column) without colours: their mean, of a mosaic that of each period.

    Raises
    ------
    WrongSize
        It has not the width and height of `size_px`, those of the first picture.
    """
    frame = read_picture(path, size_px)
    pixels = frame.pixels_dn.astype(np.float32)
    if pixels.ndim == 3:
        return np.asarray(pixels.mean(axis=2), np.float32)
    if frame.mosaic is None:
        return pixels
    rows, columns = len(frame.mosaic), len(frame.mosaic[0])
    height, width = pixels.shape[0] // rows, pixels.shape[1] // columns
    periods = pixels[: height * rows, : width * columns].reshape(height, rows, width, columns)
    return np.asarray(np.repeat(np.repeat(periods.mean(axis=(1, 3)), rows, 0), columns, 1), np.float32)


def arranged(
    grid: ImageGrid, given: Orientation | None, *, white: float, aligned_stated: bool = False, read: Grey = grey_picture
) -> ArrangedGrid:
    """Look at the pictures of a grid and put them in order.

    Parameters
    ----------
    grid : ImageGrid
        Pictures by the two numbers of their names, or by their place in a list.
    given : Orientation, optional
        The order, if options state it; the pictures are then only measured.
    white : float
        Value of a white pixel.
    aligned_stated : bool
        A person stated that the pictures are aligned, so that disparities may have any sign.
    read : callable
        Returns the grey picture (row, column) of a file.

    Raises
    ------
    NotOneScene, CopiedPicture, AmbiguousOrder, CameraTurned
        The pictures are no views of one scene from a grid, or do not tell which.
    """
    grid, found = look_at_grid(grid, given, read)
    paths = list(grid.paths.values())
    _refuse_copies(found, paths)
    if not found.seen and found.contrast > _BRIGHT * white and found.match_z:
        raise NotOneScene(
            f"{paths[0].parent}: neighbouring pictures share nothing ({found.match_z:.1f} standard errors, "
            f"{SURE:g} are needed); give views of one scene, taken from neighbouring places"
        )
    _refuse_odd(found, paths)
    if found.undecided and not (aligned_stated and not _opposed(found.orientation)):
        raise AmbiguousOrder(_two_orders(found, paths[0].parent))
    _refuse_turns(found, paths)
    nodes = found.orientation.of(list(grid.paths))
    arranged_grid = grid.turned(found.orientation).without([nodes[index] for index in found.odd])
    return ArrangedGrid(arranged_grid, found, _arrangement(arranged_grid, found, paths, nodes, given is not None))


def _refuse_copies(found: Look, paths: Sequence[Path]) -> None:
    """Refuse a picture that is there twice."""
    if found.copies:
        first, second = (paths[index] for index in found.copies[0])
        count = len({index for pair in found.copies for index in pair})
        raise CopiedPicture(
            f"{second}: is the same picture as {first.name}; {count} of {len(paths)} pictures are copies of others, "
            "which views from different places cannot be; leave out all but one, or give the right pictures"
        )


def _refuse_odd(found: Look, paths: Sequence[Path]) -> None:
    """Refuse a set of which many views fit no other."""
    if len(found.odd) > _MAX_ODD_SHARE * len(paths):
        names = ", ".join(paths[index].name for index in found.odd[:4])
        raise NotOneScene(
            f"{paths[0].parent}: {len(found.odd)} of {len(paths)} pictures fit none of their neighbours ({names} …); "
            "give views of one scene in the order of the grid"
        )


def _refuse_turns(found: Look, paths: Sequence[Path]) -> None:
    """Refuse views that are turned or magnified more than planes can use."""
    for what, values, limit, unit in (
        ("turned", np.degrees(found.turn_rad), _MAX_DEG, "°"),
        ("magnified", 100 * (found.scale - 1), 100 * _MAX_SCALE, " %"),
    ):
        worst = int(np.argmax(np.abs(values)))
        if abs(values[worst]) > limit:
            raise CameraTurned(
                f"{paths[worst]}: is {what} by {values[worst]:.1f}{unit} against the other views, at most "
                f"{limit:g}{unit} is possible on a grid; calibrate the cameras (import colmap), or leave it out"
            )


def _two_orders(found: Look, folder: Path) -> str:
    """Return the message that shows two orders that are equally likely."""
    least, largest = found.disparity_px or (0.0, 0.0)
    other = found.orientation.turned()
    if _opposed(found.orientation):
        remedy = f"give {_options(found.orientation)} or {_options(other)}"
    else:
        remedy = f"give {_options(other)}, or --disparity-px if they are aligned on a plane nearer than the scene"
    return (
        f"{folder}: two orders of the views are equally likely: disparities of {least:.2f} … {largest:.2f} px with "
        f"{_options(found.orientation) or 'the order of the names'}, or {-largest:.2f} … {-least:.2f} px with "
        f"{_options(other) or 'the order of the names'}, and no hidden parts tell near from far "
        f"({found.side_z:.1f} standard errors); {remedy}"
    )


def _opposed(orientation: Orientation) -> bool:
    """Tell whether one of rows and columns is reversed."""
    return orientation.flip_rows != orientation.flip_columns


def _options(orientation: Orientation) -> str:
    """Return the options that state an orientation."""
    flags = {"--transpose": orientation.transpose, "--flip-rows": orientation.flip_rows}
    flags["--flip-columns"] = orientation.flip_columns
    return " ".join(option for option, wanted in flags.items() if wanted)


def _arrangement(
    grid: ImageGrid, found: Look, paths: Sequence[Path], nodes: Sequence[Node], by_options: bool
) -> Arrangement:
    """Return the record of what was found."""
    light = dict(zip(nodes, found.light.tolist(), strict=True))
    uneven = found.seen and float(np.ptp(found.light)) > _SAID_LIGHT
    return Arrangement(
        disparity_range_px=_rounded(found.disparity_px),
        told_by="options" if by_options else found.direction,
        transposed=found.orientation.transpose,
        rows_flipped=found.orientation.flip_rows,
        columns_flipped=found.orientation.flip_columns,
        aligned=found.aligned,
        pitch_ratio=round(found.ratio, 4),
        missing=tuple(grid.missing),
        odd_views=tuple(paths[index].name for index in found.odd),
        turn_deg=round(float(np.degrees(np.abs(found.turn_rad).max())), 3) if found.seen else 0.0,
        relative_light=tuple(round(light[node], 4) for node in grid.paths) if uneven else (),
    )


def _rounded(range_px: tuple[float, float] | None) -> tuple[float, float] | None:
    """Return a range to the hundredth of a pixel, which is less than its margin."""
    return None if range_px is None else (round(range_px[0], 2), round(range_px[1], 2))


def show_arrangement(result: ArrangedGrid) -> None:
    """Print a small table of what was found, and what is worth a warning."""
    table = Table(show_header=False, box=None, padding=(0, 2, 0, 0))
    rows = _rows(result)
    for what, said in rows:
        table.add_row(visible(what), visible(said))
    console.print(table)
    for line in _warnings(result):
        inform(line)


def _rows(result: ArrangedGrid) -> list[tuple[str, str]]:
    """Return what was found, in words."""
    found, record = result.found, result.arrangement
    rows, columns = result.grid.size
    said = [("grid", f"{rows} rows x {columns} columns, {len(result.grid.paths)} views")]
    if not found.seen:
        return [*said, ("order", "as in the names: the pictures do not tell")]
    options = _options(found.orientation)
    order = f"not as in the names: {options}" if options else "as in the names: right and down"
    how = {
        "pictures": f"hidden parts tell near from far, {abs(found.side_z):.0f} standard errors",
        "signs": "near points move against the camera",
        "names": "the pictures do not tell it from its opposite",
        "options": "as the options state",
    }
    said.append(("order", f"{order} ({how[record.told_by]})"))
    if record.disparity_range_px is not None:
        least, largest = record.disparity_range_px
        said.append(("disparities", f"{least:.2f} … {largest:.2f} px from node to node"))
        said.append(("aligned", {True: "on a plane in the scene", False: "no", None: "not known"}[record.aligned]))
    if record.pitch_ratio != 1.0:
        said.append(("pitch", f"columns {record.pitch_ratio:.3f} times as far apart as rows"))
    if record.relative_light:
        least_light, most_light = min(record.relative_light), max(record.relative_light)
        said.append(("light", f"{least_light:.2f} … {most_light:.2f} of the typical view"))
    if record.missing:
        said.append(("missing", ", ".join(f"({row}, {column})" for row, column in record.missing)))
    return said


def _warnings(result: ArrangedGrid) -> list[str]:
    """Return what a person should know before using the set."""
    found, record = result.found, result.arrangement
    lines = []
    if found.contradicted:
        lines.append(
            "the pictures contradict the order that the options state; without them it is found from the pictures"
        )
    if not found.seen:
        lines.append("nothing is seen in single pictures or their averages; the order of the names is kept")
    elif record.told_by == "names":
        lines.append("the pictures do not tell where rows and columns begin; the order of the names is kept")
    if record.odd_views:
        lines.append(f"fit none of their neighbours, and are left out: {', '.join(record.odd_views)}")
    worst = int(np.argmax(np.abs(found.shift_px).max(axis=1)))
    if float(np.abs(found.shift_px[worst]).max()) > _SAID_PX:
        x_px, y_px = found.shift_px[worst]
        lines.append(
            f"views are shifted against their neighbours, by up to ({x_px:.1f}, {y_px:.1f}) px: the camera was off the "
            "grid; planes are sharper with calibrated poses (import colmap)"
        )
    if record.turn_deg > _SAID_DEG:
        lines.append(f"views are turned by up to {record.turn_deg:.2f}°; a grid's camera does not turn")
    if found.seen and float(np.abs(found.scale - 1).max()) > _SAID_SCALE:
        lines.append(f"views are magnified by up to {100 * float(np.abs(found.scale - 1).max()):.1f} %")
    return lines
