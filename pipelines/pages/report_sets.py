"""The sets of a report: each distinct set once, with its pictures as they were recorded, and its light."""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import NamedTuple

from msgspec import UNSET

from faintfield.pipelines.formats.files import file_within
from faintfield.pipelines.formats.frames import read_frame
from faintfield.pipelines.formats.image_files import encoded
from faintfield.pipelines.formats.reading import read_content
from faintfield.pipelines.formats.results.figures import Overview
from faintfield.pipelines.formats.results.surface import read_result
from faintfield.pipelines.formats.units import MAX_PREVIEW_BYTES, units_of
from faintfield.pipelines.pages.page import LOSSLESS, smaller_uri
from faintfield.pipelines.pages.report_planes import PREFERRED_POSES
from faintfield.pipelines.reconstruction.overview import (
    BRIGHT_VIEW,
    INTEGRAL_IMAGE,
    NOISE_REFERENCE_VIEW,
    REFERENCE_VIEW,
    REGION_OUTLINED,
)
from faintfield.recon.metrics import noise_variance_e2
from faintfield.recon.threads import map_in_threads

# Width of a picture that is shown pixel for pixel: two stand side by side.
_PIXELS_ACROSS = 540

# Quality of the picture of all views, most of which is noise: it would be a fifth of the page without losses.
_OVERVIEW_QUALITY = 45


class LightRow(NamedTuple):
    """Light per pixel by one formula: electrons and photons of one view, photons per second, photons of all views."""

    name: str
    electrons: float
    photons: float | None = None
    flux: float | None = None
    all_views: float | None = None


class PhotonBudget(NamedTuple):
    """The light on a pixel by each formula, and the variance of eq. (6) with the share of each of its parts."""

    light: list[LightRow]
    variance_e2: float
    shares: dict[str, float]


class SetSection(NamedTuple):
    """Part of the page about one set, whose pictures are data URIs, None if the file is missing."""

    overview: Overview
    noise_free: bool
    budget: PhotonBudget | None
    pictures: dict[str, str | None]


def set_sections(overviews: list[Path]) -> list[SetSection]:
    """Return the part of the page about each set, sets with noise first; sets with equal pictures are one set.

    Of a set that was reconstructed with several kinds of poses, the overview.json with the preferred ones is shown.
    """
    distinct: dict[tuple[bytes, ...], tuple[Path, Overview]] = {}
    for path in overviews:
        overview = read_result(path, Overview)
        for name in (INTEGRAL_IMAGE, REFERENCE_VIEW, NOISE_REFERENCE_VIEW, BRIGHT_VIEW, REGION_OUTLINED):
            file_within(path.parent, name)
        pictures = [path.with_name(name) for name in (INTEGRAL_IMAGE, REFERENCE_VIEW)]
        key = tuple(read_content(picture, MAX_PREVIEW_BYTES) for picture in pictures if picture.is_file()) or (
            read_content(path),
        )
        rank = PREFERRED_POSES.index(overview.poses)
        if key not in distinct or rank < PREFERRED_POSES.index(distinct[key][1].poses):
            distinct[key] = (path.parent, overview)
    sections = map_in_threads(lambda of_set: _section(*of_set), list(distinct.values()))
    return sorted(sections, key=lambda section: section.noise_free)


def _section(folder: Path, overview: Overview) -> SetSection:
    makers: dict[str, tuple[str, Callable[[Path], str]]] = {
        "integral": (INTEGRAL_IMAGE, partial(_whole, quality=_OVERVIEW_QUALITY)),
        "bright": (BRIGHT_VIEW, _whole),
        "region": (REGION_OUTLINED, _whole),
        "pixels": (REFERENCE_VIEW, _middle),
        "no_light": (NOISE_REFERENCE_VIEW, _middle),
        "view": (REFERENCE_VIEW, _thinned),
    }
    pictures = {
        kind: make(folder / name) if (folder / name).is_file() else None for kind, (name, make) in makers.items()
    }
    return SetSection(overview, overview.read_noise_e == 0, photon_budget(overview), pictures)


def _whole(path: Path, quality: int = LOSSLESS) -> str:
    return smaller_uri(read_content(path, MAX_PREVIEW_BYTES), quality)


def _middle(path: Path) -> str:
    """Return the middle of a picture, as large as can be shown pixel for pixel: shrinking would hide the noise."""
    picture = read_frame(path).pixels_dn
    (top, left) = ((size - min(size, _PIXELS_ACROSS)) // 2 for size in picture.shape[:2])
    return smaller_uri(encoded(picture[top : top + _PIXELS_ACROSS, left : left + _PIXELS_ACROSS], ".png"))


def _thinned(path: Path) -> str:
    """Return a whole picture, with pixels left out if it is too wide: averaging would reduce the noise."""
    picture = read_frame(path).pixels_dn
    step = -(-picture.shape[1] // (2 * _PIXELS_ACROSS))
    return smaller_uri(encoded(picture[::step, ::step], ".png"))


def photon_budget(overview: Overview) -> PhotonBudget | None:
    """Return the photon budget of a set, None without light or electrons, or if its dark level is not recorded."""
    light, dark_e = overview.brightness, overview.dark_e
    signal_e = light.mean_signal_e
    if dark_e is UNSET or signal_e <= 0 or units_of(overview).light != "electrons":
        return None
    by_formula = (
        ("the paper’s linear formula, eq. (7)", light.electrons_linear),
        ("moments: a uniform object of this SNR, eq. (4) being a ratio of powers", light.electrons_from_moments),
        ("counted: mean signal above dark", signal_e),
    )
    variance = noise_variance_e2(
        signal_e,
        1.0,  # of one exposure, however long
        quantum_efficiency=1.0,
        dark_current_e_per_s=dark_e,
        read_noise_e=overview.read_noise_e,
    )
    parts = (("read noise", overview.read_noise_e**2), ("light", signal_e), ("dark current", dark_e))
    return PhotonBudget(
        light=[_light_row(formula, light_e, overview) for formula, light_e in by_formula if light_e is not None],
        variance_e2=variance,
        shares={name: part / variance for name, part in parts},
    )


def _light_row(formula: str, electrons: float, overview: Overview) -> LightRow:
    if overview.quantum_efficiency is None:
        return LightRow(formula, electrons)
    photons = electrons / overview.quantum_efficiency
    per_s = None if overview.exposure_s is None else photons / overview.exposure_s
    return LightRow(formula, electrons, photons, per_s, photons * overview.views)
