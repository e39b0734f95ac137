"""What a report says of the camera: its noise, its geometry, and of what light and noise its pixels were made."""

import hashlib
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from faintfield.pipelines.formats.results.result_files import Geometry, Noise, read_result
from faintfield.pipelines.formats.sets.measured_poses import GEOMETRY_PAGE
from faintfield.pipelines.pages.page import data_uri
from faintfield.recon.metrics import noise_variance_e2

NOISE_FILE = "noise.json"

_NOISE_ROWS = (
    ("offset_dn", "offset", "DN"),
    ("gain_dn_per_e", "gain", "DN/e⁻"),
    ("read_noise_e", "read noise, rms", "e⁻"),
    ("dark_current_e_per_s", "dark current", "e⁻/s"),
    ("dsnu_e", "offset differs between pixels by (DSNU)", "e⁻"),
    ("dcnu_e_per_s", "dark current differs between pixels by (DCNU)", "e⁻/s"),
    ("prnu", "response differs between pixels by (PRNU), of 1", ""),
    ("quantum_efficiency", "quantum efficiency", "e⁻/photon"),
)


def find_beside(directory: Path, name: str) -> Path | None:
    """Return a calibration's file: in the folder, else in one of the two above it, else in a folder within it."""
    folders = [directory, *list(directory.resolve().parents)[:2], *sorted(p for p in directory.glob("*") if p.is_dir())]
    return next((folder / name for folder in folders if (folder / name).is_file()), None)


def noise_section(directory: Path, path: Path, inputs: dict[str, str]) -> dict[str, Any]:
    """Return what the page says of the sensor's noise.

    Parameters
    ----------
    directory : Path
        Where the page will stand.
    path : Path
        Of noise.json.
    inputs : dict
        SHA-256 by name of what the planes were made from.
    """
    content = read_result(path, Noise)
    rows = [
        {"words": words, "unit": unit, "digits": _digits(content[name].get("se")), **content[name]}
        for name, words, unit in _NOISE_ROWS
        if isinstance(content.get(name), dict)
    ]
    pages = sorted(path.parent.glob("noise_page*.png"))
    return {
        **_origin(directory, path, inputs),
        "rows": rows,
        "content": content,
        "likelihood": content["likelihood"],
        "temperature_c": (content.get("temperature_c") or {}).get("mean"),
        "frames": len(content["frames"]),
        "unusable": {kind: len(content.get(f"{kind}_pixels", [])) for kind in ("hot", "noisy", "dead")},
        "warnings": content.get("warnings", []),
        "pages": [(_link(directory, page), data_uri(page.read_bytes(), ".png")) for page in pages],
        "record": content.get("provenance"),
    }


def _digits(error: float | None) -> int:
    """Return the decimals that a number with a standard error deserves."""
    return int(np.clip(np.ceil(1 - np.log10(error)), 0, 6)) if error else 4


def geometry_section(directory: Path, path: Path, inputs: dict[str, str]) -> dict[str, Any]:
    """Return what the page says of where the camera was; parameters as for `noise_section`."""
    from faintfield.pipelines.pages.node_drawings import (
        node_drawing,
        sigma_maps,
    )  # draws: most reports are of sets without this
    from faintfield.pipelines.pages.stage_page import stage_rows

    content = read_result(path, Geometry)
    page = path.with_name(GEOMETRY_PAGE)
    return {
        **_origin(directory, path, inputs),
        "rows": stage_rows(content["stage"]),
        "drawing": node_drawing(content),
        "maps": sigma_maps(content),
        "content": content,
        "pages": [(_link(directory, page), None)] if page.is_file() else [],
        "record": content if "inputs" in content else None,
    }


def _origin(directory: Path, path: Path, inputs: dict[str, str]) -> dict[str, Any]:
    """Return where a calibration lies, and whether the planes were made with it."""
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    return {"where": _link(directory, path), "sha256": digest, "used": digest in inputs.values()}


def _link(directory: Path, path: Path) -> str:
    """Return a file's address relative to the page's folder."""
    return path.resolve().relative_to(directory.resolve(), walk_up=True).as_posix()


def photon_budget(overview: dict[str, Any]) -> dict[str, Any] | None:
    """Return the light on a pixel by each formula, and the shares of the variance of eq. (6); None without light.

    Light is in electrons, and in photons too where the quantum efficiency is known.

    Parameters
    ----------
    overview : dict
        The contents of overview.json.
    """
    efficiency, dark_e = overview.get("quantum_efficiency"), overview.get("dark_e")
    light, exposure_s = overview["brightness"], overview["exposure_s"]
    signal_e = light["mean_signal_e"]
    if dark_e is None or signal_e <= 0:
        return None
    counts = (
        ("the paper’s linear formula, eq. (7)", light["electrons_linear"]),
        ("moments: a uniform object of this SNR, eq. (4) being a ratio of powers", light["electrons_from_moments"]),
        ("counted: mean signal above dark", signal_e),
    )
    variance = noise_variance_e2(
        signal_e / exposure_s,
        exposure_s,
        quantum_efficiency=1.0,
        dark_current_e_per_s=dark_e / exposure_s,
        read_noise_e=overview["read_noise_e"],
    )
    parts = (("read noise", overview["read_noise_e"] ** 2), ("light", signal_e), ("dark current", dark_e))
    return {
        "light": [
            {"words": words, **_in_photons(electrons, efficiency, exposure_s, overview["views"])}
            for words, electrons in counts
            if electrons is not None
        ],
        "in_photons": efficiency is not None,
        "variance_e2": variance,
        "shares": [{"words": words, "e2": part, "share": part / variance} for words, part in parts],
    }


def _in_photons(electrons: float, efficiency: float | None, exposure_s: float, views: int) -> dict[str, float | None]:
    """Return light per pixel in electrons and photons of one view, photons per second, and photons of all views."""
    photons = None if efficiency is None else electrons / efficiency
    return {
        "electrons": electrons,
        "photons": photons,
        "flux": None if photons is None else photons / exposure_s,
        "all_views": None if photons is None else photons * views,
    }


def records(sections: Iterable[dict[str, Any] | None]) -> list[dict[str, Any]]:
    """Return where and how the calibrations were made, for the page's last part."""
    return [
        {"where": section["where"], "sha256": section["sha256"], **section["record"]}
        for section in sections
        if section is not None and section["record"] is not None
    ]
