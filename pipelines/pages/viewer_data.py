"""Data of a report's viewer: numbers packed in lossless pictures that the page's script decodes, and scales."""

from collections.abc import Sequence
from typing import Any, Literal, NamedTuple, NotRequired, TypedDict

import cv2
import numpy as np
from msgspec import UNSET
from numpy.typing import NDArray

from faintfield.pipelines.formats.image_files import encoded
from faintfield.pipelines.formats.results.records import JOINT_METHODS
from faintfield.pipelines.formats.units import StatedUnits
from faintfield.pipelines.pages.page import smaller_uri
from faintfield.pipelines.pages.report_pictures import PlaneSections
from faintfield.pipelines.pages.report_planes import Plane, best_column, column_titles
from faintfield.pipelines.pages.report_sets import SetSection

# A plane of more samples is binned: a phone draws this many in a frame.
_MAX_SAMPLES = 1_500_000

# Bytes that all numbers together may take before base64: in any case, and for each picture. Coarser steps are tried to
# keep to it. Only numbers that take more even so, more than the last of these for each picture, are binned.
_MIN_BUDGET, _BUDGET_PER_PICTURE, _MOST_PER_PICTURE = 1_300_000, 115_000, 250_000

# Pictures by which the fineness of all is chosen, spread evenly over them.
_SAMPLE = 16

# The level of a sample without a number, and the highest of one with a number.
UNKNOWN_LEVEL, _TOP_LEVEL = 65535, 65534

# White of a picture of 8 bits.
_TOP_GREY = 255

# Median absolute difference of two samples of normal noise, in its standard deviations.
_MEDIAN_DIFFERENCE = 0.6745 * np.sqrt(2)

type Kind = Literal["light", "sigma", "view", "bright"]

# Black, white and name of the pictures of each kind when the page opens.
type Scales = dict[Kind, dict[str, float | str]]


class Fineness(NamedTuple):
    """Largest step of the numbers of a plane: the greater of a share of its noise and of its range."""

    of_noise: float
    of_range: float

    def step(self, plane: NDArray[np.floating]) -> float:
        """Return the step for a plane; levels up to `_TOP_LEVEL` are enough for its range."""
        finite = plane[np.isfinite(plane)]
        reach = float(finite.max()) - float(finite.min()) if finite.size else 0.0
        return max(reach / _TOP_LEVEL, self.of_noise * _noise(plane), self.of_range * reach)


# Tried in turn until the numbers fit into their budget.
_SHARES = ((0, 0), (1 / 16, 2**-13), (1 / 8, 2**-12), (1 / 4, 2**-11), (1 / 3, 2**-10), (1 / 2, 2**-9), (1 / 2, 2**-8))
_FINENESSES = tuple(Fineness(*shares) for shares in _SHARES)


class ViewerPicture(TypedDict):
    """One picture of the viewer; JSON for the page's script.

    A number is `low + step * level`. `src` is a lossless picture with the high bytes of all levels above their low
    bytes, or else `element` is the id of an 8-bit picture on the page, `toned` if that has the tone curve of sRGB.
    Lengths are those of the numbers after binning.
    """

    kind: Kind
    title: str
    words: str
    place: int | None
    unit: str
    low: float
    step: float
    bins: int
    pitch: NotRequired[float]
    origin: NotRequired[tuple[float, float]]
    src: NotRequired[str]
    element: NotRequired[str]
    toned: NotRequired[bool]


def viewer_of(planes: list[Plane], shown: PlaneSections, the_set: SetSection | None) -> dict[str, Any] | None:
    """Return the data of the viewer as JSON for the page's script, None without planes.

    The grey scales are those of the pictures `shown`. The views are those of `the_set`, if there is one.
    """
    if not planes:
        return None
    units = planes[0].units
    places = {plane.place: plane.label for plane in sorted(planes, key=lambda plane: plane.place)}
    scales: Scales = {"light": {"black": 0.0, "white": shown.white, "name": "planes"}}
    views = _views(the_set, scales) if the_set else []
    numbers = _plane_pictures(planes, list(places), units)
    if shown.sigmas:
        scales["sigma"] = {"black": 0.0, "white": shown.sigmas.white, "name": "standard deviations"}
    pictures = [*views, *numbers]
    return {
        "pictures": pictures,
        "scales": scales,
        "places": list(places.values()),
        "quantity": units.quantity,
        "toned": units.tone_curve,
        "length": units.length or "(unit of the poses)",
        "binned": any(picture["bins"] > 1 for picture in numbers),
        "first": _first(planes, shown, list(places), pictures),
    }


def _first(
    planes: list[Plane], shown: PlaneSections, places: list[tuple[float, str]], pictures: list[ViewerPicture]
) -> tuple[int, int]:
    """Return the pictures that the viewer opens with: what the best is compared with, and the best.

    A plane of all planes together stands beside that of its own, any other beside a view as recorded.
    """
    best, titles = best_column(planes), column_titles(planes)
    of_best = [plane for plane in planes if plane.column == best]
    wanted = places[min(shown.slider_depth, len(places) - 1)]
    lead = min(of_best, key=lambda plane: abs(plane.depth_mm - wanted[0]))

    keys = [(picture["kind"], picture["title"], picture["place"]) for picture in pictures]

    def index_of(column: str) -> int:
        """Return the index of the picture of a column at the place of the best one."""
        return keys.index(("light", titles[column], places.index(lead.place)))

    second = index_of(best)
    if lead.method in JOINT_METHODS:
        alone = [plane for plane in planes if plane.method not in JOINT_METHODS and plane.place == lead.place]
        if alone:
            return index_of(best_column(alone)), second
    return 0 if second else min(1, len(pictures) - 1), second


def _views(the_set: SetSection, scales: Scales) -> list[ViewerPicture]:
    """Return the views that the page shows anyway, whose grey levels the script reads from there."""
    views: list[ViewerPicture] = []
    if the_set.pictures["view"] and the_set.overview.grey_scale_dn is not UNSET:
        black, white = the_set.overview.grey_scale_dn
        scales["view"] = {"black": black, "white": white, "name": "view as recorded"}
        step = (white - black) / _TOP_GREY
        view = _view("view", "One view", "as recorded", "DN", black, step)
        views.append(view | {"toned": True} if the_set.overview.tone else view)
    if the_set.pictures["bright"]:
        scales["bright"] = {"black": 0.0, "white": float(_TOP_GREY), "name": "bright view"}
        title, unit = "The same view in plenty of light", f"of {_TOP_GREY} grey levels"
        views.append(_view("bright", title, "preview", unit, 0.0, 1.0))
    return views


def _view(kind: Kind, title: str, words: str, unit: str, low: float, step: float) -> ViewerPicture:
    element = f"{'recorded' if kind == 'view' else kind}-view"
    return ViewerPicture(
        kind=kind, title=title, words=words, place=None, unit=unit, low=low, step=step, bins=1, element=element
    )


class _Source(NamedTuple):
    """A picture whose numbers are read when they are needed, and what is said of it."""

    plane: Plane
    kind: Kind
    title: str
    place: int

    def read(self, coarser: int) -> tuple[NDArray[np.floating], int]:
        """Return the numbers (row, column[, colour]) in bins, and the width of these; `coarser` is added to it."""
        numbers = self.plane.sidecar_pixels("sigma_file") if self.kind == "sigma" else self.plane.pixels()
        assert numbers is not None
        bins = 1
        while (numbers.shape[0] // bins) * (numbers.shape[1] // bins) > _MAX_SAMPLES:
            bins += 1
        return _binned(numbers, bins + coarser), bins + coarser


def _plane_pictures(planes: list[Plane], places: list[tuple[float, str]], units: StatedUnits) -> list[ViewerPicture]:
    """Return the planes and their standard deviations, as fine as their budget allows; one at a time is in memory."""
    sources, titles = [], column_titles(planes)
    for plane in planes:
        title, place = titles[plane.column], places.index(plane.place)
        sources.append(_Source(plane, "light", title, place))
        if plane.records[0].sigma_file:
            sources.append(_Source(plane, "sigma", f"σ of {title}", place))
    fineness, coarser = _choose_fineness(sources)
    return [_picture(source, fineness, coarser, units) for source in sources]


def _choose_fineness(sources: Sequence[_Source]) -> tuple[Fineness, int]:
    """Return the finest steps and the least extra width of bins that keep a sample of the pictures to its budget."""
    sample = [sources[int(at)] for at in np.unique(np.linspace(0, len(sources) - 1, _SAMPLE).round())]
    share = len(sample) / len(sources)
    budget = share * max(_MIN_BUDGET, _BUDGET_PER_PICTURE * len(sources))
    most = share * max(_MIN_BUDGET, _MOST_PER_PICTURE * len(sources))
    coarser = 0
    while True:
        binned = [source.read(coarser)[0] for source in sample]
        for fineness in _FINENESSES:
            limit = most if fineness is _FINENESSES[-1] else budget
            if sum(len(pack(numbers, fineness.step(numbers)).png) for numbers in binned) <= limit:
                return fineness, coarser
        coarser += 1


def _binned(numbers: NDArray[np.floating], bins: int) -> NDArray[np.floating]:
    """Return the means of bins of `bins` × `bins` samples; incomplete bins at the end are left out."""
    if bins == 1 or min(numbers.shape[:2]) < bins:
        return numbers
    rows, columns = (size // bins for size in numbers.shape[:2])
    whole = numbers[: rows * bins, : columns * bins]
    return np.asarray(cv2.resize(whole, (columns, rows), interpolation=cv2.INTER_AREA), np.float32)


class Packed(NamedTuple):
    """Numbers as a PNG: a number is `low + step * level`, high bytes of the levels above low bytes."""

    png: bytes
    low: float
    step: float


def pack(numbers: NDArray[np.floating], step: float) -> Packed:
    """Return numbers (row, column[, colour]) as a PNG twice as high, which a canvas of 8 bits can decode.

    Numbers that are not finite have the level `UNKNOWN_LEVEL`. `step` is at least the range of the others over 65534.
    """
    known = np.isfinite(numbers)
    low = float(numbers[known].min()) if known.any() else 0.0
    filled = np.where(known, numbers, low).astype(np.float64)
    levels = np.rint((filled - low) / step) if step > 0 else np.zeros(numbers.shape)
    codes = np.where(known, np.clip(levels, 0, _TOP_LEVEL), UNKNOWN_LEVEL).astype(np.uint16)
    both = np.concatenate([(codes >> 8).astype(np.uint8), (codes & 255).astype(np.uint8)])
    return Packed(encoded(both, ".png"), low, step)


def _noise(plane: NDArray[np.floating]) -> float:
    """Return the standard deviation of a plane's noise, from the differences of neighbours along rows."""
    with np.errstate(invalid="ignore"):  # neighbours that are both infinite
        differences = np.abs(np.diff(plane.astype(np.float64), axis=1))
    finite = differences[np.isfinite(differences)]
    return float(np.median(finite) / _MEDIAN_DIFFERENCE) if finite.size else 0.0


def _picture(source: _Source, fineness: Fineness, coarser: int, units: StatedUnits) -> ViewerPicture:
    numbers, bins = source.read(coarser)
    packed = pack(numbers, fineness.step(numbers))
    record = source.plane.records[0]
    pitch = record.pitch_mm
    # The first bin's centre lies half a bin less half a sample from that of the first sample
    x, y = (start + pitch * (bins - 1) / 2 for start in record.origin_mm)
    return {
        "kind": source.kind,
        "title": source.title,
        "words": source.plane.label,
        "place": source.place,
        "unit": units.light_per_pixel,
        "low": packed.low,
        "step": packed.step,
        "bins": bins,
        "pitch": pitch * bins,
        "origin": (x, y),
        "src": smaller_uri(packed.png),
    }
