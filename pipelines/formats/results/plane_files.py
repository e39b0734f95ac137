"""A plane as files: TIFFs, a preview and the record that vouches for them; its colours, until all are there."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from faintfield.pipelines.console import inform
from faintfield.pipelines.errors import BadValue, MissingFile
from faintfield.pipelines.formats.files import problem_of_file, remove, sha256, write_record, writing
from faintfield.pipelines.formats.image_files import Spacing, light_picture, white_level, write_plane, write_png
from faintfield.pipelines.formats.plane_poses import Place, TiltedPlane
from faintfield.pipelines.formats.provenance import Provenance, digest_holds, first_difference
from faintfield.pipelines.formats.reading import JSON_FAILURES, read_content, read_json
from faintfield.pipelines.formats.results.records import (
    DepthMapFileRecord,
    FileName,
    FocusPoint,
    Method,
    PlaneFileRecord,
    PlaneRecord,
    ReconstructionOptions,
    Sha256,
)
from faintfield.pipelines.formats.results.surface import SurfaceFileRecord, SurfaceOptions
from faintfield.pipelines.formats.units import record_of, units_of

# Folder of the colours of planes that still lack others.
PARTS = ".parts"

# The colours' files hold numbers of this type alone, so that nothing in them has to be decoded.
_SUFFIX_OF_PARTS, _STORED = ".float32", np.dtype("<f4")

_A_COLOUR, _ANEW = "the record of a colour of a plane", f"remove the folder {PARTS} and reconstruct again"

# What may be known of each sample besides its light, each in a file of its own.
_SIDECARS = ("sigma", "opacity", "proposal", "moved")

type Origin = Provenance[ReconstructionOptions]


def plane_name(place: Place) -> str:
    """Return the file name, without suffix, of a plane whose depth is in mm."""
    return f"plane_{place.name}" if isinstance(place, TiltedPlane) else f"plane_{place:07.1f}"


class _Part(Provenance[ReconstructionOptions], frozen=True):
    """The record of one colour: what it adds to the plane's record, and the arrays (row, column) in its file."""

    record: PlaneRecord
    focus: FocusPoint | None
    arrays: list[str]
    sha256: dict[FileName, Sha256]


@dataclass(frozen=True)
class PlaneFiles:
    """Paths of the files of one plane by one method, and their inputs.

    `channels` are its colours in their order, `origin` its provenance, if it were made now: files with another are made
    again. `stem` is the file name of the plane without suffix, by default that of a depth in mm.
    """

    folder: Path
    method: Method
    place: Place
    channels: tuple[str, ...]
    origin: Origin
    stem: str = ""

    @property
    def name(self) -> str:
        """File name of the plane, without suffix."""
        return self.stem or plane_name(self.place)

    @property
    def path(self) -> Path:
        """Path of the plane itself."""
        return self.folder / f"{self.name}.tiff"

    def finished(self) -> PlaneFileRecord | None:
        """Return the record of the plane, None unless it and its files are whole and current."""
        record = read_current(self.path.with_suffix(".json"), PlaneFileRecord, self.origin)
        if record is None:
            return None
        stated = [(plane.method, plane.channel, plane.file) for plane in record.planes]
        expected = [(self.method, channel, self.path.name) for channel in self.channels]
        alike = stated == expected and len(record.focus) == len(expected)
        return record if alike and {*record.files} <= record.sha256.keys() else None

    def missing(self) -> list[str]:
        """Return the colours that are still to be reconstructed."""
        missing = []
        for channel in self.channels:
            path = self._part(channel)
            part = read_current(path.with_suffix(".json"), _Part, self.origin)
            if part is None or list(part.sha256) != [path.name] or part.record.channel != channel:
                missing.append(channel)
        return missing

    def save_part(
        self, channel: str, arrays: Mapping[str, NDArray[np.floating]], record: PlaneRecord, focus: FocusPoint | None
    ) -> None:
        """Keep one colour until the others are there: `plane` (row, column), and what else is known of its samples."""
        path = self._part(channel)
        with writing(path) as file:
            for array in arrays.values():
                file.write(np.ascontiguousarray(array, _STORED).data)
        hashes = {path.name: sha256(path)}
        part = _Part(record, focus, list(arrays), hashes, **msgspec.structs.asdict(self.origin))
        write_record(path.with_suffix(".json"), part)

    def finish(self) -> PlaneFileRecord:
        """Write the plane and its preview from its colours, then the record that vouches for them, and return that."""
        paths = [self._part(channel) for channel in self.channels]
        entries = [read_json(path.with_suffix(".json"), _Part, what=_A_COLOUR, remedy=_ANEW) for path in paths]
        parts = [_arrays(path, entry, entries[0].record.shape) for path, entry in zip(paths, entries, strict=True)]
        plane = _joined(parts, "plane")
        spacing = Spacing(entries[0].record.pitch_mm, in_mm=units_of(entries[0]).depth == "mm")
        write_plane(self.path, plane, spacing)
        preview = self.path.with_suffix(".png")
        tone_curve = units_of(entries[0]).tone_curve
        write_png(preview, light_picture(plane, white_level(plane), tone_curve=tone_curve))
        sidecars = self._write_sidecars(parts, spacing)
        written = [self.path, preview, *sidecars.values()]
        names = {f"{name}_file": path.name for name, path in sidecars.items()}
        record = PlaneFileRecord(
            1,
            [msgspec.structs.replace(entry.record, **names) for entry in entries],
            [entry.focus for entry in entries],
            {path.name: sha256(path) for path in written},
            **msgspec.structs.asdict(self.origin),
        )
        write_record(self.path.with_suffix(".json"), record)
        for path in paths:
            path.unlink()
            path.with_suffix(".json").unlink()
        return record

    def _write_sidecars(self, parts: list[dict[str, NDArray[Any]]], spacing: Spacing) -> dict[str, Path]:
        """Write what else is known of the samples, remove the files of an earlier plane, return the paths."""
        written = {}
        for name in _SIDECARS:
            path = self.folder / f"{self.name}_{name}.tiff"
            if all(name in part for part in parts):
                write_plane(path, _joined(parts, name), spacing)
                written[name] = path
            else:
                remove(path)
        return written

    def _part(self, channel: str) -> Path:
        return self.folder / PARTS / f"{self.name}_{channel}{_SUFFIX_OF_PARTS}"


def read_current[Record: (PlaneFileRecord, DepthMapFileRecord, SurfaceFileRecord, _Part)](
    path: Path, kind: type[Record], origin: Origin | Provenance[SurfaceOptions]
) -> Record | None:
    """Return a record of this origin that agrees with its digest and with its files, in the same folder; else None.

    One that was altered or damaged is named in a message: it will be made again.
    """
    if not path.is_file():
        return None
    try:
        content = read_content(path)
        record = record_of(content, kind)
        if first_difference(content, origin) is not None:
            return None
        problem = None if digest_holds(content) else "was altered, or is of an earlier version and has no digest"
    except (MissingFile, *JSON_FAILURES):
        problem = "is damaged"
    else:
        for name, known in record.sha256.items():
            fault = problem_of_file(path.with_name(name), path.parent, known)
            problem = problem or (fault and f"{name} {fault}")
    if problem is None:
        return record
    inform(f"{path}: {problem}; it is made again")
    return None


def _arrays(path: Path, part: _Part, shape: tuple[int, int]) -> dict[str, NDArray[np.float32]]:
    found, needed = path.stat().st_size, len(part.arrays) * math.prod(shape) * _STORED.itemsize
    if found != needed or not needed or part.record.shape != shape or "plane" not in part.arrays:
        raise BadValue(
            f"{path}: holds {found} bytes, for {part.arrays} of {part.record.shape} instead of {shape} samples; {_ANEW}"
        )
    arrays = np.frombuffer(read_content(path, needed), _STORED).reshape(-1, *shape)
    return dict(zip(part.arrays, arrays, strict=True))


def _joined(parts: list[dict[str, NDArray[Any]]], name: str) -> NDArray[Any]:
    colours = [part[name] for part in parts]
    return colours[0] if len(colours) == 1 else np.dstack(colours)
