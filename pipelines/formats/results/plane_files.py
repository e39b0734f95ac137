"""A plane as files: TIFFs, preview, the record that vouches for them; and its colours until all of them are there."""

import json
import zipfile
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
from faintfield.pipelines.formats.provenance import first_difference
from faintfield.pipelines.reconstruction.planes import Method

# Holds the colours of planes that want others, until the planes are written.
PARTS = ".parts"

# What may be known of each sample besides its light; each has a file of its own.
_BESIDE = ("sigma", "opacity")


def plane_name(place: Place) -> str:
    """Return the file name, without suffix, of a plane."""
    return f"plane_{place.name}" if isinstance(place, TiltedPlane) else f"plane_{place:07.1f}"


@dataclass(frozen=True)
class PlaneFiles:
    """Where a plane of one method lies, and what it has to be made of.

    Attributes
    ----------
    folder : Path
        Of the method's planes.
    method : Method
        By which it is reconstructed.
    place : Place
        The plane's depth in mm, or its pose.
    channels : tuple of str
        Its colours, in their order.
    origin : dict
        Its provenance, were it made now: what says otherwise of itself is made anew.
    """

    folder: Path
    method: Method
    place: Place
    channels: tuple[str, ...]
    origin: dict[str, Any]

    @property
    def path(self) -> Path:
        """Where the plane itself is."""
        return self.folder / f"{plane_name(self.place)}.tiff"

    def path_beside(self, name: str) -> Path:
        """Return where the standard deviation or the opacity of each sample is."""
        return self.folder / f"{plane_name(self.place)}_{name}.tiff"

    def finished(self) -> dict[str, Any] | None:
        """Return the record of the plane, None unless it and its files are whole and made of what they have to be."""
        return vouched_for(self.path.with_suffix(".json"), self.origin)

    def missing(self) -> list[str]:
        """Return the colours that are still to be reconstructed."""
        return [channel for channel in self.channels if self._entry(channel) is None]

    def save_part(self, channel: str, arrays: dict[str, NDArray[np.floating]], entry: dict[str, Any]) -> None:
        """Keep one colour until the others are there; `entry` goes into the plane's record.

        `arrays` (row, column) are the `plane`, and what is known besides: `sigma`, `opacity`.
        """
        content = msgspec.json.encode({"entry": entry, **self.origin})
        with writing(self._part(channel)) as file:
            np.savez(file, allow_pickle=False, content=np.frombuffer(content, np.uint8), **arrays)

    def finish(self, pitch_mm: float) -> dict[str, Any]:
        """Write the plane and its preview from its colours, then the record that vouches for them, and return that."""
        parts = []
        for channel in self.channels:
            with np.load(self._part(channel), allow_pickle=False) as part:
                parts.append(dict(part))
        entries = [msgspec.json.decode(part["content"].tobytes())["entry"] for part in parts]
        plane = _together(parts, "plane")
        write_plane(self.path, plane, pitch_mm)
        preview = self.path.with_suffix(".png")
        write_png(preview, grey_levels(plane, white_level(plane)))
        written = [self.path, preview]
        beside = {}
        for name in _BESIDE:
            path = self.path_beside(name)
            if all(name in part for part in parts):
                write_plane(path, _together(parts, name), pitch_mm)
                written.append(path)
                beside[f"{name}_file"] = path.name
            else:
                remove(path)  # of the plane that was here before
        record = {
            "format": 1,
            "planes": [entry["record"] | beside for entry in entries],
            "focus": [entry["focus"] for entry in entries],
            "sha256": {path.name: sha256(path) for path in written},
            **self.origin,
        }
        write_json(self.path.with_suffix(".json"), record)
        for channel in self.channels:
            self._part(channel).unlink()
        return record

    def _part(self, channel: str) -> Path:
        return self.folder / PARTS / f"{plane_name(self.place)}_{channel}.npz"

    def _entry(self, channel: str) -> dict[str, Any] | None:
        """Return what is known of a colour that is there, None when it is not, or is made of something else."""
        try:
            with np.load(self._part(channel), allow_pickle=False) as part:
                content: dict[str, Any] = msgspec.json.decode(part["content"].tobytes())
        except (OSError, ValueError, KeyError, zipfile.BadZipFile, msgspec.MsgspecError):
            return None
        return None if first_difference(content, self.origin) else content


def vouched_for(path: Path, origin: dict[str, Any]) -> dict[str, Any] | None:
    """Return a record whose files, beside it, are whole and made of what they have to be; None for any other."""
    try:
        record: dict[str, Any] = json.loads(path.read_bytes())
        if first_difference(record, origin):
            return None
        whole = all(sha256(path.parent / name) == known for name, known in record["sha256"].items())
    except (OSError, MissingFile, ValueError, KeyError, AttributeError):
        return None  # there is none, or it is no use
    return record if whole else None


def _together(parts: list[dict[str, NDArray[Any]]], name: str) -> NDArray[Any]:
    """Return one array of all colours, (row, column[, colour])."""
    colours = [part[name] for part in parts]
    return colours[0] if len(colours) == 1 else np.dstack(colours)
