"""Units of a set and of what is made from it, limits of values: nothing is stated in a unit that nobody measured.

Records are of one type whatever their units: `depth_mm`, `mean_e` and their like hold numbers in the units that the
record states. Files name them by these units, `disparity_px`, `mean_dn`: `json_of` names them so, `record_of` back.
"""

import re
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Literal

import msgspec
from msgspec import UNSET, Meta, UnsetType

# Limits beyond which values in a file are refused: far above what any rig has, far below what overflows.
# Largest picture that is read, decoded (a plane in three colours of the largest detector, as float32), and on a page.
MAX_FRAME_BYTES, MAX_PREVIEW_BYTES = 3_000_000_000, 200_000_000

# Longest exposure: eleven days.
MAX_EXPOSURE_S = 1e6

# Largest light of a pixel, a million times what a pixel holds; its square is far from the limit of float32.
MAX_LIGHT_E = 1e12

# Largest row or column of a node.
MAX_NODE = 100_000

# Largest rotation and translation in a pose; the unit of an imported model may be as small as a µm.
MAX_ANGLE_RAD, MAX_LENGTH_MM = 10.0, 1e9

# Largest period of a mosaic; the largest that is sold has 6.
MAX_PERIOD_PX = 8

type _Angle = Annotated[float, Meta(ge=-MAX_ANGLE_RAD, le=MAX_ANGLE_RAD)]
type _Length = Annotated[float, Meta(ge=-MAX_LENGTH_MM, le=MAX_LENGTH_MM)]
type _Index = Annotated[int, Meta(ge=-MAX_NODE, le=MAX_NODE)]

# Rodrigues vector in rad and translation in mm; the row and column of a node; a shift in mm.
type Pose = tuple[_Angle, _Angle, _Angle, _Length, _Length, _Length]
type Node = tuple[_Index, _Index]
type Shift = tuple[_Length, _Length, _Length]

type DepthUnit = Literal["mm", "relative", "disparity_px"]
type LightUnit = Literal["electrons", "dn", "relative"]

# Keys that state a depth, a length across the planes, or light (squared if they end with 2).
DEPTH_KEYS = ("depth_mm", "sharp_mm", "searched_mm", "depth_range_mm")
LENGTH_KEYS = ("pitch_mm", "origin_mm")
LIGHT_KEYS = (
    *("mean_e", "flux_e", "smoothing_e", "epsilon_e2", "detail_e2", "sigma_e2"),
    *("read_noise_e", "dark_e", "mean_signal_e", "electrons_linear", "electrons_from_moments"),
)

# Their endings by unit, and what stands in the place of "e".
_DEPTH_ENDINGS: dict[DepthUnit, str] = {"mm": "_mm", "relative": "", "disparity_px": "_px"}
_LIGHT_PLACES: dict[LightUnit, str] = {"electrons": "_e", "dn": "_dn", "relative": ""}

# Keys that photons need, and what marks those that are left out.
_PHOTON_KEYS, _LEFT_OUT = ("photons_linear", "photons_from_moments", "quantum_efficiency"), "-"

# Keys whose content is named by others (files, packages, planes), or names the units themselves.
_FOREIGN = frozenset({"units", "inputs", "versions", "sha256", "plane_pose"})

# A surface states the unit of its depths by a key of its own.
_SURFACE = "surface"


def sound_mosaic(mosaic: Sequence[str], letters: str | None = None) -> bool:
    """Return whether a mosaic has rows of equal length, is no larger than any camera's, and of these letters only."""
    widths = {len(row) for row in mosaic}
    if len(widths) != 1 or not 0 < min(widths) <= max(len(mosaic), *widths) <= MAX_PERIOD_PX:
        return False
    return letters is None or not set("".join(mosaic)) - set(letters)


class Units(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """The `[units]` table of `elemental.toml`.

    Parameters
    ----------
    depth : {"mm", "relative", "disparity_px"}
        Unit of depths. "relative": that of the poses, whose length is not known. "disparity_px": pixels by which a
        point moves from one node to the next, right or down; lengths in the poses mean nothing.
    light : {"electrons", "dn", "relative"}
        Unit of light. "dn": values of the files above the dark level, as the gain is not known or only estimated.
        "relative": proportional to light, with 1 for white, as the files had a tone curve.
    tone : {"srgb"}, optional
        Tone curve of the photographs that the views were made from; pictures are shown with it. Relative light always
        has that of sRGB.
    """

    depth: DepthUnit = "mm"
    light: LightUnit = "electrons"
    tone: Literal["srgb"] | UnsetType = UNSET


# A range of depths whose far end is at least so many times its near end reaches to infinity.
_INFINITY = 9_900.0


class StatedUnits(Units, frozen=True, forbid_unknown_fields=False, omit_defaults=False):
    """The `units` of a record: those of its set, and whether its exposure is known.

    A record without them, of an earlier version, has these defaults.

    Attributes
    ----------
    exposure : {"s", "unknown"}
        Unit of exposure times. "unknown": the set states none.
    """

    exposure: Literal["s", "unknown"] = "s"

    @property
    def quantity(self) -> str:
        """Coordinate of planes: depth or disparity."""
        return "disparity" if self.depth == "disparity_px" else "depth"

    @property
    def length(self) -> str:
        """Unit of depths, disparities and lengths on planes; empty if it has no name."""
        return {"mm": "mm", "relative": "", "disparity_px": "px"}[self.depth]

    @property
    def quantity_label(self) -> str:
        """Coordinate of planes with its unit, for axes and table heads."""
        return f"{self.quantity}, {self.length or 'relative'}"

    @property
    def light_symbol(self) -> str:
        """Unit of light after a number; 1 is white if it is relative."""
        return {"electrons": "e⁻", "dn": "DN", "relative": "of white"}[self.light]

    @property
    def light_description(self) -> str:
        """Quantity of the values of a plane."""
        return {
            "electrons": "expected electrons per detector pixel of the reference view",
            "dn": "expected DN above the dark level per detector pixel of the reference view",
            "relative": "expected light per detector pixel of the reference view, 1 = white",
        }[self.light]

    @property
    def light_per_pixel(self) -> str:
        """Unit of the light of a sample after a number, in the words of a page."""
        return "of the views’ white" if self.light == "relative" else f"{self.light_symbol} per pixel"

    @property
    def tone_curve(self) -> bool:
        """True if the files had the tone curve of sRGB; pictures are then shown with it."""
        return self.light == "relative" or self.tone == "srgb"

    @property
    def quantities(self) -> str:
        """Several of what tells planes apart."""
        return "disparities" if self.depth == "disparity_px" else "depths"

    def numbers_text(self, values: Sequence[float], join: str = ", ") -> str:
        """Return depths with their unit: "500, 700 mm", "-3.25, 0.5 px", "1.234"."""
        if self.depth == "disparity_px":
            return f"{join.join(f'{round(value, 3) + 0.0:g}' for value in values)} px"
        if self.depth == "relative":
            return join.join(f"{value:.4g}" for value in values)
        return f"{join.join(f'{value:g}' for value in values)} mm"

    def depths_text(self, values: Sequence[float], join: str = ", ") -> str:
        """Return depths in words: "500, 700 mm", "disparities -3.25, 0.5 px", "depth 1.234"."""
        numbers = self.numbers_text(values, join)
        return numbers if self.depth == "mm" else f"{self.quantities if len(values) > 1 else self.quantity} {numbers}"

    def range_text(self, near: float, far: float) -> str:
        """Return a range of depths in words: "180 mm and infinity", "400 and 900 mm"."""
        if self.depth != "disparity_px" and far >= _INFINITY * near:
            return f"{self.depths_text([float(f'{near:.3g}')])} and infinity"
        return self.depths_text([near, far], " and ")


def units_of(record: object) -> StatedUnits:
    """Return the units that a record states; the defaults if it states none."""
    return getattr(record, "units", UNSET) or StatedUnits()


def json_of(record: object) -> bytes:
    """Return a record as JSON, its keys named by the units that it states."""
    if not any(_names(units_of(record))):
        return msgspec.json.encode(record)
    return msgspec.json.encode(named_by(msgspec.to_builtins(record), units_of(record)))


def named_by(content: Any, units: StatedUnits) -> Any:
    """Return what JSON holds of a record, or of a part of one, with its keys named by units; no photons without e⁻."""
    depths, lights = _names(units)
    return _renamed(content, depths, lights | dict.fromkeys(_PHOTON_KEYS if lights else (), _LEFT_OUT))


def record_of[Record](content: bytes, kind: type[Record]) -> Record:
    """Return a record from JSON, whose keys may be named by the units that it states; raise one of `JSON_FAILURES`."""
    if b'"units"' in content:
        whole = msgspec.json.decode(content)
        stated = whole.get("units") if isinstance(whole, dict) else None
        names = _names(msgspec.convert(stated, StatedUnits)) if stated is not None else ({}, {})
        if any(names):
            return msgspec.convert(
                _renamed(whole, *({new: old for old, new in pairs.items()} for pairs in names)), kind
            )
    return msgspec.json.decode(content, type=kind)


def _names(units: StatedUnits) -> tuple[dict[str, str], dict[str, str]]:
    """Return the keys that are named otherwise in these units: those of depths, and those of light."""
    depths: dict[str, str] = {}
    lights: dict[str, str] = {}
    if units.depth != "mm":
        ending = _DEPTH_ENDINGS[units.depth]
        keys = (*DEPTH_KEYS, *LENGTH_KEYS)
        depths = {key: key.replace("depth", units.quantity).removesuffix("_mm") + ending for key in keys}
    if units.light != "electrons":
        place = _LIGHT_PLACES[units.light]
        lights = {key: re.sub("_e(?=2?$)", place, key.replace("electrons", "light")) for key in LIGHT_KEYS}
    return depths, lights


def _renamed(value: Any, depths: Mapping[str, str], lights: Mapping[str, str]) -> Any:
    if isinstance(value, dict):
        return {
            depths.get(key) or lights.get(key) or key: (
                part if key in _FOREIGN else _renamed(part, {} if key == _SURFACE else depths, lights)
            )
            for key, part in value.items()
            if lights.get(key) != _LEFT_OUT
        }
    return [_renamed(part, depths, lights) for part in value] if isinstance(value, list) else value
