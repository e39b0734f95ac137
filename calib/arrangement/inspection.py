"""Inspection of the pictures of a grid: rows, columns, their directions, disparities, and views that do not fit."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from faintfield.calib.arrangement.matching import (
    MIN_BLOCKS,
    SURE,
    Axes,
    Correlations,
    block_disparities,
    correlate,
    disparity_range,
    find_axes,
)
from faintfield.calib.arrangement.neighbours import NeighbourFits, OrderTest, check_order, compare_neighbours
from faintfield.calib.arrangement.occlusion import far_side_z
from faintfield.calib.arrangement.views import GridPictures, Node, Orientation, central_nodes, neighbour_counts

# Smallest side of pictures that can be matched, px.
MIN_SIDE_PX = 32

# Largest disparity looked for, as a share of the width; farthest displacement between compared views in fine px.
_LARGEST_SHARE, _FARTHEST_PX = 0.3, 12.0

# Views whose blocks are matched: at first, and coarsely if nothing is seen then; and those with edges.
_FEW, _MANY, _EDGE_VIEWS = 6, 49, 9

# Step between compared displacements, px of the fine pictures.
_STEP_PX = 0.6

# A range keeps this margin: a share of itself, and a part of a pixel of the files.
_MARGIN_SHARE, _MARGIN_PX = 0.08, 0.1

# Disparities this close to zero, in px of the files, have no sign.
_NO_SIGN_PX = 0.25

# Disparities along x and y belong to one point if they differ by less than this share from the rough ratio of pitches;
# a pitch this close to square is called square.
_AGREE, _SQUARE = 0.35, 0.08

# Standard errors from which the occlusion test decides, and from which it casts doubt on what signs say: alone, and
# where the names agree with the signs. Objects before black hide nothing, and were seen to mislead it by nine.
_MIN_SIDE_Z, _DOUBTFUL_SIDE_Z, _DOUBTFUL_OF_BOTH = 4.0, 2.5, 12.0

type Failure = Literal["small", "single", "even", "apart", "dark"]
type DirectionSource = Literal["pictures", "signs", "names"]


@dataclass(frozen=True)
class GridInspection:
    """Result of the inspection.

    Attributes
    ----------
    orientation : Orientation
        Row and column from the numbers, x to the right and y down.
    failure : {"small", "single", "even", "apart", "dark"}, optional
        The reason why the views do not show one scene beyond doubt, and nothing else is known: too small pictures; only
        one; all pixels of each alike; no neighbours; or nothing in common above noise.
    axes : Axes
        Significance of the match and the axes, and the mean correlation of blocks.
    side_z, direction : float, {"pictures", "signs", "names"}
        Significance of which end is near, positive if it speaks for `orientation`; source of both directions against
        their opposites: hidden parts, the sign of all disparities, or only the names.
    undecided, contradicted : bool
        Another orientation, turned by 180°, is as likely, and the names state neither; the pictures deny the
        orientation that was prescribed.
    disparity_px, ratio : (float, float), float
        Range of disparities along rows of nodes in px of the files, in this orientation; disparities along x over those
        along y.
    fits, order : NeighbourFits, OrderTest
        Agreement of each view with its neighbours, and of neighbours by the names against other pictures.
    """

    orientation: Orientation
    failure: Failure | None = None
    axes: Axes = field(default_factory=Axes)
    side_z: float = 0.0
    direction: DirectionSource = "names"
    undecided: bool = False
    contradicted: bool = False
    disparity_px: tuple[float, float] = (0.0, 0.0)
    ratio: float = 1.0
    fits: NeighbourFits = field(default_factory=NeighbourFits)
    order: OrderTest = field(default_factory=OrderTest)

    @property
    def range_px(self) -> tuple[float, float]:
        """Range of disparities with a margin."""
        least, largest = self.disparity_px
        margin = _MARGIN_SHARE * (largest - least) + _MARGIN_PX
        return least - margin, largest + margin

    @property
    def aligned(self) -> bool | None:
        """The pictures are aligned on a plane: points move with the camera, too. None if points hardly move."""
        largest_px = self.disparity_px[1]
        return None if self.failure or abs(largest_px) <= _NO_SIGN_PX else largest_px > 0

    @property
    def still(self) -> bool:
        """No point moves from view to view by more than is told from zero."""
        return self.failure is None and max(map(abs, self.disparity_px)) <= _NO_SIGN_PX


def inspect_grid(
    nodes: Sequence[Node], pictures: GridPictures, prescribed: Orientation | None = None, *, square: bool = False
) -> GridInspection:
    """Inspect the pictures of a grid at different nodes; views may be missing.

    The orientation is found, or only checked if a person prescribed it. A `square` grid has the same pitch along rows
    and columns; so has one whose views are shifted by as much as another pitch would shift them.
    """
    if (failure := _failure_at_sight(nodes, pictures)) is not None:
        return GridInspection(prescribed or Orientation(), failure)
    coarse, coarse_axes = _match_coarsely(nodes, pictures)
    if coarse_axes.match_z < SURE:
        return GridInspection(prescribed or Orientation(), "dark", axes=coarse_axes)
    coarse_px = max(map(abs, disparity_range(coarse, coarse_axes) or (0.0, 0.0))) + 1.0
    fine_px = coarse_px * pictures.coarse_scale / pictures.fine_scale
    fine, distance = _match_finely(nodes, pictures, fine_px)
    axes = max(find_axes(fine), coarse_axes, key=lambda axes: axes.certainty)
    transpose = axes.transposed and axes.transposed_z > SURE
    opposed = axes.opposed and axes.opposed_z > SURE
    # The first number is the reversed one
    orientation = prescribed or Orientation(transpose, opposed and not transpose, opposed and transpose)
    no_sign_px = _NO_SIGN_PX / pictures.fine_scale
    arranged = Axes(orientation.transpose, orientation.opposed)
    ratio = 1.0 if square else pitch_ratio(fine, replace(arranged, ratio=axes.ratio), no_sign_px)
    least_px, largest_px = disparity_range(fine, replace(arranged, ratio=ratio)) or (-fine_px, fine_px)
    if orientation.flip_rows if orientation.transpose else orientation.flip_columns:
        least_px, largest_px = -largest_px, -least_px
    step_px = _STEP_PX / distance
    views = dict(zip(orientation.apply(nodes), pictures.brightness, strict=True))
    edge_nodes = central_nodes(list(views), _EDGE_VIEWS, distance)
    shifts_px = np.arange(least_px - step_px, largest_px + 1.5 * step_px, step_px)
    side_z = far_side_z(views, edge_nodes, shifts_px, distance=distance, ratio=ratio)
    turn, direction, undecided = _direction(opposed, side_z, (least_px, largest_px), no_sign_px)
    if prescribed is not None:
        turn, direction, undecided = False, "names", False
    elif turn:
        orientation, side_z, least_px, largest_px = orientation.turned(), -side_z, -largest_px, -least_px
    arranged_views = dict(zip(orientation.apply(nodes), pictures.fine, strict=True))
    fits = compare_neighbours(arranged_views, (least_px, largest_px), ratio)
    if ratio != 1:
        least_moved_px = abs(ratio - 1) / max(ratio, 1) * max(-least_px, largest_px) * distance
        if least_moved_px < SURE * np.sqrt(np.nanmean(np.square(fits.shift_px))):
            return inspect_grid(nodes, pictures, prescribed, square=True)
    fitting = {nodes[index]: pictures.coarse[index] for index in range(len(nodes)) if index not in fits.odd}
    return GridInspection(
        orientation,
        axes=axes,
        side_z=side_z,
        direction=direction,
        undecided=undecided,
        contradicted=prescribed is not None and _contradict(prescribed, axes, side_z),
        disparity_px=(least_px * pictures.fine_scale, largest_px * pictures.fine_scale),
        ratio=ratio,
        fits=replace(
            fits,
            shift_px=fits.shift_px * pictures.fine_scale,
            shift_sigma_px=fits.shift_sigma_px * pictures.fine_scale,
        ),
        order=check_order(fitting, axes, coarse_px),
    )


def _failure_at_sight(nodes: Sequence[Node], pictures: GridPictures) -> Failure | None:
    if len(nodes) < 2:
        return "single"
    if not any(np.ptp(picture) for picture in pictures.brightness):
        return "even"
    if min(pictures.fine[0].shape) < MIN_SIDE_PX:
        return "small"
    return None if neighbour_counts(nodes, 1).any() else "apart"


def _contradict(prescribed: Orientation, axes: Axes, side_z: float) -> bool:
    return (
        side_z < -_MIN_SIDE_Z
        or (axes.transposed_z > SURE and axes.transposed != prescribed.transpose)
        or (axes.opposed_z > SURE and axes.opposed != prescribed.opposed)
    )


def _match_coarsely(nodes: Sequence[Node], pictures: GridPictures) -> tuple[Correlations, Axes]:
    """Correlate neighbours at all displacements that are possible, with more views if few do not agree."""
    views = dict(zip(nodes, pictures.coarse, strict=True))
    reach = int(_LARGEST_SHARE * pictures.coarse[0].shape[1])
    shifts_px = np.arange(-reach, reach + 1.0)
    for count in (_FEW, _MANY):
        correlations = correlate(views, central_nodes(nodes, count, 1), shifts_px, distance=1)
        axes = find_axes(correlations)
        if axes.match_z > 2 * SURE:
            break
    return correlations, axes


def _match_finely(nodes: Sequence[Node], pictures: GridPictures, largest_px: float) -> tuple[Correlations, int]:
    """Correlate views at a distance in nodes at which near points move by a few pixels; return the distance, too."""
    extent = np.ptp(np.array(nodes), axis=0)
    most = max(int(extent[extent > 0].min()) // 2, 1)
    distance = int(np.clip(_FARTHEST_PX / largest_px, 1, most))
    while distance > 1 and not (neighbour_counts(nodes, distance)[:, extent > 0] == 2).all(axis=1).any():
        distance -= 1
    count = int(np.ceil(largest_px * distance / _STEP_PX)) + 2
    shifts_px = np.arange(-count, count + 1) * (_STEP_PX / distance)
    views = dict(zip(nodes, pictures.fine, strict=True))
    chosen = central_nodes(nodes, _FEW, distance, fill=False)
    return correlate(views, chosen, shifts_px, distance), distance


def pitch_ratio(correlations: Correlations, axes: Axes, no_sign_px: float) -> float:
    """Return disparities along x over those along y; 1 if they are alike, or the pictures do not tell.

    `axes` has a rough ratio. Disparities within `no_sign_px` are not told from zero.
    """
    keys = [(axis if axes.transposed else 1 - axis, axis) for axis in (0, 1)]
    if not all(key in correlations.along for key in keys):
        return 1.0
    x_px, y_px = (
        block_disparities(correlations.along[key], correlations.chance[key], correlations.shifts_px) for key in keys
    )
    y_px *= -1 if axes.opposed else 1
    sure = np.abs(x_px - axes.ratio * y_px) < _AGREE * (np.abs(x_px) + no_sign_px)
    sure &= np.abs(y_px) > 0.5 * np.nanmax(np.abs(y_px), initial=0.0)
    ratios = x_px[sure] / y_px[sure]
    if len(ratios) < MIN_BLOCKS:
        return 1.0
    ratio = float(np.median(ratios))
    sigma = float(1.25 * 1.48 * np.median(np.abs(ratios - ratio)) / np.sqrt(len(ratios)))
    return ratio if abs(ratio - 1) > max(SURE * sigma, _SQUARE) else 1.0


def _direction(
    opposed: bool, side_z: float, range_px: tuple[float, float], no_sign_px: float
) -> tuple[bool, DirectionSource, bool]:
    """Return whether to turn the orientation, what tells so, and whether both are equally likely."""
    least_px, largest_px = range_px
    least_z = -_DOUBTFUL_SIDE_Z if opposed else -_DOUBTFUL_OF_BOTH
    # Near points move against the camera, far ones less
    if largest_px < -no_sign_px and least_z < side_z < _MIN_SIDE_Z:
        return False, "signs", False
    if abs(side_z) >= _MIN_SIDE_Z:
        return side_z < 0, "pictures", False
    if least_px > no_sign_px and opposed and side_z < _DOUBTFUL_SIDE_Z:
        return True, "signs", False
    # All points move with the camera: the order is reversed, or aligned on the nearest point; the names state neither
    return False, "names", opposed or least_px > no_sign_px or largest_px < -no_sign_px
