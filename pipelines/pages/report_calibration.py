"""The camera in a report: its noise and its geometry."""

from collections.abc import Set
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from faintfield.calib.estimate import Estimate
from faintfield.pipelines.formats.files import file_within, sha256
from faintfield.pipelines.formats.provenance import Provenance
from faintfield.pipelines.formats.reading import read_content
from faintfield.pipelines.formats.results.geometry import GEOMETRY_PAGE, GeometryRecord, read_geometry
from faintfield.pipelines.formats.results.noise import NoiseRecord, read_noise
from faintfield.pipelines.formats.units import MAX_PREVIEW_BYTES
from faintfield.pipelines.pages.geometry_page import node_drawing, sigma_maps, stage_rows
from faintfield.pipelines.pages.page import Row, smaller_uri

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


@dataclass(frozen=True, kw_only=True)
class Section[Record]:
    """A calibration on the page.

    `where` is the address of its file, and `used` tells if the planes were made with it. `pages` are the addresses of
    its own pages, each with the page as a data URI if it is a picture. `unusable`, the number of unusable pixels by
    kind, is of a noise calibration; `drawing` and `maps` are of a geometry.
    """

    where: str
    sha256: str
    used: bool
    pages: list[tuple[str, str | None]]
    made: Provenance[dict[str, object]] | None
    record: Record
    rows: list[Row]
    unusable: dict[str, int] = field(default_factory=dict)
    drawing: str | None = None
    maps: list[str] = field(default_factory=list)


type NoiseSection = Section[NoiseRecord]
type GeometrySection = Section[GeometryRecord]


def find_calibration(directory: Path, name: str) -> Path | None:
    """Return a calibration's file: in the folder, else in one of the two above it, else in a folder within it."""
    folders = [directory, *list(directory.resolve().parents)[:2], *sorted(p for p in directory.glob("*") if p.is_dir())]
    return next((folder / name for folder in folders if (folder / name).is_file()), None)


def noise_section(directory: Path, path: Path, inputs: Set[str]) -> NoiseSection:
    """Return the section of a noise.json; `inputs` are the SHA-256 of the files that the planes were made from."""
    record = read_noise(path)
    pages = [file_within(path.parent, page.name) for page in sorted(path.parent.glob("noise_page*.png"))]
    return Section(
        **_origin(directory, path, inputs),
        pages=[(_link(directory, page), smaller_uri(read_content(page, MAX_PREVIEW_BYTES))) for page in pages],
        made=record.provenance,
        record=record,
        rows=[
            _noise_row(measured, words, unit)
            for name, words, unit in _NOISE_ROWS
            if isinstance(measured := getattr(record, name), Estimate)
        ],
        unusable={kind: len(getattr(record, f"{kind}_pixels")) for kind in ("hot", "noisy", "dead")},
    )


def _noise_row(measured: Estimate, words: str, unit: str) -> Row:
    if measured.value is None:
        return Row(words, why=measured.why or "no reason stated")
    # As many decimals as the standard error deserves
    digits = int(np.clip(np.ceil(1 - np.log10(measured.se)), 0, 6)) if measured.se else 4
    interval = " … ".join(f"{end:.{digits}f}" for end in measured.ci95) if measured.ci95 else "–"
    return Row(words, f"{measured.value:.{digits}f}", interval, unit)


def geometry_section(directory: Path, path: Path, inputs: Set[str]) -> GeometrySection:
    """Return the section of a geometry.json; `inputs` as for `noise_section`."""
    record = read_geometry(path, GeometryRecord)
    page = path.with_name(GEOMETRY_PAGE)
    options = msgspec.structs.asdict(record.options)
    return Section(
        **_origin(directory, path, inputs),
        pages=[(_link(directory, page), None)] if page.is_file() else [],
        made=Provenance(command=record.command, options=options, inputs=record.inputs, versions=record.versions),
        record=record,
        rows=stage_rows(record.stage),
        drawing=node_drawing(record),
        maps=sigma_maps(record),
    )


def _origin(directory: Path, path: Path, inputs: Set[str]) -> dict[str, Any]:
    digest = sha256(path)
    return {"where": _link(directory, path), "sha256": digest, "used": digest in inputs}


def _link(directory: Path, path: Path) -> str:
    """Return a file's address relative to the page's folder."""
    return path.resolve().relative_to(directory.resolve(), walk_up=True).as_posix()
