"""A plane as files: TIFFs, a preview and the record that vouches for them; its colours, until all are there."""

import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from faintfield.pipelines.errors import MissingFile
from faintfield.pipelines.formats.files import remove, sha256, write_json, writing
from faintfield.pipelines.formats.image_files import grey_levels, white_level, write_plane, write_png
from faintfield.pipelines.formats.plane_poses import Place, TiltedPlane
from faintfield.pipelines.formats.provenance import Provenance, first_difference
from faintfield.pipelines.formats.results.records import (
    DepthMapFileRecord,
    FocusPoint,
    Method,
    PlaneFileRecord,
    PlaneRecord,
    ReconstructionOptions,
)

# Folder of the colours of planes that still lack others.
PARTS = ".parts"

# What may be known of each sample besides its light, each in a file of its own.
_SIDECARS = ("sigma", "opacity")

type Origin = Provenance[ReconstructionOptions]


def plane_name(place: Place) -> str:
    """Return the file name, without suffix, of a plane."""
    return f"plane_{place.name}" if isinstance(place, TiltedPlane) else f"plane_{place:07.1f}"


class _Part(Provenance[ReconstructionOptions], frozen=True):
    """What is stored with the arrays of one colour: what it adds to the plane's record."""

    record: PlaneRecord
    focus: FocusPoint | None


@dataclass(frozen=True)
class PlaneFiles:
    """Where the files of one plane by one method are, and what they must be made of.

    Attributes
    ----------
    folder : Path
        Folder of the method's planes.
    method : Method
        By which the plane is reconstructed.
    place : Place
        The plane's depth in mm, or its pose.
    channels : tuple of str
        Its colours, in their order.
    origin : Provenance
        Its provenance, if it were made now: files with another are made again.
    """

    folder: Path
    method: Method
    place: Place
    channels: tuple[str, ...]
    origin: Origin

    @property
    def path(self) -> Path:
        """Path of the plane itself."""
        return self.folder / f"{plane_name(self.place)}.tiff"

    def finished(self) -> PlaneFileRecord | None:
        """Return the record of the plane, None unless it and its files are whole and current."""
        return read_current(self.path.with_suffix(".json"), PlaneFileRecord, self.origin)

    def missing(self) -> list[str]:
        """Return the colours that are still to be reconstructed."""
        return [channel for channel in self.channels if not self._has(channel)]

    def save_part(
        self, channel: str, arrays: Mapping[str, NDArray[np.floating]], record: PlaneRecord, focus: FocusPoint | None
    ) -> None:
        """Keep one colour until the others are there.

        Parameters
        ----------
        channel : str
            The colour.
        arrays : mapping of str to float array (row, column)
            The `plane`, and what else is known of its samples: `sigma`, `opacity`.
        record, focus : PlaneRecord, FocusPoint
            What this colour adds to the plane's record.
        """
        part = _Part(record, focus, **msgspec.structs.asdict(self.origin))
        content = np.frombuffer(msgspec.json.encode(part), np.uint8)
        with writing(self._part(channel)) as file:
            np.savez(file, allow_pickle=False, content=content, **arrays)

    def finish(self, pitch_mm: float) -> PlaneFileRecord:
        """Write the plane and its preview from its colours, then the record that vouches for them, and return that."""
        parts = []
        for channel in self.channels:
            with np.load(self._part(channel), allow_pickle=False) as part:
                parts.append(dict(part))
        entries = [msgspec.json.decode(part["content"].tobytes(), type=_Part) for part in parts]
        plane = _joined(parts, "plane")
        write_plane(self.path, plane, pitch_mm)
        preview = self.path.with_suffix(".png")
        write_png(preview, grey_levels(plane, white_level(plane)))
        sidecars = self._write_sidecars(parts, pitch_mm)
        written = [self.path, preview, *sidecars.values()]
        names = {f"{name}_file": path.name for name, path in sidecars.items()}
        record = PlaneFileRecord(
            1,
            [msgspec.structs.replace(entry.record, **names) for entry in entries],
            [entry.focus for entry in entries],
            {path.name: sha256(path) for path in written},
            **msgspec.structs.asdict(self.origin),
        )
        write_json(self.path.with_suffix(".json"), record)
        for channel in self.channels:
            self._part(channel).unlink()
        return record

    def _write_sidecars(self, parts: list[dict[str, NDArray[Any]]], pitch_mm: float) -> dict[str, Path]:
        """Write what else is known of the samples, remove the files of an earlier plane, return the paths."""
        written = {}
        for name in _SIDECARS:
            path = self.folder / f"{plane_name(self.place)}_{name}.tiff"
            if all(name in part for part in parts):
                write_plane(path, _joined(parts, name), pitch_mm)
                written[name] = path
            else:
                remove(path)
        return written

    def _part(self, channel: str) -> Path:
        return self.folder / PARTS / f"{plane_name(self.place)}_{channel}.npz"

    def _has(self, channel: str) -> bool:
        """Return whether a colour is there, whole and current."""
        try:
            with np.load(self._part(channel), allow_pickle=False) as part:
                content = part["content"].tobytes()
            msgspec.json.decode(content, type=_Part)
            return first_difference(content, self.origin) is None
        except (OSError, ValueError, KeyError, zipfile.BadZipFile):  # msgspec's errors are ValueErrors
            return False


def read_current[Record: (PlaneFileRecord, DepthMapFileRecord)](
    path: Path, kind: type[Record], origin: Origin
) -> Record | None:
    """Return a record whose files, in the same folder, are whole and of this origin; None for any other."""
    try:
        content = path.read_bytes()
        if first_difference(content, origin) is not None:
            return None
        record = msgspec.json.decode(content, type=kind)
        whole = all(sha256(path.parent / name) == known for name, known in record.sha256.items())
    except (OSError, MissingFile, ValueError):
        return None  # there is none, or it cannot be read
    return record if whole else None


def _joined(parts: list[dict[str, NDArray[Any]]], name: str) -> NDArray[Any]:
    """Return one array of all colours, (row, column[, colour])."""
    colours = [part[name] for part in parts]
    return colours[0] if len(colours) == 1 else np.dstack(colours)
