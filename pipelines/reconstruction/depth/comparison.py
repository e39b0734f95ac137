"""Views of a set compared in bins of pixels: their agreement at each depth, and whether it could be chance."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import permutations
from math import factorial
from operator import add
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from faintfield.pipelines.console import inform, progress, working
from faintfield.pipelines.formats.frames import ChannelLayout
from faintfield.pipelines.formats.large_arrays import memory_or_file
from faintfield.pipelines.formats.sets.elemental_set import ElementalSet
from faintfield.pipelines.reconstruction.channels import load_channel
from faintfield.pipelines.reconstruction.operators import OperatorFactory, plane_grid, seen_from
from faintfield.recon.depth.agreement import (
    Agreement,
    Significance,
    agreement,
    bins_for,
    disagreement,
    significance,
)
from faintfield.recon.errors import NothingInFocus
from faintfield.recon.likelihood.images import ElementalImages, binned
from faintfield.recon.operator.grid import PlaneGrid

# Place between two pixels, in pixels, at which `w² + (1 − w)²` is 2/3, as on average: see `between_pixels`.
BETWEEN_PIXELS = 0.5 - 0.5 / 3**0.5

# Fewest bins across the detector: limits the size of a bin.
_MIN_BINS_ACROSS = 8

# Bins of a view in one colour that are enough to find depths by: further colours would only take longer.
_ENOUGH_BINS = 40_000

# Most shuffles of a test.
_SHUFFLES = 499

# Largest p-value that is kept, by the fewest views: chance is taken for depth in one set of 500. Few views have few
# orders; of three or four, only those are refused that agree as well or better in every other order, as copies do.
_LARGEST_P = {7: 0.002, 5: 0.01, 3: 0.99}

# Fewest views whose p-value means something, and is returned.
_FEWEST_VIEWS = 5

# Depths of each comparison, and the most samples and views, evenly chosen: for speed and memory.
_DEPTHS, _MAX_SAMPLES, _MAX_VIEWS = 20, 1000, 49

# Least share of the pixels of a view that have a number, or it is left out.
_MIN_KNOWN = 0.5

# Fewest bins along a side of a view.
_MIN_BINS = 8

# Another arrangement of the views is right if it agrees better than shuffled views by this many times as much, and with
# at most this p-value, or that which is kept.
_CLEARLY, _MAX_P_REARRANGED = 1.2, 0.01

# Seed of the shuffles: the same set gives the same result.
_SEED = 20


@dataclass(frozen=True)
class BinnedViews:
    """The views of a set in bins of `bins_px` detector pixels, one colour after the other, the middle colour first."""

    elemental_set: ElementalSet
    colours: list[tuple[ChannelLayout, ElementalImages]]
    bins_px: int

    def agreements(self, depths_mm: Sequence[float]) -> list[Agreement]:
        """Return the agreement of the views at each depth, all colours together."""
        planes: list[Agreement] = []
        for layout, images in self.colours:
            bins = self.bins_px // max(layout.lattices[0].step)
            factory = OperatorFactory(self.elemental_set, layout, images, bins=bins)
            found = []
            for depth in progress(depths_mm, f"comparing the views, {layout.name}"):
                grid = between_pixels(plane_grid(self.elemental_set, depth).binned(self.bins_px))
                found.append(agreement(factory.at(depth, grid), images))
            planes = [Agreement(*map(add, *pair)) for pair in zip(planes, found, strict=True)] if planes else found
        return planes


def between_pixels(grid: PlaneGrid) -> PlaneGrid:
    """Return samples on the pixels of the reference view, or bins of them, moved by `BETWEEN_PIXELS` right and down.

    Interpolation between pixels blurs, and detail that is not blurred counts for more. On a regular grid of nodes, some
    depths bring all views to whole pixels, and would be favoured. At this place the mean of `w² + (1 − w)²` over the
    weights w of interpolation is 2/3, as it is over all places: such depths are no longer special.
    """
    moved = BETWEEN_PIXELS * grid.pitch_mm
    return replace(grid, origin_mm=(grid.origin_mm[0] + moved, grid.origin_mm[1] + moved))


def binned_views(elemental_set: ElementalSet, middle_mm: float, out: Path, *, min_bins_px: int = 1) -> BinnedViews:
    """Return the views in bins of pixels; the images of one colour at a time are in memory, or in a file in `out`.

    Pixels are added up in bins of at least `min_bins_px`, larger ones in low light at the depth `middle_mm`. Where that
    leaves many bins, the middle colour is enough.
    """
    layouts = elemental_set.layouts
    middle = len(layouts) // 2
    images = load_channel(elemental_set, layouts[middle], memory_or_file(out))
    lattice, factory = layouts[middle].lattices[0], OperatorFactory(elemental_set, layouts[middle], images)
    needed = bins_for(factory.at(middle_mm, plane_grid(elemental_set, middle_mm)), images)
    bins = min(max(needed, -(-min_bins_px // max(lattice.step))), min(lattice.shape) // _MIN_BINS_ACROSS)
    del factory
    colours = [(layouts[middle], images.binned(bins))]
    if np.prod(colours[0][1].electrons.shape[1:]) <= _ENOUGH_BINS:
        for layout in layouts[:middle] + layouts[middle + 1 :]:
            del images  # before the next colour is read
            images = load_channel(elemental_set, layout, memory_or_file(out))
            colours.append((layout, images.binned(bins)))
    return BinnedViews(elemental_set, colours, bins * max(lattice.step))


def check_places(views: BinnedViews, range_mm: tuple[float, float]) -> Significance | None:
    """Return how much better the views agree at their places than shuffled, over a whole range of depths.

    It is None, and said so, for fewer than `_FEWEST_VIEWS` views: these have too few orders to tell. Raises
    NothingInFocus if shuffled views agree as well, or views in reversed or exchanged rows and columns agree better.
    """
    chosen = _compared(views)
    count = len(chosen)
    if count < _FEWEST_VIEWS:
        inform(
            f"{count} views are too few to test by shuffles whether they agree by chance; {_FEWEST_VIEWS} are needed"
        )
    if count < min(_LARGEST_P):
        return None
    depths_mm = (1 / np.linspace(1 / range_mm[0], 1 / range_mm[1], _DEPTHS)).tolist()
    with working("preparing the comparison of shuffled views"):
        disagreement_from = _from_all_places(views, chosen, depths_mm)
    stated = disagreement_from(np.arange(count))
    shuffled = [disagreement_from(places) for places in progress(_shuffles(count), "comparing shuffled views")]
    found = significance(stated, shuffled)
    largest = next(p_value for fewest, p_value in _LARGEST_P.items() if count >= fewest)
    nodes = [views.elemental_set.settings.view[view].node for view in chosen]
    rearranged = [(disagreement_from(places), remedy) for remedy, places in _arrangements(nodes)]
    if rearranged:
        _refuse_rearranged(views.elemental_set, min(rearranged), stated, shuffled, min(largest, _MAX_P_REARRANGED))
    if found.p_value > largest:
        raise NothingInFocus(
            f"{views.elemental_set.folder}: the views agree no better than shuffled ones (p = {found.p_value:.2g} of "
            f"{found.shuffles} shuffles, at most {largest:g} is needed): nothing moves between them as their places "
            "say; use more light, correct order and places of the pictures, or make planes at known depths (--depth)"
        )
    return found if count >= _FEWEST_VIEWS else None


def _shuffles(count: int) -> list[NDArray[np.intp]]:
    """Return different shuffles of places, all of them if there are few.

    None keeps all or turns them round, which only exchanges near and far. A shuffle that came twice would count as two,
    and p of a few views would be too small.
    """
    left_out = {tuple(range(count)), tuple(range(count))[::-1]}
    if factorial(count) - len(left_out) <= _SHUFFLES:
        return [np.array(places) for places in permutations(range(count)) if places not in left_out]
    random, found = np.random.default_rng(_SEED), dict[tuple[int, ...], None]()
    while len(found) < _SHUFFLES:
        shuffled = tuple(random.permutation(count).tolist())
        if shuffled not in left_out:
            found[shuffled] = None
    return [np.array(places) for places in found]


def _refuse_rearranged(
    elemental_set: ElementalSet, rearranged: tuple[float, str], statistic: float, shuffled: list[float], max_p: float
) -> None:
    """Refuse views that agree clearly better with their rows or columns reversed, or exchanged (NothingInFocus)."""
    chance, (best, remedy) = float(np.mean(shuffled)), rearranged
    if significance(best, shuffled).p_value <= max_p and chance - best > _CLEARLY * (chance - statistic):
        raise NothingInFocus(
            f"{elemental_set.folder}: the views agree better with {remedy}: by {chance - best:.3g} in squared "
            f"deviations, and by {chance - statistic:.3g} as stated; import the pictures again so"
        )


def _arrangements(nodes: list[tuple[int, int] | None]) -> list[tuple[str, NDArray[np.intp]]]:
    """Return other arrangements of the nodes, how an import makes them, and the place that each view then has.

    Reversing rows and columns at once only exchanges near and far, which agreement cannot tell, so that is left out.
    """
    at = {node: index for index, node in enumerate(nodes) if node is not None}
    row_of, column_of = (sorted({node[axis] for node in at}) for axis in (0, 1))
    if len(at) < len(nodes) or min(len(row_of), len(column_of)) < 2:
        return []
    back = dict(zip(column_of, reversed(column_of), strict=True))
    up = dict(zip(row_of, reversed(row_of), strict=True))
    tried = [
        ("reversed columns (--flip-columns)", [(row, back[column]) for row, column in at]),
        ("reversed rows (--flip-rows)", [(up[row], column) for row, column in at]),
        ("rows and columns exchanged (--transpose)", [(column, row) for row, column in at]),
        (
            "rows and columns exchanged, and rows reversed (--transpose --flip-rows)",
            [(up.get(column, -1), row) for row, column in at],
        ),
    ]
    return [(remedy, np.array([at[node] for node in moved])) for remedy, moved in tried if set(moved) == set(at)]


def _compared(views: BinnedViews) -> list[int]:
    """Return the views that are compared: evenly chosen, without those that are largely saturated or masked."""
    layout, images = views.colours[0]
    chosen = _evenly(views.elemental_set)
    if images.valid is None:
        return chosen
    known = images.valid.reshape(-1, len(layout.lattices), images.valid[0].size).mean(axis=(1, 2))
    return [view for view in chosen if known[view] >= _MIN_KNOWN]


def _from_all_places(
    views: BinnedViews, chosen: list[int], depths_mm: list[float]
) -> Callable[[NDArray[np.intp]], float]:
    """Return a function of places that returns how much some views, in one colour, disagree if taken from there."""
    elemental_set, (layout, images) = views.elemental_set, views.colours[0]
    shape, bins = images.electrons.shape[1:], 1
    while (shape[0] // bins) * (shape[1] // bins) > _MAX_SAMPLES and min(shape) // (2 * bins) >= _MIN_BINS:
        bins *= 2
    electrons = binned(
        images.electrons - images.background_e if np.ndim(images.background_e) == 0 else images.electrons, bins
    )
    light = electrons.reshape(-1, len(layout.lattices), *electrons.shape[1:]).mean(axis=1)[chosen] * bins**2
    known = (float(np.mean(images.background_e)) + float(np.mean(images.read_variance_e2))) * bins**2
    places_px = _places_px(elemental_set, chosen, depths_mm, light.shape[1:], views.bins_px * bins)
    shown = np.empty((len(chosen), len(chosen), *places_px.shape[1:3]), np.float32)
    for place, at in enumerate(places_px):
        for view, image in enumerate(light.astype(np.float32)):
            shown[place, view] = cv2.remap(
                image, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
            )
    inside = (places_px >= 0) & (places_px <= np.array(light.shape[:0:-1]) - 1)
    inside, known_variance_e2 = inside.all(axis=-1), known / len(layout.lattices)

    def disagreement_from(places: NDArray[np.intp]) -> float:
        return disagreement(shown, inside, places, known_variance_e2)

    return disagreement_from


def _places_px(
    elemental_set: ElementalSet, chosen: list[int], depths_mm: list[float], shape: tuple[int, ...], bins_px: int
) -> NDArray[np.float32]:
    """Return where others see the bins of the reference view at each depth: column, row (view, depth, bin, 2)."""
    rows, columns = np.indices(shape)
    pixels = (np.stack([columns.ravel(), rows.ravel()], axis=-1) + 0.5) * bins_px - 0.5
    seen = np.stack([seen_from(elemental_set, depth, pixels, chosen) for depth in depths_mm], axis=1)
    places = (seen + 0.5) / bins_px - 0.5
    # Outside is outside, also behind a camera
    return np.clip(np.nan_to_num(places, nan=-1.0), -1.0, shape[::-1]).astype(np.float32)


def _evenly(elemental_set: ElementalSet) -> list[int]:
    """Return the views that are compared: all, or those of some rows and columns, evenly and symmetrically chosen."""
    nodes = [view.node for view in elemental_set.settings.view]
    if len(nodes) <= _MAX_VIEWS:
        return list(range(len(nodes)))
    if any(node is None for node in nodes):
        return np.linspace(0, len(nodes) - 1, _MAX_VIEWS).astype(int).tolist()
    kept = []
    for axis in (0, 1):
        values = sorted({node[axis] for node in nodes if node is not None})
        wanted = min(
            len(values), max(int(_MAX_VIEWS**0.5), _MAX_VIEWS // len({node[1 - axis] for node in nodes if node}))
        )
        half = np.linspace(0, len(values) - 1, wanted)
        kept.append(
            {values[round(float(at))] for at in half} | {values[len(values) - 1 - round(float(at))] for at in half}
        )
    return [index for index, node in enumerate(nodes) if node is not None and node[0] in kept[0] and node[1] in kept[1]]
