"""Sets and records of results as a person writes them."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import tomli_w
from numpy.typing import NDArray

from faintfield.pipelines.formats.image_files import write_frame
from faintfield.pipelines.formats.provenance import DIGEST_KEY
from faintfield.pipelines.formats.sets.elemental_set import load_set
from faintfield.pipelines.reconstruction.channels import channel_layouts, load_channel
from faintfield.recon.likelihood.images import ElementalImages


class View(NamedTuple):
    """An image (row, column[, colour]) of a set, with its node and its pose rt_cam_ref."""

    image: NDArray[Any]
    node: tuple[int, int]
    pose: Sequence[float] | NDArray[np.floating]


def write_set(
    folder: Path,
    views: Sequence[View],
    *,
    noise: dict[str, Any] | str | None = None,
    camera: dict[str, Any] | None = None,
    exposure_s: float = 0.5,
    reference_view: int = 0,
) -> Path:
    """Write a set of `view_0.tiff`, `view_1.tiff`, … into a folder, and return the folder."""
    folder.mkdir(exist_ok=True)
    height, width = views[0].image.shape[:2]
    for index, view in enumerate(views):
        write_frame(folder / f"view_{index}.tiff", view.image)
    lens = {"fx_px": 50.0, "fy_px": 50.0, "cx_px": (width - 1) / 2, "cy_px": (height - 1) / 2}
    settings = {
        "format": 1,
        "exposure_s": exposure_s,
        "reference_view": reference_view,
        "camera": {"size_px": [width, height], **lens, **(camera or {})},
        "noise": noise or {"offset_dn": 100.0, "gain_dn_per_e": 2.0, "read_noise_e": 3.0},
        "view": [
            {"image": f"view_{index}.tiff", "rt_cam_ref": [float(number) for number in view.pose], "node": view.node}
            for index, view in enumerate(views)
        ],
    }
    (folder / "elemental.toml").write_text(tomli_w.dumps(settings))
    return folder


def channels_of(folder: Path) -> dict[str, ElementalImages]:
    """Return the images of a set by the names of their colours."""
    elemental_set = load_set(folder)
    return {layout.name: load_channel(elemental_set, layout) for layout in channel_layouts(elemental_set)}


FITTED = {
    "offset_dn": {"value": 100.0, "se": 0.1},
    "gain_dn_per_e": {"value": 2.0, "se": 0.01},
    "read_noise_e": {"value": 3.0, "se": 0.02},
    "dark_current_e_per_s": {"value": 0.2, "se": 0.01},
}


def write_fitted_noise(folder: Path, values: Mapping[str, float] | None = None, **others: Any) -> None:
    """Write `noise.json` with these values, by default FITTED, as `faintfield noise` does."""
    fitted = FITTED | {name: {"value": value, "se": 0.0} for name, value in (values or {}).items()}
    (folder / "noise.json").write_text(json.dumps(fitted | others))


def write_by_hand(path: Path, record: dict[str, Any]) -> None:
    """Write a record, edited or new, without the digest that it may have had: its numbers are taken as they stand."""
    path.write_text(json.dumps({key: value for key, value in record.items() if key != DIGEST_KEY}))
