"""Views of a grid put in order by what their pictures show, or refused by name."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from faintfield.calib.arrangement.axes import SURE
from faintfield.calib.arrangement.look import Look
from faintfield.calib.arrangement.orientation import Orientation
from faintfield.pipelines.errors import AmbiguousOrder, CameraTurned, CopiedPicture, NotOneScene, ShuffledPictures
from faintfield.pipelines.formats.exchange.grid_orders import Grey, look_at_grid
from faintfield.pipelines.formats.exchange.grid_places import Node
from faintfield.pipelines.formats.exchange.image_grid import ImageGrid
from faintfield.pipelines.formats.exchange.imported_set import read_picture
from faintfield.pipelines.formats.sets.elemental_file import Arrangement

# Contrast over white, and mean light over noise, above which pictures in which nothing is seen are not dark, but show
# no scene in common.
_BRIGHT, _OVER_NOISE = 0.02, 1.2

# Share of views that may be odd; of missing ones, `find_grid` decides.
_MAX_ODD_SHARE = 0.25

# Rotation in degrees and magnification against the other views that planes cannot use.
_MAX_DEG, _MAX_SCALE = 5.0, 0.1

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
    NotOneScene, CopiedPicture, ShuffledPictures, AmbiguousOrder, CameraTurned
        The pictures are no views of one scene from a grid, or do not tell which.
    """
    grid, found = look_at_grid(grid, given, read)
    paths = list(grid.paths.values())
    _refuse_copies(found, paths)
    if found.unseen == "dark" and found.contrast > _BRIGHT * white and found.mean > _OVER_NOISE * found.noise:
        raise NotOneScene(
            f"{paths[0].parent}: neighbouring pictures share nothing ({found.match_z:.1f} standard errors, "
            f"{SURE:g} are needed); give views of one scene, taken from neighbouring places"
        )
    _refuse_odd(found, paths)
    if found.order.verdict == "denied" and given is None:
        raise ShuffledPictures(
            f"{paths[0].parent}: neighbours by the names fit better than only {found.order.share:.0%} of other "
            "pictures, in a light field they fit better than nearly all; give views of one scene in the order of the "
            "grid, by their names, by --pattern, or by --rows and --columns"
        )
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
        remedy = f"give {options_of(found.orientation)} or {options_of(other)}"
    else:
        remedy = f"give {options_of(other)}, or --disparity-px if they are aligned on a plane nearer than the scene"
    return (
        f"{folder}: two orders of the views are equally likely: disparities of {least:.2f} … {largest:.2f} px with "
        f"{options_of(found.orientation) or 'the order of the names'}, or {-largest:.2f} … {-least:.2f} px with "
        f"{options_of(other) or 'the order of the names'}, and no hidden parts tell near from far "
        f"({found.side_z:.1f} standard errors); {remedy}"
    )


def _opposed(orientation: Orientation) -> bool:
    """Tell whether one of rows and columns is reversed."""
    return orientation.flip_rows != orientation.flip_columns


def options_of(orientation: Orientation) -> str:
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
