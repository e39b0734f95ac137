"""Planes that are kept in memory, where commands write files."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from faintfield.pipelines.formats.results.plane_files import PlaneFiles
from faintfield.pipelines.formats.results.records import FocusPoint, PlaneRecord
from faintfield.pipelines.formats.units import StatedUnits
from faintfield.pipelines.notebook.results import Array, Plane


@dataclass(frozen=True)
class KeptPlane(PlaneFiles):
    """A plane that is kept in memory."""

    parts: dict[str, tuple[Mapping[str, NDArray[np.floating]], PlaneRecord]] = field(default_factory=dict)

    def missing(self) -> list[str]:
        """Return the colours that are still to be reconstructed."""
        return [channel for channel in self.channels if channel not in self.parts]

    def save_part(
        self, channel: str, arrays: Mapping[str, NDArray[np.floating]], record: PlaneRecord, focus: FocusPoint | None
    ) -> None:
        """Keep one colour."""
        self.parts[channel] = arrays, record

    def depth(self) -> float:
        """Return the depth in the unit of the set."""
        return self.parts[self.channels[0]][1].depth_mm

    def plane(self, units: StatedUnits) -> Plane:
        """Return the plane of all colours."""
        parts = [self.parts[channel] for channel in self.channels]
        names = [name for name in parts[0][0] if all(name in arrays for arrays, _ in parts)]

        def joined(name: str) -> Array:
            colours = [np.asarray(arrays[name], np.float32) for arrays, _ in parts]
            return colours[0] if len(colours) == 1 else np.stack(colours, axis=-1)

        maps = {name: joined(name) for name in names}
        return Plane(maps.pop("plane"), tuple(record for _, record in parts), units, maps)
