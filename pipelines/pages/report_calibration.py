"""The camera in a report: its noise and its geometry."""

from collections.abc import Set
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import msgspec
import numpy as np

from faintfield.pipelines.formats.files import file_within, sha256
from faintfield.pipelines.formats.provenance import Provenance
from faintfield.pipelines.formats.reading import read_content
from faintfield.pipelines.formats.results.geometry import GEOMETRY_PAGE, GeometryRecord, read_geometry
from faintfield.pipelines.formats.results.noise import Measured, NoiseRecord, read_noise
from faintfield.pipelines.formats.units import MAX_PREVIEW_BYTES
from faintfield.pipelines.pages.page import smaller_uri

if TYPE_CHECKING:
    from faintfield.pipelines.pages.geometry_page import Row

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


class NoiseRow(NamedTuple):
    """A quantity of the sensor as the page shows it: its words, its unit, and the decimals that its error deserves."""

    words: str
    unit: str
    digits: int
    measured: Measured


@dataclass(frozen=True, kw_only=True)
class Section[Record, Line]:
    """A calibration on the page: its record, as lines of a table and as drawings.

    Attributes
    ----------
    where, used : str, bool
        Address of its file, and True if the planes were made with it.
    pages : list of (str, str or None)
        Addresses of its own pages, each with the page as a data URI if it is a picture.
    unusable, drawing, maps
        Number of unusable pixels by kind, of a noise calibration; drawings of the nodes, of a geometry.
    """

    where: str
    sha256: str
    used: bool
    pages: list[tuple[str, str | None]]
    made: Provenance[dict[str, object]] | None
    record: Record
    rows: list[Line]
    unusable: dict[str, int] = field(default_factory=dict)
    drawing: str | None = None
    maps: list[str] = field(default_factory=list)


type NoiseSection = Section[NoiseRecord, NoiseRow]
type GeometrySection = Section[GeometryRecord, Row]


def find_calibration(directory: Path, name: str) -> Path | None:
    """Return a calibration's file: in the folder, else in one of the two above it, else in a folder within it."""
    folders = [directory, *list(directory.resolve().parents)[:2], *sorted(p for p in directory.glob("*") if p.is_dir())]
    return next((folder / name for folder in folders if (folder / name).is_file()), None)


def noise_section(directory: Path, path: Path, inputs: Set[str]) -> NoiseSection:
    """Return the section about the sensor's noise.

    Parameters
    ----------
    directory : Path
        The folder of the page.
    path : Path
        The noise.json.
    inputs : set of str
        SHA-256 of the files that the planes were made from.
    """
    record = read_noise(path)
    pages = [file_within(path.parent, page.name) for page in sorted(path.parent.glob("noise_page*.png"))]
    return Section(
        **_origin(directory, path, inputs),
        pages=[(_link(directory, page), smaller_uri(read_content(page, MAX_PREVIEW_BYTES))) for page in pages],
        made=record.provenance,
        record=record,
        rows=[
            # As many decimals as the standard error deserves
            NoiseRow(words, unit, int(np.clip(np.ceil(1 - np.log10(se)), 0, 6)) if (se := measured.se) else 4, measured)
            for name, words, unit in _NOISE_ROWS
            if isinstance(measured := getattr(record, name), Measured)
        ],
        unusable={kind: len(getattr(record, f"{kind}_pixels")) for kind in ("hot", "noisy", "dead")},
    )


def geometry_section(directory: Path, path: Path, inputs: Set[str]) -> GeometrySection:
    """Return the section about the poses of the camera; parameters as for `noise_section`."""
    # Loads the calibration of geometries, which most reports do not show
    from faintfield.pipelines.pages.geometry_page import node_drawing, sigma_maps, stage_rows

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
    """Return the beginning of a `Section`."""
    digest = sha256(path)
    return {"where": _link(directory, path), "sha256": digest, "used": digest in inputs}


def _link(directory: Path, path: Path) -> str:
    """Return a file's address relative to the page's folder."""
    return path.resolve().relative_to(directory.resolve(), walk_up=True).as_posix()
