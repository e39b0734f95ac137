"""Report on the views of a grid: a table, and what a person should know before using the set."""

import numpy as np
from rich.table import Table

from faintfield.calib.arrangement.look import Look
from faintfield.calib.arrangement.pictures import MIN_SIDE_PX
from faintfield.pipelines.console import console, inform, visible
from faintfield.pipelines.formats.exchange.arranged_grid import ArrangedGrid, options_of

# Rotation in degrees and magnification against the other views that are worth a word.
_SAID_DEG, _SAID_SCALE = 0.3, 0.005

# Displacement in px beyond what disparities explain that is worth a word.
_SAID_PX = 1.0


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
    counts = (_counted(rows, "row"), _counted(columns, "column"))
    said = [("grid", f"{' x '.join(counts)}, {_counted(len(result.grid.paths), 'view')}")]
    if not found.seen:
        return [*said, ("order", "as in the names: the pictures do not tell")]
    options = options_of(found.orientation)
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
        said.append(("aligned", _aligned(record.aligned, least)))
    if record.pitch_ratio != 1.0:
        said.append(("pitch", f"columns {record.pitch_ratio:.3f} times as far apart as rows"))
    if record.relative_light:
        least_light, most_light = min(record.relative_light), max(record.relative_light)
        said.append(("light", f"{least_light:.2f} … {most_light:.2f} of the typical view"))
    if record.missing:
        said.append(("missing", ", ".join(f"({row}, {column})" for row, column in record.missing)))
    return said


def _counted(count: int, what: str) -> str:
    return f"{count} {what}{'s' * (count != 1)}"


def _aligned(aligned: bool | None, least_px: float) -> str:
    """Return in words whether pictures are aligned, and where the plane is that then stands still."""
    if aligned is None:
        return "not known"
    if not aligned:
        return "no"
    return "on a plane in the scene" if least_px <= 0 else "on a plane nearer than all that is seen"


# Why nothing is seen.
_UNSEEN = {
    "small": f"the pictures are smaller than {MIN_SIDE_PX} px, too small to be compared",
    "single": "one picture has no other to be compared with",
    "even": "all pixels of each picture are alike, so nothing can be found in them",
    "apart": "no picture has a neighbour to be compared with",
    "dark": "nothing is seen in single pictures or their averages; they are too dark, or show nothing in common",
}


def _order_warning(found: Look) -> str | None:
    """Return what is not known of the scene and the order of its views, None if both are sure."""
    if found.unseen:
        return f"{_UNSEEN[found.unseen]}; the order of the names is kept"
    verdict = found.order.verdict
    if verdict != "fits" and found.still:
        return "all views show the same; no depth can be found"
    if verdict == "open":
        return "all pictures fit one another equally well: they show the same, or are too dark to check their order"
    if verdict == "few":
        return f"{len(found.light)} pictures are too few for their order to be checked"
    if verdict == "denied":
        return (
            f"neighbours fit better than only {found.order.share:.0%} of other pictures, so the order may be wrong: in "
            "a light field they fit better than nearly all"
        )
    return None


def _warnings(result: ArrangedGrid) -> list[str]:
    """Return what a person should know before using the set."""
    found, record = result.found, result.arrangement
    lines = []
    if found.contradicted:
        lines.append(
            "the pictures contradict the order that the options state; without them it is found from the pictures"
        )
    doubt = _order_warning(found)
    if doubt:
        lines.append(doubt)
    if found.seen and record.told_by == "names":
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
