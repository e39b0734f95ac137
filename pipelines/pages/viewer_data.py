"""Data of a report's viewer: numbers packed in lossless pictures that the page's script decodes, and scales."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Literal, NamedTuple, NotRequired, TypedDict

import cv2
import numpy as np
from msgspec import UNSET
from numpy.typing import NDArray

from faintfield.pipelines.formats.frames import read_frame
from faintfield.pipelines.formats.image_files import encoded, white_level
from faintfield.pipelines.formats.results.records import JOINT_METHODS
from faintfield.pipelines.formats.results.surface import SurfaceFileRecord, SurfaceRecord
from faintfield.pipelines.formats.units import StatedUnits, units_of
from faintfield.pipelines.pages.page import smaller_uri
from faintfield.pipelines.pages.report_pictures import PlaneSections
from faintfield.pipelines.pages.report_planes import Plane, best_column, column_titles, existing
from faintfield.pipelines.pages.report_sets import SetSection
from faintfield.pipelines.reconstruction.depth.depth_map import limits_of_likely, robust_limits
from faintfield.pipelines.reconstruction.planes.saturation import has_unknown
from faintfield.recon.threads import map_in_threads

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

# Steps of a surface's maps over nearly all of their range: depths are known to a percent at best.
_MAP_STEPS = 512

type Kind = Literal["light", "sigma", "view", "bright", "depth", "depth_sigma", "confidence"]


class Scale(TypedDict):
    """Black, white and name of the pictures of a kind when the page opens; maps in `colours` instead of grey."""

    black: float
    white: float
    name: str
    colours: NotRequired[bool]


type Scales = dict[Kind, Scale]


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
    bytes, or else `element` is the id of an 8-bit picture on the page: `toned` if it has the tone curve of sRGB, and
    of integers if `whole`. Lengths are those of the numbers after binning. `sigma` is the index of the picture of their
    standard deviations, and `confidence` that of the probabilities that they are right, which are sure from
    `sure_above` on. Samples without a number are not known, or else `saturated`.
    """

    kind: Kind
    title: str
    label: str
    place: int | None
    unit: str
    low: float
    step: float
    bins: int
    pitch: NotRequired[float]
    origin: NotRequired[tuple[float, float]]
    src: NotRequired[str]
    element: NotRequired[str]
    whole: NotRequired[bool]
    sigma: NotRequired[int]
    confidence: NotRequired[int]
    sure_above: NotRequired[float]
    toned: NotRequired[bool]
    saturated: NotRequired[bool]


class ViewerData(TypedDict):
    """Data of the viewer; JSON for the page's script.

    `first` are the indices of the pictures that it opens with, and `length` is the unit of length. Planes are in bins
    if `binned`.
    """

    pictures: list[ViewerPicture]
    scales: Scales
    places: list[str]
    quantity: str
    toned: bool
    length: str
    binned: bool
    first: tuple[int, int]


def viewer_of(
    planes: list[Plane],
    shown: PlaneSections,
    the_set: SetSection | None,
    surfaces: Mapping[Path, SurfaceFileRecord] = MappingProxyType({}),
) -> ViewerData | None:
    """Return the data of the viewer, None without planes and surfaces.

    The grey scales are those of the pictures `shown`. The views are those of `the_set`, if there is one.
    """
    if not planes and not surfaces:
        return None
    units = planes[0].units if planes else units_of(next(iter(surfaces.values())))
    places = {plane.place: plane.label for plane in sorted(planes, key=lambda plane: plane.place)}
    scales: Scales = {}
    if planes:
        scales["light"] = {"black": 0.0, "white": shown.white, "name": "planes"}
    if shown.sigmas:
        scales["sigma"] = {"black": 0.0, "white": shown.sigmas.white, "name": "standard deviations"}
    pictures = _views(the_set, scales) if the_set else []
    sources = _plane_sources(planes, list(places))
    maps: list[_Source] = []
    for folder, made in surfaces.items():
        title = "Surface" if len(surfaces) == 1 else f"Surface {folder.name}"
        picture, *others = _surface_sources(folder, made.surface, title, units_of(made), scales)
        sources, maps = [*sources, picture], maps + others
    fineness, coarser = _choose_fineness(sources)
    numbers = map_in_threads(lambda source: _picture(source, fineness, coarser), sources)
    pictures += numbers + map_in_threads(lambda source: _map_picture(source, coarser), maps)
    _refer(pictures)
    return {
        "pictures": pictures,
        "scales": scales,
        "places": list(places.values()),
        "quantity": units.quantity,
        "toned": units.tone_curve,
        "length": units.length or "(unit of the poses)",
        "binned": any(picture["bins"] > 1 for picture in numbers),
        "first": _first(planes, shown, list(places), pictures) if planes else _first_of_surface(pictures),
    }


def _refer(pictures: list[ViewerPicture]) -> None:
    """Name beside each picture those of its standard deviations and of its probabilities."""
    indices = {(picture["kind"], picture["title"], picture["place"]): at for at, picture in enumerate(pictures)}
    for picture in pictures:
        title, place = picture["title"], picture["place"]
        kind: Kind = "sigma" if picture["kind"] == "light" else "depth_sigma"
        sigma = indices.get((kind, title if place is None else f"σ of {title}", place))
        if picture["kind"] in ("light", "depth") and sigma is not None:
            picture["sigma"] = sigma
        confidence = indices.get(("confidence", title, place))
        if picture["kind"] == "depth" and confidence is not None:
            picture["confidence"] = confidence


def _first_of_surface(pictures: list[ViewerPicture]) -> tuple[int, int]:
    """Return the pictures that the viewer opens with: a view as recorded, else the depth; and the surface's picture."""
    kinds = [picture["kind"] for picture in pictures]
    return kinds.index("view" if "view" in kinds else "depth"), kinds.index("light")


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
        views.append(_view("view", "One view", "as recorded", "DN", black, step))
        views[-1]["whole"] = the_set.overview.whole_dn is True
        views[-1]["toned"] = the_set.overview.tone == "srgb"
    if the_set.pictures["bright"]:
        scales["bright"] = {"black": 0.0, "white": float(_TOP_GREY), "name": "bright view"}
        title, unit = "The same view in plenty of light", f"of {_TOP_GREY} grey levels"
        views.append(_view("bright", title, "preview", unit, 0.0, 1.0))
    return views


def _view(kind: Kind, title: str, label: str, unit: str, low: float, step: float) -> ViewerPicture:
    element = f"{'recorded' if kind == 'view' else kind}-view"
    return ViewerPicture(
        kind=kind, title=title, label=label, place=None, unit=unit, low=low, step=step, bins=1, element=element
    )


class _Source(NamedTuple):
    """A picture whose numbers are read when they are needed, and what is said of it.

    `pitch` and `origin` are those of its samples in the unit of length; a surface has none.
    """

    read: Callable[[], NDArray[np.floating]]
    kind: Kind
    title: str
    label: str
    place: int | None
    unit: str
    pitch: float | None = None
    origin: tuple[float, float] = (0.0, 0.0)
    sure_above: float | None = None
    saturated: bool = False

    def binned(self, coarser: int) -> tuple[NDArray[np.floating], int]:
        """Return the numbers (row, column[, colour]) in bins, and the width of these; `coarser` is added to it."""
        numbers = self.read()
        bins = 1
        while (numbers.shape[0] // bins) * (numbers.shape[1] // bins) > _MAX_SAMPLES:
            bins += 1
        return _binned(numbers, bins + coarser), bins + coarser


def _plane_sources(planes: list[Plane], places: list[tuple[float, str]]) -> list[_Source]:
    """Return the planes and their standard deviations."""
    sources, titles = [], column_titles(planes)
    for plane in planes:
        title, place, record = titles[plane.column], places.index(plane.place), plane.records[0]
        at = (plane.label, place, plane.units.light_per_pixel, record.pitch_mm, record.origin_mm)
        saturated = has_unknown(plane.records)
        sources.append(_Source(plane.pixels, "light", title, *at, saturated=saturated))
        if record.sigma_file:
            sources.append(_Source(partial(_sigma_of, plane), "sigma", f"σ of {title}", *at, saturated=saturated))
    return sources


def _sigma_of(plane: Plane) -> NDArray[np.floating]:
    sigma = plane.sidecar_pixels("sigma_file")
    assert sigma is not None
    return sigma


def _surface_sources(
    folder: Path, surface: SurfaceRecord, title: str, units: StatedUnits, scales: Scales
) -> list[_Source]:
    """Return a surface's picture and its maps; scales that are missing are added."""
    what, length = "disparity" if surface.unit == "px" else "depth", "" if surface.unit == "relative" else surface.unit
    entries: tuple[tuple[Kind, str, str, str], ...] = (
        ("light", surface.picture, "picture", units.light_per_pixel),
        ("sigma", surface.picture_sigma, "σ of the light", units.light_per_pixel),
        ("depth", surface.depth, what, length),
        ("depth_sigma", surface.depth_sigma, f"σ of the {what}", length),
        ("confidence", surface.depth_confidence, f"probability of the {what}", ""),
    )

    def read(name: str) -> NDArray[np.floating]:
        return np.asarray(read_frame(existing(folder / name)).pixels_dn, np.float32)

    def limits(kind: Kind, name: str) -> tuple[float, float]:
        """Return black and white of a kind; colours of depths span the likely ones, as in the preview."""
        if kind == "confidence":
            return 0.0, 1.0
        values = read(name)
        if kind in ("light", "sigma"):
            return 0.0, white_level(values) or 1.0
        if kind == "depth":
            return limits_of_likely(values, read(surface.depth_confidence))
        return robust_limits(values)

    sources = []
    for kind, name, label, unit in entries:
        sure_above = surface.sure_above if kind == "depth" else None
        saturated = kind in ("light", "sigma") and has_unknown(surface.channels)
        source = _Source(
            partial(read, name), kind, title, label, None, unit, sure_above=sure_above, saturated=saturated
        )
        sources.append(source)
        if kind not in scales:
            black, white = limits(kind, name)
            scales[kind] = {"black": black, "white": white, "name": label}
            if kind not in ("light", "sigma"):
                scales[kind]["colours"] = True
    return sources


def _map_picture(source: _Source, coarser: int) -> ViewerPicture:
    numbers, bins = source.binned(coarser)
    low, high = robust_limits(numbers)
    finite = numbers[np.isfinite(numbers)]
    step = max((high - low) / _MAP_STEPS, float(np.ptp(finite)) / _TOP_LEVEL if finite.size else 0.0)
    picture = _packed_picture(source, numbers, step, bins)
    if source.sure_above is not None:
        picture["sure_above"] = source.sure_above
    return picture


def _choose_fineness(sources: Sequence[_Source]) -> tuple[Fineness, int]:
    """Return the finest steps and the least extra width of bins that keep a sample of the pictures to its budget."""
    sample = [sources[int(at)] for at in np.unique(np.linspace(0, len(sources) - 1, _SAMPLE).round())]
    share = len(sample) / len(sources)
    budget = share * max(_MIN_BUDGET, _BUDGET_PER_PICTURE * len(sources))
    most = share * max(_MIN_BUDGET, _MOST_PER_PICTURE * len(sources))
    coarser = 0
    while True:
        binned = [source.binned(coarser)[0] for source in sample]
        for fineness in _FINENESSES:
            limit = most if fineness is _FINENESSES[-1] else budget
            sizes = map_in_threads(partial(_packed_bytes, fineness), binned)
            if sum(sizes) <= limit:
                return fineness, coarser
        coarser += 1


def _packed_bytes(fineness: Fineness, numbers: NDArray[np.floating]) -> int:
    return len(pack(numbers, fineness.step(numbers)).png)


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


def _picture(source: _Source, fineness: Fineness, coarser: int) -> ViewerPicture:
    numbers, bins = source.binned(coarser)
    return _packed_picture(source, numbers, fineness.step(numbers), bins)


def _packed_picture(source: _Source, numbers: NDArray[np.floating], step: float, bins: int) -> ViewerPicture:
    packed = pack(numbers, step)
    picture = ViewerPicture(
        kind=source.kind,
        title=source.title,
        label=source.label,
        place=source.place,
        unit=source.unit,
        low=packed.low,
        step=packed.step,
        bins=bins,
        src=smaller_uri(packed.png),
    )
    if source.saturated:
        picture["saturated"] = True
    if source.pitch is not None:
        # The first bin's centre lies half a bin less half a sample from that of the first sample
        x, y = (start + source.pitch * (bins - 1) / 2 for start in source.origin)
        picture |= {"pitch": source.pitch * bins, "origin": (x, y)}
    return picture
