"""Views of a grid put in order by their pictures, with a report of what these show, or refused by name."""

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from rich.table import Table

from faintfield.calib.arrangement.inspection import MIN_SIDE_PX, GridInspection, inspect_grid
from faintfield.calib.arrangement.matching import SURE, Array
from faintfield.calib.arrangement.views import Node, Orientation, prepare_pictures
from faintfield.calib.lens import Lens
from faintfield.pipelines.console import console, inform
from faintfield.pipelines.errors import AmbiguousOrder, CameraTurned, CopiedPicture, NotOneScene, ShuffledPictures
from faintfield.pipelines.formats.exchange.image_grid import ImageGrid
from faintfield.pipelines.formats.exchange.imported_set import read_picture
from faintfield.pipelines.formats.sets.elemental_file import Arrangement
from faintfield.rig.plan import grid_nodes

# Contrast over white, and mean light over noise, above which pictures that share nothing are not dark, but show no
# scene in common.
_BRIGHT, _OVER_NOISE = 0.02, 1.2

# Share of views that may be odd; of missing ones, `find_grid` decides.
_MAX_ODD_SHARE = 0.25

# Rotation in degrees and magnification against the other views that planes cannot use, and those worth a word; spread
# of light between views, and displacement in px beyond what disparities explain, that are worth a word. All
# but the light also exceed their standard errors by a factor: in 135 regular sets of 3 x 3 views of 56 x 42, 64 x 48
# and 72 x 54 px, at an SNR of 3, 7 and 20, no number beyond its limit exceeded them 2.7 times.
_MAX_DEG, _MAX_SCALE = 5.0, 0.1
_NOTABLE_DEG, _NOTABLE_SCALE, _NOTABLE_LIGHT, _NOTABLE_PX, _NOTABLE_SIGMAS = 0.3, 0.005, 0.1, 1.0, 4.0

# Correlation by which the blocks must agree better in another order of a list.
_MIN_LEVEL_GAIN = 0.05

# Displacement in px beyond what disparities explain from which names may run back and forth, and the share of it that
# may remain if they do.
_DOUBTFUL_PX, _MAX_SHIFT_SHARE = 0.15, 0.5

# Side of the squares over which what lies beyond the edges of an undistorted picture is averaged, twice, in px of
# pictures of up to so many px; larger ones are reduced before they are compared.
_BORDER_PX, _BORDER_OF_PX = 15, 448

# Reasons why no scene is seen.
_FAILURES = {
    "small": f"the pictures are smaller than {MIN_SIDE_PX} px, too small to be compared",
    "single": "one picture has no other to be compared with",
    "even": "all pixels of each picture are alike, so nothing can be found in them",
    "apart": "no picture has a neighbour to be compared with",
    "dark": "nothing is seen in single pictures or their averages; they are too dark, or show nothing in common",
}

type _Inspect = Callable[[Sequence[Node]], GridInspection]


def _read_grey(path: Path, size_px: tuple[int, int]) -> NDArray[np.float32]:
    """Return a picture (row, column) without colours: their mean, of a mosaic that of each period."""
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


def _undistorter(lens: Lens) -> Callable[[NDArray[np.float32]], NDArray[np.float32]]:
    """Return a function that shows pictures as a pinhole of the lens's focal length and principal point sees them.

    Beyond the edges of a picture, its pixels there go on without detail, which would be at one place in all views.
    """
    if not any(lens.distortion):
        return lambda picture: picture
    maps = lens.undistortion_maps()
    (column, row), (width, height) = maps, lens.size_px
    seen = (column >= 0) & (row >= 0) & (column <= width - 1) & (row <= height - 1)
    side = _BORDER_PX * -(-max(lens.size_px) // _BORDER_OF_PX)

    def undistort(picture: NDArray[np.float32]) -> NDArray[np.float32]:
        undistorted = cv2.remap(picture, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        smooth = cv2.blur(cv2.blur(undistorted, (side, side)), (side, side))
        return np.asarray(np.where(seen, undistorted, smooth), np.float32)

    return undistort


def arrange_grid(
    grid: ImageGrid,
    prescribed: Orientation | None,
    *,
    white: float,
    aligned: bool = False,
    lens: Lens,
) -> tuple[ImageGrid, Arrangement]:
    """Inspect the pictures of a grid, put them in order, and print what they show.

    If options prescribe the order, the pictures are only measured. `white` is the value of a white pixel; `aligned`
    says that a person stated that the pictures are aligned, so that disparities may have any sign; the distortion of
    the lens is undone before pictures are compared.

    Raises
    ------
    NotOneScene, CopiedPicture, ShuffledPictures, AmbiguousOrder, CameraTurned
        The pictures are no views of one scene from a grid, or do not tell which.
    """
    paths = list(grid.paths.values())
    undistort = _undistorter(lens)
    pictures = prepare_pictures(undistort(_read_grey(path, lens.size_px)) for path in paths)
    if copies := pictures.copies():
        first, second = (paths[index] for index in copies[0])
        count = len({index for pair in copies for index in pair})
        raise CopiedPicture(
            f"{second}: is the same picture as {first.name}; {count} of {len(paths)} pictures are copies of others, "
            "which views from different places cannot be; leave out all but one, or give the right pictures"
        )
    inspect = partial(inspect_grid, pictures=pictures, prescribed=prescribed)
    nodes, inspection = _choose_order(grid, inspect, fixed=prescribed is not None or grid.measured is not None)
    bright = pictures.contrast > _BRIGHT * white and float(np.median(pictures.mean)) > _OVER_NOISE * pictures.noise
    if inspection.failure == "dark" and bright:
        raise NotOneScene(
            f"{paths[0].parent}: neighbouring pictures share nothing ({inspection.axes.match_z:.1f} standard errors, "
            f"{SURE:g} are needed); give views of one scene, taken from neighbouring places"
        )
    _refuse_unfit(inspection, paths, prescribed=prescribed is not None, aligned=aligned)
    orientation, fits = inspection.orientation, inspection.fits
    arranged = grid.moved(orientation.apply(nodes), transposed=orientation.transpose, omit=fits.odd)
    light = dict(zip(paths, pictures.relative_light.tolist(), strict=True))
    uneven = inspection.failure is None and np.ptp(pictures.relative_light) > _NOTABLE_LIGHT
    least, largest = (round(limit, 2) for limit in inspection.range_px)
    record = Arrangement(
        disparity_range_px=None if inspection.failure else (least, largest),
        told_by="options" if prescribed else inspection.direction,
        transposed=orientation.transpose,
        rows_flipped=orientation.flip_rows,
        columns_flipped=orientation.flip_columns,
        aligned=inspection.aligned,
        pitch_ratio=round(inspection.ratio, 4),
        missing=tuple(node for node in grid_nodes(*arranged.size) if node not in arranged.paths),
        odd_views=tuple(paths[index].name for index in fits.odd),
        turn_deg=round(float(np.degrees(np.abs(fits.turn_rad).max())), 3),
        relative_light=tuple(round(light[path], 4) for path in arranged.paths.values()) if uneven else (),
        irregular=inspection.failure is None and any(_irregularities(inspection)),
    )
    _print_table(arranged, record, inspection, lens)
    for warning in _warnings(record, inspection, len(paths)):
        inform(warning)
    return arranged, record


def _choose_order(grid: ImageGrid, inspect: _Inspect, *, fixed: bool) -> tuple[list[Node], GridInspection]:
    """Inspect a grid and, where its order is doubtful, others; return the nodes by which the pictures agree."""
    nodes = list(grid.paths)
    inspection = inspect(nodes)
    rows, columns = grid.size
    if fixed or min(rows, columns) == 1:
        return nodes, inspection
    if grid.guessed and not inspection.order.is_certain and (line := _line_of_views(grid, inspection, inspect)):
        return line
    if grid.ordered and rows != columns:
        by_column = [(place % rows, place // rows) for row, column in nodes for place in [row * columns + column]]
        other = inspect(by_column)
        # The order as documented unless the other agrees clearly more
        if other.failure is None and other.axes.level > inspection.axes.level + _MIN_LEVEL_GAIN:
            nodes, inspection = by_column, other
    if inspection.fits.shift_rms_px > _DOUBTFUL_PX:
        reversed_kind = None
        for kind, reversed_nodes in _back_and_forth(nodes).items():
            other = inspect(reversed_nodes)
            fits_as_well = other.failure is None and len(other.fits.odd) <= len(inspection.fits.odd)
            straighter = other.fits.shift_rms_px < _MAX_SHIFT_SHARE * inspection.fits.shift_rms_px
            if fits_as_well and straighter and other.axes.level >= inspection.axes.level:
                nodes, inspection, reversed_kind = reversed_nodes, other, kind
        if reversed_kind:
            inform(f"names run back and forth: the pictures agree if every other {reversed_kind} is reversed")
    return nodes, inspection


def _line_of_views(
    grid: ImageGrid, square: GridInspection, inspect: _Inspect
) -> tuple[list[Node], GridInspection] | None:
    """Return a guessed square as one line of views if the neighbours fit in that only; AmbiguousOrder if in both."""
    (rows, columns), count = grid.size, len(grid.paths)
    nodes = [(0, place) for place in range(count)]
    line = inspect(nodes)
    if line.order.verdict != "fits":
        return None
    # The views of a square whose rows run back and forth make a line, too
    if any(inspect(other).order.is_certain for other in _back_and_forth(list(grid.paths)).values()):
        return None
    if square.failure or square.order.verdict == "denied":
        inform(f"the pictures show one line of {count} views, not {rows} x {columns}")
        return nodes, line
    if square.order.verdict == "fits" and square.order.share < line.order.share:
        raise AmbiguousOrder(
            f"{next(iter(grid.paths.values())).parent}: the views may be a grid of {rows} x {columns}, whose "
            f"neighbours fit better than {square.order.share:.0%} of other pictures, or one line of {count}, whose "
            f"neighbours fit better than {line.order.share:.0%}; give --rows {rows} --columns {columns}, "
            f"--rows 1 --columns {count}, or --rows {count} --columns 1"
        )
    return None


def _back_and_forth(nodes: list[Node]) -> dict[str, list[Node]]:
    """Return nodes with every other row reversed, as gantries move, and with every other column."""
    last_row, last_column = np.max(nodes, axis=0).tolist()
    return {
        "row": [(row, last_column - column if row % 2 else column) for row, column in nodes],
        "column": [(last_row - row if column % 2 else row, column) for row, column in nodes],
    }


def _refuse_unfit(inspection: GridInspection, paths: Sequence[Path], *, prescribed: bool, aligned: bool) -> None:
    """Refuse pictures in no order or in two, sets of which many views fit no other, and views that are turned."""
    folder, fits = paths[0].parent, inspection.fits
    if len(fits.odd) > _MAX_ODD_SHARE * len(paths):
        names = ", ".join(paths[index].name for index in fits.odd[:4])
        raise NotOneScene(
            f"{folder}: {len(fits.odd)} of {len(paths)} pictures fit none of their neighbours ({names} …); "
            "give views of one scene in the order of the grid"
        )
    if inspection.order.verdict == "denied" and not prescribed:
        raise ShuffledPictures(
            f"{folder}: the neighbours of a picture, by the names, fit it better than {inspection.order.share:.0%} of "
            "the others do, and in a light field better than nearly all do; give views of one scene in the order of "
            "the grid, by their names, by --pattern, or by --rows and --columns; or give --keep-order if the order of "
            "the names is right"
        )
    (least, largest), orientation = inspection.range_px, inspection.orientation
    if inspection.undecided and not (aligned and not orientation.opposed):
        options, other = _options(orientation), _options(orientation.turned())
        remedy = f"{options or '--keep-order'} or {other or '--keep-order'}"
        if not orientation.opposed:
            remedy = f"{remedy}, or --disparity-px if they are aligned on a plane nearer than the scene"
        by_name = "the order of the names"
        raise AmbiguousOrder(
            f"{folder}: two orders of the views are equally likely: disparities of {least:.2f} … {largest:.2f} px with "
            f"{options or by_name}, or {-largest:.2f} … {-least:.2f} px with {other or by_name}, and no hidden parts "
            f"tell near from far ({inspection.side_z:.1f} standard errors); give {remedy}"
        )
    for participle, values, sigmas, limit, unit in (
        ("turned", np.degrees(fits.turn_rad), np.degrees(fits.turn_sigma_rad), _MAX_DEG, "°"),
        ("magnified", 100 * (fits.magnification - 1), 100 * fits.magnification_sigma, 100 * _MAX_SCALE, " %"),
    ):
        sizes = _notable(values, sigmas, limit)
        worst = int(np.argmax(sizes))
        if sizes[worst]:
            raise CameraTurned(
                f"{paths[worst]}: is {participle} by {values[worst]:.1f}{unit} against the other views, at most "
                f"{limit:g}{unit} is possible on a grid; calibrate the cameras (import colmap), or leave it out"
            )


def _options(orientation: Orientation) -> str:
    flags = {"transpose": "--transpose", "flip_rows": "--flip-rows", "flip_columns": "--flip-columns"}
    return " ".join(option for name, option in flags.items() if getattr(orientation, name))


def _print_table(grid: ImageGrid, record: Arrangement, inspection: GridInspection, lens: Lens) -> None:
    counts = [*zip(grid.size, ("row", "column"), strict=True), (len(grid.paths), "view")]
    rows, columns, views = (f"{count} {noun}{'s' * (count != 1)}" for count, noun in counts)
    lines = {"grid": f"{rows} x {columns}, {views}", "order": "as in the names: the pictures do not tell"}
    if record.disparity_range_px is not None:
        options = _options(inspection.orientation)
        sources = {
            "pictures": f"hidden parts tell near from far, {abs(inspection.side_z):.0f} standard errors",
            "signs": "near points move against the camera",
            "names": "the pictures do not tell it from its opposite",
            "options": "as the options state",
        }
        order = f"not as in the names: {options}" if options else "as in the names: right and down"
        lines["order"] = f"{order} ({sources[record.told_by]})"
        least, largest = record.disparity_range_px
        lines["disparities"] = f"{least:.2f} … {largest:.2f} px from node to node, with a margin"
        plane = "on a plane in the scene" if least <= 0 else "on a plane nearer than all that is seen"
        lines["aligned"] = {None: "not known", False: "no", True: plane}[record.aligned]
        if record.pitch_ratio != 1.0:
            lines["pitch"] = f"columns {record.pitch_ratio:.3f} times as far apart as rows"
        if record.relative_light:
            lines["light"] = f"{min(record.relative_light):.2f} … {max(record.relative_light):.2f} of the typical view"
    centred = [lens.cx_px, lens.cy_px] == [(side - 1) / 2 for side in lens.size_px]
    ideal = "ideal, no distortion, centred: state another by --distortion, --cx-px, --cy-px"
    lines["lens"] = ideal if centred and not any(lens.distortion) else "as stated"
    table = Table(show_header=False, box=None, padding=(0, 2, 0, 0))
    for heading, text in lines.items():
        table.add_row(heading, text)
    console.print(table)


def _warnings(record: Arrangement, inspection: GridInspection, count: int) -> Iterator[str]:
    """Yield what a person should know before using the set."""
    order = inspection.order
    if inspection.failure:
        yield f"{_FAILURES[inspection.failure]}; the order of the names is kept"
        return
    if inspection.contradicted:
        yield "the pictures contradict the order that the options state; without these options the pictures decide"
    if order.verdict != "fits" and inspection.still:
        yield "all views show the same; no depth can be found"
    elif order.verdict == "open":
        yield "all pictures fit one another equally well: they show the same, or are too dark to check their order"
    elif order.verdict == "few":
        yield f"{count} pictures are too few for their order to be checked"
    elif order.verdict == "denied":
        share = f"the neighbours of a picture fit it better than {order.share:.0%} of the others do"
        yield f"{share}, so the order may be wrong: in a light field better than nearly all do"
    if record.told_by == "names":
        yield "the pictures do not tell where rows and columns begin; the order of the names is kept"
    if record.odd_views:
        yield f"fit none of their neighbours, and are left out: {', '.join(record.odd_views)}"
    yield from _irregularities(inspection)


def _irregularities(inspection: GridInspection) -> Iterator[str]:
    """Yield by how much the views differ from those of a regular grid, where that is notable."""
    fits = inspection.fits
    shift_px = _notable(fits.shift_px, fits.shift_sigma_px, _NOTABLE_PX)
    if shift_px.any():
        x_px, y_px = fits.shift_px[int(np.argmax(shift_px.max(axis=1)))]
        yield (
            f"views are shifted against their neighbours, by up to ({x_px:.1f}, {y_px:.1f}) px: the camera was off the "
            "grid, and `faintfield align` finds where it was"
        )
    turn_deg = _notable(np.degrees(fits.turn_rad), np.degrees(fits.turn_sigma_rad), _NOTABLE_DEG).max()
    if turn_deg:
        yield f"views are turned by up to {turn_deg:.2f}°; a grid's camera does not turn"
    magnification = _notable(fits.magnification - 1, fits.magnification_sigma, _NOTABLE_SCALE).max()
    if magnification:
        yield f"views are magnified by up to {100 * magnification:.1f} %"


def _notable(value: Array, sigma: Array, limit: float) -> Array:
    """Return the sizes of values beyond a limit and their errors, and zero for others."""
    size = np.abs(value)
    return np.where(size > np.maximum(limit, _NOTABLE_SIGMAS * sigma), size, 0.0)
