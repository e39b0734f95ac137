"""The sets of a report: each distinct set once, with its pictures as they were recorded, and its light."""

from dataclasses import dataclass
from pathlib import Path

from faintfield.pipelines.formats.frames import read_frame
from faintfield.pipelines.formats.image_files import encoded
from faintfield.pipelines.formats.results.records import Overview
from faintfield.pipelines.formats.results.result_files import read_result
from faintfield.pipelines.pages.page import data_uri
from faintfield.pipelines.pages.report_light import PhotonBudget, photon_budget
from faintfield.pipelines.pages.report_planes import PREFERRED_POSES
from faintfield.pipelines.reconstruction.overview import (
    BRIGHT_VIEW,
    INTEGRAL_IMAGE,
    NOISE_REFERENCE_VIEW,
    REFERENCE_VIEW,
    REGION_OUTLINED,
)

# Width of a picture that is shown pixel for pixel: two stand side by side.
_PIXELS_ACROSS = 540


@dataclass(frozen=True, kw_only=True)
class SetSection:
    """What the page shows of one set; pictures are data URIs, None if the file is missing.

    Attributes
    ----------
    overview : Overview
        What overview.json records.
    noise_free : bool
        The set has no read noise.
    integral, bright, region : str, optional
        All views, the bright view, and the object region outlined in it.
    pixels, no_light : str, optional
        The middle of the reference view and of the noise reference, pixel for pixel.
    view : str, optional
        The reference view.
    budget : PhotonBudget, optional
        Its light, if there is any.
    """

    overview: Overview
    noise_free: bool
    integral: str | None
    bright: str | None
    region: str | None
    pixels: str | None
    no_light: str | None
    view: str | None
    budget: PhotonBudget | None


def set_sections(overviews: list[Path]) -> list[SetSection]:
    """Return what the page shows of each set, sets with noise first; sets with equal pictures are one set.

    A set may have been reconstructed with several kinds of poses; its overview is that of the preferred ones.

    Parameters
    ----------
    overviews : list of Path
        Every overview.json.
    """
    distinct: dict[tuple[bytes, ...], tuple[Path, Overview]] = {}
    for path in overviews:
        overview = read_result(path, Overview)
        pictures = [path.with_name(name) for name in (INTEGRAL_IMAGE, REFERENCE_VIEW)]
        key = tuple(picture.read_bytes() for picture in pictures if picture.is_file()) or (path.read_bytes(),)
        if key not in distinct or _rank(overview) < _rank(distinct[key][1]):
            distinct[key] = (path.parent, overview)
    sections = [_section(folder, overview) for folder, overview in distinct.values()]
    return sorted(sections, key=lambda section: section.noise_free)


def _rank(overview: Overview) -> int:
    return PREFERRED_POSES.index(overview.poses)


def _section(folder: Path, overview: Overview) -> SetSection:
    """Return what the page shows of one set."""
    view = folder / REFERENCE_VIEW
    return SetSection(
        overview=overview,
        noise_free=overview.read_noise_e == 0,
        integral=_whole(folder / INTEGRAL_IMAGE),
        bright=_whole(folder / BRIGHT_VIEW),
        region=_whole(folder / REGION_OUTLINED),
        pixels=_pixel_for_pixel(view),
        no_light=_pixel_for_pixel(folder / NOISE_REFERENCE_VIEW),
        view=_thinned(view),
        budget=photon_budget(overview),
    )


def _whole(path: Path) -> str | None:
    """Return a picture as it is."""
    return data_uri(path.read_bytes(), ".png") if path.is_file() else None


def _pixel_for_pixel(path: Path) -> str | None:
    """Return the middle of a picture, as large as can be shown pixel for pixel: shrinking would hide the noise."""
    if not path.is_file():
        return None
    picture = read_frame(path).pixels_dn
    (top, left) = ((size - min(size, _PIXELS_ACROSS)) // 2 for size in picture.shape[:2])
    return data_uri(encoded(picture[top : top + _PIXELS_ACROSS, left : left + _PIXELS_ACROSS], ".png"), ".png")


def _thinned(path: Path) -> str | None:
    """Return a whole picture, with pixels left out if it is too wide: averaging would reduce the noise."""
    if not path.is_file():
        return None
    picture = read_frame(path).pixels_dn
    step = -(-picture.shape[1] // (2 * _PIXELS_ACROSS))
    return data_uri(encoded(picture[::step, ::step], ".png"), ".png")
