"""Planes and surfaces as arrays with coordinates: just reconstructed, or read from a folder of results."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, overload

import numpy as np
from numpy.typing import NDArray

from faintfield.pipelines.errors import BadValue, import_optional
from faintfield.pipelines.formats.frames import read_frame
from faintfield.pipelines.formats.results.records import FocusCurve, PlaneRecord, ReconstructionRecord
from faintfield.pipelines.formats.results.surface import SurfaceFileRecord, surfaces_below
from faintfield.pipelines.formats.units import StatedUnits, units_of
from faintfield.pipelines.notebook import plotting

type Array = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Plane:
    """A reconstructed plane.

    Parameters
    ----------
    image : float32 array (row, column) or (row, column, colour)
        Light of each sample in the unit of `units.light_symbol`, electrons per pixel of the reference view where the
        gain is measured. NaN where nothing is known.
    records : tuple of PlaneRecord
        Depth, samples, penalty weight, certificate and mixture of each colour.
    units : StatedUnits
        Units of light and of depth.
    maps : dict of str to float32 array
        What else is known of each sample: "sigma", its standard deviation, where `uncertainty` was asked for;
        "opacity" of planes by occlusion; "proposal" of a prior and by how much it was "moved".

    Examples
    --------
    >>> import faintfield, tempfile
    >>> from pathlib import Path
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     options = faintfield.SyntheticOptions(rows=3, columns=3, size_px=(64, 48), snr=1.0)
    ...     _ = faintfield.simulate(Path(folder) / "set", options=options)
    ...     plane = faintfield.open(Path(folder) / "set").plane(1000, prior="tv")
    >>> plane.image.shape, plane.depth, plane.units.light_symbol
    ((48, 64), 1000.0, 'e⁻')
    """

    image: Array
    records: tuple[PlaneRecord, ...]
    units: StatedUnits
    maps: dict[str, Array] = field(default_factory=dict)

    def __repr__(self) -> str:
        rows, columns = self.image.shape[:2]
        maps = "".join(f", {name}" for name in self.maps)
        return f"<plane of {columns} x {rows} samples, {self.units.depths_text([self.depth])}{maps}>"

    @property
    def depth(self) -> float:
        """Depth in mm, or in the unit of the set: relative, or px of disparity."""
        return self.records[0].depth_mm

    @property
    def channels(self) -> tuple[str, ...]:
        """Names of the colours, ("grey",) without any."""
        return tuple(record.channel for record in self.records)

    @property
    def sigma(self) -> Array | None:
        """Standard deviation of each sample of the image; None unless it was asked for."""
        return self.maps.get("sigma")

    @property
    def x(self) -> NDArray[np.float64]:
        """Places (column,) of the samples to the right of the reference camera's axis, in the unit of lengths."""
        return _places(self.records[0], 0, self.image.shape[1])

    @property
    def y(self) -> NDArray[np.float64]:
        """Places (row,) of the samples below the reference camera's axis, in the unit of lengths."""
        return _places(self.records[0], 1, self.image.shape[0])

    def plot(self, axes: Any = None, *, white: float | None = None) -> Any:
        """Draw the plane with its scale, and return the matplotlib axes; `white` is the light shown as white."""
        title = self.units.depths_text([self.depth])
        return plotting.draw_light(axes, self.image, self.units, title=title, x=self.x, y=self.y, white=white)

    def to_xarray(self) -> Any:
        """Return image and maps as an `xarray.Dataset` with coordinates y, x and colour; MissingPackage without xarray.

        Planes in colour have the dimension "colour"; attributes state the units.
        """
        xarray = import_optional("xarray", "notebook")
        names = ("y", "x", "colour")[: self.image.ndim]
        coordinates: dict[str, Any] = {"y": ("y", self.y, _length(self.units)), "x": ("x", self.x, _length(self.units))}
        if self.image.ndim == 3:
            coordinates["colour"] = ("colour", list(self.channels), {})
        arrays = {"light": (names, self.image, _light(self.units))}
        arrays |= {name: (names, array, {}) for name, array in self.maps.items()}
        return xarray.Dataset(arrays, coordinates, {"depth": self.depth, "depth_unit": self.units.length})


@dataclass(frozen=True, eq=False)
class Planes(Sequence[Plane]):
    """A sequence of planes of one method in the order of their depths; those in files are read when asked for.

    Parameters
    ----------
    records : tuple of tuple of PlaneRecord
        Records of each plane, by colour.
    units : StatedUnits
        Units of light and of depth.
    load : callable
        Returns the plane of an index.
    result : ReconstructionRecord, optional
        The record of planes that were read from a folder: inputs, options, versions.

    Examples
    --------
    >>> import faintfield, tempfile
    >>> from pathlib import Path
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     options = faintfield.SyntheticOptions(rows=3, columns=3, size_px=(64, 48), snr=1.0)
    ...     _ = faintfield.simulate(Path(folder) / "set", options=options)
    ...     planes = faintfield.open(Path(folder) / "set").planes([800, 1000, 1250], prior="tv")
    >>> planes.depths, planes.images.shape
    ((800.0, 1000.0, 1250.0), (3, 48, 64))
    """

    records: tuple[tuple[PlaneRecord, ...], ...]
    units: StatedUnits
    load: Callable[[int], Plane]
    result: ReconstructionRecord | None = None

    @overload
    def __getitem__(self, index: int) -> Plane: ...

    @overload
    def __getitem__(self, index: slice) -> "Planes": ...

    def __getitem__(self, index: int | slice) -> "Plane | Planes":
        """Return the plane of an index, or planes of a slice."""
        numbers = range(len(self))[index]
        if isinstance(numbers, int):
            return self.load(numbers)
        records = tuple(self.records[number] for number in numbers)
        return Planes(records, self.units, lambda number: self.load(numbers[number]), self.result)

    def __len__(self) -> int:
        return len(self.records)

    def __repr__(self) -> str:
        if not self.records:
            return "<no planes>"
        first = self.records[0][0]
        rows, columns = first.shape
        depths = self.units.depths_text([self.depths[0], self.depths[-1]][: len(self)], " to ")
        return f"<{len(self)} plane(s) of {columns} x {rows} samples by {first.method}, {depths}>"

    @property
    def depths(self) -> tuple[float, ...]:
        """Depth of each plane, in the unit of the set."""
        return tuple(records[0].depth_mm for records in self.records)

    @property
    def images(self) -> Array:
        """Images of all planes (depth, row, column[, colour]); BadValue if they differ in shape."""
        shapes = sorted({records[0].shape for records in self.records})
        if len(shapes) > 1:
            raise BadValue(
                f"planes have {shapes[0]} to {shapes[-1]} samples, and an array needs equal shapes; take one plane "
                "after the other, or reconstruct them without a pitch"
            )
        return np.stack([plane.image for plane in self])

    @property
    def focus(self) -> FocusCurve | None:
        """Power of detail against depth, of sweeps that were read from a folder."""
        return None if self.result is None else self.result.focus

    def plot(self, *, columns: int = 4) -> Any:
        """Draw all planes on one grey scale, and return the matplotlib figure."""
        return plotting.draw_planes(self, columns)

    def to_xarray(self) -> Any:
        """Return the images as an `xarray.Dataset` with coordinates; MissingPackage without xarray.

        The samples of a plane are a constant angle apart, so that their places x and y depend on the depth, too.
        """
        xarray = import_optional("xarray", "notebook")
        images, names = self.images, ("depth", "row", "column", "colour")
        y, x = (
            np.array([_places(records[0], axis, count) for records in self.records])
            for axis, count in ((1, images.shape[1]), (0, images.shape[2]))
        )
        coordinates: dict[str, Any] = {
            "depth": ("depth", list(self.depths), _length(self.units)),
            "y": (("depth", "row"), y, _length(self.units)),
            "x": (("depth", "column"), x, _length(self.units)),
        }
        if images.ndim == 4:
            coordinates["colour"] = ("colour", [record.channel for record in self.records[0]], {})
        return xarray.Dataset({"light": (names[: images.ndim], images, _light(self.units))}, coordinates)


@dataclass(frozen=True, eq=False)
class Surface:
    """A picture that is sharp everywhere, with the depth of each sample: the result of `reconstruct --surface`.

    Parameters
    ----------
    folder : Path
        Folder of its files.
    result : SurfaceFileRecord
        Its record: how it was estimated, how much of it is sure, inputs, options, versions.

    Examples
    --------
    >>> import faintfield, tempfile
    >>> from pathlib import Path
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     options = faintfield.SyntheticOptions(rows=3, columns=3, size_px=(48, 36), snr=20.0, objects="surfaces")
    ...     _ = faintfield.simulate(Path(folder) / "set", options=options)
    ...     surface = faintfield.open(Path(folder) / "set").surface(Path(folder) / "surface", (400, 1500))
    ...     depth = surface.depth
    >>> depth.shape, surface.result.surface.unit
    ((36, 48), 'mm')
    """

    folder: Path
    result: SurfaceFileRecord

    def __repr__(self) -> str:
        rows, columns = self.result.surface.shape
        sure = f"{self.result.surface.sure_share:.0%} of the depths sure"
        return "\n".join(filter(None, (f"<surface of {columns} x {rows} samples, {sure}>", self.warning)))

    @property
    def warning(self) -> str | None:
        """Words on a surface that does not explain its views, or of which no depth is sure; None for others."""
        return self.result.surface.warning or self.result.surface.remark

    @cached_property
    def picture(self) -> Array:
        """Light (row, column[, colour]) in the unit of `units.light_symbol`."""
        return self._read(self.result.surface.picture)

    @cached_property
    def picture_sigma(self) -> Array:
        """Standard deviation of the picture."""
        return self._read(self.result.surface.picture_sigma)

    @cached_property
    def depth(self) -> Array:
        """Depth (row, column) in `result.surface.unit`; NaN where it is not known."""
        return self._read(self.result.surface.depth)

    @cached_property
    def depth_sigma(self) -> Array:
        """Standard deviation of the depth."""
        return self._read(self.result.surface.depth_sigma)

    @cached_property
    def confidence(self) -> Array:
        """Probability that a depth is right within 2 %."""
        return self._read(self.result.surface.depth_confidence)

    @property
    def sure(self) -> NDArray[np.bool_]:
        """Samples whose depth counts as sure."""
        return self.confidence >= self.result.surface.sure_above

    @property
    def units(self) -> StatedUnits:
        """Units of light and of depth."""
        return units_of(self.result)

    def plot(self) -> Any:
        """Draw the picture and, where it is sure, the depth; return the matplotlib figure."""
        return plotting.draw_surface(self)

    def _read(self, name: str) -> Array:
        return np.asarray(read_frame(self.folder / name).pixels_dn, np.float32)


def planes_of_folder(folder: Path, result: ReconstructionRecord) -> Planes:
    """Return the planes of a folder that `faintfield reconstruct` wrote, given its record."""
    by_file: dict[str, list[PlaneRecord]] = {}
    for record in sorted(result.planes, key=lambda record: record.depth_mm):
        by_file.setdefault(record.file, []).append(record)
    records, units = tuple(map(tuple, by_file.values())), units_of(result)

    def load(number: int) -> Plane:
        of_plane = records[number]
        first = of_plane[0]
        files = {"sigma": first.sigma_file, "opacity": first.opacity_file}
        files |= {"proposal": first.proposal_file, "moved": first.moved_file}
        maps = {name: _read(folder / file) for name, file in files.items() if file}
        return Plane(_read(folder / first.file), of_plane, units, maps)

    return Planes(records, units, load, result)


def surface_of_folder(folder: Path) -> Surface:
    """Return the surface of a folder that `faintfield reconstruct --surface` wrote."""
    return Surface(folder, surfaces_below(folder)[folder])


def _read(path: Path) -> Array:
    return np.asarray(read_frame(path).pixels_dn, np.float32)


def _places(record: PlaneRecord, axis: int, count: int) -> NDArray[np.float64]:
    """Return the places of samples along x, axis 0, or y."""
    return np.asarray(record.origin_mm[axis] + record.pitch_mm * np.arange(count, dtype=np.float64))


def _length(units: StatedUnits) -> dict[str, str]:
    return {"units": units.length or "relative"}


def _light(units: StatedUnits) -> dict[str, str]:
    return {"units": units.light_symbol, "long_name": units.light_description}
