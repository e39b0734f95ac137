"""What the camera saw: each distinct set of a report once, its pictures as they were recorded, and its light."""

from pathlib import Path
from typing import Any

from faintfield.pipelines.formats.frames import read_frame
from faintfield.pipelines.formats.image_files import encoded
from faintfield.pipelines.formats.results.result_files import Overview, read_result
from faintfield.pipelines.pages.page import data_uri
from faintfield.pipelines.pages.report_calibration import photon_budget
from faintfield.pipelines.reconstruction.overview import (
    BRIGHT_VIEW,
    INTEGRAL_IMAGE,
    REFERENCE_OF_NOISE,
    REFERENCE_VIEW,
    REGION_OUTLINED,
)

# Two of them stand side by side, pixel for pixel.
_PIXELS_ACROSS = 540

# One set may have been reconstructed with several poses; what is said of it then comes from the first of these.
_POSES = ("measured", "stated", "nominal", "true")


def set_sections(overviews: list[Path]) -> list[dict[str, Any]]:
    """Return what the page says of each set, sets with noise first; the same pictures are the same set.

    Parameters
    ----------
    overviews : list of Path
        Every overview.json.
    """
    distinct: dict[tuple[bytes, ...], tuple[Path, dict[str, Any]]] = {}
    for path in overviews:
        overview = read_result(path, Overview)
        pictures = [path.with_name(name) for name in (INTEGRAL_IMAGE, REFERENCE_VIEW)]
        key = tuple(picture.read_bytes() for picture in pictures if picture.is_file()) or (path.read_bytes(),)
        if key not in distinct or _rank(overview) < _rank(distinct[key][1]):
            distinct[key] = (path.parent, overview)
    sections = [_section(folder, overview) for folder, overview in distinct.values()]
    return sorted(sections, key=lambda section: bool(section["noise_free"]))


def _rank(overview: dict[str, Any]) -> int:
    return _POSES.index(overview.get("poses", "stated"))


def _section(folder: Path, overview: dict[str, Any]) -> dict[str, Any]:
    """Return what the page says of one set."""
    whole = {
        key: data_uri((folder / name).read_bytes(), ".png") if (folder / name).is_file() else None
        for key, name in (("integral", INTEGRAL_IMAGE), ("bright", BRIGHT_VIEW), ("region", REGION_OUTLINED))
    }
    pixels = {
        key: _pixel_for_pixel(folder / name) if (folder / name).is_file() else None
        for key, name in (("view", REFERENCE_VIEW), ("nothing", REFERENCE_OF_NOISE))
    }
    view = folder / REFERENCE_VIEW
    return {
        **overview,
        "noise_free": overview["read_noise_e"] == 0,
        "pictures": whole | pixels,
        "view": _thinned(view) if view.is_file() else None,
        "budget": photon_budget(overview),
    }


def _pixel_for_pixel(path: Path) -> str:
    """Return a picture as it is; of one too large to be shown so, the middle, since to shrink noise would hide it."""
    picture = read_frame(path).pixels_dn
    (top, left) = ((size - min(size, _PIXELS_ACROSS)) // 2 for size in picture.shape[:2])
    return data_uri(encoded(picture[top : top + _PIXELS_ACROSS, left : left + _PIXELS_ACROSS], ".png"), ".png")


def _thinned(path: Path) -> str:
    """Return a whole picture no wider than what it stands beside, pixels left out: their means would be less noisy."""
    picture = read_frame(path).pixels_dn
    step = -(-picture.shape[1] // (2 * _PIXELS_ACROSS))
    return data_uri(encoded(picture[::step, ::step], ".png"), ".png")
