"""The elemental set: checked images and poses, whatever files they come from, and values in its units."""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import msgspec
import numpy as np
from msgspec import Struct, structs
from numpy.typing import NDArray

from faintfield.calib.lens import Lens
from faintfield.calib.noise_model import Map, NoiseModel
from faintfield.pipelines.console import inform
from faintfield.pipelines.errors import BadValue, MissingFile
from faintfield.pipelines.formats.files import files_in, sha256, some
from faintfield.pipelines.formats.frames import IMAGE_SUFFIXES, ChannelLayout, Frame, layouts_of, read_frame
from faintfield.pipelines.formats.plane_poses import Place, TiltedPlane
from faintfield.pipelines.formats.reading import is_file, is_folder
from faintfield.pipelines.formats.results.noise import NOISE_MAPS, FittedNoise, read_fitted_noise
from faintfield.pipelines.formats.results.plane_files import plane_name
from faintfield.pipelines.formats.results.records import RECONSTRUCTION_FILE, Poses
from faintfield.pipelines.formats.sets.aligned_poses import with_alignment
from faintfield.pipelines.formats.sets.elemental_file import (
    FILE_NAME,
    ElementalSetFile,
    Noise,
    named_files,
    read_set_file,
)
from faintfield.pipelines.formats.units import DEPTH_KEYS, LENGTH_KEYS, LIGHT_KEYS, Node, StatedUnits
from faintfield.recon.threads import map_in_threads

# Exposure without light, beside a set's images if there is one.
NOISE_REFERENCE = "noise_reference.tiff"

# Options that name the unit of depths.
_UNIT_KEYS = frozenset({"unit", "depth_map"})

# Largest relative response of a pixel.
MAX_RESPONSE = 1e6


@dataclass(frozen=True)
class ElementalSet:
    """An elemental set that was checked when it was loaded: everything but the pixels.

    Attributes
    ----------
    folder : Path
        Folder of the set, to which its paths are relative.
    settings : ElementalSetFile
        Content of `elemental.toml`.
    noise : NoiseModel
        Noise model of the camera; its offset is zero with `offset_from_files`.
    flat : float32 array (row, column), optional
        Relative response of each pixel.
    unusable : bool array (row, column)
        Pixels that are left out (hot, dead).
    measured_in : Path, optional
        The geometry.json of the lens, if it is not the set's own.
    poses : {"stated", "measured", "aligned", "nominal", "true"}
        Source of the poses.
    inverse_depth_sigma : float
        Standard deviation that the 1/depth of all points has in common by errors of the poses, as far as it is known.
    described_in : str
        Name of the file that says what the images are.
    noise_reference : tuple of Path
        Exposures without light.
    bright_view : (Path, float), optional
        The reference view in plenty of light, and its exposure time in s.
    read_frame : callable
        Reads a frame, given its path and its size in px; see `reconstruction.channels.keeping_frames`.
    in_memory : bool
        True if the frames are no files; they may then be real numbers.
    """

    folder: Path
    settings: ElementalSetFile
    noise: NoiseModel
    flat: NDArray[np.float32] | None
    unusable: NDArray[np.bool_]
    measured_in: Path | None = None
    poses: Poses = "stated"
    inverse_depth_sigma: float = 0.0
    described_in: str = FILE_NAME
    noise_reference: tuple[Path, ...] = ()
    bright_view: tuple[Path, float] | None = None
    read_frame: Callable[[Path, tuple[int, int]], Frame] = field(
        default_factory=lambda: read_frame, compare=False, repr=False
    )
    in_memory: bool = False

    @cached_property
    def lens(self) -> Lens:
        """Lens of the camera."""
        return self.settings.camera.lens

    @property
    def offset_from_files(self) -> bool:
        """The offset of each raw file is the black level of its masked pixels."""
        return isinstance(self.settings.noise, Noise) and self.settings.noise.offset_dn is None

    @property
    def nodes(self) -> list[Node]:
        """Row and column of the node of each view; those of a row of views if any view states none."""
        views = self.settings.view
        stated = [view.node for view in views if view.node is not None]
        return stated if len(stated) == len(views) else [(0, number) for number in range(len(views))]

    @property
    def reference_view(self) -> int:
        """Index of the view whose frame is the reference."""
        return self.settings.reference_view

    @property
    def poses_rt_cam_ref(self) -> NDArray[np.float64]:
        """All poses (view, 6)."""
        return np.array([view.rt_cam_ref for view in self.settings.view])

    @property
    def units(self) -> StatedUnits:
        """The units of all that is made from the set."""
        units = self.settings.units
        exposure: Literal["s", "unknown"] = "unknown" if self.settings.exposure_s is None else "s"
        return StatedUnits(units.depth, units.light, units.tone, exposure)

    @property
    def image_paths(self) -> list[Path]:
        """Path of the first frame of each view."""
        return [self.folder / view.image for view in self.settings.view]

    @cached_property
    def layouts(self) -> list[ChannelLayout]:
        """Colours of the frames, as the first one has them."""
        camera = self.settings.camera
        return layouts_of(self.read_frame(self.image_paths[0], camera.size_px), camera.mosaic)

    @property
    def frames_per_view(self) -> int:
        """Number of frames that are added up to a view."""
        return 1 + len(self.settings.view[0].repeats)

    @cached_property
    def frame_paths(self) -> list[list[Path]]:
        """Paths of all frames of each view."""
        return [[self.folder / name for name in (view.image, *view.repeats)] for view in self.settings.view]

    def background_e(self, noise: NoiseModel) -> Map:
        """Return the dark electrons expected in all frames of a view, by the noise model of all pixels or a part."""
        return noise.background_e(self.settings.exposure_s or 0.0)

    def read_variance_e2(self, noise: NoiseModel) -> Map:
        """Return the variance in (e⁻)² that reading adds to a view, once per frame."""
        return self.frames_per_view * noise.read_variance_e2()

    @property
    def principal_points_px(self) -> NDArray[np.float64]:
        """Principal point cx, cy of each view (view, 2)."""
        camera = self.settings.camera
        return np.array(
            [
                [camera.cx_px if view.cx_px is None else view.cx_px, camera.cy_px if view.cy_px is None else view.cy_px]
                for view in self.settings.view
            ]
        )

    def depth_of_disparity(self, disparity_px: float) -> float:
        """Return the depth at which a point moves by `disparity_px` from one node to the next, right or down.

        If the camera moves by B along its rows, the image of a point at depth z moves by −fx B / z, plus the shift of
        the principal point by rectification. With known nodes and poses this is an equation for 1/z, solved by least
        squares over all views. BadValue if no plane in front of the cameras has this disparity.
        """
        at_zero, slope = self.inverse_depth_of_disparity()
        if slope == 0:
            raise BadValue(
                f"{self.folder}: all views are from one place, so no plane has a disparity of {disparity_px:g} px; "
                "give a depth instead"
            )
        inverse_depth = at_zero + slope * disparity_px
        if not inverse_depth > 0:
            steps, shift_px = self._steps_and_shifts()
            at_infinity_px = np.sum(steps * shift_px) / max(float(np.sum(steps**2)), 1e-30)
            raise BadValue(
                f"no plane in front of the cameras has a disparity of {disparity_px:g} px from node to node; "
                f"give a number below {at_infinity_px:.3g} px, that of infinitely far "
                "points (cameras that move right see near points move left, by a negative number), or import pictures "
                "that were aligned on a plane again, with its --disparity-px"
            )
        return 1 / inverse_depth

    def disparity_of_depth(self, depth_mm: float) -> float:
        """Return by how many px a point at a depth moves from one node to the next; see `depth_of_disparity`."""
        at_zero, slope = self.inverse_depth_of_disparity()
        return (1 / depth_mm - at_zero) / slope

    def stated_depth(self, depth_mm: float) -> float:
        """Return a depth in the unit of the set: the same number, or the disparity in px to a millionth."""
        return depth_mm if self.units.depth != "disparity_px" else round(self.disparity_of_depth(depth_mm), 6) + 0.0

    def depth_in_mm(self, depth: float) -> float:
        """Return a depth that is stated in the unit of the set; BadValue if it is a disparity without a depth."""
        return self.depth_of_disparity(depth) if self.units.depth == "disparity_px" else depth

    def depth_text(self, depth_mm: float) -> str:
        """Return a depth in words, in the unit of the set: "892.857 mm", "disparity -3.25 px", "depth 1.234"."""
        return self.depths_text(depth_mm)

    def depths_text(self, *depths_mm: float, join: str = ", ") -> str:
        """Return several depths in words, in the unit of the set: "500, 700 mm", "disparities -3.25, 0.5 px"."""
        return self.units.depths_text([self.stated_depth(depth) for depth in depths_mm], join)

    def range_text(self, near_mm: float, far_mm: float) -> str:
        """Return a range of depths in words, in the unit of the set: "180 mm and infinity"."""
        return self.units.range_text(self.stated_depth(near_mm), self.stated_depth(far_mm))

    def inverse_depth_of_disparity(self) -> tuple[float, float]:
        """Return 1/depth in 1/mm of the disparity zero, and by how much it grows with each px of disparity."""
        steps, shift_px = self._steps_and_shifts()
        camera = self.settings.camera
        moved_px = self.poses_rt_cam_ref[:, 3:5] * [camera.fx_px, camera.fy_px]
        total = max(float(np.sum(moved_px**2)), 1e-30)
        return float(-np.sum(shift_px * moved_px)) / total, float(np.sum(steps * moved_px)) / total

    def _steps_and_shifts(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return for each view the columns and rows of nodes from the reference, and the shift of its principal point.

        Both are arrays (view, 2): right, down. Disparities are those from column to column; where rows are nearer or
        farther from one another, a row counts as so many columns.
        """
        nodes = np.array([view.node or (np.nan, np.nan) for view in self.settings.view], float)
        if np.isnan(nodes).any():
            raise BadValue(f"{self.folder}: disparities need the node of every view; give depths in mm instead")
        centres = self.principal_points_px
        ratio = self.settings.arrangement.pitch_ratio if self.settings.arrangement is not None else 1.0
        steps = (nodes - nodes[self.reference_view])[:, ::-1] / [1.0, ratio]
        return steps, centres - centres[self.reference_view]

    def input_hashes(self) -> dict[str, str]:
        """Return the SHA-256 of every file that a reconstruction reads, by name; none of a set in memory."""
        if self.in_memory:
            return {}
        files = {name: self.folder / name for name in (self.described_in, *named_files(self.settings))}
        if isinstance(self.settings.noise, str):
            maps = (self.folder / self.settings.noise).with_name(NOISE_MAPS)
            if is_file(maps):
                files[maps.relative_to(self.folder).as_posix()] = maps
        if self.measured_in is not None:
            own = self.measured_in.is_relative_to(self.folder)
            name = self.measured_in.relative_to(self.folder).as_posix() if own else self.measured_in.name
            files[name] = self.measured_in
        return dict(zip(files, map_in_threads(sha256, list(files.values())), strict=True))


def load_set(folder: Path, *, aligned: bool = True) -> ElementalSet:
    """Read and check `elemental.toml` and the files it names, except the images' pixels.

    Parameters
    ----------
    folder : Path
        The folder of the set, or its `elemental.toml`.
    aligned : bool
        Take the poses that `faintfield align` found, if there are any, rather than those that `elemental.toml` states.

    Returns
    -------
    ElementalSet
        `lens`, `poses_rt_cam_ref` (view, 6) as Rodrigues rad and mm, `noise`, `frame_paths` and `settings`, which is
        the content of `elemental.toml`.

    Raises
    ------
    InputError
        A file is missing, a key is unknown, or a value is impossible; the message names it.

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> from faintfield import SyntheticOptions, load_set, simulate
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     _ = simulate(Path(folder, "set"), options=SyntheticOptions(rows=3, columns=3, size_px=(64, 48)))
    ...     elemental_set = load_set(Path(folder, "set"))
    >>> elemental_set.poses_rt_cam_ref.shape, elemental_set.reference_view
    ((9, 6), 4)
    >>> round(elemental_set.noise.read_noise_e, 2)
    3.46
    """
    path = folder if is_file(folder) else folder / FILE_NAME
    if not is_file(path):
        _refuse_pictures(folder)
    folder = path.parent
    settings = read_set_file(path)
    camera, table = settings.camera, "camera"
    try:
        _ = camera.lens
        table = "noise"
        noise = _noise(folder, settings)
    except ValueError as failure:
        raise BadValue(f"{path}: {table}: {failure}; correct it") from failure
    elemental_set = ElementalSet(
        folder,
        settings,
        noise.model,
        flat=noise.response if camera.flat is None else _read_flat(folder / camera.flat, camera.size_px),
        unusable=noise.unusable,
        noise_reference=tuple(path for path in [folder / NOISE_REFERENCE] if is_file(path)),
    )
    return with_alignment(elemental_set, path.name) if aligned else elemental_set


def check_exists(folder: Path) -> None:
    """Refuse a set or session that is not there (MissingFile)."""
    if not is_folder(folder) and not is_file(folder):
        raise MissingFile(f"{folder}: no such folder; name a session, or a folder with {FILE_NAME}")


def _refuse_pictures(folder: Path) -> None:
    """Refuse a folder that is not there, and one of pictures that is no set yet (MissingFile)."""
    check_exists(folder)
    if is_file(folder / RECONSTRUCTION_FILE):
        raise MissingFile(f"{folder}: holds results, no images; name the set that they were made from")
    pictures = [path.name for path in files_in(folder) if path.suffix.lower() in IMAGE_SUFFIXES]
    if pictures:
        raise MissingFile(
            f"{folder}: is a folder of pictures ({some(pictures)}), no set; make a set of them first by "
            f"`faintfield import grid {folder} SET`, and name that"
        )


def _noise(folder: Path, settings: ElementalSetFile) -> FittedNoise:
    """Return the noise model that the `[noise]` table states, or that `faintfield noise` fitted."""
    camera = settings.camera
    if isinstance(settings.noise, str):
        return read_fitted_noise(folder / settings.noise, camera.size_px)
    numbers = msgspec.structs.asdict(settings.noise)
    del numbers["estimated"]
    numbers["offset_dn"] = numbers["offset_dn"] or 0.0
    numbers["saturation_dn"] = np.inf if numbers["saturation_dn"] is None else numbers["saturation_dn"]
    return FittedNoise(NoiseModel(**numbers), np.zeros(camera.size_px[::-1], bool), None)


def _read_flat(path: Path, size_px: tuple[int, int]) -> NDArray[np.float32]:
    flat = read_frame(path, size_px).pixels_dn
    if flat.ndim != 2 or not np.isfinite(flat).all() or (flat < 0).any() or (flat > MAX_RESPONSE).any():
        raise BadValue(
            f"{path}: a flat field is grey, finite, not negative, and at most {MAX_RESPONSE:g}; got an array of shape "
            f"{flat.shape} from {flat.min():g} to {flat.max():g}; divide it by its mean"
        )
    return np.asarray(flat, np.float32)


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
    light = light_per_e(elemental_set)

    def convert(name: str, value: Any, depth_mm: Any) -> Any:
        """Return a value in the units of the set, by the name of its field; lengths across a plane need its depth."""
        if isinstance(value, Struct) or value is record:  # which may be a dataclass
            depth_mm = getattr(value, "depth_mm", None)
            parts = structs.asdict(value) if isinstance(value, Struct) else vars(value)
            kind: Any = type(value)
            return kind(**{key: convert(key, part, depth_mm) for key, part in parts.items()})
        if isinstance(value, (list, tuple)):
            return type(value)([convert(name, part, depth_mm) for part in value])
        if value == "mm" and name in _UNIT_KEYS:
            return unit_of_maps(units)
        if not isinstance(value, (int, float)) or isinstance(value, bool):
            return value
        if name in DEPTH_KEYS:
            return elemental_set.stated_depth(value)
        if name in LENGTH_KEYS and units.depth == "disparity_px":
            return value * elemental_set.settings.camera.fx_px / depth_mm
        return value * light ** (2 if name.endswith("2") else 1) if name in LIGHT_KEYS else value

    converted: Record = convert("", record, None)
    return converted
