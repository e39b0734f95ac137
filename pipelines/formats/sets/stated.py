"""Values in the units of a set: numbers of records, light, and names of planes."""

from typing import Any

import numpy as np
from msgspec import Struct, structs

from faintfield.pipelines.console import inform
from faintfield.pipelines.errors import BadValue
from faintfield.pipelines.formats.plane_poses import Place, TiltedPlane
from faintfield.pipelines.formats.results.plane_files import plane_name
from faintfield.pipelines.formats.sets.elemental_set import ElementalSet
from faintfield.pipelines.formats.units import DEPTH_KEYS, LENGTH_KEYS, LIGHT_KEYS, StatedUnits

# Options that name the unit of depths.
_UNITS = frozenset({"unit", "depth_map"})


def light_per_e(elemental_set: ElementalSet) -> float:
    """Return how much light one electron is, in the unit of the set; BadValue if that is white, which is not known."""
    light, noise = elemental_set.units.light, elemental_set.noise
    if light == "electrons":
        return 1.0
    gain = float(np.mean(noise.gain_dn_per_e))
    if light == "dn":
        return gain
    white_dn = float(np.mean(noise.saturation_dn)) - float(np.mean(noise.offset_dn))
    if not (np.isfinite(white_dn) and white_dn > 0):
        raise BadValue(
            f"{elemental_set.folder}: light is relative to white, which is {white_dn:g} DN above the dark level; state "
            "noise.saturation_dn, or units.light"
        )
    return gain / (white_dn * elemental_set.frames_per_view)


def unit_of_maps(units: StatedUnits, *, as_px: bool = False) -> Any:
    """Return the unit of a map of depths: "mm", "px" or "relative"; `as_px` asks for disparities."""
    return "px" if as_px else units.length or "relative"


def stated_length(elemental_set: ElementalSet, unit: str) -> str:
    """Return the unit of lengths of an export, "relative" if the set has no scale, which a message then says."""
    if elemental_set.units.depth == "mm":
        return unit
    nodes = (
        " from node to node, for a focal length that was taken" if elemental_set.units.depth == "disparity_px" else ""
    )
    inform(
        f"{elemental_set.folder}: has no scale, so that lengths are relative{nodes}; "
        "scale them when something is measured"
    )
    return "relative"


def plane_stem(elemental_set: ElementalSet, place: Place) -> str:
    """Return the name of a plane's files without suffix, by its depth in the unit of the set.

    `plane_00500.0` is at 500 mm, `plane_px_-003.250` at a disparity of -3.25 px, and `plane_rel_4.63158` at a relative
    depth, given to six digits.
    """
    if isinstance(place, TiltedPlane) or elemental_set.units.depth == "mm":
        return plane_name(place)
    depth = elemental_set.stated_depth(place)
    return f"plane_px_{depth:+08.3f}" if elemental_set.units.depth == "disparity_px" else f"plane_rel_{depth:.6g}"


def rounded_depth(elemental_set: ElementalSet, depth_mm: float) -> float:
    """Return a depth as precisely as the name of a plane states it: to 0.1 mm, 0.001 px of disparity, six digits."""
    if elemental_set.units.depth == "mm":
        return round(depth_mm, 1)
    if elemental_set.units.depth == "relative":
        return float(f"{depth_mm:.6g}")
    return elemental_set.depth_of_disparity(round(elemental_set.disparity_of_depth(depth_mm), 3))


def in_units[Record](elemental_set: ElementalSet, record: Record) -> Record:
    """Return a record whose numbers are in the units of the set, given one in mm and electrons."""
    units = elemental_set.units
    if (units.depth, units.light) == ("mm", "electrons"):
        return record
    return _Converter(elemental_set).record(record)


class _Converter:
    def __init__(self, elemental_set: ElementalSet) -> None:
        self._loaded = elemental_set
        self._light = light_per_e(elemental_set)

    def record[Record](self, record: Record) -> Record:
        depth_mm = getattr(record, "depth_mm", None)
        values = structs.asdict(record) if isinstance(record, Struct) else vars(record)
        return type(record)(**{name: self._value(name, value, depth_mm) for name, value in values.items()})

    def _value(self, name: str, value: Any, depth_mm: Any) -> Any:
        """Return one field; lengths across a plane need its depth."""
        if isinstance(value, Struct):
            return self.record(value)
        if isinstance(value, (list, tuple)):
            return type(value)([self._value(name, part, depth_mm) for part in value])
        if value == "mm" and name in _UNITS:
            return unit_of_maps(self._loaded.units)
        if not isinstance(value, (int, float)) or isinstance(value, bool):
            return value
        if name in DEPTH_KEYS:
            return self._loaded.stated_depth(value)
        if name in LENGTH_KEYS and self._loaded.units.depth == "disparity_px":
            return value * self._loaded.settings.camera.fx_px / depth_mm
        if name in LIGHT_KEYS:
            return value * self._light ** (2 if name.endswith("2") else 1)
        return value
