"""Inspection of the pictures of a grid: rows, columns, their directions, disparities, and views that do not fit."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from faintfield.calib.arrangement.axes import SURE, Axes, find_axes
from faintfield.calib.arrangement.fitting_views import Fits, compare_neighbours
from faintfield.calib.arrangement.occlusion import NearAndFar
from faintfield.calib.arrangement.order import Order, check_order
from faintfield.calib.arrangement.orientation import Orientation, counted
from faintfield.calib.arrangement.pictures import MIN_SIDE_PX, Node, Picture, Views, copies, prepare
from faintfield.calib.arrangement.scene import NO_SIGN_PX, FineMatch, find_roughly, measure

# Standard errors from which the occlusion test decides.
SURE_SIDE = 4.0

# Standard errors from which the occlusion test casts doubt on what signs say.
_DOUBT = 2.5

type Told = Literal["pictures", "signs", "names"]

type Unseen = Literal["small", "single", "even", "apart", "dark"]


@dataclass(frozen=True)
class Look:
    """Result of the inspection.

    Attributes
    ----------
    seen : bool
        The views show one scene beyond doubt. Without it nothing else is known.
    unseen : {"small", "single", "even", "apart", "dark"}, optional
        Why not: the pictures are too small to be compared; there is one only; all pixels of each are alike; no picture
        has a neighbour; or nothing in common rises above noise.
    match_z : float
        Standard errors by which they do.
    orientation : Orientation
        Row and column from the numbers, x to the right and y down.
    axes_z, opposed_z, side_z : float
        Significance of: which number is the row; whether the numbers run opposite ways; which end is near, which is
        positive if it speaks for `orientation`.
    edges : int
        Depth edges that were tested.
    direction : {"pictures", "signs", "names"}
        What told both directions from their opposites: hidden parts, the sign of all disparities, or only the names.
    undecided : bool
        Another orientation, turned by 180°, is as likely, and the names state neither.
    contradicted : bool
        The pictures deny the orientation that was given.
    aligned : bool, optional
        The pictures are aligned on a plane in the scene: points move with the camera, too. None if points hardly move.
    disparity_px : (float, float), optional
        Range of disparities along rows of nodes in px of the files, in this orientation, with a margin.
    ratio : float
        Disparities along x over those along y: the ratio of pitches.
    ratio_sigma : float
        Its standard error.
    odd : list of int
        Views that fit none of the others, by their places.
    light : array (view,)
        Mean of each picture over the median of all.
    turn_rad, scale : array (view,)
        Rotation and magnification against the typical view.
    shift_px : array (view, 2)
        Displacement x, y beyond what disparities explain, in px of the files.
    contrast : float
        Standard deviation within a picture, in units of the files.
    noise : float
        Standard deviation from pixel to pixel, beside edges; in units of the files.
    mean : float
        Median of the pictures' means, in units of the files.
    still : bool
        No point moves from view to view by more than is told from zero.
    order : Order
        Whether neighbours by the names fit better than other pictures do.
    """

    seen: bool
    unseen: Unseen | None
    match_z: float
    orientation: Orientation
    axes_z: float
    opposed_z: float
    side_z: float
    edges: int
    direction: Told
    undecided: bool
    contradicted: bool
    aligned: bool | None
    disparity_px: tuple[float, float] | None
    ratio: float
    ratio_sigma: float
    copies: list[tuple[int, int]]
    odd: list[int]
    light: NDArray[np.float64]
    turn_rad: NDArray[np.float64]
    scale: NDArray[np.float64]
    shift_px: NDArray[np.float64]
    contrast: float
    noise: float
    mean: float
    still: bool
    level: float
    order: Order


def look(nodes: Sequence[Node], read: Callable[[int], Picture], given: Orientation | None = None) -> Look:
    """Look at the pictures of a grid.

    Parameters
    ----------
    nodes : sequence of (int, int)
        The two numbers of each view, different ones; views may be missing.
    read : callable
        Returns the grey picture (row, column) of a view by its place in `nodes`; each is read once.
    given : Orientation, optional
        Which number is row and column and where they begin, if a person said so; else it is found.
    """
    numbers = counted(nodes)
    views = prepare(numbers, read)
    places = {node: index for index, node in enumerate(numbers)}
    same = [(places[first], places[second]) for first, second in copies(views)]
    light = np.array([views.mean[node] for node in numbers])
    blank = _nothing_seen(views, given or Orientation(), same, light)
    if len(numbers) < 2:
        return replace(blank, unseen="single")
    if all(not np.ptp(view) for view in views.light.values()):
        return replace(blank, unseen="even")
    if min(views.fine[numbers[0]].shape) < MIN_SIDE_PX:
        return replace(blank, unseen="small")
    coarse, largest_px = find_roughly(views)
    if coarse is None:
        return replace(blank, unseen="apart")
    if coarse.match_z < SURE:
        return replace(blank, match_z=coarse.match_z, level=coarse.level)
    fine = FineMatch(views, largest_px)
    axes = find_axes(fine.tables, fine.chance)
    if min(axes.match_z, max(axes.transposed_z, axes.opposed_z)) < min(
        coarse.match_z, max(coarse.transposed_z, coarse.opposed_z)
    ):
        axes = coarse
    known = replace(blank, seen=True, unseen=None, match_z=max(axes.match_z, coarse.match_z))
    return _oriented(known, fine, axes, given, numbers)


def _nothing_seen(
    views: Views, orientation: Orientation, same: list[tuple[int, int]], means: NDArray[np.float64]
) -> Look:
    """Return what is known of pictures that show nothing in common."""
    count, mean = len(means), float(np.median(means))
    return Look(
        seen=False,
        unseen="dark",
        match_z=0.0,
        orientation=orientation,
        axes_z=0.0,
        opposed_z=0.0,
        side_z=0.0,
        edges=0,
        direction="names",
        undecided=False,
        contradicted=False,
        aligned=None,
        disparity_px=None,
        ratio=1.0,
        ratio_sigma=0.0,
        copies=same,
        odd=[],
        light=means / (mean or 1.0),
        turn_rad=np.zeros(count),
        scale=np.ones(count),
        shift_px=np.zeros((count, 2)),
        contrast=views.contrast,
        noise=views.noise,
        mean=mean,
        still=False,
        level=0.0,
        order=Order("open", 1.0),
    )


def _oriented(known: Look, fine: FineMatch, axes: Axes, given: Orientation | None, numbers: list[Node]) -> Look:
    """Return what was found, in its orientation."""
    single = [axis for axis in (0, 1) if np.ptp(np.array(numbers)[:, axis]) == 0]
    transpose = axes.transposed if axes.transposed_z > SURE else False
    opposed = axes.opposed if axes.opposed_z > SURE else False
    found = Orientation(transpose, flip_rows=opposed)
    if transpose and opposed:
        found = Orientation(True, flip_columns=True)  # combined() reverses the first number
    known = replace(known, axes_z=axes.transposed_z, opposed_z=0.0 if single else axes.opposed_z)
    orientation = found if given is None else given
    seen = measure(fine, orientation, axes.ratio)
    side = seen.side()
    contradicted = False
    if given is None:
        orientation, direction, undecided = _direction(found, opposed, side, seen.bare_px())
        if orientation != found:
            seen = measure(fine, orientation, axes.ratio)
            side = replace(side, z=-side.z)
    else:
        direction, undecided = "names", False
        contradicted = side.z < -SURE_SIDE
        contradicted |= axes.transposed_z > SURE and axes.transposed != given.transpose
        contradicted |= axes.opposed_z > SURE and axes.opposed != (given.flip_rows != given.flip_columns)
    fits = compare_neighbours(seen.pictures, seen.raw_px, seen.ratio[0])
    coarse_px = fine.views.fine_scale / fine.views.coarse_scale
    fitting = {
        number: fine.views.coarse[number]
        for number, node in zip(numbers, seen.order, strict=True)
        if node not in fits.odd
    }
    return _with_fits(
        replace(
            known,
            orientation=orientation,
            direction=direction,
            undecided=undecided,
            contradicted=contradicted,
            side_z=side.z,
            edges=side.edges,
            level=axes.level,
            aligned=_aligned(seen.bare_px()[1]),
            disparity_px=seen.range_px(),
            still=max(map(abs, seen.bare_px())) <= NO_SIGN_PX,
            ratio=seen.ratio[0],
            ratio_sigma=seen.ratio[1],
            order=check_order(fitting, axes, fine.largest_px * coarse_px),
        ),
        fits,
        seen.order,
        fine.views.fine_scale,
    )


def _aligned(largest_px: float) -> bool | None:
    """Tell from the largest disparity whether the pictures are aligned on a plane in the scene."""
    return None if abs(largest_px) <= NO_SIGN_PX else largest_px > 0


def _direction(
    found: Orientation, opposed: bool, side: NearAndFar, range_px: tuple[float, float]
) -> tuple[Orientation, Told, bool]:
    """Return the orientation, what tells it from its opposite, and whether two are equally likely.

    The range of disparities is in px of the files, without a margin.
    """
    if abs(side.z) >= SURE_SIDE:
        return (found if side.z > 0 else found.turned()), "pictures", False
    if range_px[1] < -NO_SIGN_PX and side.z > -_DOUBT:
        return found, "signs", False
    if range_px[0] > NO_SIGN_PX and opposed and side.z < _DOUBT:
        return found.turned(), "signs", False
    # All points move with the camera: the order is reversed, or aligned on the nearest point; the names state neither
    one_sign = range_px[0] > NO_SIGN_PX or range_px[1] < -NO_SIGN_PX
    return found, "names", opposed or one_sign


def _with_fits(known: Look, fits: Fits, order: list[Node], scale: float) -> Look:
    """Return what was found, with what pairs of neighbours say of each view."""
    if not fits.turn_rad:
        return known
    places = {node: index for index, node in enumerate(order)}
    return replace(
        known,
        odd=sorted(places[node] for node in fits.odd),
        turn_rad=np.array([fits.turn_rad[node] for node in order]),
        scale=np.array([fits.scale[node] for node in order]),
        shift_px=scale * np.array([fits.shift_px[node] for node in order]),
    )
