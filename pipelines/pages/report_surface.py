"""Surfaces and depth maps in a report: pictures, known share, and prediction of views that were left out."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from msgspec import UNSET, UnsetType

from faintfield.pipelines.formats.reading import read_content
from faintfield.pipelines.formats.results.records import DepthMapRecord, ReconstructionRecord, preview_name
from faintfield.pipelines.formats.results.surface import HeldOutRecord, SurfaceFileRecord, SurfaceRecord
from faintfield.pipelines.formats.units import MAX_PREVIEW_BYTES
from faintfield.pipelines.pages.page import LOSSLESS, Fact, data_uri, figure, smaller_uri

# Kinds of films that browsers play.
_FILMS = (".webp", ".png")

# Quality of maps as WebP, on a scale to 100: those of noise would take a tenth of the page without losses.
_MAP_QUALITY = 55

# Deviance up to which views differ from a prediction by little more than noise.
_NOISE_ALONE = 1.1

# A gain over planes that counts, in standard errors.
_SIGNIFICANT = 3.0


class Figure(NamedTuple):
    """A picture as data URI with its name and caption; `moving` is a film of it, if there is one."""

    src: str
    name: str
    caption: str
    moving: str | None = None


class Prediction(NamedTuple):
    """Prediction of the left-out views by one way."""

    by: str
    deviance: float
    best: bool


class DepthSection(NamedTuple):
    """A depth map with its pictures as data URIs; None if the file is missing."""

    title: str
    record: DepthMapRecord
    all_in_focus: str | None
    map: str | None
    confidence: str | None


def depth_sections(directory: Path, results: dict[Path, ReconstructionRecord]) -> list[DepthSection]:
    """Return the part of the page about each depth map."""
    return [
        DepthSection(
            folder.relative_to(directory).as_posix(),
            record,
            *(
                _embedded(folder / preview_name(Path(name).name))
                for name in (record.all_in_focus, record.file, record.confidence)
            ),
        )
        for folder, result in results.items()
        if (record := result.depth_map)
    ]


class SurfaceSection(NamedTuple):
    """Part of the page about one surface; a row of its table is name, value and meaning of a number.

    Facts are the numbers that matter most; the warning is of a surface that does not explain its views. Predictions,
    and the verdict that follows from them, are of views that were left out; empty if none were.
    """

    title: str
    facts: list[Fact]
    warning: str | None
    made: SurfaceFileRecord
    picture: str | None
    figures: list[Figure]
    rows: list[tuple[str, str, str]]
    predictions: list[Prediction]
    verdict: str


def surface_sections(directory: Path, surfaces: dict[Path, SurfaceFileRecord]) -> list[SurfaceSection]:
    """Return the part of the page about each surface."""
    return [_section(folder.relative_to(directory).as_posix(), folder, made) for folder, made in surfaces.items()]


def _section(title: str, folder: Path, made: SurfaceFileRecord) -> SurfaceSection:
    surface = made.surface
    predictions = _predictions(surface.held_out) if surface.held_out else []
    verdict = _verdict(surface.held_out, predictions) if surface.held_out else ""
    if surface.warning is not None:
        verdict = "The surface does not explain them."
    picture = _embedded(folder / preview_name(surface.picture))
    figures = _figures(folder, surface)
    rows, facts = _rows(surface), _facts(surface)
    return SurfaceSection(title, facts, surface.warning, made, picture, figures, rows, predictions, verdict)


def _facts(surface: SurfaceRecord) -> list[Fact]:
    """Return the share of sure depths, and how well the surface explains its views."""
    probability = f"with a probability of at least {100 * surface.sure_above:.0f} %"
    means = f"of the picture: the {_quantity(surface)} is right within {_tolerance(surface)} {probability}"
    sure = Fact(f"Sure {_quantity(surface)}s".replace("ys", "ies"), f"{100 * surface.sure_share:.0f} %", means)
    name = "Deviance; 1 is perfect"
    if surface.held_out is None:
        return [sure, Fact(name, "–", "not known: with so few views none is left out to compare with")]
    deviance = surface.held_out.surface
    times = "by their noise alone" if deviance <= _NOISE_ALONE else f"by {figure(deviance**0.5, 2)} times their noise"
    means = f"views that were left out differ from its prediction {times}"
    if (unexplained := surface.held_out.unexplained_share) is not None:
        means += f", and it explains {max(100 - 100 * unexplained, 0):.0f} % of what changes from view to view"
    return [sure, Fact(name, figure(deviance), means)]


def _figures(folder: Path, surface: SurfaceRecord) -> list[Figure]:
    quantity, unit = _quantity(surface), surface.unit
    film = _embedded_film(folder / surface.film) if surface.film and Path(surface.film).suffix in _FILMS else None
    circling = "From viewpoints between the nodes; the middle depth stands still, what is nearer moves most"
    measured = "in the unit of the poses, whose length is not known" if unit == "relative" else f"in {unit}"
    right = f"Probability that the {quantity} is right within {_tolerance(surface)}"
    known = f"Where each sample is, {measured}; hatched where that is not sure, grey where it is not known"
    entries: list[tuple[str | UnsetType, str, str]] = [
        (surface.picture, "Picture.", "One from all views, as the reference camera would see it"),
        (surface.depth, f"{quantity.capitalize()}, {unit}.", known),
        (surface.depth_confidence, "How sure.", right),
        (
            surface.visibility,
            "Seen by.",
            "Pixels that show the sample, by their weights: about one for each view in which nothing hides it",
        ),
        (surface.picture_proposal, "Proposal.", "What the prior proposed"),
        (surface.picture_moved, "Moved, σ.", "Picture less proposal, in standard deviations of the noise"),
    ]
    figures = [
        Figure(src, name, caption)
        for file, name, caption in entries
        if file is not UNSET
        and (src := _embedded(folder / preview_name(file), LOSSLESS if file == surface.picture else _MAP_QUALITY))
    ]
    if film is not None:
        still = _embedded(folder / preview_name(surface.picture)) or film
        figures.insert(1, Figure(still, "Moving.", circling, film))
    return figures


def _embedded(path: Path, quality: int = LOSSLESS) -> str | None:
    return smaller_uri(read_content(path, MAX_PREVIEW_BYTES), quality) if path.is_file() else None


def _embedded_film(path: Path) -> str | None:
    return data_uri(read_content(path, MAX_PREVIEW_BYTES), path.suffix) if path.is_file() else None


def _rows(surface: SurfaceRecord) -> list[tuple[str, str, str]]:
    quantity, unit = _quantity(surface), "" if surface.unit == "relative" else f" {surface.unit}"
    first, last = (figure(value) for value in surface.searched)
    how = "found in the views" if surface.range_found else "as asked for"
    compared = f"{how}; {surface.depths} depths compared in bins of {surface.bins_px} × {surface.bins_px} pixels"
    median = f"{figure(surface.median)}{unit}" if surface.median is not None else "–"
    return [
        (f"{quantity.capitalize()} searched", f"{first} to {last}{unit}", compared),
        (f"Median {quantity}", median, f"of all samples whose {quantity} is known, sure or not"),
        ("Known", f"{100 * surface.known_share:.0f} %", f"of the picture has a {quantity}, sure or not"),
    ]


def _quantity(surface: SurfaceRecord) -> str:
    return "disparity" if surface.unit == "px" else "depth"


def _tolerance(surface: SurfaceRecord) -> str:
    return "2 % of its difference from that of infinity" if surface.unit == "px" else "2 %"


def _predictions(held_out: HeldOutRecord) -> list[Prediction]:
    ways = [
        ("this surface", held_out.surface),
        ("the same depths on a few planes", held_out.planes),
        ("the mean of each view’s neighbours, blurred", held_out.neighbours),
    ]
    known = [(by, deviance) for by, deviance in ways if deviance is not None]
    lowest = min(deviance for _, deviance in known)
    return [Prediction(by, deviance, deviance == lowest) for by, deviance in known]


def _verdict(held_out: HeldOutRecord, predictions: Sequence[Prediction]) -> str:
    """Return in words what follows from the predictions, of which that by the surface is the first."""
    if len(predictions) < 2:
        return ""
    if predictions[0].best:
        if held_out.planes is not None and held_out.standard_error is not UNSET:
            gain = held_out.planes - held_out.surface
            if gain < _SIGNIFICANT * held_out.standard_error:
                return "The surface predicts them no better than planes do: the views do not show its shapes."
        return "The surface predicts them best: its depths explain what other cameras see."
    best = next(prediction.by for prediction in predictions if prediction.best)
    return f"They are predicted better by {best}: take the depths with caution."
